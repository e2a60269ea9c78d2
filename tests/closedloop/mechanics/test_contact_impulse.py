"""One impact through the simulator: the tip starts on the surface, moving into it, so the first event is at t = 0.

The row at t = 0 is recorded after the event.
"""

import numpy as np
import pinocchio as pin
import pytest
from budget import budget
from rounding import within

import closedloop as cl
from closedloop.mechanics.impact import two_phase_impact
from robot_models import load

ARMS = {name: cl.Robot(load(name)) for name in ("planar2", "wam4", "panda")}
SCENARIO = {"wam4": "wam_bounce", "panda": "panda_touchdown", "planar2": "planar2_drop"}


def draw(arm, seed):
    """Return a random q, a q̇ that takes the tip into the surface, and the surface's normal."""
    robot, rng = ARMS[arm], np.random.default_rng(seed)
    q = rng.uniform(robot.model.position_lower, robot.model.position_upper)
    v = rng.normal(size=robot.n)
    normal = rng.normal(size=3)
    if arm == "planar2":
        normal[1] = 0.0
    normal /= np.linalg.norm(normal)
    approach = normal @ robot.terms(q, v).jacobian @ v
    return q, -np.sign(approach) * v, normal


def strike(arm, q, v, normal, **changes):
    """Return the run of one step that begins with an impact."""
    scenario = {
        "start.q": q.tolist(),
        "start.v": v.tolist(),
        "surface.normal": normal.tolist(),
        "surface.gap": 0.0,
        "reference": {"kind": "hold"},
        "time.duration": 0.001,
    }
    return cl.simulate(cl.load_scenario(SCENARIO[arm], scenario | changes), model=ARMS[arm].model)


@pytest.mark.parametrize("restitution", [0.0, 0.4, 1.0])
@pytest.mark.parametrize("arm", ARMS)
def test_impulse_and_velocity_are_pinocchios(arm, restitution):
    """Impulse and q̇ after the impact are those of pinocchio.impulseDynamics, to 1e-10 of their size."""
    robot = ARMS[arm]
    model = robot.model.pinocchio_model()
    data = model.createData()
    for seed in range(8):
        q, v, normal = draw(arm, seed)
        run = strike(arm, q, v, normal, **{"impact.restitution": restitution})
        terms = robot.terms(q, v)
        A = np.ascontiguousarray((normal @ terms.jacobian)[None])
        expected = pin.impulseDynamics(model, data, q, v, A, restitution, 0.0)
        event = run.events[0]
        assert event.time == 0.0
        assert event.kind == ("touchdown" if restitution == 0.0 else "impact")
        assert event.rate_before == pytest.approx(A[0] @ v, rel=1e-12, abs=1e-14)
        assert event.rate_after == pytest.approx(-restitution * event.rate_before, abs=1e-12)
        impulse = event.compression + event.decompression
        assert impulse == pytest.approx(data.impulse_c[0], rel=1e-10)
        assert np.max(np.abs(run.v[0] - expected)) < 1e-10 * (1 + np.max(np.abs(expected)))
        assert np.array_equal(run.q[0], q)
        assert within(64, event.position, terms.position)


@pytest.mark.slow  # the loop with friction takes half a minute to compile
@pytest.mark.parametrize("friction", [0.1, 0.4, 1.0])
@pytest.mark.parametrize("law", ["newton", "poisson", "stronge"])
@pytest.mark.parametrize("arm", ["wam4", "panda"])
def test_an_impact_with_friction_is_the_one_of_its_law(arm, law, friction):
    """What the run logs, and q̇ after it, is what `two_phase_impact` gives for the mobility and velocity of that state.

    The tangential impulse is turned from the contact frame into the base frame. The worst of 360 impacts is
    off by 1.1e-14 of the impulse.
    """
    robot, met = ARMS[arm], set()
    for seed in range(budget(8, 20)):
        q, v, normal = draw(arm, seed)
        restitution = [0.0, 0.3, 0.7, 1.0][seed % 4]
        changes = {"impact.restitution": restitution, "impact.law": law, "friction.kind": "coulomb"}
        run = strike(arm, q, v, normal, **changes | {"friction.coefficient": friction})
        frame = cl.prepare(run.scenario, robot.model).frame
        terms = robot.terms(q, v)
        A = frame @ terms.jacobian
        S = A @ np.linalg.solve(terms.mass_matrix, A.T)
        hit = two_phase_impact(0.5 * (S + S.T), A @ v, restitution, law, friction)
        met |= set(hit.modes)
        event, size = run.events[0], 1e-12 * np.linalg.norm(hit.impulse)
        assert event.compression == pytest.approx(hit.compression[0], abs=size)
        assert event.decompression == pytest.approx(hit.decompression[0], abs=size)
        assert event.tangential == pytest.approx(frame[1:].T @ hit.impulse[1:], abs=size)
        assert event.energy_lost == pytest.approx(hit.energy_lost, abs=1e-12 * (1 + v @ terms.mass_matrix @ v))
        assert event.rate_after == pytest.approx(hit.after[0], abs=1e-12)
        assert event.slip_after == pytest.approx(np.hypot(*hit.after[1:]), abs=1e-12)
        after = v + np.linalg.solve(terms.mass_matrix, A.T @ hit.impulse)
        assert run.v[0] == pytest.approx(after, abs=1e-12 * (1 + np.max(np.abs(after))))
    assert met >= {"slip", "turn"} | ({"stick"} if friction == 1.0 else set())


def test_a_bounce_slower_than_rest_speed_is_cut_and_said():
    """What restitution would have given, below rest_speed, is in rate_cut; the impact then has no decompression."""
    q, v, normal = draw("wam4", 3)
    approach = -normal @ ARMS["wam4"].terms(q, v).jacobian @ v
    slow = v * 1e-3 / approach
    run = strike("wam4", q, slow, normal, **{"impact.restitution": 0.5, "impact.rest_speed": 6e-4})
    assert run.events[0].kind == "touchdown"
    assert run.events[0].rate_cut == pytest.approx(5e-4, rel=1e-9)
    assert run.events[0].decompression == 0.0
    run = strike("wam4", q, slow, normal, **{"impact.restitution": 0.5, "impact.rest_speed": 4e-4})
    assert run.events[0].kind == "impact"
    assert run.events[0].rate_cut == 0.0
    assert run.events[0].rate_after == pytest.approx(5e-4, rel=1e-9)
