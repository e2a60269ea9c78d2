"""The force loop as a linear system: closed forms, another tool, another engine, and small steps of the run itself."""

import json
import math
from types import SimpleNamespace

import numpy as np
import pytest
from linear_loops import DAMPING, MASS, STIFFNESS, mass_on_a_spring
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

import closedloop as cl
from closedloop.simulation.prepare import prepare
from closedloop.studies.analysis.assembly import Reduced, columns, instant_of
from closedloop.studies.analysis.here import Here

ALONG_N = ("contact", "law", "sensor", "delay", "filter", "hold")


def normal_poles(loop):
    """Return the poles of the loop along the normal, in order."""
    return [pole for pole in loop.poles() if sum(pole.participation.get(part, 0.0) for part in ALONG_N) > 0.5]


def sorted_by(values):
    """Return complex numbers in an order of their own."""
    return np.sort_complex(np.array(values, dtype=complex))


@pytest.fixture(scope="module")
def spring():
    """Return the loop of a mass on a spring under an integral law, continuous."""
    return cl.linearise(mass_on_a_spring())


def test_poles_of_a_mass_on_a_spring(spring):
    """They are the roots of m s³ + (k + c s)(s + K): with an integrator that chooses its steps, to 1e-9."""
    wanted = np.roots([MASS, DAMPING, STIFFNESS + DAMPING * 20.0, STIFFNESS * 20.0])
    found = [pole.s for pole in normal_poles(spring)]
    np.testing.assert_allclose(sorted_by(found), sorted_by(wanted), rtol=1e-9)


def test_poles_of_an_admittance_over_a_position_servo():
    """The eigenvalues of mass, spring, servo and set point, written out for x, v, x_a and ẋ_a, to 1e-9."""
    kp, kd, g, M, B, Bc = 4e4, 300.0, 0.5, 40.0, 100.0, 300.0
    law = {
        "kind": "servo_admittance", "kp": kp, "kd": kd, "gain_scaling": g, "admittance_inertia": M,
        "admittance_damping": B, "contact_damping": Bc, "speed_limit": 1.0, "force": 10.0,
    }  # fmt: skip
    loop = cl.linearise(mass_on_a_spring(law=law))
    a = np.array([
        [0.0, 1.0, 0.0, 0.0],
        [-(STIFFNESS + kp) / MASS, -(DAMPING + kd) / MASS, kp / MASS, kd / MASS],
        [0.0, 0.0, 0.0, 1.0],
        [-g * STIFFNESS / M, -g * DAMPING / M, 0.0, -g * (B + Bc) / M],
    ])  # fmt: skip
    found = [pole.s for pole in normal_poles(loop)]
    np.testing.assert_allclose(sorted_by(found), sorted_by(np.linalg.eigvals(a)), rtol=1e-9)


@pytest.mark.parametrize("scheme", ["semi_implicit_euler", "explicit_euler", "rk4"])
def test_poles_as_the_integrator_makes_them(scheme):
    """A step of each scheme, written out for the three states v, x, ∫: its eigenvalues, to 1e-11."""
    h, m, k, c, K = 0.0002, MASS, STIFFNESS, DAMPING, 20.0
    a = np.array([[-c / m, -k / m, 1.0 / m], [1.0, 0.0, 0.0], [-c * K, -k * K, 0.0]])
    step = np.eye(3) + h * a
    if scheme == "semi_implicit_euler":
        step[1] = [0.0, 1.0, 0.0] + h * step[0]
    elif scheme == "rk4":
        step += (h * a) @ (h * a) / 2 + np.linalg.matrix_power(h * a, 3) / 6 + np.linalg.matrix_power(h * a, 4) / 24
    loop = cl.linearise(mass_on_a_spring(time__integrator=scheme, time__step=h))
    found = [pole.z for pole in normal_poles(loop)]
    np.testing.assert_allclose(sorted_by(found), sorted_by(np.linalg.eigvals(step)), atol=1e-11)


def test_poles_belong_to_parts(spring):
    """The shares of a pole sum to one; without the integral, its pole is gone and the others are the contact's."""
    for pole in spring.poles():
        assert sum(pole.participation.values()) == pytest.approx(1.0)
    assert {pole.part for pole in spring.poles()} == {"arm", "contact", "law"}
    without = cl.linearise(mass_on_a_spring(gain=0.0))
    assert {pole.part for pole in without.poles()} == {"arm", "contact"}
    assert len(without.poles()) == len(spring.poles()) - 1
    pair = [pole for pole in without.poles() if pole.part == "contact"]
    assert pair[0].frequency == pytest.approx(math.sqrt(STIFFNESS / MASS) / (2 * math.pi), rel=1e-9)
    assert pair[0].damping == pytest.approx(0.5 * DAMPING / math.sqrt(STIFFNESS * MASS), rel=1e-9)


def test_loop_transfer_of_a_mass_on_a_spring(spring):
    """Cut at the sensor it is K (k + c s)/(s (m s² + c s + k)), as the exact hold of a fast sampling gives it."""
    f = np.array([0.1, 1.0, 5.0, 20.0])
    s = 2j * math.pi * f
    wanted = 20.0 * (STIFFNESS + DAMPING * s) / (s * (MASS * s**2 + DAMPING * s + STIFFNESS))
    np.testing.assert_allclose(spring.loop_transfer(f), wanted, rtol=4e-2)  # noise is held over 0.5 ms
    finer = cl.linearise(mass_on_a_spring(time__step=0.00005, time__duration=0.01))
    np.testing.assert_allclose(finer.loop_transfer(f), wanted, rtol=4e-3)


def test_gain_margin_is_the_gain_that_oscillates(spring):
    """K times the gain margin, from the transfer, is the K at which the roots of the closed form are on the axis."""
    limit = DAMPING * STIFFNESS / (MASS * STIFFNESS - DAMPING**2)
    finer = cl.linearise(mass_on_a_spring(time__step=0.00005, time__duration=0.01))
    assert 20.0 * finer.margins().gain == pytest.approx(limit, rel=2e-3)
    assert not cl.linearise(mass_on_a_spring(gain=1.02 * limit)).stable
    assert cl.linearise(mass_on_a_spring(gain=0.98 * limit)).stable


def test_admittance_of_a_mass(spring):
    """That of a mass under a law that feeds no motion back is 1/(m s), with K it is (s + K)/(m s²): passive, active."""
    free = cl.linearise(mass_on_a_spring(gain=0.0)).port()
    low = free.frequency < 50.0
    s = 2j * math.pi * free.frequency[low]
    np.testing.assert_allclose(free.admittance[low], 1.0 / (MASS * s), rtol=2e-2)
    assert free.passive
    by_steps = cl.linearise(mass_on_a_spring(gain=0.0, time__integrator="semi_implicit_euler")).port()
    w = 2.0 * math.pi * by_steps.frequency * 0.0005
    np.testing.assert_allclose(by_steps.admittance, 0.0005 / (2.0 * MASS) / (1j * np.tan(0.5 * w)), rtol=1e-6)
    assert by_steps.passive
    port = spring.port()
    low = (port.frequency > 1.0) & (port.frequency < 50.0)
    s = 2j * math.pi * port.frequency[low]
    np.testing.assert_allclose(port.admittance[low], (s + 20.0) / (MASS * s**2), rtol=3e-2)
    assert not port.passive


def test_response_to_a_surface_that_moves():
    """Without a motion gain the force settles at f_des; with one along n it keeps that stiffness, in N per mm."""
    _, f = cl.linearise(mass_on_a_spring(gain=0.0)).response("surface", duration=1.0)
    assert abs(f[-1]) < 1e-3 < np.max(np.abs(f))
    loop = cl.linearise(mass_on_a_spring(gain=0.0, law__kp=[100, 100, 2e3], law__kd=[20, 20, 40]))
    _, f = loop.response("surface", duration=1.0)
    assert f[-1] == pytest.approx(1e-3 / (1.0 / STIFFNESS + 1.0 / 2e3), rel=1e-3)
    _, f = loop.response("load", duration=1.0)  # the spring of the law and that of the surface share it
    assert f[-1] == pytest.approx(-STIFFNESS / (STIFFNESS + 2e3), rel=1e-3)


def test_a_rigid_surface_answers_with_the_laws_stiffness():
    """On the closure a load goes into the surface at once, and a surface that has moved meets the law's own spring."""
    scenario = mass_on_a_spring(
        gain=0.0, compliance={"kind": "none"}, time__integrator="semi_implicit_euler", law__kp=[100, 100, 2e3],
        law__kd=[20, 20, 40], stabiliser={"kind": "baumgarte", "damping_ratio": 0.707, "time_constant": 0.001},
    )  # fmt: skip
    loop = cl.linearise(scenario)
    _, f = loop.response("load", duration=0.1)
    np.testing.assert_allclose(f, -1.0, atol=1e-9)
    _, f = loop.response("surface", duration=0.1)
    assert f[-1] == pytest.approx(2.0, rel=1e-6)
    assert loop.closure.size == 2
    assert not any(state.part == "contact" for state in loop.states)


def test_delay_and_sampling():
    """With the plant's exact hold P(z) the poles are the roots of (z − 1) z^d + K h P(z), d the delay in samples.

    The integral of a step is that of the sample taken at its beginning.
    """
    h, delayed, K = 0.002, 3, 15.0
    loop = cl.linearise(mass_on_a_spring(gain=K, time__step=h, sensor__delay=delayed * h, law__sample_period=h))
    both = np.zeros((3, 3))
    both[:2] = [[0.0, 1.0, 0.0], [-STIFFNESS / MASS, -DAMPING / MASS, 1.0 / MASS]]
    step, c = expm(h * both), np.array([[STIFFNESS, DAMPING]])
    den = np.poly(step[:2, :2])
    num = np.poly(step[:2, :2] - step[:2, 2:] @ c) - den  # c adj(z − A) b = det(z − A + b c) − det(z − A)
    found = sorted_by([pole.z for pole in normal_poles(loop)])
    for late, same in ((delayed, True), (delayed + 1, False)):
        characteristic = np.polyadd(np.polymul(np.append([1.0, -1.0], np.zeros(late)), den), K * h * num)
        wanted = sorted_by(np.roots(characteristic))
        assert (found.size == wanted.size and np.allclose(found, wanted, rtol=0, atol=1e-9)) is same


@pytest.mark.slow
def test_delay_and_sampling_against_python_control():
    """The sampled loop with a delay, built of the plant's exact hold and of shifts: the same poles and margins."""
    control = pytest.importorskip("control")
    h, delayed, K = 0.002, 3, 15.0
    loop = cl.linearise(
        mass_on_a_spring(gain=K, time__step=h, sensor__delay=delayed * h, law__sample_period=h)
    )  # fmt: skip
    plant = control.ss([[0.0, 1.0], [-STIFFNESS / MASS, -DAMPING / MASS]], [[0.0], [1.0 / MASS]],
                       [[STIFFNESS, DAMPING]], [[0.0]])  # fmt: skip
    z = control.tf([1, 0], [1], h)
    cut = control.c2d(plant, h, "zoh") * control.ss(control.tf([K * h], [1, -1], h)) * control.ss(z**-delayed)
    wanted = control.feedback(cut, 1).poles()
    found = [pole.z for pole in normal_poles(loop)]
    np.testing.assert_allclose(sorted_by(found), sorted_by(wanted), atol=1e-9)
    gain, phase, _, at_phase = control.margin(cut)
    margins = loop.margins()
    assert margins.gain == pytest.approx(gain, rel=1e-4)
    assert margins.phase == pytest.approx(phase, rel=1e-4)
    assert 2 * math.pi * margins.phase_at == pytest.approx(at_phase, rel=1e-4)
    at = np.exp(2j * math.pi * h * np.linspace(margins.peak_at - 1.0, margins.peak_at + 1.0, 2001))
    assert margins.peak_sensitivity == pytest.approx(1.0 / np.min(np.abs(1.0 + cut(at))), rel=1e-6)
    whole = loop.to_control()
    np.testing.assert_allclose(sorted_by(whole.poles())[-3:], sorted_by(np.linalg.eigvals(loop.A))[-3:])
    assert whole.input_labels == [each.name for each in loop.inputs]


def test_flight_against_mujoco():
    """Of an arm in flight, with the torque held, MuJoCo's finite differences give the same ∂q̇⁺/∂(q, q̇)."""
    mujoco = pytest.importorskip("mujoco")
    from validation.engines.mujoco import MuJoCo

    scenario = cl.load_scenario("wam_touchdown", {"start.v": [0.3, -0.2, 0.4, 0.1]})
    problem = prepare(scenario)
    here = Here(problem, instant_of(problem, 0.005), free=True)
    other = MuJoCo(problem.robot.model, problem.robot.tip)
    model, data, at = other.model, other.data, other.columns
    h, n = 1e-5, problem.robot.n
    model.opt.timestep, model.opt.integrator = h, mujoco.mjtIntegrator.mjINT_EULER
    data.eq_active[0] = False
    data.qpos[at], data.qvel[at] = here.instant.values["q"], here.instant.values["v"]
    data.qfrc_applied[at] = here.instant.values["torque"]
    A = np.zeros((2 * n, 2 * n))
    mujoco.mjd_transitionFD(model, data, 1e-6, True, A, None, None, None)
    by_q, by_v = A[n:, :n][np.ix_(at, at)], A[n:, n:][np.ix_(at, at)] - np.eye(n)
    for name, block in (("q", by_q), ("v", by_v)):
        mine = columns(here, name, np.full(n, 1e-4), True)["qdd"]
        np.testing.assert_allclose(mine, block / h, rtol=1e-4, atol=1e-3)
        assert np.max(np.abs(mine)) > 0.1


def test_flight_against_drake():
    """Of an arm in flight Drake's linearisation, by its automatic differentiation, has ∂q̈/∂(q, q̇, Q) of ours."""
    primitives = pytest.importorskip("pydrake.systems.primitives")
    from validation.engines.drake import Drake

    scenario = cl.load_scenario("wam_touchdown", {"start.v": [0.3, -0.2, 0.4, 0.1]})
    problem = prepare(scenario)
    here = Here(problem, instant_of(problem, 0.005), free=True)
    other, n = Drake(problem.robot.model, problem.robot.tip), problem.robot.n
    values = here.instant.values
    other.free_acceleration(values["q"], values["v"], values["torque"])  # which sets the context
    port = other.plant.get_applied_generalized_force_input_port().get_index()
    none = pytest.importorskip("pydrake.systems.framework").OutputPortSelection.kNoOutput
    there = primitives.FirstOrderTaylorApproximation(other.plant, other.context, port, none)
    A, B, at = there.A()[n:], there.B()[n:], [part.velocity for part in other.parts]
    for name, block in (("q", A[:, :n]), ("v", A[:, n:]), ("torque", B)):
        mine = columns(here, name, np.full(n, 1e-4), True)["qdd"]
        np.testing.assert_allclose(mine, block[np.ix_(at, at)], rtol=1e-7, atol=1e-6)
        assert np.max(np.abs(mine)) > 0.1


def test_delay_against_a_delay_differential_equation():
    """The step response of the loop with a late sensor is that of m ẍ = f_c − f, ḟ_c = K (f_des − f(t − T)).

    The equation is solved by the method of steps: the classical Runge-Kutta scheme, with the force of the interval
    before, at every half step, from memory. The loop reads its samples once a step, and is late by up to 0.1 ms.
    """
    K, late, h, duration = 15.0, 0.004, 1e-4, 0.4
    loop = cl.linearise(mass_on_a_spring(gain=K, time__step=h, time__duration=0.01, sensor__delay=late))
    t, found = loop.response("force command", duration=duration)
    part = 0.5 * h
    past = round(late / part)
    forces = np.zeros(past + 2 * t.size + 2)  # of the half steps, from −T on

    def rate(y, delayed):
        x, v, command = y
        f = STIFFNESS * x + DAMPING * v
        return np.array([v, (1.0 + command - f) / MASS, K * (1.0 - delayed)])

    y = np.zeros(3)
    for i in range(2 * t.size):
        now, then = forces[i], forces[i + 1]
        a = rate(y, now)
        b = rate(y + 0.5 * part * a, 0.5 * (now + then))
        c = rate(y + 0.5 * part * b, 0.5 * (now + then))
        d = rate(y + part * c, then)
        y = y + part / 6.0 * (a + 2.0 * b + 2.0 * c + d)
        forces[past + i + 1] = STIFFNESS * y[0] + DAMPING * y[1]
    wanted = forces[past : past + 2 * t.size : 2]
    assert np.max(np.abs(found - wanted)) < 0.01 * np.max(np.abs(wanted))
    early = forces[: 2 * t.size : 2]  # a response that is late by T
    assert np.max(np.abs(found - early)) > 0.1 * np.max(np.abs(wanted))


@pytest.mark.parametrize("integrator", ["semi_implicit_euler", "rk4"])
def test_a_cube_that_rests_on_four_feet_beside_the_arm_changes_no_pole(integrator):
    """Its feet stick, by more rows than it can move in: it stays where it is, and the loop is that of the arm."""
    changes = {"time.integrator": integrator, "time.duration": 0.5}
    alone = cl.load_scenario("wam_slide", changes)
    corners = [[x, y, -0.05] for x in (-0.05, 0.05) for y in (-0.05, 0.05)]
    cube = {"name": "cube", "shape": "box", "edges": [0.1, 0.1, 0.1], "mass": 1.0, "position": [0.6, 0.0, 0.05]}
    feet = {"name": "foot", "link": "cube", "at": corners, "friction": 0.5}
    beside = cl.load_scenario("wam_slide", changes | {"body": [cube], "contact": [feet]})
    mine, wanted = (cl.linearise(each, at=0.25) for each in (beside, alone))
    assert [each.name for each in mine.outputs if each.name.startswith("contact force[")] == [
        f"contact force[foot {k}]" for k in (1, 2, 3, 4)
    ]
    found, poles = ([pole.z for pole in each.poles()] for each in (mine, wanted))
    np.testing.assert_allclose(found, poles, atol=1e-6)  # a double pole at 1 splits by the root of rounding


def test_poles_of_a_block_that_a_gripper_holds():
    """Fingers that stick to a block leave one motion, m s² + kd s + kp of hand and block together, in closed form."""
    scenario = cl.load_scenario("gripper_gear", {"time.integrator": "dop853"})
    problem = prepare(scenario)
    names = problem.robot.joint_names
    H = problem.robot.terms(problem.q, problem.v).mass_matrix
    lift, block = names.index("lift"), names.index("block_z_joint")
    roots = np.roots([H[lift, lift] + H[block, block], scenario.law.kd[lift], scenario.law.kp[lift]])
    poles = [pole.s for pole in cl.linearise(scenario, at=0.3).poles()]
    np.testing.assert_allclose(sorted_by(poles), sorted_by(roots), rtol=1e-9)


def test_a_free_body_beside_the_arm():
    """What a cube that spins in flight is turned by turns about ω, at |ω| in rad/s; the arm's loop is as without it."""
    changes = {"time.duration": 0.5, "time.integrator": "rk4"}
    alone = cl.linearise(cl.load_scenario("wam_slide", changes), at=0.1)
    cube = {"name": "cube", "shape": "box", "edges": [0.1, 0.1, 0.1], "mass": 1.0, "position": [2.0, 2.0, 5.0]}
    spin = [0.0] * 4 + [0.1, 0.0, 0.0] + [3.0, 1.0, 2.0]
    loop = cl.linearise(cl.load_scenario("wam_slide", changes | {"body": [cube], "start.v": spin}), at=0.1)
    for joint in range(1, 5):
        mine, other = (each.margins(f"torque[J{joint}]") for each in (loop, alone))
        assert mine.modulus == pytest.approx(other.modulus, rel=1e-6)
    turning = [pole for pole in loop.poles() if abs(pole.s - 1j * 14.0**0.5) < 1e-4]
    assert len(turning) == 1


def test_the_torque_of_each_joint_can_be_cut():
    """Each joint has its own margins there; the law of wam_slide reads no force: at the sensor nothing is fed back."""
    loop = cl.linearise(cl.load_scenario("wam_slide"), at=3.0)
    assert not loop.margins().closed
    margins = [loop.margins(f"torque[J{j}]") for j in range(1, 5)]
    assert all(one.closed and one.stable for one in margins)
    assert loop.stable
    sensitivity = np.abs(1.0 / (1.0 + loop.loop_transfer(np.geomspace(0.01, 499.0, 20_000), "torque[J3]")))
    assert loop.peak_sensitivity("torque[J3]") == pytest.approx(np.max(sensitivity), rel=1e-6)
    assert margins[2].modulus == pytest.approx(1.0 / np.max(sensitivity), rel=1e-6)
    assert loop.bandwidth() == math.inf


def test_names_are_refused_with_those_that_there_are(spring):
    """Of inputs and outputs."""
    with pytest.raises(cl.ScenarioError, match="input 'f': there is none; there are force command, surface accel"):
        spring.response("f")
    with pytest.raises(cl.ScenarioError, match="output 'q': there is none; there are contact force, tip x"):
        spring.response("load", "q")
    assert json.dumps([pole.as_dict() for pole in spring.poles()], allow_nan=False)


def test_derivatives_of_cubics_are_exact():
    """What is left by central differences at two steps is of fourth order: none of a cubic, whose rate is known."""

    def cubics(held, q=(0.0, 0.0)):
        return np.array([q[0] + 5e5 * q[0] ** 3 - q[1], 2.0 * q[1] - 4e4 * q[1] ** 3])

    here = SimpleNamespace(flat=cubics, places={"qdd": slice(0, 2)})
    found = columns(here, "q", np.full(2, 1e-6), False)["qdd"]
    np.testing.assert_allclose(found, [[1.0, -1.0], [0.0, 2.0]], atol=1e-9)


def test_a_small_rotation_of_a_ball_joint_turns_with_its_link():
    """R exp(δ) beside R, both with ω in the axes of the link: the rate of δ is −ω × δ."""
    omega, apart, h = np.array([0.3, -1.1, 0.7]), np.array([2e-5, 1e-5, -3e-5]), 1e-4
    joints = SimpleNamespace(n=4, instant=SimpleNamespace(values={"v": np.array([9.0, *omega])}))
    joints.problem = SimpleNamespace(robot=SimpleNamespace(model=SimpleNamespace(balls=[1])))
    found = Reduced.turning(joints)
    on = Rotation.from_rotvec(h * omega)
    later = (on.inv() * Rotation.from_rotvec(apart) * on).as_rotvec()
    np.testing.assert_allclose(found[1:, 1:] @ apart, (later - apart) / h, atol=1e-8)
    assert not found[0].any()
    assert not found[:, 0].any()
