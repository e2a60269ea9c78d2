"""What the harness runs: the robots, the random trees, the identities, the published numbers, the slide, the faults."""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import robot_models
from validation.comparison import Cell, Comparison, build_all, compare, missing_cells, tip_of
from validation.engines import ENGINES, Engine, Missing, available
from validation.engines.loop import ClosedLoop, Compiled
from validation.engines.symbolic import Symbolic
from validation.identities import Residual, Sample, check_all, draw_sample, unanswered
from validation.loops.andrews import compare_with_published
from validation.loops.compare import compare_on_loops
from validation.oracle import Oracle
from validation.plant import Catch
from validation.report import Check, Report, Section
from validation.states import draw_states, random_robot, random_state
from validation.surfaces.answers import compare_on_surfaces, soft_contact_section

# Name in the report -> how to load it. wam4 stands twice: its drives carry half of its inertia.
ROBOTS: dict[str, tuple[str, bool]] = {
    "planar2": ("planar2", True), "wam4": ("wam4", True), "wam4 without drives": ("wam4", False),
    "panda": ("panda", True), "ur5": ("ur5", True), "kinova": ("kinova", True),
    "free bodies": (str(Path(__file__).with_name("free_bodies.xml")), True),
}  # fmt: skip
RANDOM = "random:"


def load_robot(name: str) -> Any:
    """Return a robot by the name that a report gives it: a robot above, ``random:SEED``, or what `robot_models` loads.

    Raises `ModelError` if there is none.
    """
    if name in ROBOTS:
        model, drives = ROBOTS[name]
        return robot_models.load(model, drive_inertia=drives)
    if name.startswith(RANDOM):
        seed = name.removeprefix(RANDOM)
        if not seed.isdigit():
            raise robot_models.ModelError(f"--robot {name}: a random robot is named by its seed, such as random:7")
        return random_robot(int(seed))
    return robot_models.load(name)


def compare_with_truth(
    model: Any, tip: str | None, states: int, seed: int, engines: Sequence[type[Engine]], label: str
) -> list[Comparison]:
    """Compare all engines with the oracle, and all, the oracle too, with fifty digits where there are some."""
    tip = tip_of(model, tip)
    by_hand = [engine for engine in ENGINES if engine is not Symbolic]
    ready = [*available(model, tip, by_hand), *build_all(engines, model, tip)]
    (truth,) = available(model, tip, [Symbolic])
    found = [compare(model, tip, states=states, seed=seed, built=ready, label=label)]
    if isinstance(truth, Engine):
        fewer = max(1, states // 5)  # fifty digits take their time
        found.append(compare(model, tip, states=fewer, seed=seed, built=[truth, *ready], label=label, judge="symbolic"))
    else:
        found[0].cells += missing_cells(found[0].robot, truth)
    return found


def compare_random_trees(trees: int, states: int, engines: Sequence[type[Engine]] = ()) -> Comparison:
    """Compare all engines on random trees and return one table, each cell the worst over the trees.

    A cell's `robot` names the tree that gave it, so that `load_robot` finds it again.
    """
    found = [
        compare(random_robot(seed), states=states, seed=seed, engines=engines, label=f"{RANDOM}{seed}")
        for seed in range(trees)
    ]
    merged: dict[tuple[str, str], Cell] = {}
    counts: dict[tuple[str, str], int] = {}
    for comparison in found:
        for cell in comparison.cells:
            key = (cell.engine, cell.quantity)
            counts[key] = counts.get(key, 0) + cell.states
            if key not in merged or _rank(cell) > _rank(merged[key]):
                merged[key] = cell
    cells = [replace(cell, states=counts[key]) for key, cell in merged.items()]
    probes = {name: text for comparison in found for name, text in comparison.probes.items()}
    label = f"{trees} random trees of 2 to 12 joints"
    return Comparison(label, "tip", found[0].reference, 0, sum(c.states for c in found), cells, probes)


def _rank(cell: Cell) -> tuple[int, float]:
    """Order cells so that the one to be shown is the largest: a disagreement, then the worst value, then none."""
    order = {"disagrees": 2, "agrees": 1}.get(cell.status, 0)
    return order, -1.0 if math.isnan(cell.margin) else cell.margin


def check_identities(trees: int, states: int) -> Section:
    """Check every identity on random trees, for the oracle by complex step and for our own terms by differences."""
    section = Section("identities that need no second engine, on random trees")
    judged: list[tuple[str, Callable[[Any], Any]]] = [
        ("oracle", lambda robot: Oracle(robot.tree, robot.tip)),
        ("closedloop", lambda robot: ClosedLoop(robot, robot.tip)),
        ("compiled", lambda robot: Compiled(robot, robot.tip)),
    ]
    for name, make in judged:
        pairs = []
        for seed in range(trees):
            robot, rng = random_robot(seed), np.random.default_rng([seed, 1])
            engine = make(robot)
            pairs += [(engine, draw_sample(*random_state(robot, rng), rng)) for _ in range(states)]
        section.checks += _worst_residuals(name, pairs)
        section.checks += [
            Check(identity.replace("_", " "), name, math.nan, math.nan, None, f"has no {', '.join(methods)}")
            for identity, methods in unanswered(pairs[0][0]).items()
        ]
    return section


def check_robot_identities(model: Any, tip: str, states: int, seed: int) -> Section:
    """Check every identity on one robot, for every engine that is installed and can build it."""
    section = Section(f"identities on {model.name}")
    for engine in available(model, tip):
        if isinstance(engine, Engine):
            drawn = draw_states(model, engine, seed, states)
            rng = np.random.default_rng([seed, 2])
            pairs = [(engine, draw_sample(state.q, state.v, rng)) for state in drawn]
            section.checks += _worst_residuals(engine.name, pairs)
    return section


def _worst_residuals(name: str, pairs: Sequence[tuple[Any, Sample]]) -> list[Check]:
    """Return, for each identity that the engines can be asked, the worst residual over (engine, sample)."""
    worst: dict[str, Residual] = {}
    for engine, sample in pairs:
        for identity, residual in check_all(engine, sample).items():
            if identity not in worst or not residual.value <= worst[identity].value:
                worst[identity] = residual
    return [
        Check(identity.replace("_", " "), name, r.value, r.tolerance, r.passed, r.argument)
        for identity, r in worst.items()
    ]


def run_suite(
    *, states: int = 1000, seed: int = 0, quick: bool = False, engines: Sequence[type[Engine]] = (),
    say: Callable[[str], None] = lambda text: None,
) -> Report:  # fmt: skip
    """Run everything that needs no choice of the user's: the default of ``python -m validation.run``.

    states, seed: states drawn for each robot, and the seed
    quick: fewer random trees, and no slide: a few seconds with a tenth of the states
    engines: more engines to judge
    say: gets a word on what is being done
    """
    report = Report()
    for label in ROBOTS:
        say(f"comparing the engines on {label}")
        model = load_robot(label)
        report.comparisons += compare_with_truth(model, None, states, seed, engines, label)
    trees = 6 if quick else 30
    say("comparing the engines on random trees")
    report.comparisons.append(compare_random_trees(trees, 4, engines))
    say("checking identities")
    report.sections.append(check_identities(trees, 2))
    say("touching surfaces that are curved, move and give way")
    report.sections.append(compare_on_surfaces(5 if quick else 15, 3 if quick else 12, seed))
    report.sections.append(soft_contact_section(seed))
    say("closing loops")
    report.sections.append(compare_on_loops(3 if quick else 12, seed))
    report.sections.append(compare_with_published(quick))
    report.sections += list(_published(say))
    if not quick:
        say("sliding in every engine that can")
        report.sections.append(_slides())
        report.sections.append(_compiled_runs(say))
    return report


def _published(say: Callable[[str], None]) -> Iterable[Section]:
    from validation.anchors import grade, reference_problems

    say("grading against published numbers")
    section = Section("published and closed-form results: the worst error over its tolerance")
    for problem in reference_problems():
        for name, factory in (("oracle", Oracle.from_model), ("closedloop", ClosedLoop)):
            grades = grade(factory, problem)
            covered = [g for g in grades if g.covered]
            worst = max((g.error / g.tolerance for g in covered), default=math.nan)
            verdict = all(g.passed for g in covered) if covered else None
            title = f"{problem.name}: {len(covered)} of {len(grades)} cases"
            missing = "".join(f"; {g.quantity} not covered" for g in grades if not g.covered)
            section.checks.append(Check(title, name, worst, 1.0, verdict, f"{problem.source}{missing}"))
    yield section


def _slides() -> Section:
    """Compare the whole slide, or its beginning, with every engine that can run it."""
    from validation.engines.slides import compare_slides

    section = Section("wam_slide, trajectory against trajectory")
    for check in compare_slides():
        if isinstance(check, Missing):
            section.checks.append(Check("the slide", check.name, math.nan, math.nan, None, check.install))
        else:
            section.checks.append(
                Check(check.what, check.engine, check.error, check.tolerance, check.passed, check.argument)
            )
    return section


def _compiled_runs(say: Callable[[str], None]) -> Section:
    """Compare whole runs of the compiled engine with those on Pinocchio, on every shipped scenario."""
    from validation.engines.slides import compare_compiled

    section = Section("shipped scenarios, compiled engine against Pinocchio: the error over what rounding becomes")
    for check in compare_compiled(say):
        section.checks.append(
            Check(check.what, check.engine, check.error, check.tolerance, check.passed, check.argument)
        )
    return section


def faults_section(robot: str, catches: Sequence[Catch]) -> Section:
    """Return the table of planted faults: one line for each fault in each engine, passed if it was caught."""
    section = Section(f"faults planted in {robot}: the margin is the error over its tolerance")
    for c in catches:
        how = f"{c.quantity}, {c.by}" if c.caught else f"UNSEEN: nearest was {c.quantity}, {c.by}"
        section.checks.append(Check(c.fault, c.engine, c.margin, 1.0, c.caught, how))
    return section
