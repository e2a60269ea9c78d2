"""The textbook arm of two links: every term in closed form, at rest, in motion, and pressing on a surface."""

from collections.abc import Iterator

import numpy as np

import robot_models
from robot_models.planar2 import closed_form
from validation.anchors.description import read
from validation.anchors.problem import Case, ReferenceProblem
from validation.oracle.spatial import Array

TERMS = 1e-13
TERMS_WHY = "sums of a few products no larger than 100 in their unit, which round to 5 ε each"
CONTACT = 1e-12
CONTACT_WHY = (
    "rounding of 1e-14 in H and C, times the condition number of Eq. 24, below 30 at these poses, on |q̈| and f up to 10"
)


def problems() -> tuple[ReferenceProblem, ...]:
    """Return the shipped robot `planar2` against its closed form."""
    data = read("planar_arm")
    model = robot_models.load("planar2")
    cases: list[Case] = []
    for number, state in enumerate(data["states"], start=1):
        q, v, a = (np.array(state[name]) for name in ("q", "v", "a"))
        cases += _terms(f"state {number}", q, v, a)
        for normal in data["normals"]:
            cases += _contact(f"state {number}, normal {normal}", q, v, np.array(normal), data["force"])
    return (ReferenceProblem("planar arm", data["source"], model, "tip", tuple(cases)),)


def _terms(where: str, q: Array, v: Array, a: Array) -> Iterator[Case]:
    """Return every term of Eq. 24 at one state."""
    known, rest = closed_form.terms(q, v), closed_form.terms(q, np.zeros(2))
    torque = known.mass_matrix @ a + known.bias
    for quantity, inputs, expected in (
        ("mass_matrix", {"q": q}, known.mass_matrix),
        ("bias", {"q": q, "v": v}, known.bias),
        ("gravity_term", {"q": q}, rest.bias),
        ("position", {"q": q}, known.position),
        ("jacobian", {"q": q}, known.jacobian),
        ("drift", {"q": q, "v": v}, known.drift),
        ("inverse_dynamics", {"q": q, "v": v, "a": a}, torque),
    ):
        yield Case(f"{quantity}, {where}", quantity, inputs, expected, np.array(TERMS), TERMS_WHY)
    tolerance = np.array(CONTACT)
    yield Case(
        f"free motion, {where}", "forward_dynamics", {"q": q, "v": v, "torque": torque}, a, tolerance, CONTACT_WHY
    )


def _contact(where: str, q: Array, v: Array, normal: Array, force: float) -> Iterator[Case]:
    """Return what presses with `force` [N]: at rest by virtual work, and in the motion along the plane that it allows.

    The tip presses −f n on the surface. Among the motions with A q̈ = −nᵀJ̇ᵣq̇ the smallest is taken, the torque
    that it needs follows from Eq. 24, and the engine must find both the motion and f again.
    """
    rest, known = closed_form.terms(q, np.zeros(2)), closed_form.terms(q, v)
    pressing = rest.bias - rest.jacobian.T @ normal * force
    yield Case(
        f"pressing torque, {where}",
        "pressing_torque",
        {"q": q, "force": -force * normal},
        pressing,
        np.array(TERMS),
        TERMS_WHY,
    )
    A = normal @ known.jacobian
    a = -A * (normal @ known.drift) / (A @ A)
    torque = known.mass_matrix @ a + known.bias - A * force
    for name, rates, Q, motion in (("at rest", np.zeros(2), pressing, np.zeros(2)), ("in motion", v, torque, a)):
        inputs = {"q": q, "v": rates, "torque": Q, "normal": normal}
        expected = np.concatenate([[force], motion])
        if name == "in motion" and not np.any(v):
            continue
        yield Case(f"contact force {name}, {where}", "contact", inputs, expected, np.array(CONTACT), CONTACT_WHY)
