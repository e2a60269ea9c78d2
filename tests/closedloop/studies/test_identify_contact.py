"""The contact from a log: friction, a surface that gives, restitution, the sensor, and what a log does not tell."""

import dataclasses
import json
from types import SimpleNamespace

import numpy as np
import pytest
from budget import budget

import closedloop as cl
import robot_models
from closedloop.base.errors import ModelError
from closedloop.command.logs import identify as main
from closedloop.studies.identify.contact.found import Part, _begin, _estimates, known, touch_of
from closedloop.studies.identify.contact.identify_contact import BEGINNINGS, _allow_for_counts, impacts_of
from closedloop.studies.identify.motion import LogError

STEP = 0.001
TRUE = {
    "friction": 0.3, "viscous_friction": 8.0, "stiffness": 8000.0, "damping": 60.0, "surface_offset": 0.1,
    "bias_x": 0.0, "bias_y": 0.0, "bias_z": 0.4, "sensor_delay": 0.002, "gain": 1.0,
}  # fmt: skip


def point():
    """Return a mass that slides along x, y and z: its joints are its position."""
    return robot_models.load("pointmass3")


def motion(duration=6.0, slides=1.0, sinks=4e-4, lift=0.004, speeds=True):
    """Return time, and position, velocity and acceleration of a tip that presses on z = 0.1, slides, and is lifted."""
    t = np.arange(round(duration / STEP)) * STEP
    waves = [(0.02, 1.1, 0.0), (0.008, 2.9, 1.0)] if speeds else [(0.02, 1.1, 0.0)]
    down = [(sinks, 3.7, 0.3), (0.6 * sinks, 7.9, 1.0)]
    x, z = np.zeros((3, len(t))), np.zeros((3, len(t)))
    for rows, terms in ((x, waves), (z, down)):
        for size, f, phase in terms:
            w = 2.0 * np.pi * f
            angle = w * t + phase
            rows += size * np.array([np.sin(angle), w * np.cos(angle), -w * w * np.sin(angle)])
    x *= slides
    z[0] += TRUE["surface_offset"] - 1.8 * sinks
    # Lifted in the last fifth, from rest to rest: a smooth step.
    T, start = 0.2 * duration, 0.8 * duration
    s = np.clip((t - start) / T, 0.0, 1.0)
    step = np.array(
        [s**3 * (10 - 15 * s + 6 * s * s), 30 * (s * (1 - s)) ** 2 / T, 60 * s * (1 - s) * (1 - 2 * s) / T**2]
    )
    z += lift * step
    return t, *(np.stack([a, 0.3 * a, b], axis=1) for a, b in zip(x, z, strict=True))


def force_of(r, v, true=TRUE, law=None):
    """Return the force on the tip (N, 3), of a plane z = 0.1 that gives."""
    deep = true["surface_offset"] - r[:, 2]
    f = np.where(deep > 0.0, true["stiffness"] * deep - true["damping"] * v[:, 2], 0.0) if law is None else law(deep, v)
    f = np.maximum(f, 0.0)
    slip = v * [1.0, 1.0, 0.0]
    speed = np.linalg.norm(slip, axis=1)[:, None]
    sliding = np.divide(slip, speed, out=np.zeros_like(slip), where=speed > 0.0)
    friction = -(true["friction"] * f[:, None] * sliding + true["viscous_friction"] * slip) * (f > 0.0)[:, None]
    return f[:, None] * [0.0, 0.0, 1.0] + friction


def recorded(seed=0, noise=(3e-6, 0.1), true=TRUE, law=None, torque=True, **moving):
    """Return a log with noise of positions, m, and of forces, N, and a sensor that is late and has a bias."""
    t, r, v, a = motion(**moving)
    force = force_of(r, v, true, law)
    drives = 2.0 * (a + np.array([0.0, 0.0, 9.81])) - force
    late = force_of(
        *(np.stack([np.interp(t - true["sensor_delay"], t, c) for c in x.T], axis=1) for x in (r, v)), true, law
    )
    rng = np.random.default_rng(seed)
    read = late + [true["bias_x"], true["bias_y"], true["bias_z"]] + noise[1] * rng.normal(size=force.shape)
    return cl.Recording(t, r + noise[0] * rng.normal(size=r.shape), drives if torque else None, true["gain"] * read)


@pytest.mark.slow
def test_biases_are_below_a_third_of_the_intervals_that_hold():
    """Of logs with noise and delay: every parameter of contact and sensor, and 95 % intervals that cover."""
    found = [cl.identify_contact(recorded(seed), point()) for seed in range(budget(20, 40))]
    for name, true in TRUE.items():
        value, low, high = np.array([[getattr(x[name], k) for k in ("value", "low", "high")] for x in found]).T
        half = (high - low).mean() / 2.0
        assert abs(value.mean() - true) < half / 3.0, name
        assert np.mean((low <= true) & (true <= high)) >= 0.85, name
        assert half < 0.15 * abs(true) + 0.02 * (true == 0.0) or name == "sensor_delay", name
    assert sum(bool(x.misses) for x in found) <= len(found) // 10


def counted(seed, count):
    """Return a log whose positions are counts of encoders, m, from somewhere within a count on."""
    log = recorded(seed, noise=(0.0, 0.1))
    first = np.random.default_rng(1000 + seed).uniform(size=3) * count
    return dataclasses.replace(log, q=np.round((log.q + first) / count) * count - first)


@pytest.mark.parametrize(("count", "wide"), budget([(1e-4, 0.6)], [(5e-5, 0.3), (1e-4, 0.6)]))
def test_intervals_of_encoders_that_count_cover(count, wide):
    """Of a tip that is 0.7 mm deep, of counts of 1/14 and 1/7 of it: what counts do to the estimates is no noise.

    With 0.1 mm the stiffness was off by 1.2 of half its interval, and two of ten intervals held.
    """
    found = [cl.identify_contact(counted(seed, count), point()) for seed in range(budget(2, 40))]
    for name in ("friction", "viscous_friction", "stiffness", "damping", "surface_offset"):
        each = [x[name] for x in found if not x[name].why]
        if not each and name == "damping":
            continue
        value, low, high = np.array([[getattr(x, k) for k in ("value", "low", "high")] for x in each]).T
        half = (high - low).mean() / 2.0
        assert abs(value.mean() - TRUE[name]) < 0.8 * half, name
        assert np.mean((low <= TRUE[name]) & (TRUE[name] <= high)) >= 0.8, name
        assert half < wide * abs(TRUE[name]), name


def test_intervals_allow_for_how_few_beginnings_of_counts_are_drawn():
    """Of errors with one distribution, drawn as few times, 95 % hold the true one: of the normal quantile 89 % did."""
    z, draw, trials, hold = 1.959964, np.random.default_rng(0), 300, 0
    t = np.arange(100) * STEP
    counts = np.round(np.sin(3.0 * t[:, None] + np.arange(3.0)) / 1e-3) * 1e-3
    for _ in range(trials):
        values = iter([0.0, *draw.normal(size=BEGINNINGS)])
        parts = [Part("friction, N", [known("friction", float(draw.normal()), 0.0, "1", z)])]

        def fit(recording, values=values):
            return [Part("friction, N", [known("friction", next(values), 0.0, "1", z)])]

        _allow_for_counts(cl.Recording(t, counts), parts, 20.0, z, fit)
        (found,) = parts[0].estimates
        hold += found.low <= 0.0 <= found.high
    assert hold / trials == pytest.approx(0.95, abs=0.025)


@pytest.mark.parametrize(
    ("true", "count"), [(TRUE, 0.0), (TRUE, 2e-4), (TRUE | {"friction": 0.0, "viscous_friction": 0.0}, 2e-4)]
)
def test_friction_of_a_slip_that_turns(true, count):
    """On a circle, at speeds that vary, where encoders count or not: within the intervals, and nothing is missed.

    Means of forces that turn within a window are shorter than the forces: the viscous part was off by 5 half intervals,
    and a friction without a force was found. Directions from counts made the friction smaller by their cosine.
    """
    t = np.arange(6000) * STEP
    angle, rate = 4.0 * t + 1.5 * np.sin(1.7 * t), 4.0 + 2.55 * np.cos(1.7 * t)
    r = np.stack([0.05 * np.cos(angle), 0.05 * np.sin(angle), 0.0 * t + true["surface_offset"] - 1e-3], axis=1)
    v = 0.05 * rate[:, None] * np.stack([-np.sin(angle), np.cos(angle), 0.0 * t], axis=1)
    rng = np.random.default_rng(0)
    force = force_of(r, v, true) + 0.01 * rng.normal(size=r.shape)
    q = np.round((r + 0.37 * count) / count) * count if count else r
    found = cl.identify_contact(cl.Recording(t, q, None, force), point(), delay=0.0)
    for name in ("friction", "viscous_friction"):
        assert found[name].low <= true[name] <= found[name].high, name
        assert found[name].high - found[name].low < 0.05 * TRUE[name], name
    assert not [text for text in found.misses if "friction" in text]


def test_without_torques_the_delay_is_told_from_the_damping():
    """The acceleration tells them apart: within their intervals; given, the damping is known better."""
    for seed in range(5):
        found = cl.identify_contact(recorded(seed, torque=False), point())
        for name, true in (("delay", 0.002), ("damping", 60.0), ("stiffness", 8000.0), ("friction", 0.3)):
            half = (found[name].high - found[name].low) / 2.0
            assert abs(found[name].value - true) < 2.0 * half, name
    given = cl.identify_contact(recorded(4, torque=False), point(), delay=0.002)
    assert given["damping"].high - given["damping"].low < 0.5 * (found["damping"].high - found["damping"].low)


@pytest.mark.parametrize(
    ("moving", "names", "why"),
    [
        ({"slides": 0.0}, ("friction", "viscous_friction"), "hardly slides"),
        ({"sinks": 1e-12}, ("stiffness", "damping", "surface_offset"), "touches"),
        ({"lift": 0.0}, ("bias_x", "bias_z", "payload", "surface_offset"), "free"),
        ({}, ("restitution",), "no impact"),
        ({}, ("payload",), "does not turn"),
    ],
)
def test_what_was_never_excited_is_not_identifiable(moving, names, why):
    """It has no value and no interval, and the motion that would tell it is named."""
    found = cl.identify_contact(recorded(**moving), point())
    for name in names:
        assert np.isnan(found[name].value)
        assert found[name].high == np.inf
        assert why in found[name].why
    assert why in "\n".join(found.lines())
    json.dumps(found.summary(), allow_nan=False)


def test_friction_at_one_speed_is_one_number():
    """Under one force and at one speed, both parts of the friction are one, whose sum is known."""
    t = np.arange(4000) * STEP
    r = np.stack([0.05 * t, 0.0 * t, np.full_like(t, 0.1 - 1e-3)], axis=1)
    force = np.broadcast_to([-(0.3 * 8.0 + 8.0 * 0.05), 0.0, 8.0], r.shape)
    rng = np.random.default_rng(0)
    log = cl.Recording(t, r + 1e-6 * rng.normal(size=r.shape), None, force + 0.1 * rng.normal(size=r.shape))
    found = cl.identify_contact(log, point())
    assert "one speed" in found["viscous_friction"].why
    assert found["friction"].low < 0.3 + 8.0 * 0.05 / 8.0 < found["friction"].high
    assert "viscous_friction" in found["friction"].grouping


def test_a_wrong_model_is_found_out():
    """Damping that grows with depth, friction of Stribeck, another normal; without them nothing is missed."""
    assert cl.identify_contact(recorded(), point()).misses == ()
    hunt = recorded(law=lambda d, v: 3e5 * np.maximum(d, 0.0) ** 1.5 * (1.0 - 1.0 * v[:, 2]))
    assert any("surface" in text for text in cl.identify_contact(hunt, point()).misses)
    tilted = cl.identify_contact(recorded(), point(), normal=(0.1, 0.0, 1.0))
    assert tilted.misses
    log = recorded()
    _, r, v, _ = motion()
    extra = -force_of(r, v)[:, 2:] * 0.2 * np.exp(-((v * [1, 1, 0]) ** 2).sum(axis=1, keepdims=True) / 0.05**2)
    slip = v * [1.0, 1.0, 0.0]
    stuck = log.force + extra * slip / np.maximum(np.linalg.norm(slip, axis=1, keepdims=True), 1e-12)
    found = cl.identify_contact(cl.Recording(log.time, log.q, log.torque, stuck), point())
    assert any("low speed" in text for text in found.misses)


def bouncing(e, noise=2e-6, seed=0, count=7, start=0.3):
    """Return time and height of a mass that bounces with e, a number or a function of the speed."""
    t, g, h = np.arange(2000) * STEP, 9.81, np.zeros(2000)
    at, z, v = 0.0, start, 0.0
    for k in range(count + 1):
        fall = (v + np.sqrt(v * v + 2.0 * g * z)) / g if k < count else 10.0
        rows = (t >= at) & (t < at + fall)
        s = t[rows] - at
        h[rows] = np.maximum(z + v * s - 0.5 * g * s * s, 0.0)
        at, hit, z = at + fall, g * fall - v, 0.0
        v = hit * (e(hit) if callable(e) else e)
    return t, h + noise * np.random.default_rng(seed).normal(size=len(t))


def in_space(t, h):
    """Return a log of a point at these heights."""
    return cl.Recording(t, np.stack([0.0 * h, 0.0 * h, h], axis=1))


def test_restitution_of_bounces():
    """Rates to their noise, e within its interval and a third of it on average; one that depends on speed is said."""
    t, h = bouncing(0.6)
    impacts = impacts_of(t, h)
    assert len(impacts) == 7
    for x in impacts:
        assert abs(x.after + 0.6 * x.before) < 5.0 * x.noise
    assert abs(impacts[0].before + np.sqrt(2 * 9.81 * 0.3)) < 5.0 * impacts[0].noise < 0.05
    found = [cl.identify_contact(in_space(*bouncing(0.6, seed=seed)), point()) for seed in range(25)]
    value, low, high = np.array([[getattr(x["restitution"], k) for k in ("value", "low", "high")] for x in found]).T
    assert abs(value.mean() - 0.6) < (high - low).mean() / 6.0
    assert np.mean((low <= 0.6) & (high >= 0.6)) >= 0.85
    assert not any(x.misses for x in found)
    assert "no force" in found[0]["friction"].why
    falling = cl.identify_contact(in_space(*bouncing(lambda v: 0.8 - 0.1 * v)), point())
    assert any("depends on the speed" in text for text in falling.misses)


def test_a_smooth_turn_is_no_impact():
    """A tip that turns round under a controller, however fast, has no kink."""
    t = np.arange(3000) * STEP
    h = 0.05 * np.abs(np.sin(6.0 * t)) ** 2 + 1e-6 * np.random.default_rng(0).normal(size=len(t))
    assert impacts_of(t, h) == []


def test_free_and_closed_rows_are_told_whatever_the_bias():
    """Rows above the surface are free with a bias of −3 N too, and none is both."""
    from closedloop.mechanics.robot.pinocchio import Robot

    log = recorded(true=TRUE | {"bias_z": -3.0})
    touch = touch_of(log, Robot(point()), np.array([0.0, 0.0, 1.0]))
    over = motion()[1][:, 2] - TRUE["surface_offset"]
    assert not (touch.free & touch.closed).any()
    assert (over[touch.free] > 0.0).all()
    assert (over[touch.closed] < 1e-5).all()
    assert touch.free.mean() > 0.05
    assert touch.closed.mean() > 0.6


def test_the_command_writes_what_it_found(tmp_path, capsys, monkeypatch):
    """From a CSV with three components of the force."""
    monkeypatch.chdir(tmp_path)
    log, names = recorded(), point().joint_names
    head = ["time", *(f"q_{n}" for n in names), *(f"torque_{n}" for n in names), "fx", "fy", "fz"]
    np.savetxt(
        "log.csv",
        np.column_stack([log.time, log.q, log.torque, log.force]),
        delimiter=",",
        header=",".join(head),
        comments="",
    )
    assert main(["log.csv", "--robot", "pointmass3", "--contact", "0,0,1", "--out", "found"]) == 0
    told = capsys.readouterr().out
    assert "stiffness" in told
    summary = json.loads((tmp_path / "found" / "contact.json").read_text())
    assert summary["parameters"]["friction"]["value"] == pytest.approx(0.3, rel=0.02)
    assert (tmp_path / "found" / "contact.png").exists()


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["x.csv", "--contact", "0,1"], "2 numbers: three"),
        (["x.csv", "--contact", "0,a,1"], "must be a number"),
        (["x.csv", "x.csv", "--contact", "0,0,1"], "2 logs"),
        (["x.csv", "--contact", "0,0,1"], "no column time"),
        (["x.csv", "--contact", "0,0,1", "--columns", "force=a,b"], "no column"),
    ],
)
def test_wrong_words_are_one_line(words, says, tmp_path, capsys, monkeypatch):
    """Exit status 2."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "x.csv").write_text("a,b\n1,2\n3,4\n")
    assert main([*words, "--robot", "pointmass3"]) == 2
    error = capsys.readouterr().err
    assert says in error
    assert error.count("\n") == 1


@pytest.mark.parametrize(
    ("log", "options", "says"),
    [
        (lambda: in_space(np.arange(500) * STEP, np.zeros(500)), {}, "the robot rests"),
        (lambda: in_space(*bouncing(0.5)), {"normal": (0, 0, 0)}, "not all 0"),
        (lambda: in_space(*bouncing(0.5)), {"confidence": 1.0}, "confidence"),
        (
            lambda: cl.Recording(np.r_[np.arange(500), 700 + np.arange(500)] * STEP, np.zeros((1000, 3))),
            {},
            "time jumps",
        ),
        (lambda: cl.Recording(np.arange(500) * STEP, np.zeros((500, 2))), {}, "q has shape"),
        (lambda: cl.Recording(np.arange(500) * STEP, np.full((500, 4), 60.0)), {"robot": "wam4"}, "look like degrees"),
    ],
)
def test_bad_input_is_refused(log, options, says):
    """One line that names it."""
    with pytest.raises((LogError, ModelError), match=says):
        cl.identify_contact(log(), **({"robot": point()} | options))


@pytest.mark.slow
def test_a_run_of_a_robot_tells_its_own_contact():
    """A bounce of the WAM: its restitution; the paper's slide on a soft table: stiffness and damping."""
    run = cl.simulate(cl.load_scenario("wam_bounce"), progress=False)
    assert cl.identify_contact(run)["restitution"].value == pytest.approx(0.7, rel=5e-4)
    run = cl.simulate(cl.load_scenario("soft_table", {"time.duration": 3.0, "time.integrator": "rk4"}), progress=False)
    found = cl.identify_contact(run)
    assert found["stiffness"].value == pytest.approx(1e4, rel=2e-3)
    assert found["damping"].value == pytest.approx(100.0, rel=0.02)
    assert abs(found["delay"].value) < 5e-5


def test_a_label_is_no_longer_than_its_panel():
    """Of a run that slides, with torques: three parts."""
    changes = {"friction.kind": "coulomb", "friction.coefficient": 0.2, "time.duration": 2.0}
    figure = cl.identify_contact(cl.simulate(cl.load_scenario("soft_table", changes), progress=False)).figure()
    figure.draw_without_rendering()
    assert any("beside that" in axes.get_ylabel() for axes in figure.axes)
    for axes in figure.axes:
        assert axes.yaxis.label.get_window_extent().height < axes.get_window_extent().height


def test_a_constant_force_tells_no_gain(tmp_path):
    """A force without noise that never changes is one level, and its figure has no curves."""
    time = np.arange(1000) * STEP
    q = np.stack([0.1 * np.sin(time), np.zeros_like(time), np.zeros_like(time)], axis=1)
    found = cl.identify_contact(cl.Recording(time, q, None, np.full(1000, 10.0)), point(), normal=(0.0, 0.0, 1.0))
    assert found.closed == 1.0
    assert all(each.why for each in found.estimates)
    found.figure().savefig(tmp_path / "a.png")


@pytest.mark.parametrize("signed", [False, True])
def test_force_and_speed_alone_tell_the_surface(signed, tmp_path, capsys):
    """Of a tip that moves along the normal its speed tells how deep it is, with the sign or without."""
    t, r, v, _ = motion(slides=0.0)
    rng = np.random.default_rng(4)
    force = force_of(r, v)[:, 2] + 0.1 * rng.normal(size=len(t))
    speed = v[:, 2] + 1e-5 * rng.normal(size=len(t))
    log = cl.Recording(t, force=force, speed=speed if signed else abs(speed))
    found = cl.identify_contact(log, point(), delay=0.0)
    assert found["stiffness"].value == pytest.approx(TRUE["stiffness"], rel=0.003)
    assert found["damping"].value == pytest.approx(TRUE["damping"], rel=0.01)
    assert "no positions" in found["surface_offset"].why
    assert "normal force only" in found["friction"].why
    np.savetxt(tmp_path / "log.csv", np.stack([t, force, log.speed], 1), delimiter=",", header="time,force,speed",
               comments="")  # fmt: skip
    words = [str(tmp_path / "log.csv"), "--robot", "pointmass3", "--contact", "0,0,1", "--out", str(tmp_path / "out")]
    assert main([*words, "--delay", "0"]) == 0
    assert "stiffness" in capsys.readouterr().out


def test_the_search_for_a_delay_begins_at_that_of_an_exact_force():
    """Of f(t − τ) = −k s − c ṡ, to second order in τ: its delay, stiffness and damping."""
    s, v, a = rows = np.random.default_rng(5).normal(size=(3, 400))
    k, c, late = 4e3, 60.0, 3e-3
    force = 7.0 - k * s - (c - k * late) * v - (0.5 * k * late**2 - c * late) * a
    np.testing.assert_allclose(_begin(rows.T, rows.T, force, np.ones(400, dtype=bool)), (late, k, c), rtol=1e-6)


def test_the_interval_of_the_offset_is_that_of_what_it_is_computed_from():
    """Middle + b/k of stiffnesses and forces at the middle that are drawn with their covariance."""
    value, root = np.array([5e3, -20.0, 50.0]), np.array([[50.0, 0.0, 0.0], [3.0, 2.0, 0.0], [0.0, 0.0, 1.0]])
    fit = SimpleNamespace(value=value, told=np.ones(3, dtype=bool))
    sensor = SimpleNamespace(delay_known=True, part=SimpleNamespace(estimates=[SimpleNamespace(why="")]))
    *_, offset = _estimates(fit, root @ root.T, 0.0, 0.1, sensor, 1.0)
    k, b, _ = value[:, None] + root @ np.random.default_rng(6).normal(size=(3, 100_000))
    assert offset.value == pytest.approx(np.mean(0.1 + b / k), abs=1e-5)
    assert 0.5 * (offset.high - offset.low) == pytest.approx(np.std(b / k), rel=0.03)
