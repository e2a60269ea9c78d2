"""What a run says of the error of its step, against runs at shorter steps and closed forms."""

import numpy as np
import pytest

import closedloop as cl
from closedloop.record.report.growth import comes_out, grows
from closedloop.record.report.step_columns import variation
from closedloop.record.report.step_error import GROWS, step_rows
from closedloop.scenario.modes import wrong_decay


def away_from_changes(run, reference, k):
    """Return the largest difference of f from a run of k steps to each, rows beside a change of mode left out, N."""
    other, mode = reference.contact_force[::k], reference.mode[::k]
    beside = np.zeros(len(run), dtype=bool)
    for found in (run.mode, mode):
        for offset in (-1, 0, 1, 2):
            beside[np.clip(np.flatnonzero(np.diff(found)) + offset, 0, len(run) - 1)] = True
    kept = ~beside & (run.mode == mode)
    return np.max(np.abs(run.contact_force - other)[kept])


@pytest.mark.slow
@pytest.mark.parametrize("integrator", ["semi_implicit_euler", "rk4"])
@pytest.mark.parametrize("name", ["wam_slide", "panda_wipe", "soft_table", "joint_friction"])
def test_the_stated_error_bounds_the_true_one_and_is_near_it(name, integrator):
    """At four steps, against a run at an eighth of the shortest: at least the true error, at most 30 times that."""
    finest = 1.25e-4 / 8
    reference = cl.simulate(cl.load_scenario(name, {"time.step": finest, "time.integrator": "rk4"}), engine="compiled")
    for h in (1e-3, 5e-4, 2.5e-4, 1.25e-4):
        run = cl.simulate(cl.load_scenario(name, {"time.step": h, "time.integrator": integrator}), engine="compiled")
        true, stated = away_from_changes(run, reference, round(h / finest)), run.summary()["step_error"]
        assert true <= stated["contact_force"] <= 30.0 * true


def test_variation_of_a_decay_bounds_eulers_error_and_a_jump_is_none():
    """Of a e^-λt explicit Euler's error is within it and 30 times that; an isolated jump adds nothing."""
    n = np.arange(400)
    for z in (0.02, 0.1, 0.4):
        decay = np.exp(-z * n)
        true = np.max(np.abs((1.0 - z) ** n - decay))
        assert true <= variation(decay) <= 30.0 * true
    assert variation(1.0 * (n > 50)) == 0.0


def test_a_jump_does_not_count_and_the_decay_after_it_does():
    """A force that jumps by 20 and decays: explicit Euler's error is within the sum, which is below its first change.

    One that is there in a single row and gone counts as what it is.
    """
    n = np.arange(400)
    for z in (0.02, 0.1, 0.2, 0.5):
        exact, euler = 20.0 * (n > 50) * np.exp(-z * (n - 51.0)), 20.0 * (n > 50) * (1.0 - z) ** np.maximum(n - 51.0, 0)
        true = np.max(np.abs(euler - exact))
        assert true <= variation(euler) <= 10.0 * z * (1.0 + 1e-12)
        assert variation(euler, 4) > 0.1 * z  # its last stage has the jump before it is there
    for size in (1.0, 1.01):
        assert variation(1.0 * (n == 50) - (size - 1.0) * (n == 51)) >= 0.37  # all of it decays in one step


def test_a_smooth_signal_is_of_the_schemes_order_and_a_kink_of_order_one():
    """Half the step leaves a sixth and less with order four, half at a kink; rk4's error on a swing is within it."""
    t = np.linspace(0.0, 20.0, 1601)
    bump, kink = np.exp(-((t - 10.0) ** 2)), np.maximum(0.0, t - 10.0)
    smooth = [variation(bump[::k], 4) for k in (1, 2, 4)]
    assert smooth[0] < smooth[1] / 6.0 < smooth[2] / 36.0
    assert [variation(kink[::k], 4) for k in (2, 4)] == pytest.approx(
        [2.0 * variation(kink, 4), 4.0 * variation(kink, 4)]
    )
    assert variation(bump, 4) < 1e-2 * variation(bump, 1)
    for h in (0.1, 0.3, 0.6):
        n, z = np.arange(200), 1j * h
        made = (1 + z + z**2 / 2 + z**3 / 6 + z**4 / 24) ** n
        assert np.max(np.abs(made.real - np.cos(h * n))) <= variation(np.cos(h * n), 4)


def test_a_decay_is_wrong_where_eulers_factor_is():
    """1 − z against e^-z."""
    for z in (0.1, 1.0, 1.5):
        off, rate = wrong_decay("explicit_euler", 1e-3, np.zeros((1, 1)), np.array([[z / 1e-3]]))
        assert off == pytest.approx(abs(1.0 - z - np.exp(-z)))
        assert rate == pytest.approx(z / 1e-3)


def test_near_a_singular_pose_the_error_of_f_is_not_known_and_that_of_the_tip_is():
    """The row that is nearest to the pose, and with it the largest f, depends on the step."""
    run = cl.simulate(cl.load_scenario("wam_through_singularity"))
    found = run.summary()["step_error"]
    assert found["contact_force"] is None
    assert "singular" in found["why_not"]
    assert found["position"] > 0.0
    labels = [row[0] for row in step_rows(found)]
    assert labels == ["error of the step", "tip is within"]


@pytest.mark.parametrize("name", ["delta", "stewart", "five_bar"])
@pytest.mark.parametrize("integrator", ["semi_implicit_euler", "rk4"])
def test_loops_state_the_error_of_their_step(name, integrator):
    """At least what half the step changes, in f and at the tip."""
    scenario = cl.load_scenario(name, {"time.duration": 0.6, "time.integrator": integrator})
    run = cl.halve(scenario, engine="compiled")
    stated = cl.simulate(scenario, engine="compiled").summary()["step_error"]
    assert run.halved["force"] <= stated["contact_force"]
    assert run.halved["position"] <= stated["position"]


def beside_half_of(name, changes):
    """Return a run and what it states of f, beside how far its f, peak and lowest f are from those at half the step."""
    scenario = cl.load_scenario(name, changes)
    halved = cl.halve(scenario, engine="compiled").halved
    off = [halved["values"][key]["difference"] for key in ("peak_contact_force", "min_contact_force")]
    return cl.simulate(scenario, engine="compiled").summary()["step_error"], max(halved["force"], *off)


RAMP = {"friction.kind": "none", "force_profile.kind": "waypoints", "force_profile.times": [0.0, 0.004],
        "force_profile.forces": [10.0, 12.0]}  # fmt: skip


@pytest.mark.parametrize(
    ("name", "changes"),
    [
        # A held torque lets f drift until the next sample, which no row shows.
        ("wam_hybrid_friction", RAMP),
        # The path starts between two rows, and f is highest there.
        ("planar2_slide", {"reference.start": 0.11535680029245812, "stabiliser.kind": "none",
                           "time.integrator": "rk4"}),
        # The last stage of the step before already has the path that jumps.
        ("soft_table", {"robot.drive_inertia": False, "compliance.stiffness": 203.66421631162567,
                        "time.integrator": "rk4"}),
        # The path starts at a row with elastic joints between: f bends there, and the motors err by a share of a step.
        ("soft_table", {"transmission.stiffness": 60.0, "time.integrator": "rk4"}),
        # Slip begins within a step.
        ("wam_slide_unstabilised", {"friction.kind": "karnopp", "friction.kinetic": 0.2, "friction.static": 0.9,
                                    "friction.dead_band": 1e-3, "time.integrator": "rk4"}),
        # A joint comes to rest, off by some of f, and breaks away again.
        ("joint_friction", {"compliance.kind": "hunt_crossley", "time.integrator": "rk4", "time.duration": 1.0}),
        # A law that feeds the force back reads it a step late.
        ("stewart", RAMP | {"law.force_feedback": 0.044, "surface.kind": "capsule", "time.duration": 0.01}),
        # A joint sticks and slips ever farther: each time it rests, it is off by more.
        ("joint_friction", {"surface_motion.kind": "breathing", "drives.torque_limit": 10.834099421433354,
                            "compliance.kind": "hunt_crossley", "time.integrator": "rk4", "time.duration": 0.3}),
        # The observer takes what the stages leave the surface by for a disturbance.
        ("wam_liftoff", {"surface_motion.kind": "breathing", "compensation.kind": "observer",
                         "stabiliser.kind": "both", "time.duration": 0.1}),
        # So does an admittance.
        ("wam_through_singularity", {"law.kind": "admittance", "time.integrator": "rk4", "time.duration": 0.1}),
        # The path starts in the last row, where f of a soft surface does not jump.
        ("soft_table", {"time.integrator": "rk4", "time.duration": 0.5}),
        # A soft surface takes the tip along.
        ("wam_stick_slip", {"surface_motion.kind": "breathing", "compliance.kind": "kelvin_voigt",
                            "time.duration": 0.1}),
        # The integral of a sampled law reads a step of f_des a sample late.
        ("wam_hybrid_friction", {"force_profile.kind": "step", "force_profile.at": 0.004, "force_profile.to": 10.4,
                                 "time.duration": 0.1}),
        # A stabiliser answers rounding.
        ("stewart", {"model_error.masses": 1.3004132773938586, "model_error.payload": 0.8402064578624012,
                     "time.integrator": "rk4", "time.duration": 0.3}),
        # A learned coefficient is held at zero.
        ("stewart", {"compensation.kind": "adaptive", "reference.start": 0.02219162859778255, "time.integrator": "rk4",
                     "time.duration": 0.3}),
    ],
)  # fmt: skip
def test_what_happens_between_two_rows_is_in_the_stated_error(name, changes):
    """Largest and least f too, which lie between the rows of the longer step."""
    stated, off = beside_half_of(name, {"time.duration": 0.6, **changes})
    assert stated["why_not"] is None
    assert 0.0 < off <= stated["contact_force"] < 1.0


def test_a_jump_in_the_last_row_has_an_error():
    """No row shows how fast f decays after it: the path starts there, and f differed by 0.055 N, 0.011 stated.

    A sixth of the jump of 16 N is assumed, as of a law that decays within a step; of stiffer laws a twentieth was seen.
    """
    changes = {"surface_motion.kind": "breathing", "time.integrator": "rk4", "time.duration": 1.0}
    stated, off = beside_half_of("wam_liftoff", changes)
    assert 0.01 < off <= stated["contact_force"] < 60.0 * off


def test_of_a_stiff_law_a_jump_in_the_last_row_has_an_error():
    """A step of rk4 has answered a twentieth of it: 0.0095 N, where 0.0078 were stated."""
    gains = [x for leg in (208.4, 174.8, 210.5, 199.6, 118.3, 224.2) for x in (0.0, 0.0, leg)]
    changes = {"law.kd": gains + [0.0] * 6, "time.integrator": "rk4", "time.duration": 0.5}
    stated, off = beside_half_of("stewart", changes)
    assert 1e-3 < off <= stated["contact_force"]


def test_noise_in_the_last_row_alone_is_not_known():
    """The law's velocities count from the path's start on, which is the last row: 1.5 N, 0.18 N stated; not one before.

    In a batch too.
    """
    for duration, known in ((0.5, False), (0.6, True)):
        changes = {"encoder.velocity_noise": 0.0273, "time.duration": duration, "time.integrator": "rk4"}
        scenario = cl.load_scenario("panda_slide", changes)
        found = cl.simulate(scenario, engine="compiled").summary()["step_error"]
        assert (found["contact_force"] is not None) == (found["extremes"] is not None) == known
        assert found["why_not"].startswith("noise is drawn at each step")
        (row,) = cl.simulate_batch(scenario, {"law.force": [scenario.law.force]}).to_pylist()
        assert (row["step_error_force"] is not None) == known


def test_the_lowest_force_may_lie_between_two_rows():
    """f falls until it jumps: at half the step another row is nearer to the jump. 0.0107 N, 0.0066 stated."""
    changes = {"force_profile.kind": "step", "force_profile.at": 0.004, "force_profile.to": 12.0,
               "sensor.quantisation": 0.23, "time.duration": 0.05, "time.integrator": "rk4"}  # fmt: skip
    run = cl.halve(cl.load_scenario("payload_mismatch", changes), engine="compiled")
    stated = cl.simulate(run.scenario, engine="compiled").summary()["step_error"]
    off = run.halved["values"]["min_contact_force"]["difference"]
    assert stated["contact_force"] < off <= stated["extremes"] < 10.0 * off


def test_a_joint_that_breaks_away_again_is_off_by_more_with_order_one_too():
    """Each time what it is off by is multiplied: f differed by 1.12 N, 0.94 stated."""
    changes = {"compliance.kind": "hunt_crossley", "law.kind": "hybrid", "compensation.kind": "observer",
               "model_error.payload": 0.18102011924964692, "reference.start": 0.01808840989977198,
               "time.integrator": "semi_implicit_euler", "time.duration": 0.694}  # fmt: skip
    stated, off = beside_half_of("joint_friction", changes)
    assert 1.0 < off <= stated["contact_force"] < 5.0 * off


def test_where_contacts_of_links_change_the_error_of_the_force_at_the_tip_is_not_known():
    """It follows the friction of a block that sticks and slips: 0.44 N off at half the step, 0.22 were stated."""
    changes = {"law.kind": "admittance", "surface.normal": [0.0, 0.0, 1.0], "time.duration": 0.6}
    run = cl.halve(cl.load_scenario("push_block", changes), engine="compiled")
    stated = cl.simulate(run.scenario, engine="compiled").summary()["step_error"]
    assert run.halved["force"] > 0.4
    assert stated["contact_force"] is None
    assert stated["why_not"].startswith("contacts of links change while the tip is in contact")
    assert run.halved["position"] <= stated["position"]
    before = cl.load_scenario("push_block", changes | {"time.duration": 0.5})  # the pusher has not yet come there
    assert cl.simulate(before, engine="compiled").summary()["step_error"]["contact_force"] is not None


def test_exponential_growth_is_no_sum_of_the_steps_errors():
    """From rounding to a newton, also as a swing; not a path that starts as t⁵, nor noise, nor a jump."""
    t = np.linspace(0.0, 1.0, 601)
    rng = np.random.default_rng(0)
    assert grows(1e-15 * np.exp(35.0 * t))
    assert grows(1e-15 * np.exp(35.0 * t) * np.sin(200.0 * t))
    assert grows(300.0 + 1e-10 * np.exp(28.0 * t))  # off by as much in all rows
    assert grows(1e-12 * np.exp(9.0 * t) * np.sin(300.0 * t))  # from rounding: less is enough
    assert not grows(1e-6 * np.exp(9.0 * t) * np.sin(300.0 * t))
    # From what a stabiliser makes of rounding, as an elastic joint does that is too soft for the law.
    assert grows(rng.normal(size=601) * 5e-10 + 1e-9 * np.exp(20.0 * np.maximum(0.0, t - 0.45)))
    assert grows(1e-9 * np.exp(20.0 * np.maximum(0.0, t - 0.4)))  # less steep, and longer
    assert not grows(1e-9 * np.exp(5.0 * t) + 1.0 * (t > 0.7))  # slow growth, and then a jump
    for other in (t**3, t**5, np.maximum(0.0, t - 0.5) ** 5, rng.normal(size=601), 1.0 * (t > 0.7), 0.0 * t, t[:5]):
        assert not grows(other)
    for start in (0.0, 0.2, 0.33, 0.5):
        for power in (3, 4, 5):
            assert not grows(5e-10 * rng.normal(size=601) + 1e-3 * np.maximum(0.0, t - start) ** power)
            assert comes_out(1e-9 + 10.0 * np.maximum(0.0, t - start) ** power) == 1.0
    assert comes_out(1e-9 * np.exp(5.0 * t)) < 100.0
    assert comes_out(1e-9 * np.exp(10.0 * np.maximum(0.0, t - 0.4))) == pytest.approx(np.exp(6.0), rel=0.5)


def test_growth_that_comes_out_of_rounding_is_in_what_is_stated():
    """WAM with joints that are too soft for its law diverges at 0.8 s; at 0.4 s f was 1.6e-5 N off, 1.4e-5 N stated."""
    changes = {"friction.exponent": 0.2749416522297006, "friction.kinetic": 0.023964718001378695,
               "transmission.stiffness": 322.8849845121768}  # fmt: skip
    for duration, known in ((0.407, True), (0.509, False)):
        run = cl.halve(
            cl.load_scenario("wam_hybrid_friction", changes | {"time.duration": duration}), engine="compiled"
        )
        stated = cl.simulate(run.scenario, engine="compiled").summary()["step_error"]
        if known:
            assert run.halved["force"] < stated["contact_force"] < 10.0 * run.halved["force"]
        else:
            assert stated["contact_force"] is None
            assert stated["why_not"] == GROWS


def test_without_a_surface_no_error_of_f_is_stated():
    """Neither a zero nor "not known": there is no f."""
    found = cl.simulate(cl.load_scenario("gripper_block", {"time.duration": 0.02})).summary()
    assert found["step_error"]["contact_force"] is None
    assert found["step_error"]["why_not"] is None
    assert [row[0] for row in step_rows(found["step_error"])] == ["tip is within"]


@pytest.mark.parametrize("changes", [{"sensor.noise": 0.5}, {"encoder.velocity_noise": 0.01}])
def test_with_noise_the_error_of_the_tip_is_not_known(changes):
    """Another step draws another noise, and the tip follows it; f's error has what rows show of it."""
    scenario = cl.load_scenario("wam_slide", {**changes, "time.duration": 0.02})
    found = cl.simulate(scenario).summary()
    assert found["step_error"]["position"] is None
    assert found["step_error"]["why_not"].startswith("noise is drawn at each step")
    assert found["not_finite"] == []
    (row,) = cl.simulate_batch(scenario, {"law.force": [scenario.law.force]}).to_pylist()
    assert row["step_error_position"] is None
    assert row["step_error_force"] == pytest.approx(found["step_error"]["contact_force"], rel=1e-6, abs=1e-8)
    assert row["step_error_extremes"] == pytest.approx(found["step_error"]["extremes"], rel=1e-6, abs=1e-8)
