"""What is made of a scenario, part by part, and of which of its sections; and what several scenarios share of it.

What reads a scenario, parts, or a problem, is given one that notes what is read of it. So nothing that it depends on
can be forgotten, and where these say other things a part is made again (`Parts`). `Cache` has, besides, robots, paths
and reference tables of earlier scenarios: they take most of the 3 ms in which a scenario becomes a `Problem`. The key
of an entry is the text of all that it is made of. So what is taken over equals what would be made anew to the last bit.
"""

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import compress
from operator import is_, is_not, itemgetter
from typing import Any, TypeVar, cast

import numpy as np

from closedloop.base.sections import Section
from closedloop.scenario.load import is_users_file
from closedloop.scenario.scenario import Scenario
from closedloop.scenario.user_module import members_of_users
from robot_models import RobotModel

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


class OtherLaw:
    """A scenario that is given with another law: for what does not depend on all that the law says."""

    def __init__(self, scenario: Any, law: Any) -> None:
        self._scenario, self.law = scenario, law

    def __getattr__(self, name: str) -> Any:
        return getattr(self._scenario, name)


def without(law: Section, *keys: str) -> Section:
    """Return a law that does not say these: nothing that is made of it can depend on them."""
    alone = law.with_valid({})
    for key in keys:
        vars(alone).pop(key, None)
    return alone


def law_as(part: str, make: Maker) -> Maker:
    """Return the maker, which reads a part as the law: one `without` some of its keys."""
    return lambda scenario, of: make(OtherLaw(scenario, getattr(of, part)), of)


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
        says, its = vars(one), vars(other)
        return says == its and (
            all(map(is_, says.values(), its.values())) or all(map(alike, says.values(), its.values()))  # 0 == −0
        )
    if isinstance(one, tuple):
        return len(one) == len(other) and all(map(alike, one, other))
    if isinstance(one, float):
        return one.hex() == other.hex()
    return isinstance(one, int | str) and one == other


def text_of(section: Section) -> tuple[Hashable, ...]:
    """Return all that a section says: its type, those of its members that a user may have made, and its text."""
    types = (type(part) for part in vars(section).values() if isinstance(part, Section))
    return type(section), *types, section.model_dump_json()


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
        self.last: tuple[Scenario, Any] | None = None

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
