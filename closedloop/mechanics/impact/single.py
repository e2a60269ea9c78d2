"""One impact for reading: a law of restitution, and both phases.

What every law of restitution is: of what the coefficient is the ratio, and how large it is at this impact.

    class Viscous(Restitution):
        ratio_of = "energies"

        @staticmethod
        def coefficient(restitution, speed):
            return restitution / (1.0 + speed / 2.0)

What the three ratios share, the path of an impact in impulses, is in `closedloop.mechanics.impact.phases`. The
functions are called once for each impact, by Python.

One impact for reading, for users and for tests: `two_phase_impact`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import ArrayLike

from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError
from closedloop.base.families import Family, Member
from closedloop.jit.kernel import entry_kernel
from closedloop.jit.user_code import of_users
from closedloop.mechanics.closure.solve import OK
from closedloop.mechanics.impact.begin import MODE_NAMES, RATIOS
from closedloop.mechanics.impact.phases import impact
from closedloop.mechanics.impact.taylor import ImpactWork
from closedloop.mechanics.limits import FOUND


class Restitution(Member):
    """A law of restitution. Those that ship are in `closedloop.mechanics.impact.laws`, one file each.

    Attributes
    ----------
    ratio_of : str
        Of what the coefficient is the ratio, after to before: "velocities" along the normal; "impulses" of
        decompression to compression; "energies", the work of the normal impulse, whose ratio is its square.
    """

    folder: ClassVar[str] = "closedloop.mechanics.impact.laws"
    ratio_of: ClassVar[Literal["velocities", "impulses", "energies"]] = "energies"

    @staticmethod
    def coefficient(restitution: float, speed: float) -> float:
        """Return ε of an impact at this speed along the normal, m/s, from `impact.restitution`; 0 to 1."""
        return restitution


RESTITUTIONS = Family(Restitution)


def coefficient_at(law: type[Restitution], restitution: float, speed: float, key: str = "impact.law") -> float:
    """Return ε of an impact at a speed along the normal, m/s; `key` is what names the law, for messages.

    Raises
    ------
    ScenarioError
        If a user's law gives none from 0 to 1.
    """
    with of_users(law, key):
        given = float(law.coefficient(restitution, speed))
        if not 0.0 <= given <= 1.0:
            raise ScenarioError(
                f"{key} = {law.member_name()}: its coefficient at {speed:g} m/s is {given:g}: must be from 0 to 1"
            )
        return given


@dataclass(frozen=True, eq=False)
class Impact:
    """What an impact does to the tip; everything in the contact frame (n, t1, t2), arrays read-only.

    Attributes
    ----------
    compression, decompression : (3,) arrays
        Impulse of the surface on the robot in the two phases, N s.
    after : (3,) array
        Tip velocity after the impact, m/s.
    energy_lost : float
        Kinetic energy that the impact took, J.
    modes : tuple of str
        What happened, in this order: "slip" (the tip slid at some time), "turn" (the direction of slip turned),
        "reversal" (slip stopped and went on in another direction), "stick" (it stopped and stayed), "jam" (friction
        drove the tip into the surface for a while), "recompression" (the tip came back before decompression was over),
        "cut" (Newton's law would have created energy), "wedge" (held by friction, the tip could not leave).
    """

    compression: Array
    decompression: Array
    after: Array
    energy_lost: float
    modes: tuple[str, ...]

    @property
    def impulse(self) -> Array:
        """The whole impulse on the robot (3,), N s; H⁻¹Aᵀ times it is the change of the joint velocity."""
        return self.compression + self.decompression


def two_phase_impact(
    S: ArrayLike, u: ArrayLike, restitution: float, law: str = "newton", friction: float = 0.0
) -> Impact:
    """Return the impact of a tip with mobility S that meets the surface with velocity u.

    Parameters
    ----------
    S : (3, 3) array
        A H⁻¹Aᵀ in the contact frame (n, t1, t2), 1/kg, symmetric positive semidefinite, S[0, 0] > 0.
    u : (3,) array
        Tip velocity before, m/s; u[0] <= 0.
    restitution : float
        ε in [0, 1].
    law : str
        "newton", "poisson" or "stronge": of what ε is the ratio (see `closedloop.mechanics.impact`).
    friction : float
        Coulomb coefficient μ >= 0.

    Raises
    ------
    ScenarioError
        If one of these does not hold, or no impulse can end the approach.
    """
    mobility, before = _numbers("S", S, (3, 3)), _numbers("u", u, (3,))
    eps, mu = _number("restitution", restitution), _number("friction", friction)
    if not 0.0 <= eps <= 1.0:
        raise ScenarioError(f"restitution = {eps:g}: must be from 0 to 1")
    if mu < 0.0:
        raise ScenarioError(f"friction = {mu:g}: must not be negative")
    if law not in RESTITUTIONS:
        raise ScenarioError(f"law = {law!r}: must be {' or '.join(map(repr, RESTITUTIONS.names()))}")
    member = RESTITUTIONS[law]
    eps = coefficient_at(member, eps, -float(before[0]))
    if before[0] > 0.0:
        raise ScenarioError(f"u[0] = {before[0]:g} m/s: the tip moves off the surface; must not be positive")
    trace = float(np.trace(mobility))
    if np.max(np.abs(mobility - mobility.T)) > FOUND * trace:
        raise ScenarioError("S is not symmetric: must be A H^-1 A^T in the order (n, t1, t2)")
    if np.linalg.eigvalsh(mobility)[0] < -FOUND * trace:
        raise ScenarioError("S has a negative eigenvalue: must be A H^-1 A^T with a positive definite H")
    if not mobility[0, 0] > 0.0:
        raise ScenarioError(
            f"S[0, 0] = {mobility[0, 0]:g} 1/kg: the tip cannot move along the normal; must be positive"
        )
    compression, decompression, after = np.zeros(3), np.zeros(3), np.zeros(3)
    work = np.zeros(ImpactWork.count())
    if _impact(mobility, before, eps, RATIOS[member.ratio_of], mu, work, (compression, decompression), after) != OK:
        raise ScenarioError(
            f"u = {before.tolist()}: no impulse ends the approach; must be a velocity that a tip with this S can have"
        )
    for array in (compression, decompression, after):
        array.setflags(write=False)
    lost = float(-0.5 * (before + after) @ (compression + decompression))
    bits = int(ImpactWork(work).happened)
    return Impact(compression, decompression, after, lost, tuple(n for bit, n in MODE_NAMES.items() if bits & bit))


@entry_kernel
def _impact(
    S: Array, u: Array, restitution: float, law: int, mu: float, work: Array, phases: tuple[Array, Array], after: Array
) -> int:
    """`impact`, compiled once and kept on disk."""
    return impact(S, u, restitution, law, mu, work, phases, after)


def _number(name: str, number: float) -> float:
    if isinstance(number, bool) or not isinstance(number, (int, float, np.number)) or not math.isfinite(number):
        raise ScenarioError(f"{name} = {number!r}: must be a finite number")
    return float(number)


def _numbers(name: str, given: ArrayLike, shape: tuple[int, ...]) -> Array:
    try:
        array = np.array(given, dtype=np.float64)
    except (TypeError, ValueError):
        raise ScenarioError(f"{name} must be an array of numbers of shape {shape}") from None
    if array.shape != shape:
        raise ScenarioError(f"{name} has shape {array.shape}: must be {shape}")
    if not np.all(np.isfinite(array)):
        raise ScenarioError(f"{name} = {array.tolist()}: must be finite")
    return array
