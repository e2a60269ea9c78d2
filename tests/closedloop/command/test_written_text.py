"""No text of a run leaves its place in a file that is written: its comment, its cell, its script."""

import csv
import io
import os
import subprocess
import tomllib
from pathlib import Path
from types import SimpleNamespace
from xml.etree import ElementTree

import numpy as np
import pytest
from pyarrow.csv import write_csv

import closedloop as cl
import validation
from closedloop.__main__ import main
from closedloop.base.errors import printable
from closedloop.base.files import what_was_written
from closedloop.figures.export.files import encoded
from closedloop.figures.export.mjcf import explained
from closedloop.lab.history import quoted, save

# Line breaks of all kinds, what ends a comment, a script or a cell, and characters that no file of text may have.
NASTY = [
    "a\nlaw = 1", "a\r\nb",
    "a\x0bb", "a\x0cb", "a\x85b", "a\u2028b", "a\u2029b", "\x00", "\x1b[31m", "\x7f", "--->", "-->",
    "----", "</script><script>alert(1)</script>", 'a",b', "a'b\\c\nd", "\ud800", "=1+1", "#", '"""', "µ é 漢",
]  # fmt: skip


@pytest.mark.parametrize("text", NASTY)
def test_a_saved_command_stays_in_its_comment(text, tmp_path):
    """The scenario behind it is read back as it was, and the comment is one line."""
    scenario = cl.load_scenario("planar2_drop")
    run = SimpleNamespace(scenario=scenario, save=lambda path: path)
    file = save(run, f"closedloop {text}", tmp_path)[0]
    written = file.read_bytes().decode()
    assert written.splitlines()[1:] == scenario.to_toml().splitlines()
    assert tomllib.loads(written) == tomllib.loads(scenario.to_toml())


def test_a_command_with_line_breaks_is_one_line_that_a_shell_reads_back():
    """Of each word every character, as it was given."""
    words = [text for text in NASTY if "\x00" not in text and "\ud800" not in text]
    line = " ".join(map(quoted, words))
    assert line.isprintable()
    told = subprocess.run(["bash", "-c", f"printf '%s\\0' {line}"], capture_output=True, check=True).stdout
    assert told.decode().split("\0")[:-1] == words


@pytest.mark.parametrize("text", NASTY)
def test_a_name_stays_in_the_comment_of_an_mjcf(text):
    """Three hyphens and a bracket ended it."""
    root = ElementTree.Element("mujoco")
    root.append(ElementTree.Comment(explained(text)))
    written = ElementTree.tostring(root, encoding="unicode")
    assert "--" not in written.removeprefix("<mujoco><!--").removesuffix("--></mujoco>")
    assert len(ElementTree.fromstring(written)) == 0


@pytest.mark.parametrize("text", [text for text in NASTY if "\ud800" not in text])
def test_a_name_stays_in_its_cell_of_a_table(text):
    """A header is read back as it was."""
    written = encoded({text: np.zeros(2), "b": np.ones(2)}, write_csv).decode()
    rows = list(csv.reader(io.StringIO(written, newline="")))
    assert rows == [[text, "b"], ["0", "1"], ["0", "1"]]


@pytest.mark.parametrize("text", [text for text in NASTY if "\ud800" not in text])
def test_a_description_stays_in_its_line_of_a_scenario(text):
    """TOML is read back to the same."""
    scenario = cl.load_scenario("planar2_drop", {"description": text})
    assert tomllib.loads(scenario.to_toml())["description"] == text
    assert scenario.to_toml().split("\n")[2:] == cl.load_scenario("planar2_drop").to_toml().split("\n")[2:]


@pytest.mark.parametrize("text", ["a\nb", "a\x1bb", "a\u2028b"])
def test_names_are_of_one_line(text):
    """A contact's name stands in headers, a scenario's in comments: what cannot be printed is refused."""
    contact = {"name": text, "link": "tip"}
    with pytest.raises(cl.ScenarioError, match="must be a name on one line"):
        cl.load_scenario("planar2_drop", {"contact": [contact]})
    with pytest.raises(cl.ScenarioError, match="must be a plain name"):
        cl.load_scenario("planar2_drop", {"name": text})


def test_what_can_be_printed_is_left_alone():
    """Letters of any alphabet; the rest as Python spells it."""
    assert printable("µ é 漢 \\ ' \"") == "µ é 漢 \\ ' \""
    assert printable("a\nb\u2028c\x1b") == "a\\nb\\u2028c\\x1b"


def test_a_folder_of_two_lines_is_said_in_one(capsys, tmp_path):
    """By a run that is made, and one that is exported."""
    folder = tmp_path / "a\nb"
    commands = (
        ("run", "wam_slide", "--time.duration", "0.002", "--no-figures", "--out", folder),
        ("export", folder / "run.nc", "--to", "csv"),
    )
    for words in commands:
        assert main(list(map(str, words))) == 0
        assert "a\\nb" in capsys.readouterr().out.splitlines()[-1]


def test_every_line_that_says_what_was_written_is_made_printable():
    """By one function, in the text of the packages: a path may have any character."""
    assert what_was_written("a\nb", folder="c\td") == f"wrote c\\td{os.sep}: a\\nb"
    assert what_was_written("a/b\n", "c") == "wrote a/b\\n, c"
    lines = [
        line
        for package in (cl, validation)
        for file in Path(package.__file__).parent.rglob("*.py")
        for line in file.read_text(encoding="utf-8").splitlines()
    ]
    assert sum("what_was_written(" in line for line in lines) > 10
    assert [line for line in lines if "print(" in line and "wrote {" in line] == []
