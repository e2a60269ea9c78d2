"""What engines promise beside their numbers: nothing in silence, and a probe that notices a constraint that is off."""

import importlib.util

import numpy as np
import pytest

import robot_models
from validation.engines import ENGINES, METHODS, CannotBuild, Engine, Missing, NotCovered, Refused, available, probe
from validation.engines.hand_written import HandWritten
from validation.engines.interface import installed

WITH_CONSTRAINT = [engine for engine in ENGINES if "constrained" in engine.covers]
MJCF = """<mujoco><compiler angle="radian"/><option gravity="1 2 -9"/><worldbody>
 <body name="a" pos="0 0 .3" euler=".1 .2 .3"><inertial pos=".1 0 .2" mass="2" fullinertia=".1 .2 .15 .01 .02 .03"/>
  <joint name="j1" axis="0 0 1" armature=".2"/>
  <body name="b" pos=".4 0 0" euler=".3 0 .1"><inertial pos=".2 0 0" mass="1" diaginertia=".01 .02 .02"/>
   <joint name="held" axis="0 1 0" pos=".1 .05 0"/>
   <body name="c" pos=".3 .1 0"><inertial pos=".1 0 0" mass=".5" diaginertia=".01 .01 .01"/>
    <joint name="slide" type="slide" axis="1 1 0"/>
    <body name="d" pos=".2 0 0"><inertial pos=".1 0 .1" mass=".7" diaginertia=".01 .02 .01"/>
     <joint name="j4" axis="1 0 1"/><site name="point" pos=".1 .2 .3"/></body></body></body></body>
</worldbody></mujoco>"""


@pytest.fixture(scope="module")
def wam():
    """Return the arm of the paper."""
    return robot_models.load("wam4")


def make(engine, robot, tip=None):
    """Return the engine, or skip with the line that installs it."""
    if not installed(engine):
        pytest.skip(f"{engine.name} is not installed: {engine.install}")
    return engine(robot, robot.tip if tip is None else tip)


@pytest.mark.parametrize("engine", ENGINES, ids=lambda e: e.name)
def test_says_what_it_can_and_cannot_do(engine):
    """Each method is covered or refused with a reason, and the docstring is the map of conventions."""
    assert engine.covers | set(engine.cannot) == set(METHODS)
    assert all(len(reason) > 20 for reason in engine.cannot.values())
    assert engine.install or engine.package is None
    words = engine.__doc__.lower()
    for word in ("joint order", "armature", "gravity", "accuracy", "frames"):
        assert word in words, word
    assert "sign" in words or "constrained" in engine.cannot


@pytest.mark.parametrize("engine", ENGINES, ids=lambda e: e.name)
def test_refuses_by_name_what_it_does_not_cover(engine, wam):
    """Asking for what is not covered is an error that gives the reason."""
    made, x = make(engine, wam), np.zeros(4)
    arguments = {
        "drift": (x, x),
        "stabilised": (x, x, np.ones(3), 0.0, np.ones(2)),
        "constrained": (x, x, x, np.ones(3), 0.0),
        "impulse": (x, x, np.ones(3), 0.5),
    }
    for method, reason in engine.cannot.items():
        with pytest.raises(NotCovered, match=method) as caught:
            getattr(made, method)(*arguments[method])
        assert reason in str(caught.value)


def test_no_class_may_leave_a_method_out():
    """A subclass that neither covers nor refuses a method, or covers it without defining it, is not made."""
    with pytest.raises(TypeError, match="share out"):
        type("Half", (Engine,), {"name": "half", "covers": frozenset({"bias"})})
    with pytest.raises(TypeError, match="does not define"):
        type("Empty", (Engine,), {"name": "empty", "covers": frozenset(METHODS)})


def test_not_installed_is_said_with_the_install_line(wam, monkeypatch):
    """A peer whose package is absent stands in the list as missing, never as an engine."""
    find = importlib.util.find_spec
    absent = {"mujoco", "pydrake", "exudyn", "roboticstoolbox", "sympy"}
    monkeypatch.setattr("validation.engines.interface.find_spec", lambda name: None if name in absent else find(name))
    made = available(wam, "tip")
    assert [type(engine) for engine in made].count(Missing) == 5
    assert 'pip install "mujoco>=3.17,!=4.0.0"' in " ".join(map(str, made))
    assert len(made) == len(ENGINES)


def test_a_package_that_breaks_on_import_is_an_error(wam):
    """Only absence is reported as absence; an engine's own bug must surface."""

    class Broken(HandWritten):
        name = "broken"
        package = "json"

        def __init__(self, robot, tip):
            import json.no_such_part  # noqa: F401

    with pytest.raises(ImportError):
        available(wam, "tip", [Broken])


def test_refuses_the_wrong_mujoco(wam, monkeypatch):
    """MuJoCo 4.0.0 solves wrongly and is named as the reason."""
    mujoco = pytest.importorskip("mujoco", reason='pip install "mujoco>=3.17,!=4.0.0"')
    monkeypatch.setattr(mujoco, "__version__", "4.0.0")
    (made,) = available(wam, "tip", [e for e in ENGINES if e.name == "mujoco"])
    assert isinstance(made, Refused)
    assert "4.0.0" in made.reason


@pytest.mark.parametrize("engine", ENGINES, ids=lambda e: e.name)
def test_unknown_tip(engine, wam):
    """A tip that is not there is refused by name."""
    with pytest.raises((CannotBuild, KeyError, robot_models.ModelError), match="nose"):
        make(engine, wam, "nose")


@pytest.mark.parametrize("engine", [e for e in ENGINES if e.name not in ("oracle", "symbolic")], ids=lambda e: e.name)
def test_does_not_let_nan_in(engine, wam):
    """Pinocchio would return a number, MuJoCo would reset the state: the adapters refuse."""
    q = np.array([0.1, np.nan, 0.2, 0.3])
    with pytest.raises(ValueError, match="finite"):
        make(engine, wam).mass_matrix(q)


@pytest.mark.parametrize("engine", WITH_CONSTRAINT, ids=lambda e: e.name)
def test_probe_sees_a_constraint_that_is_off(engine, wam):
    """The same engine with its constraint silently ignored fails its probe."""

    class Off(engine):
        def constrained(self, q, v, torque, normal, b):
            return self.free_acceleration(q, v, torque), 0.0

    result = probe(make(Off, wam))
    assert not result.passed
    assert result.force == pytest.approx(1.0)
    assert result.closure == pytest.approx(result.escape)


@pytest.mark.parametrize("engine", WITH_CONSTRAINT, ids=lambda e: e.name)
@pytest.mark.parametrize(
    ("fault", "shown_by"),
    [
        (lambda a, f: (a, -f), "force"),
        (lambda a, f: (a, float("nan")), "force"),
        (lambda a, f: (a * (1 + 1e-6), f), "closure"),
        (lambda a, f: (a, f * (1 + 1e-6)), "force"),
    ],
    ids=["sign of f", "NaN", "closure by 1 ppm", "force by 1 ppm"],
)
def test_probe_sees_a_wrong_answer(engine, wam, fault, shown_by):
    """A wrong sign, no number, or a part in a million is enough to fail."""

    class Faulty(engine):
        def constrained(self, q, v, torque, normal, b):
            return fault(*super().constrained(q, v, torque, normal, b))

    result = probe(make(Faulty, wam))
    assert not result.passed
    assert getattr(result, shown_by) > 1e-8


@pytest.mark.parametrize("engine", ENGINES, ids=lambda e: e.name)
def test_armature_counts_and_only_on_the_diagonal(engine, wam):
    """Without the drives H is smaller by the armature; with a wrong one it differs by as much."""
    q = np.array([0.3, 0.7, -0.4, 1.2])
    with_drives = make(engine, wam).mass_matrix(q)
    without = make(engine, robot_models.load("wam4", drive_inertia=False)).mass_matrix(q)
    np.testing.assert_allclose(with_drives - without, np.diag(wam.armature), atol=1e-14)


def test_mujoco_needs_its_extrapolation(wam):
    """At its hardest MuJoCo is a soft engine, off by 1e-4; a third softness lies on the curve of the other two."""
    pytest.importorskip("mujoco", reason='pip install "mujoco>=3.17,!=4.0.0"')
    from validation.engines.mujoco import MuJoCo

    hardest = 0.9999

    class Soft(MuJoCo):
        def constrained(self, q, v, torque, normal, b):
            a, f, _ = self.softly(q, v, torque, normal, b, hardest)
            return a, f

    result = probe(Soft(wam, "tip"))
    assert not result.passed
    assert 1e-5 < result.force < 1e-3

    made, x = MuJoCo(wam, "tip"), np.array([0.3, 0.7, -0.4, 1.2])
    state = x, x, 10 * x, np.array([0.0, 0.6, 0.8]), 1.5
    _, f = made.constrained(*state)
    for impedance in (0.3, 0.9, 0.99):
        a_soft, f_soft, R = made.softly(*state, impedance)
        A = state[3] @ made.jacobian(x)
        assert A @ a_soft + R * f_soft == pytest.approx(1.5, rel=1e-10)
        s = R * f_soft / (f - f_soft)
        assert s == pytest.approx(A @ np.linalg.solve(made.mass_matrix(x), A), rel=1e-9)
    free, nothing, _ = made.softly(*state, hardest, held=False)
    assert nothing == 0.0
    np.testing.assert_allclose(free, made.free_acceleration(x, x, 10 * x), rtol=1e-13)


@pytest.mark.parametrize("engine", WITH_CONSTRAINT, ids=lambda e: e.name)
def test_singular_pose_is_not_answered_with_numbers(engine):
    """Nothing moves the tip of a planar arm out of its plane: A = 0, and no engine may make up a force."""
    planar, x = robot_models.load("planar2"), np.array([0.6, -1.4])
    made = make(engine, planar)
    try:
        a, f = made.constrained(x, x, x, np.array([0.0, 1.0, 0.0]), 1.0)
    except (np.linalg.LinAlgError, ZeroDivisionError, FloatingPointError):
        a, f = np.full(planar.n, np.nan), np.nan
    assert not (np.all(np.isfinite(a)) and np.isfinite(f) and abs(f) < 1e6)


def test_mjcf_with_a_locked_joint_and_a_site():
    """Engines that read MJCF agree on it: locked joint off the body's origin, tilted gravity, tip a site."""
    pytest.importorskip("mujoco", reason='pip install "mujoco>=3.17,!=4.0.0"')
    robot = robot_models.from_text(
        MJCF, "mjcf", name="arm", armature=[0.2, 0.1, 0.0], tip="point", home=np.zeros(3), locked={"held": 0.7}
    )
    made = [engine for engine in available(robot, "point") if not isinstance(engine, (Missing, Refused))]
    assert {engine.name for engine in made} == {"closedloop", "compiled", "pinocchio", "mujoco", "drake"}
    refused = [engine for engine in available(robot, "point") if isinstance(engine, Refused)]
    assert len(made) + len(refused) == len(ENGINES)
    assert all("URDF" in engine.reason for engine in refused)
    q, v, torque = np.array([[0.3, -0.2, 0.9], [1.0, -0.5, 0.4], [3.0, 2.0, -1.0]])
    first = made[0]
    for other in made[1:]:
        np.testing.assert_allclose(other.mass_matrix(q), first.mass_matrix(q), atol=1e-13)
        np.testing.assert_allclose(other.bias(q, v), first.bias(q, v), atol=1e-12)
        np.testing.assert_allclose(other.position(q), first.position(q), atol=1e-14)
        np.testing.assert_allclose(other.drift(q, v), first.drift(q, v), atol=1e-13)
        if "constrained" in other.covers:
            a, f = (engine.constrained(q, v, torque, np.array([0.0, 0.6, 0.8]), 0.3) for engine in (other, first))
            np.testing.assert_allclose(a[0], f[0], rtol=1e-10)
            assert a[1] == pytest.approx(f[1], rel=1e-10)
