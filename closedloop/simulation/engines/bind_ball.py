"""The memory of the round end of a tool, as `closedloop.loop.step.ball_tip` reads it."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from closedloop.jit.calls import address_of
from closedloop.loop.step.ball_tip import BALL_TIP, BallTip
from closedloop.mechanics.contacts.shapes import RADIUS, SHAPE, make_shape_memory
from closedloop.mechanics.loops.bind import link_poses
from closedloop.mechanics.loops.memory import POSITION, Bound, make_loop_memory
from closedloop.mechanics.robot.pinocchio import Robot
from closedloop.mechanics.surface.placed import PlacedSurface
from closedloop.simulation.engines.bind_contacts import placed_on_link


class BallMemory(NamedTuple):
    """The memory of a tip with a round end, kept as long as its address is used."""

    links: BallTip
    kept: tuple[Any, ...]


def ball_memory(robot: Robot, surface: PlacedSurface, radius: float, loop: int) -> BallMemory:
    """Return a new memory of a tip with an end of this radius, m, on a surface; `loop` is the address of the loop."""
    poses = link_poses(robot.tree, robot.model.loop_home)
    link, _, point = placed_on_link(robot, poses, robot.tip, (0.0, 0.0, 0.0), "robot.tip")
    kinds = np.array([POSITION] * 3 + [link] * 3 + [-1] * 3 + [0, 1, 1], dtype=np.int64)
    along, none = surface.frame if surface.fixed_plane else np.eye(3), np.zeros((3, 3))
    bound = Bound(kinds, np.tile(point, (3, 1)), none, none, along, np.zeros((3, 5)), np.ones(3), np.zeros(robot.n))
    shape = np.zeros((1, SHAPE))
    shape[0, RADIUS] = radius
    rows, shapes = make_loop_memory(robot.tree, bound), make_shape_memory(robot.n, shape)
    links = BallTip(np.zeros(BALL_TIP, dtype=np.int64))
    links.address, links.loop, links.rows, links.shapes = address_of(links.memory), loop, rows.address, shapes.address
    return BallMemory(links, (rows, shapes))
