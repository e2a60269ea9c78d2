"""The values of a run's summary: their names, units and meaning, in order, and how the rows of a run are counted in.

What a recorded row has to say to the summary is defined once for every way to go over the rows. `sample_row` works on
one row in a compiled batch, on the rows of eight runs side by side (`closedloop.jit.simd8`), and, interpreted, on whole
columns of a `Run`. It has no memory of other rows. What is taken over the rows, the largest, the sum, the first
instant, is the same for all values of a group: here it is counted in row by row, in compiled code, for batches, which
make no columns; `closedloop.record.report.summary` does it with numpy. Both forms are needed: interpreted the loop over
rows would take 3 s for the 8000 rows of wam_slide, and compiling it 10 s.
`tests/closedloop/record/test_measured.py` holds them equal.

Chatter is how much of a signal alternates from row to row. What alternates is the part x_i = ... + (−1)^i a: its second
differences are 4 a and change their sign from row to row, so a quarter of the smaller of two neighbours is taken
wherever they differ in sign.
"""

import math
from types import new_class
from typing import Annotated, Any, NamedTuple

import numpy as np

from closedloop.base.arrays import Array
from closedloop.control.reference.desired import Reference
from closedloop.jit.blocks import Block, Count
from closedloop.jit.kernel import entry_kernel, kernel, kernel_inlined
from closedloop.jit.simd8 import every, select
from closedloop.loop.events.table import KINDS, EventRow
from closedloop.loop.step.record_row import Row
from closedloop.mechanics.closure.contact_force import FREE, STUCK
from closedloop.mechanics.limits import NEAR
from closedloop.mechanics.robot.tree import Tree, tree_potential_energy
from closedloop.scenario.scenario import Scenario
from robot_models import RobotModel
from robot_models.model import AT_LIMIT

# The force has settled where it stays within this share of the largest f_des of the run.
SETTLED = 0.02


class Measure(NamedTuple):
    """Unit and meaning of a value."""

    units: str
    meaning: str


MEASURES: dict[str, Measure] = {
    "final_contact_force": Measure("N", "contact force at the end"),
    "peak_contact_force": Measure("N", "highest contact force"),
    "min_contact_force": Measure("N", "lowest contact force"),
    "max_stabiliser_force": Measure("N", "largest share of the contact force that is due to the stabiliser"),
    "max_abs_closure_error": Measure("m", "largest closure error in contact, either way"),
    "final_closure_error": Measure("m", "closure error at the end; positive off the surface"),
    "max_abs_closure_rate": Measure("m s-1", "largest closure rate in contact, either way"),
    "max_tip_speed": Measure("m s-1", "highest tip speed"),
    "max_kkt_residual": Measure("1", "largest relative residual of Eq. 24"),
    "rows_not_converged": Measure("1", "rows before which contact forces did not converge"),
    "max_kkt_condition": Measure("1", "largest condition number of the matrix of Eq. 24"),
    "min_normal_mobility": Measure("1", "lowest share of the tip's mobility along the normal; 0 at a singular pose"),
    "singular_pose_passed": Measure(
        "1", "1 if the tip came near singular poses on the way through only, with a contact force that stayed as it was"
    ),
    "max_energy_residual": Measure("J", "largest energy unaccounted for"),
    "energy_gained": Measure("J", "largest rise of kinetic and potential energy, of what moves without drives"),
    "energy_above_start": Measure("J", "how far they rise above the start's; of what moves without drives"),
    "energy_exchanged": Measure("J", "energy that the joint torques exchanged with the arm"),
    "deepest_penetration": Measure("m", "deepest that the tip was below the surface"),
    "time_in_contact": Measure("s", "time in contact"),
    "max_friction_force": Measure("N", "largest friction force on the tip"),
    "max_joint_friction": Measure("N m", "largest torque of friction in a joint"),
    "energy_lost_to_friction": Measure("J", "energy that sliding friction took, at all contacts and in the joints"),
    "energy_lost_in_impacts": Measure("J", "energy that impacts took, and what a soft surface had stored at its edge"),
    "energy_taken_at_rest": Measure("J", "part of that energy which the rule of rest removed (impact.rest_speed)"),
    "largest_rate_cut": Measure("m s-1", "fastest bounce that was cut to rest"),
    "rms_force_error": Measure("N", "RMS error of the contact force over the rows in contact"),
    "force_settled_at": Measure("s", "instant from which the contact force stays within 2 % of that desired"),
    "rms_path_error": Measure("m", "RMS distance of the tip from its path, along the surface, over the rows"),
    "max_kinetic_energy": Measure("J", "highest kinetic energy"),
    "start_closure_error": Measure("m", "closure error at the start, if in contact then; positive off the surface"),
    "largest_reference_force": Measure("N", "largest contact force asked for, either way"),
    "force_chatter": Measure("1", "share of the contact force that alternates from row to row"),
}

_OF_THE_TIP = (
    "final_contact_force", "peak_contact_force", "min_contact_force", "max_stabiliser_force", "max_abs_closure_error",
    "final_closure_error", "max_abs_closure_rate", "min_normal_mobility", "deepest_penetration", "time_in_contact",
    "max_friction_force", "rms_force_error", "force_settled_at", "start_closure_error", "force_chatter",
)  # fmt: skip


def absent_measures(scenario: Scenario, own_law: bool = False) -> tuple[str, ...]:
    """Return the measures that do not exist: without a surface those of the contact, without a law that of the path.

    Without contacts of links there are none of theirs.

    What is driven, or touches something that moves by itself, may gain energy.
    """
    without_law: tuple[str, ...] = ("rms_path_error",) if not (scenario.has_law or own_law) else ()
    if not scenario.contact:
        without_law += ("rows_not_converged",)
    if own_law or not scenario.is_passive:
        without_law += ("energy_gained", "energy_above_start")
    return without_law if scenario.has_surface else (*_OF_THE_TIP, *without_law)


# Of each joint, in the robot's order; for a prismatic joint read m, m/s and N.
JOINT_MEASURES: dict[str, Measure] = {
    "position_excess": Measure("rad", "farthest that the joint was beyond its position limits"),
    "position_limit_left_at": Measure("s", "when the joint first left its position limits"),
    "max_joint_velocity": Measure("rad s-1", "highest speed of the joint"),
    "velocity_limit_exceeded_at": Measure("s", "when the joint was first faster than its velocity limit"),
    "max_joint_torque": Measure("N m", "largest torque asked of the joint"),
    "effort_limit_exceeded_at": Measure("s", "when the torque asked of the joint was first beyond its effort limit"),
    "torque_chatter": Measure("1", "share of the joint's torque that alternates from row to row"),
    "torque_limited_share": Measure("1", "share of the rows in which a limit of the drives cut the joint's torque"),
    "torque_limited_at": Measure("s", "when a limit of the drives first cut the joint's torque"),
}
# A joint's torque counts as at least this share of the joints' mean: where next to none is asked, rounding alternates.
LEAST_TORQUE = 0.01


# An alternation is seen in so many values.
SPAN = 4


class Signal(Block):
    """What is remembered of a signal whose values are counted one by one."""

    before: float  # last value, difference and second difference
    slope: float
    turn: float
    alternating: float  # the sum of what alternates


@kernel_inlined
def count_signal(x: float, i: int, signal: Signal) -> None:
    """Count the value that a signal has in row i."""
    slope = x - signal.before
    turn = slope - signal.slope
    if i >= SPAN - 1:  # the first has no difference, the second no second one, the third none before it
        smaller = min(abs(turn), abs(signal.turn))
        signal.alternating += select(turn * signal.turn < 0.0, 0.25 * smaller, 0.0)
    signal.before, signal.slope, signal.turn = x, slope, turn


def alternation(signal: Array) -> Array:
    """Return how much of each column (N, n) alternates, summed over the rows, (n,)."""
    turn = np.diff(signal, 2, axis=0)
    alternates = turn[1:] * turn[:-1] < 0.0
    amplitude: Array = 0.25 * np.minimum(np.abs(turn[1:]), np.abs(turn[:-1]))
    total: Array = np.sum(amplitude, axis=0, where=alternates)
    return total


# Eq. 24 is solved to rounding: n additions of rounding 1e-16 each, with room for the conditioning of H.
RESIDUAL_TOLERANCE = 1e-12
# Below this share of its mobility the tip is within 1e-3 rad of a singular pose, and f, q̈ and Q along the normal
# grow a thousandfold; the simulation itself stops only at `closedloop.mechanics.closure.solve.SINGULAR_MOBILITY`.
NEAR_SINGULAR = 1e-6
# On the way through such a pose, within 1e-2 rad of it. A force that has a limit in the pose is about as large from
# there on; one that has none is ten times as large 1e-3 rad from it, and grows as one over the distance.
ON_THE_WAY = 1e-4
MOST_GROWTH = 2.0
NAMES = ("one_loop", "single_point", "contact_kept", "frictionless", "nonsingular")


@kernel_inlined
def assumptions_met(row: Any, friction: float, in_joints: float) -> Any:
    """Return whether each of `NAMES` holds in a row (`closedloop.loop.step.record_row.Row`), or in columns of rows.

    `friction` and `in_joints` are zero where there is none at the tip and in the joints.
    """
    met = row.residual_motion <= RESIDUAL_TOLERANCE
    return (
        (row.residual_closure <= RESIDUAL_TOLERANCE) & (row.mode != STUCK),
        met,
        (row.contact_force > 0.0) & (row.mode != FREE),
        met & (friction == 0.0) & (in_joints == 0.0),
        (row.normal_mobility > NEAR_SINGULAR) | (row.mode == FREE),  # an open contact closes no loop
    )


N = Count.of("n")


class JointLimits(Block, sizes=("n",)):
    """The limits of n joints, infinite where there is none."""

    position_lower: Annotated[Array, N]  # rad (m)
    position_upper: Annotated[Array, N]
    velocity: Annotated[Array, N]  # rad/s (m/s)
    effort: Annotated[Array, N]  # N m (N)


def joint_limits(model: RobotModel) -> Array:
    """Return the memory of the `JointLimits` of a robot."""
    return np.concatenate([model.position_lower, model.position_upper, model.velocity_limit, model.effort_limit])


class Greatest(Block, sizes=("n",)):
    """Of these the largest over the rows counts; of what is negated, the least."""

    force: float
    minus_force: float
    minus_mobility: float
    singular_force: float  # magnitude, within `NEAR_SINGULAR` of a singular pose
    approach_force: float  # and on the way there, within `ON_THE_WAY`
    stabiliser_force: float
    closure_error: float
    closure_rate: float
    penetration: float
    residual_motion: float
    residual_closure: float
    tip_speed_squared: float
    friction_squared: float
    kinetic_energy: float
    energy_residual: float
    energy: float  # above the start
    joint_friction: Annotated[Array, N]
    position_excess: Annotated[Array, N]
    joint_speed: Annotated[Array, N]
    joint_torque: Annotated[Array, N]


class Sums(Block, sizes=("n",)):
    """Of these the sum over the rows counts."""

    touching: float
    not_converged: float
    force_error_squared: float
    path_error_squared: float
    force: float  # magnitude
    torque: Annotated[Array, N]


class Flags(Block, sizes=("n",)):
    """1 where something is at fault, else 0; of these the first instant counts."""

    assumptions: Annotated[Array, len(NAMES)]
    position: Annotated[Array, N]
    velocity: Annotated[Array, N]
    effort: Annotated[Array, N]


class Powers(Block):
    """Of these the integral over time counts, by the trapezoidal rule over the rows."""

    torques: float  # |Qᵀq̇|
    friction: float


class Signals(Block, sizes=("n",)):
    """Signals whose changes of direction from row to row are counted."""

    force: float
    torque: Annotated[Array, N]


class Sample(Block, sizes=("n",)):
    """What a row has to say."""

    unsettled: float  # N by which the force is farther from that desired than it may be; the last above 0 counts
    contact_error: float  # e in contact, else 0; the first row's counts
    energy: float  # kinetic and potential, above that in the first row, J; what it rises by counts
    powers: Annotated[Array, Powers.count()]
    greatest: Annotated[Array, Greatest.count(N)]
    sums: Annotated[Array, Sums.count(N)]
    flags: Annotated[Array, Flags.count(N)]
    signals: Annotated[Array, Signals.count(N)]


class Scale(Block):
    """What of a run its rows are compared with."""

    largest_force: float  # largest |f_des|, N
    start_energy: float  # kinetic and potential energy in the first row, J
    start_supplied: float  # energy supplied until then, J


@kernel_inlined
def sample_row(
    row: Any, n: int, potential: Any, wanted: Any, limits: JointLimits, scale: Scale, sample: Sample
) -> None:
    """Write what a row of n joints has to say.

    `row`: columns by their names, see `closedloop.loop.step.record_row.Row`.
    `potential`: potential energy, J.
    `wanted`: what is desired at its instant, of which position and force count.
    `limits`, `scale`, `sample`: read, read, and written.
    """
    greatest, sums, flags = Greatest(sample.greatest, n), Sums(sample.sums, n), Flags(sample.flags, n)
    powers, signals = Powers(sample.powers), Signals(sample.signals, n)
    force, error, touching = row.contact_force, row.closure_error, row.mode != FREE
    greatest.force, greatest.minus_force, greatest.minus_mobility = force, -force, -row.normal_mobility
    held = row.normal_mobility > NEAR_SINGULAR
    greatest.singular_force = select(held, 0.0, abs(force))
    greatest.approach_force = select(held & (row.normal_mobility <= ON_THE_WAY), abs(force), 0.0)
    greatest.stabiliser_force = abs(row.stabiliser_force)
    greatest.residual_motion, greatest.residual_closure = row.residual_motion, row.residual_closure
    # Off the surface the closure error is a gap, not an error.
    sample.contact_error = select(touching, error, 0.0)
    greatest.closure_error = select(touching, abs(error), 0.0)
    greatest.closure_rate = select(touching, abs(row.closure_rate), 0.0)
    greatest.penetration = -error

    miss = force - wanted.force
    sample.unsettled = abs(miss) - SETTLED * scale.largest_force
    sums.touching = select(touching, 1.0, 0.0)
    sums.not_converged = select(row.residual_contacts <= NEAR, 0.0, 1.0)
    sums.force_error_squared = select(touching, miss * miss, 0.0)
    out, off_path, normal = 0.0, 0.0, row.surface_normal
    for k in range(3):
        out = out + normal[k] * (row.position[k] - wanted.position[k])
    for k in range(3):
        off = row.position[k] - wanted.position[k] - out * normal[k]
        off_path = off_path + off * off
    sums.path_error_squared = off_path
    sums.force, signals.force = abs(force), force

    in_joints = sample_joints(row, n, limits, sample)
    speed_squared, friction_squared = square(row.velocity), square(row.friction_force)
    greatest.tip_speed_squared, greatest.friction_squared = speed_squared, friction_squared

    greatest.kinetic_energy = row.kinetic_energy
    left = energy_left(row, potential, scale)
    greatest.energy_residual = abs(left)
    greatest.energy = sample.energy = row.kinetic_energy + potential - scale.start_energy
    powers.torques, powers.friction = abs(torque_power(row, n)), friction_power(row, n)

    met = assumptions_met(row, friction_squared, in_joints)
    for a in range(5):
        flags.assumptions[a] = select(met[a], 0.0, 1.0)


@kernel_inlined
def sample_joints(row: Any, n: int, limits: JointLimits, sample: Sample) -> Any:
    """Write what a row has to say of each joint, and return the sum of the magnitudes of friction in them, N m (N)."""
    greatest, sums, flags = Greatest(sample.greatest, n), Sums(sample.sums, n), Flags(sample.flags, n)
    signals = Signals(sample.signals, n)
    in_joints = 0.0
    for j in range(n):
        q, speed, torque, friction = row.q[j], abs(row.v[j]), row.torque[j], abs(row.joint_friction[j])
        over, under = q - limits.position_upper[j], limits.position_lower[j] - q
        excess, size = select(over > under, over, under), abs(torque)
        greatest.position_excess[j], greatest.joint_speed[j] = excess, speed
        greatest.joint_torque[j], greatest.joint_friction[j] = size, friction
        flags.position[j] = select(excess > AT_LIMIT, 1.0, 0.0)
        flags.velocity[j] = select(speed > limits.velocity[j], 1.0, 0.0)
        flags.effort[j] = select(size > limits.effort[j], 1.0, 0.0)
        sums.torque[j], signals.torque[j] = size, torque
        in_joints = in_joints + friction
    return in_joints


@kernel_inlined
def square(x: Any) -> Any:
    """Return the square of the length of a vector (3,)."""
    return x[0] * x[0] + x[1] * x[1] + x[2] * x[2]


@kernel_inlined
def energy_left(row: Any, potential: Any, scale: Scale) -> Any:
    """Return the energy unaccounted for, J; see `closedloop.record.report.summary.energy_balance`."""
    change = row.kinetic_energy + potential - scale.start_energy
    return change - (row.energy_supplied - scale.start_supplied)


@kernel_inlined
def torque_power(row: Any, n: int) -> Any:
    """Return Qᵀq̇, W."""
    total = 0.0
    for j in range(n):
        total = total + row.torque[j] * row.v[j]
    return total


@kernel_inlined
def friction_power(row: Any, n: int) -> Any:
    """Return the power of friction at the tip and in the joints, F_tᵀu_t + τᵀq̇, W: negative where it takes energy.

    At the tip it counts with the slip: on a surface that moves, the rest is work of what moves it. Bristles and springs
    of friction give back what they store, so the power of dahl, lugre and seven_parameter may be positive for a while.
    """
    total, in_joints = 0.0, 0.0
    for k in range(3):
        total = total + row.friction_force[k] * row.slip_velocity[k]
    for j in range(n):
        in_joints = in_joints + row.joint_friction[j] * row.v[j]
    return total + in_joints


# Numbers of a row that `write_control` writes.
CONTROL = 10
# In the table of values: after `MEASURES` how often each kind of event was, and when each assumption first failed, s,
# NaN if it held; then `JOINT_MEASURES`, each for all joints.
EVENTS_AT = len(MEASURES)
FAILED_AT = EVENTS_AT + len(KINDS)
WIDTH = FAILED_AT + len(NAMES)
_NONSINGULAR = NAMES.index("nonsingular")
_VALUES: dict[str, Any] = {
    **dict.fromkeys(MEASURES, float),
    "events": Annotated[Array, len(KINDS)],
    "failed_at": Annotated[Array, len(NAMES)],
    **dict.fromkeys(JOINT_MEASURES, Annotated[Array, N]),
}
# The values of a run of n joints, by their names; NaN for those that do not exist.
Values: Any = new_class(
    "Values", (Block,), {"sizes": ("n",)}, lambda space: space.update(__annotations__=_VALUES, __module__=__name__)
)


class Tally(Block, sizes=("n",)):
    """What the rows so far come to, of n joints."""

    h: float  # between two rows, s
    condition: float  # the largest condition number
    start_error: float
    last_unsettled: float  # the last row of which the force was not yet near that desired; -1: none
    excess_before: float  # `Sample.unsettled` of the row before
    settled: float  # from which row on it is near, by a line between two rows
    lowest_energy: float  # kinetic and potential, above that in the first row, J
    energy_gained: float  # largest rise above the lowest before, J
    scale: Annotated[Array, Scale.count()]
    powers_before: Annotated[Array, Powers.count()]
    work: Annotated[Array, Powers.count()]
    greatest: Annotated[Array, Greatest.count(N)]
    sums: Annotated[Array, Sums.count(N)]
    first: Annotated[Array, Flags.count(N)]
    signals: Annotated[Array, Signals.count(N), Signal.count()]
    sample: Annotated[Array, Sample.count(N)]


@entry_kernel
def measure_rows(
    tree: Tree, scratch: tuple[Array, Array], rows: Array, wanted: tuple[Array, int], h: float,
    limits: Array, events: Array, out: Array, signals: Array,
) -> None:  # fmt: skip
    """Write the values of a run.

    `tree`: the robot, for its potential energy.
    `scratch`: from `closedloop.simulation.engines.loops.compiled_work`, and (Tally.count(n),).
    `rows` (N, width): the record, N >= 1 of `closedloop.loop.step.record_row.Row`s, `h` seconds apart.
    `wanted`, (P, >= 2 n + 10) array, int: the table of what is desired, see `closedloop.loop.step.entries`, and how
        many of its rows there are to each of the record's.
    `limits` (4 n,): see `closedloop.record.report.measures.joint_limits`.
    `events` (E, EVENT_WIDTH): see `closedloop.loop.events.table`.
    `out`, (Values.count(n),) array: written.
    `signals` (CONTROL, N): written, see `write_control`.
    """
    measure(tree, scratch, rows, wanted, h, limits, events, out, signals)


@kernel_inlined
def measure(
    tree: Tree, scratch: tuple[Array, Array], rows: Array, wanted: tuple[Array, int], h: float,
    limits: Array, events: Array, out: Array, signals: Array,
) -> None:  # fmt: skip
    """Do as `measure_rows`."""
    n, count = tree.n, rows.shape[0]
    (terms, memory), (table, nodes) = scratch, wanted
    largest = 0.0
    for i in range(count):
        largest = max(largest, abs(Reference(table[i * nodes], n).force))
    tally, values, joint_limits = Tally(memory, n), Values(out, n), JointLimits(limits, n)
    begin_tally(tally, h, largest)
    sines = terms[n * n + n :]  # what the terms leave there, and more
    for i in range(count):
        row = Row(rows[i], n)
        potential = tree_potential_energy(tree, row.q, sines)
        count_row(row, n, potential, Reference(table[i * nodes], n), joint_limits, i, tally)
        count_condition(row, tally)
        write_control(row, Reference(table[i * nodes], n), signals, i)
    write_values(Row(rows[count - 1], n), n, count, tally, values)
    count_events(events, values)


@kernel_inlined
def count_events(events: Array, values: Any) -> None:
    """Count the rows of a table of events into the values of a run."""
    for i in range(events.shape[0]):
        event = EventRow(events[i])
        values.energy_lost_in_impacts += event.energy_lost
        values.energy_taken_at_rest += event.energy_rested
        values.largest_rate_cut = max(values.largest_rate_cut, event.rate_cut)
        values.events[int(event.kind) - 1] += 1.0


@kernel_inlined
def write_control(row: Row, wanted: Reference, signals: Array, i: int) -> None:
    """Write what the control of a run is judged by (`closedloop.record.report.control_verdict`) of row i.

    It is f and f_des, N, whether in contact, by how much the path is off the surface, m, the tip less its path along
    the surface, m, and the path, m.
    """
    out, normal = 0.0, row.surface_normal
    for k in range(3):
        out += normal[k] * (row.position[k] - wanted.position[k])
    signals[0, i], signals[1, i] = row.contact_force, wanted.force
    signals[2, i] = select(row.mode != FREE, 1.0, 0.0)
    signals[3, i] = row.closure_error - out
    for k in range(3):
        signals[4 + k, i] = row.position[k] - wanted.position[k] - out * normal[k]
        signals[7 + k, i] = wanted.position[k]


@kernel
def begin_tally(tally: Tally, h: float, largest: float) -> None:
    """Write the tally of no row: `h`, s, is the time between two rows, `largest` the largest |f_des|, N."""
    tally.h, tally.condition, tally.start_error, tally.last_unsettled = h, 0.0, 0.0, -1.0
    tally.excess_before = tally.settled = 0.0
    tally.lowest_energy = tally.energy_gained = 0.0
    scale = Scale(tally.scale)
    scale.largest_force = largest
    for k in range(tally.work.shape[0]):
        tally.work[k] = tally.powers_before[k] = 0.0
    for k in range(tally.greatest.shape[0]):
        tally.greatest[k] = -math.inf
    for k in range(tally.sums.shape[0]):
        tally.sums[k] = 0.0
    for k in range(tally.first.shape[0]):
        tally.first[k] = math.nan
    for k in range(tally.signals.shape[0]):
        for m in range(tally.signals.shape[1]):
            tally.signals[k, m] = 0.0


@kernel_inlined
def count_row(row: Row, n: int, potential: float, wanted: Reference, limits: JointLimits, i: int, tally: Tally) -> None:
    """Count row i in, all but its condition number; see `closedloop.record.report.measures.sample_row`."""
    scale, sample = Scale(tally.scale), Sample(tally.sample, n)
    if i == 0:
        scale.start_energy, scale.start_supplied = row.kinetic_energy + potential, row.energy_supplied
    sample_row(row, n, potential, wanted, limits, scale, sample)
    if i == 0:
        tally.start_error = sample.contact_error
    t = tally.h * i
    dt = t - tally.h * (i - 1)
    for k in range(sample.powers.shape[0]):
        power = sample.powers[k]
        if i > 0:
            tally.work[k] += 0.5 * (power + tally.powers_before[k]) * dt
        tally.powers_before[k] = power
    tally.last_unsettled = select(sample.unsettled > 0.0, 1.0 * i, tally.last_unsettled)
    enters = (sample.unsettled <= 0.0) & (tally.excess_before > 0.0)
    tally.settled = select(enters, i - 1.0 + share_inside(tally.excess_before, sample.unsettled), tally.settled)
    tally.excess_before = sample.unsettled
    tally.lowest_energy = min(tally.lowest_energy, sample.energy)
    tally.energy_gained = max(tally.energy_gained, sample.energy - tally.lowest_energy)
    for k in range(sample.greatest.shape[0]):
        tally.greatest[k] = max(tally.greatest[k], sample.greatest[k])
    for k in range(sample.sums.shape[0]):
        tally.sums[k] += sample.sums[k]
    raised = 0.0
    for k in range(sample.flags.shape[0]):
        raised += sample.flags[k]
    if not every(raised == 0.0):
        for k in range(sample.flags.shape[0]):
            first = tally.first[k]
            tally.first[k] = select((sample.flags[k] > 0.0) & (first != first), t, first)
    for k in range(sample.signals.shape[0]):
        count_signal(sample.signals[k], i, Signal(tally.signals[k]))


@kernel_inlined
def count_condition(row: Row, tally: Tally) -> None:
    """Count a row's condition number in."""
    tally.condition = max(tally.condition, row.kkt_condition)


@kernel
def write_values(last: Any, n: int, count: int, tally: Tally, values: Any) -> None:
    """Write the values of `count` rows of n joints with this tally and no event; `last` is the last row."""
    most, sums, work = Greatest(tally.greatest, n), Sums(tally.sums, n), Powers(tally.work)
    scale, first = Scale(tally.scale), Flags(tally.first, n)
    values.final_contact_force, values.final_closure_error = last.contact_force, last.closure_error
    values.peak_contact_force, values.min_contact_force = most.force, -most.minus_force
    values.min_normal_mobility, values.max_stabiliser_force = -most.minus_mobility, most.stabiliser_force
    values.singular_pose_passed = passed_singular_pose(last, most, first.assumptions[_NONSINGULAR])
    values.max_abs_closure_error, values.max_abs_closure_rate = most.closure_error, most.closure_rate
    values.deepest_penetration, values.start_closure_error = max(most.penetration, 0.0), tally.start_error
    values.max_kkt_residual = max(most.residual_motion, most.residual_closure)
    values.rows_not_converged = sums.not_converged
    values.max_kkt_condition, values.max_kinetic_energy = tally.condition, most.kinetic_energy
    values.max_tip_speed = math.sqrt(most.tip_speed_squared)
    values.max_friction_force = math.sqrt(most.friction_squared)
    values.max_energy_residual, values.energy_exchanged = most.energy_residual, work.torques
    values.energy_gained, values.energy_above_start = tally.energy_gained, max(most.energy, 0.0)
    values.energy_lost_to_friction = -work.friction
    values.time_in_contact = tally.h * (sums.touching - select(last.mode != FREE, 1.0, 0.0))
    touching = select(sums.touching > 0.0, sums.touching, math.nan)
    values.rms_force_error = math.sqrt(sums.force_error_squared / touching)
    settles = (scale.largest_force > 0.0) & (tally.last_unsettled < count - 1)
    values.force_settled_at = select(settles, tally.h * tally.settled, math.nan)
    values.rms_path_error = math.sqrt(sums.path_error_squared / count)
    force, joint_friction, mean = Signal(tally.signals[0]), 0.0 * sums.force, 0.0 * sums.force
    values.force_chatter = share_of(force.alternating, sums.force)
    values.energy_lost_in_impacts = values.energy_taken_at_rest = values.largest_rate_cut = 0.0
    values.largest_reference_force = scale.largest_force
    for k in range(values.events.shape[0]):
        values.events[k] = 0.0
    for k in range(values.failed_at.shape[0]):
        values.failed_at[k] = first.assumptions[k]
    for j in range(n):
        joint_friction = max(joint_friction, most.joint_friction[j])
        mean += sums.torque[j] / n
    values.max_joint_friction = joint_friction
    for j in range(n):
        torque = Signal(tally.signals[1 + j])
        values.position_excess[j] = max(most.position_excess[j], 0.0)
        values.max_joint_velocity[j], values.max_joint_torque[j] = most.joint_speed[j], most.joint_torque[j]
        values.position_limit_left_at[j] = first.position[j]
        values.velocity_limit_exceeded_at[j] = first.velocity[j]
        values.effort_limit_exceeded_at[j] = first.effort[j]
        values.torque_limited_share[j], values.torque_limited_at[j] = (
            0.0,
            math.nan,
        )  # see `closedloop.record.report.verdict`
        values.torque_chatter[j] = share_of(torque.alternating, max(sums.torque[j], LEAST_TORQUE * mean))


@kernel_inlined
def passed_singular_pose(last: Any, most: Greatest, first: float) -> float:
    """Return 1 if the tip came near singular poses on the way through only, and the contact force stayed as it was.

    `last`: the last row.
    `most`: over all rows.
    `first`: when the tip was first near such a pose, s; NaN: never.
    """
    on_the_way = (first > 0.0) & (last.normal_mobility > NEAR_SINGULAR)
    passed: float = select(on_the_way & (most.singular_force <= MOST_GROWTH * most.approach_force), 1.0, 0.0)
    return passed


@kernel_inlined
def share_inside(before: float, after: float) -> float:
    """Return where between two rows, from 0 to 1, a line from `before`, above 0, to `after`, not above it, is 0."""
    fall = select(before > after, before - after, 1.0)
    share: float = before / fall
    return share


@kernel_inlined
def share_of(part: float, whole: float) -> float:
    """Return part/whole, 0 of nothing."""
    share: float = select(whole > 0.0, part / select(whole > 0.0, whole, 1.0), 0.0)
    return share
