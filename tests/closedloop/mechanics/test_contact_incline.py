"""A box on four feet, as a free body, on an incline near the angle of friction: its slide is in closed form."""

import numpy as np
import pytest

import closedloop as cl
from closedloop.scenario.load import parse_scenario

G, MU, HALF = 9.81, 0.4, (0.1, 0.075, 0.05)


def let_go(angle: float, integrator: str, velocity=(0.0, 0.0, 0.0), spin=(0.0, 0.0, 0.0), **changes: object) -> cl.Run:
    """Return the run of the box, let go with a velocity and a spin along x (up the incline), y, and its normal."""
    c, s = np.cos(angle), np.sin(angle)
    axes = np.array([[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]])
    turn, normal = [float(np.cos(angle / 2)), 0.0, float(-np.sin(angle / 2)), 0.0], axes[:, 2]
    feet = [[x * HALF[0], y * HALF[1], -HALF[2]] for x in (1, -1) for y in (1, -1)]
    text = ["[robot]", 'model = "planar2"', "[[body]]", 'name = "box"', 'shape = "box"', "edges = [0.2, 0.15, 0.1]"]
    text += ["mass = 1.0", f"position = {(HALF[2] * normal).tolist()}", f"quaternion = {turn}"]
    text += [
        f"velocity = {(axes @ velocity).tolist()}",
        f"spin = {(axes @ spin).tolist()}",
        "[[contact]]",
        'link = "box"',
    ]
    text += [f"at = {feet}", f"friction = {MU}", f"normal = {normal.tolist()}", "[stabiliser]", "time_constant = 0.01"]
    text += ["[time]", "duration = 0.25", "step = 0.001", f'integrator = "{integrator}"']
    return cl.simulate(parse_scenario("\n".join(text), overrides=changes), progress=False)


def along(run: cl.Run, angle: float) -> np.ndarray:
    """Return how far up the incline the box is at the rows, m."""
    return (run.q[:, 2:5] - run.q[0, 2:5]) @ [np.cos(angle), 0.0, np.sin(angle)]


@pytest.mark.parametrize("integrator", ["rk4", "semi_implicit_euler"])
@pytest.mark.parametrize("share", [0.99, 1.001, 1.01, 1.1, 2.0])
def test_a_box_slides_from_rest_as_gravity_less_friction_says(share: float, integrator: str) -> None:
    """g (sin θ − μ cos θ): at rest below the angle of friction; above it the slide begins at once, without a kick."""
    angle = np.arctan(MU * share)
    run = let_go(angle, integrator)
    down = max(0.0, G * (np.sin(angle) - MU * np.cos(angle)))
    t = run.time * (run.time + (run.time[1] if integrator == "semi_implicit_euler" else 0.0))  # as this scheme sums v h
    np.testing.assert_allclose(along(run, angle), -0.5 * down * t, atol=1e-10 * (1.0 + down))
    assert np.max(np.abs(run.v[:, 5:])) < 1e-10  # straight down


@pytest.mark.parametrize("integrator", ["rk4", "semi_implicit_euler"])
def test_a_box_that_slides_up_and_turns_comes_to_rest_at_once(integrator: str) -> None:
    """Below the angle of friction slip and spin end together, at the same place with half the step."""
    angle = np.arctan(0.5 * MU)
    start = {"velocity": (0.3, 0.1, 0.0), "spin": (0.0, 0.0, 2.0)}
    runs = [let_go(angle, integrator, **start, **{"time.step": h}) for h in (1e-3, 5e-4)]
    for run in runs:
        assert np.all(run.link_modes[-1] == 2)
        assert np.max(np.abs(run.v[-1, 2:])) < 1e-10
    ends = [run.q[-1, 2:5] for run in runs]
    assert np.max(np.abs(ends[1] - ends[0])) < (1e-6 if integrator == "rk4" else 1e-3)


@pytest.mark.parametrize("step", [1e-3, 5e-4, 2.5e-4])
def test_a_box_that_slides_up_the_angle_of_friction_itself_stays_where_it_stops(step: float) -> None:
    """Nothing is left to move it, and nothing to spare to hold it: it sticks, and does not creep down."""
    angle = np.arctan(MU)
    run = let_go(angle, "rk4", (0.3, 0.0, 0.0), **{"time.step": step})
    assert np.all(run.link_modes[-1] == 2)
    assert np.max(np.abs(run.v[-1, 2:])) < 1e-11
    assert along(run, angle)[-1] == pytest.approx(0.3**2 / (4.0 * G * np.sin(angle)), rel=1e-5)
