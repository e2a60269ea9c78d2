"""Eight runs in SIMD lanes equal each run by itself to the last bit; what cannot use lanes is run by itself."""

import numpy as np
import pytest

import closedloop as cl
from closedloop.jit.simd8 import WIDE
from closedloop.simulation.batch.worker import Worker
from closedloop.simulation.engines.lanes import FEWEST, LaneRuns, kind_of
from closedloop.simulation.prepare import prepare
from robot_models import load

KEPT = ("q", "torque", "contact_force", "closure_error", "kkt_condition", "residual_motion")
SHORT = {"time.duration": 0.2, "reference.start": 0.1, "law.pd_start": 0.1}  # with the start of the motion in it
BRISTLES = {
    "friction.kind": "lugre", "friction.kinetic": 0.2, "friction.static": 0.3, "friction.stribeck_speed": 1e-3,
    "friction.stiffness": 1e4, "friction.damping": 30.0,
}  # fmt: skip

# A scenario, what is the same in all runs, and what is drawn for each.
KINDS = {
    "forces, gains and stabilisers": (
        "wam_slide", SHORT,
        {"law.force": (1.0, 20.0), "law.kp": (1.0, 900.0), "stabiliser.time_constant": (1e-3, 1e-2)},
    ),
    "paths": (
        "wam_slide", SHORT | {"reference.stop": 2.0},
        {"reference.speed": (0.005, 0.04), "law.pd_start": (0.0, 0.1)},
    ),
    "runge-kutta": ("wam_slide", SHORT | {"time.integrator": "rk4"}, {"law.force": (-5.0, 5.0)}),
    "explicit": ("wam_slide_unstabilised", SHORT | {"time.integrator": "explicit_euler"}, {"law.force": (1.0, 9.0)}),
    "held": ("wam_slide", SHORT | {"law.sample_period": 0.005}, {"law.kd": (5.0, 30.0)}),
    "force that changes": (
        "wam_slide",
        SHORT | {"force_profile.kind": "sine", "force_profile.amplitude": 3.0, "force_profile.frequency": 5.0},
        {"law.force": (5.0, 15.0)},
    ),
    "a contact that could break": ("wam_slide", SHORT | {"surface.contact": "unilateral"}, {"law.force": (5.0, 15.0)}),
    "sticks, slips, sticks": (
        "wam_slide_friction", {"time.duration": 0.9, "reference.start": 0.1, "reference.stop": 0.8},
        {"law.force": (8.0, 12.0), "friction.kinetic": (0.2, 0.35)},
    ),
    "slides from the start": (
        "wam_slide",
        SHORT | {"friction.kind": "coulomb", "friction.coefficient": 0.2, "time.integrator": "rk4"},
        {"law.force": (5.0, 15.0)},
    ),
    "comes down": ("wam_touchdown", {"time.duration": 0.15}, {"law.force": (8.0, 12.0), "surface.gap": (1e-4, 3e-4)}),
    "bounces": ("wam_bounce", {"time.duration": 0.4}, {"impact.restitution": (0.0, 0.9), "surface.gap": (0.01, 0.05)}),
    "leaves": ("wam_liftoff", {"time.duration": 2.0}, {"stabiliser.time_constant": (0.002, 0.004)}),
    "passes an edge": (
        "wam_bounce",
        {"time.duration": 0.2, "surface.gap": 0.0, "surface.edge_radius": 5e-3, "start.v": [0.2, 0.0, 0.0, 0.0]},
        {"law.force": (8.0, 12.0)},
    ),
    "soft": ("soft_table", SHORT, {"law.force": (5.0, 15.0), "compliance.stiffness": (5e3, 2e4)}),
    "comes down on a soft surface and rubs": (
        "wam_touchdown",
        {"time.duration": 0.2, "friction.kind": "coulomb", "friction.coefficient": 0.2, "impact.restitution": 0.0}
        | {"compliance.kind": "hunt_crossley", "compliance.stiffness": 1e5, "stabiliser.kind": "none"},
        {"law.force": (8.0, 12.0), "surface.gap": (1e-4, 3e-4)},
    ),
    "a ball that rubs": (
        "wam_sphere", SHORT | {"friction.kind": "coulomb", "friction.coefficient": 0.2}, {"law.force": (5.0, 15.0)},
    ),
    "a surface that moves": (
        "wam_slide",
        SHORT | {"surface_motion.kind": "breathing", "surface_motion.amplitude": 1e-3, "surface.contact": "unilateral"},
        {"law.force": (5.0, 15.0)},
    ),
    "two joints": ("planar2_slide", SHORT, {"law.force": (1.0, 5.0)}),
    "seven joints": ("panda_slide", SHORT, {"law.force": (1.0, 20.0)}),
}  # fmt: skip

# What happens in the runs of some of them, so that a run goes by itself meanwhile.
HAPPENS = {
    "sticks, slips, sticks": ("stick", "slip"), "comes down": ("touchdown", "impact"), "bounces": ("impact",),
    "leaves": ("liftoff",), "passes an edge": ("edge",), "comes down on a soft surface and rubs": ("touchdown",),
}  # fmt: skip


@pytest.fixture
def lane_counts(monkeypatch):
    """Return a list of how many lanes were used each time."""
    counts, run = [], LaneRuns.run

    def counted(self, count):
        counts.append(count)
        return run(self, count)

    monkeypatch.setattr(LaneRuns, "run", counted)
    return counts


def drawn(ranges, count, seed=0):
    """Return `count` random values for each key."""
    rng = np.random.default_rng(seed)
    return {key: rng.uniform(low, high, count).tolist() for key, (low, high) in ranges.items()}


def alone(monkeypatch, *args, **options):
    """Return the table of a batch in which each run goes by itself."""
    with monkeypatch.context() as now:
        for module in ("worker", "simulate_batch"):
            now.setattr(f"closedloop.simulation.batch.{module}.uses_lanes", lambda *_: False)
        return cl.simulate_batch(*args, **options)


@pytest.mark.parametrize("kind", KINDS)
def test_to_the_last_bit(kind, lane_counts, monkeypatch):
    """All values and all columns, in sets of eight lanes and the remainder."""
    name, fixed, ranges = KINDS[kind]
    scenario = cl.load_scenario(name, overrides=fixed)
    changes = drawn(ranges, 2 * WIDE + FEWEST)
    options = {"keep": KEPT, "workers": 1}
    table = cl.simulate_batch(scenario, changes, **options)
    assert lane_counts == [WIDE, WIDE, FEWEST]
    assert set(table["status"].to_pylist()) == {"done"}
    assert all(sum(table[f"{event}_events"].to_pylist()) > 0 for event in HAPPENS.get(kind, ()))
    assert table.equals(alone(monkeypatch, scenario, changes, **options))
    assert cl.simulate_batch(scenario, changes).equals(table.select(cl.simulate_batch(scenario, changes).column_names))


def test_rows_are_those_of_a_run(lane_counts):
    """The rows kept of a run in lanes are those that `simulate` records."""
    scenario = cl.load_scenario("wam_slide", overrides=SHORT)
    table = cl.simulate_batch(scenario, {"law.force": [4.0, 5.0, 6.0, 7.0]}, keep=["q", "f", "e"], workers=1)
    assert lane_counts
    run = cl.simulate(cl.load_scenario("wam_slide", overrides=SHORT | {"law.force": 6.0}), engine="compiled")
    assert np.array_equal(np.array(table["contact_force"][2].as_py()), run.contact_force)
    assert np.array_equal(np.array(table["closure_error"][2].as_py()), run.closure_error)
    assert np.array_equal(np.reshape(table["q"][2].as_py(), (-1, 4)), run.q)


def test_a_run_that_fails_does_not_affect_the_others(lane_counts, monkeypatch):
    """One that diverges, one that cannot be read: the outcomes of the others are those without them."""
    scenario = cl.load_scenario("wam_slide", overrides=SHORT)
    changes = {"law.kd": [10.0, 12.0, 14.0, 5000.0, *(18.0 + i for i in range(6))], "law.kp": [400.0] * 10}
    changes["law.kp"][5] = float("nan")
    table = cl.simulate_batch(scenario, changes, workers=1)
    assert lane_counts
    status = ["done"] * 10
    status[3], status[5] = "stopped", "refused"
    assert table["status"].to_pylist() == status
    assert table.equals(alone(monkeypatch, scenario, changes, workers=1))


def test_runs_that_cannot_go_on_end_lanes(lane_counts, monkeypatch):
    """One of eight diverges: after two sets of lanes that failed, the next are run one by one."""
    scenario = cl.load_scenario("wam_slide", overrides=SHORT)
    changes = {"law.kd": [5000.0, *np.linspace(10.0, 20.0, WIDE - 1)] * 4}
    table = cl.simulate_batch(scenario, changes, workers=1)
    assert table["status"].to_pylist() == ["stopped", *["done"] * (WIDE - 1)] * 4
    assert lane_counts == [WIDE, WIDE]
    assert table.equals(alone(monkeypatch, scenario, changes, workers=1))


def test_each_kind_has_its_own_lanes(lane_counts, monkeypatch):
    """Steps of different length, and a contact that may break, in one batch."""
    scenario = cl.load_scenario("wam_slide", overrides=SHORT)
    changes = {
        "time.step": [0.001, 0.002] * 8,
        "surface.contact": ["bilateral"] * 13 + ["unilateral"] * 3,
        "surface.gap": [0.0] * 13 + [0.001] * 3,
        "stabiliser.time_constant": [0.004] * 16,
        "law.force": [5.0 + i for i in range(16)],
    }
    table = cl.simulate_batch(scenario, changes, workers=1)
    assert set(table["status"].to_pylist()) == {"done"}
    assert lane_counts == [7, 6]  # each step's; of those that may open there are too few
    assert table.equals(alone(monkeypatch, scenario, changes, workers=1))


@pytest.mark.parametrize(
    ("name", "changes"),
    [
        ("joint_friction", {}),
        ("wam_slide", BRISTLES),
        ("wam_slide", {"stabiliser.kind": "projection"}),
        ("wam_slide", {"law.force_feedback": 0.5}),
        ("wam_slide", {"time.integrator": "dop853"}),
        ("wam_slide", {"tool.radius": 0.01}),
    ],
)
def test_branches_exclude_lanes(name, changes):
    """Friction in joints or with states, projection, a round end or another law: run one by one."""
    scenario = cl.load_scenario(name, overrides=changes)
    assert kind_of(prepare(scenario)) is None
    assert kind_of(prepare(cl.load_scenario("wam_slide"))) is not None


def test_few_runs_go_alone(monkeypatch):
    """Two runs take as long by themselves as eight in lanes; from three on lanes are used, however short the runs."""
    asked = []
    monkeypatch.setattr(LaneRuns, "run", lambda self, count: asked.append(count))  # None: they have to go alone
    scenario, model = cl.load_scenario("wam_slide", overrides={"time.duration": 0.01}), load("wam4")
    for runs, expected in ((FEWEST - 1, []), (FEWEST, [FEWEST])):
        assert {outcome.status for outcome in Worker(model=model, runs=runs).run_all([scenario] * runs)} == {"done"}
        assert asked == expected
