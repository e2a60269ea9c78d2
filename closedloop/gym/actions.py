"""What an action sets: torques, the desired force, a displacement of the desired tip, or parameters of the law."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from closedloop.base.arrays import Array, IntArray
from closedloop.base.errors import ScenarioError
from closedloop.jit.parameters import parameter_block
from closedloop.simulation.engines.problem import Problem
from closedloop.simulation.ensemble.member import FORCE, JOINT, PARAMETER, SHIFT, TORQUE

AXES = ("n", "t1", "t2")
WORDS = "torque, force, tip, tip.n, tip.t1, tip.t2, joint, joint.NAME, or law.KEY"


class Actions:
    """The numbers of an action from −1 to 1, and what each sets.

    Parameters
    ----------
    given : mapping of str to (low, high)
        "torque": of each joint, N m, held until the next action, in place of the law's. "force": f_des, N. "tip": a
        displacement of the desired tip along the normal and both tangents of the contact, m; "tip.n", "tip.t1" or
        "tip.t2": along one. "joint": a displacement of each desired joint position, rad (m); "joint.NAME": of one.
        "law.KEY": a parameter of the scenario's law, of all joints alike where it is one a joint.
        −1 and 1 are `low` and `high`, which may be lists with an entry for each number; what is left out is as the
        scenario says.
    problem : Problem
        What the scenario is prepared as.

    Attributes
    ----------
    names : tuple of str
        One for each number.
    low, high : (k,) arrays
        SI units.
    plan : (l, 3) array
        See `closedloop.simulation.ensemble.member.act`.
    held : bool
        Whether it sets torques.
    """

    def __init__(self, given: Mapping[str, Any], problem: Problem) -> None:
        if not given:
            raise ScenarioError(f"actions: is empty: name what an action sets, {WORDS}, and its range")
        self.held = "torque" in given
        if self.held and len(given) > 1:
            raise ScenarioError(f"actions: {', '.join(given)}: torques replace the law, so nothing goes with them")
        names: list[str] = []
        plan: list[tuple[int, int, int]] = []
        low: list[float] = []
        high: list[float] = []
        for name, ends in given.items():
            parts = _parts(name, problem)
            a, b = _ends(name, ends, len(parts))
            for (label, places), each_low, each_high in zip(parts, a, b, strict=True):
                plan += [(*place, len(names)) for place in places]
                names.append(label)
                low.append(each_low)
                high.append(each_high)
        if len(set(names)) < len(names):
            raise ScenarioError(f"actions: {', '.join(given)}: set {max(names, key=names.count)} twice")
        self.names = tuple(names)
        self.low, self.high = np.array(low), np.array(high)
        self.plan: IntArray = np.array(plan, dtype=np.int64)

    def physical(self, action: Array) -> Array:
        """Return actions (N, k) from −1 to 1 in SI units."""
        share = 0.5 * (action + 1.0)
        return (1.0 - share) * self.low + share * self.high  # exact at either end

    def normal(self, values: Array) -> Array:
        """Return the action (k,) from −1 to 1 that sets these values, SI units, cut to what can be set."""
        span = np.where(self.high > self.low, self.high - self.low, 1.0)
        return np.clip(2.0 * (values - self.low) / span - 1.0, -1.0, 1.0)


def _parts(name: str, problem: Problem) -> list[tuple[str, list[tuple[int, int]]]]:
    """Return the label of each number of a kind of action, and what it sets at which places."""
    robot = problem.robot
    if name == "torque":
        return [(f"torque.{joint}", [(TORQUE, j)]) for j, joint in enumerate(robot.model.joint_names)]
    if name == "force":
        return [("force", [(FORCE, 0)])]
    if name == "tip":
        return [(f"tip.{axis}", [(SHIFT, i)]) for i, axis in enumerate(AXES)]
    if name.startswith("tip.") and name[4:] in AXES:
        return [(name, [(SHIFT, AXES.index(name[4:]))])]
    joints = robot.model.joint_names
    if name == "joint":
        return [(f"joint.{joint}", [(JOINT, j)]) for j, joint in enumerate(joints)]
    if name.startswith("joint."):
        if name[6:] not in joints:
            raise ScenarioError(f"actions[{name!r}]: no such joint; there are {', '.join(joints)}")
        return [(name, [(JOINT, joints.index(name[6:]))])]
    key = name.removeprefix("law.")
    block = parameter_block(problem.law.member)
    if not name.startswith("law.") or key not in block.layout.at:
        known = ", ".join(f"law.{each}" for each in block.layout.at)
        raise ScenarioError(f"actions[{name!r}]: must be {WORDS}; of this law there are {known}")
    place = block.place(key, robot.n)
    places = range(place.start, place.stop) if isinstance(place, slice) else (place,)
    return [(name, [(PARAMETER, at) for at in places])]


def _ends(name: str, given: Any, count: int) -> tuple[list[float], list[float]]:
    try:
        low, high = given
        a, b = (np.broadcast_to(np.asarray(each, dtype=np.float64), count) for each in (low, high))
    except (TypeError, ValueError):
        a, b = np.array([np.nan]), np.array([np.nan])
    if not (np.all(np.isfinite(a)) and np.all(np.isfinite(b)) and np.all(a <= b)):
        raise ScenarioError(f"actions[{name!r}] = {given!r}: must be (low, high), each a number or {count}")
    return a.tolist(), b.tolist()
