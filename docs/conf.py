"""Sphinx configuration: ``python -m sphinx -W -b html docs out/docs``."""

import sys
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE.parent), str(HERE)]

from generate import write  # noqa: E402

OPTIONAL = ("interactive", "lab")  # pages of index.md that may be missing

project = "closedloop"
author = "the authors of closedloop"
html_title = "closedloop"
html_theme = "furo"
html_static_path = ["static"]
html_css_files = ["tables.css"]
html_show_copyright = False
html_show_sphinx = False
html_copy_source = False
extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.mathjax",
    "sphinx-mathjax-offline",  # formulas without a network
]
smartquotes = False  # a quoted word is TOML
default_role = "code"
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3
autodoc_typehints = "none"  # shapes, units and frames are in the docstrings
autodoc_member_order = "bysource"
napoleon_google_docstring = False
napoleon_use_rtype = False
napoleon_use_ivar = True


def plain_docstring(app: Any, what: str, name: str, thing: Any, options: Any, lines: list[str]) -> None:
    """Mark the indented blocks of a docstring, formulas and code, as literal, and let a | be the bars of a norm."""
    marked: list[str] = []
    fields = literal = False
    for line in lines:
        fields = fields or line.startswith((":", ".. "))  # what napoleon has made of the sections
        if not fields and line.startswith("    ") and not literal and marked and not marked[-1].strip():
            marked += ["::", ""]
            literal = True
        elif line.strip() and not line.startswith("    "):
            literal = False
        marked.append(line if literal else line.replace("|", "\\|"))
    lines[:] = marked


def leave_out_missing(app: Any, page: str, source: list[str]) -> None:
    """Take the pages out of the contents that are not there."""
    if page == "index":
        for name in OPTIONAL:
            if not (HERE / f"{name}.md").exists():
                source[0] = source[0].replace(f"\n{name}\n", "\n")


def names_in(text: str) -> list[str] | None:
    """Return the names in a list that commas part, None if it is empty."""
    return text.split(",") if text else None


def setup(app: Any) -> None:
    """Connect the functions above, and write the pages that follow from the code."""
    app.connect("autodoc-process-docstring", plain_docstring)
    app.connect("source-read", leave_out_missing)
    app.add_config_value("simulated", "", "env")  # -D simulated=NAME,NAME: only these are in gallery and verdicts
    app.connect("config-inited", lambda app, config: write(HERE / "generated", names_in(config.simulated)))
