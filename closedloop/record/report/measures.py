"""The values of a run's summary: their names, units and meaning, in order; first the run's, then each joint's.

What a recorded row has to say to the summary is defined once for every way to go over the rows. `sample_row` works on
one row in a compiled batch, on the rows of eight runs side by side (`closedloop.jit.simd8`), and, interpreted, on whole
columns of a `Run`. It has no memory of other rows. What is taken over the rows, the largest, the sum, the first
instant, is the same for all values of a group: `closedloop.record.report.measured` does it row by row,
`closedloop.record.report.run_values` with numpy.

Chatter is how much of a signal alternates from row to row. What alternates is the part x_i = ... + (−1)^i a: its second
differences are 4 a and change their sign from row to row, so a quarter of the smaller of two neighbours is taken
wherever they differ in sign.

Both forms are needed: a batch has one row at a time, of one run or of eight; a `Run` has columns, and interpreted the
loop would take a thousand times as long. `tests/closedloop/record/test_measured.py` holds them equal.
"""

from typing import Annotated, Any, NamedTuple

import numpy as np

from closedloop.base.arrays import Array
from closedloop.jit.blocks import Block, Count
from closedloop.jit.kernel import kernel_inlined
from closedloop.jit.simd8 import select
from closedloop.mechanics.closure.contact_force import FREE, STUCK
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

    What is driven, or touches something that moves by itself, may gain energy.
    """
    without_law: tuple[str, ...] = ("rms_path_error",) if not (scenario.has_law or own_law) else ()
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
