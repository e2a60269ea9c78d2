"""The study of drift: exponents as theory has them, limits where theory puts them, and an auto that is stable."""

import json

import numpy as np
import pytest

from validation.studies import drift
from validation.studies.__main__ import main
from validation.studies.drift import (
    SCHEMES,
    STEPS,
    TOLERANCES,
    fitted_slope,
    power_law,
)

SPEEDS = (0.009, 0.018, 0.036)


@pytest.mark.parametrize(("scheme", "order"), [("semi_implicit_euler", 1), ("explicit_euler", 1), ("rk4", 4)])
def test_drift_grows_with_the_integrators_order_and_with_the_square_of_the_speed(scheme, order):
    """|e| ~ h^p v²: a lower sampling rate and a higher speed are worse, by these exponents."""
    assert power_law("step", STEPS, order, scheme, "none")["slope"] == pytest.approx(order, abs=0.12)
    assert power_law("speed", SPEEDS, 2, scheme, "none")["slope"] == pytest.approx(2.0, abs=0.06)


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
