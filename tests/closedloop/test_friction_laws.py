"""What holds for every law of friction: direction, isotropy, energy, exact steps; and the closed forms of each."""

import json
import math
import os
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from closedloop.compiled import kernel
from closedloop.friction import KINDS, STICKS, largest_step, pack, presliding_motion, state_count
from closedloop.friction.laws import (
    advance_states,
    capture_speed,
    contact_states,
    holding,
    rates,
    rest_states,
    sliding,
    stick_limit,
    stick_states,
    stored_energy,
)
from closedloop.friction.layout import KINETIC, STATIC, STIFFNESS
from closedloop.friction.lugre import is_passive, passive_damping_speed, passive_viscous
from closedloop.friction.sections import (
    JointLuGre,
    NoFriction,
    SurfaceCoulomb,
    SurfaceCoulombViscous,
    SurfaceDahl,
    SurfaceKarnopp,
    SurfaceLuGre,
    SurfaceSevenParameter,
    SurfaceStribeck,
)

patient = settings(deadline=None, max_examples=60)  # the first example of all compiles

# Sums of a few products: their rounding, relative to the largest of them.
ROUNDING = 1e-13

EXAMPLES = {
    "none": NoFriction(),
    "coulomb": SurfaceCoulomb(coefficient=0.3),
    "coulomb_viscous": SurfaceCoulombViscous(coefficient=0.3, viscous=4.0),
    "stribeck": SurfaceStribeck(kinetic=0.2, static=0.35, stribeck_speed=2e-3, exponent=1.3, viscous=0.5),
    "karnopp": SurfaceKarnopp(kinetic=0.2, static=0.35, dead_band=1e-4, viscous=0.5),
    "dahl": SurfaceDahl(coefficient=0.3, stiffness=3e4, viscous=0.2),
    "lugre": SurfaceLuGre(
        kinetic=0.2, static=0.35, stribeck_speed=2e-3, stiffness=3e4, damping=40.0, damping_speed=0.02, viscous=0.5
    ),
    "seven_parameter": SurfaceSevenParameter(
        kinetic=0.1,
        static_excess=0.08,
        stribeck_speed=2e-3,
        stiffness=2e4,
        memory_delay=0.01,
        rise_time=0.4,
        viscous=0.5,
    ),
}

# Table 1 of Canudas de Wit, Olsson, Åström, Lischinsky 1995.
PUBLISHED = SurfaceLuGre(
    kinetic=1.0, static=1.5, stribeck_speed=1e-3, stiffness=1e5, damping=math.sqrt(1e5), viscous=0.4
)

level = st.floats(0.01, 2.0)
factor = st.floats(1.0, 4.0)
speeds = st.floats(-6.0, 1.0).map(lambda e: 10.0**e)
angles = st.floats(0.0, 2.0 * math.pi)


def pointing(size: float, angle: float) -> np.ndarray:
    """Return the (2,) vector of this length and direction."""
    return size * np.array([math.cos(angle), math.sin(angle)])


def friction(kind, par, u, z, delayed_speed=None, direction=None):
    """Return c and w of a contact that slides."""
    c, w = np.empty_like(u), np.empty_like(u)
    lag = float(np.linalg.norm(u)) if delayed_speed is None else delayed_speed
    sliding(kind, par, u, lag, z, np.zeros_like(u) if direction is None else direction, c, w)
    return c, w


def some_states(name, par, share, angle, d=2):
    """Return states of a law that are `share` of the largest deflection there is, along `angle`."""
    z = np.zeros(state_count(KINDS[name], d))
    rest_states(KINDS[name], par, z)
    if z.size:
        largest = stick_limit(KINDS[name], par, z) / par[STIFFNESS]
        z[-d:] = pointing(share * largest, angle)[:d]
    return z


def turned(z, rotation):
    """Return the states seen in axes that are turned."""
    return np.concatenate([z[:-2], rotation @ z[-2:]]) if z.size else z


def test_every_law_has_an_example():
    """The table of laws, that of sticking and the examples of these tests name the same laws."""
    assert set(KINDS) == set(EXAMPLES)
    assert set(STICKS) == set(KINDS.values())
    assert all(section.kind == name for name, section in EXAMPLES.items())


@pytest.mark.parametrize("name", KINDS)
@given(speed=speeds, angle=angles, share=st.floats(0.0, 1.0), along=angles, turn=angles)
@patient
def test_no_direction_is_special(name, speed, angle, share, along, turn):
    """Slip and states turned by an angle give force, rates and steps turned by that angle."""
    kind, par = pack(EXAMPLES[name])
    u, z = pointing(speed, angle), some_states(name, par, share, along)
    R = Rotation.from_euler("z", turn).as_matrix()[:2, :2]
    c, w = friction(kind, par, u, z)
    c_turned, w_turned = friction(kind, par, R @ u, turned(z, R))
    size = max(1.0, 200.0 * speed)  # σ_1|u| and σ_1 a|z|
    assert np.max(np.abs(c_turned - R @ c)) <= ROUNDING * size
    assert np.max(np.abs(w_turned - R @ w)) <= ROUNDING * max(1.0, speed)
    later, later_turned = z.copy(), turned(z, R)
    advance_states(kind, par, u, True, 1e-3, later)
    advance_states(kind, par, R @ u, True, 1e-3, later_turned)
    assert np.max(np.abs(later_turned - turned(later, R)), initial=0.0) <= ROUNDING


@pytest.mark.parametrize("name", KINDS)
@given(speed=speeds, angle=angles, share=st.floats(-1.0, 1.0))
@patient
def test_a_joint_is_a_surface_along_a_line(name, speed, angle, share):
    """With slip and states along one direction the law in two dimensions is the law in one."""
    kind, par = pack(EXAMPLES[name])
    z2 = some_states(name, par, share, angle)
    z1 = np.concatenate([z2[:-2], [share * np.linalg.norm(z2[-2:]) / abs(share)]]) if z2.size and share else z2[:-1]
    c2, w2 = friction(kind, par, pointing(speed, angle), z2)
    c1, w1 = friction(kind, par, np.array([speed]), z1)
    assert np.max(np.abs(c2 - pointing(c1[0], angle))) <= ROUNDING * max(1.0, 200.0 * speed)
    assert np.max(np.abs(w2 - pointing(w1[0], angle))) <= ROUNDING * max(1.0, speed)


@pytest.mark.parametrize("name", [name for name, kind in KINDS.items() if STICKS[kind] != "elastic"])
def test_slip_starts_where_it_is_told_to(name):
    """At rest friction acts against the direction given, at rest without one there is none."""
    kind, par = pack(EXAMPLES[name])
    z = some_states(name, par, 0.0, 0.0)
    direction = pointing(1.0, 2.0)
    for u in (np.zeros(2), pointing(1e-15, -1.0)):
        c, _ = friction(kind, par, u, z, direction=direction)
        assert c / np.linalg.norm(c) == pytest.approx(direction, abs=1e-15)
        assert not np.any(friction(kind, par, u, z)[0])
    moving, _ = friction(kind, par, pointing(1e-9, -1.0), z, direction=direction)
    assert moving / np.linalg.norm(moving) == pytest.approx(pointing(1.0, -1.0), abs=1e-12)


@pytest.mark.parametrize("name", [name for name, kind in KINDS.items() if STICKS[kind] == "rigid"])
def test_slip_is_no_harder_to_keep_than_to_start(name):
    """Friction of slip is nowhere above what sticking resists, and starts there unless the law jumps (karnopp)."""
    kind, par = pack(EXAMPLES[name])
    z = np.zeros(0)
    limit = stick_limit(kind, par, z)
    sizes = [np.linalg.norm(friction(kind, par, np.array([v, 0.0]), z)[0]) for v in np.logspace(-9, 2, 60)]
    assert max(sizes) <= limit
    assert sizes[0] == pytest.approx(par[KINETIC] if name == "karnopp" else limit, rel=1e-6)
    assert sizes[-1] == pytest.approx(par[KINETIC], rel=1e-12)


def test_only_karnopp_has_a_dead_band():
    """Karnopp's law gives its dead band; the others ask for slip to end exactly."""
    for name, section in EXAMPLES.items():
        assert capture_speed(*pack(section)) == (1e-4 if name == "karnopp" else 0.0)


@given(kinetic=level, ratio=factor, speed=st.floats(1e-9, 1e9), at=st.floats(0.0, 1e9), exponent=st.floats(0.1, 10.0))
@patient
def test_stribeck_curve(kinetic, ratio, speed, at, exponent):
    """The curve is its closed form, also where the exponential has long vanished."""
    section = SurfaceStribeck(kinetic=kinetic, static=kinetic * ratio, stribeck_speed=speed, exponent=exponent)
    kind, par = pack(section)
    c, _ = friction(kind, par, np.array([at]), np.zeros(0), direction=np.ones(1))
    with np.errstate(over="ignore"):
        wanted = kinetic + (kinetic * ratio - kinetic) * np.exp(-(np.float64(at / speed) ** exponent))
    assert c[0] == pytest.approx(wanted, rel=1e-11)


@pytest.mark.parametrize("exponent", [0.5, 1.0, 2.0])
def test_stribeck_curve_falls_by_1_e_at_its_speed(exponent):
    """Static at rest, kinetic far off, 1/e of the difference left at v_s, and falling throughout, for any exponent."""
    section = SurfaceStribeck(kinetic=0.2, static=0.5, stribeck_speed=0.01, exponent=exponent)
    kind, par = pack(section)
    force = [friction(kind, par, np.array([v]), np.zeros(0))[0][0] for v in np.linspace(1e-6, 0.2, 400)]
    assert np.all(np.diff(force) <= 0.0)
    assert stick_limit(kind, par, np.zeros(0)) == 0.5
    assert friction(kind, par, np.array([0.01]), np.zeros(0))[0][0] == pytest.approx(0.2 + 0.3 / math.e, rel=1e-15)


# ------------------------------------------------------------------------------------------------------- energy


def gained(kind, par, u, z, stuck, f, delayed_speed=None):
    """Return F_t·u + f d(stored)/dt, W, and the size of what was added."""
    d, step = u.size, np.zeros_like(z)
    rates(kind, par, u, stuck, z, step)
    if stuck and STICKS[kind] == "spring":
        c, w = np.empty_like(u), np.empty_like(u)
        holding(kind, par, z, c, w)
    else:
        c, w = friction(kind, par, u, z, delayed_speed)
    work = -f * c @ u - w @ u
    # stored = ½σ_0|x|² of a bristle, or of a spring while it is stuck; constant otherwise
    stores = (STICKS[kind] == "spring" and stuck) or (STICKS[kind] == "elastic" and z.size > 0)
    storing = f * par[STIFFNESS] * z[-d:] @ step[-d:] if stores else 0.0
    return work + storing, abs(f * c @ u) + abs(w @ u) + abs(storing)


@pytest.mark.parametrize("name", KINDS)
@given(
    speed=st.one_of(speeds, st.just(0.0)), angle=angles, share=st.floats(0.0, 1.0), along=angles,
    f=st.floats(0.0, 50.0), lag=speeds, stuck=st.booleans(),
)  # fmt: skip
@patient
def test_friction_never_adds_energy(name, speed, angle, share, along, f, lag, stuck):
    """Friction takes at least what it stores, in any state, at any slip and any constant normal force."""
    kind, par = pack(EXAMPLES[name])
    assert name != "lugre" or is_passive(par, 50.0)
    gain, size = gained(kind, par, pointing(speed, angle), some_states(name, par, share, along), stuck, f, lag)
    assert gain <= ROUNDING * size


@given(
    kinetic=level, ratio=factor, stiffness=st.floats(1e2, 1e6), damping=st.floats(0.0, 1e3), by_speed=st.booleans(),
    speed=st.floats(-7.0, 3.0).map(lambda e: 10.0**e), angle=angles, share=st.floats(0.0, 1.0), f=st.floats(0.1, 50.0),
)  # fmt: skip
@settings(deadline=None, max_examples=300)
def test_lugre_is_passive_where_it_says_so(kinetic, ratio, stiffness, damping, by_speed, speed, angle, share, f):
    """Parameters that just meet one of the two conditions give no state from which energy is gained."""
    section = SurfaceLuGre(
        kinetic=kinetic, static=kinetic * ratio, stribeck_speed=1e-3, stiffness=stiffness, damping=damping
    )
    _, par = pack(section)
    edge = passive_damping_speed(par)
    by_speed = by_speed and math.isfinite(edge)
    cure = {"damping_speed": edge} if by_speed else {"viscous": passive_viscous(par, f)}
    kind, par = pack(section.model_copy(update=cure))
    assert is_passive(par, f)
    u, z = pointing(speed, 0.0), pointing(share * par[STATIC] / par[STIFFNESS], angle)
    gain, size = gained(kind, par, u, z, False, f)
    assert gain <= 1e-12 * size


@pytest.mark.parametrize(("share", "adds"), [(0.98, True), (1.02, False)])
def test_viscous_condition_of_lugre_is_sharp(share, adds):
    """With constant damping, a little less viscous friction than the condition asks for adds energy at high speed."""
    b = passive_viscous(pack(PUBLISHED)[1], load=2.0)
    kind, par = pack(PUBLISHED.model_copy(update={"viscous": share * b}))
    assert is_passive(par, 2.0) is not adds
    gains = [gained(kind, par, np.array([v]), np.array([1.5e-5]), False, 2.0)[0] for v in np.logspace(-3, 3, 60)]
    assert bool(max(gains) > 0.0) is adds


def test_published_lugre_can_add_energy():
    """The published figures (σ_2 = 0.4 N s/m, constant damping) meet no condition, and at 10 m/s do add energy."""
    kind, par = pack(PUBLISHED)
    assert not is_passive(par)
    assert gained(kind, par, np.array([10.0]), np.array([1.5e-5]), False, 1.0)[0] > 0.0


@pytest.mark.parametrize("name", KINDS)
def test_stored_energy_is_half_stiffness_times_deflection_squared(name):
    """Elastic laws store ½σ_0|z|², the spring ½k_t|x|²; the others nothing."""
    kind, par = pack(EXAMPLES[name])
    z = some_states(name, par, 0.7, 1.0)
    wanted = 0.5 * par[STIFFNESS] * float(z[-2:] @ z[-2:]) if z.size else 0.0
    assert stored_energy(kind, par, True, z, 2) == pytest.approx(wanted, rel=1e-14)


# -------------------------------------------------------------------------------------------------- exact steps


@pytest.mark.parametrize("name", ["dahl", "lugre"])
@pytest.mark.parametrize("speed", [1e-6, 3e-4, 2e-3, 0.1])
def test_exponential_step_is_the_solution(name, speed):
    """At constant slip a step is the solution of the rates, here by Radau at 1e-11, in two dimensions."""
    kind, par = pack(EXAMPLES[name])
    u, z = pointing(speed, 0.3), some_states(name, par, 0.8, 2.5)
    duration = 2.0 * float(np.linalg.norm(z)) / speed

    def motion(t, state):
        out = np.empty(2)
        rates(kind, par, u, False, state.copy(), out)
        return out

    wanted = solve_ivp(motion, (0.0, duration), z, method="Radau", rtol=1e-11, atol=1e-20).y[:, -1]
    advance_states(kind, par, u, False, duration, z)
    assert z == pytest.approx(wanted, rel=1e-9, abs=1e-9 * np.linalg.norm(wanted))


@pytest.mark.parametrize("name", ["dahl", "lugre"])
@given(speed=st.floats(0.0, 100.0), angle=angles, share=st.floats(0.0, 1.0), h=st.floats(0.0, 1e12))
@patient
def test_bristles_stay_within_their_bound(name, speed, angle, share, h):
    """However long the step and however fast the slip, the deflection stays within its bound."""
    kind, par = pack(EXAMPLES[name])
    bound = par[STATIC] / par[STIFFNESS]
    z = some_states(name, par, share, angle)
    advance_states(kind, par, pointing(speed, 0.0), False, h, z)
    assert np.linalg.norm(z) <= bound * (1.0 + 1e-14)


@pytest.mark.parametrize("name", ["dahl", "lugre", "seven_parameter"])
@given(speed=st.floats(0.0, 1.0), share=st.floats(0.0, 1.0), h=st.floats(0.0, 0.1), split=st.floats(0.0, 1.0))
@patient
def test_two_steps_are_one(name, speed, share, h, split):
    """A step in two parts ends where the whole one does: the step is exact, whatever its length."""
    kind, par = pack(EXAMPLES[name])
    once, twice = some_states(name, par, share, 1.0), some_states(name, par, share, 1.0)
    u = pointing(speed, 4.0)
    advance_states(kind, par, u, True, h, once)
    advance_states(kind, par, u, True, split * h, twice)
    advance_states(kind, par, u, True, h - split * h, twice)
    assert twice == pytest.approx(once, rel=1e-12, abs=1e-17)


# ------------------------------------------------------------------------------------------------- before slip


@pytest.mark.parametrize("amplitude", [0.3, 1.0, 5.0])
def test_loop_of_dahl(amplitude):
    """A cycle of dahl has the force F_C tanh(σ_0 x_0/F_C) at its ends and the area 4 F_C (x_0 − F_end/σ_0)."""
    kind, par = pack(SurfaceDahl(coefficient=0.3, stiffness=3e4))
    x0 = amplitude * 0.3 / 3e4
    x = x0 * np.sin(np.linspace(0.0, 40.5 * math.pi, 40501))  # 1000 steps a half cycle
    z, force = np.zeros(1), np.zeros(x.size)
    for i in range(1, x.size):
        advance_states(kind, par, np.array([(x[i] - x[i - 1]) / 1e-3]), False, 1e-3, z)
        force[i] = friction(kind, par, np.zeros(1), z)[0][0]
    end = 0.3 * math.tanh(3e4 * x0 / 0.3)
    assert force[-1] == pytest.approx(end, rel=1e-5)  # closed to e^(−80 σ_0 x_0/F_C)
    assert force[-1 - 1000] == pytest.approx(-end, rel=1e-5)
    if amplitude >= 1.0:
        area = np.trapezoid(force[-2001:], x[-2001:])
        assert area == pytest.approx(4.0 * 0.3 * (x0 - end / 3e4), rel=1e-4)  # rule of 1000 chords


def test_loop_of_dahl_does_not_depend_on_speed():
    """Dahl's friction follows the path, not the time: the same path a thousand times slower gives the same force."""
    kind, par = pack(EXAMPLES["dahl"])
    ends = []
    for h in (1e-3, 1.0):
        z = np.zeros(2)
        for leg in (pointing(4e-6, 0.0), pointing(9e-6, 2.0), pointing(3e-6, 4.0)):
            advance_states(kind, par, leg / h, False, h, z)
        ends.append(z.copy())
    assert ends[0] == pytest.approx(ends[1], rel=1e-12)


@pytest.mark.parametrize("name", ["dahl", "lugre"])
@pytest.mark.parametrize(("mass", "load"), [(1.0, 1.0), (3.0, 12.0)])
def test_small_motions_are_a_spring_and_a_damper(name, mass, load):
    """The eigenvalues of a mass held by bristles are those of ω and ζ."""
    kind, par = pack(EXAMPLES[name])

    def motion(state):
        dz = np.empty(1)
        rates(kind, par, state[:1].copy(), False, state[1:].copy(), dz)
        c, w = friction(kind, par, state[:1].copy(), state[1:].copy())
        return np.array([(-load * c[0] - w[0]) / mass, dz[0]])

    tiny = 1e-10  # a is proportional to |u|, so differences have an error of this relative to |u|/z_max
    jacobian = np.column_stack([(motion(e * tiny) - motion(-e * tiny)) / (2.0 * tiny) for e in np.eye(2)])
    omega, zeta = presliding_motion(EXAMPLES[name], mass, load)
    found = np.linalg.eigvals(jacobian)
    wanted = omega * np.roots([1.0, 2.0 * zeta, 1.0])
    assert np.sort_complex(found) == pytest.approx(np.sort_complex(wanted), rel=1e-6)


def test_published_small_signal_figures():
    """σ_0 = 1e5 N/m, σ_1 = √1e5, σ_2 = 0.4 and 1 kg give ω = 316.2 rad/s and ζ = 0.5006 (closed form)."""
    assert presliding_motion(PUBLISHED, 1.0) == pytest.approx((316.2278, 0.500632), rel=1e-6)


@pytest.mark.parametrize(("share", "grows"), [(0.99, False), (1.01, True)])
@pytest.mark.parametrize("name", ["dahl", "lugre"])
def test_largest_step_before_slip(name, share, grows):
    """Semi-implicit Euler with the exponential step holds a mass on its bristles just below the limit, not above."""
    kind, par = pack(EXAMPLES[name])
    h = share * largest_step(*presliding_motion(EXAMPLES[name], 2.0, 5.0))
    u, z = np.array([1e-13]), np.zeros(1)
    peak = 0.0
    for _ in range(1200):
        c, w = friction(kind, par, u, z)
        u += h / 2.0 * (-5.0 * c - w)
        advance_states(kind, par, u, False, h, z)
        peak = max(peak, abs(float(u[0])))
    assert (peak > 1e3 * 1e-13) is grows  # what grows does so until the bristles yield, 1e9 times as far


def test_presliding_is_refused_without_stiffness():
    """A law without bristles has no motion before slip."""
    with pytest.raises(ValueError, match="coulomb has no stiffness"):
        presliding_motion(EXAMPLES["coulomb"], 1.0)


# ------------------------------------------------------------------------------------------------------- states


@pytest.mark.parametrize("name", KINDS)
def test_states_are_all_written(name):
    """Rates and the states of rest and of a new contact leave nothing of what was in the arrays."""
    kind, par = pack(EXAMPLES[name])
    for d in (1, 2):
        z = np.full(state_count(kind, d), np.nan)
        contact_states(z)
        assert not np.any(z)
        z[:] = np.nan
        rest_states(kind, par, z)
        assert np.all(np.isfinite(z))
        dz = np.full(z.size, np.nan)
        rates(kind, par, np.ones(d), True, z, dz)
        assert np.all(np.isfinite(dz))
        stick_states(kind, par, 0.0, np.ones(d) / math.sqrt(d), z)
        assert np.all(np.isfinite(z))


@kernel
def joints(kind, par, v, z, direction, c, w):
    """Write the friction of every joint, as a step would."""
    for j in range(v.size):
        sliding(kind, par[j], v[j : j + 1], abs(v[j]), z[j], direction[j : j + 1], c[j : j + 1], w[j : j + 1])
        advance_states(kind, par[j], v[j : j + 1], False, 1e-3, z[j])


def test_joints_within_a_kernel():
    """Slices of joint arrays go into the kernels, and give what each joint alone does."""
    kind, par = pack(
        JointLuGre(coulomb=(0.2, 0.5), static=0.6, stribeck_speed=0.1, stiffness=500.0, damping=(1.0, 2.0)), 2
    )
    v, z, c, w = np.array([0.02, -0.3]), np.array([[1e-4], [2e-4]]), np.empty(2), np.empty(2)
    alone = [friction(kind, par[j], v[j : j + 1].copy(), z[j].copy())[0][0] for j in range(2)]
    joints(kind, par, v, z, np.zeros(2), c, w)
    assert c == pytest.approx(alone, rel=1e-15)
    assert not np.any(w)
    assert np.all(z != [[1e-4], [2e-4]])


SCRIPT = """
import numpy as np
from closedloop.friction.laws import advance_states, sliding, stick_limit, stored_energy
from closedloop.friction.layout import PARAMETERS, state_count


def numbers():
    rng, total = np.random.default_rng(5), []
    for kind in range(8):
        for d in (1, 2):
            for _ in range(20):
                par, z = rng.uniform(0.1, 2.0, PARAMETERS), rng.normal(size=state_count(kind, d))
                u, c, w = rng.normal(size=d), np.empty(d), np.empty(d)
                sliding(kind, par, u, abs(rng.normal()), z, u, c, w)
                advance_states(kind, par, u, True, 0.1, z)
                total += [*c, *w, *z, stick_limit(kind, par, z), stored_energy(kind, par, True, z, d)]
    return [float(x) for x in total]
"""


def test_interpreted_and_compiled_are_the_same():
    """With the compiler off the same lines give the same numbers, to the rounding of exponentials."""
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", SCRIPT + "print(numbers())"],
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | {"NUMBA_DISABLE_JIT": "1", "PYTHONPATH": os.pathsep.join(sys.path)},
    )
    assert done.returncode == 0, done.stderr
    here: dict = {}
    exec(SCRIPT, here)
    compiled = here["numbers"]()
    assert len(compiled) > 1000
    assert json.loads(done.stdout) == pytest.approx(compiled, rel=1e-13, abs=1e-15)
