"""The table of the harness on mechanisms with loops."""

import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial

import numpy as np

from validation.engines import Missing
from validation.engines.drake import Drake
from validation.engines.interface import CannotBuild, installed
from validation.loops.cases import AWAY, Case, ask_loop, ask_oracle, draw_case, oracle_of
from validation.loops.mechanisms import MECHANISMS
from validation.loops.peers import ExudynLoops, LoopPeer, MuJoCoLoops, PinocchioLoops
from validation.oracle.loops import Motion
from validation.report import Check, Section
from validation.tolerances import Tolerance, size, worst_of

ON_LOOPS = Tolerance(
    "loops",
    1e-10,
    "Eq. 9 at a pose whose rows magnify rounding by 1e4 at most; relative to what q̈ and the reactions are summed from",
)
LOOPS = ("pinocchio", "compiled")
PEERS: tuple[type[LoopPeer], ...] = (PinocchioLoops, MuJoCoLoops, ExudynLoops)
DRAKE = (
    "its constraints act on discrete plants only, where a step has an impulse and a state no acceleration or reaction"
)


def errors(answer: Motion, truth: Motion, case: Case) -> dict[str, float]:
    """Return how far an answer is from the truth, relative to what it is summed from."""
    motion, force = scales(case, truth)
    return {
        "q̈": size(answer.acceleration - truth.acceleration) / motion,
        "torque of the loops": size(answer.pulls - truth.pulls) / force,
        "force in the loops": size(answer.force - truth.force) / (force + size(truth.force)),
        "couple in the loops": size(answer.couple - truth.couple) / (force + size(truth.couple)),
        "f": abs(answer.contact - truth.contact) / (force + abs(truth.contact)),
    }


def scales(case: Case, truth: Motion) -> tuple[float, float]:
    """Return what q̈, and what torques are summed from, as sizes."""
    oracle = oracle_of(case.name).oracle
    H, C = oracle.mass_matrix(case.q), oracle.bias(case.q, case.v)
    parts = np.vstack([case.torque - C, *truth.pulls, truth.contact * (case.normal @ oracle.jacobian(case.q))])
    return size(np.linalg.solve(H, parts.T)), size(parts)


def worst_error(cases: Sequence[Case], ask: Callable[[Case], Motion]) -> tuple[float, str]:
    """Return the worst error over cases, and which quantity of which case it is."""
    return worst_of(cases, ask_oracle, lambda case, truth: errors(ask(case), truth, case))


def compare_on_loops(states: int, seed: int = 0, names: Sequence[str] = tuple(MECHANISMS)) -> Section:
    """Compare both engines of the loop with the oracle on every mechanism, and the peers that can hold its loops.

    states: cases a mechanism: tips away from everything, that press and that slide take turns
    seed: of the cases
    """
    section = Section(f"{len(names)} mechanisms with loops: worst relative error against Eqs. 1–10 by hand")
    for name in names:
        cases = [draw_case(name, seed, index) for index in range(states)]
        for engine in LOOPS:
            value, where = worst_error(cases, partial(ask_loop, engine=engine))
            passed = value <= ON_LOOPS.value
            section.checks.append(Check(f"{name}, {len(cases)} cases", engine, value, ON_LOOPS.value, passed, where))
        section.checks += _peers(name, [case for case in cases if case.touch == AWAY])
    section.checks.append(Check("all of them", Drake.name, math.nan, math.nan, None, DRAKE))
    return section


def _peers(name: str, cases: Sequence[Case]) -> Iterator[Check]:
    """Compare the peers at the cases whose tip is away, by q̈."""
    what = f"{name}, its loops only"
    for peer in PEERS:
        if not installed(peer):  # type: ignore[arg-type]
            yield Check(what, peer.name, math.nan, math.nan, None, str(Missing(peer.name, peer.install)))
            continue
        try:
            built = peer(name)
        except CannotBuild as error:
            yield Check(what, peer.name, math.nan, math.nan, None, str(error))
            continue
        value, _ = worst_error(cases, partial(_by_peer, built))
        yield Check(what, peer.name, value, peer.bound.value, value <= peer.bound.value, peer.bound.argument)


def _by_peer(built: LoopPeer, case: Case) -> Motion:
    """Return what a peer says, the rest as it is."""
    truth = ask_oracle(case)
    return Motion(built(case), truth.pulls, truth.force, truth.couple, truth.contact)
