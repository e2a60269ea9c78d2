"""What a law sees where that is not the state itself: measured, and through a model of its own."""

from __future__ import annotations

from typing import Annotated

from closedloop.base.arrays import Array
from closedloop.jit.blocks import Block, Count

N = Count.of("n")


class Seen(Block, sizes=("n",)):
    """The parts of a `closedloop.control.law_input.LawInput` of n joints that depend on the state, but H and C."""

    r: Annotated[Array, 3]
    drift: Annotated[Array, 3]  # base axes
    frame: Annotated[Array, 3, 3]
    p: Annotated[Array, 3]  # contact frame, as the next four
    u: Annotated[Array, 3]
    drift_c: Annotated[Array, 3]
    carried: Annotated[Array, 3]
    turning: Annotated[Array, 3]
    S: Annotated[Array, 3, 3]
    q: Annotated[Array, N]
    v: Annotated[Array, N]
    J: Annotated[Array, 3, N]
    A: Annotated[Array, 3, N]
    X: Annotated[Array, 3, N]
    L: Annotated[Array, N, N]
