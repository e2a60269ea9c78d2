"""Energy of an arm without torque through flight, impacts, contact and liftoff: whatever happens, it never grows.

The adaptive integrator keeps energy to its tolerance, 1e-12 a step, so that a contact that gave any would show.
"""

import itertools

import numpy as np
import pytest
from budget import budget
from test_contact_random import ARMS, SCENARIO, draw

import closedloop as cl

FRICTION = {"friction.kind": "coulomb", "friction.coefficient": 0.4}
# As a share of 1 J and the largest kinetic energy. The worst of 60 drops of each arm, with friction and without, rise
# by 1.5e-14 from row to row; those without friction miss their balance by 1.6e-14.
RISE, BALANCE = 1e-13, 1e-13


def limp(t, q, v, terms):
    """Give no torque."""
    return np.zeros(q.size)


def limp_drop(arm, rng, **changes):
    """Return the run of a random drop without torque, or what there is of it if it cannot go on."""
    overrides = draw(arm, rng) | {"time.integrator": "dop853", "time.duration": 0.2, "time.step": 0.002} | changes
    try:
        return cl.simulate(cl.load_scenario(SCENARIO[arm], overrides), law=limp, model=ARMS[arm].model)
    except cl.SimulationError as error:
        return error.run


def check_energy(run, smooth):
    """Fail if energy rises from row to row or at an event, or on a smooth surface is not less by what events took."""
    energy, scale = run.kinetic_energy + run.potential_energy, 1.0 + np.max(run.kinetic_energy)
    assert np.max(np.diff(energy)) < RISE * scale
    assert np.all(run.event_energy_lost >= -1e-15 * scale)
    if smooth:
        lost = np.concatenate([[0.0], np.cumsum(run.event_energy_lost)])
        lost = lost[np.searchsorted(run.event_time, run.time, side="right")]
        assert np.max(np.abs(energy - energy[0] + lost - lost[0])) < BALANCE * scale


# Each arm and each surface once; with the full budget each arm on each surface.
EVERY = budget([("planar2", FRICTION), ("wam4", {})], list(itertools.product(ARMS, ({}, FRICTION))))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arm", "friction"), EVERY, ids=[f"{arm}-{'rough' if rubs else 'smooth'}" for arm, rubs in EVERY]
)
def test_energy_never_grows_by_the_contact(arm, friction):
    """Random drops, with any stabiliser, restitution and law of impact, on a smooth surface and on a rough one."""
    rng, kinds, pressed = np.random.default_rng(1), set(), 0.0
    for _ in range(budget(15, 40)):
        run = limp_drop(arm, rng, **friction)
        check_energy(run, smooth=not friction)
        kinds |= {event.kind for event in run.events}
        pressed += run.scenario.time.step * np.count_nonzero(run.mode)
    assert kinds >= {"impact", "touchdown", "liftoff"}
    assert pressed > 0.1  # s
