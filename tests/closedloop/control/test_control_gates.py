"""Closed forms of force control, met by the whole simulator: every law, three arms, three integrators."""

import numpy as np
import pytest

import closedloop as cl
from closedloop.control import law

# Those that press.
LAWS = [kind for kind in law.LAWS if kind != "none"]
# The force of these follows from a set point that moves; a servo of joint positions presses only once it has moved.
ON_SET_POINTS = {"admittance", "servo_admittance"}

ARMS = {
    "wam4": ("wam_slide", {"law.kp": 400.0, "law.kd": 30.0}),
    "panda": ("panda_slide", {}),
    "ur5": (
        "wam_slide",
        {
            "robot.model": "ur5",
            "robot.tip": "tool0",
            "start": {"q": [0.3, -1.2, 1.5, -1.9, -1.57, 0.2]},
            "surface.normal": [0.0, 0.2, 1.0],
            "law.kp": [900.0, 900.0, 400.0, 50.0, 50.0, 5.0],
            "law.kd": [60.0, 60.0, 40.0, 5.0, 5.0, 0.5],
        },
    ),
}
# f = f_c + d whatever the motion: the laws that take the arm's own dynamics out.
DECOUPLED = ("operational_space", "dynamic_hybrid", "impedance")


def press(arm, kind, **changes):
    """Simulate an arm that presses under a law; `a__b` stands for the key a.b. It holds still unless told otherwise."""
    name, own = ARMS[arm]
    settings = {"reference": {"kind": "hold"}, "time.duration": 0.1} | own | {"law.kind": kind, "law.force": 10.0}
    if kind not in ("paper", "hybrid"):  # the others have no gains of joints
        settings = {key: value for key, value in settings.items() if key not in ("law.kp", "law.kd")}
    return cl.simulate(
        cl.load_scenario(name, settings | {key.replace("__", "."): value for key, value in changes.items()})
    )


@pytest.mark.parametrize("arm", ARMS)
@pytest.mark.parametrize("kind", [kind for kind in LAWS if kind != "servo_admittance"])
def test_every_law_presses_as_told_at_rest(arm, kind):
    """Without friction f = f_des within 1e-9 N and nothing moves, force integral and observer or not.

    By projection: Baumgarte's spring of 1e6 1/s² makes up to 1e-9 N of the last place of r alone.
    """
    for extra in ({}, {"law__force_integral": 20.0, "compensation__kind": "observer"}):
        run = press(arm, kind, time__duration=0.05, stabiliser__kind="projection", **extra)
        assert np.max(np.abs(run.contact_force - 10.0)) < 1e-9
        assert np.max(np.abs(run.v)) < 1e-11


@pytest.mark.parametrize(
    ("scheme", "order"), [("semi_implicit_euler", 1), ("explicit_euler", 1), ("rk4", 4)], ids=lambda x: str(x)
)
@pytest.mark.parametrize("kind", [kind for kind in LAWS if kind not in ON_SET_POINTS])
def test_force_error_decays_as_the_integral_says(kind, scheme, order):
    """A sensor that is off by b from t = 0 on: f_des − f = b (1 − exp(−K_I t)), to the order of the integrator."""
    bias, K_I = 1.5, 40.0
    errors = []
    for h in (1e-3, 5e-4):
        run = press(
            "wam4", kind, law__force_integral=K_I, sensor__bias=bias, time__step=h, time__integrator=scheme,
            stabiliser__kind="projection",
        )  # fmt: skip
        exact = bias * (1.0 - np.exp(-K_I * run.time))
        errors.append(np.max(np.abs(10.0 - run.contact_force - exact)))
    rounding = 1e-10
    assert errors[1] < max(1.1 * (0.5 * K_I * 5e-4 * bias) ** order, rounding)
    assert errors[0] / errors[1] > 0.9 * 2**order or errors[1] < rounding


@pytest.mark.parametrize("scheme", ["semi_implicit_euler", "rk4"])
def test_observer_rejects_a_disturbance_at_its_rate(scheme):
    """A false reading is a force that the observer takes out like exp(−K_o t), to the order of the integrator."""
    bias, K_o, errors = 1.5, 40.0, []
    for h in (1e-3, 5e-4):
        run = press(
            "wam4", "operational_space", compensation={"kind": "observer", "rate": K_o}, sensor__bias=bias,
            time__step=h, time__integrator=scheme, stabiliser__kind="projection",
        )  # fmt: skip
        exact = bias * (1.0 - np.exp(-K_o * run.time))
        errors.append(np.max(np.abs(10.0 - run.contact_force - exact)))
    assert errors[1] < (2e-2 if scheme == "semi_implicit_euler" else 1e-6)
    assert errors[0] / errors[1] > (1.8 if scheme == "semi_implicit_euler" else 14.0)


@pytest.mark.parametrize("arm", ARMS)
@pytest.mark.parametrize("kind", DECOUPLED)
def test_friction_in_joints_costs_the_force_what_it_must(arm, kind):
    """In every row of a slide f − f_des is −A H⁻¹τ/(A H⁻¹Aᵀ), τ the friction of the joints."""
    run = press(
        arm,
        kind,
        reference={"kind": "line", "direction": [0.0, 1.0, -0.2] if arm == "ur5" else [0.0, 1.0, 0.0], "speed": 0.05,
                   "start": 0.02, "stop": 0.2, "timing": "minimum_jerk"},
        joint_friction={"kind": "coulomb_viscous", "kinetic": 0.2, "viscous": 0.5},
        stabiliser__kind="projection",
    )  # fmt: skip
    problem = cl.prepare(run.scenario)
    n = problem.plane.normal
    worst = 0.0
    for i in range(10, len(run), 9):
        terms = problem.robot.terms(run.q[i], run.v[i])
        row = n @ terms.jacobian
        mobility = row @ np.linalg.solve(terms.mass_matrix, row)
        lost = row @ np.linalg.solve(terms.mass_matrix, run.joint_friction[i]) / mobility
        worst = max(worst, abs(lost))
        assert run.contact_force[i] - 10.0 == pytest.approx(-lost, abs=1e-9)
    assert worst > 0.05


@pytest.mark.slow
@pytest.mark.parametrize("arm", ["panda", "ur5"])
@pytest.mark.parametrize(
    "kind", [kind for kind in LAWS if kind != "servo_admittance"]
)  # its servo is as stiff as each arm allows
def test_every_law_serves_other_arms(arm, kind):
    """On a rough surface, with the gains of a scenario for the joint laws and the defaults for the others.

    From half a second after break-away to the end of the motion: 10 N within 0.05 N and the path within 0.1 mm, RMS.
    """
    run = press(
        arm,
        kind,
        reference={"kind": "line", "direction": [0.0, 1.0, -0.2] if arm == "ur5" else [0.0, 1.0, 0.0], "speed": 0.02,
                   "start": 0.3, "stop": 3.3, "timing": "minimum_jerk"},
        friction={"kind": "stribeck", "kinetic": 0.25, "static": 0.3, "stribeck_speed": 0.005, "viscous": 1.0},
        law__force_integral=20.0,
        law__sample_period=0.001,
        compensation={"kind": "observer"},
        time={"duration": 3.0, "step": 0.00025},
    )  # fmt: skip
    normal = np.array(run.scenario.surface.normal) / np.linalg.norm(run.scenario.surface.normal)
    off = run.position - run.reference_tip
    off -= np.outer(off @ normal, normal)
    late = run.time > 1.5
    assert np.sqrt(np.mean((run.contact_force[late] - 10.0) ** 2)) < 0.05
    assert np.sqrt(np.mean(np.sum(off[late] ** 2, axis=1))) < 1e-4
