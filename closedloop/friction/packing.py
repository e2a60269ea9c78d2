"""From a section of a scenario to the arrays that the kernels read."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from closedloop.errors import ScenarioError
from closedloop.friction.layout import (
    DAMPING,
    DAMPING_SPEED,
    DEAD_BAND,
    EXPONENT,
    KINDS,
    KINETIC,
    LUGRE,
    MEMORY_DELAY,
    PARAMETERS,
    RISE_TIME,
    SEVEN_PARAMETER,
    STATIC,
    STATIC_EXCESS,
    STIFFNESS,
    STRIBECK_SPEED,
    VISCOUS,
)
from closedloop.friction.lugre import is_passive, passive_damping_speed, passive_viscous
from closedloop.friction.sections import Law, entries, names_of

Array = NDArray[np.float64]

PLACES = {
    "coefficient": KINETIC,
    "kinetic": KINETIC,
    "static": STATIC,
    "static_excess": STATIC_EXCESS,
    "stribeck_speed": STRIBECK_SPEED,
    "exponent": EXPONENT,
    "viscous": VISCOUS,
    "stiffness": STIFFNESS,
    "damping": DAMPING,
    "damping_speed": DAMPING_SPEED,
    "dead_band": DEAD_BAND,
    "memory_delay": MEMORY_DELAY,
    "rise_time": RISE_TIME,
}
"""Name of a parameter in a section to its column in a row of parameters."""


def pack(section: Law, n: int | None = None, where: str = "friction") -> tuple[int, Array]:
    """Return the number of the law and its parameters.

    Parameters
    ----------
    section : Law
        A section of friction, of a surface or of joints.
    n : int, optional
        The number of joints; left out for a surface.
    where : str
        The section's name in messages.

    Returns
    -------
    kind : int
        See `layout.KINDS`.
    par : (PARAMETERS,) array, or (n, PARAMETERS) array
        Parameters of the surface, or one row per joint; read-only. What a law does not have is 0, but for a static
        level equal to the kinetic one, and speeds, which are infinite.

    Raises
    ------
    ScenarioError
        If a parameter does not have one entry per joint.
    """
    kind = KINDS[getattr(section, "kind", "")]
    par = np.zeros((1 if n is None else n, PARAMETERS))
    par[:, [STRIBECK_SPEED, DAMPING_SPEED]] = math.inf
    for name in names_of(section):
        value: Any = getattr(section, name)
        if value is None:
            continue
        given = entries(value)
        if isinstance(value, tuple) and len(given) != par.shape[0]:
            wanted = "must be one number" + ("" if n is None else f" or {n}, one per joint")
            raise ScenarioError(f"{where}.{name} has {len(given)} entries: {wanted}")
        par[:, PLACES[name]] = given
    if "static" not in names_of(section):
        par[:, STATIC] = par[:, KINETIC]
    if kind == SEVEN_PARAMETER:
        par[:, STATIC] += par[:, STATIC_EXCESS]
    par.setflags(write=False)
    return kind, par[0] if n is None else par


def energy_fault(section: Law, load: float = 1.0, n: int | None = None) -> str | None:
    """Return why this friction might add energy and what would keep it from it, or None if it never does.

    Only lugre may, at high speed and with the constant damping of its publication; see `closedloop.friction.lugre`.

    Parameters
    ----------
    section : Law
        A section of friction.
    load : float
        The largest normal force on the surface, N; 1 for joints.
    n : int, optional
        The number of joints; left out for a surface.
    """
    kind, par = pack(section, n)
    if kind != LUGRE:
        return None
    for joint, row in enumerate(np.atleast_2d(par)):
        if is_passive(row, load):
            continue
        place, speed, unit = ("", "m/s", "N s/m") if n is None else (f" of joint {joint}", "rad/s", "N m s/rad")
        cures = (
            f"damping_speed = {passive_damping_speed(row):.3g} {speed} or less",
            f"viscous = {passive_viscous(row, load):.3g} {unit} or more",
        )
        return f"lugre{place} may add energy at high speed: {cures[0]}, or {cures[1]}, would keep it from that"
    return None
