"""Contacts of links with a surface that gives way: the tip's own soft contact, written as `[[contact]]`."""

import numpy as np
import pytest

import closedloop as cl
from closedloop.jit.interpreted import interpreted
from closedloop.mechanics.contacts.memory import make_contact_memory
from closedloop.mechanics.contacts.turning import turn
from closedloop.mechanics.limits import STICK_SPEED
from closedloop.scenario.load import scenario_of
from closedloop.simulation.prepare import prepare
from robot_models import load

SOFT = {"kind": "kelvin_voigt", "stiffness": 2e4, "damping": 300.0}


def dropped(scheme, friction, duration=0.3, **more):
    """Return the changes that drop an arm with two joints on a soft surface."""
    rubs = {"friction.kind": "coulomb", "friction.coefficient": friction} if friction else {}
    return {"time.duration": duration, "time.integrator": scheme, "compliance": SOFT, **rubs} | more


def as_contacts(tip, *others, **more):
    """Return the scenario of a run with the tip's contact as the last `[[contact]]`, and no surface."""
    scenario, n = tip.scenario, tip.surface_normal[0]
    own = {
        "link": scenario.robot.tip or load(scenario.robot.model).tip,
        "normal": n.tolist(), "through": (tip.position[0] - tip.closure_error[0] * n).tolist(),
        "friction": getattr(scenario.friction, "coefficient", 0.0), "compliance": SOFT, **more,
    }  # fmt: skip
    none = {"kind": "none", "normal": list(scenario.surface.normal)}
    changes = {"time.duration": scenario.time.duration, "time.integrator": scenario.time.integrator}
    return cl.load_scenario("planar2_drop", changes | {"surface": none, "contact": [*others, own]})


@pytest.fixture(scope="module")
def both():
    """Return the run with a soft surface at the tip, and the one with a soft contact of the tip's link."""
    tip = cl.simulate(cl.load_scenario("planar2_drop", dropped("rk4", 0.3)), progress=False)
    return tip, cl.simulate(as_contacts(tip), progress=False)


def test_soft_contact_of_a_link_is_that_of_the_tip(both):
    """With friction that sticks and slides: events, motion and force."""
    tip, link = both
    assert tip.event_kind.tolist() == link.event_kind.tolist() != []
    np.testing.assert_allclose(link.event_time, tip.event_time, atol=1e-10)
    np.testing.assert_allclose(link.q, tip.q, atol=1e-11)
    np.testing.assert_allclose(link.v, tip.v, atol=1e-9)
    assert np.max(tip.contact_force) > 50.0
    np.testing.assert_allclose(link.link_forces[:, 0], tip.contact_force, atol=1e-7)
    assert link.summary()["verdict"]["good"]


def test_force_is_that_of_the_compliance_at_the_depth(both):
    """f = max(0, k δ + c δ̇) of the row's own state, in Coulomb's cone; H q̈ + C = Q + Jᵀ F by Pinocchio."""
    link = both[1]
    touching = link.link_modes[:, 0] > 0
    frame = both[0].surface_normal[0]
    rate = link.velocity @ frame
    expected = np.maximum(-SOFT["stiffness"] * link.link_gaps[:, 0] - SOFT["damping"] * rate, 0.0)
    np.testing.assert_allclose(link.link_forces[touching, 0], expected[touching], atol=1e-8)
    assert not np.any(link.link_forces[~touching])
    rub = np.hypot(*link.link_frictions.T)
    assert np.all(rub <= 0.3 * link.link_forces[:, 0] + 1e-9)
    assert np.max(link.residual_motion) < 1e-12


@pytest.mark.parametrize("scheme", ["semi_implicit_euler", pytest.param("dop853", marks=pytest.mark.slow)])
@pytest.mark.parametrize("friction", [0.0, 0.1])
def test_with_every_scheme(scheme, friction):
    """To what their treatment of the end of slip leaves: of an adaptive scheme its tolerance."""
    tip = cl.simulate(cl.load_scenario("planar2_drop", dropped(scheme, friction, 0.4)), progress=False)
    link = cl.simulate(as_contacts(tip), progress=False)
    assert tip.event_kind.tolist() == link.event_kind.tolist()
    np.testing.assert_allclose(link.q, tip.q, atol=1e-7 if scheme == "dop853" else 1e-9)


def test_soft_tip_beside_a_rigid_contact():
    """Soft and rigid contacts closed at once: with the tip's soft contact as [surface] and as [[contact]]."""
    floor = {"link": "link2", "normal": [0, 0, 1], "through": [0, 0, 0.19], "friction": 0.2}  # of the elbow
    one = cl.simulate(cl.load_scenario("planar2_drop", dropped("rk4", 0.1, 0.4, contact=[floor])), progress=False)
    two = cl.simulate(as_contacts(one, floor), progress=False)
    assert np.any((one.link_modes[:, 0] > 0) & (one.mode > 0)), "they never touch together"
    np.testing.assert_allclose(two.q, one.q, atol=1e-9)
    np.testing.assert_allclose(two.link_forces[:, 1], one.contact_force, atol=1e-5)


def test_start_inside_a_soft_surface(both):
    """A point may start inside a soft surface, which then pushes it out; a rigid one refuses it."""
    tip = both[0]
    inside = (tip.position[0] + 0.001 * tip.surface_normal[0]).tolist()
    run = cl.simulate(as_contacts(tip, through=inside), progress=False)
    assert run.link_forces[0, 0] == pytest.approx(SOFT["stiffness"] * 0.001, rel=1e-9)
    with pytest.raises(cl.ScenarioError, match="inside the surface"):
        cl.simulate(as_contacts(tip, through=inside, compliance={"kind": "none"}), progress=False)


@pytest.mark.parametrize("compliance", [SOFT, {"kind": "hunt_crossley", "stiffness": 1e6}])
def test_a_start_deep_inside_a_soft_surface_is_refused(both, compliance):
    """Of links and of the tip: the surface would throw it out, as a cannon does, at δ √(k/m)."""
    tip = both[0]
    deep = (tip.position[0] + 0.5 * tip.surface_normal[0]).tolist()
    where = r"the (point|tip) starts 0\.5 m inside the surface, which throws it out at some [0-9.e+]+ m/s: [^\n]*$"
    with pytest.raises(cl.ScenarioError, match=where):
        prepare(as_contacts(tip, through=deep, compliance=compliance))
    plane = {"surface.gap": 0.0, "surface.offset": float(tip.surface_normal[0] @ deep)}
    with pytest.raises(cl.ScenarioError, match=where):
        prepare(cl.load_scenario("planar2_drop", dropped("rk4", 0.3, compliance=compliance, **plane)))


@pytest.mark.parametrize("speed", [9.0, 11.0])
def test_the_speed_at_which_a_soft_surface_throws_a_ball_out(speed):
    """δ √(k/m), from both sides of the largest that may start."""
    k, m = 2e4, 1.3
    contact = {"link": "b", "at": "collision", "compliance": {"kind": "kelvin_voigt", "stiffness": k, "damping": 0.0}}
    ball = {"name": "b", "shape": "ball", "radius": 0.2, "mass": m, "position": [0, 0, 0.2 - speed * (m / k) ** 0.5]}
    tables = {"robot": {"model": "none", "gravity": [0, 0, 0]}, "body": [ball], "contact": [contact]}
    tables["time"] = {"duration": 0.02, "step": 1e-4, "integrator": "rk4"}
    scenario = scenario_of(tables, "ball", {})
    if speed > 10.0:
        with pytest.raises(cl.ScenarioError, match="throws it out at some 11 m/s"):
            prepare(scenario)
    else:
        assert cl.simulate(scenario, progress=False).v[-1, 2] == pytest.approx(speed, rel=1e-6)


def thrown(compliance, mu, duration, velocity=(0.3, 0.1, 0.0), spin=(0, 0, 2.0), gravity=(0, 0, -9.81), **time):
    """Return the run of a box of 1 kg that slides and turns on its four lower corners."""
    depth = 9.81 / 4.0 / compliance["stiffness"] if "stiffness" in compliance else 0.0
    box = {
        "name": "box", "shape": "box", "edges": [0.2, 0.15, 0.1], "mass": 1.0, "position": [0, 0, 0.05 - depth],
        "velocity": list(velocity), "spin": list(spin),
    }  # fmt: skip
    contact = {"link": "box", "at": "collision", "friction": mu, "compliance": compliance}
    tables = {
        "robot": {"model": "none", "gravity": list(gravity)}, "body": [box], "contact": [contact],
        "time": {"duration": duration, "step": 1e-3, "integrator": "rk4"} | time,
    }  # fmt: skip
    return cl.simulate(scenario_of(tables, "box", {}), progress=False)


def soft(k, d):
    """Return the section of a Kelvin-Voigt surface."""
    return {"kind": "kelvin_voigt", "stiffness": k, "damping": d}


def test_a_slide_ends_alike_in_both_engines():
    """Friction of four feet is not unique where their slips end within a step: it is of least norm, in each engine."""
    for velocity, spin in (((0.28319, 0.02905, 0.0), (0, 0, 0)), ((0.2, 0.1, 0.0), (0, 0, 3.0))):
        run = thrown({"kind": "none"}, 0.3, 0.15, velocity, spin)
        other = cl.simulate(run.scenario, engine="pinocchio", progress=False)
        for name in ("q", "v", "link_forces", "link_frictions"):
            np.testing.assert_allclose(getattr(other, name), getattr(run, name), atol=1e-10)


def test_friction_that_stays_against_its_slip_is_not_turned_in_the_next_round():
    """Of fingers that hold a bar one is soft, and the slip of another is slow with the forces of every second round.

    Rounds went on between two sets of directions, and rounding decided which was the last: 2e-3 rad/s between engines.
    """
    soft = {"kind": "hunt_crossley", "stiffness": 1e6, "dissipation": 1.0}
    changes = {"contact.middle.compliance": soft, "stabiliser.time_constant": 0.00085, "time.duration": 0.017}
    scenario = cl.load_scenario("hand_rolls", changes)
    run, other = (cl.simulate(scenario, engine=engine, progress=False) for engine in ("compiled", "pinocchio"))
    np.testing.assert_allclose(other.v, run.v, atol=1e-10)


def test_a_box_on_soft_feet_slides_and_turns_to_rest():
    """In few events, and where rigid feet bring it to rest, though it rocks and its feet are at different depths."""
    ends = []
    for compliance in ({"kind": "none"}, soft(1e5, 200.0)):
        run = thrown(compliance, 0.4, 0.15)
        assert len(run.event_time) < 40
        assert np.max(np.abs(run.v[-1])) < 1e-9
        assert run.summary()["verdict"]["good"]
        ends.append(run.q[-1, :2])
    straight = (0.3**2 + 0.1**2) / (2.0 * 0.4 * 9.81)  # friction that also brakes the turn brakes the slide less
    assert straight < np.linalg.norm(ends[0]) < 1.3 * straight
    np.testing.assert_allclose(ends[1], ends[0], rtol=0.02)


@pytest.mark.parametrize(("k", "d"), [(1e3, 20.0), (1e4, 20.0), (1e4, 100.0), (1e5, 20.0), (1e5, 300.0)])
@pytest.mark.parametrize("mu", [0.2, 0.4, 0.8])
def test_a_box_on_soft_feet_rests_whatever_they_are_like(k, d, mu):
    """Each of these stopped, or had a slip that ended and began again every nanosecond."""
    run = thrown(soft(k, d), mu, 0.6)
    assert len(run.event_time) <= 20
    assert np.max(np.abs(run.v[-1])) < 2e-4  # what rocks still does so by its own damping
    assert np.all(run.link_modes[-1, run.link_forces[-1] > 0.0] == 2)
    rub = np.hypot(*np.moveaxis(run.link_frictions.reshape(len(run.time), -1, 2), -1, 0))
    assert np.max(rub - mu * run.link_forces) < 1e-9
    energy = run.kinetic_energy + run.potential_energy
    stored = 0.5 * k * np.sum(np.minimum(run.link_gaps, 0.0) ** 2, axis=1)
    assert np.max(np.diff(energy + stored)) < 1e-3 * run.kinetic_energy[0]  # the step's error at d = 300 N s/m


def test_a_turn_on_soft_feet_ends_by_its_closed_form():
    """Friction μ m g at the distance r of four feet: ω falls by μ m g r/I, then by e⁻¹ in a step, all alike."""
    run = thrown(soft(1e3, 20.0), 0.8, 0.06, velocity=(0, 0, 0), spin=(0, 0, 1.0))
    rate = 0.8 * 9.81 * np.hypot(0.1, 0.075) / ((0.2**2 + 0.15**2) / 12.0)
    fast = run.v[:, 5] > 2.0 * rate * 1e-3
    np.testing.assert_allclose(run.v[fast, 5], (1.0 - rate * run.time)[fast], atol=1e-4)
    assert np.max(np.abs(run.v[-1])) < 1e-12
    rub = np.hypot(*np.moveaxis(run.link_frictions[:, :8].reshape(len(run.time), 4, 2), -1, 0))
    assert np.max(np.ptp(rub, axis=1)) < 1e-6


@pytest.mark.slow
def test_an_integrator_that_chooses_its_steps_brings_soft_feet_to_rest():
    """Where the fixed step does, with a force of friction that is the load's; a disc that rocks and rubs goes on."""
    ends = []
    for time in ({"step": 2.5e-4}, {"integrator": "dop853", "step": 1e-2}):
        run = thrown(soft(1e4, 100.0), 0.4, 0.3, **time)
        assert np.max(np.abs(run.v[-1])) < 1e-5
        ends.append(run.q[-1])
    np.testing.assert_allclose(ends[1], ends[0], atol=2e-4)
    for more in ({}, {"rolling": 1e-3, "pivoting": 1e-3}):
        run = fallen(COIN, 5e3, 5.0, step=0.01, integrator="dop853", **more)
        assert np.sum(run.link_forces[-1]) == pytest.approx(0.05 * 9.81, rel=0.02)
        rub = np.linalg.norm(run.link_frictions.reshape(len(run.time), -1, 2)[:, : run.link_forces.shape[1]], axis=2)
        assert np.max(rub - 0.3 * run.link_forces) < 1e-9
        energy = run.kinetic_energy + run.potential_energy
        assert np.max(energy) <= energy[0] * (1.0 + 1e-9)


@pytest.mark.parametrize("tilt", [0.5, 0.99])
def test_a_box_on_soft_feet_does_not_creep_down_an_incline(tilt):
    """Below the angle of friction it stays: a second moves it by what its first steps did."""
    angle = tilt * np.arctan(0.4)
    gravity = (9.81 * np.sin(angle), 0.0, -9.81 * np.cos(angle))
    run = thrown(soft(1e4, 100.0), 0.4, 1.0, velocity=(0, 0, 0), spin=(0, 0, 0), gravity=gravity)
    settled = run.time > 0.4
    assert np.max(np.abs(run.v[settled])) < 1e-7
    assert np.max(np.ptp(run.q[settled, :3], axis=0)) < 1e-7


def test_creep_of_soft_feet_is_that_of_the_rise_of_friction():
    """Of an integrator that chooses its steps: μ f tanh(v/v_c) = m g sin α."""
    angle = 0.8 * np.arctan(0.4)
    gravity = (9.81 * np.sin(angle), 0.0, -9.81 * np.cos(angle))
    more = {"velocity": (0, 0, 0), "spin": (0, 0, 0), "gravity": gravity, "integrator": "dop853", "step": 1e-2}
    run = thrown(soft(1e4, 100.0), 0.4, 0.8, **more)
    assert run.v[-1, 0] == pytest.approx(STICK_SPEED * np.arctanh(np.tan(angle) / 0.4), rel=1e-3)


@pytest.mark.parametrize(("soft", "stiffness"), [(1, 1e5), (4, 1e4)])
def test_soft_pads_of_a_gripper_do_not_make_its_other_contacts_chatter(soft, stiffness):
    """Forces of rigid contacts that are not unique are inside their cones, whatever the soft ones carry and rub."""
    pads = {f"contact.{i}.compliance": {**SOFT, "stiffness": stiffness, "damping": 100.0} for i in range(soft)}
    changes = {**pads, "time.duration": 0.02, "time.step": 2.5e-4}
    run = cl.simulate(cl.load_scenario("gripper_block", changes))
    assert len(run.events) < 20
    assert not any(event.kind == "time_step" for event in run.events)
    rub = np.hypot(run.link_frictions[:, ::2], run.link_frictions[:, 1::2])
    assert np.all(rub <= 0.4 * run.link_forces + 1e-12)
    assert np.min(run.link_gaps[:, 2 * soft :]) > -1e-9


def fallen(shape, k, d, duration=0.3, step=1e-3, integrator="rk4", friction=0.3, **more):
    """Return the run of a disc of 50 g that falls nearly flat on a soft floor; `more` is of its contact."""
    body = {
        "name": "disc", "shape": "cylinder", "mass": 0.05, "quaternion": [1.0, 5e-5, 2e-5, 0.0],
        "position": [0.0, 0.0, 0.5 * shape["length"] + 1e-4], "velocity": [0.05, 0.0, -0.02], "spin": [0.3, 0.1, 0.5],
    } | shape  # fmt: skip
    contact = {"link": "disc", "at": "collision", "friction": friction, "compliance": soft(k, d)} | more
    times = {"duration": duration, "step": step, "integrator": integrator}
    changes = {"robot": {"model": "none"}, "body": [body], "contact": [contact], "time": times}
    return cl.simulate(cl.load_scenario(changes), progress=False)


COIN, CAN = {"radius": 0.03, "length": 0.006}, {"radius": 0.03, "length": 0.1}


@pytest.mark.slow
@pytest.mark.parametrize("shape", [COIN, CAN])
@pytest.mark.parametrize("more", [{}, {"rolling": 1e-3, "pivoting": 1e-3}])
def test_a_disc_that_lands_flat_on_a_soft_floor_rests_in_few_events(shape, more):
    """Its edge went from one side to the other for ever, each time to the point that its own spring had not raised."""
    run = fallen(shape, 5e3, 5.0, **more)
    assert len(run.event_time) < 60
    energy = run.kinetic_energy + run.potential_energy
    assert np.max(energy) <= energy[0] * (1.0 + 1e-9)
    assert np.max(np.abs(run.v[-1])) < 1e-3
    assert np.sum(run.link_forces[-1]) == pytest.approx(0.05 * 9.81, rel=0.02)


STIFF = {"kind": "hunt_crossley", "stiffness": 1e6, "dissipation": 1.0}


@pytest.mark.slow
@pytest.mark.parametrize(("law", "step"), [(soft(5e3, 8.0), 2e-3), (soft(5e3, 8.0), 1e-3), (STIFF, 1e-3)])
def test_a_can_that_resists_rolling_comes_to_rest_at_every_step(law, step):
    """It falls on its rim, tilted, and wobbles until it stands: by what resists it, and not by what the step does.

    In an earlier form it went on at one of these steps, with 0.1 rad/s, and the verdict was good.
    """
    shape = {**CAN, "mass": 0.3, "position": [0, 0, 0.08], "velocity": [0, 0, 0], "spin": [0, 0, 2.0]}
    shape |= {"quaternion": [0.9922, 0.1194, 0.0358, 0.0]}
    more = {"rolling": 1e-3, "pivoting": 5e-4, "compliance": law}
    run = fallen(shape, 0.0, 0.0, 2.4, step, "semi_implicit_euler", 0.5, **more)
    assert run.summary()["verdict"]["good"]
    assert np.max(np.abs(run.v[-1, 3:])) < 1e-8
    assert np.sum(run.link_forces[-1]) == pytest.approx(0.3 * 9.81, rel=0.02)  # it may still swing up and down


def test_a_step_that_does_not_resolve_a_soft_contact_is_said():
    """A coin whose rim is damped within a fifth of a step, alone and in a batch; with a step that the line names not.

    It hopped from foot to foot, in hundreds of events, and a run of 0.3 s was good.
    """
    coin = {"radius": 0.012, "length": 0.002, "mass": 0.006}
    run = fallen(coin, 5e3, 8.0, 0.05, 1e-3, "semi_implicit_euler")
    (problem,) = [each for each in run.summary()["verdict"]["problems"] if each["name"] == "resolution"]
    assert problem["text"].startswith("contact.contact 1.compliance: semi_implicit_euler with time.step = 0.001 s gets")
    short = 0.05 / np.ceil(0.05 / float(problem["text"].split()[-2]))
    (row,) = cl.simulate_batch(run.scenario, {"contact.*.friction": [0.3]}).to_pylist()
    assert "resolution" in row["verdict"]
    finer = fallen(coin, 5e3, 8.0, 0.05, short, "semi_implicit_euler")
    assert "resolution" not in [each["name"] for each in finer.summary()["verdict"]["problems"]]
    stepped = fallen(coin, 5e3, 8.0, 0.05, 1e-3, "time_stepping")
    assert stepped.summary()["verdict"]["good"]


def test_feet_of_one_body_do_not_press_against_each_other():
    """A coin that slides on, nearly flat, while it rocks: the friction of its feet is along its slip."""
    run = fallen(COIN, 5e3, 5.0, duration=0.02)
    rub = run.link_frictions.reshape(len(run.time), -1, 2)
    several = np.sum(run.link_forces > 0.0, axis=1) > 1
    assert np.sum(several) > 5
    total, apart = np.linalg.norm(np.sum(rub, axis=1), axis=1), np.sum(np.linalg.norm(rub, axis=2), axis=1)
    assert np.all(total[several] > 0.5 * apart[several])


def test_dry_friction_of_an_arm_does_not_touch_a_pad_beside_it():
    """A box that turns to rest on a soft pad moves, to the last bit and in as many evaluations, as beside a free arm.

    Its points each stuck and slipped by themselves while any joint had dry friction: a millisecond took minutes.
    """
    pad = {"disc": 0.034, "rings": 2, "centre": [0.0, 0.0, -0.05]}
    stiff = {"kind": "hunt_crossley", "stiffness": 1e6, "dissipation": 1.0}
    box = {
        "name": "b",
        "shape": "box",
        "edges": [0.1] * 3,
        "mass": 1.5,
        "position": [3, 3, 0.05],
        "spin": [0.5, -0.4, 0],
    }
    runs, counts = [], [0, 0]
    for i, friction in enumerate(({}, {"joint_friction": {"kind": "coulomb", "kinetic": 1.0}})):

        def idle(t, q, v, terms, i=i):
            counts[i] += 1
            return 0.0 * q

        scenario = {
            "robot": {"model": "planar2"}, "surface": {"kind": "none", "contact": "unilateral"}, "body": [box],
            "contact": [{"link": "b", "friction": 0.1, "at": pad, "compliance": stiff}],
            "time": {"duration": 0.03, "step": 1e-3, "integrator": "rk4"}, **friction,
        }  # fmt: skip
        runs.append(cl.simulate(scenario_of(scenario, "a pad", {}), law=idle, progress=False))
    free, dry = runs
    assert np.ptp(free.v[:, 0]) > 0.1 > 1e-9 > np.ptp(dry.v[:, 1])
    np.testing.assert_array_equal(dry.v[:, 2:], free.v[:, 2:])
    assert counts[0] == counts[1]


@pytest.mark.parametrize("sought", [0.0, 1e-17])
def test_what_rolls_without_friction_has_none(sought):
    """Soft contact beside others: where the friction that is sought is exactly zero, it was all of μ f for a step.

    A ball that rolled on a soft floor beside an arm was pushed by 1 mm/s in a row, and back in the next.
    """
    c = make_contact_memory(6, 2).contacts
    c.F[3], c.friction.shared[1], c.problem.along[1], c.direction[1] = 2.0, 0.1, (0.06, -0.08), (0.6, -0.8)
    interpreted(turn)(c, 1, sought, 0.0, True)
    np.testing.assert_allclose(c.problem.along[1], 0.0, atol=1e-16)
