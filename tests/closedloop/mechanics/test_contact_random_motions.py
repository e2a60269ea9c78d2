"""Random bodies on random joints with many contacts (tests/fuzz/motions.py): the motion goes on and keeps its laws."""

import sys
from pathlib import Path

import numpy as np
import pytest
from budget import budget, seeds

import closedloop as cl

sys.path.insert(0, str(Path(__file__).parents[2] / "fuzz"))
import motions
from boxes import no_torque
from drops import examine


@pytest.mark.parametrize("seed", seeds(6, budget(20, 40)))
def test_a_random_motion_goes_on(tmp_path, seed):
    """Nothing stops it, pulls or leaves its cone; impacts gain no energy, and steps no more than is said.

    Steps of impulses, of order 1, follow where modes change too often: they leave h² a/2 with a of some 20 m/s².
    """
    text, known = motions.draw(seed, tmp_path)
    (tmp_path / "scenario.toml").write_text(text)
    run = cl.simulate(cl.load_scenario(str(tmp_path / "scenario.toml")), law=no_torque, engine="compiled")
    wrong = examine(run, known["mu"], rests=False)
    stepped = "time_stepping_start" in {event.kind for event in run.events}
    assert wrong.pop("gap", 0.0) > (-1e-5 if stepped else -2e-6)
    assert wrong.pop("energy", 0.0) < (1e-5 if stepped else 1e-6)
    assert wrong.keys() <= {"energy of a gap"}


@pytest.mark.parametrize("seed", [91150049, 91150030])
def test_time_steps_in_which_contacts_rebound_gain_no_energy(tmp_path, seed):
    """Newton's restitution with friction would give 35 J in a step, whatever its length; the scheme gives little."""
    text, _ = motions.draw(seed, tmp_path)
    (tmp_path / "scenario.toml").write_text(text)
    scenario = cl.load_scenario(str(tmp_path / "scenario.toml"), {"time.integrator": "time_stepping"})
    run = cl.simulate(scenario, law=no_torque, engine="compiled")
    energy = run.kinetic_energy + run.potential_energy
    assert np.max(np.diff(energy)) < 5e-3 * np.max(np.abs(energy))
    assert np.max(run.link_forces) > 100.0


# Seeds in which, before they were mended: a contact that parts and comes back within a nanometre sank by one each time
# (1084, 1195); a time step pressed contacts in (1041); rates that multiply near a gimbal lock gained energy (1144);
# forces grew without bound within a step (1119), or in a trial step in the search for an event (20261377,
# 20262085); friction was turned round with a force that would pull (1131); a time step had impulses of 2e4 N s of
# contacts that are wedged (20261842, 20261488), or none were found (20261206, 20261722); a slip of 1e-4 m/s was at the
# edge of Painlevé's paradox in one stage (20261989); no forces were found in a stage of a step of length zero, and the
# step was taken again without end (20261838); friction of a slow slip that turns by more than a right angle was another
# at each stage of a step, and drove it (20261771, 20262102); forces until a slip ends were outside their cones by 2e-8
# (20261660, 20262484); impulses of feet that stick by any of many forces were sought by the shortest alone, outside its
# cone by 2e-6 (20263588); friction turned for a shorter step let a foot pull with 0.09 N, unseen (20263831); time steps
# pressed in by 7e-8 m a contact that slid so that pressing harder pulled it in (20283149).
MENDED = [1041, 1084, 1119, 1131, 1144, 1195]
MENDED += [20261206, 20261377, 20261488, 20261722, 20261838, 20261842, 20261989, 20262085]
MENDED += [20261214, 20261340, 20261660, 20261770, 20261771, 20261783, 20261862, 20262102, 20262484]
MENDED += [20263588, 20263831, 20283149]
QUICK = {1084, 20261340, 20261660, 20261771, 20262102, 20261770, 20261838, 20261862, 20261989, 20283149}


@pytest.mark.parametrize("seed", [pytest.param(s, marks=() if s in QUICK else pytest.mark.slow) for s in MENDED])
def test_a_mended_motion_stays_on_its_surfaces(tmp_path, seed):
    """No gap is below a nanometre, and no step gains more than a few 1e-9 of the energy, but after time steps."""
    text, known = motions.draw(seed, tmp_path)
    (tmp_path / "scenario.toml").write_text(text)
    # At 1 ms the path of 1131 has an error of its own: -5.3e-9 m, 3.4e-6 of the energy; at 0.5 ms -1.1e-9 m, and none.
    # So has that of 20261842, wedged with 2e5 N: -1.5e-9 m; and those of 20261214 and 20261783, in whose slips' last
    # steps friction turns: 1e-7 and 1.9e-5 of the energy, at 0.5 ms none and 1.2e-6, at 0.125 ms none. 20261377 gains
    # 1.7e-6, at 0.5 ms none.
    # 20261842 and 20261488 are wedged from 0.29 s and 0.15 s on, with 1e4 N and 4e4 N; what follows is the same again.
    half, eighth = {"time.step": 5e-4}, {"time.step": 1.25e-4}
    changes = {
        1131: half,
        20261214: half,
        20261377: half,
        20261783: eighth,
        20261842: half | {"time.duration": 0.295},
        20261488: {"time.duration": 0.155},
    }
    scenario = cl.load_scenario(str(tmp_path / "scenario.toml"), changes.get(seed, {}))
    run = cl.simulate(scenario, law=no_torque, engine="compiled")
    wrong = examine(run, known["mu"], rests=False)
    # Contacts that are wedged are compliant: time steps press them in, and put that back, as where boxes are dropped
    # flat.
    wedged = {1131: -1.2e-9, 20283149: -5e-8, 20261842: -5e-9, 20261488: -5e-7}
    assert wrong.pop("gap", 0.0) > wedged.get(seed, -1.01e-9)
    # A time step presses contacts in by some 1e-8 m, and what puts them back lifts the bodies: 6.6e-8 of the energy. A
    # contact of 20263588 parts from 8e-10 m inside, beside one that carries 47 N. Forces of wedged bodies, 2e5 N in
    # 20261842, gain what a gap within the bound above is worth.
    assert wrong.pop("energy", 0.0) < (1e-7 if seed in (1041, 20263588) else 4e-9)
    assert wrong.keys() <= {"energy of a gap"}
