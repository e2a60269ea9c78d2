"""Runs of dual numbers: values to the bit, and derivatives against the complex step and closed forms."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

import closedloop as cl
from closedloop.control.reference.desired import Reference
from closedloop.loop.events import locate
from closedloop.loop.events.locate import REACH_EVENT
from closedloop.loop.step.record_row import Row
from closedloop.simulation.engines.dual_loop import DualRun, prepared, structure
from closedloop.simulation.prepare import prepare
from closedloop.studies.gradient.exact import DUALS
from tests.closedloop.studies.test_gradient import FORCE, MASS, complex_step, point
from validation.oracle.engine import Closure, Law, Oracle, simulate_slide

ROWS, MOVING = 4, (0.1, -0.2, 0.3, 0.2)


def seeds(start, *changes):
    """Return a direction for each change, which writes into the loop's memory and the table of a prepared run."""
    found = []
    for change in changes:
        parts = [np.zeros_like(array) for array in start.floats]
        of = {id(array): part for array, part in zip(start.floats, parts, strict=True)}
        loop = start.loop
        w = type(loop.w)(of[id(loop.w.memory)], *loop.w.sizes)
        constants = type(loop.constants)(of[id(loop.constants.memory)], *loop.constants.sizes)
        change(w, constants, of[id(start.problem.table)])
        found.append(parts)
    return found


def test_steps_against_the_complex_step():
    """Four steps of the oracle in complex numbers: derivatives by a gain, the force, a position and a rate to 1e-12."""
    changes = {"time.duration": ROWS * 0.001, "reference.start": 0.0, "law.pd_start": 0.0}
    scenario = cl.load_scenario("wam_slide", changes)
    problem = prepare(scenario)
    n, (kp, kd), (damping, time) = problem.robot.n, problem.gains, (0.707, 0.001)
    path, press = problem.path[:: problem.nodes], float(problem.settings[0])
    oracle, step, moving = Oracle.from_model(problem.robot.model, scenario.robot.tip), 1e-30j, np.array(MOVING)

    def run(gain=0.0, force=0.0, position=0.0, rate=0.0):
        one = np.eye(n)
        return simulate_slide(
            oracle, q=problem.q + position * one[1], v=moving + rate * one[3], q_des=path[:, 0], v_des=path[:, 1],
            step=problem.h, law=Law(kp, kd + gain * one[1], press + force, problem.pd_start),
            closure=Closure(problem.plane.normal, problem.plane.offset, (damping, time)),
        )  # fmt: skip

    start = prepared(problem)
    start.loop.w.v[:] = moving
    law, n_place = start.loop.constants, Reference.place("force", n)
    first = next(i for i in range(law.law.size - n + 1) if np.array_equal(law.law[i : i + n], kd))

    def gain(w, constants, table):
        constants.law[first + 1] = 1.0

    def force(w, constants, table):
        table[:, n_place] = 1.0

    def position(w, constants, table):
        w.q[1] = 1.0

    def rate(w, constants, table):
        w.v[3] = 1.0

    duals = DualRun(start, seeds(start, gain, force, position, rate))
    assert duals.run()
    for lane, name in enumerate(("gain", "force", "position", "rate"), 1):
        truth = run(**{name: step})
        for column in ("q", "v", "acceleration", "torque", "contact_force", "closure_error"):
            mine = duals.rows[:, Row.place(column, n), lane]
            found = getattr(truth, column)
            its = np.imag(found) / step.imag
            least = 1e-3 + 1e-2 * float(np.max(np.abs(found.real)))  # the force moves nothing but by rounding
            size = max(float(np.max(np.abs(its))), least)
            np.testing.assert_allclose(mine, its, rtol=0, atol=1e-12 * size, err_msg=f"{column} by {name}")


@pytest.mark.parametrize("name", ["wam_slide", "planar2_drop", "wam_stick_slip"])
def test_values_are_those_of_the_plain_run(name):
    """To the last bit, events and all that was recorded, whatever derivatives there are."""
    scenario = cl.load_scenario(name, {"time.duration": 2.5 if name == "wam_stick_slip" else 0.5})
    plain = cl.simulate(scenario, engine="compiled", progress=False)
    start = prepared(prepare(scenario))
    frame = structure(start)

    def first(w, constants, table):
        w.v[0] = 1.0

    duals = DualRun(start, seeds(start, first))
    assert duals.run()
    n = plain.model.n
    for column in ("q", "v", "acceleration", "torque", "contact_force", "kinetic_energy", "energy_supplied"):
        np.testing.assert_array_equal(duals.rows[:, Row.place(column, n), 0], getattr(plain, column))
    for column in ("kkt_condition", "residual_motion", "residual_closure"):  # not calculated
        assert np.all(np.isnan(duals.rows[:, Row.place(column, n), 0]))
    np.testing.assert_array_equal(duals.events[:, 0, 0], plain.event_time)
    assert len(plain.events) == (0 if name == "wam_slide" else len(duals.events))
    assert structure(prepared(prepare(scenario))) == frame


def test_period_of_stick_and_slip():
    """A mass drawn by a spring at v: T = 2 a/v + (2/ω)(π − atan(a ω/v)), a = (μ_s − μ_k) N/k, and its derivatives."""
    stiffness, static, kinetic, speed = 200.0, 0.4, 0.3, 0.0213  # slip begins between two rows
    scenario = point(
        reference={"kind": "line", "direction": [1, 0, 0], "speed": speed, "start": 0.0, "stop": 10.0},
        law={"kind": "paper", "kp": [stiffness, 0.0, 0.0], "kd": [0.0] * 3, "force": FORCE, "pd_start": 0.0},
        friction={"kind": "karnopp", "static": static, "kinetic": kinetic, "dead_band": 1e-9},
        time__duration=3.0, time__step=0.002,
    )  # fmt: skip
    keys = ["friction.static", "friction.kinetic", "reference.speed"]
    found = cl.gradient(scenario, keys, of=["event_time"])
    kinds = [event.kind for event in cl.simulate(scenario, engine="compiled", progress=False).events]
    assert kinds[:3] == ["slip", "stick", "slip"]

    def period(static, kinetic, speed):
        a, rate = (static - kinetic) * FORCE / stiffness, math.sqrt(stiffness / MASS)
        return 2.0 * a / speed + 2.0 / rate * (math.pi - np.arctan(a * rate / speed))

    at = static, kinetic, speed
    assert found.value["event_time"][2] - found.value["event_time"][0] == pytest.approx(period(*at), rel=1e-7)
    for i, key in enumerate(keys):
        by = found.derivative["event_time"][key]
        expected = complex_step(lambda x, i=i: period(*(x if j == i else y for j, y in enumerate(at))), at[i])
        assert by[2] - by[0] == pytest.approx(expected, rel=1e-6)
        assert found.method["event_time"][key].startswith(DUALS)


def test_what_dual_numbers_do_not_take_is_found_by_differences():
    """An integrator that chooses its steps, and a quantity of rounding alone."""
    adaptive = cl.load_scenario("planar2_slide", {"time.duration": 0.05, "time.integrator": "dop853"})
    assert not cl.gradient(adaptive, ["law.force"], of=["q@end"]).method["q@end"]["law.force"].startswith(DUALS)
    found = cl.gradient(
        cl.load_scenario("planar2_slide", {"time.duration": 0.05}), ["law.force"], of=["max_kkt_residual", "q@end"]
    )
    assert found.method["q@end"]["law.force"].startswith(DUALS)
    assert list(found.value) == ["max_kkt_residual", "q@end"]


@pytest.mark.parametrize(
    ("at_stage", "at_end", "used"),
    [(-1e-11, -1.5e-5, "stage"), (-1e-11, -1e-12, "end"), (9.97e-10, -5.1e-7, "stage"), (9.97e-10, -5e-12, "end")],
)
def test_an_instant_that_a_stage_decides_has_the_derivatives_of_that_stage(monkeypatch, at_stage, at_end, used):
    """Friction of a slip that turns by 90 degrees stops turning at a stage, and the event function jumps at the end.

    Its derivatives there are none of the instant: the end of a slip of `push_block` had one that was off by a quarter.
    So does friction of a slip that at a stage is too slow to have a direction, 1e-12 m/s: the end of the slip of
    `panda_scan` was off by 1.4e-6.
    """
    monkeypatch.setattr(locate, "slope_of", lambda value: value)
    monkeypatch.setattr(locate, "settled", lambda tau, value, slope: (value, slope))
    search = SimpleNamespace(tau=0.1, value=at_end, at_stage=0.0, at_low=0.0)
    trial, settings = SimpleNamespace(settling=1, purpose=0), SimpleNamespace(stages=4)
    w, state = SimpleNamespace(search=search), SimpleNamespace(trial=trial, settings=settings, together=0)
    margins = iter([3e-4, at_stage, 2e-4])
    monkeypatch.setattr(locate, "event_function", lambda *_: next(margins))
    for state.stage in (1, 2, 3):
        locate.note_stage.py_func(w, None, state)
    for _ in range(2):
        locate.settle_instant.py_func(w, state)
    value = at_stage if used == "stage" else at_end
    assert search.tau == (value, value)
    assert (trial.settling, trial.purpose) == (0, REACH_EVENT)


def test_an_instant_at_which_the_slip_of_the_tip_ends_has_the_derivatives_of_the_stage_that_decides():
    """A probe comes to rest on a cylinder: friction turns round at a stage, and slip at the end jumps past zero.

    The derivative of the instant was that of the end, and 4.9e-5 off; for the second of two such instants 1.4e-6.
    """
    changes = {"time.duration": 0.145, "surface_motion.kind": "none", "friction.coefficient": 0.111}
    scenario = cl.load_scenario("panda_scan", changes)
    found = cl.gradient(scenario, ["friction.coefficient"], of=["event_time"])
    assert found.method["event_time"]["friction.coefficient"].startswith(DUALS)

    def stops(coefficient):
        run = cl.simulate(
            cl.load_scenario("panda_scan", changes | {"friction.coefficient": coefficient}), engine="compiled"
        )
        assert [event.kind for event in run.events] == ["touchdown", "stick"]
        return run.event_time[1]

    h = 5e-5
    near, wide = ((stops(0.111 + k * h) - stops(0.111 - k * h)) / (2 * k * h) for k in (1, 2))
    expected = (4.0 * near - wide) / 3.0
    assert found.derivative["event_time"]["friction.coefficient"][1] == pytest.approx(expected, rel=5e-8)
