"""Learners that others wrote take the environments as they are: the loop of CleanRL, and Stable-Baselines3."""

import warnings

import gymnasium
import numpy as np
import pytest

import closedloop.gym as clgym

SHORT = {"overrides": {"time.duration": 0.3}, "worlds": 3, "endings": {}, "hold": None}


def test_the_loop_of_cleanrl():
    """Buffers of a rollout, gymnasium's own wrappers about the vector environment, advantages, a step of the policy.

    As CleanRL's ppo_continuous_action.py does it, with a linear policy and its likelihood gradient in numpy. The
    returns that the wrapper tells of whole episodes are the sums of the rewards, and the step makes better actions
    likelier.
    """
    count, steps, random = 4, 70, np.random.default_rng(0)
    envs = gymnasium.make_vec("closedloop/Press-v0", num_envs=count, **SHORT)
    envs = gymnasium.wrappers.vector.RecordEpisodeStatistics(envs)
    envs = gymnasium.wrappers.vector.ClipAction(envs)
    size = envs.single_observation_space.shape[0]
    weights, spread = np.zeros((size, envs.single_action_space.shape[0])), 0.5
    seen, actions, rewards, dones, values = (
        np.zeros((steps, count, *shape)) for shape in ((size,), envs.single_action_space.shape, (), (), ())
    )
    observation, _ = envs.reset(seed=1)
    done, returns = np.zeros(count), []
    for step in range(steps):
        seen[step], dones[step] = observation, done
        actions[step] = observation @ weights + spread * random.normal(size=actions[step].shape)
        observation, rewards[step], terminated, truncated, infos = envs.step(actions[step].astype(np.float32))
        done = np.logical_or(terminated, truncated)
        if "episode" in infos:
            whose = np.flatnonzero(infos["_episode"])
            returns += list(zip(whose, infos["episode"]["r"][whose], strict=True))
    envs.close()
    ends = [np.flatnonzero(dones[:, i])[0] for i in range(count)]
    assert ends == [30] * count
    for i, value in returns[:count]:
        assert value == pytest.approx(rewards[:30, i].sum(), rel=1e-5)
    assert np.all(rewards[31:61] <= 0.0)
    assert np.array_equal(rewards[30], np.zeros(count))  # the step that only begins the next episode
    advantages, last = np.zeros_like(rewards), 0.0
    for step in reversed(range(steps - 1)):
        goes_on = 1.0 - dones[step + 1]
        delta = rewards[step] + 0.98 * values[step + 1] * goes_on - values[step]
        advantages[step] = last = delta + 0.98 * 0.95 * goes_on * last
    scaled = (advantages - advantages.mean()) / advantages.std()
    push = np.einsum("tns,tna,tn->sa", seen, (actions - seen @ weights) / spread**2, scaled) / scaled.size
    likelier = -((actions - seen @ (1e-4 * push)) ** 2).sum(axis=2) + (actions**2).sum(axis=2)
    assert np.all(np.isfinite(push))
    assert (scaled * likelier).sum() > 0.0


@pytest.mark.slow
def test_stable_baselines3_takes_them_as_they_are(tmp_path):
    """Its checks have nothing to say, and PPO and SAC train, save, load and predict, with arrays and with dicts."""
    pytest.importorskip("stable_baselines3", reason="Stable-Baselines3, and PyTorch with it, are no part of an extra")
    from stable_baselines3 import PPO, SAC
    from stable_baselines3.common.env_checker import check_env
    from stable_baselines3.common.env_util import make_vec_env

    for name in clgym.TASKS:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            check_env(gymnasium.make(f"closedloop/{name.capitalize()}-v0"))
    many = make_vec_env("closedloop/Press-v0", n_envs=2, seed=0, env_kwargs=SHORT)
    learner = PPO("MlpPolicy", many, n_steps=64, batch_size=64, n_epochs=1, device="cpu", seed=0).learn(128)
    learner.save(tmp_path / "ppo.zip")
    seen = many.reset()
    assert np.array_equal(
        PPO.load(tmp_path / "ppo.zip", device="cpu").predict(seen, deterministic=True)[0],
        learner.predict(seen, deterministic=True)[0],
    )
    both = gymnasium.make("closedloop/Slide-v0", privileged=True, worlds=1)
    SAC("MultiInputPolicy", both, learning_starts=20, device="cpu", seed=0).learn(30)
