"""Curved surfaces and surfaces that move: geometry against differentiation, and motions known in closed form."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.polynomial import Chebyshev
from rounding import within
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation

import closedloop as cl
from closedloop.jit.interpreted import interpreted
from closedloop.mechanics.closure.solve import solve_closure
from closedloop.mechanics.surface.along import gradients
from closedloop.mechanics.surface.geometry import Pose
from closedloop.mechanics.surface.kinds.height_field import HeightField
from closedloop.mechanics.surface.motion import MOTIONS, Move, begin_move, displace
from closedloop.mechanics.surface.placed import PlacedSurface, contact_frame, unit
from closedloop.mechanics.surface.surface import SURFACES

KINDS = {
    "plane": {},
    "sphere": {"radius": 0.4},
    "bowl": {"radius": 0.6, "inside": True},
    "cylinder": {"radius": 0.3, "axis": (0.8, 0.6, 0.0)},
    "pipe": {"radius": 0.5, "axis": (0.0, 1.0, 0.0), "inside": True},
    "ellipsoid": {"a": 0.5, "b": 0.3, "c": 0.25},
}
GRID = 0.01 * np.sin(np.add.outer(np.arange(9) * 0.9, np.arange(12) * 0.7))
KINDS["height_field"] = {"heights": tuple(map(tuple, GRID)), "spacing": 0.05}
# Its edges, too sharp for the Chebyshev polynomials of these tests, are far from their paths: see `test_polyhedron`.
KINDS["polyhedron"] = {"faces": ((1.0, 0.0, 0.5, 4.0), (-0.3, 1.0, 1.0, 5.0)), "oversize": 0.1, "rounding": 0.04}
KINDS["implicit"] = {"expression": "z*(1 + x*y) + 2*x**2 + 3*y**2*exp(x/2) - z**3"}
MOVES = {
    "none": {},
    "breathing": {"direction": (0.2, -0.3, 1.0), "amplitude": 0.05, "frequency": 0.7},
    "conveyor": {"velocity": (0.1, -0.2, 0.05)},
    "transfer": {
        "shift": (0.1, 0.2, -0.3),
        "angle": 1.4,
        "axis": (0.1, 0.3, 1.0),
        "centre": (0.1, -0.4, 0.2),
        "start": 0.0,
        "stop": 2.0,
    },
    "belt": {"velocity": (0.1, -0.2, 0.05)},
    "poses": {
        "times": (0.1, 1.1, 2.3, 3.0),
        "poses": (
            (0.0, 0.0, 0.0, 1.0, 0.2, 0.0, 0.1),
            (0.1, -0.1, 0.05, 0.8, -0.2, 0.3, 0.1),
            (0.2, 0.1, 0.1, 0.2, 0.3, 0.9, 0.1),
            (0.3, 0.0, -0.1, -0.2, 0.4, 0.8, 0.1),
        ),
    },
    "turntable": {"axis": (0.1, 0.3, 1.0), "centre": (0.1, -0.4, 0.2), "speed": 1.3},
}
NAMES = {"bowl": "sphere", "pipe": "cylinder"}
TIP = np.array([0.3, -0.2, 0.5])


def surface(kind, motion="none", tip=TIP, **more):
    """Return a surface with the tip `gap` above it, its normal upwards where nothing else is given."""
    section = SURFACES[NAMES.get(kind, kind)](**KINDS[kind] | more)
    return PlacedSurface.of(section, MOTIONS[motion](**MOVES[motion]), tip)


def path(seed):
    """Return a smooth motion of a point near the surfaces' origin: t, s, to r, ṙ and r̈."""
    random = np.random.default_rng(seed)
    c = random.uniform(-0.05, 0.05, (4, 3))

    def at(t):
        return (
            TIP + c[0] * t + c[1] * t**2 + c[2] * t**3,
            c[0] + 2 * c[1] * t + 3 * c[2] * t**2,
            2 * c[1] + 6 * c[2] * t,
        )

    return at


@settings(max_examples=12, deadline=None)
@given(st.sampled_from(sorted(KINDS)), st.sampled_from(sorted(MOVES)), st.integers(0, 99))
def test_rates_are_the_derivatives(kind, motion, seed):
    """Along a motion u is the derivative of what the surface sees, and N r̈ + turning that of u, by Chebyshev series."""
    on, at = surface(kind, motion, gap=0.02), path(seed)
    t = 0.4 + 0.1 * np.cos(np.pi * (np.arange(20) + 0.5) / 20)
    rows, gaps = [], []
    for instant in t:
        r, v, _ = at(instant)
        now = on.touching(r, v, instant)
        assert within(64, now.frame @ now.frame.T, np.eye(3))
        rows.append(now.frame @ v - now.carried)
        gaps.append(now.gap)
    r, v, a = at(0.4)
    now = on.touching(r, v, 0.4)
    slope = np.array([Chebyshev.fit(t, np.array(rows)[:, i], 19).deriv()(0.4) for i in range(3)])
    # Third derivatives of a spline jump at the lines of its grid, over which a polynomial errs: by 3e-6 in 100 paths.
    tolerance = 1e-5 if kind == "height_field" else 1e-9
    assert np.allclose(now.frame @ a + now.turning, slope, rtol=0, atol=tolerance)
    if kind not in (
        "ellipsoid",
        "height_field",
        "implicit",
        "polyhedron",
    ):  # of a φ that is no distance: to first order
        rate = Chebyshev.fit(t, gaps, 19).deriv()(0.4)
        assert now.frame[0] @ v - now.carried[0] == pytest.approx(rate, abs=1e-10)


def test_a_displacement_is_a_rotation_and_then_a_shift():
    """Place, velocity and acceleration of a surface's frame, by scipy's rotation and cross products; at first none."""
    random = np.random.default_rng(3)
    origin, axes = random.normal(size=3), Rotation.random(random_state=3).as_matrix()
    m, pose = Move(np.full(Move.count(), 7.0)), Pose(np.full(Pose.count(), 7.0))
    interpreted(begin_move)(m)
    interpreted(displace)(m, origin, axes, pose)
    assert np.array_equal(pose.origin, origin)
    assert np.array_equal(pose.axes, axes)
    assert np.array_equal(m.axis, [0.0, 0.0, 1.0])
    for part in (pose.spin, pose.spin_rate, pose.velocity, pose.acceleration, m.centre, m.shift):
        assert not np.any(part)
    m.angle, m.rate, m.acceleration = 2.3, -0.7, 1.9
    m.axis[:], m.centre[:] = unit(random.normal(size=3), "axis"), random.normal(size=3)
    m.shift[:], m.shift_rate[:], m.shift_acceleration[:] = random.normal(size=(3, 3))
    interpreted(displace)(m, origin, axes, pose)
    turn = Rotation.from_rotvec(2.3 * m.axis)
    arm, spin, spin_rate = turn.apply(origin - m.centre), -0.7 * m.axis, 1.9 * m.axis
    around = np.cross(spin_rate, arm) + np.cross(spin, np.cross(spin, arm))
    for part, wanted in (
        (pose.axes, turn.apply(axes)), (pose.origin, m.centre + arm + m.shift), (pose.spin, spin),
        (pose.spin_rate, spin_rate), (pose.velocity, np.cross(spin, arm) + m.shift_rate),
        (pose.acceleration, around + m.shift_acceleration),
    ):  # fmt: skip
        assert within(64, part, wanted, 1.0)


def test_poses_are_passed_through_and_left_at_rest():
    """Where the table says, relative to its first pose; accelerations are continuous; whole turns are kept."""
    times, rows = (np.array(MOVES["poses"][key]) for key in ("times", "poses"))
    moved = surface("plane", "poses")
    turns = Rotation.from_quat(rows[:, [4, 5, 6, 3]])
    for t, place, turn in zip(times, rows[:, :3], turns, strict=True):
        pose = moved.pose(t)
        relative = (turn * turns[0].inv()).as_matrix()
        assert within(64, pose.axes, moved.frame[[1, 2, 0]] @ relative.T)
        assert within(64, pose.origin, place + relative @ (moved.origin - rows[0, :3]))

    def accelerations(t):
        pose = moved.pose(t)
        return np.concatenate([pose.spin_rate, pose.acceleration])

    for t in (0.0, 0.1, 3.0, 9.0):
        pose = moved.pose(t)
        assert np.allclose([pose.velocity, pose.acceleration, pose.spin, pose.spin_rate], 0.0, rtol=0, atol=1e-11)
    for t in (1.1, 2.3):
        assert np.allclose(accelerations(t - 1e-9), accelerations(t + 1e-9), rtol=0, atol=1e-5)
    # about one axis it is an angle: twice over, beyond half a turn
    angle = [0.0, 2.0, 4.0, 7.0, 9.0]
    table = tuple((0.0, 0.0, 0.0, np.cos(a / 2), 0.0, np.sin(a / 2), 0.0) for a in angle)
    turned = PlacedSurface.of(SURFACES["plane"](), MOTIONS["poses"](times=(0.0, 1.0, 2.0, 3.0, 4.0), poses=table), TIP)
    end = Rotation.from_rotvec([0.0, angle[-1], 0.0]).as_matrix()
    assert turned.pose(2.5).spin[1] > 2.0
    assert within(64, turned.pose(4.0).axes, turned.frame[[1, 2, 0]] @ end.T)


def test_gradients_at_many_instants():
    """On a belt they are those at rest of the points that it carries; where φ is no number they are zero."""
    on, t = surface("ellipsoid", "conveyor"), np.array([0.0, 0.5, 2.0])
    carried = np.outer(t, MOVES["conveyor"]["velocity"])
    r = TIP + np.array([[0.1, 0.0, 0.0], [0.0, -0.1, 0.05], [0.02, 0.03, 0.0]])
    at_rest = gradients(on, np.zeros(3), r)
    assert within(64, gradients(on, t, r + carried), at_rest, 1.0)
    assert np.min(np.ptp(at_rest, axis=0)) > 1e-2
    half = surface("implicit", expression="z + log(1 + 10*x)")
    ahead, behind = gradients(half, np.zeros(2), half.origin + np.array([[0.1, 0.2, 0.0], [-0.2, 0.0, 0.0]]))
    assert within(64, ahead, [5.0, 0.0, 1.0])
    assert np.array_equal(behind, np.zeros(3))


@pytest.mark.parametrize("kind", KINDS)
def test_the_surface_is_below_the_tip(kind):
    """It lies `gap` below the tip at the start, with the normal that is asked for, and tangents as a plane's."""
    normal = unit((0.2, -0.1, 1.0), "n")
    more = {"axis": tuple(np.cross(normal, (0.0, 1.0, 0.0)))} if kind in ("cylinder", "pipe") else {}
    on = surface(kind, normal=tuple(normal), gap=0.03, **more)
    foot = on.touching(TIP - 0.03 * normal)
    assert foot.gap == pytest.approx(0.0, abs=1e-15)
    if kind != "height_field":  # in its middle it may be inclined
        assert within(64, foot.frame, contact_frame(normal))
    if kind not in ("ellipsoid", "height_field", "implicit"):
        assert within(16, on.touching(TIP).gap, 0.03, TIP)


def point_mass(**changes):
    """Return the scenario of a point mass of three slides, with nothing that drives it."""
    return cl.load_scenario("wam_slide", {
        "robot.model": "pointmass3", "robot.tip": "tip", "start.q": [0.0, 0.0, 0.0], "start.v": [0.0, 0.0, 0.0],
        "reference": {"kind": "hold"}, "law": {"kind": "paper", "kp": 0.0, "kd": 0.0, "force": 0.0},
        "stabiliser": {"kind": "none"}, "time.integrator": "rk4", "time.duration": 1.0,
    } | {key.replace("__", "."): value for key, value in changes.items()})  # fmt: skip


def no_torque(t, q, v, terms):
    """Leave the mass to gravity and the surface."""
    return np.zeros(len(q))


def lift(t, q, v, terms):
    """Carry the weight, and nothing else."""
    return terms.bias


def test_a_particle_leaves_a_sphere_at_two_thirds():
    """Released near the top of a smooth sphere it leaves at cos θ = 2/3 of its height there (with f = 0 there)."""
    radius, tilt = 0.5, 0.1
    g = 9.81
    run = cl.simulate(
        point_mass(surface__kind="sphere", surface__radius=radius, surface__contact="unilateral",
                   surface__normal=[math.sin(tilt), 0.0, math.cos(tilt)], time__step=0.0005,
                   time__duration=1.0),
        law=no_torque,
    )  # fmt: skip
    (off,) = [event for event in run.events if event.kind == "liftoff"]
    centre = run.position[0] - radius * np.array([math.sin(tilt), 0.0, math.cos(tilt)])
    cosine = (off.position - centre)[2] / radius
    assert cosine == pytest.approx(2.0 / 3.0 * math.cos(tilt), abs=1e-10)
    on = run.time < off.time
    speed2 = np.sum(run.velocity[on] ** 2, axis=1)
    height = (run.position[on] - centre)[:, 2]
    gravity = abs(float(cl.prepare(run.scenario).robot.gravity[2]))
    assert gravity == pytest.approx(g, abs=0.01)
    assert np.allclose(speed2, 2 * gravity * radius * (math.cos(tilt) - height / radius), rtol=0, atol=1e-10)
    mass = float(cl.prepare(run.scenario).robot.terms(run.q[0], run.v[0]).mass_matrix[0, 0])
    assert np.allclose(run.contact_force[on], mass * (gravity * height / radius - speed2 / radius), rtol=0, atol=1e-10)


@pytest.mark.parametrize(("kind", "rate"), [("sphere", 0.4), ("cylinder", 0.3)])
def test_a_free_point_moves_on_a_geodesic(kind, rate):
    """With its weight carried it keeps its speed, and its acceleration is along the normal: v²/R of a sphere."""
    velocity = [0.18, 0.24, 0.0]
    run = cl.simulate(point_mass(**{f"surface__{k}": v for k, v in {"kind": kind, **KINDS[kind]}.items()},
                                 start__v=velocity, time__duration=2.0), law=lift)  # fmt: skip
    assert np.allclose(np.linalg.norm(run.velocity, axis=1), 0.3, rtol=0, atol=1e-14)
    assert np.max(np.abs(run.closure_error)) < 1e-10
    along = run.acceleration - np.sum(run.acceleration * run.surface_normal, axis=1)[:, None] * run.surface_normal
    assert np.max(np.abs(along)) < 1e-10
    if kind == "sphere":
        angle = 0.3 * run.time / 0.4
        start, ahead = np.array([0.0, 0.0, 0.4]), np.array([0.6, 0.8, 0.0]) * 0.4
        circle = np.cos(angle)[:, None] * start + np.sin(angle)[:, None] * ahead
        assert within(512, run.position - run.position[0] + start, circle)


def test_a_large_sphere_is_a_plane():
    """Its force differs from the plane's in proportion to its curvature; of a radius of 10⁶ m by rounding."""
    plane = cl.simulate(cl.load_scenario("wam_slide", {"time.duration": 1.5}))
    off = []
    for radius in (1.0, 10.0, 1e6):
        changes = {"surface.kind": "sphere", "surface.radius": radius, "time.duration": 1.5}
        run = cl.simulate(cl.load_scenario("wam_slide", changes))
        off.append(np.max(np.abs(run.contact_force - plane.contact_force)))
    assert off[0] / off[1] == pytest.approx(10.0, rel=0.01)
    assert off[2] < 5e-9


@pytest.mark.parametrize("motion", ["none", "breathing", "turntable"])
@pytest.mark.parametrize("kind", ["sphere", "pipe", "ellipsoid"])
@pytest.mark.parametrize("engine", ["pinocchio", "compiled"])
def test_rows_solve_the_constraint(kind, motion, engine):
    """Of recorded rows q̈ and f are those of Eq. 24, solved with what the surface says at their q and q̇."""
    moves = {f"surface_motion.{key}": value for key, value in {"kind": motion, **MOVES[motion]}.items()}
    if motion == "breathing":
        moves["surface_motion.frequency"] = 0.2
    if motion == "turntable":
        moves |= {"surface_motion.axis": [0, 0, 1], "surface_motion.speed": 0.01}
    shape = {f"surface.{key}": value for key, value in {"kind": NAMES.get(kind, kind), **KINDS[kind]}.items()}
    run = cl.simulate(cl.load_scenario("wam_slide", shape | moves | {"time.duration": 1.0}), engine=engine)
    problem = cl.prepare(run.scenario)
    s_v, s_p = problem.stabiliser
    for k in (1, 400, 501, 700, 1000):
        terms = problem.robot.terms(run.q[k], run.v[k])
        now = problem.surface.touching(terms.position, terms.jacobian @ run.v[k], run.time[k])
        A = now.frame[0] @ terms.jacobian
        rate = A @ run.v[k] - now.carried[0]
        assert (now.gap, rate) == pytest.approx((run.closure_error[k], run.closure_rate[k]), abs=1e-12)
        b = -s_v * rate - s_p * now.gap - now.frame[0] @ terms.drift - now.turning[0]
        qdd, f = solve_closure(terms.mass_matrix, run.torque[k] - terms.bias, A, b)
        assert f == pytest.approx(run.contact_force[k], abs=1e-8)
        assert np.allclose(qdd, run.acceleration[k], rtol=0, atol=1e-8)


def test_energy_is_accounted_for_with_an_order():
    """Work of a surface that breathes included: the energy that is missing falls with the fourth power of h."""
    left = []
    for step in (0.002, 0.001):
        run = cl.simulate(cl.load_scenario("wam_slide", {
            "surface.kind": "sphere", "surface.radius": 0.4, "surface_motion.kind": "breathing",
            "surface_motion.frequency": 1.0, "surface_motion.direction": [0.3, 0.2, 1.0], "time.integrator": "rk4",
            "time.step": step, "time.duration": 2.0, "stabiliser.time_constant": 0.02,
            "reference": {"kind": "hold"}, "law.pd_start": 0.0,
        }))  # fmt: skip
        left.append(run.summary()["max_energy_residual"])
        assert run.summary()["energy_exchanged"] > 1e-3
    assert left[0] / left[1] > 10.0
    assert left[1] < 1e-8


@pytest.mark.parametrize("motion", ["conveyor", "belt"])
def test_a_belt_carries_what_lies_on_it(motion):
    """It accelerates with μ g until it moves with the belt, and stays where it stuck on it."""
    mu, speed = 0.2, 0.3
    scenario = point_mass(
        surface_motion={"kind": motion, "velocity": [speed, 0.0, 0.0]}, surface__contact="unilateral",
        friction={"kind": "coulomb", "coefficient": mu}, time__duration=0.5,
    )  # fmt: skip
    run = cl.simulate(scenario, law=no_torque)
    g = abs(float(cl.prepare(scenario).robot.gravity[2]))
    (stuck,) = [event for event in run.events if event.kind == "stick"]
    assert stuck.time == pytest.approx(speed / (mu * g), rel=1e-9)
    slides = run.time < stuck.time
    assert np.allclose(run.velocity[slides, 0], mu * g * run.time[slides], rtol=0, atol=1e-9)
    assert np.allclose(run.velocity[~slides, 0], speed, rtol=0, atol=1e-9)
    assert np.max(np.linalg.norm(run.slip_velocity[~slides], axis=1)) < 1e-9
    lost = run.summary()["energy_lost_to_friction"]
    mass = float(cl.prepare(scenario).robot.terms(run.q[0], run.v[0]).mass_matrix[0, 0])
    assert lost == pytest.approx(0.5 * mass * speed**2, rel=1e-3)  # the trapezoidal rule over the rows
    assert run.summary()["max_energy_residual"] < 1e-9


@pytest.mark.parametrize("engine", ["pinocchio", "compiled"])
def test_a_belt_runs_over_a_surface_that_stays(engine):
    """On a ball it drags with μ f along its projection, and leaves normal, gap and a smooth tip as they are at rest."""
    mu, flow = 0.3, np.array([0.05, 0.2, 0.1])
    ball = {"surface.kind": "sphere", "surface.radius": 0.3, "time.duration": 0.6, "reference.start": 0.0}
    belt = ball | {"surface_motion": {"kind": "belt", "velocity": flow.tolist()}}
    rough = {"friction": {"kind": "coulomb", "coefficient": mu}}
    still, smooth, dragged = (
        cl.simulate(cl.load_scenario("wam_slide", changes), engine=engine) for changes in (ball, belt, belt | rough)
    )
    assert np.allclose(smooth.contact_force, still.contact_force, rtol=0, atol=1e-9)
    assert np.allclose(smooth.reference_tip, still.reference_tip, rtol=0, atol=1e-12)
    n = dragged.surface_normal
    centre = dragged.position - 0.3 * n
    assert np.allclose(centre, centre[0], rtol=0, atol=1e-7)
    slip = dragged.velocity - flow
    slip -= np.sum(slip * n, axis=1)[:, None] * n
    assert np.allclose(dragged.slip_velocity, slip, rtol=0, atol=1e-7)
    against = -mu * dragged.contact_force[:, None] * slip / np.linalg.norm(slip, axis=1)[:, None]
    assert np.allclose(dragged.friction_force, against, rtol=0, atol=1e-5)
    assert np.min(np.sum(dragged.friction_force * flow, axis=1)) > 0.0


def test_a_tip_that_sticks_to_a_belt_stays_on_it():
    """On a plane its way is the belt's, with every scheme and a stabiliser."""
    for integrator in ("semi_implicit_euler", "rk4"):
        run = cl.simulate(
            point_mass(
                surface_motion={"kind": "belt", "velocity": [0.2, 0.1, 0.0]}, surface__contact="unilateral",
                friction={"kind": "coulomb", "coefficient": 0.5}, start__v=[0.2, 0.1, 0.0], time__integrator=integrator,
                stabiliser={"kind": "baumgarte"},
            ), law=no_torque,
        )  # fmt: skip
        assert np.all(run.mode == 2)
        assert np.allclose(run.position - run.position[0], np.outer(run.time, [0.2, 0.1, 0.0]), rtol=0, atol=1e-9)


def test_a_mass_on_a_turntable_goes_round():
    """Stuck with friction enough, it goes round with the disc; friction is the centripetal force."""
    rate, radius = 2.0, 0.3
    scenario = point_mass(
        surface_motion={"kind": "turntable", "speed": rate, "centre": [-radius, 0.0, 0.0]},
        friction={"kind": "coulomb", "coefficient": 0.5}, start__v=[0.0, rate * radius, 0.0],
        surface__contact="unilateral", time__duration=1.0, time__step=0.0005,
    )  # fmt: skip
    run = cl.simulate(scenario, law=no_torque)
    assert np.all(run.mode == 2)
    centre = run.position[0] - [radius, 0.0, 0.0]
    angle = rate * run.time
    circle = centre + radius * np.column_stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)])
    assert np.allclose(run.position, circle, rtol=0, atol=1e-12)
    mass = float(cl.prepare(scenario).robot.terms(run.q[0], run.v[0]).mass_matrix[0, 0])
    assert np.allclose(np.linalg.norm(run.friction_force, axis=1), mass * rate**2 * radius, rtol=0, atol=1e-12)


def test_a_ball_bounces_off_a_table_that_comes_up():
    """The impact is relative to the table: it leaves with e times the speed of approach, and takes energy from it."""
    up, e, gap = 0.4, 0.7, 0.05
    scenario = point_mass(
        surface_motion={"kind": "conveyor", "velocity": [0.0, 0.0, up]}, surface__contact="unilateral",
        surface__gap=gap, impact={"restitution": e}, time__duration=0.2,
    )  # fmt: skip
    run = cl.simulate(scenario, law=no_torque)
    g = abs(float(cl.prepare(scenario).robot.gravity[2]))
    hit = (-up + math.sqrt(up**2 + 2 * g * gap)) / g
    first = run.events[0]
    assert first.kind == "impact"
    assert first.time == pytest.approx(hit, abs=1e-10)
    assert first.rate_before == pytest.approx(-(g * hit + up), abs=1e-9)
    assert first.rate_after == pytest.approx(e * (g * hit + up), abs=1e-9)
    assert run.summary()["max_energy_residual"] < 1e-9


def test_line_on_a_sphere_is_a_great_circle():
    """A path is laid onto the surface: its points are on it, with its velocity and acceleration."""
    scenario = cl.load_scenario("wam_slide", {"surface.kind": "sphere", "surface.radius": 0.3})
    problem = cl.prepare(scenario)
    t = np.linspace(0.0, 8.0, 33)
    r, v, a = problem.wanted.tip.sample(t)
    centre = problem.surface.origin - [0.0, 0.0, 0.3]
    assert np.allclose(np.linalg.norm(r - centre, axis=1), 0.3, rtol=0, atol=1e-14)
    assert np.allclose((r - centre)[:, 0], 0.0, atol=1e-15)
    assert np.allclose(np.sum((r - centre) * v, axis=1), 0.0, atol=1e-15)
    assert np.allclose(np.sum((r - centre) * a + v * v, axis=1), 0.0, atol=1e-15)
    assert np.ptp(r[:, 1]) == pytest.approx(0.06, abs=1e-12)


def test_a_height_field_is_scipys_spline():
    """φ is z less the spline through the heights, mirrored at the edge; ∇φ and ∇∇φ are its derivatives."""
    section = HeightField(heights=tuple(map(tuple, GRID)), spacing=0.05)
    par = SimpleNamespace(heights=np.array(section.resolved()["heights"]), spacing=0.05)
    half = 0.5 * 0.05 * (np.array(GRID.shape[::-1]) - 1.0)

    def at(p):
        gradient, hessian = np.zeros(3), np.zeros((3, 3))
        return interpreted(HeightField.level)(np.array(p), par, gradient, hessian), gradient, hessian

    def scipys(x, y):
        place = [[4.0 + y / 0.05, 4.0], [5.5 + x / 0.05, 5.5]]  # there, and in the middle
        return -np.diff(map_coordinates(GRID, place, order=3, mode="mirror"))[0]

    random, step = np.random.default_rng(0), 1e-6
    for x, y in [*random.uniform(-half, half, (12, 2)), -half, half, (half[0], -half[1])]:
        level, gradient, hessian = at((x, y, 0.3))
        assert within(64, level, 0.3 - scipys(x, y))
        assert gradient[2] == 1.0
        assert np.array_equal(hessian, hessian.T)
        if np.all(np.abs([x, y]) < half - step):
            ends = [[at((x + s * dx, y + s * dy, 0.3)) for s in (step, -step)] for dx, dy in ((1, 0), (0, 1))]
            for i, (ahead, behind) in enumerate(ends):
                assert (ahead[0] - behind[0]) / (2.0 * step) == pytest.approx(gradient[i], abs=1e-8)
                assert (ahead[1] - behind[1]) / (2.0 * step) == pytest.approx(hessian[i], abs=1e-6)
        beyond = at(np.array([3.0 * x, 3.0 * y, 0.3]))[0]
        assert beyond == at((*np.clip([3.0 * x, 3.0 * y], -half, half), 0.3))[0]


def _height(on, x, y):
    """Return z of the surface at x and y from its origin, m."""
    r = on.origin + np.array([x, y, 0.0])
    return r[2] - on.touching(r).level


@pytest.mark.slow
def test_contact_begins_on_a_ball_that_moves(tmp_path):
    """Approach, impact, slide on a breathing ball with friction: the integrators agree, and the file repeats it."""
    changes = {
        "surface.kind": "sphere", "surface.radius": 0.25, "surface.contact": "unilateral", "surface.gap": 0.01,
        "surface_motion.kind": "breathing", "surface_motion.amplitude": 0.004, "law.kind": "hybrid",
        "friction.kind": "coulomb", "friction.coefficient": 0.2, "time.duration": 1.2, "law.kp": 400.0, "law.kd": 40.0,
        "reference.timing": "minimum_jerk",
    }  # fmt: skip
    run = cl.simulate(cl.load_scenario("wam_slide", changes | {"time.integrator": "dop853", "time.step": 0.002}))
    fine = cl.simulate(cl.load_scenario("wam_slide", changes | {"time.integrator": "rk4", "time.step": 0.00025}))
    kinds = [event.kind for event in run.events]
    assert kinds[0] in ("impact", "touchdown")
    assert kinds == [event.kind for event in fine.events]
    assert np.max(np.abs(run.position - fine.position[::8])) < 1e-7
    in_contact = run.mode != 0
    assert np.max(np.abs(np.sum(run.slip_velocity * run.surface_normal, axis=1))) < 1e-12
    centre = cl.prepare(run.scenario).surface.origin - [0.0, 0.0, 0.25]
    lifted = 0.002 * (1 - np.cos(2 * np.pi * 0.25 * run.time))
    away = np.linalg.norm(run.position - centre - np.outer(lifted, [0, 0, 1.0]), axis=1) - 0.25
    assert np.allclose(away, run.closure_error, rtol=0, atol=1e-12)
    assert np.max(np.abs(away[in_contact])) < 1e-7
    run.save(tmp_path / "run.nc")
    again = cl.load_run(tmp_path / "run.nc")
    assert np.array_equal(cl.simulate(again.scenario, model=again.model).contact_force, run.contact_force)
