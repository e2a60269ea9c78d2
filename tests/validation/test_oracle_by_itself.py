"""The oracle without a second engine: Lagrange, forty digits, its independence and its equations."""

import ast
import re
from pathlib import Path

import mpmath
import numpy as np
import pytest
import sympy

import validation.oracle
from validation.oracle import Joint, Link, Oracle, build_tree
from validation.states import random_robot, random_state

SOURCES = sorted(Path(validation.oracle.__file__).parent.glob("*.py"))


def planar_arm(l1, l2, c1, c2, m1, m2, i1, i2, gravity):
    """Return a planar 2R arm in the x–z plane, joints about −y so that angles count from x towards z."""
    down = np.array([0.0, -1.0, 0.0])
    links = [
        Link("base"),
        Link("upper", m1, np.array([c1, 0.0, 0.0]), np.diag([0.0, i1, 0.0])),
        Link("fore", m2, np.array([c2, 0.0, 0.0]), np.diag([0.0, i2, 0.0])),
        Link("tip"),
    ]
    joints = [
        Joint("shoulder", "revolute", "base", "upper", axis=down),
        Joint("elbow", "revolute", "upper", "fore", translation=np.array([l1, 0.0, 0.0]), axis=down),
        Joint("mount", "fixed", "fore", "tip", translation=np.array([l2, 0.0, 0.0])),
    ]
    tree = build_tree(links, joints, joint_names=["shoulder", "elbow"], gravity=[0.0, 0.0, -gravity])
    return Oracle(tree, "tip")


def test_planar_arm_is_lagranges():
    """H, C, r, Jᵣ and J̇ᵣq̇ of a planar 2R arm are those that sympy derives from T − U."""
    q1, q2, v1, v2 = symbols = sympy.symbols("q1 q2 v1 v2")
    values = {"l1": 0.7, "l2": 0.5, "c1": 0.3, "c2": 0.2, "m1": 2.0, "m2": 1.5, "i1": 0.1, "i2": 0.05}
    l1, l2, c1, c2, m1, m2, i1, i2 = (sympy.Rational(str(value)) for value in values.values())
    g = sympy.Rational("9.81")
    q, v = sympy.Matrix([q1, q2]), sympy.Matrix([v1, v2])

    def point(a, b):
        return sympy.Matrix([a * sympy.cos(q1) + b * sympy.cos(q1 + q2), a * sympy.sin(q1) + b * sympy.sin(q1 + q2)])

    first, second, tip = point(c1, 0), point(l1, c2), point(l1, l2)
    speeds = [place.jacobian(q) * v for place in (first, second)]
    T = (m1 * speeds[0].dot(speeds[0]) + m2 * speeds[1].dot(speeds[1]) + i1 * v1**2 + i2 * (v1 + v2) ** 2) / 2
    U = g * (m1 * first[1] + m2 * second[1])
    momentum = sympy.Matrix([T]).jacobian(v).T
    H = momentum.jacobian(v)
    C = momentum.jacobian(q) * v - sympy.Matrix([T - U]).jacobian(q).T
    J = tip.jacobian(q)
    drift = (J * v).jacobian(q) * v
    exact = sympy.lambdify(symbols, [H, C, tip, J, drift])

    arm = planar_arm(*values.values(), gravity=9.81)
    rng = np.random.default_rng(0)
    for _ in range(20):
        state = rng.normal(size=4)
        terms = arm.terms(state[:2], state[2:])
        H, C, r, J, drift = exact(*state)
        np.testing.assert_allclose(terms.mass_matrix, H, rtol=1e-13)
        np.testing.assert_allclose(terms.bias, C[:, 0], atol=1e-13)
        np.testing.assert_allclose(terms.position[[0, 2]], r[:, 0], atol=1e-15)
        np.testing.assert_allclose(terms.jacobian[[0, 2]], J, atol=1e-15)
        np.testing.assert_allclose(terms.drift[[0, 2]], drift[:, 0], atol=1e-14)


@pytest.mark.parametrize("seed", range(4))
def test_own_rounding_in_forty_digits(seed):
    """In double precision the oracle is within 2e-14 of itself in forty digits: its rounding is no more.

    The constants of the tree are the same doubles in both, so that only the arithmetic is compared.
    """
    robot = random_robot(seed, joints=6)
    oracle = Oracle(robot.tree, robot.tip)
    q, v = random_state(robot, np.random.default_rng(seed))
    with mpmath.workdps(40):
        exact_q, exact_v = (np.array([mpmath.mpf(x) for x in vector], dtype=object) for vector in (q, v))
        exact = oracle.terms(exact_q, exact_v)
        energy = oracle.kinetic_energy(exact_q, exact_v)
        terms = oracle.terms(q, v)
        for name in ("mass_matrix", "bias", "position", "jacobian", "drift"):
            reference = getattr(exact, name)
            error = np.abs(getattr(terms, name) - reference).max() / max(np.abs(reference).max(), 1e-3)
            assert isinstance(reference.flat[0], mpmath.mpf)
            assert error < 2e-14, name
        assert abs(oracle.kinetic_energy(q, v) - energy) < 2e-14 * energy


def test_terms_are_the_single_quantities():
    """`terms`, which places the bodies once, returns what the methods return one by one."""
    robot = random_robot(8)
    oracle = Oracle.from_model(robot)
    q, v = random_state(robot, np.random.default_rng(8))
    terms = oracle.terms(q, v)
    np.testing.assert_array_equal(terms.mass_matrix, oracle.mass_matrix(q))
    np.testing.assert_array_equal(terms.bias, oracle.bias(q, v))
    np.testing.assert_array_equal(terms.position, oracle.position(q))
    np.testing.assert_array_equal(terms.jacobian, oracle.jacobian(q))
    np.testing.assert_array_equal(terms.drift, oracle.drift(q, v))


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: path.name)
def test_independent_of_what_it_judges(path):
    """No file of the oracle imports an engine, the simulator or its robots."""
    imported = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            imported |= {name.name for name in node.names}
        elif isinstance(node, ast.ImportFrom):
            imported.add(node.module)
    outside = {name.split(".")[0] for name in imported if not name.startswith("validation.oracle")}
    assert outside <= {
        "__future__",
        "collections",
        "dataclasses",
        "io",
        "mpmath",
        "numpy",
        "scipy",  # its splines, for a surface given by heights
        "typing",
        "xml",
        "yourdfpy",
    }


def test_every_equation_has_a_function():
    """Each of the paper's equations is named in the docstring of a function that computes it."""
    texts = [
        ast.get_docstring(node) or ""
        for path in SOURCES
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.FunctionDef)
    ]
    for number in range(1, 34):
        assert any(re.search(rf"Eq\. {number}\b", text) for text in texts), number
