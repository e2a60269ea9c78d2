"""Short chains and a tree of the Rigid Body Dynamics Library (RBDL), with the accelerations that its tests expect.

All bodies weigh 1 kg, gravity is along −y, and everything falls from rest. The values for the model of three joints
were computed with Featherstone's spatial_v1, RBDL's tests say.

Painlevé's rod: the geometry at which a sliding contact stops answering a normal force.

A point mass on slides: on an inclined plane, and bouncing.

Pendulums whose motion is known in closed form: IFToMM's simple one and a uniform rod.

The textbook arm of two links: every term in closed form, at rest, in motion, and pressing on a surface.
"""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

import robot_models
from robot_models.planar2 import closed_form
from validation.anchors.problem import Case, ReferenceProblem, Robot, joint, link, read, robot
from validation.oracle.spatial import Array

CHAIN = 1e-13
CHAIN_WHY = (
    "RBDL's own bound for these values, 1e-13 absolute and relative; they are printed to 15 digits and H is well "
    "conditioned (below 60)"
)
AXIS = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


def chains() -> tuple[ReferenceProblem, ...]:
    """Return one problem for each of the chains."""
    data = read("rbdl_chains")
    return tuple(_problem(chain, data["source"], data["gravity"]) for chain in data["chains"])


def _problem(chain: Mapping[str, Any], source: str, gravity: list[float]) -> ReferenceProblem:
    parts, names = [link("base")], []
    for i, body in enumerate(chain["bodies"]):
        before = "base" if body["parent"] == 0 else f"body{body['parent']}"
        names.append(f"joint{i + 1}")
        parts += [
            link(f"body{i + 1}", body["mass"], body["com"], body["I_com"]),
            joint(names[-1], "revolute", before, f"body{i + 1}", xyz=body["at"], axis=AXIS[body["axis"]]),
        ]
    n, tip = len(names), f"body{len(names)}"
    expected = np.array(chain["acceleration"], dtype=float)
    inputs = {"q": chain["q"], "v": np.zeros(n), "torque": np.zeros(n)}
    tolerance = CHAIN * (1.0 + np.abs(expected))
    case = Case("acceleration from rest", "forward_dynamics", inputs, expected, tolerance, CHAIN_WHY)
    model = robot(chain["name"].replace(" ", "_"), parts, names, tip, gravity=gravity)
    return ReferenceProblem(f"RBDL, {chain['name']}", source, model, tip, (case,))


END = "end"
ROD = 1e-13
ROD_WHY = "one 3 × 3 solve with a condition number of 12 on numbers below 10: some 100 ε"


def rod() -> tuple[ReferenceProblem, ...]:
    """Return the rod in the vertical plane, its lower end in contact."""
    data = read("painleve_rod")
    m, half, r = data["mass"], data["half_length"], data["radius"]
    thin = m * half**2 / 3.0
    parts = [
        link("base"), link("slide"), link("hoist"), link("rod", m, (0.0, 0.0, 0.0), (m * r**2 / 2.0, thin, thin)),
        link(END), joint("x", "prismatic", "base", "slide", axis=(1.0, 0.0, 0.0)),
        joint("z", "prismatic", "slide", "hoist"), joint("theta", "revolute", "hoist", "rod", axis=(0.0, -1.0, 0.0)),
        joint("to_end", "fixed", "rod", END, xyz=(-half, 0.0, 0.0)),
    ]  # fmt: skip
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
        cases.append(Case(name, "sliding_mobility", inputs, expected, np.array(ROD), ROD_WHY))
    model = robot("painleve_rod", parts, ["x", "z", "theta"], END)
    return (ReferenceProblem("Painlevé rod", data["source"], model, END, tuple(cases)),)


SLIDE = 1e-13
SLIDE_WHY = "H is m times the identity: a handful of operations on numbers below 20, a rounding of 5 ε each"
IMPACT = 1e-12
IMPACT_WHY = (
    "free fall is a parabola, exact for DOP853 up to rounding of its few dozen steps; each crossing is found to 4 ε"
)


def point_mass() -> tuple[ReferenceProblem, ...]:
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
        cases.append(Case(name, "contact", inputs, expected, np.array(SLIDE), SLIDE_WHY))
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
        "q": np.array([ball["height"]]), "v": np.zeros(1), "normal": np.array([0.0, 0.0, 1.0]),
        "restitution": np.array(e), "count": np.array(count),
    }  # fmt: skip
    expected = first + np.concatenate([[0.0], np.cumsum(gaps)])
    case = Case("times of impact", "impact_times", inputs, expected, np.array(IMPACT), IMPACT_WHY)
    return ReferenceProblem(f"bouncing ball, {ball['name']}", source, model, "ball", (case,))


TIP = "tip"

POSITION = 2e-10
POSITION_WHY = (
    "DOP853 at 1e-12 a step over some 150 steps, all errors taken to add up; the benchmark itself accepts 1e-3"
)
PERIOD = 1e-10
PERIOD_WHY = (
    "DOP853 at 1e-12 a step over some 50 steps, and its interpolation of order 7, in which the crossing is found"
)


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


TERMS = 1e-13
TERMS_WHY = "sums of a few products no larger than 100 in their unit, which round to 5 ε each"
CONTACT = 1e-12
CONTACT_WHY = (
    "rounding of 1e-14 in H and C, times the condition number of Eq. 24, below 30 at these poses, on |q̈| and f up to 10"
)


def planar_arm() -> tuple[ReferenceProblem, ...]:
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
        f"pressing torque, {where}", "pressing_torque", {"q": q, "force": -force * normal}, pressing, np.array(TERMS),
        TERMS_WHY,
    )  # fmt: skip
    A = normal @ known.jacobian
    a = -A * (normal @ known.drift) / (A @ A)
    torque = known.mass_matrix @ a + known.bias - A * force
    for name, rates, Q, motion in (("at rest", np.zeros(2), pressing, np.zeros(2)), ("in motion", v, torque, a)):
        inputs = {"q": q, "v": rates, "torque": Q, "normal": normal}
        expected = np.concatenate([[force], motion])
        if name == "in motion" and not np.any(v):
            continue
        yield Case(f"contact force {name}, {where}", "contact", inputs, expected, np.array(CONTACT), CONTACT_WHY)


def problems() -> tuple[ReferenceProblem, ...]:
    """Return the problems of this file."""
    return (*chains(), _simple(), _physical(), *planar_arm(), *point_mass(), *rod())
