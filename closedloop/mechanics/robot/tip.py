"""The tip's motion from that of its link: Eqs. 13-18 on the results of Pinocchio's passes.

`pinocchio.crba` computes the Jacobian of every joint and `pinocchio.nonLinearEffects` the velocity and acceleration of
every link, the latter for q̈ = 0 with the base accelerating upwards instead of gravity. They are transformed to the tip
inside the compiled step, which saves three calls. `Robot.terms` gets the same quantities from Pinocchio's own frame
functions; a test holds the two equal.
"""

from closedloop.base.arrays import Array
from closedloop.jit.kernel import kernel


@kernel
def tip_kinematics(
    joint_jacobian: Array, link: tuple[Array, Array, Array, Array], offset: Array, gravity: Array, support: Array,
    J: Array, r: Array, drift: Array,
) -> None:  # fmt: skip
    """Write the tip's Jacobian, position and drift.

    `joint_jacobian` (6, n): spatial Jacobian, linear part first, of the point of each link's body that is at the base
        origin; base axes.
    `link`, arrays (3, 3), (3,), (6,) and (6,): axes and origin of the link's joint frame in the base frame; spatial
        velocity and acceleration of the link, linear part first, in its joint frame: the acceleration is for q̈ = 0 and
        includes −gravity.
    `offset` (3,): tip in the link's joint frame, m.
    `gravity` (3,): m/s², base frame.
    `support` (n,): 1 for joints between the base and the tip, else 0.
    `J`, `r`, `drift`, (3, n), (3,), (3,) arrays: written: Jᵣ (Eq. 13), r, m, and J̇ᵣq̇ (Eq. 18), m/s², base axes.
    """
    rotation, origin, velocity, acceleration = link
    # ṗ = v + ω × o at the tip, in the joint frame
    w0, w1, w2 = velocity[3], velocity[4], velocity[5]
    a0, a1, a2 = acceleration[3], acceleration[4], acceleration[5]
    o0, o1, o2 = offset[0], offset[1], offset[2]
    u0 = velocity[0] + w1 * o2 - w2 * o1
    u1 = velocity[1] + w2 * o0 - w0 * o2
    u2 = velocity[2] + w0 * o1 - w1 * o0
    # p̈ = a + α × o + ω × ṗ: the spatial acceleration moved to the tip, and the r× term that makes it classical
    c0 = acceleration[0] + a1 * o2 - a2 * o1 + w1 * u2 - w2 * u1
    c1 = acceleration[1] + a2 * o0 - a0 * o2 + w2 * u0 - w0 * u2
    c2 = acceleration[2] + a0 * o1 - a1 * o0 + w0 * u1 - w1 * u0
    for k in range(3):
        r[k] = origin[k] + rotation[k, 0] * o0 + rotation[k, 1] * o1 + rotation[k, 2] * o2
        drift[k] = gravity[k] + rotation[k, 0] * c0 + rotation[k, 1] * c1 + rotation[k, 2] * c2
    # Jᵣ = J_lin − r × J_ang (Eq. 13)
    for j in range(J.shape[1]):
        s = support[j]
        b0, b1, b2 = joint_jacobian[3, j], joint_jacobian[4, j], joint_jacobian[5, j]
        J[0, j] = s * (joint_jacobian[0, j] + b1 * r[2] - b2 * r[1])
        J[1, j] = s * (joint_jacobian[1, j] + b2 * r[0] - b0 * r[2])
        J[2, j] = s * (joint_jacobian[2, j] + b0 * r[1] - b1 * r[0])
