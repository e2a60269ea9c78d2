"""Faults planted in a module, one at a time: which of them do its tests see?

    python -m tests.mutate --module closedloop.mechanics.closure.contact_force --limit 40 --seed 0

A mutant is the module with one small change: + for −, < for ≤, a constant of the other sign, `and` for `or`, a term
left out, min for max, an index off by one, a statement left out. Each is put into a copy of the tree, and the tests
that `mutate.toml` names run on it, interpreted (NUMBA_DISABLE_JIT=1): a mutant is killed if one fails, or if they take
much longer than without it. Survivors are printed with their line: a hole in the tests, or a change that changes
nothing.

Every mutant runs in a process forked from one in which the packages are imported already, so that it costs little more
than its tests.
"""

import argparse
import ast
import copy
import os
import random
import shutil
import sys
import tempfile
import time
import tomllib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
COPIED = ("closedloop", "robot_models", "validation", "tests", "docs", "pyproject.toml", "README.md", "CONTRIBUTING.md")
HEAVY = ("numpy", "scipy.linalg", "numba", "pinocchio", "hypothesis", "pytest", "pydantic", "xarray", "yourdfpy")
OURS = ("closedloop", "robot_models", "validation", "tests", "conftest")

WHERE = {file.name: str(file.relative_to(ROOT)) for file in (ROOT / "tests").rglob("test_*.py")}

# The quick tests that hold each module.
TESTS: dict[str, tuple[str, ...]] = {
    module: tuple(WHERE[name.split("::")[0]] + name[name.find("::") :] * ("::" in name) for name in names)
    for module, names in tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8")).items()
}

ARITHMETIC = {ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult}
COMPARISONS = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
}  # fmt: skip
NAMES = {"min": "max", "max": "min", "sin": "cos", "cos": "sin", "floor": "ceil", "LOW": "HIGH", "HIGH": "LOW"}


class Mutant(NamedTuple):
    """One change.

    Attributes
    ----------
    line : int
        Where, in the module as it is.
    change : str
        What, in words.
    text : str
        The whole module with it.
    """

    line: int
    change: str
    text: str


def mutants(source: str) -> Iterator[Mutant]:
    """Yield every mutant of a module: of what stands in its functions, but for annotations, decorators and messages."""
    tree = ast.parse(source)
    for function in [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]:
        for node in _inside(function):
            for change, replacement in _changes(node):
                yield Mutant(getattr(node, "lineno", function.lineno), change, _with(tree, node, replacement))


def _inside(function: ast.FunctionDef) -> Iterator[ast.AST]:
    """Yield the nodes of a function's body that say what it does; nested functions come by themselves."""
    waiting: list[ast.AST] = list(function.body)
    while waiting:
        node = waiting.pop(0)
        if isinstance(node, (ast.Raise, ast.Assert, ast.FunctionDef, ast.Import, ast.ImportFrom, ast.JoinedStr)):
            continue
        yield node
        if isinstance(node, ast.AnnAssign):
            waiting += [node.target] + ([node.value] if node.value else [])
        else:
            waiting += ast.iter_child_nodes(node)


def _changes(node: ast.AST) -> Iterator[tuple[str, ast.AST]]:
    """Yield what a node may be replaced by, and that in words."""
    text = ast.unparse(node) if isinstance(node, (ast.expr, ast.stmt)) else ""
    short = text.splitlines()[0][:60] if text else ""
    match node:
        case ast.BinOp(left=left, op=op) | ast.AugAssign(target=left, op=op):
            if type(op) in ARITHMETIC:
                yield (
                    f"{type(op).__name__} -> {ARITHMETIC[type(op)].__name__} in {short}",
                    _set(node, op=ARITHMETIC[type(op)]()),
                )
            if isinstance(node, ast.BinOp) and isinstance(op, (ast.Add, ast.Sub)):
                yield f"last term left out of {short}", left
        case ast.Compare(ops=[op, *_]) if type(op) in COMPARISONS:
            other = COMPARISONS[type(op)]
            yield f"{type(op).__name__} -> {other.__name__} in {short}", _set(node, ops=[other(), *node.ops[1:]])
        case ast.BoolOp(op=op):
            other_op = ast.Or() if isinstance(op, ast.And) else ast.And()
            yield f"and <-> or in {short}", _set(node, op=other_op)
        case ast.UnaryOp(op=ast.USub() | ast.Not(), operand=operand):
            yield f"sign or not left out of {short}", operand
        case ast.Constant(value=float(value)):
            yield f"{short} -> {-value if value else 1.0}", ast.Constant(-value if value else 1.0)
        case ast.Subscript(slice=ast.Constant(value=int(index))):
            yield f"index of {short} off by one", _set(node, slice=ast.Constant(index - 1 if index else 1))
        case ast.Name(id=name, ctx=ast.Load()) if name in NAMES:
            yield f"{name} -> {NAMES[name]}", ast.Name(NAMES[name], ast.Load())
        case ast.Attribute(attr=name) if name in NAMES:
            yield f"{name} -> {NAMES[name]} in {short}", _set(node, attr=NAMES[name])
        case ast.Assign() | ast.AugAssign() | ast.Expr(value=ast.Call()):
            yield f"left out: {short}", ast.Pass()
        case _:
            pass
    if isinstance(node, ast.AugAssign):
        yield f"left out: {short}", ast.Pass()


def _set(node: ast.AST, **fields: object) -> ast.AST:
    changed = copy.copy(node)
    for name, value in fields.items():
        setattr(changed, name, value)
    return changed


def _with(tree: ast.Module, node: ast.AST, replacement: ast.AST) -> str:
    """Return the text of the module in which one node is replaced."""

    class Replace(ast.NodeTransformer):
        def visit(self, here: ast.AST) -> ast.AST:
            return replacement if here is node else self.generic_visit(_set(here, **_lists(here)))

    return ast.unparse(ast.fix_missing_locations(Replace().visit(tree)))


def _lists(node: ast.AST) -> dict[str, list[object]]:
    """Return copies of a node's lists: the transformer writes into them."""
    return {name: list(value) for name, value in ast.iter_fields(node) if isinstance(value, list)}


def sample(source: str, limit: int, seed: int) -> list[Mutant]:
    """Return so many of a module's mutants, drawn evenly, in order of their lines."""
    different = {mutant.text: mutant for mutant in mutants(source) if mutant.text != ast.unparse(ast.parse(source))}
    found = list(different.values())
    return sorted(random.Random(seed).sample(found, min(limit, len(found))), key=lambda mutant: mutant.line)


def tests_fail(folder: Path, tests: Sequence[str], seconds: float) -> tuple[bool | None, float]:
    """Return whether one of the tests fails in a copy of the tree, None if they were ended, and how long they took."""
    began = time.monotonic()
    child = os.fork()
    if child == 0:
        _run_tests(folder, tests)
    while time.monotonic() - began < seconds:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status) != 0, time.monotonic() - began
        time.sleep(0.05)
    os.kill(child, 9)
    os.waitpid(child, 0)
    return None, time.monotonic() - began


def _run_tests(folder: Path, tests: Sequence[str]) -> None:
    """Run the tests of a folder in this process, quietly, and end it with pytest's exit status."""
    status = 1
    try:
        import pytest

        nothing = os.open(os.devnull, os.O_RDWR)
        for stream in (0, 1, 2):
            os.dup2(nothing, stream)
        os.chdir(folder)
        # What the caller has imported of its own tree is not what is measured.
        for name in [name for name in sys.modules if name.partition(".")[0] in OURS]:
            del sys.modules[name]
        sys.path[:] = [str(folder), *(path for path in sys.path if path not in ("", str(ROOT)))]
        options = ["-x", "-q", "-p", "no:cacheprovider", "-o", "addopts=", "-m", "not slow", "--import-mode=prepend"]
        status = int(pytest.main([*options, *tests]))
    finally:
        os._exit(status)


def measure(path: Path, tests: Sequence[str], limit: int, seed: int, root: Path = ROOT) -> tuple[int, list[Mutant]]:
    """Return how many of a module's mutants were killed, and those that survived; say how it goes on.

    Parameters
    ----------
    path : Path
        The module's file, inside `root`.
    tests : sequence of str
        What pytest is given.
    limit, seed : int
        How many mutants are drawn.
    root : Path
        The tree that is copied.

    Raises
    ------
    SystemExit
        If the tests fail without any mutant.
    """
    source, place = path.read_text(encoding="utf-8"), path.relative_to(root)
    killed, survivors = 0, []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for entry in COPIED:
            if (root / entry).is_dir():
                shutil.copytree(root / entry, folder / entry, ignore=shutil.ignore_patterns("__pycache__", "*.nbc"))
            elif (root / entry).exists():
                shutil.copy(root / entry, folder / entry)
        (folder / place).write_text(ast.unparse(ast.parse(source)), encoding="utf-8")
        fails, seconds = tests_fail(folder, tests, 1800.0)
        if fails is not False:
            raise SystemExit(f"{place}: the tests fail without any mutant: {' '.join(tests)}")
        print(f"{place}: the tests take {seconds:.1f} s: {' '.join(tests)}", flush=True)
        for mutant in sample(source, limit, seed):
            (folder / place).write_text(mutant.text, encoding="utf-8")
            fails, _ = tests_fail(folder, tests, 20.0 + 5.0 * seconds)
            killed += fails is not False
            survivors += [mutant] if fails is False else []
            verdict = {True: "killed", False: "SURVIVED", None: "killed (took too long)"}[fails]
            print(f"  {place}:{mutant.line}: {mutant.change}: {verdict}", flush=True)
    print(f"{place}: {killed} of {killed + len(survivors)} killed", flush=True)
    return killed, survivors


def main() -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(
        prog="tests.mutate", description="Plant faults in a module and see what sees them."
    )
    parser.add_argument("--module", action="append", choices=sorted(TESTS), required=True, help="once for each module")
    parser.add_argument("--limit", type=int, default=40, help="mutants of each (default 40)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--tests", nargs="*", help="other tests than those of the table")
    options = parser.parse_args()
    os.environ["NUMBA_DISABLE_JIT"] = "1"
    for name in HEAVY:
        __import__(name)
    scores = {}
    for module in options.module:
        path = ROOT / (module.replace(".", "/") + ".py")
        killed, survivors = measure(path, options.tests or TESTS[module], options.limit, options.seed)
        scores[module] = f"{killed} of {killed + len(survivors)}"
    print("\n".join(f"{module:32} {score}" for module, score in scores.items()))


if __name__ == "__main__":
    main()
