"""Negative controls: faults planted on purpose, each of which the comparison must notice.

A check that has never failed proves nothing. Every fault is planted in every engine that it can be planted in, one at a
time, and the faulty engine is compared with a sound one at a few states. What caught it, and by how many times its
tolerance, is the margin by which the harness would see such a fault in earnest. A fault that goes unseen fails the
command.

The faults that are planted: in the robot that an engine is given, in how it computes, in the compiled tree.

Faults in the arrays of the compiled engine: what `closedloop.mechanics.robot.tree.tree_of` made of the robot, made a
little wrong.

A robot's text read wrongly is planted in every engine (`validation.plant`); these are faults of the compiled engine's
own: one constant of one joint, the tip, gravity, the links' order.
"""

import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

import robot_models
from closedloop.mechanics.robot.tree import Tree, layout
from robot_models.coordinates import balls
from validation.comparison import Comparison, compare, tip_of
from validation.engines import ENGINES, Engine, available
from validation.engines.hand_written import HandWritten
from validation.engines.loop import ClosedLoop, Compiled
from validation.oracle.spatial import Array

PART = 1e-6


def _place(tree: Tree, joint: int, row: int) -> int:
    """Return where a joint's constant stands in `Tree.constants`."""
    return int(tree.links[layout.CONSTANT * tree.n + joint]) + row


def _with_constants(tree: Tree, changes: dict[int, float]) -> Tree:
    constants = tree.constants.copy()
    for place, value in changes.items():
        constants[place] = value
    return tree._replace(constants=constants)


def _larger(row: int) -> Callable[[Tree], Tree | None]:
    """Return a fault: the row's largest constant, a part in a million too large; None where all are zero."""

    def fault(tree: Tree) -> Tree | None:
        values = {place: tree.constants[place] for place in (_place(tree, i, row) for i in range(tree.n))}
        largest = max(values, key=lambda place: abs(values[place]))
        return _with_constants(tree, {largest: values[largest] * (1.0 + PART)}) if values[largest] else None

    return fault


def _turned(tree: Tree) -> Tree | None:
    """Turn the last joint's axis by a microradian about the common perpendicular with the one before."""
    joint = tree.n - 1
    if joint == 0 or tree.links[layout.PARENT * tree.n + joint] < 0:
        return None
    places = [_place(tree, joint, row) for row in (layout.COS_TWIST, layout.SIN_TWIST)]
    angle = np.arctan2(tree.constants[places[1]], tree.constants[places[0]]) + PART
    return _with_constants(tree, {places[0]: np.cos(angle), places[1]: np.sin(angle)})


def _offset(row: int) -> Callable[[Tree], Tree | None]:
    """Return a fault: a joint's constant (m, or rad) a millionth too large, where the joint hangs on another."""

    def fault(tree: Tree) -> Tree | None:
        joint = tree.n - 1
        if tree.links[layout.PARENT * tree.n + joint] < 0:
            return None
        place = _place(tree, joint, row)
        return _with_constants(tree, {place: tree.constants[place] + PART})

    return fault


def _tip(tree: Tree) -> Tree | None:
    return _with_constants(tree, {layout.TIP: tree.constants[layout.TIP] + PART}) if tree.carrier >= 0 else None


def _gravity(tree: Tree) -> Tree | None:
    """Tilt gravity by a microradian."""
    x, _, z = tree.constants[layout.GRAVITY : layout.GRAVITY + 3]
    return _with_constants(tree, {layout.GRAVITY: x + PART * z, layout.GRAVITY + 2: z - PART * x}) if x or z else None


def _no_support(tree: Tree) -> Tree | None:
    """Forget that the first joint moves the tip."""
    links = tree.links.copy()
    links[layout.SUPPORT * tree.n] = 0
    return tree._replace(links=links) if tree.links[layout.SUPPORT * tree.n] else None


TREE_FAULTS: dict[str, Callable[[Tree], Tree | None]] = {
    "a joint axis turned by 1 µrad": _turned,
    "a joint's angle 1 µrad off": _offset(layout.ANGLE),
    "a joint's origin 1 µm off": _offset(layout.T0),
    "a second moment +1 ppm": _larger(layout.HALF_XX),
    "a product of inertia +1 ppm": _larger(layout.XY),
    "a first moment +1 ppm": _larger(layout.HX),
    "a drive's inertia +1 ppm": _larger(layout.ARMATURE),
    "the tip 1 µm off": _tip,
    "gravity tilted by 1 µrad": _gravity,
    "a joint missing from the tip's support": _no_support,
}
"""Name -> what makes a tree faulty, or None where the robot has nothing to carry it."""


@dataclass(frozen=True)
class Fault:
    """A fault: in the robot that an engine is given, or in how it computes.

    robot: RobotModel -> the faulty one, or None if this robot cannot carry the fault
    methods: engine, and a sound one of another kind to borrow from -> methods to put in place of the engine's own;
        empty if it does not compute what the fault touches
    tree: `closedloop.mechanics.robot.tree.Tree` -> the faulty one, or None if it cannot carry the fault: for the engine
        that has one
    """

    name: str
    robot: Callable[[Any], Any | None] | None = None
    methods: Callable[[Engine, Engine], dict[str, Callable[..., Any]]] | None = None
    tree: Callable[[Tree], Tree | None] | None = None


def _edited(model: Any, edit: Callable[[ET.Element], bool]) -> Any | None:
    """Return the robot with its text edited; None if the edit found nothing to change."""
    root = ET.fromstring(model.text)
    return replace(model, text=ET.tostring(root, encoding="unicode")) if edit(root) else None


def _moving_links(root: ET.Element, model: Any) -> list[ET.Element]:
    """Return the links of a URDF with inertia that a moving joint carries directly."""
    carried = {j.find("child").get("link") for j in root.findall("joint") if j.get("name") in model.joint_names}  # type: ignore[union-attr]
    return [k for k in root.findall("link") if k.get("name") in carried and k.find("inertial") is not None]


def _scaled(elements: list[ET.Element], attribute: str, at: int, factor: float) -> bool:
    """Scale one number of the last element of an MJCF that has it; tell whether there is one."""
    for element in reversed(elements):
        numbers = element.get(attribute, "").split()
        if len(numbers) > at and float(numbers[at]) != 0.0:
            numbers[at] = repr(float(numbers[at]) * factor)
            element.set(attribute, " ".join(numbers))
            return True
    return False


def _heavier(model: Any) -> Any | None:
    def edit(root: ET.Element) -> bool:
        if model.format == "mjcf":
            return _scaled(root.findall(".//body/inertial"), "mass", 0, 1.0 + 1e-6)
        masses = [link.find("inertial/mass") for link in _moving_links(root, model)]
        last = [m for m in masses if m is not None and float(m.get("value", "0")) > 0.0]
        if last:
            last[-1].set("value", repr(float(last[-1].get("value", "0")) * (1.0 + 1e-6)))
        return bool(last)

    return _edited(model, edit)


def _product_sign(model: Any) -> Any | None:
    def edit(root: ET.Element) -> bool:
        if model.format == "mjcf":
            return _scaled(root.findall(".//inertial[@fullinertia]"), "fullinertia", 3, -1.0)
        tensors = [t for link in _moving_links(root, model)[1:] if (t := link.find("inertial/inertia")) is not None]
        entries = [(abs(float(t.get(k, "0"))), t, k) for t in tensors for k in ("ixy", "ixz", "iyz")]
        size, tensor, key = max(entries, key=lambda entry: entry[0], default=(0.0, None, ""))
        if tensor is None or size == 0.0:
            return False
        tensor.set(key, repr(-float(tensor.get(key, "0"))))
        return True

    return _edited(model, edit)


def _moved_tip(model: Any) -> Any | None:
    def edit(root: ET.Element) -> bool:
        if model.format == "mjcf":
            return _scaled(root.findall(f".//*[@name='{model.tip}'][@pos]"), "pos", 0, 1.0 + 1e-5)
        for joint in root.findall("joint"):
            child, origin = joint.find("child"), joint.find("origin")
            if joint.get("type") == "fixed" and child is not None and child.get("link") == model.tip:
                if origin is None:
                    origin = ET.SubElement(joint, "origin")
                x, y, z = (float(c) for c in origin.get("xyz", "0 0 0").split())
                origin.set("xyz", f"{x + 1e-6!r} {y!r} {z!r}")
                return True
        return False

    return _edited(model, edit)


def _no_armature(model: Any) -> Any | None:
    return replace(model, armature=np.zeros(len(model.joint_names))) if np.any(model.armature) else None


Method = Callable[..., Any]


def _with(name: str, faulty: Callable[[Method], Method], *also: str) -> Callable[[Engine, Engine], dict[str, Method]]:
    """Return a fault: a method made of the engine's own, where it has that and others."""
    return lambda engine, sound: {name: faulty(getattr(type(engine), name))} if {name, *also} <= engine.covers else {}


def _unconstrained(engine: Engine, q: Array, v: Array, torque: Array, normal: Array, b: float) -> tuple[Array, float]:
    return engine.free_acceleration(q, v, torque), 0.0


def _drift_without_cross(engine: Engine, sound: Engine) -> dict[str, Callable[..., Any]]:
    """Leave out ω × ṙ, the term by which a point's acceleration differs from its body's spatial one."""
    if "drift" not in engine.covers or not isinstance(sound, HandWritten):
        return {}
    own = type(engine).drift

    def drift(self: Engine, q: Array, v: Array) -> Array:
        omega = sound.oracle.spatial_jacobian(q)[:3] @ v
        return np.asarray(own(self, q, v) - np.cross(omega, self.jacobian(q) @ v))

    return {"drift": drift}


def _no_gyroscopic_term(engine: Engine, sound: Engine) -> dict[str, Callable[..., Any]]:
    """Leave out ω × (H q̇) of each joint that turns freely."""
    if not engine.balls or "bias" not in engine.covers:
        return {}
    own = type(engine).bias

    def bias(self: Engine, q: Array, v: Array) -> Array:
        C, momentum = own(self, q, v).copy(), sound.mass_matrix(q) @ v
        for at in self.balls:
            C[at : at + 3] -= np.cross(v[at : at + 3], momentum[at : at + 3])
        return C

    return {"bias": bias}


def _turned_back(engine: Engine, sound: Engine) -> dict[str, Callable[..., Any]]:
    """Read each rotation vector θ as −θ: what is taken for the body's orientation is its inverse."""
    if not engine.balls:
        return {}
    own = type(engine).position

    def position(self: Engine, q: Array) -> Array:
        back = q.copy()
        for at in self.balls:
            back[at : at + 3] *= -1.0
        return own(self, back)

    return {"position": position}


def _rates_in_parent_axes(engine: Engine, sound: Engine) -> dict[str, Callable[..., Any]]:
    """Take the angular velocity of each joint that turns freely in the parent's axes: θ̇ of another orientation."""
    if not engine.balls:
        return {}
    own = type(engine).jacobian

    def jacobian(self: Engine, q: Array) -> Array:
        J = own(self, q).copy()
        for at in self.balls:
            J[:, at : at + 3] = J[:, at : at + 3] @ Rotation.from_rotvec(q[at : at + 3]).as_matrix().T
        return J

    return {"jacobian": jacobian}


def _negative_force(own: Method) -> Method:
    def constrained(self: Engine, *given: Any) -> tuple[Array, float]:
        qdd, f = own(self, *given)
        return qdd, -f

    return constrained


#: Those of joints that turn freely.
TURNING_FAULTS: tuple[Fault, ...] = (
    Fault("gyroscopic term ω × (H q̇) dropped", methods=_no_gyroscopic_term),
    Fault("orientation the wrong way round", methods=_turned_back),
    Fault("angular velocity in the parent's axes", methods=_rates_in_parent_axes),
)

FAULTS: tuple[Fault, ...] = (
    Fault("last link's mass +1 ppm", robot=_heavier),
    Fault("largest product of inertia with the wrong sign", robot=_product_sign),
    Fault("tip 1 µm off", robot=_moved_tip),
    Fault("gravity −1 ppm", robot=lambda model: replace(model, gravity=np.asarray(model.gravity) * (1.0 - 1e-6))),
    Fault("drive inertia ignored", robot=_no_armature),
    Fault("J̇ᵣq̇ dropped", methods=_with("drift", lambda own: lambda self, q, v: np.zeros(3))),
    Fault("ω × ṙ of Eq. 18 dropped", methods=_drift_without_cross),
    Fault(
        "sign of Baumgarte's terms",
        methods=_with("stabilised", lambda own: lambda self, *given: own(self, *given[:-1], -np.asarray(given[-1]))),
    ),
    Fault("constraint silently off", methods=_with("constrained", lambda own: _unconstrained, "free_acceleration")),
    Fault("sign of f", methods=_with("constrained", _negative_force)),
    *TURNING_FAULTS,
    *(Fault(f"compiled tree: {name}", tree=fault) for name, fault in TREE_FAULTS.items()),
)


# Enough that some state shows every fault; the smallest margin found is far above one.
STATES = 10


@dataclass(frozen=True)
class Catch:
    """What became of one fault in one engine.

    fault, engine: what was planted, and where
    caught: whether some quantity went out of tolerance
    quantity, by: the quantity that showed it most, and the pair of engines that disagreed
    margin: error over tolerance; inf where a probe caught it
    """

    fault: str
    engine: str
    caught: bool
    quantity: str
    by: str
    margin: float


def catch_of(fault: str, carrier: str, found: Iterable[Mapping[str, float]], bound: float, by: str = "") -> Catch:
    """Return what became of a fault planted in the oracle or in the loop, by the errors of several cases.

    Without `by` what the carrier was compared with is the other of the two.
    """
    worst, quantity = 0.0, "nothing"
    for errors in found:
        for name, value in errors.items():
            if value > worst:
                worst, quantity = value, name
    by = by or ("the oracle" if carrier != "oracle" else "the loop on Pinocchio")
    margin = worst / bound
    return Catch(fault, carrier, margin > 1.0, quantity, by, margin)


def plant_all(
    robot: Any = "wam4", tip: str | None = None, *, seed: int = 0, states: int = STATES, faults: Sequence[Fault] = ()
) -> list[Catch]:
    """Plant every fault in every engine of a robot, in turn, and return what caught it.

    Raises `ModelError` if the robot cannot be loaded.
    """
    model: Any = robot_models.load(robot) if isinstance(robot, str) else robot
    name = tip_of(model, tip)
    judges = [engine for engine in available(model, name, _judges(model)) if isinstance(engine, Engine)]
    catches = []
    for fault in faults or FAULTS:
        faulty_model = fault.robot(model) if fault.robot else model
        if faulty_model is None:
            continue
        # The symbolic engine knows two robots by heart and reads no text to plant a fault in.
        for engine in available(faulty_model, name, [each for each in ENGINES if each.name != "symbolic"]):
            if not isinstance(engine, Engine):
                continue
            sound = next(judge for judge in judges if judge.name != engine.name)
            with planted(engine, fault, judges[0]) as touched:
                if touched:
                    report = compare(model, name, states=states, seed=seed, built=[sound, engine])
                    catches.append(_verdict(fault, engine, report))
    return catches


def _judges(model: Any) -> tuple[type[Engine], type[Engine]]:
    """Return the engine that a faulty one is compared with, and the one that the former itself is compared with."""
    return (ClosedLoop, Compiled) if balls(getattr(model, "joint_types", ())) else (HandWritten, ClosedLoop)


def plant_runs() -> list[Catch]:
    """Plant every fault of the compiled engine's arrays in a run, in turn: a slide in which every joint moves."""
    from validation.engines.slides import compare_runs, faulty_tree

    slide = {"reference.direction": [0.6, 0.8, 0.0], "reference.stop": 1.0, "time.duration": 1.2}
    catches = []
    for name, fault in TREE_FAULTS.items():
        with faulty_tree(fault):
            (check,) = compare_runs("wam_slide", slide)
        by = "the run on Pinocchio"
        catches.append(Catch(f"{name}, in a run", "compiled", not check.passed, "the rows", by, check.error))
    return catches


@contextmanager
def planted(engine: Engine, fault: Fault, sound_engine: Engine) -> Iterator[bool]:
    """Give the engine the fault's methods or tree for a while; yields whether the engine has the fault."""
    if fault.tree:
        sound = engine.tree if isinstance(engine, Compiled) else None
        faulty = None if sound is None else fault.tree(sound)
        if faulty is None:
            yield False
            return
        assert isinstance(engine, Compiled)
        assert sound is not None
        engine.tree = faulty
        try:
            yield True
        finally:
            engine.tree = sound
        return
    methods = fault.methods(engine, sound_engine) if fault.methods else {}
    if fault.methods and not methods:
        yield False
        return
    kind = type(engine)
    if methods:
        engine.__class__ = type(f"Faulty{kind.__name__}", (kind,), methods)
    try:
        yield True
    finally:
        engine.__class__ = kind


def _verdict(fault: Fault, engine: Engine, report: Comparison) -> Catch:
    worst = report.worst
    if worst is None:
        return Catch(fault.name, engine.name, False, "nothing was compared", "", 0.0)
    by = f"{worst.engine} against {report.reference}"
    quantity = "the probe of its constraint" if np.isinf(worst.margin) and worst.reason else worst.quantity
    return Catch(fault.name, engine.name, worst.status == "disagrees", quantity, by, worst.margin)
