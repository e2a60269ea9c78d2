"""Any tree of revolute, continuous and prismatic joints, in compiled code of our own: H, C, Jᵣ, r, J̇ᵣq̇ and energy.

    tree = tree_of(robot_models.load("wam4"), "tip")
    work = np.zeros(work_size(tree.n))
    tree_terms(tree, q, v, work, H, C, (J, r, drift))

Tests hold it equal to Pinocchio; the simulator's two engines use one each.
"""

from closedloop.mechanics.robot.tree.dynamics import tree_kinematics, tree_terms, tree_turning
from closedloop.mechanics.robot.tree.energy import (
    energies_of_rows,
    energy_there,
    potential_energies,
    tree_potential_energy,
)
from closedloop.mechanics.robot.tree.layout import LINK_ROWS, Tree, work_size
from closedloop.mechanics.robot.tree.model import group_ends, tree_of

__all__ = [
    "LINK_ROWS", "Tree", "energies_of_rows", "energy_there", "group_ends", "potential_energies", "tree_kinematics",
    "tree_of", "tree_potential_energy", "tree_terms", "tree_turning", "work_size",
]  # fmt: skip
