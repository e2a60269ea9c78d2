"""A cache of what several scenarios share: robots, paths, reference tables.

Of the 3 ms in which a scenario becomes a `Problem` the reference table takes 1.5, the inverse kinematics of its path
0.5 and the robot 0.2 (4 more if it is read from a user's file), and most keys of a scenario affect none of the three.
The key of an entry is the text of all that it is computed from, so a cached entry equals a new one to the last bit.
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


class Key:
    """A long key that is part of many: its hash is worked out once."""

    __slots__ = ("_hash", "_key")

    def __init__(self, key: Hashable) -> None:
        self._key, self._hash = key, hash(key)

    def __hash__(self) -> int:
        return self._hash

    def __eq__(self, other: object) -> bool:
        return self is other or (isinstance(other, Key) and self._key == other._key)


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


class Cache:
    """The entries used last, up to a limit of memory. Not for use by several threads, but for `get_shared`.

    Parameters
    ----------
    limit : int
        Bytes that may be kept; an entry larger than that is kept until the next.
    shared : Cache, optional
        A cache of several threads, for entries that are only read, such as paths.
    """

    def __init__(self, limit: int = LIMIT, shared: Cache | None = None) -> None:
        self._limit, self._shared, self._lock = limit, shared, threading.Lock()
        self._entries: OrderedDict[Hashable, tuple[Any, int]] = OrderedDict()
        self._bytes = 0
        self._followed: dict[str, tuple[Any, dict[str, Any], tuple[Any, ...]]] = {}
        self._texts: dict[int, tuple[Section, tuple[Hashable, ...]]] = {}  # by the identity of what is kept
        self.newest: dict[str, Any] = {}  # what steps the scenario whose numbers were made last, by engine
        self.last: tuple[Scenario, Problem] | None = None  # what was prepared last, whose table is still its own

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

    def follow(self, name: str, scenario: Scenario, make: Callable[[Any], T], *others: Any) -> T:
        """Return what is made of a scenario and of others: what it was for the last scenario, if that has the same.

        Its sections that `make` has read must be the same objects, and so must be the others. In scenarios that differ
        from one another in a few keys, those are that none of the keys is of.
        """
        found = self._followed.get(name)
        if found is not None:
            made, read, before = found
            parts = vars(scenario)
            if all(parts[k] is part for k, part in read.items()) and all(map(is_, others, before)):
                return cast(T, made)
        watched = Watched(scenario)
        new = make(watched)
        self._followed[name] = new, watched.read, others
        return new

    def text(self, section: Section) -> tuple[Hashable, ...]:
        """Return all that a section says: its type, those of its members that a user may have made, and its text."""
        known = self._texts.get(id(section))
        if known is None or known[0] is not section:
            if len(self._texts) >= MOST_TEXTS:
                self._texts.clear()
            types = (type(part) for part in vars(section).values() if isinstance(part, Section))
            known = self._texts[id(section)] = section, (type(section), *types, section.model_dump_json())
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
        self._followed.clear()
        self._bytes, self.last = 0, None

    def get_shared(self, key: Hashable, make: Callable[[], T], size: Callable[[T], int]) -> T:
        """Return an entry that is only read: one for all threads, made under a lock by the first that needs it."""
        shared = self._shared or self
        with shared._lock:
            return shared.get(key, make, size)


class NoCache(Cache):
    """What makes everything anew: for what is hardly asked for twice."""

    def get(self, key: Hashable, make: Callable[[], T], size: Callable[[T], int]) -> T:
        """Return what is made."""
        return make()

    get_shared = get


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
