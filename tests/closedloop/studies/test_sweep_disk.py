"""A disk that is full, or a limit on files, at any byte: one line, no stray file, no crash, and the sweep goes on."""

import io

import h5netcdf
import numpy as np
import pytest
from pyarrow import parquet
from sweep_runs import Forked, sweep

import closedloop as cl
from closedloop.base.errors import OutputError
from closedloop.base.files import write_whole
from closedloop.studies.sweep.store import Store
from closedloop.studies.sweep.sweep import Design, Sweep, parse_axis, run_sweep

KEPT = (
    "wam_slide", "--time.duration", "0.2", "--over", "law.force=5:15:24", "--keep", "f,q", "--out", "t.parquet",
)  # fmt: skip


def small(**options):
    """Return a sweep of six runs of ten steps that keeps columns."""
    scenario = cl.load_scenario("wam_slide", {"time.duration": 0.01})
    return Sweep.of(scenario, Design([parse_axis("law.force=5:15:6")]), ("contact_force", "q"), **options)


@pytest.mark.parametrize(("where", "after"), [("store", 0), ("store", 1), ("store", 3), ("join", 0), ("join", 1)])
def test_what_cannot_be_written_is_said_and_leaves_nothing(tmp_path, monkeypatch, where, after):
    """A write that fails in the parts, or in the table: what was done is kept, nothing else, and it goes on."""
    calls, memory = [], []

    class Noted(io.BytesIO):
        def __init__(self, *content):
            super().__init__(*content)
            memory.append(self)

    def full(path, *rest, **options):
        if where == "store" or path.parent == tmp_path:
            calls.append(path)
        if len(calls) > after:
            raise OutputError(f"{path}: cannot be written: No space left on device")
        return write_whole(path, *rest, **options)

    out = tmp_path / "t.parquet"
    with monkeypatch.context() as patch:
        for module in ("closedloop.studies.sweep.store", "closedloop.record.save"):
            patch.setattr(f"{module}.write_whole", full)
        patch.setattr("closedloop.record.save.io.BytesIO", Noted)
        with pytest.raises(OutputError) as refused:
            run_sweep(small(), out, workers=1)
    assert "No space left on device" in str(refused.value)
    assert memory or (where, after) != ("join", 1)
    for stream in memory:  # one that is held open by a view is a line on standard error when it goes (from 3.13 on)
        stream.close()
    assert len(str(refused.value).splitlines()) == 1
    assert not out.exists()
    assert not [path for path in tmp_path.rglob("*") if path.name.endswith(".unfinished")]
    assert (tmp_path / "t.parquet.parts").exists() == (where == "join" or after == 3)
    run_sweep(small(), out, workers=1)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["t.nc", "t.parquet"]


def assert_goes_on(capsys, folder, status, err):
    """Check what a limit has left in the folder, and that the sweep goes on from it to the end."""
    assert status == 2, err
    (line,) = [line for line in err.splitlines() if not line.startswith("compiling")]
    assert "cannot be written: File too large" in line
    assert {path.name for path in folder.iterdir()} <= {"t.parquet.parts", "t.nc"}
    assert not [path for path in folder.rglob("*") if path.name.endswith(".unfinished")]
    if (folder / "t.nc").exists():
        h5netcdf.File(folder / "t.nc").close()
    assert sweep(capsys, *KEPT[:-1], folder / "t.parquet")[0] == 0
    assert sorted(path.name for path in folder.iterdir()) == ["t.nc", "t.parquet"]
    table = parquet.read_table(folder / "t.parquet")
    with h5netcdf.File(folder / "t.nc") as file:
        np.testing.assert_array_equal(file.variables["contact_force"][:, -1], table["final_contact_force"])


@pytest.mark.slow
@pytest.mark.parametrize("size", [0, 500, 4000, 12_000, 20_000, 60_000, 120_000, 180_000, 200_000])
def test_a_limit_on_files_at_any_size_is_one_line(capsys, tmp_path, size):
    """From nothing at all, as with ``ulimit -f``, to just too little for the columns: it was a segmentation fault."""
    run = Forked(tmp_path, *KEPT, most_bytes=size)
    _, err = run.communicate()
    assert_goes_on(capsys, tmp_path, run.returncode, err)


def test_a_store_that_cannot_begin_leaves_nothing(tmp_path, monkeypatch):
    """The first file of the folder cannot be written: the folder goes too."""

    def full(path, *_):
        raise OutputError(f"{path}: cannot be written: No space left on device")

    monkeypatch.setattr("closedloop.studies.sweep.store.write_whole", full)
    with pytest.raises(OutputError), Store({"keep": []}, tmp_path / "t.parquet"):
        pass
    assert list(tmp_path.iterdir()) == []
