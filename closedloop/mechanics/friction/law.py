"""What every law of friction is: a section of the scenario, its states, how it sticks, its functions and parameters.

    F_t = −f c − w        friction of the surface on the tip, N, along d = 2 tangents; c (d,) without unit, w (d,) in N
    τ   = −c − w          friction of one joint, N m: d = 1 and f = 1

Two dimensions are isotropic: only lengths and directions enter. Since c and w do not depend on f, Eq. 24 stays linear
in it.

A law of one's own is a class derived from `SurfaceFriction`, from `JointFriction` or from both, with its parameters as
typed fields. Those that ship are in `closedloop.mechanics.friction.laws`, one file each, written the same way.

    class Smooth(SurfaceFriction):
        coefficient: Annotated[NotNegative, COEFFICIENT] = Field(0.3, description="coefficient of fast slip, 1")
        speed: Annotated[Positive, SPEED_SCALE] = Field(1e-3, description="slip speed of 1/√2 of it, m/s")

        @staticmethod
        def slide(x, par, z, c, w):
            for k in range(c.size):
                c[k] = par.coefficient * x.u[k] / math.hypot(x.speed, par.speed)

The functions are compiled: they take arrays and numbers, call functions of numpy, math and numba's own, and write into
the arrays that they are given.
"""

import math
from typing import Annotated, Any, ClassVar, Literal, NamedTuple

from pydantic import AfterValidator, ValidationInfo, field_validator

from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError
from closedloop.base.families import Family, Parameters
from closedloop.base.sections import (
    COEFFICIENT,
    JOINT_SPEED_SCALE,
    PERIOD,
    SPEED_SCALE,
    TORQUE,
    Gain,
    NotNegative,
    Positive,
    Size,
    stiffness_in,
    viscous_in,
)
from closedloop.jit.kernel import kernel
from closedloop.jit.parameters import Named, one_joint_block, pack, pack_each_joint, parameter_block

Figure = float | tuple[float, ...]

# A joint no faster than this, rad/s (m/s), rests: more than the rounding of a velocity that friction has stopped.
AT_REST = 1e-9


def entries(value: Figure) -> tuple[float, ...]:
    """Return one number, or one per joint, as a tuple."""
    return value if isinstance(value, tuple) else (value,)


def _each(value: Figure, least: float, cure: str) -> Figure:
    """Refuse an entry below `least`, or at it if `least` is the smallest number above 0."""
    for index, entry in enumerate(entries(value)):
        if not entry >= least:
            raise ValueError(f"entry {index} is {entry:g}: {cure}" if isinstance(value, tuple) else cure)
    return value


EXPONENT = Size(1e3, "", "the curve is a step", 1e-3, "the curve is flat")
JointNotNegative = Annotated[Gain, AfterValidator(lambda value: _each(value, 0.0, "must not be negative"))]
JointPositive = Annotated[Gain, AfterValidator(lambda value: _each(value, 5e-324, "must be greater than 0"))]

Coefficient = Annotated[NotNegative, COEFFICIENT]
# Of a law with one level: the functions of the law have it as `kinetic`, as a joint's.
Level = Annotated[Coefficient, Named("kinetic")]
PositiveCoefficient = Annotated[Positive, COEFFICIENT]
PositiveLevel = Annotated[PositiveCoefficient, Named("kinetic")]
Viscous = Annotated[NotNegative, viscous_in("N s/m")]
Damping = Annotated[NotNegative, viscous_in("s/m")]
SlipSpeed = Annotated[Positive, SPEED_SCALE]
Stiffness = Annotated[Positive, stiffness_in("1/m")]
Exponent = Annotated[Positive, EXPONENT]
Span = Annotated[NotNegative, PERIOD]
Torque = Annotated[JointNotNegative, TORQUE]
PositiveTorque = Annotated[JointPositive, TORQUE]
JointViscous = Annotated[JointNotNegative, viscous_in("N m s/rad")]
JointSpeed = Annotated[JointPositive, JOINT_SPEED_SCALE]
JointStiffness = Annotated[JointPositive, stiffness_in("N m/rad")]
JointExponent = Annotated[JointPositive, EXPONENT]
JointSpan = Annotated[JointNotNegative, PERIOD]


# Slip below this speed, m/s or rad/s, has no direction of its own: it is rounding.
STILL = 1e-12


class Slip(NamedTuple):
    """The slip of a contact, d = 2, or the motion of a joint, d = 1; m/s, or rad/s.

    Attributes
    ----------
    u : (d,) array
        Velocity of the tip on the surface, or of the joint.
    speed : float
        |u|.
    delayed_speed : float
        |u| of `lag` ago; |u| itself for a law without memory.
    direction : (d,) array
        Unit vector along which slip starts, or along which the slip was that has just ended; zero where none is to
        start: then there is no force but that of the states.
    """

    u: Array
    speed: float
    delayed_speed: float
    direction: Array


@kernel
def length_of(u: Array) -> float:
    """Return |u| of a (1,) or (2,) vector."""
    return abs(u[0]) if u.shape[0] == 1 else math.hypot(u[0], u[1])


@kernel
def against_slip(x: Slip, level: float, c: Array) -> None:
    """Write c (d,) of the size `level` along the slip, or along `direction` where there is none to speak of."""
    for k in range(c.shape[0]):
        c[k] = level * (x.u[k] / x.speed if x.speed > STILL else x.direction[k])


@kernel
def viscous_part(x: Slip, b: float, w: Array) -> None:
    """Write w = b u (d,), N or N m."""
    for k in range(w.shape[0]):
        w[k] = b * x.u[k]


class FrictionLaw(Parameters):
    """What laws of friction share, of the surface and of joints.

    `par` has the parameters by name; for a joint, those of this joint. `z` has the states, and `dz` their rates. When
    each function is asked:

        rest           at the start, of a contact that is not slipping; of one just made, all states are zero
        slide          at each state, while it slides, and always if the law sticks "elastic"
        hold           at each state, while it is stuck, if the law sticks "spring"
        rates, decay   in a scheme of Runge and Kutta, of a law with states
        advance        in a step of the semi-implicit scheme, of a law with states
        stick_limit    to see whether sticking begins or ends
        stick          where slip ends and sticking begins, if the law sticks "spring"

    Attributes
    ----------
    sticks : str
        "rigid"    sticking is a constraint, u = 0, which the simulator solves; it ends at `stick_limit`
        "elastic"  no mode of its own: one smooth law, with or without states
        "spring"   a mode in which the force is that of a spring (`hold`); it ends at `stick_limit`
    states, slip_states : tuple of str
        Names of the states: numbers, and vectors (d,) along the surface.
    """

    folder: ClassVar[str] = "closedloop.mechanics.friction.laws"
    sticks: ClassVar[Literal["rigid", "elastic", "spring"]] = "elastic"
    states: ClassVar[tuple[str, ...]] = ()
    slip_states: ClassVar[tuple[str, ...]] = ()

    @field_validator("static", check_fields=False)
    @classmethod
    def _static_is_the_larger(cls, value: Figure, info: ValidationInfo) -> Figure:
        if "kinetic" in info.data:  # else it is at fault itself
            levels, floors = entries(value), entries(info.data["kinetic"])
            count = max(len(levels), len(floors))
            if len(levels) not in (1, count) or len(floors) not in (1, count):
                raise ValueError(f"must have as many entries as kinetic, {len(floors)}")
            for index in range(count):
                a, b = levels[index % len(levels)], floors[index % len(floors)]
                if a < b:
                    place = f"entry {index} is {a:g}: " if count > 1 else ""
                    raise ValueError(f"{place}must not be below kinetic, {b:g}: static friction is the larger")
        return value

    @classmethod
    def has_states(cls) -> bool:
        """Whether the law has states."""
        return bool(cls.states or cls.slip_states)

    @classmethod
    def check_functions(cls, key: str) -> None:
        """Refuse a class that lacks a function which a law that sticks as it does, with its states, must have."""
        wanted = ["slide"]
        wanted += ["rates", "advance"] if cls.has_states() else []
        wanted += {"rigid": ["stick_limit"], "elastic": [], "spring": ["stick_limit", "hold", "stick"]}[cls.sticks]
        if lacking := [name for name in wanted if getattr(cls, name) is getattr(FrictionLaw, name)]:
            raise ScenarioError(f"{key} = {cls.member_name()}: must define {', '.join(lacking)}")

    def energy_fault(self, load: float = 1.0, n: int | None = None) -> str | None:
        """Return why this friction might add energy and what would keep it from it, or None if it never does.

        Parameters
        ----------
        load : float
            The largest normal force on the surface, N; 1 for joints.
        n : int, optional
            The number of joints; left out for a surface.
        """
        return None

    @staticmethod
    def slide(x: Slip, par: Any, z: Any, c: Array, w: Array) -> None:
        """Write the friction of a contact that slides: c (d,), without unit (N m for a joint), and w (d,), N (N m).

        Both are zero when it is asked.
        """

    @staticmethod
    def hold(par: Any, z: Any, c: Array) -> None:
        """Write the friction c (d,) of a contact that is stuck on a spring; it is zero when it is asked."""

    @staticmethod
    def rates(x: Slip, par: Any, z: Any, stuck: bool, dz: Any) -> None:
        """Write ż; `stuck` matters to laws that stick as a spring alone."""

    @staticmethod
    def decay(x: Slip, par: Any, z: Any, stuck: bool, a: Any) -> None:
        """Write a >= 0, 1/s, of each state that decays by itself, ż = g − a z, fast; a is zero when it is asked.

        A step then takes the decay exactly. Without it, it must resolve it: a h < 2.8 with rk4.
        """

    @staticmethod
    def advance(x: Slip, par: Any, z: Any, stuck: bool, h: float) -> None:
        """Overwrite z with its value h seconds later if the slip stays what it is; best exactly, for any h >= 0."""

    @staticmethod
    def stick(x: Slip, par: Any, z: Any) -> None:
        """Overwrite z where slip along `x.direction` has ended and sticking begins."""

    @staticmethod
    def rest(par: Any, z: Any) -> None:
        """Write z of a contact that has rested for long; all of it is zero when it is asked."""

    @staticmethod
    def stick_limit(par: Any, z: Any) -> float:
        """Return the largest |F_t|/f that sticking resists, without unit (N m for a joint).

        Of an elastic law it is the largest level of slow sliding: loads below it are held, after a creep of microns.
        """
        return 0.0

    @staticmethod
    def kinetic_level(par: Any) -> float:
        """Return |F_t|/f of fast slip without its viscous part (N m for a joint): of a surface, μ of an impact."""
        return 0.0

    @staticmethod
    def capture_speed(par: Any) -> float:
        """Return the slip speed up to which sticking is tried, m/s (rad/s)."""
        return 0.0

    @staticmethod
    def lag(par: Any) -> float:
        """Return by how much the friction lags the slip, s."""
        return 0.0

    @staticmethod
    def stored_energy(par: Any, z: Any, stuck: bool) -> float:
        """Return the energy stored in the contact per newton of normal force, m; of a joint, J.

        With f constant F_t·u + f d/dt(this) <= 0: friction never adds energy, unless `energy_fault` says so. Where f
        changes, f·this changes with it: pressing harder on bent bristles stiffens them.
        """
        return 0.0


class SurfaceFriction(FrictionLaw):
    """[friction]: of the tip on the surface; its levels have no unit, and the normal force multiplies them."""


class JointFriction(FrictionLaw):
    """[joint_friction]: in the joints, in N m; a parameter may be one number for all joints, or one per joint."""


SURFACE_LAWS, JOINT_LAWS = Family(SurfaceFriction, usual="none"), Family(JointFriction, usual="none")


def surface_parameters(section: FrictionLaw) -> Any:
    """Return what the functions of a law of the surface's friction read."""
    return parameter_block(type(section))(pack(section, 1, "friction"), 1)


def joint_parameters(section: FrictionLaw, n: int | None = None) -> list[Any]:
    """Return what the functions of a law of the joints' friction read, for each joint.

    `section`: a section of friction.
    `n`: the number of joints; left out, it is that of the longest list in the section.
    """
    kind = type(section)
    if n is None:
        given = (getattr(section, name) for name in kind.model_fields)
        n = max((len(value) for value in given if isinstance(value, tuple)), default=1)
    return [one_joint_block(kind)(row, n) for row in pack_each_joint(section, n, "joint_friction")]
