"""Compiled code on disk: found again by the next process, and compiled again if anything is wrong with it."""

import errno
import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest

import closedloop as cl
from closedloop.jit import compile_cache
from closedloop.jit.cache_folder import MARKER

ROOT = Path(cl.__file__).parent.parent
SOURCE = """
from closedloop.jit.kernel import entry_kernel

@entry_kernel
def twice(x):
    return 2 * x
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Return the folder in which the code is kept."""
    folder = tmp_path / "closedloop-0123456789abcdef"
    monkeypatch.setattr(compile_cache, "cache_folder", lambda: folder)
    return folder


@pytest.fixture
def twice(tmp_path, folder):
    """Return a function that makes the kernel anew, as another process would."""
    file = tmp_path / "kernel_of_test.py"
    file.write_text(SOURCE)

    def load(source=SOURCE):
        file.write_text(source)
        spec = importlib.util.spec_from_file_location("kernel_of_test", file)
        module = importlib.util.module_from_spec(spec)
        exec(compile(source, str(file), "exec"), module.__dict__)
        return module.twice

    return load


def hits(kernel):
    """Return how often a kernel was found instead of compiled."""
    return sum(kernel.stats.cache_hits.values())


def code_of(folder):
    """Return the one file of code."""
    (file,) = folder.glob("*.nbc")
    return file


def test_the_next_process_finds_it(twice, folder):
    """What was compiled is found, for each signature its own, in a folder with the marker and nothing else."""
    first = twice()
    assert first(3) == 6
    assert hits(first) == 0
    again = twice()
    assert again(3) == 6
    assert hits(again) == 1
    assert again(1.5) == 3.0
    assert hits(again) == 1
    third = twice()
    assert (third(4), third(2.5)) == (8, 5.0)
    assert hits(third) == 2
    assert sorted(p.suffix for p in folder.iterdir()) == ["", ".nbc", ".nbc"]
    assert (folder / MARKER).is_file()


def test_another_source_is_not_found(twice, folder):
    """A kernel outside the package whose file has changed is compiled again, into the same place."""
    twice()(3)
    changed = twice(SOURCE.replace("2 * x", "5 * x"))
    assert changed(3) == 15
    assert hits(changed) == 0
    assert code_of(folder).is_file()


def cut(data):
    """Cut a file off."""
    return data[: len(data) // 2]


def one_byte(data):
    """Change a byte in the machine code."""
    at = len(data) // 2
    return data[:at] + bytes([data[at] ^ 1]) + data[at + 1 :]


@pytest.mark.parametrize(
    "damage",
    [
        cut, one_byte, lambda data: b"", lambda data: data[:10], lambda data: data[:60], lambda data: bytes(len(data)),
        lambda data: data + b"more", lambda data: b"\x80\x04N.",
    ],
)  # fmt: skip
def test_damaged_code_is_compiled_again(damage, twice, folder):
    """A file that is not as it was written is not used, and replaced."""
    twice()(3)
    whole = code_of(folder).read_bytes()
    code_of(folder).write_bytes(damage(whole))
    again = twice()
    assert again(3) == 6
    assert hits(again) == 0
    third = twice()
    assert third(3) == 6
    assert hits(third) == 1


def test_code_that_is_no_file(twice, folder):
    """A pipe or a folder in the place of the code: compiled again, and nothing waits for the pipe."""
    twice()(3)
    for put in (os.mkfifo, os.mkdir):
        file = code_of(folder)
        file.unlink()
        put(file)
        again = twice()
        assert again(3) == 6
        assert hits(again) == 0
        if file.is_dir():
            file.rmdir()


def test_a_full_disk(twice, folder, monkeypatch):
    """Where the code does not fit, it is used all the same, and no part of it is left behind."""

    def full(path, data):
        with path.open("wb") as file:
            file.write(data[:100])
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    kernel = twice()
    assert kernel(3) == 6
    assert [p.name for p in folder.iterdir()] == [MARKER]


def test_no_folder(twice, tmp_path, monkeypatch):
    """Where there can be no folder, the code is compiled in each process."""
    (tmp_path / "file").write_bytes(b"")
    monkeypatch.setattr(compile_cache, "cache_folder", lambda: tmp_path / "file" / "closedloop-0123456789abcdef")
    for _ in range(2):
        kernel = twice()
        assert kernel(3) == 6
        assert hits(kernel) == 0


def test_nothing_is_written_beside_the_source(twice, tmp_path, folder):
    """numba's own cache, which does not see a change in another file, is not fallen back to."""
    twice()(3)
    assert not (tmp_path / "__pycache__").exists()


@pytest.mark.slow
def test_several_processes_at_once(tmp_path):
    """Four processes compile the same and store it at once: each gets its answer, and the next finds all of it."""
    (tmp_path / "kernel_of_test.py").write_text(SOURCE)
    code = (
        "import kernel_of_test as k; print(k.twice(3), k.twice(1.5), k.twice(True), "
        "sum(k.twice.stats.cache_hits.values()))"
    )
    environment = {
        **os.environ,
        "NUMBA_CACHE_DIR": str(tmp_path / "cache"),
        "PYTHONPATH": os.pathsep.join([str(tmp_path), str(ROOT)]),
    }
    command = [sys.executable, "-c", code]
    at_once = [
        subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        for _ in range(4)
    ]
    for process in at_once:
        out, err = process.communicate(timeout=300)
        assert out.split()[:3] == ["6", "3.0", "2"], err
    after = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert after.stdout.split() == ["6", "3.0", "2", "3"]
    (folder,) = (tmp_path / "cache").iterdir()
    assert all(p.name == MARKER or p.suffix == ".nbc" for p in folder.iterdir())
