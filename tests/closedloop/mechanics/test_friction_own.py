"""Laws of friction and of restitution of one's own, in a file outside the package: all that a shipped one may do."""

import re
from pathlib import Path

import numpy as np
import pytest
from test_friction_loop import BLOCK

import closedloop as cl
from closedloop.jit.kernel import jit_disabled
from closedloop.mechanics.friction.law import SurfaceFriction
from closedloop.record.report.tables import restitution_cut
from closedloop.scenario.load import parse_scenario

ROOT = Path(__file__).resolve().parents[3]
ENGINES = ("pinocchio", "compiled")
MASS = 2.0  # kg, of pointmass3
OWN = '''
import math

from closedloop.mechanics.impact.single import Restitution
from closedloop.base.sections import Positive, stiffness_in


class Dry(SurfaceFriction, JointFriction):
    """Coulomb's law once more."""

    sticks = "rigid"
    level: NotNegative = Field(0.3, description="coefficient, 1; of a joint, N m")

    @staticmethod
    def slide(x, par, z, c, w):
        for k in range(c.size):
            c[k] = par.level * (x.u[k] / x.speed if x.speed > 1e-12 else x.direction[k])

    @staticmethod
    def stick_limit(par, z):
        return par.level

    @staticmethod
    def kinetic_level(par):
        return par.level


class Bristle(SurfaceFriction, JointFriction):
    """Dahl's law once more, in units of its largest deflection."""

    slip_states = ("bend",)
    level: Positive = Field(0.3, description="coefficient, 1; of a joint, N m")
    reach: Positive = Field(1e-4, description="largest deflection, m (rad)")

    @staticmethod
    def slide(x, par, z, c, w):
        for k in range(c.size):
            c[k] = par.level * z.bend[k]

    @staticmethod
    def rates(x, par, z, stuck, dz):
        for k in range(x.u.size):
            dz.bend[k] = (x.u[k] - x.speed * z.bend[k]) / par.reach

    @staticmethod
    def decay(x, par, z, stuck, rate):
        for k in range(x.u.size):
            rate.bend[k] = x.speed / par.reach

    @staticmethod
    def advance(x, par, z, stuck, h):
        left = math.exp(-x.speed * h / par.reach)
        for k in range(x.u.size):
            z.bend[k] = left * z.bend[k] + (1.0 - left) * x.u[k] / max(x.speed, 1e-300)


class Asperity(SurfaceFriction, JointFriction):
    """Sticks as a spring that has a limit, and slides at that level; remembers how long it stuck."""

    sticks = "spring"
    states, slip_states = ("stuck_for",), ("stretch",)
    level: Positive = Field(0.3, description="coefficient, 1; of a joint, N m")
    stiffness: Annotated[Positive, stiffness_in("1/m")] = Field(1e4, description="per newton, 1/m")

    @staticmethod
    def slide(x, par, z, c, w):
        for k in range(c.size):
            c[k] = par.level * (x.u[k] / x.speed if x.speed > 1e-12 else x.direction[k])

    @staticmethod
    def hold(par, z, c):
        for k in range(c.size):
            c[k] = par.stiffness * z.stretch[k]

    @staticmethod
    def rates(x, par, z, stuck, dz):
        dz.stuck_for = 1.0 if stuck else 0.0
        for k in range(x.u.size):
            dz.stretch[k] = x.u[k] if stuck else 0.0

    @staticmethod
    def advance(x, par, z, stuck, h):
        if stuck:
            z.stuck_for += h
            for k in range(x.u.size):
                z.stretch[k] += h * x.u[k]

    @staticmethod
    def stick(x, par, z):
        z.stuck_for = 0.0
        for k in range(x.direction.size):
            z.stretch[k] = par.level / par.stiffness * x.direction[k]

    @staticmethod
    def stick_limit(par, z):
        return par.level


class Forgetful(SurfaceFriction):
    """Has states, and nothing to say of them."""

    states = ("memory",)

    @staticmethod
    def slide(x, par, z, c, w):
        pass


class Undefined(SurfaceFriction):
    """Asks for what nobody gives."""

    @staticmethod
    def slide(x, par, z, c, w):
        c[0] = x.slip


class OfJointsOnly(JointFriction):
    """Not for a surface."""


class Viscoelastic(Restitution):
    """Falls with the speed of the impact."""

    ratio_of = "velocities"

    @staticmethod
    def coefficient(restitution, speed):
        return restitution / (1.0 + speed)


class Generous(Restitution):
    """Gives more than there was."""

    @staticmethod
    def coefficient(restitution, speed):
        return 1.5
'''
HALF_A_SECOND = {"time.duration": 0.5}
PULLED = {  # what wam_stick_slip does, softly, from rest: the tip sticks at first, and turns by some 160 degrees
    "law.stiffness": 2000.0,
    "law.damping": 40.0,
    "reference": {
        "kind": "circle", "direction": [1, 0.3, 0], "radius": 0.01, "turns": 0.5, "start": 0.0, "stop": 0.3,
    },
    "time": {"duration": 0.3, "step": 1e-3},
}  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a folder with a user's module: the documentation's law, and others."""
    folder = tmp_path_factory.mktemp("users")
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "extending.md").read_text(encoding="utf-8"), re.DOTALL)
    (example,) = [block for block in blocks if "class Drag(" in block]
    (folder / "my_friction.py").write_text(example + OWN, encoding="utf-8")
    return folder


@pytest.fixture(autouse=True)
def mine(folder, monkeypatch):
    """Let the user's module be imported, and return it."""
    monkeypatch.syspath_prepend(str(folder))
    import my_friction

    return my_friction


def block(engine, **overrides):
    """Simulate the point mass on a plane, without a command; `a__b` stands for the key a.b."""
    keys = {key.replace("__", "."): value for key, value in overrides.items()}
    weightless = {"surface.gap": 5.0, "surface.contact": "unilateral"} if "joint_friction" in keys else {}
    return cl.simulate(parse_scenario(BLOCK, overrides=HALF_A_SECOND | weightless | keys), engine=engine)


@pytest.mark.parametrize("engine", ENGINES)
def test_drag_on_the_surface(engine, mine):
    """A block that slides against k v² has the speed v0/(1 + k v0 t/m), whichever way it goes."""
    v0, along = 0.8, np.array([0.6, -0.8, 0.0])
    run = block(engine, friction={"kind": "my_friction:Drag", "drag": 3.0}, start__v=tuple(v0 * along))
    assert type(run.scenario.friction) is mine.Drag
    speed = v0 / (1.0 + 3.0 * v0 * run.time / MASS)
    np.testing.assert_allclose(run.velocity, np.outer(speed, along), atol=1e-10)
    np.testing.assert_allclose(run.friction_force, np.outer(-3.0 * speed**2, along), atol=1e-9)


@pytest.mark.parametrize("engine", ENGINES)
def test_drag_in_the_joints(engine):
    """So has each joint by itself."""
    run = block(engine, joint_friction={"kind": "my_friction:Drag", "drag": 3.0}, start__v=(0.7, -0.4, 0.0))
    for joint, v0 in enumerate((0.7, -0.4, 0.0)):
        wanted = v0 / (1.0 + 3.0 * abs(v0) * run.time / MASS)
        np.testing.assert_allclose(run.v[:, joint], wanted, atol=1e-10)
        np.testing.assert_allclose(run.joint_friction[:, joint], -3.0 * wanted * np.abs(wanted), atol=1e-9)


SAME = {
    "dry": ("Dry", {"level": 0.3}, {"kind": "coulomb", "coefficient": 0.3}),
    "bristle": ("Bristle", {"level": 0.3, "reach": 3e-4}, {"kind": "dahl", "coefficient": 0.3, "stiffness": 1e3}),
    "asperity": (
        "Asperity",
        {"level": 0.3, "stiffness": 1e3},
        {
            "kind": "seven_parameter", "kinetic": 0.3, "static_excess": 0.0, "stribeck_speed": 1.0, "stiffness": 1e3,
            "memory_delay": 0.0, "rise_time": 0.0,
        },
    ),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("integrator", ["semi_implicit_euler", "rk4"])
@pytest.mark.parametrize("where", ["friction", "joint_friction"])
@pytest.mark.parametrize("case", SAME)
def test_a_law_that_is_a_shipped_one_runs_as_that_one(case, where, integrator):
    """Sticking as a constraint, on bristles or on a spring: the same run to rounding, with the same events."""
    name, own, shipped = SAME[case]
    if where == "joint_friction":  # what a surface calls a coefficient is a torque there
        shipped = {("kinetic" if key == "coefficient" else key): value for key, value in shipped.items()}
    changes = PULLED | {"friction": {"kind": "none"}, "time.integrator": integrator}
    runs = [
        cl.simulate(cl.load_scenario("wam_stick_slip", changes | {where: section}), engine="compiled")
        for section in ({"kind": f"my_friction:{name}"} | own, shipped)
    ]
    ours, theirs = runs
    assert np.ptp(theirs.friction_force if where == "friction" else theirs.joint_friction) > 0.1
    for column in ("q", "v", "friction_force", "joint_friction"):
        np.testing.assert_allclose(getattr(ours, column), getattr(theirs, column), atol=1e-8, rtol=0.0)
    assert [event.kind for event in ours.events] == [event.kind for event in theirs.events]


def test_in_a_batch(mine):
    """A batch has the rows of single runs, also where the law itself changes, by its name or its class."""
    kinds = ["none", mine.Dry, "my_friction:Bristle"]
    scenario = cl.load_scenario("wam_stick_slip", PULLED | {"friction": {"kind": "none"}, "time.duration": 0.05})
    table = cl.simulate_batch(scenario, {"friction.kind": kinds}, keep=["q"], workers=1)
    assert table["friction.kind"].to_pylist() == ["none", "my_friction:Dry", "my_friction:Bristle"]
    for kind, kept in zip(kinds, table["q"], strict=True):
        changes = PULLED | {"friction": {"kind": "none"}, "time.duration": 0.05}
        single = cl.simulate(cl.load_scenario("wam_stick_slip", changes | {"friction.kind": kind}), engine="compiled")
        assert np.array_equal(np.ravel(kept.as_py()), single.q.ravel())


def test_a_law_of_control_of_ones_own_beside_it(mine):
    """Friction is there whoever controls the arm."""

    def nothing(t, q, v, terms):
        return np.zeros(q.size)

    changes = HALF_A_SECOND | {"friction.kind": mine.Drag, "start.v": (0.5, 0.0, 0.0)}
    scenario = parse_scenario(BLOCK, overrides=changes)
    run = cl.simulate(scenario, law=nothing)
    np.testing.assert_allclose(run.velocity[:, 0], 0.5 / (1.0 + 0.5 * 0.5 * run.time / MASS), atol=1e-10)


REFUSED = {
    "no rates": (
        {"friction.kind": "my_friction:Forgetful"},
        "friction.kind = my_friction:Forgetful: must define rates",
    ),
    "no force": ({"joint_friction.kind": "my_friction:OfJointsOnly"}, "my_friction:OfJointsOnly: must define slide"),
    "of joints": (
        {"friction.kind": "my_friction:OfJointsOnly"},
        "derived from closedloop.mechanics.friction.law.SurfaceFriction",
    ),
    "a restitution": (
        {"friction.kind": "my_friction:Generous"},
        "derived from closedloop.mechanics.friction.law.SurfaceFrict",
    ),
    "a friction": (
        {"impact.law": "my_friction:Drag"},
        "derived from closedloop.mechanics.impact.single.Restitution",
    ),
    "depends on the step": (
        {"joint_friction.kind": "my_friction:Dry", "time.integrator": "dop853"},
        "joint_friction.kind = 'my_friction:Dry': depends on the step",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_no_law_is_refused_in_one_line(case):
    """The line names the class and what it lacks."""
    changes, words = REFUSED[case]
    with pytest.raises(cl.ScenarioError) as caught:
        cl.prepare(cl.load_scenario("wam_slide", changes))
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("sticks", "lacks"),
    [("elastic", "slide"), ("rigid", "slide, stick_limit"), ("spring", "slide, stick_limit, hold, stick")],
)
def test_what_a_law_must_define(sticks, lacks):
    """By how it sticks, and rates and advance if it has states; what it leaves out is zero: no level, no energy."""
    bare = type("Bare", (SurfaceFriction,), {"sticks": sticks})
    with pytest.raises(cl.ScenarioError, match=f"must define {lacks}$"):
        bare.check_functions("friction.kind")
    stateful = type("Stateful", (SurfaceFriction,), {"sticks": sticks, "states": ("wear",)})
    with pytest.raises(cl.ScenarioError, match=f"must define {lacks.replace('slide', 'slide, rates, advance')}$"):
        stateful.check_functions("friction.kind")
    assert bare.stick_limit(None, None) == bare.kinetic_level(None) == bare.capture_speed(None) == 0.0
    assert bare.lag(None) == bare.stored_energy(None, None, True) == 0.0


@pytest.mark.skipif(jit_disabled(), reason="nothing is compiled")
@pytest.mark.parametrize("compiled", [True, False])
def test_what_numba_cannot_compile_is_one_line(mine, compiled):
    """The line names the class, what is wrong, and the line of the user's file; also of a run interpreted."""
    problem = cl.prepare(cl.load_scenario("wam_slide", {"friction.kind": mine.Undefined}))
    loop = problem.loop()
    with pytest.raises(cl.ScenarioError) as caught:
        problem.connect(loop, compiled=compiled)
    line = str(caught.value)
    said = r"friction.kind = my_friction:Undefined: cannot be compiled: my_friction.py:\d+: x has no 'slip'; it has u, "
    assert re.match(said, line), line
    assert "\n" not in line


@pytest.mark.parametrize("engine", ENGINES)
def test_restitution_that_falls_with_speed(engine, mine):
    """Each bounce has ε/(1 + v) of its speed, which the event says; the report does not say that it was cut."""
    changes = {"impact.law": mine.Viscoelastic, "impact.restitution": 0.8}
    run = cl.simulate(cl.load_scenario("wam_bounce", changes), engine=engine)
    impacts = [event for event in run.events if event.kind == "impact"]
    assert len(impacts) >= 2
    for event in impacts:
        wanted = 0.8 / (1.0 - event.rate_before)
        assert event.rate_after == pytest.approx(-wanted * event.rate_before, rel=1e-9)
        assert event.restitution == pytest.approx(wanted, rel=1e-12)
    assert len({event.rate_before for event in impacts}) >= 2
    assert restitution_cut(run) == ""


def test_restitution_beyond_one_is_refused():
    """A coefficient that no impact has stops the run in one line that names the law; the rows until then are kept."""
    scenario = cl.load_scenario("wam_bounce", {"impact.law": "my_friction:Generous"})
    with pytest.raises(
        cl.LawError, match=r"^stopped at t = .*: impact.law = my_friction:Generous: its coefficient at .* is 1.5: must"
    ) as caught:
        cl.simulate(scenario)
    assert caught.value.run.time[-1] == pytest.approx(caught.value.time, abs=scenario.time.step)
