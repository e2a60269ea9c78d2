"""What several tests of the notebooks need: the builder, each notebook run once a session, and what it printed.

One of them runs in a kernel, as the builder runs it; a kernel takes seconds to start and load. The others run in forks.
"""

import importlib.util
import re
import tempfile
from base64 import b64encode
from contextlib import redirect_stderr, redirect_stdout
from functools import cache
from io import StringIO
from pathlib import Path

import pytest
from forks import forked, load_for_forks

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


IN_A_KERNEL = "figures_4_to_7"


@cache
def executed(name):
    """Return the notebook of a script with its output; a cell that raises fails here."""
    if name == IN_A_KERNEL:
        return build.execute(FOLDER / f"{name}.py")
    load_for_forks()
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "executed.ipynb"

        def work():
            nbformat.write(run_here(build.read_script(FOLDER / f"{name}.py")), file)

        status, said = forked(FOLDER.parent, work)
        assert status == 0, said
        return nbformat.read(file, as_version=4)


def run_here(notebook):
    """Run the cells of a notebook in this process, in an interpreter as a kernel has, and return it with its output."""
    from IPython.core.displayhook import DisplayHook
    from IPython.core.displaypub import DisplayPublisher
    from IPython.core.interactiveshell import InteractiveShell

    found = []

    class Publisher(DisplayPublisher):
        def publish(self, data, metadata=None, **others):
            found.append(nbformat.v4.new_output("display_data", data=in_json(data)))

    class Hook(DisplayHook):
        def write_output_prompt(self):
            """Write none."""

        def write_format_data(self, format_dict, md_dict=None):
            found.append(nbformat.v4.new_output("execute_result", data=in_json(format_dict)))

    class Stream(StringIO):
        def __init__(self, name):
            super().__init__()
            self.name = name

        def write(self, text):
            if not found or found[-1].get("name") != self.name:
                found.append(nbformat.v4.new_output("stream", name=self.name, text=""))
            found[-1].text += text
            return len(text)

    class ZMQInteractiveShell(InteractiveShell):  # by this name rich knows a notebook
        def enable_gui(self, gui=None):
            """Have no window: figures are images in the output."""

    shell = ZMQInteractiveShell.instance(display_pub_class=Publisher, displayhook_class=Hook)
    for cell in notebook.cells:
        if cell.cell_type == "code":
            with redirect_stdout(Stream("stdout")), redirect_stderr(Stream("stderr")):
                result = shell.run_cell(cell.source, store_history=True)
            result.raise_error()
            cell.execution_count, cell.outputs = result.execution_count, found.copy()
            found.clear()
    return notebook


def in_json(data):
    """Return what a display has, with images as base64."""
    return {kind: b64encode(x).decode() if isinstance(x, bytes) else x for kind, x in data.items()}


def saved(name):
    """Return the committed notebook of a script."""
    return nbformat.read(FOLDER / f"{name}.ipynb", as_version=4)


def outputs(notebook):
    """Return all outputs, in order."""
    return [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]


def number(word):
    """Return the number that a word is, brackets, signs and commas around it aside, or None."""
    found = re.fullmatch(r"[(,]*([-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?)[),:;]*", word)
    return float(found[1]) if found else None
