"""Stability of a law's feedback with the integrator's step: its damping and stiffness against the arm's inertia.

With the model fed forward, as the laws do, feedback gives ẍ = −K x − D ẋ, in the joints with K = H⁻¹K_p and
D = H⁻¹K_d. One explicit step multiplies the rate by 1 − D h, which grows where the largest eigenvalue of D h exceeds 2;
a torque that is held between samples is such a step with any integrator. A spring adds K h². So gains are judged by the
spectral radius of the step's linear map, at the start posture, in every direction in which the arm can move.

A tip in bilateral contact cannot move along the normal, so that direction is projected out of H⁻¹; with a unilateral
contact the free arm is judged. Contact, friction and other postures change the limit, so the result is a warning and no
refusal.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError
from closedloop.control.laws.hybrid import HybridLaw
from closedloop.control.laws.impedance import ImpedanceLaw
from closedloop.control.tip_space import Posture, TipMotion
from closedloop.control.transmission import transmission_constants
from closedloop.jit.parameters import per_joint
from closedloop.mechanics.closure.baumgarte import linear_step
from closedloop.mechanics.integrators import ADAPTIVE, INTEGRATORS
from closedloop.mechanics.loops.reactions import loop_rows
from closedloop.mechanics.robot.pinocchio import Robot
from closedloop.mechanics.surface.placed import PlacedSurface
from closedloop.scenario.arm import start_posture
from closedloop.scenario.scenario import Scenario

# Without a spring there is a double eigenvalue one, which rounding of 1e-16 splits by its square root, 1e-8.
GROWING = 1.0 + 1e-6
# Share of the largest mobility of loop rows below which one is that of a row that depends on others.
REDUNDANT = 1e-12


class Feedback(NamedTuple):
    """Linear feedback of a part of a law: ẍ = −stiffness x − damping ẋ, (m, m), 1/s² and 1/s, and its keys."""

    spring: str
    damper: str
    stiffness: Array
    damping: Array


def growth(feedback: Feedback, integrator: str, h: float, hold: int = 0) -> float:
    """Return the spectral radius of one step, or of one held sample: stable up to 1.

    Parameters
    ----------
    feedback : Feedback
    integrator : str
        See `closedloop.mechanics.integrators`; an adaptive one is stable with any gains but those of a held torque.
    h : float
        Step, s.
    hold : int
        Steps for which a sampled torque is held; 0: the law is evaluated at every stage.
    """
    K, D = h * h * feedback.stiffness, h * feedback.damping
    m, eye = K.shape[0], np.eye(K.shape[0])
    if hold == 0:
        if integrator in ADAPTIVE:
            return 1.0
        step = linear_step(INTEGRATORS[integrator], np.block([[np.zeros((m, m)), eye], [-K, -D]]))
    else:
        # Under a constant acceleration the schemes differ in which rate the position advances with.
        early = _early(integrator)
        pushed = np.vstack([hold * (0.5 * hold + early) * eye, hold * eye]) @ np.hstack([-K, -D])
        step = np.block([[eye, hold * eye], [np.zeros((m, m)), eye]]) + pushed
    if not np.all(np.isfinite(step)):
        return np.inf
    return float(np.max(np.abs(np.linalg.eigvals(step))))


def _early(integrator: str) -> float:
    """Return a scheme's position error after one step h from rest at an acceleration a, in units of a h²."""
    scheme = INTEGRATORS.get(integrator)
    if scheme is None:  # it chooses its steps
        return 0.0
    return 0.5 if scheme.semi_implicit else float(np.dot(scheme.b, scheme.nodes)) - 0.5


def gains_fault(scenario: Scenario, robot: Robot) -> str:
    """Return a line about gains of the scenario's law that are unstable with its step, or an empty string.

    Parameters
    ----------
    scenario : Scenario
        One that can be prepared.
    robot : Robot
        Its robot with its tip.
    """
    h, period = scenario.time.step, scenario.law.sample_period
    hold = round(period / h) if period else int(scenario.reads_encoders)
    start = getattr(scenario.law, "pd_start", None)
    if start is not None and start >= scenario.time.duration:
        return ""
    with np.errstate(over="ignore", invalid="ignore"):  # what is not finite is judged
        for feedback in feedbacks(scenario, robot):
            fault = _fault(feedback, scenario, robot, hold)
            if fault:
                return fault
    return ""


def _fault(feedback: Feedback, scenario: Scenario, robot: Robot, hold: int) -> str:
    """Return what is wrong with a feedback that is unstable with the step, and a stable step, or an empty string."""
    name, span = scenario.time.integrator, scenario.time.step * max(hold, 1)
    if not all(np.all(np.isfinite(matrix)) for matrix in feedback[2:]):
        return f"{feedback.spring} or {feedback.damper} is too large for any step"
    # A negative gain drives the arm away at any step: that is the law's, not the step's.
    drives = any(np.min(np.linalg.eigvals(matrix).real) < -1e-9 * np.linalg.norm(matrix) for matrix in feedback[2:])
    if drives or growth(feedback, name, scenario.time.step, hold) <= GROWING:
        return ""
    share = _largest_share(feedback, name, scenario.time.step, hold)
    step = "law.sample_period" if hold else "time.step"
    what = "a held torque" if hold else f"a step of {name}"
    cure = "lower it" + (f", or take {step} below {_down(share * span)} s" if share > 1e-6 else "")
    undamped = feedback._replace(stiffness=np.zeros_like(feedback.stiffness))
    if growth(undamped, name, scenario.time.step, hold) > GROWING:
        rates, shapes = np.linalg.eig(feedback.damping)
        fastest = int(np.argmax(rates.real))
        damping = float(rates[fastest].real) * span
        return (
            f"{_named(feedback.damper, shapes[:, fastest], scenario, robot)} times {step} is {damping:.3g}"
            f"{_of_inertia(feedback.damper)}, where {damping * share:.3g} is the most that {what} can damp: {cure}"
        )
    stiffest = float(np.max(np.linalg.eigvals(feedback.stiffness).real)) * span * span
    return (
        f"{feedback.spring} times the square of {step} is {stiffest:.3g}{_of_inertia(feedback.spring)}, more than "
        f"{what} can carry with this {feedback.damper}: {cure}"
    )


def check_transmission(scenario: Scenario, robot: Robot, q: Array) -> None:
    """Refuse elastic joints that swing too fast for the step, at the posture q (n,): motors and links on their springs.

    δ̈ = −(H⁻¹ + B⁻¹)(K δ + D δ̇), δ = θ − q. Contact holds the tip, and with it the links: it makes nothing swing faster.
    """
    stiffness, damping, inertia, _, _ = transmission_constants(scenario.transmission, robot.model)
    try:
        mobility = closed_mobility(robot, q, np.linalg.inv(robot.terms(q, np.zeros(robot.n)).mass_matrix))
        mobility += np.diag(np.divide(1.0, inertia, out=np.zeros(robot.n), where=inertia > 0.0))
    except np.linalg.LinAlgError:  # some link moves no inertia: the run says so
        return
    swing = Feedback("transmission.stiffness", "transmission.damping", mobility * stiffness, mobility * damping)
    name, h = scenario.time.integrator, scenario.time.step
    if growth(swing, name, h) <= GROWING:
        return
    share = _largest_share(swing, name, h, 0)
    squares, shapes = np.linalg.eig(swing.stiffness)
    fastest = int(np.argmax(squares.real))
    rate, joint = np.sqrt(squares[fastest].real), robot.model.joint_names[int(np.argmax(np.abs(shapes[:, fastest])))]
    cure = f"the step may be at most {_down(share * h)} s" if share > 1e-6 else "at any step"
    undamped = swing._replace(damping=np.zeros_like(swing.damping))
    if growth(undamped, name, h) <= GROWING:
        rate = float(np.max(np.linalg.eigvals(swing.damping).real))
        raise ScenarioError(
            f"transmission.damping: {name} is unstable with time.step = {h:g} s on joints whose damping acts at "
            f"{rate:.4g} 1/s: {cure}; or take less damping or another integrator"
        )
    raise ScenarioError(
        f"transmission.stiffness: {name} is unstable with time.step = {h:g} s on joints that swing at {rate:.4g} rad/s "
        f"against their motors, {joint} most: {cure}; or take softer joints, more damping or another integrator"
    )


def _of_inertia(key: str) -> str:
    """Return the words for the inertia that a gain acts on; none if the gain is an acceleration already."""
    accelerations = ("law.motion_", "law.posture_", "law.approach_")
    return "" if key.startswith(accelerations) else " times the inertia that it acts on"


def _largest_share(feedback: Feedback, integrator: str, h: float, hold: int) -> float:
    """Return the largest share of the step that is stable, by bisection; 0 if none is."""
    low, high = 0.0, 1.0
    for _ in range(40):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if growth(feedback, integrator, middle * h, hold) <= GROWING else (low, middle)
    return low


def _down(x: float) -> str:
    """Return x to two digits, rounded down."""
    unit = 10.0 ** (np.floor(np.log10(x)) - 1)
    return f"{np.floor(x / unit) * unit:.2g}"


def _named(key: str, shape: Array, scenario: Scenario, robot: Robot) -> str:
    """Return a key of the law, of a gain on joints that of the joint that it damps most in a motion of this shape."""
    if key != "law.kd":
        return key
    gains = per_joint(key, scenario.law.kd, robot.n)  # type: ignore[attr-defined]
    joint = int(np.argmax(gains * np.abs(shape) ** 2))
    return f"law.kd[{joint}] (joint {robot.joint_names[joint]})"


class Sliding(NamedTuple):
    """A tip that slips: posture (n,), unit normal and what the surface pushes with, 1 N along it, base axes (3,)."""

    q: Array
    normal: Array
    push: Array


def without_normal(mobility: Array, normal: Array, push: Array) -> Array:
    """Return what a contact that pushes leaves of H⁻¹ (n, n), where the tip cannot move along the normal.

    A push (n,) along the joints has friction in it, as the normal (n,) has not: a torque that presses also brakes.
    """
    along = float(normal @ mobility @ push)
    return mobility - np.outer(mobility @ push, normal @ mobility) / along if along > 0.0 else mobility


def feedbacks(scenario: Scenario, robot: Robot, sliding: Sliding | None = None) -> list[Feedback]:
    """Return the feedback of the scenario's law, in decoupled parts, at the start posture or where the tip slips."""
    law, n = scenario.law, robot.n
    q = start_posture(scenario, robot.model) if sliding is None else sliding.q
    terms = robot.terms(q, np.zeros(n))
    surface = PlacedSurface.of(scenario.surface, scenario.surface_motion, terms.position, radius=scenario.tool.radius)
    A = surface.touching(terms.position).frame @ terms.jacobian
    held = scenario.surface.contact == "bilateral" or sliding is not None
    push = A[0] if sliding is None else sliding.push @ terms.jacobian
    try:
        motors = np.diag(transmission_constants(scenario.transmission, robot.model)[2])  # zero: they are in H
        mobility = closed_mobility(robot, q, np.linalg.inv(terms.mass_matrix + motors))
    except np.linalg.LinAlgError:  # some joint moves no inertia: the run says so
        return []
    S = A @ mobility @ A.T
    if held and S[0, 0] > 0.0:
        mobility = without_normal(mobility, A[0], push)
        S -= np.outer(S[:, 0], S[0]) / S[0, 0]
    parts: list[Feedback] = []
    if law.kind in ("paper", "hybrid"):
        kp, kd = (mobility * per_joint(f"law.{name}", getattr(law, name), n) for name in ("kp", "kd"))
        acts = np.eye(n)
        if isinstance(law, HybridLaw):  # T⁺T + N of `closedloop.control.laws.hybrid`
            acts += np.linalg.pinv(A[1:]) @ A[1:] - np.linalg.pinv(A) @ A
        parts.append(Feedback("law.kp", "law.kd", kp @ acts, kd @ acts))
    if isinstance(law, HybridLaw) and not held:
        parts.append(_scalar("law.approach_damping", 0.0, "law.approach_damping", law.approach_damping))
    if isinstance(law, TipMotion):
        parts.append(_scalar("law.motion_stiffness", law.motion_stiffness, "law.motion_damping", law.motion_damping))
    if isinstance(law, ImpedanceLaw):
        along = S[1:, 1:]
        parts.append(Feedback("law.stiffness", "law.damping", law.stiffness * along, law.damping * along))
        if not held:
            parts.append(
                _scalar("law.normal_stiffness", law.normal_stiffness * S[0, 0],
                        "law.normal_damping", law.normal_damping * S[0, 0])
            )  # fmt: skip
    if isinstance(law, Posture) and n > np.linalg.matrix_rank(A):
        names = ("law.posture_stiffness", "law.posture_damping")
        pull, damping = (per_joint(name, getattr(law, name.removeprefix("law.")), n) for name in names)
        parts.append(Feedback(*names, np.diag(pull), np.diag(damping)))
    return parts


def closed_mobility(robot: Robot, q: Array, mobility: NDArray[Any]) -> Array:
    """Return what a robot's loops leave of H⁻¹ (n, n) at q (n,)."""
    if not robot.model.loops:
        return mobility
    G = loop_rows(robot, q[None], np.zeros((1, robot.n)))[0][0]
    return held_at(G, mobility)


def held_at(G: Array, mobility: Array) -> Array:
    """Return what is left of a mobility (n, n) where G q̈ = 0, of rows (m, n) that may depend on each other."""
    return mobility - mobility @ G.T @ np.linalg.pinv(G @ mobility @ G.T, rcond=REDUNDANT) @ G @ mobility


def _scalar(spring: str, stiffness: float, damper: str, damping: float) -> Feedback:
    return Feedback(spring, damper, np.array([[stiffness]]), np.array([[damping]]))
