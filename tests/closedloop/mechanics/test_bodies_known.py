"""Bodies whose motion is known: a top, a rattleback, Newton's cradle, dominoes."""

import numpy as np
import pytest

import closedloop as cl
from closedloop.scenario.load import parse_scenario

pytestmark = pytest.mark.slow
ALONE = """
[robot]
model = "none"
[time]
duration = 1.0
integrator = "rk4"
"""


def simulated(text: str, duration: float, step: float = 0.001) -> cl.Run:
    """Return the run of bodies and no robot."""
    scenario = parse_scenario(ALONE + text, overrides={"time.duration": duration, "time.step": step})
    run = cl.simulate(scenario, progress=False)
    assert run.stopped is None
    return run


def of(run: cl.Run, body: str, names: str) -> np.ndarray:
    """Return positions of a body, (N, ...)."""
    return run.q[:, [run.model.coordinate_names.index(f"{body}_{name}") for name in names.split()]]


def rates_of(run: cl.Run, body: str, names: str) -> np.ndarray:
    """Return velocities of a body, (N, ...)."""
    return run.v[:, [run.model.joint_names.index(f"{body}_{name}") for name in names.split()]]


def axis_of(quaternion: np.ndarray) -> np.ndarray:
    """Return a body's axis z in the base frame, (N, 3)."""
    w, x, y, z = quaternion.T
    return np.column_stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])


def test_a_top_precesses_as_goldstein_says() -> None:
    """Steady precession about its point: I1 cosθ Ω² − I3 ω3 Ω + m g l = 0 (Goldstein, Classical Mechanics, §5.7)."""
    m, arm, I1, I3, tilt, w3 = 0.5, 0.04, 4e-4, 3e-4, 0.4, 200.0
    about = I1 + m * arm * arm
    Omega = np.min(np.roots([about * np.cos(tilt), -I3 * w3, m * 9.81 * arm]))
    turn = [np.cos(tilt / 2), 0.0, np.sin(tilt / 2), 0.0]
    R = np.array([[np.cos(tilt), 0, np.sin(tilt)], [0, 1, 0], [-np.sin(tilt), 0, np.cos(tilt)]])
    spin = R.T @ [0.0, 0.0, Omega]
    spin[2] = w3
    centre, velocity = R @ [0, 0, arm], np.cross([0, 0, Omega], R @ [0, 0, arm])
    run = simulated(
        f"""
[[body]]
name = "top"
shape = "cylinder"
radius = 0.03
length = 0.02
mass = {m}
inertia = [{I1}, {I1}, {I3}, 0, 0, 0]
position = {centre.tolist()}
quaternion = {[float(x) for x in turn]}
velocity = {velocity.tolist()}
spin = {spin.tolist()}
[[contact]]
name = "point"
link = "top"
at = [0, 0, {-arm}]
friction = 5.0
""",
        1.0,
    )
    e = axis_of(of(run, "top", "qw qx qy qz"))
    wanted = np.column_stack(
        [np.sin(tilt) * np.cos(Omega * run.time), np.sin(tilt) * np.sin(Omega * run.time), 0 * run.time + np.cos(tilt)]
    )
    np.testing.assert_allclose(e, wanted, atol=2e-6)
    assert np.min(run.link_gaps) > -1e-9


def test_a_rattleback_turns_round() -> None:
    """Spun the wrong way it rocks, stops and turns the other way; nothing is lost where it rolls (Kane and Levinson,
    Int. J. Non-Linear Mechanics 17, 1982: an ellipsoid of half axes 20, 3 and 2 cm, moments 2, 16, 17 and −0.2 kg cm²).
    """
    half = 0.004  # of the turn about its long axis at the start
    height = np.hypot(0.03 * np.sin(2 * half), 0.02 * np.cos(2 * half)) - 0.01 * np.cos(2 * half)
    run = simulated(
        f"""
[[body]]
name = "stone"
shape = "box"
edges = [0.2, 0.04, 0.02]
mass = 1.0
inertia = [2e-4, 16e-4, 17e-4, -0.2e-4, 0, 0]
position = [0, 0, {float(height)!r}]
quaternion = [{float(np.cos(half))!r}, {float(np.sin(half))!r}, 0, 0]
spin = [0, 0, -5]
[[contact]]
name = "base"
link = "stone"
at = [0, 0, 0.01]
half_axes = [[0.2, 0, 0], [0, 0.03, 0], [0, 0, 0.02]]
friction = 2.0
[stabiliser]
time_constant = 0.001
""",
        6.0,
        0.0005,
    )
    turn = rates_of(run, "stone", "wz")[:, 0]
    assert turn[0] == -5.0
    assert np.max(turn) > 2.5
    facts = run.summary()
    assert facts["verdict"]["good"], facts["verdict"]


def test_balls_in_a_row_pass_the_velocity_on() -> None:
    """Newton's cradle by his law: equal balls a hair apart strike one after the other, and e = 1 swaps velocities."""
    balls = "".join(
        f"""
[[body]]
name = "ball{i}"
shape = "ball"
radius = 0.02
mass = 0.1
position = [{0.0401 * i}, 0, 0]
velocity = [{1.0 if i == 0 else 0.0}, 0, 0]
"""
        for i in range(4)
    )
    contacts = "".join(
        f"""
[[contact]]
link = "ball{i}"
radius = 0.02
against = "ball{i + 1}"
normal = [-1, 0, 0]
through = [-0.02, 0, 0]
surface = {{ kind = "sphere", radius = 0.02 }}
restitution = 1.0
"""
        for i in range(3)
    )
    run = simulated(balls + contacts, 0.02)
    last = [rates_of(run, f"ball{i}", "x")[-1, 0] for i in range(4)]
    np.testing.assert_allclose(last, [0, 0, 0, 1], atol=1e-12)
    assert len(run.event_time) == 3


def test_dominoes_fall_one_after_the_other() -> None:
    """The first is tipped, each strikes the next, and all end lying on those before them or on the floor."""
    count, pitch, (thick, wide, high) = 4, 0.03, (0.008, 0.025, 0.05)
    text = ""
    for i in range(count):
        corners = [[x * thick / 2, y * wide / 2, z * high / 2] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
        text += f"""
[[body]]
name = "d{i}"
shape = "box"
edges = [{thick}, {wide}, {high}]
mass = 0.01
position = [{pitch * i}, 0, {high / 2}]
{"spin = [0, 6.0, 0]" if i == 0 else ""}
{f"velocity = [{6.0 * high / 2}, 0, {-6.0 * thick / 2}]" if i == 0 else ""}
[[contact]]
name = "floor{i}"
link = "d{i}"
at = {corners}
friction = 0.4
"""
    for i in range(count - 1):
        text += f"""
[[contact]]
name = "next{i}"
link = "d{i}"
at = {[[thick / 2, y * wide / 2, high / 2] for y in (-1, 1)]}
against = "d{i + 1}"
normal = [-1, 0, 0]
through = [{-thick / 2}, 0, 0]
friction = 0.2
"""
    run = simulated(text, 0.8)
    tilts = [np.arccos(axis_of(of(run, f"d{i}", "qw qx qy qz"))[:, 2]) for i in range(count)]
    falls = [int(np.argmax(tilt > 0.3)) for tilt in tilts]
    assert 0 < falls[0] < falls[1] < falls[2] < falls[3]
    assert all(tilt[-1] > 0.9 for tilt in tilts)
    assert np.min(run.link_gaps) > -1e-6
    assert len(run.event_time) < 2000  # 10 000 and more if no modes are found and each 20 µs is a time step of its own
