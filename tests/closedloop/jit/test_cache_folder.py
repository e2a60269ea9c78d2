"""The folder of compiled code: what is ours goes when nobody uses it, and nothing of anyone else's is ever touched."""

import os
import resource
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

import closedloop
from closedloop.jit import cache_folder as caches
from closedloop.jit.background import compiling_notice
from closedloop.jit.cache_folder import (
    MAGIC,
    MARKER,
    MOST_KEPT,
    UNUSED,
    UNUSED_OF_MANY,
    claim,
    forget_old_caches,
    is_ours,
    source_texts,
    why_not_kept,
    why_not_trusted,
)

OLD, LATELY = UNUSED + 3600.0, 3600.0
CODE = "step.run-0123456789abcdef0123456789abcdef.nbc"


@pytest.fixture
def root(tmp_path, monkeypatch):
    """Return a folder for caches with that of this version in it."""
    mine = tmp_path / "closedloop-ffffffffffffffff"
    monkeypatch.setattr(caches, "cache_folder", lambda: mine)
    claim(mine)
    return tmp_path


def cache(root: Path, number: int, unused: float = OLD) -> Path:
    """Make the cache of another version, not used for some seconds."""
    folder = root / f"closedloop-{number:016x}"
    claim(folder)
    (folder / CODE).write_bytes(b"code" + MAGIC)
    aged(folder, unused)
    return folder


def aged(folder: Path, unused: float) -> None:
    """Set the time of the last use."""
    then = time.time() - unused
    os.utime(folder / MARKER, (then, then), follow_symlinks=False)


def tree(root: Path) -> dict[str, bytes | None]:
    """Return all files with their content."""
    return {str(p.relative_to(root)): p.read_bytes() if p.is_file() else None for p in root.rglob("*")}


def test_a_cache_that_nobody_uses_goes(root):
    """A month after its last use a cache is removed, whole, with what a killed process left of a file."""
    old = cache(root, 1)
    (old / f"{CODE}.tmp.0123456789abcdef").write_bytes(b"co")
    (old / f"{CODE}.tmp.0123456789abcdee").write_bytes(b"")
    forget_old_caches()
    assert [p.name for p in root.iterdir()] == ["closedloop-ffffffffffffffff"]


def test_versions_in_use_stay_beside_each_other(root):
    """Two versions that share a folder do not remove each other's code; nor one's own, however old its mark."""
    other = cache(root, 1, LATELY)
    before = tree(root)
    aged(root / "closedloop-ffffffffffffffff", OLD)
    forget_old_caches()
    assert tree(root) == before
    assert (other / CODE).is_file()


def test_using_a_cache_keeps_it(root):
    """To claim a folder again is to use it."""
    old = cache(root, 1)
    claim(old)
    forget_old_caches()
    assert (old / CODE).is_file()


def test_there_are_not_ever_more(root):
    """Beyond a number, those not used for a day go, the longest unused; others stay."""
    for k in range(MOST_KEPT + 4):
        cache(root, k, UNUSED_OF_MANY + 60.0 + k)
    forget_old_caches()
    kept = sorted(p.name for p in root.iterdir())
    assert len(kept) == MOST_KEPT
    assert f"closedloop-{0:016x}" in kept
    assert f"closedloop-{MOST_KEPT + 3:016x}" not in kept
    for k in range(100, 100 + MOST_KEPT + 4):
        cache(root, k, LATELY)
    forget_old_caches()
    assert sum(p.name.startswith("closedloop-000000000000007") for p in root.iterdir()) > 0
    assert len(list(root.iterdir())) >= MOST_KEPT + 4


def results(root):
    """A folder of results beside the caches."""
    (root / "closedloop-results").mkdir()
    (root / "closedloop-results" / "run.nc").write_bytes(b"a week's work")


def lookalike(root):
    """A folder with a cache's name and something else in it."""
    (root / "closedloop-0123456789abcdef").mkdir()
    (root / "closedloop-0123456789abcdef" / "thesis.tex").write_bytes(b"mine")


def earlier_format(root):
    """A cache of numba's own files, which has no marker."""
    (root / "closedloop-0123456789abcdef" / "step_0123").mkdir(parents=True)
    (root / "closedloop-0123456789abcdef" / "step_0123" / "step.run-1.py311.1.nbc").write_bytes(b"code")


def something_added(root):
    """A cache of ours in which someone has put a file."""
    (cache(root, 1) / "notes.txt").write_bytes(b"mine")
    aged(root / f"closedloop-{1:016x}", OLD)


def code_of_another(root):
    """A cache of ours with a file of numba's in it, by its name."""
    (cache(root, 1) / CODE.replace("0123", "3210")).write_bytes(b"not ours")
    aged(root / f"closedloop-{1:016x}", OLD)


def folder_added(root):
    """A cache of ours in which someone has made a folder."""
    (cache(root, 1) / CODE.replace("0123", "3210")).mkdir()
    aged(root / f"closedloop-{1:016x}", OLD)


def link_added(root):
    """A cache of ours with a link in it to someone's code."""
    (root / "mine.nbc").write_bytes(MAGIC)
    (cache(root, 1) / CODE.replace("0123", "3210")).symlink_to(root / "mine.nbc")
    aged(root / f"closedloop-{1:016x}", OLD)


def link_to_a_cache(root):
    """A link with a cache's name to a folder that looks like one."""
    (root / "elsewhere").mkdir()
    cache(root / "elsewhere", 1)
    (root / f"closedloop-{1:016x}").symlink_to(root / "elsewhere" / f"closedloop-{1:016x}")


def marker_is_a_link(root):
    """A folder whose marker is a link to another's."""
    folder = cache(root, 1)
    (folder / MARKER).rename(root / "marker")
    (folder / MARKER).symlink_to(root / "marker")
    aged(folder, OLD)


def marker_of_another(root):
    """A folder into which another's marker was copied."""
    text = (cache(root, 1, LATELY) / MARKER).read_bytes()
    (root / f"closedloop-{2:016x}").mkdir()
    (root / f"closedloop-{2:016x}" / MARKER).write_bytes(text)
    aged(root / f"closedloop-{2:016x}", OLD)


def name_with_more(root):
    """A copy of a cache under a name of one's own."""
    cache(root, 1).rename(root / f"closedloop-{1:016x}-copy")


def a_file(root):
    """A file with a cache's name."""
    (root / f"closedloop-{1:016x}").write_bytes(b"mine")


@pytest.mark.parametrize(
    "plant",
    [results, lookalike, earlier_format, something_added, code_of_another, folder_added, link_added, link_to_a_cache,
     marker_is_a_link, marker_of_another, name_with_more,
     a_file],
    ids=lambda plant: plant.__name__,
)  # fmt: skip
def test_what_is_not_provably_ours_stays(plant, root):
    """Whatever is in a folder that we did not write, down to one file: the folder stays as it is."""
    plant(root)
    before = tree(root)
    forget_old_caches()
    assert tree(root) == before
    plain = cache(root, 3)
    forget_old_caches()
    assert not plain.exists()
    assert tree(root) == before


def test_a_folder_with_something_in_it_never_becomes_ours(root):
    """The marker goes into a folder that we make, or an empty one, and no other."""
    (root / f"closedloop-{1:016x}").mkdir()
    (root / f"closedloop-{1:016x}" / "thesis.tex").write_bytes(b"mine")
    claim(root / f"closedloop-{1:016x}")
    assert not is_ours(root / f"closedloop-{1:016x}")
    (root / f"closedloop-{2:016x}").mkdir()
    claim(root / f"closedloop-{2:016x}")
    assert is_ours(root / f"closedloop-{2:016x}")


def test_a_full_disk_leaves_no_half_marker(root):
    """With it the folder would be nobody's, and nothing compiled would ever be kept again."""
    folder = root / f"closedloop-{1:016x}"
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, before[1]))
    try:
        with pytest.raises(OSError, match="too large"):
            claim(folder)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    claim(folder)
    assert is_ours(folder)


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="only root can give a folder away")
def test_anothers_cache_stays(root):
    """In a folder that several users share, each removes only what is of his own."""
    folder = cache(root, 1)
    for path in (folder, *folder.iterdir()):
        os.chown(path, 65534, 65534)
    forget_old_caches()
    assert (folder / CODE).is_file()


def test_why_nothing_can_be_kept(root, monkeypatch):
    """A folder that cannot be made is named, with the reason."""
    assert why_not_kept() == ""
    (root / "file").write_bytes(b"")
    monkeypatch.setattr(caches, "cache_folder", lambda: root / "file" / "closedloop-ffffffffffffffff")
    assert why_not_kept() == f"{root / 'file' / 'closedloop-ffffffffffffffff'}: Not a directory"
    assert "cannot be kept" in compiling_notice()


PACKAGE = Path(closedloop.__file__).parent


def test_constants_of_kernels_count(tmp_path):
    """A file without a kernel, whose constants kernels have, is part of what they say; the commands are not."""
    texts = source_texts(PACKAGE)
    for name, counts in ("loop/events/locate.py", True), ("loop/step/memory.py", True), ("command/table.py", False):
        assert ((PACKAGE / name).read_bytes() in texts) == counts, name


def test_each_copy_of_the_tree_says_the_same(tmp_path):
    """Elsewhere the texts are the same, in the same order; with another constant they are not."""
    copy = tmp_path / "elsewhere" / "closedloop"
    shutil.copytree(PACKAGE, copy, ignore=shutil.ignore_patterns("__pycache__"))
    assert source_texts(copy) == source_texts(PACKAGE)
    phases = copy / "loop" / "events" / "table.py"
    phases.write_text(phases.read_text() + "MORE = 1\n")
    assert source_texts(copy) != source_texts(PACKAGE)


unix = pytest.mark.skipif(not hasattr(os, "geteuid"), reason="files have no such owners")


@unix
def test_a_folder_that_others_can_write_is_not_trusted(tmp_path):
    """Nor one in such a folder, unless nobody can replace what is another's there."""
    inside = tmp_path / "open" / "inside"
    inside.mkdir(parents=True)
    assert why_not_trusted(inside) == ""
    for mode in (0o777, 0o757):
        (tmp_path / "open").chmod(mode)
        assert why_not_trusted(inside).startswith(f"{tmp_path / 'open'} can be written by other users")
        assert why_not_trusted(inside / "not" / "there") != ""
    (tmp_path / "open").chmod(0o1777)
    assert why_not_trusted(inside) == ""
    inside.chmod(0o1777)  # code in it could be another's
    assert why_not_trusted(inside).startswith(str(inside))
    (tmp_path / "link").symlink_to(inside)
    assert why_not_trusted(tmp_path / "link").startswith(str(inside))


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="only root can give a folder away")
def test_a_folder_of_another_user_is_not_trusted(tmp_path):
    """Whoever owns a folder can put anything into it."""
    os.chown(tmp_path, 65534, 65534)
    assert why_not_trusted(tmp_path / "inside") == f"{tmp_path} belongs to another user"


def folder_of(**environment):
    """Return the cache folder of a process with other variables, and what it says."""
    code = "from closedloop.jit.cache_folder import cache_folder; print(cache_folder())"
    known = {key: value for key, value in os.environ.items() if not key.startswith("NUMBA_")}
    done = subprocess.run(
        [sys.executable, "-c", code], env=known | environment, cwd=PACKAGE.parent, capture_output=True, text=True,
        check=True,
    )  # fmt: skip
    return Path(done.stdout.strip()), done.stderr


@unix
def test_the_run_goes_on_with_a_folder_of_its_own(tmp_path):
    """One line says why the folder that was named is not used; the user's own is, wherever the package lies."""
    (tmp_path / "open").mkdir()
    (tmp_path / "open").chmod(0o777)
    own = tmp_path / "own"
    folder, said = folder_of(NUMBA_CACHE_DIR=str(tmp_path / "open"), XDG_CACHE_HOME=str(own))
    assert folder.parent == own
    (line,) = said.splitlines()
    assert line.startswith(f"compiled code in {tmp_path / 'open'} is not used: ")
    assert folder_of(XDG_CACHE_HOME=str(own)) == (folder, "")


@pytest.mark.slow
def test_code_for_another_processor_is_kept_apart(tmp_path):
    """And that of other settings of the compiler."""
    ways = (
        {},
        {"NUMBA_CPU_NAME": "generic"},
        {"NUMBA_BOUNDSCHECK": "1"},
        {"NUMBA_SLP_VECTORIZE": "1"},
        {"NUMBA_OPT": "1"},
    )
    names = [folder_of(NUMBA_CACHE_DIR=str(tmp_path), **way)[0].name for way in ways]
    assert len(set(names)) == len(ways)
