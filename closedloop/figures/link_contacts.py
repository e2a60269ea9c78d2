"""The contacts of the links: the force of each, and what of its cone friction uses."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from closedloop.contacts.names import names_of
from closedloop.figures.dress import dress
from closedloop.figures.style import new_figure
from closedloop.record.run import Run

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def link_contacts(run: Run) -> Figure:
    """Draw the normal force of each contact of a link, and below it its friction, with the edge of its cone dashed.

    Raises
    ------
    ValueError
        If the run has no such contact.
    """
    sections = run.scenario.contact
    if not sections:
        raise ValueError("the run has no [[contact]]")
    figure = new_figure(height=5.0)
    above, below = (figure.add_subplot(2, 1, k) for k in (1, 2))
    for k, (name, section) in enumerate(zip(names_of(sections), sections, strict=True)):
        f = run.link_forces[:, k]
        rub = np.hypot(run.link_frictions[:, 2 * k], run.link_frictions[:, 2 * k + 1])
        lines: list[Any] = above.plot(run.time, f, label=name)
        below.plot(run.time, rub, color=lines[0].get_color())
        below.plot(run.time, section.friction * f, "--", color=lines[0].get_color(), linewidth=0.7)
    dress(above, run, "Contacts of the links", "f [N]", label_marks=False)
    dress(below, run, "their friction; dashed: the edge of the cone", "|friction| [N]", label_marks=False)
    above.legend(fontsize=7, ncols=min(3, len(sections)))
    return figure
