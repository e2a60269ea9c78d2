"""The tree's kernels as kernels: what they write, what they keep, compiled or not, cached or not."""

import contextlib
import io
import os
import subprocess
import sys

import numpy as np
import pytest
from tree_cases import FIELDS, Own, random_model

from closedloop.mechanics.robot.tree import energies_of_rows, potential_energies, tree_terms
from closedloop.mechanics.robot.tree.energy import ROWS_AT_ONCE


@pytest.mark.slow
def test_below_the_diagonal_nothing_is_written(robot):
    """The caller may keep what it likes in the lower triangle of H."""
    arm = robot("wam4")
    own, H = Own(arm.model, arm.tip), np.full((4, 4), 7.0)
    tree_terms(own.tree, np.ones(4), np.ones(4), own.work, H, np.zeros(4), (np.zeros((3, 4)), np.zeros(3), np.zeros(3)))
    assert np.all(H[np.tril_indices(4, -1)] == 7.0)
    assert np.all(H[np.triu_indices(4)] != 7.0)


def test_nothing_is_remembered():
    """Terms are those of the state alone: the same to the last bit after another state, and in other scratch."""
    model, tip, rng = random_model(3, joints=7)
    own, other = Own(model, tip), Own(model, tip)
    q, v = rng.uniform(-3.0, 3.0, 7), rng.normal(size=7)
    first = own.terms(q, v)
    own.terms(rng.uniform(-3.0, 3.0, 7), rng.normal(size=7))
    for again in (own.terms(q, v), other.terms(q, v)):
        assert all(np.array_equal(getattr(first, field), getattr(again, field)) for field in FIELDS)


def test_kinematics_alone_are_those_of_the_terms():
    """`tree_kinematics` writes what `tree_terms` writes."""
    for seed in range(3):
        model, tip, rng = random_model(seed)
        own = Own(model, tip)
        q, v = rng.uniform(-3.0, 3.0, model.n), rng.normal(size=model.n)
        terms, (J, r, drift) = own.terms(q, v), own.kinematics(q, v)
        assert np.array_equal(J, terms.jacobian)
        assert np.array_equal(r, terms.position)
        assert np.array_equal(drift, terms.drift)


def test_energies_of_many_rows_are_the_same_interpreted_and_compiled():
    """A process changes from one to the other after its first runs; its columns must not say which it was."""
    for seed in range(3):
        model, tip, rng = random_model(seed)
        own, q = Own(model, tip), rng.uniform(-3.0, 3.0, (ROWS_AT_ONCE + 3, model.n))
        compiled = np.empty(q.shape[0])
        potential_energies(own.tree, q, own.work, compiled)
        assert np.array_equal(energies_of_rows(own.tree, q), compiled)
        assert np.ptp(compiled) > 0.0


SAMPLE = """
import numpy as np, robot_models
from closedloop.mechanics.robot.tree import tree_of, tree_potential_energy, tree_terms, work_size
from validation.states import random_robot
drawn = random_robot(3)
model = robot_models.from_text(drawn.text, "urdf", name="x", armature=drawn.armature, tip="tip", home=drawn.home,
                               locked={}, gravity=drawn.gravity)
tree = tree_of(model, "tip")
n = tree.n
q, v = np.linspace(-2, 2, n), np.linspace(1, -1, n)
H, C, J, r, drift = np.zeros((n, n)), np.zeros(n), np.zeros((3, n)), np.zeros(3), np.zeros(3)
work = np.zeros(work_size(n))
tree_terms(tree, q, v, work, H, C, (J, r, drift))
for x in (*H.ravel(), *C, *J.ravel(), *r, *drift, tree_potential_energy(tree, q, work)):
    print(float(x).hex())
"""


@pytest.mark.slow
def test_uncompiled_numbers_are_the_same():
    """With NUMBA_DISABLE_JIT=1 the same lines in plain Python give the same numbers to rounding."""
    with contextlib.redirect_stdout(io.StringIO()) as said:
        exec(SAMPLE, {})
    texts = said.getvalue(), run_python(SAMPLE, NUMBA_DISABLE_JIT="1")
    ours, plain = (np.array([float.fromhex(x) for x in text.split()]) for text in texts)
    assert len(ours) > 20
    assert np.max(np.abs(ours - plain)) <= 1e-15 * np.max(np.abs(ours))


CACHED = """
import numpy as np, robot_models, sys
sys.path.insert(0, {folder!r})
import kernel_of_test
from closedloop.mechanics.robot.tree import tree_of, work_size
tree = tree_of(robot_models.load("wam4"), "tip")
drift = kernel_of_test.run(tree, np.ones(4), np.ones(4), np.zeros(work_size(4)), np.zeros((4, 4)), np.zeros(4),
                           np.zeros((3, 4)), np.zeros(3), np.zeros(3))
print(sum(kernel_of_test.run.stats.cache_hits.values()), drift)
"""


ENTRY = """
from closedloop.jit.kernel import entry_kernel
from closedloop.mechanics.robot.tree import tree_terms

@entry_kernel
def run(tree, q, v, work, H, C, J, r, drift):
    tree_terms(tree, q, v, work, H, C, (J, r, drift))
    return drift[0]
"""


@pytest.mark.slow
def test_tree_as_an_argument_of_a_cached_entry_kernel(tmp_path):
    """A compiled function that is handed a `Tree` comes out of the cache in the next process."""
    (tmp_path / "kernel_of_test.py").write_text(ENTRY)
    script = CACHED.format(folder=str(tmp_path))
    first, second = (run_python(script, NUMBA_CACHE_DIR=str(tmp_path / "cache")).split() for _ in range(2))
    assert (first[0], second[0]) == ("0", "1")
    assert first[1] == second[1]


def run_python(script, **environment):
    """Return the standard output of a script in a process of its own."""
    done = subprocess.run(
        [sys.executable, "-c", script], env={**os.environ, **environment}, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout
