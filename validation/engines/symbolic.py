"""The ground truth: Lagrange's equations derived by sympy and evaluated in fifty digits by mpmath.

The equations are polynomials in the cosines and sines of the joints.
"""

# ruff: noqa: D102 - what a method returns is said once, in `interface.Engine`

from dataclasses import dataclass
from functools import lru_cache
from typing import Any
from xml.etree import ElementTree

import numpy as np

from validation.engines.interface import METHODS, CannotBuild, Engine, Robot
from validation.oracle.spatial import Array

BITS = 200
"""Sixty digits: ten to lose on the way, fifty to hand out."""


@dataclass(frozen=True)
class Derived:
    """Matrices of polynomials by name, and for each joint whether its variables are a cosine and a sine."""

    turns: tuple[bool, ...]
    matrices: dict[str, list[list[Any]]]


class Values:
    """The polynomials' variables at one q, in mpmath numbers."""

    def __init__(self, made: Derived, q: Any) -> None:
        import mpmath

        self.matrices = made.matrices
        pairs = [(mpmath.cos(x), mpmath.sin(x)) if turns else (x, 0) for turns, x in zip(made.turns, q, strict=True)]
        variables = [x for pair in pairs for x in pair]
        self._powers = [[mpmath.mpf(1), x, x * x] for x in variables]

    def matrix(self, name: str) -> Any:
        """Return one of the matrices in numbers."""
        import mpmath

        return mpmath.matrix([[self._value(entry) for entry in row] for row in self.matrices[name]])

    def _value(self, polynomial: Any) -> Any:
        import mpmath

        total = mpmath.mpf(0)
        for exponents, coefficient in polynomial:
            term = coefficient
            for powers, exponent in zip(self._powers, exponents, strict=True):
                if exponent:
                    term *= powers[exponent]
            total += term
        return total


@lru_cache(maxsize=16)
def derive(
    text: str, tip: str, names: tuple[str, ...], armature: tuple[float, ...], gravity: tuple[float, ...]
) -> Derived:
    """Derive H, ∂H/∂q_k, ∂U/∂q, r, Jᵣ and ∂Jᵣ/∂q_k from the kinetic and potential energies."""
    import mpmath
    from sympy import RealField
    from sympy.polys.rings import ring

    n = len(names)
    chain = _Chain(text, names, ring([f"{x}{i}" for i in range(n) for x in "cs"], RealField(prec=BITS)))
    with mpmath.workprec(BITS):
        chain.place()
    if tip not in chain.poses:
        raise CannotBuild(f"it has no link {tip!r}")
    slope, zero = chain.slope, chain.ring.zero
    H = np.full((n, n), zero)
    U = np.full(n, zero)
    for i, x in enumerate(armature):
        H[i, i] = chain.number(x)
    g = np.array([chain.number(x) for x in gravity])
    for mass, centre, rotation, moment in chain.bodies():
        moved = [slope(centre, k) for k in range(n)]
        turned = [slope(rotation, k) for k in range(n)]
        for i in range(n):
            U[i] -= mass * (g @ moved[i])
            for j in range(i, n):
                H[i, j] += mass * (moved[i] @ moved[j]) + np.sum((turned[i] @ moment) * turned[j])
    H = np.array([[chain.reduced(H[min(i, j), max(i, j)]) for j in range(n)] for i in range(n)])
    r = chain.poses[tip][1]
    J = np.stack([slope(r, k) for k in range(n)], axis=1)
    made = {"H": H, "U": U[:, None], "r": r[:, None], "J": J}
    made |= {f"H{k}": slope(H, k) for k in range(n)} | {f"J{k}": slope(J, k) for k in range(n)}
    return Derived(chain.turns, {name: [[_terms(x) for x in row] for row in rows] for name, rows in made.items()})


def _terms(polynomial: Any) -> list[tuple[tuple[int, ...], Any]]:
    import mpmath

    return [(exponents, mpmath.make_mpf(x._mpf_)) for exponents, x in polynomial.terms()]


class _Chain:
    """The links of a URDF, placed by polynomials in the cosines and sines of the joints."""

    def __init__(self, text: str, names: tuple[str, ...], made: Any) -> None:
        self.ring, *self.variables = made
        self.root = ElementTree.fromstring(text.encode())
        self.column = {name: i for i, name in enumerate(names)}
        kinds = {joint.get("name"): joint.get("type") for joint in self.root.iterfind("joint")}
        self.turns = tuple(kinds[name] != "prismatic" for name in names)
        self.poses: dict[str, tuple[Array, Array]] = {}

    def slope(self, x: Array, k: int) -> Array:
        """Return ∂x/∂q_k of an array of polynomials."""
        c, s = self.variables[2 * k : 2 * k + 2]

        def of(p: Any) -> Any:
            return self.reduced(p.diff(s) * c - p.diff(c) * s) if self.turns[k] else p.diff(c)

        return np.asarray(np.frompyfunc(of, 1, 1)(x))

    def reduced(self, polynomial: Any) -> Any:
        """Put 1 − cos² for every sin², so that like terms meet and powers stay at two or below."""
        for k, turns in enumerate(self.turns):
            c = self.variables[2 * k]
            while turns and any(exponents[2 * k + 1] > 1 for exponents in polynomial):
                high = {e: x for e, x in polynomial.items() if e[2 * k + 1] > 1}
                rest = self.ring.from_dict({e: x for e, x in polynomial.items() if e[2 * k + 1] <= 1})
                lower = self.ring.from_dict(
                    {(*e[: 2 * k + 1], e[2 * k + 1] - 2, *e[2 * k + 2 :]): x for e, x in high.items()}
                )
                polynomial = rest + lower * (1 - c**2)
        return polynomial

    def place(self) -> None:
        """Place every link: from the root outwards, R = R_parent R_origin R_joint."""
        joints = self.root.findall("joint")
        children = {_link(joint, "child") for joint in joints}
        for link in self.root.findall("link"):
            if link.get("name") not in children:
                self.poses[link.get("name", "")] = self._constants(np.eye(3)), self._constants(np.zeros(3))
        while joints:
            ready = [joint for joint in joints if _link(joint, "parent") in self.poses]
            if not ready:
                raise CannotBuild("the links do not form one tree")
            for joint in ready:
                joints.remove(joint)
                self._place_child(joint)

    def _place_child(self, joint: Any) -> None:
        rotation, origin = self.poses[_link(joint, "parent")]
        turn, shift = (self._constants(x) for x in _origin(joint.find("origin")))
        rotation, origin = rotation @ turn, origin + rotation @ shift
        if joint.get("type") != "fixed":
            k = self.column[joint.get("name", "")]
            c, s = self.variables[2 * k : 2 * k + 2]
            element = joint.find("axis")
            axis = _unit(_numbers("1 0 0" if element is None else element.get("xyz", "1 0 0")))
            if self.turns[k]:
                across = _cross(axis)
                parts = (np.eye(3), across, across @ across)
                one, sine, rest = (self._constants(x) for x in parts)
                rotation = rotation @ (one + sine * s + rest * (1 - c))
            else:
                origin = origin + rotation @ (self._constants(axis) * c)
        self.poses[_link(joint, "child")] = self._reduced(rotation), self._reduced(origin)

    def bodies(self) -> list[Any]:
        """Return mass, centre (3,), rotation (3, 3) and second moment (3, 3) of every link that moves."""
        out = []
        for link in self.root.findall("link"):
            inertial = link.find("inertial")
            rotation, origin = self.poses[link.get("name", "")]
            if inertial is None or all(x.is_ground for x in (*rotation.ravel(), *origin)):
                continue
            turn, centre = (self._constants(x) for x in _origin(inertial.find("origin")))
            mass, inertia = inertial.find("mass"), inertial.find("inertia")
            if mass is None or inertia is None:
                raise CannotBuild(f"link {link.get('name')!r} lacks mass or inertia")
            of = {key: _numbers(inertia.get(key, "nan"))[0] for key in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")}
            tensor = np.array([[of["i" + min(a, b) + max(a, b)] for b in "xyz"] for a in "xyz"])
            moment = self._constants(np.trace(tensor) / 2 * np.eye(3, dtype=int) - tensor)
            kilograms = self.number(_numbers(mass.get("value", "nan"))[0])
            out.append((kilograms, origin + rotation @ centre, rotation @ turn, moment))
        return out

    def number(self, x: Any) -> Any:
        """Return a number as a polynomial; `ring(x)` itself would cut it to a double on the way."""
        return self.ring.ground_new(self.ring.domain.dtype(x))

    def _constants(self, x: Array) -> Array:
        return np.asarray(np.frompyfunc(self.number, 1, 1)(x))

    def _reduced(self, x: Array) -> Array:
        return np.asarray(np.frompyfunc(self.reduced, 1, 1)(x))


def _link(joint: Any, end: str) -> str:
    return str(joint.find(end).get("link"))


def _origin(element: Any) -> tuple[Array, Array]:
    """Return rotation R_z R_y R_x and translation of an ``origin``, in mpmath numbers."""
    import mpmath

    rpy, xyz = ("0 0 0", "0 0 0") if element is None else (element.get(key, "0 0 0") for key in ("rpy", "xyz"))
    rotation = np.eye(3, dtype=int).astype(object)
    for angle, axis in zip(_numbers(rpy), np.eye(3, dtype=int), strict=True):
        across = _cross(axis)
        rotation = (
            np.eye(3, dtype=int) + mpmath.sin(angle) * across + (1 - mpmath.cos(angle)) * across @ across
        ) @ rotation
    return rotation, _numbers(xyz)


def _numbers(text: str) -> Array:
    """Return the doubles that a text names as mpmath numbers."""
    import mpmath

    return np.array([mpmath.mpf(float(word)) for word in text.split()])


def _unit(axis: Array) -> Array:
    import mpmath

    return np.asarray(axis / mpmath.sqrt(axis @ axis))


def _cross(a: Array) -> Array:
    return np.array([[0, -a[2], a[1]], [a[2], 0, -a[0]], [-a[1], a[0], 0]])


MOST_JOINTS = 4
# What is one of the matrices that are derived.
BY_NAME = {"mass_matrix": "H", "position": "r", "jacobian": "J"}


class Symbolic(Engine):
    """Lagrange's equations, with nothing of any multibody algorithm in them.

    From the text by a reader of its own: the centre of mass c and the rotation R of every link, as polynomials in
    cos qᵢ and sin qᵢ (or qᵢ, if prismatic), which sympy multiplies and differentiates.
    T = Σ ½ m ċ·ċ + ½ tr(Ṙ Σ Ṙᵀ) + ½ armature q̇², where Σ = ½ tr(I) 1 − I is the second moment of the link's
    mass about its centre, so that not even an angular velocity is needed; U = −Σ m g·c.
    H_ij = ∂²T/∂q̇_i∂q̇_j; C_i = Σ_jk (∂H_ij/∂q_k − ½ ∂H_jk/∂q_i) q̇_j q̇_k + ∂U/∂q_i; Jᵣ = ∂r/∂q;
    J̇ᵣq̇ = Σ_jk ∂²r/∂q_j∂q_k q̇_j q̇_k. Numbers have 60 digits; results are rounded once, at the end, and `exact`
    hands out all digits.

    Joint order: the robot's own, by name. Frames: base axes. Armature: a term of T. Gravity: a term of U. Sign of f:
    positive along +n on the robot. Constraint and impact: the bordered system of Eq. 24. The decimals of the text
    count as the doubles that every other engine reads.

    Accuracy: correctly rounded; 50 digits of the 60 survive a condition number of 1e10.
    """

    name = "symbolic"
    package = "sympy"
    install = 'pip install "sympy>=1.13" "mpmath>=1.3"'
    covers = frozenset(METHODS)

    def __init__(self, robot: Robot, tip: str) -> None:
        super().__init__(robot, tip)
        if robot.format != "urdf":
            raise CannotBuild(f"it reads URDF only, this robot is {robot.format!r}")
        if self.n > MOST_JOINTS:
            raise CannotBuild(f"{self.n} joints: the expressions are generated for at most {MOST_JOINTS}")
        if robot.locked:
            raise CannotBuild("it locks no joints")
        self._made = derive(
            robot.text, tip, tuple(robot.joint_names), tuple(float(x) for x in robot.armature),
            tuple(float(x) for x in robot.gravity),
        )  # fmt: skip

    def exact(self, method: str, *arguments: Any) -> Any:
        """Return a method's result as mpmath numbers: a matrix, or for `constrained` and `impulse` a pair."""
        import mpmath

        with mpmath.workprec(BITS):
            q, *others = [mpmath.matrix(np.atleast_1d(x).tolist()) for x in arguments]
            at = Values(self._made, q)
            return at.matrix(BY_NAME[method]) if method in BY_NAME else getattr(self, f"_{method}")(at, *others)

    def mass_matrix(self, q: Array) -> Array:
        return _matrix(self.exact("mass_matrix", q))

    def bias(self, q: Array, v: Array) -> Array:
        return _vector(self.exact("bias", q, v))

    def gravity_term(self, q: Array) -> Array:
        return _vector(self.exact("bias", q, np.zeros(self.n)))

    def position(self, q: Array) -> Array:
        return _vector(self.exact("position", q))

    def jacobian(self, q: Array) -> Array:
        return _matrix(self.exact("jacobian", q))

    def drift(self, q: Array, v: Array) -> Array:
        return _vector(self.exact("drift", q, v))

    def free_acceleration(self, q: Array, v: Array, torque: Array) -> Array:
        return _vector(self.exact("free_acceleration", q, v, torque))

    def stabilised(self, q: Array, v: Array, normal: Array, offset: float, gains: Array) -> float:
        return float(self.exact("stabilised", q, v, normal, offset, gains))

    def constrained(self, q: Array, v: Array, torque: Array, normal: Array, b: float) -> tuple[Array, float]:
        a, f = self.exact("constrained", q, v, torque, normal, b)
        return _vector(a), float(f)

    def impulse(self, q: Array, v: Array, normal: Array, restitution: float) -> tuple[Array, float]:
        after, p = self.exact("impulse", q, v, normal, restitution)
        return _vector(after), float(p)

    def _bias(self, at: Values, v: Any) -> Any:
        import mpmath

        slopes, C = [at.matrix(f"H{k}") for k in range(self.n)], at.matrix("U")
        for i in range(self.n):
            C[i] += mpmath.fsum(slopes[k][i, j] * v[j] * v[k] for j in range(self.n) for k in range(self.n))
            C[i] -= (v.T * slopes[i] * v)[0] / 2
        return C

    def _drift(self, at: Values, v: Any) -> Any:
        import mpmath

        return sum((at.matrix(f"J{k}") * v * v[k] for k in range(self.n)), mpmath.zeros(3, 1))

    def _free_acceleration(self, at: Values, v: Any, torque: Any) -> Any:
        import mpmath

        return mpmath.lu_solve(at.matrix("H"), torque - self._bias(at, v))

    def _stabilised(self, at: Values, v: Any, normal: Any, offset: Any, gains: Any) -> Any:
        e = (normal.T * at.matrix("r"))[0] - offset[0]
        rate = (normal.T * at.matrix("J") * v)[0]
        return -(normal.T * self._drift(at, v))[0] - gains[0] * rate - gains[1] * e

    def _constrained(self, at: Values, v: Any, torque: Any, normal: Any, b: Any) -> Any:
        return _bordered(at.matrix("H"), torque - self._bias(at, v), normal.T * at.matrix("J"), b[0])

    def _impulse(self, at: Values, v: Any, normal: Any, restitution: Any) -> Any:
        A, H = normal.T * at.matrix("J"), at.matrix("H")
        return _bordered(H, H * v, A, -restitution[0] * (A * v)[0])


def _bordered(H: Any, forcing: Any, A: Any, b: Any) -> tuple[Any, Any]:
    """Solve H x − Aᵀ f = forcing, A x = b."""
    import mpmath

    n = H.rows
    matrix, right = mpmath.zeros(n + 1), mpmath.zeros(n + 1, 1)
    matrix[:n, :n], matrix[:n, n], matrix[n, :n] = H, -A.T, A
    right[:n, 0], right[n, 0] = forcing, b
    solution = mpmath.lu_solve(matrix, right)
    return solution[:n, 0], solution[n, 0]


def _matrix(x: Any) -> Array:
    return np.array(x.tolist(), dtype=float)


def _vector(x: Any) -> Array:
    return np.array([float(entry) for entry in x])
