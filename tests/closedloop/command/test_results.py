"""The folder of results: what is replaced there, what is not, and that no result is lost or written through a link."""

import errno
import json
import os
import resource
import signal
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

import closedloop as cl
from closedloop.base.files import write_whole

SHORT = ("--time.duration", "0.02", "--no-figures", "--json", "--out", "r")
LAWS = """
import os, signal

def soft(t, q, v, terms):
    if t > 0.0155 and SIGNAL:
        os.kill(os.getpid(), SIGNAL)
    return terms.bias - 5.0 * terms.jacobian[2]

SIGNAL = 0

def interrupted(t, q, v, terms):
    if t > 0.0155:
        signal.raise_signal(signal.SIGINT)
    return soft(t, q, v, terms)

def terminated(t, q, v, terms):
    if t > 0.0155:
        signal.raise_signal(signal.SIGTERM)
    return soft(t, q, v, terms)

def interrupted_at_once(t, q, v, terms):
    signal.raise_signal(signal.SIGINT)

def fails(t, q, v, terms):
    if t > 0.0155:
        return [][3]
    return soft(t, q, v, terms)
"""


@pytest.fixture
def laws(tmp_path):
    """Write a module of laws, and return its name."""
    (tmp_path / "laws_of_results.py").write_text(LAWS)
    return "laws_of_results"


def contents(folder):
    """Return what is in a folder."""
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_the_same_question_may_be_asked_again(command_line):
    """The same command twice, and a repeat of a run file into its own folder, need no option."""
    assert command_line("planar2_slide", *SHORT).status == 0
    assert command_line("planar2_slide", *SHORT).status == 0
    assert command_line("r/run.nc", "--no-figures", "--json", "--out", "r").status == 0


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("--law.force", "12"), "law.force is 10.0 there and 12.0 here"),
        (("--time.duration", "0.03"), "time.duration is 0.02 there and 0.03 here"),
        (("--law", "laws_of_results:soft"), "the law differs"),
        (("--robot.drive_inertia", "false"), "robot"),
    ],
)
@pytest.mark.usefixtures("laws")
def test_results_of_another_question_stay(change, words, command_line, tmp_path):
    """A run of anything else is refused before it starts; with --overwrite it replaces them."""
    assert command_line("planar2_slide", *SHORT).status == 0
    before = contents(tmp_path / "r")
    line = command_line("planar2_slide", *SHORT, *change).refusal()
    assert words in line
    assert "--out" in line
    assert "--overwrite" in line
    assert contents(tmp_path / "r") == before
    assert command_line("planar2_slide", *SHORT, *change, "--overwrite").status == 0
    assert contents(tmp_path / "r")["run.nc"] != before["run.nc"]


@pytest.mark.slow
def test_nothing_of_a_replaced_run_stays_beside_the_new_one(command_line, tmp_path):
    """Figures of the run replaced go; a figure of somebody else's stays, whatever its name."""
    assert command_line("planar2_slide", *(word for word in SHORT if word != "--no-figures")).status == 0
    (tmp_path / "r" / "fig_mine.png").write_bytes(b"mine")
    (tmp_path / "r" / "notes.txt").write_bytes(b"mine")
    assert {"fig_tip_position.png", "fig_contact_force.svg"} <= set(contents(tmp_path / "r"))
    assert command_line("planar2_slide", *SHORT, "--law.force", "12", "--overwrite").status == 0
    assert set(contents(tmp_path / "r")) == {"fig_mine.png", "notes.txt", "run.nc", "summary.json"}


@pytest.mark.parametrize("law", [(), ("--law", "laws_of_results:interrupted_at_once")])
@pytest.mark.usefixtures("laws")
def test_a_run_that_gives_nothing_leaves_no_folder(law, command_line, tmp_path):
    """Refused, or interrupted before its first step: the folders made for it go, and those that were there stay."""
    (tmp_path / "mine").mkdir()
    wrong = () if law else ("--law.kp", "[1.0]")
    words = ("planar2_slide", *SHORT[:-1], "mine/new/r", *law, *wrong)
    assert command_line(*words).status == (130 if law else 2)
    assert list((tmp_path / "mine").iterdir()) == []
    assert command_line("planar2_slide", *SHORT[:-1], "mine/new/r").status == 0
    assert command_line(*words).status == 2
    assert set(contents(tmp_path / "mine" / "new" / "r")) == {"run.nc", "summary.json"}


def test_a_folder_in_which_nothing_can_be_written_is_not_left(monkeypatch, command_line, tmp_path):
    """There is room for a folder, and for no file in it."""

    def full(*_, **__):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Path, "touch", full)
    assert "No space left on device" in command_line("planar2_slide", *SHORT[:-1], "new/r").refusal()
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize("name", ["run.nc", "summary.json"])
def test_files_of_others_are_not_replaced(name, command_line, tmp_path):
    """A run.nc that is no run, or a summary.json of another program, is refused."""
    (tmp_path / "r").mkdir()
    (tmp_path / "r" / name).write_text('{"theirs": 1}')
    assert "--overwrite" in command_line("planar2_slide", *SHORT).refusal()
    assert contents(tmp_path / "r") == {name: b'{"theirs": 1}'}


def test_a_pipe_in_the_place_of_a_result_is_refused_at_once(command_line, tmp_path):
    """Nothing waits for somebody to write into it."""
    for name in ("run.nc", "summary.json"):
        (tmp_path / "r").mkdir(exist_ok=True)
        os.mkfifo(tmp_path / "r" / name)
        assert "there is a pipe of that name" in command_line("planar2_slide", *SHORT).refusal()
        (tmp_path / "r" / name).unlink()
        (tmp_path / "r" / name).symlink_to("/dev/null")
        assert "there is a link to a device of that name" in command_line("planar2_slide", *SHORT).refusal()
        (tmp_path / "r" / name).unlink()


def test_no_result_is_written_through_a_link(command_line, tmp_path, monkeypatch):
    """Where links stand in the places of results, what they point to stays as it was."""
    for name in ("tip_position", "contact_force", "closure_error", "force_control", "joints"):  # empty ones will do
        monkeypatch.setattr(f"closedloop.figures.files.{name}", lambda run: Figure())
    options = ("planar2_slide", *(word for word in SHORT if word != "--no-figures"))
    figures, files = ("fig_tip_position.png", "fig_contact_force.svg"), ("run.nc", "summary.json")
    (tmp_path / "r").mkdir()

    def link(name, content):
        (tmp_path / name).write_bytes(content)
        (tmp_path / "r" / name).unlink(missing_ok=True)
        (tmp_path / "r" / name).symlink_to(tmp_path / name)

    for name in figures:
        link(name, b"mine")
    assert command_line(*options).status == 0
    before = contents(tmp_path / "r")
    for name in files:
        link(name, before[name])
    assert command_line("planar2_slide", *SHORT).status == 0
    assert {(tmp_path / name).read_bytes() for name in figures} == {b"mine"}
    assert {name: (tmp_path / name).read_bytes() for name in files} == {name: before[name] for name in files}
    assert not any((tmp_path / "r" / name).is_symlink() for name in figures + files)


@pytest.mark.parametrize(
    ("law", "status", "word"), [("interrupted", 130, "interrupted"), ("terminated", 143, "terminated")]
)
def test_a_signal_ends_the_run_and_what_ran_is_saved(law, status, word, laws, command_line, tmp_path):
    """Ctrl-C: 130, SIGTERM: 143; one line with when and where; the files hold all rows until then."""
    line = command_line("planar2_slide", "--law", f"{laws}:{law}", *SHORT).refusal(status=status)
    assert f"stopped at t = 0.016 s: {word}; what ran is in r{os.sep}" in line
    run = cl.load_run(tmp_path / "r" / "run.nc")
    assert len(run) == 16
    assert run.stopped in line
    assert json.loads((tmp_path / "r" / "summary.json").read_text())["stopped"] == run.stopped
    assert sorted(contents(tmp_path / "r")) == ["run.nc", "summary.json"]
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL


def test_a_signal_before_the_first_row_leaves_nothing(laws, command_line, tmp_path):
    """There is nothing to be saved, and nothing is."""
    line = command_line("planar2_slide", "--law", f"{laws}:interrupted_at_once", *SHORT).refusal(status=130)
    assert "interrupted" in line
    assert not (tmp_path / "r").exists()


def test_an_interrupted_repeat_does_not_replace_the_whole_run(laws, command_line, tmp_path, monkeypatch):
    """Who asks for the same again and thinks better of it still has what he had."""
    options = ("planar2_slide", "--law", f"{laws}:soft", *SHORT)
    assert command_line(*options).status == 0
    before = contents(tmp_path / "r")
    import laws_of_results

    monkeypatch.setattr(laws_of_results, "SIGNAL", signal.SIGINT)
    assert "holds more of this run already" in command_line(*options).refusal(status=130)
    assert contents(tmp_path / "r") == before


def test_a_law_that_fails_is_named_and_what_ran_is_saved(laws, command_line, tmp_path):
    """Status 3, and in one line the law's file, line, exception and message."""
    line = command_line("planar2_slide", "--law", f"{laws}:fails", *SHORT).refusal(status=3)
    where = LAWS.splitlines().index("        return [][3]") + 1
    assert f"laws_of_results.py:{where}: IndexError: list index out of range" in line
    assert len(cl.load_run(tmp_path / "r" / "run.nc")) == 16


@pytest.mark.usefixtures("laws")
def test_a_repeat_with_an_edited_law_says_so(command_line, tmp_path):
    """The text of the law is not in the file, its digest is."""
    law = ("--law", "laws_of_results:soft")
    assert command_line("planar2_slide", *law, *SHORT).status == 0
    assert command_line("r/run.nc", *law, "--no-figures", "--json", "--out", "same").err == ""
    (tmp_path / "laws_of_results.py").write_text(LAWS.replace("5.0", "6.0"))
    again = command_line("r/run.nc", *law, "--no-figures", "--json", "--out", "again")
    assert again.status == 0
    assert again.err.splitlines() == [
        "closedloop: the text of laws_of_results:soft is not the one that r/run.nc was made with"
    ]
    assert "text of the law differs" in command_line("r/run.nc", *law, "--no-figures", "--out", "r").refusal()


@pytest.mark.parametrize("engine", ["pinocchio", "compiled"])
def test_a_repeat_takes_the_engine_of_the_run(engine, command_line, tmp_path):
    """The line that the documentation gives repeats a run to the bit, whichever engine made it; --engine overrides."""
    asked = ("wam_slide", "--time.duration", "0.05", "--no-figures", "--json")
    assert command_line(*asked, "--engine", engine, "--out", "first").status == 0
    assert command_line("first/run.nc", "--no-figures", "--json", "--out", "again").status == 0
    first, again = (cl.load_run(tmp_path / folder / "run.nc") for folder in ("first", "again"))
    assert again.engine == first.engine == engine
    assert np.array_equal(first.contact_force, again.contact_force)
    other = "compiled" if engine == "pinocchio" else "pinocchio"
    assert command_line("first/run.nc", "--engine", other, "--no-figures", "--json", "--out", "other").status == 0
    assert cl.load_run(tmp_path / "other" / "run.nc").engine == other


def test_what_a_killed_writer_left_is_removed_by_the_next_run(command_line, tmp_path):
    """The next run into the folder cleans up, and touches nothing else."""
    (tmp_path / "r").mkdir()

    def leave(file):
        os.link(next((tmp_path / "r").glob(".closedloop-*")), tmp_path / "left")
        names.append(next((tmp_path / "r").glob(".closedloop-*")).name)

    names = []
    write_whole(tmp_path / "r" / "x", leave)
    (tmp_path / "r" / "x").unlink()
    os.rename(tmp_path / "left", tmp_path / "r" / names[0])
    (tmp_path / "r" / ".closedloop-results").write_text("mine")
    assert command_line("planar2_slide", *SHORT).status == 0
    assert set(contents(tmp_path / "r")) == {"run.nc", "summary.json", ".closedloop-results"}


def sizes():
    """Yield the sizes that a file may have at most, every 50 kB up to where all fits."""
    return range(0, 800_000, 50_000)


@pytest.fixture
def limit():
    """Return a function that bounds the size of files of this process, bytes."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    yield lambda size: resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_a_full_disk_at_every_50_kb(command_line, tmp_path, limit):
    """Whatever fits: the older run stays or the new one is whole, one line says so, and no other file is there."""
    older = ("planar2_slide", *SHORT)
    assert command_line(*older).status == 0
    whole = len(contents(tmp_path / "r")["run.nc"])
    assert whole < max(sizes())
    ended = set()
    for size in sizes():
        limit(size)
        outcome = command_line(*older)
        limit(resource.RLIM_INFINITY)
        ended.add(outcome.status)
        if outcome.status != 0:
            assert "run.nc: cannot be written: File too large" in outcome.refusal()
        assert sorted(contents(tmp_path / "r")) == ["run.nc", "summary.json"]
        assert len(cl.load_run(tmp_path / "r" / "run.nc")) == 21
    assert ended == {0, 2}
