"""A surface that the controller does not know: [belief], and the normal estimated from force and motion."""

import numpy as np
import pytest

import closedloop as cl
from closedloop.mechanics.surface.placed import contact_frame
from closedloop.scenario.scenario import BeliefSection

HELD = {"time.duration": 0.05, "friction.kind": "coulomb", "friction.coefficient": 0.5}
SLOPE = 0.2
# A table that rises along y, under a controller that believes in a level one, at constant speed from the start.
UPHILL = {
    "surface": {"kind": "plane", "normal": [0.0, -np.sin(SLOPE), np.cos(SLOPE)]},
    "belief.surface": {"kind": "plane"},
    "law": {"kind": "operational_space", "force": 10.0},
    "sensor.axes": 3,
    "compensation": {"kind": "normal", "rate": 40.0},
    "reference": {"kind": "line", "direction": [0.3, 1.0, 0.0], "speed": 0.05, "start": 0.0, "stop": 1.0},
    "time.duration": 0.8,
}


def run_of(*changes, name="wam_slide", **options):
    """Return the run of a shipped scenario with changes."""
    given = {}
    for each in changes:
        given |= each
    return cl.simulate(cl.load_scenario(name, given), progress=False, **options)


def test_a_believed_normal_is_a_tilt():
    """A plane believed to be tilted is what a tilt of the believed normal says: f = F cos α where the tip sticks."""
    tilt = cl.load_scenario("wam_slide", {"model_error.normal": SLOPE}).model_error.tilt()
    normal = (tilt @ contact_frame([0.0, 0.0, 1.0]))[0]
    belief = run_of(HELD, {"belief.surface": {"kind": "plane", "normal": normal.tolist()}})
    assert belief.contact_force[-1] == pytest.approx(10.0 * np.cos(SLOPE), abs=1e-6)
    tilted = run_of(HELD, {"model_error.normal": SLOPE})
    assert np.allclose(belief.torque, tilted.torque, rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", ["wam_sphere", "panda_scan"])
def test_a_belief_in_what_is_there_changes_nothing(name):
    """Told the true surface and its motion, path and law do what they do without a belief."""
    scenario = cl.load_scenario(name, {"time.duration": 0.3})
    told = {"belief.surface": scenario.surface.model_dump(exclude_none=True)}
    if scenario.surface_motion.kind != "none":
        told["belief.surface_motion"] = scenario.surface_motion.model_dump(exclude_none=True)
    runs = [cl.simulate(each, progress=False) for each in (scenario, scenario.replace(told))]
    assert np.allclose(runs[0].torque, runs[1].torque, rtol=0, atol=1e-9)
    assert np.allclose(runs[0].contact_force, runs[1].contact_force, rtol=0, atol=1e-8)


def test_a_table_that_moves_unseen_is_believed_to_be_at_rest():
    """What is left out of [belief] is as it is: the same surface, at rest, where the true one rises."""
    rises = {"surface_motion": {"kind": "conveyor", "velocity": [0.0, 0.0, 0.02]}, "time.duration": 0.2,
             "surface.contact": "unilateral", "law": {"kind": "operational_space", "force": 10.0}}  # fmt: skip
    known, unseen = run_of(rises), run_of(rises, {"belief.surface_motion": {"kind": "none"}})
    assert np.allclose(known.reference_tip[-1, 2] - known.reference_tip[0, 2], 0.02 * 0.2, atol=1e-9)
    assert np.ptp(unseen.reference_tip[:, 2]) < 1e-12
    assert np.allclose(unseen.position[:, 2] - unseen.position[0, 2], 0.02 * unseen.time, atol=1e-7)


@pytest.mark.parametrize("friction", [0.0, 0.3])
def test_the_estimated_normal_is_that_of_the_slope(friction):
    """It settles like exp(−K t), from the normal believed in, to the true one; friction does not mislead it."""
    rough = {} if friction == 0.0 else {"friction.kind": "coulomb", "friction.coefficient": friction}
    run = run_of(UPHILL, rough)
    estimate = np.stack([run["compensation_normal_t1"], run["compensation_normal_t2"]], axis=1)
    true = run.surface_normal[0, :2]  # the believed tangents are x and y
    assert np.allclose(estimate[-1], true, rtol=0, atol=1e-5)
    begun = int(np.flatnonzero(np.abs(estimate[:, 1]) > 0.0)[0]) - 1
    decay = (1.0 - 40.0 * 1e-3) ** np.arange(60)  # of the semi-implicit scheme, whose step is 1 ms
    off = 1.0 - estimate[begun : begun + 60, 1] / true[1]
    assert np.allclose(off, decay, rtol=0, atol=2e-3)  # the first samples are of a tip that just begins to move


def test_a_force_along_the_estimated_normal_is_the_desired_one():
    """On a smooth slope a law that presses along the vertical misses force and path, one with the estimate neither."""
    rest = {"reference.stop": 0.4, "time.duration": 1.2, "law.motion_damping": 60.0}
    plain = run_of(UPHILL, rest, {"compensation": {"kind": "none"}})
    mended = run_of(UPHILL, rest)
    # At rest f n − f_c n_b is a force Λ a of the law, with a along the believed plane: n_b S (f n − f_c n_b) = 0.
    terms = cl.prepare(plain.scenario).robot.terms(plain.q[-1], np.zeros(4))
    S = terms.jacobian @ np.linalg.solve(terms.mass_matrix, terms.jacobian.T)
    assert plain.contact_force[-1] == pytest.approx(10.0 * S[2, 2] / (S[2] @ plain.surface_normal[-1]), abs=2e-3)
    assert abs(plain.contact_force[-1] - 10.0) > 0.5
    assert mended.contact_force[-1] == pytest.approx(10.0, abs=2e-3)
    off = [np.linalg.norm(run.position[-1, :2] - run.reference_tip[-1, :2]) for run in (plain, mended)]
    assert off[1] < 0.02 * off[0]


def test_engines_batches_and_gradients_of_a_belief():
    """Both engines agree, a batch is its runs, and derivatives are those of differences."""
    short = {"time.duration": 0.4, "reference.start": 0.0, "compensation.kind": "normal",
             "surface.expression": "z - 0.006*exp(-(x**2 + (y - 0.01)**2)/0.00045)"}  # fmt: skip
    scenario = cl.load_scenario("hidden_bump", short)
    runs = [cl.simulate(scenario, engine=engine, progress=False) for engine in ("pinocchio", "compiled")]
    assert np.ptp(runs[0].contact_force) > 0.1
    assert np.allclose(runs[0].contact_force, runs[1].contact_force, rtol=0, atol=1e-7)
    rates = [20.0, 60.0]
    table = cl.simulate_batch(scenario, {"compensation.rate": rates}, progress=False)
    singly = [cl.simulate(scenario.replace({"compensation.rate": rate}), engine="compiled") for rate in rates]
    errors = [run.summary()["rms_force_error"] for run in singly]
    assert np.allclose(table["rms_force_error"].to_pylist(), errors, rtol=1e-12, atol=0)
    key = "compensation.rate"
    slope = cl.gradient(scenario, [key], of=["rms_force_error"]).derivative["rms_force_error"][key]
    low, high = (
        cl.simulate(scenario.replace({key: 50.0 + d}), engine="compiled").summary()["rms_force_error"]
        for d in (-0.05, 0.05)
    )
    assert slope == pytest.approx((high - low) / 0.1, rel=1e-4)


def test_a_belief_is_told_and_read_again(tmp_path):
    """As TOML, in a run file, and swept over its kinds; a key of another kind is refused with the kind's keys."""
    scenario = cl.load_scenario("hidden_bump", {"time.duration": 0.02})
    (tmp_path / "again.toml").write_text(scenario.to_toml(), encoding="utf-8")
    assert cl.load_scenario(tmp_path / "again.toml").belief == scenario.belief
    changed = scenario.replace({"belief.surface.kind": "sphere", "belief.surface.radius": 0.3})
    assert changed.belief.surface.radius == 0.3
    assert changed.replace({"belief.surface.kind": "plane"}).belief.surface.kind == "plane"


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"belief.surface.kind": "blob"}, r"belief\.surface\.kind = 'blob': must be 'box' or "),
        (
            {"belief.surface.radius": 1.0},
            r"unknown key 'belief\.surface\.radius'; did you mean 'belief\.surface\.edge_r",
        ),
        ({"belief.table": 1.0}, r"unknown key 'belief\.table'"),
        ({"belief.surface.normal": [0, 0, 0]}, r"belief\.surface\.normal = \[0, 0, 0\]"),
        ({"belief.surface": {"kind": "none"}}, "belief: there must be a surface"),
        ({"compensation.kind": "normal", "sensor.axes": 1}, r"compensation\.kind = 'normal': .* set sensor\.axes = 3"),
    ],
)
def test_a_belief_at_fault_is_refused(changes, words):
    """One line with the key."""
    with pytest.raises(cl.ScenarioError, match=words) as caught:
        cl.prepare(cl.load_scenario("hidden_bump", changes))
    assert len(caught.value.faults) == 1


def test_a_noisy_normal_is_the_tilt_that_was_drawn(monkeypatch):
    """Where each draw is the same the run is that of `model_error.normal`, in both engines and with either scheme."""
    angle, towards = 0.05, 0.7
    tilt = angle * np.array([np.cos(towards), np.sin(towards)])
    monkeypatch.setattr(BeliefSection, "draws", lambda self, count: np.tile(tilt, (count, 1)))
    for engine, integrator in (("pinocchio", "rk4"), ("compiled", "semi_implicit_euler")):
        options = {"time.duration": 0.2, "time.integrator": integrator, "law.pd_start": 0.0}
        noisy, tilted = (
            cl.simulate(cl.load_scenario("wam_slide", options | more), engine=engine)
            for more in (
                {"belief.normal_noise": 1e-9},
                {"model_error.normal": angle, "model_error.normal_towards": towards},
            )
        )
        assert np.max(np.abs(noisy.contact_force - 10.0)) > 0.01
        np.testing.assert_allclose(noisy.contact_force, tilted.contact_force, rtol=0, atol=1e-9)
        np.testing.assert_allclose(noisy.torque, tilted.torque, rtol=0, atol=1e-9)


def test_the_noise_of_the_normal_has_its_size_and_its_seed():
    """The law's torque scatters in proportion, alike with the same seed; a mean over many rows has none of it."""
    still = {
        "time.duration": 0.4,
        "law.pd_start": 1.0,
        "start.v": [0.0] * 4,
        "reference.start": 1.0,
        "reference.stop": 2.0,
    }
    small, large, again, other = (
        cl.simulate(cl.load_scenario("wam_slide", still | {"belief.normal_noise": s, "belief.seed": seed})).torque
        for s, seed in ((1e-3, 0), (2e-3, 0), (2e-3, 0), (2e-3, 1))
    )
    np.testing.assert_array_equal(large, again)
    off = [x - x.mean(axis=0) for x in (small, large, other)]
    np.testing.assert_allclose(off[1], 2.0 * off[0], atol=2e-3 * np.max(np.abs(off[1])) + 1e-4)
    assert np.std(off[2]) == pytest.approx(np.std(off[1]), rel=0.2)
    assert np.max(np.abs(off[2] - off[1])) > np.std(off[1])
