"""Integrators: a tableau, an order, a source. One file each, whose name is the value of `time.integrator`.

    class Heun(Integrator):
        order = 2
        a = ((), (1.0,))
        b = (0.5, 0.5)
        source = "Heun 1900"

One kernel advances them all (`closedloop.loop.step.advance`), so a scheme is numbers only and is not compiled.
"""

import math
from fractions import Fraction
from typing import ClassVar

import numpy as np

from closedloop.base.arrays import Array
from closedloop.base.families import Family, Member

# Most equal parts into which the nodes of a scheme divide a step: the reference is tabulated at all of them.
MOST_PARTS = 60
# Tolerance of sums of weights: rounding of a few fractions.
ROUNDING = 1e-14


class Scheme(Member):
    """Base of all schemes.

    `order`: order of the global error on a smooth problem.
    `a`: weights of the earlier stages in each stage's state; row s has s entries, whose sum is the stage's node.
    `b`: weights of the stages in the step, whose sum is one.
    `first`: where states that decay take two exponentials one after the other (`closedloop.loop.step.advance`), the
        weights of the first, the rows of `a` and then `b`; the second has the rest. Left out there is one: it has all,
        and those states then are of order 2 at most.
    `semi_implicit`: whether the position advances with the new velocity; such a scheme has one stage.
    `time_stepping`: whether contacts are one problem of impulses in each step, without events.
    `source`: where the scheme is published.
    `nodes`: where in the step, as a share of h, each stage is evaluated: the sums of the rows of `a`.
    `stages`: evaluations of the equation of motion per step.
    `parts`: into how many equal parts the nodes cut a step.
    """

    folder: ClassVar[str] = "closedloop.mechanics.integrators"
    order: ClassVar[int]
    a: ClassVar[tuple[tuple[float, ...], ...]]
    b: ClassVar[tuple[float, ...]]
    first: ClassVar[tuple[tuple[float, ...], ...]] = ()
    semi_implicit: ClassVar[bool] = False
    time_stepping: ClassVar[bool] = False
    source: ClassVar[str]
    nodes: ClassVar[tuple[float, ...]]
    stages: ClassVar[int]
    parts: ClassVar[int]

    def __init_subclass__(cls) -> None:
        """Check the tableau.

        Raises ValueError if it is not that of an explicit scheme, or its nodes are no multiples of a 60th of the step
            or coarser.
        """
        super().__init_subclass__()
        if not hasattr(cls, "b"):
            return
        cls.stages = len(cls.b)
        if not cls.b or [len(row) for row in cls.a] != list(range(cls.stages)):
            raise ValueError(f"{cls.__name__}: row s of a must have s entries, s = 0, 1 ..., one row for each of b")
        if cls.first and [len(row) for row in cls.first] != list(range(cls.stages + 1)):
            raise ValueError(f"{cls.__name__}: first must have a row for each of a, of as many entries, and one for b")
        if abs(math.fsum(cls.b) - 1.0) > ROUNDING:
            raise ValueError(f"{cls.__name__}: the entries of b must sum to 1, not {math.fsum(cls.b):.9g}")
        if cls.semi_implicit and cls.stages > 1:
            raise ValueError(f"{cls.__name__}: a semi-implicit scheme has one stage, a = ((),) and b = (1.0,)")
        cls.nodes = tuple(math.fsum(row) for row in cls.a)
        cuts = [Fraction(node).limit_denominator(MOST_PARTS) for node in cls.nodes]
        cls.parts = math.lcm(*(cut.denominator for cut in cuts))
        if cls.parts > MOST_PARTS or any(
            abs(cut - node) > ROUNDING or not 0.0 <= node <= 1.0 for cut, node in zip(cuts, cls.nodes, strict=True)
        ):
            raise ValueError(
                f"{cls.__name__}: its nodes {cls.nodes}, the sums of the rows of a, must lie in the step, on at most "
                f"{MOST_PARTS} equal parts of it"
            )

    @classmethod
    def tableau(cls) -> Array:
        """Return the (S + 1, S) array that `closedloop.loop.step.advance` reads: row s holds stage s's weights, the
        last row b."""
        return _table((*cls.a, cls.b))

    @classmethod
    def first_tableau(cls) -> Array:
        """Return the same of `first`."""
        return _table(cls.first or (*cls.a, cls.b))


def _table(rows: tuple[tuple[float, ...], ...]) -> Array:
    table = np.zeros((len(rows), len(rows) - 1))
    for s, row in enumerate(rows):
        table[s, : len(row)] = row
    return table


class Integrator(Scheme):
    """A scheme of fixed step: an explicit Runge-Kutta scheme, or the semi-implicit Euler scheme."""


class AdaptiveIntegrator(Scheme):
    """A scheme that chooses its own steps, in `closedloop.simulation.engines.adaptive`; the loop evaluates one state at
    a time."""

    a = ((),)
    b = (1.0,)


INTEGRATORS = Family(Integrator)
ADAPTIVE = Family(AdaptiveIntegrator)


def steps_impulses(name: str) -> bool:
    """Return whether a value of `time.integrator` is a scheme with one problem of impulses for each step."""
    scheme = scheme_of(name)
    return scheme is not None and scheme.time_stepping


def scheme_of(name: str) -> type[Scheme] | None:
    """Return the scheme that a scenario names; None if it is a user's that was not named in this process."""
    return INTEGRATORS.get(name) or ADAPTIVE.get(name)
