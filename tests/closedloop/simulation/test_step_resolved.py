"""What a step does not resolve: bristles, viscous friction, elastic joints, and feedback that is sampled."""

import numpy as np
import pytest

import closedloop as cl
import robot_models
from closedloop.run import warn_of_gains
from closedloop.scenario.load import Variants
from closedloop.scenario.modes import unresolved, unresolved_feedback, unresolved_feedbacks, wrong_by

ELASTIC = {"transmission.stiffness": 7e4, "transmission.damping": 3.8, "transmission.motor_inertia": 0.05}


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
    both = {**VISCOUS, "joint_friction.viscous": 60.0, "law.kd": [90.0, 90.0, 45.0, 30.0]}
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


def test_gains_that_the_step_does_not_resolve_are_bad_though_the_run_is_quiet():
    """In a run, in a batch and in its lanes; with a shorter step they are good."""
    gains = {"law.kd": [60.0, 60.0, 30.0, 160.0], "time.duration": 0.7}
    scenario = cl.load_scenario("wam_slide", gains)
    (problem,) = cl.simulate(scenario, engine="compiled").summary()["verdict"]["problems"]
    assert problem["name"] == "resolution"
    assert problem["text"].startswith("law.kp, law.kd: semi_implicit_euler with time.step = 0.001 s gets a decay of")
    rows = cl.simulate_batch(scenario, {"law.force": [10.0 + 0.1 * i for i in range(8)]}, workers=1).to_pylist()
    assert {row["verdict"] for row in rows} == {"resolution"}
    steps = cl.simulate_batch(
        scenario, {"time.step": [1e-3, 2.5e-4], "stabiliser.time_constant": [1e-3] * 2}, workers=1
    )
    assert [row["verdict"] for row in steps.to_pylist()] == ["resolution", "good"]


MASS, STIFFNESS = 2.0, 2e4
BALL = {"name": "ball", "shape": "ball", "radius": 0.05, "mass": MASS, "position": [0.0, 0.0, 0.05]}
UNDER = {"name": "under", "shape": "box", "edges": [0.1, 0.1, 0.1], "mass": 3.0, "position": [0.0, 0.0, 0.05]}
ROUND = {"link": "ball", "radius": 0.05}
CARRIED = {"kind": "conveyor", "velocity": [0.1, 0.0, 0.0]}
ON_A_BOX = {"link": "ball", "at": "collision", "against": "under", "onto": "collision"}
STANDS = {"name": "stand", "link": "under", "at": "collision"}


@pytest.mark.parametrize(
    ("contact", "others"),
    [
        (ROUND, ()), ({"link": "ball", "at": "collision"}, ()),
        (ROUND | {"surface": {"kind": "sphere", "radius": 0.5}}, ()),
        (ROUND | {"surface": {"kind": "sphere", "radius": 0.5, "inside": True}}, ()),
        (ROUND | {"motion": {"kind": "breathing", "amplitude": 0.001, "frequency": 0.5}}, ()),
        (ROUND | {"surface": {"kind": "cylinder", "radius": 0.3}, "motion": CARRIED}, ()),
        (ON_A_BOX, (STANDS,)),
    ],
    ids=["plane", "shape", "sphere", "bowl", "moves", "cylinder that moves", "two shapes"],
)  # fmt: skip
@pytest.mark.parametrize(("z", "bad"), [(2.3, True), (1.0, False)])
def test_a_soft_contact_swings_at_the_root_of_stiffness_over_mass_whatever_its_surface(contact, others, z, bad):
    """A ball on a spring, ω = √(k/m), of which rk4 makes another swing at hω = 2.3; only planes were looked at."""
    rate, soft = (STIFFNESS / MASS) ** 0.5, {"kind": "kelvin_voigt", "stiffness": STIFFNESS, "damping": 1e-3}
    height = 0.1 if others else 0.0
    bodies = [BALL | {"position": [0.0, 0.0, 0.05 + height]}, *([UNDER] if others else [])]
    own = contact | {"name": "soft", "compliance": soft}
    data = {
        "robot": {"model": "none"}, "body": bodies, "contact": [own, *others],
        "time": {"duration": 10 * z / rate, "step": z / rate, "integrator": "rk4"},
        "stabiliser": {"time_constant": z / rate},
    }  # fmt: skip
    run = cl.simulate(cl.Scenario.model_validate(data), progress=False)
    said = [each["text"] for each in run.summary()["verdict"]["problems"] if each["name"] == "resolution"]
    assert len(said) == bad
    for line in said:
        assert line.startswith("contact.soft.compliance: rk4 with time.step = 0.023 s gets a swing of ")
        assert float(line.split(" rad/s")[0].rsplit(" ", 1)[1]) == pytest.approx(rate, rel=5e-3)


def test_a_soft_surface_that_stiffens_is_judged_at_the_force_that_the_tip_presses_with():
    """A tip that comes to the surface is not in it at the start, where Hertz's stiffness is zero; in lanes likewise."""
    hertz = {"kind": "hunt_crossley", "stiffness": 1e9, "dissipation": 0.0}
    changes = {"compliance": hertz, "surface.contact": "unilateral", "surface.gap": 1e-3, "time.integrator": "rk4"}
    lines, _ = faults_of(changes)
    assert lines[0].startswith("compliance: rk4 with time.step = 0.001 s gets a swing of ")
    assert faults_of({**changes, "compliance": hertz | {"stiffness": 1e6}})[0] == []


SPREAD = {  # by kind of law: gains, and by how many powers of ten they are raised
    "paper": {"law.kp": 6.0, "law.kd": 5.0},
    "hybrid": {"law.kp": 6.0, "law.kd": 5.0, "law.approach_damping": 3.0},
    "operational_space": {"law.motion_stiffness": 7.0, "law.motion_damping": 4.0, "law.posture_damping": 4.0},
    "impedance": {"law.stiffness": 4.0, "law.damping": 4.0, "law.normal_damping": 4.0},
}
SURFACES = {
    "plane": {"surface.contact": "unilateral"},
    "held": {},
    "sphere": {"surface.kind": "sphere", "surface.radius": 0.5},
}


@pytest.mark.parametrize("surface", SURFACES)
@pytest.mark.parametrize("kind", SPREAD)
def test_feedbacks_looked_at_together_are_as_each_alone(kind, surface):
    """Of runs with other gains and other starts the same is said, whatever is beside them."""
    random = np.random.default_rng(len(kind))
    base = cl.load_scenario("wam_slide", {"law.kind": kind, **SURFACES[surface], "reference.kind": "hold"})
    robot = cl.Robot(robot_models.load("wam4"), "tip")
    keys = (*SPREAD[kind], "start.q")
    scenarios = [base, base]
    for _ in range(30):
        gains = [float(10.0 ** random.uniform(0.0, most)) for most in SPREAD[kind].values()]
        if kind in ("paper", "hybrid") and random.uniform() < 0.5:  # one for all joints, or a list
            gains[0] = (gains[0] * random.uniform(0.5, 1.0, robot.n)).tolist()
        scenarios.append(
            Variants(base, keys).scenario((*gains, (base.start.q + random.uniform(-0.3, 0.3, 4)).tolist()))
        )
    some = [Variants(base, keys[:1]).scenario((float(x),)) for x in 10.0 ** random.uniform(0.0, 6.0, 8)]  # of one start
    together = unresolved_feedbacks(scenarios + some, robot)
    assert together == [unresolved_feedback(each, robot) for each in scenarios + some]
    assert any(together)
    assert not all(together)


@pytest.mark.parametrize(
    ("key", "bad"),
    [
        ("law.kp", [1.0, 2.0, float("nan"), 3.0]), ("law.kp", [1.0, 2.0, -1e13, 3.0]), ("law.kd", [1.0, 2.0]),
        ("law.kp", [1.0, 2.0, True, 3.0]), ("start.q", [0.1, 0.2, float("inf"), 0.3]),
        ("start.q", [9.0, 0.0, 0.0, 0.0]),
    ],
)  # fmt: skip
def test_a_bad_number_in_one_run_of_a_batch_is_refused_as_by_itself(key, bad):
    """One run is refused with the line that it says alone, and the others run."""
    base = cl.load_scenario("wam_slide", {"time.duration": 0.02, "reference.kind": "hold"})
    good = list(base.start.q) if key == "start.q" else [100.0, 90.0, 80.0, 70.0]
    rows = cl.simulate_batch(base, {key: [good, bad, good, good]}).to_pylist()
    assert [row["status"] for row in rows] == ["done", "refused", "done", "done"]
    with pytest.raises(cl.ScenarioError) as alone:
        cl.simulate(base.replace({key: bad}), engine="compiled")
    assert rows[1]["reason"] == " ".join(str(alone.value).split())
