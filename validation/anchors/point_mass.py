"""A point mass on slides: on an inclined plane, and bouncing."""

from collections.abc import Mapping
from typing import Any

import numpy as np

import robot_models
from validation.anchors.description import joint, link, read, robot
from validation.anchors.problem import Case, ReferenceProblem

CONTACT = 1e-13
CONTACT_WHY = "H is m times the identity: a handful of operations on numbers below 20, a rounding of 5 ε each"
IMPACT = 1e-12
IMPACT_WHY = (
    "free fall is a parabola, exact for DOP853 up to rounding of its few dozen steps; each crossing is found to 4 ε"
)


def problems() -> tuple[ReferenceProblem, ...]:
    """Return the inclined plane, and one problem a bouncing ball."""
    data = read("bouncing_ball")
    balls = tuple(_bouncing(ball, data["source"], data["gravity"]) for ball in data["balls"])
    return (_inclined(), *balls)


def _inclined() -> ReferenceProblem:
    """Return the shipped robot `pointmass3` on planes of several slopes."""
    data = read("inclined_plane")
    model = robot_models.load("pointmass3")
    mass, g = 2.0, data["gravity"]
    cases = []
    for slope in data["slopes_deg"]:
        tilt, heading, mu = np.radians(slope["tilt"]), np.radians(slope["heading"]), slope["friction"]
        ahead = np.array([np.cos(heading), np.sin(heading), 0.0])
        up = np.array([0.0, 0.0, 1.0])
        normal, downhill = np.sin(tilt) * ahead + np.cos(tilt) * up, np.cos(tilt) * ahead - np.sin(tilt) * up
        f = mass * g * np.cos(tilt)
        slide = g * (np.sin(tilt) - mu * np.cos(tilt)) * downhill
        inputs = {"q": np.array([0.1, -0.2, 0.3]), "v": 0.5 * downhill, "torque": -mu * f * downhill, "normal": normal}
        name = f"force and slide at {slope['tilt']:g}°, heading {slope['heading']:g}°, μ = {mu:g}"
        expected = np.concatenate([[f], slide])
        cases.append(Case(name, "contact", inputs, expected, np.array(CONTACT), CONTACT_WHY))
    return ReferenceProblem("inclined plane", data["source"], model, "tip", tuple(cases))


def _bouncing(ball: Mapping[str, Any], source: str, g: float) -> ReferenceProblem:
    """Return a ball that drops on the plane z = 0 and bounces."""
    moment = 0.4 * ball["mass"] * ball["radius"] ** 2
    parts = [
        link("base"),
        link("ball", ball["mass"], (0.0, 0.0, 0.0), (moment, moment, moment)),
        joint("height", "prismatic", "base", "ball"),
    ]
    model = robot("bouncing_ball", parts, ["height"], "ball", gravity=(0.0, 0.0, -g))
    e, count = ball["restitution"], ball["impacts"]
    first = np.sqrt(2.0 * ball["height"] / g)
    gaps = 2.0 * first * e ** np.arange(1, count)
    inputs = {
        "q": np.array([ball["height"]]),
        "v": np.zeros(1),
        "normal": np.array([0.0, 0.0, 1.0]),
        "restitution": np.array(e),
        "count": np.array(count),
    }
    expected = first + np.concatenate([[0.0], np.cumsum(gaps)])
    case = Case("times of impact", "impact_times", inputs, expected, np.array(IMPACT), IMPACT_WHY)
    return ReferenceProblem(f"bouncing ball, {ball['name']}", source, model, "ball", (case,))
