"""Negative controls: faults planted on purpose, each of which the comparison must notice.

A check that has never failed proves nothing. Every fault is planted in every engine that it can be planted in, one at a
time, and the faulty engine is compared with a sound one at a few states. What caught it, and by how many times its
tolerance, is the margin by which the harness would see such a fault in earnest. A fault that goes unseen fails the
command.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

import robot_models
from robot_models.coordinates import balls
from validation.comparison import Comparison, compare, tip_of
from validation.engines import ENGINES, Engine, available
from validation.engines.hand_written import HandWritten
from validation.engines.loop import ClosedLoop, Compiled
from validation.plant_faults import FAULTS, TREE_FAULTS, Fault

# Enough that some state shows every fault; the smallest margin found is far above one.
STATES = 10


@dataclass(frozen=True)
class Catch:
    """What became of one fault in one engine.

    fault, engine: what was planted, and where
    caught: whether some quantity went out of tolerance
    quantity, by: the quantity that showed it most, and the pair of engines that disagreed
    margin: error over tolerance; inf where a probe caught it
    """

    fault: str
    engine: str
    caught: bool
    quantity: str
    by: str
    margin: float


def catch_of(fault: str, carrier: str, found: Iterable[Mapping[str, float]], bound: float, by: str = "") -> Catch:
    """Return what became of a fault planted in the oracle or in the loop, by the errors of several cases.

    Without `by` what the carrier was compared with is the other of the two.
    """
    worst, quantity = 0.0, "nothing"
    for errors in found:
        for name, value in errors.items():
            if value > worst:
                worst, quantity = value, name
    by = by or ("the oracle" if carrier != "oracle" else "the loop on Pinocchio")
    margin = worst / bound
    return Catch(fault, carrier, margin > 1.0, quantity, by, margin)


def plant_all(
    robot: Any = "wam4", tip: str | None = None, *, seed: int = 0, states: int = STATES, faults: Sequence[Fault] = ()
) -> list[Catch]:
    """Plant every fault in every engine of a robot, in turn, and return what caught it.

    Raises `ModelError` if the robot cannot be loaded.
    """
    model: Any = robot_models.load(robot) if isinstance(robot, str) else robot
    name = tip_of(model, tip)
    judges = [engine for engine in available(model, name, _judges(model)) if isinstance(engine, Engine)]
    catches = []
    for fault in faults or FAULTS:
        faulty_model = fault.robot(model) if fault.robot else model
        if faulty_model is None:
            continue
        # The symbolic engine knows two robots by heart and reads no text to plant a fault in.
        for engine in available(faulty_model, name, [each for each in ENGINES if each.name != "symbolic"]):
            if not isinstance(engine, Engine):
                continue
            sound = next(judge for judge in judges if judge.name != engine.name)
            with planted(engine, fault, judges[0]) as touched:
                if touched:
                    report = compare(model, name, states=states, seed=seed, built=[sound, engine])
                    catches.append(_verdict(fault, engine, report))
    return catches


def _judges(model: Any) -> tuple[type[Engine], type[Engine]]:
    """Return the engine that a faulty one is compared with, and the one that the former itself is compared with."""
    return (ClosedLoop, Compiled) if balls(getattr(model, "joint_types", ())) else (HandWritten, ClosedLoop)


def plant_runs() -> list[Catch]:
    """Plant every fault of the compiled engine's arrays in a run, in turn: a slide in which every joint moves."""
    from validation.engines.slides import compare_runs, faulty_tree

    slide = {"reference.direction": [0.6, 0.8, 0.0], "reference.stop": 1.0, "time.duration": 1.2}
    catches = []
    for name, fault in TREE_FAULTS.items():
        with faulty_tree(fault):
            (check,) = compare_runs("wam_slide", slide)
        by = "the run on Pinocchio"
        catches.append(Catch(f"{name}, in a run", "compiled", not check.passed, "the rows", by, check.error))
    return catches


@contextmanager
def planted(engine: Engine, fault: Fault, sound_engine: Engine) -> Iterator[bool]:
    """Give the engine the fault's methods or tree for a while; yields whether the engine has the fault."""
    if fault.tree:
        sound = engine.tree if isinstance(engine, Compiled) else None
        faulty = None if sound is None else fault.tree(sound)
        if faulty is None:
            yield False
            return
        assert isinstance(engine, Compiled)
        assert sound is not None
        engine.tree = faulty
        try:
            yield True
        finally:
            engine.tree = sound
        return
    methods = fault.methods(engine, sound_engine) if fault.methods else {}
    if fault.methods and not methods:
        yield False
        return
    kind = type(engine)
    if methods:
        engine.__class__ = type(f"Faulty{kind.__name__}", (kind,), methods)
    try:
        yield True
    finally:
        engine.__class__ = kind


def _verdict(fault: Fault, engine: Engine, report: Comparison) -> Catch:
    worst = report.worst
    if worst is None:
        return Catch(fault.name, engine.name, False, "nothing was compared", "", 0.0)
    by = f"{worst.engine} against {report.reference}"
    quantity = "the probe of its constraint" if np.isinf(worst.margin) and worst.reason else worst.quantity
    return Catch(fault.name, engine.name, worst.status == "disagrees", quantity, by, worst.margin)
