"""What numba says of a user's function that it cannot compile, in one line: place, what is wrong, what is right."""

from __future__ import annotations

import difflib
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

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

    Parameters
    ----------
    error : exception
        What numba raised.
    files : sequence of str
        The user's files, in which the line is looked for.
    known : mapping of str to sequence of str
        Names of types, and of what they have, for "did you mean".
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
