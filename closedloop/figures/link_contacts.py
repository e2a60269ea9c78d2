"""The contacts of the links: the force of each, and what of its cone friction uses."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from closedloop.figures.dress import dress, explain_contact
from closedloop.figures.style import MANY, new_figure
from closedloop.record.run import Run
from closedloop.scenario.contact_names import names_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# By how much the broadest line is broader than the last, points.
WIDER = 5.0


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
    figure = new_figure(height=5.4)
    above, below = figure.subplots(2, 1, sharex=True)
    count = len(sections)
    for k, (name, section) in enumerate(zip(names_of(sections), sections, strict=True)):
        f = run.link_forces[:, k]
        rub = np.hypot(run.link_frictions[:, 2 * k], run.link_frictions[:, 2 * k + 1])
        # Contacts on either side are often equal: the first are drawn broader, so that they are seen behind the last.
        style: dict[str, Any] = {"color": MANY[k % len(MANY)], "linewidth": 1.2 + WIDER * (count - 1 - k) / count}
        above.plot(run.time, f, label=name, **style)
        below.plot(run.time, rub, **style)
        below.plot(run.time, section.friction * f, "--", color=MANY[k % len(MANY)], linewidth=0.7)
    dress(above, run, f"Contacts of the links ({run.model.name})", "f [N]", label_marks=False, show_events=False)
    above.set_xlabel("")
    dress(below, run, "Their friction; dashed: the edge of the cone", "|friction| [N]", label_marks=False)
    figure.legend(loc="outside upper center", ncols=min(4, count), fontsize=8, columnspacing=1.5)
    explain_contact(figure, run)
    return figure
