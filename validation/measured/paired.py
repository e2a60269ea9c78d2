"""Two engines judged by the same tests: whether their errors differ by more than the tests scatter."""

from collections.abc import Hashable, Sequence
from typing import NamedTuple

import numpy as np

from closedloop.base.arrays import Array

CONFIDENCE = 0.95
# Of more kinds of tests, several count as one, so that there are 2¹⁶ subsets at most.
MOST_KINDS = 16
BETTER, WORSE, EQUAL = "better", "worse", "equal within the scatter of the tests"


class Paired(NamedTuple):
    """The mean difference over the tests, the interval from `low` to `high`, its confidence, and what it says."""

    mean: float
    low: float
    high: float
    confidence: float
    verdict: str


def paired(first: Array, second: Array, kinds: Sequence[Hashable]) -> Paired:
    """Compare the sizes of two engines' errors, (N,) each, over N tests; a test without a figure has NaN.

    Tests of one kind are repeats, which are no new evidence: they count together. If the sums over the kinds are
    independent and symmetric about their means, the means over all subsets of the kinds cut the line into parts that
    hold the true mean with the same chance (J. Hartigan, Using subsample values as typical values, J. American
    Statistical Association 64, 1969). So the interval needs neither a normal distribution nor random numbers. Fewer
    than six kinds have none of 95 %: the widest that they have is given, and decides nothing.
    """
    difference = np.asarray(first) - np.asarray(second)
    known = np.isfinite(difference)
    if not known.any():
        return Paired(np.nan, -np.inf, np.inf, 0.0, EQUAL)
    difference, kept = difference[known], [kind for kind, ok in zip(kinds, known, strict=True) if ok]
    numbers = {kind: i % MOST_KINDS for i, kind in enumerate(dict.fromkeys(kept))}
    group = np.array([numbers[kind] for kind in kept])
    sums, counts = np.zeros(1), np.zeros(1)
    for one in range(group.max() + 1):
        part = difference[group == one]
        sums, counts = np.append(sums, sums + part.sum()), np.append(counts, counts + len(part))
    means = np.sort(sums[1:] / counts[1:])
    cut = max(1, int(0.5 * (1.0 - CONFIDENCE) * len(sums)))
    low, high, confidence = float(means[cut - 1]), float(means[-cut]), 1.0 - 2.0 * cut / len(sums)
    decided = confidence >= CONFIDENCE
    verdict = BETTER if decided and high < 0.0 else WORSE if decided and low > 0.0 else EQUAL
    return Paired(float(difference.mean()), low, high, confidence, verdict)
