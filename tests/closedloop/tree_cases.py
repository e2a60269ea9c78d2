"""What the tests of the tree share: our terms under the names of Pinocchio's, and random trees."""

from dataclasses import dataclass

import numpy as np

import closedloop as cl
import robot_models
from closedloop.mechanics.robot.tree import tree_kinematics, tree_of, tree_terms, work_size
from validation.states import random_robot

# Two summations of the same few dozen products in another order: some hundred roundings of 1e-16 of the largest.
ROUNDING = 1e-13

FIELDS = ("mass_matrix", "bias", "position", "jacobian", "drift")


@dataclass(frozen=True)
class Terms:
    """What `tree_terms` writes, H with both triangles, under the names of `closedloop.Terms`."""

    mass_matrix: np.ndarray
    bias: np.ndarray
    position: np.ndarray
    jacobian: np.ndarray
    drift: np.ndarray


class Own:
    """A tree with its scratch, whose results begin as rubbish."""

    def __init__(self, model, tip):
        self.tree = tree_of(model, tip)
        self.work = np.zeros(work_size(self.tree.n))

    def terms(self, q, v):
        """Return the terms at (q, v)."""
        n = self.tree.n
        H, C, J, r, drift = (np.full(shape, 1e300) for shape in ((n, n), (n,), (3, n), (3,), (3,)))
        tree_terms(self.tree, q, v, self.work, H, C, (J, r, drift))
        return Terms(np.triu(H) + np.triu(H, 1).T, C, r, J, drift)

    def kinematics(self, q, v):
        """Return J, r and drift from the smaller kernel."""
        J, r, drift = np.full((3, self.tree.n), 1e300), np.full(3, 1e300), np.full(3, 1e300)
        tree_kinematics(self.tree, q, v, self.work, J, r, drift)
        return J, r, drift


def close(ours, theirs, tolerance=ROUNDING, least=1.0):
    """Whether no entry differs by more than `tolerance` of the largest, or of `least`."""
    theirs = np.asarray(theirs)
    return np.max(np.abs(ours - theirs)) <= tolerance * max(least, np.max(np.abs(theirs)))


def assert_equal_terms(ours, theirs):
    """Every term agrees to rounding; drift to that of the gravity that is taken out of it, 10 m/s²."""
    for field in FIELDS:
        least = 10.0 if field == "drift" else 1e-3
        assert close(getattr(ours, field), getattr(theirs, field), least=least), field


def random_model(seed, **options):
    """Return the model of a random tree, its tip on any of its frames, and a generator."""
    drawn, rng = random_robot(seed, **options), np.random.default_rng(seed)
    model = robot_models.from_text(
        drawn.text, "urdf", name=drawn.name, armature=drawn.armature, tip=drawn.tip, home=drawn.home, locked={},
        gravity=drawn.gravity,
    )  # fmt: skip
    return model, str(rng.choice(model.frames)), rng


def random_case(seed, **options):
    """Return our tree of a random robot, Pinocchio's, and a generator."""
    model, tip, rng = random_model(seed, **options)
    return Own(model, tip), cl.Robot(model, tip), rng
