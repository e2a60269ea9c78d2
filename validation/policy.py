"""A policy that is linear in a few parts of the observation, and the control law that it becomes.

    a = s/(1 + |s|),  s = Σ wₖ cₖ xₖ

with the parts x of the observation, scales c of their usual size and weights w; the action a from −1 to 1 is the
desired force. As a law it is evaluated once in a control period, and commands the task's own law in between.

It learns by the cross-entropy method: candidates are drawn, the best are kept, and the next are drawn about them.

Source: R. Y. Rubinstein and D. P. Kroese, The Cross-Entropy Method, Springer 2004; I. Szita and A. Lőrincz, Learning
Tetris using the noisy cross-entropy method, Neural Computation 18(12), 2006 (the spread that is added).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError
from closedloop.base.files import write_whole
from closedloop.control.law import LawInput
from closedloop.gym.core import Core
from closedloop.gym.env import ContactVectorEnv
from closedloop.gym.terms import TASKS, Task

# The parts, the words for them in a law, and scales: a force error of 10 N, a sum of 1 N s.
FEATURES = {
    "force_error": ("x.f_des - x.f_measured", 0.1),
    "force_sum": ("z.force_sum", 1.0),
    "contact": ("x.pressed", 1.0),
}


@dataclass(frozen=True)
class LinearPolicy:
    """A policy with one number as its action, the desired force.

    names: names of the numbers of an observation, as an environment's `core.observation_names`
    weights: (4,), (N, 4), of the force's error, its sum, contact, and of 1; for N environments each its own
    """

    names: tuple[str, ...]
    weights: ArrayLike

    def act(self, observations: ArrayLike) -> Array:
        """Return the actions (N, 1) for observations (N, k)."""
        seen, weights = np.atleast_2d(np.asarray(observations, dtype=np.float64)), np.asarray(self.weights)
        total = np.zeros(len(seen)) + weights[..., len(FEATURES)]
        for k, (name, (_, scale)) in enumerate(FEATURES.items()):
            total = total + weights[..., k] * (scale * seen[:, self._place(name)])
        return (total / (1.0 + np.abs(total)))[:, None]

    def _place(self, name: str) -> int:
        if name not in self.names:
            raise ScenarioError(
                f"policy: the observation has no {name!r}, which it needs; it has {', '.join(self.names)}"
            )
        return self.names.index(name)

    def write_law(self, path: str | Path, core: Core) -> Path:
        """Write the policy as a control law of its own, for ``closedloop run SCENARIO --law.kind FILE:Policy``.

        core: that of the environment: its action is the desired force alone, and its law is what the policy commands
        Raises `ScenarioError` if the environment has other actions, or the weights are those of many; `OutputError` if
        the file cannot be written.
        """
        weights = np.asarray(self.weights, dtype=np.float64)
        if core.actions.names != ("force",) or weights.shape != (len(FEATURES) + 1,):
            raise ScenarioError(
                f"policy: its actions are {', '.join(core.actions.names)}, its weights {weights.shape}: must be "
                f"'force' alone and ({len(FEATURES) + 1},)"
            )
        if not core.scenario.law.sample_period > 0.0:
            raise ScenarioError("law.sample_period: must be above 0: a policy keeps its memory between samples")
        law = type(core.scenario.law)
        if law.states != ("force_error",) or law.joint_states:
            raise ScenarioError(
                f"law.kind = {law.kind!r}: has states of its own; use a law without, such as 'impedance'"
            )
        text = law_text(law.__module__, law.__name__, weights.tolist(), core)
        return write_whole(Path(path), text.encode())


def law_text(module: str, base: str, weights: Sequence[float], core: Core) -> str:
    """Return the law as Python text."""
    fields = ", ".join("z.command" if name == "f_des" else f"x.{name}" for name in LawInput._fields)
    terms = "\n".join(
        f"            s += {weight!r} * ({scale!r} * ({word}))"
        for weight, (word, scale) in zip(weights, FEATURES.values(), strict=False)
    )
    low, high = float(core.actions.low[0]), float(core.actions.high[0])
    return f'''"""A learned policy as a control law: each {core.period:g} s it commands the force of {base}."""

from closedloop.control.law import force_error_rate
from closedloop.control.law import LawInput
from {module} import {base}
from closedloop.jit.kernel import kernel_of

PERIOD, LOW, HIGH = {core.period!r}, {low!r}, {high!r}
law_torque = kernel_of({base}, "torque")


class Policy({base}):
    """{base} under the force that the policy commands; `law.force` is what it is to keep."""

    states = ("force_error", "force_sum", "command")

    @staticmethod
    def torque(x, par, z, torque):
        k = round(x.t / PERIOD)
        if abs(x.t - k * PERIOD) < 1e-6 * PERIOD:
            if k > 0 and x.pressed != 0.0:
                z.force_sum += PERIOD * (x.f_des - x.f_measured)
            s = {weights[-1]!r}
{terms}
            share = 0.5 * (s / (1.0 + abs(s)) + 1.0)
            z.command = (1.0 - share) * LOW + share * HIGH
        law_torque(
            LawInput({fields}),
            par, z, torque,
        )

    @staticmethod
    def rates(x, par, z, f, torque, dz):
        dz.force_error = force_error_rate(x, par, z, f)
        dz.force_sum, dz.command = 0.0, 0.0
'''


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
