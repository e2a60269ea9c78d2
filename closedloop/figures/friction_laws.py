"""A picture of each law: its curve over slip, its loop before slip, its rise with rest."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np

from closedloop.base.arrays import Array
from closedloop.base.files import write_whole
from closedloop.base.sections import JOINT_SPEED_SCALE, PERIOD, SPEED_SCALE, Size, sizes
from closedloop.mechanics.friction.contact import Contact, joint_contacts, surface_contact
from closedloop.mechanics.friction.law import FrictionLaw, SurfaceFriction
from closedloop.mechanics.friction.laws.none import NoFriction

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00")  # Okabe and Ito


def draw(section: FrictionLaw, target: str | Path | Axes, load: float = 1.0) -> None:
    """Draw a law of friction.

    Into a file go all its pictures: the force over the slip speed; of an elastic law with bristles, cycles of force
    over displacement before slip; of one that sticks as a spring, the static friction over dwell time. On given axes
    only the last of them, which is the one that tells the law from the others. One line a joint where joints differ.

    Parameters
    ----------
    target : path or matplotlib Axes
        A file to write, .png, .svg or .pdf, or the axes to draw on.
    load : float
        Normal force f, N; for joints 1.
    """
    law = _Law(section, load)
    pictures: list[Callable[[Axes, _Law], None]] = [_curve]
    if section.sticks == "spring":
        pictures.append(_rise)
    elif section.slip_states:
        pictures.append(_loop)
    if not isinstance(target, (str, Path)):
        pictures[-1](target, law)
        return
    from closedloop.figures.style import styled

    with styled():
        from matplotlib.figure import Figure

        figure: Figure = Figure(figsize=(4.8 * len(pictures), 3.4), layout="constrained")
        for axes, picture in zip(figure.subplots(1, len(pictures), squeeze=False)[0], pictures, strict=True):
            picture(axes, law)
        path = Path(target) if Path(target).suffix else Path(target).with_suffix(".png")
        write_whole(path, lambda file: figure.savefig(file, format=path.suffix[1:]))


class _Law:
    """What is drawn: a section's contacts, along a line, under a load."""

    def __init__(self, section: FrictionLaw, load: float) -> None:
        self.section, self.load, self.joint = section, load, not isinstance(section, SurfaceFriction)
        one = None if self.joint else surface_contact(section)
        self.contacts = joint_contacts(section) if one is None else [Contact(one.member, one.par, 1)]

    def largest(self, size: Size, otherwise: float) -> float:
        """Return the largest parameter of a size, such as the speeds; `otherwise` if there is none."""
        found: list[float] = []
        for name, field in type(self.section).model_fields.items():
            value = getattr(self.section, name)
            if value is not None and size in sizes(Annotated[field.annotation, *field.metadata, None]):
                found.extend(np.atleast_1d(value).tolist())
        return max(found, default=otherwise)

    def name(self, k: int, alone: str) -> str:
        """Return the label of joint k, or what to call the line where there is but one."""
        return f"joint {k}" if len(self.contacts) > 1 else alone

    def finish(self, axes: Axes, title: str, across: str) -> None:
        """Write the title and the names of the axes."""
        axes.set(title=f"{self.section.member_name()}: {title}", xlabel=across)
        axes.set_ylabel(
            "torque against the motion [N m]" if self.joint else f"force against the slip, f = {self.load:g} N [N]"
        )


def _curve(axes: Axes, law: _Law) -> None:
    """Draw the force of steady slip over its speed, and how much sticking resists."""
    spring, none = law.section.sticks == "spring", isinstance(law.section, NoFriction)
    span = (20.0 if spring else 5.0) * law.largest(JOINT_SPEED_SCALE if law.joint else SPEED_SCALE, 0.02)
    factor, unit = _prefixed(span, "rad/s" if law.joint else "m/s")
    right = span * np.linspace(1e-9, 1.0, 400)
    for k, contact in enumerate(law.contacts):
        colour = COLOURS[k % len(COLOURS)]
        force = np.array([_steady(contact, v, law.load) for v in right])
        axes.plot(factor * right, force, color=colour, label=law.name(k, "sliding"))
        axes.plot(-factor * right, -force, color=colour)
        contact.rested()
        limit = law.load * contact.stick_limit
        if not none:
            label = "" if len(law.contacts) > 1 else "sticking, at most"
            axes.plot([0, 0], [-limit, limit], color=colour, linewidth=2.4, alpha=0.5, label=label)
            axes.plot([0, 0], [-limit, limit], "o", color=colour, markersize=4)
        if contact.capture_speed > 0.0:
            width = factor * contact.capture_speed
            axes.axvspan(-width, width, color=colour, alpha=0.12, linewidth=0, label=law.name(k, "dead band"))
    if none:
        axes.set_ylim(-1.0, 1.0)
    what = "steady motion" if law.joint else "steady slip"
    law.finish(
        axes, f"{what}{' after a long rest' if spring else ''}", f"{'joint' if law.joint else 'slip'} speed [{unit}]"
    )
    axes.legend(loc="upper left")


def _loop(axes: Axes, law: _Law) -> None:
    """Draw the force over displacement of slow cycles of three sizes, each with the way into it."""
    reach = max(_reach(contact) for contact in law.contacts)
    factor, unit = _prefixed(reach, "rad" if law.joint else "m")
    for k, contact in enumerate(law.contacts):
        for amplitude, style in ((4.0, "-"), (1.5, "--"), (0.4, ":")):
            x, force = _to_and_fro(contact, amplitude * reach, law.load)
            colour, label = COLOURS[k % len(COLOURS)], law.name(k, "") if style == "-" else ""
            axes.plot(factor * x, force, style, color=colour, label=label)
    law.finish(axes, "slow cycles of three sizes", f"displacement [{unit}]")
    if len(law.contacts) > 1:
        axes.legend(loc="upper left")


def _rise(axes: Axes, law: _Law) -> None:
    """Draw the force at break-away over the dwell time before it, after a slide that left no Stribeck part."""
    times = np.linspace(0.0, 5.0 * max(law.largest(PERIOD, 0.0), 1e-3), 300)
    top = 0.0
    for k, contact in enumerate(law.contacts):
        colour = COLOURS[k % len(COLOURS)]
        force = law.load * np.array([_limit_after(contact, t) for t in times])
        axes.plot(times, force, color=colour, label=law.name(k, "break-away"))
        contact.rested()
        kinetic, most = law.load * contact.kinetic_level, law.load * contact.stick_limit
        top = max(top, most)
        for level, label in ((kinetic, "F_C"), (most, "F_C + F_S∞")):
            axes.axhline(level, color=colour, linestyle=":", linewidth=1)
            axes.annotate(label, (times[-1], level), xytext=(0, 3), textcoords="offset points", ha="right")
        half = 0.5 * (kinetic + most)
        if force[0] < half < force[-1]:
            after = float(np.interp(half, force, times))
            label = "" if len(law.contacts) > 1 else f"half way, after {after:.2g} s"
            axes.plot([after], [half], "o", color=colour, label=label)
    axes.set_ylim(0.0, 1.15 * top or 1.0)
    law.finish(axes, "static friction rises with rest", "dwell time [s]")
    axes.legend(loc="lower right")


def _limit_after(contact: Contact, dwell: float) -> float:
    """Return |F_t|/f at break-away of a contact just made, stuck for `dwell`, s."""
    contact.states[:] = 0.0
    contact.advance(np.zeros(1), dwell, stuck=True)
    return contact.stick_limit


def _steady(contact: Contact, speed: float, load: float) -> float:
    """Return the force against steady slip in +x, N."""
    contact.rested()
    u = np.array([speed])
    if contact.states.size and speed > 0.0:
        contact.advance(u, 1e9)  # long enough for bristles to settle
    c, w = contact.slide(u)
    return float(load * c[0] + w[0])


def _reach(contact: Contact) -> float:
    """Return how far bristles bend in slow steady slip, m (rad)."""
    contact.rested()
    contact.advance(np.array([1e-12]), 1e15)
    return float(np.max(np.abs(contact.states)))


def _to_and_fro(contact: Contact, amplitude: float, load: float) -> tuple[Array, Array]:
    """Return displacement and force of a slow motion: out, then, after a gap, one cycle of those that follow."""
    phase = np.linspace(0.0, 4.5 * math.pi, 1801)
    x = amplitude * np.sin(phase)
    force, h = np.zeros_like(x), 1e6
    contact.rested()
    for i in range(1, x.size):
        u = np.array([(x[i] - x[i - 1]) / h])
        contact.advance(u, h)
        force[i] = load * contact.slide(u)[0][0]
    force[(phase > 0.5 * math.pi) & (phase < 2.5 * math.pi)] = np.nan
    return x, force


def _prefixed(size: float, unit: str) -> tuple[float, str]:
    """Return the factor and unit that make a length or speed readable."""
    for factor, prefix in ((1.0, ""), (1e3, "m"), (1e6, "µ")):
        if size * factor >= 0.5:
            return factor, prefix + unit
    return 1e9, "n" + unit
