"""A scenario to begin with: ``closedloop new my_slide --robot ur5`` writes my_slide.toml, which runs as it is.

Where to start, which way to slide and with which gains is found by trying. The surface is level, or a wall for a tip
that hardly moves up and down. A tip that moves along one line only, such as the pad of a gripper, or finds no way to
slide, presses and stays where it is. What turns freely is held where the file has it, and joints without a drive that
carry all that have one: the trunk of a walking robot as on a stand, free bodies beside an arm where they lie.

Postures are drawn within the joint limits and kept if the tip is away from singular poses, the joints from their limits
and the torques from theirs; each that is kept is simulated, the best first, until the verdict of a run is good.
"""

from __future__ import annotations

import itertools
import math
import os
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import tomli_w

import robot_models
from closedloop.base import errors
from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError, one_line, printable
from closedloop.base.files import what_was_written, write_whole
from closedloop.command.border import DONE, Parser, as_command
from closedloop.mechanics.loops.assemble import START_OPEN, assembled, closed_start, errors_at
from closedloop.mechanics.loops.bind import loop_memory
from closedloop.mechanics.loops.reactions import loop_rows, torque_of_drives
from closedloop.mechanics.robot.pinocchio import Robot
from closedloop.mechanics.surface.placed import contact_frame
from closedloop.scenario.load import parse_scenario, scenario_of
from closedloop.scenario.modes import closed_mobility, gains_fault, unresolved_feedback
from closedloop.scenario.scenario import Scenario
from robot_models.coordinates import RATES
from robot_models.described import names_a_file
from robot_models.loop_coordinate import stands_for
from robot_models.model import AT_LIMIT, RobotModel
from robot_models.physics import SINGULAR, least_inertia


@as_command()
def main(words: list[str]) -> int:
    """Run the command line and return the exit status."""
    options = _parser().parse_args(words)
    file = Path(options.name if options.name.endswith(".toml") else f"{options.name}.toml")
    if os.path.lexists(file):
        raise errors.OutputError(f"{file}: is there already and is not replaced; choose another name")
    if not file.parent.is_dir():
        raise errors.OutputError(f"{file}: cannot be written: there is no folder {str(file.parent)!r}")
    if options.force is not None and not 0.0 < options.force <= MOST_FORCE:
        raise ScenarioError(f"--force {options.force:g}: must be greater than 0 and at most {MOST_FORCE:g} N")
    robot = Robot(held(options.robot), options.tip)
    scenario, model = first_slide(robot, options.robot, options.force), options.robot
    if names_a_file(model) and not os.path.isabs(model):  # named from the scenario's own folder
        model = Path(os.path.relpath(model, file.parent)).as_posix()
    text = scenario_text(scenario, robot, model)
    parse_scenario(text, file.stem, str(file))  # refuses a name that is none
    write_whole(file, text.encode(), replace=False)
    print(printable(f"{what_was_written(file)}: {_what(scenario, robot)}"))
    others = [name for name in robot.model.frames if name != robot.tip]
    why = "as asked" if options.tip else "the frame of a tool or the end of the longest chain"
    print(printable(f"the tip is {robot.tip}, {why}; others, see --tip: {', '.join(others[-MOST_TIPS:])}"))
    if scenario.robot.stops:
        print("joints strike hard stops at the limits of the robot's file: robot.stops")
    if robot.model.locked:
        print(printable(f"held rigid, see robot.lock: {', '.join(robot.model.locked)}"))
    print(printable(f"run it with: closedloop run {file}"))
    return DONE


MOST_TIPS = 12  # that are listed
MOST_FORCE = 1e4  # N; what is beyond no arm of the lists bears


def _parser() -> Parser:
    parser = Parser(
        prog="closedloop new",
        description="Write a commented scenario in which a robot presses on a level surface, or a wall if its tip "
        "hardly moves up and down, and slides along it. What turns freely is held where its file has it. Start, path "
        "and gains are chosen so that it runs as it is, with a good verdict.",
    )
    parser.add_argument("name", metavar="NAME", help="its name, and that of the file NAME.toml; none is replaced")
    parser.add_argument("--robot", default="wam4", help="a name of `closedloop robots`, or a file (default wam4)")
    parser.add_argument("--tip", metavar="FRAME", help="frame that touches the surface (default: the robot's own)")
    parser.add_argument(
        "--force", type=float, metavar="N", help="force to press with (default 10, less for an arm that cannot)"
    )
    return parser


def scenario_text(scenario: Scenario, robot: Robot, model: str) -> str:
    """Return a scenario of `first_slide` as a commented file; `model` is what robot.model is to say in it."""
    law, normal = scenario.law.model_dump(), list(scenario.surface.normal)
    surface = "level" if tuple(normal) == LEVEL else "a wall"
    start = scenario.start.q
    assert isinstance(start, tuple)
    width = max(len(f"{q!r},") for q in start)
    assembled = (
        "assemble = true  # close the loops and couplings of the robot from there\n" if robot.model.loops else ""
    )
    posture = "\n".join(
        f"    {f'{q!r},':{width}}  # {one_line(name)}" for q, name in zip(start, robot.joint_names, strict=True)
    )
    return f"""\
# {_what(scenario, robot)}
# Run it with `closedloop run FILE`. `closedloop run --help law` lists all keys of a
# section, `closedloop run --explain law.kp` explains one.
description = {_quoted(_what(scenario, robot))}

[robot]
model = {_quoted(model)}  # `closedloop robots {one_line(model)}` shows its joints and frames
tip = {_quoted(robot.tip)}  # the frame that touches the surface
stops = {"true" if scenario.robot.stops else "false"}  # joints strike hard stops at their limits
{_lock(scenario)}
[surface]
normal = {normal}  # out of the surface, base frame: it is {surface}
offset = "start"  # it goes through the tip at the start
contact = "bilateral"  # the tip is held to it; with "unilateral" it may leave

[start]
q = [  # rad, m for a sliding joint: away from singular poses and from the limits
{posture}
]
{assembled}
[reference]
{_path(scenario)}
[law]
kind = "paper"  # Eq. 33: joint PD control along the path, and the force
kp = {list(law["kp"])}  # N m/rad, one for each joint
kd = {list(law["kd"])}  # N m s/rad
force = {law["force"]}  # N, with which the tip presses

[stabiliser]
kind = "baumgarte"  # keeps the tip on the surface
damping_ratio = 0.707
time_constant = 0.001  # s

[time]
duration = {scenario.time.duration}  # s
step = {scenario.time.step}  # s
integrator = "{scenario.time.integrator}"
"""


def _lock(scenario: Scenario) -> str:
    """Return the line that says which joints are held rigid, if there are any."""
    lock = scenario.robot.lock or {}
    held = ", ".join(tomli_w.dumps({joint: value}).strip() for joint, value in lock.items())
    return f"lock = {{ {held} }}  # held rigid there, rad (m); 0: as the file has it\n" if lock else ""


def _path(scenario: Scenario) -> str:
    path = scenario.reference.model_dump()
    if path["kind"] == "hold":
        return 'kind = "hold"  # the tip stays where it is: it moves along one line only\n'
    return f"""\
kind = "line"
direction = {list(path["direction"])}  # along the surface, base frame
speed = {path["speed"]}  # m/s, on average
start = {path["start"]}  # s
stop = {path["stop"]}  # s
timing = "minimum_jerk"  # from rest to rest
"""


def _what(scenario: Scenario, robot: Robot) -> str:
    path = scenario.reference.model_dump()
    pressing = f"{one_line(robot.model.name)} presses with {scenario.law.force:g} N"
    surface = "a level surface" if tuple(scenario.surface.normal) == LEVEL else "a wall"
    if path["kind"] == "hold":
        return f"{pressing} on {surface}"
    return f"{pressing} and slides {1000.0 * path['speed'] * (path['stop'] - path['start']):g} mm along {surface}"


def _quoted(text: str) -> str:
    return tomli_w.dumps({"x": text}).partition("=")[2].strip()


POSTURES, SEED = 2000, 0  # drawn, fewer for more than twenty joints
MOST_RUNS = 60  # simulated
# Least share of the tip's mobility along the normal, of its smallest to its largest velocity, and of a joint's range to
# its nearest limit; a third of the mobility is that of a tip that moves alike in all directions.
LEAST_MOBILITY, LEAST_DEXTERITY, LEAST_MARGIN = 0.03, 0.1, 0.05
MOST_EFFORT = 0.6  # of the torque limits, at rest
# Of a level surface, and of walls, which are tried if no posture will do on those before.
LEVEL = (0.0, 0.0, 1.0)
NORMALS = (LEVEL, (-1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
FORCES = (10.0, 5.0, 2.0, 1.0, 0.5)  # N, tried in turn where none is asked for
BEGIN, END, DURATION = 0.5, 3.5, 4.0  # of the slide and of the run, s
SPEEDS = {0.02: 24, 0.01: 12, 0.005: 12, 0.0: 12}  # of the slide, m/s, in this order, and how many runs each has
STEP = 0.001  # s
FREQUENCY = 15.0  # of a joint with its gains, rad/s; lowered where the step cannot carry them
MOST_DAMPING = 0.2  # of a joint's velocity in a step, which a step gets right by a tenth

# What is looked at, in this order; a posture that fails late is nearly right.
LIMITS, INERTIA, MOBILITY, DEXTERITY, EFFORT, LOOPS, PATH, RUN = range(8)
Faults = dict[int, str]  # what is wrong with the first posture that failed there


class Posture(NamedTuple):
    """A start, how good it is, and the directions in which the tip can slide; none: it presses and stays."""

    q: Array
    score: float
    normal: tuple[float, float, float]
    directions: tuple[tuple[float, ...], ...]
    #: (n,) what the joints bear at rest, N m (N), and what each newton with which the tip presses takes off it.
    weight: Array
    along: Array


def first_slide(robot: Robot, name: str, force: float | None = None) -> Scenario:
    """Return a scenario in which a robot presses on a surface and slides, with a run whose verdict is good.

    `name`: what `robot.model` is to say.
    `force`: force to press with, N; if left out the first of `FORCES` with which there is such a scenario.
    Raises ScenarioError if none was found; says what was in the way of the one that was nearly right.
    """
    if robot.turns_freely:
        raise ScenarioError(
            f"--robot: {robot.model.name} turns freely, and no joint is left to move a tip if it is held"
        )
    if not robot.model.driven.any():
        raise ScenarioError(f"--robot: {robot.model.name} has no joint with a drive: only an arm is set to slide")
    if not robot.model.loops and not np.any(robot.model.driven & (robot.support > 0.0)):
        raise ScenarioError(
            f"{robot.model.name} with the tip {robot.tip}: no joint with a drive moves it; another frame may work, "
            "see --tip"
        )
    if robot.model.loops:
        memory = loop_memory(robot)
        posture = assembled(robot, memory, np.array(robot.model.loop_home))
        left = float(np.max(np.abs(errors_at(robot, memory, posture, np.zeros(robot.n))[0])))
        if left > START_OPEN:
            raise ScenarioError(
                f"{robot.model.name}: its loops stay open by {left:.3g} m (rad) near the posture of its file; check "
                "where the loop joints are on their links"
            )
    closed = cache(lambda q, normal: _closed(robot, np.array(q), normal))
    faults: Faults = {}
    runs = 0
    postures: list[Posture] = []
    for normal in NORMALS:
        there = list(_postures(robot, normal, faults))
        if sliding := [posture for posture in there if posture.directions]:
            postures = sliding
            break
        postures = postures or there
    for pressing in FORCES if force is None else (force,):
        found = [good for posture in postures if (good := _pressing(robot, posture, pressing, faults))]
        found.sort(key=lambda posture: -posture.score)
        for scenario in itertools.islice(_scenarios(robot, name, pressing, found, faults), MOST_RUNS - runs):
            runs += 1
            stage, fault = 0, ""
            if robot.model.loops:
                borne = closed(scenario.start.q, scenario.surface.normal)
                stage = LOOPS if isinstance(borne, str) else EFFORT
                fault = borne if isinstance(borne, str) else _effort(robot, *borne, pressing)[1]
            if not fault:
                stage, fault = _fault(scenario, robot)
            if not fault:
                return scenario
            faults.setdefault(stage, fault.partition(";")[0])
    raise ScenarioError(
        f"{robot.model.name} with the tip {robot.tip}: no start was found from which it presses on a surface; "
        f"at the best posture found: {faults[max(faults)]}; another frame may work, see --tip"
    )


def _closed(robot: Robot, q: Array, normal: tuple[float, float, float]) -> tuple[Array, Array] | str:
    """Return what the drives of a mechanism bear where it is closed near q, as in `Posture`, or why it is not."""
    still = np.zeros(robot.n)
    try:
        posture, _ = closed_start(robot, robot.rotation_vectors(q), still, assemble=True)
    except ScenarioError as error:
        return str(error).partition(";")[0]
    terms = robot.terms(posture, still)
    bias, along = np.array(terms.bias), contact_frame(normal)[0] @ terms.jacobian
    return torque_of_drives(robot, posture, bias)[0], torque_of_drives(robot, posture, along)[0]


def held(name: str) -> RobotModel:
    """Load a robot and hold where its file has it what turns freely, or carries all drives and has none itself."""
    model = robot_models.load(name)
    of_loops = stands_for(model.loops)
    balls = [model.joint_names[j].removesuffix(RATES[0]) for j in model.balls]
    stand = {joint: 0.0 for joint in balls if joint not in of_loops}
    if not model.loops and model.driven.any():
        mechanism = model.pinocchio_model()
        chains = [
            {mechanism.names[i] for i in mechanism.supports[mechanism.getJointId(model.joint_names[j])]}
            for j in np.flatnonzero(model.driven)
        ]
        carriers = set.intersection(*chains) - {*np.array(model.joint_names)[model.driven | model.free]}
        home = zip(model.coordinate_names, model.home.tolist(), strict=True)
        stand |= {joint: value for joint, value in home if joint in carriers}
    if not stand or all(model.of_bodies):
        return model
    return robot_models.load(name, lock=dict(model.locked) | stand)


def _postures(robot: Robot, normal: tuple[float, float, float], faults: Faults) -> Iterator[Posture]:
    """Return the postures that will do if the joints are strong enough, and note why others do not."""
    model, rng = robot.model, np.random.default_rng(SEED)
    widest = np.where(np.array(model.joint_types) == "prismatic", 1.0, math.pi)
    low = np.maximum(model.position_lower, model.home - widest)
    high = np.minimum(model.position_upper, model.home + widest)
    moves = robot.support > 0.0
    room = LEAST_MARGIN * (high - low)
    aside = _aside(robot, rng, low + room, high - room)
    for i in range(POSTURES // max(1, robot.n // 10)):  # a step of the search costs as the cube of n
        q: Array = np.where(moves, rng.uniform(low, high) if i else model.home, aside).round(4)
        q = np.clip(q, model.position_lower, model.position_upper)  # of a small range the fourth digit may be out
        posture = _judged(robot, normal, q, first=i == 0)
        if isinstance(posture, Posture):
            yield posture
        else:
            faults.setdefault(*posture)


def _aside(robot: Robot, rng: np.random.Generator, low: Array, high: Array) -> Array:
    """Return where the joints stay that do not move the tip: at home, or where they are least loaded if not there.

    Those of loops and couplings stay at home, where they are closed.
    """
    home, aside = np.asarray(robot.model.home), robot.support == 0.0
    turns = aside.copy()
    if robot.model.loops:
        turns &= ~np.any(loop_rows(robot, home[None], np.zeros((1, robot.n)))[0][0], axis=0)

    def effort(q: Array) -> float:
        terms = robot.terms(q, np.zeros(robot.n))
        torque = np.abs(terms.bias)
        if least_inertia(terms.mass_matrix) < SINGULAR:
            return math.inf  # at another posture they may move some
        return float(np.max((torque / robot.model.effort_limit)[aside], initial=0.0))

    q = np.where(turns, np.clip(home, low, high), home)
    if effort(q) <= MOST_EFFORT:
        return q
    drawn = [np.where(turns, rng.uniform(low, high), q) for _ in range(POSTURES // 10)]
    return min([q, *drawn], key=effort)


def _judged(robot: Robot, normal: tuple[float, float, float], q: Array, first: bool) -> Posture | tuple[int, str]:
    """Return a posture with its score, or where it fails and why; the robot's own is preferred where it will do."""
    model = robot.model
    span = model.position_upper - model.position_lower
    room = np.minimum(q - model.position_lower, model.position_upper - q)
    bounded = np.isfinite(span) & (robot.support > 0.0)
    least = np.where(bounded, LEAST_MARGIN * span, -AT_LIMIT)
    if np.any(out := ~(room >= least) | bounded & (span <= 0.0)):
        j = int(np.argmax(out))
        name, limits = model.joint_names[j], f"[{model.position_lower[j]:g}, {model.position_upper[j]:g}]"
        if span[j] <= 0.0:
            return LIMITS, f"joint {name} cannot move: its limits are {limits}"
        return LIMITS, f"joint {name} is at {q[j]:g}, which leaves no room in its limits {limits}"
    margin = float(np.min(room[bounded] / span[bounded], initial=0.5))
    terms = robot.terms(q, np.zeros(robot.n))
    if least_inertia(terms.mass_matrix) < SINGULAR:
        return INERTIA, "joints that move together move no inertia: look at the tensors of the links"
    frame = contact_frame(normal)
    A = frame @ terms.jacobian
    S = A @ closed_mobility(robot, q, np.linalg.inv(terms.mass_matrix)) @ A.T
    mobility = float(S[0, 0] / max(np.trace(S), 1e-300))
    if not terms.jacobian.any():
        return MOBILITY, "no joint moves the tip: it lies on their axes, and tool.offset puts it elsewhere"
    if not mobility > LEAST_MOBILITY:
        return MOBILITY, "the tip hardly moves, neither up and down nor across a wall"
    basis = np.eye(robot.n)  # of the joint velocities that loops and couplings allow
    if robot.model.loops:
        _, sizes, motions = np.linalg.svd(loop_rows(robot, q[None], np.zeros((1, robot.n)))[0][0])
        basis = motions[np.count_nonzero(sizes > 1e-9 * sizes[0]) :].T
    U, sizes, _ = np.linalg.svd(terms.jacobian @ basis, full_matrices=False)
    rank = int(np.count_nonzero(sizes > 1e-6 * sizes[0]))
    dexterity = float(sizes[rank - 1] / sizes[0])
    directions = tuple(_directions(U[:, :rank], frame))
    if dexterity < LEAST_DEXTERITY or (rank > 1 and not directions):
        return DEXTERITY, "the tip is near a singular pose, or cannot move along the surface"
    score = min(1.0, 3.0 * mobility) * dexterity * min(1.0, 4.0 * margin)
    # A last link that stands on the surface counts most, one that comes from below least.
    length = float(np.linalg.norm(robot.tip_offset))
    lever = robot.views[3] @ robot.tip_offset  # from the last joint to the tip, base frame
    score *= (10.0 if first else 1.0) * (1.0 if length == 0.0 else 0.55 - 0.45 * float(lever @ frame[0]) / length)
    return Posture(q, score, normal, directions, np.array(terms.bias), A[0])


def _pressing(robot: Robot, posture: Posture, force: float, faults: Faults) -> Posture | None:
    """Return a posture with its score if the joints can press with a force, N; note why if not.

    Of a mechanism with loops that is asked where they are closed.
    """
    if robot.model.loops:
        return posture
    effort, fault = _effort(robot, posture.weight, posture.along, force)
    if not fault:
        return posture._replace(score=posture.score * (1.0 - effort))
    faults.setdefault(EFFORT, fault)
    return None


def _effort(robot: Robot, weight: Array, along: Array, force: float) -> tuple[float, str]:
    """Return the largest share of a joint's limit that pressing takes, and whether that is too much, in words."""
    model = robot.model
    torque = np.abs(weight - along * force)
    weakest = int(np.argmax(torque / model.effort_limit))
    effort = float(torque[weakest] / model.effort_limit[weakest])
    if effort <= MOST_EFFORT:
        return effort, ""
    what = f"to press with {force:g} N: that" if along[weakest] else "for what it carries at rest, which"
    return effort, (
        f"joint {model.joint_names[weakest]} is too weak {what} takes {effort:.0%} of its effort limit, and at most "
        f"{MOST_EFFORT:.0%} are used"
    )


def _directions(reached: Array, frame: Array) -> Iterator[tuple[float, ...]]:
    """Return directions along the surface in which the tip can move; `reached` (3, rank) spans its velocities.

    `frame` (3, 3) has the normal and the tangents of the surface as rows.
    """
    across = frame[1:].T
    for direction in (frame[2], frame[1], -frame[2], -frame[1]):
        if np.linalg.norm(reached @ (reached.T @ direction) - direction) < 1e-9:
            yield tuple((direction + 0.0).tolist())
    shares, axes = np.linalg.eigh(across.T @ reached @ reached.T @ across)  # an arm in a plane that is turned
    for share, axis in zip(shares, axes.T, strict=True):
        if reached.shape[1] < 3 and share > 1.0 - 1e-12:
            yield tuple((across @ axis + 0.0).tolist())


def _scenarios(robot: Robot, name: str, force: float, postures: list[Posture], faults: Faults) -> Iterator[Scenario]:
    """Return scenarios to be tried, the best first; `faults` has those of the ones before."""
    for speed, most in SPEEDS.items():
        if speed < max(SPEEDS) and PATH not in faults:
            return  # a slow slide is a short one: it helps where the long one leaves the workspace, or none at all
        ways = 2 if speed > 0.0 else 0
        tried = ((posture, direction) for posture in postures for direction in posture.directions[:ways] or (None,))
        for posture, direction in itertools.islice(tried, most):
            yield _with_gains(robot, name, force, posture.q, direction, speed, posture.normal)


def _with_gains(
    robot: Robot, name: str, force: float, q: Array, direction: tuple[float, ...] | None, speed: float,
    normal: tuple[float, float, float] = LEVEL,
) -> Scenario:  # fmt: skip
    """Return the scenario with gains that the step carries: a frequency times the inertia of each joint."""
    H = robot.terms(q, np.zeros(robot.n)).mass_matrix
    inertia = np.diag(H)
    # A joint moves less where those beyond it give way: its damping acts on that.
    damping = 2.0 * STEP * inertia * np.diag(closed_mobility(robot, q, np.linalg.inv(H)))  # in a step, at 1 rad/s
    reference: dict[str, Any] = {"kind": "hold"}
    if direction is not None:
        reference = {
            "kind": "line", "direction": list(direction), "speed": speed, "start": BEGIN, "stop": END,
            "timing": "minimum_jerk",
        }  # fmt: skip
    bounded = bool(np.isfinite([robot.model.position_lower, robot.model.position_upper]).any())
    frequency = np.minimum(FREQUENCY, MOST_DAMPING / np.maximum(damping, MOST_DAMPING / FREQUENCY))
    while True:
        kp, kd = ([float(f"{x:.2g}") for x in gain * inertia] for gain in (frequency * frequency, 2.0 * frequency))
        data: dict[str, Any] = {
            "robot": {"model": name, "tip": robot.tip, "stops": bounded}
            | ({"lock": dict(robot.model.locked)} if robot.model.locked else {}),
            "start": {"q": q.tolist()} | ({"assemble": True} if robot.model.loops else {}),
            "surface": {"kind": "plane", "normal": list(normal)},
            "reference": reference,
            "law": {"kind": "paper", "kp": kp, "kd": kd, "force": force},
            "time": {"duration": DURATION, "step": STEP, "integrator": "semi_implicit_euler"},
        }  # fmt: skip
        scenario = scenario_of(data, "closedloop new", {})
        if np.max(frequency) < 1.0 or not _fault_of_gains(scenario, robot):
            return scenario
        frequency *= 0.7


def _fault_of_gains(scenario: Scenario, robot: Robot) -> str:
    """Return why the step does not carry the gains, or gets the motion that they make wrong, or an empty string."""
    return gains_fault(scenario, robot) or next(iter(unresolved_feedback(scenario, robot)), "")


def _fault(scenario: Scenario, robot: Robot) -> tuple[int, str]:
    """Return where a scenario fails, before its run by its path or after it, and why: an empty string if it is good."""
    from closedloop.simulation.simulate import beside_half, simulate

    if fault := _fault_of_gains(scenario, robot):
        return RUN, fault
    try:
        run = simulate(scenario, model=robot.model)
        problems = run.summary()["verdict"]["problems"]
        if not problems and not robot.model.loops:  # as `closedloop run` asks in the end
            problems = beside_half(run, model=robot.model, progress=False).summary()["verdict"]["problems"]
    except errors.InterruptedRunError:
        raise
    except (ScenarioError, errors.SimulationError) as error:
        return PATH if isinstance(error, ScenarioError) else RUN, errors.faults_on_one_line(error)
    return RUN, str(problems[0]["text"]) if problems else ""
