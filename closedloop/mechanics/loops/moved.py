"""Frames that move as a scenario tells them: a side of a loop joint that is neither on a link nor on the base.

Their motion is that of a surface (`closedloop.mechanics.surface.motion`), which is asked in the same memory. In the
rows of loops frame k is link −2 − k, and its pose is in the scratch of the tree behind that of the links, in the same
rows (`closedloop.mechanics.robot.tree.layout`), so that a row reads either side alike; V is its velocity, m/s.
"""

from math import inf
from typing import Any, NamedTuple

import numpy as np

from closedloop.base.arrays import Array
from closedloop.jit.calls import call_at, integers_at, vector_at
from closedloop.jit.interpreted import interpreted, twin_address
from closedloop.jit.kernel import kernel
from closedloop.jit.parameters import pack
from closedloop.jit.user_code import of_users
from closedloop.mechanics.robot.tree import layout as at
from closedloop.mechanics.surface.contact import SurfaceMemory, ask_at, make_memory, motion_entry
from closedloop.mechanics.surface.geometry import Pose
from closedloop.mechanics.surface.motion import SurfaceMotion


class MovedFrame(NamedTuple):
    """A frame that moves, and its pose at rest, before its motion displaces it."""

    names: tuple[str, ...]  # its own name first, then those of frames that are fixed to it
    motion: SurfaceMotion
    axes: Array  # (3, 3), columns, base frame
    origin: Array  # (3,), m

    @property
    def entry(self) -> Any:
        """Return what writes its pose at an instant."""
        return motion_entry(type(self.motion))

    def memory(self) -> SurfaceMemory:
        """Return a new memory by which its entry is asked."""
        entries = self.motion.list_length()
        with of_users(self.motion, "mocap.motion.kind"):
            numbers = pack(self.motion, entries, "mocap.motion")
        return make_memory(np.zeros(0), numbers, (0, entries), self.origin, self.axes.T, (inf, 0.0))

    def displacements(self, time: Array) -> tuple[Array, Array]:
        """Return the turns (N, 3, 3) and shifts (N, 3), m, base frame, by which it is displaced at N instants, s."""
        links, ask = self.memory()
        turns, shifts = np.empty((len(time), 3, 3)), np.empty((len(time), 3))
        for k, t in enumerate(time):
            ask.time = t
            interpreted(self.entry)(int(links.address), 0)
            turns[k] = Pose(ask.pose).axes.T @ ask.axes
            shifts[k] = Pose(ask.pose).origin - turns[k] @ self.origin
        return turns, shifts


@kernel
def place_frames(links: Any, t: float) -> None:
    """Write where the frames of the loops are at an instant, s, and how they move, into the scratch of the tree."""
    w, called = vector_at(links.scratch, links.scratch_size), integers_at(links.moved, 2 * links.frames)
    gravity = vector_at(links.tree_constants, links.tree_constants_size)
    for k in range(links.frames):
        _, ask = ask_at(called[2 * k + 1])
        ask.time = t
        call_at(called[2 * k], called[2 * k + 1], 0)
        pose, s = Pose(ask.pose), links.scratch_size - (k + 1) * at.SCRATCHES
        for i in range(3):
            j = i * at.LANES
            w[s + at.X0 + j], w[s + at.Z0 + j], w[s + at.P0 + j] = pose.axes[0, i], pose.axes[2, i], pose.origin[i]
            w[s + at.O0 + j], w[s + at.A0 + j], w[s + at.V0 + j] = pose.spin[i], pose.spin_rate[i], pose.velocity[i]
            w[s + at.B0 + j] = pose.acceleration[i] - gravity[at.GRAVITY + i]  # as links have it


def add_frames(links: Any, frames: tuple[MovedFrame, ...]) -> None:
    """Give loops the memory of frames that move, as interpreted code calls it, and place them at t = 0."""
    memories = [frame.memory() for frame in frames]
    called = np.array([(twin_address(frame.entry), 0) for frame in frames], dtype=np.int64)
    called[:, 1] = [memory.address for memory in memories]
    links.frames, links.moved = len(frames), called.ctypes.data
    links.keep_alive(frames=called, memories=memories)
    interpreted(place_frames)(links, 0.0)
