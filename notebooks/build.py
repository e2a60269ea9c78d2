"""Make the notebooks from their scripts: run each script (jupytext percent format) and save it with its output.

    python notebooks/build.py          # needs the extra: pip install -e ".[notebooks]"

The command line of jupytext would do, but it leaves random cell ids, time stamps and the version of the kernel in the
file; here the same script on the same machine gives the same notebook.
"""

from __future__ import annotations

from pathlib import Path

import jupytext
import nbformat
from nbclient import NotebookClient

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent


def scripts() -> list[Path]:
    """Return the scripts that are notebooks, sorted."""
    return sorted(path for path in HERE.glob("*.py") if path != Path(__file__).resolve())


def read_script(script: Path) -> nbformat.NotebookNode:
    """Return a script as a notebook that has not been run, free of what differs from machine to machine."""
    notebook = jupytext.read(script, fmt="py:percent")
    notebook.metadata = {
        "jupytext": {"formats": "ipynb,py:percent"},
        "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
        "language_info": {"name": "python"},
    }
    notebook.nbformat, notebook.nbformat_minor = 4, 5
    for k, cell in enumerate(notebook.cells):
        cell.id, cell.metadata = f"cell-{k}", {}
    return nbformat.from_dict(notebook)


def execute(script: Path) -> nbformat.NotebookNode:
    """Run a script in a fresh kernel, from the root of the repository, and return it with its output.

    Raises
    ------
    nbclient.exceptions.CellExecutionError
        If a cell raises.
    """
    notebook = read_script(script)
    metadata = nbformat.from_dict(notebook.metadata)
    NotebookClient(notebook, timeout=120, record_timing=False, resources={"metadata": {"path": str(ROOT)}}).execute()
    notebook.metadata = metadata  # the kernel has added its version
    return notebook


if __name__ == "__main__":
    for script in scripts():
        target = script.with_suffix(".ipynb")
        nbformat.write(execute(script), target)
        print(f"{target.relative_to(ROOT)}: {target.stat().st_size / 1e3:.0f} kB")
