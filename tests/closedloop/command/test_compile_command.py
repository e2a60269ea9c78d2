"""``closedloop compile``: all that ships, and nothing that is not there."""

import importlib
import os
import pkgutil
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from budget import FULL

import closedloop
from closedloop.__main__ import main
from closedloop.command import compile_all
from closedloop.command.compile_all import pieces
from closedloop.control.law import COMPENSATIONS, LAWS
from closedloop.jit.cache_folder import cache_folder
from closedloop.jit.inside.compile_cache import KernelCache
from closedloop.mechanics.friction.law import JOINT_LAWS, SURFACE_LAWS
from closedloop.mechanics.surface.motion import MOTIONS
from closedloop.mechanics.surface.surface import COMPLIANCES, SURFACES

ROOT = Path(closedloop.__file__).parent.parent


def kept_kernels():
    """Return the names of all functions of the package that are kept on disk."""
    found = set()
    for module in pkgutil.walk_packages(closedloop.__path__, "closedloop."):
        if not module.name.endswith("__main__"):
            values = vars(importlib.import_module(module.name)).values()
            found |= {x.__name__ for x in values if isinstance(getattr(x, "_cache", None), KernelCache)}
    return found


def test_every_kernel_that_is_kept_is_compiled():
    """One that is added to the package and not to the command would be compiled by the user's run."""
    named = [piece.kernel for piece in pieces()]
    of_duals = {"run_at", "run_varied_at", "measure_at"}  # compiled in another form, by who asks for it
    entries = [name for name in named if name.startswith("entry_of_")]  # of the plug-ins, in no module's names
    assert set(named) - set(entries) == kept_kernels() - of_duals
    assert len(kept_kernels() - of_duals) == len(named) - len(entries)
    families = LAWS, COMPENSATIONS, JOINT_LAWS, SURFACES, MOTIONS, *2 * (SURFACE_LAWS, COMPLIANCES)  # of tip and links
    # none has no friction, of surface (twice) and joints, no motion and (twice) no compliance
    assert len(entries) == sum(map(len, families)) - 6


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["compile", "wam_slide"], "unrecognized arguments: wam_slide"),
        (["compile", "--fast"], "--fast"),
        (["compile", "--workers", "0"], "--workers 0: must be at least 1, and at most 8"),
        (["compile", "--workers", "many"], "--workers"),
    ],
)
def test_bad_arguments(arguments, said, capsys):
    """Exit status 2 and one line."""
    assert main(arguments) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("closedloop: ")
    assert said in line


def test_what_a_piece_comes_after_is_there():
    """It is the kernel of a piece before it in the list: no two wait for each other."""
    before = {""}
    for piece in pieces():
        assert piece.after in before
        before.add(piece.kernel)


def test_a_process_that_is_killed(monkeypatch, capsys):
    """One line says so, and what may help."""
    monkeypatch.setattr(compile_all, "_compile_piece", os._exit)
    assert main(["compile", "--workers", "1"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("closedloop: a process that compiles was ended from outside")


def test_help(capsys):
    """It says what it does."""
    assert main(["compile", "--help"]) == 0
    assert "Compile everything that ships" in capsys.readouterr().out


def test_where_nothing_can_be_kept(monkeypatch, capsys):
    """It would be for nothing: exit status 2 and the reason."""
    monkeypatch.setattr("closedloop.command.compile_all.why_not_kept", lambda: "/some/folder: Read-only file system")
    assert main(["compile"]) == 2
    assert capsys.readouterr().err == (
        "closedloop: compiled code cannot be kept: /some/folder: Read-only file system\n"
    )


def test_without_a_compiler():
    """With NUMBA_DISABLE_JIT there is nothing to compile."""
    done = subprocess.run(
        [sys.executable, "-m", "closedloop", "compile"], cwd=ROOT, env=os.environ | {"NUMBA_DISABLE_JIT": "1"},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == "closedloop: NUMBA_DISABLE_JIT is set: there is nothing to compile\n"


# Asks each piece for what it compiles, and notes what it has asked the cache for so far.
ASKED = """
from closedloop.command.compile_all import pieces
from closedloop.jit.inside.compile_cache import KernelCache
asked, load = set(), KernelCache.load_overload
def noted(self, *rest):
    asked.add(self._function.__name__)
    return load(self, *rest)
KernelCache.load_overload = noted
for piece in pieces():
    piece.compile()
    print(piece.kernel, piece.kernel in asked)
"""


@pytest.fixture(scope="module")
def asked():
    """Return what ASKED says; afterwards everything is kept."""
    return subprocess.run([sys.executable, "-c", ASKED], cwd=ROOT, capture_output=True, text=True, check=True).stdout


@pytest.mark.slow
def test_every_piece_compiles_its_kernel(asked):
    """What a piece does asks for the kernel that it names: one that is not kept is compiled by it."""
    assert asked.splitlines() == [f"{piece.kernel} True" for piece in pieces()]


@pytest.mark.slow
def test_all_is_there_afterwards(tmp_path, asked):
    """A line for each piece and one for all, and a file of code for each kernel; what is kept is not compiled again.

    From a cache in which Coulomb's friction of surfaces is missing; with the full budget from none, and once again.
    """
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}

    def kept():
        (folder,) = tmp_path.iterdir()
        return {file.name: file.stat().st_mtime_ns for file in folder.glob("*.nbc")}

    before = {}
    if not FULL:
        shutil.copytree(cache_folder(), tmp_path / cache_folder().name)
        missing = list(tmp_path.rglob("entries.entry_of_surface_SurfaceCoulomb*.nbc"))
        assert len(missing) >= 2
        for file in missing:
            file.unlink()
        before = kept()

    def compile_all():
        return subprocess.run(
            [sys.executable, "-m", "closedloop", "compile"], cwd=ROOT, env=environment, capture_output=True, text=True,
            check=True, timeout=900,
        )  # fmt: skip

    first = compile_all()
    assert first.stderr == ""
    assert len(first.stdout.splitlines()) == len(pieces()) + 1
    files = kept()
    for piece in pieces():
        assert any(f".{piece.kernel}-" in name for name in files), piece
    assert before.items() <= files.items()
    if FULL:
        compile_all()
        assert kept() == files
