"""Lists of a scenario that leave out joints of which the law asks nothing: free bodies, and loop joints without drives.

A loop joint with friction, limits or a drive is a joint of the tree (`robot_models.loop_coordinate`), and each list of
a scenario has an entry for it. A list without that of loop joints that have no drive is meant to go on as it is: where
they start follows from the posture. A free body starts where `closedloop.scenario.arm.start_positions` has it.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from closedloop.base.arrays import Array
from closedloop.jit.parameters import lists_per_joint
from closedloop.scenario.scenario import Scenario
from robot_models import RobotModel
from robot_models.coordinates import in_pinocchios_order
from robot_models.loop_coordinate import coordinate_rates, place_coordinates


def with_all_entries(scenario: Scenario, model: RobotModel) -> Scenario:
    """Return a scenario whose start, law and friction have an entry for each joint, if only those without one lack it.

    Of friction these are the free bodies alone, which have none. Lists of any other length are left as they are.
    """
    names, driven = model.loop_coordinates, model.joint_names if model.drives is None else model.drives
    given = np.array([name not in names or name in driven for name in model.joint_names], dtype=bool) & ~model.free
    count = int(given.sum())
    if count == model.n:
        return scenario

    start = _started(scenario, model, given) if names else {}
    lists = {
        name: tuple(_filled(values, given).tolist())
        for name, values in lists_per_joint(scenario.law).items()
        if len(values) == count
    }
    held = ~model.of_bodies
    in_joints = {
        name: tuple(_filled(values, held).tolist())
        for name, values in lists_per_joint(scenario.joint_friction).items()
        if len(values) == held.sum() < model.n
    }
    if not start and not lists and not in_joints:
        return scenario
    sections = ("start", start), ("law", lists), ("joint_friction", in_joints)
    return scenario.model_copy(
        update={name: getattr(scenario, name).model_copy(update=values) for name, values in sections if values}
    )


def _filled(values: Any, given: NDArray[np.bool_]) -> Array:
    """Return values with a zero for each joint that is not given."""
    whole = np.zeros(len(given))
    whole[given] = values
    return whole


def _started(scenario: Scenario, model: RobotModel, given: NDArray[np.bool_]) -> dict[str, Any]:
    """Return start.q and start.v with the coordinates of loop joints that they leave out, where they do."""
    q, v, count, start = scenario.start.q, scenario.start.v, int(given.sum()), {}
    types, built, posture = model.joint_types, model.pinocchio_model(), model.home
    held, own = (np.isin(model.coordinate_names, np.array(model.joint_names)[these]) for these in (~model.free, given))
    if q is not None:
        if len(q) not in (count, held.sum(), len(held)):
            return {}
        posture = posture.copy()
        everything = np.ones(len(held), dtype=bool)
        posture[{count: own, len(held): everything}.get(len(q), held)] = q
        if len(q) == count:
            placed = place_coordinates(built, model.loops, in_pinocchios_order(posture, types))
            posture = np.where(held & ~own, placed, posture)
            start["q"] = tuple(posture[held].tolist())
    if v is not None and len(v) == count:
        found = _filled(v, given)
        rates = coordinate_rates(built, model.loops, in_pinocchios_order(posture, types), found)
        start["v"] = tuple(np.where(given, found, rates)[~model.free].tolist())
    return start
