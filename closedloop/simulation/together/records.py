"""The memory of simulations that are stepped side by side; see `closedloop.simulation.together.member`."""

from __future__ import annotations

from typing import Annotated

from closedloop.base.arrays import Array, IntArray
from closedloop.jit.blocks import Block
from closedloop.jit.simd8 import WIDE

# What `Member.request` is at a control instant, where an action is waited for.
WAITING = -1
# What a number of an action sets: torque of a joint; desired force; displacement of the desired tip along an axis of
# the contact frame; a number of the law's parameters; displacement of a desired joint position.
TORQUE, FORCE, SHIFT, PARAMETER, JOINT = range(5)


class Member(Block):
    """Whole numbers, int64: where the memory of a simulation is, and where it stands."""

    addresses: int  # see `closedloop.simulation.engines.proceed.Addresses`
    links: int  # the robot, see `closedloop.mechanics.robot.tree.Tree`
    constants: int
    constants_size: int
    blocks: int
    once: int
    carrier: int
    serial: int
    balls: int
    scratch: int  # address and size of the scratch of its kernels
    scratch_size: int
    copied: int  # address of rows (from, to, length) of the memory that the mark is a copy of, and how many there are
    copied_count: int
    reading: int  # address of the reading of the force sensor in the mark
    boundary: int  # address of the reference's row at the next control instant, before an action displaced it
    displaced: int  # 1 if one did
    window: int  # address of the rows that are kept, how many there is room for, and which row is the first
    room: int
    first: int
    keep: int  # how many earlier rows a step may read or write
    begins: int  # the phase that a row begins with
    held: int  # 1 if a torque from outside acts; 0: the scenario's law
    strike: int  # address of what computes an impact; 0: Python does
    steps: int  # between two control instants
    target: int  # the row of the next control instant
    marked: int  # 1 if the mark is of the latest control instant, AT_MARK if the memory itself is as the mark would be
    known: int  # 1 if the terms are those of the state in the loop's memory
    request: int  # what the loop asked for last
    lanes: int  # 1 if it may be stepped in lanes


class Group(Block):
    """Whole numbers, int64: members that are stepped together, and memory of float64x8 for it.

    See `closedloop.simulation.together.lanes`.
    """

    entry: int  # address of what steps them
    mode: int  # of the tips
    filled: int  # how many there are
    members: Annotated[IntArray, WIDE]  # addresses of each `Member`
    numbers: Annotated[IntArray, WIDE]  # which of all members it is
    trees: Annotated[IntArray, WIDE]  # addresses of the constants of the arm that each lane has
    work: int
    constants: int
    terms: int
    tree: int
    row: int
    forces: int
    before: int
    everyone: int  # addresses of all `Member`s, and of what `tell` writes of them
    rows: int
    wanted: int
    between: int


class LaneConstants(Block):
    """Of `closedloop.loop.step.memory.Constants`, what differs between lanes."""

    offset: float
    s_v: float
    s_p: float
    reach: float
    stick_speed: float
    capture_speed: float


class Kept(Block):
    """What is put back where a lane is given up, and what is only asked for once."""

    direction: Annotated[Array, 2]
    slip: Annotated[Array, 2]
    slip_speed: float
    stick_limit: float


class Between(Block):
    """What happened between two control instants, the later one included."""

    largest_force: float  # largest contact force at a row, N
    smallest_force: float
    largest_link_force: float  # largest force along the normal of a [[contact]] at a row, N
    free_rows: float  # rows at which the tip was free
    events: float  # how many there were
    impulse: float  # largest impulse along the normal, N s
    measured: float  # the force sensor's reading as a law has it at the control instant, N
    path_error: float  # distance of the tip from the reference along the surface there, m


MEMBER, BETWEEN, GROUP = Member.count(), Between.count(), Group.count()
AT_MARK = 2
# Eight in lanes take about as long as two by themselves.
FEWEST = 3
