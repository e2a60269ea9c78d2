"""The tool that plants faults: it makes the mutants that it names, and tells a strong test from a weak one."""

import ast
import importlib.util
import re
import sys
from pathlib import Path

import pytest

SPEC = importlib.util.spec_from_file_location("mutate", Path(__file__).parents[2] / "mutate.py")
assert SPEC is not None
assert SPEC.loader is not None
mutate = importlib.util.module_from_spec(SPEC)
sys.modules["mutate"] = mutate
SPEC.loader.exec_module(mutate)

SOURCE = '''"""A module."""

LIMIT = 3.0


def clamp(x: float, low: float = 0.0) -> float:
    """Return x between low and LIMIT, the half of it if it is above."""
    if x > LIMIT and not x == 4.0:
        x = x - 0.5
    return max(low, -(-x))
'''
STRONG = """
from closedloop.small import clamp

def test_all():
    assert [clamp(x) for x in (-1.0, 0.0, 2.0, 3.0, 3.5, 4.0)] == [0.0, 0.0, 2.0, 3.0, 3.0, 4.0]
    assert clamp(-1.0, -2.0) == -1.0
"""
WEAK = """
from closedloop.small import clamp

def test_something():
    assert clamp(2.0) == 2.0
"""


def small_tree(folder, test):
    """Make a tree of one module and its test; return the module's path."""
    (folder / "closedloop").mkdir()
    (folder / "tests").mkdir()
    (folder / "closedloop" / "__init__.py").touch()
    (folder / "tests" / "test_small.py").write_text(test)
    (folder / "pyproject.toml").write_text('[tool.pytest.ini_options]\nmarkers = ["slow"]\n')
    path = folder / "closedloop" / "small.py"
    path.write_text(SOURCE)
    return path


def test_every_test_that_is_named_is_there():
    """A test that is renamed or moved would else be looked for where it is not, only when mutants are made."""
    named = {name.split()[0] for names in mutate.TESTS.values() for name in names}
    for name in named:
        file, _, test = name.partition("[")[0].partition("::")
        text = (mutate.ROOT / file).read_text()
        assert not test or re.search(rf"^ *def {test}\(", text, re.MULTILINE), name


def test_every_mutant_is_one_change_and_compiles():
    """Each differs from the module, and from each other, in one place; the names and annotations stay."""
    found = list(mutate.mutants(SOURCE))
    texts = {mutant.text for mutant in found}
    assert len(texts) >= 10
    assert ast.unparse(ast.parse(SOURCE)) not in texts
    changes = " | ".join(mutant.change for mutant in found)
    expected_ones = (
        "Gt -> GtE", "and <-> or", "Eq -> NotEq", "Sub -> Add", "last term left out", "max -> min", "left out: x",
        "sign or not", "4.0 -> -4.0",
    )  # fmt: skip
    for expected in expected_ones:
        assert expected in changes
    for mutant in found:
        compile(mutant.text, "mutant", "exec")
        plain = ast.unparse(ast.parse(SOURCE)).splitlines()
        assert sum(a != b for a, b in zip(plain, mutant.text.splitlines(), strict=True)) == 1
        assert "-> float" in mutant.text
        assert mutant.line in (8, 9, 10)


def test_a_sample_is_seeded():
    """The same seed draws the same, another others, in order of lines."""
    assert mutate.sample(SOURCE, 5, 1) == mutate.sample(SOURCE, 5, 1)
    assert mutate.sample(SOURCE, 5, 1) != mutate.sample(SOURCE, 5, 2)
    lines = [mutant.line for mutant in mutate.sample(SOURCE, 99, 0)]
    assert lines == sorted(lines)


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(mutate.os, "fork"), reason="forks")
def test_a_strong_test_kills_what_a_weak_one_lets_live(tmp_path, capsys):
    """Of the same mutants the strong test kills all; the weak one lets most live."""
    for name, test in (("strong", STRONG), ("weak", WEAK)):
        (tmp_path / name).mkdir()
        path = small_tree(tmp_path / name, test)
        killed, survivors = mutate.measure(path, ["tests/test_small.py"], 2, 0, tmp_path / name)
        said = capsys.readouterr().out
        assert f"{killed} of {killed + len(survivors)} killed" in said
        if name == "strong":
            assert survivors == []
        else:
            assert survivors
            assert "closedloop/small.py:" in said
            assert "SURVIVED" in said


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(mutate.os, "fork"), reason="forks")
def test_tests_that_fail_without_a_mutant_measure_nothing(tmp_path):
    """A score on a red suite would be 100 %."""
    path = small_tree(tmp_path, "def test_red():\n    assert False\n")
    with pytest.raises(SystemExit, match="the tests fail without any mutant"):
        mutate.measure(path, ["tests/test_small.py"], 3, 0, tmp_path)


def test_every_module_of_the_table_has_its_file():
    """A module that was moved would be measured by nothing, and so would one whose tests were."""
    for module in mutate.TESTS:
        for path in (module.replace(".", "/") + ".py", *mutate.TESTS[module]):
            assert (mutate.ROOT / path.partition("::")[0]).is_file(), path
