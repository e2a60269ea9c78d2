"""Whether the step resolves what is fast, in the arm and in contacts of its links.

Bristles and viscous friction of all contacts of links make bodies swing together. Of contacts that press with f the
tangents J_t, of each, give ẍ = −H⁻¹ Σ J_tᵀ (k f J_t x + d J_t ẋ), in the joints and the bodies, with what the rigid
ones among them hold along their normals taken out of H⁻¹.

It is about accuracy, not stability alone. A step that is stable may damp a swing that the arm does not damp, or feed
one that it does: Runge-Kutta's fourth order scheme takes away 23 % of the rate at hω = 2.3. So what a step makes of a
motion, its eigenvalue μ, is compared with e^hλ.

With the semi-implicit scheme bristles follow the slip at the step's beginning, so that on them it is the explicit one.
Of the other fast parts the stabiliser is no motion of the arm, and what is unstable is refused, as are a sensor's
filter and delay that its samples do not resolve (`closedloop.control.sensor`, `closedloop.control.stability`).
"""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from closedloop.base.arrays import Array
from closedloop.control.transmission import transmission_constants
from closedloop.mechanics.closure.baumgarte import linear_step
from closedloop.mechanics.closure.contact_force import PRESSED
from closedloop.mechanics.contacts.sections import ContactSection
from closedloop.mechanics.friction.bristle import bristle
from closedloop.mechanics.friction.law import JointFriction, joint_parameters, surface_parameters
from closedloop.mechanics.integrators import INTEGRATORS
from closedloop.mechanics.robot.pinocchio import Robot
from closedloop.scenario.arm import joint_friction_of
from closedloop.scenario.gains import Sliding, closed_mobility, feedbacks, held_at, without_normal
from closedloop.scenario.scenario import Scenario
from closedloop.scenario.tables import patches_of
from robot_models.loop_joint import WORLD


class Pressed(NamedTuple):
    """Where contacts of links press: q (n,), and the normal force of each there, N."""

    q: Array
    load: Array


def where_they_press(q: Array, forces: Array) -> Pressed | None:
    """Return the row of q (N, n) in which contacts press as they mostly do, of forces (N, k), N; None if never."""
    pressed = forces > 0.0
    if not np.any(pressed):
        return None
    load = np.array([np.median(f[on]) if np.any(on) else 0.0 for f, on in zip(forces.T, pressed.T, strict=True)])
    return Pressed(q[int(np.argmax(pressed.sum(axis=1)))], load)


def has_motion(section: ContactSection) -> bool:
    """Whether the friction of a contact has bristles, or a viscous part."""
    law = section.friction_law
    return any(hasattr(law, name) for name in ("stiffness", "viscous")) and not isinstance(section.at, str)


def motion_of_contacts(
    sections: tuple[ContactSection, ...], robot: Robot, pressed: Pressed
) -> tuple[str, NDArray[Any], NDArray[Any]] | None:
    """Return the key of what acts most, and stiffness and damping (n, n), 1/s² and 1/s; None where nothing does."""
    n, names = robot.n, {k: name for name, numbers in patches_of(sections).items() for k in numbers}
    terms = robot.terms(np.array(pressed.q), np.zeros(n))
    mobility = closed_mobility(robot, pressed.q, np.linalg.inv(terms.mass_matrix))
    rows = {k: _rows(section, robot, pressed.q) for k, section in enumerate(sections) if pressed.load[k] > 0.0}
    held = [rows[k][:1] for k in rows if sections[k].compliance is None and sections[k].surface is None]
    if held:
        mobility = held_at(np.vstack(held), mobility)
    K, D, most, key = np.zeros((n, n)), np.zeros((n, n)), 0.0, ""
    for k, along in rows.items():
        law = sections[k].friction_law
        if law is None or not has_motion(sections[k]):
            continue
        stiffness, damping = bristle(law, surface_parameters(law), float(pressed.load[k]))
        tangents = along[1:]
        K, D = K + stiffness * tangents.T @ tangents, D + damping * tangents.T @ tangents
        fast = float(np.linalg.norm(tangents @ mobility @ tangents.T, 2))
        rates = {"stiffness": (stiffness * fast) ** 0.5, "damping": damping * fast}
        which = max(rates, key=lambda name: rates[name])
        if rates[which] > most:
            most = rates[which]
            which = "viscous" if which == "damping" and not hasattr(law, "damping") else which
            key = f"contact.{names[k]}.friction_law.{which}"
    return (key, mobility @ K, mobility @ D) if most > 0.0 else None


def _rows(section: ContactSection, robot: Robot, q: Array) -> Array:
    """Return what the joints move a contact's point by, along its normal and two tangents, (3, n)."""
    at = section.at if not isinstance(section.at, str) else (0.0, 0.0, 0.0)
    _, axes, origin = robot.frame_at(section.link, q)
    point = origin + axes @ np.array(at)
    moves = _moves(section.link, robot, q, point) - _moves(section.against, robot, q, point)
    normal = robot.frame_at(section.against, q)[1] @ np.array(section.normal)
    return np.linalg.svd(normal[None])[2] @ moves


def _moves(frame: str, robot: Robot, q: Array, point: Array) -> Array:
    """Return the Jacobian (3, n) of a point, base axes, that a frame carries."""
    if frame == WORLD:
        return np.zeros((3, robot.n))
    carrier = Robot(robot.model, frame)
    jacobian, lever = carrier.frame_jacobian(q), point - carrier.terms(q, np.zeros(robot.n)).position
    return jacobian[:3] - np.cross(lever, jacobian[3:], axis=0)


# A swing whose rate of decay or frequency is off by a tenth of |λ| is another swing: its damping ratio is off by 0.1.
WRONG_BY = 0.1
# What dies out without a swing counts where it is off by half of itself in a step: with Euler's schemes it alternates
# then. A swing of a law's feedback counts where it is off by this much in a step too: near critical damping frequencies
# are off by much of themselves, and it is nothing.
WRONG_DECAY, WRONG_FEEDBACK = 0.5, 0.05
# |hλ| of what a closure or a loop holds: zero to the root of rounding, since such eigenvalues are double ones.
STILL = 1e-5


class Mode(NamedTuple):
    """What moves by itself: ẍ = −stiffness x − damping ẋ, (m, m), 1/s² and 1/s, its key, and the scheme it meets."""

    key: str
    stiffness: Array
    damping: Array
    integrator: str


def wrong_by(integrator: str, h: float, stiffness: Array, damping: Array, least: float = 0.0) -> tuple[float, float]:
    """Return |ln μ − hλ|/|hλ| of the swing ẍ = −stiffness x − damping ẋ that a step h, s, gets most wrong, and its |λ|.

    Only swings count that are off by `least` in a step, not what dies out without one.
    """
    worst, rate = 0.0, 0.0
    for z, made in _rates(integrator, h, stiffness, damping):
        if z.imag <= 1e-3 * abs(z) or abs(made - np.exp(z)) < least:
            continue
        off = abs(np.log(made) - z) / abs(z) if made != 0.0 else np.inf
        if off > worst:
            worst, rate = float(off), abs(z) / h
    return worst, rate


def wrong_decay(integrator: str, h: float, stiffness: Array, damping: Array) -> tuple[float, float]:
    """Return |μ − e^hλ| of the decay of ẍ = −stiffness x − damping ẋ that a step h, s, gets most wrong, and its |λ|."""
    decays = [
        (float(abs(made - np.exp(z))), abs(z) / h)
        for z, made in _rates(integrator, h, stiffness, damping)
        if abs(z.imag) <= 1e-3 * abs(z) and z.real < 0.0
    ]
    return max(decays, default=(0.0, 0.0))


def _rates(integrator: str, h: float, stiffness: Array, damping: Array) -> list[tuple[complex, complex]]:
    """Return each hλ that is not zero to rounding, and what a step makes of e^hλ.

    Of a Runge-Kutta scheme it is a polynomial of hλ; of the semi-implicit one, the nearest that is left over.
    """
    m, scheme = stiffness.shape[0], INTEGRATORS[integrator]
    A = np.block([[np.zeros((m, m)), np.eye(m)], [-h * h * stiffness, -h * damping]])
    z = _eigenvalues(A)
    if not scheme.semi_implicit:
        return [(complex(a), complex(linear_step(scheme, np.array([[a]]))[0, 0])) for a in z if abs(a) > STILL]
    made = _eigenvalues(linear_step(scheme, A))
    apart = np.abs(np.exp(z)[:, None] - made[None])
    pairs = []
    for _ in range(z.size):
        i, k = np.unravel_index(int(np.argmin(apart)), apart.shape)
        apart[i], apart[:, k] = np.inf, np.inf
        if abs(z[i]) > STILL:
            pairs.append((complex(z[i]), complex(made[k])))
    return pairs


def _eigenvalues(matrix: Array) -> NDArray[np.complex128]:
    """Return the eigenvalues of a matrix, infinite where its numbers are too large for them to be found."""
    try:
        found: NDArray[np.complex128] = np.linalg.eigvals(matrix).astype(complex)
    except np.linalg.LinAlgError:
        found = np.full(matrix.shape[0], complex(np.inf))
    return found


def where_it_slides(q: Array, normal: Array, force: Array, friction: Array, mode: NDArray[Any]) -> Sliding | None:
    """Return where a tip slips with the most friction for its normal force, of rows (N, ...); None if it never does."""
    slips = (mode == PRESSED) & (force != 0.0)
    level = np.linalg.norm(friction, axis=1) / np.where(slips, np.abs(force), np.inf)
    k = int(np.argmax(level)) if level.size else 0
    if not level.size or not level[k] > 0.0:
        return None
    return Sliding(q[k], normal[k], normal[k] + friction[k] / force[k])


def unresolved(
    scenario: Scenario, robot: Robot, q: Array, normal: Array, depth: float,
    sliding: Callable[[], Sliding | None] = lambda: None, own_law: bool = False,
    pressed: Callable[[], Pressed | None] = lambda: None,
) -> list[str]:  # fmt: skip
    """Return a line for each fast part that the step does not resolve, with a step that would; not of the law alone.

    Parameters
    ----------
    scenario, robot
        What is run, and its robot with its tip.
    q : (n,) array
        A posture.
    normal : (3,) array
        The unit normal of the surface there, base axes.
    depth : float
        How deep the tip is in the surface there, m.
    sliding : callable
        Returns where the tip slips with the most friction; called only if there is viscous friction in joints.
    own_law : bool
        Whether the law is a user's, of whose feedback nothing is known.
    pressed : callable
        Returns where contacts of links press; called only if there are bristles or viscous friction in one.
    """
    soft, elastic = scenario.compliance.kind != "none", scenario.transmission.elastic
    in_joints = joint_friction_of(scenario, robot.model)
    slips = any(hasattr(law, name) for law in (scenario.friction, in_joints) for name in ("stiffness", "viscous"))
    lines = _of_contacts(scenario, robot, pressed)
    if scenario.time.integrator not in INTEGRATORS or not (soft or elastic or slips):
        return lines
    slip = sliding() if hasattr(in_joints, "viscous") else None
    for mode in _modes(scenario, in_joints, robot, q, normal, depth, slip):
        if np.all(np.isfinite(mode.stiffness)) and (np.any(mode.stiffness) or np.any(mode.damping)):
            law_too = mode.key == "joint_friction.viscous" and not own_law
            said = _with_feedback(mode, scenario, robot, slip) if law_too else []
            lines += said or _line(mode, scenario, decays="friction." in mode.key)
    return lines


def _of_contacts(scenario: Scenario, robot: Robot, pressed: Callable[[], Pressed | None]) -> list[str]:
    """Return a line, in a list, where the step does not resolve the friction of contacts of links."""
    sections, name = scenario.contact or (), scenario.time.integrator
    where = pressed() if name in INTEGRATORS and any(map(has_motion, sections)) else None
    found = None if where is None else motion_of_contacts(sections, robot, where)
    if found is None or not all(np.all(np.isfinite(matrix)) for matrix in found[1:]):
        return []
    key, stiffness, damping = found
    scheme = "explicit_euler" if INTEGRATORS[name].semi_implicit else name
    return _line(Mode(key, stiffness, damping, scheme), scenario, decays=True)


def unresolved_feedback(scenario: Scenario, robot: Robot) -> list[str]:
    """Return a line for each part of a law's feedback that the step does not resolve, with a step that would.

    A torque that is held is a controller's own, and is resolved.
    """
    lines = []
    for mode in _of_feedback(scenario, robot):
        lines += _line(mode, scenario, decays=True, least=WRONG_FEEDBACK)
    return lines


def feedback_key(scenario: Scenario) -> Hashable:
    """Return what `unresolved_feedback` depends on beside the robot: many runs of a batch have it in common."""
    sections = (
        scenario.start, scenario.surface, scenario.surface_motion, scenario.tool, scenario.transmission,
        scenario.encoder, scenario.time,
    )  # fmt: skip
    return (
        type(scenario.law), scenario.law.model_dump_json(exclude={"force"}), getattr(scenario.reference, "start", None),
        *(section.model_dump_json() for section in sections),
    )  # fmt: skip


def _of_feedback(scenario: Scenario, robot: Robot, sliding: Sliding | None = None) -> list[Mode]:
    """Return what a law's feedback makes the arm do, where it acts at every stage of the scheme."""
    name, start = scenario.time.integrator, getattr(scenario.law, "pd_start", 0.0)
    if name not in INTEGRATORS or scenario.law.sample_period or scenario.reads_encoders:
        return []
    if start is None:
        start = getattr(scenario.reference, "start", 0.0)  # as `closedloop.simulation.prepare` has it
    if start >= scenario.time.duration:
        return []
    return [
        Mode(f"{feedback.spring}, {feedback.damper}", feedback.stiffness, feedback.damping, name)
        for feedback in feedbacks(scenario, robot, sliding)
        if all(np.all(np.isfinite(matrix)) for matrix in feedback[2:])
    ]


def _with_feedback(slipping: Mode, scenario: Scenario, robot: Robot, sliding: Sliding | None) -> list[str]:
    """Return a line, in a list, where friction and a law damp joints too fast for the step, and the law alone not."""
    for mode in _of_feedback(scenario, robot, sliding):
        acts = mode.key == "law.kp, law.kd" and np.any(mode.damping)
        if acts and not _line(mode, scenario, decays=True, least=WRONG_FEEDBACK):
            both = Mode(f"{slipping.key}, {mode.key}", mode.stiffness, mode.damping + slipping.damping, mode.integrator)
            return _line(both, scenario, decays=True, least=WRONG_FEEDBACK)
    return []


def _modes(
    scenario: Scenario, in_joints: JointFriction, robot: Robot, q: Array, normal: Array, depth: float,
    sliding: Sliding | None,
) -> list[Mode]:  # fmt: skip
    """Return what of the arm and the surface moves by itself at a posture."""
    name, n = scenario.time.integrator, robot.n
    on_bristles = "explicit_euler" if INTEGRATORS[name].semi_implicit else name
    try:
        terms = robot.terms(np.array(q), np.zeros(n))
        mobility = closed_mobility(robot, q, np.linalg.inv(terms.mass_matrix))
    except np.linalg.LinAlgError:  # some joint moves no inertia: the run says so
        return []
    modes: list[Mode] = []
    if scenario.transmission.elastic:
        k, d, inertia, _, _ = transmission_constants(scenario.transmission, robot.model)
        between = mobility + np.diag(np.divide(1.0, inertia, out=np.zeros(n), where=inertia > 0.0))
        modes.append(Mode("transmission.stiffness", between * k, between * d, name))
    A = np.linalg.svd(normal[None])[2] @ terms.jacobian  # along the normal and two tangents
    S = A @ mobility @ A.T
    if scenario.compliance.kind != "none":
        k, d = scenario.compliance.tangent(max(0.0, depth))
        modes.append(Mode("compliance", S[:1, :1] * k, S[:1, :1] * d, name))
    elif S[0, 0] > 0.0:  # a rigid surface holds the tip
        mobility = without_normal(mobility, A[0], A[0])
        S = S - np.outer(S[:, 0], S[0]) / S[0, 0]
    if hasattr(scenario.friction, "stiffness"):
        load = max(0.0, scenario.law.force)
        k, d = bristle(scenario.friction, surface_parameters(scenario.friction), load)
        modes.append(Mode("friction.stiffness", S[1:, 1:] * k, S[1:, 1:] * d, on_bristles))
    if hasattr(scenario.friction, "viscous"):
        d = surface_parameters(scenario.friction).viscous
        modes.append(Mode("friction.viscous", np.zeros((2, 2)), S[1:, 1:] * d, name))
    of_joints, bearings = joint_parameters(in_joints, n), ~robot.model.of_bodies
    if hasattr(in_joints, "stiffness"):
        k, d = np.array([bristle(in_joints, par, 1.0) for par in of_joints]).T * bearings
        modes.append(Mode("joint_friction.stiffness", mobility * k, mobility * d, on_bristles))
    if hasattr(in_joints, "viscous"):
        d = np.array([par.viscous for par in of_joints]) * bearings
        damped = mobility if sliding is None else _while_slipping(robot, sliding)
        modes.append(Mode("joint_friction.viscous", np.zeros((n, n)), damped * d, name))
    return modes


def _while_slipping(robot: Robot, sliding: Sliding) -> Array:
    """Return what a contact with friction leaves of H⁻¹ (n, n)."""
    terms = robot.terms(np.array(sliding.q), np.zeros(robot.n))
    mobility = closed_mobility(robot, sliding.q, np.linalg.inv(terms.mass_matrix))
    return without_normal(mobility, sliding.normal @ terms.jacobian, sliding.push @ terms.jacobian)


def _line(mode: Mode, scenario: Scenario, decays: bool, least: float = 0.0) -> list[str]:
    """Return what is wrong with a motion at the scenario's step, in a list; empty if nothing is."""
    h, name = scenario.time.step, scenario.time.integrator

    def fault(step: float) -> tuple[float, float, str]:
        off, rate = wrong_by(mode.integrator, step, mode.stiffness, mode.damping, least)
        if off > WRONG_BY:
            return off, rate, "swing"
        off, rate = wrong_decay(mode.integrator, step, mode.stiffness, mode.damping)
        return (off, rate, "decay") if decays and off > WRONG_DECAY else (0.0, 0.0, "")

    off, rate, what = fault(h)
    if not what:
        return []
    short = h
    for _ in range(40):
        short *= 0.5
        if not fault(short)[2]:
            break
    unit = "rad/s" if what == "swing" else "1/s"
    return [
        f"{mode.key}: {name} with time.step = {h:g} s gets a {what} of {rate:.3g} {unit} wrong by {100 * off:.2g} %; "
        f"it is within {100 * (WRONG_BY if what == 'swing' else WRONG_DECAY):g} % with a step of {short:.2g} s"
    ]
