"""Everything that depends on the compiler; nothing here depends on mechanics."""

import os


def plain_numba() -> bool:
    """Whether ``CLOSEDLOOP_PLAIN_NUMBA=1``: kernels are compiled by numba's public decorators, and nothing is kept.

    The numbers are the same to the last bit. It is the form for a numba whose inside has changed: a step takes a fifth
    longer, compiling the loop four times as long, and each process compiles.
    """
    return os.environ.get("CLOSEDLOOP_PLAIN_NUMBA", "").strip() not in ("", "0")
