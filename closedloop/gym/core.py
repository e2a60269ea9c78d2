"""Environments side by side: what the single environment and the vector environment both are made of.

And what an action sets: torques, the desired force, a displacement of the desired tip, or parameters of the law.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.utils.seeding import np_random

from closedloop.base.arrays import Array, IntArray, Mask
from closedloop.base.errors import ScenarioError
from closedloop.gym.terms import PARTS, POSTURE, TRUTH, Now, Observations, Task, as_ranges, as_terms, drawn
from closedloop.jit.parameters import parameter_block
from closedloop.scenario.arm import start_positions
from closedloop.scenario.load import Variants
from closedloop.simulation.engines.loops import COMPILED
from closedloop.simulation.engines.problem import Problem
from closedloop.simulation.ensemble.ensemble import Ensemble
from closedloop.simulation.ensemble.member import FORCE, JOINT, PARAMETER, SHIFT, TORQUE
from closedloop.simulation.parts import Cache
from closedloop.simulation.prepare import prepare, problem_of
from closedloop.simulation.simulate import check_engine
from closedloop.simulation.time_step import whole_steps

AXES = ("n", "t1", "t2")
WORDS = "torque, force, tip, tip.n, tip.t1, tip.t2, joint, joint.NAME, or law.KEY"


class Actions:
    """The numbers of an action from −1 to 1, and what each sets.

    Parameters
    ----------
    given : mapping of str to (low, high)
        "torque": of each joint, N m, held until the next action, in place of the law's. "force": f_des, N. "tip": a
        displacement of the desired tip along the normal and both tangents of the contact, m; "tip.n", "tip.t1" or
        "tip.t2": along one. "joint": a displacement of each desired joint position, rad (m); "joint.NAME": of one.
        "law.KEY": a parameter of the scenario's law, of all joints alike where it is one a joint.
        −1 and 1 are `low` and `high`, which may be lists with an entry for each number; what is left out is as the
        scenario says.
    problem : Problem
        What the scenario is prepared as.

    Attributes
    ----------
    names : tuple of str
        One for each number.
    low, high : (k,) arrays
        SI units.
    plan : (l, 3) array
        See `closedloop.simulation.ensemble.member.act`.
    held : bool
        Whether it sets torques.
    """

    def __init__(self, given: Mapping[str, Any], problem: Problem) -> None:
        if not given:
            raise ScenarioError(f"actions: is empty: name what an action sets, {WORDS}, and its range")
        self.held = "torque" in given
        if self.held and len(given) > 1:
            raise ScenarioError(f"actions: {', '.join(given)}: torques replace the law, so nothing goes with them")
        names: list[str] = []
        plan: list[tuple[int, int, int]] = []
        low: list[float] = []
        high: list[float] = []
        for name, ends in given.items():
            parts = _parts(name, problem)
            a, b = _ends(name, ends, len(parts))
            for (label, places), each_low, each_high in zip(parts, a, b, strict=True):
                plan += [(*place, len(names)) for place in places]
                names.append(label)
                low.append(each_low)
                high.append(each_high)
        if len(set(names)) < len(names):
            raise ScenarioError(f"actions: {', '.join(given)}: set {max(names, key=names.count)} twice")
        self.names = tuple(names)
        self.low, self.high = np.array(low), np.array(high)
        self.plan: IntArray = np.array(plan, dtype=np.int64)

    def physical(self, action: Array) -> Array:
        """Return actions (N, k) from −1 to 1 in SI units."""
        share = 0.5 * (action + 1.0)
        return (1.0 - share) * self.low + share * self.high  # exact at either end

    def normal(self, values: Array) -> Array:
        """Return the action (k,) from −1 to 1 that sets these values, SI units, cut to what can be set."""
        span = np.where(self.high > self.low, self.high - self.low, 1.0)
        return np.clip(2.0 * (values - self.low) / span - 1.0, -1.0, 1.0)


def _parts(name: str, problem: Problem) -> list[tuple[str, list[tuple[int, int]]]]:
    """Return the label of each number of a kind of action, and what it sets at which places."""
    joints = problem.robot.model.joint_names
    several = {"torque": (TORQUE, joints), "tip": (SHIFT, AXES), "joint": (JOINT, joints)}
    if name == "force":
        return [("force", [(FORCE, 0)])]
    if name in several:
        kind, parts = several[name]
        return [(f"{name}.{part}", [(kind, i)]) for i, part in enumerate(parts)]
    word, _, part = name.partition(".")
    if word == "joint" and part not in joints:
        raise ScenarioError(f"actions[{name!r}]: no such joint; there are {', '.join(joints)}")
    if word in ("tip", "joint") and part in several[word][1]:
        kind, parts = several[word]
        return [(name, [(kind, parts.index(part))])]
    key = name.removeprefix("law.")
    block = parameter_block(problem.law.member)
    if not name.startswith("law.") or key not in block.layout.at:
        known = ", ".join(f"law.{each}" for each in block.layout.at)
        raise ScenarioError(f"actions[{name!r}]: must be {WORDS}; of this law there are {known}")
    place = block.place(key, problem.robot.n)
    places = range(place.start, place.stop) if isinstance(place, slice) else (place,)
    return [(name, [(PARAMETER, at) for at in places])]


def _ends(name: str, given: Any, count: int) -> tuple[list[float], list[float]]:
    try:
        low, high = given
        a, b = (np.broadcast_to(np.asarray(each, dtype=np.float64), count) for each in (low, high))
    except (TypeError, ValueError):
        a, b = np.array([np.nan]), np.array([np.nan])
    if not (np.all(np.isfinite(a)) and np.all(np.isfinite(b)) and np.all(a <= b)):
        raise ScenarioError(f"actions[{name!r}] = {given!r}: must be (low, high), each a number or {count}")
    return a.tolist(), b.tolist()


# An episode without on-target time at its end succeeds if the tip is so near to its path, m.
NEAR = 0.005
SUCCESS, TIME_UP = "success", "time is up"


class Core:
    """N environments of one task.

    Attributes
    ----------
    action_space, observation_space, privileged_space : spaces.Box
        Of one environment. The privileged observation is the truth, then what the episode has drawn.
    now : Now
        The state, of which `observe` and `privileged` are made.
    reasons : list
        Why each episode ended, or "".
    """

    def __init__(self, task: Task, count: int, threads: int = 1) -> None:
        self.task, self.count, self._cache = task, count, Cache()
        self.scenario = task.load_scenario()
        check_engine(self.scenario, COMPILED, None)
        self.ranges = as_ranges(task.ranges)
        self._terms, self._endings = as_terms(task.rewards), dict(task.endings)
        self._seeds = ("sensor.seed", "encoder.seed") if self.scenario.reads_encoders else ("sensor.seed",)
        self._worlds: dict[int, tuple[dict[str, Any], Problem]] = {}
        self._variants: dict[tuple[str, ...], Variants] = {}
        first = prepare(self.scenario, None, self._cache)
        self.home = start_positions(self.scenario, first.robot.model)
        n, h = first.robot.n, first.h
        if not 0.0 < task.control_rate <= 1.0 / h * (1.0 + 1e-9):
            raise ScenarioError(
                f"control_rate = {task.control_rate:g} Hz: must be above 0, and at most {1.0 / h:g} Hz, once a step"
            )
        if task.worlds is not None and task.worlds < 1:
            raise ScenarioError(f"worlds = {task.worlds}: must be at least 1, or None")
        self.steps = whole_steps(1.0 / task.control_rate, h, "1/control_rate")
        if first.steps % self.steps:
            raise ScenarioError(
                f"time.duration = {first.steps * h:g} s: must be a whole number of control periods of "
                f"{self.steps * h:g} s"
            )
        self.instants = first.steps // self.steps
        self.period = self.steps * h
        self.actions = Actions(task.actions, first)
        self._own = self._values_of_scenario(first)
        numbers = len(self.actions.names)
        contacts = len(self.scenario.contact or ())
        self._observed = Observations(task.observations, {**PARTS, **TRUTH}, n, numbers, contacts)
        self._truth = Observations(tuple(TRUTH), TRUTH, n, numbers, contacts)
        self.drawn_keys = tuple(key for key in self.ranges if key != POSTURE)
        self.action_space = spaces.Box(-1.0, 1.0, (numbers,), np.float32)
        self.observation_space = spaces.Box(self._observed.low, self._observed.high, dtype=np.float64)
        wide = np.full(len(self.drawn_keys), 1e18)
        self.privileged_space = spaces.Box(
            np.concatenate([self._truth.low, -wide]), np.concatenate([self._truth.high, wide]), dtype=np.float64
        )
        self.observation_names = self._observed.names
        self.privileged_names = (*self._truth.names, *self.drawn_keys)
        self.ensemble = Ensemble(count, self.steps, self.actions.plan, numbers, held=self.actions.held, threads=threads)
        self.ensemble.rows = np.zeros((count, first.row_width))
        self.ensemble.wanted = np.zeros((count, 2 * n + 10))
        both = self.ensemble.rows, self.ensemble.wanted, self.ensemble.between
        self.now = Now(*both, n, numbers, self.period, contacts, first.row_states)
        self.now.steps = self.steps
        self._generators: list[np.random.Generator | None] = [None] * count
        self.parameters: list[dict[str, Any]] = [{} for _ in range(count)]
        self._drawn = np.zeros((count, len(self.drawn_keys)))
        self.reasons = [""] * count
        self.succeeded: Mask = np.zeros(count, dtype=np.bool_)
        self.cut: IntArray = np.zeros(count, dtype=np.int64)

    def _values_of_scenario(self, problem: Problem) -> Array:
        """Return what the scenario itself would set in place of an action, SI units."""
        values: Array = 0.5 * (self.actions.low + self.actions.high)
        constants = problem.constants()
        for i, name in enumerate(self.actions.names):
            if name == "force":
                values[i] = problem.table[0, 2 * problem.robot.n + 9]
            elif name.startswith(("tip.", "joint.")):
                values[i] = 0.0
            elif name.startswith("law."):
                values[i] = constants.law[self.actions.plan[self.actions.plan[:, 2] == i, 1][0]]
        return values

    def random(self, i: int) -> np.random.Generator:
        """Return the generator of environment `i`; a new one if it has not been given a seed yet."""
        generator = self._generators[i]
        if generator is None:
            generator, _ = np_random()
            self._generators[i] = generator
        return generator

    def begin(self, i: int, seed: int | None, options: Mapping[str, Any] | None) -> None:
        """Draw an episode of environment `i`; `start` lets it begin."""
        if seed is not None:
            self._generators[i], _ = np_random(seed)
        if options is not None and not isinstance(options, Mapping):
            raise ScenarioError(f"options = {options!r}: must be a dict of keys of the scenario and their values")
        random, world = self.random(i), None
        if self.task.worlds is not None:
            world = int(random.integers(self.task.worlds))
            random = np.random.default_rng(world)
        if world is None or options or world not in self._worlds:
            values = drawn(self.ranges, self.home, random, options or {}, self._seeds)
            problem = self._prepared(values)
            if world is not None and not options:
                self._worlds[world] = values, problem
        else:
            values, problem = self._worlds[world]
        self.ensemble.begin(i, problem, own=world is None and POSTURE in values)
        self.parameters[i] = values
        self._drawn[i] = [values[key] for key in self.drawn_keys]
        now, n = self.now, problem.robot.n
        now.f_des[i] = problem.table[0, 2 * n + 9]
        for each in (now.time, now.phase, now.on_target, now.jammed, now.force_sum, now.force_square):
            each[i] = 0.0
        now.left[i], now.touched[i] = self.instants, False
        now.action[i] = now.action_before[i] = self.actions.normal(self._own)
        self.reasons[i], self.succeeded[i], self.cut[i] = "", False, 0

    def _prepared(self, values: dict[str, Any]) -> Problem:
        """Return the scenario with these values, prepared."""
        keys = tuple(values)
        if keys not in self._variants:
            self._variants[keys] = Variants(self.scenario, keys)
        scenario, elsewhere = self._variants[keys].scenario(tuple(values.values())), POSTURE in values
        problem = problem_of(scenario, None, self._cache, kept=not elsewhere)
        if problem.steps != self.instants * self.steps or problem.row_width != self.ensemble.rows.shape[1]:
            raise ScenarioError(
                "options: the arm, time.step and time.duration of an environment cannot be changed: make another"
            )
        # The cache's table is overwritten for the next scenario of the same path.
        return problem if self.task.worlds is None or elsewhere else problem.with_table(problem.table.copy())

    def start(self, some: Sequence[int]) -> None:
        """Let the episodes of these environments begin."""
        self.ensemble.start(some)
        self.now.changed()
        for i in some:
            failure = self.ensemble.failures[i]
            if failure is not None:
                raise failure
        self.now.touched[some] = self.now.contact[some]

    def checked(self, action: Any, shape: tuple[int, ...]) -> Array:
        """Return an action as numbers.

        Raises
        ------
        ValueError
            If its shape is another, or it has an entry that is no finite number.
        """
        try:
            given = np.asarray(action).astype(np.float64, casting="same_kind")
        except (TypeError, ValueError):
            given = np.empty(0)
        if given.shape != shape:
            named = ", ".join(self.actions.names)
            raise ValueError(f"action of shape {np.shape(action)}: must be numbers of shape {shape}: {named}")
        if not np.isfinite(given).all():
            at = tuple(int(x) for x in np.argwhere(~np.isfinite(given))[0])
            raise ValueError(
                f"action[{', '.join(map(str, at))}] = {given[at]} ({self.actions.names[at[-1]]}): must be a finite "
                "number; nothing was stepped"
            )
        return given

    def step(self, action: Array, some: IntArray) -> tuple[Array, Mask, Mask]:
        """Step these environments with the actions (N, k), and return rewards, terminated and truncated (N,)."""
        now, ensemble = self.now, self.ensemble
        which: Any = some if some.size < self.count else slice(None)
        cut = np.minimum(np.maximum(action, -1.0), 1.0)
        self.cut[which] = (cut != action).sum(axis=1)[which]
        now.action_before[which] = now.action[which]
        now.action[which] = cut[which]
        ensemble.actions[:] = self.actions.physical(cut)
        ensemble.step(some)
        now.changed()
        active = np.zeros(self.count, dtype=np.bool_)
        active[which] = True
        stopped = ensemble.failed & active
        for i in np.flatnonzero(stopped):
            self.reasons[i] = str(ensemble.failures[i])
        went = active & ~stopped
        self._advance(went)
        terminated = stopped.copy()
        for name, ending in self._endings.items():
            ends = np.asarray(ending(now), dtype=np.bool_) & went & ~terminated
            for i in np.flatnonzero(ends):
                self.reasons[i] = name
            terminated |= ends
        failed = terminated.copy()
        truncated = went & ~terminated & (now.left <= 0.0)
        self._judge(went & ~failed, truncated)
        terminated |= self.succeeded & went
        truncated &= ~terminated
        for i in np.flatnonzero(truncated):
            self.reasons[i] = TIME_UP
        return self._rewards(active, failed), terminated, truncated

    def _advance(self, went: Mask) -> None:
        """Bring up to date what is counted from instant to instant, of those that went on."""
        now, period = self.now, self.period
        now.left -= went
        done = self.instants - now.left
        np.multiply(done, period, out=now.time)
        np.divide(done, self.instants, out=now.phase)
        touching = now.contact
        now.touched |= went & (touching | (now.free_share < 1.0))
        error = now.force_error
        near = (np.abs(error) <= self.task.tolerance) & touching & went
        now.on_target += period
        now.on_target *= near
        if now.link_forces.shape[1]:
            now.jammed[:] = np.where(went & now.held, now.jammed + period, 0.0)
        now.force_sum += period * np.where(touching & went, now.f_des - now.f_measured, 0.0)
        now.force_square += np.where(went, period * error * error, 0.0)

    def _judge(self, going: Mask, at_end: Mask) -> None:
        """Find which episodes have succeeded."""
        now, hold, goal = self.now, self.task.hold, self.task.goal
        if goal is not None:
            won = going & np.asarray(goal(now), dtype=np.bool_)
        elif hold is not None:
            won = going & (now.on_target >= hold * (1.0 - 1e-9))
        elif not at_end.any():
            return
        else:
            mean = now.force_square / np.maximum(now.time, self.period)
            won = at_end & (mean <= self.task.tolerance**2) & (now.path_error <= NEAR)
        for i in np.flatnonzero(won):
            self.reasons[i] = SUCCESS
        self.succeeded |= won

    def _rewards(self, active: Mask, failed: Mask) -> Array:
        """Return the rewards (N,): the terms' sum, and where an episode failed the most that was left to lose."""
        now, total = self.now, np.zeros(self.count)
        self.terms: dict[str, Array] = {}
        most = 0.0
        for name, (weight, term) in self._terms.items():
            value = np.asarray(term(now), dtype=np.float64)
            if value.shape != (self.count,):
                raise ScenarioError(f"rewards[{name!r}]: returned shape {value.shape}: must be ({self.count},)")
            self.terms[name] = np.where(active, weight * value, 0.0)
            total = total + self.terms[name]
            most += abs(weight)
        if failed.any():
            self.terms["failed"] = np.where(failed, -most * (now.left + 1.0), 0.0)
            total = total + self.terms["failed"]
        bad = ~np.isfinite(total)
        if bad.any():
            i = int(np.flatnonzero(bad)[0])
            named = ", ".join(f"{name} = {value[i]}" for name, value in self.terms.items())
            raise ScenarioError(f"rewards: {total[i]} at t = {now.time[i]:g} s: {named}: must be finite numbers")
        return total

    def observe(self) -> Array:
        """Return the observations (N, k)."""
        return self._observed.read(self.now)

    def privileged(self) -> Array:
        """Return the privileged observations (N, k)."""
        return np.concatenate([self._truth.read(self.now), self._drawn], axis=1)

    def close(self) -> None:
        """End the threads."""
        self.ensemble.close()
