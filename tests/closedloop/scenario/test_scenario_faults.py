"""All faults of a scenario at once; sections without a kind; the path of a robot in a file; the page's template."""

import re
from pathlib import Path

import pytest

import closedloop as cl
from closedloop.base.errors import faults_on_one_line, lines_of
from closedloop.scenario.load import parse_scenario, scenario_of
from closedloop.scenario.messages import MOST_FAULTS
from robot_models.described import path_of

PAGE = Path(__file__).resolve().parents[3] / "docs" / "scenarios.md"
MINIMAL = "[law]\nkp = 1\nkd = 1\n"
FAULTY = """
[law]
kp = 1
force = "ten"
[reference]
speed = 0.02
[surface]
offset = "begin"
[friction]
kind = "glue"
[start]
q = [0, nan, "a"]
[time]
stp = 2
duration = -1
"""
LINES = [
    "unknown key 'reference.speed'; reference.kind is 'hold' where it is not given, and speed is a key of 'line'",
    "unknown key 'time.stp'; did you mean 'time.step'?",
    "friction.kind = 'glue': must be 'coulomb' or 'coulomb_viscous' or 'dahl' or 'karnopp' or 'lugre' or 'none' or "
    "'seven_parameter' or 'stribeck'",
    "surface.offset = 'begin': must be a finite number of metres, or \"start\"",
    "start.q[1] = nan: must be finite, not NaN or infinite",
    "start.q[2] = 'a': must be a number",
    "law.force = 'ten': must be a number",
    "'law.kd' is missing",
    "time.duration = -1: must be greater than 0",
]


def refused(text):
    """Return the faults with which a scenario's text is refused."""
    with pytest.raises(cl.ScenarioError) as caught:
        parse_scenario(text)
    return caught.value


def test_all_faults_are_told_at_once(command_line, tmp_path):
    """Each has a line of its own, with the command's name in front; the status stays 2; Python has them as `faults`."""
    (tmp_path / "bad.toml").write_text(FAULTY)
    outcome = command_line("bad.toml")
    assert (outcome.status, outcome.out) == (2, "")
    assert sorted(outcome.err.splitlines()) == sorted(f"closedloop: bad.toml: {line}" for line in LINES)
    error = refused(FAULTY)
    assert sorted(error.faults) == sorted(f"scenario: {line}" for line in LINES)
    assert str(error).splitlines() == list(error.faults) == list(lines_of(error))
    assert faults_on_one_line(error).count("; ") >= len(LINES) - 1
    assert "\n" not in faults_on_one_line(error)


@pytest.mark.parametrize("key", ["--law.force", "--time.duration"])
def test_the_scenario_and_its_output_at_once(key, command_line, tmp_path):
    """A folder that cannot be written is told with what is wrong with the scenario, read or prepared."""
    (tmp_path / "file").write_text("in the way")
    value = {"--law.force": "ten", "--time.duration": "0.0105"}[key]
    told = command_line("wam_slide", key, value, "--out", "file").err.splitlines()
    assert [line.startswith("closedloop: ") for line in told] == [True, True]
    assert key.removeprefix("--") in told[0]
    assert "--out 'file': cannot be written" in told[1]


@pytest.mark.parametrize("turn", [1, -1])
def test_a_key_that_is_given_is_never_dropped(turn):
    """A change of the kind drops what the file says of the old kind, and not what is given beside it."""
    cl.load_scenario("wam_slide", {"law.kind": "impedance"})  # which has no kp: that of the file goes
    given = dict([("law.kp", 300.0), ("law.kind", "impedance")][::turn])
    with pytest.raises(cl.ScenarioError, match=r"unknown key 'law.kp'; law.kind is 'impedance', and kp is a key of"):
        cl.load_scenario("wam_slide", given)


def test_a_fault_is_told_once():
    """A misspelt key is not missing as well, and the keys of a kind that is none are not unknown."""
    assert refused("[laws]\nkp = 1\n").faults == ("scenario: unknown key 'laws'; did you mean 'law'?",)
    assert len(refused(MINIMAL + "[stabiliser]\nkind = 'spring'\nstiffness = 3\n").faults) == 1


def test_a_thousand_faults_are_no_thousand_lines():
    """As many as fit on a screen are told, and how many more there are."""
    error = refused(MINIMAL + f"[start]\nq = [{'nan, ' * 1000}]\n")
    assert len(error.faults) == MOST_FAULTS + 1
    assert error.faults[-1] == f"scenario: {1000 - MOST_FAULTS} more faults of this sort"


def test_lists_of_a_wrong_length_are_told_together():
    """So are joints that start outside their limits: what only the robot can tell."""
    changes = {"start.q": [0.0], "law.kp": [1, 2], "law.kd": [1, 2, 3]}
    with pytest.raises(cl.ScenarioError) as caught:
        cl.prepare(cl.load_scenario("wam_slide", changes))
    assert [fault.split()[:3:2] for fault in caught.value.faults] == [
        ["start.q", "1"], ["law.kp", "2"], ["law.kd", "3"]
    ]  # fmt: skip
    with pytest.raises(cl.ScenarioError) as caught:
        cl.prepare(cl.load_scenario("wam_slide", {"start.q": [100.0, 1.0, 0.0, 200.0]}))
    assert [fault[:10] for fault in caught.value.faults] == ["start.q[0]", "start.q[3]"]


@pytest.mark.parametrize(("entry", "said"), [
    ({"link": "world", "at": [1.0, 2.0]}, "contact[1].at = [1.0, 2.0]: must be three numbers"),
    ({"link": "a", "at": [0.0, 0.0, 0.0], "normal": [True, 0, 1]}, "contact[1].normal[0] = true: must be a number"),
    ({"link": "a", "at": [0.0, 0.0, 0.0], "norm": 1}, "'contact[1].norm'; did you mean 'contact[1].normal'?"),
    ({"at": [0.0, 0.0, 0.0]}, "'contact[1].link' is missing"),
    (3, "contact[1] = 3: must be tables, each headed [[contact]]"),
])  # fmt: skip
def test_a_fault_in_a_list_of_tables_names_its_key(entry, said):
    """Which table, and which key of it."""
    whole = {"link": "world", "at": [0.0, 0.0, 0.0]}
    with pytest.raises(cl.ScenarioError) as caught:
        scenario_of({"law": {"kp": 1.0, "kd": 1.0}, "contact": [whole, entry]}, "x", {})
    assert any(said in fault for fault in caught.value.faults)


def test_a_row_of_a_batch_has_its_faults_on_one_line():
    """The table's reason is one line, whatever is wrong with the run."""
    scenario = cl.load_scenario("planar2_slide", {"time.duration": 0.01})
    table = cl.simulate_batch(scenario, {"start.q": [[0.6, -1.4], [100.0, 100.0]]})
    assert table["status"].to_pylist() == ["done", "refused"]
    reason = table["reason"].to_pylist()[1]
    assert reason.startswith("start.q[0] = 100: joint J1")
    assert "; start.q[1] = 100: joint J2" in reason
    assert "\n" not in reason


@pytest.mark.parametrize(
    ("section", "kind"),
    [
        ("surface", "plane"), ("reference", "hold"), ("law", "paper"), ("compensation", "none"), ("friction", "none"),
        ("joint_friction", "none"), ("force_profile", "constant"), ("stabiliser", "baumgarte"),
    ],
)  # fmt: skip
def test_a_section_without_a_kind_has_the_usual_one(section, kind):
    """It is that of a scenario which leaves the section out, but that a surface is there only where it is said."""
    text = MINIMAL if section == "law" else MINIMAL + f"[{section}]\n"
    assert getattr(parse_scenario(text), section).kind == kind
    if section != "surface":
        assert parse_scenario(text) == parse_scenario(MINIMAL)


def test_keys_of_the_usual_kind_need_no_kind():
    """[stabiliser] with a time constant alone is Baumgarte's."""
    assert parse_scenario(MINIMAL + "[stabiliser]\ntime_constant = 0.002\n").stabiliser.time_constant == 0.002


@pytest.fixture
def deep(tmp_path, monkeypatch):
    """Return a scenario's file in a folder below the current one, with its robot beside it."""
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "deep"
    folder.mkdir()
    (folder / "mine.urdf").write_bytes(path_of("planar2").read_bytes())
    (folder / "study.toml").write_text('robot.model = "mine.urdf"\n' + MINIMAL)
    return folder / "study.toml"


def test_a_robots_path_is_looked_up_from_the_scenario(deep, tmp_path, monkeypatch):
    """From any current folder, and from a copy of the scenario's own text; an absolute path stays."""
    scenario = cl.load_scenario("deep/study.toml")
    assert scenario.robot.model == str(deep.parent / "mine.urdf")
    (tmp_path / "copy.toml").write_text(scenario.to_toml())
    monkeypatch.chdir(deep.parent)
    assert cl.load_scenario("../copy.toml").robot == scenario.robot
    assert cl.prepare(cl.load_scenario("study.toml", {"time.duration": 0.01})).robot.n == 2


def test_a_robots_path_on_the_command_line_is_looked_up_from_here(deep, command_line, tmp_path, short):
    """It takes the place of the file's; a robot that ships is no path."""
    (tmp_path / "other.urdf").write_bytes(path_of("planar2").read_bytes())
    assert command_line("deep/study.toml", "--robot.model", "other.urdf", *short).status == 0
    assert cl.load_run("out/study/run.nc").scenario.robot.model == str(tmp_path / "other.urdf")
    assert "'mine.urdf'" not in command_line("deep/study.toml", "--robot.model", "none.urdf", *short).refusal()
    assert cl.load_scenario("wam_slide").robot.model == "wam4"


def test_a_robot_that_is_only_in_the_current_folder(deep, command_line, tmp_path, short):
    """The refusal says where it is looked up and what to write; where it is nowhere, that there is no such file."""
    (deep.parent / "mine.urdf").rename(tmp_path / "mine.urdf")
    line = command_line("deep/study.toml", *short).refusal()
    assert line.startswith("deep/study.toml: robot.model = 'mine.urdf': is looked up from the folder of the scenario")
    assert "write '../mine.urdf', or give --robot.model mine.urdf" in line
    assert command_line("deep/study.toml", "--robot.model", "mine.urdf", *short).status == 0
    (tmp_path / "mine.urdf").unlink()
    assert "mine.urdf" in command_line("deep/study.toml", *short).refusal()


def test_a_list_where_a_law_takes_a_number_names_the_law():
    """A list of the scenario's may be right for its own law, and wrong for the one that was chosen."""
    with pytest.raises(cl.ScenarioError) as caught:
        cl.load_scenario("wam_slide", {"law.kind": "impedance", "law.stiffness": [1, 2]})
    assert str(caught.value) == "wam_slide: law.stiffness = [1, 2]: must be a number with law.kind = 'impedance'"


def test_a_run_is_repeated_without_its_robots_file(deep, command_line, short):
    """run.nc has the robot's text."""
    assert command_line("deep/study.toml", *short, "--out", "a").status == 0
    (deep.parent / "mine.urdf").unlink()
    assert command_line("a/run.nc", *short, "--out", "b").status == 0
    assert (cl.load_run("b/run.nc").torque == cl.load_run("a/run.nc").torque).all()


def test_the_template_of_the_page_runs(tmp_path):
    """The first block of the page, pasted into a file, is a scenario of its own that can be run."""
    block, *_ = re.findall(r"```toml\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    (tmp_path / "mine.toml").write_text(block, encoding="utf-8")
    scenario = cl.load_scenario(tmp_path / "mine.toml")
    assert scenario.time.duration == 6.0
    run = cl.simulate(cl.load_scenario(tmp_path / "mine.toml", {"time.duration": 0.6}))
    assert run.summary()["verdict"]["good"]
    assert run.contact_force[-1] == pytest.approx(10.0, abs=0.1)
