"""A value and seven derivatives as one number: derivatives of a whole run by the kernels that run it.

A dual number is x + Σ xᵢ εᵢ with εᵢ εⱼ = 0; lane 0 is x, lanes 1 to 7 are its derivatives along seven directions
(R. E. Wengert, Communications of the ACM 7, 1964). A kernel that gets dual numbers in place of floats is compiled for
them and calculates with the same values in the same order. A comparison is of the values, so each branch is that of
the plain run. A step waits for one operation after the other, and a register of eight takes hardly longer than a float:
see `python -m validation.speed`.

What a kernel finds by a search (a bracket, an iteration) has the right value and no derivatives, as the ends of a
bracket have none. Where it has been found, one Newton step gives them:

    x = sought(x)                                  # the value, without derivatives
    slope = slope_of(g(along(x)))                  # ∂g/∂x
    x = settled(x, g(x), slope)                    # ∂x/∂p = −(∂g/∂p) / (∂g/∂x)

Of floats these do nothing; `has_derivatives` says so when compiling, and the whole of it is left out.
"""

from typing import Any

# The derivatives that `along` gives an unknown, so large that what others the function has are below rounding.
MANY = 2.0**60


def has_derivatives(x: Any) -> bool:
    """Whether a number is a dual one."""
    return False


def sought(x: Any) -> Any:
    """Return a number without its derivatives."""
    return x


def along(x: Any) -> Any:
    """Return an unknown with `MANY` as its last derivative, and the others zero."""
    return x


def slope_of(g: Any) -> float:
    """Return the derivative of a function by its unknown, which came from `along`."""
    return float(g)


def settled(x: Any, g: Any, slope: float) -> Any:
    """Return a root x of g with derivatives: those that x has, less those of g at this x over its slope."""
    return x
