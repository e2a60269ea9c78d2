"""The orientation of the tool along a path: held by the reference, followed by the laws, refused where it cannot be."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from rounding import within
from scipy.spatial.transform import Rotation

import closedloop as cl
from closedloop.control.reference.desired import Follower
from closedloop.control.reference.inverse_kinematics import _axis_rows, _frame_rows
from closedloop.control.reference.path import turned_by
from closedloop.control.reference.tip_path import Straight, seams
from closedloop.jit.interpreted import interpreted
from closedloop.jit.kernel import plain
from closedloop.loop.step.entries import desired_acceleration
from closedloop.mechanics.surface.kinds.height_field import HeightField
from closedloop.mechanics.surface.surface import Surface
from closedloop.simulation.engines.problem import Problem

ON_A_BALL = {
    "law": {"kind": "operational_space", "force": 5.0, "posture_stiffness": 400.0, "posture_damping": 40.0},
    "friction": {"kind": "none"}, "compensation": {"kind": "none"}, "surface_motion": {"kind": "none"},
    "surface": {"kind": "sphere", "radius": 0.3, "contact": "bilateral"},
    "reference": {"kind": "line", "direction": [0, 1, 0], "speed": 0.15, "start": 0.05, "stop": 0.55,
                  "orientation": "normal", "timing": "minimum_jerk"},
    "time.duration": 0.6,
}  # fmt: skip
BREATHING = {"kind": "breathing", "amplitude": 0.02, "frequency": 1.0}
TILTING = {"kind": "turntable", "axis": [1.0, 0.2, 0.0], "centre": [0.5, 0.0, 0.4], "speed": 0.4}


def load(name="panda_scan", **changes):
    """Return a scenario of the panda, on a ball where nothing else is said."""
    return cl.load_scenario(name, ON_A_BALL | {key.replace("__", "."): value for key, value in changes.items()})


def along(problem, count=101):
    """Return instants, q_des, q̇_des, and the axes of the tip's frame of the reference."""
    t = np.linspace(0.0, problem.steps * problem.h * 0.999, count)
    q, v, _ = problem.wanted.joints.sample(t)
    return t, q, v, problem.robot.tip_axes(q)


@pytest.mark.parametrize("motion", [{"kind": "none"}, BREATHING, TILTING])
def test_the_axis_is_held_against_the_normal(motion):
    """In the reference the tool's axis is −n within 1e-9 rad all along, and the tip on its path; also as it moves."""
    off = {"surface.contact": "unilateral", "surface.gap": 0.002}
    problem = cl.prepare(load(surface_motion=motion, **off))
    t, q, v, axes = along(problem)
    r, dr, _ = problem.wanted.tip.sample(t)
    normals, rates = problem.surface.normals(t, r, dr)
    assert np.ptp(normals[:, 1]) > 0.05
    assert np.max(np.linalg.norm(np.cross(axes[:, :, 2], normals), axis=1)) < 1e-9
    assert np.all(np.sum(axes[:, :, 2] * normals, axis=1) < 0.0)
    assert np.max(np.abs([problem.robot.position(each) for each in q] - r)) < 1e-9
    for k in (10, 40, 70):  # what turns the tool is what turns the normal
        turning = problem.robot.frame_jacobian(q[k])[3:] @ v[k]
        assert np.allclose(np.cross(turning, normals[k]), rates[k], rtol=0, atol=1e-7)


@pytest.mark.parametrize("shape", [ON_A_BALL["surface"], {"kind": "ellipsoid"}], ids=lambda shape: shape["kind"])
def test_the_rate_of_the_normal_is_its_derivative(shape):
    """On a surface that tilts, by a central difference of an analytic function, to the order of its step.

    Of an ellipsoid the gradient of the level changes its length, too.
    """
    surface = shape | {"contact": "unilateral", "gap": 0.002}
    surface, (t, h) = cl.prepare(load(surface_motion=TILTING, surface=surface)).surface, (0.3, 1e-4)
    r0, r1 = np.array([0.55, 0.03, 0.55]), np.array([0.1, -0.2, 0.05])
    times = t + h * np.array([-1.0, 0.0, 1.0])
    normals, rates = surface.normals(times, r0 + np.outer(times - t, r1), np.tile(r1, (3, 1)))
    assert np.allclose((normals[2] - normals[0]) / (2 * h), rates[1], rtol=0, atol=1e-7)


def test_the_law_turns_the_tool():
    """In the run the tool follows within the error of the law, and free it does not; the summary says by how much."""
    run, free = cl.simulate(load()), cl.simulate(load(reference__orientation="free"))
    assert run.summary()["verdict"]["good"]
    assert np.max(run.tool_angle) < 1.5
    assert np.max(free.tool_angle) > 5.0
    said = run.summary()["tool"]
    assert said["max_angle"] == np.max(run.tool_angle)
    assert np.max(run.orientation_error) < 3.0
    assert free.summary()["tool"] is None
    assert np.allclose(run.contact_force[-100:], 5.0, rtol=0, atol=0.05)


@pytest.mark.parametrize("held", ["start", [np.pi, 0.0, 0.0]])
def test_a_frame_is_held(held):
    """All three axes stay those that are asked for, while the tip follows its path."""
    problem = cl.prepare(load(reference__orientation=held))
    t, q, _, axes = along(problem)
    wanted = axes[0] if held == "start" else Rotation.from_rotvec(held).as_matrix()
    assert np.max(np.abs(axes - wanted)) < 1e-9
    assert np.max(np.abs([problem.robot.position(each) for each in q] - problem.wanted.tip.sample(t)[0])) < 1e-9
    assert np.ptp(q, axis=0).max() > 0.05


def test_another_axis_of_the_tool():
    """tool.axis says which axis of the tip's frame is held."""
    frame = Rotation.from_rotvec([np.pi, 0.0, 0.0]).as_matrix()
    axis = frame.T @ np.array([0.0, 0.01, -1.0])
    problem = cl.prepare(load(tool__axis=list(axis)))
    t, _, _, axes = along(problem, 5)
    normals, _ = problem.surface.normals(t, *problem.wanted.tip.sample(t)[:2])
    assert np.allclose(axes @ axis / np.linalg.norm(axis), -normals, rtol=0, atol=1e-9)


REFUSED = {
    "too few joints": ("wam_slide", {"reference.orientation": "normal"}, "take 5 joints, and wam4 has 4"),
    "six": ("wam_slide", {"reference.orientation": "start"}, "take 6 joints, and wam4 has 4"),
    "askew": ("panda_scan", {"reference.orientation": [2.9, 0.0, 0.0]}, "degrees away from it at the start"),
    "no word": ("panda_scan", {"reference.orientation": "up"}, 'must be "free", "normal", "start"'),
    "no vector": ("panda_scan", {"reference.orientation": [0.0, 0.0, "x"]}, "rotation vector"),
    "no axis": ("panda_scan", {"tool.axis": [0.0, 0.0, 0.0]}, "has no direction"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_does_not_go_is_refused_in_one_line(case):
    """The key is named, and what would be right."""
    name, changes, words = REFUSED[case]
    with pytest.raises(cl.ClosedLoopError) as caught:
        cl.prepare(cl.load_scenario(name, changes))
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_the_refusal_of_a_start_names_one_that_goes():
    """The posture that it names is accepted, and has the tip in the same place."""
    askew = load(reference__orientation=[2.9, 0.0, 0.0])
    with pytest.raises(cl.ScenarioError) as caught:
        cl.prepare(askew)
    named = [float(x) for x in str(caught.value).rpartition("[")[2].rstrip("]").split(",")]
    problem = cl.prepare(load(reference__orientation=[2.9, 0.0, 0.0], start__q=named))
    before = cl.prepare(load(reference__orientation="free"))
    assert np.allclose(problem.robot.position(problem.q), before.robot.position(before.q), rtol=0, atol=1e-7)


def test_the_law_is_told_how_the_joints_are_to_accelerate():
    """q̈_des is the rate of a smooth q̇_des, to first order in the table's spacing, and zero where q̇_des jumps."""
    h, n = 1e-3, 2
    t = h * np.arange(1001)
    table, qdd = np.zeros((t.size, 2 * n + 14)), np.zeros(n)
    table[:, n], table[:, n + 1] = np.sin(3.0 * t), np.where(t < 0.5, 0.0, 0.02)
    for k in (100, 400, 499, 500, 900):
        plain(desired_acceleration)(t[k], h, table, qdd)
        assert qdd[0] == pytest.approx(3.0 * np.cos(3.0 * t[k]), abs=9.0 * h)
        assert qdd[1] == 0.0
    plain(desired_acceleration)(0.0, h, table, qdd)
    assert not np.any(qdd)
    table[:, n] = 1e-20 * (t - 0.3) ** 2  # rounding, whose sign says nothing
    plain(desired_acceleration)(0.3, h, table, qdd)
    assert 0.0 < abs(qdd[0]) < 1e-20


@pytest.mark.parametrize("law", ["operational_space", "dynamic_hybrid"])
def test_feed_forward_holds_the_tool(monkeypatch, law):
    """Told of q̈_des a law in tip space holds the tool ten times as close to where it is to be, with a soft posture."""
    scenario = load(law__kind=law, law__posture_stiffness=25.0, law__posture_damping=10.0)
    told, begin = cl.simulate(scenario), Problem.begin

    def without(problem, loop):
        begin(problem, loop)
        loop.state.settings.feed_forward = 0

    monkeypatch.setattr(Problem, "begin", without)
    untold = cl.simulate(scenario)
    assert told.orientation_error.max() < 0.1 * untold.orientation_error.max()
    assert told.tool_angle.max() < untold.tool_angle.max()


@pytest.mark.parametrize("seamless", [False, True])
def test_a_tool_is_held_against_a_height_field(seamless, monkeypatch):
    """The acceleration jumps at the seams of its spline: a knot is at each, or halving finds them, with far more."""
    walks, walk = [], Follower.walk
    monkeypatch.setattr(Follower, "walk", lambda who, q, *way: walks.append(len(way[0])) or walk(who, q, *way))
    if seamless:
        monkeypatch.setattr(HeightField, "seams", Surface.seams)
    problem = cl.prepare(cl.load_scenario("panda_polish", {"reference.passes": 1, "reference.stop": 3.0}))
    joints = problem.wanted.joints
    assert joints.times.size < 4000
    assert (len(walks) < 12) != seamless
    assert (sum(walks) < 4 * joints.times.size) != seamless
    times = np.linspace(0.5, 3.0, 101)
    q, (r, v, _) = joints.sample(times)[0], problem.wanted.tip.sample(times)
    normals = problem.surface.normals(times, r, v)[0]
    assert np.max(np.abs(problem.robot.tip_axes(q)[:, :, 2] + normals)) < 1e-9
    assert np.max(np.abs([problem.robot.position(each) for each in q] - r)) < 1e-9


def test_the_seams_of_a_path_are_where_it_crosses_the_grid():
    """Across lines of the grid at the instants at which its coordinate is that of a line; none along a line."""
    problem = cl.prepare(cl.load_scenario("panda_polish"))
    surface, (first, *_), lines = problem.surface, problem.wanted.tip.segments, 0.03 * np.arange(-4.0, 5.0)

    def places(segment, times):
        return (segment.sample(np.array(times))[0] - surface.origin) @ surface.frame[1:].T

    assert np.ptp(places(first, [first.start, first.stop]), axis=0) == pytest.approx([0.0, 0.08], abs=1e-12)
    on = np.abs(places(first, seams(surface, first))[:, 1, None] - lines).min(axis=1)
    assert on == pytest.approx([0.0] * 2, abs=1e-15)
    along_it = replace(first, curve=Straight(0.08 * surface.frame[1] + 0.04 * surface.frame[2]))
    on = np.abs(places(along_it, seams(surface, along_it))[..., None] - lines).min(axis=2) < 1e-12
    low, high = np.sort(places(along_it, [along_it.start, along_it.stop]), axis=0)[..., None]
    assert np.all(on.any(axis=1))
    assert on.sum(axis=0).tolist() == np.sum((lines > low + 1e-9) & (lines < high - 1e-9), axis=1).tolist()
    assert seams(None, first) == []
    moving = replace(
        surface, motion=cl.load_scenario("panda_scan", ON_A_BALL | {"surface_motion": BREATHING}).surface_motion
    )
    assert seams(moving, first) == []


@pytest.mark.parametrize("seed", range(6))
def test_rows_of_the_axis_and_of_the_frame(seed):
    """Two unit vectors across the axis, and its error a × d and the rate d × ḋ along them; ½ Σ cᵢ × dᵢ of a frame."""
    random = np.random.default_rng(seed)
    axes, wanted = (np.linalg.qr(random.normal(size=(3, 3)))[0] for _ in range(2))
    target, a = random.normal(size=12), axes[:, 2]
    w = SimpleNamespace(axes=axes, turn=np.eye(3), J=np.zeros((6, 3)), error=np.zeros(6), rate=np.full(6, 7.0))
    interpreted(_axis_rows)(w, target)
    across = w.J[3:5]
    assert within(64, across @ np.column_stack([across.T, a]), np.eye(2, 3))
    assert within(64, w.error[3:5], across @ np.cross(a, target[6:9]), 1.0)
    assert within(64, w.rate[3:5], across @ np.cross(target[6:9], target[9:12]), 1.0)
    interpreted(_frame_rows)(w, wanted)
    assert within(64, w.error[3:], 0.5 * np.sum(np.cross(axes.T, wanted.T), axis=0), 1.0)
    assert np.array_equal(w.J[3:], np.eye(3))
    assert not np.any(w.rate[3:])


def test_the_angle_between_two_frames():
    """As large as they are turned, about any axis, up to half a turn; of many at once each its own."""
    rng = np.random.default_rng(0)
    angles = np.array([0.0, 1e-6, 0.3, 1.0, 2.0, 3.0])
    axes = rng.normal(size=(angles.size, 3))
    axes /= np.linalg.norm(axes, axis=1)[:, None]
    first = Rotation.random(angles.size, rng)
    second = first * Rotation.from_rotvec(angles[:, None] * axes)
    assert np.allclose(turned_by(first.as_matrix(), second.as_matrix()), angles, rtol=1e-8, atol=1e-14)
    assert turned_by(np.eye(3), np.diag([1.0, -1.0, -1.0])) == pytest.approx(np.pi, rel=1e-7)
