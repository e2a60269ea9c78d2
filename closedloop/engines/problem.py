"""A scenario as numbers: everything that the loop needs, open to inspection before it runs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from closedloop.closure.contact_force import FREE, STUCK
from closedloop.control.compensation.none import NoCompensation
from closedloop.control.law import Compensation, ControlLaw
from closedloop.control.sensor import PackedSensor, SensorSection, start_sensor
from closedloop.events.phases import PROJECTION, STEP_END
from closedloop.friction.laws import rest_states
from closedloop.friction.layout import KINETIC, LAST, SEVEN_PARAMETER, STATIC_EXCESS, STICKS, state_count
from closedloop.impact import LAWS
from closedloop.integrators import Scheme
from closedloop.jit.calls import entry_address
from closedloop.jit.interpreted import twin_address
from closedloop.jit.kernel import plain
from closedloop.parameters import pack, per_joint, state_block
from closedloop.reference.desired import Desired
from closedloop.robot.pinocchio import Robot
from closedloop.scenario.scenario import BaumgarteGains, Scenario
from closedloop.step.entries import law_entry
from closedloop.step.memory import (
    ELASTIC_STICK,
    RIGID_STICK,
    SMOOTH,
    SPRING_STICK,
    Constants,
    Loop,
    State,
    Work,
    make_loop,
)
from closedloop.surface.plane import Plane

Array = NDArray[np.float64]

# Slip slower than this, m/s, is none: a tip that starts with it sticks, one that slows down to it may.
STICK_SPEED = 1e-7


STICKING = {"rigid": RIGID_STICK, "elastic": ELASTIC_STICK, "spring": SPRING_STICK}


class PackedLaw(NamedTuple):
    """A control law, or a compensation of friction, as the loop reads it.

    Attributes
    ----------
    member : type
        Its class.
    numbers : array
        Its parameters, see `closedloop.parameters.parameter_block`.
    states : int
        How many states it has.
    """

    member: type[ControlLaw] | type[Compensation]
    numbers: Array
    states: int


def pack_law(section: ControlLaw | Compensation, n: int, joint_names: Sequence[str] = ()) -> PackedLaw:
    """Turn a law or a compensation into numbers for n joints.

    Raises
    ------
    ScenarioError
        If a list has not one entry a joint.
    """
    where = "law" if isinstance(section, ControlLaw) else "compensation"
    return PackedLaw(type(section), pack(section, n, where, joint_names), state_block(type(section)).count(n))


@dataclass(frozen=True)
class Problem:
    """A scenario as numbers: everything that the loop needs, open to inspection before it runs.

    Attributes
    ----------
    robot, plane, integrator
        The arm with its tip, the surface, the scheme.
    frame : (3, 3) array
        Contact frame: rows n, t1, t2 in base axes.
    q, v : (n,) arrays
        State at t = 0.
    mode : int
        Contact mode at t = 0, see `closedloop.closure.contact_force`.
    steps, h : int, float
        Number of steps and the step, s.
    stabiliser : (2,) array
        s_v, 1/s, and s_p, 1/s².
    pd_start : float
        Instant from which the PD part of the law acts, s.
    law, compensation, sensor : PackedLaw, PackedLaw, PackedSensor
        The law, its compensation of friction and the force sensor as numbers.
    friction, joint_friction : (int, array)
        Number and parameters of the laws of friction, see `closedloop.friction.packing`.
    table : (steps · nodes + 1, 2 n + 11) array
        The reference at every instant at which a stage is evaluated, see `closedloop.step.evaluate.reference_row`, and
        a standard normal number for the force sensor.
    nodes : int
        Rows of the table to a step.
    project : bool
        Whether the state is projected onto the closure after each step.
    hold : int
        Steps for which a sampled torque is held; 0: the law is evaluated at every stage.
    wanted : Desired
        The reference at any instant.
    tolerance : float or None
        Relative tolerance of an adaptive integrator; None: the step is fixed.
    """

    scenario: Scenario
    robot: Robot
    plane: Plane
    frame: Array
    integrator: type[Scheme]
    q: Array
    v: Array
    mode: int
    steps: int
    h: float
    stabiliser: Array
    pd_start: float
    law: PackedLaw
    compensation: PackedLaw
    friction: tuple[int, Array]
    joint_friction: tuple[int, Array]
    sensor: PackedSensor
    table: Array
    nodes: int
    project: bool
    hold: int
    wanted: Desired
    tolerance: float | None

    @property
    def time_constant(self) -> float | None:
        """T of Baumgarte's stabiliser, s, as given or as chosen by "auto"; None without that stabiliser."""
        section = self.scenario.stabiliser
        if not isinstance(section, BaumgarteGains):
            return None
        return float(self.stabiliser[1] ** -0.5) if section.time_constant == "auto" else section.time_constant

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
    def general(self) -> bool:
        """Whether the general form of the loop is needed."""
        return needs_general_form(self.scenario)

    def loop(self, user_law: bool = False) -> Loop:
        """Return the loop's memory at t = 0.

        Parameters
        ----------
        own_law : bool
            Whether a user's law replaces the scenario's law and compensation.

        The addresses of the functions that it calls are set by `connect`, or by `closedloop.engines.user_law.UserLaw`.
        """
        n, law, compensation = self.robot.n, self.law, self.compensation
        own, both = (0, 0) if user_law else (law.states, law.states + compensation.states)
        surface, joints = plain(state_count)(self.friction[0], 2), plain(state_count)(self.joint_friction[0], 1)
        extra = both + self.sensor.states + surface + n * joints
        sizes = {"law": law.numbers.size, "compensation": compensation.numbers.size, "extra": extra}
        loop = make_loop(n, **sizes, stages=self.integrator.stages, ring=self.sensor.ring)
        state = loop.state
        state.own_law_states, state.law_states = own, both
        state.friction_states, state.joint_states, state.sensor_states = surface, joints, self.sensor.states
        self._set_state(state)
        self._set_constants(loop.constants)
        self._set_start(state, loop.w)
        return loop

    def entries(self) -> list[Any]:
        """Return the functions that the loop calls by address: the entries of the law and of its compensation."""
        if not self.general:
            return []
        members = [self.law.member, self.compensation.member]
        return [law_entry(member) for member in members if member is not NoCompensation]

    def connect(self, loop: Loop, compiled: bool = True) -> None:
        """Write the addresses of `entries` into a loop's memory: of machine code, or for an interpreted loop."""
        found = [entry_address(each) if compiled else twin_address(each) for each in self.entries()]
        loop.state.law, loop.state.compensation, *_ = (*found, 0, 0)

    def _set_constants(self, constants: Constants) -> None:
        robot, impact = self.robot, self.scenario.impact
        constants.h, constants.node, constants.offset = self.h, self.h / self.nodes, self.plane.offset
        constants.s_v, constants.s_p = self.stabiliser
        constants.frame[:] = self.frame
        constants.tip[:], constants.gravity[:], constants.reach = robot.tip_offset, robot.gravity, robot.reach**2
        constants.restitution, constants.rest_speed = impact.restitution, impact.rest_speed
        constants.impact_friction, constants.stick_speed = self.friction[1][KINETIC], STICK_SPEED
        constants.sensor[:], constants.friction[:] = self.sensor.par.memory, self.friction[1]
        constants.support[:], constants.joint_friction[:] = robot.support, self.joint_friction[1]
        constants.law[:], constants.compensation[:] = self.law.numbers, self.compensation.numbers

    def _set_state(self, state: State) -> None:
        state.steps, state.hold, state.nodes_per_step = self.steps, self.hold, self.nodes
        state.project, state.semi_implicit = self.project, self.integrator.semi_implicit
        state.unilateral = self.scenario.surface.contact == "unilateral"
        state.impact_law = LAWS[self.scenario.impact.law]
        kind = self.friction[0]
        state.friction, state.joint_friction = kind, self.joint_friction[0]
        state.sticking = STICKING[STICKS[kind]] if kind else SMOOTH
        state.sensor_sampled = self.sensor.sampled
        state.mode, state.sampled, state.risen = self.mode, 1, 1
        if self.project and self.mode != FREE:
            state.phase, state.next_phase = PROJECTION, STEP_END

    def _set_start(self, state: State, w: Work) -> None:
        n = self.robot.n
        w.q[:], w.v[:] = self.q, self.v
        terms = self.robot.terms(self.q, self.v)
        u = self.frame @ terms.jacobian @ self.v
        w.anchor[:] = (self.frame @ terms.position)[1:]
        slip = float(np.hypot(u[1], u[2]))
        if slip > 0.0:
            w.direction[:] = u[1:] / slip
        felt = float(self.table[0, 2 * n + 9]) if self.mode != FREE else 0.0  # the sensor's history is f_des
        sensor = int(state.law_states)
        friction = sensor + int(state.sensor_states)
        joints = friction + int(state.friction_states)
        start_sensor(felt, self.sensor.par, w.z[sensor:friction], w.ring)
        w.measured, w.last_event = w.ring[0], -np.inf
        if joints > friction and self.mode == STUCK:
            plain(rest_states)(self.friction[0], self.friction[1].copy(), w.z[friction:joints])
        if self.joint_friction[0] == SEVEN_PARAMETER:
            for j in range(n):
                w.stuck[j] = float(self.v[j] == 0.0)
                w.z[joints + j * state.joint_states + LAST] = self.joint_friction[1][j, STATIC_EXCESS]


def needs_general_form(scenario: Scenario) -> bool:
    """Whether a scenario needs the general form of the loop, see `closedloop.step.evaluate`."""
    return (
        scenario.law.kind != "paper"
        or scenario.law.force_feedback > 0.0
        or scenario.law.force_integral > 0.0
        or scenario.compensation.kind != "none"
        or scenario.friction.kind != "none"
        or scenario.joint_friction.kind != "none"
        or scenario.sensor != SensorSection()
    )
