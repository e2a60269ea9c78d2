"""Several scenarios under the same variations."""

import itertools

import numpy as np
import pandas as pd
import pytest

import closedloop as cl
from closedloop.studies.comparison.compare import Comparison

OVER = {"friction.coefficient": [0.1, 0.3], "law.force": [8.0, 10.0]}


@pytest.fixture(scope="module")
def comparison():
    """Return the comparison of two laws over friction and force."""
    both = {
        name: cl.load_scenario(
            "wam_slide", {"time.duration": 1.0, "friction.kind": "coulomb", "friction.coefficient": 0.2, **changes}
        )
        for name, changes in {"paper": {}, "integral": {"law.force_integral": 50.0}}.items()
    }
    return cl.compare(both, OVER)


def test_all_meet_the_same_variations(comparison):
    """Each has every value of a key with every other, and its runs are those of `simulate`."""
    runs = comparison.runs
    assert list(runs["scenario"]) == ["paper"] * 4 + ["integral"] * 4
    assert [tuple(row) for row in runs[list(OVER)].to_numpy()[:4]] == [(0.1, 8.0), (0.1, 10.0), (0.3, 8.0), (0.3, 10.0)]
    assert np.array_equal(runs[list(OVER)].to_numpy()[:4], runs[list(OVER)].to_numpy()[4:])
    alone = cl.simulate(
        cl.load_scenario("wam_slide", {
            "time.duration": 1.0, "friction.kind": "coulomb", "friction.coefficient": 0.3, "law.force": 8.0,
            "law.force_integral": 50.0,
        }), progress=False, engine="compiled",
    )  # fmt: skip
    assert runs["rms_force_error"][6] == pytest.approx(alone.summary()["rms_force_error"], rel=1e-9)


def test_table_and_figure(comparison):
    """A row each with the median and the worst, and a panel for each value with a point a run."""
    table = comparison.table()
    assert list(table.index) == ["paper", "integral"]
    mine = comparison.runs[comparison.runs["scenario"] == "integral"]["rms_force_error"]
    assert table.loc["integral", "rms_force_error, worst [N]"] == mine.max()
    assert table.loc["integral", "rms_force_error, median [N]"] == mine.median()
    assert list(table["runs"]) == [4, 4]
    figure = comparison.figure()
    assert len(figure.axes) == len(comparison.of)
    assert comparison.units["peak_contact_force"] == "N"
    assert "[N]" in figure.axes[1].get_ylabel()
    assert comparison.variations == "friction.coefficient = 0.1, 0.3; law.force = 8, 10"
    assert comparison.variations in figure.axes[0].get_title("left")


def test_once_as_they_are():
    """Without variations each runs once, under its own name."""
    runs = cl.compare(["planar2_slide"], of=["rms_force_error"]).runs
    assert list(runs["scenario"]) == ["planar2_slide"]
    run = cl.simulate(cl.load_scenario("planar2_slide"), progress=False, engine="compiled")
    assert runs["rms_force_error"][0] == pytest.approx(run.summary()["rms_force_error"], rel=1e-9)


def test_variations_are_named():
    """Many values are named by the first and the last ones; none vary where each scenario runs once."""
    seeds = {"sensor.seed": list(range(9)), "time.duration": [0.01]}
    many = cl.compare(["planar2_slide"], seeds, of=["rms_force_error"])
    assert many.variations == "sensor.seed = 0, 1 ... 8 (9 values); time.duration = 0.01"
    once = cl.compare({"short": cl.load_scenario("planar2_slide", {"time.duration": 0.01})}, of=["rms_force_error"])
    assert once.variations == ""
    assert once.figure().axes[0].get_title("left") == "each point a run; bars: medians"


@pytest.mark.parametrize(
    ("scenarios", "over", "of", "why"),
    [
        ([], None, ["rms_force_error"], "compare: there are no scenarios to compare"),
        (["planar2_slide"] * 2, None, ["rms_force_error"], "compare: two of the scenarios have one name"),
        (
            ["planar2_slide"],
            {"law.nothing": [1.0]},
            ["rms_force_error"],
            "compare: planar2_slide: unknown key 'law.nothing'",
        ),
        (["planar2_slide"], None, ["beauty"], "compare: of = beauty: no value of a run's summary"),
    ],
)
def test_what_cannot_be_compared(scenarios, over, of, why):
    """Each is one line."""
    with pytest.raises(cl.ScenarioError) as caught:
        cl.compare(scenarios, over, of=of)
    assert str(caught.value).startswith(why)


OWN = '''
from closedloop.control.laws.impedance import ImpedanceLaw


class Own(ImpedanceLaw):
    """The shipped law, by another name."""
'''


@pytest.mark.slow
def test_a_users_law_stands_among_the_shipped_six(tmp_path, monkeypatch):
    """A law from a module meets the same variations and noise; one that is the shipped one again has its results."""
    (tmp_path / "own_laws_compared.py").write_text(OWN)
    monkeypatch.syspath_prepend(str(tmp_path))
    joints = {"kp": [900.0, 900.0, 400.0, 300.0], "kd": [60.0, 60.0, 30.0, 20.0]}
    laws = {
        "paper": joints, "hybrid": joints, "impedance": {}, "admittance": {}, "operational_space": {},
        "dynamic_hybrid": {}, "own_laws_compared:Own": {},
    }  # fmt: skip
    fixed = {
        "time.duration": 0.2, "reference.kind": "hold", "sensor.noise": 0.2, "sensor.seed": 3,
        "friction": {"kind": "coulomb", "coefficient": 0.2},
    }  # fmt: skip
    some = {
        kind: cl.load_scenario("wam_slide", {**fixed, "law": {"kind": kind, "force_integral": 20.0, **more}})
        for kind, more in laws.items()
    }
    table = cl.compare(some, {"friction.coefficient": [0.1, 0.3]}, of=["rms_force_error"]).runs
    assert len(table) == 14
    seen = {kind: table[table["scenario"] == kind]["rms_force_error"].to_numpy() for kind in laws}
    assert np.array_equal(seen["own_laws_compared:Own"], seen["impedance"])
    assert all(np.isfinite(each).all() and each.min() > 0.0 for each in seen.values())
    assert not np.array_equal(seen["paper"], seen["impedance"])


def test_a_run_is_good_if_it_is_done_and_both_verdicts_are():
    """Of all combinations one counts."""
    states = itertools.product(("done", "stopped"), ("good", "energy"), ("good", "force_error"))
    frame = pd.DataFrame(states, columns=["status", "verdict", "control_verdict"]).assign(scenario="one", peak=1.0)
    (row,) = Comparison(frame, ("peak",), {}).table().to_dict("records")
    assert (row["runs"], row["good"]) == (8, 1)
