"""The scene as MJCF, loaded by MuJoCo: the run's tip, masses and forces, and the surface where the run has it."""

import numpy as np
import pytest
from budget import others

import closedloop as cl
from closedloop.__main__ import main
from closedloop.figures.scene.scene import quaternions, scene_of
from closedloop.mechanics.closure.contact_force import FREE
from closedloop.mechanics.loops.reactions import loop_rows
from closedloop.mechanics.robot.pinocchio import Robot
from validation.loops import cases
from validation.loops.andrews import coasting

BUMPS = [[0.002 * np.sin(0.7 * i) * np.cos(0.5 * j) for j in range(18)] for i in range(15)]
SURFACES = {
    "plane": {"surface.normal": [0.1, -0.2, 1.0], "reference.kind": "hold"},
    "sphere": {"surface.kind": "sphere", "surface.radius": 0.4},
    "bowl": {"surface.kind": "sphere", "surface.radius": 0.4, "surface.inside": True},
    "cylinder": {"surface.kind": "cylinder", "surface.radius": 0.25, "surface.axis": [1.0, 0.5, 0.0]},
    "pipe": {"surface.kind": "cylinder", "surface.radius": 0.5, "surface.inside": True},
    "ellipsoid": {"surface.kind": "ellipsoid", "surface.normal": [0.1, 0.2, 1.0], "reference.kind": "hold"},
    "height_field": {"surface.kind": "height_field", "surface.heights": BUMPS, "surface.spacing": 0.02},
    "turntable": {"surface_motion.kind": "turntable", "surface_motion.speed": 0.5},
}
ARMS = ("planar2_slide", "panda_slide", "panda_scan", "soft_table", "payload_mismatch", "wam_sphere", "wam_touchdown")
QUICK = ("panda_scan",)
# MuJoCo's grids of heights are made of triangles.
ROUGHNESS = {"bowl": 2e-5, "pipe": 2e-5, "height_field": 2e-5}


def loaded(run, folder):
    """Return MuJoCo's model and data of a run's scene, exported by the command."""
    mujoco = pytest.importorskip("mujoco", reason="mujoco is not installed: the extra 'peers'")
    file = run.save(folder / "run.nc")
    assert main(["export", str(file), "--to", "mjcf"]) == 0
    model = mujoco.MjModel.from_xml_path(str(folder / "run.xml"))
    return mujoco, model, mujoco.MjData(model)


@pytest.mark.parametrize("name", [*QUICK, *others(n for n in ARMS if n not in QUICK)])
def test_the_arm_is_that_of_the_run(name, tmp_path):
    """At the run's states: the tip to 1e-9 m, mass matrix, bias with gravity, moved mass; no shape touches."""
    run = cl.simulate(cl.load_scenario(name, {"time.duration": 0.02}))
    mujoco, model, data = loaded(run, tmp_path)
    robot = scene_of(run).model.pinocchio_model()
    columns = [int(model.joint(joint).dofadr[0]) for joint in run.model.joint_names]
    mass = np.zeros((model.nv, model.nv))
    rng, bodies = np.random.default_rng(3), [int(model.joint(joint).bodyid[0]) for joint in run.model.joint_names]
    assert model.body_mass.sum() == pytest.approx(model.body_mass[bodies].sum())
    assert model.body_mass.sum() == pytest.approx(sum(each.mass for each in list(robot.inertias)[1:]), rel=1e-9)
    assert np.array_equal(model.opt.gravity, scene_of(run).model.gravity)
    own = Robot(scene_of(run).model, scene_of(run).tip)
    for q in (run.q[0], run.q[-1], run.q[0] + rng.normal(0.0, 0.2, run.model.n)):
        v = rng.normal(0.0, 1.0, run.model.n)
        data.qpos[columns], data.qvel[columns] = q, v
        mujoco.mj_forward(model, data)
        terms = own.terms(q, v)
        assert data.site("tip").xpos == pytest.approx(terms.position, abs=1e-9)
        mujoco.mj_fullM(model, data, mass)
        assert mass[np.ix_(columns, columns)] == pytest.approx(terms.mass_matrix, rel=1e-9, abs=1e-9)
        assert data.qfrc_bias[columns] == pytest.approx(terms.bias, rel=1e-9, abs=1e-9)
    for key, row in (("start", 0), ("end", -1)):
        mujoco.mj_resetDataKeyframe(model, data, model.key(key).id)
        mujoco.mj_forward(model, data)
        assert data.site("tip").xpos == pytest.approx(run.position[row], abs=1e-9)
        assert data.ctrl[columns] == pytest.approx(run.torque[row])
    arm = [k for k in range(model.ngeom) if model.geom(k).name != "surface"]
    assert len(arm) > 0
    assert not np.any(model.geom_contype[arm])


def distance(loaded_scene, point, normal):
    """Return how far MuJoCo's surface is below a point (3,), against a unit normal (3,)."""
    mujoco, model, data = loaded_scene
    hit, groups = np.zeros(1, dtype=np.int32), np.array([1, 0, 0, 0, 0, 0], dtype=np.uint8)
    mujoco.mj_forward(model, data)
    found = mujoco.mj_ray(model, data, point + 0.02 * normal, -normal, groups, 1, -1, hit)
    assert model.geom(int(hit[0])).name == "surface"
    return found - 0.02


@pytest.mark.parametrize("kind", SURFACES)
def test_the_surface_is_where_the_run_has_it(kind, tmp_path):
    """A ray along the normal meets MuJoCo's surface at the tip's distance, and on points of ours off the path."""
    run = cl.simulate(cl.load_scenario("wam_slide", {"time.duration": 0.05} | SURFACES[kind]))
    there, scene, near = loaded(run, tmp_path), scene_of(run), ROUGHNESS.get(kind, 1e-6)
    assert np.all(run.mode != FREE)
    gap = distance(there, run.position[0], run.surface_normal[0])
    assert gap == pytest.approx(run.closure_error[0], abs=near)
    vertices, rng = scene.surface[0], np.random.default_rng(1)
    points = rng.dirichlet(np.ones(3), 20) @ np.array(
        [vertices[0], vertices[-1], 0.7 * vertices[1] + 0.3 * vertices[0]]
    )
    none = np.zeros_like(points)
    for point in scene.ground.placed.follow(0.0, np.zeros(len(points)), (points, none, none))[0]:
        assert distance(there, point, scene.ground.placed.touching(point).frame[0]) == pytest.approx(0.0, abs=near)


def test_a_surface_that_moves_is_a_body_that_can_be_moved(tmp_path):
    """Put where the run has it at its end, the tilting surface carries the tip."""
    moving = {"surface_motion.kind": "breathing", "time.duration": 0.5, "reference.kind": "hold"}
    run = cl.simulate(cl.load_scenario("wam_slide", moving))
    there, (turn, shift) = loaded(run, tmp_path), scene_of(run).ground.place(len(run) - 1)
    _, model, data = there
    assert np.linalg.norm(shift) > 1e-4
    mocap = int(model.body("surface").mocapid[0])
    data.mocap_pos[mocap], data.mocap_quat[mocap] = shift, quaternions(turn[None])[0]
    gap = distance(there, run.position[-1], run.surface_normal[-1])
    assert gap == pytest.approx(run.closure_error[-1], abs=1e-6)


MECHANISMS = ("gripper_gear", "four_bar", "five_bar", "stewart", "delta", "two_arms_bar")


@pytest.mark.parametrize("name", [MECHANISMS[0], *others(MECHANISMS[1:])])
def test_loops_are_closed_and_contacts_touch_as_in_the_run(name, tmp_path):
    """At the first and the last row MuJoCo's equalities hold, and each pair is as far apart as the run's contact is."""
    run = cl.simulate(cl.load_scenario(name, {"time.duration": 0.02}))
    mujoco, model, data = loaded(run, tmp_path)
    assert model.npair == len(run.scenario.contact or ())
    assert (model.neq > 0) == bool(run.model.loops)
    closed_as_ours(run, mujoco, model, data)
    for key, row in (("start", 0), ("end", -1)):
        mujoco.mj_resetDataKeyframe(model, data, model.key(key).id)
        mujoco.mj_forward(model, data)
        for k, each in enumerate(scene_of(run).touching):
            ends = [model.geom(f"{each.name} {part}").id for part in ("point", "plane")]
            gap = mujoco.mj_geomDistance(model, data, *ends, 1.0, None)
            assert gap == pytest.approx(run.link_gaps[row, k], abs=1e-8)


def test_a_point_and_a_ball_are_as_far_from_their_planes_as_in_the_run(tmp_path):
    """A point has a small ball in MuJoCo, and its plane is so much lower; a ball's plane is where it is."""
    contacts = [{"link": "box", "at": [0.0, 0.0, -0.1]}, {"link": "box", "at": [0.1, 0.0, 0.0], "radius": 0.03}]
    bodies = [{"name": "box", "shape": "box", "edges": [0.3, 0.2, 0.1], "mass": 2.0, "position": [0.0, 0.0, 0.5]}]
    told = {"robot": {"model": "none"}, "body": bodies, "contact": contacts, "time": {"duration": 0.01}}
    run = cl.simulate(cl.load_scenario(told))
    mujoco, model, data = loaded(run, tmp_path)
    mujoco.mj_resetDataKeyframe(model, data, model.key("start").id)
    mujoco.mj_forward(model, data)
    for k, each in enumerate(scene_of(run).touching):
        ends = [model.geom(f"{each.name} {part}").id for part in ("point", "plane")]
        gap = mujoco.mj_geomDistance(model, data, *ends, 1.0, None)
        assert gap == pytest.approx(run.link_gaps[0, k], abs=1e-8)
        assert gap == pytest.approx((0.4, 0.47)[k], abs=1e-8)


@pytest.mark.parametrize("mechanism", [cases.distance, cases.gears])
def test_rods_and_gears_are_held_too(mechanism, tmp_path):
    """A distance is a tendon of that length, a gear a joint's equality with its polynomial."""
    run = coasted(mechanism())
    closed_as_ours(run, *loaded(run, tmp_path))


def test_a_loop_joint_without_an_equality_is_refused_in_one_line(tmp_path, capsys):
    """MuJoCo has none for a slider: it would be a tree whose loop is open."""
    run = coasted(cases.slider_crank())
    assert main(["export", str(run.save(tmp_path / "run.nc")), "--to", "mjcf"]) == 2
    err = capsys.readouterr().err
    assert len(err.splitlines()) == 1
    assert "MuJoCo has no equality for a slider, as 'guide' of slider_crank is; use --to csv or --to mcap" in err
    assert [path.name for path in tmp_path.iterdir()] == ["run.nc"]


def test_a_contact_with_a_curved_surface_is_refused_in_one_line(tmp_path, capsys):
    """It would be written as a plane, and nothing would say so."""
    bowl = {"kind": "sphere", "radius": 0.4, "inside": True}
    changes = {
        "robot.model": "pointmass3", "law.kp": 0, "law.kd": 0, "start.q": [0.0, 0.0, 0.1], "start.v": [0.0] * 3,
        "time.duration": 0.01, "reference.kind": "hold", "contact": [{"link": "tip", "surface": bowl}],
        "surface": {"kind": "plane", "offset": "start", "gap": 50.0, "contact": "unilateral"},
    }  # fmt: skip
    run = cl.simulate(cl.load_scenario("planar2_drop", changes), law=lambda x: 0.0 * x.q)
    assert main(["export", str(run.save(tmp_path / "run.nc")), "--to", "mjcf"]) == 2
    err = capsys.readouterr().err
    assert len(err.splitlines()) == 1
    assert "contact 'contact 1' has a surface that is curved or moves" in err
    assert [path.name for path in tmp_path.iterdir()] == ["run.nc"]


def coasted(model):
    """Return a run of a few steps of a mechanism whose tip touches nothing."""
    scenario = coasting(model, [float(x) for x in model.home], [0.0] * model.n, 0.005, 1e-3)
    return cl.simulate(scenario, model=model, law=lambda x: 0.0 * x.q, engine="pinocchio")


def closed_as_ours(run, mujoco, model, data):
    """Hold tip, mass matrix, closure and the directions that the loops bind against the run's, at its ends."""
    columns = [int(model.joint(joint).dofadr[0]) for joint in run.model.joint_names]
    own, mass = Robot(scene_of(run).model, scene_of(run).tip), np.zeros((model.nv, model.nv))
    assert model.nu == len(run.model.drives or run.model.joint_names)
    assert model.neq + model.npair > 0
    for key, row in (("start", 0), ("end", -1)):
        mujoco.mj_resetDataKeyframe(model, data, model.key(key).id)
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, mass)
        terms = own.terms(run.q[row], run.v[row])
        assert data.site("tip").xpos == pytest.approx(terms.position, abs=1e-9)
        assert mass[np.ix_(columns, columns)] == pytest.approx(terms.mass_matrix, rel=1e-9, abs=1e-9)
        held = data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY
        assert np.abs(data.efc_pos[held]).max(initial=0.0) < 1e-7
        if run.model.loops:
            ours = loop_rows(scene_of(run).robot, run.q, run.v)[0][row]
            theirs = jacobian(mujoco, model, data)[held][:, columns]
            ranks = [np.linalg.matrix_rank(rows, tol=1e-6) for rows in (ours, theirs, np.vstack([ours, theirs]))]
            assert ranks[0] == ranks[1] == ranks[2] > 0


def jacobian(mujoco, model, data):
    """Return the Jacobian of all of MuJoCo's constraints (rows, nv)."""
    if not mujoco.mj_isSparse(model):
        return data.efc_J.reshape(-1, model.nv)
    dense = np.zeros((data.nefc, model.nv))
    mujoco.mju_sparse2dense(dense, data.efc_J.ravel(), data.efc_J_rownnz, data.efc_J_rowadr, data.efc_J_colind)
    return dense
