"""Andrews' squeezing mechanism: the seven bodies as a robot, and the test set's own equations.

K1 turns about the origin, driven by a constant torque, and carries K2; K3, K4 on K5 and K6 on K7 turn about two fixed
points, and all meet K2's end: three loops. A spring draws K3. It is fast: β turns by 16 rad in 0.03 s.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

import closedloop as cl
import robot_models
from robot_models import RobotModel
from validation.anchors.description import read
from validation.loops.mechanisms import joint, loop, point
from validation.oracle.spatial import Array

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
