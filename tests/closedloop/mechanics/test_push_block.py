"""A block pushed over a rough floor: its slow motion is that of the limit surface, and its stop holds."""

import numpy as np
import pytest
from scipy.optimize import fsolve

import closedloop as cl

G, M, MU, HEIGHT = 9.81, 1.0, 0.4, 0.03
FEET = np.array([[-0.05, -0.06], [-0.05, 0.06], [0.05, -0.06], [0.05, 0.06]])
RADIUS = 0.015


def pushed(**changes: object) -> cl.Run:
    """Return a run of the scenario, with keys whose dots are two underscores."""
    overrides = {key.replace("__", "."): value for key, value in changes.items()}
    return cl.simulate(cl.load_scenario("push_block", overrides), progress=False)


def columns(run: cl.Run, names: str) -> np.ndarray:
    """Return coordinates of the block, (N, ...)."""
    return run.q[:, [run.model.coordinate_names.index(f"block_{name}") for name in names.split()]]


def twist_of_pushing(feet: np.ndarray, at: np.ndarray, height: float, velocity: np.ndarray) -> np.ndarray:
    """Return the velocity (3,) of a block, m/s and rad/s, that is pushed slowly at a point which does not slip.

    Unknown are its velocity and the push. The floor carries each foot by the least-norm normal forces of three
    equations, and rubs on it with μ N against its velocity; all forces are in balance.
    """

    def left(x: np.ndarray) -> np.ndarray:
        (vx, vy, w), push = x[:3], x[3:]
        v = np.array([vx, vy]) + w * np.column_stack([-feet[:, 1], feet[:, 0]])
        # N, with the moments of push and of friction, which act at `height` above and HEIGHT below the middle: m = Σ
        # r × F is zero; the friction of all feet is −push.
        A = np.vstack([np.ones(4), feet.T])
        moment = np.concatenate([[M * G], -(height + HEIGHT) * -push])
        N = np.linalg.lstsq(A, moment, rcond=None)[0]
        friction = -MU * N[:, None] * v / np.linalg.norm(v, axis=1)[:, None]
        torque = np.sum(feet[:, 0] * friction[:, 1] - feet[:, 1] * friction[:, 0]) + at[0] * push[1] - at[1] * push[0]
        slip = np.array([vx, vy]) + w * np.array([-at[1], at[0]]) - velocity
        return np.concatenate([friction.sum(axis=0) + push, [torque * 10.0], slip * 100.0])

    found, _, status, words = fsolve(left, np.array([*velocity, 0.1, 0.0, MU * M * G]), full_output=True)
    assert status == 1, words
    return found[:3]


@pytest.mark.slow
def test_a_push_off_the_middle_turns_the_block_as_the_limit_surface_says() -> None:
    """Where the tip does not slip on the block, the block's slow motion follows from friction alone."""
    run = pushed(contact__pusher__friction=2.0, reference__speed=0.02, time__duration=1.5, reference__stop=3.0)
    x, q = columns(run, "x y z"), columns(run, "qw qz")
    names = run.model.joint_names
    v = run.v[:, [names.index(f"block_{name}") for name in ("x", "y", "wz")]]
    for row in (1100, 1300, 1500):
        assert run.link_modes[row, 4] == 2
        turn = 2.0 * np.arctan2(q[row, 1], q[row, 0])
        R = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        tip = run.position[row] - x[row]
        touch = tip[:2] + RADIUS * R @ [0.0, 1.0]
        velocity = v[row, :2] + v[row, 2] * np.array([-touch[1], touch[0]])
        wanted = twist_of_pushing(FEET @ R.T, touch, tip[2], velocity)
        np.testing.assert_allclose(v[row], wanted, atol=0.02 * np.linalg.norm(v[row]))


@pytest.mark.slow
def test_a_push_through_the_middle_takes_the_friction_of_the_floor() -> None:
    """Without friction at the pusher the block goes straight, and the push is μ m g."""
    run = pushed(body__block__position=[0.0, 0.58, 0.03], contact__pusher__friction=0.0, time__duration=1.4)
    assert np.max(np.abs(columns(run, "qx qy qz"))) < 1e-6
    row = int(np.argmin(np.abs(run.time - 1.2)))
    carried = M * (run.v[row + 5] - run.v[row - 5])[run.model.joint_names.index("block_y")] / (10 * 1e-3)
    assert run.link_forces[row, 4] == pytest.approx(MU * M * G + carried, abs=2e-3)


def test_the_block_comes_to_rest_and_all_is_well() -> None:
    """The shipped run is good, with little work: nothing goes on slipping, and no contact is below its floor."""
    run = pushed()
    facts = run.summary()
    assert facts["verdict"] == {"good": True, "problems": []}
    assert len(run.event_time) < 60
    assert np.all(run.link_modes[-1] == 2)
    assert np.min(run.link_gaps) > -1e-8  # what rk4 leaves at 1 ms; at half the step it is 1e-13
    assert np.max(np.abs(run.v[-1, 4:])) < 1e-7
    slides = (run.time > 1.0) & (run.time < 2.09)  # slower and slower
    assert np.max(np.abs(np.diff(run.link_forces[slides], axis=0))) < 2e-3  # N from row to row
