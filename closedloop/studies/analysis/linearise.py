"""The force loop as a linear system about the motion at an instant.

Of the equation of motion the derivatives are taken at one state of a run, by the kernels of that run (`instant`). With
the closure they are reduced to what it leaves free, then carried over a step as the scenario's integrator would
(`discretise`), and put together with what happens to samples: the sensor's delay, the hold of a sampled torque, the
encoders. The result is x⁺ = A x + B u, y = C x + D u from one sample of the law to the next.

Coordinates: with G the rows that bind (n, and with a tip that sticks t1, t2) and P = H⁻¹Gᵀ(G H⁻¹Gᵀ)⁻¹

    δq = N y + P e,    δq̇ = N w + P ė        G N = 0, NᵀH N = 1

so y, w are the motion along the surface and in the null space, in √(kg m²), and e is the deformation of a soft surface.
On a rigid one e is what the surface is moved by, and no state of the loop.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import null_space

from closedloop.base.errors import ScenarioError, SimulationError
from closedloop.control.drives import AS_ASKED
from closedloop.mechanics.closure.contact_force import FREE, STUCK
from closedloop.mechanics.integrators import ADAPTIVE, scheme_of
from closedloop.mechanics.surface.compliances.none import Rigid
from closedloop.scenario.overrides import Variants
from closedloop.scenario.scenario import Scenario
from closedloop.simulation.engines.problem import Problem
from closedloop.simulation.prepare import prepare
from closedloop.studies.analysis.discretise import step_of
from closedloop.studies.analysis.instant import (
    EventHere,
    Here,
    Instant,
    columns,
    parts_of,
    refuse_unknown,
    row_at,
    run_to,
)
from closedloop.studies.analysis.linear_loop import LinearLoop, Quantity
from robot_models import RobotModel

Array = NDArray[np.float64]

# First steps of the differences: of positions, rad (m), velocities, forces, N, and torques, N m; Richardson's
# extrapolation leaves their fourth power, rounding is an ε over them.
STEP_Q, STEP_V, STEP_FORCE, STEP_TORQUE = 1e-4, 1e-3, 1e-2, 1e-2
# Rates below this share of the largest are rounding: a state that has none is no part of the loop.
NONE = 1e-12
# The most states of a loop; a delay has one a sample.
MOST_STATES = 2000


def linearise(scenario: Scenario, at: float | None = None, *, model: RobotModel | None = None) -> LinearLoop:
    """Return the force loop, linear about the motion at an instant.

    Parameters
    ----------
    scenario : Scenario
        From `load_scenario`.
    at : float, optional
        The instant, s, taken to the nearest sample of the law; half of the duration if left out.
    model : RobotModel, optional
        The robot to use instead of loading `scenario.robot.model`.

    Returns
    -------
    LinearLoop
        A, B, C, D, dt, names with units, poles, margins, responses, the port.

    Raises
    ------
    ScenarioError, ModelError
        If the scenario is at fault, `at` is outside the run, or it has what is not linearised (loop joints, stops).
    SimulationError
        At an event, in flight, if a drive is at its limit, or if the run stops before.
    """
    at = 0.5 * scenario.time.duration if at is None else at
    problem = prepare(scenario, model)
    instant = instant_of(scenario, problem, at, model)
    return loop_at(problem, instant)


def instant_of(scenario: Scenario, problem: Problem, at: float, model: RobotModel | None = None) -> Instant:
    """Return the state of a scenario's run at an instant; with an integrator that chooses its steps, by rk4."""
    refuse_unknown(problem)
    row = row_at(problem, at)
    if scenario.time.integrator in ADAPTIVE:
        fixed = Variants(scenario, ("time.integrator", "time.tolerance")).scenario(("rk4", None))
        problem = prepare(fixed, model)
    return run_to(problem, row)


def loop_at(problem: Problem, instant: Instant) -> LinearLoop:
    """Return the loop of a problem at the state of an instant, which may be that of a run with other gains."""
    try:
        return _Assembly(problem, instant).loop()
    except EventHere:
        raise SimulationError(
            f"linearise: the contact is about to change at t = {instant.time:g} s, where there is no linear loop; take "
            "another instant",
            instant.time,
        ) from None


class _Assembly:
    """The derivatives at an instant, and the loop that is made of them."""

    def __init__(self, problem: Problem, instant: Instant) -> None:
        self.problem, self.instant, self.n = problem, instant, problem.robot.n
        self.here = Here(problem, instant)
        self.soft = problem.compliance.member is not Rigid
        self.parts = parts_of(problem)
        self.k = self.parts["transmission"].stop
        n = self.n
        value = self.here()
        self.value = value
        limited = np.flatnonzero(self.here.loop.w.torque_limited != AS_ASKED)
        if problem.scenario.drives != type(problem.scenario.drives)() and limited.size:
            name = problem.robot.joint_names[int(limited[0])]
            raise SimulationError(
                f"linearise: the drive of joint {name} is at its limit at t = {instant.time:g} s, so that its torque "
                "answers to nothing; take another instant, or a higher limit",
                instant.time,
            )
        self.immediate = problem.sensor.states == 0 and not problem.sensor.sampled and self.here.loop.state.law != 0
        self.sampled = problem.hold > 0
        H, A, self.frame, _ = self.here.geometry()
        rigid_stick = instant.mode == STUCK and self.here.loop.state.sticking == 1
        self.G = A if rigid_stick else A[:1]
        PT = np.linalg.solve(H, self.G.T)
        self.P = PT @ np.linalg.inv(self.G @ PT)
        basis = null_space(self.G)
        self.N = basis @ np.linalg.inv(np.linalg.cholesky(basis.T @ H @ basis)).T if basis.size else basis
        self.H, self.m = H, self.G.shape[0]
        zscale = np.maximum(np.abs(self.here.loop.w.z), 1e-2) * 1e-2
        sizes = {
            "q": (n, np.full(n, STEP_Q)), "v": (n, np.full(n, STEP_V)), "z": (self.k, zscale),
            "measured": (1, [STEP_FORCE]), "force": (1, [STEP_FORCE]), "bias": (1, [STEP_FORCE]),
        }  # fmt: skip
        if self.here.differences:
            sizes["last"] = (2 * n, np.full(2 * n, STEP_Q))
        self.order = list(sizes)

        def all_of(held: bool) -> dict[str, dict[str, Array]]:
            return {
                name: columns(self.here, name, count, np.asarray(scale), held)
                for name, (count, scale) in sizes.items()
            }

        self.law = all_of(False)
        self.plant = all_of(True) if self.sampled else self.law
        torques = np.full(n, STEP_TORQUE)
        link = columns(self.here, "link", n, torques, True)
        motor = columns(self.here, "torque", n, torques, True)
        self.link, self.held = self._unseen(link), motor
        self.disturbance = self._unseen(motor) if problem.scenario.transmission.elastic else self.link

    def _unseen(self, found: dict[str, Array]) -> dict[str, Array]:
        """Return the derivatives by a torque that the law does not know of: it sees the change of f alone."""
        dz = found["dz"].copy()
        laws = slice(0, self.parts["compensation"].stop)
        dz[laws] = 0.0
        if self.immediate:
            dz[laws] = self.law["bias"]["dz"][laws] @ found["f"]
        return found | {"dz": dz}

    def _pressed(self) -> tuple[dict[str, Array], float, float]:
        """Return the derivatives by f of a soft surface, and the f of its deformation and of its rate, N/m, N s/m."""
        problem, (size,) = self.problem, self.problem.compliance.numbers.shape
        for index in range(size):
            scale = np.full(size, 1e-3 * max(abs(float(problem.compliance.numbers[index])), 1e-6))
            found = columns(self.here, "compliance", size, scale, True)
            f = found["f"][0]
            index = int(np.argmax(np.abs(f * scale)))
            if f[index] != 0.0:
                by_force = {key: x[:, index : index + 1] / f[index] for key, x in found.items()}
                break
        else:
            raise ScenarioError("linearise: the soft surface gives no force here; take another instant")
        along_n = self.P[:, :1]  # moves the tip along n alone
        stiffness = -float((self.plant["q"]["f"] @ along_n)[0, 0])
        damping = -float((self.plant["v"]["f"] @ along_n)[0, 0])
        return by_force, stiffness, damping

    def loop(self) -> LinearLoop:
        """Put the loop together."""
        here, n, m, soft = self.here, self.n, self.m, self.soft
        kept = 1 if soft and self.instant.mode != FREE else 0  # of the rows that bind, those that are states
        if self.instant.mode == FREE:
            kept = m
        free = n - m
        N, P = self.N, self.P
        # Columns of δq and δq̇ of the coordinates: y, e kept | w, ė kept | z, and s, ṡ of the surface.
        names: list[Quantity] = []
        joints = self.problem.robot.joint_names
        for rate in (False, True):
            per = "/s" if rate else ""
            names += [
                Quantity(f"{'w' if rate else 'y'}{j + 1}", "√kg m" + per, "arm") for j in range(free)
            ]
            names += [
                Quantity(("deformation rate" if rate else "deformation") if soft else f"{'u' if rate else 'p'}{j + 1}",
                         "m" + per, "contact" if soft else "arm") for j in range(kept)
            ]  # fmt: skip
        half = free + kept
        names += self._states_of_z()
        z0 = 2 * half
        s0 = z0 + self.k
        names += [Quantity("surface", "m", "surface"), Quantity("surface rate", "m/s", "surface")]
        size = s0 + 2
        Tq, Tv = np.zeros((n, size)), np.zeros((n, size))
        Tq[:, :free], Tv[:, half : half + free] = N, N
        Tq[:, free:half], Tv[:, half + free : 2 * half] = P[:, :kept], P[:, :kept]
        rigid = not soft and self.instant.mode != FREE
        if rigid:
            # On the closure: e = s, ė = ṡ, and δq̇ along P makes up for how G turns with q.
            Tq[:, s0], Tv[:, s0 + 1] = P[:, 0], P[:, 0]
        if self.instant.mode != FREE and m > kept:
            turn = self.law["q"]["u"][:m] if m == 3 else self.law["q"]["u"][:1]
            bound = slice(kept, m)
            Tv -= P[:, bound] @ (turn[bound] @ Tq)
        Tz = np.zeros((self.k, size))
        Tz[:, z0:s0] = np.eye(self.k)

        by_force = stiffness = damping = None
        if soft and self.instant.mode != FREE:
            by_force, stiffness, damping = self._pressed()

        def through(block: dict[str, dict[str, Array]], key: str) -> Array:
            found = block["q"][key] @ Tq + block["v"][key] @ Tv + block["z"][key] @ Tz
            if by_force is not None:  # a soft surface that is moved presses
                found[:, s0] += by_force[key][:, 0] * stiffness
                found[:, s0 + 1] += by_force[key][:, 0] * damping
            return found

        # Inputs of a step: reading, last readings, f_des, surface acceleration, load, noise, disturbance, torque.
        lasts = 2 * n if here.differences else 0
        inputs = [Quantity("force command", "N"), Quantity("surface acceleration", "m/s²"), Quantity("load", "N"),
                  Quantity("sensor noise", "N"), *(Quantity(f"torque[{name}]", "N m") for name in joints)]  # fmt: skip
        load_row = self.frame[0] @ self.problem.robot.terms(
            self.instant.values["q"], self.instant.values["v"]
        ).jacobian
        # A rigid surface that accelerates by a is one at rest, and the load −S⁻¹n a of inertia.
        S = self.G @ np.linalg.solve(self.H, self.G.T)
        carry = self.G.T @ np.linalg.solve(S, np.eye(m)[:, :1]) if rigid else np.zeros((n, 1))

        def of_inputs(block: dict[str, dict[str, Array]], key: str) -> Array:
            link = self.link[key]
            return np.hstack([
                block["force"][key], -link @ carry, link @ load_row[:, None], block["bias"][key], self.disturbance[key],
            ])  # fmt: skip

        def rates(block: dict[str, dict[str, Array]]) -> tuple[Array, Array, Array, Array]:
            """Return the rates of the coordinates by coordinates, reading, last readings and inputs, and by Q."""
            qdd, dz = through(block, "qdd"), through(block, "dz")
            parts = [(qdd, dz)]
            parts.append((block["measured"]["qdd"], block["measured"]["dz"]))
            parts.append(
                (block["last"]["qdd"], block["last"]["dz"]) if lasts else (np.zeros((n, 0)), np.zeros((self.k, 0)))
            )
            parts.append((of_inputs(block, "qdd"), of_inputs(block, "dz")))
            parts.append((self.held["qdd"], self.held["dz"]))
            found = []
            for number, (a, b) in enumerate(parts):
                rows = np.zeros((size, a.shape[1]))
                if number == 0:
                    rows[:half, half : 2 * half] = np.eye(half)
                    rows[s0, s0 + 1] = 1.0
                rows[half : half + free] = N.T @ self.H @ a
                rows[half + free : 2 * half] = (self.G @ a)[:kept]
                rows[z0:s0] = b
                if number == 3:
                    rows[s0 + 1, 1] = 1.0
                found.append(rows)
            return tuple(found)  # type: ignore[return-value]

        def seen(block: dict[str, dict[str, Array]], key: str) -> list[Array]:
            empty = np.zeros((block["q"][key].shape[0], 0))
            return [
                through(block, key), block["measured"][key], block["last"][key] if lasts else empty,
                of_inputs(block, key), self.held[key],
            ]  # fmt: skip

        block = self.plant if self.sampled else self.law
        scheme = scheme_of(self.problem.scenario.time.integrator)
        assert scheme is not None
        leads = np.full(size, -1)
        leads[:half] = np.arange(half, 2 * half)
        motors = self.parts["transmission"]
        if motors.stop > motors.start:
            leads[z0 + motors.start : z0 + motors.start + n] = np.arange(z0 + motors.start + n, z0 + motors.stop)
        exact = np.zeros(size, dtype=bool)
        for name in ("friction", "joint friction"):
            exact[z0 + self.parts[name].start : z0 + self.parts[name].stop] = True
        A, by_reading, by_last, by_input, by_torque = rates(block)
        h = self.problem.h
        widths = np.cumsum([0, 1, lasts, len(inputs), n])
        Phi, Gamma = step_of(scheme, A, np.hstack([by_reading, by_last, by_input, by_torque]), h, leads, exact)
        Phi[[s0, s0 + 1]] = 0.0
        Phi[s0, s0], Phi[s0, s0 + 1], Phi[s0 + 1, s0 + 1] = 1.0, h, 1.0
        Gamma[[s0, s0 + 1]] = 0.0
        Gamma[s0, 1 + lasts + 1], Gamma[s0 + 1, 1 + lasts + 1] = 0.5 * h * h, h
        reading, lasting, entering, driving = (Gamma[:, a:b] for a, b in zip(widths[:-1], widths[1:], strict=True))

        # From row to row: coordinates, samples of the sensor from the newest to the oldest, readings, and the torque.
        ages = self.problem.sensor.ring
        held = n if self.sampled else 0
        at_ring, at_last, at_torque = size, size + ages, size + ages + lasts
        whole = at_torque + held
        if whole > MOST_STATES:
            raise ScenarioError(
                f"linearise: {whole} states, {ages} of them samples of sensor.delay: must be at most {MOST_STATES}; "
                "take a longer time.step or a shorter delay"
            )

        def row_map(asked: bool) -> tuple[Array, Array, Array, Array]:
            """Return the map over a row, and the outputs at it; `asked`: the law gives its torque there."""
            F, E = np.zeros((whole, whole)), np.zeros((whole, len(inputs)))
            F[:size, :size], F[:size, at_ring + ages - 1] = Phi, reading[:, 0]
            F[:size, at_last:at_torque], E[:size] = lasting, entering

            def widened(parts: list[Array], torque: Array | None) -> tuple[Array, Array]:
                x = np.zeros((parts[0].shape[0], whole))
                x[:, :size], x[:, at_ring + ages - 1] = parts[0], parts[1][:, 0]
                x[:, at_last:at_torque] = parts[2]
                if self.sampled and torque is not None:
                    x += parts[4] @ torque
                return x, parts[3] + (parts[4] @ Qu if self.sampled and torque is not None else 0.0)

            Qx, Qu = np.zeros((n, whole)), np.zeros((n, len(inputs)))
            if self.sampled and not asked:
                Qx[:, at_torque:] = np.eye(n)
            else:
                Qx, Qu = widened(seen(self.law, "torque"), None)
                Qu = Qu.copy()
                Qu[:, 1:3] = 0.0  # at this sample the law has not seen them yet
                Qu[:, 4:] = 0.0
            if self.sampled:
                F[:size] += driving @ Qx
                E[:size] += driving @ Qu
                F[at_torque:], E[at_torque:] = Qx, Qu
            fx, fu = widened(seen(block, "f"), Qx)
            sx, su = (fx, fu.copy()) if self.problem.sensor.states == 0 else (np.zeros((1, whole)), np.zeros_like(fu))
            if self.problem.sensor.states:
                sx[0, z0 + self.parts["filter"].start] = 1.0
            su[0, 3] += 1.0
            F[at_ring], E[at_ring] = sx[0], su[0]
            for age in range(1, ages):
                F[at_ring + age, at_ring + age - 1] = 1.0
            if lasts:
                lx, lu = widened(seen(block, "last"), None)
                F[at_last:at_torque], E[at_last:at_torque] = lx, lu
            rx = np.zeros((3, whole))
            rx[:, :size] = block["q"]["r"] @ Tq
            return F, E, np.vstack([fx, rx, Qx]), np.vstack([fu, np.zeros((3, len(inputs))), Qu])

        F, E, Cx, Du = row_map(True)
        if self.problem.hold > 1:
            F2, E2, _, _ = row_map(False)
            for _ in range(self.problem.hold - 1):
                F, E = F2 @ F, F2 @ E + E2
        names += [
            Quantity("reading" if ages == 1 else f"reading, {age + 1} samples old", "N", "sensor" if ages == 1 else "delay")
            for age in range(ages)
        ]
        names += [Quantity(f"{what}[{joint}]", unit, "encoder") for what, unit in (("read q", "rad"), ("read v", "rad/s"))
                  for joint in joints][:lasts]  # fmt: skip
        names += [Quantity(f"held torque[{joint}]", "N m", "hold") for joint in joints][:held]
        outputs = [Quantity("contact force", "N"), *(Quantity(f"tip {axis}", "m") for axis in "xyz"),
                   *(Quantity(f"torque[{name}]", "N m") for name in joints)]  # fmt: skip
        keep = _moving(F, Cx, self.problem.hold <= 1)
        surface = np.zeros(whole, dtype=bool)
        surface[s0 : s0 + 2] = True
        keep |= surface
        normal = np.zeros(whole)
        normal[:size] = self.G[0] @ Tq
        pick = np.flatnonzero(keep)
        return LinearLoop(
            A=F[np.ix_(pick, pick)], B=E[pick], C=Cx[:, pick], D=Du, dt=h * max(self.problem.hold, 1),
            states=tuple(names[i] for i in pick), inputs=tuple(inputs), outputs=tuple(outputs),
            time=self.instant.time, scenario=self.problem.scenario, mode=self.instant.mode, soft=soft,
            closure=self._closure_poles(), normal=normal[pick],
        )  # fmt: skip

    def _states_of_z(self) -> list[Quantity]:
        """Return what the states beside q and q̇ are."""
        names: list[Quantity] = []
        joints = self.problem.robot.joint_names
        for part, where in self.parts.items():
            member = {"law": self.problem.law.member, "compensation": self.problem.compensation.member}.get(part)
            if member is not None:
                own = list(member.states) + [f"{name}[{joint}]" for name in member.joint_states for joint in joints]
                names += [Quantity(f"{part} {name}", "", part) for name in own]
            elif part == "transmission" and where.stop > where.start:
                names += [Quantity(f"motor[{joint}]", "rad", part) for joint in joints]
                names += [Quantity(f"motor rate[{joint}]", "rad/s", part) for joint in joints]
            else:
                named = "friction" if "friction" in part else part
                names += [Quantity(f"{part} {i + 1}", "", named) for i in range(where.stop - where.start)]
        return names

    def _closure_poles(self) -> Array:
        """Return the poles of Baumgarte's stabiliser, of e and ė alone, as the integrator makes them; (k,) complex."""
        section = self.problem.scenario.stabiliser
        if self.soft or self.instant.mode == FREE or section.kind not in ("baumgarte", "both"):
            return np.zeros(0)
        s_v, s_p = self.problem.stabiliser
        A = np.array([[0.0, 1.0], [-s_p, -s_v]])
        scheme = scheme_of(self.problem.scenario.time.integrator)
        assert scheme is not None
        step, _ = step_of(
            scheme, A, np.zeros((2, 0)), self.problem.h, np.array([1, -1]), np.zeros(2, dtype=bool)
        )
        poles: Array = np.repeat(np.linalg.eigvals(step), self.m)
        return poles


def _moving(F: Array, C: Array, whole: bool) -> Array:
    """Return which states are part of the loop: not those that stay as they are, nor those that nothing reads."""
    size = F.shape[0]
    keep = np.ones(size, dtype=bool)
    eye = np.eye(size)
    scale = float(np.max(np.abs(F)))
    while True:
        before = keep.copy()
        for i in np.flatnonzero(keep):
            others = keep.copy()
            others[i] = False
            column = np.abs(F[others, i])
            unread = not np.any(column > NONE * scale) and not np.any(np.abs(C[:, i]) > NONE)
            still = np.all(np.abs(F[i, keep] - eye[i, keep]) <= NONE * scale)
            if unread and (still or abs(F[i, i]) < NONE):
                keep[i] = False
            elif still and whole and not np.any(column > NONE * scale):
                keep[i] = False
        if np.array_equal(before, keep):
            return keep
