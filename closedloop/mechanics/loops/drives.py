"""Joints without a drive: what a law asks of them, and which of it the drives can give through the loops.

A joint without a drive gives no torque, and a drive that pulls several joints gives torques in one ratio. What all
drives give is a space of torques; what is perpendicular to it they give none of. But a force of the loops gives no
power to a motion that they allow, so that torques Q and Q' move the mechanism alike if vᵀQ = vᵀQ' for each v with
G v = 0. Let d be the part of a vector in that space, as in the joints with a drive, and p the rest, along
`robot_models.model.RobotModel.undriven`, and W an orthonormal basis of the motions of p alone, w with G w = 0 and
w_d = 0: the mechanism's drives held.

    Q'_p = 0,   Q'_d = Q_d + the shortest x with v_dᵀ x = v_pᵀ (1 − W Wᵀ) Q_p for each v with G v = 0

So where the drives span what the loops leave free, W is empty and Q' moves the mechanism just as Q would. Where they
do not, W Wᵀ Q_p, which is what gives power to motions that no drive takes part in, is lost, and the rest goes through
the loops. In a tree all of Q_p is lost.
"""

import math

import numpy as np

from closedloop.base.arrays import Array
from closedloop.jit.calls import row_of
from closedloop.jit.interpreted import interpreted
from closedloop.jit.kernel import kernel
from closedloop.mechanics.loops.bind import loop_memory
from closedloop.mechanics.loops.factor import DEPENDENT, factor
from closedloop.mechanics.loops.memory import LoopLinks, LoopRows
from closedloop.mechanics.loops.rows import locate_rows
from closedloop.mechanics.loops.solve import combine_rows, dot, free_motion, meet_rows, orthonormal_rows, take_off
from closedloop.mechanics.robot.pinocchio import Robot


@kernel
def lose_undriven(undriven: Array, count: int, x: Array) -> None:
    """Take off a torque or motion x (n,) its components along `count` rows of `undriven`, which are orthonormal."""
    for u in range(count):
        take_off(x, row_of(undriven, u), x.shape[0])


@kernel
def through_drives(links: LoopLinks, rows: LoopRows, torque: Array) -> int:
    """Replace a torque (n,) by one of the drives alone, with the rows factored last; return how many motions W has."""
    if links.undriven == 0:
        return 0
    n, count = links.n, links.n - links.rank
    powers_of_undriven(links, rows, torque)
    for i in range(count):
        Z = row_of(rows.drive_basis, i)
        free_motion(links, rows, i, Z)
        whole = dot(Z, Z, n)
        lose_undriven(rows.undriven, links.undriven, Z)
        if not dot(Z, Z, n) > DEPENDENT * DEPENDENT * whole:  # no drive takes part in it: what is left is rounding
            for j in range(n):
                Z[j] = 0.0
    rank = orthonormal_rows(rows.drive_basis, count, rows.drive_order, rows.drive_coefficients, rows.drive_lengths)
    if rank < count:
        lose_power_of_undriven(links, rows, torque, rank)
        powers_of_undriven(links, rows, torque)
    lose_undriven(rows.undriven, links.undriven, torque)
    meet_rows(
        rows.wanted, rows.drive_order, rows.drive_coefficients, rows.drive_basis, rank, rows.drive_lengths, rows.share
    )
    for j in range(n):
        torque[j] += rows.share[j]
    return int(count - rank)


@kernel
def powers_of_undriven(links: LoopLinks, rows: LoopRows, torque: Array) -> None:
    """Write the power of the joints without a drive in each free motion, of one free joint at rate one, `wanted`."""
    for i in range(links.n - links.rank):
        power = 0.0
        free_motion(links, rows, i, rows.share)
        for u in range(links.undriven):
            direction = row_of(rows.undriven, u)
            power += dot(rows.share, direction, links.n) * dot(torque, direction, links.n)
        rows.wanted[i] = power


@kernel
def lose_power_of_undriven(links: LoopLinks, rows: LoopRows, torque: Array, rank: int) -> None:
    """Take W Wᵀ Q_p off the torque; W, with the drives at rest, is written into the basis after its `rank` directions.

    What the drives do in the i-th free motion is Σ aₖ of what they do in `rank` others: less these, they do nothing.
    """
    n, count, a = links.n, links.n - links.rank, rows.drive_lengths
    for i in range(rank, count):
        W = row_of(rows.drive_basis, i)
        combine_rows(row_of(rows.drive_coefficients, i), rows.drive_coefficients, rank, a)
        free_motion(links, rows, int(rows.drive_order[i]), W)
        for k in range(rank):
            free_motion(links, rows, int(rows.drive_order[k]), rows.share)
            for j in range(n):
                W[j] -= a[k] * rows.share[j]
        for j in range(n):
            rows.share[j] = W[j]
        lose_undriven(rows.undriven, links.undriven, rows.share)
        for j in range(n):
            W[j] -= rows.share[j]
        for _ in range(2):
            for m in range(rank, i):
                take_off(W, row_of(rows.drive_basis, m), n)
        length = math.sqrt(dot(W, W, n))
        for j in range(n):
            W[j] /= length
        take_off(torque, W, n)


def torque_of_drives(robot: Robot, q: Array, torque: Array) -> tuple[Array, int]:
    """Return the torque (n,) of the drives alone, N m (N), for a given one of a mechanism at q, and W's dimension."""
    links, rows = loop_memory(robot)
    rows.q[:], found = robot.rotation_vectors(q), np.array(torque)
    interpreted(locate_rows)(links, rows)
    interpreted(factor)(links, rows, rows.error, links.m)
    return found, int(interpreted(through_drives)(links, rows, found))
