"""The guard of derivatives by dual numbers: two plain runs beside the scenario must differ by what they say."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from closedloop.base.arrays import Array
from closedloop.jit.dual import NotDualError
from closedloop.record.run import Run
from closedloop.studies.gradient.differences import LOCATED, ROUNDING
from closedloop.studies.gradient.keys import SHARE, Direction, Keys
from closedloop.studies.gradient.outputs import Output, slices_of, values_of
from closedloop.studies.gradient.variants import Sample, difference, samples
from robot_models import RobotModel

notices = logging.getLogger(__name__)

# The two plain runs are off the scenario by the first of these shares of the keys' sizes. A derivative must be that of
# their difference to a share, or to what of the difference is rounding. Where other events happen in them, or one does
# not agree because it bends or is all but rounding, so it may with the next two, if rounding is no more than a share of
# the difference there: else a smaller step would hide what the first has shown.
BESIDE, AGREE, NOISE, TELLS = (1e-5, 1e-7, 1e-4), 1e-4, 50.0, 1e-3
# The runs on both sides differ from the scenario's by as much, but for this share: else there is a kink.
KINKED = 1e-3


def agreeing(
    keys: Keys, run: Run, base: Sample, outputs: Sequence[Output], rows: dict[Direction, list[Array | None]],
    there: list[bool], model: RobotModel | None, report: Callable[[int, int], None], workers: int | None,
) -> list[bool]:  # fmt: skip
    """Return which outputs have the derivatives that two plain runs have between them."""
    weights = np.random.default_rng(0).uniform(0.5, 1.0, len(rows))
    slices, good = slices_of(outputs, run), np.zeros(len(outputs), dtype=bool)
    noise = NOISE * (LOCATED if base.happened else ROUNDING)

    whys = []
    for beside in BESIDE:
        changes = {d: beside * weight * d.step / SHARE for d, weight in zip(rows, weights, strict=True)}
        sides = [{d: sign * change for d, change in changes.items()} for sign in (-1.0, 1.0)]
        minus, plus = samples(
            [partial(keys.scenario_at, side) for side in sides], partial(values_of, outputs), model, report, workers
        )
        whys.append(difference(base, minus) or difference(base, plus))
        if whys[-1]:
            continue
        for i, part in enumerate(slices):
            if there[i] and not good[i]:
                expected = sum((changes[d] * np.ravel(np.asarray(each[i])) for d, each in rows.items()), np.zeros(1))
                own = _Beside(
                    expected, minus.values[part], base.values[part], plus.values[part], noise * rounded(run, outputs[i])
                )
                good[i] = own.agrees and (beside == BESIDE[0] or own.tells)
                if not good[i]:
                    notices.debug("no dual numbers: %s, %g beside: %s", outputs[i].name, beside, own)
        if np.all(good | ~np.array(there)):
            break
    if all(whys):
        raise NotDualError(whys[-1])
    return [bool(each) for each in good]


class _Beside(NamedTuple):
    """What a quantity is expected to change by, its values in the two runs and between them, and what is rounding."""

    expected: Array
    minus: Array
    at: Array
    plus: Array
    noise: float

    @property
    def change(self) -> Array:
        """By what it changes, from its value to that of either run."""
        return 0.5 * (self.plus - self.minus)

    @property
    def size(self) -> float:
        """The largest change, or the largest expected."""
        return max(float(np.max(np.abs(each), initial=0.0)) for each in (self.change, self.expected))

    @property
    def tells(self) -> bool:
        """Whether the change is well above rounding."""
        return self.noise <= TELLS * self.size

    @property
    def agrees(self) -> bool:
        """Whether it changes by that, and by as much on both sides."""
        change, size = self.change, self.size
        both_differ = np.abs(self.plus + self.minus - 2.0 * self.at)
        return bool(
            np.all(np.isfinite(self.expected))
            and np.all(np.abs(change - self.expected) <= AGREE * size + self.noise)
            and np.all(both_differ <= KINKED * np.abs(self.expected) + AGREE * size + self.noise)
        )


def rounded(run: Run, output: Output) -> float:
    """Return how large what a quantity is made of is, the columns with its unit: their rounding is the quantity's."""
    sizes = [float(np.max(np.abs(output.of(run)), initial=np.finfo(float).tiny))]
    for name, column in run.columns.items():
        if column.dtype.kind == "f" and run.units(name) == output.units:
            sizes.append(float(np.max(np.abs(column[np.isfinite(column)]), initial=0.0)))
    return max(sizes)
