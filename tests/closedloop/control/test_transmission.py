"""Elastic joints: closed forms, the rigid limit, the balance of energy, and what the controller sees of them."""

import numpy as np
import pytest
from rounding import within
from scipy.linalg import expm
from scipy.optimize import brentq, fsolve

import closedloop as cl
from closedloop.jit.interpreted import interpreted
from closedloop.loop.step.entries import lead_motors, motor_rates, transmit
from closedloop.loop.step.memory import make_loop

# A mass of 2 kg on three slides, held to a plane: in x and y nothing acts on it but its motors.
M, B, K, Q = 2.0, 0.5, 300.0, 3.0
SLIDER = {
    "robot.model": "pointmass3", "start.q": [0, 0, 0], "start.v": [0, 0, 0], "surface.contact": "bilateral",
    "time.integrator": "rk4", "time.step": 0.001, "time.duration": 0.5,
    "transmission.stiffness": [K, K, 1e4], "transmission.motor_inertia": B, "surface.gap": 0.0,
}  # fmt: skip
MOVING = {"time.duration": 0.3, "law.pd_start": 0.0, "reference.start": 0.0, "reference.speed": 0.05,
          "reference.stop": 0.4, "law.sample_period": 0.001, "time.step": 0.0005,
          "stabiliser.time_constant": 0.0005}  # fmt: skip
ELASTIC = {"transmission.stiffness": [4e3, 4e3, 3e3, 3e3], "transmission.damping": 30.0}


def pushed(x):
    """Push the motor of the first slide with a constant force, and hold the weight."""
    torque = x.C.copy()
    torque[0] += Q
    return torque


def slider(changes, law=pushed, **options):
    """Return a run of the mass on its slides."""
    return cl.simulate(cl.load_scenario("planar2_drop", SLIDER | changes), law=law, **options)


def test_spring_damper_and_motor_are_their_formulas():
    """What is passed on, how motors accelerate, one that is no drive stays, and angles advance with the new rates."""
    random, states, (_, constants, w) = np.random.default_rng(0), 2, make_loop(3, extra=8)
    gears = constants.gears
    for part in (w.q, w.v, w.z, w.torque, gears.stiffness, gears.damping, gears.motor_inertia):
        part[:] = random.uniform(0.5, 2.0, part.size)
    gears.motor_inertia[1] = 0.0
    w.dz[:] = 7.0
    angle, rate = w.z[states : states + 3].copy(), w.z[states + 3 :].copy()
    interpreted(transmit)(w, constants)
    passed = gears.stiffness * (angle - w.q) + gears.damping * (rate - w.v)
    assert w.drives.transmitted == pytest.approx(passed, rel=1e-14)
    interpreted(motor_rates)(w, constants)
    inertia = np.array([gears.motor_inertia[0], np.inf, gears.motor_inertia[2]])
    acceleration = (w.torque - passed) / inertia
    assert w.dz == pytest.approx([7.0, 7.0, *rate, *acceleration], rel=1e-13)
    for substep, share in ((False, 1.0), (True, 0.5)):
        interpreted(lead_motors)(w, 0.1, substep)
        assert w.dz == pytest.approx([7.0, 7.0, *(rate + share * 0.1 * acceleration), *acceleration], rel=1e-13)


def test_a_motor_and_a_mass_swing_as_two_masses_do():
    """δ = θ − q swings as Q/(B ω²) (1 − cos ωt), ω² = k (1/B + 1/M), and the centre of mass falls as Q t²/2(M + B)."""
    run = slider({})
    rate = np.sqrt(K * (1 / B + 1 / M))
    swing = Q / (B * rate**2) * (1 - np.cos(rate * run.time))
    assert np.max(np.abs(run.motor_position[:, 0] - run.q[:, 0] - swing)) < 1e-9
    centre = (B * run.motor_position[:, 0] + M * run.q[:, 0]) / (M + B)
    assert within(512, centre, Q * run.time**2 / (2 * (M + B)))
    assert np.allclose(run.transmitted_torque[:, 0], K * (run.motor_position - run.q)[:, 0], rtol=0, atol=1e-10)
    assert np.max(np.abs(run.motor_position[:, 1])) < 1e-15  # nothing is released that nothing acts on


PLAY = 0.004


def backlash_exactly(t):
    """Return δ = θ − q under a constant push from rest in the middle of the play: parabolas and swings, in turn.

    In the play δ̈ = a, between its ends and b; behind it x = δ − b swings about a/ω² with the speed that it came with.
    """
    b, a, rate = 0.5 * PLAY, Q / B, np.sqrt(K * (1 / B + 1 / M))
    fall, speed = np.sqrt(2 * b / a), np.sqrt(2 * a * b)
    swing = 2 * (np.pi - np.arctan(speed * rate / a)) / rate
    s = np.mod(t, 2 * fall + swing)
    x = a / rate**2 * (1 - np.cos(rate * (s - fall))) + speed / rate * np.sin(rate * (s - fall))
    back = 2 * fall + swing - s
    return np.where(s < fall, 0.5 * a * s**2, np.where(s < fall + swing, b + x, 0.5 * a * back**2))


def test_backlash_is_a_dead_zone_of_the_spring():
    """A pushed motor falls through its play, swings against the mass, and falls back: exactly known, piece by piece.

    The error falls as h² over the ends of the play, where a scheme of order 4 has a kink within its step.
    """
    off = []
    for h in (0.001, 0.00025):
        run = slider({"transmission.backlash": [PLAY, 0.0, 0.0], "time.step": h, "time.duration": 1.0})
        delta = run.motor_position[:, 0] - run.q[:, 0]
        off.append(np.max(np.abs(delta - backlash_exactly(run.time))))
        passed = K * np.sign(delta) * np.maximum(np.abs(delta) - 0.5 * PLAY, 0.0)
        assert np.allclose(run.transmitted_torque[:, 0], passed, rtol=0, atol=1e-12)
        centre = (B * run.motor_position[:, 0] + M * run.q[:, 0]) / (M + B)
        assert np.allclose(centre, Q * run.time**2 / (2 * (M + B)), rtol=0, atol=1e-12)
    assert off[1] < 2e-6
    assert off[0] > 6.0 * off[1]


@pytest.mark.parametrize("engine", ["pinocchio", "compiled"])
def test_backlash_starts_on_the_side_that_it_pushes_and_does_not_pull(engine):
    """A joint under load lies on its side of the play; damped teeth push or are apart, on the arm too."""
    play = {"transmission.backlash": 0.01} | ELASTIC
    run = cl.simulate(cl.load_scenario("wam_slide", MOVING | play), engine=engine)
    wound = run.motor_position - run.q
    held = np.abs(run.transmitted_torque[0]) > 1e-3
    assert held.sum() >= 2
    expected = run.transmitted_torque[0] / np.array(ELASTIC["transmission.stiffness"])
    assert np.allclose(wound[0, held], (expected + 0.005 * np.sign(expected))[held], rtol=0, atol=1e-12)
    assert np.min(run.transmitted_torque * np.sign(wound)) >= 0.0
    apart = np.abs(wound) <= 0.005
    assert np.any(apart)
    assert not np.any(run.transmitted_torque[apart])


@pytest.mark.parametrize("elastic", [False, True])
def test_friction_that_grows_with_the_load(elastic):
    """A driven link gets Q (1 − μ) − c, one that drives back is braked by Q (1 + μ) + c, and one at rest is held."""
    mu, c, speed = 0.2, 0.3, 0.4
    rigid = {key: value for key, value in SLIDER.items() if not key.startswith("transmission")}
    rough = {"joint_friction": {"kind": "coulomb", "kinetic": c}, "transmission.load_friction": mu,
             "robot.drive_inertia": False, "start.v": [speed, -speed, 0.0]}  # fmt: skip
    stiff = {"transmission.stiffness": 1e6, "transmission.motor_inertia": 1e-3, "transmission.damping": 30.0,
             "time.step": 1e-5, "time.duration": 0.02} if elastic else {"time.duration": 0.1}  # fmt: skip

    def law(x):
        torque = x.C.copy()
        torque[:2] += Q
        return torque

    run = cl.simulate(cl.load_scenario("planar2_drop", rigid | rough | stiff), law=law)
    mass = M + (1e-3 if elastic else 0.0)
    gained = (run.v[-1, :2] - run.v[0, :2]) / run.time[-1]
    expected = np.array([Q * (1 - mu) - c, Q * (1 + mu) + c]) / mass
    assert np.allclose(gained, expected, rtol=5e-3 if elastic else 1e-9, atol=0)


def test_a_gear_at_rest_holds_what_its_friction_can():
    """With a push below c/(1 − μ) nothing moves; just above it does."""
    mu, c = 0.2, 2.0
    rigid = {key: value for key, value in SLIDER.items() if not key.startswith("transmission")}
    rough = {"joint_friction": {"kind": "coulomb", "kinetic": c}, "transmission.load_friction": mu,
             "robot.drive_inertia": False, "time.duration": 0.05}  # fmt: skip
    for share in (0.99, 1.01):

        def law(x, push=share * c / (1.0 - mu)):
            torque = x.C.copy()
            torque[0] += push
            return torque

        run = cl.simulate(cl.load_scenario("planar2_drop", rigid | rough), law=law)
        assert (abs(run.v[-1, 0]) > 1e-6) == (share > 1.0)


@pytest.mark.parametrize(("integrator", "order"), [("semi_implicit_euler", 1), ("rk4", 4)])
def test_the_motors_are_integrated_with_the_schemes_order(integrator, order):
    """The error of a damped swing falls with h to the order of the scheme."""
    ends = []
    for h in (0.004, 0.002, 0.0005):
        changes = {"time.integrator": integrator, "time.step": h, "stabiliser.kind": "projection"}
        ends.append(slider(changes | {"transmission.damping": 2.0, "time.duration": 0.2}).motor_position[-1, 0])
    coarse, fine = abs(ends[0] - ends[2]), abs(ends[1] - ends[2])
    share = (0.5 - 0.125) / (1 - 0.125) if order == 1 else 0.5**4
    assert fine / coarse == pytest.approx(share, rel=0.15)


@pytest.mark.parametrize("integrator", ["rk4", "dop853"])
def test_energy_is_that_of_links_motors_and_springs(integrator):
    """What the motors give, less what the dampers take, is kept; and the report's balance of the links closes."""
    changes = MOVING | ELASTIC | {"time.integrator": integrator, "law.sample_period": 0.0}
    run = cl.simulate(cl.load_scenario("wam_slide", {k: v for k, v in changes.items() if v != 0.0 or "law.s" not in k}))
    inertia, stiffness = run.model.armature, np.array(ELASTIC["transmission.stiffness"])
    bend, rate = run.motor_position - run.q, run.motor_velocity - run.v
    kept = (
        run.kinetic_energy + run.potential_energy + 0.5 * (inertia * run.motor_velocity**2 + stiffness * bend**2).sum(1)
    )
    power = (run.torque * run.motor_velocity - ELASTIC["transmission.damping"] * rate**2).sum(1)
    given = np.concatenate([[0.0], np.cumsum(0.5 * (power[1:] + power[:-1]) * np.diff(run.time))])
    assert np.max(np.abs(kept - kept[0] - given)) < 1e-3 * np.sum(np.abs(power)) * run.scenario.time.step + 1e-7
    assert run.summary()["max_energy_residual"] < 1e-6
    assert np.max(run.residual_motion) < 1e-12


def test_stiff_joints_go_to_rigid_ones_as_one_over_k():
    """With the motors' inertia as that of the drives; four times the stiffness is a quarter of the difference."""
    rigid = cl.simulate(cl.load_scenario("wam_slide", MOVING))
    errors = []
    for k in (8e3, 3.2e4):
        elastic = {"transmission.stiffness": k, "transmission.damping": 30.0, "transmission.measured": "motor"}
        run = cl.simulate(cl.load_scenario("wam_slide", MOVING | elastic))
        errors.append(np.max(np.abs(run.q[-1] - rigid.q[-1])))
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.05)
    assert errors[1] < 2e-4


@pytest.mark.parametrize("side", ["link", "motor"])
def test_the_controller_sees_its_side_and_rigid_joints(side):
    """q is that of the side it measures, H has the motors in it, and the link starts at rest, held by its spring."""
    seen = []

    def spy(x):
        seen.append((x.q.copy(), x.v.copy(), x.H.copy()))
        return x.C - 10.0 * x.A[0]

    changes = ELASTIC | {"time.duration": 0.02, "transmission.measured": side, "transmission.damping": 3.0}
    run = cl.simulate(cl.load_scenario("wam_slide", changes), law=spy)
    assert np.array_equal([each[0] for each in seen], run.q if side == "link" else run.motor_position)
    assert np.array_equal([each[1] for each in seen], run.v if side == "link" else run.motor_velocity)
    rigid = cl.prepare(cl.load_scenario("wam_slide")).robot
    for q, v, H in seen:
        assert within(64, H, rigid.terms(q, v).mass_matrix)
    if side == "link":
        assert np.max(np.abs(run.contact_force - 10.0)) < 1e-9


def test_engines_file_simulator_and_batch_agree(tmp_path):
    """The engines to rounding, the rest to the bit, with all of a real arm at once."""
    changes = MOVING | ELASTIC | {"transmission.measured": "motor", "encoder.quantisation": 1e-6, "time.duration": 0.05,
                                  "drives.torque_limit": 20.0, "model_error.masses": 1.1}  # fmt: skip
    run, other = (cl.simulate(cl.load_scenario("wam_slide", changes), engine=e) for e in ("pinocchio", "compiled"))
    assert np.allclose(run.motor_position, other.motor_position, rtol=0, atol=1e-9)
    loaded = cl.load_run(run.save(tmp_path / "run.nc"))
    again = cl.simulate(loaded.scenario, model=loaded.model)
    assert np.array_equal(again.motor_position, run.motor_position)
    assert np.array_equal(loaded.transmitted_torque, run.transmitted_torque)
    sim = cl.Simulator(run.scenario)
    sim.run_until(0.05)
    assert np.array_equal(sim.run().contact_force, run.contact_force)
    table = cl.simulate_batch(run.scenario, {"law.force": [10.0]}, engine="pinocchio", keep=["motor_position"])
    assert np.array_equal(table["motor_position"].to_pylist()[0], run.motor_position)


def test_a_bouncing_tip_leaves_its_motors_behind():
    """An impact takes the links' speed and not the motors', and the energy of the links still balances."""
    changes = {"time.duration": 0.5, "transmission.stiffness": 200.0, "transmission.damping": 0.2,
               "transmission.motor_inertia": 0.01}  # fmt: skip
    run = cl.simulate(cl.load_scenario("planar2_drop", changes))
    assert run.events
    jump = np.max(np.abs(np.diff(run.v, axis=0)))
    assert np.max(np.abs(np.diff(run.motor_velocity, axis=0))) < 0.5 * jump
    assert "energy" not in {problem["name"] for problem in run.summary()["verdict"]["problems"]}


def test_a_step_too_long_is_refused_with_the_step_that_would_do():
    """A step of the size that the refusal names goes, half as much again does not."""
    stiff = {"transmission.stiffness": 4e6, "time.duration": 0.012}
    with pytest.raises(cl.ScenarioError, match=r"the step may be at most ([\d.e-]+) s") as refused:
        cl.prepare(cl.load_scenario("wam_slide", stiff))
    assert "\n" not in str(refused.value)
    step = float(str(refused.value).split("at most ")[1].split(" s")[0])
    taken = {"time.step": step, "time.duration": 20 * step, "stabiliser.time_constant": "auto"}
    cl.prepare(cl.load_scenario("wam_slide", stiff | taken))
    with pytest.raises(cl.ScenarioError, match=r"semi_implicit_euler is unstable"):
        cl.prepare(cl.load_scenario("wam_slide", stiff | taken | {"time.step": 1.5 * step, "time.duration": 30 * step}))


REFUSED = {
    "no spring behind the play": (
        {"transmission.backlash": 0.1},
        "transmission.backlash = 0.1: goes with transmission",
    ),
    "no dry friction": ({"transmission.load_friction": 0.1}, "transmission.load_friction: adds to a dry friction"),
    "no spring": ({"transmission.damping": 1.0}, "transmission.damping = 1.0: goes with transmission.stiffness"),
    "no inertia": (
        {"transmission.stiffness": 1e3, "robot.drive_inertia": False},
        "transmission.motor_inertia is left out",
    ),
    "negative": ({"transmission.stiffness": -1.0}, "transmission.stiffness = -1.0: must be greater than 0"),
    "length": ({"transmission.stiffness": [1e3, 1e3]}, "transmission.stiffness has 2 entries: the robot has 4 joints"),
    "motor": (
        {"transmission.stiffness": 1e3, "transmission.measured": "motor", "time.integrator": "dop853"},
        "is sampled",
    ),
    "damper": (
        {"transmission.stiffness": 1e3, "transmission.damping": 1e7},
        "transmission.damping: semi_implicit_euler is unstable with time.step = 0.001 s on joints whose damping",
    ),
    "a light link": (
        {"transmission.stiffness": [10.0, 10.0, 10.0, 1e6], "transmission.motor_inertia": 0.5},
        "against their motors, J4 most",
    ),
    "euler": ({"transmission.stiffness": 1e3, "time.integrator": "explicit_euler"}, "explicit_euler is unstable"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_does_not_go_is_refused_in_one_line(case):
    """Each with the key, the value and the cure."""
    changes, said = REFUSED[case]
    with pytest.raises(cl.ScenarioError) as refused:
        cl.prepare(cl.load_scenario("wam_slide", changes))
    assert said in str(refused.value)
    assert "\n" not in str(refused.value)


def describing_function(x):
    """Return by what share of its stiffness a spring with play b acts on an oscillation of the amplitude b/x."""
    return 1.0 - 2.0 / np.pi * (np.arcsin(x) + x * np.sqrt(1.0 - x * x))


def limit_cycle(M, B, k, b, kp, c):
    """Return half the period and the largest wind-up of a symmetric cycle of link and motor, piece by piece exactly.

    The state q, q̇, θ, θ̇ moves linearly while the teeth touch, and while they do not; half a cycle negates it.
    """
    free = np.array([[0, 1, 0, 0], [0, -c / M, 0, 0], [0, 0, 0, 1], [-kp / B, 0, 0, 0]])
    spring = np.array([[0, 0, 0, 0], [-k / M, 0, k / M, 0], [0, 0, 0, 0], [k / B, 0, -k / B, 0]])
    middle = np.array([0.0, 0.0, b, 0.0])  # the spring is relaxed there

    def touching(x, t):
        both = np.zeros((5, 5))
        both[:4, :4], both[:4, 4] = free + spring, -spring @ middle
        return (expm(t * both) @ np.append(x, 1.0))[:4]

    def closed(unknown):
        x = np.array([*unknown[:2], unknown[0] + b, unknown[2]])
        y = touching(x, unknown[3])
        return [*(expm(unknown[4] * free) @ y + x), y[2] - y[0] - b]

    w, A = np.sqrt(kp / B), b / brentq(lambda x: describing_function(x) - kp / k, 1e-6, 1.0)
    gap = np.arcsin(b / A) / w
    guess = [0.0, 0.0, A * w, np.pi / w - 2.0 * gap, 2.0 * gap]
    found, _, good, _ = fsolve(closed, guess, full_output=True, xtol=1e-13)
    assert good == 1
    x = np.array([*found[:2], found[0] + b, found[2]])
    wound = [y[2] - y[0] for y in (touching(x, t) for t in np.linspace(0.0, found[3], 400))]
    return found[3] + found[4], max(wound), A, w


def test_backlash_swings_in_the_cycle_of_its_pieces():
    """A law on the link of a mass behind a spring with play swings by itself: its gain is too high for no spring.

    The exact cycle of the piecewise linear motion has its period and amplitude. The describing function N of the play
    tells them to some percent: of B θ̈ = −K_p q − τ and M q̈ = τ − c q̇ the loop is at its limit where N k = K_p, with
    ω² = K_p/B (A. Gelb, W. Vander Velde, Multiple-input describing functions, 1968, for the play as a dead zone).
    """
    M, B, k, b, kp, c = 2.0, 0.5, 400.0, 0.002, 150.0, 12.0
    half, wound, A, w = limit_cycle(M, B, k, b, kp, c)
    run = cl.simulate(cl.load_scenario({
        "robot": {"model": "pointmass3", "gravity": [0, 0, 0]},
        "law": {"kind": "paper", "kp": [kp] * 3, "kd": [0.0] * 3},
        "joint_friction": {"kind": "coulomb_viscous", "kinetic": 0.0, "viscous": c}, "start": {"v": [0.1, 0, 0]},
        "transmission": {"stiffness": k, "motor_inertia": B, "backlash": 2 * b}, "stabiliser": {"kind": "none"},
        "time": {"duration": 20.0, "step": 1e-3, "integrator": "rk4"},
    }))  # fmt: skip
    assert run.model.n == 3
    d = (run.motor_position - run.q)[:, 0]
    at = np.flatnonzero((d[:-1] < 0.0) & (d[1:] >= 0.0))
    crossings = run.time[at] - 1e-3 * d[at] / (d[at + 1] - d[at])
    assert np.diff(crossings)[-5:] == pytest.approx([2.0 * half] * 5, rel=1e-4)
    assert d[-1000:].max() == pytest.approx(wound, rel=1e-3)
    assert 2.0 * half == pytest.approx(2.0 * np.pi / w, rel=0.05)
    assert wound == pytest.approx(A, rel=0.1)
