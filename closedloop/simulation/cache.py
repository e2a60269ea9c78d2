"""What many scenarios have in common, made once: robots, paths, tables of what is desired.

Of the 3 ms in which a scenario becomes a `Problem` the table takes 1.5, the inverse kinematics of its path 0.5 and the
robot 0.2 (4 more if it is read from a user's file), and most keys of a scenario touch none of the three. A piece is
known by the text of all that it is made from, so it is the same piece, to the last bit, as one made anew.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Any, TypeVar, cast

T = TypeVar("T")

# The pieces that a thread keeps, in bytes: the tables of two dozen runs of 8001 rows.
ROOM = 32_000_000


class Pieces:
    """The pieces used last, as many as there is room for. For one thread: robots and tables are written to.

    Parameters
    ----------
    room : int
        Bytes that may be kept; a piece larger than that is kept until the next.
    common : Pieces, optional
        Pieces of several threads: those that are only read, such as paths.
    """

    def __init__(self, room: int = ROOM, common: Pieces | None = None) -> None:
        self._room, self._common, self._lock = room, common, threading.Lock()
        self._kept: OrderedDict[Hashable, tuple[Any, int]] = OrderedDict()
        self._taken = 0

    def get(self, key: Hashable, make: Callable[[], T], size: Callable[[T], int]) -> T:
        """Return the piece with this key, made now if it is not there; `size` gives its bytes, about."""
        if key in self._kept:
            self._kept.move_to_end(key)
            return cast(T, self._kept[key][0])
        piece = make()
        self._kept[key] = piece, size(piece)
        self._taken += size(piece)
        while self._taken > self._room and len(self._kept) > 1:
            self._taken -= self._kept.popitem(last=False)[1][1]
        return piece

    def forget(self) -> None:
        """Forget all, but what is common to several threads."""
        self._kept.clear()
        self._taken = 0

    def get_common(self, key: Hashable, make: Callable[[], T], size: Callable[[T], int]) -> T:
        """Return a piece that is only read: one for all threads, made by the first that asks while the others wait."""
        common = self._common or self
        with common._lock:
            return common.get(key, make, size)
