"""The controls of the lab and what comes of moving them, without a browser."""

import itertools
import shlex
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest
from budget import every

import closedloop as cl
import robot_models
from closedloop.figures.scene.scene import scene_of
from closedloop.lab import controls as all_of
from closedloop.lab import curves
from closedloop.lab.app import Answers
from closedloop.lab.controls import LISTED, begin_values, controls
from closedloop.lab.drawn import from_text, in_text, pack, unpack
from closedloop.lab.history import History, Pins, compared, in_words, save
from closedloop.lab.server import LONG, Newest
from closedloop.lab.start import act, begun
from closedloop.plugins import Annotated, ControlLaw, Field, Positive, gain_in
from closedloop.scenario.load import Variants, parse_scenario, split_overrides
from closedloop.simulation.parts import Cache
from closedloop.simulation.prepare import prepare


def all_controls(scenario):
    """Return every control of a scenario."""
    model = robot_models.load(scenario.robot.model)
    return [control for section in LISTED for control in controls(scenario, section, model)]


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
        "rolling", "pivoting",
    }  # fmt: skip
    changed = Variants(base, (slider.key,)).scenario((0.25,))
    assert [contact.friction for contact in changed.contact].count(0.25) == 1
    assert changed.contact[4].friction == 0.25
    assert controls(cl.load_scenario("wam_slide"), "contact") == []


def test_one_slider_moves_a_key_of_all_contacts():
    """Also of a contact that was moved by itself before; where contacts differ there is none."""
    base = cl.load_scenario("gripper_block")
    history, found = History(base, "gripper_block"), all_of.all_controls(base, robot_models.load("gripper"))
    assert found["contact.*.friction", None].value == base.contact[0].friction
    history.change("contact.3.friction", 0.1)
    apart = all_of.all_controls(history.scenario(), robot_models.load("gripper"))
    assert ("contact.*.friction", None) not in apart
    history.change("contact.*.friction", 0.6)
    assert {each.friction for each in history.scenario().contact} == {0.6}
    history.change("contact.2.friction", 0.2)
    assert [each.friction for each in history.scenario().contact[:4]] == [0.6, 0.6, 0.2, 0.6]


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


def test_a_slow_drag_is_one_step_and_two_drags_are_two():
    """The pointer is held for seconds between changes; a second press, or a key of the keyboard, begins another."""
    now = [0.0]
    history = History(cl.load_scenario("wam_slide"), "wam_slide", now=lambda: now[0])
    for press, force in ((1, 11.0), (1, 12.0), (1, 13.0), (2, 14.0), (None, 15.0), (None, 16.0)):
        now[0] += 5.0
        history.press = press
        history.change("law.force", force)
    seen = [history.changes["law.force"]]
    while history.undo():
        seen.append(history.changes.get("law.force", 10.0))
    assert seen == [16.0, 15.0, 14.0, 13.0, 10.0]


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


@pytest.mark.parametrize("integrator", ["semi_implicit_euler", "dop853"])
def test_a_run_that_has_begun_is_finished_and_its_first_part_is_shown(integrator, monkeypatch):
    """However long it takes, to the bits of a run without looking; the parts grow, and are rows of the whole."""
    monkeypatch.setattr("closedloop.lab.app.SLOW", 0.0)
    monkeypatch.setattr("closedloop.simulation.engines.loops.MOST", 40)
    monkeypatch.setattr("closedloop.simulation.engines.loops.FEW", 40)
    base, parts = cl.load_scenario("wam_slide", {"time.integrator": integrator, "time.duration": 0.2}), []
    said = []
    answers = Answers(History(base, "wam_slide"), say=said.append, part=parts.append)
    found = answers.answer({"law.force": 12.0}).run
    assert len(found) == 201
    assert said[-2].startswith("computing ... ")
    assert said[-1] == "", "a page that opens later would say that the run is being computed"
    whole = cl.simulate(cl.load_scenario("wam_slide", {"law.force": 12.0, "time.integrator": integrator,
                                                       "time.duration": 0.2}), engine=found.engine)  # fmt: skip
    assert np.array_equal(found.contact_force, whole.contact_force)
    if integrator == "dop853":  # whose rows are not there before its end
        assert parts == []
        return
    lengths = [len(part) for part in parts]
    assert len(parts) > 2
    assert lengths == sorted(lengths)
    for part in parts:
        assert np.array_equal(part.contact_force, found.contact_force[: len(part)])


def test_a_run_that_is_about_to_end_shows_no_part(monkeypatch):
    """To draw a part just before the whole would only delay it."""
    ticks = itertools.count()
    clock = SimpleNamespace(perf_counter=lambda: 0.02 * next(ticks), thread_time=lambda: 0.0)  # of each look at it
    monkeypatch.setattr("closedloop.lab.app.clock", clock)
    monkeypatch.setattr("closedloop.simulation.engines.loops.MOST", 40)
    monkeypatch.setattr("closedloop.simulation.engines.loops.FEW", 40)
    base, parts = cl.load_scenario("wam_slide", {"time.duration": 2.0}), []
    answers = Answers(History(base, "wam_slide"), part=parts.append)
    for slow, least in ((0.0, 0.97), (0.4, 0.3)):
        parts.clear()
        monkeypatch.setattr("closedloop.lab.app.SLOW", slow)
        rows = len(answers.answer({"law.force": 12.0}).run)
        assert least < len(parts[-1]) / rows < least + 0.33


def test_the_first_part_is_shown_as_soon_as_a_run_is_known_to_be_slow(monkeypatch):
    """It need not have taken that long: at 0.04 s of 0.2 s already; of a run of 0.08 s no part is shown."""
    ticks = itertools.count()
    clock = SimpleNamespace(perf_counter=lambda: 0.02 * next(ticks), thread_time=lambda: 0.0)  # of each look at it
    monkeypatch.setattr("closedloop.lab.app.clock", clock)
    monkeypatch.setattr("closedloop.simulation.engines.loops.MOST", 200)
    monkeypatch.setattr("closedloop.simulation.engines.loops.FEW", 200)
    parts, said = [], []
    for duration, shown in ((2.0, 1), (0.4, 0)):
        parts.clear()
        base = cl.load_scenario("wam_slide", {"time.duration": duration})
        rows = len(Answers(History(base, "wam_slide"), say=said.append, part=parts.append).answer({}).run)
        assert len(parts) == shown
        assert all(len(part) < 0.3 * rows for part in parts)
    assert not [line for line in said if line.startswith("computing")], "so short a wait need not be explained"


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


def test_what_is_saved_repeats_the_run(tmp_path):
    """The scenario file gives the run's scenario, the run file the run; a second save goes into another folder."""
    answers = Answers(History(cl.load_scenario("wam_slide", {"time.duration": 0.05}), "wam_slide"))
    run = answers.answer({"law.force": 12.0}).run
    scenario, file = save(run, "closedloop wam_slide --law.force 12.0", tmp_path)
    assert cl.load_scenario(scenario) == run.scenario
    assert np.array_equal(cl.load_run(file).contact_force, run.contact_force)
    assert save(run, "", tmp_path)[0].parent != scenario.parent


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


def test_a_whole_list_moves_by_one_factor_and_a_typed_number_may_be_beyond_the_slider():
    """All joints together keep their ratios; from zero all become the same; what is no number is one sentence."""
    gain = control_of(cl.load_scenario("wam_slide"), "law.kp", 1)
    assert gain.together(gain.typed("450")) == [450.0, 450.0, 200.0, 150.0]
    assert gain.typed("1e9")[1] == 1e9
    assert gain.with_value(gain.typed("1e9")).high == pytest.approx(9.0)
    zero = gain.with_value([0.0, 900.0, 400.0, 300.0])
    assert control_of(cl.load_scenario("wam_slide"), "law.kp", 0).index == 0
    first = type(zero)(**{**zero.__dict__, "index": 0})
    assert first.together([5.0, 900.0, 400.0, 300.0]) == [5.0] * 4
    with pytest.raises(ValueError, match=r"law.kp: 'much' is no number"):
        gain.typed("much")


@pytest.mark.parametrize("name", every(4, [(name,) for name in cl.shipped_scenarios()]))
def test_every_key_has_one_row_in_the_group_of_its_meaning(name):
    """Gains, damping, friction and surface stand apart; none is twice or missing; what was changed is marked."""
    scenario = cl.load_scenario(name)
    found = all_of.all_controls(scenario, robot_models.load(scenario.robot.model))
    shown = all_of.rows_in_groups(found.values(), {at: c.own for at, c in found.items()}, {})
    rows = [row for group in shown for row in group["rows"]]
    assert sorted(row["id"] for row in rows) == sorted(k if i is None else f"{k}#{i}" for k, i in found)
    assert not any(row["changed"] for row in rows)
    assert {all_of.group_of(key) for key in ("law.kp", "law.motion_stiffness")} == {all_of.STIFFNESS}
    assert {all_of.group_of(key) for key in ("law.kd", "law.motion_damping")} == {all_of.DAMPING}
    if ("law.force", None) in found:
        force = found["law.force", None].with_value(7.25)
        (group,) = all_of.rows_in_groups([force], {("law.force", None): 1.0}, {"law.force": 7.25})
        assert (group["name"], group["rows"][0]["changed"]) == (all_of.LAW, True)


class Pressing(ControlLaw):
    """A law of the user's own, with a gain."""

    yielding: Annotated[Positive, gain_in("N s/m")] = Field(80.0, description="a gain")

    @staticmethod
    def torque(x, par, z, torque):
        """Compensate C and press."""
        for j in range(torque.size):
            torque[j] = x.C[j] - x.A[0, j] * x.f_des - par.yielding * 0.05 * x.v[j]


def test_a_law_of_ones_own_has_its_name_and_its_gains_are_open():
    """A class is chosen by its name and its group is open; of a function nothing is shown that it does not read."""
    model = robot_models.load("wam4")
    own = all_of.all_controls(cl.load_scenario("wam_slide", {"law.kind": Pressing}), model)
    assert own["law.kind", None].value.endswith(":Pressing")
    (group,) = [g for g in all_of.rows_in_groups(own.values(), {}, {}) if g["name"] == all_of.MORE]
    assert group["open"]
    assert "law.yielding" in {row["key"] for row in group["rows"]}
    shipped = all_of.all_controls(cl.load_scenario("wam_slide"), model)
    assert not any(g["open"] for g in all_of.rows_in_groups(shipped.values(), {}, {}) if g["name"] == all_of.MORE)
    function = all_of.all_controls(cl.load_scenario("wam_slide"), model, "my_laws:press")
    assert function["law.kind", None].options == ("my_laws:press",)
    assert {key for key, _ in function if key.startswith("law.")} == set(all_of.OF_A_FUNCTION)


def test_a_red_tile_says_why():
    """Every tile that is bad has a sentence, which stands below the strip: verdicts, torques, margins."""
    run = cl.simulate(cl.load_scenario("wam_slide", {"law.force": 900.0, "time.duration": 0.6, "time.step": 1e-3}))
    bad = [tile for tile in curves.tiles(run, run.summary()) if tile["good"] is False]
    assert "torque" in {tile["name"] for tile in bad}
    assert all(tile["why"] for tile in [*bad, *curves.margin_tiles({}, False, None, "")])


def test_the_strip_says_what_is_better_than_before():
    """Less error is green, more is red, equal says nothing; torque counts against each joint's own limit."""
    answers = Answers(History(cl.load_scenario("wam_slide_friction", {"time.duration": 2.0}), "wam_slide_friction"))
    start, stiff = answers.answer({}).run, answers.answer({"law.force_integral": 5.0}).run
    before = curves.values(start, start.summary())
    same = {tile["name"]: tile for tile in curves.tiles(start, start.summary(), before, "the start")}
    assert all("change" not in tile for tile in same.values())
    near = {key: None if value is None else 1.0001 * value for key, value in before.items()}  # no digit differs
    assert all("change" not in tile for tile in curves.tiles(start, start.summary(), near, "the start"))
    other = {key: None if value is None else 1.01 * value for key, value in before.items()}
    assert any("change" in tile for tile in curves.tiles(start, start.summary(), other, "the start"))
    found = {tile["name"]: tile for tile in curves.tiles(stiff, stiff.summary(), before, "the start")}
    assert found["force RMS"]["better"] == (stiff.summary()["rms_force_error"] < start.summary()["rms_force_error"])
    assert (found["numbers"]["good"], found["control"]["good"]) == tuple(
        stiff.summary()[key]["good"] for key in ("verdict", "control_verdict")
    )
    shares = np.abs(start.torque).max(axis=0) / start.model.effort_limit
    assert before["torque_share"] == pytest.approx(shares.max())
    off = np.abs(start.contact_force - start.reference_force)
    assert before["peak_force_error"] == pytest.approx(off.max())


def test_margins_stay_where_the_analysis_is_done_before_the_first_strip(monkeypatch):
    """As for a run whose summary takes long: the first strip has them."""
    pytest.importorskip("websockets", reason="websockets is not installed: the extra 'lab'")
    monkeypatch.setattr("closedloop.lab.start.REST", 1.0)
    monkeypatch.setattr("closedloop.lab.start.OFTEN", 1.0)
    monkeypatch.setattr("closedloop.lab.start.LATER", 0.0)
    lab = begun(History(cl.load_scenario("planar2_slide", {"time.duration": 0.2}), "planar2_slide"), port=8471)
    try:
        assert lab.wait(120.0)
        assert "phase margin" in [tile["name"] for tile in unpack(lab._last["strip"])["tiles"]]
    finally:
        lab.close()


def test_messages_hold_trees_and_arrays():
    """What is packed comes back, NaN in arrays included; a number that is not finite is null."""
    message = {"kind": "run", "time": np.array([0.0, np.nan, 1e-3]), "faces": np.array([[1, 2], [3, 4]], np.uint32),
               "rows": [{"x": np.float64(2.0), "none": None}, ["µ", float("inf")]]}  # fmt: skip
    for found in (unpack(pack(message)), from_text(in_text([message]))[0]):
        assert np.array_equal(found["time"], np.array([0.0, np.nan, 1e-3], np.float32), equal_nan=True)
        assert found["faces"].tolist() == [1, 2, 3, 4]
        assert found["rows"] == [{"x": 2.0, "none": None}, ["µ", None]]


def test_work_may_wait_for_a_rest():
    """While requests go on it waits, but not for ever; after a rest it is done once."""
    shown = []
    newest = Newest(lambda x: x, shown.append, rest=0.05, most=10.0)
    for k in range(10):
        newest.ask(k)
        time.sleep(0.005)
    assert newest.wait(5.0)
    assert shown == [9]
    newest.close()
    computing = threading.Event()
    computing.set()
    held = Newest(lambda x: x, shown.append, rest=0.02, most=10.0, held=computing.is_set)
    held.ask(10)
    assert not held.wait(0.2), "while a run is computed nothing rests"
    computing.clear()
    assert held.wait(5.0)
    held.close()
    often = Newest(lambda x: x, shown.append, rest=10.0, most=0.05, held=lambda: True)
    often.ask(10)
    assert often.wait(5.0)
    assert shown[-1] == 10
    often.close()
    moving = threading.Event()
    moving.set()
    slow = Newest(lambda x: (time.sleep(1.1 * LONG), x)[1], shown.append, rest=0.02, most=0.05, held=moving.is_set)
    slow.ask(11)
    assert slow.wait(5.0), "the first time it is not known to be long"
    slow.ask(12)
    assert not slow.wait(4.0 * LONG), "work that takes long waits until nothing goes on"
    moving.clear()
    assert slow.wait(5.0)
    assert shown[-1] == 12
    slow.close()


def test_a_pull_is_a_force_from_outside_at_what_is_held(monkeypatch):
    """Near the tip it is one on the tip, else on the link, at that point of it; the moves of one drag are one force."""
    base = cl.load_scenario("wam_slide", {"time.duration": 0.5})
    run, said = cl.simulate(base), []
    lab = SimpleNamespace(
        answer=SimpleNamespace(run=run), history=History(base, "wam_slide"), tell=lambda *a, **k: said.append(a),
        refresh=lambda: None, changed=lambda key, value: lab.history.change(key, value),
    )  # fmt: skip
    page = SimpleNamespace(time=0.1, pulls=0)
    axes, origins = scene_of(run).joint_places(100)
    at = axes[4].T @ (run.position[100] - origins[4])

    def pull(force, **more):
        act(lab, page, {"do": "pull", "joint": 4, "at": at.tolist(), "force": force, "t": 0.1} | more)
        assert not said
        return lab.history.scenario().external_force

    pull([0.0, 0.0, 1.0], first=True)
    (tip,) = pull([1.0, 2.0, 3.0], last=True)
    assert (tip.link, tip.force, tip.start, tip.duration) == (None, (1.0, 2.0, 3.0), 0.1, 0.2)
    _, link = pull([0.0, 4.0, 0.0], first=True, joint=3, at=[0.0, 0.05, 0.1], t=0.49)
    assert (link.link, link.start) == ("link3", pytest.approx(0.3))
    frame = run.model.pinocchio_model().frames[run.model.pinocchio_model().getFrameId("link3")]
    np.testing.assert_allclose(frame.placement.act(np.array(link.at)), [0.0, 0.05, 0.1], atol=1e-3)
    name, overrides = shlex.split(lab.history.command())[1], shlex.split(lab.history.command())[2:4]
    assert cl.load_scenario(name, {"time.duration": 0.5} | split_overrides(overrides)[0]) == lab.history.scenario()
    for wrong in ({"at": "x"}, {"at": None}, {"force": [1.0]}, {"joint": 99}, {"joint": None}, {"force": ["a"] * 3}):
        assert len(pull(wrong.pop("force", [0.0, 0.0, 1.0]), **wrong)) == 2
