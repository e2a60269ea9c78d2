"""Round shapes that touch: the rows of their contacts by differences, and rolling in closed form."""

import numpy as np
import pytest
from free_bodies import energy

import closedloop as cl
import robot_models
from closedloop.jit.interpreted import interpreted
from closedloop.loop.step.contact_rows import locate_points
from closedloop.mechanics.closure.contact_force import PRESSED
from closedloop.mechanics.robot.pinocchio import Robot
from closedloop.record.columns.touching import contact_torques
from closedloop.simulation.prepare import prepare

FAR = {"kind": "plane", "offset": "start", "gap": 50.0, "contact": "unilateral"}
# Half axes at right angles that are not those of the link.
TURNED = np.linalg.qr(np.array([[1.0, 2.0, 3.0], [-1.0, 2.0, 0.5], [0.3, 0.2, 1.0]]))[0]
ELLIPSOID = (TURNED * [[0.05], [0.03], [0.08]]).tolist()
SHAPES = {
    "ball": {"radius": 0.05},
    "ellipsoid": {"half_axes": ELLIPSOID},
    "disc": {"half_axes": ELLIPSOID[:2]},
    "torus": {"half_axes": ELLIPSOID[:2], "radius": 0.02},
}
SURFACES = {
    "bowl": {"surface": {"kind": "sphere", "radius": 4.0, "inside": True}, "through": [0.1, 0.2, -2.0]},
    "ellipsoid below": {"surface": {"kind": "ellipsoid"}, "through": [0.1, 0.2, -2.0]},
    "cylinder that turns": {
        "surface": {"kind": "cylinder", "radius": 0.4, "axis": [1.01, 0.02, -0.2]},
        "motion": {"kind": "turntable", "speed": 3.0},
        "through": [0.1, 0.2, -2.0],
    },
}


def located(contact, q, v, t, name="wam_slide"):
    """Return gap, u, u̇ at q̈ = 0, G and what u has beside G q̇ of a contact of an arm, at a state and an instant."""
    changes = {"surface": FAR, "contact": [contact], "law.force": 0.0, "reference.kind": "hold", "start.v": None}
    changes["time.integrator"] = "rk4"
    problem = prepare(cl.load_scenario(name, changes))
    loop = problem.loop()
    problem.connect(loop, compiled=False)
    links, c = loop.w.kept["contacts"]
    loop.w.q[:], loop.w.v[:], loop.w.time, c.mode[1] = q, v, t, PRESSED
    assert interpreted(locate_points)(links, c, loop.w, loop.constants, loop.state) == 0
    return [np.array(x[3:6]) for x in (c.located, c.u, c.drift, c.G, c.carried)]


@pytest.mark.parametrize("against", ["world", "link2"])
@pytest.mark.parametrize("kind", [*SHAPES, *SURFACES])
def test_rows_of_a_round_shape_are_the_rates_of_its_gap(kind, against):
    """The gap's derivative is u_n, u is G q̇ − carried, and u's derivative at constant q̇ is the drift."""
    rng = np.random.default_rng([*SHAPES, *SURFACES].index(kind))
    contact = {"link": "tip", "at": [0.01, -0.02, 0.03], "normal": [0.2, -0.1, 1.0], "through": [0.0, 0.0, -2.0]}
    contact |= SHAPES[kind] if kind in SHAPES else {"radius": 0.05} | SURFACES[kind]
    contact["against"] = against
    for _ in range(2):
        q, v, t, h = rng.uniform(-1.2, 1.2, 4), rng.normal(size=4), 0.3, 1e-4
        _, u, drift, G, carried = located(contact, q, v, t)
        before, after = (located(contact, q + k * h * v, v, t + k * h) for k in (-1, 1))
        np.testing.assert_allclose(u, G @ v - carried, atol=1e-13)
        np.testing.assert_allclose((after[0][0] - before[0][0]) / (2 * h), u[0], atol=1e-6)
        np.testing.assert_allclose((after[1] - before[1]) / (2 * h), drift, atol=2e-5 * (1 + np.abs(drift).max()))


G = 9.81
BODY = '<mujoco><worldbody><body name="body"><freejoint/>{inside}</body></worldbody></mujoco>'
BALL = '<geom type="sphere" size="0.1" mass="2"/>'


def rolled(tmp_path, inside, contacts, q, v, duration, **changes):
    """Return the run of a free body with these contacts."""
    (tmp_path / "body.xml").write_text(BODY.format(inside=inside))
    text = '[robot]\nmodel = "body.xml"\n[stabiliser]\ntime_constant = 0.01\n'
    text += f'[time]\nduration = {duration}\nstep = 0.001\nintegrator = "rk4"\n'
    text += f"[start]\nq = {list(map(float, q))}\nv = {list(map(float, v))}\n"
    for contact in contacts:
        text += "[[contact]]\n" + "".join(f"{key} = {value!r}\n".replace("'", '"') for key, value in contact.items())
    (tmp_path / "scenario.toml").write_text(text)
    return cl.simulate(cl.load_scenario(tmp_path / "scenario.toml", changes), progress=False)


def on_an_incline(tmp_path, slope, mu, duration):
    """Return the run of a ball let go on an incline."""
    gravity = [G * np.sin(slope), 0.0, -G * np.cos(slope)]
    contact = {"link": "body", "at": "collision", "friction": mu}
    return rolled(tmp_path, BALL, [contact], [0, 0, 0.1, 1, 0, 0, 0], [0] * 6, duration, **{"robot.gravity": gravity})


@pytest.mark.parametrize("share", [0.99, 1.01])
def test_a_ball_slips_beyond_seven_halves_of_the_friction(tmp_path, share):
    """From tan θ = 7/2 μ on."""
    run = on_an_incline(tmp_path, np.arctan(0.35 * share), 0.1, 0.005)
    assert np.all(run.link_modes == (1 if share > 1.0 else 2))


@pytest.mark.parametrize("share", [0.98, 1.5])
def test_a_ball_rolls_down_an_incline_and_slips_where_it_is_steep(tmp_path, share):
    """5/7 g sin θ without slip up to tan θ = 7/2 μ, and g (sin θ − μ cos θ) beyond."""
    mu = 0.1
    slope = np.arctan(3.5 * mu * share)
    run = on_an_incline(tmp_path, slope, mu, 0.2)
    slips = share > 1.0
    wanted = G * (np.sin(slope) - mu * np.cos(slope)) if slips else 5 / 7 * G * np.sin(slope)
    np.testing.assert_allclose(run.v[:, 0], wanted * run.time, atol=1e-12)
    assert np.all(run.link_modes == (1 if slips else 2))
    if not slips:
        np.testing.assert_allclose(0.1 * run.v[:, 4], run.v[:, 0], atol=1e-12)
        assert np.ptp(energy(run)) < 1e-12
    assert run.summary()["verdict"]["good"]


def test_a_ball_on_a_turntable_moves_on_a_circle_at_two_sevenths_of_its_rate():
    """Whatever disc carries it: the closed form of a solid ball that does not slip."""
    run = cl.simulate(cl.load_scenario("ball_on_turntable", {"time.duration": 0.5}), progress=False)
    rate = 2 / 7 * 2 * np.pi
    centre = np.array([0.2 - 0.2 / rate, 0.0])
    turned = centre + 0.2 / rate * np.stack([np.cos(rate * run.time), np.sin(rate * run.time)], axis=1)
    np.testing.assert_allclose(run.q[:, :2], turned, atol=1e-10)
    assert np.all(run.link_modes == 2)


def test_a_cylinder_rolls_down_an_incline_on_its_rims(tmp_path):
    """2/3 g sin θ: a solid cylinder on its side, by the edges of its two ends."""
    cylinder = '<geom type="cylinder" size="0.1 0.05" mass="2" euler="90 0 0"/>'
    gravity = [G * np.sin(0.2), 0.0, -G * np.cos(0.2)]
    contact = {"link": "body", "at": "collision", "friction": 0.5}
    start = [0, 0, 0.1, np.cos(0.4), 0, np.sin(0.4), 0]  # none of the feet is below
    run = rolled(tmp_path, cylinder, [contact], start, [0] * 6, 0.1, **{"robot.gravity": gravity})
    np.testing.assert_allclose(run.v[:, 0], 2 / 3 * G * np.sin(0.2) * run.time, atol=1e-10)
    np.testing.assert_allclose(run.v[:, 4], run.v[:, 0] / 0.1, atol=1e-9)


def test_a_disc_that_wobbles_keeps_its_energy(tmp_path):
    """An edge that rolls does no work, however fast the contact wanders; nor does it leave the floor."""
    disc = '<inertial mass="1" pos="0 0 0" diaginertia="0.0025 0.0025 0.005"/>'
    contact = {"link": "body", "half_axes": [[0.1, 0, 0], [0, 0.1, 0]], "friction": 2.0}
    tilt = 0.4
    q = [0, 0, 0.1 * np.sin(tilt), np.cos(tilt / 2), np.sin(tilt / 2), 0, 0]
    # a turn about the contact: the lowest point is at −y of the body
    spin, reach = np.array([0.0, 6.0, 1.0]), np.array([0.0, -0.1, 0.0])
    turn = np.array([[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]])
    run = rolled(tmp_path, disc, [contact], q, [*(-turn @ np.cross(spin, reach)), *spin], 0.4)
    assert np.all(run.link_modes == 2)
    assert np.ptp(energy(run)) < 5e-5 * run.kinetic_energy[0]  # of the step: 2e-5
    assert np.max(np.abs(run.link_gaps)) < 1e-7
    assert np.ptp(run.q[:, 2]) > 1e-3


# Two rods, long enough to cross in any posture.
CROSSING = {
    "at": [0.03, -0.02, 0.2], "through": [0.0, 0.1, 0.05], "radius": 0.01,
    "edge": {"half": [6.0, 2.0, 4.0], "onto": [[4.0, -6.0, 2.0]], "onto_radius": 0.02},
}  # fmt: skip


# A hand is turned in its joint, the links of wam4 are not.
HELD = {"tip on link2": "wam_slide", "panda_link4 on panda_hand": "panda_slide"}
PLACED = [
    (where, kind) for where in HELD for kind in ("plane", "ball", "torus", "ellipsoid below", "cylinder that turns")
]


@pytest.mark.parametrize(("where", "kind"), [*PLACED, ("panda_link4 on panda_hand", "rods")])
def test_force_at_the_contact_has_the_rows_of_the_run_as_torques(where, kind):
    """The torques of unit forces where the record puts the contact are the rows G."""
    (link, against), name, t = where.split(" on "), HELD[where], 0.2
    model = robot_models.load(cl.load_scenario(name).robot.model)
    q = np.array([0.3, 0.5, -0.4, 0.8, 0.2, 1.1, -0.6])[: model.n]
    contact = {"at": [0.01, -0.02, 0.03], "normal": [0.2, -0.1, 1.0], "through": [0.0, 0.0, -2.0]}
    contact |= SHAPES.get(kind, {}) | ({"radius": 0.05} | SURFACES[kind] if kind in SURFACES else {})
    contact |= {"link": link, "against": against} | (CROSSING if kind == "rods" else {})
    G = located(contact, q, np.zeros(model.n), t, name)[3]
    scenario = cl.load_scenario(name, {"contact": [contact]})
    forces, frictions = np.array([[1.0], [0.0], [0.0]]), np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    states = np.full(3, t), np.tile(q, (3, 1))
    torques = contact_torques(scenario, model.pinocchio_model(), *states, forces, frictions)
    # Along tangents that do not turn with the surface; the rows' own do.
    turn = torques[1:] @ np.linalg.pinv(G[1:]) if "turns" in kind else np.eye(2)
    np.testing.assert_allclose(turn @ turn.T, np.eye(2), atol=1e-12)
    np.testing.assert_allclose(torques, [G[0], *(turn @ G[1:])], atol=1e-12 if "turns" in kind else 1e-13)


def test_a_ball_that_rolls_is_not_projected_to_where_it_stuck():
    """On a turntable it rolls with a projection as it does with a stabiliser: what rolls wanders over its surface."""
    ends = []
    for kind in ("baumgarte", "projection"):
        changes = {"time.duration": 0.02, "stabiliser.kind": kind}
        ends.append(cl.simulate(cl.load_scenario("ball_on_turntable", changes), progress=False).q[-1])
    np.testing.assert_allclose(ends[1], ends[0], atol=1e-9)


CAN = {"shape": "cylinder", "radius": 0.04, "length": 0.1, "mass": 1.0}
FIXED_1_MS, OWN = {"step": 1e-3}, {"step": 1e-2, "integrator": "dop853"}


def stood(tilt, about=0.0, gap=1e-3, friction=0.0, slope=0.0, duration=0.4, body=CAN, contact=(), **time):
    """Return the run of a can let go above the floor: its tilt is about, or the slope along, an axis at that angle."""
    half, c, s = 0.5 * tilt, np.cos(about), np.sin(about)
    height = 0.5 * body["length"] * np.cos(tilt) + body["radius"] * np.sin(tilt) + gap
    turn = [np.cos(half), c * np.sin(half), s * np.sin(half), 0.0]
    scenario = {
        "robot": {"model": "none", "gravity": [c * G * np.sin(slope), s * G * np.sin(slope), -G * np.cos(slope)]},
        "body": [body | {"name": "can", "position": [0, 0, height], "quaternion": turn}],
        "contact": [{"link": "can", "at": "collision", "friction": friction} | dict(contact)],
        "stabiliser": {"kind": "baumgarte", "time_constant": 0.01},
        "time": {"duration": duration, "integrator": "rk4"} | time,
    }
    return cl.simulate(cl.Scenario.model_validate(scenario), progress=False)


SETTLING = [
    (0.05, 0.0, FIXED_1_MS), (0.3, 0.3, FIXED_1_MS), (0.02, 0.3, {"step": 2e-4}), (0.05, 0.0, OWN),
    (0.1, 0.0, {"step": 1e-3, "integrator": "semi_implicit_euler"}),
]  # fmt: skip


@pytest.mark.parametrize(("tilt", "friction", "time"), SETTLING)
def test_a_can_that_settles_on_its_end_never_gains_energy(tilt, friction, time):
    """Its lowest point jumps to the other side as the tilt passes zero: it lands on its end, and stands on its feet."""
    run = stood(tilt, friction=friction, **time)
    E = energy(run)
    assert np.max(E - np.minimum.accumulate(E)) < 1e-6 * E[0]
    np.testing.assert_allclose(E[-1], 0.05 * G, atol=1e-9)
    np.testing.assert_allclose(run.link_forces[-1], [0, 0, *[G / 3] * 3, 0, 0, 0], atol=1e-6)
    assert run.summary()["verdict"]["good"]


@pytest.mark.parametrize("about", [0.0, np.pi / 3, 0.7])
@pytest.mark.parametrize("share", [0.97, 1.03])
def test_a_can_tips_over_the_edge_of_its_end_and_not_over_its_feet(about, share):
    """On a slope with tan θ = R/(L/2), in whatever direction from the feet: less and it stands, more and it tips."""
    slope = np.arctan(share * 0.8)
    run = stood(0.0, about, gap=0.0, friction=2.0, slope=slope, duration=0.05, step=1e-3)
    assert (np.max(np.abs(run.v[-1, 3:])) > 1e-2) == (share > 1.0)


@pytest.mark.parametrize(("spin", "speed"), [(0.0, 0.0), (400.0, 0.0), (0.0, 50.0)])
def test_a_step_of_a_fast_car_costs_what_that_of_one_that_stands_does(tmp_path, monkeypatch, spin, speed):
    """Rk4 needs four evaluations a step and one more for the row, however fast wheels slip or the car slides."""
    inertia, evaluations = 'mass="0.5" diaginertia="0.0013 0.0025 0.0013"', [0]
    (tmp_path / "car.xml").write_text(
        '<mujoco model="car"><worldbody><body name="car" pos="0 0 0.1"><freejoint name="car"/>'
        '<inertial pos="0 0 0.05" mass="10" diaginertia="0.2 0.4 0.5"/>'
        + "".join(
            f'<body name="{name}" pos="{x} {y} 0"><joint name="{name}_spin" type="hinge" axis="0 1 0"/>'
            f'<inertial pos="0 0 0" {inertia}/></body>'
            for name, x, y in (("rl", -0.25, 0.2), ("rr", -0.25, -0.2), ("fl", 0.25, 0.2), ("fr", 0.25, -0.2))
        )
        + "</body></worldbody></mujoco>"
    )
    rim = {"friction": 0.05, "half_axes": [[0.1, 0.0, 0.0], [0.0, 0.0, 0.1]]}
    scenario = {
        "robot": {"model": str(tmp_path / "car.xml")},
        "contact": [{"name": name, "link": name, **rim} for name in ("rl", "rr", "fl", "fr")],
        "start": {"v": [speed] + [0.0] * 5 + [spin] * 4},  # the tip, which touches nothing, is on the last
        "time": {"duration": 0.03, "step": 0.001, "integrator": "rk4"},
    }
    passes = Robot.passes.fget

    def counted(robot):
        crba, *others = passes(robot)

        def once(*arguments):
            evaluations[0] += 1
            return crba(*arguments)

        return once, *others

    monkeypatch.setattr(Robot, "passes", property(counted))
    run = cl.simulate(cl.Scenario.model_validate(scenario), engine="pinocchio")
    assert len(run) == 31
    assert evaluations[0] < 6 * 30
    pushes = np.sign(0.1 * spin - speed)  # all wheels, with their friction
    assert run.v[-1, 0] - speed == pytest.approx(0.03 * 0.05 * G * pushes, rel=1e-9)


@pytest.mark.slow
def test_a_rolling_can_that_slips_again_takes_the_direction_of_what_pulls_it():
    """The point of a rim that rolls turns what pulls it, faster than a slip that has just begun grows.

    Friction against the direction of the break-away let the slip go aside, and an adaptive integrator stopped there.
    """
    can = {
        "name": "can",
        "shape": "cylinder",
        "radius": 0.046900057152472724,
        "length": 0.012939497257671628,
        "mass": 0.10747586792896065,
        "position": [0.0, 0.0, 0.007566289279332185],
        "quaternion": [0.9999997900182237, 4.844951330557425e-05, -0.000646232275095691, 0.0],
        "velocity": [0.14190835907812244, -0.1050497353320382, 0.07708325955612422],
        "spin": [-2.5605572972739394, 3.089004605050803, -1.1022031153920657],
    }
    resistance = {"rolling": 0.0002235029635611625, "pivoting": 0.0003335770376627696}
    scenario = {
        "robot": {"model": "none"},
        "body": [can],
        "contact": [{"link": "can", "at": "collision", "friction": 0.3, "restitution": 0.7} | resistance],
        "stabiliser": {"kind": "baumgarte", "time_constant": 0.01},
        "time": {"duration": 0.09} | OWN,
    }
    run = cl.simulate(cl.load_scenario(scenario), progress=False)
    assert run.time[-1] == pytest.approx(0.09)
    assert "slip" in {event.kind for event in run.events}
    energy = run.kinetic_energy + run.potential_energy
    assert np.all(np.diff(energy) <= 1e-9 * energy[0])
