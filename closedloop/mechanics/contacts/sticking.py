"""Contacts that all stick, with more rows than there are joints: the shortest forces, by equations of the joints alone.

Of the rows X = L⁻¹Gᵀ the forces are to give u̇ = b, so that with s = b − a they obey X Xᵀ F = s. With X of full column
rank, and M = XᵀX, of as many rows as there are joints,

    z = M⁻¹ Xᵀ s,        F = X M⁻¹ z

z is what the forces do to the joints, of least squares where the rows contradict each other by rounding, and F the
shortest of the forces that do it. Elimination in M keeps to what is not zero: bodies on each other couple neighbours.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from closedloop.jit.kernel import kernel
from closedloop.jit.pointers import row_of
from closedloop.mechanics.contacts.memory import CONE, DOUBLE, OFF, Contacts
from closedloop.mechanics.contacts.resistance import has_resistance, is_resistance
from closedloop.mechanics.contacts.shortest import CONTRADICTS, EXACT, REFINEMENTS, SAME_ROW

Array = NDArray[np.float64]

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
        for j in range(int(c.first[row // 3]), int(c.end[row // 3])):
            square += c.X[row, j] * c.X[row, j]
        if not abs(square - c.W[row, row]) <= OWN_ROW * square:
            return False
    return True


@kernel
def shortest_sticking(c: Contacts, p: int) -> float:
    """Write as `solution` the shortest forces of p unknowns that all stick; see `all_stick`.

    Returns
    -------
    float
        The size of the terms on the right; negative if X is not of full rank, rounding is in the way, or the rows
        contradict each other.
    """
    asked = 0.0
    if not factor_joints(c, p):
        return float(0.0 * c.load[0] - 1.0)
    for q in range(p):
        row, size = int(c.scratch.unknown[q]), 0.0
        for j in range(int(c.first[row // 3]), int(c.end[row // 3])):
            size += abs(c.X[row, j] * c.load[j])
        asked = max(asked, size + abs(c.drift[row]) + abs(c.b[row]))
    for side in range(2):
        if not (moved_joints(c, p, side) <= CONTRADICTS * asked and spread(c, p, side)):
            return float(0.0 * c.load[0] - 1.0)
    return float(asked)


@kernel
def factor_joints(c: Contacts, p: int) -> bool:
    """Write Cholesky's factor of M = XᵀX below the diagonal of `unknowns`, and where its rows begin as `multiplier`."""
    n, M, begins = c.X.shape[1], c.scratch.unknowns, c.scratch.multiplier
    for i in range(n):
        begins[i] = i
        for j in range(i + 1):
            M[i, j] = 0.0
    for q in range(p):
        row = int(c.scratch.unknown[q])
        x, first, end = row_of(c.X, row), int(c.first[row // 3]), int(c.end[row // 3])
        while first < end and x[first] == 0.0:
            first += 1
        for i in range(first, end):
            share = x[i]
            if share != 0.0:
                begins[i] = min(begins[i], 1.0 * first)
                to = row_of(M, i)
                for j in range(first, i + 1):
                    to[j] += share * x[j]
    for i in range(n):
        row, begin = row_of(M, i), int(begins[i])
        whole = row[i]
        for j in range(begin, i + 1):
            left, other = row[j], row_of(M, j)
            for t in range(max(begin, int(begins[j])), j):
                left -= row[t] * other[t]
            row[j] = left / other[j] if j < i else left
        if not row[i] > SAME_ROW * whole:
            return False
        row[i] = math.sqrt(row[i])
    return True


@kernel
def solve_joints(c: Contacts, x: Array) -> None:
    """Overwrite x (n,) with M⁻¹x."""
    n, M, begins = c.X.shape[1], c.scratch.unknowns, c.scratch.multiplier
    for i in range(n):
        row, left = row_of(M, i), x[i]
        for t in range(int(begins[i]), i):
            left -= row[t] * x[t]
        x[i] = left / row[i]
    for i in range(n - 1, -1, -1):
        row = row_of(M, i)
        x[i] /= row[i]
        for t in range(int(begins[i]), i):
            x[t] -= row[t] * x[i]


@kernel
def moved_joints(c: Contacts, p: int, side: int) -> float:
    """Write z = M⁻¹Xᵀs as `sum`, of s = −a, or with `side` b − a; return the largest that X z is off."""
    n, z, change, left = c.X.shape[1], c.scratch.sum, c.scratch.sum_trial, c.scratch.trial
    worst, size = 0.0, 0.0
    for j in range(n):
        z[j] = 0.0
    for q in range(p):
        row = int(c.scratch.unknown[q])
        left[q] = (c.b[row] if side == 1 else 0.0) - c.a[row]
        size = max(size, abs(left[q]))
    for _ in range(2):  # the second time of what rounding has left
        for j in range(n):
            change[j] = 0.0
        for q in range(p):
            row, share = int(c.scratch.unknown[q]), left[q]
            x = row_of(c.X, row)
            for j in range(int(c.first[row // 3]), int(c.end[row // 3])):
                change[j] += share * x[j]
        solve_joints(c, change)
        for j in range(n):
            z[j] += change[j]
        worst = 0.0
        for q in range(p):
            row, moved = int(c.scratch.unknown[q]), 0.0
            x = row_of(c.X, row)
            for j in range(int(c.first[row // 3]), int(c.end[row // 3])):
                moved += x[j] * change[j]
            left[q] -= moved
            worst = max(worst, abs(left[q]))
        if worst <= EXACT * size:
            break
    return float(worst)


@kernel
def spread(c: Contacts, p: int, side: int) -> bool:
    """Write the shortest F with XᵀF = z, of `sum`, as row `side` of `solution`; return whether they are exact."""
    n, z, left, change = c.X.shape[1], c.scratch.sum, c.scratch.sum_trial, c.scratch.multiples
    F = row_of(c.scratch.solution, side)
    size, worst = 0.0, 0.0
    for j in range(n):
        left[j] = z[j]
        size = max(size, abs(z[j]))
    for q in range(p):
        F[q] = 0.0
    for _ in range(REFINEMENTS):
        for j in range(n):
            change[j] = left[j]
        solve_joints(c, change)
        for j in range(n):
            left[j] = z[j]
        for q in range(p):
            row = int(c.scratch.unknown[q])
            x, first, end = row_of(c.X, row), int(c.first[row // 3]), int(c.end[row // 3])
            for j in range(first, end):
                F[q] += x[j] * change[j]
            for j in range(first, end):
                left[j] -= x[j] * F[q]
        worst = 0.0
        for j in range(n):
            worst = max(worst, abs(left[j]))
        if worst <= EXACT * size:
            return True
    return bool(worst <= EXACT * size)
