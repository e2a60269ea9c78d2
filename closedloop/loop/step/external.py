"""Forces from outside, [[external_force]]: F and a moment M at a point p of a link, from one instant to another.

    τ = Σ Jₚᵀ F + J_ωᵀ M

The law does not know of them. With a fixed step a force acts with the share of the step in which it is there, so that
its impulse is exact wherever it begins and ends; an adaptive integrator divides the run at these instants.
"""

from closedloop.base.arrays import Array
from closedloop.jit.calls import integers_at, row_of, vector_at
from closedloop.jit.kernel import entry_kernel, kernel
from closedloop.loop.step.memory import Constants, State, Work, loop_at
from closedloop.mechanics.loops.memory import LoopRows, loops_at, tree_at
from closedloop.mechanics.loops.rows import ALONG, POINT, move_point, turn_direction
from closedloop.mechanics.robot.tree import Tree
from closedloop.mechanics.robot.tree import layout as at
from closedloop.mechanics.robot.tree.kinematics import motion, sines

# In `LoopRows.value` of each force: the instants at which it begins and ends, s, its share of the step under way, and 1
# of one on the tip, which the force sensor feels.
# The rest is where the rows of a point are: `at_a` on the link, F and M in `along_a` and `along_b`, in the axes of the
# other side.
BEGIN, END, SHARE, FELT = range(4)
# A step begins at a row to this share of it; less of a force is rounding.
ROUNDING = 1e-9


@entry_kernel
def external_forces(address: int, what: int) -> int:
    """Write the torque of the forces that act in the step under way, by the address of their memory."""
    links, rows = loops_at(address)
    state, constants, w = loop_at(links.loop)
    if state.settings.adaptive == 0:
        share_step(rows, w, constants, state)
    for j in range(links.n):
        w.external[j] = 0.0
    for i in range(3):
        w.sensing.outside[i] = 0.0
    tree, work, placed = tree_at(links), vector_at(links.scratch, links.scratch_size), False
    sides = integers_at(links.bound, 4 * links.m)
    for k in range(links.m):
        share = rows.value[k, SHARE]
        if not share > ROUNDING:
            continue
        if not placed:
            sines(tree, w.q, work)
            motion(tree, w.v, work)
            placed = True
        point, turned = row_of(rows.motions, 0), row_of(rows.motions, 1)
        link, other = sides[links.m + k], sides[2 * links.m + k]
        move_point(tree, work, link, row_of(rows.at_a, k), point)
        force, moment = row_of(rows.directions, 0), row_of(rows.directions, 1)
        turn_direction(tree, work, other, row_of(rows.along_a, k), turned)
        for i in range(3):
            force[i] = share * turned[ALONG + i]
            w.sensing.outside[i] += rows.value[k, FELT] * force[i]
        turn_direction(tree, work, other, row_of(rows.along_b, k), turned)
        for i in range(3):
            moment[i] = share * turned[ALONG + i]
        add_wrench(tree, work, link, point, force, moment, w.external)
    return 0


@kernel
def share_step(rows: LoopRows, w: Work, constants: Constants, state: State) -> None:
    """Write the share of the step under way in which each force is there; at a row it is the step that begins there."""
    h = constants.h
    here = state.begins != 0 and w.time >= (state.row - ROUNDING) * h
    since = (state.row if here else state.row - 1) * h
    for k in range(rows.value.shape[0]):
        span = rows.value[k]
        span[SHARE] = max(min(span[END], since + h) - max(span[BEGIN], since), 0.0) / h


@kernel
def add_wrench(tree: Tree, work: Array, link: int, point: Array, force: Array, moment: Array, torque: Array) -> None:
    """Add to a torque (n,) what a force and a moment (3,), base axes, do at a point of a link."""
    n, w, joint = tree.n, work, link
    while joint >= 0:
        s = tree.links[at.SCRATCH * n + joint]
        x, y, z = force[0], force[1], force[2]
        if tree.links[at.REVOLUTE * n + joint] != 0:
            d0, d1, d2 = point[POINT] - w[s + at.P0], point[POINT + 1] - w[s + at.P1], point[POINT + 2] - w[s + at.P2]
            x, y, z = (
                moment[0] + d1 * force[2] - d2 * force[1],
                moment[1] + d2 * force[0] - d0 * force[2],
                moment[2] + d0 * force[1] - d1 * force[0],
            )
        torque[joint] += w[s + at.Z0] * x + w[s + at.Z1] * y + w[s + at.Z2] * z
        joint = tree.links[at.PARENT * n + joint]
