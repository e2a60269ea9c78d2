"""The single environment."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from closedloop.base.arguments import arguments_checked
from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError
from closedloop.gym.core import Core
from closedloop.gym.task import Task, task_of

Observation = Any
RENDER_MODES = ("rgb_array", "human")


class Shown:
    """What environments show, from when it is first asked for; see `closedloop.gym.view`."""

    core: Core
    _view: Any = None

    def _show(self, render_mode: str, i: int) -> Any:
        """Return a picture of environment `i`, or show it in the browser."""
        if self._view is None:
            from closedloop.gym.view import view_of

            self._view = view_of(render_mode, self.core)
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
