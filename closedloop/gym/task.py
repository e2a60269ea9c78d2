"""A task: a scenario, what an action sets, what is observed, what is rewarded, and what differs between episodes."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from closedloop.base.arguments import fields_checked
from closedloop.base.errors import ScenarioError
from closedloop.gym.terms import Ending, Range, contact_lost, excessive_force, jammed, lowered
from closedloop.scenario.load import load_scenario
from closedloop.scenario.scenario import Scenario

OBSERVED = ("q", "v", "tip_error", "tip_velocity", "force_error", "force_sum", "contact", "sticks", "phase", "action")
SCENARIOS = Path(__file__).parent / "scenarios"


@dataclass(frozen=True)
@fields_checked
class Task:
    """A task of an environment.

    Attributes
    ----------
    scenario : Scenario, or name or path of one
        What is simulated; its duration is that of an episode.
    overrides : mapping
        Keys of the scenario and values, as `closedloop.load_scenario` takes them.
    actions : mapping
        See `closedloop.gym.core.Actions`.
    observations : tuple of str
        See `closedloop.gym.terms.PARTS`.
    rewards : mapping
        See `closedloop.gym.terms.as_terms`; the reward is their weighted sum.
    endings : mapping of str to callable
        For each reason for which an episode ends as failed a function of `closedloop.gym.Now`, (N,) truths.
    ranges : mapping
        Dotted keys of the scenario whose values are drawn for each episode, each with (low, high) or a `Range`.
    worlds : int or None
        Number of worlds, each drawn once from the ranges, the same for any seed; each episode takes one of them. A
        world that is used again takes a fraction of the time. None: each episode is drawn anew.
    control_rate : float
        Actions per second, Hz.
    tolerance : float
        Largest error with which the force is on target, N.
    hold : float or None
        An episode succeeds once the force has been on target for so long, s; None: if it is so at its end, with a mean
        square of the force's error within the tolerance, and the tip on its path within 5 mm.
    goal : callable or None
        In place of that: an episode succeeds as soon as this function of `closedloop.gym.Now`, (N,) truths, says so.
    """

    scenario: Scenario | str | Path
    overrides: Mapping[str, Any] = field(default_factory=dict)
    actions: Mapping[str, Any] = field(default_factory=lambda: {"force": (0.0, 20.0)})
    observations: tuple[str, ...] = OBSERVED
    rewards: Mapping[str, Any] = field(default_factory=lambda: {"force": 1.0, "smooth": 0.1})
    endings: Mapping[str, Ending] = field(
        default_factory=lambda: {"excessive force": excessive_force(100.0), "contact lost": contact_lost}
    )
    ranges: Mapping[str, Any] = field(default_factory=dict)
    worlds: int | None = None
    control_rate: float = 100.0
    tolerance: float = 0.5
    hold: float | None = None
    goal: Ending | None = None

    def load_scenario(self) -> Scenario:
        """Return the scenario."""
        if isinstance(self.scenario, Scenario):
            if self.overrides:
                raise ScenarioError("overrides: go with a scenario's name or path; this one is a Scenario already")
            return self.scenario
        return load_scenario(self.scenario, dict(self.overrides))

    def changed(self, changes: Mapping[str, Any]) -> "Task":
        """Return the task with some attributes replaced.

        Raises
        ------
        ScenarioError
            If there is no such attribute.
        """
        for name in changes:
            if name not in self.__dataclass_fields__:
                raise ScenarioError(f"{name}: no such option; there are {', '.join(self.__dataclass_fields__)}")
        return replace(self, **changes)


SLIDING = {"force": 1.0, "path": 0.5, "smooth": 0.1, "overload": 1.0, "loss": 1.0}

TASKS: dict[str, Task] = {
    "press": Task(
        SCENARIOS / "press.toml",
        ranges={
            "compliance.stiffness": (3e3, 1e5),
            "friction.coefficient": (0.0, 0.6),
            "model_error.payload": (0.0, 0.5),
            "sensor.bias": (-0.1, 0.1),
            "start.q": (-0.05, 0.05),
        },
        hold=0.5,
    ),
    "slide": Task(
        SCENARIOS / "slide.toml",
        actions={"force": (0.0, 20.0), "tip.t1": (-0.01, 0.01), "tip.t2": (-0.01, 0.01)},
        rewards=SLIDING,
        ranges={
            "friction.coefficient": (0.1, 0.5),
            "model_error.payload": (0.0, 0.3),
            "sensor.bias": (-0.1, 0.1),
            "start.q": (-0.05, 0.05),
        },
    ),
    "wipe": Task(
        SCENARIOS / "wipe.toml",
        actions={"force": (0.0, 20.0), "tip.t1": (-0.01, 0.01), "tip.t2": (-0.01, 0.01)},
        rewards=SLIDING,
        ranges={
            "friction.coefficient": (0.1, 0.5),
            "model_error.payload": (0.0, 0.3),
            "surface.radius": (0.25, 0.6),
            "sensor.bias": (-0.1, 0.1),
        },
    ),
    "insert": Task(
        SCENARIOS / "insert.toml",
        actions={"joint": ((-0.004, -0.004, -0.05), (0.004, 0.004, 0.05))},
        observations=("joint_error", "v", "torque", "tip_error", "phase", "action"),
        rewards={"travel": 1.0, "knock": 0.2, "smooth": 0.1},
        endings={"excessive force": excessive_force(45.0), "jammed": jammed(0.3)},
        ranges={
            "start.q": Range((-0.0015, 0.0, -0.02), (0.0015, 0.0, 0.02)),
            "contact.*.friction": (0.05, 0.4),
            "contact.*.surface.oversize": (0.00005, 0.0002),
        },
        goal=lowered(0.015),
    ),
}


def task_of(given: Task | str | None, changes: Mapping[str, Any]) -> Task:
    """Return a task by its name or as given, or of the scenario in `changes`, with what else they replace."""
    if isinstance(given, Task):
        return given.changed(changes)
    if given is None:
        if "scenario" not in changes:
            raise ScenarioError("scenario: give the name or path of one, or a Scenario")
        return Task(changes["scenario"]).changed(changes)
    if given not in TASKS:
        raise ScenarioError(f"task = {given!r}: must be one of {', '.join(TASKS)}, or a closedloop.gym.Task")
    return TASKS[given].changed(changes)
