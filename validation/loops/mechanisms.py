"""Mechanisms with loops, as text: planar and spatial ones, some of them with rows that depend on others."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from scipy.optimize import least_squares

import robot_models
from closedloop.mechanics.loops.assemble import errors_at
from closedloop.mechanics.loops.bind import loop_memory
from closedloop.mechanics.robot.pinocchio import Robot
from robot_models import RobotModel
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
    name: str,
    parent: str,
    child: str,
    xyz: str = "0 0 0",
    axis: str = "0 -1 0",
    kind: str = "continuous",
    rpy: str = "0 0 0",
) -> str:
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
    name: str,
    body: str,
    loops: Sequence[dict[str, Any]],
    home: Sequence[float],
    drives: Sequence[str] = (),
    tip: str | None = None,
) -> RobotModel:
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
    loops = [
        loop("rod", "distance", "ab", length=0.4),
        loop("guide", "cylinder", ["block", "guide"], axis=[1, 0, 0]),
    ]
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
