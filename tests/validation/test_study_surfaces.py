"""The study of surfaces: its measures on known signals, its cells, and what it claims on a few of them."""

from types import SimpleNamespace

import numpy as np
import pytest

import closedloop as cl
from validation.studies import results, surfaces
from validation.studies.__main__ import main


def test_measures_of_known_signals():
    """RMS, peak and path error along a normal that turns; what is before the run has settled does not count."""
    time = np.linspace(0.0, 8.0, 8001)
    late = time >= surfaces.SETTLED_FROM
    normal = np.column_stack([np.sin(time), np.zeros_like(time), np.cos(time)])
    run = SimpleNamespace(
        time=time,
        contact_force=10.0 + np.where(late, 0.3 * np.sign(np.sin(50.0 * time)), 5.0),
        reference_force=np.full_like(time, 10.0),
        position=0.5 * normal + [0.0, 0.002, 0.0],
        reference_tip=np.zeros((8001, 3)),
        surface_normal=normal,
    )
    found = surfaces.measures(run)
    assert found == pytest.approx({"force_rms": 0.3, "force_peak": 0.3, "path_rms": 2.0}, rel=1e-3)


def test_every_cell_is_a_valid_scenario():
    """No law, compensation or stiffness is refused, and all carry what the controller does not know of."""
    made = [surfaces.breathing(law, name) for law in surfaces.LAWS for name in surfaces.COMPENSATIONS if law != "paper"]
    made += [surfaces.soft(law, k) for law in surfaces.LAWS for k in surfaces.STIFFNESSES]
    for scenario in made:
        assert scenario.model_error.payload == pytest.approx(0.1 * (scenario.tool.mass + scenario.model_error.payload))
        assert scenario.law.sample_period == surfaces.SAMPLE
    cl.prepare(made[-1])  # the stiffest surface is not too stiff for the step


def test_a_run_that_cannot_go_on_is_a_cell_with_its_reason(monkeypatch):
    """The study goes on; the tables say so."""

    def stop(scenario, engine):
        raise cl.DivergenceError("stopped at t = 1 s: the motion diverges", 1.0)

    monkeypatch.setattr(results, "simulate", stop)
    row = surfaces.cell("paper", surfaces.BREATHING, None)
    assert "diverges" in row["reason"]
    assert surfaces.text_of(row, "force_rms") == "stopped"


@pytest.mark.slow
def test_command_writes_the_study_of_surfaces(tmp_path, capsys):
    """The quick study leaves its tables, its numbers and its figure."""
    assert main(["surfaces", "--quick", "--out", str(tmp_path)]) == 0
    assert "impedance + observer" in capsys.readouterr().out
    for name in ("surfaces.json", "surfaces.csv", "surfaces.png", "surfaces.svg"):
        assert (tmp_path / name).stat().st_size > 100
