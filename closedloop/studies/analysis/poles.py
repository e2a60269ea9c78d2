"""A pole of the loop: how fast it decays, and which part it belongs to."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

# |z − 1| up to which a pole is one at rest: it changes nothing within a million samples. It is the square root of the
# rounding that a double pole at 1 splits by.
AT_REST = 1e-6
# |z| below which a mode is over at the next samples: it has no continuous equivalent.
DEADBEAT = 1e-6


@dataclass(frozen=True)
class Pole:
    """A pole of the loop.

    Attributes
    ----------
    z, s : complex
        From sample to sample, and the continuous equivalent ln(z)/dt, 1/s; −∞ for a pole at z = 0.
    frequency : float
        Natural frequency |s|, Hz.
    damping : float
        Damping ratio −Re s/|s|; 1 for a real pole that decays.
    participation : dict of str to float
        Share of each part: arm, contact, law, compensation, filter, sensor, delay, hold, transmission, friction,
        encoder; the sum is 1. The share of a state is |l_k r_k| with the left and the right eigenvector, normalised.
    """

    z: complex
    s: complex
    frequency: float
    damping: float
    participation: dict[str, float]

    @property
    def part(self) -> str:
        """The part with the largest share."""
        return max(self.participation, key=self.participation.__getitem__)

    @property
    def at_rest(self) -> bool:
        """Whether it neither decays nor grows: a joint that friction holds, a motion that nothing controls."""
        return abs(self.z - 1.0) < AT_REST

    @property
    def grows(self) -> bool:
        """Whether it is unstable."""
        return not self.at_rest and abs(self.z) >= 1.0

    def as_dict(self) -> dict[str, Any]:
        """Return it as plain numbers; a pole at z = 0 has no s."""
        over = not math.isfinite(self.s.real)
        return {
            "z": [self.z.real, self.z.imag], "s": None if over else [self.s.real, self.s.imag],
            "frequency": None if over else self.frequency, "damping": self.damping,
            "part": self.part, "participation": self.participation,
        }  # fmt: skip


def pole_at(z: complex, dt: float, participation: dict[str, float]) -> Pole:
    """Return the pole at z, of a loop whose samples are dt apart, s."""
    if abs(z) < DEADBEAT:
        return Pole(z, complex(-math.inf, 0.0), math.inf, 1.0, participation)
    s = complex(np.log(z)) / dt
    size = abs(s)
    return Pole(z, s, size / (2.0 * math.pi), -s.real / size if size > 0.0 else 1.0, participation)
