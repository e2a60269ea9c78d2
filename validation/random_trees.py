"""Seeded random robots: any topology, every joint type, possible bodies; as a tree and as URDF text.

The tree is built from the drawn numbers and not from the text, so that reading the text can be tested against
it. The text has 17 significant digits, from which every engine recovers the same doubles.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from validation.oracle.spatial import Array, rotation_from_rpy
from validation.oracle.tree import MOVING, Joint, Link, Tree, build_tree


@dataclass(frozen=True)
class RandomRobot:
    """A random robot, with the fields of a loaded one and the tree that its numbers make.

    joint_names, joint_types (n,) in column order; armature (n,); gravity (3,) [m/s²]; home, position_lower,
    position_upper (n,) [rad] or [m]; tip : a fixed massless link at the end of a branch
    """

    name: str
    text: str
    tree: Tree
    joint_names: tuple[str, ...]
    joint_types: tuple[str, ...]
    armature: Array
    gravity: Array
    tip: str
    home: Array
    position_lower: Array
    position_upper: Array
    format: str = "urdf"
    locked: Mapping[str, float] = field(default_factory=dict)


def random_robot(
    seed: int,
    *,
    joints: int | None = None,
    branching: bool = True,
    kinds: Sequence[str] = MOVING,
    drive_inertia: bool = True,
    gravity: Array | None = None,
) -> RandomRobot:
    """Return the random robot of a seed.

    seed: the same seed is the same robot
    joints: number of moving joints; 2 to 12 at random by default
    branching: let links carry several others; else the robot is one chain, with the tip at its end
    gravity: (3,) base frame [m/s²]; 9.81 in a random direction by default
    """
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 13)) if joints is None else joints
    draft = _Draft(rng)
    bodies = [draft.add_link("base", massive=bool(rng.integers(2)))]
    names: list[str] = []
    types: list[str] = []
    for i in range(n):
        # A new link hangs on any earlier one, on the newest twice as often: branches, but long ones too.
        above = str(rng.choice(bodies)) if branching and rng.random() < 0.5 else bodies[-1]
        types.append(str(rng.choice(kinds)))
        # Letters in random order, as engines that sort joints by name must not get away with it.
        names.append(f"{'zyxwvutsrqponmlkjihgfedcba'[rng.integers(26)]}{i}")
        bodies.append(draft.add_link(f"link{i}", massive=True))
        draft.add_joint(names[-1], types[-1], above, bodies[-1])
        if rng.random() < 0.3:
            extra = draft.add_link(f"attached{i}", massive=rng.random() < 0.7)
            draft.add_joint(f"weld{i}", "fixed", bodies[-1], extra)
            if rng.random() < 0.5:  # let the branch go on from the attached link
                bodies[-1] = extra
    draft.add_link("tip", massive=False)
    draft.add_joint("tip_mount", "fixed", bodies[-1], "tip")
    armature = 10.0 ** rng.uniform(-3.0, 0.0, n) if drive_inertia else np.zeros(n)
    fall = 9.81 * _direction(rng) if gravity is None else np.asarray(gravity, dtype=float)
    tree = build_tree(draft.links, draft.joints, joint_names=names, armature=armature, gravity=fall)
    reach = np.where(np.array(types) == "prismatic", 0.5, np.pi)
    return RandomRobot(
        name=f"random{seed}",
        text=draft.text(f"random{seed}"),
        tree=tree,
        joint_names=tuple(names),
        joint_types=tuple(types),
        armature=armature,
        gravity=fall,
        tip="tip",
        home=np.zeros(n),
        position_lower=-reach,
        position_upper=reach,
    )


def random_state(robot: RandomRobot, rng: np.random.Generator) -> tuple[Array, Array]:
    """Return q within the robot's limits and rates of order one, both (n,)."""
    return rng.uniform(robot.position_lower, robot.position_upper), rng.normal(size=len(robot.joint_names))


def random_body(rng: np.random.Generator) -> tuple[float, Array, Array]:
    """Return mass [kg], centre of mass (3,) [m] and tensor (3, 3) [kg m²] of a cloud of mass points.

    A tensor summed over points satisfies the triangle inequality of its principal moments, as one drawn entry
    by entry need not.
    """
    points = rng.uniform(-0.2, 0.2, (8, 3)) * rng.uniform(0.2, 1.0, 3) + rng.uniform(-0.3, 0.3, 3)
    masses = rng.uniform(0.05, 0.5, 8)
    mass = float(np.sum(masses))
    centre = masses @ points / mass
    arms = points - centre
    tensor = np.sum(masses * np.sum(arms**2, axis=1)) * np.eye(3) - (arms.T * masses) @ arms
    return mass, centre, (tensor + tensor.T) / 2


class _Draft:
    """Links and joints as they are drawn, each in numbers and in text."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng
        self.links: list[Link] = []
        self.joints: list[Joint] = []
        self._link_texts: list[str] = []
        self._joint_texts: list[str] = []

    def add_link(self, name: str, *, massive: bool) -> str:
        """Draw a link; its inertial frame is turned by a random rpy."""
        if not massive:
            self.links.append(Link(name))
            self._link_texts.append(f'  <link name="{name}"/>')
            return name
        mass, centre, tensor = random_body(self.rng)
        rpy = self.rng.uniform(-np.pi, np.pi, 3)
        turned = rotation_from_rpy(rpy)
        self.links.append(Link(name, mass, centre, turned @ tensor @ turned.T))
        entries = {"ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2), "iyy": (1, 1), "iyz": (1, 2), "izz": (2, 2)}
        inertia = " ".join(f'{key}="{tensor[at]:.17g}"' for key, at in entries.items())
        self._link_texts.append(
            f'  <link name="{name}">\n    <inertial>\n'
            f'      <origin xyz="{_text(centre)}" rpy="{_text(rpy)}"/>\n'
            f'      <mass value="{mass:.17g}"/>\n      <inertia {inertia}/>\n    </inertial>\n  </link>'
        )
        return name

    def add_joint(self, name: str, kind: str, parent: str, child: str) -> None:
        """Draw a joint; now and then one along a coordinate axis, as engines treat those apart."""
        xyz = self.rng.uniform(-0.4, 0.4, 3)
        rpy = np.zeros(3) if self.rng.random() < 0.2 else self.rng.uniform(-np.pi, np.pi, 3)
        axis = _direction(self.rng)
        if self.rng.random() < 0.3:
            axis = np.eye(3)[self.rng.integers(3)] * self.rng.choice([-1.0, 1.0])
        self.joints.append(Joint(name, kind, parent, child, rotation_from_rpy(rpy), xyz, axis))
        lines = [
            f'  <joint name="{name}" type="{kind}">',
            f'    <parent link="{parent}"/>\n    <child link="{child}"/>',
            f'    <origin xyz="{_text(xyz)}" rpy="{_text(rpy)}"/>',
        ]
        if kind != "fixed":
            lines.append(f'    <axis xyz="{_text(axis)}"/>')
        if kind in ("revolute", "prismatic"):
            lines.append('    <limit lower="-10" upper="10" effort="1000" velocity="100"/>')
        self._joint_texts.append("\n".join([*lines, "  </joint>"]))

    def text(self, name: str) -> str:
        """Return the URDF, joints in an order of its own: the order in a file means nothing."""
        order = np.random.default_rng(len(self.joints)).permutation(len(self.joints))
        parts = self._link_texts + [self._joint_texts[i] for i in order]
        return "\n".join([f'<?xml version="1.0"?>\n<robot name="{name}">', *parts, "</robot>\n"])


def _direction(rng: np.random.Generator) -> Array:
    """Return a random unit vector (3,)."""
    draw = rng.normal(size=3)
    return np.asarray(draw / np.linalg.norm(draw))


def _text(numbers: Array) -> str:
    """Return the numbers in 17 significant digits, enough to read the same doubles back."""
    return " ".join(f"{number:.17g}" for number in numbers)
