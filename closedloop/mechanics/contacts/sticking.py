"""Contacts that all stick, with more rows than there are joints: the shortest forces, by equations of the joints alone.

Of the rows X = L⁻¹Gᵀ the forces are to give u̇ = b, so that with s = b − a they obey X Xᵀ F = s. With X of full column
rank, and M = XᵀX, of as many rows as there are joints,

    z = M⁻¹ Xᵀ s,        F = X M⁻¹ z

z is what the forces do to the joints, of least squares where the rows contradict each other by rounding, and F the
shortest of the forces that do it. Elimination in M keeps to what is not zero: bodies on each other couple neighbours.
"""

from __future__ import annotations

import math

from closedloop.jit.calls import row_of
from closedloop.jit.kernel import kernel
from closedloop.mechanics.contacts.memory import CONE, DOUBLE, OFF, Contacts, joints_of
from closedloop.mechanics.contacts.resistance import has_resistance, is_resistance
from closedloop.mechanics.contacts.shortest import CONTRADICTS, EXACT, REFINEMENTS, SAME_ROW

# Mobility that rows beside X give a contact, a share of its own: none, but for rounding.
OWN_ROW = 1e-9


@kernel
def all_stick(c: Contacts, k: int, p: int) -> bool:
    """Whether all p unknowns are rows of rigid contacts that stick, and are more than the joints."""
    n = c.X.shape[1]
    if p <= n:
        return False
    for i in range(k):
        if c.problem.form[i] == OFF:
            continue
        stuck = c.problem.form[i] == CONE or c.problem.form[i] == DOUBLE
        if not stuck or c.soft[i] != 0.0 or has_resistance(c, i) or is_resistance(c, i):
            return False
    for q in range(p):  # what stands for the friction of joints has a normal row that is not of X
        row, square = int(c.scratch.unknown[q]), 0.0
        if row % 3 != 0:
            continue
        first, end = joints_of(c, row // 3)
        for j in range(first, end):
            square += c.X[row, j] * c.X[row, j]
        if not abs(square - c.W[row, row]) <= OWN_ROW * square:
            return False
    return True


@kernel
def shortest_sticking(c: Contacts, p: int) -> float:
    """Write as `solution` the shortest forces of p unknowns that all stick; see `all_stick`.

    Returns the size of the terms on the right; negative if X is not of full rank, rounding is in the way, or the
    rows contradict each other.
    """
    asked = 0.0
    if not factor_joints(c, p):
        return float(0.0 * c.load[0] - 1.0)
    for q in range(p):
        row = int(c.scratch.unknown[q])
        asked = max(asked, c.size[row] + abs(c.b[row]))
    if not (moved_joints(c, p) <= CONTRADICTS * asked and spread(c, p)):
        return float(0.0 * c.load[0] - 1.0)
    return float(asked)


@kernel
def rows_of_contact(c: Contacts, q: int, p: int) -> tuple[int, int, int, int]:
    """Return how many of the p unknowns from q on are rows of one contact, and three of them, the last repeated."""
    unknown, count = c.scratch.unknown, 1
    while q + count < p and int(unknown[q + count]) // 3 == int(unknown[q]) // 3:
        count += 1
    return count, int(unknown[q]), int(unknown[q + min(1, count - 1)]), int(unknown[q + count - 1])


@kernel
def factor_joints(c: Contacts, p: int) -> bool:
    """Write Cholesky's factor of M = XᵀX, and where its rows and columns are not zero; False if M is singular."""
    n, s = c.X.shape[1], c.scratch.sticking
    for i in range(n):
        s.begins[i], s.until[i] = i, i + 1
    q = 0
    while q < p:
        count, row0, _, _ = rows_of_contact(c, q, p)
        first, end = joints_of(c, row0 // 3)
        for j in range(first, end):
            s.begins[j], s.until[j] = min(s.begins[j], first), max(s.until[j], end)
        q += count
    for i in range(n):
        row = row_of(s.factor, i)
        for j in range(int(s.begins[i]), i + 1):
            row[j] = 0.0
    q = 0
    while q < p:
        count, row0, row1, row2 = rows_of_contact(c, q, p)
        x0, x1, x2 = row_of(c.X, row0), row_of(c.X, row1), row_of(c.X, row2)
        first, end = joints_of(c, row0 // 3)
        for i in range(first, end):
            a0, a1, a2 = x0[i], x1[i] if count > 1 else 0.0, x2[i] if count > 2 else 0.0
            to = row_of(s.factor, i)
            for j in range(first, i + 1):
                to[j] += a0 * x0[j] + a1 * x1[j] + a2 * x2[j]
        q += count
    for j in range(n):  # column by column: the entries of one do not wait for each other
        of = row_of(s.factor, j)
        square = whole = of[j]
        for t in range(int(s.begins[j]), j):
            square -= of[t] * of[t]
        if not square > SAME_ROW * whole:
            return False
        of[j] = 1.0 / math.sqrt(square)
        for i in range(j + 1, int(s.until[j])):
            row, begin, left = row_of(s.factor, i), int(s.begins[i]), 0.0
            if begin <= j:
                left = row[j]
                for t in range(max(begin, int(s.begins[j])), j):
                    left -= row[t] * of[t]
                left *= of[j]
                row[j] = left
            of[i] = left
    return True


@kernel
def solve_joints(c: Contacts) -> None:
    """Overwrite both rows of `change` with M⁻¹ of them."""
    n, s = c.X.shape[1], c.scratch.sticking
    a, b = row_of(s.change, 0), row_of(s.change, 1)
    for i in range(n):
        row = row_of(s.factor, i)
        x, y = a[i] * row[i], b[i] * row[i]
        a[i], b[i] = x, y
        for t in range(i + 1, int(s.until[i])):
            a[t] -= row[t] * x
            b[t] -= row[t] * y
    for i in range(n - 1, -1, -1):
        row = row_of(s.factor, i)
        x, y = a[i] * row[i], b[i] * row[i]
        a[i], b[i] = x, y
        for t in range(int(s.begins[i]), i):
            a[t] -= row[t] * x
            b[t] -= row[t] * y


@kernel
def moved_joints(c: Contacts, p: int) -> float:
    """Write z = M⁻¹Xᵀs as `moved`, of s = −a and of b − a; return the largest that X z is off."""
    n, s, worst = c.X.shape[1], c.scratch.sticking, 0.0 * c.load[0]
    size_a, size_b = 0.0 * worst, 0.0 * worst
    for j in range(n):
        s.moved[0, j], s.moved[1, j] = 0.0, 0.0
    for q in range(p):
        row = int(c.scratch.unknown[q])
        s.rows_left[0, q], s.rows_left[1, q] = -c.a[row], c.b[row] - c.a[row]
        size_a, size_b = max(size_a, abs(s.rows_left[0, q])), max(size_b, abs(s.rows_left[1, q]))
    for _ in range(2):  # the second time of what rounding has left
        for j in range(n):
            s.change[0, j], s.change[1, j] = 0.0, 0.0
        add_rows(c, p)
        solve_joints(c)
        for j in range(n):
            s.moved[0, j] += s.change[0, j]
            s.moved[1, j] += s.change[1, j]
        worst_a, worst_b = take_rows(c, p)
        worst = max(worst_a, worst_b)
        if worst_a <= EXACT * size_a and worst_b <= EXACT * size_b:
            break
    return float(worst)


@kernel
def add_rows(c: Contacts, p: int) -> None:
    """Add to both rows of `change` Xᵀ of both rows of `rows_left`."""
    s, q = c.scratch.sticking, 0
    to_a, to_b = row_of(s.change, 0), row_of(s.change, 1)
    a, b = row_of(s.rows_left, 0), row_of(s.rows_left, 1)
    while q < p:
        count, row0, row1, row2 = rows_of_contact(c, q, p)
        x0, x1, x2 = row_of(c.X, row0), row_of(c.X, row1), row_of(c.X, row2)
        a0, a1, a2 = a[q], a[q + 1] if count > 1 else 0.0, a[q + 2] if count > 2 else 0.0
        b0, b1, b2 = b[q], b[q + 1] if count > 1 else 0.0, b[q + 2] if count > 2 else 0.0
        first, end = joints_of(c, row0 // 3)
        for j in range(first, end):
            to_a[j] += a0 * x0[j] + a1 * x1[j] + a2 * x2[j]
            to_b[j] += b0 * x0[j] + b1 * x1[j] + b2 * x2[j]
        q += count


@kernel
def take_rows(c: Contacts, p: int) -> tuple[float, float]:
    """Take X of both rows of `change` from those of `rows_left`; return the largest number in either."""
    s, unknown = c.scratch.sticking, c.scratch.unknown
    of_a, of_b = row_of(s.change, 0), row_of(s.change, 1)
    worst_a, worst_b = 0.0 * c.load[0], 0.0 * c.load[0]
    for q in range(p):
        row = int(unknown[q])
        x, a, b = row_of(c.X, row), s.rows_left[0, q], s.rows_left[1, q]
        first, end = joints_of(c, row // 3)
        for j in range(first, end):
            a -= x[j] * of_a[j]
            b -= x[j] * of_b[j]
        s.rows_left[0, q], s.rows_left[1, q] = a, b
        worst_a, worst_b = max(worst_a, abs(a)), max(worst_b, abs(b))
    return worst_a, worst_b


@kernel
def spread(c: Contacts, p: int) -> bool:
    """Write the shortest F with XᵀF = z, of both rows of `moved`, as `solution`; return whether they are exact."""
    n, s, unknown = c.X.shape[1], c.scratch.sticking, c.scratch.unknown
    size_a, size_b = 0.0 * c.load[0], 0.0 * c.load[0]
    F, G = row_of(c.scratch.solution, 0), row_of(c.scratch.solution, 1)
    for j in range(n):
        s.change[0, j], s.change[1, j] = s.moved[0, j], s.moved[1, j]
        size_a, size_b = max(size_a, abs(s.moved[0, j])), max(size_b, abs(s.moved[1, j]))
    for q in range(p):
        F[q], G[q] = 0.0, 0.0
    for _ in range(REFINEMENTS):
        solve_joints(c)
        of_a, of_b = row_of(s.change, 0), row_of(s.change, 1)
        for q in range(p):
            row, f, g = int(unknown[q]), F[q], G[q]
            x = row_of(c.X, row)
            first, end = joints_of(c, row // 3)
            for j in range(first, end):
                f += x[j] * of_a[j]
                g += x[j] * of_b[j]
            F[q], G[q] = f, g
            s.rows_left[0, q], s.rows_left[1, q] = -f, -g
        for j in range(n):
            s.change[0, j], s.change[1, j] = s.moved[0, j], s.moved[1, j]
        add_rows(c, p)
        worst_a, worst_b = 0.0 * c.load[0], 0.0 * c.load[0]
        for j in range(n):
            worst_a, worst_b = max(worst_a, abs(s.change[0, j])), max(worst_b, abs(s.change[1, j]))
        if worst_a <= EXACT * size_a and worst_b <= EXACT * size_b:
            return True
    return False
