"""The condition number of Eq. 24 at each recorded row, computed for a batch of rows at once.

The condition number of K, the matrix of Eq. 24, in the 1-norm, ‖K‖₁‖K⁻¹‖₁, in SI units, takes the inverse:

    K⁻¹ = [[H⁻¹ − x xᵀ/s, x/s], [xᵀ/s, −1/s]],    x = H⁻¹Aᵀ,  s = A H⁻¹Aᵀ,  H⁻¹ = L⁻ᵀL⁻¹

That is nearly as much arithmetic as the step itself, on small triangular matrices that do not vectorise, and the step
does not need it. So each row stores the matrices in one lane of `batch`, and once all lanes are full each operation is
done for all rows together. Measured, for n joints, one row at a time and so, µs a row: n = 4: 0.26,
0.07; 7: 0.48, 0.21; 16: 1.9, 2.4; 32: 8.0, 21. Hence two forms, which
`tests/closedloop/mechanics/test_solve.py` holds equal.
Computing H anew from the record's q after the run would take 0.36 µs a row of four joints, half of a whole step.
"""

from typing import Any

from closedloop.base.arrays import Array, IntArray
from closedloop.jit.calls import matrix_of, row_of
from closedloop.jit.kernel import kernel, kernel_inlined
from closedloop.jit.simd8 import lanewise, select

BATCH = 32
# Above this many joints the rows of the matrices vectorise by themselves, one condition number at a time.
LONG_ARM = 16


def batch_rows(n: Any) -> Any:
    """Return how many numbers a lane of `batch` (batch_rows(n), BATCH) holds, for n joints (int or `Count`)."""
    return 2 * n * n + 6 * n + 5


@kernel_inlined
def add_to_batch(
    H: Array, A: Array, L: Array, X: Array, mobility: float, pressed: bool, batch: Array, lane: int
) -> None:
    """Store in a lane what the condition number of a row needs.

    `H`, `L`, (n, n) arrays: mass matrix, upper triangle; its Cholesky factor with the reciprocals of its diagonal.
    `A`, `X`, (n,) arrays: the closure's row, and L⁻¹Aᵀ.
    `mobility`: s, 1/kg.
    `pressed`: whether there is contact; without it K is H.
    `batch`, (batch_rows(n), BATCH) array: written at `lane`: H and below it L, the diagonal of L, A, X and 1/s.
    """
    n = H.shape[0]
    at = n * n
    for i in range(n):
        for j in range(i):
            batch[i * n + j, lane] = L[i, j]
            batch[j * n + i, lane] = H[j, i]
        batch[i * n + i, lane] = H[i, i]
        batch[at + i, lane] = L[i, i]
        batch[at + n + i, lane] = select(pressed, A[i], 0.0)
        batch[at + 2 * n + i, lane] = select(pressed, X[i], 0.0)
    batch[at + 3 * n, lane] = select(pressed, 1.0 / select(pressed, mobility, 1.0), 0.0)


@kernel
def condition_numbers_of_batch(batch: Array, n: int, lanes: int) -> None:
    """Overwrite the last row of `batch` with the condition numbers of its first `lanes` lanes."""
    P = batch
    diagonal, a, x = n * n, n * n + n, n * n + 2 * n
    inverse_mobility = x + n
    inverse = inverse_mobility + 1
    y, column, size = inverse + n * n, inverse + n * n + n, inverse + n * n + 2 * n
    norm, inverse_norm, total = size + n, size + n + 1, size + n + 3
    for j in range(n):
        copy(P[diagonal + j], lanes, P[inverse + j * n + j])
        for i in range(j + 1, n):
            clear(P[total], lanes)
            for k in range(j, i):
                take_product(P[i * n + k], P[inverse + k * n + j], lanes, P[total])
            multiply(P[total], P[diagonal + i], lanes, P[inverse + i * n + j])
    clear(P[norm], lanes)
    copy(P[inverse_mobility], lanes, P[inverse_norm])
    for j in range(n):
        clear(P[y + j], lanes)
        for k in range(j, n):
            take_product(P[inverse + k * n + j], P[x + k], lanes, P[y + j])  # −(H⁻¹Aᵀ)ⱼ; only its magnitude is used
        begin_columns(
            P[y + j], P[inverse_mobility], P[a + j], lanes, P[column + j], P[inverse_norm], P[size + j], P[norm]
        )
    for j in range(n):
        for i in range(j, n):
            product_of_three(P[y + i], P[y + j], P[inverse_mobility], lanes, P[total])
            for k in range(i, n):
                take_product(P[inverse + k * n + i], P[inverse + k * n + j], lanes, P[total])
            if i == j:
                add_magnitudes(P[total], P[i * n + i], lanes, P[column + i], P[size + i])
            else:
                add_to_both(P[total], P[j * n + i], lanes, P[column + i], P[column + j], P[size + i], P[size + j])
    for j in range(n):
        enlarge(P[size + j], P[column + j], lanes, P[norm], P[inverse_norm])
    multiply(P[norm], P[inverse_norm], lanes, P[total])


@kernel
def condition_number(
    H: Array, A: Array, L: Array, X: Array, mobility: float, pressed: bool, work: Array, ends: IntArray
) -> float:
    """Return the condition number of one state of a long arm.

    `H`, `A`, `L`, `X`, `mobility`, `pressed`: see `add_to_batch`.
    `work` (>= n * n + 4 * n,): scratch.
    `ends` (n,): where the blocks of H end, see `closedloop.mechanics.robot.tree.group_ends`.
    """
    n, first = H.shape[0], 0
    R = matrix_of(work, n, n)  # L⁻¹, lower
    x, column = work[n * n : n * n + n], work[n * n + n : n * n + 2 * n]
    size, row = work[n * n + 2 * n : n * n + 3 * n], work[n * n + 3 * n : n * n + 4 * n]
    inverse_mobility = 1.0 / mobility if pressed else 0.0
    for i in range(n):
        if i == ends[first]:
            first = i
        to, factors, inverse = row_of(R, i), row_of(L, i), L[i, i]
        for j in range(first, ends[i]):
            to[j] = 0.0  # above the diagonal too, so that rows may be taken four at a time
        for k in range(first, i - 3, 4):
            add_four((-factors[k], -factors[k + 1], -factors[k + 2], -factors[k + 3]), R, k, to, first, k + 4)
        for k in range(first + (i - first) // 4 * 4, i):
            add_multiple(-factors[k], row_of(R, k), to, first, k + 1)
        for j in range(first, i):
            to[j] *= inverse
        to[i], x[i] = inverse, 0.0
    first = 0
    if pressed:
        for k in range(n):
            first = first if ends[first] > k else k
            add_multiple(X[k], row_of(R, k), x, first, k + 1)
    last, last_inverse = 0.0, inverse_mobility
    for j in range(n):
        size[j] = abs(A[j]) if pressed else 0.0
        column[j] = abs(x[j]) * inverse_mobility
        last += size[j]
        last_inverse += column[j]
    first = 0
    for i in range(n):
        if i == ends[first]:
            first = i
        begin = 0 if pressed else first  # the contact couples the blocks that it touches
        for j in range(begin, i + 1):
            row[j] = 0.0
        if pressed:
            add_multiple(-inverse_mobility * x[i], x, row, 0, i + 1)
        fours = i + (ends[i] - i) // 4 * 4
        for k in range(i, fours, 4):
            add_four((R[k, i], R[k + 1, i], R[k + 2, i], R[k + 3, i]), R, k, row, first, i + 1)
        for k in range(fours, ends[i]):
            add_multiple(R[k, i], row_of(R, k), row, first, i + 1)
        for j in range(begin, i):
            row[j] = abs(row[j])
            column[j] += row[j]
            column[i] += row[j]
            size[j] += abs(H[j, i])
            size[i] += abs(H[j, i])
        column[i] += abs(row[i])
        size[i] += abs(H[i, i])
    for j in range(n):
        last = max(last, size[j])
        last_inverse = max(last_inverse, column[j])
    return last * last_inverse


@kernel_inlined
def add_multiple(factor: float, x: Array, to: Array, first: int, end: int) -> None:
    """Write to += factor x, columns first .. end − 1."""
    for j in range(first, end):
        to[j] += factor * x[j]


@kernel_inlined
def add_four(factors: tuple[float, float, float, float], R: Array, k: int, to: Array, first: int, end: int) -> None:
    """Write to += a x + b y + c z + d w, the factors times the rows of R from the k-th on, columns first .. end − 1."""
    a, b, c, d = factors
    x, y, z, w = row_of(R, k), row_of(R, k + 1), row_of(R, k + 2), row_of(R, k + 3)
    for j in range(first, end):
        to[j] += (a * x[j] + b * y[j]) + (c * z[j] + d * w[j])


# Operations on all lanes; the last arrays are written. The number of lanes is an argument: with a constant the compiler
# would unroll the loops instead of vectorising them. Interpreted, each is done for all lanes at once.
@kernel_inlined
@lanewise
def clear(to: Array, lanes: int) -> None:
    """Write zeros into `to`."""
    for r in range(lanes):
        to[r] = 0.0


@kernel_inlined
@lanewise
def copy(x: Array, lanes: int, to: Array) -> None:
    """Write to = x."""
    for r in range(lanes):
        to[r] = x[r]


@kernel_inlined
@lanewise
def multiply(x: Array, y: Array, lanes: int, to: Array) -> None:
    """Write to = x y."""
    for r in range(lanes):
        to[r] = x[r] * y[r]


@kernel_inlined
@lanewise
def take_product(x: Array, y: Array, lanes: int, to: Array) -> None:
    """Write to −= x y."""
    for r in range(lanes):
        to[r] -= x[r] * y[r]


@kernel_inlined
@lanewise
def product_of_three(x: Array, y: Array, z: Array, lanes: int, to: Array) -> None:
    """Write to = x y z."""
    for r in range(lanes):
        to[r] = x[r] * y[r] * z[r]


@kernel_inlined
@lanewise
def begin_columns(
    y: Array,
    inverse_mobility: Array,
    a: Array,
    lanes: int,
    column: Array,
    inverse_norm: Array,
    size: Array,
    norm: Array,
) -> None:
    """Begin the sums of the columns of K⁻¹ and K with their last entries, and add those to the last columns' sums."""
    for r in range(lanes):
        entry = abs(y[r] * inverse_mobility[r])
        column[r] = entry
        inverse_norm[r] += entry
        size[r] = abs(a[r])
        norm[r] += abs(a[r])


@kernel_inlined
@lanewise
def add_magnitudes(x: Array, h: Array, lanes: int, column: Array, size: Array) -> None:
    """Write column += |x|, size += |h|."""
    for r in range(lanes):
        column[r] += abs(x[r])
        size[r] += abs(h[r])


@kernel_inlined
@lanewise
def add_to_both(
    x: Array, h: Array, lanes: int, column: Array, other_column: Array, size: Array, other_size: Array
) -> None:
    """Do the same for an entry and its mirror image."""
    for r in range(lanes):
        entry = abs(x[r])
        column[r] += entry
        other_column[r] += entry
        entry = abs(h[r])
        size[r] += entry
        other_size[r] += entry


@kernel_inlined
@lanewise
def enlarge(x: Array, y: Array, lanes: int, most_x: Array, most_y: Array) -> None:
    """Write most = max(most, x), for two pairs."""
    for r in range(lanes):
        most_x[r] = max(most_x[r], x[r])
        most_y[r] = max(most_y[r], y[r])
