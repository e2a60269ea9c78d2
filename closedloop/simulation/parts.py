"""What is made of a scenario, part by part, and of which of its sections: so that it is made again where these change.

What reads a scenario, parts, or a problem, is given one that notes what is read of it. So nothing that it depends on
can be forgotten.
"""

from collections.abc import Callable, Hashable, Mapping, Sequence
from itertools import compress
from operator import is_not, itemgetter
from typing import Any, TypeVar

import numpy as np

from closedloop.base.sections import Section
from closedloop.scenario.scenario import Scenario

T = TypeVar("T")
# What makes a part of a scenario, and of parts before it.
Maker = Callable[[Any, Any], Any]

NOTHING = object()
SECTIONS = dict(Scenario.model_fields)  # looking up that attribute takes longer than reading a section
sections_of = itemgetter(*SECTIONS)


class Watched:
    """A scenario that notes which of its sections are read, by what it is given to; it turns from scenario to scenario.

    `readers`: by section, who has read it.
    `who`: who it is given to.
    `unwatched`: the scenario; to be set. A section that was read is an attribute from then on, which who turns it on
        changes.
    """

    unwatched: Scenario

    def __init__(self, readers: Mapping[str, set[int]], who: int) -> None:
        self._readers, self._who = readers, who

    def __getattr__(self, name: str) -> Any:
        readers = self._readers.get(name)
        if readers is None:
            return getattr(Scenario, name).__get__(self)  # a property, or a method, which reads sections too
        readers.add(self._who)
        part = self.__dict__[name] = self.unwatched.__dict__[name]  # where Python looks first
        return part

    def model_copy(self, *, update: Mapping[str, Any]) -> Scenario:
        """Return a changed copy of the scenario, which depends on all of it."""
        for name in self._readers:
            getattr(self, name)
        return self.unwatched.model_copy(update=update)


class Made:
    """Parts that are made, of which it notes which are read, as `Watched` does."""

    def __init__(self, parts: dict[str, Any], readers: Mapping[str, set[int]], who: int) -> None:
        self._parts, self._readers, self._who = parts, readers, who

    def __getattr__(self, name: str) -> Any:
        self._readers[name].add(self._who)
        part = self.__dict__[name] = self._parts[name]
        return part

    def unnoted(self, name: str) -> Any:
        """Return a part without noting it."""
        return self._parts[name]


class Asked:
    """A problem that notes what is read of it, and of its scenario."""

    def __init__(self, problem: Any) -> None:
        self._problem, self._read = problem, dict[str, Any]()
        self._readers: dict[str, set[int]] = {name: set() for name in SECTIONS}
        self.scenario = Watched(self._readers, 0)
        self.scenario.unwatched = problem.scenario

    def __getattr__(self, name: str) -> Any:
        part = self._read[name] = getattr(self._problem, name)
        return part

    def end(self) -> None:
        """Let the problem go."""
        scenario = vars(self._problem.scenario)
        self._sections = {name: scenario[name] for name, readers in self._readers.items() if readers}
        del self._problem, self.scenario, self._readers

    def stands_for(self, problem: Any) -> bool:
        """Whether another problem says the same to all that was read."""
        for name, part in self._read.items():
            if (now := getattr(problem, name)) is not part and not alike(part, now):
                return False
        sections = vars(problem.scenario)
        for name, part in self._sections.items():
            if (now := sections[name]) is not part and not alike(part, now):
                return False
        return True


def asking(problem: Any, make: Callable[..., T], *others: Any) -> tuple[T, Asked]:
    """Return what is made of a problem and of others, and what was read of the problem, which is not kept."""
    asked = Asked(problem)
    made = make(asked, *others)
    asked.end()
    return made, asked


class Parts:
    """What is made of a scenario, part by part: a part is made anew where what it was made of says other things.

    So a key of the scenario that changes becomes a change of the parts that follow from it, and all others are taken
    over: by a batch's next run, by a prepared problem with other values or from another start, by the next episode.

    `makers`: by the name of each part, in order, what makes it, of a scenario and of parts before it.
    `given`: the names of parts that are given, see `turn_to`.
    """

    def __init__(self, makers: Mapping[str, Maker], given: Sequence[str]) -> None:
        self._makers = tuple(makers.items())
        self._made: dict[str, Any] = dict.fromkeys((*makers, *given), NOTHING)
        self._stale = set(range(len(makers)))  # which of all parts are to be made anew
        # By section and by part: which parts have read it.
        self._of_section: dict[str, set[int]] = {name: set() for name in SECTIONS}
        self._of_part: dict[str, set[int]] = {name: set() for name in self._made}
        # What each maker is given.
        self._given = [(Watched(self._of_section, k), Made(self._made, self._of_part, k)) for k in range(len(makers))]
        self._sections: tuple[Any, ...] = (NOTHING,) * len(SECTIONS)

    def forget(self, name: str) -> None:
        """Have a part made anew next time."""
        self._stale.add(list(self._made).index(name))

    def turn_to(self, scenario: Scenario, **given: Any) -> dict[str, Any]:
        """Make of another scenario all that is made of sections, or of parts, that say other things there.

        A part that comes out as it was is the same object, and what was made of it stays. All parts are returned, until
        the next call. What a maker raises is raised; the next call goes on from there.
        """
        made, stale = self._made, self._stale
        for name, part in given.items():
            self._put(name, part)
        before, self._sections = self._sections, sections_of(vars(scenario))
        for name, one, other in compress(
            zip(SECTIONS, before, self._sections, strict=True), map(is_not, before, self._sections)
        ):
            if not alike(one, other):
                stale |= self._of_section[name]
                for k in self._of_section[name]:
                    vars(self._given[k][0])[name] = other
        while stale:
            k = min(stale)
            name, make = self._makers[k]
            watched, of = self._given[k]
            watched.unwatched = scenario
            new = make(watched, of)
            stale.discard(k)
            self._put(name, new)
        return made

    def _put(self, name: str, part: Any) -> None:
        if part is not (before := self._made[name]) and not alike(part, before):
            self._made[name] = part
            self._stale |= self._of_part[name]
            for k in self._of_part[name]:
                vars(self._given[k][1])[name] = part


def alike(one: Any, other: Any) -> bool:
    """Whether two objects are the same, or words, numbers and sections, alone or in tuples, that are so to the bit."""
    if one is other:
        return True
    if type(one) is not type(other) or type(one) is np.ndarray:
        return False
    if isinstance(one, Section):
        return vars(one) == vars(other) and text_of(one) == text_of(other)  # 0 is equal to −0, and its text is not
    if isinstance(one, tuple):
        return len(one) == len(other) and all(map(alike, one, other))
    if isinstance(one, float):
        return one.hex() == other.hex()
    return isinstance(one, int | str) and one == other


def text_of(section: Section) -> tuple[Hashable, ...]:
    """Return all that a section says: its type, those of its members that a user may have made, and its text."""
    types = (type(part) for part in vars(section).values() if isinstance(part, Section))
    return type(section), *types, section.model_dump_json()
