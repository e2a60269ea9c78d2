"""What depends on the time step: the scheme, the stabiliser's gains, how stiff a soft surface and a force loop may be.

With an exact model f = f_c + d holds on a rigid surface at every instant, so the sampled force loop is linear and does
not depend on the arm:

    f_k = f_des + K_f (f_des − m_{k−1}) + K_I z_k + d        m: reading, through low-pass and delay
    z_{k+1} = z_k + h (f_des − s_k)                          s: reading without the sampling, or m

It converges if every eigenvalue of that recursion lies within the unit circle. The disturbance observer reads the
sensor too: along n its estimate follows f_c + d − f as the sensor gives it, so K_o is bounded as K_I is.
"""

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError
from closedloop.control.compensation.observer import ObserverCompensation
from closedloop.control.law import Compensation, ControlLaw
from closedloop.control.sensor import NO_ENCODER, SensorSection, encoder_kind, pack_sensor
from closedloop.mechanics.closure.baumgarte import baumgarte_gains, is_stable, largest_stable_ratio, recommended_ratio
from closedloop.mechanics.contacts.friction import coulomb_of, has_other_law
from closedloop.mechanics.contacts.soft import is_soft
from closedloop.mechanics.friction.law import JOINT_LAWS, SURFACE_LAWS, JointFriction
from closedloop.mechanics.friction.laws.coulomb import SurfaceCoulomb
from closedloop.mechanics.friction.laws.none import NoFriction
from closedloop.mechanics.integrators import ADAPTIVE, INTEGRATORS, Scheme
from closedloop.mechanics.surface.compliances.none import Rigid
from closedloop.scenario.scenario import BaumgarteGains, Scenario
from closedloop.scenario.tables import names_of

# A run is held in memory, once as rows and once as columns: this many numbers in the rows are about 4 GB in all.
MOST_NUMBERS = 200_000_000
# Default relative tolerance of an adaptive integrator. With friction at the tip 1e-12 takes 16 s of processor time for
# the 8 s of wam_slide_friction, and 1e-9 takes 6 s: break-away and sticking are then within 2e-8 s of those at 1e-12.
# A box that falls on a soft floor with friction, for 0.5 s: 24 s and 7 s.
TOLERANCE, TOLERANCE_WITH_FRICTION = 1e-12, 1e-9
# T of the stabiliser with an integrator that chooses its steps, if none is given, s: that of the paper's step.
OWN_CONSTANT = 1e-3


def integrator_of(scenario: Scenario, joint_friction: JointFriction) -> tuple[type[Scheme], float | None]:
    """Return the scheme, and the tolerance of one that chooses its own steps, refusing what such a one cannot do."""
    section = scenario.time
    name = section.integrator
    if name not in ADAPTIVE:
        if section.tolerance is not None:
            raise ScenarioError(
                f"time.tolerance = {section.tolerance:g}: acts with integrator = {' or '.join(map(repr, ADAPTIVE))} "
                f"only; the error of {name!r} is set by time.step; leave it out"
            )
        if INTEGRATORS[name].time_stepping:
            check_time_stepping(scenario)
        return INTEGRATORS[name], None
    if scenario.reads_encoders:
        what = "encoder" if encoder_kind(scenario.encoder) != NO_ENCODER else "transmission.measured = 'motor'"
        raise ScenarioError(
            f"{what}: is sampled once a step, and {name!r} chooses its own steps; use an integrator of fixed step, "
            f"{' or '.join(map(repr, INTEGRATORS))}"
        )
    for key, law, family, possible in (
        ("friction", scenario.friction, SURFACE_LAWS, ("elastic", "rigid")),
        ("joint_friction", joint_friction, JOINT_LAWS, ("elastic",)),
    ):
        if law.sticks not in possible:
            others = [repr(name) for name, member in family.items() if member.sticks in possible]
            raise ScenarioError(
                f"{key}.kind = {law.kind!r}: depends on the step, and {name!r} chooses its own steps; "
                f"must be {' or '.join(others)}, or "
                f"use an integrator of fixed step, {' or '.join(map(repr, INTEGRATORS))}"
            )
    soft = [contact for contact in scenario.contact or () if is_soft(contact)]
    rough = scenario.friction.kind != "none" or any(coulomb_of(each) > 0.0 or has_other_law(each) for each in soft)
    usual = TOLERANCE_WITH_FRICTION if rough else TOLERANCE
    return ADAPTIVE[name], usual if section.tolerance is None else section.tolerance


def check_time_stepping(scenario: Scenario) -> None:
    """Refuse what is no part of the problem of impulses, see `closedloop.mechanics.contacts.stepping`."""
    name = scenario.time.integrator
    if not scenario.contact:
        raise ScenarioError(
            f"time.integrator = {name!r}: is for contacts of links and bodies, and the scenario has no [[contact]]; "
            "use 'semi_implicit_euler' or 'rk4'"
        )
    if not isinstance(scenario.stabiliser, BaumgarteGains):
        raise ScenarioError(
            f"stabiliser.kind = {scenario.stabiliser.kind!r}: {name!r} keeps contacts on their surfaces itself; leave "
            "[stabiliser] out, or use 'semi_implicit_euler' or 'rk4'"
        )
    if scenario.surface.contact != "unilateral" and not isinstance(scenario.compliance, Rigid):
        raise ScenarioError(
            f"compliance: {name!r} solves for a soft surface that the tip may leave; set surface.contact = "
            "'unilateral', or use 'semi_implicit_euler' or 'rk4'"
        )
    laws = {"friction": scenario.friction} | {
        f"contact {each!r}: friction_law": section.friction_law
        for each, section in zip(names_of(scenario.contact), scenario.contact, strict=True)
    }
    for key, law in laws.items():
        if law is not None and not isinstance(law, SurfaceCoulomb | NoFriction):
            raise ScenarioError(
                f"{key}.kind = {law.kind!r}: {name!r} solves for Coulomb's friction alone; must be 'coulomb' or "
                "'none', or use 'semi_implicit_euler' or 'rk4'"
            )


def check_stiffness(scenario: Scenario, mobility: float, gap: float) -> None:
    """Refuse a soft surface that is too stiff for the step: tip and surface are a mass, a spring and a damper.

    `mobility` is that of the tip along the normal, 1/kg, and `gap` its distance from the surface, m.
    """
    name, h = scenario.time.integrator, scenario.time.step
    stiffness, damping = scenario.compliance.tangent(max(0.0, -gap))
    rate = math.sqrt(stiffness * mobility)
    if not 0.0 < rate < math.inf:
        return
    damping_ratio = 0.5 * damping * mobility / rate
    if not is_stable(name, damping_ratio, h * rate):
        limit = largest_stable_ratio(name, damping_ratio)
        raise ScenarioError(
            f"compliance: {name} is unstable with time.step = {h:g} s on a surface of {stiffness:.3g} N/m and "
            f"{damping:.3g} N s/m: the tip moves with 1/{1.0 / mobility:.3g} kg; the step may be at most "
            f"{_rounded(limit / rate, down=True)} s, or take the integrator 'dop853'"
            if limit > 0.0
            else f"compliance: {name} is unstable at any step on a surface of {stiffness:.3g} N/m and {damping:.3g} "
            "N s/m; use 'rk4', 'dop853' or 'semi_implicit_euler'"
        )


def stabiliser_gains(scenario: Scenario) -> tuple[float, float]:
    """Return s_v, 1/s, and s_p, 1/s², of Baumgarte's stabiliser, zero without it; refuse what is unstable."""
    section = scenario.stabiliser
    if not isinstance(section, BaumgarteGains):
        return 0.0, 0.0
    name = scenario.time.integrator
    if name in ADAPTIVE:  # its steps are as short as stability requires
        own = 2.0 * scenario.time.step if section.time_constant == "auto" else section.time_constant
        return baumgarte_gains(section.damping_ratio, OWN_CONSTANT if own is None else own)
    rolls = any(contact.rolls or contact.edge or contact.resists for contact in scenario.contact or ())
    limit = largest_stable_ratio(name, section.damping_ratio, rolls)
    if section.time_constant == "auto":
        recommended = recommended_ratio(name, section.damping_ratio, rolls)
        if recommended == 0.0:
            raise ScenarioError(
                f'stabiliser.time_constant = "auto": no time constant makes the closure error die out with {name} at '
                f"damping ratio {section.damping_ratio:g}; use a larger stabiliser.damping_ratio, such as 0.707"
            )
        return baumgarte_gains(section.damping_ratio, scenario.time.step / recommended)
    constant = scenario.time.step if section.time_constant is None else section.time_constant
    ratio = scenario.time.step / constant
    if ratio > limit:
        if limit == 0.0:
            raise ScenarioError(
                f"stabiliser.damping_ratio = {section.damping_ratio:g}: Baumgarte is unstable with {name} at any step; "
                "use a larger damping ratio"
            )
        raise ScenarioError(
            f"stabiliser.time_constant = {constant:g} s with time.step = {scenario.time.step:g} s: "
            f"Baumgarte is unstable with {name}{', of what rolls,' if rolls else ''} beyond step/time_constant = "
            f"{limit:.4f} at damping ratio {section.damping_ratio:g}; "
            f"the step may be at most {_rounded(limit * constant, down=True)} s, "
            f"or the time constant at least {_rounded(scenario.time.step / limit, down=False)} s"
        )
    return baumgarte_gains(section.damping_ratio, constant)


def _rounded(x: float, down: bool) -> str:
    """Return x to four digits, rounded to the side on which it is still a valid limit."""
    unit = 10.0 ** (math.floor(math.log10(x)) - 3)
    return f"{(math.floor(x / unit) if down else math.ceil(x / unit)) * unit:.4g}"


def whole_steps(span: float, h: float, key: str) -> int:
    """Return how many steps h the span is, refusing a span that is no whole number of them."""
    count = round(span / h) if np.isfinite(span / h) else 0
    if count < 1 or abs(count * h - span) > 1e-9 * span:
        near = max(1, count) * h
        raise ScenarioError(f"{key} = {span:g} s: must be a whole number of steps of {h:g} s, such as {near:.10g} s")
    return count


def steps_and_hold(scenario: Scenario, period: float | None, width: int) -> tuple[int, int]:
    """Return the steps of a run, and for how many of them a torque is held, 0: it is not sampled.

    A row of its record has `width` numbers; `period` is that of the law's samples, s.
    """
    h, duration = scenario.time.step, scenario.time.duration
    steps = whole_steps(duration, h, "time.duration")
    most_rows = MOST_NUMBERS // width
    if steps > most_rows:
        raise ScenarioError(
            f"time.step = {h:g}: {duration:g} s would be {steps:.3g} rows, over the "
            f"{most_rows} that a run of this robot may have; use a larger step or a shorter duration"
        )
    hold = whole_steps(period, h, "law.sample_period") if period else 0
    return steps, max(hold, 1) if scenario.reads_encoders else hold  # encoders are read once a step


# The contour is this much outside the unit circle, for the rounding of a root on it.
ON_CIRCLE = 1e-12
# Points on each turn of the phase of the delay along half the circle, before any halving.
POINTS_A_TURN = 8
MOST_HALVINGS = 50
# Bisections between a stable gain and four times it, for the limit in a message: three decimal digits.
DIGITS = 12


def force_loop_settles(feedback: float, integral: float, sensor: SensorSection, period: float) -> bool:
    """Whether the sampled force loop converges: no root of its characteristic equation lies outside the unit circle.

    With the delay as w⁻ᵐ, the low-pass as G(w) = (h/T)/(w − 1 + h/T), or 1, and a reading that is m samples old

        F(w) = (w − 1)(1 + K_f w⁻ᵐ G) + h K_I (w⁻ᵐ or 1) G = 0        (without w − 1 where K_I = 0)

    Nyquist's criterion: F has no pole outside the circle but that at infinity, so the winding number of F along it is
    the number of roots outside. That costs as many evaluations as the delay has samples, where the eigenvalues of the
    recursion cost their cube. The contour is refined where F comes near zero, so the result is that of the eigenvalues
    but for gains within rounding of the limit, which count as stable.

    `feedback`, `integral`: K_f, and K_I, 1/s.
    `period`: time between two samples, s.
    """
    packed = pack_sensor(sensor, period)
    age = packed.ring  # m
    share = period / sensor.filter_time_constant if sensor.filter_time_constant > 0.0 else 0.0

    def characteristic(angle: Array) -> NDArray[np.complex128]:
        w = (1.0 + ON_CIRCLE) * np.exp(1j * angle)
        late = (1.0 + ON_CIRCLE) ** -age * np.exp(-1j * age * angle)
        felt = share / (w - 1.0 + share) if share > 0.0 else np.ones_like(w)
        F: NDArray[np.complex128] = 1.0 + feedback * late * felt
        if integral > 0.0:
            F = (w - 1.0) * F + period * integral * felt * (late if packed.sampled else 1.0)
        return F

    angles = np.linspace(0.0, math.pi, POINTS_A_TURN * (age + 8))
    values = characteristic(angles)
    for _ in range(MOST_HALVINGS):
        sizes = np.abs(values)
        wide = np.flatnonzero(np.abs(np.diff(values)) > 0.5 * np.minimum(sizes[1:], sizes[:-1]))
        if not wide.size:
            break
        between = 0.5 * (angles[wide] + angles[wide + 1])
        angles, values = np.insert(angles, wide + 1, between), np.insert(values, wide + 1, characteristic(between))
    turns = round(float(np.sum(np.angle(values[1:] * values[:-1].conj()))) / math.pi)  # round the whole circle
    return turns == (1 if integral > 0.0 else 0)


def check_sampling(law: ControlLaw, compensation: Compensation | None, sensor: SensorSection, period: float) -> None:
    """Refuse gains with which the sampled loop diverges.

    `period`: time between two evaluations of the law, s.
    """
    if law.force_integral > 0.0 and not force_loop_settles(0.0, law.force_integral, sensor, period):
        most = _most(lambda k: force_loop_settles(0.0, k, sensor, period), law.force_integral)
        raise ScenarioError(
            f"law.force_integral = {law.force_integral:g}: diverges with this sensor and {period:g} s between two "
            f"samples; must be below {most:.3g}"
        )
    if law.force_feedback > 0.0 and not force_loop_settles(law.force_feedback, law.force_integral, sensor, period):
        most = _most(lambda k: force_loop_settles(k, law.force_integral, sensor, period), law.force_feedback)
        raise ScenarioError(
            f"law.force_feedback = {law.force_feedback:g}: diverges, because a reading is {period + sensor.delay:g} s "
            f"old; must be below {most:.3g} (a longer sensor.filter_time_constant allows more)"
        )
    if isinstance(compensation, ObserverCompensation):
        rate = compensation.rate
        slow = not force_loop_settles(0.0, rate, sensor, period)
        if slow or not rate * period < 1.0:
            most = _most(lambda k: force_loop_settles(0.0, k, sensor, period), rate) if slow else rate
            raise ScenarioError(
                f"compensation.rate = {rate:g}: diverges with this sensor and {period:g} s between two samples; must "
                f"be below {min(most, 1.0 / period):.4g}"
            )


def _most(settles: Callable[[float], bool], above: float) -> float:
    """Return the largest gain with which the loop settles, rounded down a little; it does not with `above`."""
    low, high = 0.25 * above, above
    while not settles(low):  # it does with a gain of 0
        low, high = 0.25 * low, low
    for _ in range(DIGITS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if settles(middle) else (low, middle)
    return 0.999 * low
