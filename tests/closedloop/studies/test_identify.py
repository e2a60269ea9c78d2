"""Parameters from logs in which they are known: exact without noise, in their intervals with it, refused else."""

import re
from dataclasses import replace

import numpy as np
import pytest
from identified import excitation, simulated, true_base
from scipy import signal

import closedloop as cl
import robot_models
from closedloop.studies.identify.motion import LogError
from closedloop.studies.identify.regressor import fit
from closedloop.studies.identify.written import friction_section, report, torque_figure, write

NOISE = (2e-5, 0.3)  # rad, N m


@pytest.fixture(scope="module")
def clean():
    """A log of planar2 without noise, its robot, and what is identified from it."""
    log, robot = simulated("planar2", count=4000)
    return log, robot, cl.identify(log, robot, cutoff=10.0)


def test_without_noise_the_parameters_are_the_true_ones(clean):
    """Base parameters, friction and drive inertia come out, to what the filter takes from the motion."""
    found = clean[2]
    assert np.abs(found.solution.value - true_base(found)).max() < 2e-3
    assert found.held_out.max() < 1e-3
    assert not found.not_identifiable
    assert found["dry_" + found.robot.joint_names[0]].value == pytest.approx(2.0, abs=1e-3)


@pytest.mark.parametrize("name", ["planar2", "wam4", "panda", "ur10"])
def test_base_parameters_carry_the_whole_inverse_dynamics(name):
    """At states that no one looked at, the base columns times the base parameters are W χ, for any χ."""
    robot = robot_models.load(name)
    from closedloop.studies.identify.regressor import Regressor, Terms, base_parameters

    regressor = Regressor(robot, Terms())
    base = base_parameters(regressor)
    W = regressor.rows(*excitation(robot.n, 40, 0.1, seed=5))
    chi = np.random.default_rng(1).normal(size=len(regressor.names))
    np.testing.assert_allclose(W[:, :, base.kept] @ (base.grouping @ chi), W @ chi, atol=1e-9 * np.abs(W @ chi).max())
    assert np.linalg.matrix_rank(W.reshape(-1, W.shape[2])) == len(base.kept)


def test_a_six_joint_arm_has_as_many_base_parameters_as_the_literature_says():
    """A UR10 has 36: ten a link, less what its parallel axes and the first, vertical one do not show."""
    from closedloop.studies.identify.regressor import INERTIAL, Regressor, Terms, base_parameters

    regressor = Regressor(robot_models.load("ur10"), Terms((), drive_inertia=False))
    kept = [regressor.names[k] for k in base_parameters(regressor).kept]
    assert len(kept) == 36
    assert {name.split("_", 1)[0] for name in kept} <= set(INERTIAL)


@pytest.mark.slow
@pytest.mark.parametrize("pole", [0.0, 0.98])
def test_what_is_stated_covers_the_truth(pole):
    """Of 200 logs with noise, white or of a tenth of a second, 95 % intervals cover 95 ± 2 %, and the bias is small."""
    motion = excitation(2, 2500, 0.002, base=0.5)
    inside, error, deviation = [], [], []
    for seed in range(200):
        log, robot = simulated("planar2", count=2500, noise=(NOISE[0], 0.0), seed=seed, motion=motion)
        torque = log.torque + NOISE[1] * coloured(log.q.shape, pole, seed)
        found = cl.identify(replace(log, torque=torque), robot, cutoff=10.0, held_out=0.0)
        error.append(found.solution.value - true_base(found))
        deviation.append(found.solution.deviation)
        inside.append(np.abs(error[-1]) < 1.96 * deviation[-1])
    assert 0.93 < np.mean(inside) < 0.97
    assert (np.abs(np.mean(error, axis=0)) < 1.96 * np.mean(deviation, axis=0) / 3.0).all()


def coloured(shape, pole, seed):
    """Return noise (N, n) of variance 1 whose neighbours have this correlation."""
    noise = np.random.default_rng(seed).normal(size=(shape[0] + 1000, shape[1]))
    return np.sqrt(1.0 - pole**2) * signal.lfilter([1.0], [1.0, -pole], noise, axis=0)[1000:]


def test_intervals_of_coloured_noise_cover():
    """A mean, a slope and a wave in noise whose windows are alike, some of them not used: 95 % are 95 %."""
    rng, t = np.random.default_rng(0), np.linspace(-1.0, 1.0, 120)
    W = np.stack([np.ones_like(t), t, np.sin(20.0 * t)], axis=1)[:, None, :] * np.ones((1, 2, 1))
    used = rng.uniform(size=(120, 2)) > 0.2
    found = [fit(W, W @ np.ones(3) + coloured((120, 2), 0.6, seed) * [1.0, 3.0], used) for seed in range(120)]
    inside = [np.abs(each.value - 1.0) < 1.96 * each.deviation for each in found]
    assert 0.93 < np.mean(inside) < 0.97
    assert np.mean([each.correlation for each in found], axis=0) == pytest.approx([0.6, 0.6], abs=0.04)
    assert np.mean([each.sigma for each in found], axis=0) == pytest.approx([1.0, 3.0], rel=0.06)


def test_noise_of_positions_biases_least_squares_and_not_instruments():
    """With positions so noisy that the regressor suffers, instruments halve the error at least."""
    log, robot = simulated("planar2", count=20000, step=0.001, noise=(2e-3, 0.01), size=1.0)
    worst, plain = {}, None
    for method in ("ls", "iv"):
        found = cl.identify(log, robot, cutoff=30.0, method=method, held_out=0.0, slow=0.1)
        true = true_base(found)
        worst[method] = np.linalg.norm((found.solution.value - true)[np.abs(true) > 0.05])
        plain = found if method == "ls" else plain
    assert worst["iv"] < 0.5 * worst["ls"], worst
    np.testing.assert_allclose(found.noise_bias, plain.solution.value - found.solution.value)


def test_what_no_joint_excited_is_not_identifiable():
    """A joint that rests has no friction that the log tells; the others have."""
    log, robot = simulated("wam4", count=4000, noise=(1e-6, 0.01), still=[2])
    found = cl.identify(log, robot, cutoff=10.0)
    for kind in ("viscous", "dry", "drive_inertia"):
        assert "J3 rests" in found[f"{kind}_J3"].why
        assert np.isnan(found[f"{kind}_J3"].value)
    assert found["dry_J2"].why == ""
    assert found["dry_J2"].low < 2.0 < found["dry_J2"].high


@pytest.mark.parametrize("method", ["ls", "iv"])
def test_a_joint_that_creeps_tells_nothing_of_itself_and_leaves_the_others(method):
    """Held by friction it moves by counts of its encoder, or is pushed once: the others are as without it."""
    robot, t = robot_models.load("wam4"), np.arange(2500) * 0.004
    rng, q = np.random.default_rng(0), np.zeros((2500, 4))
    q[:, 1] = 0.9 * np.sin(1.1 * t) + 0.2 * np.sin(2.9 * t)
    q[:, 3] = 1.2 + 0.5 * np.sin(1.7 * t + 1.0) + 0.1 * np.sin(4.1 * t)
    q[:, [0, 2]] += 5e-6 * np.cumsum(rng.normal(size=(2500, 2)), axis=0)
    q[:, 2] += 0.01 * np.exp(-(((t - 5.0) / 0.2) ** 2))
    v = np.gradient(q, 0.004, axis=0)
    a = np.gradient(v, 0.004, axis=0)
    log, _ = simulated(robot, noise=(0.0, 0.05), motion=(q, v, a), friction={"viscous": 1.5}, count=2500, step=0.004)
    friction = np.sign(v) * (np.abs(v) > 1e-3)
    found = cl.identify(
        replace(log, q=np.round(q / 1.5e-5) * 1.5e-5, torque=log.torque + friction), robot, method=method
    )
    for name in ("viscous_J1", "dry_J1", "offset_J1", "viscous_J3", "dry_J3", "offset_J3", "drive_inertia_J3"):
        assert f"{name[-2:]} rests in this log, or moves too little" in found[name].why
    assert not found.used[:, [0, 2]].any()
    assert "nan" not in "\n".join(report(found)).lower()
    titles = [axes.get_title() for axes in torque_figure(found).axes]
    assert [title.endswith("not counted") for title in titles] == [True, False, True, False]
    for joint in ("J2", "J4"):
        for kind, true in (("viscous", 1.5), ("dry", 1.0), ("offset", 0.0)):
            entry = found[f"{kind}_{joint}"]
            assert abs(entry.value - true) < 2.0 * (entry.high - entry.low) / 2.0 < 0.2
    assert (found.relative_error[[1, 3]] < 0.01).all()
    assert all(np.isnan(e.value) or abs(e.value) < 20.0 for e in found.estimates)


def test_what_no_robot_can_be_is_said(tmp_path):
    """Friction and inertia of drives below zero, surely: by name, with what it would mean; and not for noise alone."""
    log, robot = simulated("planar2", count=3000, noise=(2e-5, 0.1), friction={"viscous": -0.5, "dry": 2.0})
    found = cl.identify(log, robot)
    assert [e.name for e in found.not_physical] == ["viscous_J1", "viscous_J2"]
    assert "NOT PHYSICAL: viscous_J1 is -0." in "\n".join(report(found))
    assert "drive the joint" in "\n".join(report(found))
    assert found.summary()["not_physical"] == ["viscous_J1", "viscous_J2"]
    lost, _ = simulated("planar2", count=3000, noise=(2e-5, 0.1))
    drives = replace(lost, torque=lost.torque - 0.5 * np.gradient(np.gradient(lost.q, 0.002, axis=0), 0.002, axis=0))
    assert "drive_inertia_J2" in [e.name for e in cl.identify(drives, robot, cutoff=10.0).not_physical]
    assert cl.identify(lost, robot).not_physical == ()
    slightly = replace(lost, torque=lost.torque - 0.05 * np.gradient(np.gradient(lost.q, 0.002, axis=0), 0.002, axis=0))
    for log, impossible in ((lost, False), (slightly, True)):
        write(cl.identify(log, robot, cutoff=10.0), tmp_path, "a log")
        assert ("physically impossible" in (tmp_path / "report.txt").read_text()) == impossible
    quiet = cl.identify(*simulated("wam4", count=4000, friction={}))  # intervals narrower than filters are exact
    assert quiet["viscous_J1"].high < 0.0
    assert quiet.not_physical == ()


def test_friction_at_one_speed_is_not_told_apart():
    """At one constant speed, one way, viscous friction, dry friction and offset look alike, and the message says so."""
    robot = robot_models.load("planar2")
    t = np.arange(4000) * 0.002
    q = np.stack([0.3 * t, 0.4 * np.sin(3.0 * t)], axis=1)
    v = np.stack([np.full_like(t, 0.3), 1.2 * np.cos(3.0 * t)], axis=1)
    a = np.stack([np.zeros_like(t), -3.6 * np.sin(3.0 * t)], axis=1)
    log, _ = simulated(robot, count=4000, noise=(1e-6, 0.01), motion=(q, v, a))
    found = cl.identify(log, robot, cutoff=10.0)
    first = robot.joint_names[0]
    lost = [kind for kind in ("viscous", "dry", "offset") if "looks like" in found[f"{kind}_{first}"].why]
    assert len(lost) == 2
    assert "several speeds" in "".join(found[f"{kind}_{first}"].why for kind in lost)


def test_a_stribeck_term_is_found_where_it_is_excited():
    """v_s from the candidates, the excess inside its interval; at high speed only, it is not identifiable."""
    law = {"viscous": 1.5, "dry": 2.0, "offset": 0.4, "stribeck": 1.5, "speed": 0.1}
    log, robot = simulated("planar2", count=20000, noise=(1e-7, 0.02), friction=law, base=0.1)
    found = cl.identify(log, robot, cutoff=10.0, stribeck_speed="fit")
    assert found.regressor.terms.stribeck_speed.tolist() == [0.1, 0.1]
    for entry in found.joints("stribeck"):
        assert abs(entry.value - 1.5) < 3.0 * (entry.high - entry.low) / 2.0
        assert not entry.why
    found = cl.identify(log, robot, cutoff=10.0, stribeck_speed=1e-4)
    assert all("never moves as slowly" in entry.why for entry in found.joints("stribeck"))
    assert [entry.name for entry in found.joints("Izz")] == [f"Izz_{joint}" for joint in robot.joint_names]
    with pytest.raises(cl.ModelError, match=r"joints\('x'\): a kind of parameter must be one of viscous, dry, offset,"):
        found.joints("x")


def test_friction_of_the_load_is_found_beside_the_others():
    """A gear that rubs with 12 % of what it passes on: exact without noise, near it with; left out, it is missed."""
    rubs = {"viscous": 1.5, "dry": 2.0, "offset": 0.4, "load": 0.12}
    terms = ("viscous", "dry", "offset", "load")
    log, robot = simulated("planar2", count=4000, friction=rubs)
    found = cl.identify(log, robot, cutoff=10.0, friction=terms)
    for kind, value in rubs.items():
        # in some windows the load changes its sign
        assert [e.value for e in found.joints(kind)] == pytest.approx([value] * 2, abs=1e-2)
    assert "[transmission]\nload_friction = [0.1" in friction_section(found)
    noisy = replace(log, torque=log.torque + NOISE[1] * coloured(log.q.shape, 0.0, 1))
    noisy = cl.identify(noisy, robot, cutoff=10.0, friction=terms)
    assert all(e.low - 0.005 < 0.12 < e.high + 0.005 for e in noisy.joints("load"))
    assert noisy.joints("load")[0].high - noisy.joints("load")[0].low < 0.05
    assert cl.identify(log, robot, cutoff=10.0).held_out.max() > 5.0 * found.held_out.max()
    with pytest.raises(cl.ClosedLoopError, match=r"friction is 'load'.*leave it out"):
        cl.excite(robot, friction=("load",))


def test_a_wrong_model_is_found_out():
    """With friction left out of the model, or a link of another length, the residual is no white noise, and large."""
    log, robot = simulated("planar2", count=4000, noise=NOISE)
    right = cl.identify(log, robot, cutoff=10.0)
    assert right.misses == ()
    assert right.above_noise.max() < 1.5
    wrong = cl.identify(log, robot, cutoff=10.0, friction=("viscous",))
    assert wrong.misses == robot.joint_names
    assert (wrong.held_out > 3.0 * right.held_out).all()


def test_a_delay_of_the_torque_is_found_out():
    """Four samples late, and the residual of every joint is no white noise."""
    log, robot = simulated("planar2", count=8000, step=0.001, noise=(2e-5, 0.1))
    late = replace(log, torque=np.roll(log.torque, 4, axis=0)).part(0.01, 1.0)
    assert cl.identify(log, robot, cutoff=10.0).misses == ()
    assert cl.identify(late, robot, cutoff=10.0).misses == robot.joint_names


def test_small_angles_in_degrees_are_seen_by_the_limits():
    """Below thirty, angles in degrees are found where a joint of the file cannot turn so far."""
    log, robot = simulated("ur10", count=1000, size=0.1)
    limited = replace(robot, position_upper=np.full(6, 3.0), position_lower=np.full(6, -3.0))
    cl.identify(log, limited, cutoff=20.0)
    with pytest.raises(LogError, match=r"rad, \S+ beyond its limit: angles in degrees"):
        cl.identify(replace(log, q=np.rad2deg(log.q)), limited, cutoff=20.0)


def test_joints_may_come_in_another_order(clean):
    """Columns are put into the robot's order by their names."""
    log, robot, found = clean
    turned = replace(log, q=log.q[:, ::-1], torque=log.torque[:, ::-1], joint_names=log.joint_names[::-1])
    assert np.array_equal(cl.identify(turned, robot, cutoff=10.0).solution.value, found.solution.value)


def test_several_logs_are_one(clean):
    """Two halves given apart tell what the whole tells, to what is lost at their ends."""
    log, robot, found = clean
    both = cl.identify([log.part(0.0, 0.5), log.part(0.5, 1.0)], robot, cutoff=10.0)
    assert np.abs(both.solution.value - found.solution.value).max() < 2e-3


def bad(what, log):
    """Return a log with one fault."""
    if what == "degrees":
        return replace(log, q=np.rad2deg(log.q))
    if what == "jump":
        time = log.time.copy()
        time[2000:] += 0.5
        return replace(log, time=time)
    if what == "wrapped":
        return replace(log, q=(log.q + 20.0) % (2.0 * np.pi) - np.pi)
    if what == "rest":
        return replace(log, q=np.zeros_like(log.q))
    if what == "nan":
        torque = log.torque.copy()
        torque[7, 1] = np.nan
        return replace(log, torque=torque)
    if what == "velocities":
        return replace(log, v=np.rad2deg(np.gradient(log.q, log.step, axis=0)))
    if what == "order":
        return replace(log, v=np.gradient(log.q, log.step, axis=0)[:, ::-1])
    return {
        "short": log.part(0.0, 0.01),
        "backwards": replace(log, time=log.time[::-1]),
        "others": replace(log, joint_names=("a", "b")),
        "shape": replace(log, q=log.q[:, :1]),
    }[what]


@pytest.mark.parametrize(
    ("what", "says"),
    [
        ("degrees", "angles look like degrees, and must be in rad"),
        ("jump", r"time jumps by 0.502 s after row 1999 \(1 such places\), where rows are 0.002 s apart"),
        ("wrapped", r"turns by 6.\d+ rad from row \d+ to the next, more than half a turn: do its angles begin anew"),
        ("rest", "the robot rests"),
        ("nan", r"torque of joint \S+ in row 7 is nan: must be finite"),
        ("velocities", "57.3 times the rate of its positions: they look like degrees"),
        ("order", "are the joints in another order"),
        ("short", "needs at least 100"),
        ("backwards", "time does not increase"),
        ("others", "its joints are a, b: those of"),
        ("shape", r"q has shape \(4000, 1\)"),
    ],
)
def test_a_log_that_cannot_be_is_refused_in_one_line(clean, what, says):
    """One line: what, where, what would be right."""
    with pytest.raises(LogError, match=says) as caught:
        cl.identify(bad(what, clean[0]), clean[1])
    assert "\n" not in str(caught.value)
    assert not re.search(r"Traceback|Error:", str(caught.value))
