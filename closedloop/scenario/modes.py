"""Whether the step resolves what is fast, in the arm and in contacts of its links.

Bristles and viscous friction of all contacts of links make bodies swing together. Of contacts that press with f the
tangents J_t, of each, give ẍ = −H⁻¹ Σ J_tᵀ (k f J_t x + d J_t ẋ), in the joints and the bodies, with what the rigid
ones among them hold along their normals taken out of H⁻¹. So do the soft ones along their normals, with k and d of
their compliance at the depth of f.

It is about accuracy, not stability alone. A step that is stable may damp a swing that the arm does not damp, or feed
one that it does: Runge-Kutta's fourth order scheme takes away 23 % of the rate at hω = 2.3. So what a step makes of a
motion, its eigenvalue μ, is compared with e^hλ.

With the semi-implicit scheme bristles follow the slip at the step's beginning, so that on them it is the explicit one.
Of the other fast parts the stabiliser is no motion of the arm, and what is unstable is refused, as are a sensor's
filter and delay that its samples do not resolve (`closedloop.control.sensor`, `closedloop.simulation.time_step`).

The stability of a law's feedback is that of its damping and stiffness against the arm's inertia. With the model fed
forward, as the laws do, feedback gives ẍ = −K x − D ẋ, in the joints with K = H⁻¹K_p and D = H⁻¹K_d. One explicit step
multiplies the rate by 1 − D h, which grows where the largest eigenvalue of D h exceeds 2; a torque that is held between
samples is such a step with any integrator. A spring adds K h². So gains are judged by the spectral radius of the step's
linear map, at the start posture, in every direction in which the arm can move.

A tip in bilateral contact cannot move along the normal, so that direction is projected out of H⁻¹; with a unilateral
contact the free arm is judged. Contact, friction and other postures change the limit, so the result is a warning and no
refusal.
"""

from collections.abc import Callable, Hashable, Sequence
from operator import is_, itemgetter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from closedloop.base.arrays import Array, ComplexArray, Mask
from closedloop.base.errors import ScenarioError
from closedloop.control.drives import transmission_constants
from closedloop.control.laws.hybrid import HybridLaw
from closedloop.control.laws.impedance import ImpedanceLaw
from closedloop.control.tip_space import Posture, TipMotion
from closedloop.jit.parameters import per_joint
from closedloop.mechanics.closure.baumgarte import linear_step
from closedloop.mechanics.closure.contact_force import PRESSED
from closedloop.mechanics.contacts.sections import ContactSection
from closedloop.mechanics.contacts.soft import is_soft
from closedloop.mechanics.friction.bristle import bristle
from closedloop.mechanics.friction.law import JointFriction, joint_parameters, surface_parameters
from closedloop.mechanics.integrators import ADAPTIVE, INTEGRATORS
from closedloop.mechanics.loops.reactions import loop_rows
from closedloop.mechanics.robot.pinocchio import Robot
from closedloop.mechanics.surface.placed import PlacedSurface
from closedloop.mechanics.surface.surface import Compliance
from closedloop.scenario.arm import joint_friction_of, start_posture
from closedloop.scenario.scenario import Scenario
from closedloop.scenario.tables import patches_of

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

    `integrator`: see `closedloop.mechanics.integrators`; an adaptive one is stable with any gains but those of a held
        torque.
    `h`: step, s.
    `hold`: steps for which a sampled torque is held; 0: the law is evaluated at every stage.
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

    `scenario`: one that can be prepared.
    `robot`: its robot with its tip.
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


def without_normal(mobility: NDArray[Any], normal: Array, push: Array) -> Array:
    """Return what a contact that pushes leaves of H⁻¹ (..., n, n), where the tip cannot move along the normal.

    A push (..., n) along the joints has friction in it, as the normal (..., n) has not: a torque that presses also
    brakes.
    """
    pushed, felt = mobility @ push[..., None], normal[..., None, :] @ mobility
    along = felt @ push[..., None]
    return mobility - np.divide(pushed @ felt, along, out=np.zeros_like(mobility), where=along > 0.0)


def feedbacks(scenario: Scenario, robot: Robot, sliding: Sliding | None = None) -> list[Feedback]:
    """Return the feedback of the scenario's law, in decoupled parts, at the start posture or where the tip slips."""
    q = start_posture(scenario, robot.model) if sliding is None else sliding.q
    return [
        each._replace(stiffness=each.stiffness[0], damping=each.damping[0])
        for each in _feedbacks_at([scenario], robot, q[None], sliding)
    ]


def _feedbacks_at(
    scenarios: Sequence[Scenario], robot: Robot, q: Array, sliding: Sliding | None = None
) -> list[Feedback]:
    """Return `feedbacks` of R scenarios that differ in the start and in numbers of the law alone, (R, m, m).

    `q` (R, n): their postures; (1, n): that of all.
    Raises LinAlgError if one of several has a joint that moves no inertia.
    """
    first, n = scenarios[0], robot.n
    masses = np.stack([robot.mass_matrix(each) for each in q])
    tips, jacobian = map(np.stack, zip(*(robot.known_tip(robot.pinocchios(each)) for each in q), strict=True))
    surface = PlacedSurface.of(first.surface, first.surface_motion, tips[0], radius=first.tool.radius)
    if surface.fixed_plane:
        frames = surface.frame[None]
    else:
        frames = np.stack([surface.below(tip, 0.0).touching(tip).frame for tip in tips])
    A = frames @ jacobian
    held = first.surface.contact == "bilateral" or sliding is not None
    push = A[:, 0] if sliding is None else sliding.push @ jacobian
    try:
        motors = np.diag(transmission_constants(first.transmission, robot.model)[2])  # zero: they are in H
        mobility = np.linalg.inv(masses + motors)
        if robot.model.loops:
            mobility = np.stack([closed_mobility(robot, *each) for each in zip(q, mobility, strict=True)])
    except np.linalg.LinAlgError:  # some joint moves no inertia: the run says so
        if len(scenarios) > 1:
            raise
        return []
    S = A @ mobility @ A.swapaxes(1, 2)
    if held:
        pressed = S[:, :1, :1] > 0.0
        mobility = np.where(pressed, without_normal(mobility, A[:, 0], push), mobility)
        S = S - np.divide(S[:, :, :1] @ S[:, :1], S[:, :1, :1], out=np.zeros_like(S), where=pressed)
    parts: list[Feedback] = []

    def gain(name: str) -> Array:
        """Return a gain of each, (R, 1, 1), or on each joint, (R, 1, n)."""
        return _told([getattr(each.law, name) for each in scenarios], f"law.{name}", n)

    def acting(spring: str, damper: str, on: Array) -> None:
        parts.append(Feedback(f"law.{spring}", f"law.{damper}", gain(spring) * on, gain(damper) * on))

    if first.law.kind in ("paper", "hybrid"):
        acts = np.eye(n)
        if isinstance(first.law, HybridLaw):  # T⁺T + N of `closedloop.control.laws.hybrid`
            acts = acts + np.linalg.pinv(A[:, 1:]) @ A[:, 1:] - np.linalg.pinv(A) @ A
        kp, kd = (mobility * gain(name) @ acts for name in ("kp", "kd"))
        parts.append(Feedback("law.kp", "law.kd", kp, kd))
    if isinstance(first.law, HybridLaw) and not held:
        damping = gain("approach_damping")
        parts.append(Feedback("law.approach_damping", "law.approach_damping", np.zeros_like(damping), damping))
    if isinstance(first.law, TipMotion):
        acting("motion_stiffness", "motion_damping", np.ones(1))
    if isinstance(first.law, ImpedanceLaw):
        acting("stiffness", "damping", S[:, 1:, 1:])
        if not held:
            acting("normal_stiffness", "normal_damping", S[:, :1, :1])
    if isinstance(first.law, Posture) and np.any(free := n > np.linalg.matrix_rank(A)):
        acting("posture_stiffness", "posture_damping", np.eye(n) * free[:, None, None])
    return parts


def _told(values: Sequence[float | tuple[float, ...]], key: str, n: int) -> Array:
    """Return values of a key of R runs, (R, 1, 1), or (R, 1, n) if one of them is a list with an entry a joint."""
    if any(isinstance(each, tuple) for each in values):
        return np.array([per_joint(key, each, n) for each in values])[:, None]
    return np.array(values, dtype=np.float64)[:, None, None]


def closed_mobility(robot: Robot, q: Array, mobility: NDArray[Any]) -> Array:
    """Return what a robot's loops leave of H⁻¹ (n, n) at q (n,)."""
    if not robot.model.loops:
        return mobility
    return held_at(loop_rows(robot, q[None], np.zeros((1, robot.n)))[0][0], mobility)


def held_at(G: Array, mobility: Array) -> Array:
    """Return what is left of a mobility (n, n) where G q̈ = 0, of rows (m, n) that may depend on each other."""
    return mobility - mobility @ G.T @ np.linalg.pinv(G @ mobility @ G.T, rcond=REDUNDANT) @ G @ mobility


class Pressed(NamedTuple):
    """Where contacts of links press: q (n,), the normal force of each there, N, and the rows (k, 3, n) of each there.

    The rows are what the joints move its point by, along its normal and two tangents.
    """

    q: Array
    load: Array
    rows: Array


def where_they_press(q: Array, forces: Array, rows_at: Callable[[int, Mask], Array]) -> Pressed | None:
    """Return the row of q (N, n) in which contacts press as they mostly do, of forces (N, k), N; None if never.

    `rows_at`: returns what the joints move the points of some contacts by in a row (k, 3, n), whatever their surfaces
        (`closedloop.record.columns.touching.contact_rows`).
    """
    pressed = forces > 0.0
    if not np.any(pressed):
        return None
    load = np.array([np.median(f[on]) if np.any(on) else 0.0 for f, on in zip(forces.T, pressed.T, strict=True)])
    row = int(np.argmax(pressed.sum(axis=1)))
    return Pressed(q[row], load, rows_at(row, load > 0.0))


def has_motion(section: ContactSection) -> bool:
    """Whether the friction of a contact has bristles, or a viscous part."""
    return any(hasattr(section.friction_law, name) for name in ("stiffness", "viscous"))


def motions_of_contacts(
    sections: tuple[ContactSection, ...], robot: Robot, pressed: Pressed
) -> list[tuple[str, NDArray[Any], NDArray[Any]]]:
    """Return the key of what acts most, and stiffness and damping (n, n), 1/s² and 1/s: of friction, of compliances."""
    n, names = robot.n, {k: name for name, numbers in patches_of(sections).items() for k in numbers}
    terms = robot.terms(np.array(pressed.q), np.zeros(n))
    mobility = closed_mobility(robot, pressed.q, np.linalg.inv(terms.mass_matrix))
    there = np.isfinite(pressed.rows).all(axis=(1, 2)) & (pressed.load > 0.0)  # far from its surface one has no normal
    rows = {int(k): pressed.rows[k] for k in np.flatnonzero(there)}
    held = [rows[k][:1] for k in rows if not is_soft(sections[k])]
    if held:
        mobility = held_at(np.vstack(held), mobility)
    found = []
    for soft in (False, True):
        K, D, most, key = np.zeros((n, n)), np.zeros((n, n)), 0.0, ""
        for k, along in rows.items():
            load, law = float(pressed.load[k]), sections[k].compliance if soft else sections[k].friction_law
            if law is None or not (is_soft if soft else has_motion)(sections[k]):
                continue
            if isinstance(law, Compliance):
                stiffness, damping = law.tangent(law.static_depth(load))
            else:
                stiffness, damping = bristle(law, surface_parameters(law), load)
            acting = along[:1] if soft else along[1:]
            K, D = K + stiffness * acting.T @ acting, D + damping * acting.T @ acting
            fast = float(np.linalg.norm(acting @ mobility @ acting.T, 2))
            rates = {"stiffness": max(stiffness * fast, 0.0) ** 0.5, "damping": damping * fast}
            which = max(rates, key=lambda name: rates[name])
            if rates[which] > most:
                most = rates[which]
                which = "viscous" if which == "damping" and not hasattr(law, "damping") else which
                key = f"contact.{names[k]}.{'compliance' if soft else f'friction_law.{which}'}"
        if most > 0.0:
            found.append((key, mobility @ K, mobility @ D))
    return found


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


def wrong_by(integrator: str, h: float, stiffness: Array, damping: Array, least: float = 0.0) -> tuple[Array, Array]:
    """Return |ln μ − hλ|/|hλ| of the swing ẍ = −stiffness x − damping ẋ that a step h, s, gets most wrong, and its |λ|.

    Only swings count that are off by `least` in a step, not what dies out without one. Of stacks (..., m, m) both are
    (...).
    """
    return _worst_swing(*_rates(integrator, h, stiffness, damping), h, least)


def _worst_swing(z: ComplexArray, made: ComplexArray, h: float, least: float) -> tuple[Array, Array]:
    """Return what `wrong_by` does, of what `_rates` returns."""
    with np.errstate(all="ignore"):  # of those that do not count
        counts = (z.imag > 1e-3 * np.abs(z)) & ~(np.abs(made - np.exp(z)) < least)
        off = np.where(counts, np.where(made != 0.0, np.abs(np.log(made) - z) / np.abs(z), np.inf), 0.0)
    return _largest(off, np.abs(z) / h)


def _worst_decay(z: ComplexArray, made: ComplexArray, h: float) -> tuple[Array, Array]:
    """Return |μ − e^hλ| of the decay that a step h, s, gets most wrong, and its |λ|, of what `_rates` returns."""
    with np.errstate(all="ignore"):
        counts = (np.abs(z.imag) <= 1e-3 * np.abs(z)) & (z.real < 0.0)
        off = np.where(counts, np.abs(made - np.exp(z)), 0.0)
    return _largest(off, np.abs(z) / h)


def _largest(off: Array, rate: Array) -> tuple[Array, Array]:
    """Return the largest of each row, and its rate; 0 where none is above 0."""
    worst = np.argmax(off, axis=-1)[..., None]
    off, rate = (np.take_along_axis(each, worst, axis=-1)[..., 0] for each in (off, rate))
    return off, np.where(off > 0.0, rate, 0.0)


def _rates(integrator: str, h: float, stiffness: Array, damping: Array) -> tuple[ComplexArray, ComplexArray]:
    """Return each hλ, 0 where it is zero to rounding, and what a step makes of e^hλ, (..., 2 m), of (..., m, m).

    Of a Runge-Kutta scheme it is a polynomial of hλ; of the semi-implicit one, the nearest that is left over.
    """
    m, scheme = stiffness.shape[-1], INTEGRATORS[integrator]
    A = np.zeros((*stiffness.shape[:-2], 2 * m, 2 * m))
    A[..., :m, m:], A[..., m:, :m], A[..., m:, m:] = np.eye(m), -h * h * stiffness, -h * damping
    z = _eigenvalues(A)
    still = np.abs(z) <= STILL
    if not scheme.semi_implicit:
        one_by_one: Any = z[..., None, None]
        of_each: Any = linear_step(scheme, one_by_one)[..., 0, 0]
        z[still] = 0.0
        return z, of_each
    made = _eigenvalues(linear_step(scheme, A))
    with np.errstate(all="ignore"):  # where a rate is infinite
        apart = np.abs(np.exp(z)[..., :, None] - made[..., None, :])
    nearest, each = np.empty_like(z), tuple(np.indices(z.shape[:-1]))
    for _ in range(2 * m):
        i, k = np.divmod(apart.reshape(*z.shape[:-1], -1).argmin(axis=-1), 2 * m)
        nearest[(*each, i)] = made[(*each, k)]
        apart[(*each, i)], apart[(*each, slice(None), k)] = np.inf, np.inf
    z[still] = 0.0
    return z, nearest


def _eigenvalues(matrix: Array) -> ComplexArray:
    """Return the eigenvalues (..., k) of matrices, infinite of one whose numbers are too large for them to be found."""
    try:
        found: ComplexArray = np.linalg.eigvals(matrix).astype(complex)
    except np.linalg.LinAlgError:
        if matrix.ndim > 2:
            return np.stack([_eigenvalues(each) for each in matrix])
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

    `scenario`, `robot`: what is run, and its robot with its tip.
    `q` (n,): a posture.
    `normal` (3,): the unit normal of the surface there, base axes.
    `depth`: how deep the tip is in the surface there, m.
    `sliding`: returns where the tip slips with the most friction; called only if there is viscous friction in joints.
    `own_law`: whether the law is a user's, of whose feedback nothing is known.
    `pressed`: returns where contacts of links press; called only if one is soft, or has bristles or viscous
        friction.
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
    """Return a line for what of the friction, and of the softness, of contacts of links the step does not resolve.

    Time stepping takes the forces of soft contacts at the end of a step, and resolves them as well as it does the rest.
    """
    sections, name = scenario.contact or (), scenario.time.integrator
    if name not in INTEGRATORS or INTEGRATORS[name].time_stepping:
        return []
    where = pressed() if any(has_motion(each) or is_soft(each) for each in sections) else None
    lines = []
    for key, stiffness, damping in [] if where is None else motions_of_contacts(sections, robot, where):
        bristles = INTEGRATORS[name].semi_implicit and not key.endswith("compliance")
        if np.all(np.isfinite(stiffness)) and np.all(np.isfinite(damping)):
            scheme = "explicit_euler" if bristles else name
            lines += _line(Mode(key, stiffness, damping, scheme), scenario, decays=True)
    return lines


def unresolved_feedback(scenario: Scenario, robot: Robot) -> list[str]:
    """Return a line for each part of a law's feedback that the step does not resolve, with a step that would.

    A torque that is held is a controller's own, and is resolved.
    """
    return unresolved_feedbacks([scenario], robot)[0]


def unresolved_feedbacks(scenarios: Sequence[Scenario], robot: Robot) -> list[list[str]]:
    """Return `unresolved_feedback` of each of several scenarios of a robot, which are looked at together."""
    lines: list[list[str]] = [[] for _ in scenarios]
    alike: dict[Hashable, list[int]] = {}  # those that differ in the start and in numbers of the law alone
    for i, each in enumerate(scenarios):
        if _acts_at_each_stage(each):
            alike.setdefault((type(each.law), *map(id, _BESIDE_THE_LAW(vars(each)))), []).append(i)
    for members in alike.values():
        some = [scenarios[i] for i in members]
        h, starts = some[0].time.step, [each.start for each in some]
        same = all(each is starts[0] for each in starts)
        q = np.stack([start_posture(each, robot.model) for each in (some[:1] if same else some)])
        try:
            modes = _of_feedback(some, robot, q)
        except np.linalg.LinAlgError:
            modes = []
            for i in members:
                lines[i] = unresolved_feedback(scenarios[i], robot)
        for mode in modes:
            wrong = _is_wrong(_rates(mode.integrator, h, mode.stiffness, mode.damping), h, WRONG_FEEDBACK)
            for k in np.flatnonzero(wrong):
                own = mode._replace(stiffness=mode.stiffness[k], damping=mode.damping[k])
                lines[members[k]] += _line(own, some[k], decays=True, least=WRONG_FEEDBACK)
    return lines


def _is_wrong(rates: tuple[ComplexArray, ComplexArray], h: float, least: float) -> NDArray[np.bool_]:
    """Return whether a step gets a swing or a decay wrong, of what `_rates` returns."""
    wrong: NDArray[np.bool_] = (_worst_swing(*rates, h, least)[0] > WRONG_BY) | (
        _worst_decay(*rates, h)[0] > WRONG_DECAY
    )
    return wrong


# What `unresolved_feedback` depends on, beside the law but for its force, the start, and the robot.
_BESIDE_THE_LAW = itemgetter("surface", "surface_motion", "tool", "transmission", "encoder", "time", "reference")


def same_feedback(one: Scenario, other: Scenario) -> bool:
    """Whether two scenarios of a batch have the same feedback, since their sections are the same."""
    law, its = vars(one.law), vars(other.law)
    return (
        one.start is other.start
        and all(map(is_, _BESIDE_THE_LAW(vars(one)), _BESIDE_THE_LAW(vars(other))))
        and type(one.law) is type(other.law)
        and all(law[key] is its[key] or law[key] == its[key] for key in law if key != "force")
    )


def _acts_at_each_stage(scenario: Scenario) -> bool:
    """Whether a law's feedback acts in a run, and at every stage of the scheme."""
    start = getattr(scenario.law, "pd_start", 0.0)
    if scenario.time.integrator not in INTEGRATORS or scenario.law.sample_period or scenario.reads_encoders:
        return False
    if start is None:
        start = getattr(scenario.reference, "start", 0.0)  # as `closedloop.simulation.prepare` has it
    return bool(start < scenario.time.duration)


def _of_feedback(scenarios: Sequence[Scenario], robot: Robot, q: Array, sliding: Sliding | None = None) -> list[Mode]:
    """Return what a law's feedback makes the arm do, of R scenarios as in `_feedbacks_at`; none of one not finite."""
    modes = []
    with np.errstate(over="ignore", invalid="ignore"):
        for each in _feedbacks_at(scenarios, robot, q, sliding):
            stiffness, damping = np.broadcast_arrays(each.stiffness, each.damping)
            finite = np.isfinite(stiffness + damping).all(axis=(1, 2))[:, None, None]
            acting = np.where(finite, stiffness, 0.0), np.where(finite, damping, 0.0)
            modes.append(Mode(f"{each.spring}, {each.damper}", *acting, scenarios[0].time.integrator))
    return modes


def _with_feedback(slipping: Mode, scenario: Scenario, robot: Robot, sliding: Sliding | None) -> list[str]:
    """Return a line, in a list, where friction and a law damp joints too fast for the step, and the law alone not."""
    q = start_posture(scenario, robot.model) if sliding is None else sliding.q
    for stacked in _of_feedback([scenario], robot, q[None], sliding) if _acts_at_each_stage(scenario) else []:
        mode = stacked._replace(stiffness=stacked.stiffness[0], damping=stacked.damping[0])
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
        pressed = scenario.compliance.static_depth(max(0.0, scenario.law.force))
        k, d = scenario.compliance.tangent(max(0.0, depth, pressed))
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
        rates = _rates(mode.integrator, step, mode.stiffness, mode.damping)
        off, rate = map(float, _worst_swing(*rates, step, least))
        if off > WRONG_BY:
            return off, rate, "swing"
        off, rate = map(float, _worst_decay(*rates, step))
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
