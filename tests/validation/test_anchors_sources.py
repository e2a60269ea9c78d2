"""The published robots as they were written down: every printed parameter matters, and nothing that was added does."""

import copy
from dataclasses import replace

import numpy as np
import pytest

from validation.anchors import grade, iiwa, puma560, reference_problems
from validation.anchors.problem import joint, link, read, robot
from validation.oracle import Oracle

PUMA = read("puma560")
IIWA = read("iiwa_motion_genesis")
PROBLEMS = {problem.name: problem for problem in reference_problems()}


def failures(name, model):
    """Return the cases that fail with another robot in place of the published one."""
    results = grade(Oracle.from_model, replace(PROBLEMS[name], model=model))
    assert results
    return [result.case for result in results if not result.passed]


def puma(key, *index, factor):
    """Return the Puma 560 with one published value multiplied."""
    data = copy.deepcopy(PUMA)
    row = data[key]
    for i in index[:-1]:
        row = row[i]
    assert row[index[-1]] != 0.0
    row[index[-1]] *= factor
    return puma560.build(data, data["gravity"], possible=False)


def test_puma_unaltered_passes():
    """The negative controls below start from a pass."""
    assert failures("Puma 560", puma560.build(PUMA, PUMA["gravity"], possible=False)) == []


# One per cent of masses, lengths, twists and drive inertias; the sign of moments and of coordinates of centres of mass.
PUMA_VALUES = [("m", i, 1.01) for i in range(1, 6)]
PUMA_VALUES += [(key, i, k, -1.0) for key in "Ir" for i in range(6) for k in range(3) if PUMA[key][i][k]]
PUMA_VALUES += [(key, i, 1.01) for key in ("Jm", "a", "d", "alpha") for i in range(6) if PUMA[key][i]]
PUMA_VALUES.remove(("d", 0, 1.01))  # the height of the base moves nothing


@pytest.mark.parametrize("value", PUMA_VALUES[::4], ids=str)
def test_every_value_of_the_puma_matters(value):
    """What is published with another value fails a case: a quarter of the values, of every kind."""
    *place, factor = value
    assert failures("Puma 560", puma(*place, factor=factor))


def test_puma_regrouped_is_the_same_arm():
    """The bodies that can exist move exactly like the printed ones, of which two cannot."""
    arms = [Oracle.from_model(puma560.build(PUMA, 9.81, possible=possible)) for possible in (True, False)]
    rng = np.random.default_rng(0)
    differences = []
    for _ in range(20):
        q, v, a = rng.uniform(-3.0, 3.0, (3, 6))
        regrouped, printed = (arm.inverse_dynamics(q, v, a) for arm in arms)
        differences.append(np.max(np.abs(regrouped - printed)))
        assert np.max(np.abs(arms[0].mass_matrix(q) - arms[1].mass_matrix(q))) < 1e-13
    assert max(differences) < 2e-13  # a hundred ε of torques up to 100 N m
    assert max(differences) > 0.0  # they are two descriptions
    masses, moments = list(PUMA["m"]), [list(row) for row in PUMA["I"]]

    def can_exist(moment):
        return all(2.0 * moment[k] <= sum(moment) for k in range(3))

    assert [can_exist(moment) for moment in moments] == [False, True, False, True, True, True]
    puma560._possible(masses, moments)
    assert all(map(can_exist, moments))
    assert min(masses) > 0.0


def test_puma_friction_is_that_of_the_toolbox():
    """B G² q̇ + |G| T_c is all that the printed torque at q̇ = 1 has beyond that of an arm without friction."""
    friction = puma560._friction(PUMA, np.ones(6))
    arm = Oracle.from_model(puma560.build(PUMA, 9.81))
    printed = np.array(PUMA["published"]["rne_v"]["value"])
    implied = printed - arm.bias(np.array(PUMA["states"]["qn"]), np.ones(6))
    assert np.allclose(friction, implied, rtol=0.0, atol=5e-5)
    assert np.all(puma560._friction(PUMA, -np.ones(6)) < 0.0)
    assert not np.any(puma560._friction(PUMA, np.zeros(6)))


@pytest.mark.parametrize(("key", "place"), [*(("mass", (i,)) for i in (0, 3, 6)), ("I_com", (0, 2)), ("I_com", (4, 1))])
def test_every_value_of_the_iiwa_matters(key, place):
    """One per cent of a mass or a moment is seen; link 1 turns about its own axis, with its mass 0.03 m off."""
    data = copy.deepcopy(IIWA)
    row = data[key]
    for i in place[:-1]:
        row = row[i]
    row[place[-1]] *= 1.01
    assert failures("KUKA iiwa, MotionGenesis, g = 0", iiwa.build(data, 0.0))


def test_iiwa_bound_is_the_weight_torque():
    """The torque that the bound is relative to is the largest of the bent arm at rest."""
    (at_rest,) = [entry for entry in IIWA["torques"]["9.8"] if entry["state"] == "at rest"]
    assert np.max(np.abs(at_rest["torque"])) == pytest.approx(iiwa.WEIGHT_TORQUE, rel=1e-3)


def test_iftomm_values_are_the_closed_form():
    """x = −sin φ, z = −cos φ with sin(φ/2) = k sn(K − ω₀t): the printed values, by scipy's elliptic functions."""
    from scipy.special import ellipj, ellipk

    data = read("iftomm_pendulum")
    rate, K = np.sqrt(data["gravity"] / data["length"]), ellipk(0.5)
    assert data["period"] == pytest.approx(4.0 * K / rate, rel=1e-14)
    t, x, y = np.array(data["positions"]).T
    sn, _, dn, _ = ellipj(K - rate * t, 0.5)
    half = np.sqrt(0.5) * sn
    assert np.allclose(x, -2.0 * half * dn, rtol=0.0, atol=1e-13)
    assert np.allclose(y, 2.0 * half**2 - 1.0, rtol=0.0, atol=1e-13)


def test_iftomm_body_swings_like_the_point():
    """Twice the mass at half the length with moment m L²/2 has the accelerations of the point that A01 names."""
    parts = [
        link("base"),
        link("arm"),
        link("point", 1.0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
        joint("pivot", "revolute", "base", "arm", axis=(0.0, -1.0, 0.0)),
        joint("rod", "fixed", "arm", "point", xyz=(0.0, 0.0, -1.0)),
    ]
    point = Oracle.from_model(robot("point", parts, ["pivot"], "point"))
    body = Oracle.from_model(PROBLEMS["IFToMM A01 pendulum"].model)
    for angle in np.linspace(-3.0, 3.0, 13):
        state = np.array([angle]), np.array([1.3]), np.zeros(1)
        assert np.allclose(point.forward_dynamics(*state), body.forward_dynamics(*state), rtol=0.0, atol=1e-14)
        assert np.allclose(point.position(state[0]), body.position(state[0]), rtol=0.0, atol=1e-15)


def test_painleve_rod_has_its_critical_friction():
    """At tan θ = 2 and μ = 4/3 a normal force makes no normal acceleration; with more friction a negative one."""
    states = read("painleve_rod")["states"]
    critical = states[1]
    assert np.tan(critical["theta"]) == pytest.approx(2.0, rel=1e-15)
    expected = [float(case.expected) for case in PROBLEMS["Painlevé rod"].cases]
    assert expected[1] == pytest.approx(0.0, abs=1e-15)
    assert min(expected) < -0.1
    assert max(expected) > 0.1


@pytest.mark.parametrize("name", [name for name in PROBLEMS if "planar arm" not in name])
def test_robots_are_accepted_by_the_loader(name):
    """What is published can be simulated too: the inspection of robot_models finds nothing impossible."""
    import robot_models

    model = PROBLEMS[name].model
    n = len(model.joint_names)
    loaded = robot_models.from_text(
        model.text,
        "urdf",
        name="reference",
        armature=model.armature,
        tip=PROBLEMS[name].tip,
        home=np.full(n, 0.1),
        locked={},
        gravity=model.gravity,
    )
    assert loaded.joint_names == model.joint_names
