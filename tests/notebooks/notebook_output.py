"""What several tests of the notebooks need: the builder, each notebook run once a session, and what it printed."""

import importlib.util
import re
from functools import cache
from pathlib import Path

import pytest

_MISSING = 'the notebooks need their extra: pip install -e ".[notebooks]"'
pytest.importorskip("jupytext", reason=_MISSING)
pytest.importorskip("ipykernel", reason=_MISSING)
nbformat = pytest.importorskip("nbformat", reason=_MISSING)
nbclient = pytest.importorskip("nbclient", reason=_MISSING)

FOLDER = Path(__file__).resolve().parents[2] / "notebooks"


def load_builder():
    """Return notebooks/build.py as a module."""
    spec = importlib.util.spec_from_file_location("notebook_builder", FOLDER / "build.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


build = load_builder()
SCRIPTS = build.scripts()


@cache
def executed(name):
    """Return the notebook of a script as it comes out of a fresh kernel; a cell that raises fails here."""
    return build.execute(FOLDER / f"{name}.py")


def saved(name):
    """Return the committed notebook of a script."""
    return nbformat.read(FOLDER / f"{name}.ipynb", as_version=4)


def outputs(notebook):
    """Return all outputs, in order."""
    return [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]


def printed(notebook):
    """Return the lines that were printed, without colours."""
    text = "".join(output.text for output in outputs(notebook) if output.get("name") == "stdout")
    return re.sub(r"\x1b\[\d*m", "", text).splitlines()


def number(word):
    """Return the number that a word is, brackets, signs and commas around it aside, or None."""
    found = re.fullmatch(r"[(,]*([-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?)[),:;]*", word)
    return float(found[1]) if found else None
