"""The numbers of a scenario, and what follows from them directly."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from closedloop.base.arrays import Array
from closedloop.control.reference.desired import Desired
from closedloop.control.sensor import PackedSensor
from closedloop.jit.parameters import per_joint
from closedloop.loop.step.record_row import row_width
from closedloop.mechanics.impact.restitution import RESTITUTIONS, Restitution
from closedloop.mechanics.integrators import Scheme
from closedloop.mechanics.robot.pinocchio import Robot
from closedloop.mechanics.surface.placed import PlacedSurface
from closedloop.mechanics.surface.plane import Plane
from closedloop.record.columns.derived import recorded_states
from closedloop.scenario.arm import acting_tendons
from closedloop.scenario.scenario import Scenario
from closedloop.scenario.time_sections import BaumgarteGains
from closedloop.simulation.engines.bind_contacts import ContactPlaces
from closedloop.simulation.engines.needs import arm_columns, calls_law
from closedloop.simulation.engines.packed import PackedLaw


@dataclass(frozen=True)
class ScenarioNumbers:
    """A scenario as numbers: everything that the loop needs, open to inspection before it runs.

    Attributes
    ----------
    robot, surface, integrator
        The arm with its tip, the surface, the scheme.
    frame : (3, 3) array
        Contact frame at t = 0: rows n, t1, t2 in base axes.
    q, v : (n,) arrays
        State at t = 0.
    mode : int
        Contact mode at t = 0, see `closedloop.mechanics.closure.contact_force`.
    steps, h : int, float
        Number of steps and the step, s.
    stabiliser : (2,) array
        s_v, 1/s, and s_p, 1/s².
    pd_start : float
        Instant from which the PD part of the law acts, s.
    law, compensation, friction, joint_friction, compliance : PackedLaw
        The law, its compensation of friction, friction, and the compliance of the surface, as numbers.
    sensor : PackedSensor
        The force sensor.
    table : (steps · nodes + 1, 2 n + 11) array
        The reference at every instant at which a stage is evaluated, see `closedloop.loop.step.reference_row`, and
        a standard normal number for the force sensor.
    nodes : int
        Rows of the table to a step.
    project : bool
        Whether the state is projected onto the closure after each step.
    hold : int
        Steps for which a sampled torque is held; 0: the law is evaluated at every stage.
    drives : (2, n) array
        Largest torque of each joint, and its largest change from sample to sample, N m; infinite where there is none.
    transmission : (3, n) array
        Stiffness, damping and motor inertia of elastic joints, see `closedloop.control.transmission`; zero: rigid.
    encoder : (k,) array
        The parameters of the encoders.
    wanted : Desired
        The reference at any instant.
    placed : ContactPlaces or None
        Where the contacts of [[contact]] are; None without any.
    tolerance : float or None
        Relative tolerance of an adaptive integrator; None: the step is fixed.
    """

    scenario: Scenario
    robot: Robot
    surface: PlacedSurface
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
    friction: PackedLaw
    joint_friction: PackedLaw
    compliance: PackedLaw
    sensor: PackedSensor
    table: Array
    nodes: int
    project: bool
    hold: int
    drives: Array
    transmission: Array
    encoder: Array
    wanted: Desired
    placed: ContactPlaces | None
    tolerance: float | None

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
    def general(self) -> bool:
        """Whether the law is called by address."""
        return calls_law(self.scenario, self.robot.model)

    @property
    def row_width(self) -> int:
        """Numbers in a recorded row."""
        contacts = len(self.scenario.contact or ())
        return row_width(self.robot.n, bool(arm_columns(self.scenario)), contacts, self.row_states)

    @property
    def row_states(self) -> int:
        """How many of them are states of the law and its compensation, the last."""
        return recorded_states(self.scenario, self.robot.n)

    @property
    def sizes(self) -> dict[str, int]:
        """How many numbers the parameters of each member are, in the order of `Constants`."""
        return {
            "law": self.law.numbers.size, "compensation": self.compensation.numbers.size,
            "friction": self.friction.numbers.size, "joint_friction": self.joint_friction.numbers.shape[1],
            "compliance": self.compliance.numbers.size, "tendons": len(self.tendons),
        }  # fmt: skip

    @property
    def tendons(self) -> Array:
        """What rubs along tendons of the robot, and their stops: rows of `robot_models.tendon.rough_tendons`."""
        return acting_tendons(self.scenario, self.robot.model)

    @property
    def restitution(self) -> type[Restitution]:
        """The law of restitution."""
        return RESTITUTIONS[self.scenario.impact.law]
