"""Which form of the loop a problem runs in: each is compiled when it is first needed, and then kept.

There are two engines; each has a small form for the paper's law on a smooth surface, and one with everything that may
come on top. All four take any number of joints. A loop for just one number of joints saves a fifth of a step, as its
inner loops, of known length, are written out; it changes no bit. It is compiled where many steps are ahead, and for the
first arm of an installation under the paper's law: that takes as long as the loop for any number, of which others that
follow then share one. And a batch's runs of the paper's law on a smooth surface may go eight abreast
(`closedloop.engines.lanes`), in a quarter of the time.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import TYPE_CHECKING

from closedloop.engines.pinocchio import on_pinocchio, proceed_on_pinocchio, proceed_with_more_on_pinocchio
from closedloop.jit.kernel import brief_entry, entry_kernel, needs_compiling

if TYPE_CHECKING:
    pass

PINOCCHIO, COMPILED = ENGINES = ("pinocchio", "compiled")
# How many steps must be ahead for a loop for just this number of joints to be worth the ten seconds that compiling it
# takes; and the number of joints above which inner loops are no longer written out.
WORTH_COMPILING, MOST_WRITTEN_OUT = 50_000_000, 8
# Whether the first arm of an installation has a loop for just its joints.
FIRST_HAS_ITS_OWN = True


def machine(more: bool, engine: str, n: int = 0, ahead: int = 0) -> Callable[..., int]:
    """Return the form of the machine that a problem needs.

    Parameters
    ----------
    more : bool
        See `closedloop.step.evaluate`.
    engine : "pinocchio" or "compiled"
        See `closedloop.simulate`.
    n : int
        Number of joints; with 0 a form for any number is returned.
    ahead : int
        How many steps are to come, in this run and others.
    """
    if 0 < n <= MOST_WRITTEN_OUT:
        # Whether it is the first is asked last: that takes a look at the disk, in a batch at every run.
        first = FIRST_HAS_ITS_OWN and not more
        if ahead >= WORTH_COMPILING or _is_there(n, more, engine) or (first and _is_first(engine)):
            return written_out(n, more, engine)
    if engine == COMPILED:
        from closedloop.engines.compiled import run_compiled, run_compiled_with_more

        return run_compiled_with_more if more else run_compiled
    return proceed_with_more_on_pinocchio if more else proceed_on_pinocchio


@cache
def written_out(n: int, more: bool, engine: str) -> Callable[..., int]:
    """Return the form for n joints and no other number, compiled when first called."""
    form = 1 if more else None
    if engine == COMPILED:
        from closedloop.engines.compiled import written_out_run

        loop = written_out_run(n, form)
    else:

        def loop(places: int) -> int:
            return on_pinocchio(n, places, form)

    loop.__name__ = loop.__qualname__ = f"{engine}_{n}_joints" + ("_with_more" if more else "")
    return entry_kernel(loop) if engine == COMPILED else brief_entry(loop)


def _is_there(n: int, more: bool, engine: str) -> bool:
    """Whether a loop for n joints has been compiled."""
    return bool(getattr(written_out(n, more, engine), "signatures", ())) or _was_there(n, more, engine)


@cache
def _was_there(n: int, more: bool, engine: str) -> bool:
    """Whether an earlier process has compiled it: asked once, since it takes a look at the disk."""
    return not needs_compiling(written_out(n, more, engine))


def _is_first(engine: str) -> bool:
    """Whether no loop for the paper's law has been compiled, for any or for some number of joints."""
    if not needs_compiling(machine(False, engine)):
        return False
    return not any(_is_there(n, False, engine) for n in range(1, MOST_WRITTEN_OUT + 1))
