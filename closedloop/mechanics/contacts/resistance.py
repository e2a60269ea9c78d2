"""Resistance to rolling and to pivoting: moments with the normal force f of a contact, beside its friction.

With ω of one body relative to the other, and arms ρ and σ, m,

    |M_t| <= ρ f,  M_t = −ρ f ω_t/|ω_t| where it rolls          |M_n| <= σ f,  M_n = −σ f sign ω_n where it pivots

(K. L. Johnson, Contact Mechanics, Cambridge 1985, §8.2 and 8.3; J. Szymanowski and others, for the set-valued law). It
is Coulomb's law for the turning: at rest it holds what it can. Each is a contact of its own, of the speeds ρ ω_t and
σ ω_n, m/s, with forces M/ρ and M/σ, N, and so with the coefficient 1. Its normal force is that of its owner,
and where modes are known its moment goes with the unknown f, as the friction of a contact that slides does.
"""

from closedloop.base.arrays import Array
from closedloop.jit.kernel import kernel
from closedloop.mechanics.closure.contact_force import FREE, PRESSED
from closedloop.mechanics.contacts.memory import LINE, OFF, RAY, Contacts


@kernel
def is_resistance(c: Contacts, i: int) -> bool:
    """Whether contact i is the resistance of another to rolling or to pivoting."""
    return bool(c.friction.resistance.owner[i] >= 0.0)


@kernel
def has_resistance(c: Contacts, i: int) -> bool:
    """Whether contact i has a resistance to rolling or to pivoting."""
    return bool(c.friction.resistance.rolling[i] >= 0.0 or c.friction.resistance.pivoting[i] >= 0.0)


@kernel
def form_of_resistance(c: Contacts, s: int, form: int) -> int:
    """Return the form of a resistance, `form` while its owner takes part and it turns anything, else OFF."""
    owner = int(c.friction.resistance.owner[s])
    return form if c.problem.form[owner] != OFF and c.S[s, 1, 1] + c.S[s, 2, 2] > 0.0 else OFF


@kernel
def mode_of_resistance(c: Contacts, s: int) -> int:
    """Return the mode of a resistance after its owner has struck: it goes on, or begins, with turning; or is none."""
    if c.mode[int(c.friction.resistance.owner[s])] == FREE:
        return FREE
    return PRESSED if c.mode[s] == FREE else int(c.mode[s])


@kernel
def resistance_of(c: Contacts, i: int, which: int) -> int:
    """Return the number of the resistance of contact i to rolling, 0, or to pivoting, 1; −1 if it has none."""
    return int(c.friction.resistance.rolling[i] if which == 0 else c.friction.resistance.pivoting[i])


@kernel
def turns_with(c: Contacts, s: int) -> bool:
    """Whether the moment of resistance s, −1 for none, is in a known direction: it goes with f of its owner."""
    return bool(s >= 0 and c.problem.form[s] in (RAY, LINE))


@kernel
def add_turning(c: Contacts, i: int, f: float, force: Array) -> None:
    """Add what goes with a normal force f, N, of contact i: the normal forces of its resistances and their moments."""
    for which in range(2):
        s = resistance_of(c, i, which)
        if s >= 0 and c.problem.form[s] != OFF:
            force[3 * s] += f
        if turns_with(c, s):
            force[3 * s + 1] -= c.problem.along[s, 0] * f
            force[3 * s + 2] -= c.problem.along[s, 1] * f


@kernel
def square_of_turning(c: Contacts, i: int) -> float:
    """Return the square of the moments that go with a normal force of 1 N of contact i, divided by their arms, N²."""
    square = 0.0
    for which in range(2):
        s = resistance_of(c, i, which)
        if turns_with(c, s):
            square += c.problem.along[s, 0] * c.problem.along[s, 0] + c.problem.along[s, 1] * c.problem.along[s, 1]
    return square
