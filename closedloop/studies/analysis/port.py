"""The tip as the surface sees it: how it yields to a force along the normal."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from closedloop.base.arrays import Array, ComplexArray

# −Re Y/|Y| up to which a port is passive: the rounding of a response; and what sampling makes of one that is 0, per
# frequency in samples.
PASSIVE, SAMPLING = 1e-6, 0.1


@dataclass(frozen=True)
class Port:
    """How the tip yields to a force along the normal, as the surface sees it: Y = v/f.

    Attributes
    ----------
    frequency : (k,) array
        Hz, up to half of the sampling rate.
    admittance : (k,) array of complex
        Y, m/s/N: the velocity of the tip along n to f.
    passive : bool
        Whether Re Y ≥ 0 at all of them: then the loop is stable on every passive surface.
    active_at : float or None
        The frequency at which Re Y is the most negative, relative to |Y|, Hz; None if it is passive.
    """

    frequency: Array
    admittance: ComplexArray
    passive: bool
    active_at: float | None


def port_of(frequency: Array, velocity: ComplexArray, force: ComplexArray, sampled: float | None) -> Port:
    """Return the port of a tip with these responses to a displacement of the surface.

    Parameters
    ----------
    frequency : (k,) array
        Hz.
    velocity, force : (k,) arrays of complex
        Of the tip along n, m/s, and f, N.
    sampled : float or None
        The time between two samples, s, if f varies in between.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        Y = velocity / force
    known = np.isfinite(Y)
    share = np.where(known, Y.real / np.where(known, np.abs(Y), 1.0), 0.0)
    if sampled is not None:  # by so much Re Y is uncertain, and beyond a quarter of the sampling rate not known
        share = np.where(frequency < 0.25 / sampled, share + SAMPLING * frequency * sampled, 0.0)
    worst = int(np.argmin(share))
    passive = bool(share[worst] >= -PASSIVE)
    return Port(frequency, Y, passive, None if passive else float(frequency[worst]))
