"""MJCF as MuJoCo's own compiler reads it, as a plain text that holds the mechanism, and as Pinocchio's model.

A file is compiled with its includes, classes, frames, replicas and attached models, and everything is taken from the
compiled model. Its plain text has bodies, joints, inertias, sites and shapes with all numbers written out. It stands by
itself, and MuJoCo compiles it to the same mechanism to the last bit. What couples joints and what drives them is
beside the text (`robot_models.mjcf_coupling`).

What does no work is left out with a warning. What would change the motion and cannot be simulated is refused by name.

In Pinocchio's model bodies that are fixed to each other share a joint's link, and each keeps its frame. Several joints
of one body follow each other, with nothing between them. A hinge's position is MuJoCo's: at its `ref` the body is as it
is written.
"""

import xml.etree.ElementTree as ET
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from robot_models import mjcf_coupling as coupling
from robot_models.collision import HULL, MOST_CORNERS
from robot_models.coordinates import PARTS, PLACES
from robot_models.errors import ModelError, some, warnings_heard
from robot_models.loop_joint import LoopJoint
from robot_models.mechanism import Array, check_count
from robot_models.physics import check_size
from robot_models.xml_text import parse, read_text, tidy, words

#: Names of the kinds of joints and of geoms, by MuJoCo's numbers.
JOINTS = ("free", "ball", "slide", "hinge")
_GEOMS = {2: "sphere", 3: "capsule", 4: "ellipsoid", 5: "cylinder", 6: "box"}
_NOT_READ = {0: "planes", 1: "height fields", 8: "signed distance fields"}
# How many numbers the size of each shape has.
_SIZES = {"sphere": 1, "capsule": 2, "cylinder": 2, "ellipsoid": 3, "box": 3}

#: Velocities of a joint that has more than one, by its kind; and its positions.
ONE_BY_ONE, POSITIONS = {"ball": 3, "free": 6}, {"ball": 4, "free": 7}

_MUSCLE, _MESH, _OF_ITS_HULL = 2, 7, 0


# Numbers that place, move or weigh, by kinds of objects.
_NUMBERS = {
    "body": ("pos", "quat", "ipos", "iquat", "mass", "inertia"),
    "jnt": ("pos", "axis", "range", "stiffness", "stiffnesspoly"),
    "site": ("pos", "quat"),
}
_TITLES = {"body": "body", "jnt": "joint", "site": "site"}


class Mjcf(NamedTuple):
    """What a file says.

    home: the posture of the keyframe "home", of the first one or of the model, by the names of coordinates: rad (m)
    drives: joints with a drive; None: all
    warnings: what was left out, a line each
    """

    text: str
    home: dict[str, float]
    loops: tuple[LoopJoint, ...]
    drives: tuple[str, ...] | None
    warnings: list[str]


def read(text: str, where: str, path: Path | None, mocap: Collection[str] = ()) -> Mjcf:
    """Return what MuJoCo makes of an MJCF.

    path: its file, for what it includes; None for a text that must stand by itself
    mocap: mocap bodies whose equalities are loop joints
    Raises `ModelError` if MuJoCo refuses it, or it says something that cannot be simulated.
    """
    root = parse(text, where)
    if root.tag != "mujoco":
        raise ModelError(f"{where} is no MJCF: its root is <{root.tag}>, not <mujoco>")
    tidy(root)
    _check_includes(root, where, None if path is None else path.parent, [])
    with _said() as warnings:
        model, unread = _compile(ET.tostring(root, encoding="unicode") if path is None else path, where)
    names = Names(model)
    _check(model, names, where)
    warnings += unread + _left_out(model, names)
    joints = names.joint
    limits = coupling.torque_limits(model)
    plain = ET.Element("mujoco", model=root.get("model") or "model")
    ET.SubElement(plain, "compiler", angle="radian", inertiafromgeom="false", autolimits="true")
    ET.SubElement(plain, "option", gravity=words(_gravity(model)))
    world = ET.SubElement(plain, "worldbody")
    bodies = {0: world}
    for b in range(model.nbody):
        if b:
            place = {"pos": words(model.body_pos[b]), "quat": words(model.body_quat[b])}
            bodies[b] = ET.SubElement(bodies[int(model.body_parentid[b])], "body", {"name": names.body[b], **place})
        _write_body(bodies[b], b, model, names, limits)
    _write_hulls(plain, model, names)
    _write_tendons(plain, model, names)
    _write_drives(plain, model, names)
    loops, more = coupling.couplings(model, names, where, mocap)
    return Mjcf(
        ET.tostring(plain, encoding="unicode"), _home(model, joints), loops, coupling.drives(model, joints),
        list(dict.fromkeys(warnings + more)),
    )  # fmt: skip


#: Files that one model may include.
MAX_INCLUDES = 100


def _check_includes(root: ET.Element, where: str, folder: Path | None, seen: list[str]) -> None:
    """Refuse what cannot be included: MuJoCo would wait for a pipe for ever."""
    for element in root.iter("include"):
        name = element.get("file")
        if not name or folder is None:
            raise ModelError(f"{where}: cannot include {name!r}: the text must stand by itself")
        seen.append(name)
        if len(seen) > MAX_INCLUDES:
            raise ModelError(f"{where} includes more than {MAX_INCLUDES} files: merge some")
        try:
            included = parse(read_text(folder / name), name)
        except ModelError as error:
            raise ModelError(f"{where}: included {name}: {error}") from None
        _check_includes(included, where, folder, seen)


class Names:
    """Names of bodies, joints, sites and tendons of a compiled model: its own, or made up where it has none.

    A joint without a name has that of its body. Bodies and sites have different names, since both are frames.
    """

    def __init__(self, model: Any):
        self._model = model
        used: set[str] = {"world"}
        self.body = ["world"] + [
            _unused(self.own("body", b) or f"body{b}", used, "body") for b in range(1, model.nbody)
        ]
        self.site = [_unused(self.own("site", s) or f"site{s}", used, "site") for s in range(model.nsite)]
        taken = {self.own("jnt", j) for j in range(model.njnt)}
        own = {self.own("tendon", t) for t in range(model.ntendon)}
        self.tendon = [self.own("tendon", t) or _unused(f"tendon {t + 1}", own, "tendon") for t in range(model.ntendon)]
        self.joint = [
            self.own("jnt", j) or _unused(self.body[model.jnt_bodyid[j]], taken, "joint") for j in range(model.njnt)
        ]

    def own(self, kind: str, index: int) -> str:
        """Return the name that the file gives to an object of a kind, as "body", "jnt" or "eq"; "" if none."""
        return str(getattr(self._model, kind)(index).name)


def _unused(name: str, used: set[str], kind: str) -> str:
    """Return a name, or one made of it that nothing else has, and note it as used."""
    found, k = name, 1
    while found in used:
        found, k = f"{name} {kind}{k if k > 1 else ''}", k + 1
    used.add(found)
    return found


@contextmanager
def _said() -> Iterator[list[str]]:
    """Collect what MuJoCo warns of; some of it, it otherwise writes to a file in the current folder."""
    import mujoco

    found: list[str] = []
    with warnings_heard() as heard:
        before = mujoco.get_mju_user_warning()
        mujoco.set_mju_user_warning(lambda text: found.append(f"MuJoCo says: {_one_line(text)}"))
        try:
            yield found
        finally:
            mujoco.set_mju_user_warning(before)
    found += [f"MuJoCo says: {_one_line(each.message)}" for each in heard]


def _one_line(text: object) -> str:
    return " ".join(str(text).split())


def _compile(source: str | Path, where: str) -> tuple[Any, list[str]]:
    """Return MuJoCo's model of a file or a text, and what of it is left out.

    A mesh that is only drawn is not opened; one that touches, and from which no inertia follows, need not be there.
    """
    import mujoco

    read_in = mujoco.MjSpec.from_string if isinstance(source, str) else mujoco.MjSpec.from_file
    reason = ""
    for touching in (True, False):
        try:
            spec = read_in(source if isinstance(source, str) else str(source))
            _drop_idle_assets(spec, touching)
            model = spec.compile()
        except (ValueError, TypeError, KeyError, RuntimeError, mujoco.FatalError) as error:
            reason = _one_line(error).removeprefix("Error: ").replace("XML Error: ", "")
            continue
        return model, [f"meshes of the file are not read as shapes: {reason}"] if reason else []
    raise ModelError(f"{where}: MuJoCo cannot read it: {reason}") from None


def _drop_idle_assets(spec: Any, touching: bool) -> None:
    """Delete what is only drawn, whose files need not be there: skins, textures, and meshes that weigh nothing.

    Meshes that only touch stay where `touching` says so.
    """
    weighs = int(spec.compiler.inertiafromgeom)  # 0: no, 1: always, 2: where a body has no <inertial>
    for geom in list(spec.geoms):
        body = geom.parent
        idle = weighs == 0 or (weighs == 2 and body.explicitinertial) or body.name == "world"
        touches = touching and (geom.contype or geom.conaffinity)
        if int(geom.type) == _MESH and idle and not touches:
            spec.delete(geom)
            continue
        geom.material = ""
    for skin in list(spec.skins):
        spec.delete(skin)
    for site in spec.sites:
        site.material = ""
    for tendon in spec.tendons:
        tendon.material = ""
    for asset in (*spec.materials, *spec.textures):
        spec.delete(asset)
    used = {geom.meshname for geom in spec.geoms}
    for mesh in list(spec.meshes):
        if int(mesh.inertia) != _OF_ITS_HULL:
            mesh.maxhullvert = MOST_CORNERS
        if mesh.name not in used:
            spec.delete(mesh)


@lru_cache(maxsize=8)
def compiled(text: str, where: str = "the model") -> Any:
    """Return MuJoCo's model of a plain text, that of `read`; it is not to be changed. Raises `ModelError`."""
    with _said():
        return _compile(text, where)[0]


def gravity(text: str) -> tuple[float, float, float]:
    """Return the gravity of a plain text, m/s² in the world frame."""
    x, y, z = (float(word) for word in ET.fromstring(text).find("option").get("gravity", "").split())  # type: ignore[union-attr]
    return x, y, z


def _gravity(model: Any) -> Array:
    off = int(model.opt.disableflags) & (1 << 7)
    return np.zeros(3) if off else np.array(model.opt.gravity)


def joint_types(text: str) -> Iterator[tuple[str, str]]:
    """Yield name and type of the joints of a plain text, in its order."""
    for element in ET.fromstring(text).iterfind("worldbody//joint"):
        yield element.attrib["name"], element.attrib["type"]


def _home(model: Any, joints: list[str]) -> dict[str, float]:
    """Return a posture by the names of its coordinates."""
    keys = [model.key(k) for k in range(model.nkey)]
    keys.sort(key=lambda key: key.name != "home")
    posture = keys[0].qpos if keys else model.qpos0
    ends = {"free": (*PLACES, *PARTS), "ball": PARTS}  # of the positions of a joint, see `coordinates`
    named = [name + end for j, name in enumerate(joints) for end in ends.get(JOINTS[model.jnt_type[j]], ("",))]
    return dict(zip(named, np.asarray(posture).tolist(), strict=True))


def _write_body(element: ET.Element, b: int, model: Any, names: Names, limits: dict[int, float]) -> None:
    """Write joints, inertia, shapes and sites of a body of a compiled model."""
    first = int(model.body_jntadr[b])
    for j in range(first, first + int(model.body_jntnum[b])):
        kind = JOINTS[model.jnt_type[j]]
        given = {"name": names.joint[j], "type": kind}
        if kind != "free":
            given["pos"] = words(model.jnt_pos[j])
        v = int(model.jnt_dofadr[j])
        if kind in ("slide", "hinge"):
            given["axis"] = words(model.jnt_axis[j])
            q = int(model.jnt_qposadr[j])
            if model.jnt_limited[j]:
                given["range"] = words(model.jnt_range[j])
            for key, value in (("ref", model.qpos0[q]), ("springref", model.qpos_spring[q])):
                given |= {key: words([value])} if value else {}
            if limits.get(j):
                given["actuatorfrcrange"] = f"{-limits[j]!r} {limits[j]!r}"
        given |= {"armature": words([model.dof_armature[v]])} if model.dof_armature[v] else {}
        given |= _rough(model.dof_damping[v], model.dof_dampingpoly[v], model.dof_frictionloss[v])
        if kind not in ONE_BY_ONE:
            given |= _three("stiffness", model.jnt_stiffness[j], model.jnt_stiffnesspoly[j])
        ET.SubElement(element, "joint", given)
    if b and model.body_mass[b] > 0.0:
        ET.SubElement(
            element, "inertial", pos=words(model.body_ipos[b]), quat=words(model.body_iquat[b]),
            mass=words([model.body_mass[b]]), diaginertia=words(model.body_inertia[b]),
        )  # fmt: skip
    for g in range(model.ngeom):
        kind = _GEOMS.get(int(model.geom_type[g]), "")
        if model.geom_bodyid[g] == b and kind:
            ET.SubElement(
                element, "geom", type=kind, size=words(model.geom_size[g][: _SIZES[kind]]),
                pos=words(model.geom_pos[g]), quat=words(model.geom_quat[g]),
                rgba=words(model.geom_rgba[g].astype(float).round(7)), contype=str(model.geom_contype[g]),
                conaffinity=str(model.geom_conaffinity[g]),
            )  # fmt: skip
    for s in range(model.nsite):
        if model.site_bodyid[s] == b:
            place = {"pos": words(model.site_pos[s]), "quat": words(model.site_quat[s])}
            ET.SubElement(element, "site", {"name": names.site[s], **place})


def _write_hulls(plain: ET.Element, model: Any, names: Names) -> None:
    """Write, for each mesh that touches, its colour and the corners of its convex hull in the axes of its body.

    They are numbers beside the bodies: MuJoCo would shift the corners of a mesh by rounding each time it compiles them.
    """
    custom, count = ET.Element("custom"), 0
    for i in range(model.nnumeric):  # of a plain text
        if HULL.fullmatch(model.numeric(i).name):
            ET.SubElement(custom, "numeric", name=model.numeric(i).name, data=words(model.numeric(i).data))
    for g in np.flatnonzero(model.geom_type == _MESH).tolist():
        corners = _hull(model, g)
        if corners:
            count += 1
            turn = coupling.rotation(model.geom_quat[g])
            placed = model.geom_pos[g] + model.mesh_vert[corners].astype(float) @ turn.T
            body = names.body[int(model.geom_bodyid[g])]
            numbers = [*model.geom_rgba[g][:3].astype(float).round(7), *placed.round(9).ravel()]
            ET.SubElement(custom, "numeric", name=f"hull {count} of {body}", data=words(numbers))
    if len(custom):
        plain.append(custom)


def _hull(model: Any, g: int) -> list[int]:
    """Return the numbers of the vertices of the convex hull of the mesh of a geom; none if it touches nothing."""
    mesh = int(model.geom_dataid[g])
    at = int(model.mesh_graphadr[mesh])
    if at < 0 or not (model.geom_contype[g] or model.geom_conaffinity[g]):
        return []
    count = int(model.mesh_graph[at])
    corners = model.mesh_graph[at + 2 + count : at + 2 + 2 * count]
    return (int(model.mesh_vertadr[mesh]) + np.sort(corners)).tolist()


def _write_tendons(plain: ET.Element, model: Any, names: Names) -> None:
    """Write the fixed tendons along which something acts, or by which a drive pulls several joints."""
    made, pulled = ET.Element("tendon"), coupling.pulled_tendons(model)
    for t in range(model.ntendon):
        given = _three("stiffness", model.tendon_stiffness[t], model.tendon_stiffnesspoly[t])
        if given:
            low, high = model.tendon_lengthspring[t]
            automatic = low == high == -1.0  # which MuJoCo takes for the length where the model is assembled
            given["springlength"] = words([np.nextafter(low, 0.0) if automatic else low, high])
        given |= _rough(model.tendon_damping[t], model.tendon_dampingpoly[t], model.tendon_frictionloss[t])
        if model.tendon_limited[t]:
            given["range"] = words(model.tendon_range[t])
        joints = coupling.tendon_joints(model, t)
        if joints and (given or t in pulled):
            element = ET.SubElement(made, "fixed", {"name": names.tendon[t], **given})
            for joint, coefficient in joints:
                ET.SubElement(element, "joint", joint=names.joint[joint], coef=words([coefficient]))
    if len(made):
        plain.append(made)


def _write_drives(plain: ET.Element, model: Any, names: Names) -> None:
    """Write what the drives pull, if one of them pulls several joints with one force."""
    if not coupling.pulled_tendons(model):
        return
    made = ET.SubElement(plain, "actuator")
    for a in range(model.nu):
        kind, target = int(model.actuator_trntype[a]), int(model.actuator_trnid[a][0])
        gear = {"gear": words([model.actuator_gear[a][0]])}
        if kind == coupling.AT_TENDON:
            ET.SubElement(made, "motor", {"tendon": names.tendon[target], **gear})
        elif kind in coupling.AT_JOINT and JOINTS[model.jnt_type[target]] not in ONE_BY_ONE:
            ET.SubElement(made, "motor", {"joint": names.joint[target], **gear})


def _rough(damping: Any, more: Any, friction: Any) -> dict[str, str]:
    """Return the attributes of a damper and of dry friction; none of what is zero."""
    return _three("damping", damping, more) | ({"frictionloss": words([friction])} if friction else {})


def _three(key: str, first: Any, more: Any) -> dict[str, str]:
    """Return the attribute of a polynomial of three coefficients; none if all are zero."""
    numbers = [first, *more]
    return {key: words(numbers)} if any(numbers) else {}


def _check(model: Any, names: Names, where: str) -> None:
    """Refuse what would change the motion and is not simulated."""
    kinds = [JOINTS[kind] for kind in model.jnt_type]
    check_count(model.nbody - 1 + model.nsite, sum(ONE_BY_ONE.get(kind, 1) for kind in kinds), where)
    for kind, keys in _NUMBERS.items():
        for key in keys:
            values = np.asarray(getattr(model, f"{kind}_{key}"), dtype=np.float64)
            if not np.isfinite(values).all():
                i = int(np.argwhere(~np.isfinite(values))[0][0])
                name = names.own(kind, i) or str(i)
                raise ModelError(f"{where}: {_TITLES[kind]} {name!r}: its {key} is not finite: write a number")
    if np.any(model.dof_armature < 0.0):
        joint = names.joint[int(model.dof_jntid[int(np.argmin(model.dof_armature))])]
        raise ModelError(f"{where}: joint {joint!r} has a negative armature: an inertia is zero or more")
    for count, what in ((model.nflex, "<flex>"), (model.nplugin, "<plugin>")):
        if count:
            raise ModelError(f"{where}: {what} is not simulated: remove it from the model")
    for a in range(model.nu):
        if model.actuator_gaintype[a] == _MUSCLE or model.actuator_biastype[a] == _MUSCLE:
            name = names.own("actuator", a) or str(a + 1)
            raise ModelError(f"{where}: actuator {name!r} is a muscle, which is not simulated: use a motor")
    if model.nv and (model.opt.density or model.opt.viscosity):
        raise ModelError(
            f"{where}: <option> has the density {model.opt.density:g} or the viscosity {model.opt.viscosity:g} of a "
            "medium, which is not simulated: leave them out"
        )


def _left_out(model: Any, names: Names) -> list[str]:
    """Return what of a model is not read, a line each."""
    found = [
        f"{what} of the file are left out: they do no work"
        for count, what in ((model.ncam, "cameras"), (model.nlight, "lights"), (model.nsensor, "sensors"))
        if count
    ]
    if model.nexclude or model.npair:
        found.append("<exclude> and <pair> of the file are left out: a scenario says what touches")
    meshes = np.flatnonzero(model.geom_type == _MESH).tolist()
    hulls = {int(model.geom_dataid[g]): len(_hull(model, g)) for g in meshes}
    cut = [model.mesh(mesh).name for mesh, corners in hulls.items() if corners >= MOST_CORNERS]
    if cut:
        found.append(f"convex hulls of meshes have {MOST_CORNERS} corners at most, chosen by MuJoCo: {some(cut)}")
    kinds = sorted({int(kind) for kind in model.geom_type} & set(_NOT_READ))
    found += [f"{_NOT_READ[kind]} of the file are not read as shapes" for kind in kinds]
    still = [names.body[b] for b in range(model.nbody) if model.body_mocapid[b] >= 0]
    if still:
        found.append(f"mocap bodies move as a [[mocap]], or the motion of a [[contact]], says: {', '.join(still)}")
    if model.nv and model.body_gravcomp.any():
        carried = [names.body[b] for b in np.flatnonzero(model.body_gravcomp)]
        found.append(f"gravcomp does not act ({some(carried)}): compensation of gravity is the law's")
    held = [
        names.joint[j] for j in range(model.njnt)
        if JOINTS[model.jnt_type[j]] in ONE_BY_ONE and (model.jnt_stiffness[j] or np.any(model.jnt_stiffnesspoly[j]))
    ]  # fmt: skip
    if held:
        found.append(f"springs of joints that turn freely do not act: {some(held)}")
    for j, (low, high) in enumerate(model.jnt_range.tolist()):
        if not model.jnt_limited[j] and low >= high and (low or high):
            found.append(f"joint {names.joint[j]!r}: range {low:g} {high:g} is invalid and does not act")
    for a in range(model.nu):
        for key in ("force", "ctrl"):
            low, high = getattr(model, f"actuator_{key}range")[a].tolist()
            if not getattr(model, f"actuator_{key}limited")[a] and low >= high and (low or high):
                name = names.own("actuator", a) or str(a + 1)
                found.append(f"actuator {name!r}: {key}range {low:g} {high:g} is invalid and does not act")
    turning = [
        names.joint[j] for j in range(model.njnt) if model.jnt_limited[j] and JOINTS[model.jnt_type[j]] == "ball"
    ]
    if turning:
        found.append(f"the range of a ball joint does not act: {some(turning)}")
    return found


if TYPE_CHECKING:
    import pinocchio as pin


def pinocchio_model(model: Any, locked: Mapping[str, float], where: str) -> "pin.Model":
    """Return Pinocchio's model of a compiled plain text, with some joints held where they are said to be.

    Its velocities are in the order of MuJoCo's; the armature is the text's.

    Raises `ModelError` if a number is so large that products of it might be none; `where` names the text.
    """
    import pinocchio as pin

    names, out = Names(model), pin.Model()
    out.gravity.linear = np.array(model.opt.gravity)
    frames = {*names.body, *names.site}
    armature: list[float] = []
    bodies: dict[int, tuple[int, pin.SE3, int]] = {0: (0, pin.SE3.Identity(), 0)}  # joint, place in it, frame

    def add_frame(name: str, joint: int, place: "pin.SE3", above: int, kind: "pin.FrameType") -> int:
        return int(out.addFrame(pin.Frame(name, joint, above, place, kind), False))

    for b in range(model.nbody):
        if b:
            at_body = f"{where}: body {names.body[b]!r}"
            check_size("origin", model.body_pos[b], at_body)
            check_size("mass", model.body_mass[b], at_body)
            check_size("centre of mass", model.body_ipos[b], at_body)
            check_size("inertia tensor", model.body_inertia[b], at_body)
            joint, place, above = bodies[int(model.body_parentid[b])]
            place = place * _pose(model.body_pos[b], model.body_quat[b])
            first = int(model.body_jntadr[b])
            for j in range(first, first + int(model.body_jntnum[b])):
                name, kind = names.joint[j], JOINTS[model.jnt_type[j]]
                at = pin.SE3(np.eye(3), np.array(model.jnt_pos[j]))
                if kind in ("free", "ball") and name in locked:
                    continue
                if kind in ("slide", "hinge"):
                    ref = float(model.qpos0[model.jnt_qposadr[j]])
                    if name in locked:
                        place = place * at * _moved(kind, model.jnt_axis[j], locked[name] - ref) * at.inverse()
                        continue
                    at = at * _moved(kind, model.jnt_axis[j], -ref) if ref else at
                what, start = _joint(kind, np.array(model.jnt_axis[j])), pin.SE3.Identity()
                if kind != "free":
                    start, back = place * at, pin.SE3(np.eye(3), -np.array(model.jnt_pos[j]))
                joint = int(out.addJoint(joint, what, start, name, *_limits(model, j, kind)))
                place = pin.SE3.Identity() if kind == "free" else back
                v = int(model.jnt_dofadr[j])
                check_size("armature", model.dof_armature[v], f"{where}: joint {name!r}")
                armature += [float(x) for x in model.dof_armature[v : v + out.nvs[joint]]]
                shown = name if name not in frames else f"{name} joint"
                above = add_frame(shown, joint, pin.SE3.Identity(), above, pin.FrameType.JOINT)
            if model.body_mass[b] > 0.0:
                turn = coupling.rotation(model.body_iquat[b])
                tensor = turn @ np.diag(model.body_inertia[b]) @ turn.T
                inertia = pin.Inertia(float(model.body_mass[b]), np.array(model.body_ipos[b]), tensor)
                out.appendBodyToJoint(joint, inertia, place)
            bodies[b] = joint, place, add_frame(names.body[b], joint, place, above, pin.FrameType.BODY)
        joint, place, above = bodies[b]
        for s in np.flatnonzero(model.site_bodyid == b):
            there = place * _pose(model.site_pos[s], model.site_quat[s])
            add_frame(names.site[s], joint, there, above, pin.FrameType.OP_FRAME)
    out.armature = np.array(armature)
    return out


def _pose(position: Array, quaternion: Array) -> "pin.SE3":
    import pinocchio as pin

    return pin.SE3(coupling.rotation(quaternion), np.array(position))


def _moved(kind: str, axis: Array, value: float) -> "pin.SE3":
    """Return the motion of a joint by a value, rad (m), in axes that the joint does not turn."""
    import pinocchio as pin

    if kind == "slide":
        return pin.SE3(np.eye(3), value * np.array(axis))
    return pin.SE3(pin.AngleAxis(value, np.array(axis)).toRotationMatrix(), np.zeros(3))


def _joint(kind: str, axis: Array) -> Any:
    """Return Pinocchio's joint of a kind; about or along an axis of its frame it is one that need not be told it."""
    import pinocchio as pin

    if kind == "free":
        return pin.JointModelFreeFlyer()
    if kind == "ball":
        return pin.JointModelSpherical()
    for k, plain in enumerate("XYZ"):
        if np.array_equal(axis, np.eye(3)[k]):
            return getattr(pin, f"JointModel{'P' if kind == 'slide' else 'R'}{plain}")()
    return pin.JointModelPrismaticUnaligned(axis) if kind == "slide" else pin.JointModelRevoluteUnaligned(axis)


def _limits(model: Any, j: int, kind: str) -> tuple[Array, Array, Array, Array]:
    """Return effort, velocity, lower and upper limit of a joint as Pinocchio has them; infinite where there is none."""
    n, m = {"free": (6, 7), "ball": (3, 4)}.get(kind, (1, 1))
    effort, low, high = np.full(n, np.inf), np.full(m, -np.inf), np.full(m, np.inf)
    if n == 1:
        if model.jnt_limited[j]:
            low[0], high[0] = model.jnt_range[j]
        if model.jnt_actfrclimited[j]:
            effort[0] = model.jnt_actfrcrange[j][1]
    return effort, np.full(n, np.inf), low, high
