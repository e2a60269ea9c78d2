"""What the rows of loop joints leave free, in the metric of the mass matrix.

With H = L Lᵀ and y = Lᵀq̈, the rows G q̈ = b are Z y = b, Z = G L⁻ᵀ. They split every y into a part that the loops
determine and one that they leave free, P y; a force of the loops changes the first alone. So the equation of motion,
contact and impact of the closed mechanism are those of the tree, on the second part
(`closedloop.loop.step.closed_loops`).

P is written with an orthonormal basis, of what the rows determine or of what they leave, whichever has fewer
directions. Both follow from the rows solved for the joints that they determine (`closedloop.mechanics.loops.factor`):
as G = B [1 R], in the order of elimination, [1 R] L⁻ᵀ spans the rows of Z and [−Rᵀ 1] L what they leave.

A state that obeys the loops is the nearest one to a given state, joints counting alike. The measure is the same at
every state. With one that is not, such as that of H, a stage of a Runge-Kutta step would be moved along the loops by
what the measure has changed since the last stage, which takes an order from the scheme.
"""

import math

from closedloop.base.arrays import Array
from closedloop.jit.calls import row_of
from closedloop.jit.dual8 import has_derivatives, sought
from closedloop.jit.kernel import entry_kernel, kernel
from closedloop.mechanics.loops.factor import DEPENDENT, factor, meet, order_of
from closedloop.mechanics.loops.memory import LoopLinks, LoopRows, loops_at, tree_at
from closedloop.mechanics.loops.rows import locate_rows, place_rows
from closedloop.mechanics.robot.tree.layout import move_posture

# A row that is left with no more than this share of its square by others is orthogonalised once more: twice is enough.
ONCE_MORE = 0.5


@kernel
def basis_alike(links: LoopLinks, rows: LoopRows) -> None:
    """Write the basis of P for the rows factored last, joints counting alike: for L = 1."""
    span(links, rows)
    orthonormalise(links, rows)


@kernel
def basis_in_metric(links: LoopLinks, rows: LoopRows, L: Array) -> None:
    """Write the basis of P for the rows factored last; L has the reciprocals of its diagonal on it."""
    span(links, rows)
    if links.free == 0:
        substitute_rows(L, rows.basis, links.spanned)
    else:
        for k in range(links.spanned):
            multiply_transposed(L, row_of(rows.basis, k), links.n)
    orthonormalise(links, rows)


@kernel
def span(links: LoopLinks, rows: LoopRows) -> None:
    """Write motions (n,) that span what the rows determine, or what they leave, whichever are fewer."""
    n, rank = links.n, links.rank
    links.free = 1 if n - rank < rank else 0
    links.spanned = n - rank if links.free != 0 else rank
    for k in range(links.spanned):
        if links.free != 0:
            free_motion(links, rows, k, row_of(rows.basis, k))
        else:
            determined_by(links, rows, k, row_of(rows.basis, k))


@kernel
def orthonormalise(links: LoopLinks, rows: LoopRows) -> None:
    """Make the basis orthonormal, by Gram and Schmidt's method."""
    n, B = links.n, rows.basis
    for k in range(links.spanned):
        left = dot(row_of(B, k), row_of(B, k), n)
        for _ in range(2 if k > 0 else 0):
            before = left
            for i in range(k):
                take_off(row_of(B, k), row_of(B, i), n)
            left = dot(row_of(B, k), row_of(B, k), n)
            if left > ONCE_MORE * before:
                break
        scale = 1.0 / math.sqrt(left)
        for j in range(n):
            B[k, j] *= scale


@kernel
def free_motion(links: LoopLinks, rows: LoopRows, k: int, x: Array) -> None:
    """Write a motion (n,) that the rows allow: of the k-th free joint at rate one, the other free joints at rest."""
    _, joints = order_of(links)
    for j in range(links.n):
        x[j] = 0.0
    x[joints[links.rank + k]] = 1.0
    for i in range(links.rank):
        x[joints[i]] = -rows.reduced[i, k]


@kernel
def determined_by(links: LoopLinks, rows: LoopRows, k: int, x: Array) -> None:
    """Write the row (n,), a combination of the rows, that determines the k-th joint by the free ones."""
    _, joints = order_of(links)
    for j in range(links.n):
        x[j] = 0.0
    x[joints[k]] = 1.0
    for i in range(links.rank, links.n):
        x[joints[i]] = rows.reduced[k, i - links.rank]


@kernel
def leave_free(links: LoopLinks, rows: LoopRows, x: Array) -> None:
    """Replace x (n,) by P x, what the rows leave of it."""
    project(rows, links.spanned, x, links.free != 0)


@kernel
def take_free(links: LoopLinks, rows: LoopRows, x: Array) -> None:
    """Replace x (n,) by x − P x, what the rows determine of it."""
    project(rows, links.spanned, x, links.free == 0)


@kernel
def project(rows: LoopRows, spanned: int, x: Array, onto: bool) -> None:
    """Replace x (n,) by what lies along the basis, or by what does not."""
    n, B = x.shape[0], rows.basis
    if not onto:
        for _ in range(2):  # where little is left of x, once leaves rounding of what has gone
            for k in range(spanned):
                take_off(x, row_of(B, k), n)
        return
    for k in range(spanned):
        rows.share[k] = dot(x, row_of(B, k), n)
    for j in range(n):
        x[j] = 0.0
    for k in range(spanned):
        for j in range(n):
            x[j] += rows.share[k] * B[k, j]


@kernel
def orthonormal_rows(Z: Array, m: int, order: Array, coefficients: Array, lengths: Array) -> int:
    """Replace the rows of Z by an orthonormal basis of them, and return how many it has.

    Gram and Schmidt's method, modified; the row that is farthest from the span, relative to its own length, is taken
    next, and orthogonalised once more (L. Giraud, J. Langou and M. Rozložník, Comput. Math. Appl. 50, 2005).

    `Z` (>= m, n): in: m rows. Out: the basis, in the first rows.
    `order` (m,): written: which row each direction was made of.
    `coefficients` (m, m): written: of these rows in the basis, lower triangular.
    `lengths` (m,): scratch.
    """
    n = Z.shape[1]
    for i in range(m):
        order[i], lengths[i] = i, math.sqrt(dot(row_of(Z, i), row_of(Z, i), n))
    for k in range(m):
        best, share = -1, DEPENDENT * DEPENDENT
        for i in range(k, m):
            left, whole = dot(row_of(Z, i), row_of(Z, i), n), lengths[i] * lengths[i]
            if left > share * whole:
                best, share = i, left / whole
        if best < 0:
            return k
        if best != k:
            order[k], order[best] = order[best], order[k]
            lengths[k], lengths[best] = lengths[best], lengths[k]
            for j in range(n):
                Z[k, j], Z[best, j] = Z[best, j], Z[k, j]
            for j in range(k):
                coefficients[k, j], coefficients[best, j] = coefficients[best, j], coefficients[k, j]
        for i in range(k):
            coefficients[k, i] += take_off(row_of(Z, k), row_of(Z, i), n)
        length = math.sqrt(dot(row_of(Z, k), row_of(Z, k), n))
        coefficients[k, k] = length
        for j in range(n):
            Z[k, j] /= length
        for i in range(k + 1, m):
            coefficients[i, k] = take_off(row_of(Z, i), row_of(Z, k), n)
    return m


@kernel
def orthonormal_basis(S: Array, m: int, n: int, least: float) -> int:
    """Replace the first m rows of S, of n numbers each, by an orthonormal basis of all; return how many it has.

    Gram and Schmidt's method, modified, twice; the longest that is left is next, down to the share `least`.
    """
    first = 0.0
    for k in range(min(m, n)):
        best, longest = k, 0.0
        for i in range(k, m):
            square = dot(row_of(S, i), row_of(S, i), n)
            if square > longest:
                best, longest = i, square
        first = max(first, longest)
        if not longest > least * least * first:
            return k
        row = row_of(S, k)
        for r in range(n):
            row[r], S[best, r] = S[best, r], row[r]
        for i in range(k):
            take_off(row, row_of(S, i), n)
        length = math.sqrt(dot(row, row, n))
        for r in range(n):
            row[r] /= length
        for i in range(k + 1, m):
            take_off(row_of(S, i), row, n)
    return min(m, n)


@kernel
def dot(x: Array, y: Array, n: int) -> float:
    """Return the product of the first n entries of x and y, by four sums that do not wait for each other."""
    a, b, c, d = 0.0, 0.0, 0.0, 0.0
    even = n - n % 4
    for j in range(0, even, 4):
        a += x[j] * y[j]
        b += x[j + 1] * y[j + 1]
        c += x[j + 2] * y[j + 2]
        d += x[j + 3] * y[j + 3]
    for j in range(even, n):
        a += x[j] * y[j]
    return (a + b) + (c + d)


@kernel
def take_off(x: Array, direction: Array, n: int) -> float:
    """Subtract from x its component along a direction of length one, and return that component."""
    component = dot(x, direction, n)
    for j in range(n):
        x[j] -= component * direction[j]
    return component


@kernel
def multiply_transposed(L: Array, x: Array, n: int) -> None:
    """Replace x (n,) by Lᵀx, for the factor with the reciprocals of its diagonal on it."""
    for i in range(n):
        entry = x[i]
        if entry != 0.0:
            for j in range(i):
                x[j] += L[i, j] * entry
            x[i] = entry / L[i, i]


@kernel
def substitute_rows(L: Array, Z: Array, m: int) -> None:
    """Replace the first m rows z of Z by L⁻¹z, for the factor with the reciprocals of its diagonal on it.

    An entry of L⁻¹z is taken off all below it as soon as it is known, so that they do not wait for each other's sums.
    """
    n = Z.shape[1]
    for k in range(m):
        for j in range(n):
            z = Z[k, j] * L[j, j]
            Z[k, j] = z
            if z != 0.0:
                for i in range(j + 1, n):
                    Z[k, i] -= L[i, j] * z


@kernel
def combine_rows(c: Array, coefficients: Array, rank: int, a: Array) -> None:
    """Write a (rank,) with Σ aₖ (row k) = Σ cₖ (direction k) for the rows that the basis was made of."""
    for k in range(rank - 1, -1, -1):
        s = c[k]
        for i in range(k + 1, rank):
            s -= coefficients[i, k] * a[i]
        a[k] = s / coefficients[k, k]


@kernel
def meet_rows(b: Array, order: Array, coefficients: Array, basis: Array, rank: int, along: Array, y: Array) -> None:
    """Write the shortest y (n,) with Z y = b (m,) for the rows Z that the basis was made of; `along` (m,): scratch."""
    for j in range(y.shape[0]):
        y[j] = 0.0
    for k in range(rank):
        s = b[int(order[k])]
        for i in range(k):
            s -= coefficients[k, i] * along[i]
        along[k] = s / coefficients[k, k]
        for j in range(y.shape[0]):
            y[j] += along[k] * basis[k, j]


# Newton steps at most, and the error, m or rad, below which there is no other: rounding.
MOST_MOVES, CLOSED = 50, 1e-15
# A loop is closed if no error is above this, m or rad.
TOLERANCE = 1e-12
# Where a step has left no more than this share of the error, the next is taken with the rows as they were: it leaves
# about the same share of it.
FAST = 1e-3


@kernel
def factor_rows(links: LoopLinks, rows: LoopRows, b: Array, most: int) -> None:
    """Factor the rows G, of `most` independent ones at most, for b (m,), and write the basis; joints count alike."""
    factor(links, rows, b, most)
    basis_alike(links, rows)


@kernel
def largest_error(links: LoopLinks, rows: LoopRows) -> float:
    """Return the largest error of the rows, m or rad."""
    largest = 0.0
    for k in range(links.m):
        size = abs(rows.error[k])
        if not size <= largest:
            largest = size
    return largest


@kernel
def close_state(links: LoopLinks, rows: LoopRows, q: Array, v: Array) -> float:
    """Move q and q̇ to the nearest state that the loops allow; return the error left, m or rad.

    Newton's method on the error, each step the shortest, until the error is rounding or no longer shrinks; then the
    velocity. The rows are factored again only where they have changed much since.
    """
    n, tree, before, left, factored_here = links.n, tree_at(links), math.inf, math.inf, False
    # Rows that depend on others where the loops are closed seem not to where they are open.
    most = links.known if links.known > 0 else links.m
    for _ in range(MOST_MOVES):
        for j in range(n):
            rows.q[j], rows.v[j] = q[j], v[j]
        place_rows(links, rows)
        left = largest_error(links, rows)
        factored_here = not (before < math.inf and left <= FAST * before)
        if factored_here:
            factor_rows(links, rows, rows.error, most)
        if left <= CLOSED or not left < math.inf or (left <= TOLERANCE and left >= 0.25 * before):
            break
        if not factored_here:
            meet(links, rows, rows.error)
        take_free(links, rows, rows.met)
        move_posture(tree, q, rows.met, -1.0)
        if not factored_here and left * left <= 0.01 * CLOSED * before:
            left = left * left / before  # what this step leaves, below rounding
            break
        before = left
    if has_derivatives(left):  # the derivatives of q are moved onto the loops too, and the rows are those there
        for k in range(links.m):
            rows.error[k] -= sought(rows.error[k])
        meet(links, rows, rows.error)
        take_free(links, rows, rows.met)
        move_posture(tree, q, rows.met, -1.0)
        for j in range(n):
            rows.q[j] = q[j]
        place_rows(links, rows)
        factor_rows(links, rows, rows.error, most)
        factored_here = True
    if links.frames > 0:  # G q̇ is minus the rate with which frames that move open the rows
        for j in range(n):
            rows.q[j], rows.v[j] = q[j], v[j]
        locate_rows(links, rows)
        factor_rows(links, rows, rows.rate, most)
        take_free(links, rows, rows.met)
        for j in range(n):
            v[j] -= rows.met[j]
        return left
    leave_free(links, rows, v)
    if not factored_here:  # that was where the loops were not closed yet
        for k in range(links.m):
            rows.rate[k] = dot(row_of(rows.G, k), v, n)
        meet(links, rows, rows.rate)
        take_free(links, rows, rows.met)
        for j in range(n):
            v[j] -= rows.met[j]
    return left


@entry_kernel
def closed_to(address: int, q: Array, v: Array) -> float:
    """Do `close_state` with the memory of the loops at an address."""
    links, rows = loops_at(address)
    return close_state(links, rows, q, v)


# What is asked.
TANGENT, NEAREST = range(2)


@entry_kernel
def along_path(address: int, what: int) -> int:
    """Answer for the loops at `q` of their memory, by its address; joints count alike.

    TANGENT     replace `tip`, rows of joint velocities, by what the loops leave of them
    NEAREST     replace `q` by the nearest posture that closes the loops
    """
    links, rows = loops_at(address)
    if what == TANGENT:
        for j in range(links.n):
            rows.v[j] = 0.0
        locate_rows(links, rows)
        factor_rows(links, rows, rows.error, links.m)
        links.known = links.rank
        for k in range(6):
            leave_free(links, rows, rows.tip[k])
    else:
        for j in range(links.n):
            rows.column[j], rows.still[j] = rows.q[j], 0.0
        close_state(links, rows, rows.column, rows.still)
        for j in range(links.n):
            rows.q[j] = rows.column[j]
    return 0
