"""Reactions of loop joints in the axes of their second frame: by weight and moments, and with the loop cut."""

import numpy as np
import pinocchio as pin
import pytest

import closedloop as cl
import robot_models
from closedloop.mechanics.loops.reactions import labels_of, loop_rows, share_of_rows
from closedloop.mechanics.robot.pinocchio import Robot
from validation.loops.cases import MECHANISMS, joint, loop, point

MASS, CENTRE = 2.0, np.array([0.3, -0.2, 0.1])
INERTIA = '<inertia ixx="0.1" iyy="0.2" izz="0.15" ixy="0" ixz="0" iyz="0"/>'
# A body that is free in space, and moves only as a loop joint between its frame "held" and the world lets it.
BODY = "".join(
    f'<link name="{name}"/>' + joint(f"j{name}", parent, name, axis=axis, kind=kind)
    for parent, name, axis, kind in (
        ("base", "x", "1 0 0", "prismatic"), ("x", "y", "0 1 0", "prismatic"), ("y", "z", "0 0 1", "prismatic"),
        ("z", "rx", "1 0 0", "continuous"), ("rx", "ry", "0 1 0", "continuous"),
    )
) + joint("jm", "ry", "m", axis="0 0 1") + point("held", "m", rpy="0.4 -0.3 0.8") + point("tip", "m", "0 0 0.1") + (
    f'<link name="m"><inertial><origin xyz="{" ".join(map(str, CENTRE))}"/><mass value="{MASS}"/>{INERTIA}</inertial>'
    "</link>"
)  # fmt: skip
TURN = pin.rpy.rpyToMatrix(0.4, -0.3, 0.8)
AXIS = np.array([1.0, 2.0, -0.5]) / np.linalg.norm([1.0, 2.0, -0.5])
KINDS = {
    "point": {}, "weld": {"turn": TURN.tolist()}, "distance": {"points": [[0, 0, 0], [0.0, 0.3, 0.4]], "length": 0.5},
    "hinge": {}, "cylinder": {}, "universal": {}, "planar": {}, "slider": {"turn": TURN.tolist()},
    "hinge with friction": {"friction": 0.0}, "cylinder with stops": {"limits": [[-9.0, 9.0], [-9.0, 9.0]]},
}  # fmt: skip


def held(name):
    """The body held by a loop joint of a kind, which has its directions in the axes of either frame."""
    kind, more = name.split()[0], dict(KINDS[name])
    if kind in ("hinge", "cylinder", "planar"):
        more["axes"] = [(TURN.T @ AXIS).tolist(), AXIS.tolist()]
    if kind == "universal":
        across = np.cross(AXIS, [0.0, 0.0, 1.0])
        more["axes"] = [(TURN.T @ across).tolist(), AXIS.tolist()]
    if kind == "slider":
        more["axes"] = [(TURN.T @ AXIS).tolist(), (TURN.T @ AXIS).tolist()]
    return body(loop("pin", kind, ["held", "world"], **more))


def body(*loops):
    """The body, at home at zero."""
    return robot_models.from_text(
        f'<robot name="held"><link name="base"/>{BODY}</robot>', "urdf", name="held", tip="tip", locked={},
        armature=np.zeros(6), home=np.zeros(6), loops=loops,
    )  # fmt: skip


def at_rest(model, gravity, **changes):
    """A run of a mechanism from rest, or from a velocity, on which nothing but its weight acts."""
    scenario = cl.load_scenario("planar2_drop", {
        "surface.gap": 50.0, "time.duration": 0.002, "time.step": 0.001, "law.kp": 0, "law.kd": 0, "law.force": 0,
        "stabiliser.kind": "none", "time.integrator": "rk4", "start.q": [float(x) for x in model.home],
        "start.v": [0.0] * model.n, "robot.gravity": gravity, **changes,
    })  # fmt: skip
    return cl.simulate(scenario, model=model, law=lambda x: 0.0 * x.q, engine="pinocchio")


@pytest.mark.parametrize("name", KINDS)
@pytest.mark.parametrize("gravity", [[3.0, 0.0, 0.0], [0.0, 5.0, 0.0], [0.0, 0.0, -7.0], [1.0, 2.0, 3.0]])
def test_the_reaction_is_what_the_weight_asks_for(name, gravity):
    """Newton and Euler for the body alone, about the joint's point, in base axes: nothing else holds it."""
    model = held(name)
    run = at_rest(model, gravity)
    built = body().pinocchio_model()
    built.gravity.linear = np.array(gravity)
    data, six = built.createData(), [model.joint_names.index(name) for name in built.names[1:]]
    pin.rnea(built, data, run.q[0, six].copy(), run.v[0, six].copy(), run.acceleration[0, six].copy())
    on_body = data.oMi[6].act(data.f[6])
    about = np.array([0.0, 0.3, 0.4]) if "distance" in name else np.zeros(3)
    couple = on_body.angular - np.cross(about, on_body.linear)
    found = dict(zip([label.split(": ")[1] for label in run.loops.labels], run.loops.reactions[0], strict=True))
    force = [found[f"force along {axis}"] for axis in "xyz"]
    np.testing.assert_allclose(force, on_body.linear, atol=1e-12)
    if "couple about x" in found:
        np.testing.assert_allclose([found[f"couple about {axis}"] for axis in "xyz"], couple, atol=1e-12)
    else:
        np.testing.assert_allclose(couple, 0.0, atol=1e-12)
    if name == "weld":
        np.testing.assert_allclose(force, -MASS * np.array(gravity), atol=1e-12)
        np.testing.assert_allclose(couple, -np.cross(CENTRE, MASS * np.array(gravity)), atol=1e-12)
    if name == "distance":
        assert found["push between its points"] == pytest.approx(-on_body.linear @ [0.0, 0.6, 0.8], abs=1e-12)


@pytest.mark.parametrize("name", sorted(MECHANISMS))
def test_cut_open_the_mechanism_moves_alike_under_its_reactions(name):
    """Recursive Newton-Euler of the tree, with each reaction on its first link and its opposite on the second."""
    model = MECHANISMS[name]()
    run = at_rest(model, [0.5, -0.4, -9.0], **{"time.duration": 0.05})
    built, k = model.pinocchio_model(), len(run) - 1
    built.gravity.linear = np.array([0.5, -0.4, -9.0])
    data = built.createData()
    pin.framesForwardKinematics(built, data, run.q[k].copy())
    external, torque = [pin.Force.Zero() for _ in built.joints], np.zeros(model.n)
    labels = labels_of(model)[0]
    of = dict(zip(labels, run.loops.reactions[k], strict=True))
    for each in model.loops:
        mine = {label.split(": ")[1]: of[label] for label in labels if label.startswith(f"{each.name}: ")}
        if each.type == "gear":
            for joint_name in each.joints:
                torque[model.joint_names.index(joint_name)] += mine[f"torque on {joint_name}"]
            continue
        frames = [0 if frame == "world" else built.getFrameId(frame) for frame in each.frames]
        second = data.oMf[frames[1]]
        place = pin.SE3(second.rotation, second.act(np.array(each.points[1])))
        parts = [[mine.get(f"{what} {axis}", 0.0) for axis in "xyz"] for what in ("force along", "couple about")]
        wrench = place.act(pin.Force(*map(np.array, parts)))
        for sign, frame in zip((1.0, -1.0), frames, strict=True):
            carrier = built.frames[frame].parentJoint
            external[carrier] += data.oMi[carrier].actInv(wrench) * sign
    needed = pin.rnea(built, data, run.q[k].copy(), run.v[k].copy(), run.acceleration[k].copy(), external)
    np.testing.assert_allclose(needed, torque, atol=1e-10 * (1.0 + np.max(np.abs(run.loops.reactions[k]))))
    assert np.max(np.abs(run.loops.reactions[k])) > 1e-4


@pytest.mark.parametrize("name", ["delta", "five_bar"])
def test_reactions_of_independent_rows_are_those_of_least_norm(name):
    """Where no row depends on another, Q R gives what the pseudo-inverse does; else the pseudo-inverse is taken."""
    run = cl.simulate(cl.load_scenario(name, {"time.duration": 0.05}))
    rows, _ = loop_rows(Robot(run.model, run.scenario.robot.tip or "tip"), run.q, run.v)
    independent = bool(np.all(run.loops.rank == rows.shape[1]))
    assert independent == (name == "delta")
    missing = np.einsum("kmn,km->kn", rows, run.loops.multipliers)
    least, _ = share_of_rows(rows, missing, None)
    assert np.max(np.abs(run.loops.multipliers)) > 0.1
    assert run.loops.multipliers == pytest.approx(least, abs=1e-10)
    found, stops = share_of_rows(rows, missing, None, independent)
    assert found == pytest.approx(least, abs=1e-10)
    assert not np.any(stops)
