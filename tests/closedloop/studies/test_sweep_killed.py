"""A sweep as a process that is killed, and as one on a cluster that loses a worker: the table is the same."""

import os
import signal
import socket
import threading
import time
from pathlib import Path

import h5netcdf
import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet
from sweep_runs import Forked, process, refusal, sweep

# 256 runs in 64 parts, a second or two of work; short contacts and impacts, and some runs that are refused.
ARGUMENTS = (
    "wam_bounce", "--time.duration", "0.4", "--over", "impact.restitution=-0.05:0.8",
    "--over", "surface.gap=0.001:0.02", "--random", "256", "--seed", "5",
)  # fmt: skip


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory):
    """Return the folder with the table and the columns of the sweep, never killed."""
    folder = tmp_path_factory.mktemp("whole")
    run = Forked(folder, *ARGUMENTS, "--keep", "f", "--out", "t.parquet")
    out, err = run.communicate(timeout=300)
    assert run.returncode == 0, err
    assert "256 runs: " in out
    return folder


def parts(folder: Path) -> set[str]:
    """Return the parts that are there."""
    return {path.name for path in folder.glob("t.parquet.parts/*.arrow")}


@pytest.fixture(scope="module")
def cluster():
    """Two worker processes, for the tests of one that is killed and, after it, of all that go away."""
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None, memory_limit=0
    ) as cluster:
        yield cluster


@pytest.mark.slow
def test_a_cluster_that_loses_a_worker_gives_the_same_table(capsys, tmp_path, uninterrupted, cluster):
    """One of the workers is killed in the middle: the same bytes as the threads wrote."""
    victim = next(iter(cluster.workers.values()))
    pid = victim.process.pid

    def kill() -> None:
        while len(parts(tmp_path)) < 10:
            time.sleep(0.005)
        os.kill(pid, signal.SIGKILL)
        deaths.append(len(parts(tmp_path)))

    deaths: list[int] = []
    killer = threading.Thread(target=kill, daemon=True)
    killer.start()
    out = tmp_path / "t.parquet"
    status, _, err = sweep(capsys, *ARGUMENTS, "--keep", "f", "--out", out, "--scheduler", cluster.scheduler_address)
    assert status == 0, err
    killer.join(timeout=10)
    assert 10 <= deaths[0] < 64
    assert out.read_bytes() == (uninterrupted / "t.parquet").read_bytes()
    with h5netcdf.File(tmp_path / "t.nc") as mine, h5netcdf.File(uninterrupted / "t.nc") as whole:
        np.testing.assert_array_equal(mine.variables["contact_force"][...], whole.variables["contact_force"][...])


@pytest.mark.slow
def test_a_scheduler_that_does_not_answer_is_given_up(capsys, tmp_path):
    """Something listens at the address and says nothing: one line after a few seconds, and nothing is lost."""
    with socket.socket() as silent:
        silent.bind(("127.0.0.1", 0))
        silent.listen()
        address = f"tcp://127.0.0.1:{silent.getsockname()[1]}"
        began = time.monotonic()
        line = refusal(capsys, *ARGUMENTS, "--out", tmp_path / "t.parquet", "--scheduler", address)
        assert time.monotonic() - began < 60.0  # it comes back at all
    assert f"--scheduler {address}: no answer within 5 s" in line


@pytest.mark.slow
def test_a_cluster_that_goes_away_is_gone_on_without(capsys, tmp_path, uninterrupted, cluster):
    """The whole cluster dies in the middle: exit status 3, and the same command without it ends the sweep."""
    try:
        out, folder = tmp_path / "t.parquet", tmp_path
        run = process(folder, *ARGUMENTS, "--keep", "f", "--out", "t.parquet", "--scheduler", cluster.scheduler_address)
        while run.poll() is None and len(parts(folder)) < 10:
            time.sleep(0.005)
    finally:
        cluster.close()
    _, err = run.communicate(timeout=120)
    assert run.returncode == 3, err
    assert "the cluster was lost" in err.splitlines()[-1]
    assert sweep(capsys, *ARGUMENTS, "--keep", "f", "--out", out)[0] == 0
    assert out.read_bytes() == (uninterrupted / "t.parquet").read_bytes()
    assert isinstance(parquet.read_table(out), pa.Table)
