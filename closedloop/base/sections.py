"""Base types of a scenario's sections: strict numbers and lists, no unknown keys.

The magnitude of a number is bounded: `Size` gives the bounds, the unit and the reason. The bounds below are far outside
of any arm's values, and far inside of the range of a double, so that products, squares and quotients never overflow. A
key takes one of them, or its own; one that any number may be takes `Unit`:

    force: Annotated[Number, FORCE] = Field(10.0, description=...)
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Self, get_args

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, GetCoreSchemaHandler
from pydantic.fields import FieldInfo
from pydantic_core import CoreSchema, core_schema

from closedloop.base.errors import ScenarioError
from closedloop.base.upwards import called
from robot_models.errors import shown


def _number(value: Any) -> Any:
    """Refuse what Python would quietly turn into a number."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise ValueError("must be a number")
    try:
        return float(value)
    except OverflowError:
        raise ValueError("must be a number below 1e308") from None


def _nothing(value: Any) -> Any:
    """Refuse a number that says something where there is nothing that it could be of."""
    if _number(value) != 0.0:
        raise ValueError("must be left out")
    return 0.0


def _boolean(value: Any) -> Any:
    if not isinstance(value, bool):
        raise ValueError("must be true or false")
    return value


def _pointing(value: tuple[float, float, float]) -> tuple[float, float, float]:
    """Refuse a vector without a length."""
    if not any(value):
        raise ValueError("has no direction; give a vector such as [0, 0, 1]")
    return value


def gain_of(value: Any) -> Any:
    """Return one number, or a list of them as a tuple; pydantic's union would blame a branch not meant."""
    if not isinstance(value, (list, tuple)):
        return _finite(value)
    if {*map(type, value)} == {float} and all(map(math.isfinite, value)):
        return tuple(value)
    for index, entry in enumerate(value):
        try:
            _finite(entry)
        except ValueError:
            raise ValueError(f"entry {index} is {shown(entry)}: must be a finite number") from None
    return tuple(float(entry) for entry in value)


def gains_not_negative(value: float | tuple[float, ...], *, zero: bool = True) -> float | tuple[float, ...]:
    """Refuse a negative number, or one in a list, and zero too if it is not allowed."""
    must = "must not be negative" if zero else "must be greater than 0"
    for index, entry in enumerate(value if isinstance(value, tuple) else (value,)):
        if entry < 0.0 or (entry == 0.0 and not zero):
            raise ValueError(f"entry {index} is {entry:g}: {must}" if isinstance(value, tuple) else must)
    return value


def _finite(value: Any) -> float:
    number = float(_number(value))
    if not math.isfinite(number):
        raise ValueError("must be finite, not NaN or infinite")
    return number


@dataclass(frozen=True)
class Unit:
    """The unit of a number that has no `Size`, or of each entry of a list."""

    unit: str  # "" for a number without one; "rad (m)" where it is the second for a prismatic joint


Number = Annotated[float, BeforeValidator(_number)]
Positive = Annotated[float, BeforeValidator(_number), Field(gt=0.0)]
NotNegative = Annotated[float, BeforeValidator(_number), Field(ge=0.0)]
# A number that a kind has no use for: a key of its family, left out or 0.
_LEFT_OUT = BeforeValidator(_nothing)
Nothing = Annotated[float, _LEFT_OUT]
Instant = Annotated[NotNegative, Unit("s")]
Restitution = Annotated[float, BeforeValidator(_number), Field(ge=0.0, le=1.0), Unit("")]
Flag = Annotated[bool, BeforeValidator(_boolean)]
Direction = Annotated[tuple[Number, Number, Number], AfterValidator(_pointing), Unit("")]
PerJoint = tuple[Number, ...]
Gain = Annotated[float | tuple[float, ...], BeforeValidator(gain_of)]


def _one_line(value: Any) -> Any:
    """A name stands in headers and comments of the files that are written, so nothing in it ends a line."""
    if isinstance(value, str) and not value.isprintable():
        raise ValueError("must be a name on one line, of characters that can be printed")
    return value


OneLine = Annotated[str, BeforeValidator(_one_line)]


class SizeError(ValueError):
    """A number is too large or too small."""


@dataclass(frozen=True)
class Size:
    """Bounds of the magnitude of a number that is not zero, or of each entry of a list.

    Whether zero or negative numbers are allowed is a matter of the annotated type.
    """

    most: float  # the largest magnitude
    unit: str  # its unit, see `Unit`
    why: str  # why there are no larger ones, for the message
    least: float = 0.0  # the smallest magnitude of a number that is not zero
    tiny: str = "so small a value cannot be distinguished from zero"  # why there are no smaller ones

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        """Check after whatever the annotated type checks."""
        return core_schema.no_info_after_validator_function(self.check, handler(source))

    def check(self, value: Any) -> Any:
        """Return the value, a number or a list of numbers; anything else passes."""
        if isinstance(value, tuple):
            for index, entry in enumerate(value):
                if fault := self.fault(entry):
                    raise SizeError(f"entry {index} is {entry:g}: {fault}")
        elif isinstance(value, float) and (fault := self.fault(value)):
            raise SizeError(fault)
        return value

    def fault(self, value: float) -> str:
        """Return what would be right in place of this number, or "" if it is."""
        size = abs(value)
        if self.least <= size <= self.most or size == 0.0:
            return ""
        unit = f" {self.unit}" if self.unit else ""
        if not size <= self.most:
            bound = f"at most {self.most:g}" if value > 0.0 else f"at least {-self.most:g}"
            return f"must be {bound}{unit}: {self.why}"
        return f"must be at least {self.least:g}{unit}: {self.tiny}"

    def __str__(self) -> str:
        span = f"at most {self.most:g}" if self.least == 0.0 else f"from {self.least:g} to {self.most:g}"
        return f"{span} {self.unit}".rstrip()


def sizes(annotation: Any) -> Iterator[Size]:
    """Return the sizes anywhere in the annotation of a key."""
    return (part for part in _parts(annotation) if isinstance(part, Size))


def field_units(field: FieldInfo) -> set[str]:
    """Return the units of a field, "" for a number without one; none if it takes no numbers, or does not say."""
    return {part.unit for part in (*field.metadata, *_parts(field.annotation)) if isinstance(part, Size | Unit)}


def is_left_out(field: FieldInfo) -> bool:
    """Return whether a field is `Nothing`: its kind has no use for the key."""
    return _LEFT_OUT in field.metadata


def _parts(annotation: Any) -> Iterator[Any]:
    """Return what an annotation is made of, to the innermost."""
    for part in get_args(annotation):
        yield part
        yield from _parts(part)


FORCE = Size(1e9, "N", "no arm presses so hard")
TORQUE = Size(1e9, "N m", "no joint bears so much", 1e-12)
PLACE = Size(1e6, "m", "no arm reaches so far")
LENGTH = Size(1e6, "m", "no arm reaches so far", 1e-9, "no tip is placed so finely")
ANGLE = Size(1e6, "rad (m)", "no joint turns or reaches so far")
SPEED = Size(1e4, "m/s", "a run stops at such speeds")
JOINT_SPEED = Size(1e4, "rad/s (m/s)", "a run stops at such speeds")
# A speed that another is compared with: that of no slip at all below, one that is never reached above.
SPEED_SCALE = Size(1e9, "m/s", "nothing slips so fast", 1e-12, "slower slip is rounding")
JOINT_SPEED_SCALE = Size(1e9, "rad/s (m/s)", "nothing slips so fast", 1e-12, "slower slip is rounding")
COEFFICIENT = Size(1e6, "", "no surface has so much friction", 1e-12)
RATE = Size(1e12, "1/s", "no step resolves it", 1e-9, "no run lasts long enough to show it")
ACCELERATION_GAIN = Size(1e15, "1/s²", "no step resolves it")
INERTIA = Size(1e9, "kg", "no arm moves so much", 1e-9)
STEP = Size(1e3, "s", "no motion is seen in such steps", 1e-9, "rounding of time would show in it")
PERIOD = Size(1e9, "s", "no run lasts so long")

Coordinate = Annotated[Number, PLACE]


def gain_in(unit: str) -> Size:
    """Return the size of a gain of control in this unit."""
    return Size(1e12, unit, "no drive is so stiff")


def stiffness_in(unit: str) -> Size:
    """Return the size of the stiffness of a contact or a bearing in this unit."""
    return Size(1e15, unit, "nothing is so stiff", 1e-9)


def viscous_in(unit: str) -> Size:
    """Return the size of a viscous coefficient in this unit."""
    return Size(1e12, unit, "nothing is so viscous")


class Section(BaseModel):
    """Common settings of all sections: nothing unknown, nothing infinite, nothing changed afterwards."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    def __eq__(self, other: object) -> bool:
        """Whether it says the same: where nothing but the keys is held, their values tell, at once."""
        if type(self) is type(other):
            mine, others = vars(self), vars(other)
            if mine == others or len(mine) == len(others) == len(type(self).__pydantic_fields__):
                return mine == others
        return super().__eq__(other)

    __hash__ = BaseModel.__hash__

    def with_valid(self, values: Mapping[str, Any]) -> Self:
        """Return a copy with other values, known to be valid: what `model_copy` does, in a fifth of its time."""
        made, put = object.__new__(type(self)), object.__setattr__
        put(made, "__dict__", {**self.__dict__, **values})
        put(made, "__pydantic_fields_set__", self.__pydantic_fields_set__ | values.keys())
        put(made, "__pydantic_extra__", self.__pydantic_extra__)
        put(made, "__pydantic_private__", None)
        return made

    if not TYPE_CHECKING:  # for which a section is frozen by its settings

        def __setattr__(self, name: str, value: Any) -> None:
            raise ScenarioError(called("unchanged", self, name, value))


def usual(section: type[Section]) -> BeforeValidator:
    """Return the annotation of a key that is one of several sections: without a `kind` it is this one."""
    kind = section.model_fields["kind"].default

    def fill(value: Any) -> Any:
        return {"kind": kind} | value if isinstance(value, dict) else value

    return BeforeValidator(fill)
