"""From a scenario to a `Problem`, or to the one line that says what is wrong with it."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import replace
from typing import Any

import numpy as np

import robot_models
from closedloop.base.arguments import arguments_checked
from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError
from closedloop.base.sections import Section
from closedloop.control.drives import torque_limits, torque_steps
from closedloop.control.encoder import check_steps, encoder_draws
from closedloop.control.law import Compensation, ControlLaw
from closedloop.control.laws.paper import PaperLaw
from closedloop.control.reference.desired import Desired, DrawnRow, Reference, TableRow, desired
from closedloop.control.reference.force import force_at
from closedloop.control.sensor import draws, pack_sensor
from closedloop.control.stability import check_sampling
from closedloop.control.transmission import transmission_constants
from closedloop.jit.parameters import pack
from closedloop.jit.user_code import of_users
from closedloop.mechanics.closure.contact_force import PRESSED, STUCK
from closedloop.mechanics.loops.assemble import closed_start
from closedloop.mechanics.robot.pinocchio import Robot
from closedloop.mechanics.surface.compliances.none import Rigid
from closedloop.mechanics.surface.placed import PlacedSurface
from closedloop.mechanics.surface.plane import unit
from closedloop.mechanics.surface.rates import check_rates
from closedloop.scenario.arm import beside_bodies, free_bodies, has_stops, joint_friction_of, robot_of
from closedloop.scenario.collision import with_collision_shapes
from closedloop.scenario.gains import check_transmission
from closedloop.scenario.robot_sections import NO_ROBOT
from closedloop.scenario.scenario import Scenario
from closedloop.scenario.user_module import refuse_absent
from closedloop.simulation.all_entries import with_all_entries
from closedloop.simulation.cache import Cache
from closedloop.simulation.engines.bind_contacts import placed_contacts
from closedloop.simulation.engines.packed import PackedLaw, pack_compliance, pack_friction, pack_law
from closedloop.simulation.engines.problem import Problem
from closedloop.simulation.engines.start_memory import STICK_SPEED
from closedloop.simulation.loop_calls import have_compiled
from closedloop.simulation.start import placed_surface, refuse_combinations, refuse_lengths, start_state
from closedloop.simulation.time_step import check_stiffness, integrator_of, stabiliser_gains, steps_and_hold
from robot_models import RobotModel
from robot_models.bodies import only_bodies

# Memory of a robot, with Pinocchio's model and data, about, bytes.
ROBOT_BYTES = 200_000
# Memory of a section as numbers, about, bytes.
SECTION_BYTES = 2_000


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
    refuse_absent(scenario)
    cache = Cache() if cache is None else cache
    robot = _robot(scenario, model, cache)
    model = robot.model
    scenario = completed(scenario, model)
    n = robot.n
    refuse_lengths(scenario, model)
    q, v = start_state(scenario, model)
    refuse_combinations(scenario, model)
    have_compiled(scenario, model)
    if model.loops:
        q, v = closed_start(robot, q, v, scenario.start.assemble or scenario.start.q is None)
    surface, now, mode = cache.get(
        ("surface", *_surface_key(scenario), q.tobytes(), v.tobytes()),
        lambda: placed_surface(scenario, robot, q, v),
        lambda placed: SECTION_BYTES,
    )
    check_rates(surface, scenario.time.duration)
    soft = not isinstance(scenario.compliance, Rigid)
    joint_friction = joint_friction_of(scenario, model)
    integrator, tolerance = integrator_of(scenario, joint_friction)
    if soft and tolerance is None:
        check_stiffness(scenario, robot, q, now)
    if scenario.transmission.elastic:
        check_transmission(scenario, robot, q)
    placed = None if not (scenario.contact or has_stops(scenario, model)) else cache.get(
        ("contacts", *_contacts_key(scenario), q.tobytes()), lambda: placed_contacts(scenario, robot, q),
        lambda placed: SECTION_BYTES * len(placed.start),
    )  # fmt: skip
    h, period = scenario.time.step, scenario.law.sample_period
    steps, hold = steps_and_hold(scenario, n)
    with of_users(scenario.reference, "reference.kind"):  # its curves are evaluated in there
        wanted, table = reference_table(scenario, robot, surface, q, steps, integrator.parts, cache)

    law, start = _law_from(scenario, wanted)
    compensation = _believed_compensation(scenario)
    compensation.check(law)
    check_sampling(law, compensation, scenario.sensor, law.sample_period or h)

    def packed(name: str, section: Any, how: Callable[[], PackedLaw]) -> PackedLaw:
        key = ("packed", name, n, type(section), section.model_dump_json())
        return cache.get(key, how, lambda found: SECTION_BYTES)

    friction = packed("friction", scenario.friction, lambda: pack_friction(scenario.friction, n))
    if friction.member.sticks != "elastic" and mode == PRESSED:
        u = now.frame @ robot.terms(q, v).jacobian @ v - now.carried
        mode = STUCK if np.hypot(u[1], u[2]) <= STICK_SPEED else PRESSED
    return Problem(
        scenario=scenario, robot=robot, surface=surface, frame=now.frame, integrator=integrator, tolerance=tolerance,
        q=q, v=v, mode=mode, h=h, steps=steps, hold=hold, nodes=integrator.parts, table=table, wanted=wanted,
        pd_start=start, law=pack_law(law, n, model.joint_names), friction=friction, placed=placed,
        compensation=packed("compensation", compensation, lambda: pack_law(compensation, n, model.joint_names)),
        joint_friction=packed("joint_friction", joint_friction, lambda: pack_friction(joint_friction, n, joints=True)),
        compliance=packed("compliance", scenario.compliance, lambda: pack_compliance(scenario.compliance, n)),
        sensor=cache.get(
            ("sensor", scenario.sensor.model_dump_json(), h), lambda: pack_sensor(scenario.sensor, h),
            lambda found: SECTION_BYTES,
        ),
        encoder=cache.get(
            ("encoder", n, scenario.encoder.model_dump_json(), robot_key(scenario)), lambda: _encoder(scenario, model),
            lambda found: SECTION_BYTES,
        ),
        transmission=transmission_constants(scenario.transmission, model),
        drives=np.stack([torque_limits(scenario.drives, model), torque_steps(scenario.drives, model, period)]),
        stabiliser=np.array(stabiliser_gains(scenario)),
        project=scenario.stabiliser.kind in ("projection", "both") and not soft,
    )  # fmt: skip


def _law_from(scenario: Scenario, wanted: Desired) -> tuple[ControlLaw, float]:
    """Return the control law, and the instant, s, from which its PD part acts: of the path, if the law says none."""
    law = scenario.law
    given = getattr(law, "pd_start", None)
    h = scenario.time.step
    start = (wanted.tip.start if given is None else given) - 1e-9 * h  # i·h and 0.5 may differ by rounding
    return law.model_copy(update={"pd_start": start}) if isinstance(law, PaperLaw) else law, start


def _encoder(scenario: Scenario, model: RobotModel) -> Array:
    numbers = pack(scenario.encoder, model.n, "encoder", model.joint_names)
    check_steps(scenario.encoder, model.position_lower, model.position_upper, model.joint_names)
    return numbers


def robot_key(scenario: Scenario) -> Hashable:
    """Return what the robot depends on."""
    return (
        model_key(scenario), scenario.tool.model_dump_json(), scenario.model_error.payload,
        scenario.transmission.elastic,
    )  # fmt: skip


def model_key(scenario: Scenario) -> Hashable:
    """Return what the model depends on that `load_model` returns."""
    return scenario.robot.model_dump_json(), *(each.model_dump_json() for each in scenario.body or ())


def _surface_key(scenario: Scenario) -> tuple[Hashable, ...]:
    """Return what `_surface` depends on, but for the state."""
    sections: list[Section] = [scenario.surface, scenario.surface_motion, scenario.compliance]
    if not isinstance(scenario.compliance, Rigid):  # the tip starts as deep as the force presses it
        sections += [scenario.force_profile, scenario.law]
    return robot_key(scenario), *((type(section), section.model_dump_json()) for section in sections)


def _contacts_key(scenario: Scenario) -> tuple[Hashable, ...]:
    """Return what the places of contacts depend on, but for the state."""
    sections = scenario.contact or ()
    return robot_key(scenario), *((type(x.surface), type(x.motion), x.model_dump_json()) for x in sections)


def _robot(scenario: Scenario, model: RobotModel | None, cache: Cache) -> Robot:

    def make() -> Robot:
        return robot_of(scenario, load_model(scenario) if model is None else model)

    return cache.get(("robot", robot_key(scenario)), make, lambda robot: ROBOT_BYTES)


def load_model(scenario: Scenario) -> RobotModel:
    """Return the robot that a scenario names, with each [[body]] beside it."""
    section = scenario.robot
    if section.model == NO_ROBOT:
        return only_bodies(free_bodies(scenario))
    options: dict[str, Any] = {} if section.lock is None else {"lock": section.lock}
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
    scenario: Scenario, robot: Robot, surface: PlacedSurface, q: Array, steps: int, nodes: int, cache: Cache
) -> tuple[Desired, Array]:
    """Return what is desired, and the table of it, `nodes` rows to a step, with noise in its last columns."""
    n = robot.n
    instants = (scenario.time.step / nodes) * np.arange(steps * nodes + 1, dtype=np.float64)
    row = DrawnRow if scenario.reads_encoders else TableRow
    spare = row.count(n) - Reference.count(n)
    motion = (
        scenario.robot.model_dump_json(),
        scenario.tool.model_dump_json(),
        scenario.reference.model_dump_json(),
        q.tobytes(),
        _path_key(scenario, surface),
    )
    tool = unit(scenario.tool.axis, "tool.axis"), scenario.tool.radius
    wanted = cache.get_shared(
        ("desired", *motion),
        lambda: desired(scenario, robot, surface, q, scenario.force_profile, scenario.time.duration * BEYOND, *tool),
        lambda made: 3 * made.joints.q.nbytes,
    )
    wanted = replace(wanted, profile=scenario.force_profile, force=scenario.law.force)
    noisy = scenario.sensor.noise > 0.0
    table = cache.get(
        ("table", *motion, instants.size, float(instants[1]), spare, noisy),
        lambda: wanted.table(instants, spare=spare),
        lambda made: made.nbytes,
    )
    table[:, Reference.place("force", n)] = force_at(wanted.profile, wanted.force, instants)
    if noisy:  # else its column has the zeros that it was made with
        table[::nodes, TableRow.place("noise", n)] = draws(scenario.sensor, steps + 1)
    if scenario.reads_encoders:
        table[::nodes, DrawnRow.place("draws", n)] = encoder_draws(scenario.encoder, steps + 1, n)
    return wanted, table


def _path_key(scenario: Scenario, surface: PlacedSurface) -> Hashable:
    """Return what of the surface the path depends on."""
    if surface.fixed_plane:
        return surface.normal.tobytes()
    sections = scenario.surface.model_dump_json(), scenario.surface_motion.model_dump_json()
    return (*sections, surface.origin.tobytes(), scenario.time.duration)
