"""A law's module: one line for whatever is wrong with it, and no installed module replaced by a file beside it."""

import sys

import pytest

import closedloop as cl

GOOD = "def f(t, q, v, terms):\n    return terms.bias\n"
BROKEN = {
    "a syntax error": ("import numpy\n\ndef f(:\n", "mine.py:3: invalid syntax"),
    "a missing import": ("import numpy\nimport not_there\n", "mine.py:2: ModuleNotFoundError: No module named 'not_th"),
    "a missing name": ("from numpy import not_there\n", "mine.py:1: ImportError: cannot import name 'not_there'"),
    "an exception": ("x = 1\n\ny = x / 0\n", "mine.py:3: ZeroDivisionError: division by zero"),
    "an exception of two lines": ("raise ValueError('one\\ntwo')\n", "mine.py:1: ValueError: one"),
    "an exception without words": ("raise ValueError\n", "mine.py:1: ValueError"),
    "sys.exit": ("import sys\nsys.exit(0)\n", "mine.py:2: calls sys.exit(0)"),
    "quit": ("quit()\n", "mine.py:1: calls sys.exit(None)"),
    "an exception far below": ("import json\njson.loads('{')\n", "mine.py:2: JSONDecodeError: "),
    "an exception as it is asked": ("def __getattr__(name):\n    raise KeyError(name)\n", "mine.py:2: KeyError: 'f'"),
    "half an indent": ("def f():\n    x\n  y\n", "mine.py:3: unindent does not match"),
    "a NUL": ("x = '\0'\n", "Error: source code string cannot contain null bytes"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_module_that_cannot_be_imported(case, command_line, short, tmp_path):
    """The line names the line of the user's file, and what is wrong with it; nothing is simulated."""
    text, words = BROKEN[case]
    (tmp_path / "mine.py").write_text(text)
    line = command_line("wam_slide", "--law", "mine:f", *short).refusal()
    assert line.startswith("--law mine:f: ")
    assert words in line
    assert not (tmp_path / "out").exists()


def test_module_that_is_no_text(command_line, short, tmp_path):
    """A file of other bytes is refused as what is no Python is: by a ValueError in 3.11.2, by a SyntaxError later."""
    (tmp_path / "mine.py").write_bytes(b"\xff\xfe\x00")
    line = command_line("wam_slide", "--law", "mine:f", *short).refusal()
    assert line.startswith(("--law mine:f: mine.py: SyntaxError", "--law mine:f: mine.py: ValueError"))


def test_module_that_another_lacks(command_line, short, tmp_path):
    """An error in a module that the law's module imports is placed there."""
    (tmp_path / "mine.py").write_text("import beside\n" + GOOD)
    (tmp_path / "beside.py").write_text("\n\n1 / 0\n")
    assert "beside.py:3: ZeroDivisionError" in command_line("wam_slide", "--law", "mine:f", *short).refusal()


def test_modules_beside_the_law_are_found(command_line, short, tmp_path):
    """A law may import what lies beside it, and be in a package."""
    (tmp_path / "laws_here").mkdir()
    (tmp_path / "laws_here" / "soft.py").write_text("import numpy\nfrom gains_here import scale\n" + GOOD)
    (tmp_path / "gains_here.py").write_text("scale = 1\n")
    assert command_line("wam_slide", "--law", "laws_here.soft:f", *short, "--out", "r").status == 0
    assert cl.load_run(tmp_path / "r" / "run.nc").law == "laws_here.soft:f"


@pytest.mark.parametrize("name", ["numpy", "json", "closedloop", "robot_models", "this", "sys", "pip"])
def test_module_with_the_name_of_an_installed_one(name, command_line, short, tmp_path):
    """Such a module is refused: it would take the place of the other, or not be found."""
    (tmp_path / f"{name}.py").write_text(GOOD)
    line = command_line("wam_slide", "--law", f"{name}:f", *short).refusal()
    assert line.startswith(f"--law {name}:f: {name}.py has the name of another module")
    assert line.endswith("rename it")


def test_the_current_folder_is_looked_through_last(command_line, short, tmp_path):
    """With a law from here, a module here with an installed one's name is not imported, then or later."""
    (tmp_path / "mine.py").write_text("import this_is_here, colorsys\n" + GOOD)
    (tmp_path / "this_is_here.py").write_text("")
    (tmp_path / "colorsys.py").write_text("raise RuntimeError('not this one')\n")
    sys.modules.pop("colorsys", None)
    assert command_line("wam_slide", "--law", "mine:f", *short).status == 0
    assert sys.path.index(str(tmp_path)) == len(sys.path) - 1


def test_what_a_law_prints_is_no_result(command_line, short, tmp_path):
    """What a law prints, as it is imported or asked, goes to standard error; the summary stays JSON."""
    (tmp_path / "mine.py").write_text(
        "print('imported')\n" + GOOD.replace("    return", "    print('asked')\n    return")
    )
    outcome = command_line("wam_slide", "--law", "mine:f", *short)
    assert outcome.status == 0
    assert outcome.out.startswith("{")
    assert "asked" not in outcome.out
    assert outcome.err.splitlines()[:2] == ["imported", "asked"]


def test_byte_order_mark(command_line, short, tmp_path):
    """A scenario may begin with a byte order mark, as editors of Windows write it; UTF-16 is refused in one line."""
    text = '[robot]\nmodel = "planar2"\n[law]\nkp = 100\nkd = 10\n'
    (tmp_path / "marked.toml").write_text(text, encoding="utf-8-sig")
    assert command_line("marked.toml", *short, "--out", "r").status == 0
    for coding in ("utf-16", "utf-16-le", "utf-32"):
        (tmp_path / "wide.toml").write_text(text, encoding=coding)
        assert command_line("wide.toml", *short).refusal().startswith("wide.toml: ")
