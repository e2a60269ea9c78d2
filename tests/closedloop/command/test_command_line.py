"""The command line: what it writes and prints, its exit statuses, and one line for every mistake."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import closedloop as cl
from closedloop import figures
from closedloop.record.report.verdict import CHATTER_SHARE, CLOSURE_BOUND, ENERGY_SHARE
from closedloop.run import main
from robot_models.described import path_of

ROOT = Path(cl.__file__).parent.parent
PROMISED = {
    "scenario", "steps", "final_contact_force", "peak_contact_force", "min_contact_force", "max_abs_closure_error",
    "final_closure_error", "max_kkt_residual", "max_kkt_condition", "assumptions", "wall_seconds",
}  # fmt: skip
# Shipped scenarios whose subject is control that is bad; of all others it is good.
BAD_ON_PURPOSE = {"hidden_bump", "payload_mismatch", "wam_slide_friction", "wam_stick_slip"}
LONG = ("delta", "stewart", "panda_polish", "gripper_gear", "five_bar")  # seconds each


def strict(text):
    """Parse JSON that has no NaN or Infinity in it."""

    def refuse(constant):
        raise AssertionError(f"{constant} is no JSON")

    return json.loads(text, parse_constant=refuse)


def test_list_shows_every_scenario(command_line):
    """--list has one line per shipped scenario, with its description."""
    outcome = command_line("--list")
    assert outcome.status == 0
    assert outcome.err == ""
    lines = outcome.out.splitlines()
    assert len(lines) == len(cl.shipped_scenarios()) >= 4
    for line, name in zip(lines, cl.shipped_scenarios(), strict=True):
        assert line.split()[0] == name
        assert line.endswith(cl.load_scenario(name).description)


@pytest.mark.parametrize(
    "name", [pytest.param(each, marks=pytest.mark.slow if each in LONG else ()) for each in cl.shipped_scenarios()]
)
def test_every_shipped_scenario_runs(name, command_line, tmp_path):
    """Each shipped scenario runs to its end by its name, leaves run.nc and summary.json, and is good.

    With room: three times the energy left would still pass, ten times the chatter. Its control is bad only where that
    is its subject.
    """
    outcome = command_line(name, "--no-figures", "--out", "results")
    assert outcome.status == 0, outcome.err
    assert outcome.err == ""
    assert sorted(p.name for p in (tmp_path / "results").iterdir()) == ["run.nc", "summary.json"]
    run = cl.load_run(tmp_path / "results" / "run.nc")
    loaded = cl.load_scenario(name)
    assert run.scenario in (loaded, cl.prepare(loaded).scenario)  # with the contacts of collision shapes
    facts = strict((tmp_path / "results" / "summary.json").read_text())
    if name in ("wam_edge", "wam_slide_friction", "two_arms_bar", "four_bar", "soft_table"):  # each shows other things
        assert facts == run.summary()
    assert facts["verdict"]["problems"] == []
    assert facts["control_verdict"]["good"] == (name not in BAD_ON_PURPOSE), facts["control_verdict"]
    stake = facts["energy_exchanged"] + facts["energy_lost_to_friction"] + facts["max_kinetic_energy"]
    at_rest = 1e-14  # J: bodies that rest exchange none but rounding's
    assert 3.0 * facts["max_energy_residual"] < max(max(ENERGY_SHARE.values()) * stake, at_rest)
    assert 10.0 * (facts["force_chatter"] or 0.0) < CHATTER_SHARE
    assert 10.0 * max(joint["torque_chatter"] for joint in facts["joints"].values()) < CHATTER_SHARE
    if run.scenario.has_surface and run.scenario.compliance.kind == "none":  # a soft surface gives way
        assert 10.0 * facts["max_abs_closure_error"] < CLOSURE_BOUND


def test_json_is_the_summary_and_nothing_else(command_line, tmp_path):
    """--json prints valid JSON with the promised keys, the same as summary.json, and nothing beside it."""
    outcome = command_line("wam_slide", "--time.duration", "0.6", "--no-figures", "--json", "--out", "r")
    summary = strict(outcome.out)
    assert outcome.err == ""
    assert set(summary) >= PROMISED
    assert summary == strict((tmp_path / "r" / "summary.json").read_text())
    assert summary["steps"] == 600
    assert set(summary["assumptions"]["contact_kept"]) >= {"held", "first_failed"}


def test_tables_are_printed(command_line):
    """Without --json the assumptions and the errors are printed, and where the files are."""
    outcome = command_line("wam_slide", "--time.duration", "0.6", "--no-figures", "--out", "here")
    assert outcome.status == 0
    for words in ("assumptions", "no singular pose", "closure error", "commanded 10 N", "600 steps", "here", "run.nc"):
        assert words in outcome.out


def test_results_go_beside_the_others_by_default(command_line, tmp_path, short):
    """Without --out the results go to out/SCENARIO in the current folder."""
    assert command_line("planar2_slide", *short).status == 0
    assert (tmp_path / "out" / "planar2_slide" / "run.nc").is_file()
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_figures_are_written(command_line, tmp_path):
    """A run draws Figs. 4-7, each as PNG and SVG, with something in them."""
    outcome = command_line("wam_slide", "--time.duration", "0.7", "--out", "r")
    assert outcome.status == 0, outcome.err
    names = ("fig4_tip_position", "fig5_contact_force", "fig6_closure_error", "fig7_closure_error_unstabilised")
    for name in names:
        png, svg = (tmp_path / "r" / f"{name}{suffix}" for suffix in (".png", ".svg"))
        assert png.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
        assert png.stat().st_size > 10_000
        assert svg.read_text(encoding="utf-8").count("<path") > 10
        assert name in outcome.out


@pytest.mark.parametrize(
    "words",
    [
        ("wam_slide", "--law.force", "15"),
        ("wam_slide", "--law.force=15"),
        ("wam_slide", "--law.force", "15.0"),
        ("--law.force", "15", "wam_slide"),
        ("--law.force=15", "wam_slide"),
        ("--json", "--law.force", "15", "wam_slide"),
    ],
    ids=" ".join,
)
def test_dotted_options_change_the_scenario(words, command_line, short, tmp_path):
    """--SECTION.KEY VALUE and --SECTION.KEY=VALUE change the scenario, before its name or after it."""
    outcome = command_line(*words, *short, "--out", "r")
    assert outcome.status == 0, outcome.err
    assert cl.load_run(tmp_path / "r" / "run.nc").contact_force == pytest.approx(np.full(11, 15.0))


def test_dotted_options_of_every_type(command_line, short, tmp_path):
    """Numbers below zero, lists, words with and without quotes, and true and false are read as in TOML."""
    outcome = command_line(
        "wam_slide", *short, "--out", "r",
        "--law.force", "-5", "--start.q", "[1.5, 1.0, -0.1, 2.0]", "--start.v=[-1e-3, 0, 0, 0]",
        "--time.integrator", "rk4", "--robot.tip", '"tip"', "--robot.drive_inertia", "false",
        "--reference.kind", "hold", "--law.kp=[1, 2, 3, 4]",
    )  # fmt: skip
    assert outcome.status == 0, outcome.err
    scenario = cl.load_run(tmp_path / "r" / "run.nc").scenario
    assert scenario.law.force == -5.0
    assert scenario.start.q == (1.5, 1.0, -0.1, 2.0)
    assert scenario.start.v == (-1e-3, 0.0, 0.0, 0.0)
    assert scenario.time.integrator == "rk4"
    assert scenario.robot.drive_inertia is False
    assert scenario.law.kp == (1.0, 2.0, 3.0, 4.0)


def test_help_says_what_there_is(command_line):
    """-h names the exit statuses and every option on one screen; --help SECTION the keys of a section."""
    for flag in ("-h", "--help"):
        outcome = command_line(flag)
        assert outcome.status == 0
        assert outcome.err == ""
        for words in ("exit status", "0 done", "2 the input", "3 the simulation", "--list", "--json", "--no-figures"):
            assert words in " ".join(outcome.out.split())
        assert len(outcome.out.splitlines()) <= 51
    for key in ("law.force", "time.step", "surface.normal", "stabiliser.time_constant"):
        assert f"--{key} (" in command_line("--help", key.partition(".")[0]).out


def test_without_a_scenario_the_user_is_told_to_name_one(command_line):
    """No argument at all is refused with names to try."""
    line = command_line().refusal()
    assert "--list" in line
    assert "wam_slide" in line


LAWS = """
import numpy as np

def soft(t, q, v, terms):
    return terms.bias - terms.jacobian.T @ np.array([0.0, 0.0, 7.0])

class Law:
    def __call__(self, t, q, v, terms):
        return terms.bias

held = Law()
number = 3

def short(t, q, v, terms):
    return [1.0]

def words(t, q, v, terms):
    return "much"

def breaks_down(t, q, v, terms):
    return terms.bias * (np.nan if t > 0.0045 else 1.0)
"""


@pytest.fixture
def laws(tmp_path):
    """Write a module of laws into the current folder and return its name."""
    (tmp_path / "laws_of_mine.py").write_text(LAWS)
    return "laws_of_mine"


def test_law_of_ones_own(laws, command_line, short, tmp_path):
    """--law MODULE:FUNCTION runs a function, or a callable object, from the current folder."""
    assert command_line("wam_slide", "--law", f"{laws}:soft", *short, "--out", "a").status == 0
    run = cl.load_run(tmp_path / "a" / "run.nc")
    assert run.contact_force == pytest.approx(np.full(11, 7.0))
    assert run.law == f"{laws}:soft"
    assert command_line("wam_slide", f"--law={laws}:held", *short, "--out", "b").status == 0
    assert cl.load_run(tmp_path / "b" / "run.nc").contact_force == pytest.approx(np.zeros(11), abs=1e-9)


def test_law_that_an_object_gives_can_be_repeated(laws, command_line, short, tmp_path):
    """The name of the law in the file is the one to give to --law, for a callable object, too."""
    command_line("wam_slide", f"--law={laws}:held", *short, "--out", "b")
    assert cl.load_run(tmp_path / "b" / "run.nc").law == f"{laws}:held"


@pytest.mark.parametrize(
    ("law", "words"),
    [
        ("nonsense", ["nonsense", "MODULE:FUNCTION"]),
        (":soft", ["MODULE:FUNCTION"]),
        ("laws_of_mine:", ["MODULE:FUNCTION"]),
        ("laws_of_mine:missing", ["'laws_of_mine'", "'missing'"]),
        ("laws_of_mine:number", ["'number'"]),
        ("no_such_module:soft", ["'no_such_module'"]),
        ("laws_of_mine.inner:soft", ["laws_of_mine.inner"]),
        (".relative:soft", [".relative"]),
        ("laws_of_mine:short", ["(1,)", "(4,)"]),
        ("laws_of_mine:words", ["the law returned"]),
    ],
)
def test_law_that_is_none_is_refused(law, words, laws, command_line, short):
    """A --law that cannot be used is refused with what it should look like, or what it lacks."""
    line = command_line("wam_slide", "--law", law, *short).refusal()
    assert all(word in line for word in words), line


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["wam_slid"], ["'wam_slid'", "did you mean 'wam_slide'"]),
        (["nowhere.toml"], ["nowhere.toml"]),
        (["nowhere.nc"], ["nowhere.nc"]),
        (["two\nlines.toml"], ["two", "No such file"]),
        (["two\nlines.nc"], ["two"]),
        (["wam_slide", "--robot.model", "two\nlines.urdf"], ["two"]),
        (["wam_slide", "two\nlines"], ["two"]),
        (["wam_slide", "--law", "two\nlines:law"], ["MODULE:FUNCTION"]),
        (["wam_slide", "--law.forse", "3"], ["law.forse", "law.force"]),
        (["wam_slide", "--law.force", "ten"], ["law.force", "'ten'", "number"]),
        (["wam_slide", "--law.force", "true"], ["law.force", "number"]),
        (["wam_slide", "--law.force", "nan"], ["law.force", "finite"]),
        (["wam_slide", "--law.force", "-inf"], ["law.force", "finite"]),
        (["wam_slide", "--law.force="], ["law.force", "number"]),
        (["wam_slide", "--law.force"], ["--law.force", "needs a value"]),
        (["wam_slide", "--law.force", "--no-figures"], ["--law.force", "needs a value"]),
        (["wam_slide", "--law.force", "--law.kp", "3"], ["--law.force", "needs a value"]),
        (["wam_slide", "--start.q", "[nan, 0, 0, 0]"], ["start.q", "0", "finite"]),
        (["wam_slide", "--start.q", "1,x,3,4"], ["start.q"]),
        (["wam_slide", "--surface.normal", "[0, 0"], ["surface.normal"]),
        (["wam_slide", "--stabiliser.kind", "[1]"], ["stabiliser.kind"]),
        (["wam_slide", "--law.force", "9" * 400], ["law.force"]),
        (["wam_slide", "--law.force", "9" * 5000], ["law.force"]),
        (["wam_slide", "--law.force", "[" * 5000], ["law.force"]),
        (["wam_slide", "--force", "3"], ["--force"]),
        (["wam_slide", "--figures"], ["--figures"]),
        (["wam_slide", "another"], ["another"]),
        (["wam_slide", "--out"], ["--out"]),
        (["wam_slide", "--law"], ["--law"]),
        (["wam_slide", "--time.step", "0.002"], ["time.step", "unstable"]),
        (["wam_slide", "--robot.model", "nowhere.urdf"], ["nowhere.urdf"]),
    ],
    ids=lambda x: " ".join(x)[:60] if x and "wam" in x[0] else None,
)
def test_mistake_is_one_line_and_status_2(arguments, words, command_line, tmp_path):
    """A mistake in the arguments ends with status 2, one line that names it, no traceback, and no results."""
    line = command_line(*arguments).refusal()
    assert all(word in line for word in words), line
    assert len(line) < 400
    assert list(tmp_path.rglob("run.nc")) == []


@pytest.mark.parametrize("out", ["file", "file/below", "nul\0byte"])
def test_output_that_cannot_be_written(out, command_line, tmp_path, short):
    """A file in the way of the output folder is found before the simulation, and named."""
    (tmp_path / "file").write_text("in the way")
    line = command_line("wam_slide", *short, "--out", out).refusal()
    assert "cannot be written" in line
    assert out.split("\0")[0] in line


@pytest.mark.parametrize("name", ["run.nc", "summary.json", "fig4_tip_position.svg"])
def test_folder_in_the_place_of_a_result(name, command_line, tmp_path, monkeypatch):
    """A folder where a result should go is named, and what is already written stays."""
    for place in (figures, figures.files):  # what is drawn is not looked at
        monkeypatch.setattr(place, "images_of", lambda draw, run, formats: {".svg": b"", ".png": b""})
    (tmp_path / "r" / name).mkdir(parents=True)
    line = command_line("wam_slide", "--time.duration", "0.01", "--json", "--out", "r").refusal()
    assert name.split(".")[0] in line
    assert "cannot be written" in line


PLANAR2 = path_of("planar2").read_text()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", ["bad.urdf"]),
        ("<robot name='x'><link", ["bad.urdf", "XML"]),
        ("<sdf/>", ["bad.urdf", "robot"]),
        ("<robot name='x'><link name='a'/></robot>", ["bad.urdf"]),
        (PLANAR2.replace('mass value="2.0"', 'mass value="-2.0"'), ["bad.urdf", "link2", "-2"]),
        (PLANAR2.replace('mass value="2.0"', 'mass value="nan"'), ["bad.urdf", "link2", "nan"]),
        (PLANAR2.replace('axis xyz="0 -1 0"', 'axis xyz="0 0 0"', 1), ["bad.urdf", "J1", "axis"]),
        (PLANAR2.replace('link="link1"', 'link="nowhere"', 1), ["bad.urdf", "nowhere"]),
    ],
    ids=["empty", "cut off", "another format", "no joint", "negative mass", "NaN mass", "no axis", "no link"],
)
def test_impossible_robot_is_refused(text, words, command_line, tmp_path, short):
    """A robot file that is malformed or cannot exist is refused with the file and the link or joint."""
    (tmp_path / "bad.urdf").write_text(text)
    line = command_line("planar2_slide", "--robot.model", "bad.urdf", *short).refusal()
    assert all(word in line for word in words), line


def test_singular_pose_ends_with_status_3_and_a_saved_run(command_line, tmp_path):
    """A straight arm pressing along its own line: status 3, one line with when and why, and the files are there."""
    outcome = command_line(
        "planar2_slide", "--start.q", "[0.0, 0.0]", "--surface.normal", "[1, 0, 0]", "--reference.kind", "hold",
        "--out", "r",
    )  # fmt: skip
    line = outcome.refusal(status=3)
    assert "t = 0 s" in line
    assert "singular" in line
    run = cl.load_run(tmp_path / "r" / "run.nc")
    assert len(run) == 0
    assert run.stopped in line
    summary = strict((tmp_path / "r" / "summary.json").read_text())
    assert set(summary) >= PROMISED
    assert summary["stopped"] == run.stopped


@pytest.mark.parametrize("figures", [pytest.param(True, marks=pytest.mark.slow), False])
def test_divergence_ends_with_status_3_and_the_partial_run(figures, command_line, tmp_path):
    """A law with negative damping: status 3, when and which joint, valid JSON, and every row until then, finite."""
    outcome = command_line(
        "wam_slide", "--law.kd", "-300", "--out", "r", "--json", *(() if figures else ("--no-figures",))
    )
    line = outcome.refusal(status=3)
    assert "diverges" in line
    run = cl.load_run(tmp_path / "r" / "run.nc")
    assert 500 < len(run) < 8001
    assert all(np.all(np.isfinite(column)) for column in run.columns.values())
    assert strict(outcome.out)["stopped"] == run.stopped
    assert ((tmp_path / "r" / "fig5_contact_force.png").is_file()) == figures


def test_law_that_breaks_down_ends_with_status_3(laws, command_line, tmp_path, short):
    """A law that returns NaN on the way: status 3, and what ran until then is saved."""
    line = command_line("wam_slide", "--law", f"{laws}:breaks_down", *short, "--out", "r").refusal(status=3)
    assert "t = 0.005 s" in line
    assert "not finite" in line
    assert len(cl.load_run(tmp_path / "r" / "run.nc")) == 5


def test_stopped_run_can_be_repeated(command_line, tmp_path):
    """The file of a run that stopped repeats the stop, to the bit."""
    command_line("wam_slide", "--law.kd", "-300", "--out", "r", "--json", "--no-figures")
    line = command_line("r/run.nc", "--out", "again", "--json", "--no-figures").refusal(status=3)
    first, second = (cl.load_run(tmp_path / folder / "run.nc") for folder in ("r", "again"))
    assert first.stopped == second.stopped
    assert first.stopped in line
    assert np.array_equal(first.contact_force, second.contact_force)


def test_scenario_file_by_its_path(command_line, tmp_path, short):
    """A .toml file runs from any folder by its path, and its results bear its stem."""
    file = tmp_path / "deep" / "mine.toml"
    file.parent.mkdir()
    file.write_text(cl.load_scenario("planar2_slide").to_toml().replace('name = "planar2_slide"', ""))
    assert command_line("deep/mine.toml", *short).status == 0
    assert cl.load_run(tmp_path / "out" / "mine" / "run.nc").scenario.name == "mine"


def test_python_m_and_the_console_script_are_this_command_line(tmp_path):
    """`python -m closedloop.run` exits with the status and writes the one line to standard error."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, "-m", "closedloop.run", "wam_slid"],
        cwd=tmp_path, env=environment, capture_output=True, text=True, check=False, timeout=60,
    )  # fmt: skip
    assert done.returncode == 2
    assert done.stdout == ""
    assert len(done.stderr.splitlines()) == 1
    project = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    assert 'closedloop = "closedloop.__main__:main"' in project
    assert callable(main)


def test_a_force_without_a_surface_is_said(command_line, tmp_path):
    """A file that leaves [surface] out presses on nothing: a warning, and a bad verdict of the control."""
    law = '[robot]\nmodel = "planar2"\n[law]\nkp = 100.0\nkd = 10.0\n[time]\nduration = 0.1\n'
    for name, more, err, status in (
        ("pressing", "force = 10\n", r"closedloop: warning: law\.force = 10: there is no \[surface\].*\n", 5),
        ("free", "", "", 0),
    ):
        (tmp_path / f"{name}.toml").write_text(law.replace("[time]", f"{more}[time]"))
        outcome = command_line(f"{name}.toml", "--strict", "--no-figures")
        assert re.fullmatch(err, outcome.err)
        assert outcome.status == status, outcome.out
        problems = strict((tmp_path / "out" / name / "summary.json").read_text())["control_verdict"]["problems"]
        assert [problem["name"] for problem in problems] == ["no_contact"] * bool(more)
