"""Derivatives of whole runs: closed forms, events, kinks, and what is refused."""

import re
import sys
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.linalg import expm

import closedloop as cl
from closedloop.loop.events.table import EventRow
from closedloop.mechanics.closure.contact_force import FREE, PRESSED, STUCK
from closedloop.simulation.engines.dual_loop import prepared
from closedloop.simulation.parts import Cache
from closedloop.simulation.prepare import prepare
from closedloop.studies.gradient import differences, exact
from closedloop.studies.gradient.differences import SHARE, Keys, output
from closedloop.studies.gradient.exact import SHARE_OFF, not_unique, seeds_of
from tests.closedloop.linear_loops import DAMPING, MASS, STIFFNESS, mass_on_a_spring

FORCE, GAP, RESTITUTION = 10.0, 0.1, 0.6
ACCELERATION = FORCE / MASS


def point(**changes):
    """Return a point mass of 2 kg that a law presses onto a plane, without gains."""
    return cl.load_scenario("wam_slide", {
        "robot.model": "pointmass3", "robot.tip": "tip", "start.q": [0.0, 0.0, 0.0], "start.v": [0.0, 0.0, 0.0],
        "reference": {"kind": "hold"}, "law": {"kind": "paper", "kp": [0, 0, 0], "kd": [0, 0, 0], "force": FORCE},
        "surface.contact": "unilateral", "time.integrator": "rk4", "time.duration": 1.0, "time.step": 0.002,
    } | {key.replace("__", "."): value for key, value in changes.items()})  # fmt: skip


def ball(**changes):
    """Return one that falls and bounces."""
    return point(**{"surface__gap": GAP, "impact__restitution": RESTITUTION, "impact__rest_speed": 0.05} | changes)


def bounces(count, e, h, a):
    """Return the instants of the first impacts: √(2h/a) (1 + 2 (ε + ε² + ...))."""
    return np.array([np.sqrt(2 * h / a) * (1.0 + 2.0 * sum(e**i for i in range(1, k + 1))) for k in range(count)])


def complex_step(function, x):
    """Return the derivative of an analytic function of one number, to rounding."""
    return np.imag(function(x + 1e-30j)) / 1e-30


@pytest.fixture(scope="module")
def bounced():
    """Return the derivatives of the instants and impulses of a bouncing mass."""
    return cl.gradient(
        ball(), ["impact.restitution", "surface.gap", "law.force"],
        of=["event_time", "event_compression", "energy_lost_in_impacts"],
    )  # fmt: skip


@pytest.mark.parametrize(
    ("key", "function", "at"),
    [
        ("impact.restitution", lambda x, k: bounces(k, x, GAP, ACCELERATION), RESTITUTION),
        ("surface.gap", lambda x, k: bounces(k, RESTITUTION, x, ACCELERATION), GAP),
        ("law.force", lambda x, k: bounces(k, RESTITUTION, GAP, x / MASS), FORCE),
    ],
)
def test_instants_of_a_bouncing_ball(bounced, key, function, at):
    """∂t_k/∂ε, ∂t_k/∂h and ∂t_k/∂F are those of the closed form."""
    count = len(bounced.value["event_time"])
    assert count >= 5
    expected = complex_step(lambda x: function(x, count), at)
    np.testing.assert_allclose(bounced.derivative["event_time"][key], expected, rtol=1e-7, atol=1e-8)
    assert not bounced.problems
    assert np.all(np.abs(bounced.derivative["event_time"][key] - expected) <= bounced.error["event_time"][key] + 1e-12)


def test_impulses_of_a_bouncing_ball(bounced):
    """The impulse of compression is m v εᵏ, and v = √(2 a h)."""
    k = np.arange(len(bounced.value["event_time"]))
    v = np.sqrt(2.0 * ACCELERATION * GAP)
    np.testing.assert_allclose(bounced.value["event_compression"], MASS * v * RESTITUTION**k, rtol=1e-9)
    np.testing.assert_allclose(
        bounced.derivative["event_compression"]["impact.restitution"],
        MASS * v * k * RESTITUTION ** (k - 1.0),
        rtol=1e-6,
    )
    assert bounced.derivative["energy_lost_in_impacts"]["law.force"] == pytest.approx(
        bounced.value["energy_lost_in_impacts"] / FORCE, rel=1e-7
    )
    assert bounced.units["event_time"] == "s"
    assert set(bounced.table()["key"]) == {"impact.restitution", "surface.gap", "law.force"}
    assert repr(bounced) == str(bounced)
    assert str(bounced).splitlines()[0].split() == ["of", "key", "value", "derivative", "error", "method"]
    assert "..." not in str(bounced)
    assert len(str(bounced).splitlines()) == 1 + len(bounced.table())


def test_a_gradient_is_shown_without_pandas(bounced, monkeypatch):
    """By repr() too, which a debugger asks for; the table alone needs it, and says so."""
    shown = repr(bounced)
    monkeypatch.setitem(sys.modules, "pandas", None)
    assert repr(bounced) == shown
    with pytest.raises(cl.ScenarioError, match="need pandas"):
        bounced.table()


@pytest.mark.parametrize(("key", "entry"), [("spin", (0, 1)), pytest.param("velocity", (0, 0), marks=pytest.mark.slow)])
def test_a_body_that_is_thrown_otherwise(tmp_path, key, entry):
    """A ball slips by u = v − ω r, and rolls after t = 2 u/(7 μ g): its way is that of the closed form.

    Each number of a body makes another robot.
    """
    v, friction, end, radius = 1.0, 0.2, 0.3, 0.05
    (tmp_path / "thrown.toml").write_text(
        f'[robot]\nmodel = "none"\n[[body]]\nname = "b"\nshape = "ball"\nradius = {radius}\nmass = 1.0\n'
        f"position = [0, 0, {radius}]\nvelocity = [{v}, 0, 0]\nspin = [0, 0, 0]\n"
        f"[[contact]]\nlink = 'b'\nat = 'collision'\nfriction = {friction}\n[time]\nduration = {end}\n"
    )

    def way(v, spin):
        slows = friction * 9.81
        rolls = 2.0 * (v - spin * radius) / (7.0 * slows)
        return v * rolls - 0.5 * slows * rolls**2 + (5.0 * v + 2.0 * spin * radius) / 7.0 * (end - rolls)

    found = cl.gradient(cl.load_scenario(tmp_path / "thrown.toml"), [f"body.b.{key}"], of=["q@end"])
    closed = complex_step(
        (lambda x: way(v, x)) if key == "spin" else (lambda x: way(x, 0.0)), 0.0 if key == "spin" else v
    )
    assert found.derivative["q@end"][f"body.b.{key}"][entry] == pytest.approx(closed, rel=1e-4)


def test_saltation_at_impacts():
    """Derivatives of the state after two impacts are the product of flights and saltation matrices.

    With δt = −δz/v⁻ the state beside jumps to δz⁺ = −ε δz⁻ and δv⁺ = −ε δv⁻ − (1 + ε) a δz⁻/v⁻. Each of the
    three terms is needed: without one of them the product is another.
    """
    end = 0.5
    found = cl.gradient(ball(), ["start.v"], of=[f"q@{end}", f"v@{end}"])
    mine = [found.derivative[f"{name}@{end}"]["start.v"][2, 2] for name in "qv"]

    def product(*terms):
        position, velocity, instant = terms
        state, t, v = np.array([0.0, 1.0]), 0.0, 0.0
        for impact in bounces(2, RESTITUTION, GAP, ACCELERATION):
            v -= ACCELERATION * (impact - t)
            state = np.array([[1.0, impact - t], [0.0, 1.0]]) @ state
            jump = (1.0 + RESTITUTION) * ACCELERATION / v
            state = np.array([[-RESTITUTION * position, 0.0], [-jump * instant, -RESTITUTION * velocity]]) @ state
            t, v = impact, -RESTITUTION * v
        return np.array([[1.0, end - t], [0.0, 1.0]]) @ state

    np.testing.assert_allclose(mine, product(1.0, 1.0, 1.0), rtol=1e-7)
    for planted in ((-1.0, 1.0, 1.0), (1.0, -1.0, 1.0), (1.0, 1.0, 0.0)):
        assert not np.allclose(mine, product(*planted), rtol=1e-3)


@pytest.mark.parametrize("term", ["position", "velocity", "instant"])
def test_a_fault_in_a_term_of_saltation_is_caught(term, monkeypatch):
    """One of the three terms is left out of, or turned round in, a run of dual numbers: it is not believed."""
    end, gap, lane = 0.4, 0.11, 3  # of the velocity along z
    first, second = bounces(2, RESTITUTION, gap, ACCELERATION)
    assert first < end < second
    missing = {
        "position": (2.0 * RESTITUTION * first, 0.0),
        "velocity": (0.0, 2.0 * RESTITUTION),
        "instant": (0.0, -(1.0 + RESTITUTION)),  # (1 + ε) a δz⁻/v⁻ with v⁻ = −a t
    }
    position, velocity = missing[term]

    class Faulty(exact.DualRun):
        def run(self):
            went_on = super().run()
            late = 0.002 * np.arange(len(self.rows)) - first
            self.rows[late > 0.0, 2, lane] += position + velocity * late[late > 0.0]
            self.rows[late > 0.0, 5, lane] += velocity
            return went_on

    asked = {"time.duration": end, "surface__gap": gap}
    plain = cl.gradient(ball(**asked), ["start.v"], of=["q@end"])
    assert plain.method["q@end"]["start.v"].startswith(exact.DUALS)
    monkeypatch.setattr(exact, "DualRun", Faulty)
    caught = cl.gradient(ball(**asked), ["start.v"], of=["q@end"])
    assert not caught.method["q@end"]["start.v"].startswith(exact.DUALS)
    np.testing.assert_allclose(caught.derivative["q@end"]["start.v"], plain.derivative["q@end"]["start.v"], atol=1e-7)


@pytest.mark.parametrize(("share", "caught"), [(0.0, True), (1.001, True), (1.0, False)])
def test_a_fault_in_the_instant_of_the_end_of_a_slip_is_caught(share, caught, monkeypatch):
    """An instant that has no derivatives, or has them to a thousandth, is not believed."""

    class Faulty(exact.DualRun):
        def run(self):
            went_on = super().run()
            self.events[:, EventRow.place("time"), 1:] *= share
            return went_on

    monkeypatch.setattr(exact, "DualRun", Faulty)
    v, friction = 0.81, 0.4  # between two rows
    block = point(start__v=[v, 0.0, 0.0], friction__kind="coulomb", friction__coefficient=friction)
    found = cl.gradient(block, ["friction.coefficient"], of=["event_time"])
    assert found.method["event_time"]["friction.coefficient"].startswith(exact.DUALS) != caught
    stop = MASS * v / (friction * FORCE)
    assert found.derivative["event_time"]["friction.coefficient"] == pytest.approx([-stop / friction], rel=1e-7)


def test_what_a_posture_does_to_the_preparation():
    """A sphere is placed below the tip, a curved function of the posture, beside numbers that are infinite or NaN."""
    keys = Keys(cl.load_scenario("wam_sphere", {"time.duration": 0.1}), ["start.q"])
    direction, cache = keys.directions[1], Cache()
    base = prepared(prepare(keys.scenario))
    found = seeds_of(keys, direction, base, None, cache)
    near = 1e-4 * direction.step / SHARE
    beside = [
        [array.copy() for array in prepared(prepare(keys.scenario_at({direction: change}), None, cache)).floats]
        for change in (-near, near)
    ]
    assert not found.linear
    for part, minus, plus in zip(found.parts, *beside, strict=True):
        with np.errstate(invalid="ignore"):
            expected = np.where(minus == plus, 0.0, plus - minus) / (2.0 * near)
        known = np.isfinite(expected)
        mine = np.zeros_like(expected) if part is None else part
        np.testing.assert_allclose(mine[known], expected[known], rtol=1e-6, atol=1e-6)


def test_sliding_block_stops():
    """It stops at t = m v/(μ F), after m v²/(2 μ F)."""
    v, friction = 0.8, 0.4
    block = point(start__v=[v, 0.0, 0.0], friction__kind="coulomb", friction__coefficient=friction)
    found = cl.gradient(block, ["friction.coefficient", "law.force", "start.v"], of=["event_time", "q@end"])
    stop = MASS * v / (friction * FORCE)
    assert found.value["event_time"] == pytest.approx([stop], rel=1e-9)
    by = found.derivative["event_time"]
    assert by["friction.coefficient"] == pytest.approx([-stop / friction], rel=1e-7)
    assert by["law.force"] == pytest.approx([-stop / FORCE], rel=1e-7)
    assert by["start.v"].shape == (1, 3)
    assert by["start.v"][0, 0] == pytest.approx(stop / v, rel=1e-7)
    at = found.derivative["q@end"]
    assert at["start.v"].shape == (3, 3)
    assert at["start.v"][0, 0] == pytest.approx(stop, rel=1e-7)
    assert at["friction.coefficient"][0] == pytest.approx(-0.5 * v * stop / friction, rel=1e-7)


@pytest.mark.parametrize("integrator", ["dop853", "rk4"])
def test_kelvin_voigt(integrator):
    """f, v and q of a mass on a spring and a damper that begins to sink: derivatives of the matrix exponential.

    To 1e-8: differences of dop853, and dual numbers of rk4 at a step whose own error is below.
    """

    def at_end(k, c, force):
        rates = np.array([[0.0, 1.0, 0.0], [-k / MASS, -c / MASS, force / MASS], [0.0, 0.0, 0.0]])
        x, v, _ = expm(rates * t) @ np.array([FORCE / STIFFNESS, speed, 1.0])
        return np.array([k * x + c * v, -v, -x])

    t, speed, names = 0.05, 0.05, [f"contact_force@{0.05}", f"v@{0.05}", f"q@{0.05}"]
    given = {"start__v": [0.0, 0.0, -speed], "time__integrator": integrator, "start__q": [0.0, 0.0, 0.0]}
    given |= {"time__tolerance": 1e-14} if integrator == "dop853" else {"time__step": 1e-4, "time__duration": t}
    given |= {"surface__offset": FORCE / STIFFNESS}
    keys = {"compliance.stiffness": STIFFNESS, "compliance.damping": DAMPING, "law.force": FORCE}
    found = cl.gradient(mass_on_a_spring(0.0, **given), list(keys), of=names)
    for i, key in enumerate(keys):
        closed = complex_step(
            lambda x, i=i: at_end(*(x if j == i else y for j, y in enumerate(keys.values()))), keys[key]
        )
        mine = [np.ravel(found.derivative[name][key])[-1] for name in names]
        np.testing.assert_allclose(mine, closed, rtol=1e-8)
        duals = found.method[names[1]][key].startswith(exact.DUALS)
        assert duals == (integrator == "rk4")


@pytest.mark.slow
def test_dual_numbers_and_dop853_agree_on_a_soft_table():
    """Two ways that share neither scheme nor differences: to what the differences say of themselves, and 2e-7.

    Derivatives of v along the gains are 1/200 of v, and runs of dop853 beside each other scatter by 1e-12 of v. rk4
    takes a path that jumps at a row a part of a step early, so its derivatives are extrapolated in the step: to 1e-9.
    """
    changes, keys = {"reference.start": 0.1, "time.duration": 0.3}, ["law.kd", "law.kp"]

    def along_keys(more):
        scenario = cl.load_scenario("soft_table", changes | more)
        found = cl.gradient(scenario, keys, of=["v@end"])
        gains = [np.array(scenario.law.kd), np.array(scenario.law.kp)]
        by = [[each["v@end"][key] for key in keys] for each in (found.derivative, found.error)]
        sums = [np.array([x @ gain for x, gain in zip(each, gains, strict=True)]) for each in by]
        return (*sums, found.method["v@end"]["law.kd"])

    steps = [along_keys({"time.integrator": "rk4", "time.step": 2e-4 / 2**k}) for k in range(4)]
    assert all(method.startswith(exact.DUALS) for *_, method in steps)
    once = [2.0 * fine[0] - coarse[0] for coarse, fine in pairwise(steps)]
    before, duals = [(4.0 * fine - coarse) / 3.0 for coarse, fine in pairwise(once)]
    size = np.max(np.abs(duals), axis=1, keepdims=True)
    assert np.all(np.abs(duals - before) <= 1e-9 * size)
    mine, error, method = along_keys({"time.integrator": "dop853", "time.tolerance": 1e-13})
    assert method == differences.DIFFERENCES
    assert np.all(np.abs(mine - duals) <= error + 1e-9 * size)
    assert np.all(np.abs(mine - duals) <= 2e-7 * size)


def test_one_entry_of_a_list_is_a_key():
    """The third number of a normal, at its value, and no other; a place that there is not is refused."""
    for place, value in enumerate((0.6, 0.0, 0.8)):
        keys = Keys(cl.load_scenario("wam_slide", {"surface.normal": [0.6, 0.0, 0.8]}), [f"surface.normal.{place}"])
        assert keys.values[f"surface.normal.{place}"] == value
    with pytest.raises(cl.ScenarioError):
        Keys(cl.load_scenario("wam_slide"), ["surface.normal.3"])


def test_a_motion_that_is_none_by_symmetry_has_derivatives():
    """The Panda's first and third joints do not move: rounding of their rates has any sign, their derivatives do not.

    In row 42 the signs change; torques there were off by 1.2e-2 of 22 N m/rad.
    """
    short = {"time.duration": 0.045}
    scenario = cl.load_scenario("panda_scan", short)
    found = cl.sensitivities(scenario, ["start.q"], of=["torque"]).derivative["torque"]["start.q"][..., 2]
    ends = []
    for change in (1e-5, -1e-5):
        q = np.array(scenario.start.q)
        q[2] += change
        ends.append(
            cl.simulate(cl.load_scenario("panda_scan", {**short, "start.q": q.tolist()}), progress=False).torque
        )
    np.testing.assert_allclose(found, (ends[0] - ends[1]) / 2e-5, atol=1e-5)


def pushed(**changes):
    """Return a block that slides on four feet, to which the tip begins to stick at 0.492 s."""
    return cl.load_scenario("push_block", {"time.duration": 0.5, "reference.start": 0.0} | changes)


def test_an_end_of_slip_that_forces_without_a_unique_solution_decide_over_is_found():
    """Four normal forces of feet that slide are one more than unique ones; three are unique."""
    run = cl.simulate(pushed(), engine="compiled")
    found = not_unique(run)
    assert found.instant == pytest.approx(0.492223, abs=1e-5)
    assert found.event == "stick of pusher"
    assert "forces of contacts are not unique" in found.problem
    for name, count in (("v@0.49", 0), ("v@end", run.v.shape[1]), ("event_time", 1), ("max_kinetic_energy", 1)):
        assert np.count_nonzero(found.follows(output(name, run), run)) == count
    for lifted in (1, 4):
        modes = run.link_modes.copy()
        modes[:, :lifted] = FREE
        assert not_unique(replace(run, columns=dict(run.columns) | {"link_modes": modes})) is None
    modes = run.link_modes.copy()
    modes[:, :1] = FREE
    modes[:, 1:2] = STUCK  # one that sticks beside two that slide: three normal forces, and two along the floor
    assert not_unique(replace(run, columns=dict(run.columns) | {"link_modes": modes})) is None
    modes = modes.copy()
    modes[:, :1] = PRESSED  # and three: four normal forces of which three are independent
    assert not_unique(replace(run, columns=dict(run.columns) | {"link_modes": modes})).event == "stick of pusher"
    assert not_unique(cl.simulate(pushed(**{"contact.*.friction": 0.0}), engine="compiled")) is None
    assert not_unique(cl.simulate(cl.load_scenario("wam_slide", {"time.duration": 0.1}), engine="compiled")) is None


@pytest.mark.slow
def test_derivatives_after_such_an_end_of_slip_say_how_exact_they_are():
    """Those before it are exact to rounding."""
    found = cl.gradient(pushed(), ["law.force"], of=["v@0.49", "v@end", "event_time"])
    assert re.match(r"not smooth at 0\.4922\d+ s \(stick of pusher\)", found.problems[0])
    error, largest = found.error["v@end"]["law.force"], np.max(np.abs(found.derivative["v@end"]["law.force"]))
    assert np.all(error >= SHARE_OFF * largest)
    assert np.all(found.error["v@0.49"]["law.force"] < 1e-9)
    assert np.all(found.error["event_time"]["law.force"][:-1] < 1e-9)
    assert found.error["event_time"]["law.force"][-1] > 1e-7


def test_whole_columns():
    """`sensitivities` has the derivative of every row: of f with respect to the force wanted it is 1."""
    scenario = cl.load_scenario("wam_slide", {"time.duration": 0.3})
    found = cl.sensitivities(scenario, ["law.force", "law.kd"], of=["contact_force", "q"])
    rows = len(found.time)
    assert rows == 301
    np.testing.assert_allclose(found.derivative["contact_force"]["law.force"], 1.0, rtol=1e-9)
    assert found.derivative["q"]["law.kd"].shape == (rows, 4, 4)
    one = cl.gradient(scenario, ["law.kd"], of=["q@0.2"])
    np.testing.assert_array_equal(found.derivative["q"]["law.kd"][200], one.derivative["q@0.2"]["law.kd"])
    figure = found.figure()
    assert len(figure.axes) == 4
    assert "law.kd" in figure.axes[1].get_ylabel()


@pytest.mark.parametrize(
    ("keys", "of", "words"),
    [
        (["law.kind"], ["rms_force_error"], "it is a word"),
        (["surface.offset"], ["rms_force_error"], "it is a word; give the number"),
        (["sensor.seed"], ["rms_force_error"], "a whole number"),
        (["robot.drive_inertia"], ["rms_force_error"], "not a real one"),
        (["time.step"], ["rms_force_error"], "the number of rows"),
        (["law.fource"], ["rms_force_error"], "law.fource"),
        (["drives.torque"], ["rms_force_error"], "drives.torque"),
        (["law.force", "law.force"], ["rms_force_error"], "named twice"),
        ("law.force", ["rms_force_error"], "must be a list of keys"),
        (["law.force"], "rms_force_error", "must be a list of quantities"),
        (["law.force"], ["rms_force"], "no such quantity"),
        (["law.force"], ["contact_force"], "contact_force@end"),
        (["law.force"], ["contact_force@9"], "an instant of the run"),
        (["law.force"], ["contact_force@soon"], "an instant of the run"),
        (["law.force"], ["mode@end"], "no real numbers"),
        (["law.force"], ["steps"], "no real number"),
        (["law.force"], ["time_in_contact"], "counted in rows"),
        (["law.force"], ["wall_seconds"], "no real number that the scenario gives"),
        (["law.force"], ["event_time"], "no events"),
    ],
)
def test_what_has_no_derivative_is_refused(keys, of, words):
    """In one line that says what would be right."""
    scenario = cl.load_scenario("wam_slide", {"time.duration": 0.1})
    with pytest.raises(cl.ScenarioError, match=words.replace("[", r"\[")) as error:
        cl.gradient(scenario, keys, of=of)
    assert "\n" not in str(error.value)


def test_several_scenarios_side_by_side():
    """Each has the derivatives that it has alone, in the order in which they are given; one that stops ends it."""
    three = [ball(impact__restitution=e) for e in (0.5, 0.6, 0.7)]
    counts: list[tuple[int, int]] = []
    found = cl.gradients(
        three, ["surface.gap"], ["event_time"], progress=lambda *count: counts.append(count), workers=2
    )
    assert counts[0] == (0, 3)
    assert counts[-1] == (3, 3)
    for each, e in zip(found, (0.5, 0.6, 0.7), strict=True):
        count = len(each.value["event_time"])
        expected = complex_step(lambda h, e=e, count=count: bounces(count, e, h, ACCELERATION), GAP)
        np.testing.assert_allclose(each.derivative["event_time"]["surface.gap"], expected, rtol=1e-7)
    with pytest.raises(cl.ScenarioError, match="scenarios: must be a list of scenarios"):
        cl.gradients([], ["surface.gap"], ["event_time"])
    stops = cl.load_scenario("wam_slide", {"law.kd": [1e4] * 4, "time.duration": 1.0})
    with pytest.raises(cl.SimulationError):
        cl.gradients([three[0], stops], ["law.force"], ["max_tip_speed"])


@pytest.mark.parametrize(
    ("of", "words"),
    [
        ("event_time", "is of the events, not of the rows; cl.gradient has its derivatives"),
        (
            "rms_force_error",
            "it must be a column, such as contact_force; values of the summary are those of cl.gradient",
        ),
    ],
)
def test_what_is_no_column_of_rows_is_refused(of, words):
    """In one line that says where it is; the first told to ask for what had been asked for."""
    with pytest.raises(cl.ScenarioError, match=re.escape(words)):
        cl.sensitivities(ball(time__duration=0.2), ["law.force"], of=[of])


def test_a_run_that_stops_has_no_derivative():
    """What it stops with is raised."""
    scenario = cl.load_scenario("wam_slide", {"law.kd": [1e4] * 4, "time.duration": 1.0})
    with pytest.raises(cl.SimulationError):
        cl.gradient(scenario, ["law.force"], of=["rms_force_error"])


def test_the_step_of_a_number_is_a_share_of_the_largest_of_its_list_whatever_its_sign():
    """Of an angle of −1.4 rad beside one of 0.6; and of a number below zero."""
    scenario = cl.load_scenario(
        "planar2_slide", {"start.q": [0.6, -1.4], "law.force": -2.0, "surface.contact": "bilateral"}
    )
    steps = {(each.key, each.entry): each.step for each in Keys(scenario, ["start.q", "law.force"]).directions}
    assert steps == {
        ("start.q", (0,)): SHARE * 1.4, ("start.q", (1,)): SHARE * 1.4, ("law.force", ()): SHARE * 2.0,
    }  # fmt: skip
