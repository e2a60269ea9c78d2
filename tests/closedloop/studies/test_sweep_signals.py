"""Ctrl-C, SIGTERM and SIGKILL at any moment of a sweep and its joining, and two sweeps at once."""

import random
import signal
import threading
import time

import h5netcdf
import numpy as np
import pytest
from budget import budget
from pyarrow import parquet
from sweep_runs import Forked, here, process, sweep

from closedloop.simulation.batch import threads
from closedloop.simulation.batch.threads import Done, Ended, side_by_side, uninterrupted
from closedloop.studies.sweep.store import Store

# Some tenths of a second of runs, and as long to join: 200 runs of 400 steps in 100 parts, 6 MB of columns.
ARGUMENTS = ("wam_slide", "--time.duration", "0.4", "--over", "law.force=5:15:200", "--keep", "f,q,v")
LAST_LINES = {
    signal.SIGINT: (130, "closedloop sweep: interrupted; the same command goes on from here"),
    signal.SIGTERM: (143, "closedloop sweep: terminated; the same command goes on from here"),
}


def names(folder):
    """Return the names of what is in a folder."""
    return sorted(path.name for path in folder.iterdir())


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Return the folder of the sweep that nothing has ended."""
    folder = tmp_path_factory.mktemp("whole")
    status, said = here(*ARGUMENTS, "--out", folder / "t.parquet")
    assert status == 0
    assert said.startswith("200 runs: 200 done")
    return folder


def send(run, number, folder, seconds):
    """Send a signal some seconds after the first part is there; return what the process said."""
    while run.poll() is None and seconds >= 0.0 and not list(folder.glob("t.parquet.parts/*.arrow")):
        time.sleep(0.002)
    time.sleep(abs(seconds))
    if run.poll() is None:
        run.send_signal(number)
    return run.communicate(timeout=120)


def before_it_begins(status, number, said):
    """Whether a signal came before Python itself had begun, or while it imported what the command needs."""
    return -status == number or "init_import_site" in said or (status == 130 and number == signal.SIGINT and not said)


def assert_sound(folder, status, number, said):
    """Check what a signal has left, whatever it hit."""
    if status == 0:  # it came too late
        return
    if number != signal.SIGKILL:
        expected, line = LAST_LINES[number]
        assert (status, said.strip().splitlines()[-1]) == (expected, line)
        assert "Traceback" not in said
        assert set(names(folder)) <= {"t.parquet.parts", "t.nc", "mine.txt"}
    assert not (folder / "t.parquet").exists()
    if (folder / "t.nc").exists():
        h5netcdf.File(folder / "t.nc").close()


def assert_goes_on_to(folder, whole):
    """Check that the sweep goes on to the same table, and that nothing else is left."""
    run = Forked(folder, *ARGUMENTS, "--out", "t.parquet")
    _, err = run.communicate()
    assert run.returncode == 0, err
    assert names(folder) == ["mine.txt", "t.nc", "t.parquet"]
    assert (folder / "mine.txt").read_text() == "mine"
    assert parquet.read_table(folder / "t.parquet").equals(parquet.read_table(whole / "t.parquet"))
    with h5netcdf.File(folder / "t.nc") as mine, h5netcdf.File(whole / "t.nc") as theirs:
        for name in ("contact_force", "q", "v"):
            np.testing.assert_array_equal(mine.variables[name][...], theirs.variables[name][...])


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_any_signal_at_any_moment_costs_nothing(tmp_path, whole, number):
    """From the start of the process to the renaming of the table, at random."""
    rng = random.Random(int(number))
    (tmp_path / "mine.txt").write_text("mine")
    for k in range(budget(3, 12)):
        # The first, and every fourth, while it starts; else from the first part on: the runs, then the joining.
        starts = k % 4 == 0
        run = (process if starts else Forked)(tmp_path, *ARGUMENTS, "--out", "t.parquet")
        _, err = send(run, number, tmp_path, -rng.uniform(0.2, 3.0) if starts else rng.uniform(0.0, 1.5))
        if run.returncode == 0 or (number == signal.SIGKILL and (tmp_path / "t.parquet").exists()):  # all was done
            assert parquet.read_table(tmp_path / "t.parquet").equals(parquet.read_table(whole / "t.parquet"))
            for name in ("t.parquet", "t.nc"):
                (tmp_path / name).unlink()
        elif number == signal.SIGKILL or not (before_it_begins(run.returncode, number, err) and starts):
            assert_sound(tmp_path, run.returncode, number, err)
    assert_goes_on_to(tmp_path, whole)


def test_an_interruption_while_columns_are_joined_leaves_no_file(capsys, tmp_path, monkeypatch):
    """Ctrl-C in the middle of the NetCDF file: it is ended between two parts, not within a call of HDF5."""
    from closedloop.studies.sweep import store

    waiting, main = threading.Event(), threading.main_thread().ident
    create = store._create

    def slow(*arguments):
        create(*arguments)
        signal.pthread_kill(main, signal.SIGINT)
        time.sleep(0.3)
        waiting.set()

    monkeypatch.setattr(store, "_create", slow)
    small = ("wam_slide", "--time.duration", "0.01", "--over", "law.force=5:15:6", "--keep", "f")
    status, _, err = sweep(capsys, *small, "--out", tmp_path / "t.parquet")
    assert (status, err.splitlines()[-1]) == LAST_LINES[signal.SIGINT]
    assert waiting.is_set()
    assert names(tmp_path) == ["t.parquet.parts"]
    monkeypatch.undo()
    assert sweep(capsys, *small, "--out", tmp_path / "t.parquet")[0] == 0
    assert names(tmp_path) == ["t.nc", "t.parquet"]


@pytest.mark.parametrize("again", [False, True])
def test_an_interruption_when_the_table_is_whole_came_too_late(capsys, tmp_path, monkeypatch, again):
    """The sweep is done: nothing is left of its parts, whether or not they were being removed."""
    small = ("planar2_slide", "--time.duration", "0.01", "--over", "law.force=5:15:3")
    remove, told = Store.remove, []

    def interrupted(store):
        if not told:
            told.append(store)
            if again:
                remove(store)
            raise KeyboardInterrupt
        remove(store)

    monkeypatch.setattr(Store, "remove", interrupted)
    status, said, err = sweep(capsys, *small, "--out", tmp_path / "t.parquet")
    assert (status, err) == (0, "")
    assert said.startswith("3 runs: 3 done")
    assert names(tmp_path) == ["t.parquet"]


def test_threads_end_between_two_runs_when_one_fails():
    """The error comes out at once, and the other thread ends at its next run, not at the end of its work."""
    done, ran = Done(), []
    failed = threading.Event()

    def one(own, i):
        if i == 1:
            failed.set()
            raise ZeroDivisionError
        failed.wait(10.0)
        while True:  # as many runs as there may be
            time.sleep(0.001)
            done.add()
            ran.append(i)

    with pytest.raises(ZeroDivisionError):
        side_by_side(one, 2, 2, object, lambda: None, done)
    assert not threads.still_at_work() or len(ran) < 1000
    with pytest.raises(Ended):
        done.add()


@pytest.mark.parametrize("several", [False, True])
def test_a_signal_while_a_thread_starts_ends_the_thread(monkeypatch, several):
    """It waits until the thread is known: else nothing would end it, and what it writes would be left unfinished."""
    submit, ended = threads.ThreadPoolExecutor.submit, []

    def interrupted(pool, *arguments):
        future = submit(pool, *arguments)
        signal.raise_signal(signal.SIGINT)
        return future

    def until_ended(done):
        try:
            for _ in range(1000):
                done.check()
                time.sleep(0.001)
        except Ended:
            ended.append(done)
            raise

    monkeypatch.setattr(threads.ThreadPoolExecutor, "submit", interrupted)
    done = Done()

    def start():
        if several:
            side_by_side(lambda own, i: until_ended(done), 1, 1, object, lambda: None, done)
        else:
            uninterrupted(until_ended)

    with pytest.raises(KeyboardInterrupt):
        start()
    assert len(ended) == 1


def test_uninterrupted_returns_and_raises():
    """What the thread returns or raises comes out."""
    assert uninterrupted(lambda done: 3) == 3
    with pytest.raises(ZeroDivisionError):
        uninterrupted(lambda done: 1 / 0)
