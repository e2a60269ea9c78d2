"""A law of one's own has every right of a shipped one: what it sees, its states, its parameters, both engines."""

import re
from pathlib import Path

import numba
import numpy as np
import pytest

import closedloop as cl
from closedloop.base.sections import Gain, Number
from closedloop.control.law import commanded_force
from closedloop.control.laws.paper import PaperLaw
from closedloop.simulation.engines.law_source import fresh

PAGE = Path(__file__).resolve().parents[3] / "docs" / "controllers.md"
SHORT = {"time.duration": 0.3, "reference.start": 0.05, "reference.stop": 0.25}


def scenario(changes=None, name="wam_slide"):
    """Return a short slide."""
    return cl.load_scenario(name, SHORT | (changes or {}))


class Copied(cl.ControlLaw):
    """Eq. 33 once more, written by a user."""

    kp: Gain
    kd: Gain
    pd_start: Number

    @staticmethod
    def torque(x, par, z, torque):
        """Write Q."""
        f = commanded_force(x, par, z)
        for j in range(torque.size):
            pd = par.kp[j] * (x.q[j] - x.q_des[j]) + par.kd[j] * (x.v[j] - x.v_des[j])
            torque[j] = x.C[j] - x.A[0, j] * f - (pd if x.t >= par.pd_start else 0.0)


def copied_as(law):
    """Return the parameters of the paper's law as `Copied` takes them."""
    return {"law.kind": Copied, "law.kp": list(law.kp), "law.kd": list(law.kd), "law.pd_start": 0.0499}


@pytest.mark.parametrize("integrator", ["semi_implicit_euler", "rk4"])
@pytest.mark.parametrize("engine", ["pinocchio", "compiled"])
def test_a_copy_of_the_papers_law_is_the_papers_law(engine, integrator):
    """A class of a user's gives what the shipped class gives, to the bit, force integral and sampling included."""
    changes = {"law.force_integral": 20.0, "law.sample_period": 0.002, "time.integrator": integrator}
    shipped = scenario(changes)
    mine = scenario(changes | copied_as(shipped.law))
    assert type(shipped.law) is PaperLaw
    assert type(mine.law) is Copied
    first, second = (cl.simulate(each, engine=engine) for each in (shipped, mine))
    for name in ("q", "v", "torque", "contact_force"):
        assert np.array_equal(getattr(first, name), getattr(second, name))


def test_a_class_in_a_batch_and_with_its_own_parameters():
    """A batch gives the rows of single runs; parameters of the class are keys of the scenario."""
    base = scenario(copied_as(scenario().law))
    table = cl.simulate_batch(base, {"law.force": [8.0, 9.0, 12.0], "law.pd_start": [0.05, 0.1, 0.2]}, keep=["q"])
    for i, (force, start) in enumerate(((8.0, 0.05), (9.0, 0.1), (12.0, 0.2))):
        one = scenario(copied_as(scenario().law) | {"law.force": force, "law.pd_start": start})
        assert np.array_equal(np.ravel(table["q"][i].as_py()), cl.simulate(one, engine="compiled").q.ravel())
    with pytest.raises(cl.ScenarioError, match=r"law\.stiff"):
        scenario(copied_as(scenario().law) | {"law.stiff": 1.0})


def page_law(tmp_path, monkeypatch):
    """Return the documentation's admittance as the module that a user has it in."""
    blocks = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    (block,) = [block for block in blocks if "class Yielding(ControlLaw)" in block]
    assert len([line for line in block.splitlines() if line.strip()]) <= 25
    (tmp_path / "my_laws.py").write_text(block, encoding="utf-8")
    monkeypatch.syspath_prepend(str(tmp_path))


def test_the_admittance_of_the_page(tmp_path, monkeypatch):
    """It finds 10 N on a surface whose friction it does not know, where the paper's law does not; engines agree."""
    page_law(tmp_path, monkeypatch)
    changes = {"time.duration": 2.0, "reference.start": 0.2, "reference.stop": 1.2}
    mine, papers = (
        cl.load_scenario("wam_slide_friction", changes | kind) for kind in ({"law.kind": "my_laws:Yielding"}, {})
    )
    run = cl.simulate(mine, engine="compiled")
    assert abs(run.contact_force[-1] - 10.0) < 1e-3
    assert abs(cl.simulate(papers, engine="compiled").contact_force[-1] - 10.0) > 0.1
    assert run.summary()["verdict"]["good"]
    short = mine.model_copy(update={"time": mine.time.model_copy(update={"duration": 0.3})})
    runs = [cl.simulate(short, engine=engine) for engine in ("pinocchio", "compiled")]
    assert np.max(np.abs(runs[0].q - runs[1].q)) < 1e-9


def test_a_file_cannot_name_a_class(tmp_path, monkeypatch):
    """A scenario file that names a user's class is refused in one line, and its module is not imported."""
    (tmp_path / "never_mine.py").write_text("raise SystemExit")
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "mine.toml").write_text('[law]\nkind = "never_mine:Law"\n')
    with pytest.raises(cl.ScenarioError, match=r"law\.kind.*names a class of a user's own") as refused:
        cl.load_scenario(tmp_path / "mine.toml")
    assert "\n" not in str(refused.value)


def seen(changes, columns):
    """Return what a law in Python sees of a run, by name, at the rows; and the run."""
    rows = {name: [] for name in ("t", *columns)}

    def law(x):
        rows["t"].append(x.t)
        for name in columns:
            rows[name].append(getattr(x, name))
        return x.C - x.A[0] * x.f_des - 5.0 * x.v

    run = cl.simulate(scenario(changes), law=law)
    return {name: np.array(values) for name, values in rows.items()}, run


def test_a_law_sees_the_force_sensor_and_the_reference():
    """What it sees at a row is the run's: the reading of the row before, the reference, the state, the terms."""
    noisy = {"sensor.noise": 0.3, "sensor.delay": 0.003, "sensor.seed": 4, "sensor.bias": 0.5}
    columns = ("f_measured", "f_des", "q_des", "v_des", "q", "v", "r", "p", "frame", "p_des", "pressed", "H", "A")
    x, run = seen(noisy, columns)
    assert np.array_equal(x["t"], run.time)
    assert np.array_equal(x["f_measured"][1:], run.measured_force[:-1])
    assert np.array_equal(x["q"], run.q)
    assert np.array_equal(x["v"], run.v)
    assert np.array_equal(x["r"], run.position)
    assert np.array_equal(x["q_des"], run.reference_position)
    assert np.array_equal(x["v_des"], run.reference_velocity)
    np.testing.assert_allclose(np.einsum("tij,tj->ti", x["frame"], x["r"]), x["p"], atol=1e-15)
    np.testing.assert_allclose(np.einsum("tji,tj->ti", x["frame"], x["p_des"]), run.reference_tip, atol=1e-15)
    assert np.all(x["f_des"] == 10.0)
    assert np.all(x["pressed"] == 1.0)
    robot = run.model and cl.Robot(run.model, run.scenario.robot.tip)
    for i in (0, 150, 300):
        terms = robot.terms(run.q[i], run.v[i])
        np.testing.assert_allclose(x["H"][i], terms.mass_matrix, rtol=1e-14)
        np.testing.assert_allclose(x["A"][i], x["frame"][i] @ terms.jacobian, atol=1e-15)


@numba.njit
def returned(x):
    """Press with feedback of the sensor."""
    return x.C - x.A[0] * (x.f_des + 0.2 * (x.f_des - x.f_measured)) - 5.0 * x.v


@numba.njit
def written(x, torque):
    """Do the same, in place."""
    for j in range(torque.size):
        torque[j] = x.C[j] - x.A[0, j] * (x.f_des + 0.2 * (x.f_des - x.f_measured)) - 5.0 * x.v[j]


@pytest.mark.slow
@pytest.mark.parametrize("law", [returned, written])
def test_a_compiled_law_sees_the_same(law):
    """Compiled by numba, on either engine, a law gives what it gives in Python."""
    at = scenario({"sensor.noise": 0.1, "sensor.delay": 0.002})
    plain = cl.simulate(at, law=lambda x: returned.py_func(x))
    for engine, bound in (("pinocchio", 1e-11), ("compiled", 1e-9)):
        run = cl.simulate(at, law=law, engine=engine)
        assert np.max(np.abs(run.contact_force - plain.contact_force)) < bound * 10.0
        assert np.max(np.abs(run.q - plain.q)) < bound


@numba.njit
def writes_into_the_state(x):
    """Do what no law may."""
    x.q[0] = 0.0
    return x.C


def test_what_a_law_sees_is_read_only():
    """Neither a compiled law nor one in Python can change the state."""
    with pytest.raises(cl.ScenarioError, match="there to be read"):
        cl.simulate(scenario(), law=writes_into_the_state, engine="compiled")
    with pytest.raises(cl.LawError, match="read-only"):
        cl.simulate(scenario(), law=writes_into_the_state.py_func)


class Integral:
    """Integral action on the sensor, in a Python object."""

    def __init__(self):
        self.sum = 0.0

    def __call__(self, x):
        """Return Q."""
        self.sum += 0.001 * (x.f_des - x.f_measured)
        return x.C - x.A[0] * (x.f_des + 20.0 * self.sum) - 5.0 * x.v


class Resetting(Integral):
    """The same, with a reset."""

    def reset(self):
        """Forget."""
        self.sum = 0.0


def test_every_run_starts_from_a_reset():
    """An object with `reset`, and a class, give the same run twice; what one kept does not reach the next."""
    at = scenario({"sensor.bias": 0.5, "law.sample_period": 0.001})
    law = Resetting()
    runs = [cl.simulate(at, law=each) for each in (law, law, Integral, Integral)]
    assert runs[0].contact_force[-1] != runs[0].contact_force[0]
    for run in runs[1:]:
        assert np.array_equal(run.torque, runs[0].torque)


def test_a_law_for_another_run_is_as_it_was():
    """The command gives Fig. 7's run a law that has seen nothing of the first."""
    law = Integral()
    first = fresh(law)
    cl.simulate(scenario({"sensor.bias": 0.5}), law=first)
    assert first.sum != 0.0 == law.sum
    assert fresh(returned) is returned
    assert fresh(Integral) is Integral


class Counting(cl.ControlLaw):
    """A controller that counts its samples."""

    states = ("samples",)

    @staticmethod
    def torque(x, par, z, torque):
        """Write Q, and count."""
        z.samples += 1.0
        for j in range(torque.size):
            torque[j] = x.C[j] - x.A[0, j] * (par.force + 1e-3 * z.samples) - 5.0 * x.v[j]

    @staticmethod
    def rates(x, par, z, f, torque, dz):
        """Write that nothing changes between samples."""
        dz.samples = 0.0


@pytest.mark.parametrize("integrator", ["semi_implicit_euler", "rk4"])
def test_a_sampled_law_keeps_what_it_writes_into_its_states(integrator):
    """Sampled every fourth row, it has counted one sample every fourth row: f rises by a millinewton each time."""
    run = cl.simulate(scenario({"law.kind": Counting, "law.sample_period": 0.004, "time.integrator": integrator}))
    robot = cl.Robot(run.model, run.scenario.robot.tip)
    at = slice(0, None, 4)
    for count, (q, v, torque) in enumerate(zip(run.q[at], run.v[at], run.torque[at], strict=True), start=1):
        terms = robot.terms(q, v)
        expected = terms.bias - terms.jacobian[2] * (10.0 + 1e-3 * count) - 5.0 * v
        np.testing.assert_allclose(torque, expected, atol=1e-11)
    assert np.array_equal(run.torque[1], run.torque[0])
