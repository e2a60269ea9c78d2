"""Ctrl-C waits while numba and LLVM are at work.

Both take locks, numba for all of a compilation and LLVM for each call of its library. What a signal raises as one is
taken or released would leave it taken, and the next thread that asks would wait for ever.
"""

import gc
import signal
from collections.abc import Iterator
from contextlib import contextmanager

from closedloop.base.interrupts import answered_where_it_can_be, held_back


@contextmanager
def compiler_at_work() -> Iterator[None]:
    """Let Ctrl-C wait until the block, which asks something of numba or LLVM, is done.

    A second Ctrl-C does not wait, nor does SIGTERM, after which nothing is compiled. No garbage is looked for
    meanwhile: a compiler's graphs are in use, and looking through them takes a tenth.
    """
    was = gc.isenabled()
    with answered_where_it_can_be(), held_back(signal.SIGINT):
        gc.disable()
        try:
            yield
        finally:
            if was:
                gc.enable()
