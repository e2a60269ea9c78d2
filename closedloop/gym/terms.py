"""A task of an environment and its parts: what is observed, rewarded and drawn, and how an episode ends.

Rewards and endings are functions of `Now`, the state of all environments at a control instant: a term returns (N,)
numbers, an ending (N,) truths. Terms that ship are zero or negative, so that an episode that ends early gains nothing
by it: what it would have cost at most is then due at once (`failed`).
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from closedloop.base.arguments import fields_checked
from closedloop.base.arrays import Array, Mask
from closedloop.base.errors import ScenarioError
from closedloop.control.reference.desired import Reference
from closedloop.loop.step.record_row import ContactRow, Row
from closedloop.mechanics.closure.contact_force import FREE, STUCK
from closedloop.scenario.load import load_scenario
from closedloop.scenario.scenario import Scenario
from closedloop.simulation.ensemble.member import Between
from robot_models.cached import cached_property

# A tip is held if it is slower than this, m/s, and further from where it is wanted than this, m.
SLOW, AWAY = 2e-3, 2e-3


class Now:
    """The state of N environments at a control instant, with n joints and k numbers of an action.

    Joint quantities are (N, n), vectors in space (N, 3) in the base frame, others (N,); SI units. All values are true
    ones except `measured`. The arrays are views: copy what you want to keep.

    Attributes
    ----------
    q, v, acceleration, torque : (N, n) arrays
    tip, tip_velocity, normal, slip_velocity, friction_force : (N, 3) arrays
    f, f_measured, gap, gap_rate : (N,) arrays
        Contact force; the force sensor's latest reading, as a control law has it; distance from the surface, m, and
        its rate.
    link_forces, link_gaps : (N, c) arrays
        Of each `[[contact]]`: the force along its normal, N, and its gap, m.
    wanted_tip, wanted_tip_velocity, wanted_q : (N, 3), (N, 3), (N, n) arrays
        Those of the reference, as the action has displaced it.
    f_des : (N,) array
        The force of the task, N, whatever the action sets.
    path_error : (N,) array
        Distance of the tip from the reference along the surface, m.
    contact, sticks : (N,) arrays of bool
    largest_force, smallest_force, largest_link_force, impulse : (N,) arrays
        Since the control instant before: of the contact force at any row, N; of the largest force of a `[[contact]]`,
        N; the largest impulse, N s.
    free_share, events : (N,) arrays
        Since then: share of rows off the surface; how many events there were.
    time, phase : (N,) arrays
        Since the reset, s; and as a share of the episode.
    left : (N,) array
        Control instants until the episode's end.
    touched : (N,) array of bool
        Whether it has been in contact since the reset.
    on_target : (N,) array
        Time for which the force has been within the task's tolerance, s.
    jammed : (N,) array
        Time for which a `[[contact]]` has been closed and the tip slower than 2 mm/s, although the desired position is
        more than 2 mm away, s.
    force_sum : (N,) array
        ∫ (f_des − f_measured) dt while in contact, N s.
    force_square : (N,) array
        ∫ (f_des − f)² dt since the reset, N² s.
    action, action_before : (N, k) arrays
        From −1 to 1.
    period : float
        Time between two control instants, s.
    """

    def __init__(
        self, rows: Array, wanted: Array, between: Array, n: int, numbers: int, period: float, contacts: int = 0,
        states: int = 0,
    ) -> None:  # fmt: skip
        count, end = rows.shape[0], rows.shape[1] - states
        of_contacts = rows[:, end - ContactRow.count(contacts) : end]
        self.link_forces, self.link_gaps = (
            of_contacts[:, ContactRow.place(x, contacts)] for x in ("link_forces", "link_gaps")
        )

        def part(name: str) -> Any:
            return rows[:, Row.place(name, n)]

        self.period = period
        self.q, self.v, self.acceleration, self.torque = map(part, ("q", "v", "acceleration", "torque"))
        self.tip, self.tip_velocity, self.normal = map(part, ("position", "velocity", "surface_normal"))
        self.slip_velocity, self.friction_force = map(part, ("slip_velocity", "friction_force"))
        self.f = part("contact_force")
        self.gap, self.gap_rate, self._mode = part("closure_error"), part("closure_rate"), part("mode")
        self.wanted_q, self.wanted_tip, self.wanted_tip_velocity = (
            wanted[:, Reference.place(x, n)] for x in ("q", "position", "velocity")
        )
        self.largest_force, self.smallest_force, self.largest_link_force, self._free, self.events, self.impulse = (
            between[:, Between.place(x)]
            for x in ("largest_force", "smallest_force", "largest_link_force", "free_rows", "events", "impulse")
        )
        self.f_measured, self.path_error = (between[:, Between.place(x)] for x in ("measured", "path_error"))
        self.f_des: Array = np.zeros(count)
        self.time: Array = np.zeros(count)
        self.phase: Array = np.zeros(count)
        self.left: Array = np.zeros(count)
        self.touched: Mask = np.zeros(count, dtype=np.bool_)
        self.on_target: Array = np.zeros(count)
        self.jammed: Array = np.zeros(count)
        self.force_sum: Array = np.zeros(count)
        self.force_square: Array = np.zeros(count)
        self.action: Array = np.zeros((count, numbers))
        self.action_before: Array = np.zeros((count, numbers))
        self.steps = 1

    def changed(self) -> None:
        """Discard the values computed from the arrays, because the arrays were written."""
        for name in _COMPUTED:
            vars(self).pop(name, None)

    @cached_property
    def contact(self) -> Mask:
        """Whether the tip touches the surface."""
        return self._mode != FREE

    @cached_property
    def sticks(self) -> Mask:
        """Whether it sticks to it."""
        return self._mode == STUCK

    @cached_property
    def free_share(self) -> Array:
        """Share of the rows since the control instant before at which the tip was off the surface."""
        return self._free / self.steps

    @cached_property
    def force_error(self) -> Array:
        """True force minus the desired one, N."""
        return self.f - self.f_des

    @property
    def held(self) -> Mask:
        """Whether a contact of a link is closed, and the tip is slow and not at the desired position."""
        off, speed = self.tip - self.wanted_tip, self.tip_velocity
        slow = (speed * speed).sum(axis=1) < SLOW * SLOW
        touching = (self.link_forces > 0.0).any(axis=1)
        return slow & touching & ((off * off).sum(axis=1) > AWAY * AWAY)


# What `Now` computes from its arrays once a step.
_COMPUTED = tuple(name for name, value in vars(Now).items() if isinstance(value, cached_property))


class Part(NamedTuple):
    """A part of an observation: its numbers (N, k), how many for n joints, a actions, c contacts, and their bounds."""

    read: Callable[[Now], Array]
    numbers: Callable[[int, int, int], int]
    low: float
    high: float
    unit: str


def _one(now_part: Array) -> Array:
    return now_part[:, None]


# Beyond any run that does not end: a joint's speed ends one at 1e6 rad/s (m/s).
FAR, FAST, STRONG = 1e3, 1e6, 1e6
PARTS: dict[str, Part] = {
    "q": Part(lambda now: now.q, lambda n, a, c: n, -FAR, FAR, "rad"),
    "v": Part(lambda now: now.v, lambda n, a, c: n, -FAST, FAST, "rad/s"),
    "torque": Part(lambda now: now.torque, lambda n, a, c: n, -STRONG, STRONG, "N m"),
    "joint_error": Part(lambda now: now.q - now.wanted_q, lambda n, a, c: n, -FAR, FAR, "rad"),
    "tip_error": Part(lambda now: now.tip - now.wanted_tip, lambda n, a, c: 3, -FAR, FAR, "m"),
    "tip_velocity": Part(lambda now: now.tip_velocity, lambda n, a, c: 3, -FAST, FAST, "m/s"),
    "f_measured": Part(lambda now: _one(now.f_measured), lambda n, a, c: 1, -STRONG, STRONG, "N"),
    "force_error": Part(lambda now: _one(now.f_des - now.f_measured), lambda n, a, c: 1, -STRONG, STRONG, "N"),
    "force_sum": Part(lambda now: _one(now.force_sum), lambda n, a, c: 1, -STRONG, STRONG, "N s"),
    "contact": Part(lambda now: _one(now.contact.astype(np.float64)), lambda n, a, c: 1, 0.0, 1.0, "1"),
    "sticks": Part(lambda now: _one(now.sticks.astype(np.float64)), lambda n, a, c: 1, 0.0, 1.0, "1"),
    "phase": Part(lambda now: _one(now.phase), lambda n, a, c: 1, 0.0, 1.0, "1"),
    "action": Part(lambda now: now.action, lambda n, a, c: a, -1.0, 1.0, "1"),
}
# The truth, for critics; what an episode draws stands behind it.
TRUTH: dict[str, Part] = {
    "f": Part(lambda now: _one(now.f), lambda n, a, c: 1, -STRONG, STRONG, "N"),
    "friction_force": Part(lambda now: now.friction_force, lambda n, a, c: 3, -STRONG, STRONG, "N"),
    "slip_velocity": Part(lambda now: now.slip_velocity, lambda n, a, c: 3, -FAST, FAST, "m/s"),
    "gap": Part(lambda now: _one(now.gap), lambda n, a, c: 1, -FAR, FAR, "m"),
    "link_forces": Part(lambda now: now.link_forces, lambda n, a, c: c, -STRONG, STRONG, "N"),
    "link_gaps": Part(lambda now: now.link_gaps, lambda n, a, c: c, -FAR, FAR, "m"),
    "normal": Part(lambda now: now.normal, lambda n, a, c: 3, -1.0, 1.0, "1"),
}


class Observations:
    """An observation of some parts, in order.

    Attributes
    ----------
    names : tuple of str
        Of each number: "q.0", "q.1", ..., "f_measured".
    low, high : (k,) arrays
        Bounds, to which what is observed is cut.
    """

    def __init__(self, parts: Sequence[str], known: dict[str, Part], n: int, numbers: int, contacts: int = 0) -> None:
        for name in parts:
            if name not in known:
                raise ScenarioError(f"observations: no part {name!r}; there are {', '.join(known)}")
        self._parts = [known[name] for name in parts]
        counts = [part.numbers(n, numbers, contacts) for part in self._parts]
        self.names = tuple(
            name if count == 1 else f"{name}.{i}"
            for name, count in zip(parts, counts, strict=True)
            for i in range(count)
        )
        self.low = np.repeat([part.low for part in self._parts], counts)
        self.high = np.repeat([part.high for part in self._parts], counts)

    def read(self, now: Now) -> Array:
        """Return the observations (N, k), a new array."""
        values: Array = np.concatenate([part.read(now) for part in self._parts], axis=1)
        np.maximum(values, self.low, out=values)
        np.minimum(values, self.high, out=values)
        return values


Term = Callable[[Now], Array]
Ending = Callable[[Now], Mask]


def force(now: Now) -> Array:
    """−|f − f_des|/f_des, at least −1."""
    scale = np.maximum(np.abs(now.f_des), 1.0)
    return -np.minimum(np.abs(now.force_error) / scale, 1.0)


def path(now: Now) -> Array:
    """−(distance from the path)/10 mm, at least −1."""
    return -np.minimum(now.path_error / 0.01, 1.0)


def smooth(now: Now) -> Array:
    """−(mean square change of the action)/4: 0 to −1."""
    change = now.action - now.action_before
    return -0.25 * (change * change).mean(axis=1)


def overload(now: Now) -> Array:
    """−(how far the largest force is above twice the wanted one)/f_des, at least −1."""
    scale = np.maximum(np.abs(now.f_des), 1.0)
    return -np.clip((now.largest_force - 2.0 * scale) / scale, 0.0, 1.0)


def loss(now: Now) -> Array:
    """−(share of the time off the surface, once it has been touched)."""
    return np.where(now.touched, -now.free_share, 0.0)


def travel(now: Now) -> Array:
    """−(distance of the tip from the desired one)/10 mm, at least −1, contacts of links or not."""
    off = now.tip - now.wanted_tip
    return -np.minimum(np.sqrt((off * off).sum(axis=1)) / 0.01, 1.0)


def knock(now: Now) -> Array:
    """−(largest force of a contact of a link)/100 N, at least −1."""
    return -np.minimum(now.largest_link_force / 100.0, 1.0)


TERMS: dict[str, Term] = {
    "force": force, "path": path, "smooth": smooth, "overload": overload, "loss": loss, "travel": travel,
    "knock": knock,
}  # fmt: skip


def excessive_force(limit: float) -> Ending:
    """Return the ending of a contact force above `limit`, N, at any row since the control instant before.

    Of the tip's contact, and of those of links.
    """
    return lambda now: np.maximum(now.largest_force, now.largest_link_force) > limit


def jammed(after: float) -> Ending:
    """Return the ending of a tip that contacts of links hold still for so long, s, though it is wanted elsewhere."""
    return lambda now: now.jammed >= after * (1.0 - 1e-9)


def lowered(depth: float) -> Ending:
    """Return whether the tip is below z = −`depth`, m: a goal."""
    return lambda now: now.tip[:, 2] <= -depth


def contact_lost(now: Now) -> Mask:
    """Whether the tip has left the surface and was off it since the control instant before."""
    return now.touched & (now.free_share >= 1.0)


def as_terms(given: Mapping[str, Any]) -> dict[str, tuple[float, Term]]:
    """Return weights and functions of terms: each is given as a weight of one that ships, a function, or both."""
    terms = {}
    for name, value in given.items():
        weight, term = value if isinstance(value, tuple) and len(value) == 2 else (value, TERMS.get(name))
        if callable(weight):
            weight, term = 1.0, weight
        if not callable(term) or isinstance(weight, bool) or not isinstance(weight, int | float):
            raise ScenarioError(
                f"rewards[{name!r}] = {value!r}: must be a function of closedloop.gym.Now that returns (N,) numbers, "
                f"(weight, function), or the weight of one of {', '.join(TERMS)}"
            )
        terms[name] = float(weight), term
    return terms


# The key of a posture: what is drawn is added to each joint of the scenario's start.
POSTURE = "start.q"
LARGEST_SEED = 2**31


@dataclass(frozen=True)
@fields_checked
class Range:
    """A range from which a number is drawn for each episode.

    Parameters
    ----------
    low, high : float
        Ends, in the unit of the key; of a posture also a tuple each, one number for each joint.
    log : bool
        Whether the logarithm is uniformly distributed, instead of the number.
    """

    low: float | tuple[float, ...]
    high: float | tuple[float, ...]
    log: bool = False

    def __post_init__(self) -> None:
        low, high = np.asarray(self.low, dtype=np.float64), np.asarray(self.high, dtype=np.float64)
        ordered = low.shape == high.shape and bool(np.all((low > -math.inf) & (low <= high) & (high < math.inf)))
        if not ordered or (self.log and not np.all(low > 0.0)):
            above = ", and above 0 with log=True" if self.log else ""
            raise ScenarioError(f"range: {self.low!r} to {self.high!r}: must be two numbers, the smaller first{above}")

    def draw(self, random: np.random.Generator, size: int | None = None) -> Any:
        """Return a number, or an array of `size` numbers."""
        if not self.log:
            return random.uniform(self.low, self.high, size)
        return np.exp(random.uniform(np.log(self.low), np.log(self.high), size))


def as_ranges(given: Mapping[str, Any]) -> dict[str, Range]:
    """Return ranges by key, of which a pair of numbers is one as well."""
    ranges = {}
    for key, value in given.items():
        try:
            if not isinstance(value, Range):
                low, high = map(float, value)
                value = Range(low, high)
            if np.ndim(value.low) and key != POSTURE:
                raise ValueError
            ranges[key] = value
        except (TypeError, ValueError):
            raise ScenarioError(
                f"ranges[{key!r}] = {value!r}: must be (low, high), or closedloop.gym.Range(low, high, log=True)"
            ) from None
    return ranges


def drawn(
    ranges: Mapping[str, Range], home: Array, random: np.random.Generator, given: Mapping[str, Any],
    seeds: tuple[str, ...] = ("sensor.seed",),
) -> dict[str, Any]:  # fmt: skip
    """Return a value for each key, and for `seeds`, the keys of seeds.

    Parameters
    ----------
    ranges
        By dotted keys of the scenario.
    home : (nq,) array
        The posture that one of `POSTURE` is added to.
    random
        All keys are drawn in order, so that a value that is given changes no other.
    given : mapping
        Values that replace what is drawn; of other keys of the scenario too.
    """
    values: dict[str, Any] = {}
    for key, each in ranges.items():
        if key == POSTURE:
            wanted = np.shape(each.low) or home.shape
            if wanted != home.shape:
                raise ScenarioError(f"ranges[{key!r}]: has {wanted[0]} numbers: must be one, or {home.size}")
            values[key] = (home + each.draw(random, home.size)).tolist()
        else:
            values[key] = float(each.draw(random))
    for key in seeds:
        values[key] = int(random.integers(LARGEST_SEED))
    values.update(given)
    return values


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
