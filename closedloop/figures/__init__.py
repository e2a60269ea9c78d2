"""Figures of a run: Figs. 4-7 of the paper, and, where they have something to show, its impacts and its friction.

Each function takes a run and returns a matplotlib figure that nothing else holds; `draw_figures` writes them as files.
"""

from __future__ import annotations

from closedloop.figures.closure import closure_error
from closedloop.figures.files import draw_figures, save_figure
from closedloop.figures.force import contact_force
from closedloop.figures.friction import friction_force
from closedloop.figures.impacts import impacts
from closedloop.figures.style import STYLE
from closedloop.figures.tip import tip_position

__all__ = [
    "STYLE",
    "closure_error",
    "contact_force",
    "draw_figures",
    "friction_force",
    "impacts",
    "save_figure",
    "tip_position",
]
