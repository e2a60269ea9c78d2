"""From a scenario to a `Problem`, or to the one line that says what is wrong with it.

Where the tip is to the surface at the start: on it, off it, or refused.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import replace
from threading import get_ident
from typing import Any, NamedTuple

import numpy as np

import robot_models
from closedloop.base.arguments import arguments_checked
from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError
from closedloop.base.sections import Section
from closedloop.control.drives import torque_limits, torque_steps
from closedloop.control.encoder import check_steps, encoder_draws
from closedloop.control.law import Compensation
from closedloop.control.laws.paper import PaperLaw
from closedloop.control.reference.desired import Desired, desired
from closedloop.control.reference.force import force_at
from closedloop.control.reference.on_surface import edge_key
from closedloop.control.reference.orientation import refuse_narrow
from closedloop.control.reference.table import DrawnRow, Reference, TableRow
from closedloop.control.sensor import draws, pack_sensor
from closedloop.control.stability import check_sampling
from closedloop.control.transmission import transmission_constants
from closedloop.jit.parameters import lists_per_joint, pack
from closedloop.jit.user_code import of_users
from closedloop.mechanics.closure.contact_force import FREE, PRESSED, STUCK
from closedloop.mechanics.friction.law import JointFriction
from closedloop.mechanics.limits import RESTING, TOUCHING
from closedloop.mechanics.loops.assemble import closed_start
from closedloop.mechanics.robot.pinocchio import Robot
from closedloop.mechanics.surface.compliances.none import Rigid
from closedloop.mechanics.surface.kinds.none import NoSurface
from closedloop.mechanics.surface.kinds.plane import PlaneSurface
from closedloop.mechanics.surface.placed import PlacedSurface, Touching, unit
from closedloop.mechanics.surface.rates import check_rates
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
    without_tools,
)
from closedloop.scenario.collision import with_collision_shapes
from closedloop.scenario.gains import check_transmission
from closedloop.scenario.robot_sections import NO_ROBOT
from closedloop.scenario.scenario import Scenario
from closedloop.scenario.user_module import member_digests, members_of_users
from closedloop.simulation.all_entries import with_all_entries
from closedloop.simulation.cache import Cache, Key, NoCache, Watched
from closedloop.simulation.engines.bind_contacts import placed_contacts
from closedloop.simulation.engines.problem import Problem
from closedloop.simulation.engines.scenario_numbers import PackedLaw, pack_compliance, pack_friction, pack_law
from closedloop.simulation.engines.start_memory import STICK_SPEED
from closedloop.simulation.loop_calls import MEMORY, have_compiled
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
    scenario: Scenario, robot: Robot, q: Array, v: Array, like: PlacedSurface | None
) -> tuple[PlacedSurface, Touching, int]:
    """Return the surface, how the tip is to it at the start, and what it does on it.

    `like` is the surface of the same scenario from another start, if that is known.
    """
    section = scenario.surface
    (tip, jacobian), depth = robot.known_tip(robot.pinocchios(q)), 0.0
    soft = not isinstance(scenario.compliance, Rigid)
    if soft and not section.gap:
        pressed = max(0.0, float(force_at(scenario.force_profile, scenario.law.force, np.zeros(1))[0]))
        with of_users(scenario.compliance, "compliance.kind"):
            depth = scenario.compliance.static_depth(pressed)
    surface = (
        PlacedSurface.of(section, scenario.surface_motion, tip, depth, scenario.tool.radius)
        if like is None
        else like.below(tip, depth)
    )
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
    for name, values in lists_per_joint(scenario.law).items():
        if len(values) != model.n:
            joints = ", ".join(model.joint_names)
            faults.append(f"law.{name} has {len(values)} entries: {model.name} has {model.n} joints, {joints}")
    if faults:
        raise ScenarioError(*faults)


# Memory of a robot, with Pinocchio's model and data, about, bytes.
ROBOT_BYTES = 200_000
# Memory of a section as numbers, about, bytes, and of all that is kept for the same problem from another start.
SECTION_BYTES, SETTLED_BYTES = 2_000, 500_000
# What follows from the numbers of a problem, wherever it starts.
SETTLED = (
    "general", "row_width", "row_states", "record", "sizes",
)  # fmt: skip


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
    problem = problem_of(scenario, model, Cache() if cache is None else cache)
    if cache is None:
        problem.of_thread[get_ident()] = problem.settled
    return problem


def problem_of(scenario: Scenario, model: RobotModel | None, cache: Cache, kept: bool = True) -> Problem:
    """Do as `prepare`, with arguments of the right types; what depends on the start is not `kept`, if so told."""
    if cache.last is not None and cache.last[0] is scenario:
        return cache.last[1]
    given, cache.last = scenario, None
    settled = cache.get(
        ("settled", *cache.texts(scenario, but="start")), lambda: _settled(scenario, model, cache),
        lambda found: SETTLED_BYTES,
    )  # fmt: skip
    problem = _problem(scenario, settled, cache if kept else NoCache())
    cache.last = (given, problem) if kept else None
    return problem


def borrowed(problem: Problem) -> Settled:
    """Return what is the same of a problem from another start, of this thread: its caller puts it back.

    A run within a law of this one's has another meanwhile.
    """
    settled: Settled | None = problem.of_thread.pop(get_ident(), None)
    if settled is None:
        settled = problem_of(problem.scenario, without_tools(problem.robot.model), Cache()).settled
    return settled


def started_elsewhere(settled: Settled, scenario: Scenario) -> Problem:
    """Prepare a scenario that differs in where it starts."""
    return _problem(scenario, settled, NoCache())


def changed(settled: Settled, scenario: Scenario) -> Problem:
    """Prepare a scenario of the same robot that differs in anything."""
    cache = Cache() if members_of_users(scenario) else settled.changes
    return problem_of(scenario, without_tools(settled.numbers["robot"].model), cache)


def _problem(scenario: Scenario, settled: Settled, cache: Cache) -> Problem:
    problem = Problem(**settled.numbers, **_started(scenario, settled, cache))
    settled.keep(problem)
    return problem


class Settled(NamedTuple):
    """What of a problem does not depend on where it starts."""

    scenario: Scenario  # as its run has it
    numbers: dict[str, Any]  # attributes of the `Problem`
    keys: dict[str, Key | None]  # what surface, contacts, path and law depend on, but for the state
    known: dict[str, Any]  # what follows from the numbers
    last: dict[str, Any]  # of the start before: its surface, its law, and the instant from which its PD part acts
    table: tuple[int, bool, bool]  # numbers that sensors draw beside each row; whether those of force and joints do
    changes: Cache  # of what scenarios with other values have in common

    def keep(self, problem: Problem) -> None:
        """Give a problem what is known; what steps the first is for all others, which find out the rest once."""
        if "general" not in self.known:
            self.known.update({name: getattr(problem, name) for name in SETTLED})
        vars(problem).update(self.known)


def _settled(scenario: Scenario, model: RobotModel | None, cache: Cache) -> Settled:
    """Check what does not depend on where a run starts, and return it as numbers."""
    digests = cache.follow("digests", scenario, member_digests)
    bare: RobotModel = cache.follow("model", scenario, load_model) if model is None else model
    robot: Robot = cache.follow("robot", scenario, lambda s: _robot(s, bare, cache), bare)
    model, n = robot.model, robot.n

    arm = model.without_tools  # whose masses nothing below depends on

    def follow(name: str, make: Callable[[Any], Any], *others: Any) -> Any:
        return cache.follow(name, scenario, make, *arm, *others)

    given = scenario
    scenario = follow("completed", lambda s: completed(s, model))
    scenario = given if isinstance(scenario, Watched) else scenario
    follow("lengths", lambda s: refuse_lengths(s, model))
    follow("start", lambda s: start_state(s, model) and None)  # what is wrong with it is said first
    follow("combinations", lambda s: refuse_combinations(s, model))
    have_compiled(scenario, model)
    joint_friction = follow("friction of joints", lambda s: joint_friction_of(s, model))
    integrator, tolerance = follow("integrator", lambda s: integrator_of(s, joint_friction), joint_friction)
    follow("load friction", lambda s: _refuse_load_friction(s, joint_friction), joint_friction)
    steps, hold = follow("steps", lambda s: steps_and_hold(s, n))
    compensation = follow("believed compensation", _believed_compensation)
    follow("sampling", lambda s: _check_compensation(s, compensation), compensation)
    numbers = {
        "robot": robot, "integrator": integrator, "tolerance": tolerance, "h": scenario.time.step, "steps": steps,
        "hold": hold, "nodes": integrator.parts,
        "friction": follow("friction", lambda s: pack_friction(s.friction, n)),
        "compensation": follow(
            "compensation", lambda s: pack_law(compensation, n, model.joint_names), compensation
        ),
        "joint_friction": follow(
            "joint_friction", lambda s: pack_friction(joint_friction, n, joints=True), joint_friction
        ),
        "compliance": follow("compliance", lambda s: pack_compliance(s.compliance, n)),
        "sensor": follow("sensor", lambda s: pack_sensor(s.sensor, s.time.step)),
        "encoder": follow("encoder", lambda s: _encoder(s, model)),
        "transmission": follow("transmission", lambda s: transmission_constants(s.transmission, model)),
        "drives": follow("drives", lambda s: np.stack(
            [torque_limits(s.drives, model), torque_steps(s.drives, model, s.law.sample_period)]
        )),
        "stabiliser": follow("stabiliser", lambda s: np.array(stabiliser_gains(s))),
        "project": follow("project", lambda s: s.stabiliser.kind in ("projection", "both") and _is_rigid(s)),
    }  # fmt: skip
    keys = {
        "surface": follow("surface key", lambda s: Key(_surface_key(s, cache))),
        "contacts": follow("contacts key", lambda s: _contacts_key(s, model, cache)),
        "path": follow("path key", lambda s: Key(cache.texts(s, of=("robot", "tool", "reference")))),
    }  # fmt: skip
    drawn = scenario.sensor.noise > 0.0 or scenario.sensor.jitter > 0.0
    reads = follow("reads", lambda s: s.reads_encoders)
    table = (DrawnRow if reads else TableRow).count(n) - Reference.count(n), drawn, reads
    # What stepped the scenario before may not be wanted again: its memory is taken over.
    before, cache.newest = cache.newest, {}
    if before:
        kind, spare = before.popitem()
        cache.newest[MEMORY] = spare if kind == MEMORY else spare.loop
    known: dict[str, Any] = {
        "spare": cache.newest, "tendons": follow("tendons", lambda s: acting_tendons(s, model)),
        "member_digests": digests,
    }  # fmt: skip
    settled = Settled(scenario, numbers, keys, known, {}, table, Cache())
    known["settled"] = settled
    return settled


def _started(given: Scenario, settled: Settled, cache: Cache) -> dict[str, Any]:
    """Return what depends on where a run starts: the other attributes of the `Problem`."""
    of = settled.numbers
    robot, friction = of["robot"], of["friction"]
    model = robot.model
    scenario, keys, last = settled.scenario, settled.keys, settled.last
    if scenario.start is not given.start:
        scenario = scenario.model_copy(update={"start": given.start})
        scenario = with_all_entries(scenario, model) if model.loop_coordinates else scenario
    q, v = start_state(scenario, model)
    if model.loops:
        q, v = closed_start(robot, q, v, scenario.start.assemble or scenario.start.q is None)
    surface, now, mode = cache.get(
        ("surface", keys["surface"], q.tobytes(), v.tobytes()),
        lambda: placed_surface(scenario, robot, q, v, last.get("surface")),
        lambda placed: SECTION_BYTES,
    )
    last["surface"] = surface
    check_rates(surface, scenario.time.duration)
    believed = believed_surface(scenario, robot, surface, q)
    if not isinstance(scenario.compliance, Rigid) and of["tolerance"] is None:
        check_stiffness(scenario, robot, q, now)
    if scenario.transmission.elastic:
        check_transmission(scenario, robot, q)
    placed = None if keys["contacts"] is None else cache.get(
        ("contacts", keys["contacts"], q.tobytes()), lambda: placed_contacts(scenario, robot, q),
        lambda placed: SECTION_BYTES * len(placed.start),
    )  # fmt: skip
    with of_users(scenario.reference, "reference.kind"):  # its curves are evaluated in there
        taken = surface if believed is None else believed
        wanted, table = reference_table(scenario, settled, taken, q, cache)
    start = _pd_start(scenario, wanted)
    if last.get("start") != start:
        last.update(start=start, law=_packed_law(scenario, start, model))
    if friction.member.sticks != "elastic" and mode == PRESSED:
        u = now.frame @ robot.known_tip(robot.pinocchios(q))[1] @ v - now.carried
        mode = STUCK if np.hypot(u[1], u[2]) <= STICK_SPEED else PRESSED
    return {
        "scenario": scenario, "surface": surface, "believed": believed, "frame": now.frame, "q": q, "v": v,
        "mode": mode, "table": table, "wanted": wanted, "pd_start": start, "placed": placed,
        "law": last["law"],
    }  # fmt: skip


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
    beside = (*(scenario.body or ()), *(scenario.mocap or ()))
    return scenario.robot.model_dump_json(), *(each.model_dump_json() for each in beside)


def _surface_key(scenario: Scenario, cache: Cache) -> tuple[Hashable, ...]:
    """Return what `_surface` depends on, but for the state."""
    sections: list[Section] = [scenario.surface, scenario.surface_motion, scenario.compliance]
    if not isinstance(scenario.compliance, Rigid):  # the tip starts as deep as the force presses it
        sections += [scenario.force_profile, scenario.law]
    return robot_key(scenario, cache), *map(cache.text, sections)


def _contacts_key(scenario: Scenario, model: RobotModel, cache: Cache) -> Key | None:
    """Return what the places of contacts depend on, but for the state; None if there are none."""
    if not scenario.contact and not has_stops(scenario, model):
        return None
    return Key((robot_key(scenario, cache), cache.texts(scenario, of=("contact",))))


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


def reference_table(
    scenario: Scenario, settled: Settled, surface: PlacedSurface, q: Array, cache: Cache
) -> tuple[Desired, Array]:
    """Return what is desired on a surface, and the table of it, with what sensors draw behind each row."""
    of, (spare, drawn, reads) = settled.numbers, settled.table
    robot, steps, nodes = of["robot"], of["steps"], of["nodes"]
    n = robot.n
    instants = (scenario.time.step / nodes) * np.arange(steps * nodes + 1, dtype=np.float64)
    motion = settled.keys["path"], q.tobytes(), _path_key(scenario, surface)
    tool = unit(scenario.tool.axis, "tool.axis"), scenario.tool.radius
    wanted = cache.get_shared(
        ("desired", *motion),
        lambda: desired(scenario, robot, surface, q, scenario.force_profile, scenario.time.duration * BEYOND, *tool),
        lambda made: 3 * made.joints.q.nbytes,
    )
    wanted = Desired(wanted.tip, wanted.joints, scenario.force_profile, scenario.law.force)
    table = cache.get(
        ("table", *motion, instants.size, float(instants[1]), spare, drawn),
        lambda: wanted.table(instants, spare=spare),
        lambda made: made.nbytes,
    )
    table[:, Reference.place("force", n)] = force_at(wanted.profile, wanted.force, instants)
    if drawn:  # else its columns have the zeros that they were made with
        table[::nodes, TableRow.place("sensor", n)] = draws(scenario.sensor, steps + 1)
    if reads:
        table[::nodes, DrawnRow.place("draws", n)] = encoder_draws(scenario.encoder, steps + 1, n)
    return wanted, table


def _path_key(scenario: Scenario, surface: PlacedSurface) -> Hashable:
    """Return what of the surface the path depends on."""
    if surface.fixed_plane:
        return surface.normal.tobytes()
    sections = surface.section.model_dump_json(), surface.motion.model_dump_json()
    return (*sections, surface.origin.tobytes(), scenario.time.duration)
