"""The laws of friction as one interface for the code inside a step.

    F_t = −f c − w        friction of the surface on the tip, N, along d = 2 tangents; c (d,) without unit, w (d,) in N
    τ   = −c − w          friction of one joint, N m: d = 1 and f = 1

`kind` is a number of `layout.KINDS` and `par` (PARAMETERS,) its parameters, from `packing.pack`; `z` has the
`layout.state_count(kind, d)` states. Two dimensions are isotropic: only lengths and directions enter. Since c and
w do not depend on f, Eq. 24 stays linear in it.

A simulator that uses every law

    start          `rest_states` for a contact that has been there for long, `contact_states` for one just made
    each state     stuck and sticks "rigid": u = 0 is a constraint; "spring": `holding`; otherwise: `sliding`
    each step      `rates` in a Runge-Kutta scheme, or `advance_states` with the slip of the step
    slip ends      |u| = 0, or <= `capture_speed`, and `stick_limit` f is enough to hold it: `stick_states`, stuck
    stick ends     the force reaches `stick_limit` f: no longer stuck
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from closedloop.friction import bristle, coulomb, coulomb_viscous, dahl, karnopp, lugre, none, seven_parameter, stribeck
from closedloop.friction.layout import (
    COULOMB,
    COULOMB_VISCOUS,
    DAHL,
    DISPLACEMENT,
    DWELL,
    KARNOPP,
    KINETIC,
    LAST,
    LUGRE,
    MEMORY_DELAY,
    SEVEN_PARAMETER,
    STATIC,
    STATIC_EXCESS,
    STIFFNESS,
    STILL,
    STRIBECK,
)
from closedloop.jit.kernel import kernel

Array = NDArray[np.float64]


@kernel
def speed_of(u: Array) -> float:
    """Return |u| of a (1,) or (2,) vector."""
    return abs(u[0]) if u.shape[0] == 1 else math.hypot(u[0], u[1])


@kernel
def sliding(
    kind: int, par: Array, u: Array, delayed_speed: float, z: Array, direction: Array, c: Array, w: Array
) -> None:
    """Write the friction of a contact that slides, or of a law without a mode of sticking: F_t = −f c − w.

    Parameters
    ----------
    kind, par : int, (PARAMETERS,) array
        The law and its parameters.
    u : (d,) array
        Slip velocity of the tip on the surface, m/s; of a joint, rad/s.
    delayed_speed : float
        |u| of `memory_delay` ago, m/s; |u| itself for a law without memory.
    z : array
        States.
    direction : (d,) array
        Unit vector along which slip starts, used where |u| <= STILL; zero where none is to start: then there is
        no force but that of the states.
    c, w : (d,) arrays
        Written: the part per newton of normal force, without unit (N m for a joint), and the viscous part, N (N m).
    """
    speed = speed_of(u)
    coulomb_viscous.viscous_part(par, u, w)
    if kind == DAHL:
        dahl.force(par, z, c)
        return
    if kind == LUGRE:
        lugre.force(par, u, speed, z, c)
        return
    level = none.level(par)
    if kind in (COULOMB, COULOMB_VISCOUS):
        level = coulomb.level(par)
    elif kind == KARNOPP:
        level = karnopp.level(par)
    elif kind == STRIBECK:
        level = stribeck.level(par, speed)
    elif kind == SEVEN_PARAMETER:
        level = seven_parameter.level(par, delayed_speed, z)
    for k in range(u.shape[0]):
        c[k] = level * (u[k] / speed if speed > STILL else direction[k])


@kernel
def holding(kind: int, par: Array, z: Array, c: Array, w: Array) -> None:
    """Write the friction of a stuck contact of a law that sticks as a spring: c = k_t x, w = 0, (d,) each."""
    for k in range(c.shape[0]):
        c[k] = par[STIFFNESS] * z[DISPLACEMENT + k] if kind == SEVEN_PARAMETER else 0.0
        w[k] = 0.0


@kernel
def rates(kind: int, par: Array, u: Array, stuck: bool, z: Array, dz: Array) -> None:
    """Write the time derivative of the states; `stuck` matters to the laws that stick as a spring alone."""
    if kind == DAHL:
        bristle.relax(dahl.yielding(par, speed_of(u)), u, z, dz)
    elif kind == LUGRE:
        bristle.relax(lugre.yielding(par, speed_of(u)), u, z, dz)
    elif kind == SEVEN_PARAMETER:
        dz[DWELL] = 1.0 if stuck else 0.0
        dz[LAST] = 0.0
        for k in range(u.shape[0]):
            dz[DISPLACEMENT + k] = u[k] if stuck else 0.0


@kernel
def advance_states(kind: int, par: Array, u: Array, stuck: bool, h: float, z: Array) -> None:
    """Overwrite the states with those h seconds later if the slip stays u: exact for every law, for any h >= 0."""
    if kind == DAHL:
        bristle.advance(dahl.yielding(par, speed_of(u)), u, h, z)
    elif kind == LUGRE:
        bristle.advance(lugre.yielding(par, speed_of(u)), u, h, z)
    elif kind == SEVEN_PARAMETER and stuck:
        z[DWELL] += h
        for k in range(u.shape[0]):
            z[DISPLACEMENT + k] += h * u[k]


@kernel
def stick_limit(kind: int, par: Array, z: Array) -> float:
    """Return the largest |F_t|/f that sticking resists, without unit (N m for a joint).

    Of an elastic law it is the largest level of slow sliding: loads below it are held, after a creep of microns.
    """
    if kind in (COULOMB, COULOMB_VISCOUS, DAHL):
        return par[KINETIC]  # type: ignore[no-any-return]
    if kind in (STRIBECK, KARNOPP, LUGRE):
        return par[STATIC]  # type: ignore[no-any-return]
    if kind == SEVEN_PARAMETER:
        return seven_parameter.breakaway(par, z)
    return 0.0


@kernel
def stick_states(kind: int, par: Array, delayed_speed: float, direction: Array, z: Array) -> None:
    """Overwrite the states where slip along the unit vector `direction` (d,) has ended and sticking begins."""
    if kind == SEVEN_PARAMETER:
        seven_parameter.stick(par, delayed_speed, direction, z)


@kernel
def rest_states(kind: int, par: Array, z: Array) -> None:
    """Write the states of a contact that has rested for long: nothing bent, static friction fully risen."""
    contact_states(z)
    if kind == SEVEN_PARAMETER:
        z[LAST] = par[STATIC_EXCESS]


@kernel
def contact_states(z: Array) -> None:
    """Write the states of a contact just made: nothing bent, static friction still to rise."""
    for k in range(z.shape[0]):
        z[k] = 0.0


@kernel
def capture_speed(kind: int, par: Array) -> float:
    """Return the slip speed up to which sticking is tried, m/s: karnopp's dead band, 0 for the others."""
    return karnopp.dead_band(par) if kind == KARNOPP else 0.0


@kernel
def memory_delay(kind: int, par: Array) -> float:
    """Return by how much the friction lags the slip, s: τ_L of seven_parameter, 0 for the others."""
    return par[MEMORY_DELAY] if kind == SEVEN_PARAMETER else 0.0


@kernel
def stored_energy(kind: int, par: Array, stuck: bool, z: Array, d: int) -> float:
    """Return the energy stored in the contact per newton of normal force, m; of a joint, J.

    With f constant F_t·u + f d/dt(this) <= 0: friction never adds energy (lugre: if `lugre.is_passive`). Where f
    changes, f·this changes with it: pressing harder on bent bristles stiffens them.
    """
    if kind in (DAHL, LUGRE):
        deflection = math.hypot(z[0], z[1]) if d == 2 else abs(z[0])
        return 0.5 * par[STIFFNESS] * deflection * deflection  # type: ignore[no-any-return]
    if kind == SEVEN_PARAMETER:
        return seven_parameter.stored(par, stuck, z, d)
    return 0.0
