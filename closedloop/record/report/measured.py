"""The values of a run's summary, row by row, in compiled code: for batches, which make no columns.

What a row has to say is `closedloop.record.report.measures`; here is how the rows are counted in, one after the
other. `closedloop.record.report.run_values` counts in the columns of a `Run`, many rows at a time.
"""

import math
from types import new_class
from typing import Annotated, Any

from closedloop.base.arrays import Array
from closedloop.control.reference.table import Reference
from closedloop.jit.blocks import Block
from closedloop.jit.kernel import entry_kernel, kernel, kernel_inlined
from closedloop.jit.simd8 import every, select
from closedloop.loop.events.table import KINDS, EventRow
from closedloop.loop.step.record_row import Row
from closedloop.mechanics.closure.contact_force import FREE
from closedloop.mechanics.robot.tree import Tree, tree_potential_energy
from closedloop.record.report.measures import (
    JOINT_MEASURES,
    LEAST_TORQUE,
    MEASURES,
    MOST_GROWTH,
    NAMES,
    NEAR_SINGULAR,
    Flags,
    Greatest,
    JointLimits,
    N,
    Powers,
    Sample,
    Scale,
    Signal,
    Signals,
    Sums,
    count_signal,
    sample_row,
)

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
    `scratch`: from `closedloop.simulation.engines.compiled.compiled_work`, and (Tally.count(n),).
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
