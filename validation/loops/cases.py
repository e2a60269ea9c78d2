"""Mechanisms with loops, planar and spatial, some with rows that depend on others; and cases of them.

What is said of a case: by the oracle, and by both engines of the loop.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from scipy.optimize import least_squares

import closedloop as cl
import robot_models
from closedloop.base.errors import ScenarioError
from closedloop.jit.calls import callback, interpreted_address
from closedloop.jit.interpreted import interpreted
from closedloop.jit.kernel import jit_disabled
from closedloop.loop.events.locate import DONE
from closedloop.loop.step.closed_loops import DRIVE, closed_loops
from closedloop.loop.step.record_row import Row
from closedloop.mechanics.closure.contact_force import FREE, PRESSED
from closedloop.mechanics.loops.assemble import closed_start, errors_at
from closedloop.mechanics.loops.bind import loop_memory
from closedloop.mechanics.loops.factor import factor
from closedloop.mechanics.loops.memory import LoopMemory
from closedloop.mechanics.loops.reactions import loop_reactions
from closedloop.mechanics.loops.rows import locate_rows
from closedloop.mechanics.robot.pinocchio import Robot
from closedloop.simulation.engines.problem import Problem
from closedloop.simulation.loop_calls import Driver
from robot_models import RobotModel
from robot_models.loop_joint import BINDS
from validation.oracle.engine import Oracle
from validation.oracle.loops import LoopOracle, Motion
from validation.oracle.spatial import Array


def bar(name: str, length: float, mass: float = 1.0) -> str:
    """Return a bar along x."""
    inertia = mass * length**2 / 12
    return (
        f'<link name="{name}"><inertial><origin xyz="{length / 2} 0 0.01"/><mass value="{mass}"/>'
        f'<inertia ixx="{0.1 * inertia}" iyy="{inertia}" izz="{0.95 * inertia}" ixy="0" ixz="0" iyz="0"/></inertial>'
        "</link>"
    )


def joint(
    name: str, parent: str, child: str, xyz: str = "0 0 0", axis: str = "0 -1 0", kind: str = "continuous",
    rpy: str = "0 0 0",
) -> str:  # fmt: skip
    """Return a joint, without limits if it turns."""
    limit = '<limit lower="-9" upper="9" velocity="99" effort="99"/>' if kind == "prismatic" else ""
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{xyz}" rpy="{rpy}"/><axis xyz="{axis}"/>{limit}</joint>'
    )


def point(name: str, parent: str, xyz: str = "0 0 0", rpy: str = "0 0 0") -> str:
    """Return a frame on a link."""
    return (
        f'<link name="{name}"/><joint name="{name}_fixed" type="fixed"><parent link="{parent}"/><child link="{name}"/>'
        f'<origin xyz="{xyz}" rpy="{rpy}"/></joint>'
    )


def loop(name: str, kind: str, frames: Sequence[str], **more: Any) -> dict[str, Any]:
    """Return a table of a sidecar."""
    return {"name": name, "type": kind, "frames": list(frames), **more}


def mechanism(
    name: str, body: str, loops: Sequence[dict[str, Any]], home: Sequence[float], drives: Sequence[str] = (),
    tip: str | None = None,
) -> RobotModel:  # fmt: skip
    """Return the robot, at home where its loops are closed: of the joints' given positions the first is kept."""
    text = f'<robot name="{name}"><link name="base"/>{body}</robot>'
    n = len(home)
    model = robot_models.from_text(
        text, "urdf", name=name, armature=np.zeros(n), tip=tip, home=home, locked={}, loops=loops, drives=drives
    )
    robot = Robot(model, tip)
    memory = loop_memory(robot)
    start = np.array(home, dtype=float)

    def errors(x: Array) -> Array:
        return errors_at(robot, memory, np.concatenate([start[:1], x]), np.zeros(n))[0]

    found = least_squares(errors, start[1:], xtol=1e-15, ftol=1e-15, gtol=1e-15)
    assert np.max(np.abs(found.fun)) < 1e-9, (name, found.fun)
    return robot_models.from_text(
        text, "urdf", name=name, armature=np.zeros(n), tip=tip, home=[start[0], *found.x], locked={}, loops=loops,
        drives=drives,
    )  # fmt: skip


Y = [0, 1, 0]
Z = [0, 0, 1]


def four_bar(kind: str = "hinge") -> RobotModel:
    """Return crank, coupler and rocker."""
    body = bar("crank", 0.2) + bar("coupler", 0.5) + bar("rocker", 0.4)
    body += joint("J1", "base", "crank") + joint("J2", "crank", "coupler", "0.2 0 0")
    body += joint("J3", "base", "rocker", "0.5 0 0") + point("a", "coupler", "0.5 0 0")
    body += point("b", "rocker", "0.4 0 0")
    more: dict[str, Any] = {} if kind == "point" else {"axis": Y}
    return mechanism(f"four_bar_{kind}", body, [loop("pin", kind, "ab", **more)], [1.1, -0.6, 1.5], tip="a")


def change_point(base: float, rocker: float, turn: float = 0.0) -> RobotModel:
    """Return a four-bar whose bars lie in one line at J1 = 0: crank and coupler as long as base and rocker together.

    The two directions in which its loop is closed are turned against the bars by an angle, rad: without it the row
    along the line is nothing there, and with it the two rows are one.
    """
    coupler = base + rocker - 0.2
    body = bar("crank", 0.2) + bar("coupler", coupler) + bar("rocker", rocker)
    body += joint("J1", "base", "crank") + joint("J2", "crank", "coupler", "0.2 0 0")
    body += joint("J3", "base", "rocker", f"{base} 0 0") + point("a", "coupler", f"{coupler} 0 0")
    body += point("b", "rocker", f"{rocker} 0 0", rpy=f"0 {turn} 0")
    near = [-0.3, 0.3, -0.3] if base == coupler else [-0.3, 0.25, -0.1]
    return mechanism("change_point", body, [loop("pin", "point", "ab")], near, tip="a")


def doubled_four_bar() -> RobotModel:
    """Return a parallelogram with a second, parallel rocker: a row more than it needs, wherever it is."""
    body = bar("crank", 0.3) + bar("coupler", 0.6) + bar("rocker", 0.3) + bar("middle", 0.3)
    body += joint("J1", "base", "crank") + joint("J2", "crank", "coupler", "0.3 0 0")
    body += joint("J3", "base", "rocker", "0.6 0 0") + joint("J4", "base", "middle", "0.3 0 0")
    body += point("a", "coupler", "0.6 0 0") + point("b", "rocker", "0.3 0 0")
    body += point("c", "coupler", "0.3 0 0") + point("d", "middle", "0.3 0 0")
    loops = [loop("end", "hinge", "ab", axis=Y), loop("middle", "hinge", "cd", axis=Y)]
    return mechanism("doubled_four_bar", body, loops, [1.1, -1.1, 1.1, 1.1], tip="a")


def slider_crank() -> RobotModel:
    """Return crank, rod, and a block that a loop joint holds in its guide."""
    body = bar("crank", 0.2) + bar("rod", 0.5) + bar("block", 0.1)
    body += joint("J1", "base", "crank") + joint("J2", "crank", "rod", "0.2 0 0")
    body += joint("J3", "rod", "block", "0.5 0 0")
    body += point("guide", "base")
    guide = loop("guide", "slider", ["block", "guide"], axis=[1, 0, 0])
    return mechanism("slider_crank", body, [guide], [0.9, -1.3, 0.4], tip="block")


def distance() -> RobotModel:
    """Return a crank, and a block on a guide at the end of a rod without mass."""
    body = bar("crank", 0.2) + bar("block", 0.3) + joint("J1", "base", "crank")
    body += joint("S", "base", "block", axis="1 0 0", kind="prismatic") + point("pin", "crank", "0.2 0 0")
    return mechanism("distance", body, [loop("rod", "distance", ["pin", "block"], length=0.6)], [0.7, 0.75], tip="pin")


def six_bar() -> RobotModel:
    """Return Watt's six-bar: a second loop on the first."""
    body = bar("crank", 0.2) + bar("coupler", 0.5) + bar("rocker", 0.4) + bar("arm", 0.35) + bar("last", 0.3)
    body += joint("J1", "base", "crank") + joint("J2", "crank", "coupler", "0.2 0 0")
    body += joint("J3", "base", "rocker", "0.5 0 0") + joint("J4", "rocker", "arm", "0.3 0 0.1")
    body += joint("J5", "base", "last", "0.9 0 0")
    body += point("a", "coupler", "0.5 0 0") + point("b", "rocker", "0.4 0 0")
    body += point("c", "arm", "0.35 0 0") + point("d", "last", "0.3 0 0")
    loops = [loop("first", "hinge", "ab", axis=Y), loop("second", "point", "cd")]
    return mechanism("six_bar", body, loops, [1.1, -0.6, 1.5, -1.5, 1.6], tip="c")


def serial(
    name: str, links: Sequence[tuple[float, float]], loops: Sequence[dict[str, Any]], home: Sequence[float]
) -> RobotModel:
    """Return a chain of hinges about z, each link a length along x and a twist about it; its end closes on the base."""
    body, parent, place = "", "base", ("0 0 0", "0 0 0")
    for k, (length, twist) in enumerate(links[:-1]):
        body += bar(f"link{k}", max(length, 0.1)) + joint(f"J{k}", parent, f"link{k}", place[0], "0 0 1", rpy=place[1])
        parent, place = f"link{k}", (f"{length} 0 0", f"{twist} 0 0")
    body += point("end", parent, *place)
    length, twist = links[-1]
    body += point("start", "base", f"{-length} 0 0", f"{-twist} 0 0")
    return mechanism(name, body, loops, home, tip=parent)


def bennett() -> RobotModel:
    """Return Bennett's linkage: four hinges in space that move, against counting; sin a / length is common."""
    a, alpha, b = 0.3, 0.6, 0.4
    beta = np.arcsin(b * np.sin(alpha) / a)
    first = 1.0
    ratio = np.sin((beta + alpha) / 2) / np.sin((beta - alpha) / 2)
    second = 2 * np.arctan(ratio / np.tan(first / 2))
    links = [(a, alpha), (b, beta), (a, alpha), (b, beta)]
    return serial("bennett", links, [loop("hinge", "hinge", ["end", "start"], axis=Z)], [first, second, -first])


def bricard() -> RobotModel:
    """Return Bricard's linkage of right angles: six hinges in space, one of them a loop joint."""
    links = [(0.3, np.pi / 2 * s) for s in (1, -1, 1, -1, 1, -1)]
    home = [1.9, 2.2, 1.9, 2.2, 1.9]
    return serial("bricard", links, [loop("hinge", "hinge", ["end", "start"], axis=Z)], home)


def cardan() -> RobotModel:
    """Return two shafts at an angle, and a universal joint between them."""
    body = bar("shaft", 0.3) + bar("other", 0.3) + joint("J1", "base", "shaft", axis="1 0 0")
    body += joint("J2", "base", "other", "0.3 0 0", axis="1 0 0", rpy="0 0 0.5")
    body += point("a", "shaft", "0.3 0 0") + point("b", "other")
    cross = loop("cross", "universal", "ab", axes=[[0, 1, 0], [0, 0, 1]])
    return mechanism("cardan", body, [cross], [0.4, 0.4], tip="b")


def gears() -> RobotModel:
    """Return a pair of gears, an arm that follows one of them by a polynomial, and one that follows sums of three."""
    body = bar("one", 0.2) + bar("two", 0.3) + bar("three", 0.2) + bar("four", 0.2)
    body += joint("J1", "base", "one") + joint("J2", "base", "two", "0.5 0 0") + joint("J3", "two", "three", "0.3 0 0")
    body += joint("J4", "three", "four", "0.2 0 0", axis="0 0 1")
    sums: dict[str, Any] = {
        "joints": ["J4", "J1", "J2", "J3"],
        "coefficients": [[2.0, 0.5, 0.0, -1.0], [0.0, 0.3, 1.0, -0.4]],
    }
    loops = [
        {"name": "gear", "type": "gear", "joints": ["J1", "J2"], "polynomial": [0.1, -2.0]},
        {"name": "cam", "type": "gear", "joints": ["J3", "J1"], "polynomial": [0.2, 0.5, 0.3]},
        {"name": "tendons", "type": "gear", **sums, "polynomial": [0.1, 0.8, 0.5, -0.2]},
    ]
    return mechanism("gears", body, loops, [0.5, -0.2, 0.5, 0.0], tip="four")


def spatial_slider() -> RobotModel:
    """Return a crank in space with a rod on balls to a block on a guide: distance, and a cylinder that may turn."""
    body = bar("crank", 0.15) + bar("block", 0.1) + joint("J1", "base", "crank", axis="0 0 1")
    body += "".join(f'<link name="s{k}"/>' for k in range(4))
    body += joint("X", "base", "s0", "0.4 0 0.2", "1 0 0", "prismatic")
    body += joint("Y", "s0", "s1", axis="0 1 0", kind="prismatic") + joint("A", "s1", "s2", axis="1 0 0")
    body += joint("B", "s2", "s3", axis="0 1 0") + joint("C", "s3", "block", axis="0 0 1")
    body += point("a", "crank", "0.15 0 0") + point("b", "block", "-0.05 0 0.02") + point("guide", "base", "0 0 0.2")
    loops = [loop("rod", "distance", "ab", length=0.4), loop("guide", "cylinder", ["block", "guide"], axis=[1, 0, 0])]
    return mechanism("spatial_slider", body, loops, [0.6, 0.0, 0.0, 0.0, 0.0, 0.0], tip="b")


def cut_coupler() -> RobotModel:
    """Return a four-bar whose coupler is cut in the middle and welded, its halves turned against each other."""
    body = bar("crank", 0.2) + bar("left", 0.25) + bar("rocker", 0.4) + bar("right", 0.25)
    body += joint("J1", "base", "crank") + joint("J2", "crank", "left", "0.2 0 0")
    body += joint("J3", "base", "rocker", "0.5 0 0") + joint("J4", "rocker", "right", "0.4 0 0")
    body += point("a", "left", "0.25 0 0") + point("b", "right", "0.25 0 0")
    turn = [[-1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.0]]
    return mechanism("cut_coupler", body, [loop("weld", "weld", "ab", turn=turn)], [1.1, -0.6, 1.5, 2.2], tip="a")


def plate() -> RobotModel:
    """Return an arm in space whose foot lies flat on the floor: it slides there, and turns about the vertical."""
    body = bar("turret", 0.2) + bar("upper", 0.4) + bar("lower", 0.5) + bar("foot", 0.1) + bar("roll", 0.1)
    body += joint("J1", "base", "turret", "0 0 0.5", "0 0 1") + joint("J2", "turret", "upper", "0.1 0 0", "0 1 0")
    body += joint("J3", "upper", "lower", "0.4 0 0", "0 1 0") + joint("J4", "lower", "roll", "0.5 0 0", "1 0 0")
    body += joint("J5", "roll", "foot", "0.05 0 0", "0 1 0")
    flat = loop("floor", "planar", ["foot", "world"], axis=Z, points=[[0.02, 0.01, -0.03], [0.0, 0.0, 0.05]])
    return mechanism("plate", body, [flat], [0.4, 0.2, 0.9, 0.0, -1.1], tip="foot")


MECHANISMS: dict[str, Callable[[], RobotModel]] = {
    "four_bar": four_bar, "four_bar_point": lambda: four_bar("point"), "doubled_four_bar": doubled_four_bar,
    "slider_crank": slider_crank, "distance": distance, "six_bar": six_bar, "bennett": bennett, "bricard": bricard,
    "cardan": cardan, "gears": gears, "spatial_slider": spatial_slider, "cut_coupler": cut_coupler, "plate": plate,
    "five_bar": lambda: robot_models.load("five_bar"), "delta": lambda: robot_models.load("delta"),
    "stewart": lambda: robot_models.load("stewart"),
}  # fmt: skip


AWAY, PRESSES, SLIDES = "tip away", "tip presses", "tip slides"
TOUCHES = (AWAY, PRESSES, SLIDES)
# Coulomb's μ of a tip that slides.
FRICTION = 0.3
# How far a mechanism is moved from home, rad (m) along what is free; and how small a part of the largest singular value
# of its rows, joints and rows to scale, a posture may have: nearer to dependent rows rounding is magnified.
TURNED, WORST = 0.4, 0.02
# Below this share of the largest a singular value is that of rows that depend on others.
NONE = 1e-11
# A tip that moves less than this, m/s, does not slide.
SLOW = 1e-3


@dataclass(frozen=True)
class Case:
    """One state of a mechanism.

    name, index: of the mechanism, and the case's number within its seed
    q, v, torque: (n,), what the law asks of all joints, with a drive or without, N m (N)
    touch: of `TOUCHES`
    normal: (3,), of the plane through the tip, base frame
    """

    name: str
    index: int
    robot: Any
    q: Array
    v: Array
    torque: Array
    touch: str
    normal: Array

    def __str__(self) -> str:
        return f"{self.name}, case {self.index}: {self.touch}"


@lru_cache(maxsize=64)
def mechanism_called(name: str) -> Any:
    """Return a mechanism, made once."""
    return MECHANISMS[name]()


@lru_cache(maxsize=64)
def _robot_of(name: str) -> Robot:
    return Robot(mechanism_called(name))


@lru_cache(maxsize=64)
def oracle_of(name: str) -> LoopOracle:
    """Return the mechanism as the paper's equations have it."""
    model = mechanism_called(name)
    return LoopOracle(Oracle.from_model(model), model.loops, model.drives)


def draw_case(name: str, seed: int, index: int) -> Case:
    """Draw a state of a mechanism that is well away from poses at which its rows lose rank.

    Raises `RuntimeError` if a hundred are not.
    """
    for attempt in range(100):
        rng = np.random.default_rng([seed, index, attempt])
        if (made := _draw(name, index, rng)) is not None:
            return made
    raise RuntimeError(f"no well-posed state of {name} was drawn")


def _draw(name: str, index: int, rng: np.random.Generator) -> Case | None:
    model, oracle, touch = mechanism_called(name), oracle_of(name), TOUCHES[index % len(TOUCHES)]
    n, home = model.n, np.array(model.home)
    ways = _free(np.concatenate([rows.A for rows in oracle.all_rows(home, np.zeros(n))]))
    if ways is None:
        raise ValueError(f"{name} is at home where its rows lose rank")
    # Along what is free: rows that depend on each other do so only where the loops are closed.
    start = home + TURNED * ways @ rng.normal(size=ways.shape[1])
    try:
        q, _ = closed_start(_robot_of(name), start, np.zeros(n), True)
    except ScenarioError:
        return None
    G = np.concatenate([rows.A for rows in oracle.all_rows(q, np.zeros(n))])
    free = _free(G)
    if free is None or oracle.apart(q) > 1e-12:
        return None
    torque, normal = rng.normal(scale=5.0, size=n), np.array([0.0, 0.0, 1.0])
    J = oracle.oracle.jacobian(q) @ free
    if float(np.linalg.norm(J)) < 0.05:
        touch = AWAY  # of a tip that the loops hold there is nothing to press
    if touch != AWAY:
        normal = J @ rng.normal(size=free.shape[1]) + 0.1 * float(np.linalg.norm(J)) * rng.normal(size=3)
        normal /= np.linalg.norm(normal)
        held = _free(np.vstack([G, normal @ oracle.oracle.jacobian(q)]))
        if held is None or held.shape[1] == free.shape[1]:
            return None
        free = held
    v = free @ rng.normal(size=free.shape[1]) if free.shape[1] else np.zeros(n)
    slip = oracle.oracle.jacobian(q) @ v
    if touch == SLIDES and float(np.linalg.norm(slip - normal * (normal @ slip))) < SLOW:
        touch = PRESSES  # the loops hold the tip
    made = Case(name, index, model, q, v, torque, touch, normal)
    return made if touch != SLIDES or _does_not_jam(made) else None


def _free(G: Array) -> Array | None:
    """Return an orthonormal basis (n, k) of the motions that rows leave, None near a pose where they lose rank."""
    size = np.linalg.norm(G, axis=1, keepdims=True)
    rows = np.divide(G, size, out=np.zeros_like(G), where=size > NONE)
    _, s, Vt = np.linalg.svd(rows)
    kept = s > NONE * s[0]
    if np.any(s[kept] < WORST * s[0]):
        return None
    return np.asarray(Vt[int(np.count_nonzero(kept)) :].T)


def _does_not_jam(case: Case) -> bool:
    """Whether friction leaves the push of the surface effective, by far (Painlevé)."""
    oracle = oracle_of(case.name)
    rows = oracle.all_rows(case.q, case.v)
    free = _free(np.concatenate([each.A for each in rows]))
    if free is None:
        return False
    J = oracle.oracle.jacobian(case.q) @ free
    S = J @ np.linalg.solve(free.T @ oracle.oracle.mass_matrix(case.q) @ free, J.T)
    across = S @ case.normal
    normal = float(case.normal @ across)
    return normal > 2.0 * FRICTION * float(np.linalg.norm(across - normal * case.normal))


# The step, s: so short that friction turns no slip within it, since the oracle has friction against the slip as it is.
STEP = 1e-6

Entry = Callable[[int, int], int]


@dataclass(frozen=True)
class LoopFault:
    """What is done to the loop before it is asked: nothing.

    entry: what answers for the loops, an entry as `closedloop.loop.step.closed_loops.closed_loops` -> the faulty one
    bound: changes the memory of what the loop joints bind, in place
    reactions: reactions (N, m) -> the faulty ones
    """

    entry: Callable[[Entry], Entry] = lambda sound: sound
    bound: Callable[[LoopMemory], None] = lambda memory: None
    reactions: Callable[[Array], Array] = lambda found: found


SOUND = LoopFault()


def ask_oracle(case: Case, oracle: LoopOracle | None = None) -> Motion:
    """Return what the equations by hand say of a case, or a faulty copy of them."""
    oracle = oracle or oracle_of(case.name)
    normal = None if case.touch == AWAY else case.normal
    return oracle.answer(case.q, case.v, case.torque, normal, FRICTION if case.touch == SLIDES else 0.0)


def problem_of(case: Case) -> Problem:
    """Return a case as the loop is given it."""
    changes: dict[str, Any] = {
        "start.q": case.q.tolist(), "start.v": case.v.tolist(), "reference": {"kind": "hold"},
        "law": {"kind": "paper", "kp": 0.0, "kd": 0.0, "force": 0.0}, "stabiliser": {"kind": "none"},
        "surface": {"kind": "plane", "normal": case.normal.tolist(), "offset": "start"},
        "time.duration": 2.0 * STEP, "time.step": STEP,
    }  # fmt: skip
    if case.touch == AWAY:
        changes["surface"] |= {"gap": 1.0, "contact": "unilateral"}
    if case.touch == SLIDES:
        changes["friction"] = {"kind": "coulomb", "coefficient": FRICTION}
    base = cl.prepare(cl.load_scenario("planar2_slide", changes), case.robot)
    return replace(base, q=case.q, v=case.v, mode=FREE if case.touch == AWAY else PRESSED)


def ask_loop(case: Case, engine: str, fault: LoopFault = SOUND) -> Motion:
    """Return what a loop's engine records in the first row of a run from the case's state, with a fault.

    Raises `LinAlgError` if it does not record a row.
    """
    problem = problem_of(case)
    n = problem.robot.n
    rows = np.zeros((1, Row.count(n)))
    driver = Driver(problem, rows, engine)
    state, _, w = driver.loop
    memory: LoopMemory = w.kept["loops"]
    fault.bound(memory)
    sound: Entry = interpreted(closed_loops)
    entry, kept = sound, None
    if fault is not SOUND:
        entry = fault.entry(sound)
        state.loops.entry, kept = (interpreted_address(entry), None) if jit_disabled() else callback(entry)
    state.sampled, state.settings.steps = 0, 0  # the torque is given, and one row is all
    w.torque[:] = case.torque
    memory.rows.q[:], memory.rows.v[:] = case.q, case.v
    interpreted(locate_rows)(memory.links, memory.rows)
    interpreted(factor)(memory.links, memory.rows, memory.rows.drift, int(memory.links.m))
    entry(memory.address, DRIVE)  # as after a law
    u = problem.frame @ problem.robot.terms(case.q, case.v).jacobian @ case.v
    w.friction.direction[:] = u[1:] / max(float(np.linalg.norm(u[1:])), 1e-300)
    if driver.many() != DONE:
        raise np.linalg.LinAlgError(f"the loop stopped with status {int(state.status)}")
    del kept  # what is called by its address lives until here
    return _motion(case, problem, Row(rows[0], n), fault)


def _motion(case: Case, problem: Problem, row: Any, fault: LoopFault) -> Motion:
    """Return what a row says, and the reactions that a run would give for it."""
    q, v, a, torque = (np.array(x)[None, :] for x in (row.q, row.v, row.acceleration, row.torque))
    F = (row.contact_force * np.array(row.surface_normal) + row.friction_force)[None, :]
    found = loop_reactions(problem.robot, np.zeros(1), q, v, a, torque, F)
    forces = fault.reactions(found.multipliers)[0]
    memory = loop_memory(problem.robot)  # with the rows that no joint can move
    memory.rows.q[:], memory.rows.v[:] = case.q, case.v
    interpreted(locate_rows)(memory.links, memory.rows)
    pulls, force, couple, at = [], [], [], 0
    for joint in problem.robot.model.loops:
        span = range(at, at + joint.rows)
        pulls.append(memory.rows.G[at : at + joint.rows].T @ forces[at : at + joint.rows])
        positions = {"distance": 1, "gear": 0}.get(joint.type, len(BINDS.get(joint.type, ((),))[0]))
        is_force = [k - at < positions for k in span]
        force.append(float(np.linalg.norm([forces[k] for k, yes in zip(span, is_force, strict=True) if yes])))
        couple.append(float(np.linalg.norm([forces[k] for k, yes in zip(span, is_force, strict=True) if not yes])))
        at += joint.rows
    return Motion(a[0], np.array(pulls), np.array(force), np.array(couple), float(row.contact_force))
