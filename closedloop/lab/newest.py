"""Work of which only the newest matters: a thread that computes the latest request and drops those between.

newest = Newest(compute, show)
newest.ask(1), newest.ask(2), newest.ask(3)      # computes 1, perhaps, and 3; shows them in this order
"""

from __future__ import annotations

import logging
import math
import threading
import time as clock
from collections.abc import Callable
from typing import Generic, TypeVar

Q = TypeVar("Q")
A = TypeVar("A")

logger = logging.getLogger(__name__)

# While requests go on, work that waits for a rest takes no larger part of the time than one over the first; what takes
# longer than the second, s, waits for the rest, however late it comes.
SHARE, LONG = 20.0, 0.3


class Newest(Generic[Q, A]):
    """A thread that computes the newest request.

    Parameters
    ----------
    compute : callable
        From a request to its answer; it runs in the thread.
    show : callable
        Takes each answer, in the thread. An answer is shown even if a newer request has come meanwhile, so that
        something moves while requests come faster than they are computed.
    rest, most : float
        Wait until no other request has come for `rest`, s, but no longer than `most` after the first that waits, or
        `SHARE` times what the work took last: work that takes long leaves the time to others, and waits on if it takes
        more than `LONG`.
    held : callable
        Whether something goes on that will bring another request. Then it does not rest.
    """

    def __init__(
        self, compute: Callable[[Q], A], show: Callable[[A], None], rest: float = 0.0, most: float = 0.0,
        held: Callable[[], bool] = lambda: False,
    ) -> None:  # fmt: skip
        self._compute, self._show, self._rest, self._most, self._held = compute, show, rest, most, held
        self._first = self._last = self._took = 0.0
        self._changed = threading.Condition()
        self._waiting: list[Q] = []
        self._busy, self._closed = False, False
        self.dropped = 0
        self._thread = threading.Thread(target=self._work, name="closedloop-lab", daemon=True)
        self._thread.start()

    def ask(self, request: Q) -> None:
        """Compute this as soon as possible, and not what is still waiting."""
        with self._changed:
            self.dropped += len(self._waiting)
            self._last = clock.monotonic()
            self._first = self._first if self._waiting else self._last
            self._waiting = [request]
            self._changed.notify_all()

    @property
    def idle(self) -> bool:
        """Whether the newest request is answered and shown."""
        return not self._busy and not self._waiting

    @property
    def overtaken(self) -> bool:
        """Whether a newer request waits than the one which is being computed."""
        return bool(self._waiting)

    def wait(self, seconds: float = 60.0) -> bool:
        """Wait until the newest request is answered and shown; return whether it is."""
        with self._changed:
            return self._changed.wait_for(lambda: self.idle, seconds)

    def close(self, seconds: float = 5.0) -> None:
        """End the thread, after the work at hand."""
        with self._changed:
            self._waiting, self._closed = [], True
            self._changed.notify_all()
        if threading.current_thread() is not self._thread:
            self._thread.join(seconds)

    def _left(self) -> float:
        """Return how long the request that waits is still to wait, s."""
        now = clock.monotonic()
        rests = now if self._held() else self._last
        most = max(self._most, SHARE * self._took) if self._took <= LONG else math.inf
        return min(rests + self._rest, self._first + most) - now

    def _work(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._closed)
                while not self._closed and (left := self._left()) > 0.0:
                    self._changed.wait(left)
                if self._closed:
                    return
                request, self._busy = self._waiting.pop(), True
            began = clock.monotonic()
            try:
                self._show(self._compute(request))
            except Exception:  # the thread goes on: `compute` turns what can be foreseen into an answer
                logger.exception("a result could not be computed or shown")
            finally:
                with self._changed:
                    self._busy, self._took = False, clock.monotonic() - began
                    self._changed.notify_all()
