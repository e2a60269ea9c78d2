"""How far along a range a number is, as a share from 0 to 1; the range may be even in its logarithm."""

import math


def number_at(low: float, high: float, log: bool, share: float) -> float:
    """Return the number at a share of the way from `low` to `high`."""
    if log:
        return float(low * (high / low) ** share)
    return float(low + (high - low) * share)


def share_of(low: float, high: float, log: bool, number: float) -> float:
    """Return the share of the way from `low` to `high` at which a number is."""
    if log:
        return math.log(number / low) / math.log(high / low)
    return (number - low) / (high - low)
