"""Hostile specifications and damaged tables, seeded: none ends in a traceback, a hang, a stray file or two lines."""

import importlib.util
import random
from pathlib import Path

import pytest
from budget import budget

SPEC = importlib.util.spec_from_file_location("fuzz_sweeps", Path(__file__).parents[2] / "fuzz" / "sweeps.py")
assert SPEC is not None
assert SPEC.loader is not None
fuzz = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(fuzz)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(budget(1, 4)))
def test_hostile_sweeps_and_tables_are_clean(seed):
    """Some tens of each, hundreds with the full budget; some sweeps are right, or nothing would have been tried."""
    assert fuzz.sweeps(budget(30, 150), seed) == []
    assert fuzz.plots(budget(20, 100), seed) == []
    assert fuzz.parts(budget(12, 60), seed) == []


def test_what_is_not_clean_is_found(monkeypatch):
    """A traceback, a second line or a stray file would be seen."""
    monkeypatch.setattr(fuzz, "main", lambda _: 1 / 0)
    assert all("ZeroDivisionError" in fault for fault in fuzz.sweeps(3, 0))
    monkeypatch.setattr(fuzz, "main", lambda _: 2)
    assert len(fuzz.sweeps(3, 0)) == 3

    def stray(arguments):
        Path(arguments[-1]).with_name("stray").write_text("left")
        return 0

    monkeypatch.setattr(fuzz, "main", stray)
    assert all("stray" in fault for fault in fuzz.sweeps(3, 0))
    rng = random.Random(0)
    assert len({fuzz.specification(rng) for _ in range(100)}) > 90
