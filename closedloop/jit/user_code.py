"""Users' code: the line at which it failed, and a digest of its text."""

from __future__ import annotations

import hashlib
import inspect
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from traceback import extract_tb
from typing import Any, cast

from closedloop.base.errors import ClosedLoopError, ScenarioError, one_line
from closedloop.base.families import Member, is_users
from closedloop.jit.calls import Entry
from closedloop.jit.compiler_words import why_not_compiled
from closedloop.jit.kernel import entry_kernel, jit_disabled, kernel, kernel_of


@contextmanager
def of_users(member: Member | type[Member], key: str) -> Iterator[None]:
    """Turn an exception in a user's member into a one-line error that names file and line.

    Raises
    ------
    ScenarioError
        With what was raised as its cause. An error of this package, and that of a member which ships, is raised as it
        is.
    """
    try:
        yield
    except ClosedLoopError:
        raise
    except Exception as error:
        if not is_users(member):
            raise
        own = (member if isinstance(member, type) else type(member)).__module__
        file = getattr(sys.modules.get(own), "__file__", None)
        frames = extract_tb(error.__traceback__)
        place = next((frame for frame in reversed(frames) if frame.filename == file), frames[-1])
        what = one_line(f"{type(error).__name__}: {error}" if str(error) else type(error).__name__)
        where = f"{Path(place.filename).name}:{place.lineno}"
        raise ScenarioError(f"{key} = {member.member_name()}: {where}: {what}") from error


def why_member_not_compiled(error: Exception, member: type[Member], known: Mapping[str, Sequence[str]]) -> str:
    """Return what numba cannot compile of a user's class; see `closedloop.jit.compiler_words.why_not_compiled`."""
    files = [getattr(sys.modules.get(each.__module__), "__file__", None) for each in member.__mro__ if _is_own(each)]
    files += [getattr(code, "co_filename", None) for code in map(_code, vars(member).values())]  # a notebook's cell
    return why_not_compiled(error, [file for file in files if file], known)


def _is_own(each: type[Any]) -> bool:
    """Whether a class is a user's, and not one of this package's or of a library's that all members share."""
    return issubclass(each, Member) and each.__module__.partition(".")[0] != __name__.partition(".")[0]


def _code(value: Any) -> Any:
    function = getattr(value, "__func__", value)
    return getattr(getattr(function, "py_func", function), "__code__", None)


def source_digest(what: Any) -> str:
    """Return the SHA-256 of the text that a function or a class is defined in, "" where there is none to be had.

    That is its module, so that the functions it calls there count too; in a notebook or a console its own text.
    """
    text = _source(what)
    return hashlib.sha256(text.encode("utf-8", "surrogatepass")).hexdigest() if text else ""


def _source(what: Any) -> str:
    for place in (sys.modules.get(getattr(what, "__module__", None) or "__main__"), what):
        file = getattr(place, "__file__", None)
        if file and str(file).endswith(".py"):
            try:
                return Path(file).read_text(encoding="utf-8", errors="surrogateescape")
            except OSError:
                continue
    try:
        return inspect.getsource(what)
    except (OSError, TypeError):
        return ""


def identity_of(member: type[Any]) -> str:
    """Return what tells the compiled form of a member from others: its name, and the text of all its classes."""
    bases = [each for each in member.__mro__ if issubclass(each, Member) and each is not Member]
    texts = dict.fromkeys(source_digest(each) for each in bases)
    return " ".join([f"{member.__module__}:{member.__qualname__}", *texts])


# What an entry returns whose member has raised something.
RAISED = -1


def function_of(member: type[Member], name: str) -> Callable[..., Any]:
    """Return a function of a member as a kernel; in a user's, indices are checked."""
    return kernel_of(cast(Any, member), name, checked=is_users(member))


def member_entry(entry: Entry, member: type[Member], mark: Callable[[int], None] | None = None) -> Entry:
    """Return an entry that calls a member's functions, compiled when it is first needed.

    Compiled code that was called by address can raise nothing: numba would print the exception, and the caller go on.
    So the entry of a user's member catches what is raised, calls `mark` with the address, and returns RAISED.
    """
    identity = identity_of(member)
    if jit_disabled() or not is_users(member):
        return entry_kernel(entry, identity=identity)
    inner, note = kernel(entry), kernel(_unmarked) if mark is None else mark

    def guarded(address: int, what: int) -> int:
        answer = RAISED
        try:
            answer = inner(address, what)
        except Exception:
            note(address)
        return answer

    guarded.__name__ = guarded.__qualname__ = entry.__name__
    made: Any = entry_kernel(guarded, identity=identity)
    made.unguarded = inner
    return cast(Entry, made)


def _unmarked(address: int) -> None:
    """Note nothing."""
