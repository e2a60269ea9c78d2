"""What a sweep finds where its table should be, and is not its own: it is never overwritten, nor taken for a sweep."""

import json
import os

import pyarrow as pa
import pytest
from pyarrow import parquet
from sweep_runs import SMALL, refusal, sweep
from test_sweep import small

import closedloop as cl
from closedloop.studies.sweep import store as store_module
from closedloop.studies.sweep.sweep import run_sweep


def test_what_is_not_this_sweeps_is_never_overwritten(capsys, tmp_path):
    """A text, another table, another sweep's table, another folder, another NetCDF file: each stays as it is."""
    out = tmp_path / "t.parquet"
    small_with_columns = (*SMALL, "--keep", "f")

    def refused_with(*content, arguments=SMALL):
        for path, text in content:
            path.parent.mkdir(exist_ok=True)
            path.write_bytes(text)
        line = refusal(capsys, *arguments, "--out", out)
        for path, text in content:
            assert path.read_bytes() == text
            path.unlink()
        return line

    cure = "name another file with --out, or replace it with --overwrite"
    assert f"exists and is not a sweep; {cure}" in refused_with((out, b"my notes"))
    parquet.write_table(pa.table({"a": [1]}), out)
    assert "exists and is not a sweep" in refused_with((out, out.read_bytes()))
    assert sweep(capsys, *SMALL, "--out", out)[0] == 0
    line = refused_with((out, out.read_bytes()), arguments=(*SMALL, "--law.kd", "30"))
    assert f"holds another sweep: law.kd is [60.0, 60.0, 30.0, 20.0] there and 30.0 here; {cure}" in line, line
    assert "exists and is not a sweep" in refused_with((out.with_suffix(".nc"), b"data"), arguments=small_with_columns)
    folder = tmp_path / "t.parquet.parts"
    assert "is there and holds no sweep" in refused_with((folder / "mine.txt", b"mine"))
    other = json.dumps({"format": store_module.FORMAT, "identity": {"scenario": "other"}}).encode()
    assert "holds another sweep: the scenario differs, " in refused_with((folder / "sweep.json", other))


def test_another_sweep_is_replaced_where_that_is_asked_for(capsys, tmp_path):
    """Its table and its columns go, parts of a third one too; the new table is what it would be in an empty folder."""
    out, brief = tmp_path / "t.parquet", ("wam_slide", "--time.duration", "0.002", "--workers", "1")
    assert sweep(capsys, *brief, "--over", "law.force=5,6,7", "--keep", "f", "--out", out)[0] == 0
    folder = tmp_path / "t.parquet.parts"
    folder.mkdir()
    (folder / "sweep.json").write_text(json.dumps({"format": store_module.FORMAT, "identity": {"scenario": "other"}}))
    (folder / "part-00000000.arrow").write_text("of the other")
    for over in ("law.force=8,9", "law.kd=8,9", "law.kd=8,9"):
        words = (*brief, "--over", over, "--out", out)
        assert sweep(capsys, *words, "--overwrite")[0] == 0
        assert parquet.read_table(out)[over.partition("=")[0]].to_pylist() == [8.0, 9.0]
        assert list(tmp_path.iterdir()) == [out]
    out.write_text("my notes")
    assert sweep(capsys, *words, "--overwrite")[0] == 0
    assert parquet.read_table(out).num_rows == 2


def test_what_is_somebody_elses_stays(capsys, tmp_path):
    """A user's files in the folder of parts, and what a link in it leads to, outlive the sweep; ours go."""
    out, folder, elsewhere = tmp_path / "t.parquet", tmp_path / "t.parquet.parts", tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "part-00000001.arrow").write_text("theirs")
    for path in (elsewhere / "target", elsewhere / "note"):
        path.write_text("theirs")
    identity = small().identity
    with store_module.Store(identity, out):
        (folder / "notes.txt").write_text("mine")
        (folder / "part-1.arrow").write_text("mine")
        (folder / "deep").mkdir()
        (folder / "deep" / "part-00000001.arrow").write_text("mine")
        (folder / "part-00000999.arrow").symlink_to(elsewhere / "target")
        (folder / "part-00000998.arrow").mkdir()
        (folder / ".unfinished").write_text("mine")
    run_sweep(small(), out, workers=1)
    left = {"notes.txt", "part-1.arrow", "deep", "part-00000999.arrow", "part-00000998.arrow", ".unfinished"}
    assert {path.name for path in folder.iterdir()} == left
    assert (folder / "deep" / "part-00000001.arrow").read_text() == "mine"
    assert (elsewhere / "target").read_text() == "theirs"
    assert run_sweep(small(), out, workers=1).counts == {"done": 6}  # done, whatever lies about
    assert {path.name for path in folder.iterdir()} == left


def test_pipes_and_folders_where_a_table_or_a_part_should_be(tmp_path):
    """None is waited for: a pipe as the table or its description is refused, as a part it is said."""
    out, folder = tmp_path / "t.parquet", tmp_path / "t.parquet.parts"
    os.mkfifo(out)
    with pytest.raises(cl.OutputError, match="exists and is not a sweep"):
        run_sweep(small(), out)
    out.unlink()
    folder.mkdir()
    os.mkfifo(folder / "sweep.json")
    with pytest.raises(cl.OutputError, match="is there and holds no sweep"):
        run_sweep(small(), out)
    (folder / "sweep.json").unlink()
    with store_module.Store(small().identity, out):
        os.mkfifo(folder / "part-00000002.arrow")
    with pytest.raises(cl.OutputError, match=r"part-00000002.arrow: cannot be written: there is a pipe of that name"):
        run_sweep(small(), out, workers=1)


def test_a_damaged_table_is_not_taken_for_a_sweep(tmp_path):
    """Cut short, or with its pages overwritten: one line, and it stays."""
    out = run_sweep(small(), tmp_path / "t.parquet", workers=1).table
    text = out.read_bytes()
    for damaged in (text[: len(text) // 2], text[:4] + bytes(len(text) // 2) + text[4 + len(text) // 2 :]):
        out.write_bytes(damaged)
        with pytest.raises(cl.OutputError, match=r"exists and is not a sweep|is damaged"):
            run_sweep(small(), out)
        assert out.read_bytes() == damaged
