"""The contacts of the links: when each is closed, its force, and what of its cone friction uses."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from closedloop.figures.dress import dress, explain_contact
from closedloop.figures.style import COLOURS, MANY, MOST_CURVES, new_figure, widen
from closedloop.mechanics.closure.contact_force import FREE, STUCK
from closedloop.mechanics.contacts.friction import coulomb_of, has_other_law
from closedloop.record.run import Run
from closedloop.scenario.contact_names import names_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# By how much the broadest line is broader than the last, points.
WIDER = 5.0
# The axis of the forces shows at least this share of the largest.
FLATTEST = 0.02
# Height of a row of the contacts over time, inches; and how many rows a page has room for.
ROW, MOST_ROWS = 0.17, 32


def link_contacts(run: Run) -> Figure:
    """Draw when each contact of a link is closed, its normal force, and its friction, with the cone's edge dashed.

    Of more contacts than can be told apart the forces are those of the largest.

    Raises
    ------
    ValueError
        If the run has no such contact.
    """
    sections = run.scenario.contact
    if not sections:
        raise ValueError("the run has no [[contact]]")
    names, count = names_of(sections), len(sections)
    rows = 0.6 + ROW * min(count, MOST_ROWS)
    figure = new_figure(height=4.8 + rows)
    times, above, below = figure.subplots(3, 1, sharex=True, height_ratios=[rows, 2.0, 2.0])
    draw_closed(times, run, names)
    styles = draw_forces(above, run)
    for k, style in styles.items():
        rub = np.hypot(run.link_frictions[:, 2 * k], run.link_frictions[:, 2 * k + 1])
        below.plot(run.time, rub, **style)
        if not has_other_law(sections[k]):
            limit = coulomb_of(sections[k]) * run.link_forces[:, k]
            below.plot(run.time, limit, "--", color=style["color"], linewidth=0.7)
    widen(below, FLATTEST * max(abs(end) for end in below.get_ylim()))
    dress(times, run, "Contacts of the links", "", label_marks=False, show_events=False)
    for axes in (times, above):
        axes.set_xlabel("")
    dress(below, run, "Friction of the contacts; dashed: its limit μ f", "|friction| [N]", label_marks=False)
    figure.legend(loc="outside upper center", ncols=min(4, len(styles)), fontsize=8, columnspacing=1.5)
    explain_contact(figure, run)
    return figure


def draw_forces(axes: Axes, run: Run) -> dict[int, dict[str, Any]]:
    """Draw the normal force of each contact of a link, of many the largest; return how each is drawn, by its number."""
    names, count = names_of(run.scenario.contact or ()), run.link_forces.shape[1]
    largest = np.argsort([-float(np.max(run.link_forces[:, k])) for k in range(count)], kind="stable")
    pressed = [k for k in largest if np.any(run.link_forces[:, k] > 0.0)] or largest[:1].tolist()
    shown = sorted(pressed[:MOST_CURVES])
    # Contacts on either side are often equal: the first are drawn broader, so that they are seen behind the last.
    styles: dict[int, dict[str, Any]] = {
        int(k): {"color": MANY[at % len(MANY)], "linewidth": 1.2 + WIDER * (len(shown) - 1 - at) / len(shown)}
        for at, k in enumerate(shown)
    }
    for k, style in styles.items():
        axes.plot(run.time, run.link_forces[:, k], label=names[k], **style)
    widen(axes, FLATTEST * max(abs(end) for end in axes.get_ylim()))
    those = f", the {len(shown)} largest of {len(pressed)}" if len(shown) < len(pressed) else ""
    dress(axes, run, f"Contact forces{those}", "f [N]", show_events=False)
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
    axes.set_yticks(range(len(rows)), [names[k] for k in rows], fontsize=8)
    axes.set_ylim(len(rows) - 0.4, -0.6)
    axes.grid(axis="y", visible=False)
    handles = [Patch(color=COLOURS[0], label="sticks or rolls"), Patch(color=MANY[5], label="slides")]
    axes.legend(handles=handles, loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2, fontsize=8, borderaxespad=0.0)


def spans_of(now: NDArray[np.bool_], time: NDArray[np.float64]) -> list[tuple[float, float]]:
    """Return from when to when a condition holds, by the rows (N,) in which it does, s; a row counts to the next."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], now, [False]]).astype(int)))
    ends = np.append(time, time[-1])
    return [(float(ends[a]), float(ends[b])) for a, b in edges.reshape(-1, 2)]
