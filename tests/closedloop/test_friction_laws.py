"""What holds for every law of friction: direction, isotropy, curves, states."""

import json
import math
import os
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from test_friction_examples import (
    EXAMPLES,
    ROUNDING,
    angles,
    factor,
    friction,
    level,
    patient,
    pointing,
    some_states,
    speeds,
    turned,
)

from closedloop.friction import KINDS, STICKS, pack, state_count
from closedloop.friction.laws import (
    advance_states,
    capture_speed,
    contact_states,
    rates,
    rest_states,
    sliding,
    stick_limit,
    stick_states,
)
from closedloop.friction.layout import KINETIC
from closedloop.friction.sections import (
    JointLuGre,
    SurfaceStribeck,
)
from closedloop.jit.kernel import kernel


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
        JointLuGre(kinetic=(0.2, 0.5), static=0.6, stribeck_speed=0.1, stiffness=500.0, damping=(1.0, 2.0)), 2
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


@pytest.mark.parametrize(
    ("name", "limit"),
    [
        ("none", 0.0), ("coulomb", 0.3), ("coulomb_viscous", 0.3), ("stribeck", 0.35), ("karnopp", 0.35), ("dahl", 0.3),
        ("lugre", 0.35), ("seven_parameter", 0.18),
    ],
)  # fmt: skip
def test_a_contact_at_rest_resists_its_static_level(name, limit):
    """Static where a law has such a level, kinetic where it has but that, fully risen after a long rest; or nothing."""
    kind, par = pack(EXAMPLES[name])
    z = np.full(state_count(kind, 2), np.nan)
    rest_states(kind, par, z)
    assert stick_limit(kind, par, z) == pytest.approx(limit, rel=1e-15)
