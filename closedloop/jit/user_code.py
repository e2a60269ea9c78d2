"""A user's code in kernels: the line at which it failed, a digest of its text, and in a line what numba says of it."""

import difflib
import hashlib
import inspect
import os
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from traceback import extract_tb
from typing import Any, cast

from closedloop.base.errors import ClosedLoopError, ScenarioError, one_line
from closedloop.base.families import Member, is_users
from closedloop.jit.calls import Entry
from closedloop.jit.kernel import entry_kernel, jit_disabled, kernel, kernel_of

# Where a line of numba's message says that it is: 'File "laws.py", line 7', or 'at /home/me/laws.py (7)'.
_PLACE = re.compile(r'File "(?P<file>[^"\n]+)", line (?P<line>\d+)|\bat (?P<at>[^\n"]+?) \((?P<row>\d+)\)')
_HEADS = ("Failed in", "-", "No implementation", "There are", "During", "File ", "Overload", "Rejected", "With arg")
_ALLOCATES = ("_ol_array_allocate", "NRT required", "allocate")
_ATTRIBUTE = re.compile(r"Unknown attribute '(\w+)' of type ([\w.<>]+)")
_ARGUMENTS = re.compile(r"signature '\((.*?)\)' due to")
# What compiled code is passed, by the end of its type's name: what users call it, and where it is said what it has.
_FIELDS = "par (the fields of the class)"
_PASSED = {
    "LawInput": "x", "Slip": "x", "Terms": "terms", "Parameters": _FIELDS, "OneJoint": _FIELDS,
    "States": "z or dz (the names in `states`)",
}  # fmt: skip
LONGEST = 200


def why_not_compiled(
    error: BaseException, files: Sequence[str] = (), known: Mapping[str, Sequence[str]] | None = None
) -> str:
    """Return what numba cannot do with a user's function, and in which line of whose file, on one line.

    `error`: what numba raised.
    `files`: the user's files, in which the line is looked for.
    `known`: names of types, and of what they have, for "did you mean".
    """
    text = re.sub(r"\x1b\[[0-9;]*m", "", str(error))  # numba colours its words on a terminal
    return _place(text, error, files) + _what(text, error, known or {})


def _place(text: str, error: BaseException, files: Sequence[str]) -> str:
    """Return "file:line: " of the innermost place in a user's file, else "" if none is named."""
    found = [(m["file"] or m["at"], m["line"] or m["row"]) for m in _PLACE.finditer(text)]
    loc = getattr(error, "loc", None)
    if loc is not None:
        found.append((loc.filename, loc.line))
    wanted = {os.path.realpath(file) for file in files}
    for file, line in found:
        if os.path.realpath(file) in wanted:
            return f"{Path(file).name}:{line}: "
    return ""


def _what(text: str, error: BaseException, known: Mapping[str, Sequence[str]]) -> str:
    """Return what is wrong and what would be right."""
    if "setitem(readonly" in text or "Cannot modify readonly" in text:
        return "it writes into q, v, x or terms, which are there to be read: write into an array of its own"
    if any(word in text for word in _ALLOCATES):
        return (
            "the expression makes an array of its own, which is not possible here: write into the given arrays, one "
            "number at a time in a loop, as torque[j] = x.C[j] - ..."
        )
    if found := _ATTRIBUTE.search(text):
        name, kind = found[1], found[2].rpartition(".")[2]
        near = difflib.get_close_matches(name, known.get(kind, ()), n=1, cutoff=0.5)
        fields = known.get(kind)
        hint = f"; did you mean '{near[0]}'?" if near else f"; it has {', '.join(fields)}" if fields else ""
        return f"{_PASSED.get(kind, kind)} has no '{name}'{hint}"
    if found := re.search(r"unsupported NumPy function '([\w.]+)'", text):
        return f"numba has no {found[1]}, or not in this form; write it as a loop"
    if found := re.search(r"No implementation of function Function\(<[\w-]+ (?:function )?'?([\w.]+)", text):
        return f"numba has no '{found[1]}' of these arguments: {_arguments_of(text, found[1])}"
    if found := re.search(r"NameError: name '(\w+)' is not defined|[Uu]ntyped global name '(\w+)'", text):
        return (
            f"'{found[1] or found[2]}' cannot be used in compiled code: take a number, an array or a compiled function"
        )
    lines = [line.strip() for line in text.splitlines()]
    told = next((line for line in lines if line and not line.startswith(_HEADS)), "")
    told = re.sub(r"(\w+)\((?:[^()]|\([^()]*\))*(array|float64)(?:[^()]|\([^()]*\))*\)", r"\1(...)", told)
    said = told[:LONGEST] + ("..." if len(told) > LONGEST else "")
    return said if hasattr(error, "loc") else f"{type(error).__name__}: {said}" if said else type(error).__name__


def _arguments_of(text: str, name: str) -> str:
    """Return the types of a call's arguments as numba lists them, arrays by their number of dimensions."""
    found = re.search(rf">>> {re.escape(name)}\((.*)\)\s*$", text, re.MULTILINE)
    types = re.sub(r"(?:readonly )?array\(\w+, (\d)d, \w\)", r"array of \1 dimensions", found[1] if found else "")
    types = (
        types.replace("array of 1 dimensions", "array").replace("float64", "number").replace("int64", "whole number")
    )
    return re.sub(r"Literal\[\w+\]\(([^()]*)\)", r"\1", types)[:LONGEST]


class of_users:  # a context; a class takes a fifth of the time of a function, and a start has several
    """Turn an exception in a user's member into a one-line error that names file and line.

    Raises ScenarioError: with what was raised as its cause. An error of this package, and that of a member which ships,
        is raised as it is.
    """

    __slots__ = ("_key", "_member")

    def __init__(self, member: Member | type[Member], key: str) -> None:
        self._member, self._key = member, key

    def __enter__(self) -> None:
        return None

    def __exit__(self, kind: Any, error: BaseException | None, trace: Any) -> None:
        if not isinstance(error, Exception) or isinstance(error, ClosedLoopError) or not is_users(self._member):
            return
        own = (self._member if isinstance(self._member, type) else type(self._member)).__module__
        file = getattr(sys.modules.get(own), "__file__", None)
        frames = extract_tb(error.__traceback__)
        place = next((frame for frame in reversed(frames) if frame.filename == file), frames[-1])
        what = one_line(f"{type(error).__name__}: {error}" if str(error) else type(error).__name__)
        where = f"{Path(place.filename).name}:{place.lineno}"
        raise ScenarioError(f"{self._key} = {self._member.member_name()}: {where}: {what}") from error


def why_member_not_compiled(error: Exception, member: type[Member], known: Mapping[str, Sequence[str]]) -> str:
    """Return what numba cannot compile of a user's class; see `closedloop.jit.user_code.why_not_compiled`."""
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
