"""The command `closedloop analyse`."""

import json
from collections import namedtuple

import numpy as np
import pytest
from linear_loops import DAMPING, MASS, STIFFNESS, mass_on_a_spring
from matplotlib.figure import Figure

import closedloop as cl
from closedloop.__main__ import main
from closedloop.studies.analysis.page import bode, nyquist, page_of, poles, sensitivity, stability_map
from closedloop.studies.analysis.stability import FIRST_LOOKS, Range, Stability

GAIN = ("--law.force_integral", "20", "--at", "1")


Outcome = namedtuple("Outcome", "status out err")


@pytest.fixture
def command_line(capsys, monkeypatch, tmp_path):
    """Return a function that runs `closedloop` here, in an empty folder."""
    monkeypatch.chdir(tmp_path)

    def call(*words):
        capsys.readouterr()
        status = main(list(map(str, words)))
        said = capsys.readouterr()
        err = "".join(line for line in said.err.splitlines(True) if not line.startswith("compiling the step"))
        return Outcome(status, said.out, err)

    return call


def test_first_line_is_a_sentence(command_line):
    """Then a table, whose poles are said to belong to parts."""
    said = command_line("analyse", "wam_slide", "--at", "3")
    assert said.status == 0
    first = said.out.splitlines()[0]
    assert first == "stable; the law reads no force; at torque[J3] 14.9 dB and 78° from instability"
    assert "nothing is fed back" in said.out
    table = [line for line in said.out.splitlines() if line.startswith(("cut at", "torque["))]
    assert len({len(line) for line in table}) == 1
    assert "arm 100 %" in said.out


def test_json_and_a_key(command_line, tmp_path):
    """The limit in a range, with whole runs beside it, as JSON."""
    path = tmp_path / "spring.toml"
    scenario = mass_on_a_spring(time__integrator="semi_implicit_euler", time__duration=2.0)
    path.write_text(scenario.to_toml(), encoding="utf-8")
    said = command_line("analyse", path, "--at", "0.1", "--json", "--vary", "law.force_integral=5:80")
    assert said.status == 0
    page = json.loads(said.out)
    (limit,) = page["limits"]["law.force_integral"]
    assert limit["value"] == pytest.approx(DAMPING * STIFFNESS / (MASS * STIFFNESS - DAMPING**2), rel=0.05)
    assert limit["unstable"] == "above"
    assert [trial["seen"] > 0.0 for trial in page["trials"]] == [False, True]


def test_figures_are_drawn_on_axes_of_the_users_own():
    """Each on its panels, of a figure of one's own; a map, too."""
    study = Stability(mass_on_a_spring(time__integrator="semi_implicit_euler", time__duration=2.0), at=0.1)
    page = page_of(study, limits=False)
    for draw, count in ((bode, 2), (nyquist, 1), (poles, 2), (sensitivity, 1)):
        own = Figure()
        axes = own.subplots(1, count, squeeze=False)[0]
        assert draw(page, ax=list(axes)) is own
        assert all(each.lines for each in axes)
    own = Figure()
    assert stability_map([], *[Range("law.force", 1.0, 5.0, False)] * 2, (2.0, 2.0), [], ax=own.subplots()) is own


def test_the_axes_of_a_map_have_units():
    """A key whose kinds have different units has that of the scenario's kind, and none without a scenario."""
    along, over = Range("compliance.stiffness", 1e3, 1e6, True), Range("law.force_integral", 0.0, 80.0)
    axes = stability_map([], over, along, (1e4, 5.0), []).axes[0]
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("compliance.stiffness", "law.force_integral [1/s]")
    axes = stability_map([], over, along, (1e4, 5.0), [], cl.load_scenario("soft_table")).axes[0]
    assert axes.get_xlabel() == "compliance.stiffness [N/m]"


def test_a_map_without_a_limit_says_so_and_ends_early(monkeypatch):
    """It has no curve and no legend of a boundary, and takes no look at most of its values."""
    study, looked = Stability(cl.load_scenario("wam_slide")), []
    monkeypatch.setattr(study, "growth", lambda values: looked.append(values["law.kd"]) or -1.0)
    along, over = Range("law.kd", 1.0, 30.0), Range("law.kp", 10.0, 200.0)
    assert study.boundary(over, along, points=60) == []
    assert len(set(looked)) == FIRST_LOOKS
    axes = stability_map([], over, along, None, [], study.scenario).axes[0]
    assert (axes.get_legend(), axes.get_title(loc="left") or axes.get_title()) == (
        None, "The force loop has no limit in this map",
    )  # fmt: skip


def test_bode_marks_the_turn_and_names_its_lines():
    """−180° is drawn, and each line is named: where the gain and the phase margin are, with their sizes."""
    page = page_of(Stability(cl.load_scenario("soft_table", {"law.force_integral": 20.0})), limits=False)
    upper, lower = bode(page).axes
    margins = page.weakest
    (turn,) = [line for line in lower.lines if line.get_label() == "−180°"]
    assert set(turn.get_ydata()) == {-180.0}
    curve = next(line for line in lower.lines if len(line.get_xdata()) > 2)
    at_turn = np.interp(margins.gain_at, curve.get_xdata(), curve.get_ydata())
    assert at_turn == pytest.approx(-180.0, abs=1.0)  # the gain margin is there
    named = [text.get_text() for axes in (upper, lower) for text in axes.get_legend().get_texts()]
    assert any(name.startswith(f"gain margin {margins.decibels:.3g} dB at {margins.gain_at:.3g} Hz") for name in named)
    assert "|L| = 1" in named


def test_figures_and_a_map(command_line, tmp_path, monkeypatch):
    """With --out the numbers and the figures are written, with two keys a map among them."""
    drawn = []
    for module in ("closedloop.studies.analysis.page", "closedloop.figures.files"):
        monkeypatch.setattr(
            f"{module}.write_figure", lambda figure, path, formats: drawn.append((path.name, figure)) or path
        )
    said = command_line(
        "analyse", "soft_table", *GAIN, "--out", tmp_path / "out", "--no-runs",
        "--vary", "compliance.stiffness=log:1e4:4e4:3", "--vary", "law.force_integral=log:100:4000",
    )  # fmt: skip
    assert said.status == 0
    names = [name for name, _ in drawn]
    assert names == [f"analysis_{name}" for name in ("bode", "nyquist", "poles", "sensitivity", "map")]
    page = json.loads((tmp_path / "out" / "analysis.json").read_text(encoding="utf-8"))
    assert [point["compliance.stiffness"] for point in page["boundary"]] == pytest.approx([1e4, 2e4, 4e4])
    (line,) = [line for line in drawn[-1][1].axes[0].lines if line.get_label() == "boundary"]
    assert list(line.get_ydata()) == [point["value"] for point in page["boundary"]]


@pytest.mark.parametrize(
    ("words", "why", "status"),
    [
        (("--vary", "law.force_integral=1,2"), "--vary law.force_integral=1,2: must be a range of real numbers", 2),
        (("--vary", "law.kind=a:b"), "--vary law.kind=a:b: ", 2),
        (("--vary", "x=1:2"), "--vary x=1:2: must be KEY=VALUES with a key such as law.force", 2),
        (("--vary", "law.nothing=1:2"), "law.nothing", 2),
        (("--at", "99"), "command line: --at = 99 s: must be within the run, 0 to time.duration = ", 2),
        (("--at", "-3"), "command line: --at = -3 s: must be within the run", 2),
        (("--vary", "law.force=1:2") * 3, "--vary: at most two keys", 2),
    ],
)
def test_refusals(command_line, words, why, status):
    """Each is one line."""
    said = command_line("analyse", "soft_table", *words)
    assert said.status == status
    assert why in said.err
    assert len(said.err.splitlines()) == 1


def test_in_flight_is_no_fault_of_the_input(command_line):
    """The exit status is that of a run that could not go on."""
    said = command_line("analyse", "wam_touchdown", "--at", "0.01")
    assert said.status == 3
    assert "the tip is in flight" in said.err
