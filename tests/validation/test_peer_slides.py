"""The slide of the paper in every engine that can run one: limits, orders, and a surface that really acts."""

import numpy as np
import pytest

from validation.engines import slides
from validation.engines.interface import Missing
from validation.engines.trajectories import SHORT, Trajectory, at_zero, law, problem, slide_closedloop, slide_oracle

INSTALL = {
    "mujoco": 'pip install "mujoco>=3.17,!=4.0.0"',
    "exudyn": 'pip install "exudyn>=1.13"',
    "pydrake": 'pip install "drake>=1.50"',
}


def all_pass(checks):
    """Run the checks; return how many there were."""
    done = list(checks)
    failed = [f"{c.engine}: {c.what}: {c.error:.2e} > {c.tolerance:.1e}" for c in done if not c.passed]
    assert not failed, failed
    assert all(c.argument for c in done)
    return len(done)


@pytest.mark.parametrize("changes", [{"time.duration": 1.5}, pytest.param({}, marks=pytest.mark.slow)])
def test_oracle_steps_as_the_simulator_does(changes):
    """f, e and q of the whole slide, and of its first part with the jump of velocity in it, are equal to rounding."""
    assert all_pass(slides.compare_oracle(changes)) == 4


@pytest.mark.slow
@pytest.mark.parametrize(
    ("package", "compare", "count"),
    [
        ("mujoco", slides.compare_mujoco, 4),
        ("exudyn", slides.compare_exudyn, 3),
        ("pydrake", slides.compare_drake, 3),
    ],
    ids=["mujoco", "exudyn", "drake"],
)
def test_peer_tends_to_the_simulator(package, compare, count):
    """Its surface acts, it approaches in its order, and its limit is the simulator's curve."""
    pytest.importorskip(package, reason=INSTALL[package])
    assert all_pass(compare()) == count


def test_what_is_not_installed_is_said(monkeypatch):
    """A slide that cannot be run appears as missing with its install line."""
    monkeypatch.setattr(slides, "compare_oracle", lambda: iter(()))
    monkeypatch.setattr(slides, "installed", lambda engine: False)
    found = list(slides.compare_slides())
    assert [type(x) for x in found] == [Missing] * 3
    assert all("pip install" in str(x) for x in found)


def test_a_surface_that_is_off_fails():
    """An engine that ignores its surface, or pushes with another force, does not count as acting."""

    def still(of, f, e):
        zero = np.zeros((of.steps + 1, 4))
        t = np.arange(of.steps + 1) * of.h
        return Trajectory("x", t, zero, zero, np.full(len(t), f), e * t**2, of.h)

    good = slides.slide_acts("x", lambda of, on: still(of, 10.0 if on else 0.0, 1e-7 if on else 1.0))
    assert good.passed
    for wrong in (
        lambda of, on: still(of, 0.0, 1.0),  # ignored
        lambda of, on: still(of, 9.0 if on else 0.0, 1e-7 if on else 1.0),  # not what is asked for
        lambda of, on: still(of, 10.0, 1e-7),  # never off: nothing was proven
        lambda of, on: still(of, 10.0 if on else 0.0, 0.1 if on else 1.0),  # gives way
    ):
        assert not slides.slide_acts("x", wrong).passed


def test_a_fault_of_a_part_in_a_million_shows():
    """The comparison with the oracle would notice a press of 10.00001 N instead of 10 N."""
    right, wrong = problem({"time.duration": 0.05}), problem({"time.duration": 0.05, "law.force": 10.00001})
    a, b = slide_oracle(right), slide_closedloop(wrong)
    assert np.max(np.abs(a.contact_force - b.contact_force)) > 1e-6


def test_limit_of_a_polynomial_is_exact():
    """Through k points a polynomial of degree k − 1 is met at zero; one of degree k is not."""
    t = np.linspace(0, 1, 5)

    def at(x, degree):
        zero = np.zeros((5, 1))
        return Trajectory("x", t, zero, zero, 3 + t * x + (t * x) ** degree, zero[:, 0], 0.25, x)

    runs = [at(x, 2) for x in (1.0, 2.0, 4.0)]
    limit = at_zero(runs, [run.softness for run in runs])
    np.testing.assert_allclose(limit.contact_force, 3.0, rtol=1e-14)
    runs = [at(x, 3) for x in (1.0, 2.0, 4.0)]
    assert np.abs(at_zero(runs, [1.0, 2.0, 4.0]).contact_force - 3.0).max() > 1.0


def test_law_is_the_one_of_the_simulator():
    """The law that drives the peers gives the simulator's torques at the simulator's states."""
    of = problem(SHORT | {"time.duration": 0.05})
    from closedloop import simulate

    run = simulate(of.scenario)
    for k in (0, 7, 50):
        terms = of.robot.terms(run.q[k], run.v[k])
        torque = law(of, k, run.q[k], run.v[k], terms.bias, of.plane.normal @ terms.jacobian)
        np.testing.assert_allclose(torque, run.torque[k], rtol=1e-12)


@pytest.mark.parametrize("name", ["mujoco", "oracle"])
def test_semi_implicit_loops_refuse_other_schemes(name):
    """What steps by semi-implicit Euler is not compared with RK4."""
    of = problem({"time.duration": 0.01, "time.integrator": "rk4"})
    if name == "mujoco":
        pytest.importorskip("mujoco", reason=INSTALL["mujoco"])
        from validation.engines.mujoco import slide_mujoco

        with pytest.raises(ValueError, match="semi-implicit"):
            slide_mujoco(of, 0.99)
    else:
        with pytest.raises(ValueError, match="semi-implicit"):
            slide_oracle(of)


def test_mujoco_says_when_the_tip_leaves_the_plane():
    """A push away from the surface is not answered by a contact that pulls: the run stops and says so."""
    pytest.importorskip("mujoco", reason=INSTALL["mujoco"])
    from validation.engines.mujoco import slide_mujoco

    with pytest.raises(RuntimeError, match="left the plane"):
        slide_mujoco(problem({"time.duration": 0.2, "law.force": -10.0}), 0.9999)
