"""A scenario turned into numbers: everything that the loop needs, to be looked at before it runs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from closedloop.closure.contact_force import FREE, STUCK
from closedloop.control.pack import PackedLaw
from closedloop.control.sections import SensorSection
from closedloop.control.sensor import PackedSensor, start_sensor
from closedloop.events.phases import ARRIVING, CLOSING
from closedloop.friction.laws import rest_states
from closedloop.friction.layout import KINETIC, LAST, SEVEN_PARAMETER, STATIC_EXCESS, STICKS, state_count
from closedloop.impact import LAWS
from closedloop.integrators import Integrator
from closedloop.jit.kernel import plain
from closedloop.reference.desired import Desired
from closedloop.robot.pinocchio import Robot
from closedloop.scenario.scenario import BaumgarteGains, Scenario
from closedloop.step import memory as space
from closedloop.step.evaluate import LAW_GIVEN
from closedloop.surface.plane import Plane

Array = NDArray[np.float64]

# Slip slower than this, m/s, is none: a tip that starts with it sticks, one that slows down to it may.
STICK_SPEED = 1e-7


STICKING = {"rigid": space.RIGID_STICK, "elastic": space.ELASTIC_STICK, "spring": space.SPRING_STICK}


@dataclass(frozen=True)
class Problem:
    """A scenario turned into numbers: everything that the loop needs, to be looked at before it runs.

    Attributes
    ----------
    robot, plane, integrator
        The arm with its tip, the surface, the scheme.
    frame : (3, 3) array
        Contact frame: rows n, t1, t2 in base axes.
    q, v : (n,) arrays
        State at t = 0.
    mode : int
        What the tip does at t = 0, see `closedloop.closure.contact_force`.
    steps, h : int, float
        Number of steps and the step, s.
    stabiliser : (2,) array
        s_v, 1/s, and s_p, 1/s².
    pd_start : float
        Instant from which the PD part of the law acts, s.
    law, sensor : PackedLaw, PackedSensor
        The law with its compensation and the force sensor as numbers, see `closedloop.control.pack`.
    friction, joint_friction : (int, array)
        Number and parameters of the laws of friction, see `closedloop.friction.packing`.
    table : (steps · nodes + 1, 2 n + 11) array
        What is desired at every instant at which a stage is evaluated, see `closedloop.step.evaluate.reference_row`,
        and a standard normal number for the force sensor.
    nodes : int
        Rows of the table to a step.
    project : bool
        Whether the state is put back on the closure after each step.
    hold : int
        Steps for which a sampled torque is held; 0: the law is evaluated at every stage.
    wanted : Desired
        What is desired, at any instant.
    tolerance : float or None
        Relative error that an adaptive integrator allows itself in a step; None: the step is fixed.
    """

    scenario: Scenario
    robot: Robot
    plane: Plane
    frame: Array
    integrator: Integrator
    q: Array
    v: Array
    mode: int
    steps: int
    h: float
    stabiliser: Array
    pd_start: float
    law: PackedLaw
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
        """T of Baumgarte's stabiliser, s, as given or as "auto" means it; None without that stabiliser."""
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
        """K_p and K_d of every joint, (2, n), see `closedloop.control.paper_law`."""
        return self.law.gains

    @property
    def settings(self) -> Array:
        """f_des at the start, N, and the instant from which the PD part acts, s."""
        return np.array([self.table[0, 2 * self.robot.n + 9], self.pd_start])

    @property
    def more(self) -> bool:
        """Whether the loop needs more than the paper's law on a smooth surface."""
        return needs_more(self.scenario)

    def constants(self) -> Array:
        """Return the loop's constants, see `closedloop.step.memory`."""
        n, robot, impact = self.robot.n, self.robot, self.scenario.impact
        k = np.zeros(space.JOINTS + 5 * n + space.LAW_WIDTH + n * space.FRICTION_WIDTH)
        k[space.H_STEP], k[space.NODE], k[space.OFFSET_D] = self.h, self.h / self.nodes, self.plane.offset
        k[space.S_V], k[space.S_P] = self.stabiliser
        k[space.FRAME : space.FRAME + 9] = self.frame.ravel()
        k[space.TIP : space.TIP + 3], k[space.GRAVITY : space.GRAVITY + 3] = robot.tip_offset, robot.gravity
        k[space.RESTITUTION], k[space.REST_SPEED] = impact.restitution, impact.rest_speed
        k[space.IMPACT_FRICTION], k[space.STICK_SPEED] = self.friction[1][KINETIC], STICK_SPEED
        k[space.PD_AT], k[space.REACH] = self.pd_start, robot.reach**2
        k[space.SENSOR_AT : space.SENSOR_AT + 4] = self.sensor.par
        k[space.FRICTION_AT : space.FRICTION_AT + space.FRICTION_WIDTH] = self.friction[1]
        k[space.JOINTS : space.JOINTS + n] = robot.support
        k[space.JOINTS + n : space.JOINTS + 3 * n] = self.law.gains.ravel()
        at = space.JOINTS + 3 * n
        k[at : at + space.LAW_WIDTH + 2 * n] = self.law.par
        k[at + space.LAW_WIDTH + 2 * n :] = self.joint_friction[1].ravel()
        return k

    def state(self, law_given: bool = False) -> NDArray[np.int64]:
        """Return the loop's whole numbers at t = 0; `law_given` if the torque comes from outside."""
        state = np.zeros(space.WHOLES, dtype=np.int64)
        state[space.STAGES], state[space.STEPS], state[space.HOLD] = self.integrator.stages, self.steps, self.hold
        state[space.LAW] = LAW_GIVEN if law_given else self.law.kind
        state[space.LAW_STATES] = 0 if law_given else self.law.states
        state[space.PER_STEP] = self.nodes
        state[space.PROJECT], state[space.SEMI_IMPLICIT] = self.project, self.integrator.semi_implicit
        state[space.UNILATERAL] = self.scenario.surface.contact == "unilateral"
        state[space.IMPACT_LAW] = LAWS[self.scenario.impact.law]
        kind, joints = self.friction[0], self.joint_friction[0]
        state[space.FRICTION], state[space.FRICTION_STATES] = kind, plain(state_count)(kind, 2)
        state[space.STICKING] = STICKING[STICKS[kind]] if kind else space.SMOOTH
        state[space.JOINT_FRICTION], state[space.JOINT_STATES] = joints, plain(state_count)(joints, 1)
        state[space.SENSOR_STATES], state[space.SENSOR_RING] = self.sensor.states, self.sensor.ring
        state[space.SENSOR_SAMPLED] = self.sensor.sampled
        state[space.MODE], state[space.SAMPLED], state[space.RISEN] = self.mode, 1, 1
        if self.project and self.mode != FREE:
            state[space.PHASE], state[space.NEXT] = CLOSING, ARRIVING
        return state

    def views(self, memory: Array, state: NDArray[np.int64]) -> space.Work:
        """Return the named parts of the loop's memory."""
        n = self.robot.n
        counts = state[[space.LAW_STATES, space.SENSOR_STATES, space.FRICTION_STATES]].sum()
        extra = int(counts + n * state[space.JOINT_STATES])
        return space.workspace(memory, n, extra, self.integrator.stages, self.sensor.ring)

    def memory(self, law_given: bool = False) -> Array:
        """Return the loop's memory at t = 0, with the start in it."""
        n, state = self.robot.n, self.state(law_given)
        law, sensor, friction = state[[space.LAW_STATES, space.SENSOR_STATES, space.FRICTION_STATES]].tolist()
        extra = law + sensor + friction + n * int(state[space.JOINT_STATES])
        memory = np.zeros(space.memory_size(n, extra, self.integrator.stages, self.sensor.ring))
        w = self.views(memory, state)
        w.q[:], w.v[:] = self.q, self.v
        terms = self.robot.terms(self.q, self.v)
        u = self.frame @ terms.jacobian @ self.v
        w.anchor[:] = (self.frame @ terms.position)[1:]
        slip = float(np.hypot(u[1], u[2]))
        if slip > 0.0:
            w.direction[:] = u[1:] / slip
        felt = float(self.table[0, 2 * n + 9]) if self.mode != FREE else 0.0  # the sensor has felt what is wanted
        start_sensor(felt, self.sensor.par, w.z[law : law + sensor], w.ring)
        w.now[space.MEASURED], w.now[space.LAST_EVENT] = w.ring[0], -np.inf
        if friction and self.mode == STUCK:
            rest_states(self.friction[0], self.friction[1].copy(), w.z[law + sensor : law + sensor + friction])
        if self.joint_friction[0] == SEVEN_PARAMETER:
            for j in range(n):
                at = law + sensor + friction + j * int(state[space.JOINT_STATES])
                w.stuck[j] = float(self.v[j] == 0.0)
                w.z[at + LAST] = self.joint_friction[1][j, STATIC_EXCESS]
        return memory


def needs_more(scenario: Scenario) -> bool:
    """Whether a scenario needs more than the paper's law on a smooth surface, see `closedloop.step.evaluate`."""
    return (
        scenario.law.kind != "paper"
        or scenario.law.force_feedback > 0.0
        or scenario.law.force_integral > 0.0
        or scenario.compensation.kind != "none"
        or scenario.friction.kind != "none"
        or scenario.joint_friction.kind != "none"
        or scenario.sensor != SensorSection()
    )
