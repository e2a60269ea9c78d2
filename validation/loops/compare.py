"""The table of the harness on mechanisms with loops, and faults planted in each term that loop joints have.

They are planted in the oracle and in both engines of the loop. The loop calls what answers for the loops by its
address: a fault in it is a function in Python that has the sound one answer and spoils what it has left in the memory,
as the fault in the source would.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import partial
from types import MethodType
from typing import Any, cast

import numpy as np

from closedloop.jit.calls import integers_at
from closedloop.jit.interpreted import interpreted
from closedloop.loop.step.closed_loops import BIND_TIP, DRIVE
from closedloop.loop.step.memory import loop_at
from closedloop.mechanics.closure.solve import forward_substitute
from closedloop.mechanics.loops.factor import meet
from closedloop.mechanics.loops.memory import GEAR, LoopMemory, loops_at
from closedloop.mechanics.loops.reactions import lose_undriven
from closedloop.mechanics.loops.solve import leave_free, multiply_transposed, take_free
from robot_models.loop_joint import LoopJoint
from validation.engines import Missing
from validation.engines.drake import Drake
from validation.engines.interface import CannotBuild, Tolerance, installed, size, worst_of
from validation.loops.cases import AWAY, MECHANISMS, Case, Entry, LoopFault, ask_loop, ask_oracle, draw_case, oracle_of
from validation.loops.peers import ExudynLoops, LoopPeer, MuJoCoLoops, PinocchioLoops
from validation.oracle.loops import LoopOracle, Motion
from validation.oracle.loops import LoopRows as RowsByHand
from validation.plant import Catch, catch_of
from validation.report import Check, Section

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

    Tips away from everything, that press and that slide take turns in the `states` cases of a mechanism.
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


# So many cases of the mechanism that has what a fault touches.
CASES = 3


@dataclass(frozen=True)
class Fault:
    """A fault in a term that loop joints have.

    mechanism: one that has the term
    oracle: LoopOracle -> the faulty one
    loop: the same in the loop
    """

    name: str
    mechanism: str
    oracle: Callable[[LoopOracle], LoopOracle]
    loop: LoopFault


def _with(**methods: Callable[..., Any]) -> Callable[[LoopOracle], LoopOracle]:
    """Return a fault of the oracle: methods in place of its own."""

    def fault(sound: LoopOracle) -> LoopOracle:
        faulty = copy(sound)
        for name, method in methods.items():
            setattr(faulty, name, MethodType(method, faulty))
        return faulty

    return fault


def _spoiled(what: int, spoil: Callable[[LoopMemory, Any], None]) -> Callable[[Entry], Entry]:
    """Return a fault of the loop: what the sound entry has left after one kind of request is spoiled."""

    def fault(sound: Entry) -> Entry:
        def entry(address: int, asked: int) -> int:
            answer = sound(address, asked)
            if asked == what:
                memory = LoopMemory(*interpreted(loops_at)(address))
                spoil(memory, interpreted(loop_at)(int(memory.links.loop))[2])
            return answer

        return entry

    return fault


def _with_drift(drift: Callable[[LoopMemory], np.ndarray[Any, Any]]) -> Callable[[Entry], Entry]:
    """Return a fault of the loop: another drift of its rows."""

    def spoil(memory: LoopMemory, w: Any) -> None:
        links, rows = memory
        w.tip.drift_c[:] -= rows.moved
        interpreted(meet)(links, rows, -drift(memory))
        rows.part[:] = rows.met
        interpreted(multiply_transposed)(w.L, rows.part, int(links.n))
        interpreted(take_free)(links, rows, rows.part)
        for k in range(3):
            row = np.array(w.tip.A[k])
            interpreted(forward_substitute)(w.L, row, 0, len(row))
            rows.moved[k] = row @ rows.part
        w.tip.drift_c[:] += rows.moved

    return _spoiled(BIND_TIP, spoil)


def _gears_without_curvature(memory: LoopMemory) -> np.ndarray[Any, Any]:
    kinds = np.asarray(integers_at(int(memory.links.bound), int(memory.links.m)))
    return np.where(kinds == GEAR, 0.0, memory.rows.drift)


def _one_direction_more(memory: LoopMemory, w: Any) -> None:
    """Bind what rounding leaves of a row that depends on the others, as if it were a row of its own."""
    links, rows = memory
    links.free, links.spanned = 1, 0  # of a mechanism that has one way to move
    for k in range(3):
        interpreted(leave_free)(links, rows, w.tip.X[k])
    w.tip.S[:] = np.array(w.tip.X) @ np.array(w.tip.X).T


def _counted(self: LoopOracle, q: Any, v: Any) -> list[RowsByHand]:
    """Give the first loop joint a row more, along what rounding has left of a dependent one."""
    first, *others = LoopOracle.all_rows(self, q, v)
    along = np.eye(len(q))[:1]
    return [RowsByHand(np.vstack([first.A, along]), np.append(first.drift, 0.0), first.forces), *others]


def _cut_instead(sound: Entry) -> Entry:
    def entry(address: int, asked: int) -> int:
        if asked != DRIVE:
            return sound(address, asked)
        memory = LoopMemory(*interpreted(loops_at)(address))
        w = interpreted(loop_at)(int(memory.links.loop))[2]
        interpreted(lose_undriven)(memory.rows.undriven, int(memory.links.undriven), w.torque)
        return 0

    return entry


def _moved(sound: LoopOracle) -> LoopOracle:
    loops = tuple(
        replace(joint, points=((joint.points[0][0], joint.points[0][1], joint.points[0][2] + 1e-6), joint.points[1]))
        for joint in cast("Sequence[LoopJoint]", sound.loops)
    )
    return LoopOracle(
        sound.oracle, loops, [name for name, on in zip(sound.oracle.tree.names, sound.driven, strict=True) if on]
    )


FAULTS = (
    Fault(
        "drift of the loops' rows dropped", "four_bar",
        _with(rows=lambda self, *at: replace((found := LoopOracle.rows(self, *at)), drift=0.0 * found.drift)),
        LoopFault(entry=_with_drift(lambda memory: np.zeros(int(memory.links.m)))),
    ),
    Fault(
        "sign of the reaction", "delta", _with(reaction=lambda self, forces: -forces),
        LoopFault(reactions=lambda found: -found),
    ),
    Fault(
        "a row that depends on others counted as its own", "four_bar", _with(all_rows=_counted),
        LoopFault(entry=_spoiled(BIND_TIP, _one_direction_more)),
    ),
    Fault(
        "a gear's curvature dropped", "gears", _with(curvature=lambda self, joint, x: 0.0),
        LoopFault(entry=_with_drift(_gears_without_curvature)),
    ),
    Fault(
        "torque of joints without a drive not passed on", "five_bar",
        _with(through_drives=lambda self, torque, G: np.where(self.driven, torque, 0.0)), LoopFault(entry=_cut_instead),
    ),
    Fault(
        "a point of a loop joint 1 µm off", "delta", _moved,
        LoopFault(bound=lambda memory: np.copyto(memory.rows.at_a[:, 1], memory.rows.at_a[:, 1] + 1e-6)),
    ),
)  # fmt: skip


def plant_on_loops(seed: int = 0, faults: Sequence[Fault] = FAULTS) -> list[Catch]:
    """Plant every fault in the oracle and in both engines of the loop, and return what caught it."""
    catches = []
    for fault in faults:
        cases = [draw_case(fault.mechanism, seed, 3 * k) for k in range(CASES)]
        for carrier in ("oracle", *LOOPS):
            catches.append(_caught(fault, carrier, cases))
    return catches


def _caught(fault: Fault, carrier: str, cases: list[Case]) -> Catch:
    """Compare the faulty one with a sound one: the oracle, or a loop where the oracle is faulty."""

    def found(case: Case) -> dict[str, float]:
        if carrier == "oracle":
            return errors(ask_loop(case, LOOPS[0]), ask_oracle(case, fault.oracle(oracle_of(case.name))), case)
        return errors(ask_loop(case, carrier, fault.loop), ask_oracle(case), case)

    return catch_of(fault.name, carrier, map(found, cases), ON_LOOPS.value)
