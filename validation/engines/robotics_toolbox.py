# ruff: noqa: D102 - what a method returns is said once, in `interface.Engine`
"""The Robotics Toolbox, which the paper names: H by repeated Newton–Euler passes, and the Jacobians of Eqs. 26–27."""

from importlib import import_module
from types import MappingProxyType
from typing import Any

import numpy as np

from validation.engines.interface import CannotBuild, Engine, Robot
from validation.oracle.spatial import Array, about_centre, axes_about
from validation.oracle.tree import GROUND, Tree, UnsupportedModel, read_urdf

_NO_CLOSURE = "the toolbox simulates the open tree; it has no closure equation"


class RoboticsToolbox(Engine):
    """Peter Corke's Robotics Toolbox for Python, the successor of the MATLAB toolbox that the paper refers to.

    Joint order: the robot's own, given as `jindex`. Frames: the toolbox turns about and slides along the z axis of a
    link, so each link frame is turned until its joint axis is z; ``jacob0`` gives linear rows first, base axes,
    reference point at the tip. Armature: motor inertia `Jm` with gear ratio 1, which ``rne`` adds. Gravity:
    `Robot.gravity`, the acceleration of free fall. The merged bodies of `validation.oracle.tree` are what it is built
    from, as its reader of URDF drops the rotation of inertial frames; everything computed is the toolbox's.

    H is the method of Walker and Orin (1982) that the paper compares the composite-rigid-body algorithm with: one
    Newton–Euler pass a column. C is one pass at q̈ = 0 (``rne``); ``coriolis``, which makes the same of n (n + 1)/2
    passes at unit speeds, is `coriolis_and_gravity`. The drift contracts ``hessian0`` with q̇ twice.

    Accuracy: rounding; times the condition number of H in q̈.
    """

    name = "robotics toolbox"
    package = "roboticstoolbox"
    install = 'pip install "roboticstoolbox-python>=1.5"'
    covers = frozenset({"mass_matrix", "bias", "gravity_term", "position", "jacobian", "drift", "free_acceleration"})
    cannot = MappingProxyType(dict.fromkeys(("stabilised", "constrained", "impulse"), _NO_CLOSURE))

    def __init__(self, robot: Robot, tip: str) -> None:
        super().__init__(robot, tip)
        try:
            tree = read_urdf(robot)
            tree.frame(tip)
        except (UnsupportedModel, KeyError) as error:
            raise CannotBuild(str(error)) from error
        if tree.frame(tip).body == GROUND:
            raise CannotBuild("the tip does not move: the toolbox has no path of joints to it")
        self.robot, self.path = _build(tree, tip)
        # ``coriolis`` works on a copy without friction whose links (1.5.0) still name parents of the original and are
        # not found; this robot has no friction, so it is its own copy.
        self.robot.nofriction = lambda *_: self.robot

    def mass_matrix(self, q: Array) -> Array:
        return np.atleast_2d(self.robot.inertia(_finite(q)))

    def bias(self, q: Array, v: Array) -> Array:
        return np.atleast_1d(self.robot.rne(_finite(q), _finite(v), np.zeros(self.n)))

    def coriolis_and_gravity(self, q: Array, v: Array) -> Array:
        """Return C (n,) as the toolbox's users write it: ``coriolis(q, q̇) q̇ + gravload(q)``."""
        return np.asarray(np.atleast_2d(self.robot.coriolis(_finite(q), _finite(v))) @ v + self.gravity_term(q))

    def gravity_term(self, q: Array) -> Array:
        return np.atleast_1d(self.robot.gravload(_finite(q)))

    def position(self, q: Array) -> Array:
        return np.array(self.robot.fkine(_finite(q), end="tip").t)

    def jacobian(self, q: Array) -> Array:
        return self._columns(self.robot.jacob0(_finite(q), end="tip"))[:3]

    def drift(self, q: Array, v: Array) -> Array:
        # hessian0[i, :, j] = ∂J[:, j]/∂q_i, of the joints on the path to the tip.
        along = _finite(v)[self.path]
        H = self.robot.hessian0(_finite(q), end="tip")
        return np.asarray(np.einsum("irj,i,j->r", H, along, along)[:3])

    def free_acceleration(self, q: Array, v: Array, torque: Array) -> Array:
        return np.atleast_1d(self.robot.accel(_finite(q), _finite(v), torque))

    def toolbox_jacobians(self, q: Array) -> tuple[Array, Array]:
        """Return J₀ and Jₙ of Eqs. 26–27, (6, n) each: ``jacob0`` and ``jacobe``, angular rows first.

        Jₙ is along the axes of the frame of the link named as the tip.
        """
        both = (self.robot.jacob0(_finite(q), end="tip"), self.robot.jacobe(_finite(q), end="tip"))
        linear_first = [self._columns(J) for J in both]
        return (np.roll(linear_first[0], 3, axis=0), np.roll(linear_first[1], 3, axis=0))

    def _columns(self, J: Any) -> Array:
        """Return a Jacobian (6, n) from that of the joints on the path."""
        out = np.zeros((6, self.n))
        out[:, self.path] = J
        return out


def _finite(x: Array) -> Array:
    x = np.asarray(x, dtype=float)
    if not np.all(np.isfinite(x)):
        raise ValueError("q and v must be finite")
    return x


def _build(tree: Tree, tip: str) -> tuple[Any, list[int]]:
    """Return the toolbox's robot and the columns of the joints on the path to the tip."""
    rtb: Any = import_module("roboticstoolbox")  # its own types confuse its classes with the modules they stand in
    from spatialmath import SE3

    turned = [axes_about(axis) for axis in tree.axis]

    def pose(rotation: Array, translation: Array) -> Any:
        return rtb.ET.SE3(SE3(_homogeneous(rotation, translation), check=False))

    links: list[Any] = [rtb.Link(name="base")]
    for i, above in enumerate(tree.parent):
        before = np.eye(3) if above == GROUND else turned[above].T
        placed = pose(before @ tree.rotation[i] @ turned[i], before @ tree.translation[i])
        moves = rtb.ET.tz(jindex=i) if tree.kinds[i] == "prismatic" else rtb.ET.Rz(jindex=i)
        mass, centre, inertia = about_centre(tree.inertia[i])
        parent, body = "base" if above == GROUND else f"joint{above}", {"m": mass, "r": turned[i].T @ centre}
        body |= {"I": turned[i].T @ inertia @ turned[i], "Jm": float(tree.armature[i]), "G": 1.0}
        links.append(rtb.Link(rtb.ETS([placed, moves]), name=f"joint{i}", parent=parent, **body))
    frame = tree.frame(tip)
    after = turned[frame.body].T
    end = rtb.ETS([pose(after @ frame.rotation, after @ frame.translation)])
    links.append(rtb.Link(end, name="tip", parent=f"joint{frame.body}"))
    robot = rtb.Robot(links, gravity=np.array(tree.gravity))
    return robot, [int(i) for i in np.flatnonzero(tree.supports[:, frame.body])]


def _homogeneous(rotation: Array, translation: Array) -> Array:
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = rotation, translation
    return out
