"""The rows of the table that the loop reads: what is desired, and what sensors draw, at each of its instants.

`table[:, Reference.place("force", n)]` is a column of it.
"""

from typing import Annotated

from closedloop.base.arrays import Array
from closedloop.jit.blocks import Block, Count

N = Count.of("n")


class Reference(Block, sizes=("n",)):
    """What is desired of n joints, and of the tip in base axes; see `closedloop.loop.step.locate.in_contact_frame`."""

    q: Annotated[Array, N]  # rad (m)
    v: Annotated[Array, N]  # rad/s (m/s)
    position: Annotated[Array, 3]  # m
    velocity: Annotated[Array, 3]  # m/s
    acceleration: Annotated[Array, 3]  # m/s²
    force: float  # N


class TableRow(Block, sizes=("n",)):
    """A row of the table."""

    reference: Reference
    sensor: Annotated[Array, 4]  # see `closedloop.control.sensor.draws`


class DrawnRow(TableRow, sizes=("n",)):
    """A row of the table of an arm whose encoders are noisy."""

    draws: Annotated[Array, 2 * N]  # see `closedloop.control.sensor.encoder_draws`
