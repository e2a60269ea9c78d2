"""Sequences of strikes that converge, or that alternate: between two walls, between a wall and a stop, in a groove."""

import numpy as np
import pytest
from boxes import G

import closedloop as cl

WIDTH = 0.1


def slider(path, axes, lower=-1000.0, upper=1000.0):
    """Write a URDF of a ball of 1 kg on prismatic joints along these axes, with these limits, m; return its name."""
    parts, parent = ['<link name="base"/>'], "base"
    for i, axis in enumerate(axes):
        child = "ball" if i == len(axes) - 1 else f"c{i}"
        heavy = (
            '<inertial><mass value="1"/><inertia ixx="1e-3" iyy="1e-3" izz="1e-3" ixy="0" ixz="0" iyz="0"/></inertial>'
        )
        parts.append(
            f'<link name="{child}">{heavy if child == "ball" else ""}</link>'
            f'<joint name="j{i}" type="prismatic"><parent link="{parent}"/><child link="{child}"/><axis xyz="{axis}"/>'
            f'<limit lower="{lower}" upper="{upper}" velocity="1e4" effort="1e6"/></joint>'
        )
        parent = child
    (path / "ball.urdf").write_text(f'<robot name="ball">{"".join(parts)}</robot>')
    return str(path / "ball.urdf")


def run_with(path, model, contacts, q, v, duration, robot=()):
    """Return the run of a ball against planes through points, with normals, μ and e."""
    text = ["[robot]", f'model = "{model}"', 'tip = "ball"', *robot, "[time]", f"duration = {duration}", "step = 0.001"]
    text += ['integrator = "rk4"', "[start]", f"q = {q}", f"v = {v}"]
    for normal, through, mu, e in contacts:
        text += ["[[contact]]", 'link = "ball"', f"normal = {normal}", f"through = {through}"]
        text += [f"friction = {mu}", f"restitution = {e}"]
    (path / "scenario.toml").write_text("\n".join(text) + "\n")
    return cl.simulate(cl.load_scenario(str(path / "scenario.toml")), progress=False)


@pytest.mark.parametrize("e", [0.3, 0.9])
def test_a_ball_between_two_walls_strikes_as_the_geometric_sequence_says(tmp_path, e):
    """Strike n comes at Σ L/(v eᵏ) and leaves v eⁿ⁺¹, with energy to match."""
    walls = [([1, 0, 0], [0, 0, 0], 0.0, e), ([-1, 0, 0], [WIDTH, 0, 0], 0.0, e)]
    speed, duration = 2.0, 1.0
    run = run_with(tmp_path, slider(tmp_path, ["1 0 0"]), walls, [0.0], [speed], duration)
    times, speeds, t, v = [], [], WIDTH / speed, speed
    while t < duration:
        times.append(t)
        speeds.append(v)
        v *= e
        t += WIDTH / v
    strikes = [event for event in run.events if event.time > 0.0]
    # A contact closes at −1e-13 m, which takes the longer the slower the ball is.
    late = 4e-13 * np.cumsum(1.0 / np.array(speeds))
    assert np.all(np.abs(np.array([event.time for event in strikes]) - times) < late)
    np.testing.assert_allclose([-event.rate_before for event in strikes], speeds, rtol=1e-12)
    np.testing.assert_allclose([event.rate_after for event in strikes], e * np.array(speeds), rtol=1e-12)
    assert [event.contact for event in strikes] == [2 - (k % 2) for k in range(len(strikes))]
    assert np.min(run.link_gaps) > -1e-12
    lost = 0.5 * (1.0 - e * e) * np.array(speeds) ** 2
    np.testing.assert_allclose([event.energy_lost for event in strikes], lost, rtol=1e-12)


def test_a_ball_rests_at_a_wall_once_it_rebounds_slower_than_the_rest_speed(tmp_path):
    """Between walls a micrometre apart: strikes lose speed until the rebound is below the rest speed; then none."""
    e, apart, speed = 0.5, 1e-6, 0.5
    walls = [([1, 0, 0], [0, 0, 0], 0.0, e), ([-1, 0, 0], [apart, 0, 0], 0.0, e)]
    run = run_with(tmp_path, slider(tmp_path, ["1 0 0"]), walls, [0.5 * apart], [speed], 0.5)
    least = run.scenario.impact.rest_speed
    expected = int(np.floor(np.log(least / speed) / np.log(e))) + 1
    assert abs(len(run.events) - expected) <= 1
    assert np.max(np.abs(run.v[-1])) < 1e-9
    assert np.sum(run.event_energy_lost) == pytest.approx(0.5 * speed**2, rel=1e-12)
    assert np.min(run.link_gaps) > -1e-12


@pytest.mark.parametrize("mu", [0.0, 0.3])
@pytest.mark.parametrize("e", [0.0, 0.6])
def test_a_ball_rattles_to_rest_in_a_groove(tmp_path, mu, e):
    """It falls between two planes at 30° and 60° and ends where they meet, with all of its energy lost and no more."""
    normals = [[float(np.sin(a)), 0.0, float(np.cos(a))] for a in (np.pi / 6, -np.pi / 3)]
    planes = [(n, [0.0, 0.0, 0.0], mu, e) for n in normals]
    run = run_with(tmp_path, slider(tmp_path, ["1 0 0", "0 0 1"]), planes, [0.01, 0.08], [0.3, 0.0], 4.0)
    assert len(run.events) < 2000
    assert np.min(run.link_gaps) > -1e-9
    assert np.max(np.diff(run.kinetic_energy + run.potential_energy)) < 1e-11  # 1.5e-12 J, of rk4 where a slide ends
    assert np.all(run.event_energy_lost >= -1e-15)
    assert np.max(np.abs(run.v[-1])) < 1e-9
    if mu == 0.0:
        np.testing.assert_allclose(run.q[-1], 0.0, atol=1e-9)
        forces = np.array(normals).T[[0, 2]] @ run.link_forces[-1]
        np.testing.assert_allclose(forces, [0.0, G], atol=1e-6)


def test_a_ball_between_a_wall_and_a_stop_strikes_both_in_turn(tmp_path):
    """The stop of the joint is one of the two walls; the speeds fall by the restitution of each."""
    model = slider(tmp_path, ["1 0 0"], -1000.0, WIDTH)
    wall, stop, speed = 0.8, 0.5, 2.0
    robot = ["stops = true", f"stop_restitution = {stop}"]
    run = run_with(tmp_path, model, [([1, 0, 0], [0, 0, 0], 0.0, wall)], [0.05], [speed], 1.0, robot)
    assert [event.kind for event in run.events] == (["stop", "impact"] * len(run.events))[: len(run.events)]
    assert len(run.events) >= 4
    left = speed
    for k, event in enumerate(run.events):
        left *= stop if k % 2 == 0 else wall
        row = int(np.searchsorted(run.time, event.time)) + 1
        assert abs(run.v[row, 0]) == pytest.approx(left, rel=1e-9)
