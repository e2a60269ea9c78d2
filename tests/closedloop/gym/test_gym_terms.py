"""What rewards, endings and observations are computed from, in numbers; and what is counted over an episode."""

import numpy as np
import pytest

from closedloop.base.errors import ScenarioError
from closedloop.gym import terms
from closedloop.gym.core import Actions
from closedloop.gym.env import ContactEnv, ContactVectorEnv
from closedloop.gym.terms import PARTS, TRUTH, Now, Observations, Range, as_ranges, drawn
from closedloop.loop.step.record_row import ContactRow, Row
from closedloop.mechanics.closure.contact_force import FREE, PRESSED, STUCK
from closedloop.simulation.ensemble.member import Between

N, K, CONTACTS, STATES = 2, 3, 2, 1


def now_of(count=1, period=0.02, **given):
    """Return the state of so many environments, all zero but for what is given, by the names of its attributes."""
    rows = np.zeros((count, Row.count(N) + ContactRow.count(CONTACTS) + STATES))
    now = Now(rows, np.zeros((count, 2 * N + 10)), np.zeros((count, len(Between.__annotations__))), N, K, period,
              CONTACTS, STATES)  # fmt: skip
    now.steps = 20
    now._mode[:] = given.pop("mode", FREE)
    now._free[:] = np.asarray(given.pop("free_share", 0.0)) * now.steps
    for name, values in given.items():
        getattr(now, name)[:] = values
    return now


TERMS = [
    ("force", {"f": [15, 5, 30, 10], "f_des": 10}, [-0.5, -0.5, -1, 0]),
    ("force", {"f": [0.75, -8, -30], "f_des": [0.5, -10, -10]}, [-0.25, -0.2, -1]),
    ("path", {"path_error": [0, 0.004, 0.02]}, [0, -0.4, -1]),
    ("smooth", {"action": [[1, -1, 0], [1, 1, 1]], "action_before": [[-1, -1, 1], [-1, -1, -1]]}, [-5 / 12, -1]),
    ("overload", {"largest_force": [20, 25, 25, 0, 1.5], "f_des": [10, 10, -10, 10, 0.5]}, [0, -0.5, -0.5, 0, 0]),
    ("overload", {"largest_force": [40], "f_des": [10]}, [-1]),
    ("loss", {"touched": [False, True, True], "free_share": [0.5, 0.5, 0]}, [0, -0.5, 0]),
    ("travel", {"tip": [[0.003, 0, -0.004], [0, 1, 0]], "wanted_tip": [[0, 0, 0], [0, 0, 0]]}, [-0.5, -1]),
    ("travel", {"tip": [[0.3, 0.1, 0.2]], "wanted_tip": [[0.3, 0.1, 0.204]]}, [-0.4]),
    ("knock", {"largest_link_force": [0, 50, 200]}, [0, -0.5, -1]),
]


@pytest.mark.parametrize(("name", "given", "value"), TERMS)
def test_a_term_is_what_its_sentence_says(name, given, value):
    """Its scale, its least value, and 0 where nothing is wrong."""
    found = terms.TERMS[name](now_of(len(value), **given))
    np.testing.assert_allclose(found, value, rtol=1e-12, atol=1e-15)


ENDINGS = [
    (terms.excessive_force(30.0), {"largest_force": [30, 31, 0, 0], "largest_link_force": [0, 0, 30, 31]}, "0101"),
    (terms.jammed(0.3), {"jammed": [0.28, 0.3 - 1e-11, 0.32]}, "011"),
    (terms.lowered(0.015), {"tip": [[0, 0, -0.0149], [0, 0, -0.015], [-1, -1, 0.015]]}, "010"),
    (terms.contact_lost, {"touched": [True, True, False], "free_share": [1.0, 0.95, 1.0]}, "100"),
]  # fmt: skip


@pytest.mark.parametrize(("ending", "given", "value"), ENDINGS)
def test_an_ending_is_told_from_either_side(ending, given, value):
    """At the limit itself, just below it and just above."""
    assert "".join(str(int(x)) for x in ending(now_of(len(value), **given))) == value


def test_contacts_stand_before_the_states_of_a_law():
    """In a row the forces and the gaps of contacts come first; states of a law are at its end."""
    rows = np.arange(float(Row.count(N) + ContactRow.count(CONTACTS) + STATES))[None, :]
    now = Now(
        rows, np.zeros((1, 2 * N + 10)), np.zeros((1, len(Between.__annotations__))), N, K, 0.02, CONTACTS, STATES
    )
    places = [ContactRow.place(name, CONTACTS) for name in ("link_forces", "link_gaps")]
    of_contacts = rows[0, Row.count(N) : -STATES]
    assert [now.link_forces[0].tolist(), now.link_gaps[0].tolist()] == [of_contacts[at].tolist() for at in places]


def test_a_tip_is_held_if_it_is_slow_touches_and_is_away():
    """Each of the three from either side of 2 mm/s, of 0 N and of 2 mm."""
    now = now_of(
        7, tip_velocity=[[0, v, 0] for v in (0.0, 1.9e-3, -2.1e-3, 0.0, 0.0, 0.0, 0.0)],
        tip=[[0.1, 0, 0]] * 7, wanted_tip=[[0.1, 0, x] for x in (0.1, -2.1e-3, 0.1, 1.9e-3, 2.1e-3, 0.1, 0.1)],
        link_forces=[[0, 1], [1, 0], [1, 1], [1, 1], [1, 1], [0, 0], [-1, 0]],
    )  # fmt: skip
    assert now.held.tolist() == [True, True, False, False, True, False, False]


def test_what_is_derived_has_its_sign():
    """Modes, shares and errors; and what is known of an instant is forgotten with the next."""
    now = now_of(3, mode=[FREE, PRESSED, STUCK], f=[12, 8, 0], f_des=10, free_share=[1.0, 0.25, 0.0])
    assert now.contact.tolist() == [False, True, True]
    assert now.sticks.tolist() == [False, False, True]
    assert now.force_error.tolist() == [2, -2, -10]
    assert now.free_share.tolist() == [1.0, 0.25, 0.0]
    now.f[:] = 11
    assert now.force_error.tolist() == [2, -2, -10]
    now.changed()
    assert now.force_error.tolist() == [1, 1, 1]


def test_observations_have_their_sign_their_place_and_their_bounds():
    """Errors of joints and tip are actual minus desired, the force's is desired minus measured, as a law has it."""
    now = now_of(
        2, mode=[PRESSED, STUCK], q=[[1, 2], [3, 4]], wanted_q=[[0.5, 3], [3, 3]], tip=[[1, 2, 3], [4, 5, 6]],
        wanted_tip=[[1, 1, 4], [4, 5, 5]], f_measured=[8, 2e7], f_des=10, f=[9, 7], phase=[0.25, 1],
        action=[[1, 0, -1], [0, 0, 0]], v=[[1e7, -1e7], [0, 0]], gap=[-1e-3, 0], link_forces=[[1, 2], [3, 4]],
    )  # fmt: skip
    names = "joint_error", "tip_error", "f_measured", "force_error", "contact", "sticks", "phase", "action", "v"
    observed = Observations(names, PARTS, N, K, CONTACTS)
    expected = [
        [0.5, -1, 0, 1, -1, 8, 2, 1, 0, 0.25, 1, 0, -1, 1e6, -1e6],
        [0, 1, 0, 0, 1, 1e6, -1e6, 1, 1, 1, 0, 0, 0, 0, 0],
    ]
    assert observed.read(now).tolist() == expected
    assert observed.names == (
        "joint_error.0", "joint_error.1", "tip_error.0", "tip_error.1", "tip_error.2", "f_measured", "force_error",
        "contact", "sticks", "phase", "action.0", "action.1", "action.2", "v.0", "v.1",
    )  # fmt: skip
    assert observed.low.size == observed.high.size == len(observed.names)
    truth = Observations(("f", "gap", "link_forces"), TRUTH, N, K, CONTACTS)
    assert truth.read(now).tolist() == [[9, -1e-3, 1, 2], [7, 0, 3, 4]]


def test_what_is_counted_over_an_episode():
    """Time, both integrals of the force's error, and the time on target, from what each instant says itself."""
    env = ContactEnv("press", overrides={"time.duration": 1.0}, control_rate=50.0, ranges={}, hold=None, tolerance=2.0,
                     endings={})  # fmt: skip
    env.reset(seed=0)
    now, integral, square, on_target, random = env.core.now, 0.0, 0.0, 0.0, np.random.default_rng(0)
    seen = set()
    for k in range(1, 51):
        *_, terminated, truncated, info = env.step(random.uniform(-1.0, 1.0, 1))
        error = info["f"] - info["f_des"]
        integral += 0.02 * (info["f_des"] - now.f_measured[0]) * info["contact"]
        square += 0.02 * error * error
        on_target = on_target + 0.02 if abs(error) <= 2.0 and info["contact"] else 0.0
        seen |= {on_target > 0.0, info["contact"]}
        assert info["time"] == pytest.approx(0.02 * k, rel=1e-12)
        assert now.phase[0] == pytest.approx(k / 50, rel=1e-12)
        assert now.force_sum[0] == pytest.approx(integral, rel=1e-12)
        assert info["force_rms"] == pytest.approx(np.sqrt(square / (0.02 * k)), rel=1e-12)
        assert now.on_target[0] == pytest.approx(on_target, rel=1e-12)
        assert (terminated or truncated) == (k == 50)
    assert seen == {True, False}
    assert now.left[0] == 0
    assert info["is_success"] == (square <= 4.0 and info["path_error"] <= 5e-3)


def test_the_end_of_an_episode_is_judged_from_either_side():
    """The root of the mean square of the force's error against the tolerance, and the tip within 5 mm of its path."""

    def ended(task, tolerance):
        env = ContactEnv(task, ranges={}, tolerance=tolerance, hold=None, overrides={"time.duration": 1.2})
        env.reset(seed=0)
        over = False
        while not over:
            *_, terminated, truncated, info = env.step(env.core.actions.normal(env.core._own))
            over = terminated or truncated
        assert terminated == info["is_success"]
        return info

    first = ended("press", 0.01)
    assert first["reason"] == "time is up"
    assert first["path_error"] < 5e-3
    for share, reason in ((1.0 - 1e-9, "time is up"), (1.0 + 1e-9, "success")):
        assert ended("press", share * first["force_rms"])["reason"] == reason
    beside = ended("slide", 100.0)
    assert (beside["path_error"] <= 5e-3) == (beside["reason"] == "success")
    assert beside["path_error"] > 5e-3


def test_success_comes_after_its_time_on_target():
    """At the first instant at which it has been reached, counted from the last one off target."""
    env = ContactEnv("press", ranges={}, control_rate=50.0, hold=0.1, tolerance=5.0)
    env.reset(seed=0)
    terminated, times = False, []
    while not terminated:
        _, _, terminated, _, _ = env.step(np.zeros(1))
        times.append(env.core.now.on_target[0])
    assert times[-1] == pytest.approx(0.1)
    assert max(times[:-1]) == pytest.approx(0.08)


def test_what_an_instant_told_stays():
    """The truth of one step, and what an episode ended with, are not overwritten by the next steps."""
    many = ContactVectorEnv(2, "press", autoreset_mode="SameStep", privileged=True, overrides={"time.duration": 0.1},
                            control_rate=50.0)  # fmt: skip
    many.reset(seed=0)
    kept = []
    for k in range(7):
        seen, rewards_, _, _, infos = many.step(np.full((2, 1), 0.1 * k))
        told = [seen["policy"], seen["critic"], rewards_]
        told += [value for value in infos.values() if isinstance(value, np.ndarray) and value.dtype != object]
        if "final_obs" in infos:
            told += [part for each in infos["final_obs"] for part in each.values()]
        kept.append((told, [value.copy() for value in told]))
    assert any(len(told) > len(kept[0][0]) for told, _ in kept)
    assert all(np.array_equal(a, b) for told, copies in kept for a, b in zip(told, copies, strict=True))


def test_actions_and_their_numbers():
    """−1 and 1 are the ends, exactly; a value is the action that sets it, cut to what can be set."""
    actions = Actions.__new__(Actions)
    actions.low, actions.high = np.array([0.1, -3.0, 2.0]), np.array([20.3, 5.0, 2.0])
    assert actions.physical(np.array([[-1.0] * 3, [1.0] * 3])).tolist() == [actions.low.tolist(), actions.high.tolist()]
    np.testing.assert_allclose(actions.physical(np.array([[0.5, -0.5, 0.3]])), [[15.25, -1.0, 2.0]], rtol=1e-15)
    np.testing.assert_allclose(actions.normal(np.array([15.25, -1.0, 2.0])), [0.5, -0.5, -1.0], rtol=1e-15)
    assert actions.normal(np.array([30.0, -9.0, 9.0])).tolist() == [1.0, -1.0, 1.0]


def test_what_is_drawn_follows_its_law():
    """Uniform in the number or in its logarithm; a posture is added to home; what is given changes nothing else."""
    random = np.random.default_rng(0)
    plain, log = Range(1.0, 100.0), Range(1.0, 100.0, log=True)
    assert np.mean([plain.draw(random) for _ in range(2000)]) == pytest.approx(50.5, abs=2.0)
    assert np.median([log.draw(random) for _ in range(2000)]) == pytest.approx(10.0, rel=0.1)
    ranges = {"start.q": Range((-0.1, 0.0), (0.1, 0.0)), "a": plain}
    home = np.array([1.0, 2.0])
    one = drawn(ranges, home, np.random.default_rng(1), {})
    other = drawn(ranges, home, np.random.default_rng(1), {"a": 7.0, "b": 1})
    assert other == one | {"a": 7.0, "b": 1}
    assert one["start.q"][0] != 1.0
    assert abs(one["start.q"][0] - 1.0) <= 0.1
    assert one["start.q"][1] == 2.0
    assert set(one) == {"start.q", "a", "sensor.seed"}
    turned = ranges["start.q"].draw(np.random.default_rng(1), 2)
    np.testing.assert_array_equal(one["start.q"], home + turned)
    assert as_ranges({"a": (1, 2), "b": log}) == {"a": Range(1.0, 2.0), "b": log}
    for ends in ((0.0, np.inf), (-np.inf, 0.0), (2.0, 1.0)):
        with pytest.raises(ScenarioError, match="must be two numbers, the smaller first"):
            Range(*ends)


def test_contact_within_an_instant_is_a_touch_and_a_force_off_the_surface_no_target():
    """A tip that touches in half of the rows has touched; a force of zero where zero is wanted, in the air, is none."""
    env = ContactEnv("press", ranges={})
    env.reset(seed=0)
    core, now = env.core, env.core.now
    for free_share, touched in ((1.0, False), (0.5, True)):
        now.touched[:], now._mode[:], now._free[:], now.on_target[:] = False, FREE, free_share * now.steps, 0.4
        now.f[:] = now.f_des[:] = 0.0
        now.changed()
        core._advance(np.array([True]))
        assert now.touched.tolist() == [touched]
        assert now.on_target.tolist() == [0.0]


def test_an_episode_begins_with_what_it_begins_with():
    """A tip that touches at the start has touched; the action before is that of the instant before."""
    begun = []
    for task in ("press", "slide"):
        env = ContactEnv(task, ranges={})
        env.reset(seed=0)
        now, size = env.core.now, env.action_space.shape
        begun.append(bool(now.contact[0]))
        assert now.touched.tolist() == now.contact.tolist()
        for a in (0.2, -0.3):
            before = now.action.copy()
            env.step(np.full(size, a))
            assert np.array_equal(now.action_before, before)
    assert any(begun)


def test_a_world_keeps_its_own_force():
    """The tables of worlds of one path are not written over each other, however often they are met."""
    env = ContactEnv("press", ranges={"law.force": (5.0, 20.0)}, worlds=3)
    env.reset(seed=0)
    seen = []
    for _ in range(12):
        seen.append(float(env.core.now.f_des[0]))
        assert seen[-1] == env.core.parameters[0]["law.force"]
        env.reset()
    assert len(set(seen)) == 3


def test_before_the_first_step_an_action_is_what_the_scenario_has():
    """A gain of all joints sets as many numbers as there are joints; the next action is still its own."""
    actions = {"law.kp": (0.0, 2000.0), "law.kd": (0.0, 200.0), "force": (0.0, 40.0)}
    env = ContactEnv(scenario="wam_slide", actions=actions, overrides={"time.duration": 0.1})
    env.reset(seed=0)
    law = env.core.scenario.law
    found = env.core.actions.physical(env.core.now.action)[0]
    np.testing.assert_allclose(found, [np.ravel(law.kp)[0], np.ravel(law.kd)[0], law.force])


def test_options_count_in_worlds_that_were_met():
    """A value that is given replaces that of the world, in this episode alone."""
    env = ContactEnv("press", worlds=1)
    own = env.reset(seed=0)[1]["parameters"]
    given = env.reset(options={"friction.coefficient": 0.123})[1]["parameters"]
    assert given == own | {"friction.coefficient": 0.123}
    assert env.reset()[1]["parameters"] == own
