"""The states that engines are compared at: drawn by seed, inside the joint limits, and on purpose near singular poses.

State k of a seed is the same however many are drawn, so that a single one can be looked at again.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from validation.oracle.spatial import Array

# Every so many states the normal is the direction in which the pose lets the tip move least.
SINGULAR_EVERY = 5
# Such a pose is the worst of so many draws; a direction that the tip cannot move in at all is passed over.
CANDIDATES = 20
SMALLEST_SHARE = 1e-3


class Limited(Protocol):
    """What drawing states needs of a robot."""

    joint_names: tuple[str, ...]
    position_lower: Array
    position_upper: Array


class Kinematics(Protocol):
    """What finding near-singular poses needs of an engine."""

    def jacobian(self, q: Array) -> Array:
        """Return Jᵣ (3, n)."""
        ...


@dataclass(frozen=True)
class State:
    """A state and what acts in it.

    q, v, torque: (n,), joint positions, velocities and torques
    normal: (3,), unit normal of the surface, base frame
    b: what the closure asks of A q̈ beyond −nᵀJ̇ᵣq̇, m/s²
    error: closure error e that the plane leaves at q, m; the plane's offset follows from it
    restitution: of an impact, in [0, 1]
    singular: whether it was looked for near a singular pose
    """

    index: int
    q: Array
    v: Array
    torque: Array
    normal: Array
    b: float
    error: float
    restitution: float
    singular: bool


def draw_state(robot: Limited, kinematics: Kinematics, seed: int, index: int) -> State:
    """Draw state number `index` of `seed`.

    Positions are uniform within the limits (within ±π or ±1 m where there are none), velocities and torques normal with
    deviation 1 rad/s and 20 N m, normals uniform on the sphere.
    """
    rng = np.random.default_rng([seed, index])
    lower = np.where(np.isfinite(robot.position_lower), robot.position_lower, -np.pi)
    upper = np.where(np.isfinite(robot.position_upper), robot.position_upper, np.pi)
    n = len(robot.joint_names)
    singular = index % SINGULAR_EVERY == SINGULAR_EVERY - 1
    normal = rng.normal(size=3)
    q = rng.uniform(lower, upper)
    if singular:
        share = np.inf
        for candidate in rng.uniform(lower, upper, size=(CANDIDATES, n)):
            U, s, _ = np.linalg.svd(np.asarray(kinematics.jacobian(candidate)))
            movable = np.flatnonzero(s > SMALLEST_SHARE * s[0])
            if movable.size and s[movable[-1]] / s[0] < share:
                q, normal, share = candidate, U[:, movable[-1]], s[movable[-1]] / s[0]
    else:
        # A planar arm's tip cannot leave its plane: lean the normal into what the tip can do.
        U, s, _ = np.linalg.svd(np.asarray(kinematics.jacobian(q)))
        reach = U[:, : s.size] @ (np.where(s > SMALLEST_SHARE * s[0], 1.0, 0.0) * (U[:, : s.size].T @ normal))
        normal = reach if np.linalg.norm(reach) > 1e-3 else U[:, 0]
    return State(
        index=index,
        q=q,
        v=rng.normal(size=n),
        torque=rng.normal(scale=20.0, size=n),
        normal=normal / np.linalg.norm(normal),
        b=float(rng.normal()),
        # A centimetre: of a smaller error, e = n·r − d would keep fewer digits than the comparison looks at.
        error=0.01 * float(rng.normal()),
        restitution=float(rng.uniform()),
        singular=singular,
    )


def draw_states(robot: Limited, kinematics: Kinematics, seed: int, count: int) -> list[State]:
    """Draw the first `count` states of `seed`."""
    return [draw_state(robot, kinematics, seed, index) for index in range(count)]
