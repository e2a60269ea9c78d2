"""What becomes of a contact in an event: its mode by force and acceleration, and what is told of it."""

import itertools
from types import SimpleNamespace

import numpy as np
import pytest
from contact_mobility import write_own_mobilities

from closedloop.jit.interpreted import interpreted
from closedloop.loop.events.contacts import apply_contact_event, log_contacts, resume_with_contacts
from closedloop.loop.events.locate import APPLY_EVENT, AT_EVENT, ENLARGE_TABLE
from closedloop.loop.events.table import EVENT_WIDTH, LIFTOFF, RELEASE, STOP, EventRow
from closedloop.loop.step.contacts import margin_of, save_contacts
from closedloop.mechanics.closure.contact_force import FREE, PRESSED, STUCK
from closedloop.mechanics.closure.solve import OK, PAINLEVE
from closedloop.mechanics.contacts.impact import STRUCK_AND_LEFT, STRUCK_AND_STAYED, apply_impulses
from closedloop.mechanics.contacts.memory import CONE, DOUBLE, OFF, RAY, make_contact_memory
from closedloop.mechanics.contacts.modes import (
    CAME,
    LEFT,
    SLIPPED,
    STUCK_NOW,
    TURNED_ROUND,
    carries_nothing,
    choose_kinds,
    decide,
    happened_to,
    mode_after,
)
from closedloop.mechanics.contacts.time_step import TANGENTIAL_IMPACT, TIME_STEP, begin_time_step
from closedloop.mechanics.limits import BEYOND_EDGE, CLOSED, HOVERING, OFF_SURFACE, STICK_SPEED, TIME_STEP_SPAN

NOTHING = 1e-9


@pytest.fixture
def memory():
    """Two contacts, of which the second is asked about: one kilogram in all directions, at rest, touching."""
    memory = make_contact_memory(6, 2)
    c = memory.contacts
    c.X[:] = np.eye(6)
    c.mu[:], c.mode[:], c.load[:] = 0.5, [FREE, PRESSED], 1.0
    write_own_mobilities(c)
    c.located[0], c.direction[1] = 1.0, [0.6, 0.8]
    return memory


def test_a_time_step_where_no_modes_agree(memory):
    """A contact that pressing harder pulls in has no force; the impulse of a step stops it, as its equations say."""
    links, c = memory
    touching, mu, h = slice(3, 6), 2.0, TIME_STEP_SPAN
    c.X[touching] = 0.0
    c.X[touching, 3:] = np.linalg.cholesky([[1.0, 0.8, 0.0], [0.8, 1.0, 0.0], [0.0, 0.0, 1.0]])
    write_own_mobilities(c)
    c.mu[1], c.u[touching], c.a[touching] = mu, [0.0, 0.5, 0.0], [-9.81, 0.0, 0.0]
    c.load[3:] = np.linalg.solve(c.X[touching, 3:], c.a[touching])
    assert interpreted(decide)(links, c, 1e-7) == PAINLEVE
    c.step.struck = 3.0  # there was a tangential impact at this instant
    interpreted(begin_time_step)(links, c, 3.0)
    P = h * c.step.force[touching]
    np.testing.assert_allclose(P, -np.linalg.solve(c.S[1], c.u[touching] + h * c.a[touching]), rtol=1e-8)
    assert np.hypot(P[1], P[2]) < mu * P[0]
    assert (c.mode[1], c.event.happened[1], links.stepped) == (PRESSED, TIME_STEP, 1)
    assert c.step.end == 3.0 + h
    np.testing.assert_array_equal(c.F, 0.0)
    np.testing.assert_array_equal(c.problem.after, c.u)


@pytest.mark.parametrize(("near", "mu"), list(itertools.product((0.1, 0.5, 0.8), (1.5, 2.5, 9.0, 11.0))))
def test_a_tangential_impact_stops_a_slip_that_pulls_in(memory, near, mu):
    """By the one impulse that is not zero and stops it: -W^-1 u, inside the cone, of the energy that it takes."""
    links, c = memory
    touching = slice(3, 6)
    W = np.array([[1.0, near, 0.0], [near, 1.0, 0.0], [0.0, 0.0, 1.0]])
    c.X[touching] = 0.0
    c.X[touching, 3:] = np.linalg.cholesky(W)
    write_own_mobilities(c)
    c.mu[1], c.u[touching], c.a[touching] = mu, [0.0, 0.5, 0.0], [-9.81, 0.0, 0.0]
    c.load[3:] = np.linalg.solve(c.X[touching, 3:], c.a[touching])
    interpreted(begin_time_step)(links, c, 3.0)
    pulls_in = mu * near > 1.0  # then f (1, -mu) is no force off the surface, and -W^-1 u is in the cone
    assert c.step.at_once == pulls_in
    assert c.event.happened[1] == (TANGENTIAL_IMPACT if pulls_in else TIME_STEP)
    assert links.stepped == (not pulls_in)
    if pulls_in:
        np.testing.assert_allclose(c.F[touching], -np.linalg.solve(W, c.u[touching]), rtol=1e-9)
        np.testing.assert_allclose(c.problem.after[touching], 0.0, atol=1e-12)
        np.testing.assert_allclose(c.event.energy_lost, 0.5 * c.u[4] ** 2 / (1.0 - near**2), rtol=1e-9)
        assert c.mode[1] == PRESSED


def test_what_is_told_of_a_contact(memory):
    """Of every mode before and after; an impact has been told already, and where it turns round it was at rest."""
    c = memory.contacts
    told = {
        (FREE, PRESSED): CAME, (FREE, STUCK): CAME, (PRESSED, FREE): LEFT, (STUCK, FREE): LEFT,
        (PRESSED, STUCK): STUCK_NOW, (STUCK, PRESSED): SLIPPED,
    }  # fmt: skip
    for before, after, struck, turned, kind in itertools.product(
        (FREE, PRESSED, STUCK), (FREE, PRESSED, STUCK), (0.0, 1.0), (0.0, 1.0), (RAY, CONE)
    ):
        c.mode[1], c.event.struck[1], c.event.turned[1], c.problem.form[1] = before, struck, turned, kind
        expected = told.get((before, after), 0.0)
        if before == after == PRESSED and turned and kind == CONE:
            expected = TURNED_ROUND
        if struck and before != FREE and after != FREE:
            expected = 0.0
        assert interpreted(happened_to)(c, 1, after) == expected


def test_mode_and_direction_by_force_and_acceleration(memory):
    """It parts where it accelerates away; else it slips or sticks."""
    c = memory.contacts
    after = interpreted(mode_after)
    c.problem.form[:], c.F[3], c.problem.rounding = [OFF, CONE], 1.0, 1e-9
    assert after(c, 0, NOTHING) == FREE
    assert after(c, 1, NOTHING) == STUCK
    c.problem.after[3] = 2 * NOTHING
    assert after(c, 1, NOTHING) == FREE
    c.problem.after[3] = 0.0
    for slip, turned in (([3.0, -4.0], 1.0), ([4.0, -2.9], 0.0), ([-5.0, 3.0], 1.0), ([-1.0, 1.0], 0.0)):
        c.direction[1], c.problem.after[4:6] = [0.6, 0.8], slip
        c.event.turned[1] = 1.0 - turned
        assert after(c, 1, NOTHING) == PRESSED
        assert c.event.turned[1] == turned
        np.testing.assert_allclose(c.direction[1], slip / np.linalg.norm(slip))
    c.problem.form[1], c.direction[1], c.event.turned[1] = RAY, [-0.28, 0.96], 1.0
    assert after(c, 1, NOTHING) == PRESSED
    assert c.event.turned[1] == 0.0
    np.testing.assert_array_equal(c.direction[1], [-0.28, 0.96])
    c.friction.pulls[1], c.problem.form[1], c.problem.after[3:6] = 1.0, DOUBLE, [2 * NOTHING, 0.0, 0.0]
    assert after(c, 1, NOTHING) == STUCK  # what cannot part


def test_a_contact_at_its_limit_slips_if_it_is_found_to_stick_again_and_again(memory):
    """Against the friction that would have to hold it; only after many events in a row, and only at its limit."""
    c = memory.contacts
    after = interpreted(mode_after)
    c.problem.form[1], c.F[3:] = CONE, [1.0, 0.3, -0.4]
    for many, outside, mode in ((True, 1.0, PRESSED), (True, 0.0, STUCK), (False, 1.0, STUCK)):
        c.event.outside[1] = outside
        assert after(c, 1, NOTHING, many) == mode
    c.event.outside[1] = 1.0
    after(c, 1, NOTHING, True)
    np.testing.assert_allclose(c.direction[1], [-0.6, 0.8])


@pytest.mark.parametrize(("lift", "mode"), [(1.0, FREE), (-1.0, STUCK)])
def test_where_it_parts_and_where_it_sticks_is_kept(memory, lift, mode):
    """The gap at which it parted if that was inside; the place where it sticks; impulses take what is left of slip."""
    links, c = memory
    c.located[3], c.gaps.floor[1], c.gaps.cleared[1], c.at[3:] = -2e-9, 0.5, 1.0, [7.0, 8.0, 9.0]
    c.a[3], c.u[4], c.size[3:] = lift, 1e-10, 1.0
    assert interpreted(decide)(links, c, 1e-6) == OK
    assert c.mode[1] == mode
    assert c.event.happened[1] == (LEFT if mode == FREE else STUCK_NOW)
    np.testing.assert_array_equal(c.anchor[3:], 0.0 if mode == FREE else [7.0, 8.0, 9.0])
    assert (c.gaps.cleared[1], c.gaps.floor[1]) == ((0.0, -2e-9) if mode == FREE else (1.0, 0.5))
    np.testing.assert_allclose(c.F, [0, 0, 0, 0, 0 if mode == FREE else -1e-10, 0], atol=1e-24)
    assert c.event.energy_lost == pytest.approx(0.0 if mode == FREE else 0.5e-20, rel=1e-6)
    assert c.gaps.floor[0] == 0.0


def test_kinds_by_slip(memory):
    """Free where it does not touch or parts; in the cone where it hardly slips; else against its slip."""
    links, c = memory
    c.a[:], c.size[:] = 0.0, 3.0
    for slip, kind in (([0, 0], CONE), ([1e-7, 0], CONE), ([-1e-7, 0], CONE), ([3e-3, 4e-3], RAY), ([-3e-3, 0], RAY)):
        c.u[4:6] = slip
        assert interpreted(choose_kinds)(links, c, 5e-7) == 3.0
        assert list(c.problem.form) == [OFF, kind]
        speed = np.linalg.norm(slip)
        np.testing.assert_allclose(c.problem.along[1], 0.5 * np.array(slip) / speed if kind == RAY else 0.0)
    c.mu[1] = 0.0
    interpreted(choose_kinds)(links, c, 5e-7)
    assert c.problem.form[1] == RAY
    np.testing.assert_array_equal(c.problem.along[1], 0.0)
    c.mode[1], c.u[3] = FREE, 1e-3
    interpreted(choose_kinds)(links, c, 5e-7)
    assert list(c.problem.form) == [OFF, OFF]


@pytest.mark.parametrize(("rest_speed", "tired", "bounces"), [(0.9, 0, True), (1.1, 0, False), (0.9, 1, False)])
def test_a_contact_that_strikes_leaves_or_stays(memory, rest_speed, tired, bounces):
    """With restitution 0.5, unless that is too slow or there were many; what pulled before is told by its force."""
    links, c = memory
    c.mode[:], c.restitution[:], links.chattering = [STUCK, FREE], 0.5, tired
    c.u[:] = [0, 0, 0, -2.0, 0, 0]
    c.located[3], c.gaps.floor[1], c.rigid[0] = -1e-13, 0.5, -1.0
    assert interpreted(apply_impulses)(links, c, rest_speed) == OK
    assert list(c.event.struck) == [0.0, 1.0]
    assert list(c.event.happened) == [0.0, STRUCK_AND_LEFT if bounces else STRUCK_AND_STAYED]
    assert list(c.mode) == [STUCK, FREE if bounces else PRESSED]
    assert (c.gaps.cleared[1], c.gaps.floor[1]) == ((1.0, -1e-13) if bounces else (0.0, 0.5))
    np.testing.assert_allclose(c.problem.after[3:], [1.0 if bounces else 0.0, 0, 0], atol=1e-12)
    assert c.event.energy_lost == pytest.approx(1.5 if bounces else 2.0)
    assert c.event.restitution_share == 1.0
    assert list(c.event.pulled) == [1.0, 0.0]


def test_what_does_not_come_together_does_not_strike(memory):
    """A contact that also pulls, one that is off the surface or parts, and one that was closed."""
    links, c = memory
    c.u[:] = [-2.0, 0, 0, -2.0, 0, 0]
    for case in ("line", "off", "parts", "closed"):
        c.mode[1], c.friction.pulls[1], c.located[3], c.u[3] = FREE, 0.0, 0.0, -2.0
        if case == "line":
            c.friction.pulls[1] = 1.0
        elif case == "off":
            c.located[3] = 1e-3
        elif case == "parts":
            c.u[3] = 2.0
        else:
            c.mode[1] = STUCK
        assert interpreted(apply_impulses)(links, c, 0.0) == OK
        np.testing.assert_array_equal(c.F, 0.0)
        np.testing.assert_array_equal(c.problem.after, c.u)
        assert list(c.event.happened) == list(c.event.struck) == list(c.event.pulled) == [0.0, 0.0]


@pytest.mark.parametrize("struck", [0.0, 1.0])
def test_each_contact_to_which_something_happened_has_its_row(struck):
    """Rates, slips, impulses and place; the loss once, and what the surfaces gave by their motion; stops by their own
    names.
    """
    links, c = make_contact_memory(4, 4, stops=2)
    rng = np.random.default_rng(0)
    for array in (c.F, c.before, c.problem.after, c.event.axes, c.event.point, c.carried):
        array[:] = rng.normal(size=array.shape)
    c.event.happened[:] = [0.0, STRUCK_AND_LEFT, LIFTOFF, STRUCK_AND_STAYED]
    c.event.struck[:], c.event.energy_lost = struck, 0.7
    c.before[[3, 6, 9]], c.problem.after[[3, 6, 9]] = [-2.0, -2.0, -2.0], [0.5, -0.5, 0.0]
    supply, tip = SimpleNamespace(energy=1.0), SimpleNamespace(carried=rng.normal(size=3))
    w, events = SimpleNamespace(time=0.3, supply=supply, tip=tip), np.full((5, EVENT_WIDTH), np.nan)
    state = SimpleNamespace(event=SimpleNamespace(rows=1), striking=-1, loops=SimpleNamespace(frames=0))
    interpreted(log_contacts)(w, links, c, state, events)
    assert state.event.rows == 4
    assert np.all(np.isnan(events[[0, 4]]))
    for row, i, kind, lost in ((1, 1, STRUCK_AND_LEFT, 0.7), (2, 2, RELEASE, 0.0), (3, 3, STOP, 0.0)):
        event, at = EventRow(events[row]), 3 * i
        assert (event.time, event.kind, event.contact, event.energy_lost) == (0.3, kind, i, lost)
        assert (event.rate_before, event.rate_after, event.compression) == (c.before[at], c.problem.after[at], c.F[at])
        assert event.slip_before == pytest.approx(np.linalg.norm(c.before[at + 1 : at + 3]), rel=1e-15)
        assert event.slip_after == pytest.approx(np.linalg.norm(c.problem.after[at + 1 : at + 3]), rel=1e-15)
        assert event.restitution == (0.25 if i == 1 and struck else 0.0)
        np.testing.assert_allclose(event.tangential, c.F[at + 1 : at + 3] @ c.event.axes[at + 1 : at + 3], rtol=1e-14)
        np.testing.assert_array_equal(event.position, c.event.point[i])
    carried = np.r_[w.tip.carried, c.carried[3:]]
    assert w.supply.energy == pytest.approx(1.0 - 0.7 + c.F @ carried, rel=1e-14)


def test_an_event_waits_for_room_in_the_table():
    """Three rows for each contact; and where modes are known, one that does not last is an event."""
    links, _ = make_contact_memory(2, 2)
    at, count = SimpleNamespace(at=links.address), SimpleNamespace(rows=7, stepping=0)
    state = SimpleNamespace(contacts=at, event=count, phase=-1)
    assert interpreted(apply_contact_event)(None, None, state, np.zeros((10, EVENT_WIDTH))) == ENLARGE_TABLE
    assert state.phase == AT_EVENT
    decided = interpreted(resume_with_contacts)
    assert decided(SimpleNamespace(contacts=SimpleNamespace(margin=-1e-9)), None, state, None) == APPLY_EVENT


def test_the_margin_of_contacts_is_what_is_left_of_their_modes(memory):
    """Of the gap, the pressure, the cone and the speed along the old direction, the least; what also pulls has none."""
    c, slow, margin = memory.contacts, 1e-7, interpreted(margin_of)
    c.located[0], c.problem.rounding, c.direction[1] = 100.0, 1e-9, [0.6, 0.8]
    c.mode[1], c.located[3] = FREE, 1e-9
    for risen, floor, touches_at in (
        (0.0, 0.0, -OFF_SURFACE), (0.0, -5e-11, -OFF_SURFACE), (0.0, -OFF_SURFACE, -OFF_SURFACE - CLOSED),
        (1.0, 0.0, -CLOSED), (1.0, -5e-11, -5e-11 - CLOSED),
    ):  # fmt: skip
        c.gaps.cleared[1], c.gaps.floor[1] = risen, floor
        assert margin(memory.links, c, 2, slow, 0.0, 1e-3) == pytest.approx(1e-9 - touches_at, rel=1e-14)
    c.mode[1], c.rigid[3:], c.mu[1] = STUCK, [5.0, 0.9, 1.2], 0.5
    assert margin(memory.links, c, 2, slow, 0.0, 1e-3) == pytest.approx(1.0 + 1e-9, rel=1e-14)
    c.rigid[3:] = [5.0, 0.0, 0.0]
    assert margin(memory.links, c, 2, slow, 0.0, 1e-3) == pytest.approx(2.5 + 1e-9, rel=1e-14)
    c.mode[1], c.u[3:], c.rigid[3:] = PRESSED, [9.0, 0.3, 0.4], [5.0, 9.0, 9.0]
    for start, rest, added in (
        (1e-3, 0.0, 0.0), (1e-10, 0.0, slow), (1e-8, 0.0, -1e-9), (1e-3, 2e-7, -2e-7), (1.5e-7, 2e-7, -1.5e-8)
    ):  # fmt: skip
        c.friction.start_slip[1] = start
        assert margin(memory.links, c, 2, slow, rest, 1e-3) == pytest.approx(0.5 + added, rel=1e-14)
    c.mu[1] = 0.0
    assert margin(memory.links, c, 2, slow, 0.0, 1e-3) == pytest.approx(5.0 + 1e-9, rel=1e-14)
    c.friction.pulls[1] = 1.0
    assert margin(memory.links, c, 2, slow, 0.0, 1e-3) == pytest.approx(100.0, rel=1e-6)
    c.mode[1], c.mu[1], c.rigid[3:] = STUCK, 0.5, [-5.0, 0.9, 1.2]
    assert margin(memory.links, c, 2, slow, 0.0, 1e-3) == pytest.approx(1.0 + 1e-9, rel=1e-14)
    c.inside[1] = 0.25
    assert margin(memory.links, c, 2, slow, 0.0, 1e-3) == 0.25
    c.mode[1], c.friction.pulls[1], c.past_edge[1] = FREE, 0.0, 1.0  # beyond its edge, until it is inside again
    for gap, inside, left in (
        (0.0, -0.25, 0.25 + HOVERING),
        (-BEYOND_EDGE, 0.25, HOVERING - 0.25),
        (-1.1 * BEYOND_EDGE, 0.25, 100.0),
    ):
        c.located[3], c.inside[1] = gap, inside
        assert margin(memory.links, c, 2, slow, 0.0, 1e-3) == pytest.approx(left, rel=1e-6)


def test_what_a_substep_begins_with_is_kept(memory):
    """The speed of slip unless it is clear, the direction of what slides, and that a contact has come clear."""
    links, c = memory
    for mode, slip, clear in itertools.product((FREE, PRESSED, STUCK), ([0.3, -0.4], [3e-8, 4e-8]), (True, False)):
        c.mode[1], c.u[4:], c.direction[1], c.gaps.cleared[1], c.gaps.floor[1] = mode, slip, [1.0, 0.0], 0.0, -0.5
        c.located[3], c.friction.start_slip[1] = (2.0 if clear else 0.5) * HOVERING, -1.0
        interpreted(save_contacts)(links, c)
        speed = np.linalg.norm(slip)
        kept = -1.0 if mode == FREE and clear else speed
        assert c.friction.start_slip[1] == pytest.approx(kept, rel=1e-15)
        slides = mode == PRESSED and speed > STICK_SPEED
        np.testing.assert_allclose(c.direction[1], np.array(slip) / speed if slides else [1.0, 0.0])
        assert (c.gaps.cleared[1], c.gaps.floor[1]) == ((1.0, 0.0) if clear else (0.0, -0.5))


def test_a_contact_that_carries_nothing_is_open(memory):
    """One that its mode had pull or leave its cone, and one that was open and has not come closer; no other."""
    links, c = memory.links, memory.contacts
    nothing = interpreted(carries_nothing)
    c.mode[1], c.F[3], c.problem.rounding, links.fresh = STUCK, 0.5e-9, 1e-9, 0
    assert not nothing(links, c, 1)
    for flag in (c.event.pulled, c.event.outside):
        flag[1], c.F[3] = 1.0, 0.5e-9
        assert nothing(links, c, 1)
        c.F[3] = 1.0
        assert not nothing(links, c, 1)
        flag[1] = 0.0
    c.mode[1], c.F[3], c.gaps.cleared[1], c.gaps.floor[1] = FREE, 0.0, 0.0, 0.0
    cases = ((0.0, 0, 0, True), (-2 * HOVERING, 0, 0, False), (0.0, 1, 0, False), (0.0, 0, 1, False))
    for gap, struck, fresh, opened in cases:
        c.located[3], c.event.struck[1], links.fresh = gap, struck, fresh
        assert nothing(links, c, 1) == opened
