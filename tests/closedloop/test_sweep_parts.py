"""Parts of a sweep that another user, or another machine, has written are read by a process of their own first."""

import io
import sys

import numpy as np
import pyarrow as pa
import pytest

from closedloop.record import sealed
from closedloop.studies.sweep import part_file
from closedloop.studies.sweep.part_file import read_part, write_part


def rows():
    """Return the bytes of a table as a part has it."""
    table, out = pa.table({"run": [0, 1], "verdict": ["good", "BAD step"]}), pa.BufferOutputStream()
    with pa.ipc.new_file(out, table.schema) as writer:
        writer.write_table(table)
    return memoryview(out.getvalue())


def columns():
    """Return the bytes of whole columns as a part has them."""
    out = io.BytesIO()
    np.savez(out, q=np.arange(6.0).reshape(2, 3))
    return out.getbuffer()


@pytest.fixture
def breaks_down(tmp_path, monkeypatch):
    """Let a process that reads break down."""
    program = tmp_path / "python"
    program.write_text("#!/bin/sh\nkill -SEGV $$\n")
    program.chmod(0o700)
    monkeypatch.setattr(sys, "executable", str(program))


@pytest.fixture
def not_ours(monkeypatch):
    """Let another user have written what is written now."""

    def written_by_another(path, content):
        with monkeypatch.context() as patch:
            patch.setattr(sealed, "seal_key", lambda: b"another user's")
            write_part(path, content)
        part_file._read.clear()

    return written_by_another


@pytest.mark.usefixtures("breaks_down")
@pytest.mark.parametrize(("name", "content"), [("part-1.arrow", rows()), ("part-1.npz", columns())])
def test_ones_own_parts_need_no_other_process(name, content, tmp_path):
    """What this user has written on this machine is read at once."""
    write_part(tmp_path / name, content)
    assert bytes(read_part(tmp_path / name)) == bytes(content)


@pytest.mark.parametrize(("name", "content"), [("part-1.arrow", rows()), ("part-1.npz", columns())])
def test_parts_of_others_are_read_once_they_were_tried(name, content, tmp_path, not_ours, monkeypatch):
    """A sweep goes on where another user or machine began it; each part is tried once."""
    not_ours(tmp_path / name, content)
    assert bytes(read_part(tmp_path / name)) == bytes(content)
    monkeypatch.setattr(part_file.subprocess, "run", None)
    assert bytes(read_part(tmp_path / name)) == bytes(content)


@pytest.mark.parametrize(("name", "content"), [("part-1.arrow", rows()), ("part-1.npz", columns())])
def test_a_part_of_others_that_is_damaged_is_told(name, content, tmp_path, not_ours):
    """It has a seal that is right, for anyone can seal bytes."""
    not_ours(tmp_path / name, content[:100])
    with pytest.raises(ValueError, match="is damaged: it cannot be read"):
        read_part(tmp_path / name)


@pytest.mark.usefixtures("breaks_down")
def test_a_part_over_which_arrow_breaks_down_does_so_alone(tmp_path, not_ours):
    """SIGSEGV, which some of the damaged tables with a new seal gave, ends that process and not the sweep."""
    not_ours(tmp_path / "part-1.arrow", rows())
    with pytest.raises(ValueError, match="is damaged: it cannot be read"):
        read_part(tmp_path / "part-1.arrow")
