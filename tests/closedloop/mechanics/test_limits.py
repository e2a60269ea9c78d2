"""The limits of contact stand in one record, each with a unit and a reason, and each is used."""

import ast
import re
from pathlib import Path

import pytest

import closedloop
from closedloop.mechanics import limits

HOME = Path(closedloop.__file__).parent
ROOMS = ("mechanics/contacts", "loop/events")


def test_each_limit_is_what_code_reads_and_says_why():
    """A name of the module is the value in `LIMITS`; units are those of SI, "1" or none."""
    for name, (value, unit, reason) in limits.LIMITS.items():
        assert getattr(limits, name) == value, name
        assert set(re.findall("[a-zA-Z]+", unit)) <= {"m", "s", "rad", "N", "or"}, name
        assert len(reason.split()) >= 4, name
    assert len(limits.LIMITS) <= 39  # may only become fewer


def test_no_limit_is_left_unused():
    """Some module imports each."""
    used = set()
    for path in HOME.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and node.module == limits.__name__:
                used |= {alias.name for alias in node.names}
    assert limits.LIMITS.keys() - used == set()


@pytest.mark.parametrize("room", ROOMS)
def test_no_tolerance_stands_elsewhere(room):
    """No number between 1e-200 and 1e-3, nor a large one, is written in what solves contacts or finds events."""
    for path in (HOME / room).rglob("*.py"):
        if path.name == "sections.py":  # bounds of what a scenario may say
            continue
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Constant) and isinstance(node.value, float) and node.value:
                size = abs(node.value)
                allowed = 1e-3 < size < 1e3 or size < 1e-200 or node.value in ALLOWED
                assert allowed, f"{path.relative_to(HOME)}:{node.lineno}: {node.value}"


# Rounding of doubles; mm in a metre; N/m by which a gap becomes a force, of which only the sign counts.
ALLOWED = (4e-16, 1e3, 1.001e3, 1e6)
