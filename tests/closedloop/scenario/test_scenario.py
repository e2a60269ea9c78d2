"""Scenarios: read, changed, written, and refused in one line that names the key, the value and the cure."""

import tomllib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import closedloop as cl
from closedloop.base.sections import ANGLE, PLACE
from closedloop.loop.step.record_row import Row
from closedloop.scenario.load import Variants, parse_scenario
from closedloop.scenario.messages import all_keys, describe_section, explain_key, keys, sections
from closedloop.simulation.time_step import MOST_NUMBERS
from robot_models.described import path_of

MINIMAL = "[law]\nkp = 1\nkd = 1\n"
MOST_ROWS = str(MOST_NUMBERS // Row.count(4))
ONE_LINE = 400  # characters; a terminal of 80 columns shows it in five rows


def refusal(changes, name="wam_slide"):
    """Return the one line with which a scenario is refused, by the file's checks or by `prepare`."""
    with pytest.raises(cl.ClosedLoopError) as caught:
        cl.prepare(cl.load_scenario(name, {"time.duration": 0.01} | changes))
    assert isinstance(caught.value, cl.ScenarioError | cl.ModelError)
    return one_line(str(caught.value))


def one_line(message):
    """Return the message, having checked that it is a single short line without Python's inner words."""
    assert len(message.splitlines()) == 1, message
    assert len(message) < ONE_LINE, message
    for inner in ("pydantic", "function-before", "Traceback", "input_value", "tuple[", "NoneType"):
        assert inner not in message, message
    return message


def finite_numbers():
    """Return a strategy for numbers that a TOML file can hold."""
    return st.floats(allow_nan=False, allow_infinity=False)


@pytest.mark.parametrize("name", cl.shipped_scenarios())
def test_written_scenario_is_read_back_equal(name, tmp_path):
    """What `to_toml` writes is a scenario file that reads back to an equal scenario, and says every setting."""
    scenario = cl.load_scenario(name)
    file = tmp_path / "copy.toml"
    file.write_text(scenario.to_toml(), encoding="utf-8")
    assert cl.load_scenario(file) == scenario
    assert cl.load_scenario(str(file)) == scenario
    assert cl.load_scenario(file).to_toml() == scenario.to_toml()


@given(
    st.lists(st.floats(-ANGLE.most, ANGLE.most), min_size=4, max_size=4),
    st.lists(finite_numbers(), min_size=3, max_size=3).filter(any),
    st.floats(-PLACE.most, PLACE.most),
    st.floats(1e-9, 1e9),
    st.text(st.characters(blacklist_categories=("Cs",))),
)
def test_any_number_survives_being_written(q, normal, offset, duration, text):
    """Every finite number and every text comes back from TOML to the last bit."""
    changes = {"start.q": q, "surface.normal": normal, "surface.offset": offset, "time.duration": duration}
    scenario = cl.load_scenario("wam_slide", changes | {"description": text})
    assert parse_scenario(scenario.to_toml()) == scenario


@pytest.mark.parametrize("name", cl.shipped_scenarios())
def test_shipped_file_is_commented_and_complete(name):
    """A shipped file opens with what one will see, has a description, and names no key twice."""
    text = (Path(cl.__file__).parent / "scenario" / "shipped" / f"{name}.toml").read_text(encoding="utf-8")
    assert text.startswith("#")
    assert "What you will see" in text
    arm = set() if "[[contact]]" in text else {"surface", "start", "reference", "law"}  # bodies may fall
    assert {"robot", "stabiliser", "time"} | arm <= set(tomllib.loads(text))
    scenario = cl.load_scenario(name)
    assert scenario.name == name
    assert 20 < len(scenario.description) <= 110


def test_smallest_scenario_is_a_law_alone(tmp_path):
    """Everything but the law's gains has a default, and the name is the file's; without a surface f is 0."""
    file = tmp_path / "tiny.toml"
    file.write_text(MINIMAL)
    scenario = cl.load_scenario(file)
    assert scenario.name == "tiny"
    assert scenario.robot.model == "wam4"
    assert scenario.reference.kind == "hold"
    run = cl.simulate(cl.load_scenario(file, {"time.duration": 0.01, "surface.kind": "plane"}))
    assert run.contact_force == pytest.approx(np.full(11, 10.0))
    assert not cl.simulate(cl.load_scenario(file, {"time.duration": 0.01})).contact_force.any()


def test_gains_for_all_joints_may_be_one_number():
    """One gain is the same as that gain for every joint."""
    one, many = (cl.prepare(cl.load_scenario("wam_slide", {"law.kp": kp})).gains[0] for kp in (50, [50, 50.0, 50, 50]))
    assert np.array_equal(one, many)


def test_overrides_lie_over_the_file():
    """An override changes its key and no other, and the file stays as it is."""
    plain = cl.load_scenario("wam_slide")
    changed = cl.load_scenario("wam_slide", {"law.force": 15, "time.step": 0.002, "robot.lock.J3": 0.0})
    assert changed.law.force == 15.0
    assert changed.time.step == 0.002
    assert changed.robot.lock == {"J3": 0.0}
    assert changed.law.model_copy(update={"force": 10.0}) == plain.law
    assert changed.reference == plain.reference
    assert cl.load_scenario("wam_slide") == plain


def test_overrides_stay_the_callers_own():
    """A table that is handed in as an override is not changed, though later overrides go into it."""
    mine = {"J3": 0.0}
    scenario = cl.load_scenario("wam_slide", {"robot.lock": mine, "robot.lock.J2": 1.0})
    assert scenario.robot.lock == {"J3": 0.0, "J2": 1.0}
    assert mine == {"J3": 0.0}


def test_a_dotted_key_in_a_dictionary_is_explained():
    """There a section is a dictionary; dots are for overrides."""
    with pytest.raises(cl.ScenarioError, match=r"robot = \{model = \.\.\.\}; a dot is for overrides"):
        cl.load_scenario({"robot.model": "planar2"})


def test_another_kind_drops_the_keys_of_the_old():
    """Overriding a kind drops what the new kind does not know, and nothing else, in any order of the overrides."""
    assert cl.load_scenario("wam_slide", {"stabiliser.kind": "none"}).stabiliser.model_dump() == {"kind": "none"}
    every_path = {"on_surface": "projected", "orientation": "free"}
    hold = cl.load_scenario("wam_slide", {"reference.kind": "hold"}).reference.model_dump()
    assert hold == every_path | {"kind": "hold"}
    back = {"stabiliser.kind": "baumgarte", "stabiliser.time_constant": 0.002}
    for changes in (back, dict(reversed(back.items()))):
        assert cl.load_scenario("wam_slide_unstabilised", changes).stabiliser.time_constant == 0.002
    same = cl.load_scenario("wam_slide", {"stabiliser.kind": "baumgarte"})
    assert same == cl.load_scenario("wam_slide")


def test_key_of_another_kind_is_an_error():
    """A key that only another kind knows is refused when it is asked for beside the kind."""
    line = refusal({"stabiliser.kind": "none", "stabiliser.time_constant": 0.002})
    assert "stabiliser.time_constant" in line


def test_scenario_cannot_be_changed_afterwards():
    """A scenario is frozen, and its lists are tuples."""
    scenario = cl.load_scenario("wam_slide")
    with pytest.raises(cl.ScenarioError) as refused:
        scenario.law.force = 3.0
    assert str(refused.value) == (
        "law.force: a scenario is not changed; scenario.replace({'law.force': 3.0}) returns another one"
    )
    with pytest.raises(cl.ScenarioError, match=r"^name: .*replace\(\{'name': 'x'\}\)"):
        scenario.name = "x"
    assert scenario.law.force == 10.0
    assert isinstance(scenario.start.q, tuple)


def test_every_key_is_described():
    """--help can list every section, and --explain every key there is, with what it is, on 80 columns."""
    known = all_keys()
    assert {"robot.model", "surface.normal", "start.q", "reference.speed", "law.force", "time.step"} <= set(known)
    assert all(sections().values())
    for text in (*map(explain_key, known), *map(describe_section, sections())):
        assert max(map(len, text.splitlines())) <= 80, text
    shipped = [
        key for section in sections() for key in keys(section) if not all(":" in kind for kind in key.kinds or [""])
    ]
    assert all(key.field.description for key in shipped)  # users' classes, of other tests, may have keys without


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("wam_slid", ["'wam_slid'", "did you mean 'wam_slide'"]),
        ("wipe", ["'wipe'", "did you mean 'panda_wipe'"]),
        ("nosuch", ["'nosuch'", "'closedloop scenarios' lists them"]),  # no name is like it
        ("xyzzy", ["'xyzzy'", "wam_slide", ".toml"]),
        ("", ["wam_slide"]),
        ("missing.toml", ["missing.toml", "No such file"]),
        (Path("missing.toml"), ["missing.toml", "No such file"]),
        ("two\nlines", ["wam_slide"]),
        ("nul\0.toml", ["nul"]),
    ],
)
def test_scenario_that_is_not_there(name, words):
    """A name that is none is refused with the nearest, a file that is none with the reason."""
    with pytest.raises(cl.ScenarioError) as caught:
        cl.load_scenario(name)
    line = one_line(str(caught.value))
    assert all(word in line for word in words), line


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"law = [", ["not valid TOML"]),
        (b"law = 1\nlaw = 2\n", ["not valid TOML", "line 2"]),
        (b"[law]\nkp = 1\nkp = 2\n", ["not valid TOML"]),
        (b"\xff\xfe", ["UTF-8"]),
        (b"", ["'robot' is missing"]),
        (b"[time]\nduration = 1.0\n", ["'robot' is missing"]),
        (b"[law]\nkd = 1\n", ["'law.kp'", "missing"]),
        (b"law = 3\n", ["law = 3", "[law]"]),
        (b"[[law]]\nkp = 1\n", ["law", "[law]"]),
        (b"speed = 3\n[law]\nkp = 1\nkd = 1\n", ["unknown", "'speed'"]),
        (b'"a\\nb" = 3\n[law]\nkp = 1\nkd = 1\n', ["unknown"]),
        (b"[laws]\nkp = 1\n", ["laws", "did you mean 'law'"]),
        (b"[law]\nkp = 1\nkd = 1\nforce = 1" + b"0" * 400, ["law.force"]),
        (b"[law]\nkp = 1\nkd = 1\nforce = 1" + b"0" * 5000, ["mine.toml"]),
        (b"[law]\nkp = 1\nkd = 1\nforce = " + b"[" * 100_000, ["mine.toml"]),
        (b"[law]\nkp = 1\nkd = 1\nforce = 2020-01-01\n", ["law.force", "number"]),
        (b"name = 3\n[law]\nkp = 1\nkd = 1\n", ["name", "text"]),
        (b'name = "../up"\n[law]\nkp = 1\nkd = 1\n', ["name"]),
        (b'name = "/abs"\n[law]\nkp = 1\nkd = 1\n', ["name"]),
        (b'name = "nul\\u0000"\n[law]\nkp = 1\nkd = 1\n', ["name"]),
        (b'name = "two\\nlines"\n[law]\nkp = 1\nkd = 1\n', ["name"]),
    ],
    ids=lambda x: ascii(x)[:40] if isinstance(x, bytes) else "",
)
def test_file_that_is_no_scenario(content, words, tmp_path):
    """A file that is no scenario is refused with the file, the place and what would be right.

    A name goes into the path that results are written to, so it must not lead out of the folder.
    """
    file = tmp_path / "mine.toml"
    file.write_bytes(content)
    with pytest.raises(cl.ScenarioError) as caught:
        cl.load_scenario(file)
    line = one_line(str(caught.value))
    assert all(word in line for word in words), line


def test_folder_is_no_scenario(tmp_path):
    """A folder whose name ends in .toml is refused like a file that cannot be read."""
    folder = tmp_path / "folder.toml"
    folder.mkdir()
    with pytest.raises(cl.ScenarioError, match="cannot be read"):
        cl.load_scenario(folder)


NAN, INF = float("nan"), float("inf")

REFUSED = {
    # unknown and missing
    "unknown key, near another": ({"law.forse": 3}, ["law.forse", "did you mean 'law.force'"]),
    "unknown key": ({"law.xyz": 3}, ["law.xyz", "kp", "kd", "force"]),
    "unknown section": ({"xyz.key": 3}, ["'xyz'", "sections", "robot"]),
    "unknown section, near another": ({"surfaces.normal": [0, 0, 1]}, ["'surfaces'", "did you mean 'surface'"]),
    "key below a number": ({"law.kp.first": 1}, ["law.kp.first", "'kp'", "section"]),
    "section that is a number": ({"law": 3}, ["law", "[law]"]),
    "unknown key below a kind": ({"reference.kind": "hold", "reference.speed": 1}, ["reference.speed"]),
    "unknown key with the name of a kind": ({"law.paper": 1}, ["'law.paper'", "[law] has", "kp"]),
    "unknown key with the name of the kind that it is": ({"reference.line": 1}, ["'reference.line'"]),
    # kinds
    "unknown reference": ({"reference.kind": "spiral"}, ["reference.kind", "'spiral'", "'line'", "'hold'"]),
    "unknown surface": ({"surface.kind": "saddle"}, ["surface.kind", "'saddle'", "'plane'"]),
    "unknown law": ({"law.kind": "pid"}, ["law.kind", "'pid'", "'paper'"]),
    "unknown integrator": ({"time.integrator": "rk5"}, ["time.integrator", "'rk5'", "'rk4'"]),
    "kind that is a list": ({"stabiliser.kind": ["none"]}, ["stabiliser.kind"]),
    "kind that is a table": ({"stabiliser.kind": {"a": 1}}, ["stabiliser.kind"]),
    "kind that is a number": ({"stabiliser.kind": 1}, ["stabiliser.kind", "'baumgarte'"]),
    # types
    "text for a number": ({"law.force": "ten"}, ["law.force", "'ten'", "number"]),
    "true for a number": ({"law.force": True}, ["law.force", "number"]),
    "true in a list": ({"surface.normal": [0, 0, True]}, ["surface.normal", "2", "number"]),
    "true in gains": ({"law.kp": [1, 2, 3, True]}, ["law.kp", "3", "number"]),
    "true for a step": ({"time.step": True}, ["time.step", "number"]),
    "a list for a number": ({"law.force": [10.0]}, ["law.force", "number"]),
    "a number for a list": ({"start.q": 1.0}, ["start.q", "list of numbers"]),
    "text for a list": ({"surface.normal": "up"}, ["surface.normal", "'up'", "numbers"]),
    "text in a list": ({"start.q": [0, "a", 0, 0]}, ["start.q", "1", "'a'", "number"]),
    "a list in a list": ({"start.q": [[0], 0, 0, 0]}, ["start.q", "0", "number"]),
    "1 for true": ({"robot.drive_inertia": 1}, ["robot.drive_inertia", "true or false"]),
    "a number for a name": ({"robot.model": 3}, ["robot.model", "text"]),
    "a word for an offset": ({"surface.offset": "begin"}, ["surface.offset", "'begin'", "number", '"start"']),
    "true for an offset": ({"surface.offset": True}, ["surface.offset", "number"]),
    "true for a locked joint": ({"robot.lock": {"J3": True}}, ["robot.lock.J3", "number"]),
    "a list of locked joints": ({"robot.lock": ["J3"]}, ["robot.lock"]),
    "no number at all": ({"law.force": None}, ["law.force"]),
    # not finite
    "NaN force": ({"law.force": NAN}, ["law.force", "finite"]),
    "infinite force": ({"law.force": -INF}, ["law.force", "finite"]),
    "NaN in q": ({"start.q": [0, NAN, 0, 0]}, ["start.q", "1", "finite"]),
    "infinite v": ({"start.v": [0, 0, INF, 0]}, ["start.v", "2", "finite"]),
    "NaN in the normal": ({"surface.normal": [NAN, 0, 1]}, ["surface.normal", "0", "finite"]),
    "infinite direction": ({"reference.direction": [0, INF, 0]}, ["reference.direction", "1", "finite"]),
    "NaN in gains": ({"law.kd": [1, 2, NAN, 3]}, ["law.kd", "2", "finite"]),
    "NaN gain": ({"law.kp": NAN}, ["law.kp", "finite"]),
    "NaN offset": ({"surface.offset": NAN}, ["surface.offset", "finite"]),
    "NaN speed": ({"reference.speed": NAN}, ["reference.speed", "finite"]),
    "infinite stop": ({"reference.stop": INF}, ["reference.stop", "finite"]),
    "NaN step": ({"time.step": NAN}, ["time.step"]),
    "infinite duration": ({"time.duration": INF}, ["time.duration", "finite"]),
    "NaN time constant": ({"stabiliser.time_constant": NAN}, ["stabiliser.time_constant"]),
    "infinite damping": ({"stabiliser.damping_ratio": INF}, ["stabiliser.damping_ratio", "finite"]),
    "NaN locked joint": ({"robot.lock": {"J3": NAN}}, ["robot.lock.J3", "finite"]),
    "NaN period": ({"law.sample_period": NAN}, ["law.sample_period"]),
    "a whole number beyond all floats": ({"law.force": 10**400}, ["law.force"]),
    # sizes
    "step zero": ({"time.step": 0}, ["time.step", "greater than 0"]),
    "negative step": ({"time.step": -0.001}, ["time.step", "-0.001", "greater than 0"]),
    "negative duration": ({"time.duration": -1.0}, ["time.duration", "greater than 0"]),
    "time constant zero": ({"stabiliser.time_constant": 0.0}, ["stabiliser.time_constant", "greater than 0"]),
    "negative damping": ({"stabiliser.damping_ratio": -0.1}, ["stabiliser.damping_ratio", "negative"]),
    "negative start": ({"reference.start": -1.0}, ["reference.start", "negative"]),
    "negative period": ({"law.sample_period": -0.004}, ["law.sample_period", "negative"]),
    "duration no multiple": ({"time.duration": 0.0105}, ["time.duration", "0.0105", "whole number of steps"]),
    "duration below a step": ({"time.duration": 0.0001}, ["time.duration", "whole number of steps", "0.001"]),
    "period no multiple": ({"law.sample_period": 0.0015}, ["law.sample_period", "whole number of steps"]),
    "too many rows": ({"time.step": 1e-9, "time.duration": 8.0}, ["time.step", "8e+09 rows", MOST_ROWS]),
    "absurdly many rows": ({"time.step": 1e-9, "time.duration": 1e9}, ["time.step", "rows"]),
    "a step that is none": ({"time.step": 1e-300}, ["time.step", "at least 1e-09 s"]),
    # lengths
    "q too short": ({"start.q": [1.0, 2.0]}, ["start.q", "2 entries", "4 joints", "J1"]),
    "q too long": ({"start.q": [0.0] * 5}, ["start.q", "5 entries", "4 joints"]),
    "v too short": ({"start.v": [0.0]}, ["start.v", "1 entr", "4 joints"]),
    "v of no entries": ({"start.v": []}, ["start.v", "4 joints"]),
    "gains too short": ({"law.kp": [1, 2, 3]}, ["law.kp", "3 entries", "4 joints"]),
    "damping too long": ({"law.kd": [1] * 5}, ["law.kd", "5 entries", "4 joints"]),
    "normal of two": ({"surface.normal": [0, 1]}, ["surface.normal", "three numbers"]),
    "normal of four": ({"surface.normal": [0, 0, 1, 0]}, ["surface.normal", "three numbers"]),
    "direction of one": ({"reference.direction": [1]}, ["reference.direction", "three numbers"]),
    "tensor of three": ({"tool.inertia": [1, 1, 1]}, ["tool.inertia = [1, 1, 1]: must be six numbers"]),
    "tensor of nine": ({"tool.inertia": [1.0] * 9}, ["tool.inertia", "must be six numbers"]),
    "extent of one": ({"surface.extent": [1]}, ["surface.extent = [1]: must be two numbers"]),
    # what cannot be simulated
    "normal zero": ({"surface.normal": [0, 0, 0]}, ["surface.normal", "direction"]),
    "direction zero": ({"reference.direction": [0, 0, 0]}, ["reference.direction", "direction"]),
    "direction out of the plane": ({"reference.direction": [0, 1, 1]}, ["reference.direction", "[0.0, 1.0, 0.0]"]),
    "direction along the normal": ({"reference.direction": [0, 0, 1]}, ["reference.direction", "surface"]),
    "stop before start": ({"reference.stop": 0.2}, ["reference.stop", "0.2", "reference.start", "0.5"]),
    "stop at start": ({"reference.stop": 0.5}, ["reference.stop", "reference.start"]),
    "no such robot": ({"robot.model": "pandas"}, ["'pandas'", "did you mean 'panda'"]),
    "no such robot file": ({"robot.model": "nowhere.urdf"}, ["nowhere.urdf"]),
    "no such tip": ({"robot.tip": "hand"}, ["'hand'", "'tip'"]),
    "no such joint to lock": ({"robot.lock": {"J9": 1.0}}, ["'J9'", "J1, J2, J3, J4"]),
    "start outside the limits": ({"start.q": [100.0, 1.0, 0.0, 2.0]}, ["start.q[0]", "J1", "100"]),
    "path out of reach": ({"reference.stop": 60.5, "reference.speed": 0.1}, ["reference", "unreachable"]),
    "unstable stabiliser": ({"stabiliser.time_constant": 0.0005}, ["stabiliser.time_constant", "1.035", "unstable"]),
    "unstable step": ({"time.step": 0.002}, ["time.step", "1.035", "unstable"]),
    "explicit Euler without damping": (
        {"stabiliser.damping_ratio": 0.0, "time.integrator": "explicit_euler"},
        ["stabiliser.damping_ratio", "unstable", "larger damping"],
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_bad_setting_is_refused_in_one_line(case):
    """Each bad setting is refused with one line that has the key, the value or the reason, and what would be right."""
    changes, words = REFUSED[case]
    line = refusal(changes)
    assert all(word in line for word in words), line


ACCEPTED = {
    "a force that pulls": {"law.force": -3},
    "no force": {"law.force": 0},
    "a long normal": {"surface.normal": [0, 0, 1e300]},
    "a short normal": {"surface.normal": [0, 0, 1e-310]},
    "no speed": {"reference.speed": 0.0},
    "a motion that starts at once": {"reference.start": 0.0, "reference.stop": 1.0},
    "a motion after the end": {"reference.start": 3.0, "reference.stop": 4.0},
    "undamped stabiliser of rk4": {"stabiliser.damping_ratio": 0.0, "time.integrator": "rk4"},
    "strong damping": {"stabiliser.damping_ratio": 2000.0, "stabiliser.time_constant": 10.0},
    "a stabiliser that is hardly there": {"stabiliser.time_constant": 1e300},
    "a step that rounds": {"time.step": 0.0001, "time.duration": 0.0007},
    "a single step": {"time.duration": 0.001},
    "a third": {"time.step": 1 / 3e3, "time.duration": 0.01},
    "a locked joint": {"robot.lock.J3": 0.0, "start.q": [1.57, 1, 2], "start.v": None, "law.kp": 10, "law.kd": 1},
    "integers for numbers": {"law.force": 10, "start.v": [0, 0, 0, 0], "time.duration": 1},
}  # fmt: skip


@pytest.mark.parametrize("case", ACCEPTED)
def test_unusual_setting_is_accepted(case):
    """What is unusual but right is prepared without complaint: a refusal must not be a habit."""
    problem = cl.prepare(cl.load_scenario("wam_slide", {"time.duration": 0.01} | ACCEPTED[case]))
    assert problem.steps >= 1
    assert np.all(np.isfinite(problem.path))


@pytest.mark.parametrize("side", [-1, 1])
def test_surface_that_the_tip_does_not_start_on_is_refused(side, robot):
    """A surface off the tip's start is refused with the offset that would be right; a hair off is accepted.

    The closure is rigid and holds the tip wherever it starts: a wall in mid-air would be silently wrong.
    """
    height = float(robot("wam4").position(cl.load_scenario("wam_slide").start.q)[2])
    cl.prepare(cl.load_scenario("wam_slide", {"surface.offset": height + side * 1e-6, "time.duration": 0.01}))
    line = refusal({"surface.offset": height - side * 0.05})
    assert "0.05 m off" in line if side > 0 else "0.05 m inside" in line
    cure = float(line.split()[-1])
    assert cure == pytest.approx(height, abs=1e-8)
    cl.prepare(cl.load_scenario("wam_slide", {"surface.offset": cure, "time.duration": 0.01}))


def test_a_scenario_file_may_name_a_robot_file(tmp_path, monkeypatch):
    """A robot in a file of the user's own is found in the folder in which scenario and user are."""
    (tmp_path / "mine.urdf").write_bytes(path_of("planar2").read_bytes())
    (tmp_path / "study.toml").write_text('robot.model = "mine.urdf"\n' + MINIMAL)
    monkeypatch.chdir(tmp_path)
    assert cl.prepare(cl.load_scenario("study.toml", {"time.duration": 0.01})).robot.n == 2


def test_numbers_and_arrays_of_numpy_are_those_of_a_file():
    """As an override; what is no number stays none."""
    gains = np.array([900.0, 400.0, 400.0, 300.0])
    changes = {"law.force": np.float32(12.5), "law.kp": gains, "sensor.seed": np.int64(3)}
    scenario = cl.load_scenario("wam_slide", changes)
    assert (scenario.law.force, scenario.law.kp, scenario.sensor.seed) == (12.5, tuple(gains), 3)
    with pytest.raises(cl.ScenarioError, match=r"law.force = \(3\+1j\): must be a number"):
        cl.load_scenario("wam_slide", {"law.force": np.complex64(3 + 1j)})


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (lambda: cl.load_scenario("wam_slide", ["law.force"]), "overrides = ['law.force']: must be keys and their"),
        (lambda: cl.simulate("wam_slide"), "scenario = 'wam_slide': must be a Scenario, as load_scenario"),
        (lambda: cl.halve("wam_slide"), "scenario = 'wam_slide': must be a Scenario, as load_scenario"),
    ],
)
def test_what_is_no_scenario_is_refused_in_one_line(wrong, said):
    """A name in place of a scenario, a list in place of overrides."""
    with pytest.raises(cl.ScenarioError) as caught:
        wrong()
    assert str(caught.value).startswith(said)


BRISTLES = {"kind": "lugre", "static": 0.5, "kinetic": 0.3, "stribeck_speed": 0.01, "stiffness": 1e4, "damping": 10.0}


@pytest.mark.parametrize("more", [{}, {"friction": BRISTLES}])
def test_numbers_are_read_in_their_sections_as_in_the_whole(more):
    """A number of a section makes the scenario, or the message, that it makes where all sections are read again.

    Of bristles what is static and what is kinetic depend on each other.
    """
    scenario, short = cl.load_scenario("wam_slide", more), 0
    for section, part in scenario:
        for key in getattr(type(part), "model_fields", ()):
            for value in (np.float64(0.5), -1, [0.1] * 4, float("nan")):
                own, whole = (Variants(scenario, (f"{section}.{key}",)) for _ in range(2))
                short, whole._alone = short + own._alone, False
                assert _read(own, value) == _read(whole, value)
    assert short


def _read(variants, value):
    try:
        return variants.scenario((value,)).to_toml()
    except cl.ScenarioError as error:
        return str(error)
