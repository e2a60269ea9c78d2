"""How an engine computes a value: by a method of its own, a short function, or its own terms in Eq. 1 and Eq. 24.

An engine is an object with some of the methods of `validation.oracle.Oracle`; `free_acceleration`, `constrained` and
`impulse` of `validation.engines` are asked too. The rule for every quantity: the engine's own method if it has one;
else the equation of motion assembled from the engine's own H, C, J and drift; else it is not covered.

Orientations come from positions: beside its tip every robot that is asked for one carries links ``<tip>_x``,
``<tip>_y`` and ``<tip>_z``, one metre off along the tip's axes (see `description.with_triad`), so an engine that
knows only where points are answers for frames as well.

Quantities that take time: an engine's own accelerations, integrated tightly.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

import numpy as np

from validation.oracle.closure import impulse, solve_bordered
from validation.oracle.spatial import Array, skew
from validation.oracle.tree import RobotModel

EngineFactory = Callable[[Any, str], object]
"""(robot, name of its tip) → an engine."""


class Unanswered(NotImplementedError):
    """The engine has no method that this quantity could come from."""


class Asked:
    """One engine, built anew for each tip that is asked for.

    factory: (robot, tip) → engine
    tip: link whose origin is the tip
    """

    def __init__(self, factory: EngineFactory, model: RobotModel, tip: str) -> None:
        self.factory, self.model, self.tip = factory, model, tip
        self.n = len(model.joint_names)
        self._engine = factory(model, tip)
        self._others: dict[str, Asked] = {}

    def at(self, tip: str) -> Asked:
        """Return the same engine with another link of the robot as its tip."""
        if tip not in self._others:
            self._others[tip] = Asked(self.factory, self.model, tip)
        return self._others[tip]

    def mass_matrix(self, q: Array) -> Array:
        """Return H (n, n)."""
        return self._ask("mass_matrix", q)

    def bias(self, q: Array, v: Array) -> Array:
        """Return C (n,), gravity included."""
        return self._ask("bias", q, v)

    def position(self, q: Array) -> Array:
        """Return the tip r (3,), base frame [m]."""
        return self._ask("position", q)

    def jacobian(self, q: Array) -> Array:
        """Return Jᵣ (3, n), base frame."""
        return self._ask("jacobian", q)

    def drift(self, q: Array, v: Array) -> Array:
        """Return J̇ᵣq̇ (3,), base frame [m/s²]."""
        return self._ask("drift", q, v)

    def coriolis_matrix(self, q: Array, v: Array) -> Array:
        """Return the Coriolis matrix of Christoffel symbols (n, n)."""
        return self._ask("coriolis_matrix", q, v)

    def gravity_term(self, q: Array) -> Array:
        """Return the gravity part of C (n,), which is C at rest."""
        return self._first(lambda: self._ask("gravity_term", q), lambda: self.bias(q, np.zeros(self.n)))

    def inverse_dynamics(self, q: Array, v: Array, a: Array) -> Array:
        """Return Q = H q̈ + C (n,)."""
        return self._first(
            lambda: self._ask("inverse_dynamics", q, v, a), lambda: self.mass_matrix(q) @ a + self.bias(q, v)
        )

    def forward_dynamics(self, q: Array, v: Array, torque: Array) -> Array:
        """Return q̈ (n,) of the arm that touches nothing."""
        return self._first(
            lambda: self._ask("forward_dynamics", q, v, torque),
            lambda: self._ask("free_acceleration", q, v, torque),
            lambda: np.linalg.solve(self.mass_matrix(q), torque - self.bias(q, v)),
        )

    def pressed(self, q: Array, v: Array, torque: Array, normal: Array) -> Array:
        """Return f [N] and then q̈, (1 + n,), of the tip that stays in its plane: Eq. 24, no stabiliser.

        normal: (3,) unit n, base frame; f is the force of the surface on the robot along it
        """
        b = float(-normal @ self.drift(q, v))

        def assembled() -> Array:
            a, f = solve_bordered(self.mass_matrix(q), torque - self.bias(q, v), normal @ self.jacobian(q), np.array(b))
            return np.concatenate([f, a])

        def own() -> Array:
            a, f = self._method("constrained")(q, v, torque, normal, b)
            return np.concatenate([[float(f)], np.asarray(a)])

        return self._first(own, assembled)

    def rebound(self, q: Array, v: Array, normal: Array, restitution: float) -> Array:
        """Return q̇⁺ (n,) after an impact along `normal` (3,)."""
        return self._first(
            lambda: np.asarray(self._method("impulse")(q, v, normal, restitution)[0]),
            lambda: impulse(self.mass_matrix(q), v, normal @ self.jacobian(q), restitution)[0],
        )

    def _method(self, name: str) -> Callable[..., Any]:
        method = getattr(self._engine, name, None)
        if method is None:
            raise Unanswered(f"it has no method {name}")
        return method

    def _ask(self, name: str, *state: Array) -> Array:
        return np.asarray(self._method(name)(*state), dtype=float)

    @staticmethod
    def _first(*ways: Callable[[], Array]) -> Array:
        """Return the first answer that the engine has; if there is none, say what was missing last."""
        for way in ways[:-1]:
            try:
                return way()
            except NotImplementedError:  # not this way: `Unanswered`, or `validation.engines.NotCovered`
                continue
        return ways[-1]()


RELATIVE, ABSOLUTE = 1e-12, 1e-13
"""Tolerances of DOP853 a step, close to the smallest that it takes."""

HORIZON = 60.0
"""No swing or flight of a reference problem takes longer [s]; one that does has gone wrong."""


def free_positions(engine: Asked, q: Array, v: Array, times: Array) -> Array:
    """Return the tip (k, 3) at `times` (k,) [s], moving freely from (q, v) at time 0."""
    states = _free(engine, q, v, float(times[-1]), t_eval=times).y
    return np.stack([engine.position(state[: engine.n]) for state in states.T])


def swing_period(engine: Asked, q: Array, v: Array) -> Array:
    """Return the time () [s] of a full swing of one joint about q = 0: twice that between two crossings of zero."""

    def crossing(_: float, state: Array) -> float:
        return float(state[0])

    crossing.terminal = 2  # type: ignore[attr-defined]
    (times,) = _free(engine, q, v, HORIZON, events=crossing).t_events
    if len(times) < 2:
        raise ArithmeticError(f"it does not swing through zero twice in {HORIZON:g} s")
    return np.asarray(2.0 * (times[1] - times[0]))


def impact_times(engine: Asked, q: Array, v: Array, normal: Array, restitution: Array, count: Array) -> Array:
    """Return when (count,) [s] the tip, falling freely, strikes the plane n·r = 0; between strikes q̇⁺ by `rebound`."""
    out: list[float] = []
    now = 0.0

    def height(_: float, state: Array) -> float:
        return float(normal @ engine.position(state[: engine.n]))

    height.terminal, height.direction = True, -1.0  # type: ignore[attr-defined]
    while len(out) < int(count):
        flight = _free(engine, q, v, HORIZON, events=height)
        if not len(flight.t_events[0]):
            raise ArithmeticError(f"it does not come down within {HORIZON:g} s")
        now += float(flight.t_events[0][0])
        out.append(now)
        q, v = np.split(flight.y_events[0][0], 2)
        v = engine.rebound(q, v, normal, float(restitution))
    return np.array(out)


def _free(engine: Asked, q: Array, v: Array, until: float, **options: Any) -> Any:
    """Integrate q̈ of the free arm, no torque, from time 0."""
    from scipy.integrate import solve_ivp

    n, nothing = engine.n, np.zeros(engine.n)

    def rates(_: float, state: Array) -> Array:
        return np.concatenate([state[n:], engine.forward_dynamics(state[:n], state[n:], nothing)])

    right_hand_side: Callable[[float, Array], Array] = rates
    start = np.concatenate([q, v])
    result = solve_ivp(
        right_hand_side, (0.0, until), start, method="DOP853", rtol=RELATIVE, atol=ABSOLUTE, max_step=0.1, **options
    )
    if result.status < 0:
        raise ArithmeticError(f"its accelerations cannot be integrated: {result.message}")
    return result


AXES = "xyz"


def coriolis_torque(engine: Asked, q: Array, v: Array) -> Array:
    """Return C without gravity (n,)."""
    return engine.bias(q, v) - engine.gravity_term(q)


def tip_velocity(engine: Asked, q: Array, v: Array) -> Array:
    """Return Jᵣq̇ (3,) [m/s]."""
    return np.asarray(engine.jacobian(q) @ v)


def tip_acceleration(engine: Asked, q: Array, v: Array, a: Array) -> Array:
    """Return Jᵣq̈ + J̇ᵣq̇ (3,) [m/s²]."""
    return engine.jacobian(q) @ a + engine.drift(q, v)


def rotation(engine: Asked, q: Array) -> Array:
    """Return the tip's axes as columns (3, 3), base frame."""
    origin = engine.position(q)
    return np.stack([engine.at(f"{engine.tip}_{axis}").position(q) - origin for axis in AXES], axis=1)


def angular_velocity(engine: Asked, q: Array, v: Array) -> Array:
    """Return ω of the tip's link (3,) [rad/s]."""
    return np.asarray(_frame_jacobian(engine, q)[3:] @ v)


def angular_acceleration(engine: Asked, q: Array, v: Array, a: Array) -> Array:
    """Return ω̇ of the tip's link (3,) [rad/s²]: ë = ω̇ × e + ω × (ω × e) for each axis e, and Σ e × (ω̇ × e) = 2
    ω̇.
    """
    R, omega = rotation(engine, q), angular_velocity(engine, q, v)
    own = tip_acceleration(engine, q, v, a)
    out = np.zeros(3)
    for e, axis in zip(R.T, AXES, strict=True):
        relative = tip_acceleration(engine.at(f"{engine.tip}_{axis}"), q, v, a) - own
        out += np.cross(e, relative - np.cross(omega, np.cross(omega, e))) / 2.0
    return out


def loaded_gravity_term(engine: Asked, q: Array, wrench: Array) -> Array:
    """Return the torque (n,) that holds the arm while its tip exerts `wrench` (6,), force first, in the tip's frame."""
    turn = np.kron(np.eye(2), rotation(engine, q))
    return np.asarray(engine.gravity_term(q) + _frame_jacobian(engine, q).T @ (turn @ wrench))


def cartesian_inertia(engine: Asked, q: Array) -> Array:
    """Return J⁻ᵀ H J⁻¹ (6, 6) of an arm with six joints, base frame, linear rows first."""
    inverse = np.linalg.inv(_frame_jacobian(engine, q))
    return np.asarray(inverse.T @ engine.mass_matrix(q) @ inverse)


def manipulability(engine: Asked, q: Array) -> Array:
    """Return Yoshikawa's √det(J Jᵀ) of the whole, the linear and the angular Jacobian (3,)."""
    J = _frame_jacobian(engine, q)
    return np.array([np.sqrt(np.linalg.det(part @ part.T)) for part in (J, J[:3], J[3:])])


def inertia_ellipsoid(engine: Asked, q: Array) -> Array:
    """Return Asada's ratio of extreme eigenvalues of the Cartesian inertia: whole, linear, angular block (3,)."""
    M = cartesian_inertia(engine, q)
    values = [np.linalg.eigvalsh(part) for part in (M, M[:3, :3], M[3:, 3:])]
    return np.array([value[0] / value[-1] for value in values])


def contact(engine: Asked, q: Array, v: Array, torque: Array, normal: Array) -> Array:
    """Return f [N] and q̈, (1 + n,), of the tip held in the plane through it (Eq. 24)."""
    return engine.pressed(q, v, torque, normal)


def pressing_torque(engine: Asked, q: Array, force: Array) -> Array:
    """Return the torque (n,) with which the arm at rest presses `force` (3,) [N] on what it touches: G + Jᵣᵀ F."""
    return np.asarray(engine.gravity_term(q) + engine.jacobian(q).T @ force)


def sliding_mobility(engine: Asked, q: Array, normal: Array, slip: Array, friction: Array) -> Array:
    """Return nᵀJᵣ H⁻¹ Jᵣᵀ (n − μ t) () [1/kg]: the normal acceleration per newton of f while the tip slides along t."""
    J = engine.jacobian(q)
    return np.asarray(normal @ J @ np.linalg.solve(engine.mass_matrix(q), J.T @ (normal - friction * slip)))


QUANTITIES: Mapping[str, Callable[..., Array]] = MappingProxyType(
    {
        function.__name__: function
        for function in (
            Asked.mass_matrix,
            Asked.gravity_term,
            Asked.bias,
            Asked.coriolis_matrix,
            coriolis_torque,
            Asked.inverse_dynamics,
            Asked.forward_dynamics,
            Asked.position,
            Asked.jacobian,
            Asked.drift,
            tip_velocity,
            tip_acceleration,
            rotation,
            angular_velocity,
            angular_acceleration,
            loaded_gravity_term,
            cartesian_inertia,
            manipulability,
            inertia_ellipsoid,
            contact,
            pressing_torque,
            sliding_mobility,
            free_positions,
            swing_period,
            impact_times,
        )
    }
)


def _frame_jacobian(engine: Asked, q: Array) -> Array:
    """Return the Jacobian of the tip's frame (6, n), linear rows first: ė = ω × e, and Σ e × (ω × e) = 2 ω."""
    R, J = rotation(engine, q), engine.jacobian(q)
    turning = sum(
        (skew(e) @ (engine.at(f"{engine.tip}_{axis}").jacobian(q) - J) for e, axis in zip(R.T, AXES, strict=True)),
        start=np.zeros_like(J),
    )
    return np.concatenate([J, turning / 2.0])
