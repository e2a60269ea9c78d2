"""What couples the joints of a compiled MJCF, and what drives them.

Equalities are loop joints that hold exactly, where MuJoCo holds them by a soft force (solref, solimp): `connect` is a
point, `weld` a weld, `joint` a gear, and `tendon`, of fixed tendons, a gear between sums of joints. What holds is taken
from MuJoCo's own numbers, so that it is the same at every posture.

An actuator drives the joint that it acts on, or the joints of the fixed tendon that it pulls: with its force times its
gear times the joint's coefficient. Of a torque that is asked of joints that are pulled together, that part acts which
their drives can give (`robot_models.model.RobotModel.undriven`). An actuator's force is held in `forcerange`; that of
a motor is its control, held in `ctrlrange`. Actuators of one joint add up, and `actuatorfrcrange` of the joint holds
their sum.
"""

from collections.abc import Collection
from math import comb, inf
from typing import TYPE_CHECKING, Any

import numpy as np

from robot_models.errors import ModelError
from robot_models.loop_joint import MOST_NUMBER, WORLD, LoopJoint
from robot_models.mechanism import Array

if TYPE_CHECKING:
    from robot_models.mjcf import Names

# MuJoCo's numbers of kinds.
_CONNECT, _WELD, _JOINT, _TENDON = 0, 1, 2, 3
AT_JOINT, AT_TENDON = (0, 1), 3  # a joint in its own or its parent's axes
_SITE, _WRAPS_JOINT = 6, 1
_OTHER_TRANSMISSIONS = {2: "a crank", 4: "a site", 5: "a body"}
_FOLLOWS = (0, 2, 3)  # no activation, or one that goes to the control and never beyond


def couplings(
    model: Any, names: "Names", where: str, mocap: Collection[str] = ()
) -> tuple[tuple[LoopJoint, ...], list[str]]:
    """Return the equalities of a compiled model as loop joints, and warnings of what is left out.

    Those to a mocap body are left out but for bodies that are named in `mocap`, whose motion a scenario gives.

    Raises `ModelError` if one is not simulated.
    """
    made: list[LoopJoint] = []
    warnings = _idle_tendons(model, names, where)
    for k in range(model.neq):
        if not model.eq_active0[k]:
            continue
        kind = int(model.eq_type[k])
        if kind > _TENDON:
            raise ModelError(f"{where}: <equality>: a <flex> is not simulated: remove it from the model")
        title = ("connect", "weld", "joint", "tendon")[kind]
        name = names.own("eq", k) or f"{title} {k + 1}"
        largest = float(np.abs(model.eq_data[k]).max())
        if not largest <= MOST_NUMBER:
            raise ModelError(
                f"{where}: {title} {name!r} has the number {largest:g}: it must be at most {MOST_NUMBER:g}"
            )
        if kind in (_CONNECT, _WELD):
            ends = _ends(model, names, k)
            pulled = [frame for frame, body in ends if model.body_mocapid[body] >= 0 and names.body[body] not in mocap]
            if pulled:
                warnings.append(
                    f"{title} {name!r} to the mocap body {pulled[0]!r} is left out: a [[mocap]] of a scenario with "
                    f"frame = {pulled[0]!r} moves the robot by it; a [[closed_loop]] of a sidecar with frames = [..., "
                    f"{pulled[0]!r}] holds it where that stands"
                )
                continue
            made.append(_frames(model, k, kind, name, ends))
        else:
            made.append(_gear(model, k, name, names.joint, where))
    for a in range(model.nu):
        if what := _OTHER_TRANSMISSIONS.get(int(model.actuator_trntype[a])):
            name = names.own("actuator", a) or str(a + 1)
            warnings.append(f"actuator {name!r} acts on {what} and is left out: drives are of joints and fixed tendons")
    if drives(model, names.joint) == ():
        warnings.append(
            "no joint has a drive, and a law gives no torque: drives of a sidecar says which joints have one"
        )
    return tuple(made), warnings


def _ends(model: Any, names: "Names", k: int) -> list[tuple[str, int]]:
    """Return the two frames of an equality, each with its body."""
    found = []
    for index in (int(model.eq_obj1id[k]), int(model.eq_obj2id[k])):
        if int(model.eq_objtype[k]) == _SITE:
            found.append((names.site[index], int(model.site_bodyid[index])))
        else:
            found.append((names.body[index] if index else WORLD, index))
    return found


def _frames(model: Any, k: int, kind: int, name: str, ends: list[tuple[str, int]]) -> LoopJoint:
    """Return a `connect` or a `weld` as a loop joint; the world is its second side."""
    data, type_ = np.array(model.eq_data[k]), "point" if kind == _CONNECT else "weld"
    frames = [frame for frame, _ in ends]
    points, turn = [np.zeros(3), np.zeros(3)], np.eye(3)
    if int(model.eq_objtype[k]) != _SITE:  # sites coincide
        points = [data[:3], data[3:6]] if kind == _CONNECT else [data[3:6], data[:3]]
        turn = rotation(data[6:10]).T if kind == _WELD else turn  # of the first frame's axes, in the second frame
    if frames[0] == WORLD:
        frames, points, turn = frames[::-1], points[::-1], turn.T
    return LoopJoint(name, type_, tuple(frames), _vectors(*points), turn=_vectors(*turn))


def rotation(quaternion: Array) -> Array:
    """Return the rotation (3, 3) of a quaternion w, x, y, z of any length."""
    w, x, y, z = np.asarray(quaternion) / np.linalg.norm(quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _vectors(*rows: Array) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(float(x) for x in row) for row in rows)


def _gear(model: Any, k: int, name: str, joints: list[str], where: str) -> LoopJoint:
    """Return an equality of joints or of fixed tendons, x1 − r1 = P(x2 − r2) with r where the model is assembled.

    Between two joints it is the gear q1 = P(q2) where a polynomial says so.

    Raises `ModelError` if it binds no joint.
    """
    (first, r1), (second, r2) = (_sum(model, k, int(end[k])) for end in (model.eq_obj1id, model.eq_obj2id))
    P = np.zeros(5)
    for power, coefficient in enumerate(model.eq_data[k][: 5 if second else 1].tolist()):
        for i in range(power + 1):
            P[i] += coefficient * comb(power, i) * (-r2) ** (power - i)
    P[0] += r1
    bound = [*first, *(j for j in second if j not in first)]
    if not P[2:].any():  # one sum says it all
        first = {j: first.get(j, 0.0) - P[1] * second.get(j, 0.0) for j in bound}
        bound, P[1], second = [j for j in bound if first[j]], 0.0, {}
        if 1 <= len(bound) <= 2:
            lead, *rest = (first[j] for j in bound)
            P[:2] = P[0] / lead, -rest[0] / lead if rest else 0.0
            first, second = {bound[0]: 1.0}, dict.fromkeys(bound[1:], 1.0)
    if not (first and bound):
        raise ModelError(f"{where}: equality {name!r} binds no joint: leave it out")
    plain = list(first) == bound[:1] and first[bound[0]] == 1.0 and [*second.items()] == [(j, 1.0) for j in bound[1:]]
    rows = () if plain else tuple(tuple(each.get(j, 0.0) for j in bound) for each in (first, second))
    return LoopJoint(
        name, "gear", joints=tuple(joints[j] for j in bound), polynomial=tuple(P.tolist()), coefficients=rows
    )


def _sum(model: Any, k: int, end: int) -> tuple[dict[int, float], float]:
    """Return the joints of a side of an equality with their coefficients, and its value where the model is assembled.

    That side is a joint or a fixed tendon; −1 is none.
    """
    if end < 0:
        return {}, 0.0
    if int(model.eq_type[k]) == _JOINT:
        return {end: 1.0}, float(model.qpos0[model.jnt_qposadr[end]])
    found: dict[int, float] = {}
    for joint, coefficient in tendon_joints(model, end):
        found[joint] = found.get(joint, 0.0) + coefficient
    return {joint: c for joint, c in found.items() if c}, float(model.tendon_length0[end])


def tendon_joints(model: Any, tendon: int) -> list[tuple[int, float]]:
    """Return the joints of a fixed tendon with their coefficients; none of a spatial one."""
    first = int(model.tendon_adr[tendon])
    parts = range(first, first + int(model.tendon_num[tendon]))
    if any(model.wrap_type[i] != _WRAPS_JOINT for i in parts):
        return []
    return [(int(model.wrap_objid[i]), float(model.wrap_prm[i])) for i in parts]


def _idle_tendons(model: Any, names: "Names", where: str) -> list[str]:
    """Refuse spatial tendons that act, and an armature of others, and return warnings of those that do not act."""
    used = {int(model.actuator_trnid[a][0]) for a in range(model.nu) if model.actuator_trntype[a] == AT_TENDON}
    used |= {int(i) for k in np.flatnonzero(model.eq_type == _TENDON) for i in (model.eq_obj1id[k], model.eq_obj2id[k])}
    warnings = []
    for t in range(model.ntendon):
        name = names.own("tendon", t) or str(t + 1)
        acting = [
            key
            for key in ("stiffness", "stiffnesspoly", "damping", "dampingpoly", "frictionloss", "armature", "limited")
            if np.any(getattr(model, f"tendon_{key}")[t])
        ]
        if not tendon_joints(model, t):
            if acting or t in used:
                raise ModelError(f"{where}: tendon {name!r} is spatial, which is not simulated: leave it out")
            warnings.append(f"tendon {name!r} is spatial and left out: it does no work")
        elif "armature" in acting:
            raise ModelError(f"{where}: the armature of tendon {name!r} is not simulated: leave it out")
    return warnings


def _actuated(model: Any) -> list[tuple[int, int, float]]:
    """Return each actuator with each joint that it drives, and the torque there of a force of one."""
    found = []
    for a in range(model.nu):
        kind, target = int(model.actuator_trntype[a]), int(model.actuator_trnid[a][0])
        gear = float(model.actuator_gear[a][0])
        if kind in AT_JOINT:
            found.append((a, target, gear))
        elif kind == AT_TENDON:
            found += [(a, joint, gear * coefficient) for joint, coefficient in tendon_joints(model, target)]
    return found


def pulled_tendons(model: Any) -> set[int]:
    """Return the tendons that actuators pull, if one of them has several joints."""
    at = {int(model.actuator_trnid[a][0]) for a in range(model.nu) if model.actuator_trntype[a] == AT_TENDON}
    return at if any(len({joint for joint, c in tendon_joints(model, t) if c}) > 1 for t in at) else set()


def drives(model: Any, joints: list[str]) -> tuple[str, ...] | None:
    """Return the joints of one coordinate that have a drive, of all named `joints`; None if that is every one.

    That is also where the file has no actuator at all: a law is then to drive it.
    """
    driven = {joint for _, joint, ratio in _actuated(model) if ratio and model.jnt_type[joint] > 1}
    single = {joint for joint in range(model.njnt) if model.jnt_type[joint] > 1}
    return tuple(joints[joint] for joint in sorted(driven)) if model.nu and driven != single else None


def torque_limits(model: Any) -> dict[int, float]:
    """Return the largest torque of the drives of each joint that has a limit, N m (N)."""
    most: dict[int, float] = {}
    for a, joint, ratio in _actuated(model):
        force = _limit(model.actuator_forcerange[a], model.actuator_forcelimited[a])
        plain = model.actuator_gaintype[a] == 0 and model.actuator_biastype[a] == 0
        if plain and int(model.actuator_dyntype[a]) in _FOLLOWS:
            gain = abs(float(model.actuator_gainprm[a][0]))
            force = min(
                force, gain * _limit(model.actuator_ctrlrange[a], model.actuator_ctrllimited[a]) if gain else 0.0
            )
        most[joint] = most.get(joint, 0.0) + (abs(ratio) * force if ratio else 0.0)
    for joint in range(model.njnt):
        own = _limit(model.jnt_actfrcrange[joint], model.jnt_actfrclimited[joint])
        most[joint] = min(own, most.get(joint, inf))
    return {joint: limit for joint, limit in most.items() if 0.0 < limit < inf}


def _limit(given: Any, limited: Any) -> float:
    """Return the magnitude that a range allows in both directions, infinite where it is none.

    Of a range that allows one direction alone it is the larger bound.
    """
    low, high = float(given[0]), float(given[1])
    if not limited:
        return inf
    return min(-low, high) if low < 0.0 < high else max(abs(low), abs(high))
