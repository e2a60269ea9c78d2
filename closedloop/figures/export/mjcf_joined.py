"""What joins the links of a scene beside its tree, for MuJoCo: loop joints as equalities, contacts as pairs of geoms.

A point is a `connect`, a hinge two on its axis, a weld a `weld`, a gear a `joint`, a distance a tendon of that length.
The point of a contact is a small ball, and its plane lies lower by its radius: they are as far apart as the point
is from the plane, in every posture. Nothing but these pairs touches.
"""

from __future__ import annotations

from typing import Any
from xml.etree import ElementTree

import numpy as np

from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError
from closedloop.figures.export.mjcf_text import element, quaternion
from closedloop.figures.scene.scene import Scene
from closedloop.mechanics.contacts.friction import coulomb_of, has_other_law
from closedloop.record.columns.touching import placed_frame
from robot_models.loop_joint import LoopJoint

BALL = 0.002  # radius of the ball that stands for a contact's point, m
APART = 0.1  # of the arm's reach: between the two points that hold a hinge
GROUP = 3  # of the geoms that touch; MuJoCo's viewer does not show it at first
HELD = ("point", "hinge", "weld", "gear", "distance")  # types of loop joints that MuJoCo has an equality for


def check_joined(scene: Scene) -> None:
    """Refuse loop joints that MuJoCo has no equality for, and contacts of links but of points and balls with planes."""
    for loop in scene.run.model.loops:
        if loop.type not in HELD:
            raise ScenarioError(
                f"--to mjcf: MuJoCo has no equality for a {loop.type}, as {loop.name!r} of {scene.run.model.name} is; "
                "use --to csv or --to mcap"
            )
    for section, touching in zip(scene.run.scenario.contact or (), scene.touching, strict=True):
        if section.half_axes is not None:
            raise ScenarioError(
                f"--to mjcf: contact {touching.name!r} is of an ellipsoid or the edge of a disc, and only points and "
                "balls are written; use --to csv or --to mcap"
            )
        if has_other_law(section):
            raise ScenarioError(
                f"--to mjcf: contact {touching.name!r} has a law of friction that MuJoCo does not have; "
                "use --to csv or --to mcap"
            )
        if touching.surface is not None:
            raise ScenarioError(
                f"--to mjcf: contact {touching.name!r} has a surface that is curved or moves, and only planes at rest "
                "are written; use --to csv or --to mcap"
            )


def add_joined_parts(body: ElementTree.Element, joint: int, scene: Scene, mechanism: Any) -> None:
    """Add the sites of loop joints, and the geoms of contacts, that a body carries; `joint` 0: the world's."""
    for loop in scene.run.model.loops:
        for side, name in enumerate(loop.frames):
            frame, rotation, origin = placed_frame(mechanism, name)
            if frame == joint:
                turned = rotation if side == 0 else rotation @ np.array(loop.turn)
                for end, point in enumerate(_points(loop, side, APART * scene.size)):
                    place = origin + rotation @ point
                    element(body, "site", name=_site(loop, side, end), pos=place, quat=quaternion(turned), group=GROUP)
    for section, touching in zip(scene.run.scenario.contact or (), scene.touching, strict=True):
        if touching.point_frame == joint:
            _add_geom(body, f"{touching.name} point", "sphere", touching.point, (section.radius or BALL,))
        if touching.plane_frame == joint:
            _, rotation, origin = placed_frame(mechanism, section.against)
            normal, half = touching.axes[0], scene.size
            place = origin + rotation @ np.array(section.through) - (0.0 if section.radius else BALL) * normal
            turned = quaternion(touching.axes[[1, 2, 0]].T)
            if joint:  # MuJoCo has planes in the world only
                place = place - half * normal
            size = (half, half, half if joint else 0.01)
            _add_geom(body, f"{touching.name} plane", "box" if joint else "plane", place, size, turned)


def add_equalities(root: ElementTree.Element, scene: Scene, mechanism: Any) -> None:
    """Add the sections that hold the loop joints closed."""
    import pinocchio as pin

    if not scene.run.model.loops:
        return
    held = element(root, "equality")
    for loop in scene.run.model.loops:
        if loop.type == "gear":
            names = dict(zip(("joint1", "joint2"), loop.joints, strict=False))
            element(held, "joint", name=loop.name, polycoef=loop.polynomial, **names)
        elif loop.type == "distance":
            tendons = root.find("tendon")
            rod = element(element(root, "tendon") if tendons is None else tendons, "spatial", name=loop.name)
            ends, data = [], mechanism.createData()
            pin.forwardKinematics(mechanism, data, np.zeros(mechanism.nq))  # MuJoCo's tendons have their length here
            for side, name in enumerate(loop.frames):
                element(rod, "site", site=_site(loop, side, 0))
                joint, rotation, origin = placed_frame(mechanism, name)
                ends.append(data.oMi[joint].act(origin + rotation @ np.array(loop.points[side])))
            longer = loop.length - float(np.linalg.norm(ends[1] - ends[0]))
            element(held, "tendon", name=loop.name, tendon1=loop.name, polycoef=(longer, 0.0, 0.0, 0.0, 0.0))
        else:
            for end, _ in enumerate(_points(loop, 0, 1.0)):
                sites = {"site1": _site(loop, 0, end), "site2": _site(loop, 1, end)}
                element(held, "weld" if loop.type == "weld" else "connect", name=_numbered(loop.name, end), **sites)


def add_pairs(root: ElementTree.Element, scene: Scene) -> None:
    """Add the pairs of geoms that touch, each with its friction."""
    if not scene.touching:
        return
    pairs = element(root, "contact")
    for section, touching in zip(scene.run.scenario.contact or (), scene.touching, strict=True):
        mu = coulomb_of(section)
        rubs = {"condim": 3, "friction": (mu, mu, 0.0, 0.0, 0.0)}
        geoms = {"geom1": f"{touching.name} point", "geom2": f"{touching.name} plane"}
        element(pairs, "pair", name=touching.name, **geoms, **(rubs if mu > 0.0 else {"condim": 1}))


def _add_geom(
    body: ElementTree.Element, name: str, kind: str, place: Array, size: tuple[float, ...], quat: Array | None = None
) -> None:
    """Add a geom that touches nothing but what it is paired with."""
    element(
        body, "geom", name=name, type=kind, pos=place, quat=quat, size=size, mass=0.0, contype=0, conaffinity=0,
        group=GROUP, rgba=(0.34, 0.71, 0.91, 0.2),
    )  # fmt: skip


def _points(loop: LoopJoint, side: int, apart: float) -> list[Array]:
    """Return the points (3,), m, in the frame of a side at which a loop joint is held: of a hinge two on its axis."""
    point = np.array(loop.points[side])
    return [point, point + apart * np.array(loop.axes[side])] if loop.type == "hinge" else [point]


def _site(loop: LoopJoint, side: int, end: int) -> str:
    return _numbered(f"{loop.name} {'ab'[side]}", end)


def _numbered(name: str, end: int) -> str:
    return f"{name} {end + 1}" if end else name
