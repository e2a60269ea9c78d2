"""Where the tip is to the surface at the start: on it, off it, or refused."""

from __future__ import annotations

from typing import Any

import numpy as np

from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError
from closedloop.control.reference.force import force_at
from closedloop.control.reference.on_surface import edge_key
from closedloop.control.reference.orientation import refuse_narrow
from closedloop.jit.parameters import lists_per_joint
from closedloop.jit.user_code import of_users
from closedloop.loop.events.phases import RESTING, TOUCHING
from closedloop.mechanics.closure.contact_force import FREE, PRESSED
from closedloop.mechanics.robot.pinocchio import Robot
from closedloop.mechanics.surface.compliance import largest_mobility
from closedloop.mechanics.surface.compliances.none import Rigid
from closedloop.mechanics.surface.kinds.plane import PlaneSurface
from closedloop.mechanics.surface.placed import PlacedSurface, Touching
from closedloop.mechanics.surface.surface import Surface
from closedloop.scenario.arm import has_stops, start_positions, start_posture, start_velocities
from closedloop.scenario.scenario import Scenario
from robot_models import RobotModel
from robot_models.model import AT_LIMIT

# Largest |e| of the tip at the start, m: with the paper's stabiliser the force due to a larger error would dominate, a
# thousand newtons for each kilogram of apparent mass and each millimetre.
START_GAP = 1e-3
# Largest |ė| of a tip in contact at the start, m/s: the rounding of a velocity given to four digits. The stabiliser has
# to stop it, with 0.14 N for each kilogram of apparent mass at the paper's setting; without one the error would grow.
START_RATE = 1e-4


def start_state(scenario: Scenario, model: RobotModel) -> tuple[Array, Array]:
    """Return q and q̇ (n,) as they are asked for and as the loop has them, refusing joints beyond their limits."""
    q = start_posture(scenario, model)
    v = start_velocities(scenario, model)
    if faults := [
        f"start.q[{j}] = {q[j]:g}: joint {model.joint_names[j]} of {model.name} moves within [{low:g}, {high:g}] "
        + ("m" if model.joint_types[j] == "prismatic" else "rad")
        for j, (low, high) in enumerate(zip(model.position_lower, model.position_upper, strict=True))
        if not low - AT_LIMIT <= q[j] <= high + AT_LIMIT
    ]:
        raise ScenarioError(*faults)
    return q, v


def refuse_combinations(scenario: Scenario, model: RobotModel) -> None:
    """Refuse what loops, and stops of joints, cannot be combined with."""
    stopped = has_stops(scenario, model)
    if scenario.reads_encoders and not np.any(model.measured):
        raise ScenarioError(f"encoder: {model.name} has joints that turn freely, which no encoder reads: leave it out")
    if scenario.robot.stop_restitution > 0.0 and not stopped:
        raise ScenarioError(
            "robot.stop_restitution: acts at the stops of joints; set robot.stops = true, or leave it out"
        )


def placed_surface(scenario: Scenario, robot: Robot, q: Array, v: Array) -> tuple[PlacedSurface, Touching, int]:
    """Return the surface, how the tip is to it at the start, and what it does on it."""
    section = scenario.surface
    terms = robot.terms(q, v)
    tip = terms.position
    soft = not isinstance(scenario.compliance, Rigid)
    pressed = max(0.0, float(force_at(scenario.force_profile, scenario.law.force, np.zeros(1))[0]))
    with of_users(scenario.compliance, "compliance.kind"):
        depth = scenario.compliance.static_depth(pressed) if soft and not section.gap else 0.0
    surface = PlacedSurface.of(section, scenario.surface_motion, tip, depth, scenario.tool.radius)
    if scenario.tool.radius > 0.0 and not surface.fixed_plane and surface.below_start:
        refuse_narrow(surface, np.zeros(1), surface.origin[None], scenario.tool.radius)
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
        mobility = largest_mobility(terms.mass_matrix, now.frame[:1] @ terms.jacobian)
        if now.inside >= 0.0 and (thrown := scenario.compliance.thrown_out(-gap, mobility)):
            raise ScenarioError(f"{given}: the tip starts {-gap:.4g} m inside the surface{thrown}: {at_most}")
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


def refuse_lengths(scenario: Scenario, model: RobotModel) -> None:
    """Refuse lists that have not one entry for each joint, all of them at once."""
    faults: list[str] = []
    for start in (start_positions, start_velocities):
        try:
            start(scenario, model)
        except ScenarioError as error:
            faults += error.faults
    for name, values in lists_per_joint(scenario.law).items():
        if len(values) != model.n:
            joints = ", ".join(model.joint_names)
            faults.append(f"law.{name} has {len(values)} entries: {model.name} has {model.n} joints, {joints}")
    if faults:
        raise ScenarioError(*faults)
