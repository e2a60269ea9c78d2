"""Andrews' squeezing mechanism: the seven bodies as a robot, and the test set's own equations.

K1 turns about the origin, driven by a constant torque, and carries K2; K3, K4 on K5 and K6 on K7 turn about two fixed
points, and all meet K2's end: three loops. A spring draws K3. It is fast: β turns by 16 rad in 0.03 s.

The row of four-bars of the IFToMM library (A02): N windows of bars of one length, all one parallelogram.

It lies flat twice a turn. There N rows are lost at once, each window could go on in two ways, and the velocity says in
which they go on. As one parallelogram it has one coordinate, the angle of its uprights, whose equation is a pendulum's.

Published benchmarks of multibody dynamics that have loops, held against their printed values.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

import closedloop as cl
import robot_models
from closedloop.record.run import Run
from robot_models import RobotModel
from validation.anchors.problem import read
from validation.loops.cases import joint, loop, point
from validation.oracle.spatial import Array
from validation.report import Check, Section

NAMES = ("beta", "theta", "gamma", "phi", "delta", "omega", "epsilon")
"""The order of the test set."""
MEETING = ("K3", "K4", "K6")
"""The bodies that meet K2's end, in the order of the test set's multipliers."""
VERTICAL = "0 0 1"


@dataclass(frozen=True)
class Squeezed:
    """The mechanism at an instant, in the order of the test set.

    position, velocity, acceleration : (7,) rad, rad/s, rad/s²
    forces : (3,) sizes of the forces in the three loops, N
    """

    position: Array
    velocity: Array
    acceleration: Array
    forces: Array


def printed() -> tuple[Squeezed, Squeezed]:
    """Return what the test set prints of the start and of the end."""
    data = read("andrews")

    def printed_at(names: tuple[str, str], position: Array, velocity: Array) -> Squeezed:
        acceleration, multipliers = (np.array(data[name]) for name in names)
        return Squeezed(position, velocity, acceleration, np.linalg.norm(multipliers.reshape(3, 2), axis=1))

    start = printed_at(("start_acceleration", "start_multipliers"), np.array(data["start"]), np.zeros(7))
    end = np.array(data["position"]), np.array(data["velocity"])
    return start, printed_at(("acceleration", "multipliers"), *end)


@lru_cache(maxsize=1)
def andrews() -> RobotModel:
    """Return the mechanism, its axes vertical, so that weight does nothing, at home where the test set starts.

    Of a body that turns about a fixed point only how far its centre of mass is from there matters.
    """
    d = read("andrews")
    centres = [(d["ra"], 0.0), (-d["da"], 0.0), (d["sb"], -d["sa"]), (0.0, d["ea"] - d["e"]), (d["ta"], d["tb"]),
               (d["zf"] - d["fa"], 0.0), (d["ua"], d["ub"])]  # fmt: skip
    body = "".join(_body(k, at) for k, at in enumerate(centres, start=1))
    for name, parent, child, x, y in (
        ("beta", "base", "K1", 0.0, 0.0), ("theta", "K1", "K2", d["rr"], 0.0),
        ("gamma", "base", "K3", d["xb"], d["yb"]),
        ("delta", "base", "K5", d["xa"], d["ya"]), ("phi", "K5", "K4", d["zt"], 0.0),
        ("epsilon", "base", "K7", d["xa"], d["ya"]), ("omega", "K7", "K6", 0.0, -d["u"]),
    ):  # fmt: skip
        body += joint(name, parent, child, f"{x!r} {y!r} 0", VERTICAL)
    body += point("end", "K2", f"{-d['d']!r} 0 0")
    ends = ((0.0, -d["ss"], 0.0), (0.0, -d["e"], 0.0), (d["zf"], 0.0, 0.0))
    loops = [
        loop(name, "point", ["end", name], points=[[0.0, 0.0, 0.0], list(at)])
        for name, at in zip(MEETING, ends, strict=True)
    ]
    text = f'<robot name="andrews"><link name="base"/>{body}</robot>'
    start = dict(zip(NAMES, d["start"], strict=True))

    def built(home: list[float]) -> RobotModel:
        return robot_models.from_text(
            text, "urdf", name="andrews", armature=np.zeros(7), tip="end", home=home, locked={}, loops=loops
        )

    return built([start[name] for name in built([0.0] * 7).joint_names])


def _body(k: int, centre: tuple[float, float]) -> str:
    """Return body K_k with its centre of mass, m; the moments that a planar motion does not feel are made up."""
    data = read("andrews")
    mass, moment = data["m"][k - 1], data["i"][k - 1]
    return (
        f'<link name="K{k}"><inertial><origin xyz="{centre[0]!r} {centre[1]!r} 0"/><mass value="{mass!r}"/>'
        f'<inertia ixx="{moment!r}" iyy="{moment!r}" izz="{moment!r}" ixy="0" ixz="0" iyz="0"/></inertial></link>'
    )


def spring_torque(data: dict[str, Any], gamma: float) -> float:
    """Return the torque of the spring on K3, N m."""
    cos, sin = np.cos(gamma), np.sin(gamma)
    across, along = data["sd"] * sin - data["sc"] * cos, data["sd"] * cos + data["sc"] * sin
    x, y = along + data["xb"] - data["xc"], across + data["yb"] - data["yc"]
    length = np.hypot(x, y)
    return float(-data["c0"] * (length - data["l0"]) / length * (y * along - x * across))


def squeezed(step: float, duration: float, engine: str = "pinocchio") -> tuple[Squeezed, Squeezed]:
    """Return start and end of a run of the mechanism, by rk4 with steps of `step`, s.

    Raises `RuntimeError` if the run stopped.
    """
    model, data = andrews(), read("andrews")
    order = [model.joint_names.index(name) for name in NAMES]
    beta, gamma = order[0], order[2]
    mom = data["mom"]

    def law(t: float, q: Array, v: Array, terms: Any) -> Array:
        torque = np.zeros(7)
        torque[beta], torque[gamma] = mom, spring_torque(data, q[gamma])
        return torque

    scenario = coasting(model, list(model.home), [0.0] * 7, duration, step)
    run = cl.simulate(scenario, model=model, law=law, engine=engine)
    if run.stopped or run.loops is None:
        raise RuntimeError(run.stopped)
    q, v, a = (np.array(x)[:, order] for x in (run.q, run.v, run.acceleration))
    forces = np.linalg.norm(run.loops.reactions.reshape(-1, 3, 3), axis=2)
    start, end = (Squeezed(q[k], v[k], a[k], forces[k]) for k in (0, -1))
    return start, end


def coasting(model: RobotModel, q: list[float], v: list[float], duration: float, step: float) -> cl.Scenario:
    """Return a run of a mechanism whose tip touches nothing."""
    far = 10.0 * (1.0 + model.n)
    changes: dict[str, Any] = {
        "start.q": q, "start.v": v, "reference": {"kind": "hold"}, "stabiliser": {"kind": "none"},
        "law": {"kind": "paper", "kp": 0.0, "kd": 0.0, "force": 0.0},
        "surface": {"kind": "plane", "normal": [1, 0, 0], "offset": "start", "gap": far, "contact": "unilateral"},
        "time.duration": duration, "time.step": step, "time.integrator": "rk4",
    }  # fmt: skip
    return cl.load_scenario("planar2_slide", changes)


def by_its_equations() -> Squeezed:
    """Return the same by the test set's equations, M q̈ + Gᵀλ = f and G q̈ = −Ġ q̇, with scipy's DOP853.

    Ġ q̇ is a complex step of G along q̇: it has no truncation.
    """
    data = read("andrews")

    def rates(t: float, y: Array) -> Array:
        return np.concatenate([y[7:], _solved(data, y[:7], y[7:])[0]])

    start = np.concatenate([data["start"], np.zeros(7)])
    end = solve_ivp(rates, (0.0, data["time"]), start, method="DOP853", rtol=3e-14, atol=1e-14).y[:, -1]
    acceleration, multipliers = _solved(data, end[:7], end[7:])
    return Squeezed(end[:7], end[7:], acceleration, np.linalg.norm(multipliers.reshape(3, 2), axis=1))


def _solved(d: dict[str, Any], q: Array, v: Array) -> tuple[Array, Array]:
    """Return q̈ (7,) and λ (6,)."""
    tiny = 1e-30
    drift = np.imag(_rows(d, q + 1j * tiny * v)) @ v / tiny
    G = _rows(d, q)
    K = np.block([[_mass(d, q), G.T], [G, np.zeros((6, 6))]])
    found = np.linalg.solve(K, np.concatenate([_forces(d, q, v), -drift]))
    return found[:7], found[7:]


def _mass(d: dict[str, Any], q: Array) -> Array:
    theta, phi, omega = q[1], q[3], q[5]
    m, i, M = d["m"], d["i"], np.zeros((7, 7))
    fold, e, z = d["da"] * d["rr"] * np.cos(theta), d["e"] - d["ea"], d["zf"] - d["fa"]
    M[0, 0] = m[0] * d["ra"] ** 2 + m[1] * (d["rr"] ** 2 - 2.0 * fold + d["da"] ** 2) + i[0] + i[1]
    M[0, 1] = M[1, 0] = m[1] * (d["da"] ** 2 - fold) + i[1]
    M[1, 1] = m[1] * d["da"] ** 2 + i[1]
    M[2, 2] = m[2] * (d["sa"] ** 2 + d["sb"] ** 2) + i[2]
    M[3, 3], lean = m[3] * e**2 + i[3], d["zt"] * e * np.sin(phi)
    M[3, 4] = M[4, 3] = M[3, 3] + m[3] * lean
    M[4, 4] = M[3, 3] + m[3] * (d["zt"] ** 2 + 2.0 * lean) + m[4] * (d["ta"] ** 2 + d["tb"] ** 2) + i[4]
    M[5, 5], lean = m[5] * z**2 + i[5], d["u"] * z * np.sin(omega)
    M[5, 6] = M[6, 5] = M[5, 5] - m[5] * lean
    M[6, 6] = M[5, 5] + m[5] * (d["u"] ** 2 - 2.0 * lean) + m[6] * (d["ua"] ** 2 + d["ub"] ** 2) + i[6]
    return M


def _forces(d: dict[str, Any], q: Array, v: Array) -> Array:
    """Return what drives, draws, and turns with the velocities."""
    m, turn = d["m"], d["m"][1] * d["da"] * d["rr"] * np.sin(q[1])
    bend = m[3] * d["zt"] * (d["e"] - d["ea"]) * np.cos(q[3])
    swing = m[5] * d["u"] * (d["zf"] - d["fa"]) * np.cos(q[5])
    return np.array([
        d["mom"] - turn * v[1] * (v[1] + 2.0 * v[0]), turn * v[0] ** 2, spring_torque(d, q[2]), bend * v[4] ** 2,
        -bend * v[3] * (v[3] + 2.0 * v[4]), -swing * v[6] ** 2, swing * v[5] * (v[5] + 2.0 * v[6]),
    ])  # fmt: skip


def _rows(d: dict[str, Any], q: Array) -> Array:
    """Return G (6, 7): how K2's end moves away from the points of K3, K4 and K6."""
    beta, theta, gamma, phi, delta, omega, epsilon = q
    G = np.zeros((6, 7), dtype=q.dtype)
    for row in (0, 2, 4):
        G[row, 1] = d["d"] * np.sin(beta + theta)
        G[row + 1, 1] = -d["d"] * np.cos(beta + theta)
        G[row, 0] = G[row, 1] - d["rr"] * np.sin(beta)
        G[row + 1, 0] = G[row + 1, 1] + d["rr"] * np.cos(beta)
    G[0:2, 2] = -d["ss"] * np.cos(gamma), -d["ss"] * np.sin(gamma)
    G[2:4, 3] = -d["e"] * np.cos(phi + delta), -d["e"] * np.sin(phi + delta)
    G[2:4, 4] = G[2, 3] + d["zt"] * np.sin(delta), G[3, 3] - d["zt"] * np.cos(delta)
    G[4:6, 5] = d["zf"] * np.sin(omega + epsilon), -d["zf"] * np.cos(omega + epsilon)
    G[4:6, 6] = G[4, 5] - d["u"] * np.cos(epsilon), G[5, 5] - d["u"] * np.sin(epsilon)
    return G


def windows(count: int) -> RobotModel:
    """Return a row of so many windows, upright: D0 ... are the joints of the uprights, C0 ... of the bars on top."""
    data = read("n_four_bar")
    length, mass = data["length"], data["mass"]
    moment = mass * length**2 / 12.0
    body, loops = "", []
    for k in range(count + 1):
        names = ("d", "c") if k < count else ("d",)
        for kind in names:
            body += (
                f'<link name="{kind}{k}"><inertial><origin xyz="{length / 2} 0 0"/><mass value="{mass}"/>'
                f'<inertia ixx="{moment!r}" iyy="{moment!r}" izz="{moment!r}" ixy="0" ixz="0" iyz="0"/>'
                "</inertial></link>"
            )
        body += joint(f"D{k}", "base", f"d{k}", f"{k * length} 0 0")
        if k < count:
            body += joint(f"C{k}", f"d{k}", f"c{k}", f"{length} 0 0")
            ends = [[length, 0.0, 0.0]] * 2
            loops.append(loop(f"B{k + 1}", "point", [f"c{k}", f"d{k + 1}"], points=ends))
    text = f'<robot name="windows"><link name="base"/>{body}</robot>'
    n = 2 * count + 1

    def built(home: Array) -> RobotModel:
        return robot_models.from_text(
            text, "urdf", name="windows", armature=np.zeros(n), tip="d0", home=home, locked={}, loops=loops
        )

    return built(np.array([np.pi / 2 * side for side in _sides(built(np.zeros(n)))]))


def _sides(model: RobotModel) -> list[float]:
    """Return 1 for the joint of an upright, and −1 for that of a bar, which turns back as much."""
    return [1.0 if name.startswith("D") else -1.0 for name in model.joint_names]


def falling(count: int, duration: float, step: float, engine: str = "pinocchio") -> Run:
    """Return the run of so many windows that fall as the benchmark's do, by rk4."""
    model, data = windows(count), read("n_four_bar")
    speed = data["speed"] / data["length"]
    start = [-speed * side for side in _sides(model)]
    scenario = coasting(model, list(model.home), start, duration, step)

    def no_torque(t: float, q: Array, v: Array, terms: object) -> Array:
        return np.zeros(model.n)

    return cl.simulate(scenario, model=model, law=no_torque, engine=engine)


def lean(run: Run) -> Array:
    """Return by how much each upright (N, count + 1) leans from the vertical, rad."""
    at = [j for j, name in enumerate(run.model.joint_names) if name.startswith("D")]
    return np.pi / 2 - np.asarray(run.q)[:, at]


def lean_of_a_pendulum(count: int, times: Array) -> Array:
    """Return the same (N,) by the equation of its one coordinate, with scipy's DOP853."""
    data = read("n_four_bar")
    inertia = (count + 1) * data["length"] / 3.0 + count * data["length"]
    weight = data["gravity"] * ((count + 1) / 2.0 + count)

    def rates(t: float, y: Array) -> Array:
        return np.array([y[1], weight / inertia * np.sin(y[0])])

    start = (0.0, data["speed"] / data["length"])
    found = solve_ivp(rates, (0.0, times[-1]), start, method="DOP853", rtol=1e-13, atol=1e-14, t_eval=times)
    return np.asarray(found.y[0])


LOOP = "closedloop"
ANDREWS_STEP = 5e-6
"""s: rk4 leaves 1e-11 of the velocities, as half and double this step show."""
ANDREWS_START = {"acceleration": 1e-12, "forces": 1e-12}
ANDREWS_PRINTED = {"position": 2e-10, "velocity": 1e-9, "acceleration": 2e-7, "forces": 2e-7}
"""Relative to the largest of each. What is printed is the motion 1.0e-12 s later, to all its digits: the error of its
own integration, at tolerances of 1e-14; the test set's equations end where ours do."""
ANDREWS_EQUATIONS = {"position": 5e-12, "velocity": 5e-11, "acceleration": 5e-10, "forces": 5e-10}
FALLING_STEP = 0.005
FALLING_PRINTED = 1e-6
"""m: six digits are printed, and ADAMS errs by less than one of the last."""
FALLING_EQUATION = 2e-8
"""rad: rk4 over two seconds at this step."""
ENERGY = 1e-8
CLOSED = 1e-12


def compare_with_published(quick: bool) -> Section:
    """Compare runs of published mechanisms with what is printed of them, and with their own equations.

    Quick, what takes more than a few seconds is left out: the forty windows, and energy over a minute.
    """
    section = Section("published mechanisms with loops: values as printed")
    section.checks += _andrews()
    section.checks += _windows(2)
    if not quick:
        section.checks += _windows(read("n_four_bar")["windows"])
        section.checks += _for_long("IFToMM A02, two windows", falling(2, 60.0, FALLING_STEP))
        section.checks += _for_long("IFToMM A04, Bricard", bricard_of_rods(10.0, 0.002))
    return section


def _andrews() -> list[Check]:
    data = read("andrews")
    (start, end), (start_printed, end_printed) = squeezed(ANDREWS_STEP, data["time"]), printed()
    cases = (
        ("at the start", start, start_printed, ANDREWS_START, data["source"]),
        ("as printed", end, end_printed, ANDREWS_PRINTED, data["source"]),
        ("by the test set's equations", end, by_its_equations(), ANDREWS_EQUATIONS, "rk4 beside scipy's DOP853"),
    )
    checks = []
    for what, found, truth, bounds, note in cases:
        for name, bound in bounds.items():
            error = apart(getattr(found, name), getattr(truth, name))
            checks.append(Check(f"Andrews' squeezer, {name} {what}", LOOP, error, bound, error <= bound, note))
    return checks


def apart(found: Array, truth: Array) -> float:
    """Return the worst error, relative to the largest entry of the truth."""
    return float(np.max(np.abs(found - truth)) / np.max(np.abs(truth)))


def _windows(count: int) -> list[Check]:
    data = read("n_four_bar")
    rows = np.array(data["positions"])
    run = falling(count, float(rows[-1, 0]), FALLING_STEP)
    leans, times = lean(run), np.asarray(run.time)
    title = f"IFToMM A02, {count} windows"
    error = float(np.max(np.abs(leans - lean_of_a_pendulum(count, times)[:, None])))
    why = "two passes flat; the equation of its one coordinate, by scipy's DOP853"
    checks = [Check(f"{title}, angle of each upright", LOOP, error, FALLING_EQUATION, error <= FALLING_EQUATION, why)]
    if count != data["windows"]:
        return checks
    at = np.searchsorted(times, rows[:, 0] - 1e-9)
    where = data["length"] * np.stack([np.sin(leans[at, 0]), np.cos(leans[at, 0])], axis=1)
    error = float(np.max(np.abs(where - rows[:, 1:])))
    passed = error <= FALLING_PRINTED
    return [*checks, Check(f"{title}, B0 as printed", LOOP, error, FALLING_PRINTED, passed, data["source"])]


def _for_long(title: str, run: Run) -> list[Check]:
    """Check energy and closure of a run in which nothing is driven."""
    kinetic = np.asarray(run.kinetic_energy)
    energy = kinetic + np.asarray(run.potential_energy)
    drift = float(np.max(np.abs(energy - energy[0])) / np.max(kinetic))
    assert run.loops is not None
    open_by = float(np.max(np.abs(run.loops.errors)))
    why = f"over {run.time[-1]:g} s, of the largest kinetic energy; no values of this motion were found"
    return [
        Check(f"{title}, energy", LOOP, drift, ENERGY, drift <= ENERGY, why),
        Check(f"{title}, closure, m", LOOP, open_by, CLOSED, open_by <= CLOSED, f"over {run.time[-1]:g} s"),
    ]


def bricard_of_rods(duration: float, step: float) -> Run:
    """Return Bricard's mechanism of the IFToMM library (A04) as it falls: five rods along edges of a cube of 1 m.

    Six hinges at right angles, where counting leaves no freedom. Its y, up, is z here.
    """
    ends = np.array([[0, 0, 0], [1, 0, 0], [1, 0, -1], [1, -1, -1], [0, -1, -1], [0, -1, 0]], dtype=float)
    axes = ("0 0 1", "0 -1 0", "1 0 0", "0 0 1", "0 -1 0")
    body = ""
    for k in range(5):
        along = ends[k + 1] - ends[k]
        before = ends[k] - ends[max(k - 1, 0)]
        body += _rod(f"rod{k}", along)
        body += joint(f"J{k}", f"rod{k - 1}" if k else "base", f"rod{k}", " ".join(map(str, before)), axes[k])
    points = [list(ends[5] - ends[4]), list(ends[5])]
    loops = [loop("last", "hinge", ["rod4", "world"], points=points, axis=[1, 0, 0])]
    text = f'<robot name="bricard_of_rods"><link name="base"/>{body}</robot>'
    model: RobotModel = robot_models.from_text(
        text, "urdf", name="bricard_of_rods", armature=np.zeros(5), tip="rod2", home=np.zeros(5), locked={}, loops=loops
    )

    def no_torque(t: float, q: Array, v: Array, terms: object) -> Array:
        return np.zeros(model.n)

    return cl.simulate(coasting(model, [0.0] * 5, [0.0] * 5, duration, step), model=model, law=no_torque)


def _rod(name: str, along: Array) -> str:
    """Return a rod of 1 kg with a square section of 0.1 m, from its origin along an edge (3,), m."""
    side = 0.1
    thin, long = side**2 / 6.0, (float(along @ along) + side**2) / 12.0
    moments = [thin if a else long for a in along]
    xyz, (x, y, z) = " ".join(map(str, along / 2.0)), moments
    return (
        f'<link name="{name}"><inertial><origin xyz="{xyz}"/><mass value="1"/>'
        f'<inertia ixx="{x!r}" iyy="{y!r}" izz="{z!r}" ixy="0" ixz="0" iyz="0"/></inertial></link>'
    )
