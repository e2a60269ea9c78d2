"""Laws of mechanics that any engine must obey, whatever the robot: no second engine is needed to see a flaw.

An identity is a function of an engine and a `Sample` that returns a `Residual`: a relative error, the tolerance for it
and the argument for the tolerance. It asks the engine only for the methods that `IDENTITIES` lists beside it, so the
same identities grade the oracle, Pinocchio or anything else with those names. `check_all` runs what the engine can
answer and `unanswered` names the rest, so that nothing is skipped in silence.

The residual of an identity, and the derivatives that an identity takes: by a complex step, or by differences.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from validation.oracle.closure import impulse, solve_bordered
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


@dataclass(frozen=True)
class Sample:
    """A state and what acts on it: q, v, a, torque (n,); unit normal (3,) of a plane; restitution ε."""

    q: Array
    v: Array
    a: Array
    torque: Array
    normal: Array
    restitution: float


def draw_sample(q: Array, v: Array, rng: np.random.Generator) -> Sample:
    """Return a sample at a state, the rest drawn at random."""
    n, normal = len(q), rng.normal(size=3)
    unit = normal / np.linalg.norm(normal)
    return Sample(q, v, rng.normal(size=n), 10.0 * rng.normal(size=n), unit, float(rng.uniform()))


def symmetric(engine: Engine, s: Sample) -> Residual:
    """H = Hᵀ."""
    H = engine.mass_matrix(s.q)
    return rounded(H - H.T, H)


def positive_definite(engine: Engine, s: Sample) -> Residual:
    """H has only positive eigenvalues, the smallest above what rounding could hide."""
    eigenvalues = np.linalg.eigvalsh(engine.mass_matrix(s.q))
    noise = len(s.q) * EPS * eigenvalues[-1]
    value = noise / eigenvalues[0] if eigenvalues[0] > 0.0 else np.inf
    return Residual(float(value), 1.0, "n ε λ_max is the error of a computed eigenvalue")


def kinetic_energy_is_quadratic(engine: Engine, s: Sample) -> Residual:
    """T, summed over the bodies, is ½ q̇ᵀ H q̇."""
    T = engine.kinetic_energy(s.q, s.v)
    return rounded(T - s.v @ engine.mass_matrix(s.q) @ s.v / 2, T)


def inverse_undoes_forward(engine: Engine, s: Sample) -> Residual:
    """The torque that inverse dynamics asks for the accelerations that a torque causes is that torque."""
    a = engine.forward_dynamics(s.q, s.v, s.torque)
    Q = engine.inverse_dynamics(s.q, s.v, a)
    return rounded(Q - s.torque, s.torque, _work_terms(engine, s, a))


def inverse_dynamics_is_affine(engine: Engine, s: Sample) -> Residual:
    """Q = H q̈ + C: the recursion that gives Q against the one that gives H."""
    Q = engine.inverse_dynamics(s.q, s.v, s.a)
    return rounded(Q - engine.mass_matrix(s.q) @ s.a - engine.bias(s.q, s.v), Q, _work_terms(engine, s, s.a))


def gravity_is_gradient(engine: Engine, s: Sample) -> Residual:
    """The gravity term is ∂U/∂q."""
    slope = gradient(engine, engine.potential_energy, s.q)
    return derived(engine, slope - engine.gravity_term(s.q), slope, engine.potential_energy(s.q))


def bias_follows_from_mass_matrix(engine: Engine, s: Sample) -> Residual:
    """C − gravity term = Ḣ q̇ − ½ ∂(q̇ᵀ H q̇)/∂q: Lagrange's equations.

    Where a link turns freely with ω in its own axes, Euler's and Poincaré's: ω × (H q̇) is added to its rows.
    """
    inertial = along(engine, engine.mass_matrix, s.q, s.v) @ s.v
    momentum = engine.mass_matrix(s.q) @ s.v
    for j in getattr(engine, "balls", ()):
        inertial[j : j + 3] += np.cross(s.v[j : j + 3], momentum[j : j + 3])
    slope = gradient(engine, lambda q: s.v @ engine.mass_matrix(q) @ s.v / 2, s.q)
    C = engine.bias(s.q, s.v)
    G = engine.gravity_term(s.q)
    return derived(engine, C - G - inertial + slope, C, G, inertial, slope, _coriolis_scale(engine, s))


def coriolis_matrix_is_skew(engine: Engine, s: Sample) -> Residual:
    """Ḣ − 2 (Coriolis matrix) is skew-symmetric."""
    H_dot = along(engine, engine.mass_matrix, s.q, s.v)
    N = H_dot - 2.0 * engine.coriolis_matrix(s.q, s.v)
    return derived(engine, N + N.T, H_dot, N, norm(engine.mass_matrix(s.q)) * norm(s.v))


def coriolis_matrix_gives_bias(engine: Engine, s: Sample) -> Residual:
    """(Coriolis matrix) q̇ + gravity term = C."""
    C, G = engine.bias(s.q, s.v), engine.gravity_term(s.q)
    return rounded(engine.coriolis_matrix(s.q, s.v) @ s.v + G - C, C, G, _coriolis_scale(engine, s))


def jacobian_is_derivative(engine: Engine, s: Sample) -> Residual:
    """Jᵣ = ∂r/∂q."""
    J = engine.jacobian(s.q)
    columns = [along(engine, engine.position, s.q, unit) for unit in np.eye(len(s.q))]
    return derived(engine, np.stack(columns, axis=1) - J, J, engine.position(s.q))


def drift_is_derivative(engine: Engine, s: Sample) -> Residual:
    """J̇ᵣq̇ = d/dt (Jᵣ q̇) with q̇ held."""
    drift = along(engine, lambda q: engine.jacobian(q) @ s.v, s.q, s.v)
    J = engine.jacobian(s.q)
    return derived(engine, drift - engine.drift(s.q, s.v), drift, norm(J) * norm(s.v) ** 2)


def power_balance(engine: Engine, s: Sample) -> Residual:
    """d(T + U)/dt = Qᵀq̇ + f ė, with ė the rate at which the tip itself leaves the plane."""
    return _energy_rate(engine, s, s.v)


def closure_does_no_work(engine: Engine, s: Sample) -> Residual:
    """d(T + U)/dt = Qᵀq̇ with the tip pressed on the plane, when the tip moves along it."""
    along = gradient(engine, lambda q: s.normal @ engine.position(q), s.q)
    return _energy_rate(engine, s, s.v - along * (along @ s.v) / (along @ along), count_closure=False)


def closure_holds(engine: Engine, s: Sample) -> Residual:
    """d²e/dt² = 0 along the motion that Eq. 24 gives, e differentiated through the Jacobian."""
    a, _ = _press(engine, s, s.v)

    def rate(t: Any) -> Array:
        return np.asarray(s.normal @ engine.jacobian(moved(engine, s.q, t * s.v + t * t * a / 2)) @ (s.v + t * a))

    second = derivative(engine, rate)
    J = engine.jacobian(s.q)
    return derived(engine, second, norm(J) * norm(a), norm(J) * norm(s.v) ** 2)


def force_can_be_applied(engine: Engine, s: Sample) -> Residual:
    """Take the plane away and push the tip with f n instead: the same torque makes the same motion."""
    a, f = _press(engine, s, s.v)
    Q = engine.pushed_inverse_dynamics(s.q, s.v, a, f * s.normal)
    push = f * norm(engine.jacobian(s.q))
    return rounded(Q - s.torque, s.torque, push, _work_terms(engine, s, a))


def impulse_momentum(engine: Engine, s: Sample) -> Residual:
    """At an impact the energy changes by p·(ė⁺ + ė⁻)/2, the momentum H q̇ by Jᵣᵀ n p, and ė⁺ = −ε ė⁻."""
    H, A = engine.mass_matrix(s.q), s.normal @ engine.jacobian(s.q)
    after, (p,) = impulse(H, s.v, A, s.restitution)
    before_rate, after_rate = A @ s.v, A @ after
    momentum = H @ (after - s.v) - A * p
    energies = [engine.kinetic_energy(s.q, v) for v in (s.v, after)]
    energy = energies[1] - energies[0] - p * (before_rate + after_rate) / 2
    values = (
        relative(momentum, norm(H) * norm(after), norm(H) * norm(s.v)),
        relative(after_rate + s.restitution * before_rate, norm(A) * norm(after), norm(A) * norm(s.v)),
        relative(energy, *energies, norm(H) * norm(after) ** 2, norm(H) * norm(s.v) ** 2),
    )
    return Residual(max(values), ROUNDING, "residuals of one dense solve")


IDENTITIES: Mapping[str, tuple[Callable[[Engine, Sample], Residual], tuple[str, ...]]] = {
    check.__name__: (check, needs)
    for check, needs in (
        (symmetric, ("mass_matrix",)),
        (positive_definite, ("mass_matrix",)),
        (kinetic_energy_is_quadratic, ("mass_matrix", "kinetic_energy")),
        (inverse_undoes_forward, ("mass_matrix", "bias", "forward_dynamics", "inverse_dynamics")),
        (inverse_dynamics_is_affine, ("mass_matrix", "bias", "inverse_dynamics")),
        (gravity_is_gradient, ("gravity_term", "potential_energy")),
        (bias_follows_from_mass_matrix, ("mass_matrix", "bias", "gravity_term")),
        (coriolis_matrix_is_skew, ("mass_matrix", "coriolis_matrix")),
        (coriolis_matrix_gives_bias, ("mass_matrix", "bias", "gravity_term", "coriolis_matrix")),
        (jacobian_is_derivative, ("position", "jacobian")),
        (drift_is_derivative, ("jacobian", "drift")),
        (power_balance, ("mass_matrix", "bias", "gravity_term", "position", "jacobian", "drift")),
        (closure_does_no_work, ("mass_matrix", "bias", "gravity_term", "position", "jacobian", "drift")),
        (closure_holds, ("mass_matrix", "bias", "jacobian", "drift")),
        (force_can_be_applied, ("mass_matrix", "bias", "jacobian", "drift", "pushed_inverse_dynamics")),
        (impulse_momentum, ("mass_matrix", "jacobian", "kinetic_energy")),
    )
}


def check_all(engine: Engine, sample: Sample) -> dict[str, Residual]:
    """Return the residuals of every identity that the engine has the methods for."""
    left_out = unanswered(engine)
    return {name: check(engine, sample) for name, (check, _) in IDENTITIES.items() if name not in left_out}


def unanswered(engine: Engine) -> dict[str, tuple[str, ...]]:
    """Return the identities that the engine cannot be asked, each with the methods that it lacks."""
    lacking = {
        name: tuple(each for each in needs if not hasattr(engine, each) or each in getattr(engine, "cannot", {}))
        for name, (_, needs) in IDENTITIES.items()
    }
    return {name: methods for name, methods in lacking.items() if methods}


def _energy_rate(engine: Engine, s: Sample, v: Array, *, count_closure: bool = True) -> Residual:
    """Return d(T + U)/dt − Qᵀq̇ − f ė at rates v, T = ½ q̇ᵀ H q̇ and dU/dt = (gravity term)·q̇."""
    a, f = _press(engine, s, v)
    H, H_dot = engine.mass_matrix(s.q), along(engine, engine.mass_matrix, s.q, v)
    leaving = along(engine, lambda q: s.normal @ engine.position(q), s.q, v)
    closure = f * leaving if count_closure else 0.0
    powers = np.array([v @ H @ a, v @ H_dot @ v / 2, engine.gravity_term(s.q) @ v, -(s.torque @ v), -closure])
    push = f * norm(engine.jacobian(s.q)) * norm(v)
    scales = (norm(v) * norm(H) * norm(a), norm(H) * norm(v) ** 3, push)
    return derived(engine, np.sum(powers), powers, *scales)


def _press(engine: Engine, s: Sample, v: Array) -> tuple[Array, float]:
    """Return q̈ and f of Eq. 24 with the tip on the plane, without stabiliser."""
    A = s.normal @ engine.jacobian(s.q)
    b = -s.normal @ engine.drift(s.q, v)
    a, (f,) = solve_bordered(engine.mass_matrix(s.q), s.torque - engine.bias(s.q, v), A, b)
    return a, float(f)


def _work_terms(engine: Engine, s: Sample, a: Array) -> float:
    """Return the size of the terms of H q̈ + C, which sets the rounding of their sum."""
    return norm(engine.mass_matrix(s.q)) * norm(a) + norm(engine.bias(s.q, s.v))


def _coriolis_scale(engine: Engine, s: Sample) -> float:
    """Return the size of the terms that cancel in a Coriolis torque."""
    return norm(engine.mass_matrix(s.q)) * norm(s.v) ** 2
