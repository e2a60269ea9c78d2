"""The dynamics of planar2 written out by hand, a truth that no engine took part in.

The textbook arm of two links (Spong, Hutchinson, Vidyasagar, *Robot Modeling and Control*, 2006, §7.4;
Siciliano et al., *Robotics*, 2009, §7.3.2), in the vertical x–z plane. With s₁ = sin q₁, c₁₂ = cos(q₁ + q₂)
and so on,

    r = (l₁c₁ + l₂c₁₂, 0, l₁s₁ + l₂s₁₂)

    H = [ I₁ + m₁a₁² + I₂ + m₂(l₁² + a₂² + 2 l₁a₂c₂) + d₁     I₂ + m₂(a₂² + l₁a₂c₂) ]
        [ I₂ + m₂(a₂² + l₁a₂c₂)                               I₂ + m₂a₂² + d₂       ]

    C = [ −h (2 q̇₁q̇₂ + q̇₂²) + g (m₁a₁ + m₂l₁) c₁ + g m₂a₂c₁₂ ]      h = m₂l₁a₂s₂
        [  h q̇₁²            + g m₂a₂c₁₂                       ]

where l is a length, a the distance of the centre of mass from the joint, I the moment about it normal to
the plane, and d a drive inertia. Positions are in the base frame; g acts along −z.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

LENGTH = (0.4, 0.3)  # m
MASS = (3.0, 2.0)  # kg
COM = (0.2, 0.15)  # m, from the joint
INERTIA = (0.041875, 0.0158)  # kg m², m (3 r² + l²) / 12 with r = 0.05, 0.04 m
DRIVE_INERTIA = (0.02, 0.01)  # kg m²
GRAVITY = 9.81  # m/s²


@dataclass(frozen=True)
class Terms:
    """What the closed form gives at one state; names, frames and units are those of the simulator.

    mass_matrix (2, 2) kg m², bias (2,) N m (Coriolis, centrifugal and gravity), position (3,) m of the tip
    in the base frame, jacobian (3, 2) m of the tip's velocity in the base frame, drift (3,) m/s² its J̇q̇.
    """

    mass_matrix: Array
    bias: Array
    position: Array
    jacobian: Array
    drift: Array


def terms(q: ArrayLike, v: ArrayLike, *, drive_inertia: bool = True) -> Terms:
    """Evaluate the closed form at joint angles (2,), rad, and their rates (2,), rad/s.

    `drive_inertia`: whether the drives' inertia is in the mass matrix.
    """
    (q1, q2), (w1, w2) = np.asarray(q, dtype=np.float64), np.asarray(v, dtype=np.float64)
    (l1, l2), (m1, m2), (a1, a2), (I1, I2) = LENGTH, MASS, COM, INERTIA
    d1, d2 = DRIVE_INERTIA if drive_inertia else (0.0, 0.0)
    s1, c1, s2, c2 = np.sin(q1), np.cos(q1), np.sin(q2), np.cos(q2)
    s12, c12 = np.sin(q1 + q2), np.cos(q1 + q2)

    h22 = I2 + m2 * a2**2
    h12 = h22 + m2 * l1 * a2 * c2
    h11 = I1 + m1 * a1**2 + h22 + m2 * (l1**2 + 2.0 * l1 * a2 * c2)
    h = m2 * l1 * a2 * s2
    g2 = GRAVITY * m2 * a2 * c12
    g1 = GRAVITY * (m1 * a1 + m2 * l1) * c1 + g2
    w12 = w1 + w2
    return Terms(
        mass_matrix=np.array([[h11 + d1, h12], [h12, h22 + d2]]),
        bias=np.array([-h * (2.0 * w1 * w2 + w2**2) + g1, h * w1**2 + g2]),
        position=np.array([l1 * c1 + l2 * c12, 0.0, l1 * s1 + l2 * s12]),
        jacobian=np.array([[-l1 * s1 - l2 * s12, -l2 * s12], [0.0, 0.0], [l1 * c1 + l2 * c12, l2 * c12]]),
        drift=np.array([-l1 * c1 * w1**2 - l2 * c12 * w12**2, 0.0, -l1 * s1 * w1**2 - l2 * s12 * w12**2]),
    )
