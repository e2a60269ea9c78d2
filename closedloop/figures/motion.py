"""How a run moves: the tip (Fig. 4 of the paper) and the tool on it, the joints, free bodies; and any columns."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError
from closedloop.figures import style
from closedloop.mechanics.surface.placed import contact_frame, unit
from closedloop.record.columns.derived import DERIVED, WRENCH, DerivedColumn, part_labels
from closedloop.record.columns.record import SYMBOLS, Column
from closedloop.record.run import Run, units_by_kind
from closedloop.scenario.messages import typeset
from robot_models import RobotModel
from robot_models.coordinates import PLACES

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


# A desired motion slower than this share of its largest step has no direction of its own.
STILL = 1e-3


class TipErrors(NamedTuple):
    """Tip errors r − r_des (N,), m: along the path, across it in the surface, along the normal."""

    along: Array
    across: Array
    normal: Array


def frame_of(run: Run) -> Array:
    """Return the contact frame at the surface's origin (3, 3): rows n, t1, t2 in base axes."""
    return contact_frame(unit(run.scenario.surface.normal, "surface.normal"))


def directions(run: Run) -> Array:
    """Return unit vectors along the path in the surface (N, 3), base frame; at rest that of the motion before.

    Before the first motion it is that of the first; of a reference that never moves along the surface it is t1. On a
    surface that moves it is the motion along the surface, without that of the surface.
    """
    normals = run.surface_normal
    step = np.gradient(run.reference_tip, axis=0) if len(run) > 1 else np.zeros_like(run.reference_tip)
    if len(run) > 1 and run.scenario.surface_motion.kind != "none":
        carried = run.velocity - run.slip_velocity - run.closure_rate[:, None] * normals
        step -= carried * np.gradient(run.time)[:, None]
    step = _along(step, normals)
    size = np.sqrt(_dot(step, step))
    moves = size > max(STILL * float(np.max(size, initial=0.0)), 1e-12)
    if not np.any(moves):
        found = np.tile(frame_of(run)[1], (len(run), 1))
    else:
        found = step[np.maximum.accumulate(np.where(moves, np.arange(len(run)), np.argmax(moves)))]
    found = _along(found, normals)  # of a surface that curves away since
    return found / np.sqrt(_dot(found, found))[:, None]


def _along(x: Array, normals: Array) -> Array:
    """Return the parts of vectors (N, 3) along the surface."""
    return x - _dot(x, normals)[:, None] * normals


def _dot(x: Array, y: Array) -> Array:
    """Return the inner products (N,) of vectors (N, 3)."""
    return np.einsum("ij,ij->i", x, y)


def sideways(run: Run, along: Array) -> Array:
    """Return the direction across the path (N, 3) in the surface, on the left of `along` (N, 3) seen from outside."""
    return np.cross(run.surface_normal, along)


def tip_errors(run: Run) -> TipErrors:
    """Return the tip's errors against the desired tip position."""
    off, along = run.position - run.reference_tip, directions(run)
    return TipErrors(*(_dot(off, axis) for axis in (along, sideways(run, along), run.surface_normal)))


# Displacements below this share of the largest are not seen beside it, and get a panel of their own; what is below
# ROUNDING, m, is what many steps have rounded off.
SMALL, ROUNDING = 0.01, 1e-12


def tip_position(run: Run, ax: Axes | Sequence[Axes] | None = None) -> Figure:
    """Draw the tip's position against time (Fig. 4), its displacement from the start, and small components of that.

    For `ax` see `closedloop.figures`.
    """
    moved = run.position - run.position[0]
    sizes = np.max(np.abs(moved), axis=0)
    if style.length_unit(float(sizes.max()))[1] == "mm":
        small = [k for k in range(3) if ROUNDING < sizes[k] < SMALL * sizes.max()]
    else:
        small = [0, 1, 2]
    slide = run.scenario.reference.kind == "line" and not style.contact_changes(run)
    ratios = [2, 2, 1] if small else [1, 1]
    figure, drawn = style.panels(len(ratios), 6.2 if small else 4.8, ax, ratios)
    where, above = drawn[:2]
    for k, axis in enumerate("xyz"):
        name = f"{axis} from {round(run.position[0, k], 4) + 0.0:.4f} m"
        where.plot(run.time, run.position[:, k], style.STROKES[k], color=style.COLOURS[k], label=axis)
        above.plot(run.time, 1e3 * moved[:, k], style.STROKES[k], color=style.COLOURS[k], label=name)
    for axes in (where, above):
        axes.margins(y=0.15)
    style.dress(where, run, "Tip, base frame", "position [m]", show_events=False)
    style.legend_beside_title(where)
    style.dress(above, run, "Displacement", "displacement [mm]", label_marks=False, show_events=not small)
    style.legend_beside_title(above)
    if small:
        below = drawn[2]
        factor, unit = style.length_unit(float(sizes[small].max()))
        for k in small:
            below.plot(run.time, factor * moved[:, k], style.STROKES[k], color=style.COLOURS[k], label="xyz"[k])
        title = "Displacement off the path" if slide else "Small components of the displacement"
        style.dress(below, run, title, f"[{unit}]", label_marks=False)
        style.legend_beside_title(below)
    return style.finished(figure, drawn, run)


# A moment that is less than this times the force, with an arm of a metre, is rounding.
TURN_ROUNDING = 1e-13


def has_tool(run: Run) -> bool:
    """Whether the arm carries something, or the orientation of the tool is held."""
    held = getattr(run.scenario.reference, "orientation", "free") != "free"
    return bool(held or run.scenario.tool.mass or run.scenario.model_error.payload)


def tool(run: Run, ax: Axes | Sequence[Axes] | None = None) -> Figure:
    """Draw the force and the moment at the wrist, in the axes of the frame robot.tip, and the angle of the tool.

    A moment that is zero to rounding has no panel. For `ax` see `closedloop.figures`.
    """
    force, moment = (float(np.max(np.linalg.norm(part, axis=1))) for part in np.split(run.wrist_wrench, 2, axis=1))
    parts = [("Force at the wrist", "N", 0), ("Moment", "N m", 3)]
    if moment < TURN_ROUNDING * max(1.0, force):
        parts.pop()
    figure, drawn = style.panels(len(parts) + 1, 1.6 + 1.6 * (len(parts) + 1), ax)
    for axes, (title, units, first) in zip(drawn, parts, strict=False):
        part = run.wrist_wrench[:, first : first + 3]
        for k in range(3):
            axes.plot(run.time, part[:, k], color=style.MANY[k], label=WRENCH[first + k])
        axes.margins(y=0.08)
        largest = float(np.max(np.linalg.norm(part, axis=1)))
        label = f"{title.split()[0].lower()} [{units}]"
        style.dress(
            axes, run, f"{title}, up to {largest:.3g} {units}", label, label_marks=first == 0, show_events=False
        )
        style.legend_beside_title(axes)
    last = drawn[-1]
    last.plot(run.time, run.tool_angle, color=style.MANY[0], label="from the normal")
    last.plot(run.time, run.orientation_error, "--", color=style.MANY[1], label="from its reference")
    last.margins(y=0.08)
    told = f"Angle of the tool, up to {float(np.max(run.tool_angle)):.3g} deg"
    style.dress(last, run, told, "angle [deg]", label_marks=False)
    style.legend_beside_title(last)
    return style.finished(figure, drawn, run)


# A limit is drawn if the axis need not be longer than this times the range of the data for it; it is named in any case.
ROOM = 2.0


def has_joints(run: Run) -> bool:
    """Tell whether the run has a joint that is not that of a free body."""
    return not all(in_bodies(run.model, positions=False))


def in_bodies(model: RobotModel, positions: bool) -> list[bool]:
    """Return whether each position, or each velocity, is that of a free body."""
    names = model.coordinate_names if positions else model.joint_names
    found = [False] * len(names)
    for j in model.bodies:
        at = names.index(model.joint_names[j])
        found[at : at + (7 if positions else 6)] = [True] * (7 if positions else 6)
    return found


def joints(run: Run, ax: Axes | Sequence[Axes] | None = None) -> Figure:
    """Draw the torque, velocity and position of every joint, with the limits of the robot's file as dashed lines.

    The coordinates of free bodies are left out: they have a figure of their own, `closedloop.figures.motion`.

    A limit far from all that the joint does is not drawn; the titles say how near the joints come to one. For `ax` see
    `closedloop.figures`.
    """
    model = run.model
    figure, on = style.panels(3, 6.4, ax)
    drawn = (
        ("Torque Q", "torque", -model.effort_limit, model.effort_limit, "torque"),
        ("Velocity", "velocity", -model.velocity_limit, model.velocity_limit, "v"),
        ("Position", "position", *_position_limits(model), "q"),
    )
    for axes, (title, label, low, high, name) in zip(on, drawn, strict=True):
        values = run.columns[name]
        held = [j for j, free in enumerate(in_bodies(model, positions=name == "q")) if not free]
        all_names = model.coordinate_names if name == "q" else model.joint_names
        names, values = tuple(all_names[j] for j in held), values[:, held]
        if len(low) != len(held):
            low, high = low[held], high[held]
        colours = _colours(run, names)
        for j, joint in enumerate(names):
            named = joint in colours
            axes.plot(
                run.time, values[:, j], color=colours.get(joint, style.OTHERS), label=joint if named else None,
                zorder=2.0 if named else 1.5,
            )  # fmt: skip
        axes.margins(y=0.08)
        of_named = [j for j, joint in enumerate(names) if joint in colours]
        _draw_limits(axes, values[:, of_named], low[of_named], high[of_named], [colours[names[j]] for j in of_named])
        kinds = model.coordinate_types if name == "q" else model.joint_types
        each = [typeset(units_by_kind(run.specs[name].units, kinds[j])) for j in held]
        units = " | ".join(dict.fromkeys(each))
        told = f"{title}, {_told(values, low, high, names, each, positions=name == 'q')}"
        style.dress(axes, run, told, f"{label} [{units}]", label_marks=axes is on[0], show_events=axes is on[-1])
    handles, named_joints = on[0].get_legend_handles_labels()
    grey = sum(not free for free in in_bodies(model, positions=False)) - len(named_joints)
    others = f"; grey: {grey} others" if grey else ""
    style.legend_outside(figure, "upper center", handles, 4, f"joints; limits dashed{others}", on[0])
    return style.finished(figure, on, run)


# What moves across, or turns, by no more than this, m or rad, does not: it has no panel.
AT_REST = 1e-9
HEIGHT = "z [mm]"
# Heights that change by less than this share of the way across are not drawn.
FLAT = 1e-3
# The axis of heights is at least so long, as a share of the longest way of a body.
LEAST = 0.01


def _position_limits(model: RobotModel) -> tuple[Array, Array]:
    """Return the limits of all positions, (nq,), rad (m); a quaternion has none."""
    if not model.balls:
        return model.position_lower, model.position_upper
    lower, upper = (dict(zip(model.joint_names, x, strict=True)) for x in (model.position_lower, model.position_upper))
    names = model.coordinate_names
    return np.array([lower.get(name, -np.inf) for name in names]), np.array([upper.get(name, np.inf) for name in names])


def _colours(run: Run, names: tuple[str, ...]) -> dict[str, str]:
    """Return the colour of each joint that is named: all of them, or those with a drive if they are too many."""
    model = run.model
    driven = [name for name, drive in zip(model.joint_names, model.driven, strict=True) if drive and name in names]
    chosen = names if len(names) <= style.MOST_CURVES else (driven or list(names))[: style.MOST_CURVES]
    return dict(zip(chosen, style.MANY, strict=False))


def _draw_limits(axes: Axes, values: Array, low: Array, high: Array, colours: Sequence[str]) -> None:
    """Draw the limits, each in its joint's colour, that are near what the joints do."""
    span = float(np.ptp(values))
    bottom, top = float(np.min(values)) - 0.5 * (ROOM - 1.0) * span, float(np.max(values)) + 0.5 * (ROOM - 1.0) * span
    reach = list(axes.get_ylim())
    for j in range(values.shape[1]):
        for limit in (float(low[j]), float(high[j])):
            if bottom <= limit <= top:
                axes.axhline(limit, color=colours[j], linestyle=(0, (6, 3)), linewidth=0.9)
                reach = [min(reach[0], limit - 0.05 * span), max(reach[1], limit + 0.05 * span)]
    axes.set_ylim(*reach)


def _told(values: Array, low: Array, high: Array, names: tuple[str, ...], units: Sequence[str], positions: bool) -> str:
    """Return how near the joints come to their limits, in words; `units` has that of each."""
    known = np.isfinite(low) & np.isfinite(high) & (high > low)
    if not np.any(known):
        return "no limits in the robot's file"
    if positions:
        room = np.minimum(np.min(values, axis=0) - low, high - np.max(values, axis=0))[known]
        j = int(np.argmin(room))
        which = np.flatnonzero(known)[j]
        distance = f"{abs(room[j]):.2g} {units[which]}"
        told = f"at least {distance} from every limit" if room[j] >= 0.0 else f"{distance} past a limit"
        return f"{told}: {names[which]}"
    share = np.max(np.abs(values), axis=0)[known] / high[known]
    j = int(np.argmax(share))
    which = np.flatnonzero(known)[j]
    return f"up to {float(f'{100.0 * share[j]:.2g}'):g} % of a limit: {names[which]}, ±{high[which]:g} {units[which]}"


def has_bodies(run: Run) -> bool:
    """Tell whether a body of the run is free."""
    return bool(run.model.bodies)


def rests(run: Run) -> bool:
    """Tell whether no free body of the run moves."""
    return all(
        np.max(np.abs(r - r[0]), initial=0.0) <= AT_REST and np.max(turned(turn), initial=0.0) <= AT_REST
        for r, turn in body_motions(run).values()
    )


def turned(quaternions: Array) -> Array:
    """Return the angle (N,), rad, from 0 to π, by which each of unit quaternions (N, 4) is turned from the first."""
    along = np.abs(quaternions @ quaternions[0])
    across = np.linalg.norm(quaternions - np.sign(quaternions @ quaternions[0])[:, None] * quaternions[0], axis=1)
    return 2.0 * np.arctan2(across * np.sqrt(np.maximum(1.0 - 0.25 * across**2, 0.0)), along)


def body_motions(run: Run) -> dict[str, tuple[Array, Array]]:
    """Return the positions (N, 3), m, and quaternions (N, 4) of each free body, by the name of its joint."""
    names, found = list(run.model.coordinate_names), {}
    for j in run.model.bodies:
        name = run.model.joint_names[j].removesuffix(PLACES[0])
        at = names.index(run.model.joint_names[j])
        found[name] = run.q[:, at : at + 3], run.q[:, at + 3 : at + 7]
    return found


def bodies(run: Run, ax: Axes | Sequence[Axes] | None = None) -> Figure:
    """Draw the height of each free body, its distance from the start across, and the angle from its start.

    Of more bodies than can be told apart those that move most are drawn. What does not change has no panel, except the
    height where nothing moves. For `ax` see `closedloop.figures`.
    """
    motions = body_motions(run)
    if not motions:
        raise ValueError("the run has no free body")
    size = {name: float(np.max(np.abs(r - r[0]))) for name, (r, _) in motions.items()}
    shown = sorted(sorted(motions, key=lambda name: -size[name])[: style.MOST_CURVES], key=list(motions).index)
    across = {name: np.hypot(*(motions[name][0] - motions[name][0][0])[:, :2].T) for name in shown}
    angles = {name: turned(motions[name][1]) for name in shown}
    furthest, most = (max(float(np.max(each)) for each in values.values()) for values in (across, angles))
    factor, unit = style.length_unit(furthest)
    drawn = []
    rise = max(float(np.ptp(motions[name][0][:, 2])) for name in shown)
    if rise > max(AT_REST, FLAT * furthest) or max(furthest, most) <= AT_REST:
        drawn.append(({name: 1e3 * motions[name][0][:, 2] for name in shown}, "Height", HEIGHT))
    if furthest > AT_REST:
        shifts, label = {name: factor * each for name, each in across.items()}, f"√(Δx² + Δy²) [{unit}]"
        drawn.append((shifts, "Horizontal distance from the start", label))
    if most > AT_REST:
        turns = {name: np.degrees(each) for name, each in angles.items()}
        drawn.append((turns, "Rotation from the start", "angle [°]"))
    figure, on = style.panels(len(drawn), 1.6 + 1.6 * len(drawn), ax)
    those = f"the {len(shown)} of {len(motions)} bodies that move most" if len(shown) < len(motions) else ""
    for axes, (curves, title, label) in zip(on, drawn, strict=True):
        for k, name in enumerate(shown):
            axes.plot(run.time, curves[name], color=style.MANY[k % len(style.MANY)], label=name)
        axes.margins(y=0.12)
        if label == HEIGHT:
            style.widen(axes, LEAST * 1e3 * max(furthest, *size.values()))
        first, title = axes is on[0], f"{title}: {those}" if axes is on[0] and those else title
        style.dress(axes, run, title, label, label_marks=first, show_events=axes is on[-1])
    style.legend_outside(figure, "upper center", on[0].get_legend_handles_labels()[0], 4, axes=on[0])
    return style.finished(figure, on, run)


def columns(run: Run, names: Sequence[str], ax: Axes | Sequence[Axes] | None = None) -> Figure:
    """Draw columns over time, a panel each; parts of a column, such as joints, are lines of its panel.

    Parameters
    ----------
    names : sequence of str
        Columns of the run, or their symbols, such as "f" and "e".
    ax
        See `closedloop.figures`.

    Raises
    ------
    ScenarioError
        If the run has no such column over time.
    """
    known: dict[str, Column | DerivedColumn] = {**run.specs, **DERIVED}
    over_time = [name for name, spec in known.items() if spec.dims[0] == "time" and name != "time"]
    for name in names:
        if SYMBOLS.get(name, name) not in over_time:
            symbols = [short for short, column in SYMBOLS.items() if column in over_time]
            raise ScenarioError(
                f"columns: {name!r}: the run has no such column over time; there are "
                f"{', '.join(symbols)}, {', '.join(over_time)}"
            )
    if not names:
        raise ScenarioError("columns: name at least one, such as f")
    figure, on = style.panels(len(names), 1.2 + 1.6 * len(names), ax)
    for axes, name in zip(on, names, strict=True):
        column = SYMBOLS.get(name, name)
        values, units = np.asarray(run[column]).reshape(len(run), -1), run.units(column)
        if units == "m":
            factor, units = style.length_unit(float(np.nanmax(np.abs(values), initial=0.0)) or 1.0)
            values = factor * values
        labels = part_labels(run, column)
        for k, label in enumerate(labels or (None,)):
            stroke = style.STROKES[k // len(style.MANY) % len(style.STROKES)]
            axes.plot(run.time, values[:, k], stroke, color=style.MANY[k % len(style.MANY)], label=label)
        axes.margins(y=0.1)
        unit = typeset(units) if units not in ("", "1") else ""
        text = name if name in SYMBOLS else name.replace("_", " ")
        style.dress(axes, run, "", f"{text} [{unit}]" if unit else text, label_marks=False, show_events=axes is on[-1])
        if len(labels) > 1:
            style.legend_beside_title(axes)
    return style.finished(figure, on, run)
