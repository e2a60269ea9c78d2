"""LuGre against its published stick-slip trial, against MuJoCo's, and what sets it apart: break-away by rate."""

import math

import numpy as np
import pytest
from test_friction_examples import contact

from closedloop.mechanics.friction.laws.lugre import SurfaceLuGre

# Canudas de Wit, Olsson, Åström, Lischinsky 1995, as in EXUDYN's Examples/lugreFrictionODE1.py, commit e44aca1b.
PUBLISHED = SurfaceLuGre(
    kinetic=1.0, static=1.5, stribeck_speed=1e-3, stiffness=1e5, damping=math.sqrt(1e5), viscous=0.4
)


def test_break_away_is_the_lower_the_faster_the_load_grows():
    """Break-away below F_S, the more so the faster the pull grows: of 1 kg on 2 N/m whose end moves at these speeds."""
    pulls, h = [], 1e-4
    for speed in (0.5, 2.0, 8.0):
        law, u, x, k = contact(PUBLISHED, d=1), np.zeros(1), 0.0, 0
        while u[0] < 1e-3:
            k += 1
            pull = 2.0 * (speed * k * h - x)
            law.advance(u, h)
            c, w = law.slide(u)
            u[0] += h * (pull - c[0] - w[0])
            x += h * u[0]
        pulls.append(pull)
    assert 1.5 > pulls[0] > pulls[1] > pulls[2] > 1.0


def test_damping_falls_with_speed_as_a_gaussian():
    """With a damping speed v_d the part of σ_1 in the force is σ_1 ż exp(−(u/v_d)²); without one it is σ_1 ż."""
    for v_d, shares in ((None, (1.0, 1.0, 1.0)), (0.02, (math.exp(-0.25), math.exp(-1.0), math.exp(-4.0)))):
        law = contact(PUBLISHED.model_copy(update={"damping_speed": v_d}), d=1)
        law.states[:] = -4e-6
        for u, share in zip((0.01, 0.02, 0.04), shares, strict=True):
            c, _ = law.slide(np.array([u]))
            assert (c[0] + 1e5 * 4e-6) / law.rates(np.array([u]))[0] == pytest.approx(math.sqrt(1e5) * share, rel=1e-13)


def test_same_as_mujoco():
    """Rates, force and exponential step are those of MuJoCo's dcmotor, at 200 states, to rounding.

    Its electrical part is switched off by a motor constant of 1e-9: 1e-18 N m s/rad.
    """
    mujoco = pytest.importorskip("mujoco")
    rng = np.random.default_rng(3)
    for _ in range(4):
        coulomb, static = np.sort(rng.uniform(0.1, 1.0, 2)).tolist()
        stiffness, damping, v_s = rng.uniform(50.0, 500.0), rng.uniform(0.1, 5.0), rng.uniform(0.01, 0.5)
        model = mujoco.MjModel.from_xml_string(
            f"""<mujoco><option timestep="1e-3" gravity="0 0 0"/>
            <worldbody><body><joint name="joint" type="slide" axis="1 0 0"/><geom size="1" mass="1"/></body></worldbody>
            <actuator><dcmotor joint="joint" motorconst="1e-9" resistance="1"
              lugre="{stiffness!r} {damping!r} {coulomb!r} {static!r} {v_s!r}"/></actuator></mujoco>"""
        )
        data = mujoco.MjData(model)
        law = contact(
            SurfaceLuGre(kinetic=coulomb, static=static, stribeck_speed=v_s, stiffness=stiffness, damping=damping), d=1
        )
        for _ in range(50):
            u = np.array([rng.choice([-1.0, 1.0]) * 10.0 ** rng.uniform(-4, 1)])
            z = np.array([rng.uniform(-1.0, 1.0) * static / stiffness])
            data.qvel[:], data.act[:], law.states[:] = u, z, z
            mujoco.mj_forward(model, data)
            c, w = law.slide(u)
            dz = law.rates(u)
            size = static + damping * abs(u[0]) * (1.0 + static / coulomb)
            assert -c[0] - w[0] == pytest.approx(data.actuator_force[0], abs=1e-14 * size)
            assert dz[0] == pytest.approx(data.act_dot[0], abs=1e-14 * abs(u[0]) * (1.0 + static / coulomb))
            law.advance(u, 1e-3)
            mujoco.mj_step(model, data)
            assert law.states[0] == pytest.approx(data.act[0], rel=1e-12, abs=1e-15)


def force_along(x, h):
    """Return LuGre's friction without its viscous part, N, along the motion x (N,), m, sampled every h, s."""
    law = contact(PUBLISHED.model_copy(update={"viscous": 0.0}), d=1)
    force = np.zeros_like(x)
    for i in range(1, x.size):
        u = np.array([(x[i] - x[i - 1]) / h])
        law.advance(u, h)
        force[i] = law.slide(u)[0][0]
    return force


@pytest.mark.parametrize("share", [0.3, 1.0, 3.0])
def test_slow_cycles_before_slip_are_dahls_at_the_static_level(share):
    """Far below v_s bristles yield at F_S: cycles of amplitude x_0 have the force F_S tanh(σ_0 x_0/F_S) at their ends.

    The loop is run through clockwise, force after displacement: it takes 4 F_S (x_0 − F_end/σ_0) a cycle.
    """
    reach = 1.5 / 1e5
    phase = np.linspace(0.0, 20.5 * np.pi, 5126)
    x = share * reach * np.sin(phase)
    force = force_along(x, 10.0)  # 4.7 days: no faster than a nanometre per second
    end = 1.5 * math.tanh(share)
    last = phase >= 18.5 * np.pi - 1e-9
    # Ten cycles, as where the first one began is forgotten the slower, the smaller they are.
    assert 0.5 * np.ptp(force[last]) == pytest.approx(end, rel=2e-3)
    assert np.trapezoid(force[last], x[last]) == pytest.approx(4.0 * 1.5 * (share * reach - end / 1e5), rel=1e-2)


def test_friction_lags_a_speed_that_varies_the_more_the_faster_it_does():
    """Friction is higher while slip gets faster than while it gets slower, the more so at 25 rad/s than at 1 rad/s.

    What Hess and Soom measured in 1990, and the loops of the publication's figure on frictional lag (recalled).
    """
    widths = []
    for omega in (1.0, 10.0, 25.0):
        t = np.linspace(0.0, 6.0 * np.pi / omega, 6001)
        force = force_along(2e-3 * t + 1e-3 / omega * (1.0 - np.cos(omega * t)), t[1])
        v = 2e-3 + 1e-3 * np.sin(omega * (t - 0.5 * t[1]))
        cycle = t > 3.5 * np.pi / omega
        faster, slower = cycle & (np.cos(omega * t) > 0.0), cycle & (np.cos(omega * t) < 0.0)
        order = np.argsort(v[faster]), np.argsort(v[slower])
        at = np.linspace(1.2e-3, 2.8e-3, 50)
        gap = np.interp(at, v[faster][order[0]], force[faster][order[0]])
        gap -= np.interp(at, v[slower][order[1]], force[slower][order[1]])
        widths.append(float(np.max(gap)))
    assert 0.0 < widths[0] < 0.2 * widths[1]
    assert widths[1] < 0.5 * widths[2]
