"""The stated error of a step where strikes, slips and beginnings of contact are at other instants."""

import numpy as np
import pytest

import closedloop as cl
from closedloop.loop.events.table import IMPACT
from closedloop.mechanics.closure.contact_force import FREE
from closedloop.record.report.growth import bounces_on, starts_again
from closedloop.record.report.step_error import beside_of, step_rows


def test_a_tip_that_strikes_with_elastic_joints_is_off_by_more_each_time():
    """Which of its strikes come, and when, depends on the motors' swing."""
    changes = {"compensation.kind": "adaptive", "transmission.stiffness": 3850.717075626698, "time.integrator": "rk4",
               "model_error.normal": 0.04295818238057388, "time.duration": 0.5}  # fmt: skip
    run = cl.halve(cl.load_scenario("planar2_drop", changes), engine="compiled")
    stated = cl.simulate(run.scenario, engine="compiled").summary()["step_error"]["position"]
    assert 1e-3 < run.halved["position"] <= stated < 30.0 * run.halved["position"]


def test_a_joint_that_breaks_away_again_moves_the_tip_by_more_than_it_was_off():
    """As it does the force: the tip was off by 1.1e-5 m, 5.7e-6 stated."""
    changes = {"compliance.kind": "hunt_crossley", "time.integrator": "rk4", "time.duration": 1.36}
    run = cl.halve(cl.load_scenario("joint_friction", changes), engine="compiled")
    stated = cl.simulate(run.scenario, engine="compiled").summary()["step_error"]["position"]
    assert run.halved["position"] <= stated


def test_a_tip_that_breaks_away_is_off_by_more_than_it_was():
    """Its slip begins up to a step late, and friction that falls with speed multiplies what it is off by then."""
    changes = {"tool.mass": 0.9, "time.integrator": "semi_implicit_euler", "time.duration": 1.0}
    run = cl.halve(cl.load_scenario("wam_hybrid_friction", changes), engine="compiled")
    stated = cl.simulate(run.scenario, engine="compiled").summary()["step_error"]["position"]
    assert run.halved["position"] <= stated < 30.0 * run.halved["position"]


def test_where_contact_begins_the_force_asked_for_may_be_that_of_either_row():
    """A tip that lands half a step later is asked for another force, and f after it starts from another error."""
    changes = {"time.duration": 0.6, "time.integrator": "semi_implicit_euler", "force_profile.kind": "sine",
               "force_profile.amplitude": 8.0, "force_profile.frequency": 50.0}  # fmt: skip
    run = cl.simulate(cl.load_scenario("planar2_drop", changes), engine="compiled")
    touching = run.mode != FREE
    begins = np.flatnonzero(touching[1:] & ~touching[:-1]) + 1
    moved = np.abs(run.reference_force[begins] - run.reference_force[begins - 1])
    assert begins.size > 0
    assert np.max(moved) > 0.5
    assert run.summary()["step_error"]["contact_force"] > np.max(moved)


def test_rest_on_friction_after_an_impact_and_coarse_encoders_are_said_to_be_unknown():
    """Which force friction bears there is another at every step; without friction, or still moving, it is known."""
    rest = {"joint_friction.kind": "seven_parameter", "joint_friction.kinetic": 0.192, "joint_friction.rise_time": 0.05,
            "joint_friction.static_excess": 0.13, "joint_friction.stiffness": 776.0,
            "joint_friction.memory_delay": 0.003, "joint_friction.stribeck_speed": 0.01}  # fmt: skip
    for changes, why in (
        (rest | {"time.duration": 0.3}, "joint_friction"),
        ({"time.duration": 0.05}, None),
        ({"encoder.quantisation": 1e-3, "time.duration": 0.05}, "encoder.quantisation"),
    ):
        found = cl.simulate(cl.load_scenario("four_bar", {**changes, "time.integrator": "rk4"}), engine="compiled")
        stated = found.summary()["step_error"]
        assert (stated["why_not"] or "None").startswith(str(why))
        assert (stated["contact_force"] is None) == (why is not None)


def test_of_a_tip_that_strikes_only_no_error_of_f_is_stated():
    """No row was in contact, and none was said to be wrong; at half the step seven were, with up to 69 N."""
    changes = {"transmission.stiffness": 488.7088305431963, "surface_motion.kind": "turntable",
               "surface_motion.speed": -6.91992848743863, "time.duration": 0.65, "time.integrator": "rk4"}  # fmt: skip
    scenario = cl.load_scenario("planar2_drop", changes)
    run = cl.simulate(scenario, engine="compiled")
    assert not np.any(run.mode != FREE)
    found = run.summary()["step_error"]
    assert found["contact_force"] is None
    assert found["extremes"] is None
    assert found["why_not"].startswith("the tip strikes")
    (row,) = cl.simulate_batch(scenario, {"law.force": [scenario.law.force]}).to_pylist()
    assert row["step_error_force"] is None


def test_strikes_of_an_arm_with_friction_in_its_joints_are_late_by_a_step_each():
    """Also with rk4: after twelve strikes contact begins up to five steps late, and f is 1 to 2 N off."""
    friction = {"kind": "seven_parameter", "kinetic": 1.04, "static_excess": 0.463, "stribeck_speed": 0.01,
                "stiffness": 5676.0, "memory_delay": 0.003, "rise_time": 0.0848}  # fmt: skip
    changes = {"joint_friction": friction, "stabiliser.kind": "none", "time.integrator": "rk4", "time.duration": 0.551}
    runs = {k: cl.simulate(cl.load_scenario("planar2_drop", changes | {"time.step": 1e-3 / k}), engine="compiled")
            for k in (1, 2, 16)}  # fmt: skip
    for k in (1, 2):
        run, reference = runs[k], runs[16]
        touching = (run.mode != FREE) & (reference.mode[:: 16 // k] != FREE)
        off = np.max(np.abs(run.contact_force - reference.contact_force[:: 16 // k])[touching])
        aside = np.max(np.linalg.norm(run.position - reference.position[:: 16 // k], axis=1))
        stated = run.summary()["step_error"]
        assert np.count_nonzero(run.event_kind == IMPACT) >= 10
        assert off < stated["contact_force"] < 30.0 * off
        assert aside < stated["position"] < 30.0 * aside


def test_where_the_tip_sticks_or_slips_the_extremes_of_f_are_not_known():
    """At half the step a row may fall where friction turns: the peak was off by 1.18 N, 0.0024 N stated."""
    changes = {
        "reference.kind": "waypoints", "reference.points": [[0.0, 0.0, 0.0], [0.0, 0.0002, 0.0]],
        "reference.times": [0.001, 0.008], "compensation.kind": "model", "stabiliser.time_constant": 0.006,
        "time.duration": 0.05, "time.integrator": "rk4",
    }  # fmt: skip
    found = cl.simulate(cl.load_scenario("wam_stick_slip", changes), engine="compiled").summary()["step_error"]
    assert found["contact_force"] > 0.0
    assert found["extremes"] is None
    assert found["why_not"] is None
    assert [row[:2] for row in step_rows(found)[:1]] == [("error of peak and last f", "not known")]


def test_where_contact_begins_the_extremes_of_f_are_off_by_the_force_that_begins():
    """And by no more than the error of f in a run whose contact does not change."""
    drop = cl.simulate(cl.load_scenario("planar2_drop", {"time.duration": 0.6}), engine="compiled").summary()
    slide = cl.simulate(cl.load_scenario("wam_slide", {"time.duration": 0.6}), engine="compiled").summary()
    assert slide["step_error"]["extremes"] == slide["step_error"]["contact_force"]
    assert drop["step_error"]["extremes"] is None or (
        drop["step_error"]["extremes"] > drop["step_error"]["contact_force"] + 1.0
    )


def test_a_tip_that_still_bounces_at_the_end_may_be_in_contact_there_at_another_step():
    """Off the surface at the end, and on it a row before; not a run that came to rest, nor one long off it."""
    for time, end, mode, bounces in ((0.59, 0.6, 0, True), (0.59, 0.6, 1, False), (0.5, 0.6, 0, False)):
        events = np.array([1]), np.array([time]), np.array([-0.1]), np.array([0])
        rows, forces = np.zeros((round(end / 1e-3) + 1, 4)), 2 * (np.full(round(end / 1e-3) + 1, 10.0),)
        assert beside_of(cl.load_scenario("wam_bounce"), events, mode, rows, forces).off_at_the_end == bounces


def test_bounces_that_go_on_and_those_of_a_touchdown():
    """Also where they grow, or last for a while only."""
    decay = 0.3 * 0.9 ** np.arange(40.0)
    growth = decay[7::-1]
    for speeds, on in ((decay, False), (decay[:5], False), (np.full(6, 0.1), True), (np.full(5, 0.1), False),
                       (growth, True), (np.concatenate([growth, decay]), True), (decay[:0], False)):  # fmt: skip
        assert bounces_on(speeds) == on


def test_bounces_that_go_on_leave_f_anywhere_in_its_range():
    """Of an unstable loop on a soft surface 18 N were stated, and 128 true, at each step: its touchdowns come apart."""
    changes = {
        "surface.contact": "unilateral", "compliance.kind": "kelvin_voigt", "compliance.stiffness": 2.5e5,
        "compliance.damping": 108.0, "law.kind": "admittance", "law.force_integral": 5.0, "sensor.delay": 0.01,
        "time.integrator": "rk4", "time.step": 2e-4, "time.duration": 2.0,
    }  # fmt: skip
    run = cl.halve(cl.load_scenario("joint_friction", changes), engine="compiled")
    stated = cl.simulate(run.scenario, engine="compiled").summary()
    assert run.halved["force"] > 50.0
    assert run.halved["force"] <= stated["step_error"]["contact_force"] <= 3.0 * run.halved["force"]
    assert run.halved["position"] <= stated["step_error"]["position"]
    assert [problem["name"] for problem in stated["verdict"]["problems"]] == ["step"]
    assert "no step is short enough" in stated["verdict"]["problems"][0]["text"]
    assert "bouncing" in {problem["name"] for problem in stated["control_verdict"]["problems"]}


def test_a_joint_that_rests_and_moves_again():
    """Not one that rests before or after."""
    moves = np.array([0.0, 0.0, 1.0, 1.0, 0.0, 0.0])
    assert starts_again(moves[:, None]) == 0
    assert starts_again(np.concatenate([moves, moves])[:, None]) == 1
    assert starts_again(np.concatenate([moves[2:], moves, moves])[:, None]) == 2
    assert starts_again(np.zeros((1, 3))) == 0


@pytest.mark.parametrize(("stiffness", "damping"), [(5.2e4, 9.1), (2.5e4, 31.0)])
def test_bounces_on_a_soft_surface_are_resolved_by_rk4_and_said_to_be(stiffness, damping):
    """It stated 28 N where 0.9 were true: an instant found within a step does not move by one."""
    changes = {
        "compliance.kind": "kelvin_voigt", "compliance.stiffness": stiffness, "compliance.damping": damping,
        "stabiliser.kind": "none", "impact.restitution": 0.0, "time.duration": 0.5, "time.integrator": "rk4",
    }  # fmt: skip
    run = cl.halve(cl.load_scenario("wam_bounce", changes), engine="compiled")
    found = cl.simulate(run.scenario, engine="compiled").summary()
    assert run.halved["force"] <= found["step_error"]["contact_force"] <= 30.0 * run.halved["force"]
    assert found["step_error"]["contact_force"] < 5.0
    assert found["verdict"]["good"]
