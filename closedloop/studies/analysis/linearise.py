"""The force loop as a linear system about the motion at an instant.

Of the equation of motion the derivatives are taken at one state of a run, by the kernels of that run (`instant`). With
the closure they are reduced to what it leaves free, then carried over a step as the scenario's integrator would
(`discretise`), and put together with what happens to samples: the sensor's delay, the hold of a sampled torque, the
encoders. The result is x⁺ = A x + B u, y = C x + D u from one sample of the law to the next.

Coordinates: with G the rows that bind (n, with a tip that sticks t1 and t2, and those of loop joints) and
P = H⁻¹Gᵀ(G H⁻¹Gᵀ)⁻¹

    δq = N y + P e,    δq̇ = N w + P ė        G N = 0, NᵀH N = 1

so y, w are the motion along the surface and in the null space, in √(kg m²), and e is the deformation of a soft surface.
On a rigid one e is what the surface is moved by, and no state of the loop.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import null_space

from closedloop.base.arguments import arguments_checked
from closedloop.base.errors import ScenarioError, SimulationError
from closedloop.control.drives import AS_ASKED
from closedloop.loop.step.memory import RIGID_STICK
from closedloop.mechanics.closure.contact_force import FREE, STUCK
from closedloop.mechanics.integrators import ADAPTIVE, AdaptiveIntegrator, Scheme, scheme_of
from closedloop.mechanics.surface.compliances.none import Rigid
from closedloop.scenario.overrides import Variants
from closedloop.scenario.scenario import Scenario
from closedloop.simulation.cache import Cache
from closedloop.simulation.engines.problem import Problem
from closedloop.simulation.prepare import prepare
from closedloop.studies.analysis.discretise import step_of
from closedloop.studies.analysis.here import EventHere, Here, columns, independent
from closedloop.studies.analysis.instant import Instant, parts_of, refuse_outside, row_at, run_to
from closedloop.studies.analysis.linear_loop import OUTSIDE, LinearLoop, Quantity
from robot_models import RobotModel

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Block = dict[str, dict[str, Array]]

# Columns of the inputs.
COMMAND, ACCELERATION, LOAD, NOISE = range(4)
# First steps of the differences: of positions, rad (m), velocities, forces, N, and torques, N m; Richardson's
# extrapolation leaves their fourth power, rounding is an ε over them.
STEP_Q, STEP_V, STEP_FORCE, STEP_TORQUE = 1e-4, 1e-3, 1e-2, 1e-2
# Rates below this share of the largest are rounding: a state that has none is no part of the loop.
NONE = 1e-12
# The most states of a loop; a delay has one a sample.
MOST_STATES = 2000


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
        For one call after another: the robot and the path that they share are prepared once.

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
    refuse_outside(scenario, at)  # before the path is made, which takes a while
    problem = prepare(scenario, model, cache)
    instant = instant_of(scenario, problem, at, model)
    return loop_at(problem, instant)


def instant_of(scenario: Scenario, problem: Problem, at: float, model: RobotModel | None = None) -> Instant:
    """Return the state of a scenario's run at an instant; with an integrator that chooses its steps, by rk4."""
    row = row_at(problem, at)
    if scenario.time.integrator in ADAPTIVE:
        fixed = Variants(scenario, ("time.integrator", "time.tolerance")).scenario(("rk4", None))
        problem = prepare(fixed, model)
    return run_to(problem, row)


def loop_at(problem: Problem, instant: Instant, free: bool = False) -> LinearLoop:
    """Return the loop of a problem at the state of an instant, which may be that of a run with other gains.

    In flight there is only a loop of motion, which is returned if `free` says that it is meant.
    """
    try:
        return _Assembly(problem, instant, free).loop()
    except EventHere:
        raise SimulationError(
            f"linearise: at t = {instant.time:g} s the contact is about to change, or friction to turn: there is no "
            "linear loop; take another instant",
            instant.time,
        ) from None


class _Assembly:
    """The derivatives at an instant, and the loop that is made of them.

    The coordinates of a step are y, e | w, ė | z | s, ṡ: of e those rows that bind but give way, s the displacement of
    the surface. Its inputs: the reading of the sensor, the latest readings of the encoders, `inputs`, and the torque.
    """

    def __init__(self, problem: Problem, instant: Instant, free: bool) -> None:
        self.problem, self.instant, self.n = problem, instant, problem.robot.n
        self.here = here = Here(problem, instant, free)
        here()
        _refuse_limited(here)
        self.state = here.loop.state
        self.soft = problem.compliance.member is not Rigid and instant.mode != FREE
        self.rigid = problem.compliance.member is Rigid and instant.mode != FREE
        self.sampled = problem.hold > 0
        self.parts = parts_of(problem)
        self._coordinates()
        self._differentiate()
        names = problem.robot.joint_names
        self.inputs = (
            Quantity("force command", "N"), Quantity("surface acceleration", "m/s²"), Quantity("load", "N"),
            Quantity("sensor noise", "N"), *(Quantity(f"torque[{name}]", "N m") for name in names),
        )  # fmt: skip
        self.outputs = (
            Quantity("contact force", "N"), *(Quantity(f"tip {axis}", "m") for axis in "xyz"),
            *(Quantity(f"torque[{name}]", "N m") for name in names), Quantity("force felt", "N"),
            *(Quantity(f"contact force[{name}]", "N") for name in (here.contacts.names if here.contacts else ())),
        )  # fmt: skip

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
            self.by_force = self._by_contact_force()
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

    def _turning(self) -> Array:
        """Return what δq of joints that turn freely, in the axes of their links, adds to its rate: −ω × δq; (n, n)."""
        found, v = np.zeros((self.n, self.n)), self.instant.values["v"]
        for j in self.problem.robot.model.balls:
            x, y, z = v[j : j + 3]
            found[j : j + 3, j : j + 3] = [[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]
        return found

    def _unseen(self, found: dict[str, Array]) -> dict[str, Array]:
        """Return the derivatives by a torque that the law does not know of: it sees the change of f alone."""
        dz, sensor = found["dz"].copy(), self.problem.sensor
        laws = slice(0, self.parts["compensation"].stop)
        dz[laws] = 0.0
        if sensor.states == 0 and not sensor.sampled and self.state.settings.general != 0:
            dz[laws] = self.law["bias"]["dz"][laws] @ found["f"]
        return found | {"dz": dz}

    def _by_contact_force(self) -> dict[str, Array]:
        """Return the derivatives by f of a soft surface: those by the parameter of it that f depends on most."""
        numbers = self.problem.compliance.numbers
        scales = 1e-3 * np.maximum(np.abs(numbers), 1e-6)
        found = columns(self.here, "compliance", scales, True)
        index = int(np.argmax(np.abs(found["f"][0] * scales)))
        if found["f"][0, index] == 0.0:
            raise SimulationError(
                f"linearise: the soft surface gives no force at t = {self.instant.time:g} s; take another instant",
                self.instant.time,
            )
        return {key: x[:, index : index + 1] / found["f"][0, index] for key, x in found.items()}

    def _by_coordinates(self, block: Block, key: str) -> Array:
        found = block["q"][key] @ self.by_q + block["v"][key] @ self.by_v + block["z"][key] @ self.by_z
        if self.soft:  # a surface that is moved presses
            found[:, self.s0] += self.by_force[key][:, 0] * self.stiffness
            found[:, self.s0 + 1] += self.by_force[key][:, 0] * self.damping
        return np.asarray(found)

    def _by_inputs(self, block: Block, key: str) -> Array:
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

    def _all(self, block: Block, key: str) -> list[Array]:
        """Return the derivatives by coordinates, reading, readings of the encoders, inputs and torque."""
        return [
            self._by_coordinates(block, key), block["measured"][key], block["last"][key], self._by_inputs(block, key),
            self.held[key],
        ]  # fmt: skip

    def _step(self) -> tuple[Array, list[Array]]:
        """Return Φ (x, x) of a step of the coordinates, and Γ by each of the inputs of a step."""
        block, half, free = self.plant, self.half, self.free
        parts = []
        for qdd, dz in zip(self._all(block, "qdd"), self._all(block, "dz"), strict=True):
            rows = np.zeros((self.size, qdd.shape[1]))
            rows[half : half + free] = self.N.T @ self.H @ qdd
            rows[half + free : 2 * half] = (self.G @ qdd)[: self.kept]
            rows[self.z0 : self.s0] = dz
            parts.append(rows)
        A, by_input = parts[0], parts[3]
        A[:half, half : 2 * half] = np.eye(half)
        turns = self._turning() @ self.by_q
        A[:free] += self.N.T @ self.H @ turns
        A[free:half] += (self.G @ turns)[: self.kept]
        A[self.s0, self.s0 + 1] = by_input[self.s0 + 1, ACCELERATION] = 1.0
        leads, exact = np.full(self.size, -1), np.zeros(self.size, dtype=bool)
        leads[:half] = np.arange(half, 2 * half)
        motors = self.parts["transmission"]
        if motors.stop > motors.start:
            first = self.z0 + motors.start
            leads[first : first + self.n] = np.arange(first + self.n, first + 2 * self.n)
        for name in ("friction", "joint friction"):
            exact[self.z0 + self.parts[name].start : self.z0 + self.parts[name].stop] = True
        h = self.problem.h
        Phi, Gamma = step_of(_scheme(self.problem), A, np.hstack(parts[1:]), h, leads, exact)
        ends = np.cumsum([part.shape[1] for part in parts[1:]])
        effects = np.split(Gamma, ends[:-1], axis=1)
        surface = slice(self.s0, self.s0 + 2)  # which moves as it moves, whatever the scheme
        Phi[surface], Phi[surface, surface] = 0.0, [[1.0, h], [0.0, 1.0]]
        for effect in effects:
            effect[surface] = 0.0
        effects[2][surface, ACCELERATION] = 0.5 * h * h, h
        return Phi, effects

    def loop(self) -> LinearLoop:
        """Put the loop together: coordinates, samples of the sensor, newest first, encoders' readings, held torque."""
        Phi, (reading, lasting, entering, driving) = self._step()
        ages, size = self.problem.sensor.ring, self.size
        lasts, held = lasting.shape[1], self.n if self.sampled else 0
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
            F, E = np.zeros((whole, whole)), np.zeros((whole, len(self.inputs)))
            F[:size], E[:size] = widened([Phi, reading, lasting, entering, driving], None)
            if asked:
                Q = widened(self._all(self.law, "torque"), None)
                Q[1][:, 1:3] = Q[1][:, 4:] = 0.0  # what disturbs the arm has not been seen yet
            else:
                Q = np.zeros((self.n, whole)), np.zeros((self.n, len(self.inputs)))
                Q[0][:, at_torque:] = np.eye(self.n)
            torque = Q if self.sampled else None
            if torque is not None:
                F[:size] += driving @ Q[0]
                E[:size] += driving @ Q[1]
                F[at_torque:], E[at_torque:] = Q
            f = widened(self._all(self.plant, "f"), torque)
            if self.problem.sensor.states:
                F[size, self.z0 + self.parts["filter"].start] = 1.0
            else:
                F[size], E[size] = f[0][0], f[1][0]
            felt = F[size : size + 1].copy(), E[size : size + 1].copy()
            E[size, NOISE] += 1.0
            F[size + 1 : at_last, size : at_last - 1] = np.eye(ages - 1)
            F[at_last:at_torque], E[at_last:at_torque] = (
                widened(self._all(self.plant, "last"), None) if lasts else (0, 0)
            )
            r = np.zeros((3, whole))
            r[:, :size] = self.plant["q"]["r"] @ self.by_q
            still = np.zeros((3, len(self.inputs)))
            presses = (
                (r[:0], still[:0]) if self.here.contacts is None else widened(self._all(self.plant, "presses"), torque)
            )
            C, D = (np.vstack(parts) for parts in zip(f, (r, still), Q, felt, presses, strict=True))
            return F, E, C, D

        F, E, C, D = row_map(True)
        for _ in range(self.problem.hold - 1):
            F2, E2, _, _ = row_map(False)
            F, E = F2 @ F, F2 @ E + E2
        keep = _moving(F, C)
        keep[self.s0 : self.s0 + 2] = True
        normal = np.zeros(whole)
        if self.rigid or self.kept:
            normal[self.s0 + 1 if self.rigid else self.half + self.free] = 1.0
        else:
            normal[: self.size] = self.along @ self.by_v
        pick, names = np.flatnonzero(keep), self._names(ages, lasts, held)
        return LinearLoop(
            A=F[np.ix_(pick, pick)], B=E[pick], C=C[:, pick], D=D, dt=self.problem.h * max(self.problem.hold, 1),
            states=tuple(names[i] for i in pick), inputs=self.inputs, outputs=self.outputs, time=self.instant.time,
            scenario=self.problem.scenario, mode=self.instant.mode, soft=self.soft, closure=self._closure_poles(),
            normal=normal[pick], held_force=self.rigid or _one_stage(self.problem),
        )  # fmt: skip

    def _names(self, ages: int, lasts: int, held: int) -> list[Quantity]:
        """Return the names of all states, in their order."""
        names: list[Quantity] = []
        joints = self.problem.robot.joint_names
        for tangent, normal, per in (("y", "deformation", ""), ("w", "deformation rate", "/s")):
            names += [Quantity(f"{tangent}{j + 1}", f"√kg m{per}", "arm") for j in range(self.free)]
            if self.soft:
                names.append(Quantity(normal, f"m{per}", "contact"))
            else:
                names += [Quantity(f"{'pu'[bool(per)]}{j + 1}", f"m{per}", "arm") for j in range(self.kept)]
        for part, where in self.parts.items():
            member = {"law": self.problem.law.member, "compensation": self.problem.compensation.member}.get(part)
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

    def _closure_poles(self) -> ComplexArray:
        """Return the poles of Baumgarte's stabiliser, of e and ė alone, as the integrator makes them; (k,) complex."""
        section = self.problem.scenario.stabiliser
        if not self.rigid or section.kind not in ("baumgarte", "both"):
            return np.zeros(0, dtype=complex)
        s_v, s_p = self.problem.stabiliser
        A = np.array([[0.0, 1.0], [-s_p, -s_v]])
        step, _ = step_of(
            _scheme(self.problem), A, np.zeros((2, 0)), self.problem.h, np.array([1, -1]), np.zeros(2, dtype=bool)
        )
        return np.repeat(np.linalg.eigvals(step).astype(complex), self.rows)


def _scheme(problem: Problem) -> type[Scheme]:
    scheme = scheme_of(problem.scenario.time.integrator)
    assert scheme is not None
    return scheme


def _one_stage(problem: Problem) -> bool:
    scheme = _scheme(problem)
    return scheme.stages == 1 and not issubclass(scheme, AdaptiveIntegrator)


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
