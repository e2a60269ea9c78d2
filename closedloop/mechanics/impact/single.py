"""One impact: both phases, and a law of restitution. It says of what the coefficient is the ratio, and how large it is
at this impact.

    class Viscous(Restitution):
        ratio_of = "energies"

        @staticmethod
        def coefficient(restitution, speed):
            return restitution / (1.0 + speed / 2.0)

What the three ratios share, the path of an impact in impulses, is the kernel `impact`: both phases, piece by
piece. The functions of a law are called once for each impact, by Python. `two_phase_impact` is one impact for reading,
for users and for tests.

See `closedloop.mechanics.impact` for the theory. A piece ends where slip stops, where the normal velocity changes its
sign (the phase changes), where it turns round (so that inside a piece it is monotone and has one zero at most), at the
end of a series, or at the end of the impact.
"""

import math
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import ArrayLike

from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError
from closedloop.base.families import Family, Member
from closedloop.jit.kernel import entry_kernel, kernel
from closedloop.jit.user_code import of_users
from closedloop.mechanics.closure.solve import DIVERGED, OK, SINGULAR
from closedloop.mechanics.impact.begin import (
    CUT,
    JAM,
    MODE_NAMES,
    NEWTON,
    ORDER,
    POISSON,
    RATIOS,
    RECOMPRESSION,
    RESTING,
    REVERSAL,
    SLIP,
    STILL,
    STRONGE,
    TURNING,
    WEDGE,
    ImpactWork,
    begin_piece,
    first_reach,
    to_extremum,
    value,
)
from closedloop.mechanics.limits import EXACT, FOUND

# An approach, m/s, or a restitution below this is none: its square, in the work, would underflow.
TINY = 1e-150
# Random impacts need less than a tenth of it; more is that of a velocity that no tip with this S can have.
MOST_PIECES = 1000

# How a piece ends.
GOES_ON, STOPS, PHASE, ENDS = 0, 1, 2, 3


@kernel
def impact(
    S: Array, u: Array, restitution: float, law: int, mu: float, work: Array, phases: tuple[Array, Array], after: Array
) -> int:
    """Write the impulses of the two phases and the tip velocity after the impact.

    Parameters
    ----------
    S : (3, 3) array
        Mobility of the tip A H⁻¹Aᵀ in the contact frame (n, t1, t2), 1/kg, symmetric positive semidefinite.
    u : (3,) array
        Tip velocity before, m/s, in the contact frame. Unless u[0] < 0 nothing happens.
    restitution : float
        ε in [0, 1].
    law : int
        NEWTON, POISSON or STRONGE.
    mu : float
        Coulomb coefficient μ >= 0 of the circle |P_t| <= μ P_n.
    work : (ImpactWork.count(),) array
        Scratch. Written: `ImpactWork.happened`, what happened, a sum of the bits of
        `closedloop.mechanics.impact.begin`.
    phases : two (3,) arrays
        Written: impulse on the robot while u_n < 0, of compression, and while u_n > 0, of decompression, N s, in the
        contact frame.
    after : (3,) array
        Written: u + S (compression + decompression), m/s; its normal part is never negative.

    Returns
    -------
    status : int
        OK; SINGULAR if no impulse ends the approach (S_nn = 0, or u is no velocity of a tip with this S); DIVERGED if
        something is not finite. Unless OK, the impulses are zero and after = u.
    """
    compression, decompression = phases
    total = restitution + mu
    for i in range(3):
        compression[i] = 0.0
        decompression[i] = 0.0
        after[i] = u[i]
        total += u[i]
        for j in range(3):
            total += S[i, j]
    c = ImpactWork(work)
    c.happened = 0.0
    if not math.isfinite(total):
        return DIVERGED
    if not S[0, 0] > 0.0:
        return SINGULAR
    if u[0] > -TINY:
        after[0] = max(u[0], 0.0)
        return OK
    if restitution < TINY:
        restitution = 0.0
    happened = _collide(S, u, restitution, law, mu, c, compression, decompression)
    if happened < 0:
        for i in range(3):
            compression[i] = 0.0
            decompression[i] = 0.0
        return SINGULAR
    c.happened = happened
    for i in range(3):
        for j in range(3):
            after[i] += S[i, j] * (compression[j] + decompression[j])
    after[0] = max(after[0], 0.0)
    return OK


@kernel
def energy_lost(u: Array, after: Array, impulse: Array) -> float:
    """Return the kinetic energy that an impact took, J: −½ (u + u⁺)·P.

    `u`, `after` (3,), m/s, and the whole `impulse` P (3,), N s, in one frame. It is ½ vᵀHv before less after, for the
    joint velocity changes by H⁻¹AᵀP.
    """
    gained: float = 0.0
    for i in range(3):
        gained += 0.5 * (u[i] + after[i]) * impulse[i]
    return -gained


@kernel
def _collide(
    S: Array, u: Array, restitution: float, law: int, mu: float, c: ImpactWork, compression: Array, decompression: Array
) -> int:
    """Add up the pieces of the impact; return what happened, or -1 if it does not end."""
    c.w1[0], c.w2[0], c.un[0] = u[1], u[2], u[0]
    speed = math.hypot(u[0], math.hypot(u[1], u[2]))
    c.pn[0], c.p1[0], c.p2[0], c.work[0], c.energy[0] = 0.0, 0.0, 0.0, 0.0, 0.0
    slid = math.hypot(u[1], u[2]) > STILL * speed
    rebound = -restitution * u[0]
    compressing, happened = True, 0
    owed, energy = 0.0, 0.0  # what decompression still has to deliver, N s or J; the change of energy so far
    for _ in range(MOST_PIECES):
        kind, length, bits = begin_piece(S, mu, speed, c)
        happened |= bits
        if kind == RESTING and bits == SLIP and slid:
            happened |= REVERSAL
        degree = ORDER if kind == TURNING else 2
        end = STOPS if math.isfinite(length) else GOES_ON
        if kind == TURNING:
            end = GOES_ON
            length = to_extremum(S, mu, length, c)
        elif c.un[1] > EXACT * S[0, 0]:
            enough = _enough(compressing, law, rebound, owed, c)
            if enough < length:
                length, end = enough, GOES_ON
        elif end == GOES_ON:
            # The normal velocity stays what it is, whatever the impulse.
            if abs(c.un[0]) > FOUND * speed:
                return -1
            happened |= WEDGE
            end, length = ENDS, max(owed, 0.0) if law == POISSON else 0.0
            compressing = False
        if end != ENDS:
            length, end, cut = _end_piece(compressing, law, rebound, owed, energy, (length, end, degree), c)
            happened |= cut
        if compressing and value(c.un, degree, length) < c.un[0]:
            happened |= JAM
        phase = compression if compressing else decompression
        normal, power = value(c.pn, degree, length), value(c.work, degree, length)
        phase[0] += normal
        phase[1] += value(c.p1, degree, length)
        phase[2] += value(c.p2, degree, length)
        energy += value(c.energy, degree, length)
        if law == POISSON:
            owed += restitution * normal if compressing else -normal
        elif law == STRONGE:
            owed += -restitution * restitution * power if compressing else -power
        if end == ENDS:
            return happened
        _move_on(degree, length, end, c)
        if end == PHASE:
            compressing = not compressing
            if compressing:
                happened |= RECOMPRESSION
            elif restitution == 0.0:
                return happened
    return -1


@kernel
def _enough(compressing: bool, law: int, rebound: float, owed: float, c: ImpactWork) -> float:
    """Return a normal impulse beyond the end of this phase, for a straight piece with du_n/dP_n > 0."""
    a: float = c.un[1]
    rate: float = c.un[0]
    if compressing:
        return -2.0 * rate / a
    if law == NEWTON:
        return 2.0 * max(rebound - rate, 0.0) / a
    if law == POISSON:
        return 2.0 * owed
    return 2.0 * math.sqrt(2.0 * max(owed, 0.0) / a)


@kernel
def _end_piece(
    compressing: bool,
    law: int,
    rebound: float,
    owed: float,
    energy: float,
    piece: tuple[float, int, int],
    c: ImpactWork,
) -> tuple[float, int, int]:  # fmt: skip
    """Return the length of a piece inside which u_n is monotone, how it ends, and CUT if energy ends it.

    `piece` has the length and the end that are known of it, and the degree of its polynomials.
    """
    length, end, degree = piece
    beyond = value(c.un, degree, length)
    if compressing:
        if beyond >= 0.0:
            return first_reach(c.un, degree, 0.0, length), PHASE, 0
        return length, end, 0
    if beyond < 0.0:
        length, end = first_reach(c.un, degree, 0.0, length), PHASE
    row, level = c.un, rebound
    if law == POISSON:
        row, level = c.pn, owed
    elif law == STRONGE:
        row, level = c.work, owed
    if level <= row[0]:
        return 0.0, ENDS, 0
    if value(row, degree, length) >= level:
        length, end = first_reach(row, degree, level, length), ENDS
    if law == NEWTON and energy < 0.0 and energy + value(c.energy, degree, length) > -EXACT * energy:
        return first_reach(c.energy, degree, -energy, length), ENDS, CUT
    return length, end, 0


@kernel
def _move_on(degree: int, length: float, end: int, c: ImpactWork) -> None:
    """Begin the next piece with the velocities at the end of this one."""
    x, y, normal = value(c.w1, degree, length), value(c.w2, degree, length), value(c.un, degree, length)
    c.w1[0], c.w2[0] = x, y
    c.un[0] = 0.0 if end == PHASE else normal
    if end == STOPS:
        c.w1[0], c.w2[0] = 0.0, 0.0


class Restitution(Member):
    """A law of restitution. Those that ship are in `closedloop.mechanics.impact.laws`, one file each.

    `ratio_of`: of what the coefficient is the ratio, after to before: "velocities" along the normal; "impulses" of
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

    Raises ScenarioError if a user's law gives none from 0 to 1.
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

    `compression`, `decompression`, (3,) arrays: impulse of the surface on the robot in the two phases, N s.
    `after` (3,): tip velocity after the impact, m/s.
    `energy_lost`: kinetic energy that the impact took, J.
    `modes`: what happened, in this order: "slip" (the tip slid at some time), "turn" (the direction of slip turned),
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

    `S` (3, 3): a H⁻¹Aᵀ in the contact frame (n, t1, t2), 1/kg, symmetric positive semidefinite, S[0, 0] > 0.
    `u` (3,): tip velocity before, m/s; u[0] <= 0.
    `restitution`: ε in [0, 1].
    `law`: "newton", "poisson" or "stronge": of what ε is the ratio (see `closedloop.mechanics.impact`).
    `friction`: coulomb coefficient μ >= 0.
    Raises ScenarioError if one of these does not hold, or no impulse can end the approach.
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
