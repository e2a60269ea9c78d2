"""A cache of what several scenarios share: robots, paths, reference tables.

Of the 3 ms in which a scenario becomes a `Problem` the reference table takes 1.5, the inverse kinematics of its path
0.5 and the robot 0.2 (4 more if it is read from a user's file), and most keys of a scenario affect none of the three.
The key of an entry is the text of all that it is computed from, so a cached entry equals a new one to the last bit.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Any, TypeVar, cast

T = TypeVar("T")

# Bytes of one thread's cache: the reference tables of two dozen runs of 8001 rows.
LIMIT = 32_000_000


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

    def clear(self) -> None:
        """Remove all entries of this thread; those shared with others stay."""
        self._entries.clear()
        self._bytes = 0

    def get_shared(self, key: Hashable, make: Callable[[], T], size: Callable[[T], int]) -> T:
        """Return an entry that is only read: one for all threads, made under a lock by the first that needs it."""
        shared = self._shared or self
        with shared._lock:
            return shared.get(key, make, size)
