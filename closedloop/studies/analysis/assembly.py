"""The force loop as a linear system, put together from what is reduced to free coordinates, and one step of it.

One step by each integrator has its inputs constant over the step but for its beginning.

    ẋ = A x + B₀ u  at the beginning,  A x + B u  within the step:    x⁺ = Φ x + Γ u

A scheme of Runge and Kutta gives polynomials in h A, and exponentials of what decays by itself, the semi-implicit one
lets positions advance with the new velocities, and an integrator that chooses its own steps the exponential, which is
exact. B₀ is that of the first stage: what a sampled sensor reads changes at a row, between the law's evaluation there
and those within the step. Of schemes of one stage it is the whole step, of the exponential no part.

Of the equation of motion the derivatives are taken at one state of a run, by the kernels of that run (`here`). With
the closure they are reduced to what it leaves free (`reduced`), carried over a step as the scenario's integrator would
(`step_of`), and put together with what happens to samples (`assembled`): the sensor's delay, the hold of a sampled
torque, the encoders. The result is x⁺ = A x + B u, y = C x + D u from one sample of the
law to the next.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from closedloop.base.arguments import arguments_checked
from closedloop.base.arrays import Array, ComplexArray
from closedloop.base.errors import ScenarioError
from closedloop.mechanics.integrators import ADAPTIVE, AdaptiveIntegrator, Scheme, scheme_of
from closedloop.scenario.load import Variants
from closedloop.scenario.scenario import Scenario
from closedloop.simulation.cache import Cache
from closedloop.simulation.engines.problem import Problem
from closedloop.simulation.prepare import prepare
from closedloop.studies.analysis.here import Instant, refuse_outside, row_at, run_to, without_event
from closedloop.studies.analysis.linear_loop import OUTSIDE, LinearLoop, Quantity
from closedloop.studies.analysis.reduced import Reduced
from robot_models import RobotModel


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
    inputs, outputs = _inputs(r), _outputs(r)
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
    pick, names = np.flatnonzero(keep), _names(r, ages, lasts, held)
    return LinearLoop(
        A=F[np.ix_(pick, pick)], B=E[pick], C=C[:, pick], D=D, dt=r.problem.h * max(r.problem.hold, 1),
        states=tuple(names[i] for i in pick), inputs=inputs, outputs=outputs, time=r.instant.time,
        scenario=r.problem.scenario, mode=r.instant.mode, soft=r.soft, closure=_closure_poles(r),
        normal=normal[pick], held_force=r.rigid or _one_stage(r.problem),
    )  # fmt: skip


def _inputs(r: Reduced) -> tuple[Quantity, ...]:
    return (
        Quantity("force command", "N"), Quantity("surface acceleration", "m/s²"), Quantity("load", "N"),
        Quantity("sensor noise", "N"), *(Quantity(f"torque[{name}]", "N m") for name in r.problem.robot.joint_names),
    )  # fmt: skip


def _outputs(r: Reduced) -> tuple[Quantity, ...]:
    contacts = () if r.here.contacts is None else r.here.contacts.names
    return (
        Quantity("contact force", "N"), *(Quantity(f"tip {axis}", "m") for axis in "xyz"),
        *(Quantity(f"torque[{name}]", "N m") for name in r.problem.robot.joint_names), Quantity("force felt", "N"),
        *(Quantity(f"contact force[{name}]", "N") for name in contacts),
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


def _one_stage(problem: Problem) -> bool:
    scheme = _scheme(problem)
    return scheme.stages == 1 and not issubclass(scheme, AdaptiveIntegrator)


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
    refuse_outside(scenario, at)  # before the path is made, which takes a while
    problem = prepare(scenario, model, cache)
    instant = instant_of(scenario, problem, at, model)
    return loop_at(problem, instant)


def instant_of(scenario: Scenario, problem: Problem, at: float, model: RobotModel | None = None) -> Instant:
    """Return the state of a scenario's run at an instant; with an integrator that chooses its steps, by rk4."""
    row = row_at(problem, at)
    return run_to(of_fixed_steps(problem, model), row)


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


def loop_at(problem: Problem, instant: Instant, free: bool = False) -> LinearLoop:
    """Return the loop of a problem at the state of an instant, which may be that of a run with other gains.

    In flight there is only a loop of motion, which is returned if `free` says that it is meant.
    """
    with without_event(instant.time):
        return assembled(Reduced(problem, instant, free))
