"""Pendulums whose motion is known in closed form: IFToMM's simple one and a uniform rod."""

import numpy as np

from validation.anchors.description import Robot, joint, link, read, robot
from validation.anchors.problem import Case, ReferenceProblem

TIP = "tip"

POSITION = 2e-10
POSITION_WHY = (
    "DOP853 at 1e-12 a step over some 150 steps, all errors taken to add up; the benchmark itself accepts 1e-3"
)
PERIOD = 1e-10
PERIOD_WHY = (
    "DOP853 at 1e-12 a step over some 50 steps, and its interpolation of order 7, in which the crossing is found"
)


def problems() -> tuple[ReferenceProblem, ...]:
    """Return the simple and the physical pendulum."""
    return _simple(), _physical()


def _simple() -> ReferenceProblem:
    """Return IFToMM A01; q = 0 hangs down, −π/2 is the release at x = −L, here x to the right and z up."""
    data = read("iftomm_pendulum")
    L, m = data["length"], data["mass"]
    # A point has no inertia tensor, which some engines refuse. A body of twice the mass at half the length with
    # the moment m L²/2 has the same m c and the same m L² about the pivot, hence the same motion.
    moment = m * L**2 / 2.0
    model = _swinging("iftomm_pendulum", 2.0 * m, L / 2.0, (moment, moment, moment), L, data["gravity"])
    start = {"q": np.array([-np.pi / 2]), "v": np.zeros(1)}
    rows = np.array(data["positions"])
    positions = np.stack([rows[:, 1], np.zeros(len(rows)), rows[:, 2]], axis=1)
    # The printed digits of the closed form carry 1e-15, far below the integration.
    cases = (
        Case(
            "positions over 10 s",
            "free_positions",
            {**start, "times": rows[:, 0]},
            positions,
            np.array(POSITION),
            POSITION_WHY,
        ),
        Case("period", "swing_period", start, np.array(data["period"]), np.array(PERIOD), PERIOD_WHY),
    )
    return ReferenceProblem("IFToMM A01 pendulum", data["source"], model, TIP, cases)


def _physical() -> ReferenceProblem:
    from scipy.special import ellipk

    data = read("physical_pendulum")
    L, m, r, g = data["length"], data["mass"], data["radius"], data["gravity"]
    thin = m * L**2 / 12.0
    model = _swinging("physical_pendulum", m, L / 2.0, (thin, thin, m * r**2 / 2.0), L, g)
    small = 4.0 * np.sqrt(m * L**2 / 3.0 / (m * g * L / 2.0))
    cases = tuple(
        Case(
            f"period at amplitude {amplitude} rad",
            "swing_period",
            {"q": np.array([amplitude]), "v": np.zeros(1)},
            np.asarray(small * ellipk(np.sin(amplitude / 2.0) ** 2)),
            np.array(PERIOD),
            PERIOD_WHY,
        )
        for amplitude in data["amplitudes"]
    )
    return ReferenceProblem("physical pendulum", data["source"], model, TIP, cases)


def _swinging(
    name: str, mass: float, centre: float, moments: tuple[float, float, float], length: float, g: float
) -> Robot:
    """Write a body that hangs along −z and turns about −y, so that positive q moves its tip towards +x."""
    parts = [
        link("base"),
        link("body", mass, (0.0, 0.0, -centre), moments),
        joint("pivot", "revolute", "base", "body", axis=(0.0, -1.0, 0.0)),
        link(TIP),
        joint("to_tip", "fixed", "body", TIP, xyz=(0.0, 0.0, -length)),
    ]
    return robot(name, parts, ["pivot"], TIP, gravity=(0.0, 0.0, -g))
