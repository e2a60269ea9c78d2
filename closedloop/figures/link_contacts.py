"""The contacts of the links: when each is closed, its force, and what of its cone friction uses."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from closedloop.base.arrays import Array
from closedloop.figures.style import (
    COLOURS,
    MANY,
    MOST_CURVES,
    dress,
    explain_contact,
    legend_beside_title,
    legend_outside,
    no_upper_labels,
    panels,
    widen,
)
from closedloop.mechanics.closure.contact_force import FREE, STUCK
from closedloop.mechanics.contacts.friction import coulomb_of, has_other_law
from closedloop.record.run import Run
from closedloop.scenario.tables import names_of, patches_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# What titles say where `contacts_drawn` takes points together.
SUMMED = ", sums over points"
# By how much the broadest line is broader than the last, points.
WIDER = 5.0
# The axis of the forces shows at least this share of the largest.
FLATTEST = 0.02
# Height of a row of the contacts over time, inches; and how many rows a page has room for.
ROW, MOST_ROWS = 0.17, 32


def link_contacts(run: Run, ax: Axes | Sequence[Axes] | None = None) -> Figure:
    """Draw when each contact of a link is closed, its normal force, and its friction, with the cone's edge dashed.

    Of more contacts than can be told apart the forces are sums over the points of one patch, and those of the largest.
    For `ax` see `closedloop.figures`.
    """
    sections = run.scenario.contact
    if not sections:
        raise ValueError("the run has no [[contact]]")
    names, count = names_of(sections), len(sections)
    rows = 0.6 + ROW * min(count, MOST_ROWS)
    figure, (times, above, below) = panels(3, 4.8 + rows, ax, [rows, 2.0, 2.0])
    draw_closed(times, run, names)
    styles = draw_forces(above, run)
    for drawn, style in styles:
        below.plot(run.time, drawn.friction(run), **style)
        if not any(has_other_law(sections[k]) for k in drawn.numbers):
            limit = sum(coulomb_of(sections[k]) * run.link_forces[:, k] for k in drawn.numbers)
            below.plot(run.time, limit, "--", color=style["color"], linewidth=0.7)
    widen(below, FLATTEST * max(abs(end) for end in below.get_ylim()))
    dress(times, run, "Contacts of the links", "", label_marks=False, show_events=False)
    dress(below, run, "Friction of the contacts; dashed: its limit μ f", "|friction| [N]", label_marks=False)
    no_upper_labels(figure, (times, above, below))
    legend_outside(figure, "upper center", above.get_legend_handles_labels()[0], 4, axes=above)
    explain_contact(figure, run)
    return figure


class Drawn(NamedTuple):
    """What has one curve: its name, and the numbers of its contacts, from 0."""

    name: str
    numbers: list[int]

    def force(self, run: Run) -> Array:
        """Return the sum of the normal forces (N,), N."""
        return run.link_forces[:, self.numbers].sum(axis=1)

    def friction(self, run: Run) -> Array:
        """Return the sum of the sizes of friction (N,), N."""
        both = run.link_frictions.reshape(len(run), -1, 2)[:, self.numbers]
        return np.hypot(both[..., 0], both[..., 1]).sum(axis=1)


def contacts_drawn(run: Run) -> tuple[list[Drawn], str]:
    """Return the contacts that have a curve, and what a title says of them: of many points, each patch has one."""
    sections = run.scenario.contact or ()
    each, patches = [Drawn(name, [k]) for k, name in enumerate(names_of(sections))], patches_of(sections)
    pressed = np.any(run.link_forces > 0.0, axis=0)
    if int(pressed.sum()) > MOST_CURVES and len(patches) < len(each):
        return [Drawn(*patch) for patch in patches.items()], SUMMED
    return each, ""


def draw_forces(axes: Axes, run: Run) -> list[tuple[Drawn, dict[str, Any]]]:
    """Draw the normal forces of the links' contacts, of many the largest; return what is drawn, and how."""
    each, summed = contacts_drawn(run)
    largest = sorted(range(len(each)), key=lambda k: -float(np.max(each[k].force(run))))
    pressed = [k for k in largest if np.any(each[k].force(run) > 0.0)] or largest[:1]
    shown = sorted(pressed[:MOST_CURVES])
    # Contacts on either side are often equal: the first are drawn broader, so that they are seen behind the last.
    styles: list[tuple[Drawn, dict[str, Any]]] = [
        (each[k], {"color": MANY[at % len(MANY)], "linewidth": 1.2 + WIDER * (len(shown) - 1 - at) / len(shown)})
        for at, k in enumerate(shown)
    ]
    for drawn, style in styles:
        axes.plot(run.time, drawn.force(run), label=drawn.name, **style)
    widen(axes, FLATTEST * max(abs(end) for end in axes.get_ylim()))
    those = f", the {len(shown)} largest of {len(pressed)}" if len(shown) < len(pressed) else ""
    dress(axes, run, f"Contact forces{summed}{those}", "f [N]", show_events=False)
    return styles


def draw_closed(axes: Axes, run: Run, names: tuple[str, ...]) -> None:
    """Draw a bar for each time that a contact is closed, by its name: dark as it sticks or rolls, light as it slides.

    Of more than a page has room for, those that are closed longest.
    """
    from matplotlib.patches import Patch

    closed = run.link_modes != FREE
    order = np.argsort(-closed.sum(axis=0), kind="stable")[:MOST_ROWS]
    rows = np.sort(order)
    for at, k in enumerate(rows):
        for mode, colour in ((STUCK, COLOURS[0]), (None, MANY[5])):
            now = closed[:, k] & ((run.link_modes[:, k] == STUCK) == (mode == STUCK))
            spans = spans_of(now, run.time)
            if spans:
                axes.broken_barh([(a, b - a) for a, b in spans], (at - 0.4, 0.8), color=colour, linewidth=0)
    axes.set_yticks(range(len(rows)), [names[k] for k in rows], fontsize="small")
    axes.set_ylim(len(rows) - 0.4, -0.6)
    axes.grid(axis="y", visible=False)
    handles = [Patch(color=COLOURS[0], label="sticks or rolls"), Patch(color=MANY[5], label="slides")]
    legend_beside_title(axes, handles)


def spans_of(now: NDArray[np.bool_], time: NDArray[np.float64]) -> list[tuple[float, float]]:
    """Return from when to when a condition holds, by the rows (N,) in which it does, s; a row counts to the next."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], now, [False]]).astype(int)))
    ends = np.append(time, time[-1])
    return [(float(ends[a]), float(ends[b])) for a, b in edges.reshape(-1, 2)]
