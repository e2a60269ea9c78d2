"""Scenarios with wrong and extreme values: a fixed budget of them, the same each time, of which none may be unclean."""

import random
from collections import Counter
from copy import deepcopy

import pytest
from bounded import judged
from budget import budget
from combinations import change, combinations
from judged import BAD, FAULTY, HELD, RAN, REFUSED, STOPPED, judge, judge_halved, of_json, of_line, same
from scenario_cases import Case, all_cases, legal_extremes, tables
from scenarios import FIRST
from shipped_cases import shipped_cases, shipped_tables

from closedloop.base.errors import ScenarioError
from closedloop.record.report import verdict
from closedloop.scenario.load import scenario_of, shipped_scenarios
from closedloop.scenario.messages import variants
from closedloop.scenario.scenario import Scenario

CASES = budget(120, 4000)


@pytest.mark.slow
def test_no_value_makes_anything_but_a_refusal_a_run_or_a_stop():
    """Of many hundreds of scenarios none ends in a traceback, a warning, a hang, or a number that is none."""
    counts, faulty = Counter(), []
    plain = all_cases(extremes=budget(0, 500), count=budget(110, None))
    shipped = [case for pair in zip(plain, shipped_cases(len(plain)), strict=True) for case in pair]
    # One that stops, whatever is drawn: its friction throws the joint about.
    stops = tables("wam4", {"joint_friction": "dahl"})
    stops["joint_friction"]["viscous"] = 2.0**31
    cases = [Case("a joint thrown about", stops, {}), *legal_extremes(8), *shipped][:CASES]
    for case, outcome, words, _ in judged(cases, judge, FAULTY, FIRST):
        counts[outcome] += 1
        if outcome == FAULTY:
            faulty.append(f"{case.name[:200]}: {words}")
    assert not faulty, "\n".join(faulty)
    assert counts.total() > 110
    assert min(counts[REFUSED], counts[RAN], counts[STOPPED]) > 0


def test_every_kind_of_every_section_has_a_legal_scenario_to_start_from():
    """A key that must be given needs an example, or nothing of its kind would be tried."""
    for section in Scenario.model_fields:
        for kind in variants(section):
            for robot in ("wam4", "pointmass3", "planar2"):
                scenario_of(tables(robot, {section: kind}), "fuzz", {})


@pytest.mark.slow
def test_combinations_are_of_values_that_are_valid_alone_and_the_same_for_the_same_seed():
    """Each change by itself makes a scenario that is read; another seed draws others, and a duration is kept."""
    drawn = list(combinations(60, seed=3))
    assert [case.content for case in drawn] == [case.content for case in combinations(60, seed=3)]
    assert [case.content for case in drawn] != [case.content for case in combinations(60, seed=4)]
    assert all(0.03 < case.content["time"]["duration"] < 0.41 for case in combinations(20, 3, 0.2))
    draw, read, refused = random.Random(5), 0, []
    for _ in range(400):
        name, seed = draw.choice(shipped_scenarios()), draw.random()
        alone, again = deepcopy(shipped_tables(name)), deepcopy(shipped_tables(name))
        said = change(random.Random(seed), alone)
        assert said == change(random.Random(seed), again)
        assert alone == again
        if not said:
            continue
        try:
            scenario_of(alone, "fuzz", {})
        except ScenarioError as error:
            refused.append((said, str(error)))
        else:
            read += 1
    assert all(said.partition(".")[0] in line for said, line in refused)  # by what was changed, not by what it is of
    assert read > 200


@pytest.mark.slow
def test_a_difference_beyond_the_bound_is_seen(monkeypatch):
    """What is judged at half the step holds for a slide, and is not good with a bound near zero."""
    case = Case("slide", tables("planar2", {"law": "paper"}) | {"time": {"duration": 0.05, "step": 0.001}}, {})
    assert judge_halved(case)[0] == HELD
    monkeypatch.setattr(verdict, "STEP_SHARE", 1e-12)
    assert judge_halved(case) == (BAD, "step")


def _fault(kind):
    """Judge nothing: be what a case must not be."""
    if kind == "hang":
        while True:
            pass
    if kind == "end":
        raise SystemExit(3)
    return FAULTY if kind == "faulty" else RAN, kind


@pytest.mark.slow
def test_a_hang_and_an_end_are_seen_and_the_rest_goes_on():
    """Negative control: a case that never ends or ends its process is faulty, those after are judged."""
    cases = ["good", "hang", "end", "good", "faulty"]
    outcomes = [outcome for _, outcome, _, _ in judged(cases, _fault, FAULTY, most=1.0)]
    assert outcomes == [RAN, FAULTY, FAULTY, RAN, FAULTY]


def test_what_is_not_clean_is_seen():
    """Negative controls of what is looked at: two lines, escapes, NaN, and a value that is not the one asked for."""
    assert of_line("two\nlines")
    assert of_line("\x1b[31m")
    assert of_line("x" * 10_000)
    assert not of_line("closedloop: one line")
    assert of_json('{"a": NaN}')
    assert of_json('{"a": -Infinity}')
    assert not of_json('{"a": null}')
    assert same([1, 2.0], (1.0, 2.0))
    assert not same([1, 2.0], (1.0, 2.5))
    assert not same(True, 1.0)
    assert not same("1.0", 1.0)
    assert not same({"kind": "none"}, {"kind": "line"})
    outcome, words = judge(Case("asked for another", tables("planar2", {"law": "paper"}), {"law.force": 11.0}))
    assert outcome == FAULTY
    assert words == "law.force = '11.0' was asked for, and is '10.0'"
