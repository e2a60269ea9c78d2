"""What rewards and endings are computed from: the state of all environments at a control instant."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from closedloop.base.arrays import Array, Mask
from closedloop.control.reference.table import Reference
from closedloop.loop.step.record_row import ContactRow, Row
from closedloop.mechanics.closure.contact_force import FREE, STUCK
from closedloop.simulation.together.records import Between

# A tip is held if it is slower than this, m/s, and further from where it is wanted than this, m.
SLOW, AWAY = 2e-3, 2e-3


class Now:
    """The state of N environments at a control instant, with n joints and k numbers of an action.

    Joint quantities are (N, n), vectors in space (N, 3) in the base frame, others (N,); SI units. All values are true
    ones except `measured`. The arrays are views: copy what you want to keep.

    Attributes
    ----------
    q, v, acceleration, torque : (N, n) arrays
    tip, tip_velocity, normal, slip_velocity, friction_force : (N, 3) arrays
    force, measured, gap, gap_rate : (N,) arrays
        Contact force; the force sensor's latest reading, as a control law has it; distance from the surface, m, and
        its rate.
    link_forces, link_gaps : (N, c) arrays
        Of each `[[contact]]`: the force along its normal, N, and its gap, m.
    wanted_tip, wanted_tip_velocity, wanted_q : (N, 3), (N, 3), (N, n) arrays
        Those of the reference, as the action has displaced it.
    wanted_force : (N,) array
        The force of the task, N, whatever the action sets.
    path_error : (N,) array
        Distance of the tip from the reference along the surface, m.
    contact, sticks : (N,) arrays of bool
    largest_force, smallest_force, largest_link_force, impulse : (N,) arrays
        Since the control instant before: of the contact force at any row, N; of the largest force of a `[[contact]]`,
        N; the largest impulse, N s.
    free_share, events : (N,) arrays
        Since then: share of rows off the surface; how many events there were.
    time, phase : (N,) arrays
        Since the reset, s; and as a share of the episode.
    left : (N,) array
        Control instants until the episode's end.
    touched : (N,) array of bool
        Whether it has been in contact since the reset.
    on_target : (N,) array
        Time for which the force has been within the task's tolerance, s.
    jammed : (N,) array
        Time for which a `[[contact]]` has been closed and the tip slower than 2 mm/s, although the desired position is
        more than 2 mm away, s.
    force_sum : (N,) array
        ∫ (wanted_force − measured) dt while in contact, N s.
    force_square : (N,) array
        ∫ (wanted_force − force)² dt since the reset, N² s.
    action, action_before : (N, k) arrays
        From −1 to 1.
    period : float
        Time between two control instants, s.
    """

    def __init__(
        self, rows: Array, wanted: Array, between: Array, n: int, numbers: int, period: float, contacts: int = 0,
        states: int = 0,
    ) -> None:  # fmt: skip
        count, end = rows.shape[0], rows.shape[1] - states
        of_contacts = rows[:, end - ContactRow.count(contacts) : end]
        self.link_forces, self.link_gaps = (
            of_contacts[:, ContactRow.place(x, contacts)] for x in ("link_forces", "link_gaps")
        )

        def part(name: str) -> Any:
            return rows[:, Row.place(name, n)]

        self.period = period
        self.q, self.v, self.acceleration, self.torque = map(part, ("q", "v", "acceleration", "torque"))
        self.tip, self.tip_velocity, self.normal = map(part, ("position", "velocity", "surface_normal"))
        self.slip_velocity, self.friction_force = map(part, ("slip_velocity", "friction_force"))
        self.force = part("contact_force")
        self.gap, self.gap_rate, self._mode = part("closure_error"), part("closure_rate"), part("mode")
        self.wanted_q, self.wanted_tip, self.wanted_tip_velocity = (
            wanted[:, Reference.place(x, n)] for x in ("q", "position", "velocity")
        )
        self.largest_force, self.smallest_force, self.largest_link_force, self._free, self.events, self.impulse = (
            between[:, Between.place(x)]
            for x in ("largest_force", "smallest_force", "largest_link_force", "free_rows", "events", "impulse")
        )
        self.measured, self.path_error = between[:, Between.place("measured")], between[:, Between.place("path_error")]
        self.wanted_force: Array = np.zeros(count)
        self.time: Array = np.zeros(count)
        self.phase: Array = np.zeros(count)
        self.left: Array = np.zeros(count)
        self.touched: Mask = np.zeros(count, dtype=np.bool_)
        self.on_target: Array = np.zeros(count)
        self.jammed: Array = np.zeros(count)
        self.force_sum: Array = np.zeros(count)
        self.force_square: Array = np.zeros(count)
        self.action: Array = np.zeros((count, numbers))
        self.action_before: Array = np.zeros((count, numbers))
        self.steps = 1
        self._known: dict[str, Any] = {}

    def changed(self) -> None:
        """Discard the values computed from the arrays, because the arrays were written."""
        self._known.clear()

    def _once(self, name: str, compute: Callable[[], Any]) -> Any:
        if name not in self._known:
            self._known[name] = compute()
        return self._known[name]

    @property
    def contact(self) -> Mask:
        """Whether the tip touches the surface."""
        return self._once("contact", lambda: self._mode != FREE)

    @property
    def sticks(self) -> Mask:
        """Whether it sticks to it."""
        return self._once("sticks", lambda: self._mode == STUCK)

    @property
    def free_share(self) -> Array:
        """Share of the rows since the control instant before at which the tip was off the surface."""
        return self._once("free_share", lambda: self._free / self.steps)

    @property
    def force_error(self) -> Array:
        """True force minus the desired one, N."""
        return self._once("force_error", lambda: self.force - self.wanted_force)

    @property
    def held(self) -> Mask:
        """Whether a contact of a link is closed, and the tip is slow and not at the desired position."""
        off, speed = self.tip - self.wanted_tip, self.tip_velocity
        slow = (speed * speed).sum(axis=1) < SLOW * SLOW
        touching = (self.link_forces > 0.0).any(axis=1)
        return slow & touching & ((off * off).sum(axis=1) > AWAY * AWAY)
