"""Painlevé's rod: the geometry at which a sliding contact stops answering a normal force."""

import numpy as np

from validation.anchors.description import joint, link, read, robot
from validation.anchors.problem import Case, ReferenceProblem

TIP = "end"
TOLERANCE = 1e-13
ARGUMENT = "one 3 × 3 solve with a condition number of 12 on numbers below 10: some 100 ε"


def problems() -> tuple[ReferenceProblem, ...]:
    """Return the rod in the vertical plane, its lower end in contact."""
    data = read("painleve_rod")
    m, half, r = data["mass"], data["half_length"], data["radius"]
    thin = m * half**2 / 3.0
    parts = [
        link("base"),
        link("slide"),
        link("hoist"),
        link("rod", m, (0.0, 0.0, 0.0), (m * r**2 / 2.0, thin, thin)),
        link(TIP),
        joint("x", "prismatic", "base", "slide", axis=(1.0, 0.0, 0.0)),
        joint("z", "prismatic", "slide", "hoist"),
        joint("theta", "revolute", "hoist", "rod", axis=(0.0, -1.0, 0.0)),
        joint("to_end", "fixed", "rod", TIP, xyz=(-half, 0.0, 0.0)),
    ]
    cases = []
    for state in data["states"]:
        theta, mu = state["theta"], state["friction"]
        c, s = np.cos(theta), np.sin(theta)
        inputs = {
            "q": np.array([0.0, half * s, theta]),
            "normal": np.array([0.0, 0.0, 1.0]),
            "slip": np.array([-1.0, 0.0, 0.0]),
            "friction": np.array(mu),
        }
        expected = np.asarray((1.0 + 3.0 * c * (c - mu * s)) / m)
        name = f"normal acceleration per newton at θ = {theta:.6g}, μ = {mu:.6g}"
        cases.append(Case(name, "sliding_mobility", inputs, expected, np.array(TOLERANCE), ARGUMENT))
    model = robot("painleve_rod", parts, ["x", "z", "theta"], TIP)
    return (ReferenceProblem("Painlevé rod", data["source"], model, TIP, tuple(cases)),)
