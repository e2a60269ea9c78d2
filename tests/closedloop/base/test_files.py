"""Files that are whole or not there."""

import os
import re
import resource
import subprocess
import sys
from pathlib import Path

import pytest

from closedloop.base.errors import OutputError
from closedloop.base.files import remove_unfinished, write_whole

ROOT = Path(__file__).resolve().parents[3]


@pytest.fixture
def small_files():
    """Let no file of this process grow beyond 10 kB."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_bytes_and_writer(tmp_path):
    """Bytes, or a function, fill a file, and only that file is there."""
    assert write_whole(tmp_path / "a", b"one").read_bytes() == b"one"
    write_whole(tmp_path / "a", lambda file: file.write(b"two"), reserve=2)
    assert (tmp_path / "a").read_bytes() == b"two"
    assert os.listdir(tmp_path) == ["a"]


def test_a_link_is_replaced_not_followed(tmp_path):
    """What a link points to stays as it was."""
    theirs = tmp_path / "theirs"
    theirs.write_text("theirs")
    (tmp_path / "a").symlink_to(theirs)
    write_whole(tmp_path / "a", b"ours")
    assert theirs.read_text() == "theirs"
    assert not (tmp_path / "a").is_symlink()


@pytest.mark.parametrize("reserve", [0, 50_000])
@pytest.mark.usefixtures("small_files")
def test_full_disk_leaves_the_older_file_and_nothing_else(tmp_path, reserve):
    """A file that does not fit is refused in one line."""
    write_whole(tmp_path / "a", b"older")
    with pytest.raises(OutputError, match=re.escape(f"{tmp_path / 'a'}: cannot be written: File too large")):
        write_whole(tmp_path / "a", bytes(50_000), reserve=reserve)
    assert (tmp_path / "a").read_bytes() == b"older"
    assert os.listdir(tmp_path) == ["a"]


@pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError])
def test_an_interrupted_writer_leaves_nothing(tmp_path, error):
    """Ctrl-C in the middle of writing, or any error, leaves no file."""

    def write(file):
        file.write(b"half")
        raise error

    with pytest.raises(error):
        write_whole(tmp_path / "a", write)
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize(("make", "kind"), [(os.mkdir, "a folder"), (os.mkfifo, "a pipe")])
def test_what_is_no_file_is_not_replaced(tmp_path, make, kind):
    """A rename would replace an empty folder or a pipe."""
    make(tmp_path / "a")
    with pytest.raises(OutputError, match=f"there is {kind} of that name"):
        write_whole(tmp_path / "a", b"")
    assert os.listdir(tmp_path) == ["a"]


def test_device_is_not_replaced():
    """Root may replace a device by a rename, and must not."""
    with pytest.raises(OutputError, match="there is a device of that name"):
        write_whole("/dev/null", b"")


@pytest.mark.parametrize("path", ["nosuch/a", "a\0b"])
def test_no_such_place(tmp_path, path):
    """A missing folder and a name that no file can have are refused in one line."""
    with pytest.raises(OutputError, match="cannot be written"):
        write_whole(tmp_path / path, b"")


KILLED = """
import os, signal, sys
from closedloop.base.files import write_whole
write_whole(sys.argv[1], lambda file: (file.write(b"half"), os.kill(os.getpid(), signal.SIGKILL)))
"""


def test_what_a_kill_leaves_is_removed_and_nothing_else(tmp_path):
    """A name that looks like ours is not enough to be removed."""
    theirs = {".closedloop-results", ".closedloop-0123456789abcdef-0123456789abcdef.unfinished", "run.nc"}
    for name in theirs:
        (tmp_path / name).write_text("theirs")
    subprocess.run([sys.executable, "-c", KILLED, tmp_path / "a"], check=False)
    (left,) = set(os.listdir(tmp_path)) - theirs
    assert re.fullmatch(r"\.closedloop-.*\.unfinished", left)
    assert remove_unfinished(tmp_path) == [tmp_path / left]
    assert set(os.listdir(tmp_path)) == theirs


def test_a_writer_at_work_is_left_alone(tmp_path):
    """An unfinished file in use is not taken for left behind."""
    write_whole(tmp_path / "a", lambda file: file.write(bytes([len(remove_unfinished(tmp_path))])))
    assert (tmp_path / "a").read_bytes() == b"\0"


def test_nothing_is_written_but_whole():
    """No command opens a file of a user's for writing by itself; caches of compiled code have a way of their own."""
    own_way = {
        "closedloop/base/files.py",
        "closedloop/jit/cache_folder.py",
        "closedloop/jit/inside/compile_cache.py",
        "closedloop/studies/tune/tune.py",
    }  # a tuning's runs, a line for each: a line cut off is left out
    nothing = {
        "closedloop/base/second_process.py",
        "closedloop/command/border.py",
        "closedloop/figures/page.py",
        "closedloop/jit/background.py",
        "validation/bodies.py",
        "validation/franka_sim.py",
        "validation/measured/cubes/engine.py",
        "validation/measured/judged.py",
        "validation/speed/scenes.py",
    }  # in a temporary folder, or where a user's own savefig says
    writing = re.compile(
        r"write_text\(|write_bytes\(|\bopen\([^)\n]*[\"'][wxa][b+]*[\"']|savefig\((?!image|file|picture)"
    )
    found = {
        str(file.relative_to(ROOT))
        for package in ("closedloop", "validation")
        for file in (ROOT / package).rglob("*.py")
        if writing.search(file.read_text(encoding="utf-8"))
    }
    assert found - nothing == own_way
