"""What the lab draws, read back: the arm, the forces, the curves, the replay, the page and the film."""

import re
import sys
from dataclasses import replace

import matplotlib as mpl
import numpy as np
import pinocchio
import pytest
from budget import others

import closedloop as cl
from closedloop.figures.force import friction_bounds
from closedloop.figures.scene.scene import LOOP, OUTSIDE, TOUCH, quaternions, scene_of
from closedloop.figures.scene.solids import Ghost, Joined, Shape
from closedloop.lab import curves
from closedloop.lab.animate import CELLS, OWN, Picture
from closedloop.lab.app import cards
from closedloop.lab.curves import Panel, Trace, beside, main_panel, panels, reduced
from closedloop.lab.drawn import frames, from_text, robot_message, space_message
from closedloop.lab.history import page_of
from closedloop.loop.events.table import EVENT_COLUMNS
from closedloop.mechanics.closure.contact_force import FREE
from closedloop.mechanics.loops.reactions import loop_rows
from closedloop.mechanics.robot.pinocchio import Robot
from validation.loops import cases

SHIPPED = cl.shipped_scenarios()
QUICK = ("wam_slide", "planar2_drop")


def short_run(name, **changes):
    """Return a shipped scenario's run of half a second at most, on Pinocchio, which is compiled in any case."""
    return cl.simulate(cl.load_scenario(name, {"time.duration": 0.5} | changes))


@pytest.mark.parametrize("name", [*QUICK, *others(n for n in SHIPPED if n not in QUICK)])
def test_the_drawn_tip_is_on_the_surface_and_the_arrows_are_the_forces(name):
    """In every shipped scenario: in contact the tip is drawn on the drawn surface, and the arrows are the run's."""
    run = cl.simulate(cl.load_scenario(name), engine="compiled") if name not in QUICK else short_run(name)
    scene = scene_of(run)
    vertices, faces = scene.ground.mesh
    assert faces.max() < len(vertices)
    for vertex in vertices[:: max(1, len(vertices) // 9)] if run.scenario.has_surface else ():
        assert abs(scene.ground.placed.touching(vertex).gap) < 1e-9
    touching = np.flatnonzero(run.mode != FREE)
    rows = touching[np.unique(np.linspace(0, len(touching) - 1, 40).astype(int))] if touching.size else []
    for row in rows:
        turn, shift = scene.ground.place(row)
        gap = scene.ground.placed.touching(turn.T @ (scene.tip_place(row) - shift)).gap
        assert gap == pytest.approx(run.closure_error[row], abs=1e-6)
    few = np.linspace(0, len(run) - 1, 20).astype(int)
    for row, (pushed, rubbed, wanted, *in_loops) in zip(few, scene.arrows(few), strict=True):
        assert scene.tip_place(row) == pytest.approx(run.position[row], abs=1e-9)
        normal = run.surface_normal[row]
        kinds = [LOOP] * len(run.model.loops) + [TOUCH] * (len(scene.patches) if run.scenario.contact else 0)
        assert [arrow.kind for arrow in in_loops] == kinds
        assert pushed.force @ normal == pytest.approx(run.contact_force[row], rel=1e-12)
        assert np.linalg.norm(np.cross(pushed.force, normal)) < 1e-9
        assert rubbed.force == pytest.approx(run.friction_force[row])
        acts = run.mode[row] != FREE  # in flight nothing is pressed on
        assert wanted.force @ normal == pytest.approx(-run.reference_force[row] if acts else 0.0)
        assert np.array_equal(pushed.tail, run.position[row])
    assert [mark.time for mark in scene.marks] == run.event_time.tolist()


@pytest.mark.parametrize("name", ["four_bar", "stewart"])
def test_the_drawn_forces_of_loops_do_the_work_that_the_torques_lack(name):
    """Drawn at their marks they give, with C, Q and the contact, q̈; both sides of a mark are one place."""
    run = short_run(name, **{"time.duration": 0.02})
    scene, row, step = scene_of(run), 15, 1e-6
    robot, mechanism = scene.robot, scene.model.pinocchio_model()
    frames = [[mechanism.frames[mechanism.getFrameId(name)] for name in loop.frames] for loop in run.model.loops]

    def ends(q):  # (loops, 2, 3), from the robot's file alone
        data = mechanism.createData()
        pinocchio.forwardKinematics(mechanism, data, q)
        each = zip(frames, run.model.loops, strict=True)
        return np.array([[(data.oMi[f.parentJoint] * f.placement).act(np.array(p))
                          for f, p in zip(pair, loop.points, strict=True)] for pair, loop in each])  # fmt: skip

    (arrows,) = scene.arrows([row])
    drawn = [arrow for arrow in arrows if arrow.kind == LOOP]
    assert np.array([arrow.tail for arrow in drawn]) == pytest.approx(ends(run.q[row])[:, 0], abs=1e-12)
    assert ends(run.q[row])[:, 1] == pytest.approx(ends(run.q[row])[:, 0], abs=1e-9)
    apart = [ends(run.q[row] + step * side)[:, 0] - ends(run.q[row] + step * side)[:, 1] for side in np.eye(robot.n)]
    still = ends(run.q[row])[:, 0] - ends(run.q[row])[:, 1]
    work = -np.einsum("jki,ki->j", (np.array(apart) - still) / step, [arrow.force for arrow in drawn])
    terms, torque = robot.terms(run.q[row], run.v[row]), run.torque[row] + run.joint_friction[row]
    force = run.contact_force[row] * run.surface_normal[row] + run.friction_force[row]
    missing = terms.mass_matrix @ run.acceleration[row] + terms.bias - torque - terms.jacobian.T @ force
    assert np.abs(missing).max() > 0.1
    assert work == pytest.approx(missing, abs=1e-3)
    errors = next(panel for panel in panels(run) if panel.name == "loops")
    assert [trace.label for trace in errors.traces] == [loop.name for loop in run.model.loops]
    assert all(trace.values.max() < 1e-6 for trace in errors.traces)


def test_titles_have_the_units_of_their_joints_and_say_where_errors_are_rounding():
    """Sliding joints have N alone; the loops of `delta` are closed to rounding, the contact of its tip is not."""
    titles = [panel.title for panel in panels(short_run("gripper_block", **{"time.duration": 0.02}))]
    assert "torque of joints without a limit [N]" in titles
    closure, loops = [panel.title for panel in panels(short_run("delta", **{"time.duration": 1.0}))][-2:]
    assert (closure, loops) == ("closure error [nm]", "loop error, rounding only [m]")


def test_the_curves_of_a_run_beside_a_pinned_one_have_its_unit():
    """Lengths are in nm, of the run that is pinned in µm: both are drawn in µm, and a length in m is the same."""
    fine = Panel("tip", "nm", np.arange(2.0), (Trace("e", "#000000", np.array([5.0, 7.0])),), factor=1e9)
    coarse = Panel("tip", "µm", np.arange(2.0), (Trace("e", "#000000", np.array([-35.0, 0.0])),), factor=1e6)
    (drawn,) = beside([fine], [coarse])
    assert (drawn.unit, drawn.factor) == ("µm", 1e6)
    np.testing.assert_allclose(drawn.main.values / drawn.factor, fine.main.values / fine.factor)
    assert beside([coarse], [fine])[0].unit == "µm"
    assert beside([fine], [])[0].unit == "nm"


def test_viscous_friction_is_within_the_cone_that_is_drawn():
    """The bound is μ f + b |u|: a tip that slips is at it, and Coulomb's part alone lies below."""
    run = cl.simulate(cl.load_scenario("wam_slide_friction", {
        "friction.kind": "coulomb_viscous", "friction.coefficient": 0.1, "friction.viscous": 200.0,
        "law.kind": "operational_space", "time.duration": 1.5}))  # fmt: skip
    size, slips = np.linalg.norm(run.friction_force, axis=1), np.linalg.norm(run.slip_velocity, axis=1) > 1e-3
    ((bound, name, _),) = friction_bounds(run)
    assert "b |u|" in name
    assert np.any(slips)
    np.testing.assert_allclose(size[slips], bound[slips], rtol=1e-6)
    assert np.all(size[slips] > 1.15 * 0.1 * run.contact_force[slips])


def test_what_rests_has_no_path_in_space():
    """Of boxes that stand there is none; of a slide there are the tip's and the one desired."""
    assert space_message(scene_of(short_run("tower", **{"time.duration": 0.02})), [0])["paths"] == []
    slide = space_message(scene_of(short_run("planar2_slide", **{"time.duration": 0.7})), [0])
    assert [path["name"] for path in slide["paths"]] == ["actual path", "desired path"]


def test_the_errors_of_loops_are_those_of_some_rows(monkeypatch):
    """Of a long run not all rows are evaluated, but the first and the last; each point is the error of its row."""
    run = short_run("four_bar", **{"time.duration": 0.02})
    every = next(panel for panel in panels(run) if panel.name == "loops")
    monkeypatch.setattr(curves, "MOST_LOOPS", 7)
    some = next(panel for panel in panels(run) if panel.name == "loops")
    assert (every.time.size, some.time.size) == (21, 7)
    rows = np.searchsorted(run.time, some.time)
    assert rows[[0, -1]].tolist() == [0, 20]
    scale = some.traces[0].values[-1] / every.traces[0].values[-1]  # the unit may be another
    for few, all_ in zip(some.traces, every.traces, strict=True):
        np.testing.assert_allclose(few.values, scale * all_.values[rows], rtol=1e-12)


@pytest.mark.parametrize("name", ["two_arms_bar", "gripper_gear"])
def test_the_drawn_forces_between_links_are_the_torques_that_are_missing(name):
    """Where they are drawn, on one link and its opposite on the other, they give, with C, Q and loops, q̈."""
    run = short_run(name, **{"time.duration": 0.02})
    scene, row = scene_of(run), 15
    (arrows,) = scene.arrows([row])
    drawn = [arrow for arrow in arrows if arrow.kind == TOUCH]
    assert [arrow.name.removeprefix(f"{TOUCH} ") for arrow in drawn] == [c.name for c in run.scenario.contact]
    assert (len(scene.surface[1]) > 0) == (name == "gripper_gear")  # the floor that links touch, drawn once
    plotted = {panel.name: panel for panel in panels(run)}
    assert not {"closure", "friction"} & set(plotted)
    assert np.array_equal(plotted["links"].traces[2].values, run.link_forces[:, 1])
    slips = replace(run, columns=run.columns | {"event_contact": np.array([2]), "event_time": run.time[row : row + 1]})
    others = [name for name in EVENT_COLUMNS if name not in slips.columns or not len(slips.columns[name])]
    more = {name: np.ones((1, *run.columns[name].shape[1:]), dtype=int) for name in others}
    slips = replace(slips, columns=slips.columns | more)
    assert scene_of(slips).marks[0].position == pytest.approx(drawn[1].tail)
    mechanism = scene.model.pinocchio_model()
    data = mechanism.createData()
    pinocchio.computeJointJacobians(mechanism, data, run.q[row])

    def torque(frame, place, force):
        joint = 0 if frame == "world" else mechanism.frames[mechanism.getFrameId(frame)].parentJoint
        jacobian = (
            pinocchio.getJointJacobian(mechanism, data, joint, pinocchio.WORLD) if joint else np.zeros((6, run.model.n))
        )
        return jacobian.T @ np.concatenate([force, np.cross(place, force)])

    work = sum(
        torque(contact.link, arrow.tail, arrow.force) - torque(contact.against, arrow.tail, arrow.force)
        for contact, arrow in zip(run.scenario.contact, drawn, strict=True)
    )
    terms = scene.robot.terms(run.q[row], run.v[row])
    missing = terms.mass_matrix @ run.acceleration[row] + terms.bias - run.torque[row] - work
    if run.loops is not None:  # the gear between the fingers
        missing -= loop_rows(scene.robot, run.q, run.v)[0][row].T @ run.loops.multipliers[row]
    assert np.abs(work).max() > 1.0
    assert missing == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("mechanism", [cases.distance, cases.slider_crank, cases.gears])
def test_every_kind_of_loop_joint_has_a_mark_where_it_is(mechanism):
    """A rod reaches from one point to the other, a slider's mark lies along its axis, a gear's at its first joint."""
    model = mechanism()
    joined = Joined(Robot(model, model.frames[-1]), 1.0)
    data = model.pinocchio_model().createData()
    pinocchio.framesForwardKinematics(model.pinocchio_model(), data, model.home)
    axes, origins = (np.array([getattr(place, part) for place in data.oMi]) for part in ("rotation", "translation"))
    turns, places = joined.places(axes, origins)
    for loop, drawn, turn, place in zip(model.loops, joined.loops, turns, places, strict=True):
        length = np.ptp(drawn.shape.vertices[:, 2])
        if loop.type == "gear":
            assert place == pytest.approx(origins[model.joint_names.index(loop.joints[0]) + 1])
            continue
        one, other = (data.oMf[model.pinocchio_model().getFrameId(name)] for name in loop.frames)
        assert place == pytest.approx(one.act(np.array(loop.points[0])))
        if loop.type == "distance":
            assert place + length * turn[:, 2] == pytest.approx(other.act(np.array(loop.points[1])), abs=1e-6)
        else:
            assert np.abs(turn[:, 2] @ one.rotation @ np.array(loop.axes[0])) == pytest.approx(1.0)


@pytest.mark.parametrize("model", ["wam4", "planar2", pytest.param("ur5", marks=pytest.mark.slow)])
def test_shapes_move_with_the_joints(model):
    """Each shape belongs to a joint of the robot or its base, and its triangles to its vertices."""
    import robot_models
    from closedloop.figures.scene.solids import robot_shapes

    robot = robot_models.load(model)
    shapes = robot_shapes(robot, robot.tip)
    assert {shape.joint for shape in shapes} <= set(range(robot.n + 1))
    assert len({shape.joint for shape in shapes}) > 1
    for shape in shapes:
        assert shape.faces.max() < len(shape.vertices)
        assert np.abs(shape.vertices).max() < 3.0


def test_a_robot_without_shapes_is_drawn_as_rods():
    """An MJCF, whose shapes are not read, has a rod or a ball for the base and every joint."""
    import robot_models
    from closedloop.figures.scene.solids import robot_shapes

    inertia = '<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>'
    body = f'<body name="{{}}" pos="0 0 0.5">{inertia}<joint name="{{}}" type="hinge" axis="0 1 0"/>'
    arm = body.format("a", "one") + body.format("b", "two") + "</body></body>"
    text = f"<mujoco><worldbody>{arm}</worldbody></mujoco>"
    robot = robot_models.from_text(
        text, "mjcf", name="two", armature=[0, 0], tip="b", home=[0.1, 0.1], locked={}
    )  # fmt: skip
    assert {shape.joint for shape in robot_shapes(robot, "b")} == {0, 1, 2}


def test_quaternions_turn_as_their_matrices_do():
    """A half turn about x is i, the identity 1."""
    turn = np.diag([1.0, -1.0, -1.0])
    assert np.abs(quaternions(np.array([np.eye(3), turn]))) == pytest.approx(np.array([[1, 0, 0, 0], [0, 1, 0, 0]]))


def test_a_reduced_curve_keeps_its_extremes_and_its_ends():
    """An overshoot of one row survives any reduction, and a window shows its own rows only."""
    run = short_run("wam_slide", **{"time.duration": 2.0})
    full = panels(run)[0]
    few = reduced(full, 0.0, 2.0, cells=20)
    assert few.time.size < 150
    for before, after in zip(full.traces, few.traces, strict=True):
        assert (after.values.min(), after.values.max()) == (before.values.min(), before.values.max())
    assert (few.time[0], few.time[-1]) == (0.0, full.time[-1])
    part = reduced(full, 0.4, 0.6, cells=20)
    assert part.time[0] >= 0.398
    assert part.time[-1] <= 0.602


def test_the_page_holds_the_run_and_no_text_ends_its_script():
    """What the page's data decode to is the run; a name with markup stays text."""
    run = short_run("planar2_drop", description="</script><script>alert(1)</script>")
    page = page_of(run, "closedloop planar2_drop")
    assert "<script>alert" not in page
    assert not re.search(r'(src|href)="', page)
    found = {m["kind"]: m for m in from_text(re.search(r'type="text/plain">(.*?)</script>', page, re.S)[1])}
    force = next(trace for trace in found["run"]["panels"][0]["traces"] if trace["label"] == "f")
    assert force["values"].max() == pytest.approx(run.contact_force.max(), rel=1e-6)
    assert len(found["run"]["marks"]) == len(run.events) > 0
    assert found["hello"]["scenario"] == run.scenario.to_toml()
    assert found["hello"]["command"] == "closedloop planar2_drop"
    assert (
        found["space"]["frames"]["places"].size == 7 * found["robot"]["joints"] * found["space"]["frames"]["time"].size
    )


@pytest.mark.slow
def test_a_film_has_a_frame_for_each_instant(tmp_path):
    """A .gif of 0.5 s at 8 frames a second; what cannot be a film is one line."""
    from PIL import Image

    run = short_run("planar2_drop")
    with Image.open(run.animate(tmp_path / "drop.gif", frames_per_second=8)) as film:
        assert film.n_frames == 5
        frames = []
        for k in range(film.n_frames):
            film.seek(k)
            frames.append(np.asarray(film.convert("RGB")).astype(int))
    with mpl.rc_context(OWN):
        picture = Picture(scene_of(run), reduced(main_panel(run), 0.0, float(run.time[-1]), CELLS))
        pictures = [picture.pixels(row)[..., :3].astype(int) for row in (0, 125, 250, 375, 500)]
    for wanted, frame in zip(pictures, frames, strict=True):  # each is whole, but for the palette
        off = np.abs(wanted - frame).max(axis=2)
        assert np.mean(off > 60) < 2e-3
    with pytest.raises(cl.ScenarioError, match=r"must end in \.gif or \.mp4"):
        run.animate(tmp_path / "drop.avi")
    with pytest.raises(cl.ScenarioError, match="speed = 0"):
        run.animate(tmp_path / "drop.gif", speed=0.0)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["drop.gif"]


@pytest.mark.slow
def test_a_mp4_has_the_frames_of_the_run(tmp_path):
    """Read back by ffmpeg: as many frames and seconds as asked for, of the film's size; the arm moves in it."""
    reader = pytest.importorskip("imageio_ffmpeg", reason="imageio-ffmpeg is not installed: the extra 'mp4'")
    file = short_run("planar2_drop").animate(tmp_path / "drop.mp4", speed=0.5, frames_per_second=10)
    assert reader.count_frames_and_secs(str(file)) == (11, pytest.approx(1.1))
    about, *frames = reader.read_frames(str(file))
    assert (about["codec"], about["size"], about["fps"]) == ("h264", (1000, 500), 10.0)
    pictures = [np.frombuffer(frame, dtype=np.uint8).reshape(500, 1000, 3).astype(int) for frame in frames]
    assert np.abs(pictures[-1] - pictures[0])[:, :500].max() > 50
    assert [path.name for path in tmp_path.iterdir()] == ["drop.mp4"]


def test_a_mp4_without_ffmpeg_is_one_line(tmp_path, monkeypatch):
    """The line says what to install, and the way out; nothing is written."""
    monkeypatch.setattr("closedloop.lab.animate.shutil.which", lambda name: None)
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(cl.OutputError) as refused:
        short_run("planar2_drop").animate(tmp_path / "drop.mp4")
    assert 'pip install "closedloop[mp4]", or write a .gif' in str(refused.value)
    assert len(str(refused.value).splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


def test_a_ghost_is_beside_the_bodies_of_a_run():
    """The page has its shape, seen through, and its place at each instant: between two of its rows by half a turn."""
    run = short_run("planar2_slide")
    box = Shape(0, np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], dtype=np.int32), (0.0, 0.0, 0.0))
    end = run.time[-1]
    turned = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])  # by half a turn about z
    ghost = Ghost("measured", (box,), np.array([0.0, end]), turned, np.array([[0.0, 0.0, 0.0], [1.0, 2.0, 3.0]]))
    scene = scene_of(run, [ghost])
    about, there = robot_message(scene), frames(scene, [0, len(run) // 2, len(run) - 1])
    (shape,) = [each for each in about["shapes"] if each["kind"] == "measured"]
    assert 0.0 < shape["opacity"] < 1.0
    assert shape["joint"] == about["joints"] - 1
    places = there["places"][:, shape["joint"]]
    assert places.shape == (3, 7)
    middle = run.time[len(run) // 2] / end
    np.testing.assert_allclose(places[:, 4:], np.outer([0.0, middle, 1.0], [1.0, 2.0, 3.0]), atol=1e-12)
    np.testing.assert_allclose(
        np.abs(places[1, :4]), [np.cos(middle * np.pi / 2), 0, 0, np.sin(middle * np.pi / 2)], atol=1e-9
    )
    assert frames(scene_of(run), [0])["places"].shape[1] == about["joints"] - 1


def test_the_gallery_opens_with_an_arm_above_its_table():
    """Nothing of the arm passes through what it presses on, at any instant, and every scenario has a card."""
    names = [card["name"] for card in cards()]
    assert sorted(names) == sorted(cl.shipped_scenarios())
    run = cl.simulate(cl.load_scenario(names[0]))
    clearance = run.summary()["clearance"]
    assert clearance is None or clearance["distance"] > 0.0
    surface = np.max(run.position[run.mode != 0, 2])
    _, origins = scene_of(run).joint_places(len(run) - 1)
    assert origins[4, 2] > surface + 0.1  # the elbow


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["joint_friction", "wam_edge", "wam_hybrid_friction", "wam_slide_friction", "planar2_drop", "panda_wipe"]
)
def test_no_link_passes_through_the_surface(name):
    """From the start to the end of the run the arm is drawn clear of its table; only the ball at the tip touches it."""
    run = cl.simulate(cl.load_scenario(name), engine="compiled")
    assert run.summary()["clearance"]["distance"] > 0.0


def test_the_points_of_a_face_have_one_arrow():
    """It is their sum, at their centre of pressure, as `contact_wrench` has them: 37 arrows would hide each other."""
    body = {"name": "puck", "shape": "cylinder", "radius": 0.05, "length": 0.02, "mass": 1.0}
    body["position"] = [0, 0, 0.0099]
    pad = {"kind": "kelvin_voigt", "stiffness": 2e5, "damping": 200.0}
    face = {"name": "pad", "link": "puck", "at": {"disc": 0.05, "centre": [0, 0, -0.01]}, "compliance": pad}
    push = [{"link": "puck", "at": [0.02, 0.0, 0.0], "force": [0.0, 0.0, -5.0]}]
    run = cl.simulate(cl.load_scenario({
        "robot": {"model": "none"}, "body": [body], "contact": [face], "external_force": push,
        "stabiliser": {"kind": "none"}, "time": {"duration": 0.2, "step": 1e-3, "integrator": "rk4"},
    }))  # fmt: skip
    scene, row = scene_of(run), len(run) - 1
    assert run.link_forces.shape[1] == 37
    (touch,) = (arrow for arrow in scene.arrows([row])[0] if arrow.kind == TOUCH)
    wrench = run.contact_wrench("pad")[row]
    np.testing.assert_allclose(touch.force, wrench[:3], atol=1e-9)
    np.testing.assert_allclose(touch.tail, wrench[6:], atol=1e-9)
    (outside,) = (arrow for arrow in scene.arrows([row])[0] if arrow.kind == OUTSIDE)
    np.testing.assert_allclose(outside.force, [0.0, 0.0, -5.0])
    assert outside.tail[0] == pytest.approx(0.02, abs=1e-3)
    assert {TOUCH, OUTSIDE} <= set(scene.kinds)
    assert all(len(each["tails"][0]) == len(scene.arrows([0])[0]) for each in [frames(scene, [0, row])])
