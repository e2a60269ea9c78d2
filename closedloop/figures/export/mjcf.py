"""The scene of a run as MJCF: the arm with its tool, and the surface, for MuJoCo and what reads its files.

The bodies are those of the dynamics: a link with a joint each, what is fixed to it included, in the frames in which the
run computes, with the drives' inertia as `armature`. The shapes carry no mass and touch nothing; the surface can be
touched, and the links where the scenario has contacts of them; loops are closed by equalities (`mjcf_joined`). There
are a motor for each joint with a drive, a site `tip`, and keyframes of the run's first and last row.

The law, the closure and friction are no part of it: contact in MuJoCo is soft, and its force differs.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import ArrayLike

from closedloop.base.errors import ScenarioError, printable
from closedloop.base.files import write_whole
from closedloop.figures.export.mjcf_joined import add_equalities, add_joined_parts, add_pairs, check_joined
from closedloop.figures.export.mjcf_surface import add_surface
from closedloop.figures.export.mjcf_text import element, numbers, quaternion
from closedloop.figures.scene.scene import Scene, scene_of
from closedloop.record.run import Run

ARM_GROUP = 1  # of the arm's geoms; the surface is in group 0
TIP_RADIUS = 0.006  # m
# The least mass and moment that MuJoCo takes for a moving body: a link without any gets it, kg and kg m².
LEAST = 1e-12
SHORT = {"revolute": "hinge", "continuous": "hinge", "prismatic": "slide"}
EXPLAINED = (
    " A scene of closedloop: {}. Angles in rad, lengths in m, masses in kg, axes of the base frame.\n"
    "     Without the control law and the closure: contact in MuJoCo is soft, and its force differs. "
)


def write_mjcf(run: Run, path: str | Path) -> list[Path]:
    """Write the scene of a run as MJCF, and return its path in a list.

    Raises
    ------
    ScenarioError
        If the run has no rows, MuJoCo has no equality for a loop joint of the robot, or the surface is a user's class
        not named in this process.
    OutputError
        If the file cannot be written.
    """
    if not len(run):
        raise ScenarioError(f"{run.scenario.name}: the run has no rows: there is no scene")
    check_joined(scene_of(run))
    root = mjcf_of(run)
    ElementTree.indent(root)
    text = '<?xml version="1.0" encoding="utf-8"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"
    return [write_whole(path, text.encode())]


def explained(name: str) -> str:
    """Return the comment of the file, which no name ends: two hyphens would."""
    return EXPLAINED.format(re.sub("-(?=-)", "- ", printable(name)))


def mjcf_of(run: Run) -> ElementTree.Element:
    """Return the scene of a run of at least one row as the element <mujoco>."""
    scene, mechanism = scene_of(run), scene_of(run).model.pinocchio_model()
    root = ElementTree.Element("mujoco", model=run.scenario.name)
    root.append(ElementTree.Comment(explained(run.scenario.name)))
    element(root, "compiler", angle="radian", autolimits="true", boundmass=LEAST, boundinertia=LEAST)
    element(root, "option", gravity=mechanism.gravity.linear, timestep=run.scenario.time.step)
    assets, world = element(root, "asset"), element(root, "worldbody")
    element(world, "light", pos=(1.0, -1.0, 2.5), dir=(-0.4, 0.4, -1.0))
    order = _add_links(assets, world, scene, mechanism)
    if scene.ground.there:
        add_surface(assets, world, scene)
    add_pairs(root, scene)
    add_equalities(root, scene, mechanism)
    motors, keys = element(root, "actuator"), element(root, "keyframe")
    driven = [joint for joint in order if run.model.driven[mechanism.joints[joint].idx_v]]
    for joint in driven:
        name, most = str(mechanism.names[joint]), float(run.model.effort_limit[mechanism.joints[joint].idx_v])
        element(motors, "motor", name=name, joint=name, ctrlrange=(-most, most) if np.isfinite(most) else None)
    columns: list[int] = []
    places: list[int] = []
    for joint in (mechanism.joints[joint] for joint in order):
        places += range(joint.idx_q, joint.idx_q + joint.nq)
        columns += range(joint.idx_v, joint.idx_v + joint.nv)
    powered = [mechanism.joints[joint].idx_v for joint in driven]
    for name, row in (("start", 0), ("end", len(run) - 1)):
        states = {"qpos": run.q[row, places], "qvel": run.v[row, columns], "ctrl": run.torque[row, powered]}
        element(keys, "key", name=name, time=run.time[row], **states)
    return root


def _add_links(assets: ElementTree.Element, world: ElementTree.Element, scene: Scene, mechanism: Any) -> list[int]:
    """Add a body for each joint, with its shapes, and return the joints in MuJoCo's order: depth first."""
    order: list[int] = []
    sliders = {at + k for at in scene.run.model.bodies for k in range(3)}

    def add(joint: int, into: ElementTree.Element) -> None:
        chain = [joint]
        while mechanism.joints[chain[-1]].idx_v in sliders:  # a free joint, taken apart: one body
            chain.append(chain[-1] + 1)
        body = _add_body(into, chain, scene, mechanism) if joint else into
        if joint:
            order.extend(chain)
        joint = chain[-1]
        for at, shape in enumerate(scene.shapes):
            if shape.joint == joint:
                _add_mesh(assets, body, f"shape{at}", shape.vertices, shape.faces, shape.colour)
        _add_tip(body, joint, scene, mechanism)
        add_joined_parts(body, joint, scene, mechanism)
        for child in range(1, mechanism.njoints):
            if int(mechanism.parents[child]) == joint:
                add(child, body)

    add(0, world)
    return order


def _add_body(into: ElementTree.Element, chain: list[int], scene: Scene, mechanism: Any) -> ElementTree.Element:
    """Add the body that a joint moves, or those of a free joint taken apart, with its inertia, and return it."""
    joint = chain[-1]
    place, inertia = mechanism.jointPlacements[chain[0]], mechanism.inertias[joint]
    name = str(mechanism.names[joint])
    body = element(into, "body", name=name, pos=place.translation, quat=quaternion(place.rotation))
    moments, axes = np.linalg.eigh(inertia.inertia)
    axes[:, 2] *= np.linalg.det(axes)  # right-handed
    element(
        body, "inertial", pos=inertia.lever, mass=inertia.mass, quat=quaternion(axes),
        diaginertia=np.maximum(moments, 0.0),
    )  # fmt: skip
    if len(chain) > 1 and into.tag == "worldbody" and place.isIdentity(0.0):
        element(body, "joint", name=name, type="free", armature=mechanism.armature[mechanism.joints[joint].idx_v])
        return body
    for each in chain:
        _add_joint(body, each, scene, mechanism)
    return body


def _add_joint(body: ElementTree.Element, joint: int, scene: Scene, mechanism: Any) -> None:
    """Add a joint to its body."""
    kind, model, name = mechanism.joints[joint], scene.run.model, str(mechanism.names[joint])
    column = kind.idx_v
    if kind.nv > 1:
        element(body, "joint", name=name, type="ball", armature=mechanism.armature[column])
        return
    data = kind.createData()
    kind.calc(data, np.zeros(1))
    moved = np.asarray(data.S).ravel()  # what a unit of speed moves: linear, angular
    hinge = model.joint_types[column] != "prismatic"
    low, high = float(model.position_lower[column]), float(model.position_upper[column])
    element(
        body, "joint", name=name, type=SHORT[model.joint_types[column]], axis=moved[3:] if hinge else moved[:3],
        range=(low, high) if np.isfinite(low) and np.isfinite(high) else None, armature=mechanism.armature[column],
    )  # fmt: skip


def _add_tip(body: ElementTree.Element, joint: int, scene: Scene, mechanism: Any) -> None:
    """Add the site that touches the surface, and the tool as a rod, to the body that carries them."""
    frame = mechanism.frames[mechanism.getFrameId(scene.tip)]
    if int(frame.parentJoint) != joint:
        return
    place = frame.placement
    element(body, "site", name="tip", pos=place.translation, quat=quaternion(place.rotation), size=(TIP_RADIUS,))
    flange = place.translation - place.rotation @ np.array(scene.run.scenario.tool.offset)
    if np.linalg.norm(place.translation - flange) > TIP_RADIUS:
        element(
            body, "geom", name="tool", type="capsule", fromto=(*flange, *place.translation), size=(TIP_RADIUS,),
            mass=0.0, contype=0, conaffinity=0, group=ARM_GROUP,
        )  # fmt: skip


def _add_mesh(
    assets: ElementTree.Element, body: ElementTree.Element, name: str, vertices: ArrayLike, faces: ArrayLike,
    colour: Sequence[float],
) -> None:  # fmt: skip
    """Add a shape, which has neither mass nor contact."""
    element(
        assets, "mesh", name=name, inertia="shell", vertex=numbers(vertices, 6), face=numbers(faces),
    )  # fmt: skip
    element(
        body, "geom", name=name, type="mesh", mesh=name, rgba=(*colour, 1.0), mass=0.0, contype=0, conaffinity=0,
        group=ARM_GROUP,
    )  # fmt: skip
