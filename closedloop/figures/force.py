"""The forces of a run: the contact force (Fig. 5 of the paper), impacts, and friction in its cone.

And of the contacts of the links: when each is closed, its force, and what of its cone friction uses.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from closedloop.base.arrays import Array
from closedloop.figures import style
from closedloop.figures.motion import directions, sideways
from closedloop.loop.events.table import IMPACT, TOUCHDOWN
from closedloop.mechanics.closure.contact_force import FREE, STUCK
from closedloop.mechanics.contacts.friction import coulomb_of, has_other_law
from closedloop.mechanics.friction.contact import surface_contact
from closedloop.mechanics.friction.law import FrictionLaw
from closedloop.record.run import Run
from closedloop.scenario.tables import names_of, patches_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


# Values that span more than this ratio are drawn on a logarithmic axis; what is below this share of the largest, or
# of the impulse of the largest force in a step, is rounding.
SPREAD, ROUNDING = 20.0, 1e-12


class _Series(NamedTuple):
    """Values, one an impact; their name, and how they are drawn."""

    values: Array
    label: str
    marker: str
    colour: str


def hits(run: Run) -> NDArray[np.bool_]:
    """Return which events are meetings with the surface (M,).

    A touchdown without an impulse does not count, nor one whose impulse is the rounding of the forces times a step.
    """
    forces = run.link_forces if run.scenario.contact else run.contact_force
    least = ROUNDING * run.scenario.time.step * float(np.max(np.abs(forces), initial=0.0))
    return np.isin(run.event_kind, (IMPACT, TOUCHDOWN)) & (run.event_compression > least)


def has_impacts(run: Run) -> bool:
    """Tell whether the tip ever met the surface with an impulse."""
    return bool(np.any(hits(run)))


def impacts(run: Run, ax: Axes | Sequence[Axes] | None = None) -> Figure:
    """Draw the closure rate before and after each impact, its impulses, and its energy loss, against time.

    For `ax` see `closedloop.figures`.
    """
    if not has_impacts(run):
        raise ValueError("the run has no impact to draw")
    hit = hits(run)
    time, cut, lost = run.event_time[hit], run.event_rate_cut[hit], run.event_energy_lost[hit]
    figure, (above, middle, below) = style.panels(3, 6.2, ax)
    rates = [
        _Series(-run.event_rate_before[hit], "before", "o", style.COLOURS[0]),
        _Series(run.event_rate_after[hit], "after", "^", style.COLOURS[1]),
        _Series(cut, "cut to rest", "x", "0.25"),
    ]
    rest = run.scenario.impact.rest_speed
    _draw(above, time, rates, beside=rest if np.any(cut > 0.0) else None)
    if np.any(cut > 0.0):
        above.axhline(rest, color="0.3", linestyle=":", linewidth=1)
        above.annotate(
            f"impact.rest_speed = {rest:g} m/s", (0.0, rest), xycoords=("axes fraction", "data"), xytext=(4, 3),
            textcoords="offset points", fontsize="small", color="0.25",
        )  # fmt: skip
    above.set(title=f"Closure rate at impacts ({run.model.name})", ylabel="|ė| [m/s]")
    impulses = [
        _Series(run.event_compression[hit], "compression", "o", style.COLOURS[0]),
        _Series(run.event_decompression[hit], "decompression", "^", style.COLOURS[1]),
        _Series(np.linalg.norm(run.event_tangential[hit], axis=1), "tangential", "x", style.COLOURS[2]),
    ]
    _draw(middle, time, impulses)
    middle.set(title="Impulse" if np.any(run.event_contact[hit] > 0) else "Impulse on the tip", ylabel="impulse [N s]")
    _draw(below, time, [_Series(lost, "", "o", style.COLOURS[0])])
    below.set(title=f"Kinetic energy lost, {np.sum(lost):.3g} J in total", ylabel="energy [J]")
    margin = max(0.04 * float(np.ptp(time)), 2.0 * run.scenario.time.step)
    for axes in (above, middle, below):
        axes.set(xlim=(float(time[0]) - margin, float(time[-1]) + margin), xlabel="time [s]")
    style.no_upper_labels(figure, (above, middle, below))
    return figure


def _draw(axes: Axes, time: Array, series: list[_Series], beside: float | None = None) -> None:
    """Draw what is positive of each series: zero has no place on a logarithmic axis; `beside` is to be seen too."""
    from matplotlib.ticker import NullFormatter

    least = ROUNDING * max(float(np.max(each.values)) for each in series)
    shown = [each for each in series if np.any(each.values > least)]
    for values, label, marker, colour in shown:
        axes.plot(
            time, np.where(values > least, values, np.nan), linestyle="none" if marker == "x" else ":", linewidth=0.7,
            marker=marker, markersize=5, markerfacecolor="none" if marker == "^" else colour, color=colour, label=label,
        )  # fmt: skip
    everything = np.concatenate([each.values[each.values > least] for each in shown] or [np.ones(1)])
    low, high = float(np.min(everything)), float(np.max(everything))
    if beside is not None:
        low, high = min(low, beside), max(high, beside)
    if high > SPREAD * low:
        axes.set(yscale="log", ylim=(10 ** math.floor(math.log10(0.8 * low)), 10 ** math.ceil(math.log10(1.25 * high))))
        axes.yaxis.set_minor_formatter(NullFormatter())
    else:
        axes.set_ylim(0.0, 1.2 * high)
    if any(each.label for each in shown):
        style.legend_beside_title(axes)


# A force that varies by less than this share of itself, or of 1 N, is drawn flat and never enlarged.
FLAT = 1e-3
# Nor is a change below this share of all that the force does in the run.
MINOR = 0.02
# Nor is a change of the motion after which the force goes on in a line, to this share of what it does in contact.
LEAST_BEND = 0.05
# How much of the run is enlarged on either side of an instant, s, and in how many panels at most.
SHORT, LONG = 0.02, 0.12
MOST_PANELS = 3


def contact_force(run: Run, ax: Axes | Sequence[Axes] | None = None) -> Figure:
    """Draw the contact force against time, with the commanded force and the transients enlarged (Fig. 5).

    Enlarged are the instants at which the law or the reference changes and contact or sticking begins or ends, and any
    other at which the force changes more; of more than three those at which it changes most. Impulses are no part of
    the force, and have an axis of their own; see `impacts`. For `ax` see `closedloop.figures`.
    """
    # A narrow page has room for fewer panels beside one another.
    moments = transients(run, math.ceil(MOST_PANELS * min(1.0, style.page_width() / style.WIDE)))
    if ax is None:
        figure = style.new_figure(height=5.0 if moments else 3.4)
        rows = 2 if moments else 1
        grid = figure.add_gridspec(rows, max(1, len(moments)), height_ratios=[1.3, 1][:rows])
        whole = figure.add_subplot(grid[0, :])
        near = [figure.add_subplot(grid[1, k]) for k in range(len(moments))]
    else:
        figure, (whole, *near) = style.panels(1 + len(moments), 5.0, ax)
    draw_measured(whole, run, run.measured_force)
    _draw_force(whole, run, slice(None))
    style.dress(whole, run, "Contact force", "f [N]")
    style.legend_beside_title(whole)
    _draw_impulses(whole, run)
    narrow = len(moments) > 1 and (len(moments) == MOST_PANELS or style.page_width() < style.WIDE)
    for k, (axes, (text, shown)) in enumerate(zip(near, moments, strict=True)):
        _draw_force(axes, run, shown, marker=".", markersize=2.5)
        style.dress(axes, run, text, "f [N]" if k == 0 or not narrow else "", label_marks=False, rows=shown)
        if narrow or (len(moments) > 1 and run.time[-1] >= 10.0):
            axes.locator_params(axis="x", nbins=4)  # room for the numbers
    style.explain_contact(figure, run)
    return figure


def draw_measured(axes: Axes, run: Run, measured: NDArray[np.float64]) -> None:
    """Draw what the force sensor says (N,), N, behind the force, if that is anything else."""
    if np.any(run.measured_force != run.contact_force):
        axes.plot(run.time, measured, color="0.65", linewidth=0.7, label="measured", zorder=1.5)


def _draw_impulses(axes: Axes, run: Run) -> None:
    """Draw the impulses along the normal at their instants, on an axis of their own with the same zero."""
    hit = hits(run)
    if not np.any(hit):
        return
    beside: Any = axes.twinx()
    time, impulse = run.event_time[hit], (run.event_compression + run.event_decompression)[hit]
    beside.vlines(time, 0.0, impulse, color=style.COLOURS[1], linewidth=1.0)
    beside.plot(time, impulse, ".", color=style.COLOURS[1], markersize=4)
    low, high = axes.get_ylim()
    low, high = min(low, 0.0), max(high, 1e-9)
    axes.set_ylim(low, high)
    most = 1.25 * float(np.max(impulse))
    beside.set_ylim(most * low / high, most)
    beside.set_ylabel("impulses at impacts [N s]", color=style.COLOURS[1])
    beside.tick_params(axis="y", colors=style.COLOURS[1])
    beside.set_yticks([tick for tick in beside.get_yticks() if 0.0 <= tick <= most])
    beside.grid(visible=False)
    beside.spines["right"].set_visible(True)


def transients(run: Run, most: int = MOST_PANELS) -> list[tuple[str, slice]]:
    """Return what is to be enlarged, up to `most`, in order of time: what happens there, and the rows around it."""
    short, long = max(SHORT, 5 * run.scenario.time.step), max(LONG, 30 * run.scenario.time.step)
    # Where the motion changes, what counts is by how much the force leaves the commanded one.
    away = run.contact_force - run.reference_force
    wanted = [
        (t, text, short, long, run.contact_force if text == style.FORCE_STEPS else away)
        for t, text in style.marks(run)
        if run.time[0] < t < run.time[-1]
    ]
    around = dict.fromkeys(("touchdown", "stick", "slip"), (short, long))
    around |= dict.fromkeys(("liftoff", "edge"), (long, short))
    for event in run.events:
        if event.kind in around:
            said = f"{event.kind} at {event.time:.4g} s"
            wanted.append((event.time, said, *around[event.kind], run.contact_force))
    touching = run.contact_force[run.mode != FREE]
    least = MINOR * float(np.ptp(run.contact_force)) if len(run) else 0.0
    least_bend = LEAST_BEND * float(np.ptp(touching)) if touching.size else 0.0
    found: list[_Moment] = []
    for t, text, before, after, what in wanted:
        rows = slice(*np.searchsorted(run.time, (t - before, t + after)).tolist())
        change = float(np.ptp(what[rows])) if what[rows].size else 0.0
        bends = what is not away or 2.0 * float(_bend(what[rows])) > least_bend
        if bends and change > max(_flat(run.contact_force[rows]), least):
            found.append(_Moment(change, t, text, rows))
    found = sorted(found, key=lambda each: (-each.change, each.time)) + _unnamed(run, away, short + long, found)
    chosen: list[_Moment] = []
    for moment in found:
        apart = all(abs(moment.time - other.time) > long for other in chosen)
        # Of a hundred slips one is enlarged.
        alone = all(moment.kind != other.kind for other in chosen)
        if len(chosen) < most and apart and alone:
            chosen.append(moment)
    return [(each.text, each.rows) for each in sorted(chosen, key=lambda each: each.time)]


class _Moment(NamedTuple):
    """By how much the force changes there, N; an instant, s; what happens; and the rows around it."""

    change: float
    time: float
    text: str
    rows: slice

    @property
    def kind(self) -> str:
        return self.text.partition(" at ")[0]


def _bend(force: NDArray[np.float64]) -> Any:
    """Return how far a force (..., N), N, is from a straight line between its ends; NaN if any of it is."""
    if force.shape[-1] < 2:
        return 0.0
    along = np.linspace(0.0, 1.0, force.shape[-1])
    first, last = force[..., :1], force[..., -1:]
    return np.max(np.abs(force - first - (last - first) * along), axis=-1)


def _unnamed(run: Run, away: NDArray[np.float64], width: float, named: list[_Moment]) -> list[_Moment]:
    """Return where, within `width`, s, a force in contact bends most, if more than it changes at all that is named."""
    count = min(round(width / run.scenario.time.step), len(run) - 1)
    if count < 2:
        return []
    inside = np.where(run.mode != FREE, away, np.nan)
    starts = np.arange(0, len(run) - count, max(1, count // 4))
    change = 2.0 * _bend(np.lib.stride_tricks.sliding_window_view(inside, count + 1)[starts])
    for moment in named:
        change[(starts + count >= moment.rows.start) & (starts <= moment.rows.stop)] = np.nan
    largest = float(np.nanmax(change, initial=0.0))
    if not largest > max(_flat(run.contact_force), *(moment.change for moment in named), 0.0):
        return []
    begin = int(starts[int(np.nanargmax(change))])
    within = inside[begin : begin + count + 1]
    most = begin + int(np.argmax(np.abs(within - np.median(within))))
    begin = min(max(0, most - count // 4), len(run) - count - 1)
    t = float(run.time[most])
    return [_Moment(largest, t, f"around {t:.3g} s", slice(begin, begin + count + 1))]


def _flat(force: NDArray[np.float64]) -> float:
    """Return the variation, N, up to which this force counts as constant."""
    return FLAT * max(abs(float(np.mean(force))), 1.0) if force.size else 0.0


def _draw_force(axes: Axes, run: Run, rows: slice, **look: Any) -> None:
    force = run.contact_force[rows]
    axes.plot(run.time[rows], force, color=style.COLOURS[0], label="f", **look)
    if run.law == "scenario":
        wanted = run.reference_force
        dotted: dict[str, Any] = {"color": "0.3", "linestyle": ":", "linewidth": 1}
        if np.all(wanted == wanted[0]):
            axes.axhline(float(wanted[0]), label=f"commanded {wanted[0]:g} N", **dotted)
        else:
            axes.plot(run.time[rows], wanted[rows], label="commanded", **dotted)
    # A force constant to rounding is a flat line, not a picture of its sixteenth digit.
    if np.ptp(force) < _flat(force):
        middle = float(np.mean(force))
        axes.set_ylim(middle - 1, middle + 1)


# A part of friction below this share of all of it is not drawn.
ASIDE = 0.01


def has_friction(run: Run) -> bool:
    """Tell whether the surface ever resisted slip."""
    return bool(np.any(run.friction_force))


def friction_levels(law: Any) -> list[tuple[float, str, str]]:
    """Return the levels that a law has, static and kinetic, each with its name and stroke; none of one that is gone."""
    if not isinstance(law, FrictionLaw):
        return []
    contact = surface_contact(law)
    contact.rested()
    static, kinetic = contact.stick_limit, contact.kinetic_level
    levels = [(kinetic, "μ f", "-")] if static == kinetic else [(static, "μₛ f", "-"), (kinetic, "μₖ f", "--")]
    return [each for each in levels if each[0] > 0.0]


def friction_bounds(run: Run) -> list[tuple[Array, str, str]]:
    """Return the cone of a run's friction: each level times f, and the viscous part b |u|, which f does not bound.

    Each is an array (N,), N, with its name and stroke.
    """
    law = run.scenario.friction
    b = float(getattr(law, "viscous", 0.0))
    touching = run.mode != FREE
    viscous = b * np.linalg.norm(run.slip_velocity, axis=1) if b > 0.0 else np.zeros(len(run))
    more = " + b |u|" if b > 0.0 else ""
    return [
        (np.where(touching, level * run.contact_force + viscous, 0.0), f"{name}{more}", stroke)
        for level, name, stroke in friction_levels(law)
    ]


def friction_force(run: Run, ax: Axes | Sequence[Axes] | None = None) -> Figure:
    """Draw friction along the path inside the friction cone, ±(μf + b|u|), and the velocity of slip along the path.

    Both are signed along the direction of the path, see `closedloop.figures.motion.directions`: friction that resists
    slip along the path is negative. Its part across the path is drawn beside it, where there is any.
    For `ax` see `closedloop.figures`.
    """
    along, force = directions(run), run.friction_force
    across = sideways(run, along)
    slip = np.where(run.mode != FREE, np.sum(run.slip_velocity * along, axis=1), np.nan)
    figure, (above, below) = style.panels(2, 4.8, ax)
    levels = friction_levels(run.scenario.friction)
    for (bound, name, stroke), (level, *_) in zip(friction_bounds(run), levels, strict=True):
        for sign, label in ((1.0, f"±({name})" if "+" in name else f"±{name}"), (-1.0, "")):
            named = f"{label}, μ = {level:g}" if label else None
            above.plot(run.time, sign * bound, stroke, color="0.6", linewidth=1.8, label=named)
    above.plot(run.time, np.sum(force * along, axis=1), color=style.COLOURS[0], label="along the path")
    beside = np.sum(force * across, axis=1)
    if np.max(np.abs(beside)) > ASIDE * np.max(np.abs(force)):
        above.plot(run.time, beside, color=style.COLOURS[2], linewidth=0.9, label="across")
    above.axhline(0.0, color="0.3", linestyle=":", linewidth=1)
    style.dress(above, run, "Friction", "Fₜ [N]", show_events=False)
    style.legend_beside_title(above)
    below.plot(run.time, 1e3 * slip, color=style.COLOURS[1])
    below.axhline(0.0, color="0.3", linestyle=":", linewidth=1)
    style.dress(below, run, "Slip along the path", "velocity [mm/s]", label_marks=False)
    return style.finished(figure, (above, below), run)


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
    figure, (times, above, below) = style.panels(3, 4.8 + rows, ax, [rows, 2.0, 2.0])
    draw_closed(times, run, names)
    styles = draw_forces(above, run)
    for drawn, look in styles:
        below.plot(run.time, drawn.friction(run), **look)
        if not any(has_other_law(sections[k]) for k in drawn.numbers):
            limit = sum(coulomb_of(sections[k]) * run.link_forces[:, k] for k in drawn.numbers)
            below.plot(run.time, limit, "--", color=look["color"], linewidth=0.7)
    style.widen(below, FLATTEST * max(abs(end) for end in below.get_ylim()))
    style.dress(times, run, "Contacts of the links", "", label_marks=False, show_events=False)
    style.dress(below, run, "Friction of the contacts; dashed: its limit μ f", "|friction| [N]", label_marks=False)
    style.no_upper_labels(figure, (times, above, below))
    style.legend_outside(figure, "upper center", above.get_legend_handles_labels()[0], 4, axes=above)
    style.explain_contact(figure, run)
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
    if int(pressed.sum()) > style.MOST_CURVES and len(patches) < len(each):
        return [Drawn(*patch) for patch in patches.items()], SUMMED
    return each, ""


def draw_forces(axes: Axes, run: Run) -> list[tuple[Drawn, dict[str, Any]]]:
    """Draw the normal forces of the links' contacts, of many the largest; return what is drawn, and how."""
    each, summed = contacts_drawn(run)
    largest = sorted(range(len(each)), key=lambda k: -float(np.max(each[k].force(run))))
    pressed = [k for k in largest if np.any(each[k].force(run) > 0.0)] or largest[:1]
    shown = sorted(pressed[: style.MOST_CURVES])
    # Contacts on either side are often equal: the first are drawn broader, so that they are seen behind the last.
    styles: list[tuple[Drawn, dict[str, Any]]] = []
    for at, k in enumerate(shown):
        wide = 1.2 + WIDER * (len(shown) - 1 - at) / len(shown)
        styles.append((each[k], {"color": style.MANY[at % len(style.MANY)], "linewidth": wide}))
        axes.plot(run.time, each[k].force(run), label=each[k].name, **styles[-1][1])
    style.widen(axes, FLATTEST * max(abs(end) for end in axes.get_ylim()))
    those = f", the {len(shown)} largest of {len(pressed)}" if len(shown) < len(pressed) else ""
    style.dress(axes, run, f"Contact forces{summed}{those}", "f [N]", show_events=False)
    return styles


def draw_closed(axes: Axes, run: Run, names: tuple[str, ...]) -> None:
    """Draw a bar for each time that a contact is closed, by its name: dark as it sticks or rolls, light as it slides.

    Of more than a page has room for, those that are closed longest.
    """
    from matplotlib.patches import Patch

    closed = run.link_modes != FREE
    rows = np.sort(np.argsort(-closed.sum(axis=0), kind="stable")[:MOST_ROWS])
    for at, k in enumerate(rows):
        for mode, colour in ((STUCK, style.COLOURS[0]), (None, style.MANY[5])):
            now = closed[:, k] & ((run.link_modes[:, k] == STUCK) == (mode == STUCK))
            spans = spans_of(now, run.time)
            if spans:
                axes.broken_barh([(a, b - a) for a, b in spans], (at - 0.4, 0.8), color=colour, linewidth=0)
    axes.set_yticks(range(len(rows)), [names[k] for k in rows], fontsize="small")
    axes.set_ylim(len(rows) - 0.4, -0.6)
    axes.grid(axis="y", visible=False)
    handles = [Patch(color=style.COLOURS[0], label="sticks or rolls"), Patch(color=style.MANY[5], label="slides")]
    style.legend_beside_title(axes, handles)


def spans_of(now: NDArray[np.bool_], time: NDArray[np.float64]) -> list[tuple[float, float]]:
    """Return from when to when a condition holds, by the rows (N,) in which it does, s; a row counts to the next."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], now, [False]]).astype(int)))
    ends = np.append(time, time[-1])
    return [(float(ends[a]), float(ends[b])) for a, b in edges.reshape(-1, 2)]
