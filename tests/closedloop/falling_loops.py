"""Mechanisms that move without torque, and their rows: what tests of loops need."""

import numpy as np

import closedloop as cl
from closedloop.mechanics.loops.assemble import errors_at
from closedloop.mechanics.loops.bind import loop_memory
from closedloop.mechanics.robot.pinocchio import Robot


def free(model, duration=0.1, step=0.001, **changes):
    """A scenario in which nothing acts on the mechanism but its weight: the surface is out of reach."""
    changes = {
        "surface.gap": 50.0, "time.duration": duration, "time.step": step, "law.kp": 0, "law.kd": 0, "law.force": 0,
        "stabiliser.kind": "none", "start.q": [float(x) for x in model.home], "start.v": [0.0] * model.n, **changes,
    }  # fmt: skip
    return cl.load_scenario("planar2_drop", changes)


def no_torque(x):
    """A law that asks for nothing."""
    return 0.0 * x.q


def falling(model, engine="pinocchio", **changes):
    """The run of a mechanism that falls."""

    return cl.simulate(free(model, **changes), model=model, law=no_torque, engine=engine)


def rows_at(model, q, v):
    """The robot, and rows, drift, error and rate of its loops at a state."""
    robot = Robot(model)
    memory = loop_memory(robot)
    error, rate = errors_at(robot, memory, np.asarray(q), np.asarray(v))
    return robot, memory.rows.G.copy(), memory.rows.drift.copy(), error, rate


def null_space_acceleration(model, q, v, torque):
    """The acceleration of a mechanism: free along the null space of its rows, prescribed across it."""
    robot, G, drift, _, _ = rows_at(model, q, v)
    terms = robot.terms(q, v)
    U, sizes, Vt = np.linalg.svd(G)
    rank = int(np.sum(sizes > 1e-8 * sizes[0]))
    across = Vt[:rank].T @ ((U[:, :rank].T @ -drift) / sizes[:rank])
    N = Vt[rank:].T
    y = np.linalg.solve(N.T @ terms.mass_matrix @ N, N.T @ (torque - terms.bias - terms.mass_matrix @ across))
    return across + N @ y
