"""Evaluations of the equation of motion beside the state of a run at an instant.

An evaluation is one call of the loop's own kernel at a row: law, friction, contact and Eq. 24 are those of a run, and
nothing is written twice. White noise and quantisation, which have no derivative, are left out of it.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError, SimulationError
from closedloop.control.encoder import DIFFERENCE, NO_ENCODER, EncoderParameters
from closedloop.control.reference.table import Reference
from closedloop.control.sensor import SensorParameters
from closedloop.jit.background import make_ready
from closedloop.loop.step.record_row import complete_record
from closedloop.loop.step.turn import turn
from closedloop.mechanics.closure.contact_force import FREE
from closedloop.mechanics.loops.close import closed_to
from closedloop.mechanics.loops.memory import LoopMemory
from closedloop.mechanics.loops.reactions import loop_rows
from closedloop.mechanics.robot.pinocchio import Robot
from closedloop.simulation.engines.loop_start import read_encoders
from closedloop.simulation.engines.loops import PINOCCHIO, kernels_of, loop_for
from closedloop.simulation.engines.problem import Problem
from closedloop.simulation.loop_calls import Answers, single_calls
from closedloop.studies.analysis.closed_contacts import ClosedContacts
from closedloop.studies.analysis.instant import Instant, parts_of, put

# Rows that bind whose singular value is below this share of the largest depend on others.
DEPENDENT = 1e-9


class EventHere(Exception):
    """The contact changes its mode at the state that was evaluated, or the forces have no derivative there."""


@contextmanager
def without_event(time: float) -> Iterator[None]:
    """Say of an event at the state of an instant, s, that there is no linear loop.

    Raises
    ------
    SimulationError
        In place of `EventHere`.
    """
    try:
        yield
    except EventHere:
        raise SimulationError(
            f"linearise: at t = {time:g} s the contact is about to change, or friction to turn: there is no linear "
            "loop; take another instant",
            time,
        ) from None


@dataclass
class Here:
    """Evaluations at states beside that of an instant, without the stabiliser.

    So a tip that is off the surface, or moves off it, is one whose surface has been moved.
    """

    problem: Problem
    instant: Instant
    free: bool = False  # whether it may be in flight

    def __post_init__(self) -> None:
        problem = self.problem
        model = problem.robot.model
        self.problem = problem = replace(problem, robot=Robot(model, problem.robot.tip))
        self.row = round(self.instant.time / problem.h)
        self.loop = loop = problem.loop()
        self._loops: LoopMemory | None = loop.w.kept.get("loops")
        closing = [] if self._loops is None else [closed_to]
        make_ready(*kernels_of(PINOCCHIO), *problem.called(loop), complete_record, *closing)
        problem.connect(loop)
        self._rows = np.empty((self.row + 2, problem.row_width))
        self._answers = Answers(problem, loop)
        arrays = problem.table, problem.integrator.tableau(), self._rows
        _, self._call = single_calls(problem, loop_for(PINOCCHIO), loop, arrays, PINOCCHIO)
        self._passes = problem.robot.passes
        self._posture, self._turned = problem.robot.configuration(loop.w.q)
        self._balls = problem.robot.model.balls
        state, w, constants = loop.state, loop.w, loop.constants
        n = problem.robot.n
        put(self.instant, problem, loop)
        state.settings.project = 0
        state.settings.semi_implicit = 0  # so that friction's states have rates
        sensor: Any = SensorParameters(constants.sensor, 0)
        sensor.noise = sensor.quantisation = 0.0
        if problem.encoder.size:
            encoder = EncoderParameters(constants.encoder, n)
            for name in ("noise", "quantisation", "velocity_noise"):
                getattr(encoder, name)[:] = 0.0
        for key, lag in (("friction", constants.lag), ("joint_friction", np.max(constants.joint_lag))):
            if lag > 0.0:
                kind = getattr(problem.scenario, key).kind
                raise ScenarioError(
                    f"linearise: {key}.kind = {kind!r} depends on the slip {lag:g} s earlier, which is not linearised; "
                    "take another law"
                )
        constants.s_v = constants.s_p = 0.0
        self.contacts = ClosedContacts(problem, loop) if self.instant.contacts else None
        touches = self.free or self.contacts is not None
        if not problem.scenario.has_surface and not touches:
            raise ScenarioError(
                "linearise: the scenario has no [surface], and no contact of a link is closed at "
                f"t = {self.instant.time:g} s: without a contact there is no force loop"
            )
        if self.instant.mode == FREE and not touches:
            raise SimulationError(
                f"linearise: the tip is in flight at t = {self.instant.time:g} s, where there is no force loop; take "
                "an instant at which it presses",
                self.instant.time,
            )
        self._encoder = int(state.settings.encoder)
        self._motors = parts_of(problem)["transmission"]
        self._saved = state.memory.copy(), w.memory.copy(), constants.memory.copy()
        self._sensor, self._z = sensor, type(w).place("z", *w.sizes)
        node = self.row * problem.nodes
        self._force_nodes = problem.table[node : node + problem.nodes + 1, Reference.place("force", n)]
        self._asked = self._force_nodes.copy()
        sizes = {
            "qdd": n, "dz": w.z.size, "f": 1, "reading": 1, "torque": n, "r": 3, "u": w.tip.u.size, "gap": 1,
            "last": 2 * n, **({} if self.contacts is None else self.contacts.sizes),
        }  # fmt: skip
        ends = np.cumsum(list(sizes.values())).tolist()
        self.places = {name: slice(end - size, end) for (name, size), end in zip(sizes.items(), ends, strict=True)}
        self._width = ends[-1]

    @property
    def n(self) -> int:
        """Joints."""
        return self.problem.robot.n

    @property
    def differences(self) -> bool:
        """Whether the controller's velocities are differences of readings."""
        return self._encoder == DIFFERENCE

    def __call__(self, held: bool = False, **changes: Any) -> dict[str, Array]:
        """Evaluate once, with changes to the state and the inputs, and return what follows, by name; see `flat`."""
        found = self.flat(held, **changes)
        return {name: found[where] for name, where in self.places.items()}

    def flat(self, held: bool = False, **changes: Any) -> Array:
        """Evaluate once, with changes to the state and the inputs, and return what follows in one row, see `places`.

        Parameters
        ----------
        held : bool
            Whether the torque is what it was, instead of the law's.
        changes : arrays
            q, v, z, last: added to the state; measured, force (f_des), bias (of the sensor), (1,), N; link: torque on
            the links (n,), N m; torque: added to what is held (n,); compliance: added to its parameters.

        Raises
        ------
        EventHere
            If the contact would change its mode.
        """
        loop, problem, n = self.loop, self.problem, self.n
        state, w, constants = loop.state, loop.w, loop.constants
        state.memory[:], w.memory[:], constants.memory[:] = self._saved
        if self.contacts is not None:
            self.contacts.put_back()
        if "z" in changes:
            w.z += changes["z"]
        if "torque" in changes:
            w.torque += changes["torque"]
        if "measured" in changes:
            w.sensing.measured += changes["measured"][0]
        if "last" in changes:
            w.encoders.last_q += changes["last"][:n]
            w.encoders.last_v += changes["last"][n:]
        if "bias" in changes:
            self._sensor.bias += changes["bias"][0]
        if "compliance" in changes:
            constants.compliance += changes["compliance"]
        nodes, asked = self._force_nodes, "force" in changes
        if asked:
            nodes += changes["force"]
        encoders = self._encoder != NO_ENCODER
        if encoders:
            w.q[:], w.v[:] = w.encoders.true_q, w.encoders.true_v
        if "q" in changes:
            self.move(w.q, changes["q"])
        if "v" in changes:
            w.v += changes["v"]
        self._close(w.q, w.v)
        if encoders:
            read_encoders(loop, problem.table)
        crba, bias, convention, pinocchio, data = self._passes
        try:
            for _ in range(2 if encoders else 1):
                if self._turned is not None:
                    self._turned()
                crba(pinocchio, data, self._posture, convention)
                bias(pinocchio, data, self._posture, w.v)
                if "link" in changes:
                    problem.robot.views[1][:] -= changes["link"]
                state.sampled = 0 if held else 1
                self._call(self._answers.events)
        finally:
            if asked:
                nodes[:] = self._asked
        if state.row != self.row + 1 and not (state.row == problem.steps and self.row == state.row):
            raise EventHere
        found, places, general = np.empty(self._width), self.places, state.settings.general != 0
        dz, motors = found[places["dz"]], self._motors
        dz[:] = w.dz if general else 0.0
        if motors.stop > motors.start:  # what the semi-implicit scheme writes there is its own
            dz[motors][:n] = (self._saved[1][self._z] + changes.get("z", 0.0))[motors][n:]
        found[places["qdd"]], found[places["torque"]], found[places["r"]] = w.qdd, w.torque, w.r
        f = found[places["f"]] = w.tip.F[0]
        found[places["reading"]] = w.sensing.reading if general else f
        found[places["u"]], found[places["gap"]] = w.tip.u, w.tip.gap
        last = found[places["last"]]
        last[:n], last[n:] = w.encoders.last_q, w.encoders.last_v
        if self.contacts is not None:
            seen = self.contacts.read()
            if seen is None:
                raise EventHere
            found[places["rates"]], found[places["presses"]] = seen
        return found

    def move(self, q: Array, by: Array) -> None:
        """Move q (n,) by so much; a joint that turns freely turns by it in the axes of its link."""
        before = q.copy()
        q += by
        for j in self._balls:
            turn(q, j, before, j, *by[j : j + 3])

    def _close(self, q: Array, v: Array) -> None:
        """Move q and q̇ to the nearest state that the loops allow."""
        if self._loops is not None:
            closed_to(self._loops.address, q, v)

    def loop_rows(self, q: Array) -> tuple[Array, Array]:
        """Return the rows G (m, n) of the loops at q, and their rate (m,) with q̇ of the instant."""
        if not self.problem.robot.model.loops:
            return np.zeros((0, self.n)), np.zeros(0)
        v = self.instant.values["v"]
        G = loop_rows(self.problem.robot, q[None], v[None])[0][0]
        return G, G @ v

    def geometry(self) -> tuple[Array, Array, Array, Array]:
        """Return H (n, n), the contact frame's Jacobian A (3, n), the frame (3, 3) and S (3, 3) at the instant."""
        self()
        w = self.loop.w
        H = np.triu(self.problem.robot.terms(self.instant.values["q"], self.instant.values["v"]).mass_matrix)
        H = H + np.triu(H, 1).T
        return H, np.array(w.tip.A), np.array(w.tip.frame), np.array(w.tip.S)

    def moved(self, depth: float) -> Instant:
        """Return the instant with the tip moved along the normal until it is so deep, m, in a soft surface.

        Nothing but geometry is asked: where the tip was, this surface may not carry it.
        """
        instant, problem = self.instant, self.problem
        q, v = instant.values["q"].copy(), instant.values["v"].copy()
        for _ in range(20):
            terms = problem.robot.terms(q, v)
            touching = problem.surface.touching(terms.position, t=instant.time)
            off = touching.gap + depth
            if abs(off) <= 1e-13 + 1e-12 * depth:
                break
            H, loops = np.triu(terms.mass_matrix), self.loop_rows(q)[0]
            H = H + np.triu(H, 1).T
            bound = np.vstack([touching.frame[:1] @ terms.jacobian, independent(loops) @ loops])
            answer = np.linalg.solve(H, bound.T)
            self.move(q, -answer @ np.linalg.inv(bound @ answer)[:, 0] * off)
            self._close(q, v)
        return replace(instant, values=instant.values | {"q": q, "v": v})


def independent(rows: Array) -> Array:
    """Return combinations (k, m) of rows (m, n) that are independent and span all of them."""
    if rows.size == 0:
        return np.zeros((0, rows.shape[0]))
    left, sizes, _ = np.linalg.svd(rows, full_matrices=False)
    return np.asarray(left[:, sizes > DEPENDENT * sizes[0]].T)
