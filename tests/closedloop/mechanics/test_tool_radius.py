"""The round end of a tool: its contact is that of a ball of a link about the tip, on every surface."""

import numpy as np
import pytest

import closedloop as cl

RADIUS, MU = 0.03, 0.4
FAR = {"kind": "plane", "offset": "start", "gap": 50.0, "contact": "unilateral"}
SURFACES = {
    "plane": {},
    "sphere": {"kind": "sphere", "radius": 0.3},
    "cylinder": {"kind": "cylinder", "radius": 0.2},
    "bowl": {"kind": "sphere", "radius": 0.5, "inside": True},
}
MOTIONS = {
    "turntable": {"kind": "turntable", "speed": 2.0},
    "conveyor": {"kind": "conveyor", "velocity": [0.1, 0.05, 0]},
    "belt": {"kind": "belt", "velocity": [0.1, 0.05, 0]},
}
SOFT = {"kind": "kelvin_voigt", "stiffness": 2e4, "damping": 100.0}


def both(surface, motion=None, compliance=None, **changes):
    """Return the run of a tip with a round end, and that of a point with a ball of a link about it."""
    common = {
        "law.force": 0.0,
        "model_error.payload": 1.0,
        "reference.kind": "line",
        "reference.stop": 0.4,
        "reference.start": 0.0,
    }
    common |= {"reference.on_surface": "no", "reference.direction": [0.2, 1.0, 0.0], "reference.speed": 0.2}
    common |= {"time.duration": 0.25, "time.integrator": "rk4", "stabiliser.time_constant": 0.01} | changes
    start = cl.simulate(cl.load_scenario("wam_slide", {"time.duration": 0.002}), progress=False).position[0]
    of_tip = {f"surface.{key}": value for key, value in surface.items()} | {"surface.contact": "unilateral"}
    of_tip |= {"friction.kind": "coulomb", "friction.coefficient": MU, "tool.radius": RADIUS, "impact.law": "newton"}
    contact = {"link": "tip", "radius": RADIUS, "friction": MU, "through": [*start[:2], start[2] - RADIUS]}
    if surface:
        contact["surface"] = surface
    if motion:
        of_tip |= {f"surface_motion.{key}": value for key, value in motion.items()}
        contact["motion"] = motion
    if compliance:
        of_tip |= {f"compliance.{key}": value for key, value in compliance.items()}
        contact["compliance"] = compliance
    tip = cl.simulate(cl.load_scenario("wam_slide", common | of_tip), progress=False)
    link = cl.simulate(cl.load_scenario("wam_slide", common | {"surface": FAR, "contact": [contact]}), progress=False)
    return tip, link


@pytest.mark.parametrize("kind", SURFACES)
@pytest.mark.parametrize("way", ["at rest", "turntable", "conveyor", "belt", "soft"])
def test_a_round_end_is_a_ball_about_the_tip(kind, way):
    """Pressed on and drawn along with friction: the same motion, force and friction to rounding."""
    tip, link = both(SURFACES[kind], MOTIONS.get(way), SOFT if way == "soft" else None)
    assert np.max(tip.contact_force) > 1.0
    assert np.max(np.abs(tip.slip_velocity)) > 0.01
    np.testing.assert_allclose(tip.q, link.q, atol=1e-9)
    np.testing.assert_allclose(tip.contact_force, link.link_forces[:, 0], atol=1e-5 * np.max(tip.contact_force))
    # the instant of a liftoff is located by another event function: 3e-10 m
    np.testing.assert_allclose(tip.closure_error, link.link_gaps[:, 0], atol=1e-9)


def test_friction_has_its_lever():
    """With friction the motion is not that of a point on the same surface raised by the radius, without it is."""
    changes = {"time.duration": 0.3, "reference.start": 0.0, "reference.stop": 1.0}
    runs = {}
    for radius in (0.0, RADIUS):
        for mu in (0.0, 0.5):
            more = {"tool.radius": radius, "friction.kind": "coulomb", "friction.coefficient": mu}
            runs[radius, mu] = cl.simulate(cl.load_scenario("wam_slide", changes | more), progress=False)
    np.testing.assert_allclose(runs[RADIUS, 0.0].q, runs[0.0, 0.0].q, atol=1e-13)
    assert np.max(np.abs(runs[RADIUS, 0.5].q - runs[0.0, 0.5].q)) > 1e-6
    assert runs[RADIUS, 0.5].summary()["verdict"]["good"]


def test_both_engines_and_a_batch_agree():
    """With friction and a radius."""
    changes = {"tool.radius": RADIUS, "friction.kind": "coulomb", "friction.coefficient": 0.3, "time.duration": 0.7}
    scenario = cl.load_scenario("wam_slide", changes)
    run, other = (cl.simulate(scenario, engine=engine, progress=False) for engine in ("compiled", "pinocchio"))
    np.testing.assert_allclose(run.q, other.q, atol=1e-11)
    table = cl.simulate_batch(scenario, {"friction.coefficient": [0.3] * 8})
    np.testing.assert_array_equal(np.asarray(table["final_contact_force"]), run.contact_force[-1])


def test_the_wrench_at_the_wrist_has_the_moment_of_friction():
    """A sensor between arm and tool reads the force at the place where the ball touches."""
    changes = {"friction.kind": "coulomb", "friction.coefficient": 0.5, "time.duration": 0.7}
    run = cl.simulate(cl.load_scenario("wam_slide", changes | {"tool.radius": RADIUS}), progress=False)
    force, n = run.contact_force[:, None] * run.surface_normal + run.friction_force, run.surface_normal
    moment = np.linalg.norm(np.cross(-RADIUS * n, force), axis=1)
    np.testing.assert_allclose(np.linalg.norm(run.wrist_wrench[:, 3:], axis=1), moment, atol=1e-12)
    assert moment.max() > 0.01
