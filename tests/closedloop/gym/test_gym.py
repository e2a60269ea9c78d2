"""Environments of Gymnasium: its own checks, one against many, seeds, actions, endings, rewards."""

import json
import os
import subprocess
import sys
import warnings
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from budget import budget
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

import closedloop as cl
import closedloop.gym as clgym
from closedloop.gym.env import ContactEnv, ContactVectorEnv
from closedloop.loop.step.record_row import Row
from validation.policy import Episodes, LinearPolicy, cross_entropy, learn_to_press

IDS = {**{name: {} for name in clgym.TASKS}, "scenario": {"scenario": "wam_touchdown"}}
FORTH = {"overrides": {"time.duration": 0.3}}


def made(name, **options):
    """Return an environment by its registered name."""
    return gymnasium.make(f"closedloop/{name.capitalize()}-v0", **IDS[name], **options).unwrapped


@pytest.mark.parametrize("name", IDS)
def test_gymnasium_has_nothing_to_say(name):
    """`check_env` passes without a warning."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(made(name), skip_render_check=name != "insert")


@pytest.mark.parametrize(
    ("name", "mode"),
    [
        ("press", AutoresetMode.NEXT_STEP),
        ("slide", AutoresetMode.SAME_STEP),
        ("wipe", AutoresetMode.NEXT_STEP),
        ("insert", AutoresetMode.SAME_STEP),
    ],
)
def test_many_are_each_as_one(name, mode):
    """Observations, rewards, ends and the truth are those of single environments, to the bit, over several episodes."""
    options = {"overrides": {"time.duration": 0.2}, "control_rate": 50.0}
    if name == "insert":  # it begins on the plate, pressed against it from the first action on
        options["ranges"] = {"start.q": clgym.Range((0.0025, -0.0029, 0.0), (0.0035, -0.0029, 0.01))}
    if name != "press":
        options["overrides"] |= {"reference.stop": 0.19, "reference.start": 0.02}
    many = gymnasium.make_vec(
        f"closedloop/{name.capitalize()}-v0", num_envs=3, threads=2, autoreset_mode=mode, **options
    )
    singles, random = [made(name, **options) for _ in range(3)], np.random.default_rng(1)
    seen, _ = many.reset(seed=11)
    assert np.array_equal(seen, [each.reset(seed=11 + i)[0] for i, each in enumerate(singles)])
    over, ends = [False] * 3, 0
    for _ in range(25):
        action = random.uniform(-1.0, 1.0, many.action_space.shape).astype(np.float32)
        seen, rewards, terminated, truncated, infos = many.step(action)
        for i, each in enumerate(singles):
            if over[i]:
                alone, reward, ended, cut = each.reset()[0], 0.0, False, False
            else:
                alone, reward, ended, cut, info = each.step(action[i])
                assert infos["privileged"][i].tolist() == info["privileged"].tolist() or ended or cut
            over[i] = ended or cut
            ends += over[i]
            if over[i] and mode == AutoresetMode.SAME_STEP:
                assert np.array_equal(infos["final_obs"][i], alone)
                alone, over[i] = each.reset()[0], False
            assert np.array_equal(seen[i], alone)
            assert (rewards[i], terminated[i], truncated[i]) == (reward, ended, cut)
    assert ends >= 3
    many.close()


@pytest.mark.parametrize("name", ["press", "slide", "insert"])
def test_an_episode_leaves_nothing_to_the_next(name):
    """An episode that takes over the memory of others is, to the bit, that of a new environment with its seed."""
    used, fresh, random = made(name), made(name), np.random.default_rng(4)
    for seed in (1, 2):
        used.reset(seed=seed)
        for _ in range(4):
            used.step(random.uniform(-1.0, 1.0, used.action_space.shape))
    assert np.array_equal(used.reset(seed=3)[0], fresh.reset(seed=3)[0])
    for _ in range(8):
        action = random.uniform(-1.0, 1.0, used.action_space.shape)
        (one, *rest, _), (other, *of_other, _) = used.step(action), fresh.step(action)
        assert np.array_equal(one, other)
        assert rest == of_other
    used.close()
    fresh.close()


def test_a_disabled_autoreset_waits():
    """With autoreset disabled an ended episode is refused until it is reset by its mask, which touches no other."""
    many = ContactVectorEnv(2, "press", autoreset_mode="Disabled", **FORTH, control_rate=10.0)
    many.reset(seed=0)
    still = np.zeros((2, 1))
    for _ in range(3):
        *_, truncated, infos = many.step(still)
    assert truncated.all()
    assert list(infos["reason"]) == ["time is up"] * 2
    with pytest.raises(gymnasium.error.ResetNeeded, match="environment 0 is over"):
        many.step(still)
    many.reset(options={"reset_mask": np.array([True, False])})
    with pytest.raises(gymnasium.error.ResetNeeded, match="environment 1 is over"):
        many.step(still)
    with pytest.raises(ValueError, match="reset_mask"):
        many.reset(options={"reset_mask": [True, False]})


EPISODE = """
import json, numpy as np
from closedloop.gym.env import ContactVectorEnv
many = ContactVectorEnv(4, "press", threads=3, overrides={"time.duration": 0.1})
many.reset(seed=5)
for k in range(8):
    seen, *_ = many.step(np.full((4, 1), 0.1 * k))
print(json.dumps(seen.tolist()))
"""


def test_seeds_hold_across_processes_and_threads(capsys):
    """The same seed gives the same observations in another process, with another number of threads."""
    there = subprocess.run([sys.executable, "-c", EPISODE], check=True, capture_output=True).stdout
    exec(EPISODE.replace("threads=3", "threads=1"), {})
    assert json.loads(there) == json.loads(capsys.readouterr().out)


def test_what_is_drawn_is_within_its_range():
    """Each parameter is in its range and differs; a value given as an option stands, and changes no other draw."""
    env = made("press", **FORTH)
    ranges = clgym.TASKS["press"].ranges
    drawn = [env.reset(seed=seed)[1]["parameters"] for seed in range(6)]
    for key in (key for key in ranges if key != "start.q"):
        values = [each[key] for each in drawn]
        assert len(set(values)) == 6
        assert all(ranges[key][0] <= value <= ranges[key][1] for value in values)
    given = env.reset(seed=3, options={"friction.coefficient": 0.123})[1]["parameters"]
    assert given == {**drawn[3], "friction.coefficient": 0.123}
    with pytest.raises(cl.ScenarioError, match="coeficient"):
        env.reset(options={"friction.coeficient": 0.1})
    assert 1e3 <= clgym.Range(1e3, 1e5, log=True).draw(np.random.default_rng(0)) <= 1e5
    with pytest.raises(cl.ScenarioError, match="smaller first"):
        clgym.Range(2.0, 1.0)


def test_an_episode_is_the_scenario_that_it_says():
    """The scenario with the parameters of the episode, run by `simulate`, is the episode under its own force."""
    env = made("slide", overrides={"time.duration": 0.5}, actions={"force": (0.0, 20.0)}, endings={})
    _, info = env.reset(seed=4)
    scenario = cl.load_scenario(clgym.TASKS["slide"].scenario, {**info["parameters"], "time.duration": 0.5})
    run = cl.simulate(scenario, engine="compiled")
    for k in range(10, 501, 10):
        *_, info = env.step(np.zeros(1))
        assert info["f"] == run.contact_force[k]
    assert info["reason"] == "time is up"
    assert np.array_equal(Row(env.core.ensemble.rows[0], 4).q, run.q[500])


@pytest.mark.parametrize(
    ("action", "said"),
    [
        (np.array([np.nan]), r"action\[0\] = nan \(force\): must be a finite number; nothing was stepped"),
        (np.zeros(2), r"action of shape \(2,\): must be numbers of shape \(1,\): force"),
        ("up", r"action of shape \(\)"),
        (np.array([1j]), r"action of shape \(1,\): must be numbers"),
    ],
)
def test_bad_actions_are_answered(action, said):
    """A NaN and a wrong shape are refused in one line, and the episode goes on as if nothing was asked."""
    env = made("press", **FORTH)
    first, _ = env.reset(seed=0)
    with pytest.raises(ValueError, match=said) as error:
        env.step(action)
    assert "\n" not in str(error.value)
    after = env.step(np.zeros(1))[0]
    env.reset(seed=0)
    assert np.array_equal(after, env.step(np.zeros(1))[0])
    assert not np.array_equal(first, after)


def test_actions_out_of_range_are_cut_and_counted():
    """An action beyond 1 acts as 1, and the info counts it."""
    env = made("press", **FORTH)
    env.reset(seed=0)
    beyond = env.step(np.array([7.0]))
    env.reset(seed=0)
    one = env.step(np.array([1.0]))
    assert np.array_equal(beyond[0], one[0])
    assert (beyond[4]["cut"], one[4]["cut"]) == (1, 0)


def test_a_step_needs_a_reset():
    """Before the first reset, and after the end, a step is refused."""
    env = made("press", overrides={"time.duration": 0.1}, control_rate=10.0)
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(np.zeros(1))
    env.reset(seed=0)
    env.step(np.zeros(1))
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(np.zeros(1))


def test_rewards_are_composed_of_named_terms():
    """The reward is the weighted sum of its terms, a user's own among them; a term that returns no number is named."""
    terms = {"force": 2.0, "still": (0.5, lambda now: -np.abs(now.v).sum(axis=1)), "alive": lambda now: now.time * 0.0}
    env = made("press", rewards=terms, **FORTH)
    env.reset(seed=0)
    for _ in range(5):
        _, reward, _, _, info = env.step(np.zeros(1))
        parts = [info[f"reward/{name}"] for name in terms]
        assert reward == pytest.approx(sum(parts), rel=1e-15)
        assert info["reward/force"] == -2.0 * min(abs(info["f"] - 10.0) / 10.0, 1.0)
    env = made("press", rewards={"bad": lambda now: now.time * np.nan}, **FORTH)
    env.reset(seed=0)
    with pytest.raises(cl.ScenarioError, match="bad = nan"):
        env.step(np.zeros(1))
    with pytest.raises(cl.ScenarioError, match="speed"):
        made("press", rewards={"speed": 1.0})


def test_endings_say_why():
    """Too much force and a lost contact end an episode as failed, with what was left to lose; success is told."""
    env = made("slide", endings={"excessive force": lambda now: now.largest_force > 14.0}, ranges={})
    env.reset(seed=0)
    total, terminated = 0, False
    while not terminated:
        _, _, terminated, truncated, info = env.step(np.array([1.0, 0.0, 0.0]))
        total += 1
        assert not truncated
    assert info["reason"] == "excessive force"
    assert info["reward/failed"] == pytest.approx(-(250 - total + 1) * 3.6)
    env = made("press", ranges={}, overrides={"friction.coefficient": 0.0})
    env.reset(seed=0)
    terminated = truncated = False
    while not (terminated or truncated):
        _, _, terminated, truncated, info = env.step(np.zeros(1))
    assert terminated
    assert info["reason"] == "success"
    assert info["is_success"]


def test_a_simulation_that_stops_ends_its_own_episode():
    """One that diverges terminates with its reason; its neighbour goes on, as it does alone."""
    options = {"scenario": "planar2_drop", "actions": {"torque": (-1e8, 1e8)}, "endings": {}}
    options["overrides"] = {"time.duration": 0.5}
    many, alone = ContactVectorEnv(2, **options), ContactEnv(**options)
    many.reset(seed=0)
    alone.reset(seed=1)
    seen, _, terminated, _, infos = many.step(np.array([[1.0, -1.0], [0.0, 0.0]]))
    assert terminated.tolist() == [True, False]
    assert infos["reason"][0].startswith("stopped at t = ")
    assert np.array_equal(seen[1], alone.step(np.zeros(2))[0])
    seen, *_ = many.step(np.zeros((2, 2)))
    assert np.array_equal(seen[1], alone.step(np.zeros(2))[0])


def test_critics_see_the_truth():
    """The privileged observation holds the true force and what was drawn; with `privileged` it is part of a dict."""
    env = made("press", privileged=True, **FORTH)
    seen, info = env.reset(seed=0)
    names = env.core.privileged_names
    assert seen in env.observation_space
    assert np.array_equal(seen["critic"], info["privileged"])
    told = dict(zip(names, info["privileged"], strict=True))
    assert told["f"] == info["f"]
    assert told["compliance.stiffness"] == info["parameters"]["compliance.stiffness"]
    many = ContactVectorEnv(2, "press", privileged=True, **FORTH)
    assert np.array_equal(many.reset(seed=0)[0]["critic"][0], seen["critic"])


def test_worlds_are_met_again():
    """With a number of worlds there are so many, the same for any seed."""
    env = made("press", worlds=3, **FORTH)
    stiffness = {env.reset(seed=seed)[1]["parameters"]["compliance.stiffness"] for seed in range(30)}
    other = {env.reset()[1]["parameters"]["compliance.stiffness"] for _ in range(10)}
    assert len(stiffness) == 3
    assert other <= stiffness


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"task": "push"}, "must be one of press"),
        ({"task": "press", "control_rate": 0.0}, "control_rate = 0 Hz"),
        ({"task": "press", "control_rate": 300.0}, "whole number of steps"),
        ({"task": "press", "actions": {}}, "actions: is empty"),
        ({"task": "press", "actions": {"law.kp": (0.0, 1.0)}}, "law.normal_damping"),
        ({"task": "press", "actions": {"force": (1.0, 0.0)}}, "low, high"),
        ({"task": "press", "actions": {"torque": (-1, 1), "force": (0, 1)}}, "torques replace the law"),
        ({"task": "press", "observations": ("colour",)}, "no part 'colour'"),
        ({"task": "press", "ranges": {"friction.coefficient": 0.3}}, r"must be \(low, high\)"),
        ({"task": "press", "render_mode": "ansi"}, "'rgb_array' or 'human'"),
        ({"task": "press", "length": 3}, "length: no such option"),
        ({}, "scenario: give the name"),
        ({"scenario": "wam_slide", "overrides": {"time.integrator": "dop853"}}, "integrator"),
    ],
)
def test_wrong_options_are_answered_in_a_line(options, said):
    """What is wrong, where, and what would be right."""
    with pytest.raises(cl.ScenarioError, match=said) as error:
        ContactEnv(**options)
    assert "\n" not in str(error.value)


def test_pictures_are_drawn_without_a_display():
    """`render` gives a picture that changes with the state, of each of several environments too."""
    env = made("press", render_mode="rgb_array", **FORTH)
    env.reset(seed=0)
    first = env.render()
    for _ in range(20):
        env.step(np.ones(1))
    then = env.render()
    assert first.shape == then.shape == (480, 640, 3)
    assert first.dtype == np.uint8
    assert not np.array_equal(first, then)
    env.close()
    env.close()


def test_an_episode_is_recorded_as_a_video(tmp_path):
    """`RecordVideo` writes a film of an episode, a picture for each control instant, without a display."""
    pytest.importorskip("moviepy")
    env = gymnasium.make(
        "closedloop/Press-v0", render_mode="rgb_array", overrides={"time.duration": 0.1}, control_rate=50.0
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        film = gymnasium.wrappers.RecordVideo(env, str(tmp_path), disable_logger=True)
    film.reset(seed=0)
    truncated = False
    while not truncated:
        *_, truncated, _ = film.step(np.zeros(1))
    film.close()
    (written,) = tmp_path.glob("*.mp4")
    import imageio.v3 as iio

    frames = iio.imread(written, plugin="FFMPEG")
    assert frames.shape[1:] == (480, 640, 3)
    assert len(frames) == 6
    assert frames.std() > 10.0


@pytest.mark.slow
def test_many_control_steps_do_not_grow():
    """With a reset every thousand control steps the process holds no more than after the first tenth of them."""
    steps = budget(300_000, 1_000_000)
    many = ContactVectorEnv(
        256,
        "slide",
        threads=2,
        worlds=2,
        control_rate=1000.0,
        endings={},
        overrides={"time.duration": 1.0, "reference.start": 0.05, "reference.stop": 0.9},
    )
    many.reset(seed=0)
    still, held, count = np.zeros((256, 3)), [], 0
    while count < steps:
        many.step(still)
        count += 256
        if count % (256 * (steps // 2560)) == 0:
            held.append(resident())
    many.close()
    assert len(held) >= 10
    assert held[-1] - held[1] < 20e6


def resident():
    """Return the memory that the process holds now, bytes."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


def test_a_policy_becomes_a_law(tmp_path, monkeypatch):
    """The law that a policy is written as gives the forces of the policy in the environment.

    To rounding: the policy sums its products in numpy, the law in compiled code, and 0.4 s of control follow.
    """
    env = made("press", overrides={"time.duration": 0.4}, control_rate=50.0, endings={}, hold=None)
    policy = LinearPolicy(env.core.observation_names, [0.7, 3.0, 0.2, 0.1])
    seen, info = env.reset(seed=2)
    values, forces = info["parameters"], []
    for _ in range(20):
        seen, *_, info = env.step(policy.act(seen)[0])
        forces.append(info["f"])
    assert policy.write_law(tmp_path / "learned.py", env.core).is_file()
    monkeypatch.syspath_prepend(str(tmp_path))
    given = {**values, "time.duration": 0.4, "law.kind": "learned:Policy"}
    run = cl.simulate(cl.load_scenario(clgym.TASKS["press"].scenario, given), engine="compiled")
    assert run.contact_force[20::20] == pytest.approx(forces, rel=1e-9)
    assert max(forces) > 5.0
    with pytest.raises(cl.ScenarioError, match="has no 'force_sum'"):
        LinearPolicy(("force_error", "contact"), [0.0] * 4).act(np.zeros(2))
    with pytest.raises(cl.ScenarioError, match="must be 'force' alone"):
        policy.write_law(tmp_path / "other.py", made("slide").core)


def test_the_cross_entropy_method_finds_a_least_value():
    """Of a bowl whose least is known, from a start two spreads away; another seed, another way to the same place."""
    least = np.array([2.0, -1.0])
    for seed in range(2):
        found = cross_entropy(
            lambda x, k: ((x - least) ** 2).sum(axis=1), np.zeros(2), np.ones(2), generations=25, seed=seed
        )
        assert found.weights == pytest.approx(least, abs=0.05)
        assert found.costs[-1] < 1e-2 * found.costs[0]


@pytest.mark.slow
def test_a_learned_policy_keeps_its_force_on_surfaces_that_it_has_not_met():
    """Half a newton RMS after a short training, as a policy and as a law; the same seed gives the same weights."""
    from validation import learning

    options = {"seconds": 1.0, "generations": 4, "candidates": 12, "worlds": 4, "of": 8}
    policy, _ = learn_to_press(**options, threads=2)
    assert np.array_equal(policy.weights, learn_to_press(**options, threads=1)[0].weights)
    held_out = Episodes(clgym.TASKS["press"].changed({"overrides": {"time.duration": 1.5}}), policies=2, worlds=6)
    errors = held_out.errors(np.array([policy.weights, np.zeros(4)]), range(5000, 5006))
    assert errors[0].max() < 0.5 < errors[1].max()
    assert learning.on_surfaces({}, held_out.core.parameters[:2]) == pytest.approx(errors[1, :2], abs=1e-3)


def test_a_page_shows_an_environment_at_its_address(capsys):
    """The page gets the arm, its place and the force at each step; a browser reads them as bytes."""
    sockets = pytest.importorskip("websockets.sync.client", reason="websockets is not installed: the extra 'lab'")
    from closedloop.lab.drawn import unpack

    env = made("press", render_mode="human")
    try:
        env.reset(seed=0)
        address = capsys.readouterr().out.split()[-1]
        with sockets.connect(address.replace("http", "ws", 1), compression=None) as socket:
            for _ in range(3):
                env.step(np.zeros(env.action_space.shape))
            found = {}
            while not {"robot", "space", "run", "frame"} <= found.keys() or len(found["run"]["panels"][0]["time"]) < 3:
                message = unpack(socket.recv(timeout=60.0))
                found[message["kind"]] = message
                if message["kind"] == "run":
                    socket.send('{"do": "shown"}')
        *_, force, wanted = (trace["values"] for trace in found["run"]["panels"][0]["traces"])
        assert np.all(np.isfinite(force))
        assert np.all(wanted >= 0.0)
        frame = found["frame"]
        assert frame["robot"] == found["robot"]["robot"]
        assert frame["places"].size == 7 * found["robot"]["joints"]
        assert np.linalg.norm(frame["forces"][:3]) == pytest.approx(force[-1], abs=1e-6)
    finally:
        env.close()
