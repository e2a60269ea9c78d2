# ruff: noqa: D103 - the name of a law says what is wrong with it
"""A law of one's own in the compiled engine: the run is Python's, and what cannot be compiled is refused."""

import numba
import numpy as np
import pytest

import closedloop as cl

UP = np.array([0.0, 0.0, 1.0])


def push(t, q, v, terms):
    """Compensate C, press with a force that swings, damp; every term that a law gets has a part in it."""
    force = 12.0 + 2.0 * np.sin(40.0 * t)
    inertia = terms.mass_matrix[0] * (0.5 - v)
    return terms.bias + inertia - force * terms.jacobian[2] - terms.position[1] * v + 0.1 * terms.drift[0] * q


returning = numba.njit(push)


@numba.njit
def writing(t, q, v, terms, torque):
    """Do the same, entry by entry, into the torque."""
    force = 12.0 + 2.0 * np.sin(40.0 * t)
    for i in range(q.size):
        torque[i] += terms.bias[i] - force * terms.jacobian[2, i] - terms.position[1] * v[i]
        torque[i] += 0.1 * terms.drift[0] * q[i]
        torque[i] += terms.mass_matrix[0, i] * (0.5 - v[i])


CASES = {
    "slide": ("wam_slide", {"time.duration": 0.1}),
    "rk4, held": ("wam_slide", {"time.duration": 0.1, "time.integrator": "rk4", "law.sample_period": 0.002}),
    "projection": ("wam_slide", {"time.duration": 0.1, "stabiliser.kind": "projection"}),
    "impact": ("wam_slide", {"time.duration": 0.1, "surface.contact": "unilateral", "surface.gap": 1e-4}),
}


@pytest.mark.slow
@pytest.mark.parametrize(("case", "law"), [*zip(CASES, (returning, writing, writing, returning), strict=True)])
def test_run_is_that_of_the_same_law_in_python(case, law):
    """The same function in Python and compiled, in either engine and either form: one run, to rounding, events too."""
    scenario = cl.load_scenario(*CASES[case])
    python = cl.simulate(scenario, law=push)
    assert np.ptp(python.contact_force) > 0.1
    for engine in ("pinocchio", "compiled"):
        run = cl.simulate(scenario, law=law, engine=engine)
        for column in ("q", "v", "torque", "contact_force"):
            ours, theirs = getattr(run, column), getattr(python, column)
            assert np.max(np.abs(ours - theirs)) < 1e-7 * max(1.0, np.max(np.abs(theirs))), (engine, column)
        assert [e.kind for e in run.events] == [e.kind for e in python.events]
    if case == "impact":
        assert len(python.events) > 0


@pytest.mark.slow
def test_friction_with_a_law_of_ones_own():
    """The full form of the loop takes a law, too."""
    scenario = cl.load_scenario(
        "wam_slide", {"time.duration": 0.1, "friction.kind": "coulomb", "friction.coefficient": 0.3}
    )
    python = cl.simulate(scenario, law=push)
    run = cl.simulate(scenario, law=writing, engine="compiled")
    assert np.max(np.abs(python.friction_force)) > 0.1
    assert np.max(np.abs(run.q - python.q)) < 1e-9


@numba.njit
def changes_the_state(t, q, v, terms):
    q[0] = 0.0
    return terms.bias * 1.0


@numba.njit
def number(t, q, v, terms):
    return 1.0


@numba.njit
def listed(t, q, v, terms):
    return [1.0, 2.0, 3.0, 4.0]


@numba.njit
def three_arguments(t, q, v):
    return v * 1.0


@numba.njit
def no_such_term(t, q, v, terms):
    return terms.gravity * 1.0


@numba.njit
def both(t, q, v, terms, torque):
    return torque


@numba.njit
def too_short(t, q, v, terms):
    return np.zeros(3)


@pytest.mark.parametrize(
    ("law", "words"),
    [
        (push, ["law push is not compiled", "@numba.njit", "'pinocchio'"]),
        (lambda t, q, v, terms: terms.bias, ["@numba.njit"]),
        (changes_the_state, ["changes_the_state", "there to be read"]),
        (number, ["number returns float64", "one torque a joint"]),
        (listed, ["listed returns", "one torque a joint"]),
        (three_arguments, ["takes 3 arguments", "(x)", "(t, q, v, terms)", "torque besides"]),
        (no_such_term, ["'gravity'", "test_compiled_law.py"]),
        (both, ["both returns", "must return nothing"]),
        (too_short, ["Q of shape (3,)", "(4,)"]),
    ],
    ids=lambda value: getattr(value, "__name__", None),
)
def test_law_that_cannot_be_compiled_is_refused_in_one_line(law, words):
    """The line names the law, what is wrong, and what would be right; nothing is simulated in another way instead."""
    with pytest.raises(cl.ScenarioError) as caught:
        cl.simulate(cl.load_scenario("wam_slide", {"time.duration": 0.01}), law=law, engine="compiled")
    line = str(caught.value)
    assert "\n" not in line
    assert all(word in line for word in words), line


@numba.njit
def breaks_down(t, q, v, terms):
    return terms.bias * (np.nan if t > 0.0045 else 1.0)


@numba.njit
def gives_up(t, q, v, terms):
    if t > 0.0045:
        raise ValueError("enough")
    return terms.bias * 1.0


@pytest.mark.parametrize("engine", [pytest.param("pinocchio", marks=pytest.mark.slow), "compiled"])
def test_torque_that_is_not_finite_stops_the_run(engine):
    """NaN from a compiled law stops the run at its instant, in the same words as from one in Python; rows are kept."""
    scenario = cl.load_scenario("wam_slide", {"time.duration": 0.01})
    with pytest.raises(cl.DivergenceError, match=r"stopped at t = 0\.005 s: the law returned Q = \[nan") as caught:
        cl.simulate(scenario, law=breaks_down, engine=engine)
    assert len(caught.value.run) == 5


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["pinocchio", "compiled"])
def test_exception_of_a_compiled_law_keeps_what_ran(engine):
    """What a compiled law raises arrives, as from a law in Python: with its line, and with the rows before it."""
    scenario = cl.load_scenario("wam_slide", {"time.duration": 0.01})
    with pytest.raises(cl.LawError, match=r"test_compiled_law.py:\d+: ValueError: enough") as caught:
        cl.simulate(scenario, law=gives_up, engine=engine)
    assert isinstance(caught.value.__cause__, ValueError)
    assert len(caught.value.run) == 5


LAWS = """
import numba

def plain(t, q, v, terms):
    return terms.bias

@numba.njit
def fast(t, q, v, terms):
    return terms.bias - 7.0 * terms.jacobian[2]
"""


@pytest.mark.slow
def test_command_line_takes_a_compiled_law(command_line, tmp_path):
    """--law MODULE:FUNCTION --engine compiled runs what is compiled, and refuses what is not with status 2."""
    (tmp_path / "laws_for_numba.py").write_text(LAWS)
    words = ["wam_slide", "--engine", "compiled", "--time.duration", "0.01", "--no-figures"]
    outcome = command_line(*words, "--law", "laws_for_numba:fast", "--out", "a")
    assert outcome.status == 0, outcome.err
    run = cl.load_run(tmp_path / "a" / "run.nc")
    assert run.law == "laws_for_numba:fast"
    assert run.contact_force == pytest.approx(np.full(11, 7.0))
    outcome = command_line(*words, "--law", "laws_for_numba:plain", "--out", "b")
    assert outcome.status == 2
    assert "law plain is not compiled" in outcome.err
    assert len(outcome.err.splitlines()) == 1
