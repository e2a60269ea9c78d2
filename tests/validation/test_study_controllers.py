"""The study of controllers: its measures on known signals, its claims on a few cells, its bad input."""

from types import SimpleNamespace

import numpy as np
import pytest

import closedloop as cl
from validation.studies import controllers, results
from validation.studies.__main__ import main


def test_measures_of_known_signals():
    """RMS, peak, path error and settling of signals whose values are known by construction."""
    time = np.linspace(0.0, 8.0, 8001)
    force = 10.0 + np.where(time >= 1.5, 0.1, 5.0) + np.where((time > 6.5) & (time < 6.9), 0.9, 0.0)
    force[(time >= 7.5)] = 10.01  # settled half a second after the rise
    position = np.column_stack([0.003 * np.ones_like(time), 0.004 * np.ones_like(time), 0.5 * np.ones_like(time)])
    run = SimpleNamespace(
        time=time,
        contact_force=force,
        reference_force=np.full_like(time, 10.0),
        position=position,
        reference_tip=np.zeros((8001, 3)),
        scenario=SimpleNamespace(surface=SimpleNamespace(normal=(0.0, 0.0, 2.0))),
    )
    found = controllers.measures(run)
    share = 0.4 / 5.5  # of the time the error is 1 N, else 0.1 N
    assert found["force_rms"] == pytest.approx(np.sqrt(share + (1 - share) * 0.01), rel=2e-3)
    assert found["force_peak"] == pytest.approx(1.0)
    assert found["path_rms"] == pytest.approx(5.0)  # the height over the surface is not counted
    assert found["settling"] == pytest.approx(0.5, abs=2e-3)
    run.contact_force[-1] = 10.3
    assert controllers.measures(run)["settling"] == np.inf


@pytest.mark.slow
def test_settling_tells_controllers_apart():
    """After a rise of the force a law without sensor never settles, an integral takes longer than with an observer."""
    never, slow, soon, once = (
        controllers.cell(name, "dahl")["settling"]
        for name in ("paper", "impedance", "impedance + observer", "impedance + model, 20 % off")
    )
    assert never == np.inf
    assert 0.3 > slow > 1.3 * soon > 1.3 * controllers.RISE
    assert once < controllers.RISE


def test_a_cell_says_what_there_is(capsys):
    """Two digits, or a word; every measure is a block of one table."""
    row = {"controller": "paper", "friction": "dahl", "reason": ""} | dict.fromkeys(controllers.MEASURES, 0.12345)
    assert controllers.cell_text(row, "force_rms") == "0.12"
    assert controllers.cell_text(row | {"force_rms": 1e-7}, "force_rms") == "<0.001"
    assert controllers.cell_text(row | {"settling": np.inf}, "settling") == "never"
    assert controllers.cell_text(row | {"reason": "stopped at t = 1 s: ..."}, "settling") == "stopped"
    controllers.print_table([row, row | {"friction": "seven-parameter"}])
    printed = capsys.readouterr().out
    assert printed.count("0.12") == 2 * len(controllers.MEASURES)
    assert "seven-parameter" in printed
    assert all(title in printed for title in controllers.TITLES.values())


def test_a_run_that_cannot_go_on_is_a_cell_with_its_reason(monkeypatch):
    """The study goes on; the cell says why."""

    def stop(scenario, engine):
        raise cl.DivergenceError("stopped at t = 1 s: the motion diverges", 1.0)

    monkeypatch.setattr(results, "simulate", stop)
    row = controllers.cell("paper", "coulomb")
    assert "diverges" in row["reason"]
    assert np.isnan(row["force_rms"])


def test_every_cell_is_a_valid_scenario():
    """No controller and no friction of the study is refused."""
    for name in controllers.CONTROLLERS:
        for friction in controllers.FRICTIONS:
            scenario = controllers.scenario_of(name, friction)
            assert scenario.law.sample_period == controllers.SAMPLE
            assert (scenario.friction.kind == "none") == (friction == "none")


@pytest.mark.slow
def test_command_writes_the_study(tmp_path, capsys):
    """The quick study leaves its table, its numbers and its figure."""
    assert main(["controllers", "--quick", "--out", str(tmp_path)]) == 0
    assert "impedance + observer" in capsys.readouterr().out
    for name in ("controllers.json", "controllers.csv", "controllers.png", "controllers.svg"):
        assert (tmp_path / name).stat().st_size > 100
