"""The force loop as a linear system: derivatives at an instant, reduced to free coordinates, and put together.

Of the equation of motion the derivatives are taken at one state of a run, by central differences of the kernels of that
run (`here`), and reduced to what binds leaves free. With G the rows that bind (n, with a tip that sticks t1 and t2, and
those of loop joints) and P = H⁻¹Gᵀ(G H⁻¹Gᵀ)⁻¹

    δq = N y + P e,    δq̇ = N w + P ė        G N = 0, NᵀH N = 1

so y, w are the motion along the surface and in the null space, in √(kg m²), and e is the deformation of a soft surface.
On a rigid one e is what the surface is moved by, and no state of the loop. The coordinates are y, e | w, ė | z | s, ṡ:
of e those rows that bind but give way, s the displacement of the surface.

They are carried over a step as the scenario's integrator would (`step_of`), with inputs constant but for its beginning,

    ẋ = A x + B₀ u  at the beginning,  A x + B u  within the step:    x⁺ = Φ x + Γ u

A scheme of Runge and Kutta gives polynomials in h A, and exponentials of what decays by itself, the semi-implicit one
lets positions advance with the new velocities, and an integrator that chooses its own steps the exponential, which is
exact. B₀ is that of the first stage: what a sampled sensor reads changes at a row, between the law's evaluation there
and those within the step. Of schemes of one stage it is the whole step, of the exponential no part.

Put together with what happens to samples (`assembled`), the sensor's delay, the hold of a sampled torque, the encoders,
the result is x⁺ = A x + B u, y = C x + D u from one sample of the law to the next.
"""

from contextlib import suppress

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm, null_space

from closedloop.base.arguments import arguments_checked
from closedloop.base.arrays import Array, ComplexArray
from closedloop.base.errors import ScenarioError, SimulationError
from closedloop.control.drives import AS_ASKED
from closedloop.loop.step.memory import RIGID_STICK
from closedloop.mechanics.closure.contact_force import FREE, STUCK
from closedloop.mechanics.integrators import ADAPTIVE, AdaptiveIntegrator, Scheme, scheme_of
from closedloop.mechanics.surface.compliances.none import Rigid
from closedloop.scenario.load import Variants
from closedloop.scenario.scenario import Scenario
from closedloop.simulation.engines.problem import Problem
from closedloop.simulation.parts import Cache
from closedloop.simulation.prepare import prepare
from closedloop.studies.analysis import here as instants
from closedloop.studies.analysis.linear_loop import OUTSIDE, LinearLoop, Quantity
from robot_models import RobotModel

# Two steps whose differences are further apart than this share, at the best, show a function that has no derivative: of
# those that have one they are nearer than a millionth. A first step whose differences are so near is short enough.
KINK, NEAR = 1e-2, 1e-6
# The most steps that are tried.
MOST = 7


def columns(here: instants.Here, name: str, steps: Array, held: bool) -> dict[str, Array]:
    """Return the derivatives of all that `Here` evaluates by the numbers of a change, matrices (rows, k); see
    `Here.flat`.

    Central differences at a step and half of it cancel the error of second order (Richardson). Where they are far
    apart, as over a change of the contact's mode, the step, at first of `steps` (k,), is a tenth of it; the best of
    `MOST` is taken.
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
            with suppress(instants.EventHere):
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
        raise instants.EventHere
    return {key: best[:, where].T for key, where in here.places.items()}


def _apart(here: instants.Here, value: Array, wide: Array, near: Array, step: Array) -> Array:
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
    """The derivatives at an instant by the free coordinates and the inputs; `free`: whether it may be in flight."""

    def __init__(self, problem: Problem, instant: instants.Instant, free: bool) -> None:
        self.problem, self.instant, self.n = problem, instant, problem.robot.n
        self.here = here = instants.Here(problem, instant, free)
        here.held = here()["torque"]  # which acts from this row on: before it that of the last sample did
        self.state, self.decays = here.loop.state, np.array(here.loop.w.decays.rate)
        limited = np.flatnonzero(here.loop.w.drives.limited != AS_ASKED)
        if self.state.settings.drives != 0 and limited.size:
            raise SimulationError(
                f"linearise: the drive of joint {problem.robot.joint_names[int(limited[0])]} is at its limit at "
                f"t = {instant.time:g} s, so its torque does not respond; take another instant, or a higher limit",
                instant.time,
            )
        self.soft = problem.compliance.member is not Rigid and instant.mode != FREE
        self.rigid = problem.compliance.member is Rigid and instant.mode != FREE
        self.sampled = problem.hold > 0
        self.parts = instants.parts_of(problem)
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
        self.spans = instants.independent(np.vstack(others))
        self.H, self.along, self.G = H, A[0], np.vstack([contact, self.spans @ np.vstack(others)])
        if instants.independent(self.G).shape[0] < self.G.shape[0]:
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


def step_of(
    scheme: type[Scheme], A: Array, B: Array, begin: Array, h: float, leads: Array, exact: Array, decays: Array
) -> tuple[Array, Array]:
    """Return Φ (k, k) and Γ (k, m) of a step h, s.

    `scheme`: the integrator.
    `A`, `B`, `begin`, (k, k), (k, m), (k, m) arrays: the system; `begin` is B₀.
    `leads` (k,): for the semi-implicit scheme, the state whose new value is in the rate of this one; −1: none.
    `exact` (k,): for the semi-implicit scheme, the states that advance exactly, with what they depend on held over the
        step.
    `decays` (k,): for the schemes of Runge and Kutta, the rates a of states that decay by themselves, 1/s; 0 of others.
    """
    k, m = B.shape
    both = np.zeros((k + m, k + m))
    both[:k, :k], both[:k, k:] = A, B
    if issubclass(scheme, AdaptiveIntegrator):
        step = expm(h * both)[:k]
        return step[:, :k], step[:, k:]
    eye, first = np.eye(k + m), both.copy()
    first[:k, k:] = begin
    if scheme.semi_implicit:
        step = eye + h * first
        if np.any(exact):
            alone = first.copy()
            alone[~np.append(exact, np.zeros(m, dtype=bool))] = 0.0
            rows = np.flatnonzero(exact)
            step[rows] = expm(h * alone)[rows]
        for place in np.flatnonzero(leads >= 0):
            step[place] = eye[place] + h * (first[place] - eye[leads[place]] + step[leads[place]])
        return step[:k, :k], step[:k, k:]
    return _stages(scheme, both, first, h, np.append(decays, np.zeros(m)), k)


def _stages(scheme: type[Scheme], within: Array, first: Array, h: float, decays: Array, k: int) -> tuple[Array, Array]:
    """Return Φ and Γ of a scheme of Runge and Kutta, with exponentials of the states that decay.

    About states at rest, g = a z, the E of `closedloop.loop.step.advance` is E δz = e^(−s) δz + (1 − e^(−s))/s p, with
    p = h Σ wᵢ (δżᵢ + a δzᵢ).
    """
    states, slopes = [np.eye(within.shape[0])], list[Array]()
    fast = np.flatnonzero(decays > 0.0)
    a = decays[fast, None]
    for weights, early in zip(scheme.tableau()[1:], scheme.first_tableau()[1:], strict=True):
        slopes.append((within if slopes else first) @ states[-1])
        done = len(slopes)
        new = states[0] + h * np.tensordot(weights[:done], slopes, 1)
        z = states[0][fast]
        driven = [slope[fast] + a * state[fast] for slope, state in zip(slopes, states, strict=True)]
        for part in (early, weights - early):
            s = h * a * np.sum(part)
            z = np.exp(-s) * z + np.where(s == 0.0, 1.0, -np.expm1(-s) / np.where(s == 0.0, 1.0, s)) * (
                h * np.tensordot(part[:done], driven, 1)
            )
        new[fast] = z
        states.append(new)
    return states[-1][:k, :k], states[-1][:k, k:]


# Columns of the inputs.
COMMAND, ACCELERATION, LOAD, NOISE = range(4)
# Rates below this share of the largest are rounding: a state that has none is no part of the loop.
NONE = 1e-12
# The most states of a loop; a delay has one a sample.
MOST_STATES = 2000


def _step(r: Reduced) -> tuple[Array, list[Array]]:
    """Return Φ (x, x) of a step of the coordinates, and Γ by each of the inputs of a step.

    They are the reading of the sensor at the row, that after it, the encoders' readings before, the inputs of the loop
    and the held torque.
    """
    block, half, free = r.plant, r.half, r.free
    parts = []
    for qdd, dz in zip(r.all_of(block, "qdd"), r.all_of(block, "dz"), strict=True):
        rows = np.zeros((r.size, qdd.shape[1]))
        rows[half : half + free] = r.N.T @ r.H @ qdd
        rows[half + free : 2 * half] = (r.G @ qdd)[: r.kept]
        rows[r.z0 : r.s0] = dz
        parts.append(rows)
    A, by_input = parts[0], parts[3]
    A[:half, half : 2 * half] = np.eye(half)
    turns = r.turning() @ r.by_q
    A[:free] += r.N.T @ r.H @ turns
    A[free:half] += (r.G @ turns)[: r.kept]
    A[r.s0, r.s0 + 1] = by_input[r.s0 + 1, ACCELERATION] = 1.0
    leads, exact = np.full(r.size, -1), np.zeros(r.size, dtype=bool)
    leads[:half] = np.arange(half, 2 * half)
    motors = r.parts["transmission"]
    if motors.stop > motors.start:
        first = r.z0 + motors.start
        leads[first : first + r.n] = np.arange(first + r.n, first + 2 * r.n)
    for name in ("friction", "joint friction"):
        exact[r.z0 + r.parts[name].start : r.z0 + r.parts[name].stop] = True
    kept, none = np.zeros_like(A), np.zeros_like(parts[1])
    kept[r.z0 : r.s0] = r.read_at_rows()  # what encoders read at a row acts until the next
    decays = np.zeros(r.size)
    decays[r.z0 : r.s0] = r.decays
    h, (reading, *others) = r.problem.h, parts[1:]
    Phi, Gamma = step_of(
        _scheme(r.problem), A - kept, np.hstack([none, reading, *others, kept]),
        np.hstack([reading, none, *others, kept]), h, leads, exact, decays,
    )  # fmt: skip
    ends = np.cumsum([part.shape[1] for part in (none, reading, *others)])
    *effects, by_kept = np.split(Gamma, ends, axis=1)
    Phi += by_kept
    surface = slice(r.s0, r.s0 + 2)  # which moves as it moves, whatever the scheme
    Phi[surface], Phi[surface, surface] = 0.0, [[1.0, h], [0.0, 1.0]]
    for effect in effects:
        effect[surface] = 0.0
    effects[3][surface, ACCELERATION] = 0.5 * h * h, h
    return Phi, effects


def assembled(r: Reduced) -> LinearLoop:
    """Put the loop together: coordinates, samples of the sensor, newest first, encoders' readings, held torque."""
    torques = [Quantity(f"torque[{name}]", "N m") for name in r.problem.robot.joint_names]
    contacts = () if r.here.contacts is None else r.here.contacts.names
    inputs = (
        Quantity("force command", "N"), Quantity("surface acceleration", "m/s²"), Quantity("load", "N"),
        Quantity("sensor noise", "N"), *torques,
    )  # fmt: skip
    outputs = (
        Quantity("contact force", "N"), *(Quantity(f"tip {axis}", "m") for axis in "xyz"), *torques,
        Quantity("force felt", "N"), *(Quantity(f"contact force[{name}]", "N") for name in contacts),
    )  # fmt: skip
    Phi, (reading, after, lasting, entering, driving) = _step(r)
    ages, size = r.problem.sensor.ring, r.size
    lasts, held = lasting.shape[1], r.n if r.sampled else 0
    at_last = size + ages
    at_torque = at_last + lasts
    whole = at_torque + held
    if whole > MOST_STATES:
        raise ScenarioError(
            f"linearise: {whole} states, {ages} of them samples of sensor.delay: must be at most {MOST_STATES}; "
            "take a longer time.step or a shorter delay"
        )

    def widened(parts: list[Array], torque: tuple[Array, Array] | None) -> tuple[Array, Array]:
        """Return what depends on the coordinates, and so on, by all states and by the inputs."""
        x, u = np.zeros((parts[0].shape[0], whole)), parts[3].copy()
        x[:, :size], x[:, at_last - 1], x[:, at_last:at_torque] = parts[0], parts[1][:, 0], parts[2]
        if torque is not None:
            x += parts[4] @ torque[0]
            u += parts[4] @ torque[1]
        return x, u

    def row_map(asked: bool) -> tuple[Array, Array, Array, Array]:
        """Return the map over a row, and the outputs at it; `asked`: the law gives its torque there."""
        F, E = np.zeros((whole, whole)), np.zeros((whole, len(inputs)))
        F[:size], E[:size] = widened([Phi, reading, lasting, entering, driving], None)
        if asked:
            Q = widened(r.all_of(r.law, "torque"), None)
            Q[1][:, 1:3] = Q[1][:, 4:] = 0.0  # what disturbs the arm has not been seen yet
        else:
            Q = np.zeros((r.n, whole)), np.zeros((r.n, len(inputs)))
            Q[0][:, at_torque:] = np.eye(r.n)
        torque = Q if r.sampled else None
        if torque is not None:
            F[:size] += driving @ Q[0]
            E[:size] += driving @ Q[1]
            F[at_torque:], E[at_torque:] = Q
        f = widened(r.all_of(r.plant, "f"), torque)
        if r.problem.sensor.states:
            F[size, r.z0 + r.parts["filter"].start] = 1.0
        else:
            feels = widened(r.all_of(r.plant, "felt"), torque)
            F[size], E[size] = feels[0][0], feels[1][0]
        felt = F[size : size + 1].copy(), E[size : size + 1].copy()
        E[size, NOISE] += 1.0
        F[size + 1 : at_last, size : at_last - 1] = np.eye(ages - 1)
        F[:size] += after @ F[at_last - 1 : at_last]
        E[:size] += after @ E[at_last - 1 : at_last]
        F[at_last:at_torque], E[at_last:at_torque] = widened(r.all_of(r.plant, "last"), None) if lasts else (0, 0)
        tip = np.zeros((3, whole))
        tip[:, :size] = r.plant["q"]["r"] @ r.by_q
        still = np.zeros((3, len(inputs)))
        presses = (tip[:0], still[:0]) if r.here.contacts is None else widened(r.all_of(r.plant, "presses"), torque)
        C, D = (np.vstack(parts) for parts in zip(f, (tip, still), Q, felt, presses, strict=True))
        return F, E, C, D

    F, E, C, D = row_map(True)
    for _ in range(r.problem.hold - 1):
        F2, E2, _, _ = row_map(False)
        F, E = F2 @ F, F2 @ E + E2
    keep = _moving(F, C)
    keep[r.s0 : r.s0 + 2] = True
    normal = np.zeros(whole)
    if r.rigid or r.kept:
        normal[r.s0 + 1 if r.rigid else r.half + r.free] = 1.0
    else:
        normal[: r.size] = r.along @ r.by_v
    pick, names, scheme = np.flatnonzero(keep), _names(r, ages, lasts, held), _scheme(r.problem)
    return LinearLoop(
        A=F[np.ix_(pick, pick)], B=E[pick], C=C[:, pick], D=D, dt=r.problem.h * max(r.problem.hold, 1),
        states=tuple(names[i] for i in pick), inputs=inputs, outputs=outputs, time=r.instant.time,
        scenario=r.problem.scenario, mode=r.instant.mode, soft=r.soft, closure=_closure_poles(r),
        normal=normal[pick],
        held_force=r.rigid or (scheme.stages == 1 and not issubclass(scheme, AdaptiveIntegrator)),
    )  # fmt: skip


def _names(r: Reduced, ages: int, lasts: int, held: int) -> list[Quantity]:
    names: list[Quantity] = []
    joints = r.problem.robot.joint_names
    for tangent, normal, per in (("y", "deformation", ""), ("w", "deformation rate", "/s")):
        names += [Quantity(f"{tangent}{j + 1}", f"√kg m{per}", "arm") for j in range(r.free)]
        if r.soft:
            names.append(Quantity(normal, f"m{per}", "contact"))
        else:
            names += [Quantity(f"{'pu'[bool(per)]}{j + 1}", f"m{per}", "arm") for j in range(r.kept)]
    for part, where in r.parts.items():
        member = {"law": r.problem.law.member, "compensation": r.problem.compensation.member}.get(part)
        if member is not None:
            own = [*member.states, *(f"{name}[{joint}]" for name in member.joint_states for joint in joints)]
            names += [Quantity(f"{part} {name}", "", part) for name in own]
        elif part == "transmission" and where.stop > where.start:
            names += [Quantity(f"motor[{joint}]", "rad", part) for joint in joints]
            names += [Quantity(f"motor rate[{joint}]", "rad/s", part) for joint in joints]
        else:
            belongs = "friction" if "friction" in part else part
            names += [Quantity(f"{part} {i + 1}", "", belongs) for i in range(where.stop - where.start)]
    names += [Quantity("surface", "m", OUTSIDE), Quantity("surface rate", "m/s", OUTSIDE)]
    names += [Quantity("reading", "N", "sensor")] if ages == 1 else [
        Quantity(f"reading, {age + 1} samples old", "N", "delay") for age in range(ages)
    ]  # fmt: skip
    read = (("read q", "rad"), ("read v", "rad/s"))
    names += [Quantity(f"{what}[{joint}]", unit, "encoder") for what, unit in read for joint in joints][:lasts]
    return names + [Quantity(f"held torque[{joint}]", "N m", "hold") for joint in joints][:held]


def _closure_poles(r: Reduced) -> ComplexArray:
    """Return the poles of Baumgarte's stabiliser, of e and ė alone, as the integrator makes them; (k,) complex."""
    section = r.problem.scenario.stabiliser
    if not r.rigid or section.kind not in ("baumgarte", "both"):
        return np.zeros(0, dtype=complex)
    s_v, s_p = r.problem.stabiliser
    A = np.array([[0.0, 1.0], [-s_p, -s_v]])
    step, _ = step_of(
        _scheme(r.problem), A, np.zeros((2, 0)), np.zeros((2, 0)), r.problem.h, np.array([1, -1]),
        np.zeros(2, dtype=bool), np.zeros(2),
    )  # fmt: skip
    return np.repeat(np.linalg.eigvals(step).astype(complex), r.rows)


def _scheme(problem: Problem) -> type[Scheme]:
    scheme = scheme_of(problem.scenario.time.integrator)
    assert scheme is not None
    return scheme


def _moving(F: Array, C: Array) -> NDArray[np.bool_]:
    """Return which states are part of the loop: not those that stay as they are, nor those that nothing reads."""
    keep, scale = np.ones(F.shape[0], dtype=bool), NONE * float(np.max(np.abs(F)))
    changes = np.abs(F - np.eye(F.shape[0])) > scale
    reads = changes & ~np.eye(F.shape[0], dtype=bool)
    seen, over = np.any(np.abs(C) > NONE, axis=0), np.abs(np.diag(F)) <= scale
    while True:
        unread = ~np.any(reads[keep], axis=0)
        still = ~np.any(changes[:, keep], axis=1)
        left = keep & ~(unread & (still | (over & ~seen)))
        if np.array_equal(left, keep):
            return keep
        keep = left


@arguments_checked()
def linearise(
    scenario: Scenario, at: float | None = None, *, model: RobotModel | None = None, cache: Cache | None = None
) -> LinearLoop:
    """Return the force loop, linear about the motion at an instant.

    Parameters
    ----------
    scenario : Scenario
        From `load_scenario`.
    at : float, optional
        The instant, s, taken to the nearest sample of the law; half of the duration if left out.
    model : RobotModel, optional
        The robot to use instead of loading `scenario.robot.model`.
    cache : Cache, optional
        For repeated calls: the robot and the path that they share are prepared once.

    Returns
    -------
    LinearLoop
        A, B, C, D, dt, names with units, poles, margins, responses, the port.

    Raises
    ------
    ScenarioError, ModelError
        If the scenario is at fault, or `at` is outside the run.
    SimulationError
        At an event, in flight, if a drive is at its limit or a joint at its stop, or if the run stops before.
    """
    at = 0.5 * scenario.time.duration if at is None else at
    instants.refuse_outside(scenario, at)  # before the path is made, which takes a while
    problem = prepare(scenario, model, cache)
    return loop_at(problem, instant_of(problem, at, model))


def instant_of(problem: Problem, at: float, model: RobotModel | None = None) -> instants.Instant:
    """Return the state of a run at an instant; with an integrator that chooses its steps, by rk4."""
    return instants.run_to(of_fixed_steps(problem, model), instants.row_at(problem, at))


def of_fixed_steps(problem: Problem, model: RobotModel | None = None, cache: Cache | None = None) -> Problem:
    """Return a problem that is stepped row by row: with an integrator that chooses its steps, the same one by rk4."""
    scenario = problem.scenario
    if problem.integrator.time_stepping:
        raise ScenarioError(
            f"linearise: time.integrator = {scenario.time.integrator!r} finds impulses, not the forces of a mode; use "
            "'semi_implicit_euler' or 'rk4'"
        )
    if scenario.time.integrator not in ADAPTIVE:
        return problem
    fixed = Variants(scenario, ("time.integrator", "time.tolerance")).scenario(("rk4", None))
    return prepare(fixed, model, cache)


def loop_at(problem: Problem, instant: instants.Instant, free: bool = False) -> LinearLoop:
    """Return the loop at an instant, which may be of a run with other gains; with `free` in flight that of motion."""
    with instants.without_event(instant.time):
        return assembled(Reduced(problem, instant, free))
