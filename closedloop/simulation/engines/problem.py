"""A scenario as numbers: everything that the loop needs, open to inspection before it runs.

And the loop's memory at t = 0: its constants, its whole-number state, where the run starts, and the
first reading of encoders.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from closedloop.base.arrays import Array
from closedloop.base.errors import ClosedLoopError, LawError, ScenarioError
from closedloop.base.families import is_users
from closedloop.base.upwards import called
from closedloop.control.law import LawInput
from closedloop.control.reference.desired import Desired, Reference
from closedloop.control.sensor import NO_ENCODER, PackedSensor, start_sensor
from closedloop.jit.calls import address_of, entry_address
from closedloop.jit.interpreted import interpreted, twin_address
from closedloop.jit.parameters import one_joint_block, parameter_block, per_joint
from closedloop.jit.user_code import of_users, why_member_not_compiled
from closedloop.loop.events.locate import MEASURED, PROJECTION, STEP_END
from closedloop.loop.step.closed_loops import closed_loops
from closedloop.loop.step.contacts import contacts_in_step
from closedloop.loop.step.external import external_forces
from closedloop.loop.step.locate import ball_tip, read_joints
from closedloop.loop.step.memory import SPRING_STICK, Constants, Loop, State, Work, make_loop
from closedloop.loop.step.record_row import ContactRow
from closedloop.mechanics.closure.contact_force import FREE, PRESSED
from closedloop.mechanics.contacts.sections import AS_IMPACT
from closedloop.mechanics.contacts.surfaces import Called
from closedloop.mechanics.friction.contact import Contact
from closedloop.mechanics.friction.law import Slip
from closedloop.mechanics.friction.laws.none import NoFriction
from closedloop.mechanics.impact import RATIOS
from closedloop.mechanics.impact.single import RESTITUTIONS, Restitution, coefficient_at
from closedloop.mechanics.integrators import Scheme
from closedloop.mechanics.limits import TOUCHING
from closedloop.mechanics.loops.bind import step_memory
from closedloop.mechanics.loops.reactions import torque_of_drives
from closedloop.mechanics.loops.rows import locate_rows
from closedloop.mechanics.loops.solve import close_state, factor_rows
from closedloop.mechanics.robot.pinocchio import Robot
from closedloop.mechanics.surface.contact import place_at
from closedloop.mechanics.surface.placed import PlacedSurface, Plane
from closedloop.record.columns.derived import Recorded
from closedloop.record.run import Run
from closedloop.scenario.load import START, Variants, replaced
from closedloop.scenario.scenario import BaumgarteGains, Scenario
from closedloop.simulation.engines import bind_contacts
from closedloop.simulation.engines.bind_contacts import ContactPlaces, ContactRows
from closedloop.simulation.engines.loops import proceed_at
from closedloop.simulation.engines.scenario_numbers import SIZES, PackedLaw, RecordLayout, Shape, entries_of
from closedloop.simulation.parts import asking
from robot_models import RobotModel
from robot_models.cached import cached_property


def read_encoders(loop: Loop, table: Array) -> None:
    """Read the joints in the state of a loop, as the law sees them: the loops of the mechanism are closed there too."""
    state, entry = loop.state, loop.state.loops.entry
    state.loops.entry = 0  # compiled code, which interpreted code cannot call
    interpreted(read_joints)(loop.w, loop.constants, state, table)
    state.loops.entry, state.phase = entry, MEASURED
    if state.loops.perceived_at != 0:
        # The rank of the loops is that at the true state, before it is found in the course of a run.
        links, rows = loop.w.kept["perceived_loops"]
        rows.q[:], rows.v[:] = loop.w.encoders.true_q, loop.w.encoders.true_v
        interpreted(locate_rows)(links, rows)
        interpreted(factor_rows)(links, rows, rows.error, links.m)
        links.known = links.rank
        interpreted(close_state)(links, rows, loop.w.q, loop.w.v)


# Slip slower than this, m/s, is none: a tip that starts with it sticks, one that slows down to it may.
STICK_SPEED = 1e-7


def write_constants(problem: "Problem", constants: Constants) -> None:
    """Write the constants of a run, unless they are there: those of a problem that says the same."""
    there = constants.kept.get("asked")
    if there is None or not there.stands_for(problem):
        constants.memory[:] = 0.0
        constants.keep_alive(asked=asking(problem, _write_constants, constants)[1])
    constants.offset, constants.law[:] = problem.surface.offset, problem.law.numbers
    constants.restitution = problem.scenario.impact.restitution


def _write_constants(problem: "Problem", constants: Constants) -> None:
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


def write_settings(problem: "Problem", state: State) -> None:
    """Write the settings of a run."""
    to = state.settings
    for name, value in problem.loop_settings:
        setattr(to, name, value)
    to.steps, to.hold, to.nodes_per_step, to.general = problem.steps, problem.hold, problem.nodes, problem.general
    to.project, to.semi_implicit = problem.project, problem.integrator.semi_implicit
    to.time_stepping = state.event.stepping = int(problem.integrator.time_stepping)
    state.friction.sticking, state.joint_friction.sticking = problem.shape.sticking
    state.sensor.axes, state.sensor.states, _, state.sensor.sampled = problem.shape.sensor
    states = problem.row_states if state.law_states > 0 else 0  # a user's function in place of the law has none
    to.states_at = problem.row_width - states if states > 0 else 0


def write_start(problem: "Problem", state: State, w: Work) -> None:
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
    # the sensor's history is f_des
    felt = float(problem.table[0, Reference.place("force", n)]) if problem.mode != FREE else 0.0
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


def tip_contact(problem: "Problem") -> Contact:
    """Return the contact of the tip, for what is asked of its friction once."""
    member, numbers, _ = problem.friction
    return Contact(member, parameter_block(member)(numbers, problem.robot.n), 2)


def joint_contacts(problem: "Problem") -> list[Contact]:
    """Return the contact of each joint, for the same."""
    member, rows, _ = problem.joint_friction
    return [Contact(member, one_joint_block(member)(row, problem.robot.n), 1) for row in rows]


# The members of a placed surface, by the names of its entries.
MEMBERS = {"surface": "section", "surface_motion": "motion"}


def as_it_is(entry: Any) -> Any:
    """Return an entry of floats."""
    return entry


@dataclass(frozen=True)
class Problem:
    """The numbers of a scenario, everything that the loop needs, and the memory of the simulation loop."""

    scenario: Scenario
    robot: Robot  # the arm with its tip
    surface: PlacedSurface
    believed: PlacedSurface | None  # the surface that the controller believes in; None: the true one
    frame: Array  # (3, 3): contact frame at t = 0: rows n, t1, t2 in base axes
    integrator: type[Scheme]
    q: Array  # (n,): state at t = 0, with v
    v: Array
    mode: int  # contact mode at t = 0, see `closedloop.mechanics.closure.contact_force`
    steps: int  # how many
    h: float  # the step, s
    stabiliser: Array  # (2,): s_v, 1/s, and s_p, 1/s²
    pd_start: float  # instant from which the PD part of the law acts, s
    # The members of the scenario, as numbers.
    law: PackedLaw
    compensation: PackedLaw
    friction: PackedLaw
    joint_friction: PackedLaw
    compliance: PackedLaw
    sensor: PackedSensor  # the force sensor
    nodes: int  # rows of the table to a step
    project: bool  # whether the state is projected onto the closure after each step
    hold: int  # steps for which a sampled torque is held; 0: the law is evaluated at every stage
    # (2, n): largest torque of each joint, and its largest change from sample to sample, N m; infinite where there is
    # none
    drives: Array
    transmission: Array  # (5, n): see `closedloop.control.drives.transmission_constants`
    encoder: Array  # (k,): the parameters of the encoders
    wanted: Desired  # the reference at any instant
    placed: ContactPlaces | None  # where the contacts of [[contact]] are; None without any
    tolerance: float | None  # relative tolerance of an adaptive integrator; None: the step is fixed
    forces: Array  # (P,): the desired force at every row of the table, N
    bare_table: Array  # the table but for the force, where it has that of another problem of the same path
    general: bool  # whether the law is called by address
    papers_law: bool  # whether the law is the paper's
    # What the loop calls by address of the scenario's members, by the names that `State` has for it
    members_called: tuple[tuple[str, Any], ...]
    # What sections say of the loop beside numbers, see `closedloop.loop.step.memory.Settings`
    loop_settings: tuple[tuple[str, int], ...]
    record: RecordLayout  # what its record has
    shape: Shape  # how many numbers there are of what is called
    there: PlacedSurface  # the surface for a tip somewhere, see `PlacedSurface.below`
    ends: tuple[int, ...]  # where the groups of joints end, see `closedloop.mechanics.robot.tree.group_ends`
    has_loops: bool  # whether the robot has loop joints
    # The friction along tendons of the robot, and their stops: rows of `robot_models.tendon.rough_tendons`
    tendons: Array
    stops: tuple[Array, Array]  # where the joints have hard stops, lower and upper, (n,)
    member_digests: dict[str, str]  # see `closedloop.scenario.user_module.member_digests`
    bare: RobotModel  # the robot's model without what the scenario puts on it
    model_given: RobotModel | None  # the model that was given in place of that which the scenario names
    # What steps its loop, by engine, where no run uses it: `closedloop.simulation.loop_calls.Driver`
    spare: dict[str, Any]

    @property
    def time_constant(self) -> float | None:
        """T of Baumgarte's stabiliser, s, as given or as chosen; None without that stabiliser."""
        section = self.scenario.stabiliser
        if not isinstance(section, BaumgarteGains):
            return None
        given = section.time_constant
        return given if isinstance(given, float) else float(self.stabiliser[1] ** -0.5)

    @property
    def plane(self) -> Plane:
        """The plane through the surface's origin at t = 0, with its normal there: the surface itself if it is one."""
        return Plane(self.surface.normal, self.surface.offset)

    @property
    def path(self) -> Array:
        """q_des and q̇_des of every row of the table, (P, 2, n)."""
        n = self.robot.n
        return self.table[:, : 2 * n].reshape(-1, 2, n)

    @property
    def gains(self) -> Array:
        """K_p and K_d of every joint, (2, n), of a law that has them."""
        law: Any = self.scenario.law
        return np.array([per_joint(f"law.{name}", getattr(law, name), self.robot.n) for name in ("kp", "kd")])

    @property
    def settings(self) -> Array:
        """f_des at the start, N, and the instant from which the PD part acts, s."""
        return np.array([self.table[0, 2 * self.robot.n + 9], self.pd_start])

    @property
    def contact_rows(self) -> ContactRows | None:
        """The rows of the contacts of [[contact]] on the links; None without any."""
        return None if self.placed is None else self.placed.rows

    @property
    def row_width(self) -> int:
        """Numbers in a row of the record."""
        return self.record.width

    @property
    def row_states(self) -> int:
        """How many of these, the last, are states of the law and its compensation."""
        return self.record.row_states

    @property
    def n(self) -> int:
        """Joints."""
        return self.robot.n

    @property
    def restitution(self) -> type[Restitution]:
        """The law of restitution."""
        return RESTITUTIONS[self.scenario.impact.law]

    def run(
        self, changes: Mapping[str, Any] | None = None, *, q: ArrayLike | None = None, v: ArrayLike | None = None,
        law: Callable[..., ArrayLike] | None = None, progress: bool = False,
        engine: str = "pinocchio", record: Recorded | None = None,
    ) -> Run:  # fmt: skip
        """Simulate the problem, or the same with other values of some keys, from another start; return the `Run`.

        It equals `closedloop.simulate` of ``scenario.replace(changes)`` to the bit, and does not load the robot again.

        Parameters
        ----------
        changes : mapping, optional
            Dotted keys and values, such as ``{"law.force": 12.0}``.
        q, v : array_like, optional
            The start, in place of ``start.q`` and ``start.v``.
        law, progress, engine, record
            See `closedloop.simulate`, which names the errors too.
        """
        start = {key: value for key, value in (("start.q", q), ("start.v", v)) if value is not None}
        changes = {**(changes or {}), **start}
        scenario = self.scenario
        if changes and changes.keys() <= START:
            scenario = replaced(scenario, changes)
        elif changes:
            keys = tuple(changes)
            if keys not in self._variants:
                self._variants[keys] = Variants(scenario, keys)
            scenario = self._variants[keys].scenario(tuple(changes.values()))
        kept = START.isdisjoint(changes)  # hardly any start is asked for twice
        return called("run", scenario, self, law, progress, engine, record, kept)

    @cached_property
    def _variants(self) -> dict[tuple[str, ...], Variants]:
        return {}

    @cached_property
    def of_thread(self) -> dict[int, Any]:
        """Of each thread what it has made of the scenario with other values and from other starts: a robot of its own.

        See `closedloop.simulation.prepare.borrowed`.
        """
        return {}

    @cached_property
    def table(self) -> Array:
        """The reference at every instant at which a stage is evaluated, see `closedloop.loop.step.entries`, and what
        the force sensor draws, (steps · nodes + 1, 2 n + 14).

        The forces are written into `bare_table` when it is first asked for.
        """
        self.bare_table[:, Reference.place("force", self.n)] = self.forces
        return self.bare_table

    @classmethod
    def of(cls, numbers: dict[str, Any]) -> Self:
        """Return the problem of its attributes, and of what else is known of it."""
        made = object.__new__(cls)
        vars(made).update(numbers)
        return made

    def with_robot(self, robot: Robot) -> Self:
        """Return the same problem, with the same table, for another robot of the same model."""
        made = replace(self, robot=robot)
        vars(made)["table"] = self.table
        return made

    def with_table(self, table: Array) -> Self:
        """Return the same problem with another table."""
        forces = table[:, Reference.place("force", self.n)]
        return type(self).of({**vars(self), "table": table, "bare_table": table, "forces": forces})

    def loop(self, user_law: bool = False, into: Loop | None = None) -> Loop:
        """Return the loop's memory at t = 0; see `make_loop` for `into`."""
        loop = self.memory(user_law, into)
        self.begin(loop)
        return loop

    def memory(self, user_law: bool = False, into: Loop | None = None) -> Loop:
        """Return the loop's memory with all that does not depend on where the run starts; see `begin` and `fits`."""
        loop, asked = asking(self, Problem._memory, user_law, into)
        loop.w.keep_alive(asked=asked)
        return loop

    def fits(self, loop: Loop) -> bool:
        """Whether `memory` would return one like this: constants and the start are all in which it may differ."""
        found: bool = loop.w.kept["asked"].stands_for(self)
        return found

    def _memory(self, user_law: bool, into: Loop | None) -> Loop:
        """Return the memory without constants, of a problem that notes what is read of it."""
        _ = self.members_called  # whose addresses `connect` writes: a loop of other members is not this one's
        (law, compensation, surface, joints), (_, sensor, ring, _), _, sizes = self.shape
        n, own = self.n, 0 if user_law else law
        both = 0 if user_law else law + compensation
        motors = 2 * n if self.scenario.transmission.elastic else 0
        tip, before = both + sensor, both + sensor + surface + n * joints
        rows = self.contact_rows
        contacts = None if rows is None else bind_contacts.contact_memory(self.scenario, self.robot, rows)
        extra = (before if contacts is None else bind_contacts.place_states(contacts.contacts, tip, before)) + motors
        loop = make_loop(
            n, **dict(zip(SIZES, sizes, strict=True)), extra=extra, stages=self.integrator.stages, ring=ring,
            ends=np.array(self.ends), into=into,
        )  # fmt: skip
        state = loop.state
        state.law.states, state.law_states = own, both
        state.friction.states, state.joint_friction.states = surface, joints
        write_settings(self, state)
        loop.w.decays.first[:] = self.integrator.first_tableau()
        if not self.there.fixed_plane:
            memory = self.there.memory()
            state.surface.at = memory.address
            loop.w.keep_alive(surface=memory)
        if self.believed is not None:
            memory = self.believed.memory()
            state.surface.believed.at = memory.address
            loop.w.keep_alive(believed=memory)
        if self.scenario.belief.normal_noise > 0.0:
            noise = self.scenario.belief.draws(self.steps + 1)
            state.surface.noise = address_of(noise)
            loop.w.keep_alive(noise=noise)
        if self.scenario.tool.radius > 0.0 and self.scenario.has_surface:
            ball = bind_contacts.ball_memory(self.robot, self.there, self.scenario.tool.radius, state.address)
            state.ball.at = ball.links.address
            loop.w.keep_alive(ball=ball)
        if self.scenario.external_force:
            external = bind_contacts.external_memory(self.scenario, self.robot)
            state.external.at, external.links.loop = external.address, state.address
            loop.w.keep_alive(external=external)
        if self.has_loops:
            loops = step_memory(self.robot)
            state.loops.at, loops.links.loop, state.loops.frames = loops.address, state.address, len(self.robot.moved)
            loop.w.keep_alive(loops=loops)
        if self.has_loops and state.settings.perceived != 0:
            perceived = step_memory(self.robot)
            state.loops.perceived_at, perceived.links.loop = perceived.address, state.address
            loop.w.keep_alive(perceived_loops=perceived)
        if contacts is not None:
            state.contacts.at, contacts.links.loop = contacts.address, state.address
            points = len(self.scenario.contact or ())
            contacts.links.record_at = self.row_width - self.row_states - ContactRow.count(points)
            contacts.contacts.mode[0] = PRESSED if state.settings.unilateral == 0 else FREE
            loop.w.keep_alive(contacts=contacts)
        return loop

    def begin(self, loop: Loop) -> None:
        """Write where the run starts into a loop's memory, which is as `memory` returned it: of this or one like it."""
        state, kept = loop.state, loop.w.kept
        write_constants(self, loop.constants)
        for name, place in (("surface", self.surface), ("believed", self.believed)):
            if name in kept and place is not None:
                place_at(kept[name].ask, place.origin)
        write_start(self, state, loop.w)
        if self.placed is not None:
            contacts = kept["contacts"]
            bind_contacts.rest_states(self.scenario, self.placed, self.v, contacts, loop.w.z)
            held = bind_contacts.stops_at_start(contacts, loop.constants, self.q, self.v)
            stepped = self.integrator.time_stepping
            state.coupled = int(stepped or self.placed.starts_closed or held)
            contacts.links.undecided = contacts.links.fresh = int(state.coupled and not stepped)
        if state.settings.encoder != NO_ENCODER and state.phase == STEP_END:
            read_encoders(loop, self.table)

    def constants(self, into: Constants | None = None) -> Constants:
        """Return the constants of the loop's memory, by themselves; `into` is that of another problem of this form."""
        sizes = self.robot.n, *self.shape.sizes
        constants = Constants(np.zeros(Constants.count(*sizes)), *sizes) if into is None else into
        write_constants(self, constants)
        return constants

    def entries(self, user_law: bool = False) -> dict[str, Any]:
        """Return what the loop calls by address, by the names that `State` has for it; see `loop` for `user_law`."""
        called = entries_of(self.scenario, self.robot.model, False) if user_law else dict(self.members_called)
        return self.surface.entries() | called

    def believed_entries(self) -> dict[str, Any]:
        """Return what is called of the surface that the controller believes in, by the keys of [belief]."""
        return {} if self.believed is None else self.believed.all_entries()

    def called(self, loop: Loop, user_law: bool = False) -> list[Any]:
        """Return all entry kernels that the loop of this memory calls by address; see `loop` for `user_law`."""
        entries = [*self.entries(user_law).values(), *self.believed_entries().values()]
        if loop.state.loops.at != 0:
            entries += [closed_loops, *(frame.entry for frame in self.robot.moved)]
        if loop.state.ball.at != 0:
            entries.append(ball_tip)
        if loop.state.external.at != 0:
            entries.append(external_forces)
        if loop.state.contacts.at != 0:
            entries += [contacts_in_step, *(each.entry for each in contact_members(loop))]
        return entries

    def connect(
        self, loop: Loop, user_law: Callable[[bool], None] | None = None, compiled: bool = True,
        form: Callable[[Any], Any] = as_it_is, machine: Callable[[Any], int] = entry_address,
        loop_compiled: bool = True,
    ) -> None:  # fmt: skip
        """Write into a loop's memory the addresses of what it calls: of machine code, or for an interpreted loop.

        Parameters
        ----------
        loop : Loop
            The memory.
        user_law : callable, optional
            Writes the address of a law of your own; it gets `compiled`.
        compiled : bool
            Whether the loop is machine code. A user's class is compiled in either case, so that a run which begins
            interpreted refuses what the next one would.
        form : callable
            Returns the form of an entry that is called, see `closedloop.jit.dual.dual`.
        machine : callable
            Returns the address of an entry's machine code.
        loop_compiled : bool
            Whether the loop itself is machine code too; interpreted, it can call what is.
        """

        def address(entry: Any) -> int:
            return machine(form(entry)) if compiled else twin_address(entry)

        def address_of_member(entry: Any, key: str, member: Any) -> int:
            address = machine if compiled else twin_address
            try:
                if address is twin_address and is_users(member):
                    entry_address(form(entry))
                return address(form(entry))
            except Exception as error:
                known = {"LawInput": LawInput._fields, "Slip": Slip._fields}
                if not is_users(member) or isinstance(error, ClosedLoopError):
                    raise
                why = why_member_not_compiled(error, type(member), known)
                raise ScenarioError(f"{key}.kind = {member.kind}: cannot be compiled: {why}") from None

        loop.state.proceed = address(proceed_at) if loop_compiled else twin_address(proceed_at)
        for name, entry in self.entries(user_law is not None).items():
            getattr(loop.state, name).entry = address_of_member(entry, name, getattr(self.scenario, name))
        if loop.state.loops.at != 0:
            loop.state.loops.entry = address(closed_loops)
            for k, frame in enumerate(self.robot.moved):
                where = address_of_member(frame.entry, f"mocap.{k}.motion", frame.motion)
                for name in loop.w.kept.keys() & {"loops", "perceived_loops"}:
                    loop.w.kept[name].links.kept["frames"][k, 0] = where
        if loop.state.ball.at != 0:
            loop.state.ball.entry = address(ball_tip)
        if loop.state.external.at != 0:
            loop.state.external.entry = address(external_forces)
        if loop.state.contacts.at != 0:
            loop.state.contacts.entry = address(contacts_in_step)
            for each in contact_members(loop):
                address_of_member(each.entry, f"contact.{each.contact - 1}.{each.key}", each.member)
            for members in _contact_families(loop):
                members.connect(address)
        if loop.state.surface_motion.entry != 0:
            loop.w.kept["surface"].links.motion = loop.state.surface_motion.entry
        for name, entry in self.believed_entries().items():
            where = address_of_member(entry, f"belief.{name}", getattr(self.believed, MEMBERS[name]))
            if name == "surface":
                loop.state.surface.believed.entry = where
            else:
                loop.w.kept["believed"].links.motion = where
        if user_law is not None:
            user_law(compiled)

    def set_restitution(self, loop: Loop) -> None:
        """Write into a loop's memory the law and the coefficient of restitution of the impact at which it stands."""
        law, _, _ = self._struck(loop)
        loop.state.settings.impact_law = RATIOS[law.ratio_of]
        loop.constants.restitution = self.restitution_at(loop, -float(loop.w.impact.before[0]))

    def restitution_at(self, loop: Loop, speed: float) -> float:
        """Return the coefficient of restitution of the impact at which a loop stands, at a speed, m/s."""
        law, given, where = self._struck(loop)
        try:
            return coefficient_at(law, given, speed, where)
        except ScenarioError as error:
            t = float(loop.w.time)
            raise LawError(f"stopped at t = {t:.6g} s: {error}", t) from error.__cause__

    def _struck(self, loop: Loop) -> tuple[Any, float, str]:
        """Return the law of the impact at which a loop stands, what it is given, and the key that names it."""
        i = int(loop.state.striking)
        if not (loop.state.coupled and i > 0):
            return self.restitution, self.scenario.impact.restitution, "impact.law"
        contact = (self.scenario.contact or ())[i - 1]
        if contact.restitution_law == AS_IMPACT:
            return self.restitution, contact.restitution, "impact.law"
        return RESTITUTIONS[contact.restitution_law], contact.restitution, f"contact.{i - 1}.restitution_law"


def _contact_families(loop: Loop) -> list[Any]:
    """Return the surfaces, compliances and laws of friction of the links' contacts, those that there are."""
    kept = loop.w.kept["contacts"].links.kept
    return [kept[name] for name in ("surfaces", "compliances", "frictions") if name in kept]


def contact_members(loop: Loop) -> list[Called]:
    """Return what the links' contacts call by address, and what each is of."""
    if loop.state.contacts.at == 0:
        return []
    return [each for members in _contact_families(loop) for each in members.entries()]
