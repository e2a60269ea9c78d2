"""What several scenarios share: the parts of a problem that the keys in which they differ do not change.

`Parts` follows each part of a problem to the sections of the scenario that it was made of; all but what is other is
taken over from the scenario before. `Cache` has, besides, robots, paths and reference tables of earlier scenarios: they
take most of the 3 ms in which a scenario becomes a `Problem`. The key of an entry is the text of all that it is made
of. So what is taken over equals what would be made anew to the last bit.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from operator import is_
from typing import Any, TypeVar, cast

from closedloop.base.sections import Section
from closedloop.scenario.load import is_users_file
from closedloop.scenario.scenario import Scenario
from closedloop.scenario.user_module import members_of_users
from closedloop.simulation.engines.problem import Problem
from robot_models import RobotModel

T = TypeVar("T")

SECTIONS = dict(Scenario.model_fields)  # looking up that attribute takes longer than reading a section
# Bytes of one thread's cache: the reference tables of two dozen runs of 8001 rows.
LIMIT = 32_000_000
# As many sections are kept with their texts.
MOST_TEXTS = 500
# Of so many models, as calls of two prepared problems in turns have them, a thread keeps the caches.
MOST_CACHES = 2


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


class Parts:
    """What is made of a scenario, part by part: a part is made anew where a section that it has read says other things.

    So a key of the scenario that changes becomes a change of the parts that follow from it, and all others are taken
    over: by a batch's next run, by a prepared problem with other values or from another start, by the next episode.
    """

    def __init__(self) -> None:
        self._made: dict[str, tuple[Any, tuple[Any, ...], set[str]]] = {}
        self._within: list[set[str]] = []  # of the parts that are being made, one within another: sections they read
        self._readers: dict[str, set[str]] = {}  # by section: which parts have read it
        self._sections: dict[str, Any] = {}
        self._tuples: dict[str, tuple[Any, ...]] = {}
        self._numbers: dict[str, Any] = {}
        self._scenario: Any = None

    def turn_to(self, scenario: Scenario) -> None:
        """Go to another scenario: what is made of sections that say other things there is dropped."""
        known, self._scenario = self._sections, scenario
        for name, part in vars(scenario).items():
            before = known.get(name, part)
            known[name] = part
            if before is not part and not says_the_same(before, part):
                for reader in self._readers.get(name, ()):
                    self._made.pop(reader, None)

    def follow(self, name: str, make: Callable[[Any], T], *others: Any) -> T:
        """Return what is made of the scenario and of others: as it was, where both are as they were.

        The others must be the same objects. A part may be made of parts that are followed: it has then read what they
        have.
        """
        found = self._made.get(name)
        if found is None or not all(map(is_, others, found[1])):
            watched, own = Watched(self._scenario), set[str]()
            self._within.append(own)
            try:
                new = make(watched)
            finally:
                self._within.pop()
            own.update(watched.read)
            for section in own:
                self._readers.setdefault(section, set()).add(name)
            found = self._made[name] = new, others, own
        if self._within:
            self._within[-1].update(found[2])
        return cast(T, found[0])

    def same(self, name: str, parts: tuple[Any, ...]) -> tuple[Any, ...]:
        """Return a tuple of parts: the one that has had this name, if it is of the same objects."""
        before = self._tuples.get(name, ())
        if len(before) == len(parts) and all(map(is_, before, parts)):
            return before
        self._tuples[name] = parts
        return parts

    def number(self, name: str, x: T) -> T:
        """Return a number: the object that has had this name, if that is equal."""
        before = self._numbers.get(name)
        if before != x:
            self._numbers[name] = before = x
        return cast(T, before)

    def forget(self, *names: str) -> None:
        """Let what has these names be made anew."""
        for name in names:
            self._made.pop(name, None)


def says_the_same(one: Any, other: Any) -> bool:
    """Whether two sections, or lists of them, say the same to the bit: 0 is equal to −0, and its text is not."""
    if not (type(one) is type(other) and one == other):
        return False
    if isinstance(one, tuple):
        return all(map(says_the_same, one, other))
    return not isinstance(one, Section) or text_of(one) == text_of(other)


def text_of(section: Section) -> tuple[Hashable, ...]:
    """Return all that a section says: its type, those of its members that a user may have made, and its text."""
    types = (type(part) for part in vars(section).values() if isinstance(part, Section))
    return type(section), *types, section.model_dump_json()


class Cache:
    """The entries used last, up to a limit of memory. Not for use by several threads, but for `get_shared`.

    Parameters
    ----------
    limit : int
        Bytes that may be kept; an entry larger than that is kept until the next.
    shared : Cache, optional
        A cache of several threads, for entries that are only read, such as paths.

    Attributes
    ----------
    given, whole : Parts
        What is made of the scenario as it was given, and as its run has it.
    spare : dict
        What steps its loop, by engine, where no run uses it: `closedloop.simulation.loop_calls.Calls`.
    last : (Scenario, Problem) or None
        What was prepared last, whose table is still its own.
    """

    def __init__(self, limit: int = LIMIT, shared: Cache | None = None) -> None:
        self._limit, self._shared, self._lock = limit, shared, threading.Lock()
        self._entries: OrderedDict[Hashable, tuple[Any, int]] = OrderedDict()
        self._bytes = 0
        self._texts: dict[int, tuple[Section, tuple[Hashable, ...]]] = {}  # by the identity of what is kept
        self.given, self.whole = Parts(), Parts()
        self.spare: dict[str, Any] = {}
        self.last: tuple[Scenario, Problem] | None = None

    def get(self, key: Hashable, make: Callable[[], T], size: Callable[[T], int]) -> T:
        """Return the entry with this key, made now if it is not there; `size` gives its bytes, about."""
        if key in self._entries:
            self._entries.move_to_end(key)
            return cast(T, self._entries[key][0])
        entry = make()
        self._entries[key] = entry, size(entry)
        self._bytes += size(entry)
        while self._bytes > self._limit and len(self._entries) > 1:
            self._bytes -= self._entries.popitem(last=False)[1][1]
        return entry

    def text(self, section: Section) -> tuple[Hashable, ...]:
        """Return `text_of` a section."""
        known = self._texts.get(id(section))
        if known is None or known[0] is not section:
            if len(self._texts) >= MOST_TEXTS:
                self._texts.clear()
            known = self._texts[id(section)] = section, text_of(section)
        return known[1]

    def texts(self, scenario: Scenario, of: Sequence[str] = (), but: str = "") -> tuple[Hashable, ...]:
        """Return the same of these sections of a scenario, or of all but one, with what else it has."""
        parts = [getattr(scenario, name) for name in of or SECTIONS if name != but]
        return tuple(
            self.text(part) if isinstance(part, Section)
            else tuple(map(self.text, part)) if isinstance(part, tuple) else part
            for part in parts
        )  # fmt: skip

    def clear(self) -> None:
        """Remove all entries of this thread; those shared with others stay."""
        self._entries.clear()
        self.given, self.whole = Parts(), Parts()
        self._bytes, self.last = 0, None

    def get_shared(self, key: Hashable, make: Callable[[], T], size: Callable[[T], int]) -> T:
        """Return an entry that is only read: one for all threads, made under a lock by the first that needs it."""
        shared = self._shared or self
        with shared._lock:
            return shared.get(key, make, size)


class _Kept(threading.local):
    def __init__(self) -> None:
        self.caches: list[tuple[RobotModel | None, Cache]] = []  # of the models given last, the last one last


_kept = _Kept()


@contextmanager
def kept_cache(scenario: Scenario, model: RobotModel | None) -> Iterator[Cache]:
    """Give the cache of this thread's earlier calls, for a problem that is not kept: its robot and table are reused.

    A call within a call, as in a user's law, has a cache of its own; so has a scenario that names a file or a class of
    the user's, which may have changed since.
    """
    if (model is None and is_users_file(scenario.robot.model)) or members_of_users(scenario):
        yield Cache()
        return
    kept = next((each for each in _kept.caches if each[0] is model), (model, Cache()))
    _kept.caches = [each for each in _kept.caches if each is not kept]
    try:
        yield kept[1]
    finally:
        _kept.caches = [*(each for each in _kept.caches if each[0] is not model), kept][-MOST_CACHES:]
