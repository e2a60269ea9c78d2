"""`closedloop excite`: motions within limits, better than random ones, with intervals that come true."""

import numpy as np
import pandas as pd
import pytest
from identified import truth

import closedloop as cl
import robot_models
from closedloop.base.errors import ModelError
from closedloop.command.logs import excite as main
from closedloop.studies.identify.excite import _Series
from closedloop.studies.identify.motion import Log
from closedloop.studies.identify.regressor import Regressor, Terms


@pytest.fixture(scope="module")
def found():
    """Return a motion for the friction of a joint."""
    return cl.excite("planar2", ["viscous_J1", "dry_J1"], noise=0.2, duration=12.0)


def test_the_motion_is_within_limits_and_from_rest_to_rest(found):
    """Of position, speed and acceleration; one limit of each joint is used; velocities are rates."""
    robot = found.robot
    centre, half = (
        0.5 * (robot.position_upper + robot.position_lower),
        0.5 * (robot.position_upper - robot.position_lower),
    )
    shares = [
        np.abs(found.q - centre).max(axis=0) / (0.9 * half),
        np.abs(found.v).max(axis=0) / (0.9 * robot.velocity_limit),
        np.abs(found.a).max(axis=0) / (robot.velocity_limit / 0.25),
    ]
    assert np.max(shares) < 1.001
    assert (np.max(shares, axis=0) > 0.99).all()
    assert np.abs(found.v[[0, -1]]).max() < 1e-9
    assert np.abs(found.a[[0, -1]]).max() < 1e-9
    step = found.time[1]
    for x, rate in ((found.q, found.v), (found.v, found.a)):
        np.testing.assert_allclose(np.gradient(x, step, axis=0)[2:-2], rate[2:-2], atol=0.02 * np.abs(rate).max())


def test_the_parameters_asked_for_are_known_better(found):
    """Than by the median random motion, and than by the motion that is best for all."""
    at = [found.names.index(name) for name in found.target]
    assert np.log(found.half[at]).mean() < np.log(found.drawn[at]).mean() - 0.1
    everything = cl.excite("planar2", noise=0.2, duration=12.0)
    assert np.log(found.half[at]).mean() < np.log(everything.half[at]).mean()
    assert np.log(everything.half).mean() < np.log(everything.drawn).mean() - 0.1


def test_expected_intervals_come_true(found):
    """Logs of the motion with that noise: the spread of what is identified is the one that was expected."""
    robot = found.robot
    regressor = Regressor(robot, Terms())
    chi = truth(robot, regressor.names)
    clean = regressor.rows(found.q, found.v, found.a) @ chi
    errors = []
    for seed in range(25):
        torque = clean + 0.2 * np.random.default_rng(seed).normal(size=clean.shape)
        result = cl.identify(Log(found.time, found.q, torque, robot.joint_names), robot)
        base = result.base.grouping @ chi
        errors.append([e.value - base[k] for k, e in enumerate(result.estimates)])
    spread = 1.96 * np.array(errors).std(axis=0)
    assert ((spread / found.half > 0.6) & (spread / found.half < 1.7)).all()


def test_what_no_motion_tells_is_said():
    """Parameters that act only with others, names that are none, arguments that cannot be."""
    robot = robot_models.load("planar2")
    for target, arguments, expected in (
        (["drive_inertia_J1"], {}, "acts only together with others"),
        (["mass"], {}, "'mass' is no parameter of planar2: they are"),
        ([], {"duration": -1.0}, "duration is -1.0: it must be from 0.1"),
        ([], {"noise": [1.0, 2.0, 3.0]}, "must be positive, one number or 2"),
        ([], {"acceleration": 0.0}, "acceleration is 0.0: must be positive"),
        ([], {"harmonics": 1}, "harmonics is 1"),
    ):
        with pytest.raises(ModelError, match=expected):
            cl.excite(robot, target, **arguments)


def test_the_command_writes_the_motion(tmp_path, capsys):
    """A table whose velocities are within limits, and a report; a wrong number is one line."""
    words = ["--robot", "planar2", "--for", "dry_J2", "--duration", "5", "--out", str(tmp_path / "out")]
    assert main(words) == 0
    assert "* dry_J2" in capsys.readouterr().out
    table = pd.read_csv(tmp_path / "out" / "excitation.csv")
    assert list(table.columns)[:3] == ["time", "q_J1", "q_J2"]
    assert table["v_J2"].abs().max() <= 10.0
    assert "* dry_J2" in (tmp_path / "out" / "report.txt").read_text()
    assert main([*words, "--noise", "little"]) == 2
    told = capsys.readouterr().err
    assert "--noise 'little': must be a number" in told
    assert len(told.strip().splitlines()) == 1


@pytest.mark.parametrize(("duration", "acceleration"), [(0.5, 20.0), (0.5, 1e4), (50.0, 20.0)])
def test_any_series_is_scaled_to_the_nearest_limit(duration, acceleration):
    """Acceleration, speed or position, each in another motion: it is reached, and none is passed."""
    robot = robot_models.load("planar2")
    series = _Series(robot, duration, 5, acceleration, 0.8)
    q, v, a = series.motion(np.random.default_rng(1).normal(size=series.size), 600)
    half = 0.5 * (robot.position_upper - robot.position_lower)
    limits = 0.8 * half, 0.8 * robot.velocity_limit, np.full(2, acceleration)
    both = zip((q - series.centre, v, a), limits, strict=True)
    np.testing.assert_allclose(np.max([np.abs(x).max(axis=0) / limit for x, limit in both], axis=0), 1.0, rtol=1e-12)
