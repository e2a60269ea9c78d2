"""From a scenario to a `Problem`, or to the one line that says what is wrong with it."""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

import robot_models
from closedloop.closure.baumgarte import baumgarte_gains, largest_stable_ratio, recommended_ratio
from closedloop.closure.contact_force import FREE, PRESSED, STUCK
from closedloop.contacts.bind import check_contacts
from closedloop.control.drives import torque_limits, torque_steps
from closedloop.control.encoder import NO_ENCODER, encoder_draws, encoder_kind
from closedloop.control.law import Compensation
from closedloop.control.laws.paper import PaperLaw
from closedloop.control.sensor import draws, pack_sensor
from closedloop.control.stability import check_sampling
from closedloop.control.transmission import transmission_constants
from closedloop.engines.problem import (
    STICK_SPEED,
    PackedLaw,
    Problem,
    arm_columns,
    pack_friction,
    pack_law,
)
from closedloop.errors import ScenarioError
from closedloop.events.phases import RESTING, TOUCHING
from closedloop.friction.law import JOINT_LAWS, SURFACE_LAWS, JointFriction
from closedloop.integrators import ADAPTIVE, INTEGRATORS, Scheme
from closedloop.loops.assemble import closed_start
from closedloop.parameters import lists_per_joint, pack
from closedloop.reference.desired import Desired, desired
from closedloop.reference.force import force_at
from closedloop.robot.pinocchio import Robot
from closedloop.scenario.arm import joint_friction_of, robot_of
from closedloop.scenario.gains import check_transmission
from closedloop.scenario.members import refuse_absent
from closedloop.scenario.scenario import BaumgarteGains, ModelErrorSection, Scenario
from closedloop.sections import Section
from closedloop.simulation.cache import Cache
from closedloop.simulation.edge import edge_key, refuse_beyond_edge
from closedloop.step.record_row import row_width
from closedloop.surface.compliances.none import Rigid
from closedloop.surface.kinds.plane import PlaneSurface
from closedloop.surface.placed import PlacedSurface, Touching
from closedloop.surface.plane import unit
from closedloop.surface.rates import check_rates
from closedloop.surface.surface import Surface
from closedloop.user_code import of_users
from robot_models import RobotModel

Array = NDArray[np.float64]

# A run is held in memory, once as rows and once as columns: this many numbers in the rows are about 4 GB in all.
MOST_NUMBERS = 200_000_000
# Largest |e| of the tip at the start, m: with the paper's stabiliser the force due to a larger error would dominate, a
# thousand newtons for each kilogram of apparent mass and each millimetre.
START_GAP = 1e-3
# Largest |ė| of a tip in contact at the start, m/s: the rounding of a velocity given to four digits. The stabiliser has
# to stop it, with 0.14 N for each kilogram of apparent mass at the paper's setting; without one the error would grow.
START_RATE = 1e-4
# Default relative tolerance of an adaptive integrator. With friction at the tip 1e-12 takes 16 s of processor time for
# the 8 s of wam_slide_friction, and 1e-9 takes 6 s: break-away and sticking are then within 2e-8 s of those at 1e-12.
TOLERANCE, TOLERANCE_WITH_FRICTION = 1e-12, 1e-9
# A path on a surface that moves goes on this much longer than the run, so that its last row is no end of it.
BEYOND = 1.001
# Memory of a robot, with Pinocchio's model and data, about, bytes.
ROBOT_BYTES = 200_000
# Memory of a section as numbers, about, bytes.
SECTION_BYTES = 2_000


def prepare(scenario: Scenario, model: RobotModel | None = None, cache: Cache | None = None) -> Problem:
    """Turn a scenario into the numbers of a `Problem`.

    Parameters
    ----------
    scenario : Scenario
    model : RobotModel, optional
        The robot to use instead of loading `scenario.robot.model`.
    cache : Cache, optional
        Robots, paths and tables of earlier scenarios of this thread, with this same `model`. The robot and the table
        of an earlier `Problem` may then be this one's, and its table be overwritten.

    Raises
    ------
    ScenarioError, ModelError
        If something in it cannot be simulated: a wrong length, an unreachable path, a step that makes the
        stabiliser unstable, a tip that the robot does not have ...
    """
    refuse_absent(scenario)
    cache = Cache() if cache is None else cache
    robot = _robot(scenario, model, cache)
    model = robot.model
    n = robot.n
    _refuse_lengths(scenario, model)
    q = model.home.copy() if scenario.start.q is None else np.array(scenario.start.q)
    v = np.zeros(n) if scenario.start.v is None else np.array(scenario.start.v)
    if faults := [
        f"start.q[{j}] = {q[j]:g}: joint {model.joint_names[j]} of {model.name} moves within [{low:g}, {high:g}]"
        for j, (low, high) in enumerate(zip(model.position_lower, model.position_upper, strict=True))
        if not low <= q[j] <= high
    ]:
        raise ScenarioError(*faults)

    if (model.loops or scenario.robot.stops) and scenario.time.integrator in ADAPTIVE:
        raise ScenarioError(
            f"time.integrator = {scenario.time.integrator!r}: loops and stops of joints take steps of fixed length; "
            f"must be {' or '.join(map(repr, INTEGRATORS))}"
        )
    if model.loops:
        for section, asked in (
            ("model_error", scenario.model_error != ModelErrorSection()),
            ("encoder", encoder_kind(scenario.encoder) != NO_ENCODER),
            ("transmission", scenario.transmission.elastic),
            ("robot.stops", scenario.robot.stops),
        ):
            if asked:
                raise ScenarioError(f"{section}: is for arms without loops, and {model.name} has some; leave it out")
        q, v = closed_start(robot, q, v, scenario.start.assemble or scenario.start.q is None)
    surface, now, mode = cache.get(
        ("surface", *_surface_key(scenario), q.tobytes(), v.tobytes()),
        lambda: _surface(scenario, robot, q, v),
        lambda placed: SECTION_BYTES,
    )
    check_rates(surface, scenario.time.duration)
    soft = not isinstance(scenario.compliance, Rigid)
    joint_friction = joint_friction_of(scenario, model)
    integrator, tolerance = _integrator(scenario, joint_friction)
    if soft and tolerance is None:
        _check_stiffness(scenario, robot, q, now)
    if scenario.transmission.elastic:
        check_transmission(scenario, robot, q)
    steps = _whole(scenario.time.duration, scenario.time.step, "time.duration")
    if scenario.contact:
        check_contacts(scenario, robot, q)
    most_rows = MOST_NUMBERS // row_width(n, bool(arm_columns(scenario)), len(scenario.contact or ()))
    if steps > most_rows:
        raise ScenarioError(
            f"time.step = {scenario.time.step:g}: {scenario.time.duration:g} s would be {steps:.3g} rows, over the "
            f"{most_rows} that a run of this robot may have; use a larger step or a shorter duration"
        )
    h = scenario.time.step
    period = scenario.law.sample_period
    hold = _whole(period, h, "law.sample_period") if period else 0
    if scenario.reads_encoders:  # its readings are taken once a step
        hold = max(hold, 1)

    nodes_per_step = integrator.parts
    instants = (h / nodes_per_step) * np.arange(steps * nodes_per_step + 1, dtype=np.float64)
    with of_users(scenario.reference, "reference.kind"):  # its curves are evaluated in there
        wanted, table = _desired(scenario, robot, surface, q, instants, cache)
    if scenario.reference.on_surface != "no":
        refuse_beyond_edge(surface, wanted)
    table[::nodes_per_step, 2 * n + 10] = draws(scenario.sensor, steps + 1)
    if table.shape[1] > 2 * n + 11:
        table[::nodes_per_step, 2 * n + 11 :] = encoder_draws(scenario.encoder, steps + 1, n)

    law = scenario.law
    given = getattr(law, "pd_start", None)
    start = (wanted.tip.start if given is None else given) - 1e-9 * h  # i·h and 0.5 may differ by rounding
    law = law.model_copy(update={"pd_start": start}) if isinstance(law, PaperLaw) else law
    compensation = _believed_compensation(scenario)
    compensation.check(law)
    check_sampling(law, compensation, scenario.sensor, law.sample_period or h)

    def packed(name: str, section: Any, how: Callable[[], PackedLaw]) -> PackedLaw:
        key = ("packed", name, n, type(section), section.model_dump_json())
        return cache.get(key, how, lambda found: SECTION_BYTES)

    friction = packed("friction", scenario.friction, lambda: pack_friction(scenario.friction, n))
    if friction.member.sticks != "elastic" and mode == PRESSED:
        u = now.frame @ robot.terms(q, v).jacobian @ v - now.carried
        mode = STUCK if np.hypot(u[1], u[2]) <= STICK_SPEED else PRESSED
    return Problem(
        scenario=scenario,
        robot=robot,
        surface=surface,
        frame=now.frame,
        integrator=integrator,
        q=q,
        v=v,
        mode=mode,
        steps=steps,
        h=h,
        stabiliser=np.array(_stabiliser_gains(scenario)),
        pd_start=start,
        law=pack_law(law, n, model.joint_names),
        compensation=packed("compensation", compensation, lambda: pack_law(compensation, n, model.joint_names)),
        friction=friction,
        joint_friction=packed("joint_friction", joint_friction, lambda: pack_friction(joint_friction, n, joints=True)),
        compliance=packed(
            "compliance",
            scenario.compliance,
            lambda: PackedLaw(type(scenario.compliance), pack(scenario.compliance, n, "compliance"), 0),
        ),
        sensor=cache.get(
            ("sensor", scenario.sensor.model_dump_json(), h),
            lambda: pack_sensor(scenario.sensor, h),
            lambda found: SECTION_BYTES,
        ),
        table=table,
        nodes=nodes_per_step,
        project=scenario.stabiliser.kind in ("projection", "both") and not soft,
        hold=hold,
        transmission=transmission_constants(scenario.transmission, model),
        encoder=pack(scenario.encoder, n, "encoder", model.joint_names),
        drives=np.stack([torque_limits(scenario.drives, model), torque_steps(scenario.drives, model, period)]),
        wanted=wanted,
        tolerance=tolerance,
    )


def _robot_key(scenario: Scenario) -> Hashable:
    """Return what the robot depends on."""
    return (
        scenario.robot.model_dump_json(), scenario.tool.model_dump_json(), scenario.model_error.payload,
        scenario.transmission.elastic,
    )  # fmt: skip


def _surface_key(scenario: Scenario) -> tuple[Hashable, ...]:
    """Return what `_surface` depends on, but for the state."""
    sections: list[Section] = [scenario.surface, scenario.surface_motion, scenario.compliance]
    if not isinstance(scenario.compliance, Rigid):  # the tip starts as deep as the force presses it
        sections += [scenario.force_profile, scenario.law]
    return _robot_key(scenario), *((type(section), section.model_dump_json()) for section in sections)


def _robot(scenario: Scenario, model: RobotModel | None, cache: Cache) -> Robot:

    def make() -> Robot:
        return robot_of(scenario, load_model(scenario) if model is None else model)

    return cache.get(("robot", _robot_key(scenario)), make, lambda robot: ROBOT_BYTES)


def load_model(scenario: Scenario) -> RobotModel:
    """Return the robot that a scenario names."""
    section = scenario.robot
    options: dict[str, Any] = {} if section.lock is None else {"lock": section.lock}
    return robot_models.load(section.model, drive_inertia=section.drive_inertia, **options)


def _believed_compensation(scenario: Scenario) -> Compensation:
    """Return the compensation with its figures of friction wrong by `model_error.friction`."""
    section, factor = scenario.compensation, scenario.model_error.friction
    if factor == 1.0:
        return section
    figures = {name: getattr(section, name) for name in section.friction_figures}
    wrong = {
        name: tuple(factor * x for x in value) if isinstance(value, tuple) else factor * value
        for name, value in figures.items()
        if value is not None
    }
    if not any(np.any(figures[name]) for name in wrong):
        raise ScenarioError(
            f"model_error.friction = {factor:g}: the compensation {section.kind!r} has no figures of friction to "
            "be wrong about; give compensation.kind = 'model' some, or leave it out"
        )
    return section.model_copy(update=wrong)


def _desired(
    scenario: Scenario, robot: Robot, surface: PlacedSurface, q: Array, instants: Array, cache: Cache
) -> tuple[Desired, Array]:
    """Return what is desired, and the table of it at `instants` (P,), s, with room for noise in its last columns."""
    n = robot.n
    spare = 1 + 2 * n if scenario.reads_encoders else 1
    motion = (
        scenario.robot.model_dump_json(),
        scenario.tool.model_dump_json(),
        scenario.reference.model_dump_json(),
        q.tobytes(),
        _path_key(scenario, surface),
    )
    axis = unit(scenario.tool.axis, "tool.axis")
    wanted = cache.get_shared(
        ("desired", *motion),
        lambda: desired(scenario, robot, surface, q, scenario.force_profile, scenario.time.duration * BEYOND, axis),
        lambda made: 3 * made.joints.q.nbytes,
    )
    wanted = replace(wanted, profile=scenario.force_profile, force=scenario.law.force)
    table = cache.get(
        ("table", *motion, instants.size, float(instants[1]), spare),
        lambda: wanted.table(instants, spare=spare),
        lambda made: made.nbytes,
    )
    table[:, 2 * n + 9] = force_at(wanted.profile, wanted.force, instants)
    return wanted, table


def _path_key(scenario: Scenario, surface: PlacedSurface) -> Hashable:
    """Return what of the surface the path depends on."""
    if surface.fixed_plane:
        return surface.normal.tobytes()
    sections = scenario.surface.model_dump_json(), scenario.surface_motion.model_dump_json()
    return (*sections, surface.origin.tobytes(), scenario.time.duration)


def _integrator(scenario: Scenario, joint_friction: JointFriction) -> tuple[type[Scheme], float | None]:
    """Return the scheme, and the tolerance of one that chooses its own steps, refusing what such a one cannot do."""
    section = scenario.time
    name = section.integrator
    if name not in ADAPTIVE:
        if section.tolerance is not None:
            raise ScenarioError(
                f"time.tolerance = {section.tolerance:g}: goes with integrator = {' or '.join(map(repr, ADAPTIVE))} "
                f"only; the error of {name!r} is set by time.step; leave it out"
            )
        return INTEGRATORS[name], None
    if scenario.reads_encoders:
        what = "encoder" if encoder_kind(scenario.encoder) != NO_ENCODER else "transmission.measured = 'motor'"
        raise ScenarioError(
            f"{what}: is read once a step, and {name!r} has none; take an integrator of fixed step, "
            f"{' or '.join(map(repr, INTEGRATORS))}"
        )
    for key, law, family, possible in (
        ("friction", scenario.friction, SURFACE_LAWS, ("elastic", "rigid")),
        ("joint_friction", joint_friction, JOINT_LAWS, ("elastic",)),
    ):
        if law.sticks not in possible:
            others = [repr(name) for name, member in family.items() if member.sticks in possible]
            raise ScenarioError(
                f"{key}.kind = {law.kind!r}: depends on the step, and {name!r} has none; "
                f"must be {' or '.join(others)}, or "
                f"take an integrator of fixed step, {' or '.join(map(repr, INTEGRATORS))}"
            )
    usual = TOLERANCE if scenario.friction.kind == "none" else TOLERANCE_WITH_FRICTION
    return ADAPTIVE[name], usual if section.tolerance is None else section.tolerance


def _surface(scenario: Scenario, robot: Robot, q: Array, v: Array) -> tuple[PlacedSurface, Touching, int]:
    """Return the surface, how the tip is to it at the start, and what it does on it.

    Raises
    ------
    ScenarioError
        If the start is neither on the surface nor off it.
    """
    section = scenario.surface
    terms = robot.terms(q, v)
    tip = terms.position
    soft = not isinstance(scenario.compliance, Rigid)
    pressed = max(0.0, float(force_at(scenario.force_profile, scenario.law.force, np.zeros(1))[0]))
    with of_users(scenario.compliance, "compliance.kind"):
        depth = scenario.compliance.static_depth(pressed) if soft and not section.gap else 0.0
    surface = PlacedSurface.of(section, scenario.surface_motion, tip, depth)
    now = surface.touching(tip, terms.jacobian @ v)
    if now.inside < 0.0 and (section.contact == "bilateral" or soft):
        raise ScenarioError(
            f"surface.{edge_key(section)}: the tip starts {-now.inside:.4g} m beyond the edge of the surface; "
            'make it larger, or start the tip on it, or use contact = "unilateral" without compliance'
        )
    exact = surface.below_start and isinstance(section, PlaneSurface) and not soft
    gap = section.gap if exact else now.gap
    rate = float(now.frame[0] @ terms.jacobian @ v - now.carried[0])
    given, at_most, place = _where_given(section, surface, tip)
    if soft:  # how deep the tip is, or how fast it comes, is for the surface to answer
        return surface, now, PRESSED if section.contact == "bilateral" or gap <= TOUCHING else FREE
    if section.contact == "bilateral":
        if abs(gap) > START_GAP:
            side = "off" if gap > 0 else "inside"
            raise ScenarioError(
                f"{given}: the tip starts {abs(gap):.4g} m {side} the surface, and the closure holds it "
                f'there from the start: use contact = "unilateral", or {place}'
            )
        if abs(rate) > START_RATE:
            raise ScenarioError(_through_the_closure(now.frame[0] @ terms.jacobian, v, rate))
        return surface, now, PRESSED
    if now.inside < 0.0:
        return surface, now, FREE
    if gap < -TOUCHING:
        raise ScenarioError(f"{given}: the tip starts {-gap:.4g} m inside the surface: {at_most} for this start")
    if gap > TOUCHING:
        return surface, now, FREE
    if rate > RESTING:
        raise ScenarioError(
            f"start.v: the tip starts on the surface and leaves it at {rate:.4g} m/s: start it off the surface "
            "(surface.gap), or without velocity along the normal"
        )
    return surface, now, FREE if rate < -RESTING else PRESSED


def _check_stiffness(scenario: Scenario, robot: Robot, q: Array, now: Touching) -> None:
    """Refuse a soft surface that is too stiff for the step: tip and surface are a mass, a spring and a damper."""
    terms, name, h = robot.terms(q, np.zeros(robot.n)), scenario.time.integrator, scenario.time.step
    A = now.frame[0] @ terms.jacobian
    try:
        mobility = float(A @ np.linalg.solve(terms.mass_matrix, A))
    except np.linalg.LinAlgError:  # some joint moves no inertia: the run says so
        return
    stiffness, damping = scenario.compliance.tangent(max(0.0, -now.gap))
    rate = math.sqrt(stiffness * mobility)
    if not 0.0 < rate < math.inf:
        return
    limit = largest_stable_ratio(name, 0.5 * damping * mobility / rate)
    if h * rate > limit:
        raise ScenarioError(
            f"compliance: {name} is unstable with time.step = {h:g} s on a surface of {stiffness:.3g} N/m and "
            f"{damping:.3g} N s/m: the tip moves with 1/{1.0 / mobility:.3g} kg; the step may be at most "
            f"{_rounded(limit / rate, down=True)} s, or take the integrator 'dop853'"
            if limit > 0.0
            else f"compliance: {name} is unstable at any step on a surface of {stiffness:.3g} N/m and {damping:.3g} "
            "N s/m; use 'rk4', 'dop853' or 'semi_implicit_euler'"
        )


def _where_given(section: Surface, surface: PlacedSurface, tip: Array) -> tuple[str, str, str]:
    """Return key and value that place the surface, what the value may be for this start, and two ways to be on it."""
    own: Any
    if isinstance(section, PlaneSurface):
        key, own, best = "offset", section.offset, f"{float(surface.normal @ tip):.9g}"
    else:
        key, own = "point", getattr(section, "point", None)
        best = str([float(f"{x:.9g}") for x in tip])
    said = f"{own:.9g}" if isinstance(own, float) else f"{list(own or ())}"
    given = f"surface.gap = {section.gap:.9g}" if surface.below_start else f"surface.{key} = {said}"
    return given, f"surface.{key} may be at most {best}", f'{key} = "start" or {best}'


def _through_the_closure(A: Array, v: Array, rate: float) -> str:
    """Return what is wrong with joint velocities v (n,) that move a tip held by n·Jᵣ = A (n,) at `rate`, m/s."""
    along = v - A * (rate / float(A @ A))  # the nearest that obey A q̇ = 0
    return (
        f"start.v: the tip is held to the surface and starts through it at {rate:.4g} m/s, where {START_RATE:g} m/s is "
        f"the most; the nearest start.v along the surface is {[float(f'{x:.9g}') for x in along]}, or use "
        'contact = "unilateral"'
    )


def _stabiliser_gains(scenario: Scenario) -> tuple[float, float]:
    section = scenario.stabiliser
    if not isinstance(section, BaumgarteGains):
        return 0.0, 0.0
    name = scenario.time.integrator
    if name in ADAPTIVE:  # its steps are as short as stability requires
        own = 2.0 * scenario.time.step if section.time_constant == "auto" else section.time_constant
        return baumgarte_gains(section.damping_ratio, own)
    limit = largest_stable_ratio(name, section.damping_ratio)
    if section.time_constant == "auto":
        recommended = recommended_ratio(name, section.damping_ratio)
        if recommended == 0.0:
            raise ScenarioError(
                f'stabiliser.time_constant = "auto": no time constant makes the closure error die out with {name} at '
                f"damping ratio {section.damping_ratio:g}; use a larger stabiliser.damping_ratio, such as 0.707"
            )
        return baumgarte_gains(section.damping_ratio, scenario.time.step / recommended)
    constant = section.time_constant
    ratio = scenario.time.step / constant
    if ratio > limit:
        if limit == 0.0:
            raise ScenarioError(
                f"stabiliser.damping_ratio = {section.damping_ratio:g}: Baumgarte is unstable with {name} at any step; "
                "use a larger damping ratio"
            )
        raise ScenarioError(
            f"stabiliser.time_constant = {constant:g} s with time.step = {scenario.time.step:g} s: "
            f"Baumgarte is unstable with {name} beyond step/time_constant = {limit:.4f} at damping ratio "
            f"{section.damping_ratio:g}; the step may be at most {_rounded(limit * constant, down=True)} "
            f"s, or the time constant at least {_rounded(scenario.time.step / limit, down=False)} s"
        )
    return baumgarte_gains(section.damping_ratio, constant)


def _rounded(x: float, down: bool) -> str:
    """Return x to four digits, rounded to the side on which it is still a valid limit."""
    unit = 10.0 ** (math.floor(math.log10(x)) - 3)
    return f"{(math.floor(x / unit) if down else math.ceil(x / unit)) * unit:.4g}"


def _refuse_lengths(scenario: Scenario, model: RobotModel) -> None:
    """Refuse lists that have not one entry for each joint, all of them at once."""
    lists = {"start.q": scenario.start.q, "start.v": scenario.start.v}
    lists |= {f"law.{name}": value for name, value in lists_per_joint(scenario.law).items()}
    faults = [
        f"{key} has {len(value)} entries: {model.name} has {model.n} joints, {', '.join(model.joint_names)}"
        for key, value in lists.items()
        if value is not None and len(value) != model.n
    ]
    if faults:
        raise ScenarioError(*faults)


def _whole(span: float, h: float, key: str) -> int:
    """Return how many steps h the span is, refusing a span that is no whole number of them."""
    count = round(span / h) if np.isfinite(span / h) else 0
    if count < 1 or abs(count * h - span) > 1e-9 * span:
        near = max(1, count) * h
        raise ScenarioError(f"{key} = {span:g} s: must be a whole number of steps of {h:g} s, such as {near:.10g} s")
    return count
