"""The loop's memory, made in Python."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from closedloop.jit.calls import address_of
from closedloop.loop.step.memory import STATE_COUNT, Constants, State, Work


class Loop(NamedTuple):
    """The loop's memory, made in Python: kept as long as its address is used."""

    state: State
    constants: Constants
    w: Work

    @property
    def address(self) -> int:
        """Return what `loop_at` takes."""
        return int(self.state.address)

    @property
    def written(self) -> list[NDArray[Any]]:
        """Return the memory that a call of the loop changes, that of loops and of contacts of links included."""
        kept = self.w.kept
        others = (block for name in ("loops", "seen_loops", "contacts") for block in kept.get(name, ()))
        return [block.memory for block in (self.state, self.w, *others)]


def make_loop(
    n: int, *, law: int = 0, compensation: int = 0, friction: int = 0, joint_friction: int = 0, compliance: int = 0,
    tendons: int = 0, extra: int = 0, stages: int = 1, ring: int = 1, ends: NDArray[np.int64] | None = None,
) -> Loop:  # fmt: skip
    """Return a loop's memory, zero everywhere.

    Parameters
    ----------
    n : int
        Joints.
    law, compensation, friction, joint_friction, compliance : int
        How many numbers their parameters are; of the joints' friction, those of one joint.
    tendons : int
        That rub or have stops.
    extra : int
        Numbers of state beside q and q̇.
    stages : int
        Of the integrator.
    ring : int
        Samples that the force sensor keeps.
    ends : (n,) array, optional
        See `closedloop.mechanics.robot.tree.group_ends`; all joints are one group without it.
    """
    state = State(np.zeros(STATE_COUNT, dtype=np.int64))
    sizes = n, law, compensation, friction, joint_friction, compliance, tendons
    constants = Constants(np.zeros(Constants.count(*sizes)), *sizes)
    w = Work(np.zeros(Work.count(n, extra, stages, ring, tendons)), n, extra, stages, ring, tendons)
    state.address = address_of(state.memory)
    ends = np.full(n, n, dtype=np.int64) if ends is None else ends
    state.addresses.group_ends = address_of(ends)
    state.keep_alive(ends=ends)
    state.n, state.addresses.extra, state.settings.stages, state.sensor.ring = n, extra, stages, ring
    state.law.size, state.compensation.size, state.tendons = law, compensation, tendons
    state.friction.size, state.joint_friction.size, state.compliance.size = friction, joint_friction, compliance
    state.addresses.constants, state.addresses.constants_size = address_of(constants.memory), constants.memory.size
    state.addresses.work, state.addresses.work_size = address_of(w.memory), w.memory.size
    w.contacts.margin = w.tip.inside = np.inf  # of what there may not be: it is nowhere near
    return Loop(state, constants, w)
