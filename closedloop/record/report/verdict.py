"""The verdict of a run: whether a run that ended is a good run, also where there are only the values of its summary.

A run ends whether or not its numbers mean anything. So each is judged by what a reader would have to look for, and the
verdict stands in the first line of the report, in ``summary.json`` and in a column of a batch's table:

========================  ==============================================================================
``stopped``               the simulation could not go on
``gains``                 gains that the step cannot carry (`closedloop.scenario.modes`), and it shows
``energy``                energy unaccounted for
``gain``                  energy of what nothing drives that grows
``convergence``           contact forces that did not converge
``chatter``               force or torque that alternates from row to row, or events without end
``closure``               the tip in contact is off the surface, or inside it
``position_limit``        a joint beyond its position limits
``velocity_limit``        a joint faster than its velocity limit
``effort_limit``          more torque asked of a joint than its effort limit
``step``                  f of a run at half the step differs too much (`closedloop.record.report.halved`)
``resolution``            what is fast that the step gets wrong (`closedloop.scenario.modes`)
``saturation``            a limit of `[drives]` cut a joint's torque more often than not
an assumption's name      an assumption of the paper that failed though the scenario keeps to it
========================  ==============================================================================

An ideal actuator is the paper's assumption, and nothing in the loop is cut unless `[drives]` asks for it: a run beyond
the arm's own limits is right about an arm that is not this one, which is no good run of this one.
"""

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from closedloop.base.arrays import Array
from closedloop.control.drives import AS_ASKED
from closedloop.mechanics.closure.contact_force import PRESSED, STUCK
from closedloop.mechanics.friction.contact import joint_contacts
from closedloop.mechanics.friction.law import AT_REST
from closedloop.mechanics.integrators import ADAPTIVE, scheme_of
from closedloop.mechanics.loops.reactions import torque_of_drives
from closedloop.mechanics.robot.pinocchio import Robot
from closedloop.record.columns.record import Record
from closedloop.record.report import measures as of_rows
from closedloop.scenario.arm import joint_friction_of, robot_of
from closedloop.scenario.modes import gains_fault
from closedloop.scenario.scenario import Scenario
from robot_models import RobotModel
from robot_models.tendon import loop_dynamics


def count_limited(limited: Array, h: float, values: Any) -> None:
    """Write `torque_limited_share` and `torque_limited_at` into a run's values.

    `limited` (N, n): the column `torque_limited`, N >= 1.
    `values`: see `closedloop.record.report.measures.Values`; written.
    """
    cut = limited != AS_ASKED
    values.torque_limited_share[:] = np.mean(cut, axis=0)
    values.torque_limited_at[:] = np.where(np.any(cut, axis=0), h * np.argmax(cut, axis=0), np.nan)


def not_determined_from(run: Record) -> float | None:
    """Return the first row's instant, s, at which f is the one of least friction, see `step.share_friction`; or None.

    There all joints rest, each with dry friction, and the tip is held along the surface by friction or not at all.
    """
    scenario = run.scenario
    law = joint_friction_of(scenario, run.model)
    if law.kind == "none" or law.sticks != "rigid" or scenario.contact or run.loops is not None or not len(run):
        return None
    if not all(each.stick_limit > 0.0 for each in joint_contacts(law, run.model.n)):
        return None
    if scenario.friction.kind == "none":
        if scenario.compliance.kind != "none":
            return None
        touching = run.mode == PRESSED
    else:
        touching = (run.mode == STUCK) & (scenario.friction.sticks == "rigid")
    after = run.v + scenario.time.step * run.acceleration
    rests = np.all((np.abs(run.v) <= AT_REST) & (np.abs(after) <= AT_REST), axis=1) & touching
    return float(run.time[np.argmax(rests)]) if np.any(rests) else None


def motions_without_drive(run: Record) -> int:
    """Return how many independent motions at the first row no drive takes part in, see
    `closedloop.mechanics.loops.reactions`."""
    model = run.model
    if not len(run) or not len(model.undriven):
        return 0
    if not model.loops:
        return len(model.undriven)
    return torque_of_drives(robot_of(run.scenario, model), np.array(run.q[0]), np.zeros(model.n))[1]


# Smaller angles than this, degrees, are those between the states of a row and of the stages beside it.
LEAST_ANGLE = 1.0


def friction_off_slip(run: Record) -> dict[str, float] | None:
    """Return the largest angle between −F_t and the slip, degrees, when, s, and the fastest slip at which there is one.

    Where friction would turn the slip within a step it points to where the slip will be
    (`closedloop.loop.step.tip_friction`): no step resolves it.

    None where friction is along the slip, to `LEAST_ANGLE`, at every row that slips; laws with elastic bristles have a
    direction of their own, and none is meant.
    """
    if run.scenario.friction.kind == "none" or run.scenario.friction.sticks != "rigid" or not len(run):
        return None
    slip, friction = run.slip_velocity, -run.friction_force
    speed, size = np.linalg.norm(slip, axis=1), np.linalg.norm(friction, axis=1)
    slips = (run.mode == PRESSED) & (speed > AT_REST) & (size > 0.0)
    cosine = np.einsum("ij,ij->i", slip, friction)[slips] / (speed * size)[slips]
    angle = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    if not np.any(angle > LEAST_ANGLE):
        return None
    return {
        "max_angle": float(np.max(angle)),
        "at": float(run.time[slips][np.argmax(angle)]),
        "below_speed": float(np.max(speed[slips][angle > LEAST_ANGLE])),
    }


GOOD = "good"

# Energy unaccounted for, over what the torques exchanged, friction took and the arm held at most. A step h of a scheme
# of order one errs by ½ h² dP/dt in the work of a power P, which sums to h/2τ of the energy exchanged where P changes
# over a time τ. A tenth is a power that changes within five steps: such a motion is no longer resolved. The trapezoidal
# rule of the balance and a scheme of order two leave h²/12τ², 0.003 for the same five steps, and three times that is
# room for the scheme's own. Where the power jumps, at events and held torques, the rule is of order one whatever the
# scheme. Shipped scenarios leave 0.02 at most (wam_bounce, wam_stick_slip), runs that shake themselves apart about 1.
ENERGY_SHARE = {1: 0.1, 2: 0.01}
# The share by which the energy of what nothing drives may rise, of what it could fall by: the error of steps that
# resolve the motion. With rk4 at 1 ms bodies that roll, rock and settle gain 1e-4 at most; explicit Euler gains a
# hundredth where they spin.
GAINED_SHARE = 1e-3
# Less than this is nothing, J: what the nominal 10 N do over a tenth of a micrometre, far below any run's exchange.
LEAST_ENERGY = 1e-6
# The share of a force or a torque that alternates from row to row. A signal that the step resolves turns by h²/τ² of
# itself: a twentieth is one that changes within four to five steps. Shipped scenarios have 0.003 at most, a joint that
# its step does not carry 0.15 and more.
CHATTER_SHARE = 0.05
# Events: a bounce of restitution 0.9 from 1 m/s to the default rest speed takes under a hundred impacts, and they end;
# a contact that is not resolved goes on with one in every few steps. A body of several contacts comes to rest by such
# bounces on a corner, on an edge and on a face.
EVENTS_OF_A_BOUNCE, BOUNCES_OF_A_BODY = 100, 3
STEPS_TO_AN_EVENT = 20
# A scheme that takes steps of its own resolves what alternates between its rows. Of rows farther apart than the nominal
# step, s, as many events are counted as of rows so far apart.
NOMINAL_STEP = 1e-3
# The repeatability of such arms is ±0.03 to ±0.1 mm: a tip that is farther than that from the surface it is on is not
# on it. With Baumgarte's stabiliser shipped scenarios keep 1e-8 m, without one 2e-6 m. A closure may start farther off
# (`closedloop.simulation.prepare.START_GAP`) and comes to it from there.
CLOSURE_BOUND = 1e-4

# A limit of the drives may cut a torque as the tip strikes, or as a motion starts; where it acts in most of the rows it
# is the limit that moves the arm, and no longer the law.
SATURATED_SHARE = 0.5

# The share of the largest force asked for by which f may differ from the run at half the step. Shipped scenarios differ
# by 0.1 at most.
STEP_SHARE = 0.5
# Of so many events bounces are the probable reason: a touchdown has fewer.
STRIKES = 6

# What a run says that stopped by it (`closedloop.simulation.engines.failures`).
DIVERGES = "the motion diverges"
# Problems with which gains that the step cannot carry show.
SHAKEN = {"stopped", "energy", "chatter", "closure"}

# What a joint's limits are about: the problem's name, value, when, what is said, and the units if it turns and if it
# slides.
_LIMITS = (
    ("position_limit", "position_excess", "position_limit_left_at",
     "is up to {:.3g} {} beyond its limits [{low:g}, {high:g}]", "rad", "m"),
    ("velocity_limit", "max_joint_velocity", "velocity_limit_exceeded_at",
     "moves with up to {:.3g} {}, its limit is {speed:g}", "rad/s", "m/s"),
    ("effort_limit", "max_joint_torque", "effort_limit_exceeded_at",
     "is asked for up to {:.3g} {}, its limit is {effort:g}", "N m", "N"),
)  # fmt: skip


class Facts(NamedTuple):
    """What a run is judged by."""

    # scenario, model: what was asked for, and of which robot
    scenario: Scenario
    model: RobotModel
    stopped: str | None  # why it could not go on
    steps: int  # how many steps it has; below 0: not a single row
    measures: Mapping[str, float | None]  # see `closedloop.record.report.measures.MEASURES`
    events: int  # how many events there were
    # of the assumptions that failed though they were expected to hold: when first, s, and what decided, in words
    failed: Mapping[str, tuple[float, str]]
    # see `closedloop.record.report.measures.JOINT_MEASURES`; when is NaN where it never was
    joints: Mapping[str, Sequence[float]]
    # see `closedloop.scenario.modes.unresolved` and `unresolved_feedback`
    unresolved: Sequence[str] = ()
    halved: Mapping[str, Any] | None = None  # see `closedloop.record.report.halved`, if the step's error was measured
    passive: bool = False  # whether nothing drives what moves


def outside_by_the_scenario(scenario: Scenario, model: RobotModel) -> set[str]:
    """Return the names of the paper's assumptions that the scenario itself, with its robot, gives up.

    Friction at the tip gives up freedom from it, and, since a tip may stick with three rows, the one row; friction in
    the joints the former; a unilateral contact that contact is kept. Without a surface the tip closes no loop.
    """
    outside = set()
    if scenario.friction.kind != "none":
        outside |= {"frictionless", "one_loop"}
    if scenario.rubs_in_joints or (model.loops and any(map(np.any, loop_dynamics(model)))):
        outside.add("frictionless")
    if scenario.surface.contact == "unilateral":
        outside.add("contact_kept")
    if not scenario.has_surface:
        outside |= {"one_loop", "nonsingular"}
    return outside


def outside_by_the_run(measures: Mapping[str, float | None], stopped: str | None) -> set[str]:
    """Return the names of the paper's assumptions that a run of these measures left in a determined way.

    Of a singular pose that the tip passed the force is known; of one in which the run stopped, or near which the
    force grew, began or ended, it is not.
    """
    return {"nonsingular"} if measures["singular_pose_passed"] == 1.0 and not stopped else set()


def judge(facts: Facts, gains: Callable[[], str]) -> list[dict[str, Any]]:
    """Return what is wrong with a run: a list of ``name``, ``at``, the instant, s, or None, and ``text``.

    `gains`: returns what is wrong with the gains for this step (`closedloop.scenario.modes.gains_fault`); called only
        if something else is wrong.
    """
    problems = [problem_of("stopped", facts.stopped)] if facts.stopped else []
    if facts.steps >= 0:
        each = (_energy(facts), _gain(facts), _convergence(facts), _chatter(facts), _closure(facts))
        problems += [problem for problem in each if problem]
    if SHAKEN & {problem["name"] for problem in problems} and (fault := gains()):
        problems.insert(0, problem_of("gains", fault))
    if facts.steps >= 0:
        problems += _limits(facts) + _saturation(facts)
        problems += [
            problem_of(name, f"an assumption of the paper that the scenario makes is violated: {measured}", at)
            for name, (at, measured) in facts.failed.items()
        ]
        problems += _step(facts) + [problem_of("resolution", text) for text in facts.unresolved]
    return problems


def names_of(problems: Sequence[Mapping[str, Any]]) -> str:
    """Return "good", or the names of the problems, each once, as a column of a table has them."""
    return ", ".join(dict.fromkeys(problem["name"] for problem in problems)) or GOOD


def probable_reason(problems: Sequence[Mapping[str, Any]]) -> str:
    """Return in words that an instability is the probable reason of these problems, "" where they do not look like one.

    One of many problems is the cause, and the others follow: a loop that is unstable breaks every bound in the end.
    """
    said = {problem["name"]: problem["text"] for problem in problems}
    if "gains" in said:
        return "probably unstable: the gains are too high for this step"
    if DIVERGES in said.get("stopped", ""):
        return "probably unstable: the motion diverges"
    if {"energy", "chatter"} <= said.keys():
        return "probably unstable: it oscillates from step to step"
    return ""


def energy_bound(facts: Facts) -> float:
    """Return how much energy may be unaccounted for, J; the argument is beside `ENERGY_SHARE`."""
    time, m = facts.scenario.time, facts.measures
    scheme = scheme_of(time.integrator)  # None: a user's, of which a run file has the name only
    order = 1 if scheme is None else min(2, scheme.order)
    if facts.events or facts.scenario.law.sample_period or facts.scenario.reads_encoders:
        order = 1
    return max(LEAST_ENERGY, ENERGY_SHARE[order] * energy_at_stake(m, facts.passive))


def energy_at_stake(measures: Mapping[str, float | None], passive: bool = False) -> float:
    """Return what the torques exchanged, friction took and the motion had at most, J; what is not known counts zero.

    The motion of a body that falls has what gravity gave it; if nothing drives it, no more than it had at the start.
    """
    exchanged, held = measures["energy_exchanged"] or 0.0, measures["max_kinetic_energy"] or 0.0
    lost = abs(measures["energy_lost_to_friction"] or 0.0)
    if passive:
        held = max(0.0, held - (measures["energy_gained"] or 0.0))
        return held + min(lost, held)
    return exchanged + lost + held


def _energy(facts: Facts) -> dict[str, Any] | None:
    left, bound = _number(facts.measures["max_energy_residual"]), energy_bound(facts)
    if left <= bound:
        return None
    if left == math.inf:
        return problem_of("energy", "the energy that is unaccounted for is not known: it is not a number in the record")
    gains = " or lower gains" if facts.scenario.has_law else ""
    return problem_of("energy", f"{left:.3g} J are unaccounted for, more than {bound:.2g} J: try a shorter step{gains}")


def _gain(facts: Facts) -> dict[str, Any] | None:
    """Return the problem of energy that grows though nothing drives what moves; what is stored comes back."""
    if not facts.passive:
        return None
    gained = _number(facts.measures["energy_above_start" if facts.scenario.stores_energy else "energy_gained"])
    bound = max(LEAST_ENERGY, GAINED_SHARE * energy_at_stake(facts.measures, passive=True))
    if gained <= bound:
        return None
    text = f"the energy grows by {gained:.3g} J, more than {bound:.2g} J, though nothing drives it: try a shorter step"
    other = " or time.integrator = 'rk4'" if facts.scenario.time.integrator not in ("rk4", *ADAPTIVE) else ""
    return problem_of("gain", text + other)


def _convergence(facts: Facts) -> dict[str, Any] | None:
    """Return the problem of iterations that ended before the forces of the contacts agreed with their motion."""
    rows = _number(facts.measures["rows_not_converged"]) if facts.scenario.contact else 0.0
    if not rows:
        return None
    where = f"{rows:.0f} of {facts.steps + 1} rows"
    return problem_of("convergence", f"forces of contacts did not converge in {where}: try a shorter step")


def _chatter(facts: Facts) -> dict[str, Any] | None:
    force = _number(facts.measures["force_chatter"]) if facts.scenario.has_surface else 0.0
    joints = [_number(share) for share in facts.joints["torque_chatter"]]
    said, time = [], facts.scenario.time
    own_steps = time.integrator in ADAPTIVE and time.step > NOMINAL_STEP
    if own_steps and math.isfinite(force):
        force, joints = 0.0, [0.0]
    if not force <= CHATTER_SHARE:
        said.append(f"{force:.2g} of the contact force")
    if joints and not max(joints) <= CHATTER_SHARE:
        worst = joints.index(max(joints))
        said.append(f"{joints[worst]:.2g} of the torque of joint {facts.model.joint_names[worst]}")
    text = " and ".join(said) + " alternates from row to row" if said else ""
    steps = facts.steps * (time.step / NOMINAL_STEP if own_steps else 1.0)
    links = Counter(contact.link for contact in facts.scenario.contact or ())
    bounces = int(facts.scenario.has_surface) + sum(min(n, BOUNCES_OF_A_BODY) for n in links.values())
    if facts.events > max(EVENTS_OF_A_BOUNCE * max(1, bounces), steps / STEPS_TO_AN_EVENT):
        text += f"{'; ' if text else ''}{facts.events} events in {facts.steps} steps"
    return problem_of("chatter", text) if text else None


def _closure(facts: Facts) -> dict[str, Any] | None:
    m = facts.measures
    if facts.scenario.compliance.kind != "none" or not facts.scenario.has_surface:
        return None  # a soft surface gives way
    bound = CLOSURE_BOUND + abs(m["start_closure_error"] or 0.0)
    error, depth = _number(m["max_abs_closure_error"]), _number(m["deepest_penetration"])
    if math.isfinite(facts.scenario.surface.bounds()[0]):
        depth = 0.0  # beyond the edge a tip that is free may be below the surface's level
    if error <= bound and depth <= bound:
        return None
    what = f"{depth:.2g} m inside the surface" if depth >= error else f"{error:.2g} m off the surface in contact"
    return problem_of("closure", f"the tip is {what}, more than {bound:.2g} m")


def _limits(facts: Facts) -> list[dict[str, Any]]:
    """Return a problem for each kind of limit and each joint that is beyond it."""
    problems, m = [], facts.model
    for name, measure, when, said, *units in _LIMITS:
        for j, at in enumerate(facts.joints[when]):
            if not math.isnan(at):
                text = said.format(
                    facts.joints[measure][j], units[m.joint_types[j] == "prismatic"], low=m.position_lower[j],
                    high=m.position_upper[j], speed=m.velocity_limit[j], effort=m.effort_limit[j],
                )  # fmt: skip
                problems.append(problem_of(name, f"joint {m.joint_names[j]} {text}", at))
    return problems


def _step(facts: Facts) -> list[dict[str, Any]]:
    """Return the problem of a force that differs too much at half the step, in a list; empty if there is none."""
    if facts.halved is None:
        return []
    if facts.halved["stopped"] and not facts.stopped:
        return [problem_of("step", f"the run at half the step could not go on: {facts.halved['stopped']}")]
    error, asked = facts.halved["force"], facts.measures["largest_reference_force"] or 0.0
    if error is None or not asked > 0.0 or error <= STEP_SHARE * asked:
        return []
    time = facts.scenario.time
    scheme = scheme_of(time.integrator)
    other = ", or time.integrator = 'rk4'" if scheme is None or scheme.order == 1 else ""
    text = (
        f"f differs by up to {error:.3g} N from the run at half the step, where at most {asked:.3g} N are asked for: "
        f"take a shorter time.step than {time.step:g} s{other}"
    )
    if facts.events >= STRIKES:
        text += "; while the tip bounces on, a small change grows from bounce to bounce, and no shorter step helps"
    return [problem_of("step", text)]


def _saturation(facts: Facts) -> list[dict[str, Any]]:
    """Return a problem for each joint whose torque a limit of the drives cut in most of the rows."""
    shares, since = facts.joints["torque_limited_share"], facts.joints["torque_limited_at"]
    names = facts.model.joint_names
    return [
        problem_of("saturation", f"[drives] cuts the torque of joint {name} in {100.0 * share:.3g} % of the rows", at)
        for name, share, at in zip(names, shares, since, strict=True)
        if share > SATURATED_SHARE
    ]


def problem_of(name: str, text: str, at: float | None = None) -> dict[str, Any]:
    """Return a problem: its name, its instant, s, None if it has none, and what is wrong in words."""
    return {"name": name, "at": None if at is None else float(at), "text": text}


def _number(value: float | None) -> float:
    """Return a value; one that does not exist is infinite, so that what is missing never passes."""
    return math.inf if value is None or math.isnan(value) else value


def verdict_of(
    scenario: Scenario, robot: Robot, values: Array, steps: int, stopped: str | None = None,
    swings: Sequence[str] = (), own_law: bool = False,
) -> str:  # fmt: skip
    """Return "good", or the names of what is wrong with a run, as `closedloop.record.report.verdict` judges its values.

    `swings` are what `closedloop.scenario.modes.unresolved` and `unresolved_feedback` say.
    """
    numbers, n = values.tolist(), robot.n
    measures = dict(zip(of_rows.MEASURES, numbers[: of_rows.EVENTS_AT], strict=True))
    outside = outside_by_the_scenario(scenario, robot.model) | outside_by_the_run(measures, stopped)
    failed = {
        name: (at, "")
        for name, at in zip(of_rows.NAMES, numbers[of_rows.FAILED_AT : of_rows.WIDTH], strict=True)
        if not math.isnan(at) and name not in outside
    }
    start = of_rows.WIDTH
    joints = {name: numbers[start + n * m : start + n * (m + 1)] for m, name in enumerate(of_rows.JOINT_MEASURES)}
    facts = Facts(
        scenario, robot.model, stopped, steps, measures,
        0 if steps < 0 else int(sum(numbers[of_rows.EVENTS_AT:of_rows.FAILED_AT])), failed,
        joints, swings, passive=scenario.is_passive and not own_law,
    )  # fmt: skip
    return names_of(judge(facts, lambda: gains_fault(scenario, robot)))


# Of what a bound is a share of, or is added to, the least is the worst, of some in size; of instants the first.
_LEAST = [
    list(of_rows.MEASURES).index(name) for name in ("energy_exchanged", "max_kinetic_energy", "singular_pose_passed")
]
_LEAST_IN_SIZE = [list(of_rows.MEASURES).index(name) for name in ("energy_lost_to_friction", "start_closure_error")]


def verdicts_of(
    scenarios: Sequence[Scenario], robot: Robot, values: Array, steps: int, swings: Sequence[Sequence[str]]
) -> list[str]:
    """Return `verdict_of` each of R runs in one set of lanes, of values (R, W).

    Where nothing is wrong with a run that is as bad in everything as the worst of them, each is good.
    """
    first, n, events = scenarios[0], robot.n, values[:, of_rows.EVENTS_AT : of_rows.FAILED_AT].any(axis=1)
    if not any(swings) and events.all() == events.any() and all(s.surface is first.surface for s in scenarios):
        worst, names = values.max(axis=0), list(of_rows.JOINT_MEASURES)
        worst[_LEAST] = values[:, _LEAST].min(axis=0)
        worst[_LEAST_IN_SIZE] = np.abs(values[:, _LEAST_IN_SIZE]).min(axis=0)
        instants = [of_rows.WIDTH + n * m + j for m, name in enumerate(names) if name.endswith("_at") for j in range(n)]
        instants += range(of_rows.FAILED_AT, of_rows.WIDTH)
        worst[instants] = np.fmin.reduce(values[:, instants], axis=0)
        if verdict_of(first, robot, worst, steps) == GOOD:
            return [GOOD] * len(scenarios)
    return [
        verdict_of(scenario, robot, own, steps, swings=said)
        for scenario, own, said in zip(scenarios, values, swings, strict=True)
    ]


def forget_absent(scenario: Scenario, values: Array, own_law: bool = False) -> None:
    """Write NaN for the measures that do not exist into the values (..., W) of runs."""
    absent = {*of_rows.absent_measures(scenario, own_law)}
    values[..., [at for at, name in enumerate(of_rows.MEASURES) if name in absent]] = math.nan
