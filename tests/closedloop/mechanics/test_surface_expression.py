"""A surface given by a formula: exact derivatives, the same runs as a surface written by hand, and what is refused."""

import gc
import math
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import closedloop as cl
from closedloop.mechanics.surface.expression import FUNCTIONS, evaluate, instructions

FORMULAS = (
    "x**2 + y**2 + (z/2)**2 - 1",
    "z - 0.1*sin(5*x)*cos(3*y) + exp(-x**2)*tanh(y)/7",
    "sqrt(x**2 + y**2 + 3) - (z + 2)**1.5 + log(2 + z)*atan(x - y)",
    "-(sinh(x) - cosh(y*z))/(4 + tan(z)) + 2**x - (3 + x)**y + (1 + x*y*z)**(-2) + z**5 - +pi*y**3",
    "(x - y)*(x - y)*(x - y) - 2/(3 + x) + z**0 + (y - 1)**(-3)",
    "x",
)
P = np.array([0.31, -0.47, 0.73])


def second_order(text, p):
    """Return φ, ∇φ and ∇∇φ of a formula at p."""
    gradient, hessian = np.zeros(3), np.zeros((3, 3))
    level = evaluate(np.array(instructions(text)), *p, gradient, hessian)
    return level, gradient, hessian


def complex_step(function):
    """Return the gradient at P of a function of x, y and z that takes complex numbers."""
    steps = 1e-30j * np.eye(3)
    return np.array([complex(function(*(P + step))).imag / 1e-30 for step in steps])


@pytest.mark.parametrize("text", FORMULAS)
def test_derivatives_are_exact(text):
    """The gradient against the complex step of the formula, the Hessian against that of sympy's gradient."""
    level, gradient, hessian = second_order(text, P)
    import sympy

    xyz = sympy.symbols("x y z")
    formula = sympy.sympify(text)
    as_function = sympy.lambdify(xyz, formula, "numpy")
    assert level == pytest.approx(complex(as_function(*P)).real, abs=1e-13)
    assert np.allclose(gradient, complex_step(as_function), rtol=0, atol=1e-12)
    slopes = [sympy.lambdify(xyz, sympy.diff(formula, each), "numpy") for each in xyz]
    assert np.allclose(hessian, [complex_step(slope) for slope in slopes], rtol=0, atol=1e-12)
    assert np.array_equal(hessian, hessian.T)


def test_equal_parts_are_computed_once():
    """(x − y)³ with its factor written three times takes two products."""
    assert instructions("(x - y)*(x - y)*(x - y)")[0] == 2 + 1 + 2
    assert instructions("x + x*0.5 - x")[0] == 1 + 3


def test_threads_read_formulas_at_once():
    """A batch does: Python 3.11 fails where another thread parses while one does, as when garbage is collected."""
    text = " + ".join(f"sin({k}*x)*(z - {k})" for k in range(9))
    expected, before = instructions(text), gc.get_threshold()

    def pause(phase: str, info: object) -> None:
        time.sleep(0)  # lets another thread run

    gc.callbacks.append(pause)
    gc.set_threshold(20)
    try:
        with ThreadPoolExecutor(4) as pool:
            assert all(found == expected for found in pool.map(instructions, [text] * 40))
    finally:
        gc.set_threshold(*before)
        gc.callbacks.remove(pause)


def test_where_there_is_no_value_there_is_none():
    """Outside of a function's domain φ is no number, and nothing is raised."""
    for text, p in (
        ("sqrt(x)", -1.0),
        ("log(x)", 0.0),
        ("x**0.5", -1.0),
        ("x**1.5", 0.0),  # no second derivative
        ("exp(x)", 1e9),
        ("1/x", 0.0),
        ("sin(x)", 1e400),
    ):
        assert math.isnan(second_order(text, (p, 0.0, 0.0))[0]), text
    assert second_order("x**2", (0.0, 0.0, 0.0))[2][0, 0] == 2.0


@pytest.mark.parametrize("engine", ["pinocchio", "compiled"])
def test_an_ellipsoid_as_a_formula(engine, tmp_path):
    """The run is that on the ellipsoid that ships, and the file repeats it."""
    short = {"time.duration": 0.4, "reference.start": 0.05, "reference.stop": 0.3, "reference.speed": 0.1}
    formula = {"kind": "implicit", "expression": "(x/0.4)**2 + (y/0.3)**2 + (z/0.2)**2 - 1", "at": [0.0, 0.0, 0.19]}
    run = cl.simulate(cl.load_scenario("wam_slide", short | {"surface": formula}), engine=engine)
    shipped = {"kind": "ellipsoid", "a": 0.4, "b": 0.3, "c": 0.2}
    other = cl.simulate(cl.load_scenario("wam_slide", short | {"surface": shipped}), engine=engine)
    assert np.ptp(run.surface_normal[:, 1]) > 0.05
    assert np.allclose(run.q, other.q, rtol=0, atol=1e-12)
    assert np.allclose(run.contact_force, other.contact_force, rtol=0, atol=1e-7)
    saved = cl.load_run(run.save(tmp_path / "run.nc"))
    assert np.array_equal(cl.simulate(saved.scenario, model=saved.model, engine=engine).q, run.q)


REFUSED = {
    "no formula": ("x**", "is not a formula"),
    "code": ("__import__('os').remove('x')", "is not allowed in a formula"),
    "call": ("open('x') + z", "'open' is unknown"),
    "attribute": ("x.real + z", "'x.real' is not allowed in a formula"),
    "name": ("z + w", "'w' is unknown: a formula has x, y, z"),
    "caret": ("x^2 + z", "a power is written **"),
    "arguments": ("sqrt(x, y)", "'sqrt' takes one argument"),
    "no surface": ("3 + 4", "does not depend on x, y or z"),
    "no number": ("z + 1/0", "not a finite number"),
    "imaginary": ("z + sqrt(-1)", "not a finite number"),
    "nested": ("(" * 900 + "z" + ")" * 900, "is not a formula"),
    "deep": ("-" * 1900 + "z", "is not a formula"),
    "long": ("z" + " + x" * 900, "more than 2000 characters"),
    "no gradient": ("x**2 + y**2 + z**2 - 1", "gradient of surface.expression is zero"),
    "nowhere": ("x**2 + y**2 + z**2 + 1 + z", "no surface was found"),
    "inside out": ("-z", "must grow along the normal"),
    "no value": ("z + log(x)", "is zero or not finite at"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_does_not_go_is_refused_in_one_line(case):
    """The key is named, and what would be right."""
    text, words = REFUSED[case]
    with pytest.raises(cl.ScenarioError) as caught:
        cl.prepare(cl.load_scenario("wam_slide", {"surface": {"kind": "implicit", "expression": text}}))
    assert words in str(caught.value)
    assert "surface." in str(caught.value)
    assert len(caught.value.faults) == 1


def test_every_function_is_known_by_its_name():
    """Each of the functions that a formula may have is evaluated as Python's."""
    for name in FUNCTIONS:
        assert second_order(f"{name}(x)", (0.37, 0.0, 0.0))[0] == getattr(math, name)(0.37)
