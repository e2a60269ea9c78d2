"""Run files damaged at random: refused in one line, or loaded as what they were."""

import importlib.util
import sys
from pathlib import Path

import pytest
from budget import budget

import closedloop as cl

_spec = importlib.util.spec_from_file_location("run_files", Path(__file__).with_name("run_files.py"))
run_files = importlib.util.module_from_spec(_spec)
sys.modules["run_files"] = run_files
_spec.loader.exec_module(run_files)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Return a run file."""
    run = cl.simulate(cl.load_scenario("planar2_slide", {"time.duration": 0.1}))
    return run.save(tmp_path_factory.mktemp("run") / "run.nc")


def test_the_generator_repeats_itself(whole):
    """The same seed damages a file in the same ways, and hardly any copy stays whole."""
    content = whole.read_bytes()
    one, two = (list(run_files.damaged_files(content, 40, 3)) for _ in range(2))
    assert [damaged.what for damaged in one] == [damaged.what for damaged in two]
    assert [d.content for d in one if "bytes" in d.what] == [d.content for d in two if "bytes" in d.what]
    assert sum(damaged.content != content for damaged in one) >= 38


def test_a_loader_that_is_fooled_is_found(whole, monkeypatch):
    """The negative control: a loader that takes every file for whole, or raises something else, is not clean."""
    for lie in ("print('other', flush=True)", "print('KeyError: 1', flush=True)", "break"):
        monkeypatch.setattr(run_files, "_LOADER", f"print('ready', flush=True)\nfor line in open(0):\n    {lie}\n")
        assert len(run_files.judge(whole, 5, 0)[1]) == 5


def test_damaged_files(whole):
    """Some damaged files, whichever way they are read."""
    counts, faults = run_files.judge(whole, 5, 1)
    assert faults == []
    assert sum(number for what, number in counts.items() if "refused" in what) > 2


@pytest.mark.slow
@pytest.mark.parametrize("kind", run_files.KINDS)
def test_many_damaged_files(kind, tmp_path):
    """More of them, of runs of every kind; hundreds with the full budget."""
    file = cl.simulate(cl.load_scenario(kind, run_files.KINDS[kind])).save(tmp_path / "run.nc")
    counts, faults = run_files.judge(file, budget(10, 200), 0)
    assert faults == []
    assert counts.total() == budget(10, 200)
