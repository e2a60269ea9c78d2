"""The desired force over time: each profile against its definition, and what is refused."""

import numpy as np
import pytest

import closedloop as cl
from closedloop.control.reference.path import (
    ConstantForceSection,
    SineForceSection,
    StepForceSection,
    WaypointForceSection,
    force_at,
)

BASE = 10.0  # N


def test_constant_is_the_law_s_force():
    """Without a profile the desired force is law.force at all times."""
    assert np.array_equal(force_at(ConstantForceSection(), BASE, np.array([0.0, 1.0, 1e9])), [BASE] * 3)


def test_step_has_its_later_value_at_its_instant():
    """A step is there from its instant on, also where rounding put i·h an ulp before it."""
    h, section = 0.001, StepForceSection(to=15.0, at=0.3)
    i = np.arange(1000)
    assert np.array_equal(force_at(section, BASE, h * i), np.where(i >= 300, 15.0, BASE))
    assert force_at(section, BASE, np.array([np.nextafter(0.3, 0.0)]))[0] == 15.0
    assert force_at(section, BASE, np.array([0.3 - 1e-6]))[0] == BASE
    assert force_at(StepForceSection(to=3.0, at=0.0), BASE, np.zeros(1))[0] == 3.0


def test_step_long_after_the_start():
    """After hours, when i·h is off by more than an ulp, the step is still in the row of its instant."""
    h, at = 1e-3, 36000.0
    i = np.arange(35_999_990, 36_000_010)
    assert np.array_equal(force_at(StepForceSection(to=1.0, at=at), BASE, h * i) == 1.0, i >= 36_000_000)


def test_sine_swings_about_the_law_s_force():
    """From its start on the force is base + amplitude · sin 2πf(t − start); base before; continuous at the start."""
    section = SineForceSection(amplitude=2.0, frequency=0.5, start=1.0)
    t = np.array([0.0, 1.0, 1.5, 2.0, 2.5, 3.0, 101.5])
    assert np.allclose(force_at(section, BASE, t), [10, 10, 12, 10, 8, 10, 12], rtol=0, atol=1e-12)


def test_sine_has_its_mean_and_its_power():
    """Over whole periods the mean is law.force and the variance half the squared amplitude."""
    t = np.arange(2000) / 1000.0
    force = force_at(SineForceSection(amplitude=-3.0, frequency=4.0), BASE, t)
    assert np.mean(force) == pytest.approx(BASE, abs=1e-12)
    assert np.var(force) == pytest.approx(4.5, rel=1e-12)
    assert force[1] < BASE


def test_waypoints_are_joined_by_straight_lines():
    """law.force before the first instant, straight between, the last force after: against numpy's interpolation."""
    section = WaypointForceSection(times=(1.0, 2.0, 4.0), forces=(10.0, 20.0, 5.0))
    t = np.linspace(0.0, 6.0, 601)
    expected = np.where(t < 1.0, BASE, np.interp(t, section.times, section.forces))
    assert np.allclose(force_at(section, BASE, t), expected, rtol=0, atol=1e-12)


def test_waypoints_may_begin_with_a_jump():
    """A first force other than law.force is a step at the first instant, later value there."""
    section = WaypointForceSection(times=(1.0,), forces=(3.0,))
    t = np.array([0.0, 1.0 - 1e-6, np.nextafter(1.0, 0.0), 1.0, 9.0])
    assert np.array_equal(force_at(section, BASE, t), [BASE, BASE, 3.0, 3.0, 3.0])


@pytest.mark.parametrize("forces", [(1e9, -1e9), (-1e9, 1e9)])
def test_waypoints_of_any_size_have_no_overflow(forces):
    """Between the largest numbers there are, an instant apart, every force is a number between them."""
    section = WaypointForceSection(times=(0.0, 5e-324), forces=forces)
    assert np.all(np.isfinite(force_at(section, BASE, np.array([0.0, 5e-324, 1.0, 1e300]))))


REFUSED = {
    "a force too few": ({"kind": "waypoints", "times": [0, 1], "forces": [1]}, ["forces has 1", "2", "times"]),
    "times that stand": ({"kind": "waypoints", "times": [0, 1, 1], "forces": [1, 2, 3]}, ["times", "entry 2", "later"]),
    "negative time": ({"kind": "waypoints", "times": [-1, 1], "forces": [1, 2]}, ["times", "negative"]),
    "no times": ({"kind": "waypoints", "times": [], "forces": [1.0]}, ["times", "list"]),
    "text for forces": ({"kind": "waypoints", "times": [0.0], "forces": "ten"}, ["forces", "'ten'", "list"]),
    "true in forces": ({"kind": "waypoints", "times": [0.0], "forces": [True]}, ["forces", "entry 0", "number"]),
    "NaN in forces": ({"kind": "waypoints", "times": [0.0], "forces": [float("nan")]}, ["forces", "finite"]),
    "huge entry": ({"kind": "waypoints", "times": [0.0], "forces": [10**400]}, ["forces", "entry 0", "1e308"]),
    "no step": ({"kind": "step", "at": 1.0}, ["'force_profile.to'", "missing"]),
    "step before the start": ({"kind": "step", "at": -1.0, "to": 3.0}, ["force_profile.at", "negative"]),
    "no frequency": ({"kind": "sine", "amplitude": 1.0, "frequency": 0.0}, ["frequency", "greater than 0"]),
    "absurd frequency": ({"kind": "sine", "amplitude": 1.0, "frequency": 1e300}, ["frequency", "at most 1e+06 Hz"]),
    "unknown kind": ({"kind": "ramp"}, ["force_profile.kind", "'ramp'", "'constant'", "'sine'"]),
    "unknown key": ({"kind": "step", "at": 1.0, "to": 1.0, "too": 2.0}, ["force_profile.too", "'force_profile.to'"]),
}


@pytest.mark.parametrize("case", REFUSED)
def test_bad_profile_is_refused_in_one_line(case):
    """Each bad profile is refused with one line that names the key and what would be right."""
    section, words = REFUSED[case]
    with pytest.raises(cl.ScenarioError) as caught:
        cl.prepare(cl.load_scenario("wam_slide", {"force_profile": section, "time.duration": 0.01}))
    line = str(caught.value)
    assert "\n" not in line
    assert all(word in line for word in words), line
