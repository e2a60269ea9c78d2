"""The root of the project's errors, the one that this package raises, and warnings of other libraries."""

import reprlib
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager

# What shows warnings, and which, is one for the whole process; so is the function that MuJoCo tells its own.
_hearing = threading.Lock()


class ClosedLoopError(Exception):
    """Base class of every error that the project raises on purpose."""


# Characters of a message. Long enough for two paths and a list of names.
_LONG = 600


class ModelError(ClosedLoopError, ValueError):
    """A robot model is wrong, or the request for one.

    The text is one line: what is wrong, where (link or joint, and file), and what would be right. If it quotes a very
    long text, the middle of the quotation is left out.
    """

    def __init__(self, text: str) -> None:
        super().__init__(text if len(text) <= _LONG else f"{text[: _LONG - 200]} … {text[-150:]}")


def shown(value: object) -> str:
    """Return a value from a file as a message shows it: a line of a few words, however large the value is."""
    try:
        return reprlib.repr(value)
    except ValueError:  # Python writes out no whole number of more than some thousand digits
        return "a number of thousands of digits"


def some(names: list[str]) -> str:
    """Return four names of a list at most, and how many more there are."""
    return ", ".join(names[:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else "")


@contextmanager
def warnings_heard() -> Iterator[list[warnings.WarningMessage]]:
    """Collect what Python's libraries warn of within the block, which one thread at a time goes through."""
    with _hearing, warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        yield heard
