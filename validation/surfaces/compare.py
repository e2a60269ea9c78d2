"""The tables of the harness on contact with surfaces."""

import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

import robot_models
from validation.engines import Engine, Missing, Refused, available
from validation.engines.drake import Drake
from validation.engines.exudyn import Exudyn
from validation.engines.loop import as_robot_model
from validation.engines.mujoco import MuJoCo
from validation.engines.pinocchio_cpp import PinocchioCpp
from validation.engines.robotics_toolbox import RoboticsToolbox
from validation.random_trees import random_robot
from validation.report_tables import Check, Section
from validation.surfaces.answers import Answer, Scales, ask_loop, ask_oracle, ask_peer
from validation.surfaces.cases import MATERIALS, SHAPES, SMOOTH, Case
from validation.surfaces.draw import draw_case
from validation.tolerances import Tolerance
from validation.worst import size, worst_of

ON_SURFACES = Tolerance(
    "surfaces",
    1e-10,
    "Eq. 24 at a pose that magnifies its entries' rounding by 1e4 at most, and the entries known to some thousand "
    "roundings; relative to what q̈ and F are summed from",
)
LOOPS = ("pinocchio", "compiled")
ARMS = ("planar2", "wam4", "panda", "ur5", "kinova")
# Those that take A q̈ = b as a row of their own, and one that takes none.
PEERS = (PinocchioCpp, MuJoCo, Exudyn, Drake, RoboticsToolbox)
ENGINES_WITHOUT_SHAPES = (
    "takes n and the right side of Eq. 24, which is where the curvature and the surface's motion stand; no peer has "
    "the row itself: they know pairs of shapes or tendons, whose Ṙ they do not give away"
)


def errors(answer: Answer, truth: Answer, scales: Scales) -> dict[str, float]:
    """Return how far an answer is from the truth, relative to the scales; e, ė and n in m, m/s and 1."""
    return {
        "q̈": size(answer.acceleration - truth.acceleration) / scales.acceleration,
        "F": size(answer.force - truth.force) / scales.force,
        "e": abs(answer.error - truth.error),
        "ė": abs(answer.rate - truth.rate),
        "n": size(answer.normal - truth.normal),
    }


def worst_error(cases: Sequence[Case], ask: Callable[[Case], Answer]) -> tuple[float, str]:
    """Return the worst error over cases, and which quantity of which case it is."""
    return worst_of(cases, ask_oracle, lambda case, truth: errors(ask(case), *truth[:2]))


def draw_cases(name: str, robot: Any, tip: str, seed: int, count: int) -> list[Case]:
    """Draw the first `count` cases of a seed on a robot."""
    return [draw_case(name, robot, tip, seed, index) for index in range(count)]


def compare_on_surfaces(states: int, trees: int, seed: int = 0) -> Section:
    """Compare both engines of the loop with the oracle: on the shipped arms and on random trees.

    states: cases an arm: shapes, materials and motions take turns, so that 30 have every pair of shape and material
    trees, seed: random trees, of 5 cases each; seed of the cases
    """
    title = f"curved, moving, rubbing and soft surfaces ({len(SHAPES)} shapes, {len(MATERIALS)} materials, 5 motions)"
    section = Section(f"{title}: worst relative error against Eqs. 2–3 by hand")
    groups = {}
    for name in ARMS:
        model = robot_models.load(name)
        groups[name] = draw_cases(name, model, str(model.tip), seed, states)
    drawn = []
    for k in range(trees):
        robot = random_robot(k)
        drawn += [
            draw_case(f"random:{k}", as_robot_model(robot, robot.tip), robot.tip, seed + 1, 5 * k + i) for i in range(5)
        ]
    if drawn:
        groups[f"{trees} random trees of 2 to 12 joints"] = drawn
    for name, cases in groups.items():
        for engine in LOOPS:
            value, where = worst_error(cases, partial(ask_loop, engine=engine))
            passed = value <= ON_SURFACES.value
            section.checks.append(Check(f"{name}, {len(cases)} cases", engine, value, ON_SURFACES.value, passed, where))
    section.checks += _peers(groups["panda"])
    return section


def _peers(cases: Sequence[Case]) -> Iterator[Check]:
    """Compare the peers at the cases whose row they can be given."""
    smooth = [case for case in cases if case.material == SMOOTH and not case.tool]
    model, tip = smooth[0].robot, smooth[0].tip
    what = f"the row given, panda, {len(smooth)} cases"
    for engine in available(model, tip, PEERS):
        if not isinstance(engine, Engine):
            yield Check(what, engine.name, math.nan, math.nan, None, _why_not(engine))
        elif "constrained" not in engine.covers:
            yield Check(what, engine.name, math.nan, math.nan, None, engine.cannot["constrained"])
        else:
            own = engine.tolerances.get("constrained")
            bound = max(ON_SURFACES.value, own.value if own else 0.0)
            value, _ = worst_error(smooth, partial(_ask_peer, engine))
            yield Check(what, engine.name, value, bound, value <= bound, ENGINES_WITHOUT_SHAPES)


def _ask_peer(engine: Engine, case: Case) -> Answer:
    return ask_peer(case, engine, ask_oracle(case)[2])


def _why_not(engine: Missing | Refused) -> str:
    return engine.install if isinstance(engine, Missing) else engine.reason
