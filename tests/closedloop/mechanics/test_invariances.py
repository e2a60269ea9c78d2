"""What must not matter does not: units of the normal, signs, where north is, how hard it presses."""

import numpy as np
import pytest
from rounding import within

import closedloop as cl
import robot_models

STATE = ("q", "v", "acceleration", "reference_position")


def run(name="wam_slide", **changes):
    """Simulate 0.7 s of a shipped scenario, which has the velocity step in it, with SECTION__KEY changes."""
    dotted = {key.replace("__", "."): value for key, value in changes.items()}
    return cl.simulate(cl.load_scenario(name, {"time.duration": 0.7} | dotted))


@pytest.fixture(scope="module")
def plain():
    """Return the run that nothing was changed in."""
    return run()


@pytest.mark.parametrize("length", [4.0, 2.0**-40, 2.0**900])
def test_length_of_the_normal_changes_nothing(length, plain):
    """A normal longer or shorter by a power of two gives the same run, bit for bit."""
    scaled = run(surface__normal=[0, 0, length])
    for name in plain.columns:
        assert np.array_equal(plain.columns[name], scaled.columns[name]), name


def test_length_of_a_tilted_normal_changes_rounding_at_most():
    """Any other length gives the same run to rounding."""
    one, other = (run("panda_slide", surface__normal=[-0.342 * s, 0, 0.94 * s]) for s in (1.0, 3.7))
    assert np.max(np.abs(one.contact_force - other.contact_force)) < 1e-9
    assert within(512, one.q, other.q)


def test_turning_normal_and_force_around_is_the_same_push(plain):
    """Calling the other side "out" and pulling instead of pushing is the same physics: f and e change sign."""
    turned = run(surface__normal=[0, 0, -1], law__force=-10.0)
    for name in STATE:
        assert np.max(np.abs(getattr(plain, name) - getattr(turned, name))) < 1e-10, name
    assert np.max(np.abs(turned.contact_force + plain.contact_force)) < 1e-10
    assert np.max(np.abs(turned.closure_error + plain.closure_error)) < 1e-15


@pytest.mark.parametrize("force", [0.0, 15.0, 100.0])
def test_motion_does_not_know_how_hard_the_arm_presses(force, plain):
    """Eq. 33's force term is balanced by the surface alone: q(t) is the same, and f is higher by what is asked.

    Exact in exact arithmetic, at every instant, transients included: f - f_des does not depend on f_des.
    """
    other = run(law__force=force)
    assert np.max(np.abs(other.q - plain.q)) < 1e-12
    assert np.max(np.abs(other.contact_force - plain.contact_force - (force - 10.0))) < 1e-9


def test_north_does_not_matter():
    """Turning the whole scene about the vertical, which is the WAM's first axis, turns the run and changes no force.

    1e-8 N: rounding of some 1e-12 rad in the inverse kinematics times K_p of 900 N m/rad, over a lever of some 0.1 m.
    """
    tilted, along = np.array([0.2, -0.1, 1.0]), np.array([0.1, 1.0, 0.08])
    turn = 0.4
    R = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    q = np.array([1.2, 1.0, 0.1, 2.0])
    here = run(surface__normal=tilted.tolist(), reference__direction=along.tolist(), start__q=q.tolist())
    there = run(
        surface__normal=(R @ tilted).tolist(),
        reference__direction=(R @ along).tolist(),
        start__q=(q + np.array([turn, 0, 0, 0])).tolist(),
    )
    assert np.ptp(here.contact_force) > 0.5
    assert np.max(np.abs(there.contact_force - here.contact_force)) < 1e-8
    assert np.max(np.abs(there.torque - here.torque)) < 1e-8
    assert np.max(np.abs(there.q - here.q - [turn, 0, 0, 0])) < 1e-11
    assert np.max(np.abs(there.position - here.position @ R.T)) < 1e-11


@pytest.mark.parametrize("name", ["wam_slide", "panda_slide", "planar2_slide"])
def test_at_rest_the_force_is_the_commanded_one_on_any_plane(name, robot):
    """At rest f = f_des on a plane of any orientation: random tilts, random forces.

    Rounding of some 50 N m of bias, over the lever of the normal, times the condition of Eq. 24 (below 1e5 where
    the mobility share is above 1e-3): 1e-10 relative.
    """
    rng = np.random.default_rng(0)
    arm = robot(name.split("_")[0].replace("wam", "wam4"))
    compared = 0
    for _ in range(25):
        normal, force = rng.normal(size=3), rng.uniform(1.0, 50.0)
        changes = {
            "surface.normal": normal.tolist(),
            "law.force": force,
            "reference.kind": "hold",
            "time.duration": 0.01,
        }
        at_rest = cl.simulate(cl.load_scenario(name, changes), model=arm.model)
        if at_rest.normal_mobility[0] < 1e-3:
            continue
        assert np.max(np.abs(at_rest.contact_force - force)) < 1e-10 * (50.0 + force)
        compared += 1
    assert compared > 15


def test_a_free_mass_is_pushed_as_newton_says():
    """A point mass on three slides is held to a tilted plane by exactly what pushes it along the normal.

    In closed form for the pointmass3 robot: q̈ = (Q - C + n f)/m and n·q̈ = 0, so f = -n·(Q - C).
    """
    robot = cl.Robot(robot_models.load("pointmass3"))
    rng = np.random.default_rng(1)
    for _ in range(10):
        normal, torque = rng.normal(size=3), 10 * rng.normal(size=3)
        n = normal / np.linalg.norm(normal)
        terms = robot.terms(np.zeros(3), np.zeros(3))
        mass = terms.mass_matrix[0, 0]
        assert np.allclose(terms.mass_matrix, mass * np.eye(3))
        changes = {"robot.model": "pointmass3", "surface.normal": normal.tolist(), "time.duration": 0.001}
        changes |= {"start.q": [0.0] * 3, "start.v": None, "reference.kind": "hold", "law.kp": 1.0, "law.kd": 1.0}
        scenario = cl.load_scenario("planar2_slide", changes)
        pushed = cl.simulate(scenario, law=lambda t, q, v, terms, Q=torque: Q)
        f = -n @ (torque - terms.bias)
        assert pushed.contact_force[0] == pytest.approx(f, rel=1e-12, abs=1e-12)
        assert np.allclose(pushed.acceleration[0], (torque - terms.bias + n * f) / mass, rtol=0, atol=1e-12)


def test_robot_given_in_python_is_the_robot_loaded_by_name(plain, robot):
    """Handing over the model gives the run that naming it gives."""
    given = cl.simulate(plain.scenario, model=robot("wam4").model)
    for name in plain.columns:
        assert np.array_equal(plain.columns[name], given.columns[name]), name
