"""The map of equations on its page is true: what it names exists, and it leaves no equation out."""

import ast
import re
from importlib import import_module
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
ROW = re.compile(r"^\| (\d+)(?:-(\d+))? \|(.*)\|$", re.MULTILINE)
ROWS = ROW.findall((ROOT / "docs" / "equations.md").read_text(encoding="utf-8"))
PAPER = (ROOT / "closedloop" / "paper.py").read_text(encoding="utf-8").splitlines()
NAMES = [name for *_, rest in ROWS for name in re.findall(r"`([^`]+)`", rest)]


def test_every_equation_is_in_the_map():
    """Each of Eqs. 1 to 33 stands in exactly one row."""
    numbers = [n for first, last, _ in ROWS for n in range(int(first), int(last or first) + 1)]
    assert numbers == list(range(1, 34))


def test_every_function_in_the_map_exists():
    """Each dotted name of a row can be imported, and each row names one written by hand."""
    functions = [name for name in NAMES if "::" not in name]
    assert len(functions) > 33
    for name in functions:
        parts = name.split(".")
        for cut in range(len(parts) - 1, 0, -1):
            try:
                found = import_module(".".join(parts[:cut]))
            except ModuleNotFoundError:
                continue
            for attribute in parts[cut:]:
                found = getattr(found, attribute)
            break
        else:
            raise AssertionError(f"{name} cannot be imported")
    assert all("validation.oracle." in rest for *_, rest in ROWS)


def test_every_test_in_the_map_exists():
    """Each test of a row is a function in the file that the row names, and each row has one."""
    assert all("::" in rest for *_, rest in ROWS)
    for name in (name for name in NAMES if "::" in name):
        file, function = name.split("::")
        tree = ast.parse((ROOT / file).read_text(encoding="utf-8"))
        assert function in {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}, name


def test_lines_of_the_paper():
    """The lines of `paper.py` that a row names name its equations, and every line that names one is in the map."""
    tagged = {
        (int(number), at)
        for at, line in enumerate(PAPER, start=1)
        if at > PAPER.index("class Arm:")
        for tag in re.findall(r"Eqs?\. ([\d, ]+)", line)
        for number in re.findall(r"\d+", tag)
    }
    mapped = set()
    for first, last, rest in ROWS:
        lines = [int(at) for at in re.findall(r"\d+", rest.split("|")[1])]
        numbers = range(int(first), int(last or first) + 1)
        assert all(any((number, at) in tagged for number in numbers) for at in lines), first
        mapped |= {(number, at) for number in numbers for at in lines}
    assert tagged <= mapped
