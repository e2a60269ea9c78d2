"""Bounds of rounding: so many units in the last place of the size of what is compared, whatever the processor.

Processors with and without fused multiply-add, and other versions of libraries, round a sum otherwise; an absolute
bound of 1e-14 is 20 ulps of 3 m/s and 4000 of a millimetre. Sums of N terms may take √N roundings and more.
"""

import numpy as np

ULP = float(np.finfo(float).eps)


def rounding(ulps, *sizes):
    """Return `ulps` units in the last place of the largest magnitude in `sizes`, numbers or arrays."""
    return ulps * ULP * max(float(np.max(np.abs(size))) for size in sizes)


def within(ulps, found, expected, *sizes):
    """Whether numbers are those expected to so many units in the last place of the largest of these, or of `sizes`."""
    off = np.max(np.abs(np.subtract(found, expected)), initial=0.0)
    return bool(off <= rounding(ulps, expected, *sizes))
