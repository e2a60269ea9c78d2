"""Axes and designs of sweeps: what their texts mean, and which values are drawn."""

import re

import numpy as np
import pytest

import closedloop as cl
from closedloop.studies.sweep.sweep import BLOCK, Design, parse_axis


def values_of(text, drawn=False):
    """Return all values of an axis in a grid."""
    axis = parse_axis(text, drawn)
    return [axis.at(i) for i in range(len(axis))]


def test_axes_are_what_they_say():
    """Ends are exact, a logarithmic range has a constant ratio, a list is of numbers, words or lists."""
    np.testing.assert_allclose(values_of("law.force=5:15:11"), np.arange(5.0, 16.0), rtol=1e-15)
    values = values_of("stabiliser.time_constant=log:1e-4:1e-2:5")
    assert (values[0], values[-1]) == (1e-4, 1e-2)
    for low, high in np.random.default_rng(0).uniform(0.1, 9.0, size=(200, 2)).tolist():
        for some in (values_of(f"law.force={log}{low!r}:{high!r}:4") for log in ("log:", "")):
            assert (some[0], some[-1]) == (low, high)
    np.testing.assert_allclose(np.diff(np.log(values)), np.log(100) / 4, rtol=1e-12)
    assert values_of("law.force=15:5:3") == [15.0, 10.0, 5.0]
    assert values_of("law.force=5,10") == [5.0, 10.0]
    assert values_of("time.integrator=rk4, explicit_euler") == ["rk4", "explicit_euler"]
    assert values_of("robot.drive_inertia=true,false") == [True, False]
    assert values_of("law.kp=[1, 2, 3, 4],5") == [[1, 2, 3, 4], 5]
    assert values_of('stabiliser.time_constant="auto",0.001') == ["auto", 0.001]
    assert values_of("sensor.seed=0:4:5") == [0, 1, 2, 3, 4]
    assert all(isinstance(seed, int) for seed in values_of("sensor.seed=0:4:5"))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("law.force", "must be KEY=VALUES with a key such as law.force"),
        ("force=1,2", "must be KEY=VALUES with a key such as law.force"),
        ("law.force=", "has no values; they are 5:15:11"),
        ("law.force=,", "has no values"),
        ("law.force=5:15:0", "0 values: must be a whole number from 2 on"),
        ("law.force=5:15:2.5", "2.5 values: must be a whole number from 2 on"),
        ("law.force=5,,6", "has a comma too many: a value is missing"),
        ("time.integrator=,rk4", "has a comma too many: a value is missing"),
        ("law.force=5:5:3", "is empty: it ends where it begins; a single value is written law.force=5"),
        ("law.force=5:15", "how many values? such as 5:15:11"),
        ("law.force=5:15:3:4", "a range has two ends and how many values it has"),
        ("law.force=5:inf:3", "both ends must be finite"),
        ("law.force=log:0:1:3", "both ends of a logarithmic range must be above 0"),
        ("law.force=log:a:1:3", "not a range of numbers"),
        ("law.force=a:b:c", "not a range of numbers"),
        ("law.force=5,5.0", "the same value twice"),
        ("law.force=5:15:1e12", "1e12 values: must be a whole number from 2 on, up to 1000000000"),
        ("law.force=5:15:nan", "nan values: must be a whole number from 2 on"),
        ("law.force=1:1e400:3", "both ends must be finite"),
        ("law.force=nan:1:3", "both ends must be finite"),
        ("law.force=-1e308:1e308:3", "is wider than a double can hold"),
        ("stabiliser.time_constant=log:1e-300:1e300:3", "is wider than a double can hold"),
        ("sensor.seed=0:1e30:3", "whole numbers of a range may go to 2^53"),
        ("law.force=\udcff", "has characters that cannot be printed"),
        ("sensor.seed=0:1:5", "sensor.seed takes whole numbers only; name them"),
    ],
)
def test_axes_at_fault(text, said):
    """Each is refused with the word that is wrong and what would be right."""
    with pytest.raises(cl.ScenarioError, match=re.escape(said)) as refused:
        parse_axis(text)
    assert str(refused.value).startswith(f"--over {text}: ")


def test_grid_has_every_pair_once_the_last_axis_fastest():
    """Every value goes with every other, once."""
    design = Design([parse_axis("law.force=1,2,3"), parse_axis("law.kp=4,5")])
    assert list(design) == [(f, k) for f in (1.0, 2.0, 3.0) for k in (4.0, 5.0)]
    assert design[2:4] == [(2.0, 4.0), (2.0, 5.0)]


def test_random_draws_depend_on_seed_and_number_alone():
    """Run i is the same whoever asks for it and in whatever order, and another with another seed; all are in range."""
    axes = [parse_axis("law.force=5:15", drawn=True), parse_axis("stabiliser.time_constant=log:1e-4:1e-2", drawn=True)]
    design, again = Design(axes, "random", 3000, 7), Design(axes, "random", 3000, 7)
    backwards = [again[i] for i in reversed(range(3000))][::-1]
    assert list(design) == backwards
    assert Design(axes, "random", 3000, 8)[0] != design[0]
    values = np.array(list(design))
    assert len(set(map(tuple, values))) == 3000 > 2 * BLOCK
    assert np.all((values[:, 0] >= 5.0) & (values[:, 0] < 15.0))
    # Even in its logarithm: half are below the geometric mean; 3000 draws miss that by 1 % (one standard deviation).
    assert np.mean(values[:, 1] < 1e-3) == pytest.approx(0.5, abs=0.05)


def test_latin_hypercube_has_one_run_in_each_interval():
    """Each axis, cut into as many equal intervals as there are runs, has exactly one run in each."""
    axes = [parse_axis("law.force=5:15", drawn=True), parse_axis("law.kp=log:1:100", drawn=True)]
    values = np.array(list(Design(axes, "latin", 50, 3)))
    force = np.floor((values[:, 0] - 5.0) / 10.0 * 50)
    stiffness = np.floor(np.log(values[:, 1]) / np.log(100.0) * 50)
    assert sorted(force) == sorted(stiffness) == list(range(50))


def test_whole_numbers_are_drawn_whole_and_words_evenly():
    """Both ends of a range of whole numbers are drawn, and every word of a list."""
    axes = [parse_axis("sensor.seed=1:3", drawn=True), parse_axis("time.integrator=rk4,explicit_euler", drawn=True)]
    drawn = list(Design(axes, "random", 200, 0))
    assert {seed for seed, _ in drawn} == {1, 2, 3}
    assert {word for _, word in drawn} == {"rk4", "explicit_euler"}
