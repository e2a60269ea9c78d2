"""Faults in the arrays of the compiled engine: what `closedloop.mechanics.robot.tree.tree_of` made of the robot, made a
little wrong.

A robot's text read wrongly is planted in every engine (`validation.plant`); these are faults of the compiled engine's
own: one constant of one joint, the tip, gravity, the links' order.
"""

from collections.abc import Callable

import numpy as np

from closedloop.mechanics.robot.tree import Tree
from closedloop.mechanics.robot.tree import layout as at

PART = 1e-6


def _place(tree: Tree, joint: int, row: int) -> int:
    """Return where a joint's constant stands in `Tree.constants`."""
    return int(tree.links[at.CONSTANT * tree.n + joint]) + row


def _edited(tree: Tree, changes: dict[int, float]) -> Tree:
    constants = tree.constants.copy()
    for place, value in changes.items():
        constants[place] = value
    return tree._replace(constants=constants)


def _scaled(row: int) -> Callable[[Tree], Tree | None]:
    """Return a fault: the row's largest constant, a part in a million too large; None where all are zero."""

    def fault(tree: Tree) -> Tree | None:
        values = {place: tree.constants[place] for place in (_place(tree, i, row) for i in range(tree.n))}
        largest = max(values, key=lambda place: abs(values[place]))
        return _edited(tree, {largest: values[largest] * (1.0 + PART)}) if values[largest] else None

    return fault


def _turned(tree: Tree) -> Tree | None:
    """Turn the last joint's axis by a microradian about the common perpendicular with the one before."""
    joint = tree.n - 1
    if joint == 0 or tree.links[at.PARENT * tree.n + joint] < 0:
        return None
    places = [_place(tree, joint, row) for row in (at.COS_TWIST, at.SIN_TWIST)]
    angle = np.arctan2(tree.constants[places[1]], tree.constants[places[0]]) + PART
    return _edited(tree, {places[0]: np.cos(angle), places[1]: np.sin(angle)})


def _offset(row: int) -> Callable[[Tree], Tree | None]:
    """Return a fault: a joint's constant (m, or rad) a millionth too large, where the joint hangs on another."""

    def fault(tree: Tree) -> Tree | None:
        joint = tree.n - 1
        if tree.links[at.PARENT * tree.n + joint] < 0:
            return None
        place = _place(tree, joint, row)
        return _edited(tree, {place: tree.constants[place] + PART})

    return fault


def _tip(tree: Tree) -> Tree | None:
    return _edited(tree, {at.TIP: tree.constants[at.TIP] + PART}) if tree.carrier >= 0 else None


def _gravity(tree: Tree) -> Tree | None:
    """Tilt gravity by a microradian."""
    x, _, z = tree.constants[at.GRAVITY : at.GRAVITY + 3]
    return _edited(tree, {at.GRAVITY: x + PART * z, at.GRAVITY + 2: z - PART * x}) if x or z else None


def _no_support(tree: Tree) -> Tree | None:
    """Forget that the first joint moves the tip."""
    links = tree.links.copy()
    links[at.SUPPORT * tree.n] = 0
    return tree._replace(links=links) if tree.links[at.SUPPORT * tree.n] else None


TREE_FAULTS: dict[str, Callable[[Tree], Tree | None]] = {
    "a joint axis turned by 1 µrad": _turned,
    "a joint's angle 1 µrad off": _offset(at.ANGLE),
    "a joint's origin 1 µm off": _offset(at.T0),
    "a second moment +1 ppm": _scaled(at.HALF_XX),
    "a product of inertia +1 ppm": _scaled(at.XY),
    "a first moment +1 ppm": _scaled(at.HX),
    "a drive's inertia +1 ppm": _scaled(at.ARMATURE),
    "the tip 1 µm off": _tip,
    "gravity tilted by 1 µrad": _gravity,
    "a joint missing from the tip's support": _no_support,
}
"""Name -> what makes a tree faulty, or None where the robot has nothing to carry it."""
