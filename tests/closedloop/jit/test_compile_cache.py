"""Compiled code on disk: found again by the next process, and compiled again if anything is wrong with it."""

import errno
import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest
from numba import float64, int64

import closedloop as cl
from closedloop.jit.cache_folder import MARKER
from closedloop.jit.inside import compile_cache

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


def test_with_and_without_the_type_of_the_answer(twice, folder):
    """A form is found whether it is asked for by its arguments alone or by its answer too, if that is the same."""
    twice()(3)
    asked = twice()
    asked.compile(int64(int64))
    assert hits(asked) == 1
    other = twice()
    other.compile(float64(int64))
    assert (hits(other), other(3)) == (0, 6.0)


def test_another_source_is_not_found(twice, folder):
    """A kernel outside the package whose file has changed is compiled again."""
    twice()(3)
    changed = twice(SOURCE.replace("2 * x", "5 * x"))
    assert changed(3) == 15
    assert hits(changed) == 0
    assert len(list(folder.glob("*.nbc"))) == 2
    again = twice()
    assert again(3) == 6
    assert hits(again) == 1


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
    """Three processes compile the same and store it at once: each gets its answer, and the next finds all of it."""
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
        for _ in range(3)
    ]
    for process in at_once:
        out, err = process.communicate(timeout=300)
        assert out.split()[:3] == ["6", "3.0", "2"], err
    after = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert after.stdout.split() == ["6", "3.0", "2", "3"]
    (folder,) = (tmp_path / "cache").iterdir()
    assert all(p.name == MARKER or p.suffix == ".nbc" for p in folder.iterdir())


CALLS = """
from closedloop.jit.kernel import entry_kernel
import numba
import helper_of_test as helper
from helper_of_test import HALF

inner = numba.njit(helper.inner)

@entry_kernel
def whole(x):
    return inner(x) + HALF + helper.MORE
"""
HELPER = "HALF, MORE = 0.5, 0.0\n\ndef inner(x):\n    return 2.0 * x\n"


def made_in(place, helper, monkeypatch):
    """Return a kernel made from files in a folder, as another process would."""
    place.mkdir(exist_ok=True)
    (place / "helper_of_test.py").write_text(helper)
    (place / "calls_of_test.py").write_text(CALLS)
    for name in ("helper_of_test", "calls_of_test"):
        sys.modules.pop(name, None)
        spec = importlib.util.spec_from_file_location(name, place / f"{name}.py")
        module = importlib.util.module_from_spec(spec)
        monkeypatch.setitem(sys.modules, name, module)
        exec(compile((place / f"{name}.py").read_text(), str(place / f"{name}.py"), "exec"), module.__dict__)
    return module.whole


@pytest.mark.usefixtures("folder")
def test_a_copy_elsewhere_finds_it(tmp_path, monkeypatch):
    """What the code says counts, and not where it lies; but all that it says, in other files and constants too."""
    assert made_in(tmp_path / "one", HELPER, monkeypatch)(3.0) == 6.5
    copy = made_in(tmp_path / "two", HELPER, monkeypatch)
    assert copy(3.0) == 6.5
    assert hits(copy) == 1
    for changed, answer in (("2.0 *", "4.0 *"), 12.5), (("= 0.5", "= 1.5"), 7.5), (("0.0\n", "9.0\n"), 15.5):
        other = made_in(tmp_path / "two", HELPER.replace(*changed), monkeypatch)
        assert other(3.0) == answer
        assert hits(other) == 0


@pytest.mark.skipif(not hasattr(os, "geteuid"), reason="files have no such owners")
def test_code_that_another_user_could_have_written_is_not_loaded(twice, folder, caplog):
    """A file that others can write, or of another user, is compiled again, with a line that says so."""
    twice()(3)
    ways = [lambda file: file.chmod(0o666)]
    if os.geteuid() == 0:
        ways.append(lambda file: os.chown(file, 65534, 65534))
    for make in ways:
        make(code_of(folder))
        caplog.clear()
        again = twice()
        assert again(3) == 6
        assert hits(again) == 0
        assert "is not used: it " in caplog.text
        trusted = twice()
        trusted(3)
        assert hits(trusted) == 1


def test_a_link_to_code_is_not_followed(twice, folder, tmp_path):
    """Who can make a link only cannot choose what is loaded."""
    twice()(3)
    file = code_of(folder)
    file.rename(tmp_path / "planted")
    file.symlink_to(tmp_path / "planted")
    again = twice()
    assert again(3) == 6
    assert hits(again) == 0
