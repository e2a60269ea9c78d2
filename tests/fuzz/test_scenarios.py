"""Scenarios with wrong and extreme values: a fixed budget of them, the same each time, of which none may be unclean."""

from collections import Counter

import pytest
from bounded import judged
from budget import budget
from judged import FAULTY, RAN, REFUSED, STOPPED, judge, of_json, of_line, same
from scenario_cases import Case, all_cases, legal_extremes, one_wrong_value, places, tables, wrong_values
from scenarios import FIRST
from shipped_cases import shipped_cases

from closedloop.scenario.load import scenario_of
from closedloop.scenario.messages import variants
from closedloop.scenario.scenario import Scenario

BUDGET = budget(12.0, 60.0)  # s of processor time


@pytest.mark.slow
def test_no_value_makes_anything_but_a_refusal_a_run_or_a_stop():
    """Of many hundreds of scenarios none ends in a traceback, a warning, a hang, or a number that is none."""
    counts, faulty = Counter(), []
    plain = all_cases(extremes=budget(0, 500), count=budget(500, None))
    shipped = [case for pair in zip(plain, shipped_cases(len(plain)), strict=True) for case in pair]
    cases = [*legal_extremes(8), *shipped]
    for case, outcome, words, _ in judged(cases, judge, FAULTY, FIRST, BUDGET):
        counts[outcome] += 1
        if outcome == FAULTY:
            faulty.append(f"{case.name[:200]}: {words}")
    assert not faulty, "\n".join(faulty)
    assert counts.total() > 500
    assert min(counts[REFUSED], counts[RAN], counts[STOPPED]) > 0


def test_every_kind_of_every_section_has_a_legal_scenario_to_start_from():
    """A key that must be given needs an example, or nothing of its kind would be tried."""
    for section in Scenario.model_fields:
        for kind in variants(section):
            for robot in ("wam4", "pointmass3", "planar2"):
                scenario_of(tables(robot, {section: kind}), "fuzz", {})


@pytest.mark.slow
def test_every_key_is_tried_and_there_are_many_cases():
    """The cases are as many as asked for, each its own, and the same for the same seed."""
    names = [case.name for case in one_wrong_value()]
    assert len(names) == len(set(names)) == len(places()) * len(list(wrong_values())) > 10_000
    pairs = [case.name for case in legal_extremes(2, seed=3)]
    assert pairs == [case.name for case in legal_extremes(2, seed=3)]
    assert pairs != [case.name for case in legal_extremes(2, seed=4)]


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
