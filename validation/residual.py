"""The residual of an identity, and the derivatives that an identity takes: by a complex step, or by differences."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from validation.oracle.spatial import Array

Engine = Any
"""An object with some of the methods mass_matrix(q), bias(q, v), gravity_term(q), coriolis_matrix(q, v),
inverse_dynamics(q, v, a), pushed_inverse_dynamics(q, v, a, force at the tip), forward_dynamics(q, v, Q),
kinetic_energy(q, v), potential_energy(q), position(q), jacobian(q), drift(q, v); and `complex_step`, true if
they take complex arrays."""

EPS = float(np.finfo(float).eps)

ROUNDING = 1024 * EPS
"""2e-13: sums of some hundred products a joint over a dozen joints, and solves judged by their residual."""

DIFFERENCES = 1e-10
"""Five-point differences with h = 2e-4: truncation h⁴ f⁽⁵⁾/30 is 1e-12 where f turns with 7 times the angle
(twice the sum of a dozen joints' angles along a unit direction), rounding ε/h is 1e-12; a decade and more
is left for many such terms together."""

STEP = 2e-4


@dataclass(frozen=True)
class Residual:
    """An identity's relative error at one sample; it holds if that is a number within the tolerance."""

    value: float
    tolerance: float
    argument: str

    @property
    def passed(self) -> bool:
        """Tell whether the identity holds; NaN does not."""
        return bool(self.value <= self.tolerance)


def along(engine: Engine, function: Callable[[Array], Array], q: Array, direction: Array) -> Array:
    """Return the derivative of a function of q as q moves along `direction`."""
    size = norm(direction)
    if size == 0.0:
        return np.zeros_like(function(q))
    unit = direction / size
    return size * derivative(engine, lambda t: function(moved(engine, q, t * unit)))


def moved(engine: Engine, q: Array, step: Array) -> Array:
    """Return q + step, but where a link turns freely its rotation vector turned on by the step, in the link's axes."""
    found = q + step
    for j in getattr(engine, "balls", ()):
        from scipy.spatial.transform import Rotation

        turned, on = (Rotation.from_rotvec(x[j : j + 3]) for x in (q, step))
        found[j : j + 3] = (turned * on).as_rotvec()
    return found


def gradient(engine: Engine, function: Callable[[Array], Array], q: Array) -> Array:
    """Return the gradient (n,) of a scalar function of q."""
    return np.array([along(engine, function, q, unit) for unit in np.eye(len(q))])


def derivative(engine: Engine, function: Callable[[Any], Array]) -> Array:
    """Return df/dt at t = 0: by a complex step, exact to rounding, or by five-point differences."""
    if getattr(engine, "complex_step", False):
        return np.asarray(np.imag(function(1e-40j)) / 1e-40)
    near = np.asarray(function(STEP)) - np.asarray(function(-STEP))
    far = np.asarray(function(2 * STEP)) - np.asarray(function(-2 * STEP))
    return np.asarray((8.0 * near - far) / (12.0 * STEP))


def rounded(difference: Array, *terms: Any) -> Residual:
    """Return the residual of an identity without derivatives."""
    return Residual(relative(difference, *terms), ROUNDING, "rounding of sums and of one solve")


def derived(engine: Engine, difference: Array, *terms: Any) -> Residual:
    """Return the residual of an identity with a derivative in it."""
    if getattr(engine, "complex_step", False):
        return Residual(relative(difference, *terms), ROUNDING, "rounding: a complex step adds nothing")
    return Residual(relative(difference, *terms), DIFFERENCES, "truncation and rounding of differences")


def relative(difference: Array, *terms: Any) -> float:
    """Return the largest |difference| against the largest of the terms that made it; NaN stays NaN."""
    error = float(np.max(np.abs(difference)))
    return error / max(norm(term) for term in terms) if error != 0.0 else 0.0


def norm(term: Any) -> float:
    """Return the largest magnitude in an array."""
    return float(np.max(np.abs(term)))
