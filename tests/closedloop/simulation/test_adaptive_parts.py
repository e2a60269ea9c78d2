"""The parts of the adaptive integrator: what is desired between jumps, and the first crossing of a gauge."""

import numpy as np
import pytest
from rounding import within

import closedloop as cl
from closedloop.simulation.engines.adaptive_parts import first_crossing, interval_from, jumps, root


def wanted(name, **changes):
    """Return what a scenario desires, as functions of time."""
    return cl.prepare(cl.load_scenario(name, changes)).wanted


def bounds(desired, end, step=0.001):
    """Return the instants between which what is desired is smooth."""
    return jumps(desired, np.zeros(0), step * np.arange(round(end / step) + 1))


@pytest.mark.parametrize(
    ("name", "changes"),
    [
        ("wam_slide", {"time.duration": 1.0}),
        ("wam_slide", {"time.duration": 1.0, "reference.timing": "minimum_jerk"}),
        ("wam_edge", {"time.duration": 1.0}),
        (
            "planar2_slide",
            {"force_profile.kind": "sine", "force_profile.amplitude": 3.0, "force_profile.frequency": 40.0},
        ),
    ],
)
def test_intervals_cover_the_run_and_equal_the_table(name, changes):
    """Between 0 and 1 s, interval by interval, every column at any instant is that of the table to 1e-11.

    A velocity is a difference of positions of 1 rad over some 10 ms: 2e-14 rad/s of rounding, and as much again.
    """
    desired = wanted(name, **changes)
    ends = bounds(desired, 1.0)
    assert ends[0] == 0.0
    assert ends[-1] == 1.0
    t, rng = 0.0, np.random.default_rng(0)
    while t < 1.0:
        interval = interval_from(desired, t, ends[np.searchsorted(ends, t, side="right")])
        assert interval.start == t
        assert interval.end > t
        inside = rng.uniform(t + 0.01 * (interval.end - t), interval.end - 0.01 * (interval.end - t), 3)
        table = desired.table(inside)
        for row, instant in zip(table, inside, strict=True):
            assert np.max(np.abs(interval.at(instant) - row)) < 1e-11
        t = interval.end


def test_a_jump_has_its_earlier_value_before_and_its_later_value_after():
    """The speed of the slide at 0.5 s is 0 at the end of one interval and that of the path at the start of the next."""
    desired = wanted("wam_slide")
    ends = bounds(desired, 1.0)
    assert 0.5 in ends
    n = desired.joints.q.shape[1]
    before = interval_from(desired, 0.4, 0.5).at(0.5)
    after = interval_from(desired, 0.5, ends[np.searchsorted(ends, 0.5, side="right")]).at(0.5)
    assert within(64, before[:n], after[:n])
    assert np.max(np.abs(before[n : 2 * n])) < 1e-14
    assert after[n : 2 * n] == pytest.approx(desired.table(np.array([0.5]))[0, n : 2 * n], abs=1e-12)
    assert np.max(np.abs(after[n : 2 * n])) > 1e-3


def test_jumps_are_rows_where_they_mean_rows():
    """An instant that is a row but for rounding is that row; one between rows stays; none is there twice."""
    desired = wanted(
        "planar2_slide",
        **{"force_profile.kind": "waypoints", "force_profile.times": [0.3, 0.55555], "force_profile.forces": [10, 12]},
    )
    rows = 0.1 * np.arange(11)
    assert rows[3] != 0.3
    found = jumps(desired, np.array([0.3, 0.3 + 1e-14, 2.0]), rows)
    assert rows[3] in found
    assert 0.55555 in found
    assert np.all(np.diff(found) > 1e-9)
    assert found[-1] == rows[-1]


def test_an_interval_ends_early_where_the_polynomial_is_inaccurate():
    """A force of 200 Hz over a second is cut into pieces of a few periods at most."""
    fast = wanted(
        "planar2_slide",
        **{"force_profile.kind": "sine", "force_profile.amplitude": 3.0, "force_profile.frequency": 200.0},
    )
    interval = interval_from(fast, 0.0, 0.4)
    assert 1e-4 < interval.end < 0.01
    assert interval.at(interval.end)[-1] == pytest.approx(10 + 3 * np.sin(400 * np.pi * interval.end), abs=1e-11)


@pytest.mark.parametrize("slope", [0.5, 3.0, 40.0])
def test_crossing_of_a_line_is_its_root(slope):
    """1 − s t falls through zero at 1/s, if that is within the step."""
    found = first_crossing(lambda t: 1.0 - slope * t, 1.0)
    assert found == (pytest.approx(1 / slope, abs=1e-15) if slope > 1.0 else None)


def test_first_of_several_crossings_is_found():
    """Of sin's zeros within the step the first falling one counts."""
    assert within(64, first_crossing(np.sin, 10.0), np.pi)
    assert within(64, first_crossing(np.cos, 10.0), np.pi / 2)


@pytest.mark.parametrize("depth", [1e-3, 1e-6, 1e-9, -1e-9])
@pytest.mark.parametrize("known", [True, False])
def test_dip_between_two_places_is_found(depth, known):
    """A parabola that dips below zero by `depth` about 0.437 for a moment crosses where it should, or not at all."""

    def gauge(t):
        return (t - 0.437) ** 2 - depth

    found = first_crossing(gauge, 1.0, 0.0, (lambda t: 2 * (t - 0.437)) if known else None)
    if depth < 0.0:
        assert found is None
    else:
        assert found == pytest.approx(0.437 - np.sqrt(depth), abs=1e-9)


def test_bounce_shorter_than_a_place_is_found():
    """A tip that rises from zero and is back long before the first place is found on its way down, not at zero."""
    found = first_crossing(lambda t: t * (0.001 - t), 1.0, 0.0, lambda t: 0.001 - 2 * t)
    assert within(16, found, 0.001)


def test_rounding_below_zero_is_no_crossing():
    """What is no deeper than the floor does not count; what begins below zero and stays there begins there."""
    assert first_crossing(lambda t: -1e-14 + t**3, 1.0, 1e-13, lambda t: 3 * t**2) is None
    assert first_crossing(lambda t: -t, 1.0) == 0.0


def test_root_is_as_exact_as_numbers_are():
    """Brent's method to the last digits."""
    assert within(16, root(np.cos, 1.0, 2.0), np.pi / 2)
