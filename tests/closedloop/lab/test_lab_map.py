"""The map of the lab: its cells, its axes, and the first one, which begins by itself."""

import threading
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import closedloop as cl
import robot_models
from closedloop.lab import controls, mapping
from closedloop.lab.app import Answers
from closedloop.lab.history import History
from closedloop.lab.mapping import Axis, Map, MapWork, coarse_first


def control_of(scenario, key, index=None):
    """Return one control."""
    return controls.all_controls(scenario, robot_models.load(scenario.robot.model))[key, index]


def test_the_cells_of_a_map_are_the_runs_of_their_changes():
    """Every cell is computed once, coarse ones first, and holds what a single run gives."""
    base = cl.load_scenario("wam_slide", {"time.duration": 0.05})
    x, y = control_of(base, "law.force"), control_of(base, "law.kp", 1)
    found = Map(base, Axis.of(x, 4), Axis.of(y, 3), "peak_contact_force")
    assert list(found.fill(batch=6)) == [6, 12]
    history = History(base, "wam_slide")
    for cell in ((0, 3), (2, 1)):
        run = cl.simulate(history.scenario(found.values(*cell)), engine="compiled")
        assert found.grid[cell] == run.summary()["peak_contact_force"]
    assert sorted(coarse_first(9, 10)) == [(i, j) for i in range(9) for j in range(10)]
    assert coarse_first(9, 10)[:4] == [(0, 0), (0, 8), (8, 0), (8, 8)]


def test_cells_that_cannot_be_run_are_grey_and_the_map_goes_on():
    """Kinetic friction above the static is refused, whole batches too: each cell has the reason, the others a value."""
    base = cl.load_scenario("wam_slide_friction", {"time.duration": 0.05})
    x, y = control_of(base, "law.force"), control_of(base, "friction.kinetic")
    found = Map(base, Axis.of(x, 3), Axis.of(y, 6), "peak_contact_force")
    assert list(found.fill(batch=2))[-1] == 18
    refused = found.y.values > base.friction.static
    assert refused.any()
    assert np.all(found.state[refused] == 2.0)
    assert np.all(np.isfinite(found.grid[~refused]))
    assert "must not be below kinetic" in found.reasons[5, 0]


def test_an_axis_has_the_values_of_its_slider():
    """Each is one that the slider can show; of a step, which moves in round values, every one of them."""
    base = cl.load_scenario("wam_slide")
    for key, index in (("law.force", None), ("law.kp", 1), ("time.duration", None)):
        control = control_of(base, key, index)
        values = Axis.of(control).values
        assert values.size == 40
        assert np.all(np.diff(values) > 0.0)
        for value in values:
            whole = [*control.value[:1], value, *control.value[2:]] if index else value
            assert control.read(control.with_value(whole).shown) == pytest.approx(whole)
    assert {1e-4, 2e-4, 5e-4, 1e-3} <= set(Axis.of(control_of(base, "time.step")).values)


def test_a_first_map_begins_however_loaded_the_computer_is(monkeypatch):
    """A run is quick by its time of a processor: on the clock it takes longer while other programs are at work."""
    base = cl.load_scenario("wam_slide", {"time.duration": 0.05})
    answers, begun = Answers(History(base, "wam_slide")), []
    told = []
    lab = SimpleNamespace(controls=controls.all_controls(base, robot_models.load("wam4")),
                          tell=lambda slot, message, keep=True: told.append(message))  # fmt: skip
    work = MapWork(lab)
    work.show_keys()
    monkeypatch.setattr(mapping, "needs_compiling", lambda function: False)
    monkeypatch.setattr(work, "start", lambda x, y, quantity, by_itself: begun.append((x, y)))
    answer = answers.answer({})
    assert 0.0 < answer.effort < mapping.QUICK
    for effort in (answer.effort, 2.0 * mapping.QUICK):
        work.begin_by_itself(replace(answer, seconds=5.0, effort=effort))
        assert begun == [("law.kp, all", "law.kd, all")]
    assert told[-1] == {"kind": "tab", "name": "analysis"}  # where no map comes, another tab has something to show
    work.close()


@pytest.mark.parametrize("refused", ["", "a variable refuses it"])
def test_a_first_map_begins_once_what_it_needs_is_compiled(refused, monkeypatch):
    """Until then the page says what it waits for; where no process may compile, how to have it compiled."""
    base = cl.load_scenario("wam_slide", {"time.duration": 0.05})
    told, asked, started, compiled = [], threading.Event(), [], threading.Event()
    answer = Answers(History(base, "wam_slide")).answer({})
    lab = SimpleNamespace(controls=controls.all_controls(base, robot_models.load("wam4")), answer=answer,
                          details=SimpleNamespace(ask=lambda answer: asked.set()),
                          tell=lambda slot, message, keep=True: told.append(message.get("line", "")))  # fmt: skip
    monkeypatch.setattr(mapping, "needs_compiling", lambda function: not compiled.is_set())
    monkeypatch.setattr(mapping, "refused", lambda: refused)
    monkeypatch.setattr(mapping, "start", lambda functions, quietly: started.append(functions))
    monkeypatch.setattr(mapping, "LOOK", 0.01)
    work = MapWork(lab)
    work.show_keys()
    for _ in range(2):  # a page that opens later is told as well, and nothing is begun twice
        work.begin_by_itself(answer)
    assert "not compiled yet" in told[-1]
    assert ("press compute" if refused else "then the first map begins") in told[-1]
    assert not asked.wait(0.1)
    assert bool(started) is not bool(refused)
    compiled.set()
    assert asked.wait(10.0)
    work.close()


def test_a_place_of_the_map_is_a_value_that_its_slider_can_show():
    """The middle of a cell is that cell's value, also of one joint of a list; the ends stay within the axis."""
    base = cl.load_scenario("wam_slide")
    for key, index in (("law.force", None), ("law.kp", 1), ("time.step", None)):
        axis = Axis.of(control_of(base, key, index), 9)
        for cell, value in enumerate(axis.values):
            found = axis.at((cell + 0.5) / axis.values.size)
            assert (found if index is None else found[index]) == pytest.approx(value, rel=6e-3)
        assert axis.at(0.0) == axis.at(-3.0)
    assert axis.name == "time.step"


@pytest.mark.parametrize(("name", "keys"), [
    ("wam_hybrid_friction", ["law.stiffness", "law.damping"]),
    ("panda_scan", ["law.motion_stiffness", "law.motion_damping"]),
    ("wam_slide", ["law.kp, all", "law.kd, all"]),
])  # fmt: skip
def test_a_first_map_is_over_keys_that_move_the_tip(name, keys):
    """Not over gains of the posture, which change nothing of a force that others are to answer for."""
    base, told = cl.load_scenario(name), []
    lab = SimpleNamespace(controls=controls.all_controls(base, robot_models.load(base.robot.model)),
                          tell=lambda slot, message, keep=True: told.append(message))  # fmt: skip
    work = MapWork(lab)
    work.show_keys()
    assert [told[0][axis] for axis in "xy"] == keys
    if name == "wam_hybrid_friction":
        errors = [
            cl.simulate(cl.load_scenario(name, {"time.duration": 1.2, key: value})).summary()["rms_force_error"]
            for key in ("law.stiffness", "law.posture_stiffness") for value in (150.0, 2400.0)
        ]  # fmt: skip
        assert abs(errors[1] / errors[0] - 1.0) > 0.01
        assert abs(errors[3] / errors[2] - 1.0) < 1e-6
    work.close()
