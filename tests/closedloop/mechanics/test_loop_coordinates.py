"""Friction, limits and drives of loop joints: the same mechanism cut elsewhere, where the joint is one of the tree."""

import itertools

import numpy as np
import pytest

import closedloop as cl
import robot_models
from closedloop.scenario.arm import with_all_entries
from closedloop.simulation.prepare import prepare
from robot_models import ModelError, loop_coordinate
from validation.loops.cases import MECHANISMS, bar, joint, loop, point

Y = [0, 1, 0]
HINGE = {"axis": Y}
# A four-bar that is closed: crank 0.2 m, coupler 0.5 m, rocker 0.4 m, 0.5 m between the pivots.
CRANK, COUPLER, ROCKER, BASE = 0.2, 0.5, 0.4, 0.5


def posture(crank):
    """The angles J1, J2, J3 of the closed four-bar, and that of its pin: of the rocker to the coupler about y."""
    x, z = BASE - CRANK * np.cos(crank), -CRANK * np.sin(crank)
    far = np.hypot(x, z)
    coupler = np.arctan2(z, x) + np.arccos((far**2 + COUPLER**2 - ROCKER**2) / (2 * far * COUPLER))
    end = CRANK * np.array([np.cos(crank), np.sin(crank)]) + COUPLER * np.array([np.cos(coupler), np.sin(coupler)])
    rocker = np.arctan2(end[1], end[0] - BASE)
    return crank, coupler - crank, rocker, coupler - rocker


def made(tmp_path, name, body, loops, drives=(), sidecar=""):
    """A robot of files: its URDF and its sidecar."""
    (tmp_path / f"{name}.urdf").write_text(f'<robot name="{name}"><link name="base"/>{body}</robot>')
    lines = [f'tip = "a"\n{f"drives = {list(drives)}" if drives else ""}\n{sidecar}']
    for table in loops:
        lines.append("[[closed_loop]]\n" + "\n".join(f"{key} = {value!r}" for key, value in table.items()))
    (tmp_path / f"{name}.toml").write_text("\n".join(lines))
    return robot_models.load(tmp_path / f"{name}.urdf")


def cut_at_pin(tmp_path, drives=(), kind="hinge", **acting):
    """The four-bar with its loop closed by the pin of coupler and rocker."""
    body = bar("crank", CRANK) + bar("coupler", COUPLER) + bar("rocker", ROCKER)
    body += joint("J1", "base", "crank") + joint("J2", "crank", "coupler", f"{CRANK} 0 0")
    body += joint("J3", "base", "rocker", f"{BASE} 0 0") + point("a", "coupler", f"{COUPLER} 0 0")
    pin = loop(
        "pin", kind, ["a", "rocker"], **({} if kind == "point" else HINGE), points=[[0, 0, 0], [ROCKER, 0, 0]], **acting
    )
    return made(tmp_path, "at_pin", body, [pin], drives)


def cut_at_base(tmp_path, drives=(), friction=0.0, damping=0.0, limits=None):
    """The same with its loop closed by the pivot of the rocker: the pin is a joint of the tree."""
    rocker = bar("rocker", ROCKER).replace(f'xyz="{ROCKER / 2}', f'xyz="{-ROCKER / 2}')
    body = bar("crank", CRANK) + bar("coupler", COUPLER) + rocker
    body += joint("J1", "base", "crank") + joint("J2", "crank", "coupler", f"{CRANK} 0 0")
    pin = joint("pin", "coupler", "rocker", f"{COUPLER} 0 0", "0 1 0", "revolute" if limits else "continuous")
    more = f'<dynamics friction="{friction}" damping="{damping}"/>'
    if limits:
        more += f'<limit lower="{limits[0]}" upper="{limits[1]}" velocity="99" effort="99"/>'
    body += pin.replace("</joint>", f"{more}</joint>") + point("a", "coupler", f"{COUPLER} 0 0")
    pivot = loop("J3", "hinge", ["rocker", "world"], **HINGE, points=[[-ROCKER, 0, 0], [BASE, 0, 0]])
    return made(tmp_path, "at_base", body, [pivot], drives)


def no_torque(x):
    """A law that asks for nothing."""
    return 0.0 * x.q


def falling(model, law=no_torque, crank=1.1, **changes):
    """The run of a four-bar that falls from a closed posture."""
    j1, j2, j3, pin = posture(crank)
    named = {"J1": j1, "J2": j2, "J3": j3, "pin": pin}
    q = [named[name] for name in model.joint_names]
    return run_of(model, q, law, **changes)


def run_of(model, q, law=no_torque, **changes):
    """The run of a mechanism on which nothing but its weight and a law acts."""
    changes = {
        "surface.gap": 50.0, "time.duration": 0.2, "time.step": 0.002, "law.kp": 0, "law.kd": 0, "law.force": 0,
        "stabiliser.kind": "none", "start.q": q, "start.v": [0.0] * model.n, "time.integrator": "rk4", **changes,
    }  # fmt: skip
    return cl.simulate(cl.load_scenario("planar2_drop", changes), model=model, law=law)


def of(run, name, column="q"):
    """A column of a joint."""
    return getattr(run, column)[:, run.model.joint_names.index(name)]


def same(one, other, tolerance):
    """Whether two cuts of the four-bar move alike."""
    for name in ("J1", "J2", "pin"):
        np.testing.assert_allclose(of(one, name), of(other, name), atol=tolerance)


def test_a_coordinate_changes_nothing(tmp_path):
    """With friction zero the loop joint has an angle, and the motion is that without; reactions too."""
    plain, with_angle = (falling(cut_at_pin(tmp_path, **acting)) for acting in ({}, {"friction": 0.0}))
    for name in ("J1", "J2", "J3"):
        np.testing.assert_allclose(of(plain, name), of(with_angle, name), atol=1e-9)
    np.testing.assert_allclose(of(with_angle, "pin"), of(plain, "J1") + of(plain, "J2") - of(plain, "J3"), atol=1e-12)
    forces = [np.linalg.norm(run.loops.reactions[:, :3], axis=1) for run in (plain, with_angle)]
    np.testing.assert_allclose(*forces, rtol=1e-6)
    assert np.max(with_angle.loops.unexplained) < 1e-10


@pytest.mark.parametrize("name", ["doubled_four_bar", "spatial_slider", "bennett"])
def test_coordinates_change_nothing_in_space(name):
    """Redundant rows, two coordinates of a cylinder, two loop joints at one link: motion, energy and reactions stay."""
    plain = MECHANISMS[name]()
    zero = {"hinge": 0.0, "cylinder": [0.0, 0.0]}
    tables = []
    for each in plain.loops:
        acting = {"friction": zero[each.type]} if each.type in zero else {}
        tables.append(each.as_table() | {"name": f"loop {each.name}"} | acting)
    model = robot_models.from_text(
        plain.text, "urdf", name=name, armature=plain.armature, tip=plain.tip, home=plain.home, locked={}, loops=tables
    )
    assert set(model.joint_names) - set(model.loop_coordinates) == set(plain.joint_names)
    with_them, without = (run_of(each, each.home.tolist(), **{"time.duration": 0.02}) for each in (model, plain))
    for joint_name in plain.joint_names:
        np.testing.assert_allclose(of(with_them, joint_name), of(without, joint_name), atol=1e-12)
    for energy in ("kinetic_energy", "potential_energy"):
        np.testing.assert_allclose(getattr(with_them, energy), getattr(without, energy), atol=1e-12)
    sizes = [np.linalg.norm(run.loops.reactions, axis=1) for run in (with_them, without)]
    np.testing.assert_allclose(*sizes, rtol=1e-11)
    assert np.max(with_them.loops.unexplained) < 1e-12


@pytest.mark.parametrize("acting", [{"friction": 0.3}, {"damping": 0.4}, {"limits": [-1.1, -0.9]}])
def test_it_is_the_joint_of_another_cut(tmp_path, acting):
    """Friction, damping and stops at the pin act alike whether it closes the loop or is a joint of the tree."""
    bounce, stops = {"robot.stop_restitution": 0.4}, "limits" in acting
    closed = falling(cut_at_pin(tmp_path, **acting), **(bounce if stops else {}))
    asked = bounce | {"robot.stops": True} if stops else {"robot.friction": True}
    tree = falling(cut_at_base(tmp_path, **acting), **asked)
    same(closed, tree, 1e-8)
    assert [event.kind for event in closed.events] == [event.kind for event in tree.events]
    assert bool(closed.events) == stops
    column = "stop_torque" if stops else "joint_friction"
    np.testing.assert_allclose(of(closed, "pin", column), of(tree, "pin", column), atol=1e-6)


def test_its_drive_moves_the_mechanism(tmp_path):
    """A drive at the pin gives what the law asks of it, and through the loops what the law asks of the crank."""

    def law(x):
        torque = 0.0 * x.q
        torque[0], torque[2] = 0.7, 0.4 - x.v[2]
        return torque

    closed, tree = (falling(cut(tmp_path, drives=["pin"]), law) for cut in (cut_at_pin, cut_at_base))
    same(closed, tree, 1e-9)
    assert np.ptp(of(closed, "pin", "torque")) > 0.1
    assert not np.any(of(closed, "J1", "torque"))
    np.testing.assert_allclose(of(closed, "pin", "torque"), of(tree, "pin", "torque"), atol=1e-8)


def slider_crank(tmp_path, kind=None, **acting):
    """Crank, rod and block, the block held to the world by a loop joint, or by a joint of the tree if there is none."""
    body = bar("crank", 0.2) + bar("rod", 0.5) + bar("block", 0.1)
    body += joint("J1", "base", "crank") + joint("J2", "crank", "rod", "0.2 0 0") + point("a", "rod", "0.5 0 0")
    if kind:
        body += joint("J3", "rod", "block", "0.5 0 0")
        closed = loop("S", kind, ["block", "world"], axis=[1, 0, 0], points=[[0, 0, 0], [0.1, 0, 0]], **acting)
    else:
        low, high = acting.get("limits", (-9, 9))
        more = f'<dynamics friction="{acting.get("friction", 0)}"/></joint>'
        slide = joint("S", "base", "block", "0.1 0 0", "1 0 0", "prismatic").replace("</joint>", more)
        body += slide.replace('"-9"', f'"{low}"').replace('"9"', f'"{high}"')
        closed = loop("J3", "hinge", ["block", "a"], axis=Y)
    return made(tmp_path, f"crank_{kind}", body, [closed])


@pytest.mark.parametrize("acts", ["friction", "limits"])
def test_sliders_and_cylinders(tmp_path, acts):
    """Friction and stops of a block along its guide; the distance is of the second side, the world, to the first."""
    x = 0.2 * np.cos(0.9) + np.sqrt(0.25 - (0.2 * np.sin(0.9)) ** 2)
    rod = np.arctan2(-0.2 * np.sin(0.9), x - 0.2 * np.cos(0.9))
    value = {"friction": 2.0, "limits": (0.45, 0.51)}[acts]
    turned = value if acts == "friction" else tuple(-y for y in value[::-1])
    asked = {"robot.friction": True} if acts == "friction" else {"robot.stops": True}
    tree = run_of(slider_crank(tmp_path, **{acts: value}), [0.9, rod - 0.9, x - 0.1], **asked)
    free = [0.0, turned] if acts == "friction" else [[-np.inf, np.inf], list(turned)]
    for kind, given in (("slider", turned if acts == "friction" else list(turned)), ("cylinder", free)):
        model = slider_crank(tmp_path, kind, **{acts: given})
        q = {"J1": 0.9, "J2": rod - 0.9, "J3": -rod, "S": 0.1 - x, "S_distance": 0.1 - x, "S_angle": 0.0}
        run = run_of(model, [q[name] for name in model.joint_names])
        same_joint = "S" if kind == "slider" else "S_distance"
        np.testing.assert_allclose(of(run, same_joint), -of(tree, "S"), atol=1e-8)
        np.testing.assert_allclose(of(run, "J1"), of(tree, "J1"), atol=1e-8)
        assert len(run.events) == len(tree.events) == (acts == "limits")


def test_lists_without_the_coordinate(tmp_path):
    """A scenario for the mechanism without friction goes on: the loop joint starts where the posture has it, moving."""
    model = cut_at_pin(tmp_path, friction=0.1)
    j1, j2, j3, pin = posture(1.1)
    here = [np.array(posture(1.1 + h)) for h in (-1e-4, 1e-4)]
    rates = (here[1] - here[0]) / 2e-4
    changes = {"start.q": [j1, j2, j3], "start.v": rates[:3].tolist(), "law.kp": [10.0, 0.0, 0.0], "law.kd": 0}
    problem = prepare(cl.load_scenario("planar2_drop", {"surface.gap": 50.0, **changes}), model)
    j = model.joint_names.index("pin")
    assert problem.q[j] == pytest.approx(pin, abs=1e-12)
    assert problem.v[j] == pytest.approx(rates[3], abs=1e-6)
    assert problem.scenario.law.kp == tuple(10.0 * (name == "J1") for name in model.joint_names)


def test_each_list_is_filled_by_itself(tmp_path):
    """Whichever of start and law have no entry for the loop joint get one, those with all are left; home as given."""
    model = cut_at_pin(tmp_path, friction=0.1)
    of_tree = [name != "pin" for name in model.joint_names]
    named = dict(zip(("J1", "J2", "J3", "pin"), posture(1.1), strict=True))
    whole = {"start.q": [named[name] for name in model.joint_names], "law.kp": (np.arange(1.0, 5.0) * of_tree).tolist()}
    short = {"start.v": [0.1, 0.2, 0.3]} | {key: list(itertools.compress(whole[key], of_tree)) for key in whole}

    def filled(left_out="", **changes):
        changes = {"law.kd": 0, "law.kp": 0, "start.q": whole["start.q"], **changes}
        scenario = cl.load_scenario("planar2_drop", changes)
        start = scenario.start.model_copy(update={left_out: None} if left_out else {})
        return with_all_entries(scenario.model_copy(update={"start": start}), model)

    whole["start.v"] = list(filled(**short).start.v)
    for some in itertools.chain.from_iterable(itertools.combinations(whole, count) for count in range(4)):
        given = filled(**(whole | {key: short[key] for key in some}))
        np.testing.assert_allclose(given.start.q, whole["start.q"], atol=1e-12)
        np.testing.assert_allclose(given.start.v, whole["start.v"], atol=1e-12)
        assert given.law.kp == tuple(whole["law.kp"])
    at_home = filled(**{"start.q": list(model.home), "start.v": short["start.v"]})
    assert filled("q", **{"start.v": short["start.v"]}).start.v == at_home.start.v
    at_rest = filled("v", **{"start.q": short["start.q"]}).start
    assert (len(at_rest.q), at_rest.v) == (model.n, None)
    nothing = cl.load_scenario("planar2_drop", {"law.kd": 0, **whole})
    assert with_all_entries(nothing, model) is nothing


@pytest.mark.parametrize(
    ("more", "drives", "said"),
    [
        ({"kind": "point", "friction": 0.1}, (), "friction is for hinge, slider, cylinder: a point has no coordinate"),
        ({"kind": "point"}, ["pin"], "drives names the loop joint 'pin', a point: loop joints with one are"),
        ({"kind": "cylinder"}, ["pin"], "a cylinder: name 'pin_angle' or 'pin_distance'"),
        (
            {"kind": "cylinder", "friction": 0.1},
            (),
            "friction is 0.1: it must be two, of the angle and of the distance",
        ),
        ({"friction": -0.1}, (), "friction is -0.1: it must be a number, zero or more"),
        ({"damping": [0.1]}, (), "damping is [0.1]: it must be a finite number"),
        ({"limits": [0.5, -0.5]}, (), "limits is [0.5, -0.5]: it must be a pair of limits, the lower first"),
        ({"limits": 0.5}, (), "limits is 0.5: it must be a pair of limits"),
    ],
)
def test_wrong_tables_are_refused(tmp_path, more, drives, said):
    """One line each, with the loop joint's name."""
    with pytest.raises(ModelError) as refusal:
        cut_at_pin(tmp_path, drives, **more)
    assert said in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_two_laws_of_friction_are_refused(tmp_path):
    """A joint_friction of the scenario would have an entry for the loop joint too."""
    with pytest.raises(cl.ScenarioError, match="loop joints of at_pin have friction in the robot's sidecar"):
        falling(cut_at_pin(tmp_path, friction=0.1), **{"joint_friction.kind": "coulomb", "joint_friction.kinetic": 0.1})


@pytest.mark.parametrize("a", [[0.0, 0.0, 1.0], [0.6, 0.0, -0.8], [0.36, -0.48, 0.8], [-0.36, 0.48, -0.8]])
def test_the_smallest_rotation_from_one_direction_to_another(a):
    """A rotation that takes one to the other, by the angle between them; the opposite one by a half turn."""
    b = np.array([0.36, -0.48, 0.8])
    R = loop_coordinate._onto(b, np.array(a))
    np.testing.assert_allclose(R @ b, a, atol=1e-15)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-15)
    assert np.linalg.det(R) > 0.0
    assert np.trace(R) == pytest.approx(1.0 + 2.0 * float(b @ a))
