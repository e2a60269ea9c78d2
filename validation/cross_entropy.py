"""Learning by the cross-entropy method: candidates are drawn, the best are kept, and the next are drawn about them.

Source: R. Y. Rubinstein and D. P. Kroese, The Cross-Entropy Method, Springer 2004; I. Szita and A. Lőrincz, Learning
Tetris using the noisy cross-entropy method, Neural Computation 18(12), 2006 (the spread that is added).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from closedloop.base.arrays import Array
from closedloop.gym.env import ContactVectorEnv
from closedloop.gym.task import TASKS, Task
from validation.policy import LinearPolicy

# Cost of an episode that could not be simulated to its end, N²: worse than any that could.
STOPPED = 1e4


@dataclass(frozen=True)
class Learned:
    """What the cross-entropy method has found.

    weights: (k,), the mean of the last candidates' best
    costs: (g,), mean cost of the best of each generation
    """

    weights: Array
    costs: Array


def cross_entropy(
    cost: Callable[[Array, int], Array], mean: ArrayLike, spread: ArrayLike, *, generations: int = 12,
    candidates: int = 24, best: int = 6, extra: float = 0.2, seed: int = 0,
) -> Learned:  # fmt: skip
    """Return numbers of little cost.

    cost: of candidates (m, k) and the number of the generation, to their costs (m,), finite
    mean, spread: (k,), of the first candidates, which are drawn from normal distributions
    generations, candidates, best: how often, how many, and how many of them the next are drawn about
    extra: added to the spread at first, as a share of the first one, and less from generation to generation
    """
    random = np.random.default_rng(seed)
    middle, wide = np.array(mean, dtype=np.float64), np.array(spread, dtype=np.float64)
    first, costs = wide.copy(), []
    for generation in range(generations):
        drawn = middle + wide * random.normal(size=(candidates, middle.size))
        found = cost(drawn, generation)
        order = np.argsort(found, kind="stable")[:best]
        costs.append(float(np.mean(found[order])))
        middle = drawn[order].mean(axis=0)
        wide = drawn[order].std(axis=0) + extra * first * (1.0 - (generation + 1) / generations)
    return Learned(middle, np.array(costs))


class Episodes:
    """Episodes of pressing, in which many linear policies are tried side by side on the same worlds.

    task: its action is the desired force
    policies, worlds: how many of each
    settled: the force counts from here on, s
    """

    def __init__(
        self, task: Task = TASKS["press"], *, policies: int, worlds: int, settled: float = 0.5,
        threads: int | None = None,
    ) -> None:  # fmt: skip
        task = task.changed({"endings": {}, "hold": None})
        self._envs = ContactVectorEnv(policies * worlds, task, threads=threads)
        self.core, self._worlds, self._settled = self._envs.core, worlds, settled

    def errors(self, weights: Array, seeds: Sequence[int]) -> Array:
        """Return the RMS error of the force after `settled` (m, w), N, of policies (m, 4) on worlds of these seeds."""
        many = np.repeat(weights, self._worlds, axis=0)
        policy = LinearPolicy(self.core.observation_names, many)
        seen, _ = self._envs.reset(seed=[int(seed) for _ in weights for seed in seeds])
        stopped, before = np.zeros(len(many), dtype=np.bool_), np.zeros(len(many))
        now = self.core.now
        for _ in range(self.core.instants):
            seen, _, terminated, *_ = self._envs.step(policy.act(seen))
            stopped |= terminated
            before = np.where(now.time <= self._settled * (1.0 + 1e-9), now.force_square, before)
        mean = (now.force_square - before) / (now.time - self._settled)
        error = np.sqrt(np.where(stopped, STOPPED, np.minimum(mean, STOPPED)))
        return np.asarray(error.reshape(len(weights), self._worlds))

    def close(self) -> None:
        """End the threads."""
        self._envs.close()


def learn_to_press(
    *, seconds: float = 1.5, generations: int = 12, candidates: int = 24, worlds: int = 8, of: int = 48, seed: int = 0,
    threads: int | None = None,
) -> tuple[LinearPolicy, Learned]:  # fmt: skip
    """Return a policy for `Press-v0`, and how it was found.

    seconds: length of an episode, s
    generations, candidates: see `cross_entropy`
    worlds, of: on how many each candidate of a generation is tried, out of so many
    """
    task = TASKS["press"].changed({"overrides": {"time.duration": seconds}, "worlds": of})
    episodes = Episodes(task, policies=candidates, worlds=worlds, threads=threads)

    def cost(weights: Array, generation: int) -> Array:
        errors = episodes.errors(weights, [seed + generation * worlds + i for i in range(worlds)])
        return np.asarray((errors**2).mean(axis=1))

    found = cross_entropy(
        cost, np.zeros(4), np.array([1.0, 2.0, 1.0, 1.0]), generations=generations, candidates=candidates, seed=seed
    )
    episodes.close()
    return LinearPolicy(episodes.core.observation_names, found.weights), found
