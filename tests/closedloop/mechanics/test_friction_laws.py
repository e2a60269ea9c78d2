"""What holds for every law of friction: direction, isotropy, curves, states; compiled as interpreted."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rounding import within
from scipy.spatial.transform import Rotation
from test_friction_examples import (
    EXAMPLES,
    ROUNDING,
    angles,
    contact,
    factor,
    level,
    patient,
    pointing,
    some_states,
    speeds,
    turned,
)

from closedloop.jit.calls import entry_address
from closedloop.jit.interpreted import interpreted
from closedloop.jit.parameters import one_joint_block, parameter_block, state_block
from closedloop.loop.step.entries import friction_entry, joint_friction_entry
from closedloop.loop.step.memory import make_loop
from closedloop.mechanics.closure.contact_force import PRESSED, STUCK
from closedloop.mechanics.friction.answers import ADVANCE_STATES, HOLD, LIMIT, RATES, SLIDE, STICK
from closedloop.mechanics.friction.contact import Contact
from closedloop.mechanics.friction.law import JOINT_LAWS, SURFACE_LAWS, joint_parameters, length_of, surface_parameters
from closedloop.mechanics.friction.laws.stribeck import SurfaceStribeck


@pytest.mark.parametrize("name", EXAMPLES)
@given(speed=speeds, angle=angles, share=st.floats(0.0, 1.0), along=angles, turn=angles)
@patient
def test_no_direction_is_special(name, speed, angle, share, along, turn):
    """Slip and states turned by an angle give force, rates and steps turned by that angle."""
    law, other = contact(EXAMPLES[name]), contact(EXAMPLES[name])
    R = Rotation.from_euler("z", turn).as_matrix()[:2, :2]
    u = pointing(speed, angle)
    other.states[:] = turned(some_states(law, share, along), R)
    c, w = law.slide(u)
    c_turned, w_turned = other.slide(R @ u)
    size = max(1.0, 200.0 * speed)  # σ_1|u| and σ_1 a|z|
    assert np.max(np.abs(c_turned - R @ c)) <= ROUNDING * size
    assert np.max(np.abs(w_turned - R @ w)) <= ROUNDING * max(1.0, speed)
    law.advance(u, 1e-3, stuck=True)
    other.advance(R @ u, 1e-3, stuck=True)
    assert np.max(np.abs(other.states - turned(law.states, R)), initial=0.0) <= ROUNDING


@pytest.mark.parametrize("name", EXAMPLES)
@given(speed=speeds, angle=angles, share=st.floats(-1.0, 1.0))
@patient
def test_a_joint_is_a_surface_along_a_line(name, speed, angle, share):
    """With slip and states along one direction the law in two dimensions is the law in one."""
    two, one = contact(EXAMPLES[name]), contact(EXAMPLES[name], d=1)
    z = some_states(two, share, angle)
    if z.size:
        one.states[:] = [*z[:-2], np.copysign(np.linalg.norm(z[-2:]), share)]
    c2, w2 = two.slide(pointing(speed, angle))
    c1, w1 = one.slide(np.array([speed]))
    assert np.max(np.abs(c2 - pointing(c1[0], angle))) <= ROUNDING * max(1.0, 200.0 * speed)
    assert np.max(np.abs(w2 - pointing(w1[0], angle))) <= ROUNDING * max(1.0, speed)


@pytest.mark.parametrize("name", [name for name, section in EXAMPLES.items() if section.sticks != "elastic"])
def test_slip_starts_where_it_is_told_to(name):
    """At rest friction acts against the direction given, at rest without one there is none."""
    law = contact(EXAMPLES[name])
    some_states(law, 0.0, 0.0)
    direction = pointing(1.0, 2.0)
    for u in (np.zeros(2), pointing(1e-15, -1.0)):
        c, _ = law.slide(u, direction=direction)
        assert within(16, c / np.linalg.norm(c), direction)
        assert not np.any(law.slide(u)[0])
    moving, _ = law.slide(pointing(1e-9, -1.0), direction=direction)
    assert moving / np.linalg.norm(moving) == pytest.approx(pointing(1.0, -1.0), abs=1e-12)


@pytest.mark.parametrize("name", [name for name, section in EXAMPLES.items() if section.sticks == "rigid"])
def test_slip_is_no_harder_to_keep_than_to_start(name):
    """Friction of slip is nowhere above what sticking resists, and starts there unless the law jumps (karnopp)."""
    law = contact(EXAMPLES[name])
    limit, kinetic = law.stick_limit, law.kinetic_level
    sizes = [np.linalg.norm(law.slide(np.array([v, 0.0]))[0]) for v in np.logspace(-9, 2, 60)]
    assert max(sizes) <= limit
    assert sizes[0] == pytest.approx(kinetic if name == "karnopp" else limit, rel=1e-6)
    assert sizes[-1] == pytest.approx(kinetic, rel=1e-12)


@pytest.mark.parametrize("name", EXAMPLES)
def test_the_viscous_part_is_b_u(name):
    """Whatever the states: w = b u of a law with a viscous coefficient b, and nothing of one without."""
    for d, u in ((1, np.array([-0.07])), (2, np.array([0.03, -0.4]))):
        law = contact(EXAMPLES[name], d)
        law.states[:] = 1e-6
        assert law.slide(u)[1] == pytest.approx(getattr(law.par, "viscous", 0.0) * u, rel=1e-15)


def test_length_of_a_slip():
    """Of one component and of two, whatever their signs."""
    for u in ([-0.3], [0.0], [3.0, -4.0], [-0.1, 0.0], [0.0, 0.2]):
        assert interpreted(length_of)(np.array(u)) == pytest.approx(np.linalg.norm(u), rel=1e-15)


def test_only_karnopp_has_a_dead_band():
    """Karnopp's law gives its dead band; the others ask for slip to end exactly."""
    for name, section in EXAMPLES.items():
        assert contact(section).capture_speed == (1e-4 if name == "karnopp" else 0.0)


@given(kinetic=level, ratio=factor, speed=st.floats(1e-9, 1e9), at=st.floats(0.0, 1e9), exponent=st.floats(0.1, 10.0))
@patient
def test_stribeck_curve(kinetic, ratio, speed, at, exponent):
    """The curve is its closed form, also where the exponential has long vanished."""
    section = SurfaceStribeck(kinetic=kinetic, static=kinetic * ratio, stribeck_speed=speed, exponent=exponent)
    c, _ = contact(section, d=1).slide(np.array([at]), direction=np.ones(1))
    with np.errstate(over="ignore"):
        wanted = kinetic + (kinetic * ratio - kinetic) * np.exp(-(np.float64(at / speed) ** exponent))
    assert c[0] == pytest.approx(wanted, rel=1e-11)


@pytest.mark.parametrize("exponent", [0.5, 1.0, 2.0])
def test_stribeck_curve_falls_by_1_e_at_its_speed(exponent):
    """Static at rest, kinetic far off, 1/e of the difference left at v_s, and falling throughout, for any exponent."""
    section = SurfaceStribeck(kinetic=0.2, static=0.5, stribeck_speed=0.01, exponent=exponent)
    law = contact(section, d=1)
    force = [law.slide(np.array([v]))[0][0] for v in np.linspace(1e-6, 0.2, 400)]
    assert np.all(np.diff(force) <= 0.0)
    assert law.stick_limit == 0.5
    assert law.slide(np.array([0.01]))[0][0] == pytest.approx(0.2 + 0.3 / math.e, rel=1e-15)


@pytest.mark.parametrize("name", EXAMPLES)
@pytest.mark.parametrize("d", [1, 2])
def test_states_are_all_written(name, d):
    """Rates and the states of sticking leave nothing of what was in the arrays, and rest does from zero."""
    law = contact(EXAMPLES[name], d)
    law.states[:] = np.nan
    assert np.all(np.isfinite(law.rested()))
    assert np.all(np.isfinite(law.rates(np.ones(d), stuck=True)))
    law.stick(np.ones(d) / math.sqrt(d))
    assert np.all(np.isfinite(law.states))


def numbers(member, joints):
    """Return what the entry of a law, compiled and interpreted, makes of the same random states of a loop."""
    rng, n = np.random.default_rng(5), 3
    par = (one_joint_block if joints else parameter_block)(member).count(n)
    count = state_block(member).count(1 if joints else 2)
    key = "joint_friction" if joints else "friction"
    loop = make_loop(n, extra=n * count if joints else count, **{key: par})
    state, constants, w = loop
    getattr(state, key).states = count
    constants.bearings[:] = 1.0
    entry = (joint_friction_entry if joints else friction_entry)(member)
    entry_address(entry)  # compiled as the loop has it
    work = w.memory.copy()
    found = []
    for call in (entry, interpreted(entry)):
        rng, values = np.random.default_rng(5), []
        for i in range(20):
            getattr(constants, key)[:] = rng.uniform(0.1, 2.0, getattr(constants, key).shape)
            w.memory[:] = rng.normal(size=work.size)
            w.z[:], w.joint_friction.lagged[:], w.friction.delayed_slip = (
                np.abs(w.z),
                np.abs(w.joint_friction.lagged),
                abs(w.friction.delayed_slip),
            )
            w.friction.span, state.mode = 0.1, STUCK if i % 2 else PRESSED
            w.joint_friction.stuck[:] = rng.integers(0, 2, n)
            for what in (SLIDE, HOLD, RATES, ADVANCE_STATES, LIMIT, STICK):
                assert call(loop.address, what) == 0
                values.append(w.memory.copy())
        found.append(np.array(values))
    return found


@pytest.mark.parametrize("joints", [False, True], ids=["surface", "joints"])
@pytest.mark.parametrize("name", [name for name in EXAMPLES if name != "none"])
def test_interpreted_and_compiled_are_the_same(name, joints):
    """The entry that the loop calls and the same lines interpreted give the same numbers, to the last bit."""
    compiled, twin = numbers((JOINT_LAWS if joints else SURFACE_LAWS)[name], joints)
    assert np.ptp(compiled) > 0.0
    assert np.array_equal(compiled, twin)


@pytest.mark.parametrize("joints", [False, True], ids=["surface", "joints"])
@pytest.mark.parametrize("name", ["lugre", "seven_parameter"])
def test_an_entry_is_the_law_of_each_contact(name, joints):
    """What the loop's memory has after each call is what the law says of the tip, or of each joint by itself."""
    rng, shared = np.random.default_rng(2), {"stribeck_speed": 0.1, "stiffness": 300.0, "viscous": 0.2}
    shared |= {"memory_delay": 0.0, "rise_time": 0.4} if name == "seven_parameter" else {"damping": 2.0}
    above = "static_excess" if name == "seven_parameter" else "static"
    if joints:
        section = JOINT_LAWS[name](**shared | {"kinetic": [0.1, 0.2, 0.3], above: [0.4, 0.7, 0.5]})
        pars, d, key = joint_parameters(section, 3), 1, "joint_friction"
    else:
        section = SURFACE_LAWS[name](**shared | {"kinetic": 0.2, above: 0.7})
        pars, d, key = [surface_parameters(section)], 2, "friction"
    laws = [Contact(type(section), par, d) for par in pars]
    count = laws[0].states.size
    state, constants, w = loop = make_loop(3, extra=count * len(laws), **{key: pars[0].memory.size})
    getattr(constants, key)[:] = [par.memory for par in pars] if joints else pars[0].memory
    getattr(state, key).states = count
    constants.bearings[:] = 1.0
    entry = interpreted((joint_friction_entry if joints else friction_entry)(type(section)))
    z = w.z.reshape(len(laws), count)
    for stuck in ([False, True, False], [True, False, True]):
        stuck = stuck[: len(laws)]
        w.joint_friction.stuck[: len(laws)], state.mode = stuck, STUCK if stuck[0] else PRESSED
        u, w.friction.span = rng.normal(size=(len(laws), d)), 0.02
        along = np.array([[1.0], [-1.0], [0.0]]) if joints else np.array([[0.6, -0.8]])
        slip, direction = (
            (w.joint_friction.slip, w.joint_friction.direction) if joints else (w.friction.slip, w.friction.direction)
        )
        slip[:], direction[:], w.friction.delayed_slip, w.joint_friction.lagged[:] = (
            u.ravel(),
            along.ravel(),
            np.linalg.norm(u[0]),
            abs(u[:, 0]),
        )
        z[:] = np.abs(rng.normal(size=z.shape)) * 1e-3
        for law, states in zip(laws, z, strict=True):
            law.states[:] = states
        w.friction.c[:], w.friction.viscous[:], w.joint_friction.dry[:], w.joint_friction.viscous[:] = (
            7.0,
            7.0,
            7.0,
            7.0,
        )
        each = list(zip(laws, u, along, stuck, strict=True))
        held = [(law.hold(), np.zeros(d)) for law in laws]
        slid = [law.slide(x, direction=way) for law, x, way, _ in each]
        if joints:
            assert entry(loop.address, SLIDE) == 0
            wanted = [h if still else s for h, s, still in zip(held, slid, stuck, strict=True)]
            assert [*zip(w.joint_friction.dry, w.joint_friction.viscous, strict=True)] == [
                (c[0], v[0]) for c, v in wanted
            ]
        else:
            for what, wanted in ((SLIDE, slid[0]), (HOLD, held[0])):
                assert entry(loop.address, what) == 0
                assert np.array_equal([w.friction.c, w.friction.viscous], wanted)
        assert entry(loop.address, RATES) == 0
        assert np.array_equal(w.dz.reshape(z.shape), [law.rates(x, still) for law, x, _, still in each])
        assert entry(loop.address, LIMIT) == 0
        assert (w.joint_friction.limit.tolist() if joints else [w.friction.stick_limit]) == [
            law.stick_limit for law in laws
        ]
        assert entry(loop.address, ADVANCE_STATES) == 0
        for law, x, _, still in each:
            law.advance(x, 0.02, still)
        assert np.array_equal(z, [law.states for law in laws])
        slip[:] = 0.0
        w.friction.delayed_slip, w.joint_friction.lagged[:] = 0.0, 0.0
        assert entry(loop.address, STICK) == 0
        for law, _, way, _ in each:
            if np.any(way):
                law.stick(way)
        assert np.array_equal(z, [law.states for law in laws])
