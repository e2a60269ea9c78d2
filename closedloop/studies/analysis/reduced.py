"""Derivatives at an instant, by central differences of the run's kernels, reduced to what binds leaves free.

Coordinates: with G the rows that bind (n, with a tip that sticks t1 and t2, and those of loop joints) and
P = H⁻¹Gᵀ(G H⁻¹Gᵀ)⁻¹

    δq = N y + P e,    δq̇ = N w + P ė        G N = 0, NᵀH N = 1

so y, w are the motion along the surface and in the null space, in √(kg m²), and e is the deformation of a soft surface.
On a rigid one e is what the surface is moved by, and no state of the loop.

The coordinates are laid out as y, e | w, ė | z | s, ṡ: of e those rows that bind but give way, s the displacement of
the surface.
"""

from contextlib import suppress

import numpy as np
from scipy.linalg import null_space

from closedloop.base.arrays import Array
from closedloop.base.errors import SimulationError
from closedloop.control.drives import AS_ASKED
from closedloop.loop.step.memory import RIGID_STICK
from closedloop.mechanics.closure.contact_force import FREE, STUCK
from closedloop.mechanics.surface.compliances.none import Rigid
from closedloop.simulation.engines.problem import Problem
from closedloop.studies.analysis.here import EventHere, Here, Instant, independent, parts_of

# Two steps whose differences are further apart than this share, at the best, show a function that has no derivative: of
# those that have one they are nearer than a millionth. A first step whose differences are so near is short enough.
KINK, NEAR = 1e-2, 1e-6
# The most steps that are tried.
MOST = 7


def columns(here: Here, name: str, steps: Array, held: bool) -> dict[str, Array]:
    """Return the derivatives of all that `Here` evaluates by the numbers of a change, matrices (rows, k).

    Central differences at a step and at half of it cancel the error of second order (Richardson's extrapolation). Where
    the two are far apart, as over a change of the contact's mode, the step of that number is a tenth of it; the best of
    `MOST` steps is taken.

    `here`, `name`, `held`: where, the change, and whether the torque is held; see `Here.flat`.
    `steps` (k,): the first step of each number.
    Raises EventHere if no step stays clear of a change of mode, or there is no derivative.
    """
    value, k = here.flat(held), steps.size
    best, least = np.empty((k, value.size)), np.full(k, np.inf)
    change, step, left = np.zeros(k), steps.astype(float), np.arange(k)

    def at(j: int, amount: float) -> Array:
        change[j] = amount
        try:
            return here.flat(held, **{name: change})
        finally:
            change[j] = 0.0

    for _ in range(MOST):
        ends, tried = [], []
        for j in left.tolist():
            with suppress(EventHere):
                ends.append([at(j, share * step[j]) for share in (1.0, -1.0, 0.5, -0.5)])
                tried.append(j)
        if tried:
            four, size = np.array(ends), step[tried][:, None]
            wide, near = (four[:, 0] - four[:, 1]) / (2.0 * size), (four[:, 2] - four[:, 3]) / size
            apart = _apart(here, value, wide, near, size)
            for i in np.flatnonzero(apart < least[tried]):
                best[tried[i]], least[tried[i]] = (4.0 * near[i] - wide[i]) / 3.0, apart[i]
        left = left[least[left] >= NEAR]
        if not left.size:
            break
        step[left] *= 0.1
    if np.any(least > KINK):
        raise EventHere
    return {key: best[:, where].T for key, where in here.places.items()}


def _apart(here: Here, value: Array, wide: Array, near: Array, step: Array) -> Array:
    """Return how far two differences (k, ...) are apart, (k,): the most of all that is evaluated, each by its size.

    `value`: what is evaluated without a change: its size decides what is rounding.
    `wide`, `near`, (k, ...) arrays: the differences.
    `step` (k, 1): the step of the wide ones.
    """
    firsts = [where.start for where in here.places.values() if where.stop > where.start]

    def largest(x: Array) -> Array:
        return np.asarray(np.maximum.reduceat(np.abs(x), firsts, axis=-1))

    rounding = 1e-12 * (largest(value) + 1e-3) / step
    return np.max(largest(near - wide) / (largest(near) + rounding / 1e-7 + 1e-300), axis=1)


Block = dict[str, dict[str, Array]]

# First steps of the differences: of positions, rad (m), velocities, forces, N, and torques, N m; Richardson's
# extrapolation leaves their fourth power, rounding is an ε over them.
STEP_Q, STEP_V, STEP_FORCE, STEP_TORQUE = 1e-4, 1e-3, 1e-2, 1e-2


class Reduced:
    """The derivatives at an instant, by the coordinates that the closure leaves free, and by the inputs.

    `free`: whether it may be in flight.
    """

    def __init__(self, problem: Problem, instant: Instant, free: bool) -> None:
        self.problem, self.instant, self.n = problem, instant, problem.robot.n
        self.here = here = Here(problem, instant, free)
        here.held = here()["torque"]  # which acts from this row on: before it that of the last sample did
        _refuse_limited(here)
        self.state, self.decays = here.loop.state, np.array(here.loop.w.decays.rate)
        self.soft = problem.compliance.member is not Rigid and instant.mode != FREE
        self.rigid = problem.compliance.member is Rigid and instant.mode != FREE
        self.sampled = problem.hold > 0
        self.parts = parts_of(problem)
        self._coordinates()
        self._differentiate()

    def _coordinates(self) -> None:
        """Lay out the coordinates, and write δq, δq̇ and δz by them."""
        n, k = self.n, self.parts["transmission"].stop
        H, A, self.frame, _ = self.here.geometry()
        sticks = self.instant.mode == STUCK and self.state.friction.sticking == RIGID_STICK
        contact = A if sticks else A[:1]
        if self.instant.mode == FREE and self.here.contacts is not None:
            contact = A[:0]  # what keeps the links bound is elsewhere
        self.rows = contact.shape[0]
        others = [self.here.loop_rows(self.instant.values["q"])[0]]
        if self.here.contacts is not None:
            others.append(self.here.contacts.rows())
        self.spans = independent(np.vstack(others))
        self.H, self.along, self.G = H, A[0], np.vstack([contact, self.spans @ np.vstack(others)])
        if independent(self.G).shape[0] < self.G.shape[0]:
            raise SimulationError(
                "linearise: the tip's contact binds what other contacts or loops bind already at "
                f"t = {self.instant.time:g} s, so that f is not unique; take another instant",
                self.instant.time,
            )
        m = self.G.shape[0]
        answer = np.linalg.solve(H, self.G.T)
        self.P = answer @ np.linalg.inv(self.G @ answer)
        basis = null_space(self.G) if m else np.eye(n)
        self.N = basis @ np.linalg.inv(np.linalg.cholesky(basis.T @ H @ basis)).T if basis.size else basis
        self.bound = slice(1 if self.soft else self.rows if self.instant.mode == FREE else 0, m)  # do not give way
        self.free, self.kept = n - m, self.bound.start
        self.half = self.free + self.kept
        self.z0, self.s0 = 2 * self.half, 2 * self.half + k
        self.size = self.s0 + 2
        self.by_q, self.by_v, self.by_z = (np.zeros((rows, self.size)) for rows in (n, n, k))
        for part, start in ((self.by_q, 0), (self.by_v, self.half)):
            part[:, start : start + self.free] = self.N
            part[:, start + self.free : start + self.half] = self.P[:, : self.kept]
        if self.rigid:  # on the closure of a surface that moves: e = s, ė = ṡ
            self.by_q[:, self.s0], self.by_v[:, self.s0 + 1] = self.P[:, 0], self.P[:, 0]
        self.by_z[:, self.z0 : self.s0] = np.eye(k)

    def _differentiate(self) -> None:
        """Take the derivatives by the state and the inputs, with the law's torque and with a held one."""
        n, here = self.n, self.here
        sizes: dict[str, Array] = {
            "q": np.full(n, STEP_Q), "v": np.full(n, STEP_V), "z": 1e-2 * np.maximum(np.abs(here.loop.w.z), 1e-2),
            "measured": np.array([STEP_FORCE]), "force": np.array([STEP_FORCE]), "bias": np.array([STEP_FORCE]),
        }  # fmt: skip
        if here.differences:
            sizes["last"] = np.full(2 * n, STEP_Q)
        self.law = {name: columns(here, name, steps, False) for name, steps in sizes.items()}
        self.plant = self.law
        if self.sampled:
            self.plant = {name: columns(here, name, steps, True) for name, steps in sizes.items()}
        if not here.differences:
            nothing = {key: found[:, :0] for key, found in self.law["bias"].items()}
            self.law["last"] = self.plant["last"] = nothing
        torques = np.full(n, STEP_TORQUE)
        self.link = self._unseen(columns(here, "link", torques, True))
        self.held = columns(here, "torque", torques, True)
        elastic = self.problem.scenario.transmission.elastic
        self.disturbance = self._unseen(self.held) if elastic else self.link
        if self.bound.stop > self.bound.start:
            # On the closure δq̇ along P makes up for how G turns with q.
            others = [self._turn_of_loops()] + ([] if here.contacts is None else [self.law["q"]["rates"]])
            turn = np.vstack([self.law["q"]["u"][: self.rows], self.spans @ np.vstack(others)])[self.bound]
            self.by_v -= self.P[:, self.bound] @ (turn @ self.by_q)
        if self.soft:
            # f of a soft surface is changed by the parameter of it that f depends on most.
            numbers = self.problem.compliance.numbers
            scales = 1e-3 * np.maximum(np.abs(numbers), 1e-6)
            found = columns(self.here, "compliance", scales, True)
            index = int(np.argmax(np.abs(found["f"][0] * scales)))
            if found["f"][0, index] == 0.0:
                raise SimulationError(
                    f"linearise: the soft surface gives no force at t = {self.instant.time:g} s; take another instant",
                    self.instant.time,
                )
            self.by_force = {key: x[:, index : index + 1] / found["f"][0, index] for key, x in found.items()}
            along = self.P[:, :1]  # moves the tip along n alone
            self.stiffness = -float((self.plant["q"]["f"] @ along)[0, 0])
            self.damping = -float((self.plant["v"]["f"] @ along)[0, 0])

    def _turn_of_loops(self) -> Array:
        """Return the derivatives (k, n) by q of the rates of the loops' rows, q̇ being what it is."""
        q, apart = self.instant.values["q"], STEP_Q * np.eye(self.n)

        def rates(sign: float) -> Array:
            found = []
            for x in apart:
                beside = q.copy()
                self.here.move(beside, sign * x)
                found.append(self.here.loop_rows(beside)[1])
            return np.array(found)

        above, below = rates(1.0), rates(-1.0)
        return np.asarray((above - below).T / (2.0 * STEP_Q))

    def turning(self) -> Array:
        """Return what δq of joints that turn freely, in the axes of their links, adds to its rate: −ω × δq; (n, n)."""
        found, v = np.zeros((self.n, self.n)), self.instant.values["v"]
        for j in self.problem.robot.model.balls:
            x, y, z = v[j : j + 3]
            found[j : j + 3, j : j + 3] = [[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]
        return found

    def _unseen(self, found: dict[str, Array]) -> dict[str, Array]:
        """Return the derivatives by a torque that the law does not know of: it sees the change of f alone."""
        dz = found["dz"].copy()
        dz[: self.parts["compensation"].stop] = self._by_force_felt() @ found["f"]
        return found | {"dz": dz}

    def read_at_rows(self) -> Array:
        """Return the derivatives of ż by what encoders read at a row, by the coordinates; zero without encoders.

        They are all those of the law and its compensation by the joints but for what f, unsampled, brings: these know
        of the joints by their encoders alone.
        """
        found = np.zeros((self.by_z.shape[0], self.size))
        if not self.problem.scenario.reads_encoders:
            return found
        laws, own = slice(0, self.parts["compensation"].stop), slice(0, self.parts["filter"].stop)
        for name, by in (("q", self.by_q), ("v", self.by_v), ("z", self.by_z)):
            block = self.plant[name]
            read = block["dz"][laws] - self._by_force_felt() @ block["f"]
            if name == "z":
                read[:, own] = 0.0
            found[laws] += read @ by
        return found

    def _by_force_felt(self) -> Array:
        """Return the derivatives (k, 1) of the rates of law and compensation by f that they feel unsampled."""
        laws, sensor = slice(0, self.parts["compensation"].stop), self.problem.sensor
        if sensor.states == 0 and not sensor.sampled and self.state.settings.general != 0:
            return self.law["bias"]["dz"][laws]
        return np.zeros((laws.stop, 1))

    def by_inputs(self, block: Block, key: str) -> Array:
        """Return the derivatives by `inputs`: a rigid surface that accelerates is one at rest, and an inertial load."""
        carry, load = np.zeros((self.n, 1)), (self.frame[0] @ np.asarray(self.jacobian))[:, None]
        if self.rigid:
            S = self.G @ np.linalg.solve(self.H, self.G.T)
            carry = self.G.T @ np.linalg.solve(S, np.eye(S.shape[0])[:, :1])
        link = self.link[key]
        return np.hstack([block["force"][key], -link @ carry, link @ load, block["bias"][key], self.disturbance[key]])

    @property
    def jacobian(self) -> Array:
        """Jᵣ at the instant."""
        values = self.instant.values
        return self.problem.robot.terms(values["q"], values["v"]).jacobian

    def all_of(self, block: Block, key: str) -> list[Array]:
        """Return the derivatives by coordinates, reading, readings of the encoders, inputs and torque."""
        found = block["q"][key] @ self.by_q + block["v"][key] @ self.by_v + block["z"][key] @ self.by_z
        if self.soft:  # a surface that is moved presses
            found[:, self.s0] += self.by_force[key][:, 0] * self.stiffness
            found[:, self.s0 + 1] += self.by_force[key][:, 0] * self.damping
        return [
            np.asarray(found), block["measured"][key], block["last"][key], self.by_inputs(block, key),
            self.held[key],
        ]  # fmt: skip


def _refuse_limited(here: Here) -> None:
    """Refuse a drive that is at its limit: its torque answers to nothing."""
    problem, time = here.problem, here.instant.time
    limited = np.flatnonzero(here.loop.w.drives.limited != AS_ASKED)
    if here.loop.state.settings.drives != 0 and limited.size:
        raise SimulationError(
            f"linearise: the drive of joint {problem.robot.joint_names[int(limited[0])]} is at its limit at "
            f"t = {time:g} s, so its torque does not respond; take another instant, or a higher limit",
            time,
        )
