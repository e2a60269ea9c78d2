"""Mechanisms with loops under a controller that errs, reads encoders or drives through springs, and with dop853."""

import dataclasses

import numpy as np
import pytest

import closedloop as cl
from robot_models import load

# The controller takes the links for lighter than they are, and the arm sags: a motion without a jump of the reference.
MOVED = {"reference.start": 1.0, "model_error.masses": 0.8}


def five_bar(duration=0.06, step=0.002, **changes):
    """The run of the five-bar that presses and slides, its line begun early."""
    usual = {
        "time.duration": duration, "time.step": step, "time.integrator": "rk4", "law.pd_start": 0.0,
        "reference.start": 0.01, "reference.stop": 4.0,
    }  # fmt: skip
    return cl.simulate(cl.load_scenario("five_bar", usual | changes))


def apart(one, other):
    """The largest differences of positions, rad, and of contact forces, N."""
    return np.abs(one.q - other.q).max(), np.abs(one.contact_force - other.contact_force).max()


@pytest.fixture(scope="module")
def plain():
    """The run without any of it, its torque held over each step as that of a controller with encoders is."""
    return five_bar(**{"law.sample_period": 0.002})


@pytest.mark.parametrize(
    "changes",
    [
        {"model_error.normal_towards": 0.3},
        {"encoder.noise": 1e-14},
        {"encoder.noise": 1e-14, "model_error.masses": 1.0 + 1e-14},
    ],
)
def test_no_error_changes_nothing(plain, changes):
    """What the controller sees through errors and encoders of no size is the mechanism itself, loops included."""
    run = five_bar(**{"law.sample_period": 0.002, "time.integrator": "rk4"}, **changes)
    q, f = apart(run, plain)
    assert q < 1e-10
    assert f < 1e-6


def test_errors_act():
    """Masses that are wrong leave an error, and coarse encoders are read at every joint: the loops stay closed."""
    run = five_bar(**{"model_error.masses": 0.8, "encoder.quantisation": 1e-3, "encoder.noise": 1e-3})
    assert np.max(np.abs(run.loops.errors)) < 1e-14
    assert np.max(run.loops.unexplained) < 1e-9
    assert 1e-4 < np.std(run.measured_position - run.q) < 1e-2
    assert not np.any(run.torque[:, [1, 3]])
    assert 0.1 < abs(run.contact_force[-1] - 10.0) < 5.0


def test_stiff_springs_are_rigid_drives():
    """The motion goes to that of rigid drives as 1/k; the joints without a drive have neither spring nor motor."""
    off, rigid = [], five_bar(step=0.0005, **MOVED)
    for k in (2e3, 8e3):
        run = five_bar(step=0.0005, **MOVED, **{"transmission.stiffness": k, "transmission.damping": 10.0})
        assert not np.any(run.transmitted_torque[:, [1, 3]])
        assert not np.any(run.motor_velocity[:, [1, 3]])
        assert np.max(run.loops.unexplained) < 1e-9
        off.append(np.abs(run.q - rigid.q)[-20:].max())  # once the springs have taken up the load
    assert 3.0 < off[0] / off[1] < 5.0
    assert off[0] < 1e-7


@pytest.mark.parametrize("given", [{}, {"transmission.motor_inertia": 0.02}])
def test_a_joint_without_a_drive_has_no_motor(given):
    """An inertia that turns with its axis is the link's: it has no speed of a motor, and the law sees it in H once."""
    model = dataclasses.replace(load("five_bar"), armature=np.full(4, 0.02))
    changes = {"transmission.stiffness": 4e3, "transmission.damping": 10.0, "time.duration": 0.004}
    seen = []

    def law(x):
        seen.append((x.q.copy(), x.v.copy(), x.H.copy()))
        return x.C

    run = cl.simulate(cl.load_scenario("five_bar", changes | given), model=model, law=law)
    assert np.all(run.motor_velocity[1:, model.driven] != 0.0)
    assert not np.any(run.motor_velocity[:, ~model.driven])
    for q, v, H in seen:
        np.testing.assert_allclose(H, cl.Robot(model).terms(q, v).mass_matrix, rtol=1e-12)


def energy(run, k, inertia):
    """The energy of links, springs and motors of the drives, J."""
    drives, motors = run.motor_position - run.q, run.motor_velocity
    each = 0.5 * k * drives**2 + 0.5 * inertia * motors**2
    return run.kinetic_energy + run.potential_energy + each[:, [0, 2]].sum(axis=1)


def test_energy_of_elastic_drives():
    """Free of the surface and without a law, links, springs and motors keep their energy to the integrator's order."""
    lost = []
    for step in (0.002, 0.0005):
        changes = {
            "surface.contact": "unilateral", "surface.gap": 0.2, "reference.kind": "hold", "stabiliser.kind": "none",
            "transmission.stiffness": 300.0, "time.duration": 0.08, "time.step": step, "time.integrator": "rk4",
        }  # fmt: skip
        run = cl.simulate(cl.load_scenario("five_bar", changes), law=lambda x: 0.0 * x.q)
        assert np.ptp(run.motor_velocity) > 0.01
        lost.append(np.ptp(energy(run, 300.0, 0.02)))
    assert lost[0] < 1e-5
    assert lost[1] < lost[0] / 200.0


def test_dop853_is_rk4_with_small_steps():
    """With its loops closed at every state the adaptive scheme gives what small steps do, in contact and before it."""
    fine, run = five_bar(0.03, 0.00025, **MOVED), five_bar(0.03, **MOVED, **{"time.integrator": "dop853"})
    assert np.ptp(run.q[:, 0]) > 1e-6
    np.testing.assert_allclose(run.q, fine.q[::8], atol=1e-9)
    np.testing.assert_allclose(run.contact_force, fine.contact_force[::8], rtol=1e-5)
    assert np.max(np.abs(run.loops.errors)) < 1e-14
    usual = {"time.duration": 0.02, "time.step": 0.001}
    fine, run = (
        cl.simulate(cl.load_scenario("four_bar", usual | {"time.integrator": name})) for name in ("rk4", "dop853")
    )
    np.testing.assert_allclose(run.q, fine.q, atol=1e-11)


def test_dop853_bounces():
    """The four-bar strikes the wall at the instants of steps of fixed length."""
    runs = [
        cl.simulate(cl.load_scenario("four_bar", {"time.duration": 0.16, "time.integrator": name, "time.step": 0.002}))
        for name in ("rk4", "dop853")
    ]
    instants = [[event.time for event in run.events] for run in runs]
    assert len(instants[0]) >= 1
    np.testing.assert_allclose(instants[1], instants[0], atol=1e-8)
