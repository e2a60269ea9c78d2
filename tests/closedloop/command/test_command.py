"""The border of all commands: statuses, one line, and text for an output that lacks characters."""

import io
import os
import sys

import pytest

from closedloop.base.errors import ClusterError, ScenarioError, SimulationError
from closedloop.command.border import Parser, run_command


def raising(error):
    """Return a command that raises."""

    def main(words):
        raise error

    return main


@pytest.mark.parametrize(
    ("error", "status", "line"),
    [
        (ScenarioError("law.force: 'ten'"), 2, "law.force: 'ten'"),
        (ScenarioError("two\nlines"), 2, r"two\nlines"),
        (SimulationError("stopped at t = 1 s", 1.0), 3, "stopped at t = 1 s"),
        (ClusterError("lost"), 3, "lost"),
        (KeyboardInterrupt(), 130, "interrupted"),
        (MemoryError(), 2, "out of memory: ask for fewer steps, runs or columns"),
        (PermissionError(13, "Permission denied", "/there"), 2, "'/there': Permission denied"),
        (OSError("no reason"), 2, "no reason"),
        (SystemExit(0), 2, "something that was run, such as a law, called sys.exit(0)"),
    ],
    ids=lambda x: type(x).__name__,
)
def test_status_and_line(error, status, line, capsys):
    """Each error has its status and one line; a law that calls sys.exit(0) is no success."""
    assert run_command("closedloop", raising(error), []) == status
    assert capsys.readouterr().err == f"closedloop: {line}\n"


def test_a_fault_of_ours_is_not_hidden():
    """What is no error of the input or the surroundings keeps its traceback."""
    with pytest.raises(ZeroDivisionError):
        run_command("closedloop", raising(ZeroDivisionError()), [])


def test_arguments_of_a_parser(capsys):
    """--help ends with status 0, an unknown option with 2 and the cure."""
    parser = Parser(prog="x", cure="see --help")

    def main(words):
        parser.parse_args(words)
        return 7

    assert run_command("x", main, ["--help"]) == 0
    assert capsys.readouterr().out.startswith("usage: x")
    assert run_command("x", main, ["--nosuch"]) == 2
    assert capsys.readouterr().err == "x: command line: unrecognized arguments: --nosuch; see --help\n"
    assert run_command("x", main, []) == 7


def test_surroundings_are_as_before(monkeypatch):
    """A command run from Python leaves its output, its warnings and its environment as they were."""
    monkeypatch.setenv("MPLBACKEND", "nosuch")
    before = sys.stdout, sys.stderr
    assert run_command("x", lambda words: 0 if os.environ["MPLBACKEND"] == "agg" else 1, []) == 0
    assert os.environ["MPLBACKEND"] == "nosuch"
    assert (sys.stdout, sys.stderr) == before
    monkeypatch.delenv("MPLBACKEND")
    assert run_command("x", lambda words: 0, []) == 0
    assert "MPLBACKEND" not in os.environ


def test_output_that_no_one_takes(monkeypatch, capsys):
    """A reader who has gone is no error, and Python does not complain of what is left as it ends."""
    reader, writer = os.pipe()
    os.close(reader)
    with open(writer, "w", encoding="ascii") as stream:
        monkeypatch.setattr(sys, "stdout", stream)
        assert run_command("x", lambda words: print("ζ") or 0, []) == 0
        assert run_command("x", lambda words: print("x" * 100_000, flush=True) or 0, []) == 0  # to nowhere by now
    assert capsys.readouterr().err == ""


def test_a_character_that_is_lacking_is_printed_as_its_code(monkeypatch):
    """A code page of Windows keeps its own characters."""
    stream = io.TextIOWrapper(io.BytesIO(), encoding="cp1252")
    monkeypatch.setattr(sys, "stdout", stream)
    assert run_command("x", lambda words: print("m/s² ζ é") or 0, []) == 0
    assert stream.buffer.getvalue().decode("cp1252") == "m/s² \\u03b6 é\n"
