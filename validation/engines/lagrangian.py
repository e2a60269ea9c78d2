"""Lagrange's equations of a URDF as polynomials in the cosines and sines of its joints; see `symbolic`."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any
from xml.etree import ElementTree

import numpy as np

from validation.engines.interface import CannotBuild
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
                lower = self.ring.from_dict({_less(e, 2 * k + 1): x for e, x in high.items()})
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


def _less(exponents: tuple[int, ...], at: int) -> tuple[int, ...]:
    return (*exponents[:at], exponents[at] - 2, *exponents[at + 1 :])


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
