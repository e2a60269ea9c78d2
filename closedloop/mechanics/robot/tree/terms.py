"""The terms of the equation of motion and of the tip at one state, from the package's own code instead of Pinocchio.

Pinocchio's calls cost half a microsecond each and are made from Python. These kernels are compiled into the loop that
uses them.
"""

from __future__ import annotations

from closedloop.base.arrays import Array
from closedloop.jit.kernel import kernel
from closedloop.mechanics.robot.tree.dynamics import bodies, matrix_and_bias
from closedloop.mechanics.robot.tree.energy import add_springs
from closedloop.mechanics.robot.tree.kinematics import jacobian, motion, sines, tip, turning
from closedloop.mechanics.robot.tree.layout import Tree


@kernel
def tree_terms(
    tree: Tree, q: Array, v: Array, work: Array, H: Array, C: Array, of_tip: tuple[Array, Array, Array]
) -> None:
    """Write the terms of the robot in Eq. 24 at (q, v).

    Parameters
    ----------
    tree : Tree
        From `tree_of`.
    q, v : (n,) arrays
        Joint positions, rad (m), and rates, rad/s (m/s).
    work : (work_size(n),) array
        Scratch, zeros at first; not shared by threads.
    H : (n, n) array
        Written: mass matrix, kg m² (kg), armature included, the upper triangle; below it nothing is written.
    C : (n,) array
        Written: Coriolis, centrifugal and gravity terms, and those of springs, N m (N).
    of_tip : arrays (3, n), (3,) and (3,)
        Written: the tip's Jacobian Jᵣ (Eq. 13; zero for joints that do not move it), position r, m, and J̇ᵣq̇ (Eq. 18),
        m/s², in base axes.
    """
    J, r, drift = of_tip
    sines(tree, q, work)
    motion(tree, v, work)
    tip(tree, work, r, drift)
    jacobian(tree, work, r, J)
    bodies(tree, work)
    matrix_and_bias(tree, work, H, C)
    add_springs(tree, q, C)


@kernel
def tree_kinematics(tree: Tree, q: Array, v: Array, work: Array, J: Array, r: Array, drift: Array) -> None:
    """Write J (3, n), r (3,) and drift (3,) alone; see `tree_terms`."""
    sines(tree, q, work)
    motion(tree, v, work)
    tip(tree, work, r, drift)
    jacobian(tree, work, r, J)


@kernel
def tree_turning(tree: Tree, work: Array, axes: Array, J: Array) -> None:
    """Write the orientation of the tip's link, after `tree_kinematics` with this scratch.

    Parameters
    ----------
    tree, work
        See `tree_terms`.
    axes : (3, 3) array
        Written: the link's axes as `Tree` has them, columns, base axes.
    J : (3, n) array
        Written: the link's angular velocity per joint rate, base axes.
    """
    turning(tree, work, axes, J)
