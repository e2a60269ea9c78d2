"""Faults planted in each term that a plane at rest does not have, in the oracle and in both engines of the loop.

The loop is compiled: what can be made wrong in it is what it calls and what it is given, which are a surface that
forgets a derivative, a motion that does, a stiffness in another unit, an arm without its tool.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

import robot_models
from closedloop.jit.calls import call_at
from closedloop.jit.kernel import entry_kernel
from closedloop.jit.parameters import parameter_block
from closedloop.jit.user_code import function_of
from closedloop.mechanics.surface.contact import FOUND, NO_NORMAL, ask_at
from closedloop.mechanics.surface.geometry import Pose, Touch, contact_geometry, frame_and_turning, into_surface_axes
from closedloop.mechanics.surface.kinds.ellipsoid import Ellipsoid
from closedloop.mechanics.surface.placed import PlacedSurface
from closedloop.mechanics.surface.surface import Surface
from closedloop.simulation.engines.problem import Problem
from validation.oracle.spatial import Array
from validation.oracle.surface import Shape, SurfaceContact
from validation.plant import Catch, catch_of
from validation.surfaces.answers import LOOPS, ON_SURFACES, ask_loop, ask_oracle, errors, problem_of
from validation.surfaces.cases import MATERIALS, SMOOTH, SOFT, Case, Tumble, draw_case, oracle_with_tool

# So many cases that have what a fault touches.
CASES = 3
_level = function_of(Ellipsoid, "level")


class NoCurvature(Ellipsoid):
    """An ellipsoid whose ∇∇φ is forgotten."""

    @staticmethod
    def level(p: Array, par: Any, gradient: Array, hessian: Array) -> float:
        """Return φ, and ∇φ alone."""
        value = _level(p, par, gradient, hessian)
        for i in range(3):
            hessian[i, i] = 0.0
        return float(value)


class WrongCurvature(Ellipsoid):
    """An ellipsoid whose ∇∇φ has the wrong sign."""

    @staticmethod
    def level(p: Array, par: Any, gradient: Array, hessian: Array) -> float:
        """Return φ, ∇φ and −∇∇φ."""
        value = _level(p, par, gradient, hessian)
        for i in range(3):
            hessian[i, i] = -hessian[i, i]
        return float(value)


_move = function_of(Tumble, "move")


class NoVelocity(Tumble):
    """A motion whose velocity is forgotten."""

    @staticmethod
    def move(t: float, par: Any, m: Any) -> None:
        """Write displacement and acceleration."""
        _move(t, par, m)
        m.rate = 0.0
        for i in range(3):
            m.shift_rate[i] = 0.0


class NoAcceleration(Tumble):
    """A motion whose acceleration is forgotten."""

    @staticmethod
    def move(t: float, par: Any, m: Any) -> None:
        """Write displacement and velocity."""
        _move(t, par, m)
        m.acceleration = 0.0
        for i in range(3):
            m.shift_acceleration[i] = 0.0


_Parameters = parameter_block(Ellipsoid)


@entry_kernel
def _entry_without_turning(address: int, what: int) -> int:
    """Answer as the entry of an ellipsoid, but for a contact frame that is taken not to turn: u̇ = N (r̈ − d/dt v₀)."""
    links, ask = ask_at(address)
    call_at(links.motion, address, 0)
    pose, touch = Pose(ask.pose), Touch(ask.touch)
    into_surface_axes(pose, ask.r, touch)
    touch.level = _level(touch.at, _Parameters(ask.par, links.entries), touch.gradient, touch.hessian)
    if not contact_geometry(pose, links.motion != 0, ask.r, ask.velocity, ask.frame, touch):
        return NO_NORMAL
    t0, t1, t2 = touch.turning[0], touch.turning[1], touch.turning[2]
    x0, x1, x2 = touch.at[0], touch.at[1], touch.at[2]
    going = touch.at  # scratch: the velocity relative to the surface, in its axes
    for i in range(3):
        going[i] = 0.0
        for k in range(3):
            along = -touch.carried[k]
            for j in range(3):
                along += ask.frame[k, j] * ask.velocity[j]
            going[i] += touch.local[k, i] * along
    frame_and_turning(going, touch)
    w0 = pose.axes[0, 0] * going[0] + pose.axes[1, 0] * going[1] + pose.axes[2, 0] * going[2]
    w1 = pose.axes[0, 1] * going[0] + pose.axes[1, 1] * going[1] + pose.axes[2, 1] * going[2]
    w2 = pose.axes[0, 2] * going[0] + pose.axes[1, 2] * going[1] + pose.axes[2, 2] * going[2]
    o = pose.spin
    x, y, z = o[1] * w2 - o[2] * w1, o[2] * w0 - o[0] * w2, o[0] * w1 - o[1] * w0
    for i in range(3):
        turned = ask.frame[i, 0] * x + ask.frame[i, 1] * y + ask.frame[i, 2] * z
        touch.turning[i] = (t0 if i == 0 else (t1 if i == 1 else t2)) - touch.turning[i] + turned
    touch.at[0], touch.at[1], touch.at[2] = x0, x1, x2
    return FOUND


class NotTurning(PlacedSurface):
    """A surface with that entry."""

    def entries(self) -> dict[str, Any]:
        """Return what the loop calls."""
        return super().entries() | {"surface": _entry_without_turning}


@dataclass(frozen=True)
class SurfaceFault:
    """A fault in a term that curved, moving or soft surfaces have.

    case, material: number of a case that has the term, and what its surface is made of
    oracle, loop: SurfaceContact or Problem, and the case -> the faulty one
    """

    name: str
    case: int
    material: str
    oracle: Callable[[SurfaceContact, Case], SurfaceContact]
    loop: Callable[[Problem, Case], Problem]


def _bent(factor: float) -> Callable[[SurfaceContact, Case], SurfaceContact]:
    """Return a fault of the oracle: ∇∇φ times a factor."""

    def fault(contact: SurfaceContact, case: Case) -> SurfaceContact:
        sound = contact.shape
        return replace(contact, shape=Shape(sound.level, sound.gradient, lambda p: factor * sound.hessian(p)))

    return fault


def _without(**methods: Callable[..., Array]) -> Callable[[SurfaceContact, Case], SurfaceContact]:
    """Return a fault of the oracle: methods in place of its own."""
    kind = type("FaultyContact", (SurfaceContact,), methods)
    return lambda contact, case: kind(**contact.__dict__)


def _shaped(member: type[Surface]) -> Callable[[Problem, Case], Problem]:
    """Return a fault of the loop: another class of surface, with the same parameters."""

    def fault(problem: Problem, case: Case) -> Problem:
        own = {key: value for key, value in case.section.items() if key != "kind"}
        return replace(problem, surface=replace(problem.surface, section=member(**own)))

    return fault


def _moving(member: type[Tumble]) -> Callable[[Problem, Case], Problem]:
    """Return a fault of the loop: another class of motion, with the same parameters."""
    return lambda problem, case: replace(
        problem, surface=replace(problem.surface, motion=member(**case.moving.model_dump(exclude={"kind"})))
    )


def _stiffness_per_mm(problem: Problem, case: Case) -> Problem:
    numbers = problem.compliance.numbers * [1e-3, 1.0]
    return replace(problem, compliance=problem.compliance._replace(numbers=numbers))


def _bare_arm(problem: Problem, case: Case) -> Problem:
    return replace(problem, robot=problem_of(replace(case, tool={}), problem.surface).robot)


FAULTS = (
    SurfaceFault("curvature dropped", 4, SMOOTH, _bent(0.0), _shaped(NoCurvature)),
    SurfaceFault("Hessian sign", 4, SMOOTH, _bent(-1.0), _shaped(WrongCurvature)),
    SurfaceFault(
        "Ṅ dropped", 4, SMOOTH, _without(frame_rate=lambda self, *at: np.zeros((3, 3))),
        lambda problem, case: replace(problem, surface=NotTurning(**_fields(problem.surface))),
    ),
    SurfaceFault(
        "surface velocity dropped", 4, SMOOTH, _without(surface_velocity=lambda self: np.zeros(6)), _moving(NoVelocity)
    ),
    SurfaceFault(
        "surface acceleration dropped", 4, SMOOTH, _without(surface_acceleration=lambda self: np.zeros(6)),
        _moving(NoAcceleration),
    ),
    SurfaceFault(
        "stiffness per mm", 4, SOFT, lambda contact, case: replace(contact, push=_softer(case)), _stiffness_per_mm
    ),
    SurfaceFault(
        "tool dropped", 14, SMOOTH,
        lambda contact, case: replace(contact, oracle=oracle_with_tool(case.robot, case.tip, {})), _bare_arm,
    ),
)  # fmt: skip


def _fields(surface: PlacedSurface) -> dict[str, Any]:
    return {name: getattr(surface, name) for name in ("section", "motion", "frame", "origin", "below_start")}


def _softer(case: Case) -> Callable[[float, float], float]:
    par = MATERIALS[case.material]["compliance"]
    return lambda depth, speed: 1e-3 * par["stiffness"] * depth + par["damping"] * speed


def plant_on_surfaces(robot: str = "panda", seed: int = 0, faults: Sequence[SurfaceFault] = FAULTS) -> list[Catch]:
    """Plant every fault in the oracle and in both engines of the loop, and return what caught it."""
    model = robot_models.load(robot)
    catches = []
    for fault in faults:
        cases = [
            replace(draw_case(robot, model, str(model.tip), seed, fault.case + 30 * k), material=fault.material)
            for k in range(CASES)
        ]
        for carrier in ("oracle", *LOOPS):
            catches.append(_caught(fault, carrier, cases))
    return catches


def _caught(fault: SurfaceFault, carrier: str, cases: list[Case]) -> Catch:
    """Compare the faulty one with a sound one: the oracle, or a loop where the oracle is faulty."""

    def found(case: Case) -> dict[str, float]:
        if carrier == "oracle":
            truth, scales, _ = ask_oracle(case, lambda contact: fault.oracle(contact, case))
            return errors(ask_loop(case, LOOPS[0]), truth, scales)
        truth, scales, _ = ask_oracle(case)
        return errors(ask_loop(case, carrier, lambda problem: fault.loop(problem, case)), truth, scales)

    return catch_of(fault.name, carrier, map(found, cases), ON_SURFACES.value)
