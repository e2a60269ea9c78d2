"""Compiling in a process of its own: detached, one at a time, and gone with its lock whatever happens to it."""

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

import closedloop as cl
from closedloop.control.reference.inverse_kinematics import walk
from closedloop.jit import background, cache_folder
from closedloop.jit.cache_folder import MARKER
from closedloop.loop.events.transitions import collide
from closedloop.loop.step.contacts import contacts_in_step
from closedloop.mechanics.loops.reactions import rows_along
from closedloop.simulation.engines.lanes import run_in_lanes
from closedloop.simulation.engines.loops import proceed_at

ROOT = Path(cl.__file__).parent.parent
# In place of the compiler: say who it is, and stay until it is told to go.
SLEEPER = """
import time
open(os.path.join({folder!r}, "who-" + "-".join(sys.argv[3:])), "w").write(
    f"{{os.getpid()}} {{os.getsid(0)}} {{os.getppid()}} {{os.nice(0)}} {{os.getcwd()}}")
while not os.path.exists(os.path.join({folder!r}, "go")):
    time.sleep(0.01)
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Return a folder in which a process sleeps in place of the compiler; nothing is compiled and all is allowed."""
    mine = tmp_path / "closedloop-0123456789abcdef"
    notes = tmp_path / "notes"
    notes.mkdir()
    for module in (background, cache_folder):
        monkeypatch.setattr(module, "cache_folder", lambda: mine)
    monkeypatch.setattr(background, "_PROGRAM", background._DETACHED + SLEEPER.format(folder=str(notes)))
    monkeypatch.setattr(background, "_asked", [])
    monkeypatch.setattr(background, "_said", set())
    monkeypatch.setattr(background, "_waited_for", set())
    monkeypatch.setattr(background, "needs_compiling", lambda function: True)
    monkeypatch.delenv(background.VARIABLE)
    yield notes
    (notes / "go").touch()
    assert not background.wait_until_done(patience=10.0)


def who(folder, *names):
    """Return process, session, parent, niceness and folder of the process that compiles these, once it has begun."""
    file, until = folder / f"who-{'-'.join(names)}", time.monotonic() + 30.0
    while not (file.exists() and file.read_text()):
        assert time.monotonic() < until
        time.sleep(0.01)
    return file.read_text().split()


def test_a_process_in_the_background(folder, caplog):
    """Of low priority, in a session of its own, in no folder of the user's, and no child that must be waited for."""
    with caplog.at_level("INFO", "closedloop.compiling"):
        background.start([proceed_at, collide])
    process, session, parent, nice, where = who(folder, "proceed_at", "collide")
    assert int(session) != os.getsid(0)
    assert int(parent) != os.getpid() != int(process)
    assert int(nice) == min(19, os.nice(0) + background.NICE)
    assert where == os.sep
    (line,) = caplog.messages
    assert line.startswith("compiling the step in the background, once for this installation")


def test_one_at_a_time(folder, monkeypatch, caplog):
    """While one is at work another is not begun, and that is said; nor is one begun twice for the same."""
    background.start([proceed_at])
    first = who(folder, "proceed_at")[0]
    background.start([proceed_at])
    monkeypatch.setattr(background, "_said", set())
    with caplog.at_level("INFO", "closedloop.compiling"):
        background.start([collide])  # which is short: not worth a word
        background.start([run_in_lanes])
        background.start([walk])  # another like it is not said again
    what = "the step of eight runs at a time"
    assert caplog.messages == [f"compiling {what} in another process; this run is interpreted meanwhile"]
    assert [file.name for file in folder.iterdir()] == ["who-proceed_at"]
    os.kill(int(first), signal.SIGKILL)
    assert not background.wait_until_done(patience=10.0)
    background.start([collide])
    assert who(folder, "collide")[0] != first


def test_how_long_it_still_takes(folder, monkeypatch):
    """What comes before it and itself, in the order of the process; less what that has had of a core."""
    clock = SimulatedClock()
    monkeypatch.setattr(background, "clock", clock)
    background.start([contacts_in_step, proceed_at, collide, rows_along])
    contacts, step, brief = (background.seconds_of([each]) for each in (contacts_in_step, proceed_at, collide))
    assert background.seconds_left([contacts_in_step, proceed_at]) == contacts + step
    assert background.seconds_left([collide]) == contacts + step + brief
    clock.sleep(5.0)
    assert background.seconds_left([contacts_in_step]) == pytest.approx(contacts - 5.0 * background.OF_A_CORE)
    clock.sleep(100.0)
    assert background.seconds_left([contacts_in_step]) == 0.0
    assert background.seconds_left([run_in_lanes]) == background.seconds_of([run_in_lanes])  # nobody is at it


def test_who_needs_what_comes_last_compiles_it(folder, monkeypatch, caplog):
    """The inverse kinematics of a path, which is wanted now and behind the step in the background."""
    background.start([proceed_at, walk])
    who(folder, "proceed_at", "walk")
    with caplog.at_level("INFO", "closedloop.compiling"):
        background.make_ready(walk)
    assert caplog.messages[-1].startswith("compiling the inverse kinematics of a path (once for this installation")


def test_who_needs_it_waits(folder, monkeypatch, caplog):
    """For the process that is at it, until what is needed is there, and no longer."""
    background.start([proceed_at])
    who(folder, "proceed_at")
    missing = iter([True] * 4)
    monkeypatch.setattr(background, "needs_compiling", lambda function: next(missing, False))
    with caplog.at_level("INFO", "closedloop.compiling"):
        background.make_ready(proceed_at)
    assert caplog.messages == ["compiling the step: waiting for the process that does it in the background ..."]
    assert next(missing, None) is None


class SimulatedClock:
    """A clock that goes on only while somebody sleeps."""

    def __init__(self):
        self.now = time.monotonic()

    def monotonic(self):
        """Return the time, s."""
        return self.now

    def sleep(self, seconds):
        """Let time pass."""
        self.now += seconds


def test_nobody_waits_much_longer_than_compiling_takes(folder, monkeypatch):
    """A process may be stopped, or get no processor: all who wait for it give up in time, and for good."""
    background.start([proceed_at, run_in_lanes])
    who(folder, "proceed_at", "run_in_lanes")
    clock = SimulatedClock()
    began = clock.now
    monkeypatch.setattr(background, "clock", clock)
    wanted = [(proceed_at,), (proceed_at, run_in_lanes), (run_in_lanes, collide), (proceed_at,), (collide,)]
    for functions in wanted * 3:
        background.make_ready(*functions)
    needed = background.PATIENT * background.seconds_of({function for functions in wanted for function in functions})
    assert 0.9 * needed < clock.now - began < needed + len(wanted) * 3 * background.BETWEEN_LOOKS


def test_who_needs_what_never_comes_compiles_it(folder, caplog):
    """A process that was killed, or compiles other things, leaves nobody waiting."""
    background.start([collide])
    who(folder, "collide")
    (folder / "go").touch()
    with caplog.at_level("INFO", "closedloop.compiling"):
        background.make_ready(proceed_at)
    assert caplog.messages[-1].startswith("compiling the step (once for this installation")


@pytest.mark.parametrize("value", ["0", "no", "Off", "FALSE"])
def test_a_switch_refuses_it(folder, monkeypatch, value):
    """The variable, as one writes no."""
    monkeypatch.setenv(background.VARIABLE, value)
    monkeypatch.setattr(background, "_spawn", lambda *_: pytest.fail("a process"))
    assert background.VARIABLE in background.refused()
    background.start([collide])


@pytest.mark.parametrize("executable", ["", "/usr/bin/matlab"])
def test_part_of_another_program(folder, monkeypatch, executable):
    """Where Python is no program of its own, nobody starts that program again."""
    monkeypatch.setattr(sys, "executable", executable)
    assert "another program" in background.refused()


def test_no_process_is_left(folder, monkeypatch, caplog):
    """A process that cannot be begun is a line, and holds no lock."""

    def none_left(*_):
        raise BlockingIOError(11, "Resource temporarily unavailable")

    monkeypatch.setattr(background, "_spawn", none_left)
    with caplog.at_level("INFO", "closedloop.compiling"):
        background.start([collide])
    assert "not possible" in caplog.messages[0]
    assert not background._at_work()


def test_where_nothing_can_be_kept(folder, monkeypatch, tmp_path, caplog):
    """Nobody compiles for nothing."""
    (tmp_path / "file").write_bytes(b"")
    for module in (background, cache_folder):
        monkeypatch.setattr(module, "cache_folder", lambda: tmp_path / "file" / "closedloop-0123456789abcdef")
    monkeypatch.setattr(background, "_spawn", lambda *_: pytest.fail("a process"))
    with caplog.at_level("INFO", "closedloop.compiling"):
        background.start([collide])
    assert "cannot be kept" in caplog.messages[0]


def test_a_folder_that_was_removed_stays_removed(tmp_path, monkeypatch):
    """A process in the background makes no folder."""
    monkeypatch.setattr(cache_folder, "make_folders", False)
    with pytest.raises(OSError, match="closedloop-0123456789abcdef"):
        cache_folder.claim(tmp_path / "closedloop-0123456789abcdef")
    assert not any(tmp_path.iterdir())


@pytest.mark.slow
def test_from_the_first_run_to_the_second(tmp_path):
    """Without a compiled step: the first run is interpreted, the second compiled and the same to the last bit.

    Two first runs at once start one process; one that is killed is begun again by the next run. All else that the tests
    have compiled is there, because nothing here depends on how long compiling takes.
    """
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    compiled = cache_folder.cache_folder()
    new = tmp_path / "cache" / compiled.name
    cache_folder.claim(new)
    for file in compiled.glob("*.nbc"):
        if ".proceed_at-" not in file.name:
            shutil.copy(file, new)
    del environment[background.VARIABLE]
    command = [sys.executable, "-m", "closedloop.run", "wam_slide", "--time.duration", "0.1", "--no-figures", "--json"]

    def begin(name):
        return subprocess.Popen(
            [*command, "--out", str(tmp_path / name)], env=environment, cwd=ROOT, text=True,
            stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
        )  # fmt: skip

    def at_work():
        (folder,) = (entry for entry in (tmp_path / "cache").iterdir() if entry.is_dir())
        return [
            int(process.name)
            for process in Path("/proc").iterdir()
            if process.name.isdigit() and holds(process, folder / MARKER)
        ]

    def holds(process, marker):
        try:
            return any(os.path.samefile(file, marker) for file in (process / "fd").iterdir())
        except OSError:
            return False

    both = [begin("first"), begin("beside")]
    said = [process.communicate(timeout=120)[1] for process in both]
    assert [process.returncode for process in both] == [0, 0]
    assert sorted(line.split(",")[0] for line in said) == [
        "compiling the step in another process; this run is interpreted meanwhile\n",
        "compiling the step in the background",
    ]
    (compiler,) = at_work()
    os.kill(compiler, signal.SIGKILL)
    until = time.monotonic() + 60.0
    while at_work():  # its priority is low: on a busy machine its end takes a while, and it has the lock until then
        assert time.monotonic() < until
        time.sleep(0.05)
    again = begin("again")
    assert "compiling the step in the background" in again.communicate(timeout=120)[1]
    wait = "from closedloop.jit.background import wait_until_done; wait_until_done(patience=400)"
    subprocess.run([sys.executable, "-c", wait], env=environment, cwd=ROOT, check=True, timeout=500)
    assert at_work() == []
    second = begin("second")
    assert second.communicate(timeout=120)[1] == ""
    runs = [cl.load_run(tmp_path / name / "run.nc") for name in ("first", "beside", "again", "second")]
    for name, column in runs[-1].columns.items():
        assert len({run.columns[name].tobytes() for run in runs}) == 1, name
        assert column.size or name.startswith("event")
