"""The study of drift: exponents as theory has them, limits where theory puts them, and an auto that is stable."""

import json

import numpy as np
import pytest

import closedloop as cl
from closedloop.mechanics.closure.baumgarte import largest_stable_ratio
from validation.studies import drift
from validation.studies.__main__ import main
from validation.studies.drift import (
    SCHEMES,
    STEPS,
    TOLERANCES,
    fitted_slope,
    largest_error,
    measured_limit,
    power_law,
    slide,
)

SPEEDS = (0.009, 0.018, 0.036)


@pytest.mark.parametrize(("scheme", "order"), [("semi_implicit_euler", 1), ("explicit_euler", 1), ("rk4", 4)])
def test_drift_grows_with_the_integrators_order_and_with_the_square_of_the_speed(scheme, order):
    """|e| ~ h^p v²: a lower sampling rate and a higher speed are worse, by these exponents."""
    assert power_law("step", STEPS, order, scheme, "none")["slope"] == pytest.approx(order, abs=0.12)
    assert power_law("speed", SPEEDS, 2, scheme, "none")["slope"] == pytest.approx(2.0, abs=0.06)


@pytest.mark.parametrize("scheme", SCHEMES)
def test_what_baumgarte_leaves_grows_with_the_squares_of_step_and_speed(scheme):
    """With T of two steps |e| settles at ~ h² v² under every scheme.

    For semi-implicit Euler it is 2 ζ T/h = 4 ζ of what a step leaves out, that is of the drift without stabiliser over
    the steps of the path.
    """
    row = power_law("step", STEPS, 2, scheme, "baumgarte")
    assert row["slope"] == pytest.approx(2.0, abs=0.2)
    assert power_law("speed", SPEEDS, 2, scheme, "baumgarte")["slope"] == pytest.approx(2.0, abs=0.03)
    if scheme == "semi_implicit_euler":
        drift = power_law("step", STEPS, 1, scheme, "none")["errors"]
        left_out = np.array(drift) * np.array(STEPS) / 3.0  # the tip moves for 3 s
        assert np.array(row["errors"]) == pytest.approx(4 * 0.707 * left_out, rel=0.2)


@pytest.mark.slow
def test_the_adaptive_scheme_drifts_like_its_tolerance():
    """Without stabiliser DOP853 drifts by a share of time.tolerance, down to 0.1 pm at 1e-8: far below any other."""
    row = power_law("tolerance", TOLERANCES, 1, "dop853", "none")
    assert row["slope"] == pytest.approx(1.0, abs=0.25)
    assert row["errors"][-1] < 1e-12


def test_every_stabiliser_is_better_than_none():
    """Baumgarte takes drift down a thousandfold, projection to rounding."""
    errors = {kind: largest_error(slide(scheme="semi_implicit_euler", stabiliser=kind))[0] for kind in (
        "none", "baumgarte", "projection", "both")}  # fmt: skip
    assert errors["baumgarte"] < 2e-3 * errors["none"]
    assert max(errors["projection"], errors["both"]) < 4e-15


@pytest.mark.parametrize("scheme", SCHEMES)
def test_measured_limit_is_that_of_theory(scheme):
    """A real arm's closure shakes loose where the linear map's spectral radius passes one, to a part in a thousand."""
    assert measured_limit(scheme, 0.707) == pytest.approx(largest_stable_ratio(scheme, 0.707), rel=2e-3)


@pytest.mark.parametrize("value", ["fast", "", True, -1.0, 0.0])
def test_another_time_constant_is_refused_in_one_line(value):
    """What is neither a positive number nor "auto" is refused with both."""
    with pytest.raises(cl.ScenarioError, match=r'stabiliser\.time_constant.*"auto"') as caught:
        cl.load_scenario("wam_slide", {"stabiliser.time_constant": value})
    assert "\n" not in str(caught.value)


def test_slope_of_a_power_law_is_its_exponent():
    """Points on c·x³ have slope 3 and no misfit; points that could not be measured are left out."""
    x = [1.0, 2.0, 4.0, 8.0]
    assert fitted_slope(x, [5 * v**3 for v in x]) == pytest.approx((3.0, 0.0), abs=1e-12)
    assert fitted_slope(x, [5.0, 40.0, np.nan, 2560.0])[0] == pytest.approx(3.0)
    assert np.isnan(fitted_slope(x, [np.nan] * 4)[0])


@pytest.mark.slow
def test_command_writes_the_study(tmp_path, capsys, monkeypatch):
    """The quick study, here with one tolerance, leaves its numbers, a table and two figures."""
    monkeypatch.setenv("COLUMNS", "160")  # a narrower terminal breaks the heads of columns
    monkeypatch.setattr(drift, "TOLERANCES", TOLERANCES[:1])
    assert main(["drift", "--quick", "--out", str(tmp_path)]) == 0
    assert "p measured" in " ".join(capsys.readouterr().out.split())
    results = json.loads((tmp_path / "drift.json").read_text())
    assert {row["integrator"] for row in results["limits"]} == set(SCHEMES)
    assert [len(results[name]) for name in ("against_step", "against_speed", "against_tolerance")] == [6, 6, 1]
    for name in ("drift.csv", "drift_slopes.png", "drift_slopes.svg", "baumgarte_stability.png"):
        assert (tmp_path / name).stat().st_size > 100


def test_bad_command_is_one_line_and_status_2(tmp_path, capsys):
    """An unknown study and a folder that cannot be written are the user's to mend."""
    (tmp_path / "file").write_text("")
    for arguments in (["drif"], ["drift", "--out", str(tmp_path / "file" / "x")]):
        assert main(arguments) == 2
        error = capsys.readouterr().err
        assert error.startswith("closedloop study: ")
        assert error.count("\n") == 1
