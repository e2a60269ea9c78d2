"""The columns that a run records, row by row and event by event: dimensions, unit and meaning of each.

`Record` is what a run has. A report, and whatever follows from the columns, is written for it;
`closedloop.record.run.Run` adds these. The columns are attributes with types: an editor completes them, and a type
checker refuses other names; a test compares them with what a run has. Columns that only some runs have, such as states
of a law of one's own, are not among them: ``run["law_error"]``.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple, Protocol, get_type_hints

from numpy.typing import NDArray

from closedloop.base.arrays import Array
from closedloop.loop.events.table import EVENT_COLUMNS, KINDS
from closedloop.mechanics.loops.reactions import LoopReactions
from closedloop.scenario.scenario import Scenario
from robot_models import RobotModel
from robot_models.cached import cached_property


class Column(NamedTuple):
    """Dimensions, unit and meaning of a column."""

    dims: tuple[str, ...]
    units: str
    meaning: str


Values = NDArray[Any]
ROWS, JOINTS, AXES = ("time",), ("time", "joint"), ("time", "axis")
CONTACTS, TANGENTS = ("time", "contact"), ("time", "contact_tangent")


class EveryRun(Protocol):
    """What every run records.

    Joint quantities are in rad, rad/s, rad/s² and N m for revolute joints; for prismatic ones m, m/s, m/s² and N.
    """

    time: Annotated[Values, Column(ROWS, "s", "time since the start of the run")]
    q: Annotated[Values, Column(JOINTS, "rad", "joint positions")]
    v: Annotated[Values, Column(JOINTS, "rad s-1", "joint velocities")]
    acceleration: Annotated[Values, Column(JOINTS, "rad s-2", "joint accelerations, solution of Eq. 24")]
    torque: Annotated[Values, Column(JOINTS, "N m", "torque Q of the control law on the joints (Eq. 33)")]
    reference_position: Annotated[Values, Column(JOINTS, "rad", "q_des")]
    reference_velocity: Annotated[Values, Column(JOINTS, "rad s-1", "time derivative of q_des")]
    reference_tip: Annotated[Values, Column(AXES, "m", "desired tip position, base frame")]
    reference_force: Annotated[Values, Column(ROWS, "N", "desired contact force f_des")]
    position: Annotated[Values, Column(AXES, "m", "tip position r, base frame")]
    velocity: Annotated[Values, Column(AXES, "m s-1", "tip velocity, base frame")]
    surface_normal: Annotated[Values, Column(AXES, "1", "unit normal n of the surface at the tip, base frame")]
    slip_velocity: Annotated[
        Values, Column(AXES, "m s-1", "velocity of the tip along the surface and relative to it, base frame")
    ]
    contact_force: Annotated[
        Values,
        Column(ROWS, "N", "force of the surface on the tip along the surface normal; positive pushes the robot away"),
    ]
    stabiliser_force: Annotated[Values, Column(ROWS, "N", "part of contact_force that is due to the stabiliser")]
    friction_force: Annotated[Values, Column(AXES, "N", "tangential force of the surface on the tip, base frame")]
    joint_friction: Annotated[Values, Column(JOINTS, "N m", "torque of friction on the joints")]
    measured_force: Annotated[
        Values, Column(ROWS, "N", "reading of the force sensor that the law gets at the next row")
    ]
    closure_error: Annotated[Values, Column(ROWS, "m", "e = n.r - d; positive off the surface")]
    closure_rate: Annotated[Values, Column(ROWS, "m s-1", "time derivative of closure_error")]
    mode: Annotated[Values, Column(ROWS, "1", "0 free, 1 pressed (sliding or at rest), 2 stuck")]
    residual_motion: Annotated[Values, Column(ROWS, "1", "relative residual of the equation of motion in Eq. 24")]
    residual_closure: Annotated[Values, Column(ROWS, "1", "relative residual of the closure row in Eq. 24")]
    kkt_condition: Annotated[Values, Column(ROWS, "1", "condition number of the matrix of Eq. 24, 1-norm, SI units")]
    normal_mobility: Annotated[
        Values, Column(ROWS, "1", "A H^-1 A^T over the trace of J H^-1 J^T; 0 at a singular pose")
    ]
    kinetic_energy: Annotated[Values, Column(ROWS, "J", "kinetic energy, drives included")]
    potential_energy: Annotated[Values, Column(ROWS, "J", "potential energy of gravity")]
    energy_supplied: Annotated[
        Values,
        Column(ROWS, "J", "work of torque, contact force and friction since row 0, less what the events after it took"),
    ]


class OfArm(Protocol):
    """What a run has if its scenario asks for it, see `closedloop.simulation.engines.scenario_numbers.arm_columns`."""

    torque_limited: Annotated[
        Values,
        Column(JOINTS, "1", "0: torque is what the law asked for; 1: cut by the torque limit; 2: by the rate limit"),
    ]
    measured_position: Annotated[Values, Column(JOINTS, "rad", "joint positions as the encoders read them")]
    measured_velocity: Annotated[Values, Column(JOINTS, "rad s-1", "joint velocities as the controller has them")]
    motor_position: Annotated[
        Values, Column(JOINTS, "rad", "angles of the motors behind elastic joints, at the joints")
    ]
    motor_velocity: Annotated[
        Values, Column(JOINTS, "rad s-1", "rates of the motors behind elastic joints, at the joints")
    ]
    transmitted_torque: Annotated[Values, Column(JOINTS, "N m", "torque that elastic joints pass on to the links")]


class OfContacts(Protocol):
    """What it has if its links have contacts besides the tip."""

    residual_contacts: Annotated[
        Values,
        Column(ROWS, "1", "largest relative residual of contact forces since the row before that did not converge"),
    ]
    link_modes: Annotated[Values, Column(CONTACTS, "1", "mode of each contact of a link: 0 free, 1 sliding, 2 stuck")]
    link_gaps: Annotated[Values, Column(CONTACTS, "m", "gap of each, positive off its plane")]
    link_forces: Annotated[
        Values, Column(CONTACTS, "N", "force of each along its normal, on the link that has the point")
    ]
    link_frictions: Annotated[
        Values,
        Column(TANGENTS, "N", "force of each along the two tangents, which are fixed in the link that has the surface"),
    ]
    link_slips: Annotated[
        Values, Column(TANGENTS, "m s-1", "velocity of each relative to its surface, along the two tangents")
    ]
    link_rolling_moments: Annotated[
        Values, Column(TANGENTS, "N m", "resistance of each to rolling, about the two tangents")
    ]
    link_pivoting_moments: Annotated[
        Values, Column(CONTACTS, "N m", "resistance of each to pivoting, about its normal")
    ]


class TypedColumns(EveryRun, OfArm, OfContacts, Protocol):
    """All that a run may have, with its table of events, the derived columns and the symbols."""

    event_time: Values
    event_kind: Values
    event_rate_before: Values
    event_rate_after: Values
    event_rate_cut: Values
    event_compression: Values
    event_decompression: Values
    event_tangential: Values
    event_energy_lost: Values
    event_energy_rested: Values
    event_position: Values
    event_slip_before: Values
    event_slip_after: Values
    event_restitution: Values
    event_contact: Values
    tip_force: Values
    wrist_wrench: Values
    tool_angle: Values
    orientation_error: Values
    stop_torque: Values
    f: Values
    f_des: Values
    f_measured: Values
    e: Values
    r: Values
    r_des: Values
    n: Values
    Q: Values
    q_des: Values
    v_des: Values


def columns_of(group: type) -> dict[str, Column]:
    """Return what each of a group of columns is."""
    return {name: hint.__metadata__[0] for name, hint in get_type_hints(group, include_extras=True).items()}


if TYPE_CHECKING:
    _Columns = TypedColumns
else:
    _Columns = object


class Event(NamedTuple):
    """One event of the contact: an impact, the beginning or the end of contact, of sticking or of slip.

    Attributes
    ----------
    time : float
        Instant, s.
    kind : str
        "impact", "touchdown", "liftoff", "stick", "slip", "reversal", "edge", "stop", "release", "time_step",
        "tangential_impact" or "time_stepping_start".
    rate_before, rate_after : float
        Rate of the closure error just before and just after it, m/s.
    rate_cut : float
        Rate of a bounce that `impact.rest_speed` turned into contact, m/s.
    compression, decompression : float
        Impulses of both phases on the tip along the normal, N s.
    tangential : (3,) array
        Impulse on the tip along the surface, N s, base frame.
    energy_lost : float
        Kinetic energy lost, J; at an edge the energy of the spring of a soft surface.
    energy_rested : float
        Part of `energy_lost` that was removed so that a contact which separates too slowly comes to rest, J.
    position : (3,) array
        Where the tip is, m, base frame.
    slip_before, slip_after : float
        Speed of the tip along the surface, m/s.
    restitution : float
        Coefficient of restitution of an impact: `impact.restitution`, or less where Newton's law would have created
        energy. It is 0 for all other events.
    contact : int
        Number of the contact: 0 is the tip; the scenario's sections [[contact]] follow in their order, and then the
        joints that have stops.
    """

    time: float
    kind: str
    rate_before: float
    rate_after: float
    rate_cut: float
    compression: float
    decompression: float
    tangential: Array
    energy_lost: float
    energy_rested: float
    position: Array
    slip_before: float
    slip_after: float
    restitution: float
    contact: int = 0


def events_of(columns: Mapping[str, NDArray[Any]]) -> tuple[Event, ...]:
    """Return the events of columns that have those of `EVENT_COLUMNS`, in order of time."""
    parts = [columns[name] for name in EVENT_COLUMNS]
    rows = zip(*(part if part.ndim == 2 else part.tolist() for part in parts), strict=True)
    return tuple(Event(row[0], KINDS[row[1]], *row[2:]) for row in rows)


_BY_TIME, ARM_COLUMNS, _OF_LINKS = map(columns_of, (EveryRun, OfArm, OfContacts))
# Of all contacts together; without any it is zero. And of each.
OF_CONTACTS = ("residual_contacts",)
CONTACT_COLUMNS = {name: column for name, column in _OF_LINKS.items() if name not in OF_CONTACTS}
# Those of the last that a run has if one of its contacts resists to rolling or to pivoting.
RESISTANCE_COLUMNS = ("link_rolling_moments", "link_pivoting_moments")
SOMETIMES = ARM_COLUMNS | _OF_LINKS

# What it has if there is a surface that its tip may touch; without one a `Run` answers with zeros.
SURFACE_COLUMNS = (
    "surface_normal", "slip_velocity", "contact_force", "stabiliser_force", "friction_force", "closure_error",
    "closure_rate", "mode", "residual_closure",
)  # fmt: skip

COLUMNS: dict[str, Column] = _BY_TIME | {name: Column(*spec) for name, spec in EVENT_COLUMNS.items()}
ALL_COLUMNS = COLUMNS | SOMETIMES
# Symbols of the equations, which name a column as well: `run.f` is `run.contact_force`.
SYMBOLS = {
    "f": "contact_force", "f_des": "reference_force", "f_measured": "measured_force", "e": "closure_error",
    "r": "position", "r_des": "reference_tip", "n": "surface_normal", "Q": "torque", "q_des": "reference_position",
    "v_des": "reference_velocity",
}  # fmt: skip
_NOT_ALWAYS = {*SURFACE_COLUMNS, *SOMETIMES}
POSITIONS = ("q", "reference_position")


def in_order(columns: Iterable[str]) -> list[str]:
    """Return the names of columns in the order of `ALL_COLUMNS`, and those that are not in it behind, sorted."""
    there = set(columns)
    return [*(name for name in ALL_COLUMNS if name in there), *sorted(there - set(ALL_COLUMNS))]


class ColumnsOnDemand(Mapping[str, NDArray[Any]]):
    """Columns that are made when they are first asked for, each once; they are read-only.

    `names`: their names, in order.
    `make`: makes the column of a name; it is let go when all are made.
    """

    def __init__(self, names: Mapping[str, Any], make: Callable[[str], NDArray[Any]]) -> None:
        self._names, self._make = names, make
        self._made: dict[str, NDArray[Any]] = {}

    def __getitem__(self, name: str) -> NDArray[Any]:
        found = self._made.get(name)
        if found is None:
            if name not in self._names:
                raise KeyError(name)
            made = self._make(name)
            made.setflags(write=False)
            found = self._made.setdefault(name, made)  # that of the thread which was first
            if len(self._made) == len(self._names):
                self._make = self._made.__getitem__
        return found

    def __contains__(self, name: object) -> bool:
        return name in self._names

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)

    def __or__(self, other: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
        return {**self, **other}


@dataclass(frozen=True, eq=False)
class Record(_Columns):
    """The record of a simulation, and what produced it; see `closedloop.record.run.Run`, which every record is.

    Every column of `columns`, and every derived one, is an attribute too.
    """

    scenario: Scenario
    model: RobotModel
    columns: Mapping[str, NDArray[Any]]
    law: str = "scenario"
    versions: Mapping[str, str] = field(default_factory=dict)
    stopped: str | None = None
    wall_seconds: float = 0.0
    engine: str = "pinocchio"
    law_digest: str = ""
    member_digests: Mapping[str, str] = field(default_factory=dict)
    added: Mapping[str, Column] = field(default_factory=dict)
    halved: Mapping[str, Any] | None = None

    def __len__(self) -> int:
        return int(self.columns["time"].size)

    @cached_property
    def events(self) -> tuple[Event, ...]:
        """Changes of the contact, in order of time."""
        return events_of(self.columns)

    @property
    def specs(self) -> Mapping[str, Column]:
        """Dimensions, unit and meaning of each of the columns."""
        there = set(self.columns)
        found = {name: spec for name, spec in ALL_COLUMNS.items() if name in there or name not in _NOT_ALWAYS}
        if bool(self.model.balls):
            found |= {name: found[name]._replace(dims=("time", "coordinate")) for name in POSITIONS}
        return found | dict(self.added)

    if TYPE_CHECKING:  # what a `Run` works out of it

        @property
        def loops(self) -> LoopReactions | None:
            """What the loop joints of a mechanism carried; None of a tree."""

        def summary(self) -> dict[str, Any]:
            """Return the summary, see `closedloop.record.report.summary.summarise`."""

        def units(self, name: str) -> str:
            """Return the unit of a column."""

        def __getitem__(self, name: str) -> NDArray[Any]: ...
