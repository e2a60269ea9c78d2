"""The memory of a loop that is ready to run, with everything in it drawn: for kernels, one at a time."""

import numpy as np

import closedloop as cl
from closedloop.jit.interpreted import interpreted
from closedloop.mechanics.closure.contact_force import factorise


def loop_at_random(scenario, changes, seed=0):
    """The memory of a scenario's loop, interpreted, with a random H, rows of the tip, velocities and states."""
    problem = cl.prepare(cl.load_scenario(scenario, changes))
    loop, rng = problem.loop(), np.random.default_rng(seed)
    problem.connect(loop, compiled=False)
    state, constants, w = loop.state, loop.constants, loop.w
    root = rng.normal(size=(state.n, state.n))
    ends = problem.robot.tree.ends
    H = (root @ root.T + np.eye(state.n)) * (ends[:, None] == ends)  # as of trees that no joint connects
    w.tip.A[:], w.v[:], w.z[:], w.tip.carried[:] = (
        rng.normal(size=x.shape) for x in (w.tip.A, w.v, w.z, w.tip.carried)
    )
    assert interpreted(factorise)(H, w.tip.A, w.L, w.tip.X, w.tip.S, constants.reach, ends) == 0
    w.tip.u[:] = w.tip.A @ w.v - w.tip.carried
    return loop, H, rng
