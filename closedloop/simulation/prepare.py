"""From a scenario to a `Problem`, or to the one line that says what is wrong with it.

Where the tip is to the surface at the start: on it, off it, or refused.
"""

from collections.abc import Hashable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from operator import itemgetter
from threading import get_ident
from typing import Any

import numpy as np

import robot_models
from closedloop.base.arguments import arguments_checked
from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError
from closedloop.control.drives import torque_limits, torque_steps, transmission_constants
from closedloop.control.law import Compensation
from closedloop.control.laws.paper import PaperLaw
from closedloop.control.reference.desired import Desired, DrawnRow, Motion, Reference, TableRow, desired
from closedloop.control.reference.path import force_at, refuse_narrow
from closedloop.control.reference.tip_path import TipPath, edge_key
from closedloop.control.sensor import check_steps, draws, encoder_draws, pack_sensor
from closedloop.jit.parameters import lists_per_joint, pack
from closedloop.jit.user_code import of_users
from closedloop.mechanics.closure.contact_force import FREE, PRESSED, STUCK
from closedloop.mechanics.friction.law import JointFriction
from closedloop.mechanics.limits import RESTING, TOUCHING
from closedloop.mechanics.loops.assemble import closed_start
from closedloop.mechanics.robot.pinocchio import Robot
from closedloop.mechanics.surface.along import check_rates
from closedloop.mechanics.surface.compliances.none import Rigid
from closedloop.mechanics.surface.kinds.none import NoSurface
from closedloop.mechanics.surface.kinds.plane import PlaneSurface
from closedloop.mechanics.surface.placed import PlacedSurface, Touching, unit
from closedloop.mechanics.surface.surface import Surface, largest_mobility
from closedloop.record.columns.derived import StatesOf
from closedloop.scenario import arm
from closedloop.scenario.arm import with_collision_shapes
from closedloop.scenario.modes import check_transmission
from closedloop.scenario.scenario import NO_ROBOT, Scenario
from closedloop.scenario.user_module import member_digests
from closedloop.simulation import time_step
from closedloop.simulation.engines import scenario_numbers
from closedloop.simulation.engines.bind_contacts import contact_rows, placed_contacts
from closedloop.simulation.engines.problem import STICK_SPEED, Problem
from closedloop.simulation.loop_calls import have_compiled
from closedloop.simulation.parts import Cache, Made, Maker, Parts, Watched, law_as, without
from robot_models import RobotModel
from robot_models.bodies import only_bodies
from robot_models.model import AT_LIMIT

# Numbers of a law that change from run to run, on which neither its states nor its class depend.
OFTEN_OTHER = "force", "kp", "kd"
# A path on a surface that moves goes on this much longer than the run, so that its last row is no end of it.
BEYOND = 1.001
# Memory of a robot, with Pinocchio's model and data, about, bytes.
ROBOT_BYTES = 200_000
# Largest |e| of the tip at the start, m: with the paper's stabiliser the force due to a larger error would dominate, a
# thousand newtons for each kilogram of apparent mass and each millimetre.
START_GAP = 1e-3
# Largest |ė| of a tip in contact at the start, m/s: the rounding of a velocity given to four digits. The stabiliser has
# to stop it, with 0.14 N for each kilogram of apparent mass at the paper's setting; without one the error would grow.
START_RATE = 1e-4
# A tip somewhere, for a surface that is not placed yet.
ORIGIN = np.zeros(3)


def start_state(scenario: Scenario, model: RobotModel) -> tuple[Array, Array]:
    """Return q and q̇ (n,) as they are asked for and as the loop has them, refusing joints beyond their limits."""
    try:
        q, v = arm.start_posture(scenario, model), arm.start_velocities(scenario, model)
    except ScenarioError:
        refuse_lengths(scenario, model)  # all of them
        raise
    if faults := [
        f"start.q[{j}] = {q[j]:g}: joint {model.joint_names[j]} of {model.name} moves within [{low:g}, {high:g}] "
        + ("m" if model.joint_types[j] == "prismatic" else "rad")
        for j, (low, high) in enumerate(zip(model.position_lower, model.position_upper, strict=True))
        if not low - AT_LIMIT <= q[j] <= high + AT_LIMIT
    ]:
        raise ScenarioError(*faults)
    return q, v


def refuse_combinations(scenario: Scenario, model: RobotModel) -> None:
    """Refuse what loops, and stops of joints, cannot be combined with."""
    stopped = arm.has_stops(scenario, model)
    if scenario.reads_encoders and not np.any(model.measured):
        raise ScenarioError(f"encoder: {model.name} has joints that turn freely, which no encoder reads: leave it out")
    if scenario.robot.stop_restitution > 0.0 and not stopped:
        raise ScenarioError(
            "robot.stop_restitution: acts at the stops of joints; set robot.stops = true, or leave it out"
        )


def placed_surface(
    scenario: Scenario, robot: Robot, q: Array, v: Array, there: PlacedSurface, fixed_step: bool = True
) -> tuple[PlacedSurface, Touching, int]:
    """Return the surface, how the tip is to it at the start, and what it does on it.

    `there` is the same surface for a tip somewhere. With a `fixed_step` it must not be too stiff for that.
    """
    section = scenario.surface
    (tip, jacobian), depth = robot.known_tip(robot.pinocchios(q)), 0.0
    soft = not isinstance(scenario.compliance, Rigid)
    if soft and not section.gap:
        pressed = max(0.0, float(force_at(scenario.force_profile, scenario.law.force, np.zeros(1))[0]))
        with of_users(scenario.compliance, "compliance.kind"):
            depth = scenario.compliance.static_depth(pressed)
    surface = there.below(tip, depth)
    if scenario.tool.radius > 0.0 and not surface.fixed_plane and surface.below_start:
        refuse_narrow(surface, np.zeros(1), surface.origin[None], scenario.tool.radius)
    now = surface.touching(tip, jacobian @ v)
    if now.inside < 0.0 and (section.contact == "bilateral" or soft):
        raise ScenarioError(
            f"surface.{edge_key(section)}: the tip starts {-now.inside:.4g} m beyond the edge of the surface; "
            'make it larger, or start the tip on it, or use contact = "unilateral" without compliance'
        )
    exact = surface.below_start and isinstance(section, PlaneSurface) and not soft
    gap = section.gap if exact else now.gap
    rate = float(now.frame[0] @ jacobian @ v - now.carried[0])
    if soft:  # how deep the tip is, or how fast it comes, is for the surface to answer
        H = robot.known_terms(robot.pinocchios(q), v).mass_matrix
        mobility = largest_mobility(H, now.frame[:1] @ jacobian)
        if now.inside >= 0.0 and (thrown := scenario.compliance.thrown_out(-gap, mobility)):
            given, at_most, _ = _where_given(section, surface, tip)
            raise ScenarioError(f"{given}: the tip starts {-gap:.4g} m inside the surface{thrown}: {at_most}")
        if fixed_step:
            time_step.check_stiffness(scenario, mobility, now.gap)
        return surface, now, PRESSED if section.contact == "bilateral" or gap <= TOUCHING else FREE
    if section.contact == "bilateral":
        if abs(gap) > START_GAP:
            side = "off" if gap > 0 else "inside"
            given, _, place = _where_given(section, surface, tip)
            raise ScenarioError(
                f"{given}: the tip starts {abs(gap):.4g} m {side} the surface, and the closure holds it "
                f'there from the start: use contact = "unilateral", or {place}'
            )
        if abs(rate) > START_RATE:
            raise ScenarioError(_through_the_closure(now.frame[0] @ jacobian, v, rate))
        return surface, now, PRESSED
    if now.inside < 0.0:
        return surface, now, FREE
    if gap < -TOUCHING:
        given, at_most, _ = _where_given(section, surface, tip)
        raise ScenarioError(f"{given}: the tip starts {-gap:.4g} m inside the surface: {at_most} for this start")
    if gap > TOUCHING:
        return surface, now, FREE
    if rate > RESTING:
        raise ScenarioError(
            f"start.v: the tip starts on the surface and leaves it at {rate:.4g} m/s: start it off the surface "
            "(surface.gap), or without velocity along the normal"
        )
    return surface, now, FREE if rate < -RESTING else PRESSED


def believed_surface(scenario: Scenario, robot: Robot, surface: PlacedSurface, q: Array) -> PlacedSurface | None:
    """Return the surface that the controller believes in, None if it is the true one.

    What [belief] leaves out is as it is. A surface whose place is "start" lies where the true one does below the tip,
    unless it has a `gap` of its own.
    """
    belief = scenario.belief
    if not belief.differs:
        return None
    section = scenario.surface if belief.surface is None else belief.surface
    motion = scenario.surface_motion if belief.surface_motion is None else belief.surface_motion
    if isinstance(section, NoSurface) or not scenario.has_surface:
        raise ScenarioError("belief: there must be a surface, and one that the controller believes in; leave it out")
    if section is scenario.surface:
        place = replace(surface, motion=motion, where="belief.surface")
    else:
        place = PlacedSurface.of(
            section, motion, robot.position(q), radius=scenario.tool.radius, where="belief.surface"
        )
    if place.below_start and section is not scenario.surface and not section.gap:
        place = replace(place, origin=place.origin - surface.touching(robot.position(q)).gap * place.normal)
    check_rates(place, scenario.time.duration)
    return place


def _where_given(section: Surface, surface: PlacedSurface, tip: Array) -> tuple[str, str, str]:
    """Return key and value that place the surface, what the value may be for this start, and two ways to be on it."""
    own: Any
    if isinstance(section, PlaneSurface):
        key, own, best = "offset", section.offset, f"{float(surface.normal @ tip):.9g}"
    else:
        key, own = "point", getattr(section, "point", None)
        best = str([float(f"{x:.9g}") for x in tip])
    said = f"{own:.9g}" if isinstance(own, float) else f"{list(own or ())}"
    given = f"surface.gap = {section.gap:.9g}" if surface.below_start else f"surface.{key} = {said}"
    return given, f"surface.{key} may be at most {best}", f'{key} = "start" or {best}'


def _through_the_closure(A: Array, v: Array, rate: float) -> str:
    """Return what is wrong with joint velocities v (n,) that move a tip held by n·Jᵣ = A (n,) at `rate`, m/s."""
    along = v - A * (rate / float(A @ A))  # the nearest that obey A q̇ = 0
    return (
        f"start.v: the tip is held to the surface and starts through it at {rate:.4g} m/s, where {START_RATE:g} m/s is "
        f"the most; the nearest start.v along the surface is {[float(f'{x:.9g}') for x in along]}, or use "
        'contact = "unilateral"'
    )


def refuse_lengths(scenario: Scenario, model: RobotModel) -> None:
    """Refuse lists that have not one entry for each joint, all of them at once."""
    faults: list[str] = []
    for start in (arm.start_positions, arm.start_velocities):
        try:
            start(scenario, model)
        except ScenarioError as error:
            faults += error.faults
    _refuse(faults + _wrong_lengths(scenario, model))


def _wrong_lengths(scenario: Scenario, model: RobotModel) -> list[str]:
    """Return what is wrong with the lengths of lists of the law."""
    return [
        f"law.{name} has {len(values)} entries: {model.name} has {model.n} joints, {', '.join(model.joint_names)}"
        for name, values in lists_per_joint(scenario.law).items()
        if len(values) != model.n
    ]


def _refuse(faults: list[str]) -> None:
    if faults:
        raise ScenarioError(*faults)


def completed(scenario: Scenario, model: RobotModel) -> Scenario:
    """Return a scenario as its run has it: lists with an entry for each joint, contacts with the robot's own shapes."""
    return with_collision_shapes(arm.with_all_entries(scenario, model), model)


@arguments_checked()
def prepare(scenario: Scenario, model: RobotModel | None = None, cache: Cache | None = None) -> Problem:
    """Turn a scenario into the numbers of a `Problem`.

    Parameters
    ----------
    scenario : Scenario
    model : RobotModel, optional
        The robot to use instead of loading `scenario.robot.model`.
    cache : Cache, optional
        Robots, paths and tables of earlier scenarios of this thread, with this same `model`. The robot and the table
        of an earlier `Problem` may then be this one's, and its table be overwritten.

    Raises
    ------
    ScenarioError, ModelError
        If something in it cannot be simulated: a wrong length, an unreachable path, a step that makes the
        stabiliser unstable, a tip that the robot does not have ...
    """
    if cache is not None:
        return problem_of(scenario, model, cache)
    own = Cache()
    problem = problem_of(scenario, model, own, kept=False)
    problem.of_thread[get_ident()] = own
    return problem


@contextmanager
def borrowed(problem: Problem) -> Iterator[Cache]:
    """Give what this thread has made of the scenarios of a problem, with other values and from other starts.

    A run within a law of this one's has another meanwhile.
    """
    cache = problem.of_thread.pop(get_ident(), None)
    if cache is None:
        cache = Cache()
        cache.get(("model", model_key(problem.scenario)), lambda: problem.bare, lambda model: ROBOT_BYTES)
    try:
        yield cache
    finally:
        problem.of_thread[get_ident()] = cache


def problem_of(scenario: Scenario, model: RobotModel | None, cache: Cache, kept: bool = True) -> Problem:
    """Do as `prepare`, with arguments of the right types; path and table are not `kept` for others, if so told.

    Every part of it is followed, see `closedloop.simulation.parts`: made anew where what it depends on is other.
    """
    if cache.last is not None and cache.last[0] is scenario:
        return cache.last[1]
    cache.last = None
    if cache.parts is None:
        cache.parts = Parts(OF_GIVEN, ("cache", "model_given")), Parts(OF_WHOLE, ("cache", "kept", "robot", "arm"))
    first, whole = cache.parts
    given = first.turn_to(scenario, cache=cache, model_given=model)
    completed = scenario if given["completed"] is None else given["completed"]
    made = whole.turn_to(completed, cache=cache, kept=kept, robot=given["robot"], arm=given["arm"])
    if not kept:
        whole.forget("table")  # which is the problem's own
    numbers = dict(zip(NUMBERS, _numbers_of(made), strict=True))
    (numbers["integrator"], numbers["tolerance"]), (numbers["steps"], numbers["hold"]) = made["scheme"], made["count"]
    (numbers["q"], numbers["v"]), (numbers["surface"], now, _, numbers["believed"]) = made["start"], made["place"]
    numbers |= {
        "bare_table": made["table"], "frame": now.frame, "nodes": numbers["integrator"].parts, "scenario": completed,
        "bare": given["bare"], "member_digests": given["member_digests"], "model_given": model, "spare": cache.spare,
    }  # fmt: skip
    problem = Problem.of(numbers)
    cache.last = (scenario, problem) if kept else None
    return problem


def _model_of(of: Made) -> RobotModel:
    """Return the robot's model for what does not depend on the masses of its tools."""
    _ = of.arm
    model: RobotModel = of.unnoted("robot").model
    return model


def _completed(s: Any, of: Made) -> Scenario | None:
    """Return the scenario as its run has it, None if that is as it is given."""
    found = completed(s, _model_of(of))
    return None if isinstance(found, Watched) else found


# What is made of a scenario as it is given.
OF_GIVEN: dict[str, Maker] = {
    "gainless": lambda s, of: without(s.law, *OFTEN_OTHER),
    "member_digests": law_as("gainless", lambda s, of: member_digests(s)),
    "bare": lambda s, of: of.model_given or of.cache.get(
        ("model", model_key(s)), lambda: load_model(s), lambda model: ROBOT_BYTES
    ),
    "robot": lambda s, of: of.cache.get(
        ("robot", robot_key(s, of.cache)), lambda: arm.robot_of(s, of.bare), lambda robot: ROBOT_BYTES
    ),
    "arm": lambda s, of: of.robot.model.without_tools,
    "completed": _completed,
}  # fmt: skip


def _compiling(s: Any, of: Made) -> None:
    """Have compiled what a run will want; which numbers it has does not matter."""
    _ = of.members_called, of.loop_settings, of.record
    have_compiled(s.unwatched, _model_of(of))


def _instants(s: Any, of: Made) -> Array:
    """Return the instants of the rows of the table of what is desired, s."""
    nodes, (steps, _) = of.scheme[0].parts, of.count
    return (s.time.step / nodes) * np.arange(steps * nodes + 1, dtype=np.float64)


def _drawn(s: Any, of: Made) -> tuple[bool, bool]:
    """Return whether sensors of force, and those of joints, draw numbers."""
    return s.sensor.noise > 0.0 or s.sensor.jitter > 0.0, s.reads_encoders


def _closed(s: Any, of: Made) -> tuple[Array, Array]:
    """Return q and q̇ at the start, with the loops of the mechanism closed."""
    q, v = of.asked
    return closed_start(of.robot, q, v, s.start.assemble or s.start.q is None) if _model_of(of).loops else (q, v)


def _path(s: Any, of: Made) -> tuple[Motion, tuple[Hashable, ...] | None]:
    """Return the desired motion on the surface that the controller believes in, and its key, if it is kept."""
    true, _, _, believed = of.place
    surface, robot, q = true if believed is None else believed, of.robot, of.start[0]
    tool = unit(s.tool.axis, "tool.axis"), s.tool.radius
    duration = 0.0 if surface.fixed_plane else s.time.duration * BEYOND

    def found() -> Motion:
        return desired(s.reference, robot, surface, q, duration, *tool)

    with of_users(s.reference, "reference.kind"):
        if not of.kept:
            return found(), None
        own: Hashable = surface.normal.tobytes()
        if not surface.fixed_plane:
            own = (
                surface.section.model_dump_json(),
                surface.motion.model_dump_json(),
                surface.origin.tobytes(),
                duration,
            )
        key = of.cache.texts(s, of=("robot", "tool", "reference")), q.tobytes(), own
        return of.cache.get_shared(("desired", *key), found, lambda made: 3 * made.joints.q.nbytes), key


def _table(s: Any, of: Made) -> Array:
    """Return the table of what is desired, with what sensors draw behind each row; the force is not written yet."""
    (motion, key), instants, (noisy, reads), n = of.path, of.instants, of.drawn, of.robot.n
    spare = (DrawnRow if reads else TableRow).count(n) - Reference.count(n)
    with of_users(s.reference, "reference.kind"):  # its curves are evaluated in there
        if key is None:
            return motion.table(instants, spare=spare)
        table: Array = of.cache.get(
            ("table", *key, instants.size, float(instants[1]), spare, noisy),
            lambda: motion.table(instants, spare=spare), lambda table: table.nbytes,
        )  # fmt: skip
        return table


def _draws(s: Any, of: Made) -> None:
    """Write what sensors draw into the table; where they draw nothing it has the zeros that it was made with."""
    (noisy, reads), table, n, steps, nodes = of.drawn, of.table, of.robot.n, of.count[0], of.scheme[0].parts
    if noisy:
        table[::nodes, TableRow.place("sensor", n)] = draws(s.sensor, steps + 1)
    if reads:
        table[::nodes, DrawnRow.place("draws", n)] = encoder_draws(s.encoder, steps + 1, n)


def _mode(s: Any, of: Made) -> int:
    """Return the contact mode at the start: a tip that rests on a surface with dry friction sticks."""
    (_, now, mode, _), (q, v), robot = of.place, of.start, of.robot
    if mode != PRESSED or of.friction.member.sticks == "elastic":
        return int(mode)
    u = now.frame @ robot.known_tip(robot.pinocchios(q))[1] @ v - now.carried
    return STUCK if np.hypot(u[1], u[2]) <= STICK_SPEED else PRESSED


# What is made of a scenario as its run has it. First what is wrong with where it starts is said.
OF_WHOLE: dict[str, Maker] = {
    "forceless": lambda s, of: without(s.law, "force"),
    "gainless": lambda s, of: without(of.forceless, *OFTEN_OTHER),
    "asked": lambda s, of: start_state(s, _model_of(of)),
    "lengths": law_as("forceless", lambda s, of: _refuse(_wrong_lengths(s, _model_of(of)))),
    "combinations": lambda s, of: refuse_combinations(s, _model_of(of)),
    "joint_law": lambda s, of: arm.joint_friction_of(s, _model_of(of)),
    "scheme": lambda s, of: time_step.integrator_of(s, of.joint_law),
    "load_friction": lambda s, of: _refuse_load_friction(s, of.joint_law),
    "states": law_as("gainless", lambda s, of: StatesOf.of(s, _model_of(of).n)),
    "plain": lambda s, of: not scenario_numbers.calls_any_law(s, _model_of(of)),
    "papers_law": lambda s, of: not scenario_numbers.is_no_papers_law(of.forceless),
    "general": lambda s, of: not of.plain or not of.papers_law,
    "members_called": lambda s, of: tuple(
        scenario_numbers.entries_of(s, _model_of(of), of.general, of.joint_law).items()
    ),
    "loop_settings": lambda s, of: tuple(scenario_numbers.settings_of(s, _model_of(of)).items()),
    "record": lambda s, of: scenario_numbers.record_of(s, of.states),
    "period": lambda s, of: of.forceless.sample_period,
    "count": lambda s, of: time_step.steps_and_hold(s, of.period, of.record.width),
    "believed_law": lambda s, of: _believed_compensation(s),
    "sampling": law_as("forceless", lambda s, of: _check_compensation(s, of.believed_law)),
    "compiling": _compiling,
    "h": lambda s, of: s.time.step,
    "friction": lambda s, of: scenario_numbers.pack_friction(s.friction, _model_of(of).n),
    "compensation": lambda s, of: scenario_numbers.pack_law(
        of.believed_law, _model_of(of).n, _model_of(of).joint_names
    ),
    "joint_friction": lambda s, of: scenario_numbers.pack_friction(of.joint_law, _model_of(of).n, joints=True),
    "compliance": lambda s, of: scenario_numbers.PackedLaw(
        type(s.compliance), pack(s.compliance, _model_of(of).n, "compliance"), 0
    ),
    "sensor": lambda s, of: pack_sensor(s.sensor, s.time.step),
    "encoder": lambda s, of: _encoder(s, _model_of(of)),
    "transmission": lambda s, of: transmission_constants(s.transmission, _model_of(of)),
    "drives": lambda s, of: np.stack(
        [torque_limits(s.drives, _model_of(of)), torque_steps(s.drives, _model_of(of), of.period)]
    ),
    "stabiliser": lambda s, of: np.array(time_step.stabiliser_gains(s)),
    "project": lambda s, of: s.stabiliser.kind in ("projection", "both") and isinstance(s.compliance, Rigid),
    "tendons": lambda s, of: arm.acting_tendons(s, _model_of(of)),
    "stops": lambda s, of: arm.stop_limits(s, _model_of(of)),
    "ends": lambda s, of: tuple(of.robot.tree.ends.tolist()),
    "has_loops": lambda s, of: bool(_model_of(of).loops),
    "start": _closed,
    "there": lambda s, of: PlacedSurface.of(s.surface, s.surface_motion, ORIGIN, 0.0, s.tool.radius),
    "place": lambda s, of: _placed(s, of.robot, of.start, of.there, of.scheme[1]),
    "contact_rows": lambda s, of: contact_rows(s, of.robot) if s.contact or arm.has_stops(s, _model_of(of)) else None,
    "placed": lambda s, of: None if of.contact_rows is None else placed_contacts(
        s, of.robot, of.contact_rows, of.start[0]
    ),
    "drawn": _drawn,
    "instants": _instants,
    "forces": lambda s, of: force_at(s.force_profile, s.law.force, of.instants),  # refused before a path is found
    "path": _path,
    "table": _table,
    "draws": _draws,
    "wanted": lambda s, of: Desired(of.path[0].tip, of.path[0].joints, s.force_profile, s.law.force),
    "pd_start": law_as("gainless", lambda s, of: _pd_start(s, of.path[0].tip)),
    "law": lambda s, of: scenario_numbers.pack_law(
        s.law.with_valid({"pd_start": of.pd_start}) if isinstance(s.law, PaperLaw) else s.law, _model_of(of).n,
        _model_of(of).joint_names,
    ),
    "mode": _mode,
    "shape": lambda s, of: scenario_numbers.Shape.of(
        of.law, of.compensation, of.friction, of.joint_friction, of.compliance, of.sensor, of.tendons
    ),
}  # fmt: skip

# Those of these that are numbers of the problem as they are.
NUMBERS = (
    "robot", "h", "general", "papers_law", "members_called", "loop_settings", "record", "friction", "compensation",
    "joint_friction", "compliance", "sensor", "encoder", "transmission", "drives", "stabiliser", "project",
    "tendons", "stops", "ends", "has_loops", "there", "placed", "forces", "wanted", "pd_start", "law", "mode",
    "shape",
)  # fmt: skip
_numbers_of = itemgetter(*NUMBERS)


def _placed(
    scenario: Scenario, robot: Robot, start: tuple[Array, Array], there: PlacedSurface, tolerance: float | None
) -> tuple[PlacedSurface, Touching, int, PlacedSurface | None]:
    """Return what `placed_surface` does, and the surface that the controller believes in; refuse one too stiff."""
    q, v = start
    surface, now, mode = placed_surface(scenario, robot, q, v, there, tolerance is None)
    check_rates(surface, scenario.time.duration)
    believed = believed_surface(scenario, robot, surface, q)
    if scenario.transmission.elastic:
        check_transmission(scenario, robot, q)
    return surface, now, mode, believed


def _pd_start(scenario: Scenario, tip: TipPath) -> float:
    """Return the instant, s, from which the PD part of the law acts: of the path, if the law says none."""
    given = getattr(scenario.law, "pd_start", None)
    h = scenario.time.step
    start: float = (tip.start if given is None else given) - 1e-9 * h  # i·h and 0.5 may differ by rounding
    return start


def _encoder(scenario: Scenario, model: RobotModel) -> Array:
    numbers = pack(scenario.encoder, model.n, "encoder", model.joint_names)
    check_steps(scenario.encoder, model.position_lower, model.position_upper, model.joint_names)
    return numbers


def robot_key(scenario: Scenario, cache: Cache) -> Hashable:
    """Return what the robot depends on."""
    of_robot = cache.texts(scenario, of=("robot", "body", "mocap", "tool"))
    return of_robot, scenario.model_error.payload, scenario.transmission.elastic


def model_key(scenario: Scenario) -> Hashable:
    """Return what the model depends on that `load_model` returns."""
    robot, beside = scenario.robot, (*(scenario.body or ()), *(scenario.mocap or ()))
    return robot.model, robot.drive_inertia, repr(robot.lock), *(each.model_dump_json() for each in beside)


def _refuse_load_friction(scenario: Scenario, joint_friction: JointFriction) -> None:
    """Refuse gears that rub with their load, where a law of friction in the joints is no dry one."""
    if np.any(scenario.transmission.load_friction) and joint_friction.sticks != "rigid":
        raise ScenarioError(
            "transmission.load_friction: adds to a dry friction of the joints: give joint_friction.kind = 'coulomb', "
            "'coulomb_viscous', 'stribeck' or 'karnopp', with joint_friction.kinetic = 0 where there is no other"
        )


def _check_compensation(scenario: Scenario, compensation: Compensation) -> None:
    """Refuse a compensation that does not go with the law or the sensor, and a law that is sampled too slowly."""
    law = scenario.law
    compensation.check(law)
    if compensation.reads_tangential and scenario.sensor.axes == 1:
        raise ScenarioError(
            f"compensation.kind = {compensation.kind!r}: needs the force along the tangents too: set sensor.axes = 3"
        )
    time_step.check_sampling(law, compensation, scenario.sensor, law.sample_period or scenario.time.step)


def load_model(scenario: Scenario) -> RobotModel:
    """Return the robot that a scenario names, with each [[body]] beside it."""
    section = scenario.robot
    if section.model == NO_ROBOT:
        return only_bodies(arm.free_bodies(scenario))
    options: dict[str, Any] = {} if section.lock is None else {"lock": section.lock}
    options["mocap"] = {each.frame for each in scenario.mocap or ()}
    model = robot_models.load(section.model, drive_inertia=section.drive_inertia, **options)
    return arm.beside_bodies(scenario, model)


def _believed_compensation(scenario: Scenario) -> Compensation:
    """Return the compensation with its values of friction wrong by `model_error.friction`."""
    section, factor = scenario.compensation, scenario.model_error.friction
    if factor == 1.0:
        return section
    values = {name: getattr(section, name) for name in section.friction_values}
    wrong = {
        name: tuple(factor * x for x in value) if isinstance(value, tuple) else factor * value
        for name, value in values.items()
        if value is not None
    }
    if not any(np.any(values[name]) for name in wrong):
        raise ScenarioError(
            f"model_error.friction = {factor:g}: the compensation {section.kind!r} has no friction values "
            "that could be wrong; use compensation.kind = 'model', or leave model_error.friction out"
        )
    return section.model_copy(update=wrong)
