"""The errors of the package.

Every message says what was wrong, where, and what would be right, on one line; only a `ScenarioError` may have several,
one for each fault. The command line turns `ScenarioError` and `ModelError` into exit status 2 and `SimulationError`
into exit status 3.

`EXTRAS` are packages that a run does not need, and the extras of this package that install them.
"""

from importlib.util import find_spec
from typing import Any

from robot_models.errors import ClosedLoopError as ClosedLoopError
from robot_models.errors import ModelError as ModelError

# Characters of a message that are shown; a name in it may be of any length.
LONGEST_LINE = 900


def printable(text: str) -> str:
    """Return a text with what cannot be printed, line breaks above all, written as Python spells it."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text)


def one_line(message: str) -> str:
    """Return the message on one line of printable characters, without the middle of a very long one.

    Names in it may be arbitrary text. A message begins with what was wrong and ends with what would be right.
    """
    line = printable(message)
    half = LONGEST_LINE // 2
    return line if len(line) <= LONGEST_LINE else f"{line[:half]} ... {line[-half:]}"


class ScenarioError(ClosedLoopError, ValueError):
    """The scenario is at fault: an unknown key, a wrong type, a value out of range.

    Its text has a line for each fault. Where there is room for one line only, `faults_on_one_line` makes it.

    Parameters
    ----------
    *faults : str
        What is wrong, where, and what would be right, one argument for each fault.
    """

    def __init__(self, *faults: str) -> None:
        super().__init__(*faults)

    @property
    def faults(self) -> tuple[str, ...]:
        """What is wrong, one text for each fault."""
        return self.args

    def __str__(self) -> str:
        return "\n".join(self.faults)


def lines_of(error: BaseException) -> tuple[str, ...]:
    """Return what an error says, a text for each fault; none if it says nothing."""
    said = error.faults if isinstance(error, ScenarioError) else (str(error),)
    return tuple(text for text in said if text)


def faults_on_one_line(error: BaseException) -> str:
    """Return what an error says without line breaks, for a cell of a table."""
    return "; ".join(map(one_line, lines_of(error)))


class RunFileError(ClosedLoopError, ValueError):
    """A file is not a run of this package, or is damaged."""


class OutputError(ClosedLoopError, OSError):
    """The results cannot be written to the given path."""


class ClusterError(ClosedLoopError, OSError):
    """The connection to a cluster was lost during a sweep."""


class SimulationError(ClosedLoopError):
    """The simulation could not go on.

    Attributes
    ----------
    time : float
        The instant at which it stopped, s.
    run : Run or None
        Everything that was simulated until then.
    """

    def __init__(self, message: str, time: float, run: Any = None) -> None:
        super().__init__(message)
        self.time = time
        self.run = run

    def __reduce__(self) -> tuple[Any, ...]:
        # An exception is otherwise made anew from its message alone, which fails where a pool hands it over, and the
        # pool waits for ever.
        return type(self), (*self.args, self.time, self.run), dict(self.__dict__)


class SingularClosureError(SimulationError):
    """Eq. 24 has no reliable solution: the tip cannot move along the surface normal."""


class DivergenceError(SimulationError):
    """The state grew beyond all bounds or stopped being a number."""


class ChatterError(SimulationError):
    """The contact changes its mode again and again at one instant."""


class PainleveError(SimulationError):
    """Friction admits no rigid contact force (Painlevé's paradox): a larger f accelerates the tip into the surface."""


class NoNormalError(SimulationError):
    """The surface has no normal where the tip is: the gradient of its φ vanishes there."""


class LawError(SimulationError):
    """A user's law raised an exception, which is the cause, or returned something that is not a torque."""


class InterruptedRunError(SimulationError, KeyboardInterrupt):
    """Ctrl-C, or another signal that raises KeyboardInterrupt, came while the simulation ran."""


# By the name that Python imports: what the package is for, and its extra.
EXTRAS = {
    "pyarrow": ("tables of runs", "tables"),
    "pandas": ("data frames", "tables"),
    "xarray": ("datasets of xarray", "tables"),
}


def needs(*packages: str) -> None:
    """Refuse what needs packages that are not installed."""
    for package in packages:
        if find_spec(package) is None:
            raise ScenarioError(_line(package))


def not_installed(error: BaseException) -> str:
    """Return the line for an import that failed for want of one of `EXTRAS`, "" for any other error."""
    package = (error.name or "").partition(".")[0] if isinstance(error, ModuleNotFoundError) else ""
    return _line(package) if package in EXTRAS else ""


def missing_line(what: str, package: str, extra: str) -> str:
    """Return the line that something needs a package, and how to install it: `what` ends with its verb."""
    return f'{what} {package}, which is not installed: pip install "closedloop[{extra}]"'


def _line(package: str) -> str:
    what, extra = EXTRAS[package]
    return missing_line(f"{what} need", package, extra)
