"""The row of four-bars of the IFToMM library (A02): N windows of bars of one length, all one parallelogram.

It lies flat twice a turn. There N rows are lost at once, each window could go on in two ways, and the velocity says in
which they go on. As one parallelogram it has one coordinate, the angle of its uprights, whose equation is a pendulum's.
"""

import numpy as np
from scipy.integrate import solve_ivp

import closedloop as cl
import robot_models
from closedloop.record.run import Run
from robot_models import RobotModel
from validation.anchors.description import read
from validation.loops.andrews import coasting
from validation.loops.mechanisms import joint, loop
from validation.oracle.spatial import Array


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
