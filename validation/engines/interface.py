"""What every engine looks like from outside, and what stands in its place when it is not there.

An engine is made from a robot and the name of its tip. All arrays are in the column order of
`robot.joint_names`, SI units, base axes; f is the force of the surface *on the robot*, positive along +n [N].
What an engine cannot do it says, method by method and with the reason: `covers` and `cannot` together list
every method of `METHODS`, so nothing can be left out in silence.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from types import MappingProxyType
from typing import ClassVar, NoReturn

import numpy as np

from robot_models.coordinates import PLACES, RATES, balls
from validation.oracle.spatial import Array
from validation.oracle.urdf import RobotModel
from validation.tolerances import Tolerance

METHODS = (
    "mass_matrix",
    "bias",
    "gravity_term",
    "position",
    "jacobian",
    "drift",
    "free_acceleration",
    "stabilised",
    "constrained",
    "impulse",
)
"""The quantities that engines are compared in, each a method of that name."""

Robot = RobotModel
"""What an engine reads of a robot: format, text, joint_names, armature, tip, locked, gravity."""


class CannotBuild(ValueError):
    """The engine is installed but cannot represent this robot; the text says what stands in the way."""


class NotCovered(NotImplementedError):
    """The engine does not offer this quantity; the text is the reason that its class gives."""


class Engine:
    """The methods of an engine; a subclass overrides those that it covers and gives a reason for the others.

    Parameters
    ----------
    robot : a `robot_models.RobotModel`, or anything with the fields that `Robot` lists
    tip : link, body or site whose origin touches the surface

    Attributes
    ----------
    name : what tables call it
    package : the module that must be importable; None for what comes with this project
    install : the command that installs it; empty where nothing is to be installed
    balls : the first velocity of each joint that turns freely
    covers : names out of `METHODS` that it computes
    cannot : method → why not, for all others
    turns_freely : whether it is given joints that turn freely; q has rotation vectors, see `robot_models.coordinates`
    tolerances : method → its own bound, with the argument, where it is further from rounding than the harness asks
    """

    name: ClassVar[str]
    package: ClassVar[str | None] = None
    install: ClassVar[str] = ""
    covers: ClassVar[frozenset[str]]
    cannot: ClassVar[Mapping[str, str]] = MappingProxyType({})
    tolerances: ClassVar[Mapping[str, Tolerance]] = MappingProxyType({})
    turns_freely: ClassVar[bool] = False

    def __init__(self, robot: Robot, tip: str) -> None:
        self.n = len(robot.joint_names)
        self.balls = tuple(_balls(robot))

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        if set(cls.cannot) | cls.covers != set(METHODS) or set(cls.cannot) & cls.covers:
            raise TypeError(f"{cls.__name__}: covers and cannot must share out {METHODS} between them")
        for method in cls.covers:
            if getattr(cls, method) is getattr(Engine, method):
                raise TypeError(f"{cls.__name__} says that it covers {method} but does not define it")

    def mass_matrix(self, q: Array) -> Array:
        """Return H (n, n), armature included."""
        self._refuse("mass_matrix")

    def bias(self, q: Array, v: Array) -> Array:
        """Return C (n,): Coriolis, centrifugal and gravity."""
        self._refuse("bias")

    def gravity_term(self, q: Array) -> Array:
        """Return the gravity part of C (n,)."""
        self._refuse("gravity_term")

    def position(self, q: Array) -> Array:
        """Return the tip r (3,), base frame [m]."""
        self._refuse("position")

    def jacobian(self, q: Array) -> Array:
        """Return Jᵣ (3, n), base axes."""
        self._refuse("jacobian")

    def drift(self, q: Array, v: Array) -> Array:
        """Return J̇ᵣq̇ (3,), base axes [m/s²]."""
        self._refuse("drift")

    def free_acceleration(self, q: Array, v: Array, torque: Array) -> Array:
        """Return q̈ (n,) of the arm that touches nothing."""
        self._refuse("free_acceleration")

    def stabilised(self, q: Array, v: Array, normal: Array, offset: float, gains: Array) -> float:
        """Return b_s of Eq. 23 [m/s²]: −nᵀJ̇ᵣq̇ − s_v ė − s_p e with e = n·r − d and gains (s_v, s_p)."""
        self._refuse("stabilised")

    def constrained(self, q: Array, v: Array, torque: Array, normal: Array, b: float) -> tuple[Array, float]:
        """Return q̈ (n,) and f [N] of Eq. 24 with A = nᵀJᵣ: H q̈ + C = Q + Aᵀ f and A q̈ = b.

        Parameters
        ----------
        normal : (3,) unit n, base frame
        b : right-hand side of the closure [m/s²]; −nᵀJ̇ᵣq̇ keeps the tip in its plane
        """
        self._refuse("constrained")

    def impulse(self, q: Array, v: Array, normal: Array, restitution: float) -> tuple[Array, float]:
        """Return q̇⁺ (n,) and p [N s] of an impact: H (q̇⁺ − q̇) = Aᵀ p and A q̇⁺ = −ε A q̇."""
        self._refuse("impulse")

    def _refuse(self, method: str) -> NoReturn:
        raise NotCovered(f"{self.name} does not compute {method}: {self.cannot[method]}")


@dataclass(frozen=True)
class Missing:
    """An engine that is not installed: `install` is the command that would change that."""

    name: str
    install: str

    def __str__(self) -> str:
        return f"{self.name}: not installed ({self.install})"


@dataclass(frozen=True)
class Refused:
    """An engine that is installed but cannot be used here, and why."""

    name: str
    reason: str

    def __str__(self) -> str:
        return f"{self.name}: cannot be used here ({self.reason})"


def installed(engine: type[Engine]) -> bool:
    """Tell whether the engine's package is there, without importing it.

    A package that is there and breaks on import is a fault of its own and will show as one.
    """
    return engine.package is None or find_spec(engine.package) is not None


def columns_of(names: Mapping[str, int], robot: Robot, engine: str) -> Array:
    """Return, for each joint of the robot, its column in the engine: the one map between the two orders.

    Parameters
    ----------
    names : the engine's moving joints and their columns

    Raises
    ------
    CannotBuild
        If the engine has not exactly these joints.
    """
    names = dict(names)
    for first, joint in zip(_balls(robot), _ball_names(robot), strict=True):
        if (at := names.pop(joint, None)) is not None:
            places = [joint + end for end in PLACES]
            if set(places) <= set(robot.joint_names) and not set(places) & set(names):  # a free joint in one piece
                names |= {name: at + k for k, name in enumerate(places)}
                at += len(places)
            names |= {robot.joint_names[first + k]: at + k for k in range(3)}
    if set(names) != set(robot.joint_names) or sorted(names.values()) != list(range(len(names))):
        raise CannotBuild(
            f"{engine} made joints {sorted(names)} out of {sorted(robot.joint_names)}: one column each is needed"
        )
    return np.array([names[joint] for joint in robot.joint_names], dtype=int)


def _balls(robot: Robot) -> list[int]:
    """Return the first velocity of each ball joint, of which a robot that is no `RobotModel` has none."""
    return balls(getattr(robot, "joint_types", ()))


def _ball_names(robot: Robot) -> list[str]:
    return [robot.joint_names[j].removesuffix(RATES[0]) for j in _balls(robot)]


def refuse_balls(robot: Robot, engine: str) -> None:
    """Refuse joints that turn freely, for an engine whose adapter has none.

    Raises
    ------
    CannotBuild
    """
    if names := _ball_names(robot):
        raise CannotBuild(f"joint {names[0]!r} turns freely: {engine} is given joints of one variable here")
