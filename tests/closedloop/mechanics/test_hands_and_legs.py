"""The shipped hand and quadruped: weight carried, nothing slips, energy, by closed forms."""

import numpy as np
import pytest

import closedloop as cl

G, BLOCK, WEIGHT = 9.81, 0.3, 8.912 * 9.81


def test_a_hand_carries_a_block_by_friction_and_then_by_its_lower_finger():
    """The tendon's spring gives 250 (0.04 + 0.08) N on either side; the block stays where it is in the hand."""
    run = cl.simulate(cl.load_scenario("hand_turns"), progress=False)
    pressed, rubbed = run.link_forces.reshape(-1, 2, 4).sum(axis=2), run.link_frictions.reshape(len(run.time), 2, 4, 2)
    assert pressed.sum(axis=1) == pytest.approx(np.full(len(run.time), 2 * 30.0), abs=0.02)  # m r ω² of the fingers
    assert pressed[0] == pytest.approx([30.0, 30.0], rel=1e-9)
    carried = np.linalg.norm(rubbed.sum(axis=2), axis=2)
    assert carried[0] == pytest.approx([BLOCK * G / 2, BLOCK * G / 2], rel=1e-9)
    assert abs(pressed[-1, 1] - pressed[-1, 0]) == pytest.approx(BLOCK * G, rel=1e-4)
    assert np.all(carried[-1] <= 1e-2 * BLOCK * G)
    assert run.q[-1, 0] == pytest.approx(np.pi / 2, abs=1e-3)
    # the block turns about the hand's axis as the hand does, and its centre is on it
    half = 0.5 * (run.q[:, 0] - run.q[0, 0])
    turned = run.q[:, 6:10] * np.sign(run.q[:, 6:7])
    assert turned == pytest.approx(np.column_stack([np.cos(half), np.sin(half), 0 * half, 0 * half]), abs=1e-7)
    assert run.q[:, 3:6] == pytest.approx(np.tile([0.1034, 0.0, 0.4], (len(half), 1)), abs=1e-7)
    balance = run.energy_supplied - run.kinetic_energy - run.potential_energy
    assert np.ptp(balance) <= 1e-7 * WEIGHT
    assert run.summary()["verdict"]["good"]


def test_a_block_too_heavy_for_the_friction_falls():
    """With nine tenths of the friction that would hold it, it falls with a tenth of g."""
    more = {"time.duration": 0.05, "contact.*.friction": 0.9 * BLOCK * G / 60.0}
    run = cl.simulate(cl.load_scenario("hand_turns", more), progress=False)
    assert run.q[:, 5] == pytest.approx(0.4 - 0.05 * G * run.time**2, abs=1e-6)


@pytest.mark.slow
def test_a_quadruped_carries_its_weight_before_and_after_a_push():
    """The feet carry m g at rest, stay where they stand, and no torque acts on the trunk but through them."""
    run = cl.simulate(cl.load_scenario("quadruped"), progress=False)
    feet = run.link_forces[:, :4].sum(axis=1)
    assert feet[-1] == pytest.approx(WEIGHT, rel=1e-3)
    assert run.torque[:, :6] == pytest.approx(np.zeros((len(run.time), 6)))
    pushed = [event for event in run.events if event.kind == "impact"]
    assert len(pushed) == 1
    after = run.time > pushed[0].time
    assert np.max(np.abs(run.q[after, 1])) > 5e-3
    assert abs(run.q[-1, 1]) < 1e-3
    assert np.abs(run.q[:, 2] - 0.279).max() < 0.01
    assert run.summary()["verdict"]["good"]
    assert run.summary()["control_verdict"]["good"]
