"""The single environment."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from closedloop.base.arguments import arguments_checked
from closedloop.base.errors import ScenarioError
from closedloop.gym.core import Core
from closedloop.gym.task import Task, task_of

Observation = Any
RENDER_MODES = ("rgb_array", "human")


class ContactEnv(gymnasium.Env[Observation, Any]):
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
        self._view: Any = None

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
        if self._view is None:
            from closedloop.gym.view import view_of

            self._view = view_of(self.render_mode, self.core)
        return self._view.show(0)

    def close(self) -> None:
        """End what the environment has begun."""
        if self._view is not None:
            self._view.close()
            self._view = None
        self.core.close()


def observation_space(core: Core, privileged: bool) -> spaces.Space[Any]:
    """Return the space of the observations of one environment."""
    if not privileged:
        return core.observation_space
    return spaces.Dict({"policy": core.observation_space, "critic": core.privileged_space})


def info_of(core: Core, i: int) -> dict[str, Any]:
    """Return the truth about environment `i` at its control instant."""
    now = core.now
    return {
        "time": float(now.time[i]),
        "force": float(now.force[i]),
        "wanted_force": float(now.wanted_force[i]),
        "largest_force": float(now.largest_force[i]),
        "largest_link_force": float(now.largest_link_force[i]),
        "impulse": float(now.impulse[i]),
        "contact": bool(now.contact[i]),
        "path_error": float(now.path_error[i]),
        "force_rms": rms(core, i),
        "cut": int(core.cut[i]),
        "is_success": bool(core.succeeded[i]),
        "privileged": core.privileged()[i],
        "parameters": dict(core.parameters[i]),
    }


def rms(core: Core, i: int) -> float:
    """Return the root mean square of the force's error since the reset, N."""
    return float(np.sqrt(core.now.force_square[i] / core.now.time[i])) if core.now.time[i] > 0.0 else 0.0


def ended_of(core: Core, i: int, over: bool) -> dict[str, Any]:
    """Return why the episode of environment `i` is over, if it is."""
    return {"reason": core.reasons[i]} if over else {}
