"""The memory of the loop at t = 0, of a tool's round end and of encoders.

The memory of the round end of a tool, as `closedloop.loop.step.locate` reads it.

The first reading of encoders, before a run begins or where it goes on.

The loop's memory at t = 0: its constants, its whole-number state, and where the run starts.
"""

from typing import Any, NamedTuple

import numpy as np

from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError
from closedloop.control.reference.table import Reference
from closedloop.control.sensor import start_sensor
from closedloop.jit.calls import address_of
from closedloop.jit.interpreted import interpreted
from closedloop.jit.parameters import one_joint_block, parameter_block
from closedloop.jit.user_code import of_users
from closedloop.loop.events.phases import MEASURED, PROJECTION, STEP_END
from closedloop.loop.step.external import BEGIN, END, FELT, SHARE
from closedloop.loop.step.locate import BALL_TIP, BallTip
from closedloop.loop.step.memory import SPRING_STICK, Constants, Loop, State, Work
from closedloop.loop.step.perceived import read_joints
from closedloop.mechanics.closure.contact_force import FREE
from closedloop.mechanics.contacts.rolling import RADIUS, SHAPE, make_shape_memory
from closedloop.mechanics.friction.contact import Contact
from closedloop.mechanics.friction.laws.none import NoFriction
from closedloop.mechanics.limits import TOUCHING
from closedloop.mechanics.loops.bind import link_poses
from closedloop.mechanics.loops.close import close_state, factor_rows
from closedloop.mechanics.loops.drives import torque_of_drives
from closedloop.mechanics.loops.memory import POSITION, LoopMemory, bound_points, make_loop_memory
from closedloop.mechanics.loops.rows import locate_rows
from closedloop.mechanics.robot.pinocchio import Robot
from closedloop.mechanics.surface.placed import PlacedSurface
from closedloop.scenario.scenario import Scenario
from closedloop.simulation.engines.bind_contacts import placed_on_link
from closedloop.simulation.engines.scenario_numbers import ScenarioNumbers
from closedloop.simulation.parts import asking
from robot_models.errors import shown


class BallMemory(NamedTuple):
    """The memory of a tip with a round end, kept as long as its address is used."""

    links: BallTip
    kept: tuple[Any, ...]


def ball_memory(robot: Robot, surface: PlacedSurface, radius: float, loop: int) -> BallMemory:
    """Return a new memory of a tip with an end of this radius, m, on a surface; `loop` is the address of the loop."""
    poses = link_poses(robot.tree, robot.model.loop_home)
    link, _, point = placed_on_link(robot, poses, robot.tip, (0.0, 0.0, 0.0), "robot.tip")
    kinds = np.array([POSITION] * 3 + [link] * 3 + [-1] * 3 + [0, 1, 1], dtype=np.int64)
    along = surface.frame if surface.fixed_plane else np.eye(3)
    bound = bound_points(robot.n, kinds, np.tile(point, (3, 1)), np.zeros((3, 3)), along)
    shape = np.zeros((1, SHAPE))
    shape[0, RADIUS] = radius
    rows, shapes = make_loop_memory(robot.tree, bound), make_shape_memory(robot.n, shape)
    links = BallTip(np.zeros(BALL_TIP, dtype=np.int64))
    links.address, links.loop, links.rows, links.shapes = address_of(links.memory), loop, rows.address, shapes.address
    return BallMemory(links, (rows, shapes))


def external_memory(scenario: Scenario, robot: Robot) -> LoopMemory:
    """Return a new memory of forces from outside, see `closedloop.loop.step.external`."""
    sections = scenario.external_force or ()
    poses, m = link_poses(robot.tree, robot.model.loop_home), len(sections)
    places: list[tuple[int, int, Array, Array, Array]] = []
    for i, section in enumerate(sections):
        where, (frame, at) = f"external_force[{i}]", section.place(robot.tip, scenario.tool.offset)
        link, _, point = placed_on_link(robot, poses, frame, at, f"{where}.link")
        other, turn, _ = placed_on_link(robot, poses, section.axes, (0.0, 0.0, 0.0), f"{where}.axes")
        if link < 0:
            raise ScenarioError(f"{where}.link = {shown(frame)}: no joint moves it: name a frame that moves")
        places.append((link, other, point, turn @ section.force, turn @ section.moment))
    links, others, points, forces, moments = map(np.array, zip(*places, strict=True))
    sides = np.concatenate([np.full(m, POSITION), links, others, np.zeros(m)]).astype(np.int64)
    bound = bound_points(robot.n, sides, points, np.zeros((m, 3)), moments)
    memory = make_loop_memory(robot.tree, bound._replace(along_a=forces))
    span = memory.rows.value
    span[:, BEGIN] = [section.start for section in sections]
    span[:, END] = [section.end for section in sections]
    span[:, SHARE], span[:, FELT] = span[:, BEGIN] <= 0.0, [section.link is None for section in sections]
    return memory


def read_encoders(loop: Loop, table: Array) -> None:
    """Read the joints in the state of a loop, as the law sees them: the loops of the mechanism are closed there too."""
    state, entry = loop.state, loop.state.loops.entry
    state.loops.entry = 0  # compiled code, which interpreted code cannot call
    interpreted(read_joints)(loop.w, loop.constants, state, table)
    state.loops.entry, state.phase = entry, MEASURED
    if state.loops.perceived_at != 0:
        _close_reading(loop.w, loop.w.kept["perceived_loops"])


def _close_reading(w: Work, memory: LoopMemory) -> None:
    """Move the first reading of encoders, in place of q and q̇, to the nearest state that the loops allow.

    Their rank is that at the true state, before it is found in the course of a run.
    """
    links, rows = memory
    rows.q[:], rows.v[:] = w.encoders.true_q, w.encoders.true_v
    interpreted(locate_rows)(links, rows)
    interpreted(factor_rows)(links, rows, rows.error, links.m)
    links.known = links.rank
    interpreted(close_state)(links, rows, w.q, w.v)


# Slip slower than this, m/s, is none: a tip that starts with it sticks, one that slows down to it may.
STICK_SPEED = 1e-7


def write_constants(problem: ScenarioNumbers, constants: Constants) -> None:
    """Write the constants of a run, unless they are there: those of a problem that says the same."""
    there = constants.kept.get("asked")
    if there is None or not there.stands_for(problem):
        constants.memory[:] = 0.0
        constants.keep_alive(asked=asking(problem, _write_constants, constants)[1])
    write_places(problem, constants)


def _write_constants(problem: ScenarioNumbers, constants: Constants) -> None:
    robot, wrong = problem.robot, problem.scenario.model_error
    constants.h, constants.node = problem.h, problem.h / problem.nodes
    constants.rest_speed = problem.scenario.impact.rest_speed
    constants.s_v, constants.s_p = problem.stabiliser
    constants.tip[:], constants.gravity[:], constants.reach = robot.tip_offset, robot.gravity, robot.reach**2
    constants.support[:], constants.stick_speed = robot.support, STICK_SPEED
    constants.lower_stop[:], constants.upper_stop[:] = problem.stops
    constants.sensor[:], constants.compensation[:] = problem.sensor.par.memory, problem.compensation.numbers
    constants.mass_factor, constants.unknown_payload = wrong.masses, wrong.payload
    constants.armature[:] = robot.model.rigid_armature
    constants.undriven[: len(robot.model.undriven)] = robot.model.undriven
    constants.turns[list(robot.model.balls)] = 1.0
    constants.measured[:] = robot.model.measured
    gears = constants.gears
    gears.stiffness[:], gears.damping[:], gears.motor_inertia[:], gears.play[:], gears.load_friction[:] = (
        problem.transmission
    )
    constants.tilt[:], constants.encoder[:] = np.eye(3) if wrong.normal == 0.0 else wrong.tilt(), problem.encoder
    constants.torque_limit[:], constants.torque_change[:] = problem.drives
    constants.compliance[:], constants.tendons[:] = problem.compliance.numbers, problem.tendons
    constants.friction[:], constants.joint_friction[:] = problem.friction.numbers, problem.joint_friction.numbers
    if problem.friction.member is not NoFriction:  # whose numbers are zero, as the memory is
        tip = tip_contact(problem)
        with of_users(problem.friction.member, "friction.kind"):
            constants.impact_friction = tip.kinetic_level
            constants.capture_speed, constants.lag = tip.capture_speed, tip.lag
    if problem.joint_friction.member is not NoFriction:
        with of_users(problem.joint_friction.member, "joint_friction.kind"):
            constants.bearings[:] = ~robot.model.of_bodies
            for j, joint in enumerate(joint_contacts(problem)):
                constants.joint_capture_speed[j], constants.joint_lag[j] = joint.capture_speed, joint.lag


def write_places(problem: ScenarioNumbers, constants: Constants) -> None:
    """Write those constants that may be others where a run starts elsewhere, or that a run changes."""
    constants.offset, constants.law[:] = problem.surface.offset, problem.law.numbers
    constants.restitution = problem.scenario.impact.restitution


def write_settings(problem: ScenarioNumbers, state: State) -> None:
    """Write the settings of a run."""
    to, law = state.settings, problem.layout
    for name, value in law.settings:
        setattr(to, name, value)
    to.steps, to.hold, to.nodes_per_step, to.general = problem.steps, problem.hold, problem.nodes, law.general
    to.project, to.semi_implicit = problem.project, problem.integrator.semi_implicit
    to.time_stepping = problem.integrator.time_stepping
    state.friction.sticking, state.joint_friction.sticking = problem.shape.sticking
    state.sensor.axes, state.sensor.states, _, state.sensor.sampled = problem.shape.sensor
    states = law.row_states if state.law_states > 0 else 0  # a user's function in place of the law has none
    to.states_at = law.row_width - states if states > 0 else 0


def write_start(problem: ScenarioNumbers, state: State, w: Work) -> None:
    """Write where the arm, the tip's contact and the states of sensor, friction and motors are at t = 0."""
    n = problem.robot.n
    state.mode, state.sampled, state.cleared = problem.mode, 1, 1
    if problem.project and problem.mode != FREE:
        state.phase, state.projection.next_phase = PROJECTION, STEP_END
    w.q[:], w.v[:] = problem.q, problem.v
    w.tip.frame[:] = problem.frame
    q = problem.robot.pinocchios(problem.q)
    tip, jacobian = problem.robot.known_tip(q)
    velocity = jacobian @ problem.v
    u = problem.frame @ velocity
    w.tip.anchor[:] = problem.frame @ tip
    if not problem.surface.fixed_plane:
        now = problem.surface.touching(tip, velocity)
        u -= now.carried
        state.past_edge = problem.mode == FREE and now.inside < 0.0 and now.gap <= TOUCHING
        w.tip.anchor[:] = problem.surface.frame[[1, 2, 0]] @ (tip - problem.surface.origin)
    slip = float(np.hypot(u[1], u[2]))
    if slip > 0.0:
        w.friction.direction[:] = u[1:] / slip
    felt = (
        float(problem.table[0, Reference.place("force", n)]) if problem.mode != FREE else 0.0
    )  # the sensor's history is f_des
    sensor = int(state.law_states)
    friction = sensor + int(state.sensor.states)
    joints = friction + int(state.friction.states)
    start_sensor(felt, problem.sensor, w.z[sensor:friction], w.sensing.signal, w.sensing.ring)
    w.sensing.measured, w.last_event = w.sensing.ring[0, 0], -np.inf
    w.sensing.tangential[:] = w.sensing.ring[1:, 0]
    if joints > friction and problem.mode != FREE and slip <= STICK_SPEED:
        with of_users(problem.friction.member, "friction.kind"):
            w.z[friction:joints] = tip_contact(problem).rested()
    if state.joint_friction.sticking == SPRING_STICK:
        w.joint_friction.stuck[:] = problem.v == 0.0
    if state.joint_friction.states > 0:
        with of_users(problem.joint_friction.member, "joint_friction.kind"):
            motors = joints + n * int(state.joint_friction.states)
            w.z[joints:motors] = np.concatenate([joint.rested() for joint in joint_contacts(problem)])
    if state.settings.elastic:
        # Each spring carries what holds the arm against gravity and the force desired, so that none is released.
        held = problem.robot.known_terms(q, problem.v).bias - felt * (problem.frame[0] @ jacobian)
        if problem.robot.model.loops:
            held, _ = torque_of_drives(problem.robot, problem.q, held)
        stiffness, play = problem.transmission[0], problem.transmission[3]
        driven = stiffness > 0.0
        wound = np.divide(held, stiffness, out=np.zeros(n), where=driven)
        w.z[-2 * n : -n] = problem.q + wound + np.where(driven, play * np.sign(held), 0.0)
        w.z[-n:] = np.where(driven, problem.v, 0.0)


def tip_contact(problem: ScenarioNumbers) -> Contact:
    """Return the contact of the tip, for what is asked of its friction once."""
    member, numbers, _ = problem.friction
    return Contact(member, parameter_block(member)(numbers, problem.robot.n), 2)


def joint_contacts(problem: ScenarioNumbers) -> list[Contact]:
    """Return the contact of each joint, for the same."""
    member, rows, _ = problem.joint_friction
    return [Contact(member, one_joint_block(member)(row, problem.robot.n), 1) for row in rows]
