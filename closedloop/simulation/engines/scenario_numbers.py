"""A scenario's numbers, its laws as numbers, and what it needs of the loop.

That is a law at its address, columns of the record, readings of encoders.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Any, NamedTuple

import numpy as np

from closedloop.base.arrays import Array
from closedloop.control.compensation.none import NoCompensation
from closedloop.control.drives import DrivesSection
from closedloop.control.law import Compensation, ControlLaw
from closedloop.control.reference.desired import Desired
from closedloop.control.reference.table import Reference
from closedloop.control.sensor import MEASURED_VELOCITY, NO_ENCODER, PackedSensor, SensorSection, encoder_kind
from closedloop.jit.parameters import pack, pack_each_joint, per_joint, state_block
from closedloop.loop.events.table import EVENT_COLUMNS
from closedloop.loop.step.entries import friction_entry, joint_friction_entry, law_entry
from closedloop.loop.step.locate import MOTORS_MEASURED
from closedloop.loop.step.memory import ELASTIC_STICK, RIGID_STICK, SMOOTH, SPRING_STICK
from closedloop.loop.step.record_row import CONTACT_RECORDED, RECORDED, ArmRow, ContactRow, Row, row_width
from closedloop.loop.step.solve_contact import compliance_entry
from closedloop.mechanics.friction.law import FrictionLaw, JointFriction
from closedloop.mechanics.friction.laws.none import NoFriction
from closedloop.mechanics.impact import RATIOS
from closedloop.mechanics.impact.single import RESTITUTIONS, Restitution
from closedloop.mechanics.integrators import Scheme
from closedloop.mechanics.robot.pinocchio import Robot
from closedloop.mechanics.surface.compliances.none import Rigid
from closedloop.mechanics.surface.placed import PlacedSurface, Plane
from closedloop.mechanics.surface.surface import Compliance
from closedloop.record.columns.derived import StatesOf, recorded_states, state_columns
from closedloop.record.columns.record import RESISTANCE_COLUMNS, SURFACE_COLUMNS, Column
from closedloop.scenario.arm import acting_tendons, has_stops, joint_friction_of, stop_limits, without_tools
from closedloop.scenario.scenario import BaumgarteGains, BeliefSection, ModelErrorSection, Scenario
from closedloop.scenario.user_module import member_digests
from closedloop.simulation.engines.bind_contacts import ContactPlaces, ContactRows
from robot_models import RobotModel
from robot_models.cached import cached_property

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


def pack_compliance(section: Compliance, n: int) -> PackedLaw:
    """Turn a soft surface into numbers for n joints."""
    return PackedLaw(type(section), pack(section, n, "compliance"), 0)


def sticking(friction: PackedLaw) -> int:
    """Return how a law of friction holds what it has stopped, see `closedloop.loop.step.memory`."""
    return SMOOTH if friction.member is NoFriction else STICKING[friction.member.sticks]


# Sections that ask for nothing.
_DRIVES, _SENSOR, _MODEL_ERROR, _BELIEF = DrivesSection(), SensorSection(), ModelErrorSection(), BeliefSection()


def needs_general_form(scenario: Scenario) -> bool:
    """Whether a scenario is more than the paper's law on a smooth surface, see `closedloop.loop.step.evaluate`."""
    return is_no_papers_law(scenario.law) or asks_for_more(scenario)


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
    """Whether the law is called by address: see `needs_general_form`."""
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
    absent = () if has_surface else SURFACE_COLUMNS
    every = dict.fromkeys(x for x in ("time", *places, "potential_energy", *EVENT_COLUMNS) if x not in absent)
    without = dict.fromkeys(name for name in every if name not in states)
    return RecordLayout(places, (without, every), {name: column for name, (column, _) in states.items()})


def _moved(place: int | slice, by: int) -> int | slice:
    return slice(place.start + by, place.stop + by) if isinstance(place, slice) else place + by


class Layout(NamedTuple):
    """What the kinds of a scenario's members say of the loop and of its record."""

    general: bool  # whether the law is called by address
    row_width: int  # numbers in a recorded row
    row_states: int  # how many of them are states of the law and its compensation, the last
    record: RecordLayout
    entries: tuple[tuple[str, Any], ...]  # what the loop calls of the members, see `entries_of`
    settings: tuple[tuple[str, int], ...]  # of `closedloop.loop.step.memory.Settings`

    @classmethod
    def of(cls, scenario: Scenario, model: RobotModel) -> "Layout":
        """Return that of a scenario with a robot."""
        states, general = StatesOf.of(scenario, model.n), calls_law(scenario, model)
        entries, settings = entries_of(scenario, model, general), settings_of(scenario, model)
        return cls.joined(scenario, states, general, tuple(entries.items()), tuple(settings.items()))

    @classmethod
    def joined(
        cls, scenario: Scenario, states: StatesOf, general: bool, entries: tuple[tuple[str, Any], ...],
        settings: tuple[tuple[str, int], ...],
    ) -> "Layout":  # fmt: skip
        """Return that of its parts."""
        sections, arm, of_law = scenario.contact or (), arm_columns(scenario), recorded_states(states)
        resists = any(each.resists for each in sections)
        record = record_layout(states, len(sections), resists, arm, scenario.has_surface)
        return cls(general, row_width(states.n, bool(arm), len(sections), of_law), of_law, record, entries, settings)


def settings_of(scenario: Scenario, model: RobotModel) -> dict[str, int]:
    """Return what sections say of the loop beside numbers, by the names of `Settings`."""
    transmission, belief, wrong = scenario.transmission, scenario.belief, scenario.model_error
    to = {
        "unilateral": scenario.surface.contact == "unilateral",
        "impact_law": RATIOS[RESTITUTIONS[scenario.impact.law].ratio_of],
        "feed_forward": scenario.reference.orientation != "free",
        "elastic": MOTORS_MEASURED if transmission.on_motors else transmission.elastic,
        "encoder": reading_kind(scenario), "balls": len(model.balls), "undriven": len(model.undriven),
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


def reading_kind(scenario: Scenario) -> int:
    """Return whether the controller reads encoders, see `closedloop.control.sensor.encoder_kind`."""
    kind = encoder_kind(scenario.encoder)
    return MEASURED_VELOCITY if kind == NO_ENCODER and scenario.transmission.on_motors else kind


@dataclass(frozen=True)
class ScenarioNumbers:
    """A scenario as numbers: everything that the loop needs, open to inspection before it runs.

    `robot`, `surface`, `integrator`: the arm with its tip, the surface, the scheme.
    `believed`: the surface that the controller believes in; None: the true one.
    `frame` (3, 3): contact frame at t = 0: rows n, t1, t2 in base axes.
    `q`, `v`, (n,) arrays: state at t = 0.
    `mode`: contact mode at t = 0, see `closedloop.mechanics.closure.contact_force`.
    `steps`, `h`: number of steps and the step, s.
    `stabiliser` (2,): s_v, 1/s, and s_p, 1/s².
    `pd_start`: instant from which the PD part of the law acts, s.
    `law`, `compensation`, `friction`, `joint_friction`, `compliance`: the law, its compensation of friction, friction,
        and the compliance of the surface, as numbers.
    `sensor`: the force sensor.
    `table` (steps · nodes + 1, 2 n + 14): the reference at every instant at which a stage is evaluated, see
        `closedloop.loop.step.entries`, and the numbers that the force sensor draws.
    `nodes`: rows of the table to a step.
    `project`: whether the state is projected onto the closure after each step.
    `hold`: steps for which a sampled torque is held; 0: the law is evaluated at every stage.
    `drives` (2, n): largest torque of each joint, and its largest change from sample to sample, N m; infinite where
        there is none.
    `transmission` (5, n): see `closedloop.control.drives.transmission_constants`.
    `encoder` (k,): the parameters of the encoders.
    `wanted`: the reference at any instant.
    `placed`: where the contacts of [[contact]] are; None without any.
    `tolerance`: relative tolerance of an adaptive integrator; None: the step is fixed.
    """

    scenario: Scenario
    robot: Robot
    surface: PlacedSurface
    believed: PlacedSurface | None
    frame: Array
    integrator: type[Scheme]
    q: Array
    v: Array
    mode: int
    steps: int
    h: float
    stabiliser: Array
    pd_start: float
    law: PackedLaw
    compensation: PackedLaw
    friction: PackedLaw
    joint_friction: PackedLaw
    compliance: PackedLaw
    sensor: PackedSensor
    table: Array
    nodes: int
    project: bool
    hold: int
    drives: Array
    transmission: Array
    encoder: Array
    wanted: Desired
    placed: ContactPlaces | None
    tolerance: float | None

    @property
    def time_constant(self) -> float | None:
        """T of Baumgarte's stabiliser, s, as given or as chosen; None without that stabiliser."""
        section = self.scenario.stabiliser
        if not isinstance(section, BaumgarteGains):
            return None
        given = section.time_constant
        return given if isinstance(given, float) else float(self.stabiliser[1] ** -0.5)

    @property
    def plane(self) -> Plane:
        """The plane through the surface's origin at t = 0, with its normal there: the surface itself if it is one."""
        return Plane(self.surface.normal, self.surface.offset)

    @property
    def path(self) -> Array:
        """q_des and q̇_des of every row of the table, (P, 2, n)."""
        n = self.robot.n
        return self.table[:, : 2 * n].reshape(-1, 2, n)

    @property
    def gains(self) -> Array:
        """K_p and K_d of every joint, (2, n), of a law that has them."""
        law: Any = self.scenario.law
        return np.array([per_joint(f"law.{name}", getattr(law, name), self.robot.n) for name in ("kp", "kd")])

    @property
    def settings(self) -> Array:
        """f_des at the start, N, and the instant from which the PD part acts, s."""
        return np.array([self.table[0, 2 * self.robot.n + 9], self.pd_start])

    @cached_property
    def forces(self) -> Array:
        """The desired force at every row of the table (P,), N."""
        return self.table[:, Reference.place("force", self.n)]

    @cached_property
    def bare_table(self) -> Array:
        """The table but for the force, where it has that of another problem of the same path."""
        return self.table

    @cached_property
    def layout(self) -> Layout:
        """What the kinds of the scenario's members say of the loop and of its record."""
        return Layout.of(self.scenario, self.robot.model)

    @property
    def contact_rows(self) -> ContactRows | None:
        """The rows of the contacts of [[contact]] on the links; None without any."""
        return None if self.placed is None else self.placed.rows

    @cached_property
    def there(self) -> PlacedSurface:
        """The surface for a tip somewhere, see `PlacedSurface.below`."""
        return self.surface

    @property
    def n(self) -> int:
        """Joints."""
        return self.robot.n

    @cached_property
    def ends(self) -> tuple[int, ...]:
        """Where the groups of joints end, see `closedloop.mechanics.robot.tree.group_ends`."""
        return tuple(self.robot.tree.ends.tolist())

    @cached_property
    def has_loops(self) -> bool:
        """Whether the robot has loop joints."""
        return bool(self.robot.model.loops)

    @property
    def general(self) -> bool:
        """Whether the law is called by address."""
        return self.layout.general

    @property
    def row_width(self) -> int:
        """Numbers in a recorded row."""
        return self.layout.row_width

    @property
    def row_states(self) -> int:
        """How many of them are states of the law and its compensation, the last."""
        return self.layout.row_states

    @property
    def record(self) -> RecordLayout:
        """What its record has."""
        return self.layout.record

    @cached_property
    def member_digests(self) -> dict[str, str]:
        """See `closedloop.scenario.user_module.member_digests`."""
        return member_digests(self.scenario)

    @cached_property
    def shape(self) -> Shape:
        """How many numbers there are of what is called."""
        laws = self.law, self.compensation, self.friction, self.joint_friction
        return Shape.of(*laws, self.compliance, self.sensor, self.tendons)

    @cached_property
    def tendons(self) -> Array:
        """What rubs along tendons of the robot, and their stops: rows of `robot_models.tendon.rough_tendons`."""
        return acting_tendons(self.scenario, self.robot.model)

    @cached_property
    def stops(self) -> tuple[Array, Array]:
        """Where the joints have hard stops, lower and upper, (n,)."""
        return stop_limits(self.scenario, self.robot.model)

    @cached_property
    def bare(self) -> RobotModel:
        """The robot's model without what the scenario puts on it."""
        return without_tools(self.robot.model)

    @cached_property
    def model_given(self) -> RobotModel | None:
        """The model that was given in place of that which the scenario names."""
        return self.bare

    @cached_property
    def spare(self) -> dict[str, Any]:
        """What steps its loop, by engine, where no run uses it: `closedloop.simulation.loop_calls.Driver`."""
        return {}

    @property
    def restitution(self) -> type[Restitution]:
        """The law of restitution."""
        return RESTITUTIONS[self.scenario.impact.law]
