"""``python -m`` and the folder one is in: what lies there takes the place of nothing, and a checkout stays."""

import sys
from pathlib import Path

import pytest

import closedloop as cl
from closedloop.command.current_folder import leave_out_current_folder

FILE = cl.__file__
CHECKOUT = Path(FILE).parent.parent


@pytest.fixture
def started(monkeypatch, tmp_path):
    """Return a function that pretends that Python was started with these words, and returns its path afterwards."""

    def start(*words, here=tmp_path, path=None, arguments=1):
        if path is None:
            monkeypatch.chdir(here)
        monkeypatch.setattr(sys, "path", [str(here) if path is None else path, "/elsewhere"])
        monkeypatch.setattr(sys, "orig_argv", ["python", *words])
        monkeypatch.setattr(sys, "argv", ["-m", *words[len(words) - arguments + 1 :]] if arguments else ["script.py"])
        leave_out_current_folder(FILE)
        return sys.path

    return start


@pytest.mark.parametrize(
    ("words", "arguments"),
    [
        (("-m", "closedloop.run"), 1),
        (("-m", "closedloop.run", "wam_slide", "--json"), 3),
        (("-W", "error", "-m", "closedloop.command.sweep", "plot"), 2),
        (("-X", "dev", "-umvalidation.studies", "drift"), 2),
        (("-mvalidation.run",), 1),
    ],
)
def test_a_command_of_ours_leaves_it_out(words, arguments, started):
    """However Python is asked to run one of our commands, the folder is no place to find modules."""
    assert started(*words, arguments=arguments) == ["/elsewhere"]


@pytest.mark.parametrize("module", ["mine.main", "closed.run", "pytest", "mclosedloop"])
def test_a_program_that_uses_the_package_keeps_it(module, started, tmp_path):
    """A program of the user's that imports the package finds its own modules."""
    assert started("-m", module) == [str(tmp_path), "/elsewhere"]


def test_what_else_keeps_it(started, tmp_path):
    """So does a script, and a first entry that is another folder."""
    assert started("script.py", arguments=0) == [str(tmp_path), "/elsewhere"]
    assert started("-m", "closedloop.run", path="/another") == ["/another", "/elsewhere"]


def test_a_checkout_stays(started):
    """In the folder that the package itself came from nothing changes."""
    assert started("-m", "closedloop.run", here=CHECKOUT) == [str(CHECKOUT), "/elsewhere"]


def test_a_deleted_folder(started, monkeypatch):
    """A folder that is not there any more is left out, too."""

    def gone():
        raise FileNotFoundError

    with monkeypatch.context() as here:
        here.setattr("closedloop.command.current_folder.os.getcwd", gone)
        assert started("-m", "closedloop.run", path="") == ["/elsewhere"]
