"""The control laws on a rigid, frictionless plane: what holds exactly for every arm, and what each law promises."""

from types import SimpleNamespace

import numba
import numpy as np
import pytest
from control_loop import POSES, Loop, arm

import closedloop as cl
from closedloop.control.compensation.adaptive import AdaptiveCompensation
from closedloop.control.compensation.model import ModelCompensation
from closedloop.control.compensation.observer import ObserverCompensation
from closedloop.control.laws.admittance import AdmittanceLaw
from closedloop.control.laws.dynamic_hybrid import DynamicHybridLaw
from closedloop.control.laws.hybrid import HybridLaw
from closedloop.control.laws.impedance import ImpedanceLaw
from closedloop.control.laws.operational_space import OperationalSpaceLaw
from closedloop.control.laws.paper import PaperLaw, paper_law
from closedloop.control.tip_space import motion_along_normal, pseudo_inverse, surface_mobility
from closedloop.jit.calls import address_of, matrix_of
from closedloop.jit.inside.dual8 import dual_vector_at
from closedloop.jit.kernel import numba_ready, plain
from closedloop.jit.simd8 import WIDE, aligned
from closedloop.simulation.engines.scenario_numbers import pack_law

LAWS = {
    "paper": PaperLaw(kp=400.0, kd=30.0),
    "hybrid": HybridLaw(kp=400.0, kd=30.0),
    "operational_space": OperationalSpaceLaw(),
    "dynamic_hybrid": DynamicHybridLaw(),
    "impedance": ImpedanceLaw(),
    "admittance": AdmittanceLaw(),
}
# Laws that invert the arm's dynamics, so that motion and force obey linear equations of their own.
EXACT = ("operational_space", "dynamic_hybrid", "impedance", "admittance")
LINEAR_MOTION = ("operational_space", "dynamic_hybrid", "admittance")
COMPENSATIONS = {
    "none": None,
    "model": ModelCompensation(kinetic=0.2, viscous=2.0, joint_coulomb=0.5, joint_viscous=0.1),
    "observer": ObserverCompensation(),
    "adaptive": AdaptiveCompensation(),
}


def drawn(name, law, seed, **changes):
    """Return a loop in a random state near the arm's pose, and what the law knows there."""
    rng = np.random.default_rng(seed)
    n = arm(name).n
    loop = Loop(name, law, q=np.array(POSES[name]) + rng.uniform(-0.3, 0.3, n), v=rng.uniform(-0.5, 0.5, n), **changes)
    x, _ = loop.moment(0.0, loop.q, loop.v)
    mobile = np.array([1.0, 1.0, 1.0 if name != "planar2" else 0.0])
    x = x._replace(
        q_des=x.q + rng.uniform(-0.1, 0.1, n),
        v_des=rng.uniform(-0.1, 0.1, n),
        qdd_des=np.zeros(n),
        p_des=x.p + mobile * [0.0, *rng.uniform(-0.01, 0.01, 2)],
        u_des=mobile * [0.0, *rng.uniform(-0.1, 0.1, 2)],
        a_des=mobile * [0.0, *rng.uniform(-1.0, 1.0, 2)],
    )
    return loop, x


def on_plane(loop, x):
    """Return the tip's acceleration and the contact force where the plane holds the tip's acceleration at zero."""
    qdd, f = cl.solve_closure(x.H, loop.torque(x) - x.C, x.A[0], -x.drift[0])
    return x.A @ qdd + x.drift, f


@pytest.mark.parametrize("name", POSES)
@pytest.mark.parametrize("kind", LAWS)
def test_at_rest_the_force_is_the_wanted_one(name, kind):
    """At rest where it shall be, without friction, every arm presses with f_des, to 1e-9 N, and does not move."""
    loop = Loop(name, LAWS[kind])
    qdd, F, dz, _ = loop.evaluate(0.0, loop.q, loop.v, loop.z)
    assert abs(F[0] - 10.0) < 1e-9
    assert np.max(np.abs(qdd)) < 1e-9
    assert np.all(np.abs(dz) < 1e-9)


@pytest.mark.parametrize("name", POSES)
@pytest.mark.parametrize("kind", EXACT)
def test_force_and_motion_as_commanded_in_any_state(name, kind):
    """In a random state of motion and error, f = f_c and the tip accelerates along the surface as the law asks."""
    for seed in range(5):
        loop, x = drawn(name, LAWS[kind], seed)
        a, f = on_plane(loop, x)
        e, rate = (x.p_des - x.p)[1:], (x.u_des - x.u)[1:]
        if kind == "impedance":
            P = np.array([[surface_mobility(x.S, 1.0, i, k) for k in (1, 2)] for i in (1, 2)])
            wanted = x.a_des[1:] + P @ (1200.0 * e + 120.0 * rate)
            assert f == pytest.approx(10.0 + 200.0 * x.u[0], abs=1e-9)
        elif kind == "admittance":
            wanted = x.a_des[1:] + 400.0 * e + 40.0 * rate
            assert f == pytest.approx(10.0 + 40.0 * x.u[0] / x.S[0, 0], abs=1e-9)
        else:
            wanted = x.a_des[1:] + 400.0 * e + 40.0 * rate
            assert f == pytest.approx(10.0, abs=1e-9)
        moves = np.diag(x.S)[1:] > 1e-9
        assert moves.sum() == (1 if name == "planar2" else 2)
        assert np.max(np.abs((a[1:] - wanted)[moves])) < 1e-9 * max(1.0, np.max(np.abs(wanted)))


@pytest.mark.parametrize("kind", EXACT)
def test_force_and_motion_are_orthogonal(kind):
    """Another force leaves the motion as it is, another motion the force; with Eq. 33 the motion disturbs the force."""
    changes = {}
    for name in (kind, "paper"):
        loop, x = drawn("panda", LAWS[name], 3)
        x = x._replace(v=np.zeros(7), u=np.zeros(3), drift=np.zeros(3))
        a, f = on_plane(loop, x)
        harder, f_harder = on_plane(loop, x._replace(f_des=25.0))
        assert f_harder - f == pytest.approx(15.0, abs=1e-9)
        assert np.max(np.abs(harder - a)) < 1e-9
        off, f_off = on_plane(loop, x._replace(p_des=x.p_des + np.array([0.0, 0.02, 0.03]), q_des=x.q_des + 0.02))
        assert np.max(np.abs(off - a)) > 0.1
        changes[name] = abs(f_off - f)
    assert changes[kind] < 1e-9
    assert changes["paper"] > 0.01


@pytest.mark.parametrize(("kind", "name"), list(zip(LINEAR_MOTION, POSES, strict=False)))
def test_path_error_decays_as_the_gains_say(name, kind):
    """From a millimetre beside the path ë + K_v ė + K_p e = 0, critically damped: e = e₀(1 + ωt) exp(−ωt)."""
    loop = Loop(name, LAWS[kind])
    beside = np.array([0.0, 1e-3, 0.0 if name == "planar2" else -0.5e-3])
    loop.path = lambda t: (beside, np.zeros(3), np.zeros(3))
    run = loop.run(0.15, h=1e-3, scheme="rk4")
    t = run["t"][:, None]
    closed_form = beside * (1.0 + 20.0 * t) * np.exp(-20.0 * t)
    assert np.max(np.abs(run["e"] - closed_form)[:, 1:]) < 1e-9
    assert np.max(np.abs(run["f"] - 10.0)) < 1e-6


@pytest.mark.parametrize("kind", LAWS)
@pytest.mark.parametrize("compensation", COMPENSATIONS)
def test_torque_does_not_depend_on_the_tangents(kind, compensation):
    """Tangents turned about the normal describe the same surface, so the torque and the rates stay."""
    answers = []
    for turn in (0.0, 0.7):
        loop, x = drawn("panda", LAWS[kind], 11, compensation=COMPENSATIONS[compensation])
        c, s = np.cos(turn), np.sin(turn)
        R = np.array([[1.0, 0, 0], [0, c, s], [0, -s, c]])
        tip = {key: R @ getattr(x, key) for key in ("A", "p", "u", "drift", "p_des", "u_des", "a_des")}
        x = x._replace(**tip, X=np.ascontiguousarray(x.X.T @ R.T).T.copy(), S=R @ x.S @ R.T)
        loop.z[:] = np.linspace(0.01, 0.3, loop.z.size)
        torque = loop.torque(x)
        answers.append(np.concatenate([torque, loop.rates(x, 9.0, torque)]))
    assert np.max(np.abs(answers[0] - answers[1])) < 1e-10 * np.max(np.abs(answers[0]))


def test_paper_law_through_the_family_is_eq_33_to_the_last_bit():
    """Chosen by name, the law gives the numbers of `paper_law`, those of Eq. 33; the PD part acts from its start."""
    law = PaperLaw(kp=(900, 900, 400, 300), kd=(60, 60, 30, 20), force=7.3)
    loop, x = drawn("wam4", law, 5)
    kp, kd = np.array(law.kp), np.array(law.kd)
    for start in (x.t - 1.0, x.t, x.t + 1.0):
        loop.packed[0] = pack_law(law.model_copy(update={"pd_start": start}), 4)
        expected = np.zeros(4)
        par = SimpleNamespace(kp=kp, kd=kd, pd_start=start)
        plain(paper_law)(x.t, x.f_des, par, (x.q_des, x.v_des), (x.q, x.v), x.C, x.A, expected)
        assert np.array_equal(loop.torque(x), expected)
        pd = -kp * (x.q - x.q_des) - kd * (x.v - x.v_des) if x.t >= start else 0.0
        assert expected == pytest.approx(x.C - 7.3 * x.A[0] + pd, rel=1e-12)


@pytest.mark.parametrize("name", ["wam4", "planar2", "ur5", "panda"])
def test_the_two_inverse_dynamics_agree_without_redundancy(name):
    """Khatib's law and Yoshikawa's are one where the tip fixes all joints, and differ only within a redundant arm."""
    laws = (
        OperationalSpaceLaw(posture_stiffness=9.0, posture_damping=2.0),
        DynamicHybridLaw(posture_stiffness=9.0, posture_damping=2.0),
    )
    torques, accelerations = [], []
    for law in laws:
        loop, x = drawn(name, law, 8)
        torques.append(loop.torque(x))
        accelerations.append(on_plane(loop, x)[0])
    assert np.max(np.abs(accelerations[0] - accelerations[1])) < 1e-9
    same = np.max(np.abs(torques[0] - torques[1])) < 1e-8
    assert same == (arm(name).n == np.linalg.matrix_rank(x.A, tol=1e-9))


@pytest.mark.parametrize("kind", EXACT)
@pytest.mark.parametrize("name", ["wam4", "panda"])
def test_redundant_joints_go_to_their_posture_and_leave_the_tip(name, kind):
    """Another wanted posture moves joints, but neither tip nor force; motion that leaves the tip at rest is damped."""
    loop, x = drawn(name, LAWS[kind], 2)
    a, f = on_plane(loop, x)
    elsewhere = x._replace(q_des=x.q_des + np.linspace(0.2, -0.3, x.q.size))
    b, g = on_plane(loop, elsewhere)
    assert np.max(np.abs(a - b)) < 1e-9
    assert f == pytest.approx(g, abs=1e-9)
    assert np.max(np.abs(loop.torque(x) - loop.torque(elsewhere))) > 1e-3
    # A joint velocity that leaves the tip at rest is damped: its kinetic energy falls.
    within = np.linalg.svd(x.A)[2][-1]
    rest = x._replace(v=0.1 * within, u=np.zeros(3), drift=np.zeros(3), q_des=x.q, v_des=np.zeros(x.q.size))
    rest = rest._replace(p_des=x.p, u_des=np.zeros(3), a_des=np.zeros(3))
    qdd, _ = cl.solve_closure(x.H, loop.torque(rest) - x.C, x.A[0], 0.0)
    assert rest.v @ x.H @ qdd == pytest.approx(
        -10.0 * rest.v @ x.H @ rest.v, rel=1e-2 if kind == "dynamic_hybrid" else 1e-6
    )


def test_hybrid_is_stable_where_the_inverse_jacobian_is_not():
    """With J⁻¹S a two-joint arm has postures in which positive gains push away; with (S J)⁺, as here, none is found."""
    law = HybridLaw(kp=100.0, kd=1.0)
    lowest = {"ours": [], "inverse": []}
    for elbow in np.linspace(-2.8, -0.3, 40):
        loop = Loop("planar2", law, q=(0.6, elbow))
        x, _ = loop.moment(0.0, loop.q, loop.v)
        base = loop.torque(x)
        step = np.array([0.0, 1e-3, 0.0])
        gain = (loop.torque(x._replace(p_des=x.p_des + step)) - base) / 1e-3
        stiffness = {
            "ours": np.outer(gain, x.A[1]),
            "inverse": 100.0 * np.linalg.solve(x.A[:2], np.diag([0.0, 1.0]) @ x.A[:2]),
        }
        for key, K in stiffness.items():
            lowest[key].append(np.linalg.eigvals(np.linalg.solve(x.H, K)).real.min())
    assert min(lowest["ours"]) > -1e-6
    assert min(lowest["inverse"]) < -10.0


@pytest.mark.parametrize("name", POSES)
def test_hybrid_is_its_formula(name):
    """Q is the law written with numpy's pseudo-inverse: pressed, and free with no force to apply, where p_des leads."""
    law = HybridLaw(kp=400.0, kd=30.0, force=7.0)
    rate, speed = law.approach_damping, law.approach_speed
    for seed, height in enumerate((-0.1, -0.001, 0.0, 0.002)):
        loop, x = drawn(name, law, seed)
        T, N = np.linalg.pinv(x.A[1:], rcond=1e-6), np.eye(loop.n) - np.linalg.pinv(x.A, rcond=1e-6) @ x.A
        joints = 400.0 * (T @ (x.p_des - x.p)[1:] + N @ (x.q_des - x.q))
        joints += 30.0 * (T @ (x.u_des - x.u)[1:] + N @ (x.v_des - x.v))
        assert loop.torque(x) == pytest.approx(x.C + joints - 7.0 * x.A[0], rel=1e-9, abs=1e-9)
        free = x._replace(pressed=0.0, f_des=0.0, p_des=x.p_des + height * np.eye(3)[0])
        a = rate * (np.clip(0.25 * rate * (free.p_des - free.p)[0], -speed, speed) - x.u[0])
        off = joints + a / x.S[0, 0] * x.A[0]
        assert loop.torque(free) == pytest.approx(x.C + off, rel=1e-9, abs=1e-9)
        singular = free._replace(S=np.zeros((3, 3)))  # where nothing moves the tip along the normal
        assert loop.torque(singular) == pytest.approx(x.C + joints, rel=1e-9, abs=1e-9)


def test_impedance_yields_to_a_push_like_its_spring():
    """A push along the surface moves the tip by F/K, and a p_des below the surface adds K_n times the depth to f."""
    law = ImpedanceLaw(stiffness=1000.0, damping=110.0, normal_stiffness=800.0)
    loop = Loop("wam4", law)
    push = np.array([0.0, 0.4, -0.3])
    free = loop.evaluate
    loop.path = lambda t: (np.array([-0.003, 0.0, 0.0]), np.zeros(3), np.zeros(3))

    def pushed(t, q, v, z):
        loop.disturbance = loop.moment(t, q, v)[0].A.T @ push
        return free(t, q, v, z)

    loop.evaluate = pushed
    run = loop.run(1.0, h=2e-3, scheme="rk4")
    assert run["e"][-1, 1:] == pytest.approx(-push[1:] / 1000.0, abs=2e-7)
    # What pushes along the surface unknown to the law also presses: by S_nt/S_nn of it.
    S = loop.moment(loop.t, loop.q, loop.v)[0].S
    assert run["f"][-1] == pytest.approx(10.0 + 800.0 * 0.003 - S[0] @ push / S[0, 0], abs=1e-4)
    assert abs(S[0] @ push / S[0, 0]) > 0.1


@pytest.mark.parametrize(
    ("law", "speed"),
    [
        (HybridLaw(kp=400.0, kd=30.0, approach_speed=0.03), 0.03),
        (OperationalSpaceLaw(approach_speed=0.04), 0.04),
        (DynamicHybridLaw(approach_speed=0.04), 0.04),
        (ImpedanceLaw(normal_damping=400.0), 10.0 / 400.0),
        (AdmittanceLaw(admittance_damping=500.0), 10.0 / 500.0),
    ],
    ids=lambda value: value.kind if hasattr(value, "kind") else "",
)
def test_a_tip_off_the_surface_comes_down_at_a_set_speed(law, speed):
    """Off the surface a law that is to press seeks it at a speed of its own, whatever the height."""
    loop = Loop("wam4", law)
    loop.pressed = 0.0
    x, _ = loop.moment(0.0, loop.q, loop.v)
    loop.p_start[0] -= 0.2  # the surface is 20 cm below
    loop.restart()
    first = loop.evaluate(0.0, loop.q, loop.v, loop.z)[0]
    assert -10.0 < (x.A @ first)[0] <= 0.0
    run = loop.run(0.4, h=2e-3, scheme="rk4")
    assert -run["rate"][-1, 0] == pytest.approx(-speed, rel=5e-3)
    assert np.all(-run["rate"][:, 0] > -1.2 * speed)
    assert np.max(np.abs(run["e"][:, 1:])) < (1e-3 if law.kind == "hybrid" else 1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["hybrid", "operational_space", "dynamic_hybrid"])
def test_without_a_force_to_apply_the_tip_follows_its_path_off_the_surface(kind):
    """With f_des = 0 a free tip goes to p_des along the normal too, no faster than the approach speed."""
    loop = Loop("wam4", LAWS[kind].model_copy(update={"force": 0.0}))
    loop.pressed = 0.0
    loop.path = lambda t: (np.array([0.01, 0.0, 0.0]), np.zeros(3), np.zeros(3))
    run = loop.run(1.2, h=2e-3, scheme="rk4")
    assert abs(run["e"][-1, 0]) < 1e-5
    assert 0.04 < np.max(-run["rate"][:, 0]) <= 0.05 * 1.001


@pytest.mark.parametrize("rank", [0, 1, 2, 3])
def test_pseudo_inverse_by_rotations(rank):
    """Moore and Penrose's four conditions hold for symmetric matrices of any rank, and the rank is counted."""
    rng = np.random.default_rng(rank)
    for _ in range(50):
        basis = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        values = np.where(np.arange(3) < rank, 10.0 ** rng.uniform(-4, 2, 3), 0.0)
        M = basis @ np.diag(values) @ basis.T
        M = 0.5 * (M + M.T)
        P = np.zeros((3, 3))
        assert pseudo_inverse(M, np.zeros(36), P) == rank
        size, inverse_size = np.linalg.norm(M) or 1.0, np.linalg.norm(P) or 1.0
        assert np.max(np.abs(M @ P @ M - M)) < 1e-9 * size
        assert np.max(np.abs(P @ M @ P - P)) < 1e-9 * inverse_size
        assert np.max(np.abs(M @ P - (M @ P).T)) < 1e-9
        in_place = M.copy()
        pseudo_inverse(in_place, np.zeros(36), in_place)
        assert np.array_equal(in_place, P)


@pytest.mark.slow
def test_pseudo_inverse_has_the_derivatives_of_its_closed_form():
    """Of matrices that are diagonal, which no rotation turns, with two or three equal eigenvalues, and of any rank."""
    numba_ready()

    @numba.njit(error_model="numpy")
    def inverted(at):
        memory = dual_vector_at(at, 54)
        pseudo_inverse(matrix_of(memory[:9], 3, 3), memory[9:45], matrix_of(memory[45:54], 3, 3))

    rng = np.random.default_rng(0)
    turned = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    for values in (
        [1.0, 2.0, 5.0],
        [2.0, 2.0, 5.0],
        [3.0, 3.0, 3.0],
        [0.0, 2.0, 5.0],
        [0.0, 2.0, 2.0],
        [0.0, 0.0, 4.0],
    ):
        for basis in (np.eye(3), turned):
            memory = aligned(54)
            M, nulls = basis @ np.diag(values) @ basis.T, np.array(values) == 0
            memory[:9, 0] = M.ravel()
            for k in range(1, WIDE):
                change = rng.normal(size=(3, 3))
                change = basis.T @ (change + change.T) @ basis
                change[np.ix_(nulls, nulls)] = 0.0  # so that its rank stays
                memory[:9, k] = (basis @ change @ basis.T).ravel()
            inverted(address_of(memory))
            P, N = np.linalg.pinv(M), np.eye(3) - np.linalg.pinv(M) @ M
            np.testing.assert_allclose(memory[45:54, 0].reshape(3, 3), P, atol=1e-14)
            for k in range(1, WIDE):
                dM = memory[:9, k].reshape(3, 3)
                expected = -P @ dM @ P + P @ P @ dM @ N + N @ dM @ P @ P
                np.testing.assert_allclose(memory[45:54, k].reshape(3, 3), expected, atol=1e-13)


@pytest.mark.parametrize("height", [-0.1, 0.0, 0.1])
@pytest.mark.parametrize("rate", [-0.5, 0.0, 0.3])
@pytest.mark.parametrize("f_des", [-30.0, -0.5, 0.0, 0.5, 30.0])
def test_off_the_surface_the_sign_of_the_command_says_where_to(f_des, rate, height):
    """Down at the speed of approach to press, however gently; after the path at zero; never down to stay away."""
    stiffness, damping, speed = 400.0, 40.0, 0.05
    loop = Loop("wam4", LAWS["operational_space"])
    x = loop.moment(0.0, loop.q, loop.v)[0]
    x = x._replace(f_des=f_des, pressed=0.0, u=np.array([rate, 0.0, 0.0]), p_des=x.p + height * np.eye(3)[0])
    a = plain(motion_along_normal)(x, f_des, stiffness, damping, speed)
    if f_des > 0.0:
        in_contact = -x.S[0, 0] * f_des - damping * max(rate, 0.0)  # no harder than f_des would press
        wanted = max(damping * (-speed - rate), in_contact)
    else:
        follow = stiffness / damping * height
        if f_des < 0.0:
            follow = max(follow, 0.0) + x.S[0, 0] * -f_des / damping
        wanted = damping * (np.clip(follow, -speed, speed) - rate)
    assert a == pytest.approx(wanted, rel=1e-14)
    assert plain(motion_along_normal)(x._replace(pressed=1.0), f_des, stiffness, damping, speed) == 0.0
