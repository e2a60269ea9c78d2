"""A picture of each law: its curve over slip, its loop before slip, its rise with rest."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import NDArray

from closedloop.files import write_whole
from closedloop.friction.laws import advance_states, rest_states, sliding, stick_limit
from closedloop.friction.layout import (
    DAHL,
    DEAD_BAND,
    KARNOPP,
    KINDS,
    KINETIC,
    LUGRE,
    NONE,
    RISE_TIME,
    SEVEN_PARAMETER,
    STATIC,
    STATIC_EXCESS,
    STIFFNESS,
    STRIBECK_SPEED,
    state_count,
)
from closedloop.friction.packing import pack
from closedloop.friction.sections import JointLaw, Law, entries, names_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = NDArray[np.float64]
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00")  # Okabe and Ito


def draw(section: Law, target: str | Path | Axes, load: float = 1.0) -> None:
    """Draw a law of friction.

    Into a file go all its pictures: the force over the slip speed, for dahl and lugre cycles of force over displacement
    before slip, for seven_parameter the static friction over dwell time. On given axes only the last of them, which
    is the one that tells the law from the others. One line a joint where joints differ.

    Parameters
    ----------
    section : Law
        A section of friction, of a surface or of joints.
    target : path or matplotlib Axes
        A file to write, .png, .svg or .pdf, or the axes to draw on.
    load : float
        Normal force f, N; for joints 1.

    Raises
    ------
    OutputError
        If the file cannot be written.
    """
    counts = [len(entries(getattr(section, name))) for name in names_of(section) if getattr(section, name) is not None]
    kind, rows = pack(section, max(counts, default=1)) if max(counts, default=1) > 1 else pack(section)
    joint = isinstance(section, JointLaw)
    pictures: list[Callable[..., None]] = {DAHL: [_loop], LUGRE: [_curve, _loop], SEVEN_PARAMETER: [_curve, _rise]}.get(
        kind, [_curve]
    )
    if not isinstance(target, (str, Path)):
        pictures[-1](target, kind, np.atleast_2d(rows), load, joint)
        return
    import matplotlib as mpl

    from closedloop.figures import STYLE

    with mpl.rc_context(cast(Any, STYLE)):
        from matplotlib.figure import Figure

        figure: Figure = Figure(figsize=(4.8 * len(pictures), 3.4), layout="constrained")
        for axes, picture in zip(figure.subplots(1, len(pictures), squeeze=False)[0], pictures, strict=True):
            picture(axes, kind, np.atleast_2d(rows), load, joint)
        path = Path(target) if Path(target).suffix else Path(target).with_suffix(".png")
        write_whole(path, lambda file: figure.savefig(file, format=path.suffix[1:]))


def _curve(axes: Axes, kind: int, rows: Array, load: float, joint: bool) -> None:
    """Draw the force of steady slip over its speed, and how much sticking resists."""
    marks = [*rows[np.isfinite(rows[:, STRIBECK_SPEED]), STRIBECK_SPEED], *rows[rows[:, DEAD_BAND] > 0.0, DEAD_BAND]]
    span = (20.0 if kind == SEVEN_PARAMETER else 5.0) * float(max(marks, default=0.02))
    factor, unit = _prefixed(span, "rad/s" if joint else "m/s")
    right = span * np.linspace(1e-9, 1.0, 400)
    for k, row in enumerate(rows):
        colour = COLOURS[k % len(COLOURS)]
        force = np.array([_steady(kind, row, v, load) for v in right])
        axes.plot(factor * right, force, color=colour, label=_name(rows, k, "sliding"))
        axes.plot(-factor * right, -force, color=colour)
        limit = load * stick_limit(kind, row, _rested(kind, row))
        if kind != NONE:
            label = "" if len(rows) > 1 else "sticking, at most"
            axes.plot([0, 0], [-limit, limit], color=colour, linewidth=2.4, alpha=0.5, label=label)
            axes.plot([0, 0], [-limit, limit], "o", color=colour, markersize=4)
        if kind == KARNOPP:
            width = factor * row[DEAD_BAND]
            axes.axvspan(-width, width, color=colour, alpha=0.12, linewidth=0, label=_name(rows, k, "dead band"))
    if kind == NONE:
        axes.set_ylim(-1.0, 1.0)
    what = "steady motion" if joint else "steady slip"
    axes.set_title(f"{_law(kind)}: {what}{' after a long rest' if kind == SEVEN_PARAMETER else ''}")
    axes.set_xlabel(f"{'joint' if joint else 'slip'} speed [{unit}]")
    axes.set_ylabel(_force_label(load, joint))
    axes.legend(loc="upper left")


def _loop(axes: Axes, kind: int, rows: Array, load: float, joint: bool) -> None:
    """Draw the force over displacement of slow cycles of three sizes, each with the way into it."""
    reach = float(np.max(rows[:, STATIC] / rows[:, STIFFNESS]))
    factor, unit = _prefixed(reach, "rad" if joint else "m")
    for k, row in enumerate(rows):
        for amplitude, style in ((4.0, "-"), (1.5, "--"), (0.4, ":")):
            x, force = _to_and_fro(kind, row, amplitude * reach, load)
            colour, label = COLOURS[k % len(COLOURS)], _name(rows, k, "") if style == "-" else ""
            axes.plot(factor * x, force, style, color=colour, label=label)
    axes.set_title(f"{_law(kind)}: slow cycles of three sizes")
    axes.set_xlabel(f"displacement [{unit}]")
    axes.set_ylabel(_force_label(load, joint))
    if len(rows) > 1:
        axes.legend(loc="upper left")


def _rise(axes: Axes, kind: int, rows: Array, load: float, joint: bool) -> None:
    """Draw the force at break-away over the dwell time before it, after a slide that left no Stribeck part."""
    times = np.linspace(0.0, 5.0 * max(float(np.max(rows[:, RISE_TIME])), 1e-3), 300)
    for k, row in enumerate(rows):
        colour = COLOURS[k % len(COLOURS)]
        force = [load * stick_limit(kind, row, np.array([t, 0.0, 0.0])) for t in times]
        axes.plot(times, force, color=colour, label=_name(rows, k, "break-away"))
        for level, label in ((row[KINETIC], "F_C"), (row[KINETIC] + row[STATIC_EXCESS], "F_C + F_S∞")):
            axes.axhline(load * level, color=colour, linestyle=":", linewidth=1)
            axes.annotate(label, (times[-1], load * level), xytext=(0, 3), textcoords="offset points", ha="right")
        if row[RISE_TIME] > 0.0:
            half = load * (row[KINETIC] + 0.5 * row[STATIC_EXCESS])
            axes.plot([row[RISE_TIME]], [half], "o", color=colour, label="" if len(rows) > 1 else "half way, at γ")
    axes.set_ylim(0.0, 1.15 * load * float(np.max(rows[:, STATIC])) or 1.0)
    axes.set_title(f"{_law(kind)}: static friction rises with rest")
    axes.set_xlabel("dwell time [s]")
    axes.set_ylabel(_force_label(load, joint))
    axes.legend(loc="lower right")


def _name(rows: Array, k: int, alone: str) -> str:
    """Return the label of joint k, or what to call the line where there is but one."""
    return f"joint {k}" if len(rows) > 1 else alone


def _law(kind: int) -> str:
    return next(name for name, number in KINDS.items() if number == kind)


def _rested(kind: int, row: Array) -> Array:
    z = np.zeros(state_count(kind, 1))
    rest_states(kind, row, z)
    return z


def _steady(kind: int, row: Array, speed: float, load: float) -> float:
    """Return the force against steady slip in +x, N."""
    z, u, c, w = _rested(kind, row), np.array([speed]), np.empty(1), np.empty(1)
    advance_states(kind, row, u, False, 1e9 if speed > 0.0 else 0.0, z)  # long enough for bristles to settle
    sliding(kind, row, u, speed, z, np.zeros(1), c, w)
    return float(load * c[0] + w[0])


def _to_and_fro(kind: int, row: Array, amplitude: float, load: float) -> tuple[Array, Array]:
    """Return displacement and force of a slow motion: out, then, after a gap, one cycle of those that follow."""
    phase = np.linspace(0.0, 4.5 * math.pi, 1801)
    x = amplitude * np.sin(phase)
    z, force, h = _rested(kind, row), np.zeros_like(x), 1e6
    for i in range(1, x.size):
        advance_states(kind, row, np.array([(x[i] - x[i - 1]) / h]), False, h, z)
        force[i] = load * row[STIFFNESS] * z[0]
    force[(phase > 0.5 * math.pi) & (phase < 2.5 * math.pi)] = np.nan
    return x, force


def _force_label(load: float, joint: bool) -> str:
    return "torque against the motion [N m]" if joint else f"force against the slip, f = {load:g} N [N]"


def _prefixed(size: float, unit: str) -> tuple[float, str]:
    """Return the factor and unit that make a length or speed readable."""
    for factor, prefix in ((1.0, ""), (1e3, "m"), (1e6, "µ")):
        if size * factor >= 0.5:
            return factor, prefix + unit
    return 1e9, "n" + unit
