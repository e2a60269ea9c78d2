"""A scenario's numbers, its laws as numbers, and what it needs of the loop.

That is a law at its address, columns of the record, readings of encoders.
"""

from collections.abc import Sequence
from functools import cache, lru_cache
from typing import Any, NamedTuple

from closedloop.base.arrays import Array
from closedloop.control.compensation.none import NoCompensation
from closedloop.control.drives import DrivesSection
from closedloop.control.law import Compensation, ControlLaw
from closedloop.control.reference.desired import Reference
from closedloop.control.sensor import MEASURED_VELOCITY, NO_ENCODER, PackedSensor, SensorSection, encoder_kind
from closedloop.jit.parameters import pack, pack_each_joint, state_block
from closedloop.loop.events.table import EVENT_COLUMNS
from closedloop.loop.step.entries import friction_entry, joint_friction_entry, law_entry
from closedloop.loop.step.locate import MOTORS_MEASURED
from closedloop.loop.step.memory import ELASTIC_STICK, RIGID_STICK, SMOOTH, SPRING_STICK
from closedloop.loop.step.record_row import CONTACT_RECORDED, RECORDED, ArmRow, ContactRow, Row, row_width
from closedloop.loop.step.solve_contact import compliance_entry
from closedloop.mechanics.friction.law import FrictionLaw, JointFriction
from closedloop.mechanics.friction.laws.none import NoFriction
from closedloop.mechanics.impact import RATIOS
from closedloop.mechanics.impact.single import RESTITUTIONS
from closedloop.mechanics.surface.compliances.none import Rigid
from closedloop.record.columns.derived import StatesOf, recorded_states, state_columns
from closedloop.record.columns.record import OF_CONTACTS, RESISTANCE_COLUMNS, SURFACE_COLUMNS, Column
from closedloop.scenario.arm import has_stops, joint_friction_of
from closedloop.scenario.scenario import BeliefSection, ModelErrorSection, Scenario
from robot_models import RobotModel

STICKING = {"rigid": RIGID_STICK, "elastic": ELASTIC_STICK, "spring": SPRING_STICK}


class PackedLaw(NamedTuple):
    """A law as the loop reads it: of control, of compensation, of friction, or of a soft surface."""

    member: Any  # its class
    # its parameters, see `closedloop.jit.parameters.parameter_block`; of friction in joints a row for each, (n, ...),
    # see `closedloop.jit.parameters.one_joint_block`
    numbers: Array
    states: int  # how many states it has; of friction in joints, each of them


def pack_law(section: ControlLaw | Compensation, n: int, joint_names: Sequence[str] = ()) -> PackedLaw:
    """Turn a law or a compensation into numbers for n joints."""
    where = "law" if isinstance(section, ControlLaw) else "compensation"
    _check_functions(type(section), f"{where}.kind")
    return PackedLaw(type(section), pack(section, n, where, joint_names), state_block(type(section)).count(n))


def pack_friction(section: FrictionLaw, n: int, joints: bool = False) -> PackedLaw:
    """Turn a law of the surface's friction, or of the joints', into numbers for n joints."""
    member, where = type(section), "joint_friction" if joints else "friction"
    if member is not NoFriction:
        _check_functions(member, f"{where}.kind")
    numbers = pack_each_joint(section, n, where) if joints else pack(section, n, where)
    return PackedLaw(member, numbers, state_block(member).count(1 if joints else 2))


@cache
def _check_functions(member: Any, key: str) -> None:
    """Refuse a member that lacks functions, once."""
    member.check_functions(key)


def sticking(friction: PackedLaw) -> int:
    """Return how a law of friction holds what it has stopped, see `closedloop.loop.step.memory`."""
    return SMOOTH if friction.member is NoFriction else STICKING[friction.member.sticks]


# Sections that ask for nothing.
_DRIVES, _SENSOR, _MODEL_ERROR, _BELIEF = DrivesSection(), SensorSection(), ModelErrorSection(), BeliefSection()


def is_no_papers_law(law: ControlLaw) -> bool:
    """Whether a law is another than the paper's."""
    return law.kind != "paper" or law.force_feedback > 0.0 or law.force_integral > 0.0


def asks_for_more(scenario: Scenario) -> bool:
    """Whether a scenario has more than a law on a smooth surface."""
    return (
        scenario.compensation.kind != "none"
        or scenario.friction.kind != "none"
        or scenario.rubs_in_joints
        or scenario.sensor != _SENSOR
        or scenario.model_error != _MODEL_ERROR
        or scenario.belief != _BELIEF
        or bool(arm_columns(scenario))
        or bool(scenario.contact or scenario.external_force)
    )


def calls_law(scenario: Scenario, model: RobotModel) -> bool:
    """Whether the law is called by address, see `closedloop.loop.step.evaluate`."""
    return is_no_papers_law(scenario.law) or calls_any_law(scenario, model)


def calls_any_law(scenario: Scenario, model: RobotModel) -> bool:
    """Whether any law would be called by address, the paper's too."""
    undriven = not model.loops and len(model.undriven) > 0
    return asks_for_more(scenario) or has_stops(scenario, model) or undriven


def entries_of(scenario: Scenario, model: RobotModel, law: bool, joints: JointFriction | None = None) -> dict[str, Any]:
    """Return what the loop calls by address of the members of a scenario, by the names that `State` has for it.

    `law` says whether it calls the scenario's law, see `calls_law`; `joints` is the friction in them, if it is known.
    """
    found: dict[str, Any] = {}
    if law:
        found["law"] = law_entry(type(scenario.law))
        if not isinstance(scenario.compensation, NoCompensation):
            found["compensation"] = law_entry(type(scenario.compensation))
    if not isinstance(scenario.compliance, Rigid):
        found["compliance"] = compliance_entry(type(scenario.compliance))
    if not isinstance(scenario.friction, NoFriction):
        found["friction"] = friction_entry(type(scenario.friction))
    if not isinstance(joints := joints or joint_friction_of(scenario, model), NoFriction):
        found["joint_friction"] = joint_friction_entry(type(joints))
    return found


# The columns of what is desired, and their parts of `Reference`.
WANTED = {"reference_position": "q", "reference_velocity": "v", "reference_tip": "position", "reference_force": "force"}


class RecordLayout(NamedTuple):
    """The columns of a run."""

    # those that are a part of the record: whether in a row or in the table, and the place there
    places: dict[str, tuple[bool, int | slice]]
    names: tuple[dict[str, None], dict[str, None]]  # of all in order, without and with states of the law
    states: dict[str, Column]  # what the columns of these states are, see `state_columns`
    width: int  # numbers in a recorded row
    row_states: int  # how many of them are states of the law and its compensation, the last


def record_of(scenario: Scenario, states: StatesOf) -> RecordLayout:
    """Return the columns of a run of a scenario."""
    sections = scenario.contact or ()
    resists = any(each.resists for each in sections)
    return record_layout(states, len(sections), resists, arm_columns(scenario), scenario.has_surface)


@lru_cache(maxsize=128)
def record_layout(
    states_of: StatesOf, contacts: int, resists: bool, arm: tuple[str, ...], has_surface: bool
) -> RecordLayout:
    """Return the columns of a run with so many contacts of links, of which one may resist to rolling or pivoting."""
    n, states = states_of.n, state_columns(states_of)
    behind = row_width(n, bool(arm), contacts)
    before = behind - ContactRow.count(contacts)
    of_contacts = [name for name in CONTACT_RECORDED if contacts and (resists or name not in RESISTANCE_COLUMNS)]
    places: dict[str, tuple[bool, int | slice]] = {
        **{name: (False, Reference.place(part, n)) for name, part in WANTED.items()},
        **{name: (True, Row.place(name, n)) for name in RECORDED},
        **{name: (True, _moved(ArmRow.place(name, n), Row.count(n))) for name in arm},
        **{name: (True, _moved(ContactRow.place(name, contacts), before)) for name in of_contacts},
        **{name: (True, _moved(place, behind)) for name, (_, place) in states.items()},
    }
    absent = (*(() if has_surface else SURFACE_COLUMNS), *(() if contacts else OF_CONTACTS))
    every = dict.fromkeys(x for x in ("time", *places, "potential_energy", *EVENT_COLUMNS) if x not in absent)
    without = dict.fromkeys(name for name in every if name not in states)
    columns, of_law = {name: column for name, (column, _) in states.items()}, recorded_states(states_of)
    return RecordLayout(places, (without, every), columns, row_width(n, bool(arm), contacts, of_law), of_law)


def _moved(place: int | slice, by: int) -> int | slice:
    return slice(place.start + by, place.stop + by) if isinstance(place, slice) else place + by


def settings_of(scenario: Scenario, model: RobotModel) -> dict[str, int]:
    """Return what sections say of the loop beside numbers, by the names of `Settings`."""
    transmission, belief, wrong = scenario.transmission, scenario.belief, scenario.model_error
    reading = encoder_kind(scenario.encoder)
    if reading == NO_ENCODER and transmission.on_motors:
        reading = MEASURED_VELOCITY
    to = {
        "unilateral": scenario.surface.contact == "unilateral",
        "impact_law": RATIOS[RESTITUTIONS[scenario.impact.law].ratio_of],
        "feed_forward": scenario.reference.orientation != "free",
        "elastic": MOTORS_MEASURED if transmission.on_motors else transmission.elastic,
        "encoder": reading, "balls": len(model.balls), "undriven": len(model.undriven),
        "drives": scenario.drives != _DRIVES, "model_error": wrong != _MODEL_ERROR,
        "misjudged": belief.differs or wrong.normal != 0.0 or belief.normal_noise > 0.0,
        "arm_at": Row.count(model.n) if arm_columns(scenario) else 0,
    }  # fmt: skip
    to["perceived"] = any(to[name] for name in ("model_error", "misjudged", "elastic", "encoder"))
    return {name: int(value) for name, value in to.items()}


# The members that have parameters, in the order of `Constants`, and the tendons.
SIZES = "law", "compensation", "friction", "joint_friction", "compliance", "tendons"


class Shape(NamedTuple):
    """How many numbers there are of what is called."""

    states: tuple[int, int, int, int]  # of the law, its compensation, friction, friction in each joint
    sensor: tuple[int, int, int, int]  # axes, states, ring, sampled, see `PackedSensor`
    sticking: tuple[int, int]  # of friction, and of that in joints, see `closedloop.loop.step.memory`
    sizes: tuple[int, ...]  # how many numbers the parameters are of each of `SIZES`

    @classmethod
    def of(
        cls, law: PackedLaw, compensation: PackedLaw, friction: PackedLaw, joints: PackedLaw, compliance: PackedLaw,
        sensor: PackedSensor, tendons: Array,
    ) -> "Shape":  # fmt: skip
        """Return that of what is called."""
        sizes = (
            law.numbers.size, compensation.numbers.size, friction.numbers.size, joints.numbers.shape[1],
            compliance.numbers.size, len(tendons),
        )  # fmt: skip
        states = law.states, compensation.states, friction.states, joints.states
        of_sensor = sensor.axes, sensor.states, sensor.ring, int(sensor.sampled)
        return cls(states, of_sensor, (sticking(friction), sticking(joints)), sizes)


def arm_columns(scenario: Scenario) -> tuple[str, ...]:
    """Return the columns beyond `closedloop.loop.step.record_row.RECORDED` that a run of a scenario has."""
    drives = ("torque_limited",) if scenario.drives != _DRIVES else ()
    encoder = ("measured_position", "measured_velocity") if scenario.reads_encoders else ()
    motors = ("motor_position", "motor_velocity", "transmitted_torque") if scenario.transmission.elastic else ()
    return drives + encoder + motors
