"""What forces of contacts do to their rows: the mobility W = X Xᵀ, 1/kg, with X = L⁻¹Gᵀ, which is nowhere written."""

import math

from closedloop.base.arrays import Array
from closedloop.jit.calls import row_of
from closedloop.jit.kernel import kernel
from closedloop.mechanics.contacts.memory import Contacts, joints_of


@kernel
def own_mobilities(c: Contacts, k: int) -> None:
    """Write S, the block of W of each contact that is near."""
    for i in range(k):
        for a in range(3 if c.near[i] != 0.0 else 0):
            first, end = joints_of(c, i)
            x = row_of(c.X, 3 * i + a)
            for b in range(a + 1):
                y, s = row_of(c.X, 3 * i + b), 0.0
                for j in range(first, end):
                    s += x[j] * y[j]
                c.S[i, a, b] = c.S[i, b, a] = s


@kernel
def write_motion(c: Contacts, k: int, F: Array) -> None:
    """Write Xᵀ F, what forces F (3 k,) do to the joints: not normal forces that are known, whose part is in a."""
    motion = c.scratch.motion
    for j in range(c.X.shape[1]):
        motion[j] = 0.0
    for r in range(3 * k):
        if F[r] != 0.0 and c.near[r // 3] != 0.0 and not (r % 3 == 0 and c.soft[r // 3] != 0.0):
            first, end = joints_of(c, r // 3)
            row = row_of(c.X, r)
            for j in range(first, end):
                motion[j] += row[j] * F[r]


@kernel
def added(c: Contacts, r: int) -> float:
    """Return what the forces of `write_motion` accelerate row r by, m/s²; zero of a contact that is not near."""
    s = 0.0 * c.load[0]
    first, end = joints_of(c, r // 3)
    row = row_of(c.X, r)
    for j in range(first, end if c.near[r // 3] != 0.0 else first):
        s += row[j] * c.scratch.motion[j]
    return s


@kernel
def force_size(F: Array) -> float:
    """Return the largest of some forces, N; infinite if one is no number."""
    most = 0.0
    for f in F:
        if not abs(f) < math.inf:
            return math.inf
        most = max(most, abs(f))
    return most
