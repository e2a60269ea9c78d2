# ruff: noqa: D102, D103 - the name of a law says what is wrong with it
"""What a newcomer's own law does wrong is told in one line: whose file, which line, and what would be right."""

import numba
import numpy as np
import pytest

import closedloop as cl
from closedloop.control.reference.path import PATHS, Path
from closedloop.jit.user_code import why_member_not_compiled, why_not_compiled
from closedloop.simulation.engines.law_source import arguments_of

SHORT = {"time.duration": 0.01}


@numba.njit
def unknown_function(x):
    return x.C - np.einsum("i,i", x.q, x.q)


@numba.njit
def misspelt(x):
    return x.C - x.q_dess


@numba.njit
def wrong_arguments(x):
    return x.C - np.cross(x.q, 3, banana=2)


class Remembers:
    """A callable object."""

    def __call__(self, x):
        return x.C


COMPILED = {
    unknown_function: ["test_own_mistakes.py:18: ", "numpy.einsum", "loop"],
    misspelt: ["test_own_mistakes.py:23: ", "x has no 'q_dess'; did you mean 'q_des'?"],
    wrong_arguments: ["test_own_mistakes.py:28: ", "'cross'", "array, 3, banana=2"],
    Remembers(): ["Remembers is a Python object", "closedloop.ControlLaw", "`states`", "torque(x, par, z, torque)"],
}


@pytest.mark.parametrize("law", COMPILED)
def test_a_law_that_numba_cannot_compile(law):
    """The line has the user's file and line, no text of numba's about its own parts, and what would be right."""
    with pytest.raises(cl.ScenarioError) as caught:
        cl.simulate(cl.load_scenario("wam_slide", SHORT), law=law, engine="compiled")
    line = str(caught.value)
    assert all(word in line for word in COMPILED[law]), line
    assert not any(word in line for word in ("\n", ">>>", "Function(", "nopython", "float64", "numba/"))


def law_with(**body):
    """Return a law of control with these functions."""
    return type("Mine", (cl.ControlLaw,), body)


def test_an_array_of_its_own_in_a_class():
    """What numba says of its own allocation of arrays is told as what the user did."""

    @staticmethod
    def torque(x, par, z, torque):
        torque[:] = x.C - x.A[0] * x.f_des

    with pytest.raises(Exception, match=r"allocate|NRT required") as caught:  # by what it has compiled
        numba.njit(_nrt=False)(lambda a: (a + a)[0])(np.ones(2))
    line = why_member_not_compiled(caught.value, law_with(torque=torque), {})
    assert "test_own_mistakes.py:" in line
    assert "in a loop" in line
    assert why_not_compiled(ValueError("odd")) == "ValueError: odd"


def no_arguments():
    return 0.0


def three(a, b, c):
    return c


def by_name(x, *, gain):
    return x.C


@pytest.mark.parametrize("law", [no_arguments, three, by_name, numba.njit(three)])
def test_a_law_with_other_arguments(law):
    """Nothing is simulated, and the line says what a law takes."""
    with pytest.raises(cl.ScenarioError, match=r"test_own_mistakes.py:\d+: .*law\(x\) or law\(t, q, v, terms\)"):
        cl.simulate(cl.load_scenario("wam_slide", SHORT), law=law)


def test_laws_with_the_right_arguments():
    """Arguments with a default, bound methods, classes and any number of arguments are what they were."""
    for law in (lambda x, gain=1.0: x, lambda t, q, v, terms=None: t, lambda *all: 0.0, Remembers, Remembers()):
        arguments_of(law)
    assert arguments_of(Remembers).sees_input


def _torque(x, par, z, torque):
    torque[0] = 0.0


def _short(x, par, torque):
    torque[0] = 0.0


LAWS = {
    "an argument less": (
        {"torque": staticmethod(_short)},
        "torque(x, par, torque): must be @staticmethod def torque(x",
    ),
    "of the instance": ({"torque": _torque}, "torque: must be @staticmethod def torque(x, par, z, torque)"),
    "no torque": ({}, "must define @staticmethod def torque(x, par, z, torque)"),
    "no rates": ({"torque": staticmethod(_torque), "states": ("error",)}, "must define @staticmethod def rates(x, par"),
    "no comma": ({"torque": staticmethod(_torque), "states": "error"}, "states = 'error': must be a tuple of names"),
}


@pytest.mark.parametrize("case", LAWS)
def test_a_class_whose_functions_are_none(case):
    """The line names the class and the signature that is right."""
    body, words = LAWS[case]
    with pytest.raises(cl.ScenarioError) as caught:
        cl.prepare(cl.load_scenario("wam_slide", SHORT | {"law.kind": law_with(**body)}))
    assert words in str(caught.value)
    assert str(caught.value).startswith("law.kind = ")


def test_a_path_with_other_arguments():
    """The same of a path, whose function is a method."""

    class Lacking(Path):
        def tip_path(self, origin):
            return origin

    with pytest.raises(cl.ScenarioError, match=r"tip_path\(self, origin\): must be def tip_path\(self, origin, norm"):
        PATHS.named(Lacking, "reference.kind")
