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
    bodies            height, way and rotation of free bodies
    columns           any columns of the run, a panel each

Each function takes a run and returns a matplotlib figure that nothing else holds; its panels are `figure.axes`. With
``ax=`` it draws on axes of yours: one Axes is the first panel, a sequence has one for each panel. Legends are inside
them, and `contact_handles(run)` are for a legend of the bands and events. `draw_figures` writes as files the figures
for which the run has data. `STYLE` is their style, matplotlib's settings by their names; `styled` draws in it, with
another width or font.
"""

from closedloop.figures.errors import closure_error, force_control
from closedloop.figures.files import draw_figures, images_of, is_papers, save_figure
from closedloop.figures.force import contact_force, friction_force, impacts, link_contacts
from closedloop.figures.motion import bodies, columns, joints, tip_position, tool
from closedloop.figures.style import STYLE, contact_handles, styled

__all__ = [
    "STYLE", "bodies", "closure_error", "columns", "contact_force", "contact_handles", "draw_figures", "force_control",
    "friction_force", "images_of", "impacts", "is_papers", "joints", "link_contacts", "save_figure", "styled",
    "tip_position", "tool",
]  # fmt: skip
