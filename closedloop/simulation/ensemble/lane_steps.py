"""Eight members at a time in SIMD lanes, and which may be.

They go from control instant to control instant, see `closedloop.jit.simd8`. Members may be stepped so whose torque is
held by an action, whose tip slides or sticks on a plane, and of which no part has a memory of its own that acts on the
motion. The kernels are those of a step by itself, so every number is the same to the last bit. Friction is asked member
by member, by its address.

A lane in which something else may happen (liftoff, the end of slip or of sticking, a slip so slow that friction turns
with it) is left as it was, and its member is stepped by itself. What is tested for here may be less than an event,
never more.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from closedloop.base.arrays import Array
from closedloop.control.reference.desired import TableRow
from closedloop.control.sensor import SensorParameters, bias_at, sense, sensor_rates, signal_of
from closedloop.jit.calls import address_of, call_at, entry_address, integers_at, matrix_at, row_of, vector_at
from closedloop.jit.inside.simd8 import float64x8_at, lane, with_lane
from closedloop.jit.kernel import entry_kernel, jit_disabled, kernel, kernel_inlined, plain
from closedloop.jit.simd8 import WIDE, aligned, every, select
from closedloop.loop.events.locate import slip_margin
from closedloop.loop.step.advance import advance
from closedloop.loop.step.energy_supplied import add_stage_work, commit_work, save_power
from closedloop.loop.step.evaluate import bounded
from closedloop.loop.step.locate import locate_on_plane
from closedloop.loop.step.memory import RIGID_STICK, SMOOTH, Constants, State, Work, loop_at
from closedloop.loop.step.record_row import Row, write_row
from closedloop.loop.step.solve_contact import near_singular
from closedloop.mechanics.closure.contact_force import (
    STUCK,
    accelerate,
    baumgarte_acceleration,
    factorise,
    free_acceleration,
    pressed_force,
    stuck_force,
)
from closedloop.mechanics.closure.solve import OK, SINGULAR
from closedloop.mechanics.friction.answers import LIMIT
from closedloop.mechanics.limits import OUTPACED
from closedloop.mechanics.robot.tree import LINK_ROWS, Tree, tree_terms, work_size
from closedloop.simulation.engines.lane_contact import ask_friction_of, save_slip_of
from closedloop.simulation.engines.loops import ADDRESSES, Addresses
from closedloop.simulation.engines.problem import Problem
from closedloop.simulation.ensemble.member import (
    AT_MARK,
    BETWEEN,
    GROUP,
    MEMBER,
    WAITING,
    Between,
    Group,
    Kept,
    LaneConstants,
    Member,
    write_wanted,
)

# A square is compared with a square, to leave out what is nearer to a bound than this share: its rounding.
NEARLY = 1e-9


@kernel_inlined
def member_at(g: Group, i: int) -> tuple[Member, Addresses]:
    """Return the member in lane `i`, and its addresses."""
    m = Member(integers_at(g.members[i], MEMBER))
    return m, Addresses(integers_at(m.addresses, ADDRESSES))


@kernel
def put_in(g: Group, w: Work, c: LaneConstants, tree: Array, kept: Kept, i: int) -> None:
    """Put the state of the member of lane `i` into the lane."""
    m, a = member_at(g, i)
    state, constants, own = loop_at(a.loop)
    for j in range(a.n):
        w.q[j], w.v[j] = with_lane(w.q[j], i, own.q[j]), with_lane(w.v[j], i, own.v[j])
        w.torque[j] = with_lane(w.torque[j], i, own.torque[j])
    for k in range(3):
        for j in range(3):
            w.tip.frame[k, j] = with_lane(w.tip.frame[k, j], i, own.tip.frame[k, j])
        w.tip.anchor[k] = with_lane(w.tip.anchor[k], i, own.tip.anchor[k])
    for k in range(2):
        w.friction.direction[k] = with_lane(w.friction.direction[k], i, own.friction.direction[k])
        kept.direction[k] = w.friction.direction[k]
        kept.slip[k] = with_lane(kept.slip[k], i, own.start.slip[k])
    w.start.slip_speed = with_lane(w.start.slip_speed, i, own.start.slip_speed)
    kept.slip_speed = w.start.slip_speed
    w.supply.energy = with_lane(w.supply.energy, i, own.supply.energy)
    w.supply.work = with_lane(w.supply.work, i, own.supply.work)
    c.offset, c.reach = with_lane(c.offset, i, constants.offset), with_lane(c.reach, i, constants.reach)
    c.s_v, c.s_p = with_lane(c.s_v, i, constants.s_v), with_lane(c.s_p, i, constants.s_p)
    c.stick_speed = with_lane(c.stick_speed, i, constants.stick_speed)
    c.capture_speed = with_lane(c.capture_speed, i, constants.capture_speed)
    if g.mode == STUCK:
        call_at(state.friction.entry, state.address, LIMIT)
        kept.stick_limit = with_lane(kept.stick_limit, i, own.friction.stick_limit)
    if g.trees[i] != m.constants:
        g.trees[i] = m.constants
        of_tree = vector_at(m.constants, m.constants_size)
        for j in range(m.constants_size):
            tree[j] = with_lane(tree[j], i, of_tree[j])


@kernel_inlined
def hold_on_surface(w: Work, c: LaneConstants, kept: Kept, stuck: bool, sticks: bool, h: float) -> tuple[int, Array]:
    """Write F and its parts; return a status, and for each lane 1 where the mode surely goes on, else 0.

    See `closedloop.loop.step.solve_contact.contact_force`, of which this is the part without an event.
    """
    S, F = w.tip.S, w.tip.F
    goes_on = 0.0 * F[0] + 1.0
    w.tip.b[0] = baumgarte_acceleration(c.s_v, c.s_p, w.tip.rate, w.tip.gap)
    if stuck:
        for i in range(1, 3):
            w.tip.b[i] = baumgarte_acceleration(c.s_v, c.s_p, w.tip.u[i], w.tip.p[i] - w.tip.anchor[i])
        status = stuck_force(S, w.tip.a, w.tip.b, F, w.tip.stabiliser_force)
        limit, size = kept.stick_limit * abs(F[0]), F[1] * F[1] + F[2] * F[2]
        goes_on = select(limit * limit * (1.0 - NEARLY) > size, goes_on, 0.0)
        return status, goes_on
    status, w.tip.stabiliser_force[0] = pressed_force(S, w.tip.a, w.tip.b[0], w.friction.c, w.friction.viscous, F)
    goes_on = select(F[0] >= 0.0, goes_on, 0.0)
    if sticks:
        rub_share = w.friction.c[0] * w.friction.c[0] + w.friction.c[1] * w.friction.c[1]
        reach = h * F[0] * (S[1, 1] + S[2, 2])  # see `closedloop.mechanics.friction.turning.turn_friction`
        speed = w.tip.u[1] * w.tip.u[1] + w.tip.u[2] * w.tip.u[2]
        goes_on = select(reach * reach * rub_share < speed * (1.0 - NEARLY), goes_on, 0.0)
        goes_on = select(slip_margin(w, c) > 0.0, goes_on, 0.0)
    return status, goes_on


@entry_kernel
def step_in_lanes(address: int, count: int) -> int:
    """Step the members of a group to their next control instant, with their torques in their memories.

    Returns a number whose bit i is 1 if member i is there; else it is where it was.

    `address`: of `closedloop.simulation.ensemble.member.Group`.
    `count`: how many there are; other lanes repeat the first.
    """
    g = Group(integers_at(address, GROUP))
    for i in range(count, WIDE):
        g.members[i] = g.members[0]
    m, a = member_at(g, 0)
    state, constants, _ = loop_at(a.loop)
    n, h, steps, stuck = a.n, constants.h, m.steps, g.mode == STUCK
    ends = integers_at(state.addresses.group_ends, n)
    sticks, unilateral = state.friction.sticking == RIGID_STICK, state.settings.unilateral != 0
    w, c = Work(float64x8_at(g.work, 0), n, 0, 1, 1, 0), LaneConstants(float64x8_at(g.constants, 0))
    kept, row = Kept(float64x8_at(g.before, 0)), Row(float64x8_at(g.row, 0), n)
    terms, forces = float64x8_at(g.terms, n * n + n + work_size(n)), float64x8_at(g.forces, steps + 1)
    H, C, scratch = terms[0 : n * n].reshape(n, n), terms[n * n : n * n + n], terms[n * n + n :]
    of_tree, tableau = float64x8_at(g.tree, m.constants_size), matrix_at(a.tableau, 2, 1)
    for i in range(WIDE):
        put_in(g, w, c, of_tree, kept, i)
    tree = Tree(n, m.blocks, m.once, m.carrier, m.serial, integers_at(m.links, LINK_ROWS * n), of_tree, m.balls)
    goes_on = 0.0 * w.q[0] + 1.0
    done = 0
    for step in range(steps + 1):
        tree_terms(tree, w.q, w.v, scratch, H, C, (w.J, w.r, w.drift))
        locate_on_plane(w, c)
        status = factorise(H, w.tip.A, w.L, w.tip.X, w.tip.S, c.reach, ends)
        if status == OK and near_singular(w.tip.S):
            status = SINGULAR
        if status == OK:
            free_acceleration(w.L, w.tip.X, w.tip.drift_c, w.torque, C, w.y, w.tip.a, ends)
            if sticks or state.friction.entry != 0:
                for i in range(WIDE if not stuck else 0):
                    ask_friction_of(w, g.members, i)
            status, stays = hold_on_surface(w, c, kept, stuck, sticks, h)
            goes_on = min(goes_on, stays)
            if unilateral:
                goes_on = select(w.tip.F[0] - w.tip.stabiliser_force[0] >= 0.0, goes_on, 0.0)
            accelerate(w.L, w.tip.X, w.y, w.tip.F, w.qdd, ends)
        if status != OK or not bounded(w) or every(goes_on < 0.5):
            done = -1
            break
        forces[step] = w.tip.F[0]
        if step == steps:
            break
        commit_work(w)
        if sticks and (not stuck or step == steps - 1):
            for i in range(WIDE):
                save_slip_of(w, g.members, i)
        save_power(w, state)
        add_stage_work(w, state, 0, h, tableau[1, 0])
        advance(0, h, True, False, tableau, w)
    if done == 0:
        energy, work = w.supply.energy, w.supply.work
        commit_work(w)
        write_row(H, C, w, state, row)
        row.kkt_condition = 0.0 * row.q[0]
        w.supply.energy, w.supply.work = energy, work
        for i in range(count):
            if lane(goes_on, i) > 0.5:
                done |= 1 << i
                put_back(g, w, row, forces, i)
    for i in range(count):
        if done < 0 or done & (1 << i) == 0:
            give_up(g, kept, i)
    return max(done, 0)


@kernel
def give_up(g: Group, kept: Kept, i: int) -> None:
    """Put back what a lane has changed in its member's memory."""
    _, a = member_at(g, i)
    _, _, own = loop_at(a.loop)
    for k in range(2):
        own.friction.direction[k], own.start.slip[k] = lane(kept.direction[k], i), lane(kept.slip[k], i)
    own.start.slip_speed = lane(kept.slip_speed, i)


@kernel
def put_back(g: Group, w: Work, row: Row, forces: Array, i: int) -> None:
    """Let the member of lane `i` stand where the lane does, at the end of the step before its next control instant.

    That row is told, but recorded only with the next action, as after `closedloop.simulation.ensemble.member.go_back`.
    """
    m, a = member_at(g, i)
    state, constants, own = loop_at(a.loop)
    n, width, nodes, sensor = a.n, a.row_width, state.settings.nodes_per_step, state.sensor.states
    par, h, first = SensorParameters(constants.sensor, 0), constants.h, m.target - m.steps
    table = matrix_at(a.table, a.instants, a.table_width)
    z, dz = own.z[state.law_states :], own.dz[state.law_states :]
    told = vector_at(g.rows + 8 * width * g.numbers[i], width)
    between = Between(vector_at(g.between + 8 * BETWEEN * g.numbers[i], BETWEEN))
    between.measured = own.sensing.measured
    for j in range(width):
        told[j] = lane(row.memory[j], i)
    between.largest_force, between.smallest_force = -np.inf, np.inf
    measured = told_force = 0.0
    for step in range(m.steps + 1):
        force, here = lane(forces[step], i), first + step
        measured, told_force = told_force, force
        if state.settings.general != 0:
            sensor_rates(force, par, z, dz)
            noise, ring = TableRow(row_of(table, here * nodes), n).sensor[0], row_of(own.sensing.ring, 0)
            own.sensing.signal[0] = signal_of(force, par, z)
            bias = bias_at(here * h, 0, par)
            told_force = sense(own.sensing.signal[0], bias, here, par, noise, ring[0 : state.sensor.ring])
        if step < m.steps:
            for j in range(sensor):
                z[j] += h * dz[j]
        if step > 0:
            between.largest_force = max(between.largest_force, force)
            between.smallest_force = min(between.smallest_force, force)
    own.sensing.measured = between.measured = measured
    Row(told, n).measured_force = told_force
    between.free_rows, between.events, between.impulse, between.largest_link_force = 0.0, 0.0, 0.0, 0.0
    for j in range(n):
        own.q[j], own.v[j] = lane(w.q[j], i), lane(w.v[j], i)
    own.supply.energy, own.supply.work = lane(w.supply.energy, i), lane(w.supply.work, i)
    own.time, own.length, own.search.tau = m.target * h, h, h
    own.start.time = (m.target - 1) * h
    state.row, state.stage, state.batched, state.after_event, state.divided = m.target, 0, 0, 0, 0
    state.trial.purpose, state.trial.watched = 0, 0
    state.event.rows, state.event.in_step = 0, max(state.event.in_step - OUTPACED * m.steps, 0)
    wanted = vector_at(g.wanted + 8 * (2 * n + 10) * g.numbers[i], 2 * n + 10)
    write_wanted(m, a, told, wanted, between.memory)
    m.marked, m.known, m.request, m.first = AT_MARK, 0, WAITING, m.target
    a.rows = m.window - 8 * m.target * width


def may_step_in_lanes(problem: Problem, state: State, constants: Constants, w: Work) -> bool:
    """Whether a simulation whose torque is held may be stepped in lanes while its tip is on the surface."""
    settings, friction, sensor = state.settings, state.friction, problem.scenario.sensor
    called = (
        state.surface, state.ball, state.external, state.compliance, state.loops, state.contacts, state.joint_friction,
    )  # fmt: skip
    # The states of a law that is not asked act on nothing, unless they are recorded or its functions may raise.
    has_memory = bool(friction.states or constants.lag > 0.0 or settings.states_at)
    members = problem.friction.member, problem.law.member
    asked = (
        settings.stages != 1, not settings.semi_implicit, settings.adaptive, settings.project, settings.encoder,
        settings.elastic, settings.drives, settings.arm_at, settings.balls, settings.misjudged,
        state.sensor.axes > 1, np.any(sensor.cross_talk), sensor.mass, sensor.jitter,
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
    """The memory of one thread for members of one mode; see `closedloop.simulation.ensemble.member.Group`.

    `problem`: one of the members, for the sizes.
    `mode`: PRESSED or STUCK.
    `steps`: between two control instants.
    `arrays`: by name those that `Group` has the addresses of, of all members.
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
