"""Soft surfaces: motions known in closed form, the limit of a stiff one, and energy."""

import math

import numpy as np
import pytest

import closedloop as cl
from closedloop.mechanics.surface.compliances.hunt_crossley import HuntCrossley
from closedloop.mechanics.surface.surface import COMPLIANCES, Compliance

G, MASS = 9.81, 2.0


def point_mass(**changes):
    """Return the scenario of a point mass of three slides above a soft floor, with nothing that drives it."""
    return cl.load_scenario("wam_slide", {
        "robot.model": "pointmass3", "robot.tip": "tip", "start.q": [0.0, 0.0, 0.0], "start.v": [0.0, 0.0, 0.0],
        "reference": {"kind": "hold"}, "law": {"kind": "paper", "kp": 0.0, "kd": 0.0, "force": 0.0},
        "stabiliser": {"kind": "none"}, "time.integrator": "rk4", "time.duration": 0.5, "time.step": 0.0005,
        "surface.contact": "unilateral", "compliance.kind": "kelvin_voigt",
    } | {key.replace("__", "."): value for key, value in changes.items()})  # fmt: skip


def no_torque(t, q, v, terms):
    """Leave the mass to gravity and the surface."""
    return np.zeros(len(q))


def lift(t, q, v, terms):
    """Carry the weight, and nothing else."""
    return terms.bias


def test_a_mass_settles_on_a_spring():
    """Put down on a damped spring it is a damped oscillator about m g/k, and f is k δ + d δ̇ at every row."""
    k, d = 5e3, 40.0
    scenario = point_mass(compliance__stiffness=k, compliance__damping=d)
    problem = cl.prepare(scenario)
    g = abs(float(problem.robot.gravity[2]))
    run = cl.simulate(scenario, law=no_torque)
    w0, zeta = math.sqrt(k / MASS), d / (2.0 * math.sqrt(k * MASS))
    w, rest, t = w0 * math.sqrt(1 - zeta**2), MASS * g / k, run.time
    depth = rest * (1 - np.exp(-zeta * w0 * t) * (np.cos(w * t) + zeta * w0 / w * np.sin(w * t)))
    assert np.allclose(-run.closure_error, depth, rtol=0, atol=1e-9)
    assert np.allclose(run.contact_force, -k * run.closure_error - d * run.closure_rate, rtol=0, atol=1e-9)
    assert run.contact_force[-1] == pytest.approx(MASS * g, rel=1e-2)
    assert not np.any(run.stabiliser_force)
    assert run.summary()["max_energy_residual"] < 1e-8


def test_the_engines_agree_on_a_spring():
    """Pressed by the paper's law, which both run: the same motion, the same force, from approach to rest."""
    scenario = point_mass(compliance__stiffness=5e3, compliance__damping=40.0, surface__gap=0.001, law__force=MASS * G)
    ours, theirs = (cl.simulate(scenario, engine=engine) for engine in ("compiled", "pinocchio"))
    assert np.ptp(ours.closure_error) > 1e-3
    assert [event.kind for event in ours.events] == [event.kind for event in theirs.events] != []
    for name in ("q", "contact_force"):
        assert np.allclose(getattr(ours, name), getattr(theirs, name), rtol=0, atol=1e-9)


def test_an_undamped_bounce_takes_half_a_period():
    """Without gravity a mass that hits an undamped spring leaves after π √(m/k) with the speed of approach."""
    k, speed, gap = 2e4, 0.2, 0.01
    run = cl.simulate(point_mass(compliance__stiffness=k, compliance__damping=0.0, surface__gap=gap,
                                 start__v=[0.0, 0.0, -speed]), law=lift)  # fmt: skip
    down, off = run.events
    assert (down.kind, off.kind) == ("touchdown", "liftoff")
    assert down.time == pytest.approx(gap / speed, abs=1e-10)
    assert off.time - down.time == pytest.approx(math.pi * math.sqrt(MASS / k), rel=1e-6)
    assert off.rate_after == pytest.approx(speed, rel=1e-6)
    assert (down.compression, down.energy_lost, off.energy_lost) == (0.0, 0.0, 0.0)
    deepest = np.max(-run.closure_error)
    assert deepest == pytest.approx(speed * math.sqrt(MASS / k), rel=1e-3)
    assert np.all(run.contact_force >= 0.0)


def test_restitution_of_hunt_and_crossley():
    """Of small dissipation it is 1 − (2/3) λ v, to second order in λ v."""
    dissipation, speed = 0.3, 0.1
    missing = []
    for factor in (1.0, 0.5):
        run = cl.simulate(point_mass(
            compliance={"kind": "hunt_crossley", "stiffness": 1e6, "dissipation": factor * dissipation},
            surface__gap=0.002, start__v=[0.0, 0.0, -speed], time__duration=0.1, time__step=0.0002,
        ), law=lift)  # fmt: skip
        off = next(event for event in run.events if event.kind == "liftoff")
        missing.append(abs(off.rate_after / speed - (1 - 2 / 3 * factor * dissipation * speed)))
    assert missing[0] < 1e-3
    assert missing[0] / missing[1] > 3.5


def test_a_stiff_surface_is_the_rigid_one():
    """The force of the paper's slide approaches the multiplier of Eq. 24 in proportion to 1/k."""
    base = {"time.duration": 1.5, "time.integrator": "rk4", "reference.timing": "minimum_jerk"}
    rigid = cl.simulate(cl.load_scenario("wam_slide", base))
    off = []
    for k in (1e4, 1e5):
        soft = {"compliance.kind": "kelvin_voigt", "compliance.stiffness": k, "compliance.damping": 2.0 * math.sqrt(k)}
        run = cl.simulate(cl.load_scenario("wam_slide", base | soft | {"time.step": 0.0005}))
        assert run.contact_force[0] == pytest.approx(10.0, abs=1e-9)  # placed where the surface carries it
        off.append(np.max(np.abs(run.contact_force[::2] - rigid.contact_force)))
        assert run.summary()["verdict"]["good"]
    assert off[1] < 0.02
    assert off[0] / off[1] == pytest.approx(10.0, rel=0.25)


def test_it_sticks_and_slips_on_a_soft_surface():
    """With Coulomb's friction a mass pressed into a soft floor holds up to μ f, and slides with μ f."""
    mu = 0.3

    def push(t, q, v, terms):
        return np.array([40.0 * t, 0.0, 0.0])

    run = cl.simulate(point_mass(
        compliance__stiffness=1e4, compliance__damping=100.0, friction={"kind": "coulomb", "coefficient": mu},
        start__q=[0.0, 0.0, 0.0], law__force=MASS * G, time__duration=0.4,
    ), law=push)  # fmt: skip
    slip = next(event for event in run.events if event.kind == "slip")
    force = np.interp(slip.time, run.time, run.contact_force)
    assert slip.time == pytest.approx(mu * force / 40.0, rel=1e-3)
    stuck = run.mode == 2
    assert np.max(np.abs(run.position[stuck] - run.position[0])[:, :2]) < 1e-9
    slides = (run.mode == 1) & (run.time > slip.time + 0.001)
    size = np.linalg.norm(run.friction_force, axis=1)
    assert np.allclose(size[slides], mu * run.contact_force[slides], rtol=0, atol=1e-9)
    assert np.max(run.velocity[slides, 0]) > 0.1
    assert run.summary()["max_energy_residual"] < 1e-6


def test_friction_is_against_the_slip_where_a_soft_surface_pulls():
    """A mass lifted off a bilateral spring is pulled down by it, and braked by μ|f|."""
    mu, pull = 0.3, 5.0

    def lifted(t, q, v, terms):
        return terms.bias + np.array([0.0, 0.0, pull])

    run = cl.simulate(point_mass(
        surface__contact="bilateral", compliance__stiffness=1e4, compliance__damping=200.0,
        friction={"kind": "coulomb", "coefficient": mu}, start__v=[0.3, 0.0, 0.0], time__duration=0.3,
    ), law=lifted)  # fmt: skip
    pulls = run.contact_force < -0.5 * pull
    assert run.contact_force[-1] == pytest.approx(-pull, abs=1e-3)
    assert np.allclose(run.friction_force[pulls, 0], mu * run.contact_force[pulls], rtol=0, atol=1e-9)
    assert run.velocity[-1, 0] < 0.3 - 0.9 * mu * pull / MASS * 0.3
    assert run.summary()["max_energy_residual"] < 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["kelvin_voigt", "hunt_crossley"])
@pytest.mark.parametrize("integrator", ["semi_implicit_euler", "rk4", "dop853"])
def test_an_arm_comes_down_on_a_soft_ball(kind, integrator):
    """Approach, touchdown, press and slide on a ball that breathes; the force is that of the depth, the energy held."""
    changes = {
        "surface.kind": "sphere", "surface.radius": 0.25, "surface.contact": "unilateral", "surface.gap": 0.005,
        "surface_motion.kind": "breathing", "surface_motion.amplitude": 0.004, "law.kind": "hybrid",
        "time.duration": 1.0, "law.kp": 400.0, "law.kd": 40.0, "compliance.kind": kind,
        "time.integrator": integrator, "time.step": 0.0005, "reference.timing": "minimum_jerk",
    }  # fmt: skip
    run = cl.simulate(cl.load_scenario("wam_slide", changes))
    section = run.scenario.compliance
    par = section.model_copy()
    held = run.mode != 0
    wanted = [max(0.0, section.force(-e, -r, par)) for e, r in zip(run.closure_error, run.closure_rate, strict=True)]
    assert np.allclose(run.contact_force[held], np.array(wanted)[held], rtol=0, atol=1e-9)
    assert not np.any(run.contact_force[~held])
    assert run.contact_force[-1] == pytest.approx(10.0, abs=0.5)
    assert run.summary()["verdict"]["good"], run.summary()["verdict"]


class Foam(Compliance):
    """Stiffens with depth: f = k δ (1 + δ/a)."""

    stiffness: float = 2e3
    depth: float = 0.004

    def static_depth(self, force):
        """Return the root of k δ (1 + δ/a) = f."""
        a = self.depth
        return 0.5 * a * (math.sqrt(1 + 4 * force / (self.stiffness * a)) - 1)

    def tangent(self, depth):
        """Return k (1 + 2 δ/a), and no damping."""
        return self.stiffness * (1 + 2 * depth / self.depth), 0.0

    @staticmethod
    def force(depth, speed, par):
        """Return k δ (1 + δ/a)."""
        return par.stiffness * depth * (1.0 + depth / par.depth)


def test_a_compliance_of_ones_own():
    """A class of one's own joins by its name; the tip starts at the depth that carries law.force."""
    run = cl.simulate(cl.load_scenario("wam_slide", {"compliance.kind": Foam, "time.duration": 0.4}))
    assert np.allclose(run.contact_force, 10.0, rtol=0, atol=1e-8)
    assert -run.closure_error[0] == pytest.approx(Foam().static_depth(10.0), rel=1e-12)


def test_what_is_too_stiff_is_refused_with_the_step_that_would_do():
    """In one line; and the step that it names does."""
    stiff = {"compliance.kind": "kelvin_voigt", "compliance.stiffness": 1e8, "compliance.damping": 0.0}
    with pytest.raises(cl.ScenarioError, match="the step may be at most ") as caught:
        cl.prepare(cl.load_scenario("wam_slide", stiff))
    step = float(str(caught.value).split("at most ")[1].split(" s")[0])
    step = 10.0 ** math.floor(math.log10(step))
    cl.prepare(cl.load_scenario("wam_slide", stiff | {"time.step": step, "time.duration": 100 * step}))
    with pytest.raises(cl.ScenarioError, match=r"compliance.stiffness = -1.0: must be greater than 0"):
        cl.load_scenario("wam_slide", stiff | {"compliance.stiffness": -1.0})
    assert COMPLIANCES["none"]().tangent(0.0) == (0.0, 0.0)


@pytest.mark.parametrize(
    "law", [{"kind": "kelvin_voigt", "damping": 0.0}, {"kind": "hunt_crossley", "dissipation": 0.0}]
)
def test_the_spring_at_an_edge_is_booked(law):
    """A mass slides over the edge of an undamped surface: its energy and the spring's are constant, but the event's."""
    k = 5e3 if law["kind"] == "kelvin_voigt" else 2e5
    scenario = point_mass(
        compliance=law | {"stiffness": k}, start__v=[0.47, 0.0, 0.0], surface__extent=[0.05, 1.0], time__duration=0.15
    )
    run = cl.simulate(scenario, law=no_torque)
    (edge,) = [event for event in run.events if event.kind == "edge"]
    energy = run.kinetic_energy + run.potential_energy
    n = 1.0 if law["kind"] == "kelvin_voigt" else 1.5
    deep = np.where(run.mode != 0, np.maximum(-run.closure_error, 0.0), 0.0)
    stored = k * deep ** (n + 1.0) / (n + 1.0)
    assert edge.energy_lost > 0.005
    total = energy + stored + np.where(run.time > edge.time, edge.energy_lost, 0.0)
    np.testing.assert_allclose(total, total[0], atol=1e-7)
    assert np.ptp(run.energy_supplied - energy) < 1e-7  # and the arm's own books close as before


@pytest.mark.parametrize(("exponent", "dissipation"), [(1.5, 0.8), (1.0, 0.0), (2.2, 3.0)])
def test_hunt_and_crossley_by_its_own_differences(exponent, dissipation):
    """The tangent is that of the force, and where a bilateral surface pulls the force is the mirrored one."""
    law = HuntCrossley(stiffness=3e5, exponent=exponent, dissipation=dissipation)
    depth, step = 2e-3, 1e-6
    stiffness, damping = law.tangent(depth)
    along = (HuntCrossley.force(depth + step, 0.0, law) - HuntCrossley.force(depth - step, 0.0, law)) / (2.0 * step)
    assert stiffness == pytest.approx(along, rel=1e-6)
    rate = HuntCrossley.force(depth, 0.5, law) - HuntCrossley.force(depth, -0.5, law)
    assert damping == pytest.approx(rate, rel=1e-12)
    for speed in (0.0, 0.1, -0.2):
        assert HuntCrossley.force(-depth, -speed, law) == -HuntCrossley.force(depth, speed, law)
