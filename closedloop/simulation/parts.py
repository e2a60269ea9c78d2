"""What is made of a scenario, part by part, and of which of its sections: so that it is made again where these change.

What reads a scenario, or a problem, is given one that notes what is read of it. So nothing that it depends on can be
forgotten.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping
from operator import is_
from typing import Any, NamedTuple, TypeVar, cast

from closedloop.base.sections import Section
from closedloop.scenario.scenario import Scenario

T = TypeVar("T")

NOTHING = object()
SECTIONS = dict(Scenario.model_fields)  # looking up that attribute takes longer than reading a section


class Watched:
    """A scenario that notes which of its sections are read, by what it is given to."""

    def __init__(self, scenario: Scenario) -> None:
        self._scenario = scenario
        self.read: dict[str, Any] = {}

    def __getattr__(self, name: str) -> Any:
        if name in SECTIONS:
            part = self.read[name] = getattr(self._scenario, name)
            return part
        return getattr(Scenario, name).__get__(self)  # a property, or a method, which reads sections too

    def model_copy(self, *, update: Mapping[str, Any]) -> Scenario:
        """Return a changed copy of the scenario, which depends on all of it."""
        self.read.update(vars(self._scenario))
        return self._scenario.model_copy(update=update)


class Asked:
    """A problem that notes what is read of it, and of its scenario."""

    def __init__(self, problem: Any) -> None:
        self._problem, self._read, self.scenario = problem, dict[str, Any](), Watched(problem.scenario)

    def __getattr__(self, name: str) -> Any:
        part = self._read[name] = getattr(self._problem, name)
        return part

    def stands_for(self, problem: Any) -> bool:
        """Whether another problem says the same to all that was read."""
        for name, part in self._read.items():
            if (now := getattr(problem, name)) is not part and not alike(part, now):
                return False
        sections = vars(problem.scenario)
        for name, part in self.scenario.read.items():
            if (now := sections[name]) is not part and not alike(part, now):
                return False
        return True


def asking(problem: Any, make: Callable[..., T], *others: Any) -> tuple[T, Asked]:
    """Return what is made of a problem and of others, and what was read of the problem, which is not kept."""
    asked = Asked(problem)
    made = make(asked, *others)
    asked._problem = None
    return made, asked


class Part(NamedTuple):
    """What was made, of which other objects, and of which sections."""

    made: Any
    others: tuple[Any, ...]
    read: set[str]


class Parts:
    """What is made of a scenario, part by part: a part is made anew where a section that it has read says other things.

    So a key of the scenario that changes becomes a change of the parts that follow from it, and all others are taken
    over: by a batch's next run, by a prepared problem with other values or from another start, by the next episode.
    """

    def __init__(self) -> None:
        self._parts: dict[str, Part] = {}
        self._stale: set[str] = set()  # parts that are to be made anew
        self._within: list[set[str]] = []  # of the parts that are being made, one within another: sections they read
        self._readers: dict[str, set[str]] = {}  # by section: which parts have read it
        self._sections: dict[str, Any] = {}
        self._scenario: Any = None

    def turn_to(self, scenario: Scenario) -> None:
        """Go to another scenario: what is made of sections that say other things there is to be made anew."""
        known, self._scenario = self._sections, scenario
        for name, section in vars(scenario).items():
            if (before := known.get(name, NOTHING)) is not section:
                known[name] = section
                if before is not NOTHING and not alike(before, section):
                    self._stale |= self._readers.get(name, set())

    def follow(self, name: str, make: Callable[[Any], T], *others: Any) -> T:
        """Return what is made of the scenario and of others: as it was, where both are as they were.

        The others must be the same objects. So a part that comes out as it was is the same object. A part may be made
        of parts that are followed: it has then read what they have.
        """
        found = self._parts.get(name)
        if found is None or name in self._stale or not all(map(is_, others, found.others)):
            watched, own = Watched(self._scenario), set[str]()
            self._within.append(own)
            try:
                new = make(watched)
            finally:
                self._within.pop()
            own.update(watched.read)
            for section in own if found is None else own - found.read:
                self._readers.setdefault(section, set()).add(name)
            found = Part(found.made if found and alike(new, found.made) else new, others, own)
            self._parts[name] = found
            self._stale.discard(name)
        if self._within:
            self._within[-1].update(found.read)
        return cast(T, found.made)


def alike(one: Any, other: Any) -> bool:
    """Whether two objects are the same, or words, numbers and sections, alone or in tuples, that are so to the bit."""
    if one is other:
        return True
    if type(one) is not type(other):
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
