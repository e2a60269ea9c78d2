"""The next trial in a search for a root between two ends, by Chandrupatla's method."""

from __future__ import annotations

from closedloop.jit.kernel import kernel


@kernel
def next_share(x: float, y: float, far: float, at_far: float, old: float, at_old: float) -> float:
    """Return which share of the way from `x` to `far` the next trial is.

    That is inverse quadratic interpolation, or bisection where the three values do not allow it (T. R. Chandrupatla,
    Adv. Eng. Softw. 28, 1997).

    Parameters
    ----------
    x, y : float
        The latest trial, and the value there.
    far, at_far : float
        The other end of the bracket.
    old, at_old : float
        The end that the latest trial has replaced.
    """
    share = 0.5
    within, fall = (x - far) / (old - far), (y - at_far) / (at_old - at_far)
    if fall * fall < within and (1.0 - fall) * (1.0 - fall) < 1.0 - within:
        share = y / (at_far - y) * at_old / (at_far - at_old)
        share += (old - x) / (far - x) * y / (at_old - y) * at_far / (at_old - at_far)
    return float(share)
