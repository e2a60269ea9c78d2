"""Which simulations may be stepped in SIMD lanes, and memory: see `closedloop.simulation.together.lane_steps`."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from closedloop.jit.calls import address_of, entry_address
from closedloop.jit.kernel import jit_disabled, plain
from closedloop.jit.simd8 import aligned
from closedloop.loop.step.memory import RIGID_STICK, SMOOTH, Constants, State, Work
from closedloop.loop.step.record_row import Row
from closedloop.mechanics.robot.tree import work_size
from closedloop.simulation.engines.problem import Problem
from closedloop.simulation.together.lane_steps import step_in_lanes
from closedloop.simulation.together.records import GROUP, Group, Kept, LaneConstants


def may_step_in_lanes(problem: Problem, state: State, constants: Constants, w: Work) -> bool:
    """Whether a simulation whose torque is held may be stepped in lanes while its tip is on the surface."""
    settings, friction = state.settings, state.friction
    called = (state.surface, state.ball, state.compliance, state.loops, state.contacts, state.joint_friction)
    # The states of a law that is not asked act on nothing, unless they are recorded or its functions may raise.
    has_memory = bool(friction.states or constants.lag > 0.0 or settings.states_at)
    members = problem.friction.member, problem.law.member
    asked = (
        settings.stages != 1, not settings.semi_implicit, settings.adaptive, settings.project, settings.encoder,
        settings.elastic, settings.drives, settings.arm_at, settings.balls,
    )  # fmt: skip
    return (
        not jit_disabled()
        and not any(each.entry for each in called)
        and not any(asked)
        and not has_memory
        and friction.sticking in (SMOOTH, RIGID_STICK)
        and all(each.__module__.startswith("closedloop.") for each in members)
        and not np.isfinite(w.tip.inside)
    )


class Lanes:
    """The memory of one thread for members of one mode; see `closedloop.simulation.together.records.Group`.

    Parameters
    ----------
    problem : Problem
        One of the members, for the sizes.
    mode : int
        PRESSED or STUCK.
    steps : int
        Between two control instants.
    arrays : dict of arrays
        By name those that `Group` has the addresses of, of all members.
    """

    def __init__(self, problem: Problem, mode: int, steps: int, arrays: dict[str, NDArray[Any]]) -> None:
        n, tree = problem.robot.n, problem.robot.tree
        parts = {
            "work": aligned(Work.count(n, 0, 1, 1, 0)), "constants": aligned(LaneConstants.count()),
            "terms": aligned(n * n + n + plain(work_size)(n)), "tree": aligned(tree.constants.size),
            "row": aligned(Row.count(n)), "forces": aligned(steps + 1), "before": aligned(Kept.count()),
        }  # fmt: skip
        self.group = Group(np.zeros(GROUP, dtype=np.int64))
        for name, part in (parts | arrays).items():
            setattr(self.group, name, address_of(part))
        self.group.mode, self.group.entry = mode, entry_address(step_in_lanes)
        self.group.keep_alive(parts=parts, arrays=arrays)
        self.address = address_of(self.group.memory)
