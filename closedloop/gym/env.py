"""The single environment, and the vector environment: many episodes side by side in compiled code, on all cores."""

from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from closedloop.base.arguments import arguments_checked
from closedloop.base.arrays import Array, Mask
from closedloop.base.errors import ScenarioError
from closedloop.base.second_process import cores
from closedloop.gym.core import Core
from closedloop.gym.terms import Task, task_of

Observation = Any
RENDER_MODES = ("rgb_array", "human")


class Shown:
    """What environments show, from when it is first asked for; see `closedloop.gym.view`."""

    core: Core
    _view: Any = None

    def _show(self, render_mode: str, i: int) -> Any:
        """Return a picture of environment `i`, or show it in the browser."""
        if self._view is None:
            from closedloop.gym.view import VIEWS

            self._view = VIEWS[render_mode](self.core)
        return self._view.show(i)

    def _close(self) -> None:
        if self._view is not None:
            self._view.close()
            self._view = None
        self.core.close()


class ContactEnv(gymnasium.Env[Observation, Any], Shown):
    """An arm in hard contact, as an environment of Gymnasium.

    Parameters
    ----------
    task : Task or str, optional
        What is to be done, "press", "slide", "wipe"; left out: `scenario` says it.
    render_mode : "rgb_array", "human" or None
        A picture (H, W, 3) without a display; the arm in the browser.
    privileged : bool
        Whether an observation is a dict of "policy" and "critic", which is the truth, instead of the former alone.
    changes
        Attributes of `closedloop.gym.Task` that replace those of the task.

    Raises
    ------
    ScenarioError
        If the task or its scenario is at fault.
    """

    metadata: dict[str, Any] = {"render_modes": list(RENDER_MODES)}  # noqa: RUF012

    @arguments_checked()
    def __init__(
        self, task: Task | str | None = None, *, render_mode: str | None = None, privileged: bool = False,
        **changes: Any,
    ) -> None:  # fmt: skip
        if render_mode is not None and render_mode not in RENDER_MODES:
            raise ScenarioError(f"render_mode = {render_mode!r}: must be {' or '.join(map(repr, RENDER_MODES))}")
        self.core = Core(task_of(task, changes), 1)
        self.render_mode, self._privileged = render_mode, privileged
        self.metadata = {**self.metadata, "render_fps": max(1, round(1.0 / self.core.period))}
        self.action_space = self.core.action_space
        self.observation_space = observation_space(self.core, privileged)
        self._only = np.zeros(1, dtype=np.int64)
        self._over = True

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode.

        Parameters
        ----------
        seed : int, optional
            Of everything that is drawn from now on.
        options : dict, optional
            Values of keys of the scenario, in place of what is drawn: ``{"friction.coefficient": 0.3}``.

        Returns
        -------
        observation, info
            `info` has the truth, "privileged" and the "parameters" of the episode.
        """
        super().reset(seed=seed)
        self.core.begin(0, seed, options)
        self.core.start([0])
        self._over = False
        if self.render_mode == "human":
            self.render()
        return self._observation(), info_of(self.core, 0)

    def step(self, action: Any) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Hold an action for a control period; see `gymnasium.Env.step`.

        Raises
        ------
        ValueError
            If the action has another shape or an entry that is no finite number.
        gymnasium.error.ResetNeeded
            If the episode is over.
        """
        if self._over:
            raise gymnasium.error.ResetNeeded("step: the episode is over, or was not begun: call reset() first")
        given = self.core.checked(action, (len(self.core.actions.names),))
        rewards, terminated, truncated = self.core.step(given[None, :], self._only)
        self._over = bool(terminated[0] or truncated[0])
        if self.render_mode == "human":
            self.render()
        info = info_of(self.core, 0) | ended_of(self.core, 0, self._over)
        info |= {f"reward/{name}": float(value[0]) for name, value in self.core.terms.items()}
        return self._observation(), float(rewards[0]), bool(terminated[0]), bool(truncated[0]), info

    def _observation(self) -> Observation:
        policy = self.core.observe()[0]
        return {"policy": policy, "critic": self.core.privileged()[0]} if self._privileged else policy

    def render(self) -> Any:
        """Return a picture (H, W, 3) of the arm, or with "human" show it in the browser."""
        if self.render_mode is None:
            gymnasium.logger.warn('render: the environment was made without render_mode; give "rgb_array" or "human"')
            return None
        return self._show(self.render_mode, 0)

    def close(self) -> None:
        """End what the environment has begun."""
        self._close()


def observation_space(core: Core, privileged: bool) -> spaces.Space[Any]:
    """Return the space of the observations of one environment."""
    if not privileged:
        return core.observation_space
    return spaces.Dict({"policy": core.observation_space, "critic": core.privileged_space})


def truth_of(core: Core) -> dict[str, Array]:
    """Return the truth about all environments at their control instants: arrays with a row for each.

    "force_rms" is the root mean square of the force's error since the reset, N.
    """
    now = core.now
    names = (
        "time", "f", "f_des", "f_measured", "largest_force", "largest_link_force", "impulse", "contact", "path_error",
    )  # fmt: skip
    mean = np.divide(now.force_square, now.time, out=np.zeros(core.count), where=now.time > 0.0)
    return {name: getattr(now, name) for name in names} | {
        "force_rms": np.sqrt(mean), "cut": core.cut, "is_success": core.succeeded, "privileged": core.privileged(),
    }  # fmt: skip


def info_of(core: Core, i: int) -> dict[str, Any]:
    """Return the truth about environment `i` at its control instant, and what its episode has drawn."""
    told = {name: values[i].item() if values.ndim == 1 else values[i] for name, values in truth_of(core).items()}
    return {**told, "parameters": dict(core.parameters[i])}


def ended_of(core: Core, i: int, over: bool) -> dict[str, Any]:
    """Return why the episode of environment `i` is over, if it is."""
    return {"reason": core.reasons[i]} if over else {}


Result = tuple[Any, Array, Mask, Mask, dict[str, Any]]


class ContactVectorEnv(VectorEnv[Any, Any, Any], Shown):
    """Environments of one task, each to the bit what the single one with its seed is.

    Parameters
    ----------
    num_envs : int
    task, render_mode, privileged, changes
        See `closedloop.gym.env.ContactEnv`; "rgb_array" alone draws, a picture of each.
    autoreset_mode : AutoresetMode or str
        "NextStep", "SameStep" or "Disabled", as Gymnasium has them.
    threads : int, optional
        As many as there are cores if left out. Results are the same, to the last bit, for any number.

    Raises
    ------
    ScenarioError
    """

    metadata: dict[str, Any] = {  # noqa: RUF012
        "render_modes": ["rgb_array"],
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }

    @arguments_checked()
    def __init__(
        self, num_envs: int = 1, task: Task | str | None = None, *, render_mode: str | None = None,
        privileged: bool = False, autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        threads: int | None = None, **changes: Any,
    ) -> None:  # fmt: skip
        if num_envs < 1 or (threads is not None and threads < 1):
            raise ScenarioError(f"num_envs = {num_envs}, threads = {threads}: must be at least 1")
        if render_mode not in (None, RENDER_MODES[0]):
            raise ScenarioError(f"render_mode = {render_mode!r}: must be {RENDER_MODES[0]!r} for many environments")
        try:
            self.autoreset_mode = AutoresetMode(autoreset_mode)
        except ValueError:
            known = ", ".join(repr(mode.value) for mode in AutoresetMode)
            raise ScenarioError(f"autoreset_mode = {autoreset_mode!r}: must be one of {known}") from None
        self.core = Core(task_of(task, changes), num_envs, threads or cores())
        self.num_envs, self.render_mode, self._privileged = num_envs, render_mode, privileged
        self.metadata = {
            **self.metadata,
            "autoreset_mode": self.autoreset_mode,
            "render_fps": max(1, round(1.0 / self.core.period)),
        }
        self.single_action_space = self.core.action_space
        self.single_observation_space = observation_space(self.core, privileged)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self._over: Mask = np.ones(num_envs, dtype=np.bool_)
        self._everyone = np.arange(num_envs)
        self._begun = False

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode in each environment; with a whole number as `seed` environment i has seed + i.

        `options` are as for one environment, for all; with "reset_mask", (N,) truths, only those begin.
        """
        some, options = self._asked(options)
        if isinstance(seed, int | np.integer):
            super().reset(seed=int(seed))
            seeds: list[int | None] = [int(seed) + i for i in range(self.num_envs)]
        else:
            seeds = [None] * self.num_envs if seed is None else list(seed)
        if len(seeds) != self.num_envs:
            raise ValueError(f"seed: has {len(seeds)} entries: must be one number, or one for each of {self.num_envs}")
        self._begin(some, seeds, options)
        infos: dict[str, Any] = {}
        for i in some:
            infos = self._add_info(infos, info_of(self.core, i), int(i))
        self._begun = self._begun or len(some) == self.num_envs
        return self._observations(), infos

    def _asked(self, options: dict[str, Any] | None) -> tuple[NDArray[np.int64], dict[str, Any] | None]:
        """Return which environments are to begin, and the other options."""
        if not isinstance(options, Mapping) or "reset_mask" not in options:
            return self._everyone, options
        options = dict(options)
        mask = options.pop("reset_mask")
        flags = isinstance(mask, np.ndarray) and mask.dtype == np.bool_ and mask.shape == (self.num_envs,)
        if not flags or not mask.any():
            raise ValueError(f"options['reset_mask']: must be an array of {self.num_envs} booleans, one of them True")
        return np.flatnonzero(mask), options

    def _begin(self, some: Any, seeds: list[int | None], options: Mapping[str, Any] | None) -> None:
        for i in some:
            self.core.begin(int(i), seeds[i], options)
        self.core.start(some)
        self._over[some] = False

    def step(self, actions: Any) -> Result:
        """Hold an action in each environment for a control period; see `gymnasium.vector.VectorEnv.step`.

        Raises
        ------
        ValueError
            If the actions have another shape, or an entry that is no finite number.
        gymnasium.error.ResetNeeded
            Before `reset`, and with autoreset disabled if an episode is over.
        """
        if not self._begun:
            raise gymnasium.error.ResetNeeded("step: no episode was begun: call reset() first")
        core, over = self.core, self._over
        given = core.checked(actions, self.action_space.shape or ())
        mode, fresh = self.autoreset_mode, np.empty(0, dtype=np.int64)
        if over.any():
            fresh = np.flatnonzero(over)
            if mode == AutoresetMode.DISABLED:
                raise gymnasium.error.ResetNeeded(
                    f"step: the episode of environment {fresh[0]} is over, and autoreset is disabled: call reset with "
                    "options={'reset_mask': ...}"
                )
            self._begin(fresh, [None] * self.num_envs, None)
        going = self._everyone if not fresh.size else np.setdiff1d(self._everyone, fresh)
        rewards, terminated, truncated = core.step(given, going)
        ended = terminated | truncated
        infos = self._infos(going)
        for i in np.flatnonzero(ended):
            infos = self._add_info(infos, ended_of(core, int(i), True), int(i))
        if mode == AutoresetMode.SAME_STEP:
            infos = self._same_step(np.flatnonzero(ended), infos)
        else:
            self._over = ended
        for i in fresh:
            infos = self._add_info(infos, {"parameters": dict(core.parameters[i])}, int(i))
        return self._observations(), rewards, terminated, truncated, infos

    def _same_step(self, ended: NDArray[np.int64], infos: dict[str, Any]) -> dict[str, Any]:
        """Begin the next episodes at once, with what the last ended with in the infos."""
        if not ended.size:
            return infos
        last = self._observations()
        for i in ended:
            final = {name: part[i] for name, part in last.items()} if self._privileged else last[i]
            told = info_of(self.core, int(i)) | ended_of(self.core, int(i), True)
            infos = self._add_info(infos, {"final_obs": final, "final_info": told}, int(i))
        self._begin(ended, [None] * self.num_envs, None)
        return infos

    def _infos(self, went: NDArray[np.int64]) -> dict[str, Any]:
        """Return the truth about all environments, arrays with a row for each."""
        told = {name: values.copy() for name, values in truth_of(self.core).items()}
        told |= {f"reward/{name}": value for name, value in self.core.terms.items()}
        everyone = np.ones(self.num_envs, dtype=np.bool_)
        stepped = everyone if went.size == self.num_envs else np.isin(self._everyone, went)
        masks = {f"_{name}": stepped if name.startswith("reward/") else everyone for name in told}
        return told | masks

    def _observations(self) -> Any:
        policy = self.core.observe()
        return {"policy": policy, "critic": self.core.privileged()} if self._privileged else policy

    def render(self) -> Any:
        """Return a picture (H, W, 3) of each environment."""
        if self.render_mode is None:
            gymnasium.logger.warn('render: the environment was made without render_mode="rgb_array"')
            return None
        return tuple(self._show(self.render_mode, i) for i in range(self.num_envs))

    def close_extras(self, **kwargs: Any) -> None:
        """End the threads."""
        self._close()
