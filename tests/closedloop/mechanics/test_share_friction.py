"""An arm at rest with friction in its joints and at its tip: the force of least friction, and that it is said."""

import numpy as np
import pytest
from random_loop import loop_at_random
from scipy.optimize import minimize

import closedloop as cl
from closedloop.jit.interpreted import interpreted
from closedloop.loop.step.joint_friction import share_friction
from closedloop.loop.step.memory import RIGID_STICK
from closedloop.mechanics.closure.contact_force import STUCK, factorise
from closedloop.record.report.tables import report_rows

MU = 0.4
RUBBING = {
    "friction.kind": "coulomb", "friction.coefficient": MU, "joint_friction.kind": "coulomb",
    "joint_friction.kinetic": 0.5,
}  # fmt: skip


@pytest.mark.parametrize("seed", range(6))
def test_forces_at_rest_are_those_of_least_friction(seed):
    """They hold the arm as those before, keep the limits and the cone, and no others that do so have less; by SLSQP."""
    loop, H, _ = loop_at_random("wam_bounce", RUBBING)
    rng = np.random.default_rng(seed)
    state, constants, w = loop.state, loop.constants, loop.w
    w.tip.A[:] = rng.normal(size=(3, 4))
    assert interpreted(factorise)(H, w.tip.A, w.L, w.tip.X, w.tip.S, constants.reach, np.full(4, 4)) == 0
    state.mode, state.friction.sticking, state.settings.unilateral = STUCK, RIGID_STICK, 1
    limit = rng.uniform(0.2, 2.0, size=4)
    w.joint_friction.limit[:], w.v[:], w.qdd[:], w.joint_friction.viscous[:] = limit, 0.0, 0.0, 0.0
    w.tip.F[:] = [10.0, *rng.uniform(-2.5, 2.5, size=2)]
    w.joint_friction.torque[:] = rng.uniform(-1.0, 1.0, size=4) * limit
    w.tip.rigid_force, w.tip.a[:] = w.tip.F[0], -w.tip.S @ w.tip.F
    given = w.tip.A.T @ w.tip.F + w.joint_friction.torque
    interpreted(share_friction)(w, constants, state)
    np.testing.assert_allclose(w.tip.A.T @ w.tip.F + w.joint_friction.torque, given, rtol=0, atol=1e-13)
    np.testing.assert_allclose(w.tip.S @ w.tip.F + w.tip.a, 0.0, atol=1e-10)
    assert w.tip.rigid_force == pytest.approx(w.tip.F[0], rel=1e-14)
    assert np.all(np.abs(w.joint_friction.torque) <= limit + 1e-12)
    assert np.hypot(w.tip.F[1], w.tip.F[2]) <= MU * w.tip.F[0]

    def friction(F):
        return F[1] ** 2 + F[2] ** 2 + np.sum((given - w.tip.A.T @ F) ** 2)

    bounds = [
        {"type": "ineq", "fun": lambda F: limit - (given - w.tip.A.T @ F)},
        {"type": "ineq", "fun": lambda F: limit + (given - w.tip.A.T @ F)},
    ]
    best = minimize(
        friction, w.tip.F.copy(), constraints=bounds, method="SLSQP", options={"ftol": 1e-15, "maxiter": 500}
    )
    if np.hypot(best.x[1], best.x[2]) < MU * best.x[0]:
        np.testing.assert_allclose(w.tip.F, best.x, rtol=0, atol=1e-5)


def test_a_moving_joint_leaves_the_forces_as_they_are():
    """The force is then determined."""
    loop, _, _ = loop_at_random("wam_bounce", RUBBING)
    w = loop.w
    loop.state.mode, w.v[:], w.qdd[:], w.joint_friction.limit[:] = STUCK, [0.0, 1e-3, 0.0, 0.0], 0.0, 0.5
    before = w.tip.F.copy()
    interpreted(share_friction)(w, loop.constants, loop.state)
    np.testing.assert_array_equal(w.tip.F, before)


def test_the_force_at_rest_is_the_same_in_both_engines_and_said_not_to_be_determined():
    """A law that balances gravity and presses with 10 N presses with 10 N, row for row."""
    changes = RUBBING | {"joint_friction.kinetic": 0.35, "reference.kind": "hold", "time.duration": 0.03}
    for engine in ("pinocchio", "compiled"):
        run = cl.simulate(cl.load_scenario("planar2_slide", changes), engine=engine)
        np.testing.assert_allclose(run.contact_force, 10.0, rtol=1e-12)
        assert run.summary()["force_not_determined_from"] == 0.0
        rows = {row[0]: row for row in report_rows(run)}
        assert rows["f not determined by rigid bodies"][1] == "from 0"
    smooth = cl.simulate(cl.load_scenario("planar2_slide", {"time.duration": 0.01}), engine="compiled")
    assert smooth.summary()["force_not_determined_from"] is None
