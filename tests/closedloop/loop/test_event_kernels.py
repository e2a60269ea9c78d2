"""What the kernels of events write, one at a time, in the memory of a loop that is ready to run."""

import numpy as np
import pytest
from random_loop import loop_at_random
from scipy.optimize import brentq

import closedloop as cl
from closedloop.jit.interpreted import interpreted
from closedloop.loop.events.locate import (
    AFTER_EVENT,
    AT_EVENT,
    LOCATE_EVENT,
    NEED_TERMS,
    PROJECTION,
    REACH_EVENT,
    STEP_END,
    refine_bracket,
    slip_margin,
)
from closedloop.loop.events.proceed import project
from closedloop.loop.events.substep import too_many_events
from closedloop.loop.events.table import EVENT_WIDTH, IMPACT, LIFTOFF, REVERSAL, SLIP_AGAIN, STICK, TOUCHDOWN, EventRow
from closedloop.loop.events.transitions import apply_event, apply_impact, end_stick_or_slip, find_direction
from closedloop.mechanics.closure.contact_force import FREE, PRESSED, STUCK
from closedloop.mechanics.closure.solve import CHATTER, CROWDED, RUBS
from closedloop.mechanics.limits import INSTANT, MAX_IN_STEP, REFINEMENTS
from closedloop.simulation.engines.failures import failure_of

RUBBING = {
    "friction.kind": "dahl", "friction.coefficient": 0.4, "friction.stiffness": 3e3, "joint_friction.kind": "dahl",
    "joint_friction.kinetic": 0.3, "joint_friction.stiffness": 300.0,
}  # fmt: skip
SOFT = {"compliance.kind": "kelvin_voigt", "compliance.stiffness": 1e4, "compliance.damping": 40.0}
STICKING = {"friction.kind": "coulomb", "friction.coefficient": 0.4}


@pytest.mark.parametrize("kind", [IMPACT, TOUCHDOWN])
def test_an_impact_changes_velocity_energy_and_the_states_of_friction(kind):
    """q̇ jumps by H⁻¹AᵀP, on a surface that moves too what is supplied by ½ q̇ᵀH q̇, and bristles begin anew."""
    loop, H, rng = loop_at_random("wam_bounce", RUBBING)
    state, constants, w = loop.state, loop.constants, loop.w
    before, kept, energy = w.v.copy(), w.z.copy(), w.supply.energy
    w.impact.before[:], w.impact.compression[:], w.impact.decompression[:] = (
        w.tip.u,
        rng.normal(size=3),
        rng.normal(size=3),
    )
    impulse = w.impact.compression + w.impact.decompression
    w.impact.after[:], w.time, state.event.kind, state.cleared, state.mode = (
        w.impact.before + w.tip.S @ impulse,
        0.3,
        kind,
        0,
        FREE,
    )
    events = np.zeros((3, EVENT_WIDTH))
    interpreted(apply_impact)(w, constants, state, events)
    np.testing.assert_allclose(w.v, before + np.linalg.solve(H, w.tip.A.T @ impulse), rtol=1e-10)
    gained = 0.5 * w.v @ H @ w.v - 0.5 * before @ H @ before
    assert w.supply.energy - energy == pytest.approx(gained, rel=1e-10)
    assert EventRow(events[0]).energy_lost == pytest.approx(impulse @ w.tip.carried - gained, rel=1e-10)
    assert (state.event.rows, state.cleared, state.mode) == (1, 1, FREE if kind == IMPACT else PRESSED)
    bristles = np.arange(len(kept)) - state.law_states - state.sensor.states
    bristles = (bristles >= 0) & (bristles < state.friction.states)
    assert 0 < np.count_nonzero(bristles) < len(kept)
    np.testing.assert_array_equal(w.z, np.where(bristles, 0.0, kept))
    np.testing.assert_allclose(
        w.friction.direction, w.impact.after[1:] / np.linalg.norm(w.impact.after[1:]), rtol=1e-14
    )


@pytest.mark.parametrize("slip", [[0.3, 0.4], [0.0, 1.1], [1.1, 0.0], [0.0, 0.0]])
def test_a_tip_that_lands_sticks_where_it_hardly_slips(slip):
    """Up to the speed that counts as none it sticks, at the place where it lands; without slip no direction is told."""
    loop, _, _ = loop_at_random("wam_bounce", STICKING)
    state, constants, w = loop.state, loop.constants, loop.w
    w.impact.after[:], w.tip.p[:], w.friction.direction[:] = (
        [0.0, *(constants.stick_speed * np.array(slip))],
        [1.0, 2.0, 3.0],
        [0.6, -0.8],
    )
    w.tip.anchor[:], state.event.kind = 0.0, TOUCHDOWN
    interpreted(apply_impact)(w, constants, state, np.zeros((3, EVENT_WIDTH)))
    stuck = np.linalg.norm(slip) < 1.0
    assert state.mode == (STUCK if stuck else PRESSED)
    np.testing.assert_array_equal(w.tip.anchor, w.tip.p if stuck else 0.0)
    np.testing.assert_allclose(w.friction.direction, slip / np.linalg.norm(slip) if any(slip) else [0.6, -0.8])


def no_rows(state):
    """A record of nothing."""
    return np.zeros((state.settings.steps + 1, 1))


@pytest.mark.parametrize("contact", ["rigid", "pulling", "soft", "soft and pulling"])
def test_slip_begins_where_it_is_driven_on(contact):
    """Of the directions in which the tip then accelerates, μ|f| against it, the fastest; by a search of its own."""
    pulls, soft = "pulling" in contact, "soft" in contact
    changes = (
        STICKING | (SOFT if soft else {}) | ({"surface.contact": "bilateral", "surface.gap": 0.0} if pulls else {})
    )
    loop, _, rng = loop_at_random("wam_bounce", changes)
    state, w, mu = loop.state, loop.w, STICKING["friction.coefficient"]
    angles, compared = np.linspace(0.0, 2.0 * np.pi, 721), 0
    for trial in range(12):
        root = rng.normal(size=(3, 3))
        w.tip.S[:], w.tip.a[:] = (
            root @ root.T + 0.3 * np.eye(3),
            [-rng.uniform(1.0, 3.0), *rng.normal(scale=3.0, size=2)],
        )
        if trial == 0:  # along the first tangent, where a search over the circle begins and ends
            w.tip.S[:], w.tip.a[:] = np.diag([1.0, 2.0, 1.0]), [-1.0, 3.0, 0.0]
        if trial == 1:  # faster along the first tangent, where it would turn
            w.tip.S[:], w.tip.a[:] = [[1.0, 0.0, 0.0], [0.0, 1.8, 3.3], [0.0, 3.3, 16.5]], [-1.0, 1.9, 4.6]
        w.tip.a[0] *= -1.0 if pulls else 1.0
        given = rng.uniform(0.5, 2.0) * (-1.0 if pulls else 1.0)

        def onset(angle, given=given):
            d = np.array([np.cos(angle), np.sin(angle)])
            rub = -mu * d if pulls else mu * d
            f = given if soft else -w.tip.a[0] / (w.tip.S[0, 0] - w.tip.S[0, 1:] @ rub)
            slip = w.tip.a[1:] + w.tip.S[1:, 0] * f - f * w.tip.S[1:, 1:] @ rub
            return d[0] * slip[1] - d[1] * slip[0], d @ slip

        across = np.array([onset(angle)[0] for angle in angles])
        found = []
        for k in np.flatnonzero(across[:-1] * across[1:] <= 0.0):
            angle = brentq(lambda x: onset(x)[0], angles[k], angles[k + 1], xtol=1e-15)
            found.append((onset(angle)[1], np.cos(angle), np.sin(angle)))
        if max(found)[0] < 0.1:
            continue
        compared += 1
        w.friction.slip[:], w.friction.delayed_slip, w.friction.direction[:], w.tip.F[0] = 1.0, 1.0, np.nan, given
        interpreted(find_direction)(w, state)
        np.testing.assert_allclose(w.friction.direction, max(found)[1:], atol=1e-12)
    assert compared > 5


@pytest.mark.parametrize("soft", [False, True])
@pytest.mark.parametrize("case", ["held", "reversed", "let go", "fast", "unloaded"])
def test_the_end_of_stick_or_slip(case, soft):
    """The mode and the event that follow; what is left of the tip's velocity goes by an impulse, whose loss is booked.

    On a soft surface the impulse is along it.
    """
    loop, H, _ = loop_at_random("wam_bounce", STICKING | (SOFT if soft else {}))
    state, constants, w = loop.state, loop.constants, loop.w
    stuck = case in ("let go", "unloaded")
    share = {"held": 0.9, "reversed": 1.1}.get(case, 1.0) * 0.4 * np.array([-0.6, 0.8])
    force = 5.0 * np.array([1.0, *(0.0 * share if case == "unloaded" else share)])
    w.tip.carried[:], w.friction.direction[:], w.tip.p[:], state.mode = (
        0.0,
        [1.0, 0.0],
        [1.0, 2.0, 3.0],
        STUCK if stuck else PRESSED,
    )
    w.v[:] = w.v if case == "fast" else 1e-8 * w.v
    w.tip.u[:], w.tip.a[:], w.tip.F[:], w.tip.rigid_force = w.tip.A @ w.v, -w.tip.S @ force, force, force[0]
    w.impact.before[:], w.impact.after[:], w.impact.compression[:], w.impact.decompression[:] = (
        w.tip.u,
        w.tip.u,
        0.0,
        0.0,
    )
    v, events, w.start.slip_speed = w.v.copy(), np.zeros((3, EVENT_WIDTH)), 1e-6  # of a tip that had drifted
    state.phase, w.friction.stick_limit = AT_EVENT, np.nan
    assert interpreted(end_stick_or_slip)(w, constants, state, no_rows(state), events) == NEED_TERMS
    assert state.phase == AFTER_EVENT
    kind = {"held": STICK, "reversed": REVERSAL, "let go": SLIP_AGAIN}.get(case)
    assert state.mode == (STUCK if case in ("held", "unloaded") else PRESSED)
    assert state.event.rows == (kind is not None)
    lost = 0.5 * v @ H @ v - 0.5 * w.v @ H @ w.v
    event = EventRow(events[0])
    assert event.energy_lost == pytest.approx(lost, rel=1e-7, abs=0.0)
    assert w.supply.energy == -event.energy_lost
    if kind is not None:
        assert event.kind == kind
    if case in ("held", "let go"):
        assert lost > 0.0
        first = 1 if soft else 0
        np.testing.assert_allclose((w.tip.A @ w.v)[first:], 0.0, atol=1e-22)
        np.testing.assert_allclose(event.rate_after, w.tip.A[0] @ w.v, atol=1e-22)
        impulse = np.linalg.solve(np.linalg.qr(w.tip.A.T)[1], np.linalg.qr(w.tip.A.T)[0].T @ (H @ (w.v - v)))
        np.testing.assert_allclose(H @ (w.v - v), w.tip.A.T @ impulse, atol=1e-20)
        assert abs(impulse[0]) < 1e-20 or not soft
    else:
        np.testing.assert_array_equal(w.v, v)
    if case in ("let go", "reversed"):  # its slip starts from rest: a rounding of u against the slip is no end of it
        w.tip.u[1:], before = -1e-17 * w.friction.direction, w.start.slip_speed
        assert (before, interpreted(slip_margin)(w, constants) > 0.0) == (0.0, True)
        w.tip.u[:] = w.impact.before
    np.testing.assert_array_equal(w.tip.anchor, w.tip.p if case == "held" else loop.w.tip.anchor)
    ahead = {"fast": w.tip.u[1:], "let go": -force[1:]}.get(case, [1.0, 0.0])
    if case == "reversed":  # driven on against friction
        f = 5.0 if soft else -w.tip.a[0] / (w.tip.S[0, 0] - 0.4 * w.tip.S[0, 1:] @ w.friction.direction)
        ahead = w.tip.a[1:] + f * (w.tip.S[1:, 0] - 0.4 * w.tip.S[1:, 1:] @ w.friction.direction)
    np.testing.assert_allclose(w.friction.direction, ahead / np.linalg.norm(ahead), atol=1e-12)


def test_a_tip_that_lifts_off_leaves_what_is_left_of_its_rate():
    """The closure's rate that a stabiliser had not yet removed is projected out, and its energy is booked."""
    loop, H, _ = loop_at_random("wam_bounce", {})
    state, constants, w = loop.state, loop.constants, loop.w
    w.tip.carried[:], w.tip.u[:], w.tip.gap, w.tip.rigid_force, state.mode, state.cleared = (
        0.0,
        w.tip.A @ w.v,
        0.0,
        -1.0,
        PRESSED,
        1,
    )
    v, events = w.v.copy(), np.zeros((3, EVENT_WIDTH))
    interpreted(apply_event)(H, w, constants, state, no_rows(state), events)
    assert (state.mode, state.cleared, state.event.kind, state.event.rows) == (FREE, 0, LIFTOFF, 1)
    assert interpreted(project)(H, w, constants, state) == NEED_TERMS
    assert state.phase == AFTER_EVENT
    assert abs(w.tip.A[0] @ w.v) < 1e-12
    event = EventRow(events[0])
    assert event.energy_lost == pytest.approx(0.5 * v @ H @ v - 0.5 * w.v @ H @ w.v, rel=1e-10)
    assert w.supply.energy == -event.energy_lost
    assert (event.rate_before, event.rate_after) == (w.tip.u[0], 0.0)


@pytest.mark.parametrize("stuck", [False, True])
def test_projection_is_the_smallest_move_that_closes(stuck):
    """First of q, as often as it may be, then of q̇: by H⁻¹Aᵀ, along the normal or of the whole tip if it sticks."""
    loop, H, rng = loop_at_random("wam_bounce", STICKING)
    state, constants, w = loop.state, loop.constants, loop.w
    state.mode, state.projection.next_phase = STUCK if stuck else PRESSED, STEP_END
    w.tip.carried[:], w.tip.anchor[:] = 0.0, 3.0
    rows = w.tip.A[: 3 if stuck else 1].copy()
    back = np.linalg.solve(H, rows.T) @ np.linalg.inv(rows @ np.linalg.solve(H, rows.T))
    for gap, moves, closes in (
        (1e-3, 0, False),
        (0.0, 1, not stuck),
        (1e-16, REFINEMENTS, True),
        (1e-3, REFINEMENTS, True),
    ):
        off = np.array([gap, 0.0 if closes else 2e-3, 0.0 if closes else -1e-3])
        w.tip.gap, w.tip.p[:], w.v[:], w.q[:] = gap, w.tip.anchor + off, rng.normal(size=4), 0.0
        w.tip.u[:], state.projection.moves, q, v = w.tip.A @ w.v, moves, w.q.copy(), w.v.copy()
        assert interpreted(project)(H, w, constants, state) == NEED_TERMS
        assert (state.phase, state.projection.moves) == ((STEP_END, moves) if closes else (PROJECTION, moves + 1))
        np.testing.assert_allclose(w.q, q if closes else q - back @ off[: len(rows)], atol=1e-15)
        np.testing.assert_allclose(w.v, v - back @ rows @ v if closes else v, atol=1e-12)


def test_projection_leaves_a_tip_that_has_no_way_along_the_normal():
    """In a singular pose there is no move that closes, and none is made."""
    loop, H, _ = loop_at_random("wam_bounce", {})
    state, constants, w = loop.state, loop.constants, loop.w
    state.mode, w.tip.A[0], w.tip.gap, w.tip.u[0] = PRESSED, 0.0, 1e-6, 1e-3
    q, v = w.q.copy(), w.v.copy()
    for _ in range(REFINEMENTS + 1):
        assert interpreted(project)(H, w, constants, state) == NEED_TERMS
    assert state.phase != PROJECTION
    np.testing.assert_array_equal([w.q, w.v], [q, v])


@pytest.mark.parametrize("mode", [FREE, PRESSED, STUCK])
def test_an_event_in_contact_is_applied_where_its_mode_has_ended_and_not_where_it_is_about_to(mode):
    """A gap of zero is no gap: a tip that leaves a soft surface slowly has it for longer than the search resolves.

    Applied there, liftoff changed nothing, and came again at the same instant until the run was said to chatter.
    """
    loop, _, _ = loop_at_random("wam_bounce", SOFT)
    state, w = loop.state, loop.w
    ends = 3e-14  # so long is the gap zero to the last bit
    state.mode, state.trial.purpose, state.trial.steps, w.length = mode, LOCATE_EVENT, 0, 1e-3
    w.search.low, w.search.high, w.search.at_low, w.search.at_high = 0.0, 1e-3, 0.0, -1e-3
    for _ in range(200):
        if state.trial.purpose == REACH_EVENT:
            break
        w.search.tau = 0.5 * (w.search.low + w.search.high) if w.search.tau <= 0.0 else w.search.tau
        w.search.value = 0.0 if w.search.tau <= ends else ends - w.search.tau
        interpreted(refine_bracket)(w, state)
    assert w.search.low <= ends < w.search.high <= w.search.low + INSTANT
    assert w.search.tau == (w.search.low if mode == FREE else w.search.high)


def test_events_without_end_stop_the_run_and_are_told_apart():
    """Too many at one instant say what alternated; too many in the latest steps are too many, wherever they are."""
    loop, _, _ = loop_at_random("wam_bounce", STICKING)
    state, most = loop.state, 20
    for kind, status in ((SLIP_AGAIN, RUBS), (STICK, RUBS), (REVERSAL, RUBS), (LIFTOFF, CHATTER), (TOUCHDOWN, CHATTER)):
        for rapid, events, told in ((most, MAX_IN_STEP, 0), (most + 1, 1, status), (0, MAX_IN_STEP + 1, CROWDED)):
            state.event.kind, state.event.rapid, state.event.in_step, state.status = kind, rapid, events, 0
            assert interpreted(too_many_events)(state, most) == (told != 0)
            assert state.status == told
    problem = cl.prepare(cl.load_scenario("wam_bounce"))
    alternating, crowded = (
        failure_of(status, 0.25, problem.robot, problem, None, problem.q, problem.v) for status in (RUBS, CROWDED)
    )
    assert "stick and slip alternate" in str(alternating)
    assert f"more than {MAX_IN_STEP} times" in str(crowded)
    assert all("torque presses" not in str(error) and error.time == 0.25 for error in (alternating, crowded))
