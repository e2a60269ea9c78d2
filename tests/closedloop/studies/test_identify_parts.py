"""The parts of an identification, each by what defines it: windows, columns of coupled joints, the filter, pieces."""

import itertools
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from identified import simulated
from scipy import signal, stats

import closedloop as cl
import robot_models
from closedloop.studies.identify.identify import PIECES, _pieces
from closedloop.studies.identify.motion import (
    ABOVE_MOTION,
    Log,
    LogError,
    Motion,
    between_counts,
    check_velocities,
    checked,
    count_of,
    joined,
    motion,
    usual_cutoff,
)
from closedloop.studies.identify.regressor import (
    NOISY,
    REST,
    UNIQUE,
    Regressor,
    Terms,
    _autoregression,
    _covariance,
    base_parameters,
    fit,
    told_apart,
)

SIZE = 4


def moving(q, v, noise=0.0):
    """A motion of two joints with windows of four rows."""
    count = len(v) // SIZE
    zeros = np.zeros((count, 2))
    return Motion(q, v, np.zeros_like(v), np.arange(count), zeros, SIZE, np.full(2, noise), np.zeros(2), 10.0)


def reversing(frequencies):
    """Angles and velocities of two joints that swing, at 400 rows over 2 s."""
    t = np.linspace(0.0, 2.0, 100 * SIZE, endpoint=False)[:, None]
    rates = 2.0 * np.pi * np.array(frequencies)
    return np.sin(rates * t + 0.3), rates * np.cos(rates * t + 0.3)


@pytest.mark.parametrize(("coupled", "noise"), [(False, 0.0), (False, 0.3), (True, 0.0), (True, 0.4)])
def test_windows_count_where_all_rows_of_them_and_of_those_beside_move_one_way(coupled, noise):
    """Window by window: faster than what is slow, and than the noise, with one sign; of a pair the sum of both, too."""
    robot = robot_models.load("planar2")
    pairs = (tuple(robot.joint_names),) if coupled else ()
    q, v = reversing((1.0, 1.7))
    found = Regressor(robot, Terms(coupled=pairs, slow=0.1)).certain(moving(q, v, noise))
    sums = [(v[:, 0], noise, (0,)), (v[:, 1], noise, (1,))]
    sums += [(v.sum(axis=1), np.sqrt(2.0) * noise, (0, 1)) for _ in pairs]
    expected = np.ones_like(found)
    for speed, of_speed, joints in sums:
        least = max(0.1 * np.abs(speed).max(), NOISY * of_speed)
        signs = np.where(np.abs(speed) > least, np.sign(speed), 0.0).reshape(-1, SIZE)
        sure = [len(set(window)) == 1 and window[0] != 0.0 for window in signs]
        for joint in joints:
            expected[:, joint] &= [all(sure[max(k - 1, 0) : k + 2]) for k in range(len(sure))]
    assert 0.2 < expected.mean() < 0.9
    np.testing.assert_array_equal(found, expected)


def test_a_joint_that_only_trembles_does_not_count():
    """Between two changes of its direction it moves by less than what a joint may creep while it sticks."""
    robot = robot_models.load("planar2")
    q, v = reversing((1.0, 1.0))
    share = np.array([1.0, 0.4 * REST])
    found = Regressor(robot, Terms(slow=0.1)).certain(moving(share * q, share * v))
    assert found[:, 0].any()
    assert not found[:, 1].any()


def test_coupled_joints_take_power_as_their_friction_and_their_inertia_do():
    """Dry friction takes |v1 + v2|, viscous friction 2 v1 v2 of what both have, a common inertia d/dt v1 v2."""
    robot = robot_models.load("planar2")
    regressor = Regressor(robot, Terms(coupled=(tuple(robot.joint_names),)))
    q, v, a = np.random.default_rng(0).normal(size=(3, 50, 2))
    W = regressor.rows(q, v, a)
    power = {
        name.split("_")[1]: np.einsum("tj,tj->t", v, W[:, :, k])
        for k, name in enumerate(regressor.names)
        if name.startswith("coupled_")
    }
    np.testing.assert_allclose(power["dry"], np.abs(v.sum(axis=1)), atol=1e-13)
    np.testing.assert_allclose(power["viscous"], 2.0 * v[:, 0] * v[:, 1], atol=1e-13)
    np.testing.assert_allclose(power["inertia"], v[:, 0] * a[:, 1] + v[:, 1] * a[:, 0], atol=1e-13)


@pytest.mark.parametrize("share", [0.1, 0.25, 0.5])
def test_what_is_held_out_is_the_end_of_each_of_ten_pieces(share):
    """So many runs of windows, that share of all, the last window among them and the first not."""
    held = _pieces(1000, share)
    runs = [(value, len(list(group))) for value, group in itertools.groupby(held)]
    assert [value for value, _ in runs] == [False, True] * PIECES
    assert all(length == pytest.approx(100 * (share if value else 1.0 - share), abs=1.0) for value, length in runs)
    assert not _pieces(1000, 0.0).any()


def swinging(frequency, duration=20.0, step=0.002):
    """A log of two joints that swing, without noise."""
    t = np.arange(0.0, duration, step)
    q = np.sin(2.0 * np.pi * frequency * t)[:, None] * [1.0, 0.5]
    return cl.Log(t, q, np.zeros_like(q))


def test_the_filter_halves_what_has_its_frequency_and_the_cutoff_is_ten_times_the_motions():
    """Forwards and backwards: (1/√2)² at the cutoff, without a delay; 1/(1 + x⁸) of it at another frequency."""
    log = swinging(5.0)
    assert usual_cutoff(log) == pytest.approx(ABOVE_MOTION * 5.0, rel=0.06)
    for cutoff in (5.0, 7.0):
        x = motion(log, cutoff)
        inner = slice(len(x.q) // 4, 3 * len(x.q) // 4)
        # of the bilinear transform, whose frequencies are tan(π f h)
        ratio = np.tan(np.pi * 5.0 * log.step) / np.tan(np.pi * cutoff * log.step)
        share = 1.0 / (1.0 + ratio**8)
        assert np.abs(x.q[inner]).max(axis=0) == pytest.approx([share, 0.5 * share], rel=5e-3)
        assert np.abs(x.v[inner]).max(axis=0) == pytest.approx(10.0 * np.pi * np.array([share, 0.5 * share]), rel=5e-3)


def test_a_cutoff_keeps_a_motion_of_a_fifth_of_a_count_and_knows_frequencies_to_a_quarter_of_a_hertz():
    """What is counted is noise of a count/√12, far below which periods that repeat still show."""
    time, count = np.arange(20000) * 1e-3, 1e-3
    fast = 20.0 * np.sin(2.0 * np.pi * 3.0 * time) + 0.2 * np.sin(2.0 * np.pi * 40.0 * time)
    log = SimpleNamespace(q=count * np.round(fast)[:, None], step=1e-3)
    assert usual_cutoff(log) == pytest.approx(200.0)  # 0.2/step, as ten times 40 Hz is more
    log = SimpleNamespace(q=np.sin(2.0 * np.pi * 3.0 * time)[:, None], step=1e-3)
    assert usual_cutoff(log) == pytest.approx(ABOVE_MOTION * 3.25)  # of 4 s each: the next of their frequencies


def test_positions_between_counts():
    """They are nearer to a motion that the counts round, and no number that is no count is changed."""
    t = np.linspace(0.0, 2.0, 2001)[:, None]
    true = np.hstack([np.sin(3.0 * t), 0.01 * np.cos(2.0 * t), np.maximum(t - 0.5, 0.0) ** 3])
    size = np.array([1e-3, 5e-4, 0.0])
    q = np.hstack([np.round(true[:, :2] / size[:2]) * size[:2], true[:, 2:]])
    np.testing.assert_allclose(count_of(q), size, rtol=1e-9, atol=0)
    found = between_counts(q)
    assert np.array_equal(found[:, 2], true[:, 2])
    assert np.all(np.abs(found - q)[:, :2] <= 0.5 * size[:2])
    off, before = (np.sqrt(np.mean((x - true) ** 2, axis=0))[:2] for x in (found, q))
    assert np.all(off < [0.75, 0.3] * before)  # at three counts a row, and at 25 rows a count
    assert np.array_equal(between_counts(true), true)


def test_intervals_of_few_windows_of_correlated_noise_cover():
    """Of a line through 40 windows of an autoregression, 95 %, but for the spread of 120: 86 % as if s were known."""
    rng, covered = np.random.default_rng(0), []
    W = np.stack([np.ones(40), np.linspace(-1.0, 1.0, 40)], axis=1)[:, None]
    for _ in range(60):
        noise = signal.lfilter([1.0], [1.0, -0.7], rng.normal(size=240))[200:, None]
        found = fit(W, noise, np.ones((40, 1), dtype=bool))
        covered += (np.abs(found.value) < 1.96 * found.deviation).tolist()
    assert np.mean(covered) > 0.91


def test_what_is_left_of_few_windows_is_that_of_the_noise():
    """Over the windows less the columns: of 20 with 6 columns s² is unbiased, though 0.7 of it is left on average."""
    W, used = np.random.default_rng(0).normal(size=(20, 1, 6)), np.ones((20, 1), dtype=bool)
    found = [fit(W, np.random.default_rng(k).normal(size=(20, 1)), used).sigma[0] ** 2 for k in range(150)]
    assert np.mean(found) == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize(("share", "both"), [(0.8, False), (1.25, True)])
def test_columns_are_told_apart_by_the_part_that_no_other_explains(share, both):
    """Of two columns of length one it is the sine of the angle between them."""
    alike = np.sqrt(1.0 - (share * UNIQUE) ** 2)
    told, confused = told_apart(np.array([[1.0, alike], [alike, 1.0]]))
    assert told.all() == both
    assert confused == [() if at else (1 - k,) for k, at in enumerate(told)]


def test_windows_of_a_long_log_are_half_a_period_of_the_cutoff(monkeypatch):
    """Evaluated at every third row; noise of velocities and mean torques is what the motion says, and time goes on."""
    monkeypatch.setattr("closedloop.studies.identify.motion.EVALUATIONS", 10_000)
    rng = np.random.default_rng(0)
    log = Log(np.arange(24_000) * 1e-3, 1e-3 * rng.normal(size=(24_000, 1)), rng.normal(size=(24_000, 1)), ("J1",))
    x = motion(log, 20.0)
    assert np.diff(x.time) == pytest.approx(0.5 / 20.0, rel=0.05)
    assert len(x.q) == x.size * len(x.time)
    assert x.v.std() == pytest.approx(0.89 * x.noise[0], rel=0.1)  # of what the filter is not a sharp one
    assert x.torque.std() == pytest.approx(x.torque_noise[0], rel=0.1)
    assert np.diff(joined([x, x]).time) == pytest.approx(np.diff(x.time)[0])


def test_the_inertia_of_a_drive_is_part_of_that_of_its_link_where_it_acts_alike():
    """The first joint's drive turns as its link does; the second's does not."""
    names = base_parameters(Regressor(robot_models.load("planar2"), Terms())).names
    assert [name for name in names if "drive_inertia_J1" in name] == ["Iyy_J1 + 0.16 m_J2 + drive_inertia_J1"]
    assert "drive_inertia_J2" in names


def test_an_interval_of_few_windows_is_students():
    """Of a mean of R white windows: 1/R of the variance of φ and 2/R of that of log s² make R/3 degrees of freedom."""
    W, used = np.ones((20, 1, 1)), np.ones((20, 1), dtype=bool)
    found = [fit(W, np.random.default_rng(k).normal(size=(20, 1)), used).deviation[0] for k in range(200)]
    assert np.sqrt(20) * np.median(found) == pytest.approx(stats.t.ppf(0.975, 20 / 3) / 1.96, rel=0.1)


def test_velocities_are_compared_by_the_trapezoidal_rule():
    """At nine rows a period a row more or less is half a right angle: what moves so much later is another joint's."""
    robot, t = robot_models.load("planar2"), np.arange(400)[:, None]
    rate = 2.0 * np.pi / 9.0
    q, v = np.sin(rate * (t - [[0, 1]])), rate * np.cos(rate * (t - [[0, 1]]))
    check_velocities(q, v, 1.0, robot, "log")
    for share, said in ((0.3, "0.288"), (3.0, "2.88")):  # the rule loses 4 % of such a wave
        with pytest.raises(LogError, match=f"velocities of J1 are {said} times the rate of its positions"):
            check_velocities(q, share * v, 1.0, robot, "log")


def test_the_covariance_is_that_of_all_windows_with_each_other(monkeypatch):
    """Of 60 windows of correlated noise, pair by pair: rows φ^|t − t'| s²/(1 − φ²) rowsᵀ, the first windows too."""
    monkeypatch.setattr("closedloop.studies.identify.regressor.FEWEST", 1e12)  # intervals as of a normal distribution
    noise = signal.lfilter([1.0], [1.0, -0.9], np.random.default_rng(3).normal(size=260))[200:, None]
    X, used = np.stack([np.ones((60, 1)), np.linspace(-1.0, 1.0, 60)[:, None]], axis=2), np.ones((60, 1), dtype=bool)
    rows, sigma = np.linalg.pinv(X[:, 0]), noise.std(axis=0)
    found, phi = _covariance(rows.T[:, None], X / sigma, noise, noise, used, sigma)
    step = _autoregression(X / sigma, noise, used, sigma)[1]
    apart = np.abs(np.subtract.outer(np.arange(60), np.arange(60)))
    assert phi[0] > 0.5
    np.testing.assert_allclose(found, rows @ (phi**apart * step**2 / (1.0 - phi**2)) @ rows.T, rtol=1e-9, atol=1e-9)


def test_parameters_of_a_slider_have_the_units_of_one():
    """A force, N, where a joint slides, and a torque, N m, where it turns."""
    robot = robot_models.load("planar2")
    slides = replace(robot, joint_types=("revolute", "prismatic"))
    regressor = Regressor(slides, Terms())
    assert [regressor.unit(f"{kind}_{robot.joint_names[1]}") for kind in ("dry", "viscous", "drive_inertia")] == [
        "N", "N s/m", "kg",
    ]  # fmt: skip
    assert regressor.unit(f"dry_{robot.joint_names[0]}") == "N m"


def test_parts_of_a_log_are_all_of_it():
    """One after the other, to the last row; and velocities go with their joints where columns come in another order."""
    log, robot = simulated("planar2", count=1001)
    log = replace(log, v=np.gradient(log.q, log.step, axis=0))
    both = [log.part(*ends) for ends in ((0.0, 0.3), (0.3, 1.0))]
    for name in ("time", "q", "torque", "v"):
        assert np.array_equal(np.concatenate([getattr(part, name) for part in both]), getattr(log, name))
    turned = {name: getattr(log, name)[:, ::-1] for name in ("q", "torque", "v")}
    again = checked(replace(log, joint_names=log.joint_names[::-1], **turned), robot)
    assert np.array_equal(again.v, log.v)
