"""Hundreds of damaged robot files: an error of ours in one line, or the robot that another reader sees."""

import os
import time
import warnings
from collections import Counter

import pytest
import robot_files
from budget import budget

import robot_models


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(budget(1, 2)))
def test_every_file_is_refused_in_one_line_or_is_the_robot_of_its_text(seed):
    """No traceback, no noise, no hang, no other robot; blanks and remarks change nothing; the count is what ran."""
    pytest.importorskip("mujoco")
    files = budget(48, 400)
    outcomes = robot_files.run(robot_files.generate(seed, files))
    wrong = [f"{outcome.kind}: {outcome.case.name}\n{outcome.text}" for outcome in outcomes if not outcome.clean]
    assert not wrong, "\n".join(wrong)
    count = Counter((outcome.case.suffix, outcome.kind) for outcome in outcomes)
    assert sum(count.values()) == files
    assert min(count[suffix, kind] for suffix in (".urdf", ".xml") for kind in ("refused", "loaded")) >= files // 8


def hanging(path):
    """Never come back."""
    time.sleep(1000)


def dying(path):
    """Take the process along."""
    os._exit(11)


def raising(path):
    """Fail as no user should see it."""
    raise IndexError("list index out of range")


def noisy(path):
    """Say something where nobody asked."""
    os.write(2, b"Error: could not parse inertial\n")
    return robot_models.load(path)


def warning(path):
    """Warn of an overflow."""
    warnings.warn("overflow encountered", RuntimeWarning, stacklevel=1)
    return robot_models.load(path)


def wordy(path):
    """Explain at length."""
    raise robot_models.ModelError("first line\nsecond line")


def forgetful(path):
    """Lose a link's mass, as urdfdom does."""
    text = path.read_text().replace('<mass value="2.5"/>', '<mass value="0.5"/>', 3)
    path.with_name("other.urdf").write_text(text)
    return robot_models.load(path.with_name("other.urdf"))


PLANTED = {
    "hang": hanging,
    "died": dying,
    "traceback": raising,
    "noise": noisy,
    "wordy": wordy,
    "differs": forgetful,
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", [*PLANTED, "warning"])
def test_what_is_not_clean_is_seen(kind):
    """Each kind of failure, planted in the loader, is found; and the next file gets a fresh process."""
    whole = robot_files.URDF.encode()
    cases = [robot_files.Case(name, ".urdf", whole, whole, same) for name, same in (("one", True), ("two", False))]
    reader = warning if kind == "warning" else PLANTED[kind]
    found = robot_files.run(cases, 1.0 if kind == "hang" else robot_files.PATIENCE, reader)
    assert [outcome.kind for outcome in found] == [{"warning": "traceback"}.get(kind, kind)] * 2
    assert not any(outcome.clean for outcome in found)


@pytest.mark.slow
def test_whole_files_are_clean():
    """Without a fault there is nothing to find."""
    wholes = [(".urdf", robot_files.URDF.encode()), (".xml", robot_files.MJCF.encode())]
    cases = [
        robot_files.Case(f"{suffix} {same}", suffix, data, data, same) for suffix, data in wholes for same in (1, 0)
    ]
    assert [outcome.kind for outcome in robot_files.run(cases)] == ["loaded"] * 4
