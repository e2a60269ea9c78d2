"""The harness itself: what it reports, that it cannot pass by silence, and that it sees every planted fault."""

import json
import math
from types import MappingProxyType

import numpy as np
import pytest

import robot_models
import validation
from validation.comparison import compare
from validation.engines import ENGINES, Engine, Missing, available
from validation.engines.hand_written import HandWritten
from validation.engines.interface import METHODS
from validation.engines.loop import ClosedLoop
from validation.plant import FAULTS, TURNING_FAULTS, Fault, plant_all
from validation.report import Report
from validation.run import main
from validation.states import QUANTITIES, draw_state
from validation.suite import check_identities, compare_random_trees, faults_section, load_robot


@pytest.fixture(scope="module")
def pair():
    """Return the oracle and our own loop on the WAM."""
    model = robot_models.load("wam4")
    return [HandWritten(model, "tip"), ClosedLoop(model, "tip")]


@pytest.fixture(scope="module")
def report():
    """Return a small cross-check of planar2."""
    return validation.crosscheck("planar2", states=20, seed=3)


def test_crosscheck_compares_everything_and_agrees(report):
    """Every quantity of our loop is compared with the oracle at every state, and agrees."""
    cells = {(c.quantity): c for c in report.comparisons[0].cells if c.engine == "closedloop"}
    assert set(cells) == set(QUANTITIES)
    assert all(c.status == "agrees" and c.states == 20 and c.margin <= 1.0 for c in cells.values())
    assert report.passed


def test_every_known_engine_has_its_line(report):
    """Each engine of the registry stands in the report for every quantity, with a value or a reason."""
    for engine in ENGINES:
        cells = [c for comparison in report.comparisons for c in comparison.cells if c.engine == engine.name]
        judges = any(comparison.reference == engine.name for comparison in report.comparisons)
        assert judges or {c.quantity for c in cells} == set(QUANTITIES), engine.name
        assert all(c.status == "agrees" or c.reason for c in cells)


def test_report_in_every_form(report):
    """JSON reads back, Markdown and HTML have every engine and the command that reproduces the worst case."""
    data = json.loads(report.to_json())
    assert data["passed"] is True
    assert {c["engine"] for c in data["comparisons"][0]["cells"]} >= {"closedloop", "pinocchio"}
    for text in (report.to_markdown(), report.to_html()):
        assert all(word in text for word in ("closedloop", "pinocchio", "--state", "planar2"))
    assert report.to_html().count("<table>") == report.to_html().count("</table>") >= 1


def test_worst_state_is_reproduced(report):
    """The worst case of the report, looked at alone, gives the same error."""
    worst = report.worst
    again = compare(robot_models.load("planar2"), states=[worst.state], seed=3, judge=_judge_of(report, worst))
    (cell,) = [c for c in again.cells if (c.engine, c.quantity) == (worst.engine, worst.quantity)]
    assert cell.absolute == worst.absolute


def _judge_of(report, cell):
    return next(c.reference for c in report.comparisons if cell in c.cells)


def test_states_do_not_depend_on_how_many_are_drawn(pair):
    """State k of a seed is the same alone and among others; another seed gives another."""
    model = robot_models.load("wam4")
    first = [draw_state(model, pair[0], 5, k) for k in range(6)]
    assert np.array_equal(first[4].q, draw_state(model, pair[0], 5, 4).q)
    assert not np.array_equal(first[4].q, draw_state(model, pair[0], 6, 4).q)
    assert [s.singular for s in first] == [False] * 4 + [True, False]
    for s in first:
        assert np.all((model.position_lower <= s.q) & (s.q <= model.position_upper))
        assert np.linalg.norm(s.normal) == pytest.approx(1.0)


def _engine(name, **methods):
    """Return an engine class that is our loop but for some methods."""
    return type(name, (ClosedLoop,), {"name": name.lower(), **methods})


@pytest.mark.parametrize(
    "wrong",
    [
        lambda self, q, v: np.full(3, np.nan),
        lambda self, q, v: np.zeros(2),
        lambda self, q, v: np.array([0.0, 0.0, np.inf]),
    ],
    ids=["nan", "shape", "inf"],
)
def test_what_is_no_number_does_not_pass(wrong):
    """NaN, infinity and an answer of another shape are infinitely wrong, in that quantity alone."""
    model = robot_models.load("wam4")
    liar = _engine("Liar", drift=wrong)(model, "tip")
    found = compare(model, "tip", states=3, built=[HandWritten(model, "tip"), liar])
    bad = {c.quantity for c in found.cells if c.status == "disagrees"}
    assert "drift" in bad
    assert not found.passed
    assert math.isinf(found.worst.margin)
    assert json.loads(Report([found]).to_json())["comparisons"][0]["cells"][5]["margin"] is None


def test_missing_engine_never_passes(pair):
    """An engine that is not installed has a line with the command that installs it, and counts as nothing."""
    model = robot_models.load("wam4")
    found = compare(model, "tip", states=2, built=[pair[0], Missing("absent", "pip install absent")])
    assert {c.status for c in found.cells} == {"not installed"}
    assert {c.reason for c in found.cells} == {"pip install absent"}
    assert not found.passed  # nothing was compared
    assert not Report([found]).passed
    assert not Report().passed


def test_quantity_that_is_not_covered_is_named(pair):
    """What an engine does not compute is a cell with its reason."""
    kind = type(
        "Partial",
        (ClosedLoop,),
        {"name": "partial", "covers": frozenset(METHODS) - {"drift"}, "cannot": MappingProxyType({"drift": "no idea"})},
    )
    model = robot_models.load("wam4")
    found = compare(model, "tip", states=2, built=[pair[0], kind(model, "tip")])
    (cell,) = [c for c in found.cells if c.quantity == "drift"]
    assert (cell.status, cell.reason) == ("not covered", "no idea")
    assert found.passed
    assert "no idea" in Report([found]).to_markdown()


@pytest.mark.parametrize("states", [1, pytest.param(6, marks=pytest.mark.slow)])
@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_every_fault_is_caught_in_every_engine(fault, states):
    """Each planted fault goes far out of tolerance, whichever engine carries it, in a single random state already."""
    turning = fault in TURNING_FAULTS
    catches = plant_all(load_robot("free bodies") if turning else "wam4", states=states, faults=[fault])
    others = {"closedloop", "pinocchio" if turning else "oracle"}
    assert {c.engine for c in catches} >= {"compiled"} | (set() if fault.tree else others)
    for c in catches:
        assert c.caught, c
        assert c.margin > 1e3, c  # the least of them, a part in a million, is a million roundings


def test_a_fault_that_changes_nothing_is_unseen():
    """The negative control of the negative controls: a fault that is none is reported as unseen, and fails."""
    catches = plant_all("wam4", states=2, faults=[Fault("none at all", robot=lambda model: model)])
    assert catches
    assert not any(c.caught for c in catches)
    section = faults_section("wam4", catches)
    assert not Report(sections=[section]).passed
    assert "UNSEEN" in section.checks[0].note


def test_planting_leaves_the_engine_as_it_was(pair):
    """After a fault was planted in a method, the engine computes as before."""
    from validation.plant import planted

    engine = pair[1]
    before, kind = engine.drift(np.ones(4), np.ones(4)), type(engine)
    fault = next(f for f in FAULTS if f.name.startswith("J̇"))
    with planted(engine, fault, pair[0].oracle) as touched:
        assert touched
        assert not np.any(engine.drift(np.ones(4), np.ones(4)))
    assert type(engine) is kind
    assert np.array_equal(engine.drift(np.ones(4), np.ones(4)), before)


def test_random_trees_name_the_tree_that_was_worst():
    """The table over random trees keeps which tree gave a value, and the name finds it again."""
    found = compare_random_trees(2, 2)
    assert found.passed
    worst = found.worst
    assert worst.robot.startswith("random:")
    assert load_robot(worst.robot).name == worst.robot.replace("random:", "random")
    assert f"--robot {worst.robot}" in Report([found]).reproduce()
    assert all(c.states == 4 for c in found.cells if c.engine == "closedloop")


def test_identities_hold_and_name_what_is_left_out():
    """All identities hold for the oracle; those our terms have no methods for are lines without a verdict."""
    section = check_identities(2, 1)
    verdicts = {(c.of, c.name): c.passed for c in section.checks}
    assert all(passed is not False for passed in verdicts.values())
    assert all(passed for (of, _), passed in verdicts.items() if of == "oracle")
    assert verdicts["closedloop", "gravity is gradient"] is None


def test_near_singular_states_are_hard_and_still_agree(pair):
    """States looked for near singular poses magnify rounding much more than others, and stay within their bound."""
    from validation.engines.interface import amplification

    model, oracle = robot_models.load("wam4"), pair[0]
    grown = {False: [], True: []}
    for k in range(60):
        s = draw_state(model, oracle, 0, k)
        J = oracle.jacobian(s.q)
        grown[s.singular].append(amplification(oracle.mass_matrix(s.q), J, s.normal @ J))
    assert np.median(grown[True]) > 3 * np.median(grown[False])


def test_command_line_passes_and_writes(tmp_path, capsys):
    """A good robot exits with 0 and writes what was asked for."""
    files = {kind: tmp_path / f"report.{kind}" for kind in ("json", "html", "markdown")}
    words = [word for kind, path in files.items() for word in (f"--{kind}", str(path))]
    assert main(["--robot", "planar2", "--states", "5", *words]) == 0
    out = capsys.readouterr().out
    assert "0 out of tolerance" in out
    assert "the worst case again: python -m validation.run --robot planar2" in out
    assert json.loads(files["json"].read_text())["passed"] is True
    assert "<html" in files["html"].read_text()
    assert files["markdown"].read_text().startswith("# Cross-check: passed")


def test_command_line_judges_a_users_engine(tmp_path, capsys, monkeypatch):
    """--engine brings in an engine from the user's folder; a wrong one fails the command."""
    (tmp_path / "mine.py").write_text(
        "from validation.engines.loop import ClosedLoop\n"
        "class Mine(ClosedLoop):\n    name = 'mine'\n"
        "class Wrong(ClosedLoop):\n    name = 'wrong'\n"
        "    def mass_matrix(self, q):\n        return 1.001 * super().mass_matrix(q)\n"
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    assert main(["--robot", "planar2", "--states", "3", "--engine", "mine:Mine"]) == 0
    assert "mine" in capsys.readouterr().out
    assert main(["--robot", "planar2", "--states", "3", "--engine", "mine:Wrong"]) == 1


def test_command_line_takes_a_users_robot(tmp_path, capsys):
    """A URDF of the user's own is judged like any robot; --state looks at one state."""
    file = tmp_path / "mine.urdf"
    file.write_text(robot_models.load("planar2").text)
    assert main(["--robot", str(file), "--tip", "tip", "--states", "3"]) == 0
    assert main(["--robot", str(file), "--tip", "tip", "--state", "2"]) == 0
    assert "1 states" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["--robot", "wamm"], "wam4"),
        (["--robot", "random:x"], "random:7"),
        (["--robot", "wam4", "--tip", "toe"], "'tip'"),
        (["--robot", "wam4", "--states", "0"], "at least 1"),
        (["--seed", "-1"], "zero or more"),
        (["--state", "3"], "--robot"),
        (["--engine", "nothing:Here", "--robot", "wam4"], "there is no module 'nothing'"),
        (["--engine", "nothing", "--robot", "wam4"], "MODULE:CLASS"),
        (["--engine", "json:JSONDecoder", "--robot", "wam4"], "MODULE:CLASS"),
        (["--json", "no/such/folder/x.json"], "cannot be written"),
        (["--nonsense"], "--help"),
        (["--states", "many"], "--states"),
    ],
)
def test_bad_input_is_one_line_and_status_2(words, expected, capsys):
    """A mistake on the command line is answered by one line that says what would be right."""
    assert main(words) == 2
    captured = capsys.readouterr()
    lines = captured.err.splitlines()
    assert len(lines) == 1, captured.err
    assert expected in lines[0]


def test_engines_are_installed_here_or_said_to_be_missing():
    """Each engine of the registry is built, missing with its command, or refused with its reason."""
    found = available(robot_models.load("wam4"), "tip")
    assert len(found) == len(ENGINES)
    assert all(isinstance(engine, Engine) or str(engine) for engine in found)
