"""What a run says of the error of its step, against runs at shorter steps and closed forms."""

import numpy as np
import pytest

import closedloop as cl
import robot_models
from closedloop.command.cautions import warn_of_gains
from closedloop.loop.events.table import IMPACT
from closedloop.mechanics.closure.contact_force import FREE
from closedloop.record.report.growth import bounces_on, comes_out, grows, starts_again
from closedloop.record.report.step_columns import variation
from closedloop.record.report.step_error import GROWS, beside_of, step_rows
from closedloop.scenario.modes import unresolved, unresolved_feedback, wrong_by, wrong_decay

ELASTIC = {"transmission.stiffness": 7e4, "transmission.damping": 3.8, "transmission.motor_inertia": 0.05}


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


@pytest.mark.parametrize(("z", "bad"), [(2.3, True), (1.0, False)])
def test_rk4_damps_a_swing_that_nothing_damps(z, bad):
    """With rk4 an undamped swing of hω = 2.3 is wrong by a tenth and more, as its polynomial says; of 1 it is not."""
    off, rate = wrong_by("rk4", 1e-3, np.array([[(z / 1e-3) ** 2]]), np.zeros((1, 1)))
    polynomial = sum((1j * z) ** k / f for k, f in enumerate((1, 1, 2, 6, 24)))
    assert off == pytest.approx(abs(np.log(polynomial) - 1j * z) / z, rel=1e-9)
    assert rate == pytest.approx(z / 1e-3)
    assert (off > 0.1) == bad


def test_a_step_that_does_not_resolve_elastic_joints_is_bad():
    """What diverges at every shorter step is not good at 1 ms, alone or in a batch."""
    changes = {**ELASTIC, "time.integrator": "rk4", "time.duration": 0.02}
    scenario = cl.load_scenario("wam_slide", changes)
    summary = cl.simulate(scenario, engine="compiled").summary()
    (row,) = cl.simulate_batch(scenario, {"law.force": [scenario.law.force]}).to_pylist()
    assert row["verdict"] == "resolution"
    assert row["step_error_force"] == pytest.approx(summary["step_error_force"], rel=1e-9)
    assert [problem["name"] for problem in summary["verdict"]["problems"]] == ["resolution"]


def faults_of(changes):
    """Return what is said of a changed wam_slide before a run: of arm and surface, and of its law's feedback."""
    scenario = cl.load_scenario("wam_slide", changes)
    robot = cl.Robot(robot_models.load("wam4"), "tip")
    return unresolved(scenario, robot, scenario.start.q, np.array([0.0, 0.0, 1.0]), 0.0), unresolved_feedback(
        scenario, robot
    )


DAHL = {"joint_friction.kind": "dahl", "joint_friction.kinetic": 50.0, "joint_friction.stiffness": 1e5}
LUGRE = {
    "friction.kind": "lugre", "friction.kinetic": 0.2, "friction.static": 0.3, "friction.stribeck_speed": 0.01,
    "friction.stiffness": 1e5, "friction.damping": 316.0,
}  # fmt: skip


def test_bristles_that_the_step_does_not_resolve_are_bad_and_a_shorter_step_is_good():
    """Dahl's bristles in the joints, undamped, grow from rounding with the semi-implicit scheme; rk4 resolves them."""
    still = {"reference.kind": "hold", "law.kp": 1e-9, "law.kd": 1e-9, "time.duration": 0.3}
    (line,), none = faults_of(DAHL)
    assert line.startswith("joint_friction.stiffness: semi_implicit_euler with time.step = 0.001 s gets a swing")
    assert not none
    fast, slow = (
        cl.simulate(cl.load_scenario("wam_slide", {**DAHL, **still, **more}), engine="compiled")
        for more in ({}, {"time.integrator": "rk4", "time.step": 1e-4})
    )
    assert "resolution" in [problem["name"] for problem in fast.summary()["verdict"]["problems"]]
    assert np.max(np.abs(fast.v)) > 1e-3 > 1e-9 > np.max(np.abs(slow.v))
    assert slow.summary()["verdict"]["good"]


@pytest.mark.parametrize("integrator", ["semi_implicit_euler", "rk4", "explicit_euler"])
def test_bristles_at_the_tip_are_compared_with_every_scheme(integrator):
    """The published stiffness asks for a shorter step than 1 ms with each; the step that is named is good."""
    (line,), _ = faults_of({**LUGRE, "time.integrator": integrator, "stabiliser.time_constant": 0.01})
    short = float(line.rsplit(" ", 2)[1])
    assert 1e-5 < short < 1e-3
    finer = {"time.step": short, "time.integrator": integrator, "stabiliser.time_constant": 0.01}
    assert faults_of({**LUGRE, **finer})[0] == []


VISCOUS = {"joint_friction.kind": "coulomb_viscous", "joint_friction.kinetic": 0.68, "joint_friction.viscous": 168.0}


def test_viscous_friction_that_the_step_does_not_resolve_is_bad():
    """The largest rate of H⁻¹B of an arm whose tip is held, by hand; and of the tip itself. A shorter step is good."""
    fast = {"joint_friction.viscous": 400.0, "time.integrator": "rk4", "law.kp": 0.0, "law.kd": 0.0}
    (line,), _ = faults_of({**VISCOUS, **fast})
    scenario = cl.load_scenario("wam_slide")
    robot = cl.Robot(robot_models.load("wam4"), "tip")
    terms = robot.terms(np.array(scenario.start.q), np.zeros(4))
    mobility, along = np.linalg.inv(terms.mass_matrix), terms.jacobian[2]
    mobility -= np.outer(mobility @ along, along @ mobility) / (along @ mobility @ along)
    rate = np.max(np.linalg.eigvals(400.0 * mobility).real)
    assert line.startswith("joint_friction.viscous: rk4 with time.step = 0.001 s gets a decay of")
    assert float(line.split(" 1/s")[0].rsplit(" ", 1)[1]) == pytest.approx(rate, rel=5e-3)
    assert faults_of({**VISCOUS, **fast, "time.step": 5e-4})[0] == []
    (line,), _ = faults_of(
        {"friction.kind": "coulomb_viscous", "friction.coefficient": 0.1, "friction.viscous": 2000.0}
    )
    assert line.startswith("friction.viscous: semi_implicit_euler with time.step = 0.001 s gets a decay of")


def test_a_slip_whose_friction_makes_joints_fast_for_the_step_is_bad_in_a_run_and_in_a_batch():
    """Friction at the tip and in the joints and a law's damping together: with hλ = −2.9 rk4 grew, f was 2 % off."""
    changes = {**VISCOUS, "time.integrator": "rk4", "time.duration": 1.297, "joint_friction.kinetic": 0.6836}
    scenarios = [cl.load_scenario("wam_slide_friction", {**changes, "time.step": h}) for h in (1e-3, 5e-4)]
    coarse, fine = (cl.simulate(scenario, engine="compiled") for scenario in scenarios)
    assert np.max(np.abs(coarse.contact_force - fine.contact_force[::2])) > 0.1
    names = [problem["name"] for problem in coarse.summary()["verdict"]["problems"]]
    assert names == ["resolution"]
    assert fine.summary()["verdict"]["good"]
    for scenario, verdict in zip(scenarios, ("resolution", "good"), strict=True):
        (row,) = cl.simulate_batch(scenario, {"law.force": [scenario.law.force]}, workers=1).to_pylist()
        assert row["verdict"] == verdict


def test_friction_and_a_law_that_damp_joints_together_too_fast_are_said_together():
    """Each alone is resolved."""
    both = {**VISCOUS, "joint_friction.viscous": 60.0, "law.kd": [90.0, 90.0, 45.0, 30.0], "time.duration": 0.5}
    (line,), feedback = faults_of(both)
    assert line.startswith(
        "joint_friction.viscous, law.kp, law.kd: semi_implicit_euler with time.step = 0.001 s gets a "
    )
    assert feedback == faults_of({**both, "joint_friction.viscous": 1.0})[0] == []
    assert faults_of({**both, "law.kd": 1.0})[0] == []
    assert faults_of({**both, "time.duration": 0.3, "law.pd_start": 0.5})[0] == []  # it does not act yet


def test_feedback_that_alternates_is_said_before_the_run(capsys):
    """Where a step makes a decay of the law alternate; not where the torque is held, which is a controller's own."""
    nothing, (line,) = faults_of({"law.kd": 160.0})
    assert not nothing
    assert line.startswith("law.kp, law.kd: semi_implicit_euler with time.step = 0.001 s gets a decay")
    assert faults_of({"law.kd": 160.0, "time.step": float(line.rsplit(" ", 2)[1])}) == ([], [])
    assert faults_of({"law.kd": 160.0, "law.sample_period": 0.001})[1] == []
    assert faults_of({}) == ([], [])
    warn_of_gains(cl.load_scenario("wam_slide", {"law.kd": 160.0}), robot_models.load("wam4"))
    assert capsys.readouterr().err == f"closedloop: warning: {line}\n"


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


def test_a_tip_that_strikes_with_elastic_joints_is_off_by_more_each_time():
    """Which of its strikes come, and when, depends on the motors' swing."""
    changes = {"compensation.kind": "adaptive", "transmission.stiffness": 3850.717075626698, "time.integrator": "rk4",
               "model_error.normal": 0.04295818238057388, "time.duration": 0.5}  # fmt: skip
    run = cl.halve(cl.load_scenario("planar2_drop", changes), engine="compiled")
    stated = cl.simulate(run.scenario, engine="compiled").summary()["step_error"]["position"]
    assert 1e-3 < run.halved["position"] <= stated < 30.0 * run.halved["position"]


def test_a_joint_that_breaks_away_again_is_off_by_more_with_order_one_too():
    """Each time what it is off by is multiplied: f differed by 1.12 N, 0.94 stated."""
    changes = {"compliance.kind": "hunt_crossley", "law.kind": "hybrid", "compensation.kind": "observer",
               "model_error.payload": 0.18102011924964692, "reference.start": 0.01808840989977198,
               "time.integrator": "semi_implicit_euler", "time.duration": 0.694}  # fmt: skip
    stated, off = beside_half_of("joint_friction", changes)
    assert 1.0 < off <= stated["contact_force"] < 5.0 * off


def test_a_joint_that_breaks_away_again_moves_the_tip_by_more_than_it_was_off():
    """As it does the force: the tip was off by 1.1e-5 m, 5.7e-6 stated."""
    changes = {"compliance.kind": "hunt_crossley", "time.integrator": "rk4", "time.duration": 1.36}
    run = cl.halve(cl.load_scenario("joint_friction", changes), engine="compiled")
    stated = cl.simulate(run.scenario, engine="compiled").summary()["step_error"]["position"]
    assert run.halved["position"] <= stated


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


def test_without_a_surface_no_error_of_f_is_stated():
    """Neither a zero nor "not known": there is no f."""
    found = cl.simulate(cl.load_scenario("gripper_block", {"time.duration": 0.02})).summary()
    assert found["step_error"]["contact_force"] is None
    assert found["step_error"]["why_not"] is None
    assert [row[0] for row in step_rows(found["step_error"])] == ["tip is within"]


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
