"""The controls of the lab and what comes of moving them, without a browser and without viser."""

import shlex
import threading
import time
from types import SimpleNamespace
from unittest.mock import MagicMock

import numpy as np
import pytest
from budget import every

import closedloop as cl
import robot_models
from closedloop.lab.answers import Answers
from closedloop.lab.controls import TABS, controls
from closedloop.lab.history import History, in_words
from closedloop.lab.keeping import save
from closedloop.lab.kinds import begin_values
from closedloop.lab.map_picture import MapPicture
from closedloop.lab.mapping import Axis, Map, coarse_first
from closedloop.lab.newest import Newest
from closedloop.lab.picture import Picture
from closedloop.lab.pins import Pins, compared, table_html
from closedloop.scenario.load import parse_scenario
from closedloop.scenario.overrides import Variants, split_overrides
from closedloop.simulation.cache import Cache
from closedloop.simulation.prepare import prepare

SECTIONS = [section for tab in TABS.values() for section in tab]


def all_controls(scenario):
    """Return every control of a scenario."""
    model = robot_models.load(scenario.robot.model)
    return [control for section in SECTIONS for control in controls(scenario, section, model)]


def control_of(scenario, key, index=None):
    """Return one control."""
    return next(c for c in all_controls(scenario) if (c.key, c.index) == (key, index))


@pytest.mark.parametrize("name", every(3, [(name,) for name in cl.shipped_scenarios()]))
def test_each_control_gives_back_the_value_that_it_shows(name):
    """For every key of every shipped scenario; and both ends of its span are values that it can show again."""
    for control in all_controls(cl.load_scenario(name)):
        if control.form == "text" or control.key == "time.step":
            continue
        back = control.read(control.shown)
        if isinstance(control.value, list | float):
            assert np.allclose(back, control.value, rtol=6e-3, atol=1e-9), control.key
            low, high = control.read(control.low), control.read(control.high)
            assert control.low <= control.with_value(low).shown <= control.with_value(high).shown <= control.high
        else:
            assert back == control.value


def test_every_control_says_what_it_is():
    """In words when hovered over, of every kind that can be chosen; and the force is at the top of its tab."""
    for name in ("wam_slide", "panda_scan", "soft_table", "payload_mismatch"):
        base = cl.load_scenario(name)
        for control in all_controls(base):
            assert len(control.hint.split()) > 1, control.key
        for control in all_controls(base):
            for kind in control.options if control.key.endswith(".kind") else ():
                section = control.key.partition(".")[0]
                values = begin_values(base, section, kind) | {control.key: kind}
                changed = Variants(base, tuple(values)).scenario(tuple(values.values()))
                for each in controls(changed, section):
                    assert len(each.hint.split()) > 1, (kind, each.key)
    assert [c.key for c in controls(cl.load_scenario("panda_scan"), "law")][:2] == ["law.kind", "law.force"]


def test_each_contact_of_a_list_has_sliders():
    """Of all its numbers, with its name; what a slider says is laid over that contact alone."""
    base = cl.load_scenario("gripper_gear")
    slider = control_of(base, "contact.4.friction")
    assert (slider.label, slider.form, slider.own) == ("floor left: friction", "linear", base.contact[4].friction)
    assert {control.key.rpartition(".")[2] for control in controls(base, "contact")} == {
        "at", "normal", "through", "friction", "restitution", "rest_speed", "radius", "half_axes",
    }  # fmt: skip
    changed = Variants(base, (slider.key,)).scenario((0.25,))
    assert [contact.friction for contact in changed.contact].count(0.25) == 1
    assert changed.contact[4].friction == 0.25
    assert controls(cl.load_scenario("wam_slide"), "contact") == []


@pytest.mark.parametrize(("contact", "pulls"), [("unilateral", False), ("bilateral", True)])
def test_the_force_is_moved_to_a_pull_only_where_the_surface_can_hold_the_tip(contact, pulls):
    """A tip that is pulled off a surface that only pushes has left it; a force that is there to begin with is shown."""
    force = control_of(cl.load_scenario("wam_slide", {"surface.contact": contact}), "law.force")
    assert (force.low < 0.0) == pulls
    given = control_of(cl.load_scenario("wam_slide", {"surface.contact": contact, "law.force": -3.0}), "law.force")
    assert given.low < -3.0 < given.high


@pytest.mark.parametrize("section", ["law", "compensation", "friction", "joint_friction", "reference", "force_profile"])
def test_every_kind_can_be_chosen_from_any_scenario(section):
    """What a kind requires and the present one does not have gets a value to begin with."""
    for name in ("wam_slide", "wam_touchdown", "panda_wipe"):
        base = cl.load_scenario(name)
        for kind in control_of(base, f"{section}.kind").options:
            history = History(base, name)
            history.change(f"{section}.kind", kind, begin_values(base, section, kind))
            assert getattr(history.scenario(), section).kind == kind


def test_a_browser_cannot_choose_what_is_not_offered():
    """A kind is one of those listed: a module that a stranger's page names is not imported."""
    with pytest.raises(ValueError, match="must be one of"):
        control_of(cl.load_scenario("wam_slide"), "law.kind").read("antigravity:Law")


def test_undo_and_redo_go_through_the_same_scenarios():
    """A drag is one step; undo and redo are each other's inverse."""
    now = [0.0]
    history = History(cl.load_scenario("wam_slide"), "wam_slide", now=lambda: now[0])
    for k in range(10):
        now[0] += 0.016
        history.change("law.force", 10.0 + k)
    history.change("law.kind", "impedance")
    history.change("law.stiffness", 900.0)
    after = history.changes
    seen = [history.changes]
    while history.undo():
        seen.append(history.changes)
    assert [dict(s) for s in seen[::-1]] == [
        {},
        {"law.force": 19.0},
        {"law.kind": "impedance", "law.force": 19.0},
        after,
    ]
    while history.redo():
        pass
    assert history.changes == after
    assert history.scenario().law.stiffness == 900.0


def test_the_command_line_repeats_what_was_changed():
    """Read as the command line reads them, its words give the very scenario, lists and kinds included."""
    base = cl.load_scenario("wam_slide", {"law.force": 11.0})
    history = History(base, "wam_slide", {"law.force": 11.0})
    history.change("law.kp", [900.0, 800.0, 400.0, 300.0])
    history.change("friction.kind", "coulomb", begin_values(base, "friction", "coulomb"))
    program, name, *words = shlex.split(history.command())
    overrides, rest = split_overrides(words)
    assert (program, name, rest) == ("closedloop", "wam_slide", ["--engine", "compiled"])
    assert cl.load_scenario(name, overrides) == history.scenario()


def test_a_scenario_made_in_python_is_named_by_what_differs_from_the_shipped_one():
    """The words give it back; one that no words give is a file, which save writes."""
    for changes in ({}, {"law.kp": [9.0, 8.0, 7.0, 6.0]}, {"friction.kind": "coulomb", "friction.coefficient": 0.2}):
        made = cl.load_scenario("wam_slide", changes)
        name, given = in_words(made)
        assert given.keys() == changes.keys()
        overrides, _ = split_overrides(shlex.split(History(made, name, given).command())[2:])
        assert cl.load_scenario(name, overrides) == made
    other = parse_scenario(cl.load_scenario("wam_slide").to_toml().replace('"wam_slide"', '"my_own"'))
    assert in_words(other) == ("scenario.toml", {})


def test_the_newest_request_wins_and_the_one_before_is_shown_meanwhile():
    """Of a hundred requests in a row the first and the last are computed, hardly any between, in order."""
    gate, shown = threading.Event(), []
    newest = Newest(lambda x: (gate.wait(5.0), x)[1], shown.append)
    newest.ask(0)
    time.sleep(0.05)
    for k in range(1, 100):
        newest.ask(k)
    assert newest.overtaken
    gate.set()
    assert newest.wait(5.0)
    assert shown == [0, 99]
    assert newest.dropped == 98
    newest.close()


def test_an_answer_is_a_run_or_the_one_line_that_says_why_not():
    """An input at fault names its key; a run that cannot go on comes until where it stopped."""
    said = []
    answers = Answers(History(cl.load_scenario("wam_slide", {"time.duration": 0.05}), "wam_slide"), say=said.append)
    good = answers.answer({"law.force": 12.0}, "law.force")
    assert good.fault == good.stopped == ""
    assert good.run.reference_force[0] == 12.0
    assert said[-1] == ""
    bad = answers.answer({"stabiliser.time_constant": 1e-5})
    assert bad.run is None
    assert bad.fault.startswith("stabiliser.time_constant = 1e-05")
    assert "\n" not in bad.fault
    wild = answers.answer(
        {"law.kp": -1e9, "law.pd_start": 0.0, "start.v": [0.0, 0.0, 0.0, 0.0], "reference.start": 0.0}
    )
    assert wild.stopped
    assert 0 < len(wild.run) < 51


def test_a_long_run_is_given_up_when_it_is_overtaken(monkeypatch):
    """On an engine that returns meanwhile; a run within the patience is finished."""
    monkeypatch.setattr("closedloop.lab.answers.PATIENCE", 0.0)
    waiting, base = [True], cl.load_scenario("wam_slide", {"time.integrator": "dop853", "time.duration": 0.2})
    answers = Answers(History(base, "wam_slide"), overtaken=lambda: waiting[0])
    given_up = answers.answer({})
    assert (given_up.run, given_up.fault, given_up.stopped) == (None, "", "")
    waiting[0] = False
    assert len(answers.answer({}).run) == 201


def test_pinned_runs_are_compared_with_the_present_one():
    """The table has the keys that differ and the values with their differences; the fifth pin is refused."""
    base = cl.load_scenario("wam_slide", {"time.duration": 0.05})
    history, pins = History(base, "wam_slide"), Pins()
    answers = Answers(history)
    one, two = answers.answer({}), answers.answer({"law.force": 12.0})
    pins.add(one.run, one.changes)
    rows = dict(compared(pins.held, two.run, two.changes))
    assert rows["law.force"] == ["10.0", "12.0"]
    assert rows["peak_contact_force [N]"] == ["10 (-2)", "12"]
    assert [pins.add(one.run, {}) is not None for _ in range(4)] == [True, True, True, False]
    assert len({pin.colour for pin in pins.held}) == 4


def test_a_run_that_stopped_stands_in_the_table_of_pins():
    """What is wrong with it is named; the table is text."""
    history, pins = History(cl.load_scenario("wam_slide", {"time.duration": 1.0}), "wam_slide"), Pins()
    good = Answers(history).answer({})
    unstable = Answers(history).answer({"law.kp": [9e5] * 4, "law.kd": [0.0] * 4})
    pins.add(unstable.run, unstable.changes)
    assert unstable.stopped
    first, second = dict(compared(pins.held, good.run, good.changes))["verdict"]
    assert "stopped" in first
    assert second == "good"
    assert "stopped" in table_html(pins.held, good.run, good.changes)


def test_what_is_saved_repeats_the_run(tmp_path):
    """The scenario file gives the run's scenario, the run file the run; a second save goes into another folder."""
    answers = Answers(History(cl.load_scenario("wam_slide", {"time.duration": 0.05}), "wam_slide"))
    run = answers.answer({"law.force": 12.0}).run
    scenario, file = save(run, "closedloop wam_slide --law.force 12.0", tmp_path)
    assert cl.load_scenario(scenario) == run.scenario
    assert np.array_equal(cl.load_run(file).contact_force, run.contact_force)
    assert save(run, "", tmp_path)[0].parent != scenario.parent


def test_the_cells_of_a_map_are_the_runs_of_their_changes():
    """Every cell is computed once, coarse ones first, and holds what a single run gives."""
    base = cl.load_scenario("wam_slide", {"time.duration": 0.05})
    x, y = control_of(base, "law.force"), control_of(base, "law.kp", 1)
    found = Map(base, Axis.of(x, 4), Axis.of(y, 3), "peak_contact_force")
    assert list(found.fill(batch=6)) == [6, 12]
    history = History(base, "wam_slide")
    for cell in ((0, 3), (2, 1)):
        run = cl.simulate(history.scenario(found.changes(*cell)), engine="compiled")
        assert found.grid[cell] == run.summary()["peak_contact_force"]
    assert sorted(coarse_first(9, 10)) == [(i, j) for i in range(9) for j in range(10)]
    assert coarse_first(9, 10)[:4] == [(0, 0), (0, 8), (8, 0), (8, 8)]


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


@pytest.mark.parametrize("name", ["wam_slide", "wam_stick_slip", "soft_table", "panda_scan"])
def test_what_runs_share_is_as_if_made_for_each(name):
    """A variant is the scenario read from all its keys; prepared after others, its numbers are those of a new one."""
    base, cache = cl.load_scenario(name, {"time.duration": 0.01}), Cache()
    variants = Variants(base, ("law.force", "sensor.bias"))
    for values in ((base.law.force, 0.0), (7.0, 0.0), (7.0, 0.1), (base.law.force, 0.0)):
        changed = variants.scenario(values)
        whole = cl.load_scenario(name, {"time.duration": 0.01} | dict(zip(variants.keys, values, strict=True)))
        assert changed == whole
        assert changed.to_toml() == whole.to_toml()
        shared, own = prepare(changed, cache=cache), prepare(whole)
        assert np.array_equal(shared.constants().memory, own.loop().constants.memory)
        assert np.array_equal(shared.loop().w.memory, own.loop().w.memory)
        assert np.array_equal(shared.table, own.table)


def test_the_picture_of_a_map_shows_its_cells_while_they_come():
    """At every stage, a linear scale or one of decades: each cell has the colour of its value, grey where none is."""
    base = cl.load_scenario("wam_slide")
    found = Map(
        base, Axis.of(control_of(base, "law.force"), 8), Axis.of(control_of(base, "law.kp", 1), 5), "rms_force_error"
    )
    drawn = MapPicture(found)

    def colours():
        pixels, (left, right, top, bottom) = drawn.draw(True)
        high, wide = pixels.shape[:2]
        x = (left + (right - left) * (np.arange(8) + 0.5) / 8) * wide
        y = (bottom - (bottom - top) * (np.arange(5) + 0.5) / 5) * high
        return pixels[np.ix_(y.astype(int), x.astype(int))].astype(int)

    assert np.ptp(colours()) <= 1
    for values in (np.linspace(1.0, 2.0, 40), np.logspace(-3.0, 3.0, 40)):
        found.grid[:] = values.reshape(5, 8)
        shown = colours().sum(axis=2).ravel()
        assert np.all(np.diff(shown) > 0)
        found.grid[2, 3] = np.nan
        assert np.ptp(colours()[2, 3]) <= 1
    assert len(np.unique(colours().reshape(-1, 3), axis=0)) == 40


def test_where_the_page_is_late_the_picture_waits_for_the_slider_to_rest(monkeypatch):
    """While a slider moves a run is drawn once a second; not if the second run after that came late; and at rest."""
    now, drawn = [100.0], []
    monkeypatch.setattr("closedloop.lab.picture.clock", SimpleNamespace(perf_counter=lambda: now[0]))
    picture = Picture(MagicMock(), None, SimpleNamespace(playing=False), MagicMock(), MagicMock(), 400)
    monkeypatch.setattr(picture, "_show", lambda run: drawn.append(now[0]))

    def drag(seconds, gap):
        drawn.clear()
        end = now[0] + seconds
        while now[0] < end:
            picture.ask(object())
            picture.follow(now[0])
            now[0] += gap(now[0])

    drag(4.0, lambda t: 0.05)
    assert len(drawn) == 4
    drag(14.0, lambda t: 0.3 if drawn and t - drawn[-1] < 0.1 else 0.05)  # each picture keeps the page for 0.3 s
    assert len(drawn) == 1
    now[0] += 0.5
    picture.follow(now[0])
    assert len(drawn) == 2
    assert picture.wait(0.0)
