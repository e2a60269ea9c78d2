"""From a scenario to a `Problem`, or to the one line that says what is wrong with it.

Where the tip is to the surface at the start: on it, off it, or refused.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager
from dataclasses import replace
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
from closedloop.control.reference.desired import Desired, Motion, desired
from closedloop.control.reference.force import force_at
from closedloop.control.reference.on_surface import edge_key
from closedloop.control.reference.orientation import refuse_narrow
from closedloop.control.reference.table import DrawnRow, Reference, TableRow
from closedloop.control.sensor import check_steps, draws, encoder_draws, pack_sensor
from closedloop.control.stability import check_sampling
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
from closedloop.scenario.arm import (
    acting_tendons,
    beside_bodies,
    free_bodies,
    has_stops,
    joint_friction_of,
    robot_of,
    start_positions,
    start_posture,
    start_velocities,
    stop_limits,
)
from closedloop.scenario.collision import with_collision_shapes
from closedloop.scenario.modes import check_transmission
from closedloop.scenario.robot_sections import NO_ROBOT
from closedloop.scenario.scenario import Scenario
from closedloop.scenario.user_module import member_digests, members_of_users
from closedloop.simulation.all_entries import with_all_entries
from closedloop.simulation.cache import Cache
from closedloop.simulation.engines.bind_contacts import contact_rows, placed_contacts
from closedloop.simulation.engines.problem import Problem
from closedloop.simulation.engines.scenario_numbers import (
    Layout,
    PackedLaw,
    Shape,
    pack_compliance,
    pack_friction,
    pack_law,
)
from closedloop.simulation.engines.start_memory import STICK_SPEED
from closedloop.simulation.loop_calls import have_compiled
from closedloop.simulation.parts import Watched
from closedloop.simulation.time_step import check_stiffness, integrator_of, stabiliser_gains, steps_and_hold
from robot_models import RobotModel
from robot_models.bodies import only_bodies
from robot_models.model import AT_LIMIT

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
        q, v = start_posture(scenario, model), start_velocities(scenario, model)
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
    stopped = has_stops(scenario, model)
    if scenario.reads_encoders and not np.any(model.measured):
        raise ScenarioError(f"encoder: {model.name} has joints that turn freely, which no encoder reads: leave it out")
    if scenario.robot.stop_restitution > 0.0 and not stopped:
        raise ScenarioError(
            "robot.stop_restitution: acts at the stops of joints; set robot.stops = true, or leave it out"
        )


def placed_surface(
    scenario: Scenario, robot: Robot, q: Array, v: Array, there: PlacedSurface
) -> tuple[PlacedSurface, Touching, int]:
    """Return the surface, how the tip is to it at the start, and what it does on it.

    `there` is the same surface for a tip somewhere.
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
    for start in (start_positions, start_velocities):
        try:
            start(scenario, model)
        except ScenarioError as error:
            faults += error.faults
    _refuse(faults + _wrong_lengths(scenario, model))


def _wrong_lengths(scenario: Scenario, model: RobotModel) -> list[str]:
    """Return what is wrong with the lengths of lists of the law."""
    joints = ", ".join(model.joint_names)
    return [
        f"law.{name} has {len(values)} entries: {model.name} has {model.n} joints, {joints}"
        for name, values in lists_per_joint(scenario.law).items()
        if len(values) != model.n
    ]


def _refuse(faults: list[str]) -> None:
    if faults:
        raise ScenarioError(*faults)


# Memory of a robot, with Pinocchio's model and data, about, bytes; of a section as numbers.
ROBOT_BYTES, SECTION_BYTES = 200_000, 2_000


def completed(scenario: Scenario, model: RobotModel) -> Scenario:
    """Return a scenario as its run has it: lists with an entry for each joint, contacts with the robot's own shapes."""
    return with_collision_shapes(with_all_entries(scenario, model), model)


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

    Every part of it is followed, see `closedloop.simulation.cache.Parts`: made anew where what it depends on is other.
    """
    if cache.last is not None and cache.last[0] is scenario:
        return cache.last[1]
    cache.last, first = None, cache.given
    first.turn_to(scenario)
    digests = first.follow("digests", member_digests) if members_of_users(scenario) else {}
    bare: RobotModel = first.follow("model", lambda s: _model(s, cache)) if model is None else model
    robot: Robot = first.follow("robot", lambda s: _robot(s, bare, cache), bare)
    arm: Any = first.follow("arm", lambda s: robot.model.without_tools, robot)
    done = first.follow("completed", lambda s: _completed(s, robot.model), arm)
    given, scenario = scenario, scenario if done is None else done
    cache.whole.turn_to(scenario)
    follow = cache.whole.follow
    follow("start", lambda s: start_state(s, robot.model), arm)  # what is wrong with it is said first
    numbers = follow("settled", lambda s: _settled(scenario, robot, arm, cache), robot, arm)
    problem = Problem.of({
        **numbers, **_started(scenario, numbers, arm, cache, kept), "scenario": scenario, "member_digests": digests,
        "bare": bare, "model_given": model, "spare": cache.spare,
    })  # fmt: skip
    cache.last = (given, problem) if kept else None
    return problem


def _completed(scenario: Any, model: RobotModel) -> Scenario | None:
    """Return the scenario as its run has it, None if that is as it is given."""
    found = completed(scenario, model)
    return None if isinstance(found, Watched) else found


def _settled(scenario: Scenario, robot: Robot, arm: Any, cache: Cache) -> dict[str, Any]:
    """Check what does not depend on where a run starts, and return it as numbers."""
    follow, model, n = cache.whole.follow, robot.model, robot.n  # none of these depends on masses of tools
    follow("lengths", lambda s: _refuse(_wrong_lengths(s, model)), arm)
    follow("combinations", lambda s: refuse_combinations(s, model), arm)
    joint_friction = follow("friction of joints", lambda s: joint_friction_of(s, model), arm)
    integrator, tolerance = follow("integrator", lambda s: integrator_of(s, joint_friction), joint_friction)
    follow("load friction", lambda s: _refuse_load_friction(s, joint_friction), joint_friction)
    layout, period = (
        follow("layout", lambda s: Layout.of(s, model), arm),
        follow("period", lambda s: s.law.sample_period),
    )
    steps, hold = follow("steps", lambda s: steps_and_hold(s, period, layout.row_width), period, layout)
    compensation = follow("believed compensation", _believed_compensation)
    follow("sampling", lambda s: _check_compensation(s, compensation), compensation)
    follow("compiled", lambda s: have_compiled(scenario, model), arm, layout)
    return {
        "robot": robot, "integrator": integrator, "tolerance": tolerance,
        "h": follow("step", lambda s: s.time.step), "steps": steps, "hold": hold, "nodes": integrator.parts,
        "layout": layout,
        "friction": follow("friction", lambda s: pack_friction(s.friction, n), arm),
        "compensation": follow(
            "compensation", lambda s: pack_law(compensation, n, model.joint_names), arm, compensation
        ),
        "joint_friction": follow(
            "joint_friction", lambda s: pack_friction(joint_friction, n, joints=True), arm, joint_friction
        ),
        "compliance": follow("compliance", lambda s: pack_compliance(s.compliance, n), arm),
        "sensor": follow("sensor", lambda s: pack_sensor(s.sensor, s.time.step)),
        "encoder": follow("encoder", lambda s: _encoder(s, model), arm),
        "transmission": follow("transmission", lambda s: transmission_constants(s.transmission, model), arm),
        "drives": follow("drives", lambda s: np.stack(
            [torque_limits(s.drives, model), torque_steps(s.drives, model, period)]
        ), arm, period),
        "stabiliser": follow("stabiliser", lambda s: np.array(stabiliser_gains(s))),
        "project": follow("project", lambda s: s.stabiliser.kind in ("projection", "both") and _is_rigid(s)),
        "tendons": follow("tendons", lambda s: acting_tendons(s, model), arm),
        "stops": follow("stops", lambda s: stop_limits(s, model), arm),
        "ends": follow("ends", lambda s: tuple(robot.tree.ends.tolist()), robot), "has_loops": bool(model.loops),
    }  # fmt: skip


def _started(scenario: Scenario, of: dict[str, Any], arm: Any, cache: Cache, kept: bool) -> dict[str, Any]:
    """Return what depends on where a run starts: the other numbers of the `Problem`."""
    follow, robot, friction = cache.whole.follow, of["robot"], of["friction"]
    model = robot.model
    q, v = follow("start", lambda s: start_state(s, model), arm)
    if model.loops:
        q, v = follow(
            "closed start", lambda s: closed_start(robot, q, v, s.start.assemble or s.start.q is None), robot, q, v
        )
    there = follow("surface", lambda s: PlacedSurface.of(s.surface, s.surface_motion, ORIGIN, 0.0, s.tool.radius))
    following = follow if kept else _made_of(scenario)
    place = following("place", lambda s: _placed(s, robot, q, v, there, of["tolerance"]), robot, q, v, there, arm)
    surface, now, mode, believed = place
    on = follow("contact rows", lambda s: contact_rows(s, robot) if s.contact or has_stops(s, model) else None, robot)
    placed = None if on is None else follow("contacts", lambda s: placed_contacts(s, robot, on, q), robot, on, q)
    taken = surface if believed is None else believed
    with of_users(scenario.reference, "reference.kind"):  # its curves are evaluated in there
        wanted, table = _reference(of, taken, q, cache, kept, following)
    start = follow("pd_start", lambda s: _pd_start(s, wanted), wanted.tip)
    law = follow("law", lambda s: _packed_law(s, start, model), start, arm)
    if mode == PRESSED and friction.member.sticks != "elastic":
        u = now.frame @ robot.known_tip(robot.pinocchios(q))[1] @ v - now.carried
        mode = STUCK if np.hypot(u[1], u[2]) <= STICK_SPEED else PRESSED
    called = [of[name] for name in ("compensation", "friction", "joint_friction", "compliance", "sensor", "tendons")]
    return {
        "shape": follow("shape", lambda s: Shape.of(law, *called), law, *called),
        "surface": surface, "believed": believed, "frame": now.frame, "q": q, "v": v,
        "mode": mode, "table": table, "wanted": wanted, "pd_start": start, "placed": placed, "law": law,
        "there": there,
    }  # fmt: skip


def _placed(
    scenario: Scenario, robot: Robot, q: Array, v: Array, there: PlacedSurface, tolerance: float | None
) -> tuple[PlacedSurface, Touching, int, PlacedSurface | None]:
    """Return what `placed_surface` does, and the surface that the controller believes in; refuse one too stiff."""
    surface, now, mode = placed_surface(scenario, robot, q, v, there)
    check_rates(surface, scenario.time.duration)
    believed = believed_surface(scenario, robot, surface, q)
    if not isinstance(scenario.compliance, Rigid) and tolerance is None:
        check_stiffness(scenario, robot, q, now)
    if scenario.transmission.elastic:
        check_transmission(scenario, robot, q)
    return surface, now, mode, believed


def _pd_start(scenario: Scenario, wanted: Desired) -> float:
    """Return the instant, s, from which the PD part of the law acts: of the path, if the law says none."""
    given = getattr(scenario.law, "pd_start", None)
    h = scenario.time.step
    start: float = (wanted.tip.start if given is None else given) - 1e-9 * h  # i·h and 0.5 may differ by rounding
    return start


def _packed_law(scenario: Scenario, start: float, model: RobotModel) -> PackedLaw:
    """Return the control law as numbers, its PD part acting from an instant on, s."""
    law = scenario.law
    law = law.model_copy(update={"pd_start": start}) if isinstance(law, PaperLaw) else law
    return pack_law(law, model.n, model.joint_names)


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


def _is_rigid(scenario: Scenario) -> bool:
    return isinstance(scenario.compliance, Rigid)


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
    check_sampling(law, compensation, scenario.sensor, law.sample_period or scenario.time.step)


def _robot(scenario: Scenario, model: RobotModel, cache: Cache) -> Robot:
    key = "robot", robot_key(scenario, cache)
    return cache.get(key, lambda: robot_of(scenario, model), lambda robot: ROBOT_BYTES)


def _model(scenario: Scenario, cache: Cache) -> RobotModel:
    return cache.get(("model", model_key(scenario)), lambda: load_model(scenario), lambda model: ROBOT_BYTES)


def load_model(scenario: Scenario) -> RobotModel:
    """Return the robot that a scenario names, with each [[body]] beside it."""
    section = scenario.robot
    if section.model == NO_ROBOT:
        return only_bodies(free_bodies(scenario))
    options: dict[str, Any] = {} if section.lock is None else {"lock": section.lock}
    options["mocap"] = {each.frame for each in scenario.mocap or ()}
    model = robot_models.load(section.model, drive_inertia=section.drive_inertia, **options)
    return beside_bodies(scenario, model)


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


# A path on a surface that moves goes on this much longer than the run, so that its last row is no end of it.
BEYOND = 1.001


def _made_of(scenario: Scenario) -> Callable[..., Any]:
    """Return what makes parts as `Parts.follow` does, but for keeping them: of a start that none follows."""
    return lambda name, make, *others: make(scenario)


def _reference(
    of: dict[str, Any], surface: PlacedSurface, q: Array, cache: Cache, kept: bool, following: Callable[..., Any]
) -> tuple[Desired, Array]:
    """Return what is desired on a surface, and the table of it, with what sensors draw behind each row."""
    follow, robot, steps, nodes = cache.whole.follow, of["robot"], of["steps"], of["nodes"]
    n = robot.n

    def beside(s: Any) -> tuple[bool, bool, Array]:
        force_at(s.force_profile, s.law.force, np.zeros(1))  # a profile at fault is refused before its path is found
        instants = follow(
            "instants", lambda t: (t.time.step / nodes) * np.arange(steps * nodes + 1, dtype=np.float64), nodes, steps
        )
        return s.sensor.noise > 0.0 or s.sensor.jitter > 0.0, s.reads_encoders, instants

    drawn, reads, instants = follow("beside the path", beside, nodes, steps)

    def path(s: Any) -> tuple[Motion, tuple[Hashable, ...] | None]:
        tool = unit(s.tool.axis, "tool.axis"), s.tool.radius
        duration = 0.0 if surface.fixed_plane else s.time.duration * BEYOND

        def found() -> Motion:
            return desired(s.reference, robot, surface, q, duration, *tool)

        if not kept:
            return found(), None
        key = cache.texts(s, of=("robot", "tool", "reference")), q.tobytes(), _path_key(s, surface)
        return cache.get_shared(("desired", *key), found, lambda made: 3 * made.joints.q.nbytes), key

    motion, key = following("path", path, robot, surface, q)

    def made(s: Any) -> Array:
        spare = (DrawnRow if reads else TableRow).count(n) - Reference.count(n)
        if key is None:
            return motion.table(instants, spare=spare)
        step = float(instants[1])
        return cache.get(
            ("table", *key, instants.size, step, spare, drawn), lambda: motion.table(instants, spare=spare),
            lambda table: table.nbytes,
        )  # fmt: skip

    def force(s: Any) -> Desired:
        table[:, Reference.place("force", n)] = force_at(s.force_profile, s.law.force, instants)
        return Desired(motion.tip, motion.joints, s.force_profile, s.law.force)

    def draw(s: Any) -> None:
        if drawn:  # else its columns have the zeros that they were made with
            table[::nodes, TableRow.place("sensor", n)] = draws(s.sensor, steps + 1)
        if reads:
            table[::nodes, DrawnRow.place("draws", n)] = encoder_draws(s.encoder, steps + 1, n)

    table = following("table", made, motion, instants, drawn, reads)
    following("draws", draw, table)
    wanted: Desired = following("force", force, motion, table)
    return wanted, table


def _path_key(scenario: Scenario, surface: PlacedSurface) -> Hashable:
    """Return what of the surface the path depends on."""
    if surface.fixed_plane:
        return surface.normal.tobytes()
    sections = surface.section.model_dump_json(), surface.motion.model_dump_json()
    return (*sections, surface.origin.tobytes(), scenario.time.duration)
