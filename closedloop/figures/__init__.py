"""Figures of a run, among them Figs. 4-7 of the paper: `closedloop.figures`.

    tip_position      where the tip is, in the base frame (Fig. 4)
    contact_force     the contact force, its transients enlarged, and the impulses of impacts (Fig. 5)
    closure_error     how far the tip is off the surface (Figs. 6 and 7)
    force_control     the errors of force and tip, and the path seen from above: what `run.plot()` shows
    joints            torques, velocities and positions of the joints against their limits
    link_contacts     force and friction of the links' contacts
    impacts           rates, impulses and energy losses of impacts
    friction_force    friction in its cone, and the slip
    tool              force and moment at the wrist, and how the tool is turned to the surface

Each function takes a run and returns a matplotlib figure that nothing else holds; `draw_figures` writes as files the
figures for which the run has data. `STYLE` is their style, for ``matplotlib.rcParams.update``.
"""

from __future__ import annotations

from closedloop.figures.closure import closure_error
from closedloop.figures.files import draw_figures, images_of, is_papers, save_figure
from closedloop.figures.force import contact_force
from closedloop.figures.friction import friction_force
from closedloop.figures.impacts import impacts
from closedloop.figures.joints import joints
from closedloop.figures.link_contacts import link_contacts
from closedloop.figures.overview import force_control
from closedloop.figures.style import STYLE
from closedloop.figures.tip import tip_position, tool

__all__ = [
    "STYLE",
    "closure_error",
    "contact_force",
    "draw_figures",
    "force_control",
    "friction_force",
    "images_of",
    "impacts",
    "is_papers",
    "joints",
    "link_contacts",
    "save_figure",
    "tip_position",
    "tool",
]
