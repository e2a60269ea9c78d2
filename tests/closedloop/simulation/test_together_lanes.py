"""Simulations that are stepped side by side in SIMD lanes do, to the last bit, what each does alone."""

import numpy as np
import pytest

import closedloop as cl
import closedloop.gym
from closedloop.loop.step.record_row import Row
from closedloop.simulation.ensemble.ensemble import Ensemble
from closedloop.simulation.ensemble.member import AT_MARK, TORQUE, Member
from closedloop.simulation.prepare import prepare

SLIDE = str(closedloop.gym.TASKS["slide"].scenario)
COUNT, STEPS = 19, 4  # two whole groups and three more
# What is simulated; from one control instant to the next the torques change by this share of a normal number, N m.
CASES = {
    "sticks and slips": (SLIDE, {"time.duration": 0.4}, 3.0),
    "sticks": (SLIDE, {"time.duration": 0.2}, 0.2),
    "without friction": (
        "wam_slide",
        {"time.duration": 0.3, "surface.contact": "unilateral", "sensor.noise": 0.1, "sensor.delay": 0.003},
        0.5,
    ),
    "seven joints": ("panda_slide", {"time.duration": 0.2}, 1.0),
    "stribeck": ("wam_slide_friction", {"time.duration": 0.3, "surface.contact": "unilateral"}, 3.0),
}


def problems(name, changes):
    """Return `COUNT` problems that differ in payload and in noise, or are the same."""
    for i in range(COUNT):
        drawn = {"model_error.payload": 0.05 * (i % 3), "sensor.seed": i} if name == SLIDE else {}
        yield prepare(cl.load_scenario(name, changes | drawn))


def played(name, changes, size, threads, alone):
    """Return what is told at each control instant of all, and the share of control steps that were made in lanes."""
    given, told = list(problems(name, changes)), []
    n, random = given[0].robot.n, np.random.default_rng(1)
    plan = np.array([(TORQUE, j, j) for j in range(n)])
    together = Ensemble(COUNT, STEPS, plan, n, held=True, threads=threads)
    for i, problem in enumerate(given):
        together.begin(i, problem)
        if alone:
            Member(together._members[i]).lanes = 0
    together.start(range(COUNT))
    first, place, lanes = together.rows[:, Row.place("torque", n)].copy(), Row.place("kkt_condition", n), 0
    going = np.arange(COUNT)
    for k in range(given[0].steps // STEPS):
        together.actions[:] = first + size * random.normal(size=(COUNT, n)) * (1 + k % 3)
        together.step(going)
        going = going[~together.failed[going]]
        rows = together.rows.copy()
        rows[:, place] = 0.0
        told.append(np.concatenate([rows, together.wanted, together.between], axis=1))
        lanes += sum(Member(together._members[i]).marked == AT_MARK for i in range(COUNT))
    together.close()
    return np.array(told), lanes / (len(told) * COUNT)


@pytest.mark.parametrize("case", CASES)
def test_lanes_are_as_each_alone(case):
    """All that is told is the same to the bit, where lanes go on, are given up, and are taken up again."""
    name, changes, size = CASES[case]
    alone, share = played(name, changes, size, 1, True)
    assert share == 0.0
    together, share = played(name, changes, size, 2, False)
    assert share > 0.1
    assert np.array_equal(alone, together)
