"""How far a loop is from instability, from its transfer L where it is cut.

gain margin      by which a gain may rise, or fall, until L = −1
phase margin     by which the phase at |L| = 1 may lag
delay margin     the delay that the loop may have in addition: phase margin over frequency, the least of all crossings
modulus margin   the least distance of L from −1, 1/max|S|: it bounds all of them from below
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from scipy.optimize import brentq, minimize_scalar

from closedloop.base.arrays import Array, ComplexArray
from closedloop.base.plain import plain

# |L| below which there is no loop.
OPEN = 1e-12


@dataclass(frozen=True)
class Margins:
    """Margins of a loop cut at one place.

    Attributes
    ----------
    cut : str
        "sensor", or "torque[JOINT]".
    stable, closed : bool
        Whether the loop is stable, and whether anything is fed back there.
    gain, gain_at : float
        The factor by which the gain may rise, infinite if any, and the frequency at which it then oscillates, Hz.
    least_gain : float
        The factor by which the gain may fall, 0 if any: above it the loop is stable.
    phase, phase_at : float
        Phase margin, degrees, infinite if |L| is below 1 everywhere, and its frequency, Hz.
    delay : float
        Delay margin, s.
    modulus, peak_sensitivity, peak_at : float
        min |1 + L|, max |S| = 1/that, and where, Hz.
    """

    cut: str
    stable: bool
    closed: bool
    gain: float
    gain_at: float
    least_gain: float
    phase: float
    phase_at: float
    delay: float
    modulus: float
    peak_sensitivity: float
    peak_at: float

    @property
    def decibels(self) -> float:
        """Gain margin, dB: of a rise or a fall, whichever is nearer."""
        down = -20.0 * math.log10(self.least_gain) if self.least_gain > 0.0 else math.inf
        return min(20.0 * math.log10(self.gain) if self.gain < math.inf else math.inf, down)

    def as_dict(self) -> dict[str, Any]:
        """Return them as plain values; what is infinite, or has no place, is None."""
        return plain(asdict(self) | {"decibels": self.decibels})


def margins_of(transfer: Callable[[Array], ComplexArray], grid: Array, cut: str, stable: bool) -> Margins:
    """Return the margins of a loop transfer L.

    Parameters
    ----------
    transfer : callable
        L at frequencies, Hz.
    grid : (k,) array
        Frequencies, Hz, in order, close enough to each other that L turns little from one to the next.
    """
    L = transfer(grid)
    closed = bool(np.max(np.abs(L)) > OPEN)
    nan = math.nan
    if not closed:
        return Margins(cut, stable, False, math.inf, nan, 0.0, math.inf, nan, math.inf, 1.0, 1.0, nan)

    def at(f: float) -> complex:
        return complex(transfer(np.array([f]))[0])

    gain, gain_at, least = math.inf, nan, 0.0
    for i in np.flatnonzero((L.imag[:-1] * L.imag[1:] < 0.0) & ((L.real[:-1] < 0.0) | (L.real[1:] < 0.0))):
        f = float(brentq(lambda f: at(f).imag, grid[i], grid[i + 1], xtol=1e-14, rtol=1e-13))
        value = at(f)
        if value.real >= 0.0 or abs(value.imag) > 1e-3 * abs(value.real):
            continue
        factor = -1.0 / value.real
        if 1.0 <= factor < gain:
            gain, gain_at = factor, f
        elif least < factor < 1.0:
            least = factor
    last = L[-1]  # at half of the sampling rate L is real
    if last.real < 0.0 and abs(last.imag) <= 1e-3 * abs(last.real):
        factor = -1.0 / last.real
        if 1.0 <= factor < gain:
            gain, gain_at = factor, float(grid[-1])
        elif least < factor < 1.0:
            least = factor
    phase, phase_at, delay = math.inf, nan, math.inf
    size = np.log(np.maximum(np.abs(L), 1e-300))
    for i in np.flatnonzero(size[:-1] * size[1:] < 0.0):
        f = float(brentq(lambda f: math.log(abs(at(f))), grid[i], grid[i + 1], xtol=1e-14, rtol=1e-13))
        angle = math.degrees(math.atan2(at(f).imag, at(f).real))
        ahead = (angle + 180.0) % 360.0  # by which it may lag
        nearest = min(ahead, 360.0 - ahead)
        if nearest < phase:
            phase, phase_at = nearest, f
        delay = min(delay, math.radians(ahead) / (2.0 * math.pi * f))
    distance = np.abs(1.0 + L)
    k = int(np.argmin(distance))
    low, high = grid[max(k - 1, 0)], grid[min(k + 1, grid.size - 1)]
    best = minimize_scalar(lambda f: abs(1.0 + at(f)), bounds=(low, high), method="bounded", options={"xatol": 1e-10})
    modulus, peak_at = (float(best.fun), float(best.x)) if best.fun < distance[k] else (distance[k], grid[k])
    modulus = float(modulus)
    return Margins(
        cut, stable, True, gain, gain_at, least, phase, phase_at, delay, modulus,
        1.0 / modulus if modulus > 0.0 else math.inf, float(peak_at),
    )  # fmt: skip
