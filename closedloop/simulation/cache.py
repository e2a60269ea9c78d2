"""What several scenarios share: the parts of a problem that the keys in which they differ do not change.

`Parts` follows each part of a problem to the sections of the scenario that it was made of; all but what is other is
taken over from the scenario before. `Cache` has, besides, robots, paths and reference tables of earlier scenarios: they
take most of the 3 ms in which a scenario becomes a `Problem`. The key of an entry is the text of all that it is made
of. So what is taken over equals what would be made anew to the last bit.
"""

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, TypeVar, cast

from closedloop.base.sections import Section
from closedloop.scenario.load import is_users_file
from closedloop.scenario.scenario import Scenario
from closedloop.scenario.user_module import members_of_users
from closedloop.simulation.engines.problem import Problem
from closedloop.simulation.parts import SECTIONS, Parts, text_of
from robot_models import RobotModel

T = TypeVar("T")

# Bytes of one thread's cache: the reference tables of two dozen runs of 8001 rows.
LIMIT = 32_000_000
# As many sections are kept with their texts.
MOST_TEXTS = 500
# Of so many models, as calls of two prepared problems in turns have them, a thread keeps the caches.
MOST_CACHES = 2


class Cache:
    """The entries used last, up to a limit of memory. Not for use by several threads, but for `get_shared`.

    `limit`: bytes that may be kept; an entry larger than that is kept until the next.
    `shared`: a cache of several threads, for entries that are only read, such as paths.
    `parts`, (Parts, Parts) or None: what is made of the scenario as it was given, and as its run has it.
    `spare`, dict: what steps its loop, by engine, where no run uses it: `closedloop.simulation.loop_calls.Calls`.
    `last`, (Scenario, Problem) or None: what was prepared last, whose table is still its own.
    """

    def __init__(self, limit: int = LIMIT, shared: "Cache | None" = None) -> None:
        self._limit, self._shared, self._lock = limit, shared, threading.Lock()
        self._entries: OrderedDict[Hashable, tuple[Any, int]] = OrderedDict()
        self._bytes = 0
        self._texts: dict[int, tuple[Section, tuple[Hashable, ...]]] = {}  # by the identity of what is kept
        self.parts: tuple[Parts, Parts] | None = None
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
        self.parts = None
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
