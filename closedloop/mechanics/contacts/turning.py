"""The friction of contacts that slip slowly, and the instant at which the first slip ends.

It is solved with the forces, and points to where the slips go within the step.

See `closedloop.mechanics.friction.turning`, which does it for one contact. The friction of each moves the slips of the
others, so that all directions are those of one problem, with u⁺ what is left of each slip after the step h:

    u_t⁺ = u_t + h u̇_t,    F_t = −μ|f| u_t⁺/|u_t⁺|,    u̇_n = b_n where contacts are closed, u̇ = b where they stick

Where a slip ends within the step, so does the step, with constant forces: the problem is then solved for
steps τ of other lengths, until the first slip ends just then.
Soft contacts beside others go on: their friction is then within its limit, F_t with u_t⁺ = 0, and their slips become
less by e in a step. An integrator that chooses its steps has none that could say where a slip goes: u⁺ is that after
the time BREAKING_AWAY, in which a slip that has just begun takes its direction. Friction is a smooth function of the
state, within its limit where u⁺ is zero: what lets go and could stick at once does not move. A faster slip is followed
through its turns: friction is against the slip as it is. That of soft contacts beside others rises with the slip there
(`closedloop.mechanics.contacts.soft`).

The work is bounded. What is not found by then is left: friction is then against the slip as it is, and agrees with the
forces. So it is where directions go round among some without end; what they change by at last is in the record.
"""

import math

from closedloop.jit.calls import row_of
from closedloop.jit.dual8 import along, has_derivatives, settled, slope_of, sought
from closedloop.jit.kernel import kernel
from closedloop.mechanics.closure.contact_force import FREE, IMMOBILE, PRESSED
from closedloop.mechanics.closure.solve import OK
from closedloop.mechanics.contacts.closed import solve_closed
from closedloop.mechanics.contacts.friction import stops_slipping
from closedloop.mechanics.contacts.given_modes import sticks
from closedloop.mechanics.contacts.joint_space import (
    OWNED,
    STICKS,
    JointSpace,
    differentiate,
    solve_in_joint_space,
    start_at_rest,
)
from closedloop.mechanics.contacts.memory import CONE, DOUBLE, INSIDE, LINE, OFF, RAY, ContactLinks, Contacts, joints_of
from closedloop.mechanics.contacts.mobility import added, force_size, write_motion
from closedloop.mechanics.contacts.resistance import is_resistance
from closedloop.mechanics.contacts.soft import drop_contradictions, shared_friction, some_share
from closedloop.mechanics.contacts.unknown_modes import pack_contacts, unpack_contacts
from closedloop.mechanics.limits import (
    DEPENDENT,
    EXACT,
    FIRST_RHO,
    FOUND,
    HIGH,
    HOVERING,
    ITERATIONS,
    NEAR,
    REFINEMENTS,
    STICK_SPEED,
    STIFF,
    STILL,
    WIDENING,
)
from closedloop.mechanics.loops.solve import dot, orthonormal_basis, take_off


@kernel
def turn_and_solve(links: ContactLinks, c: Contacts, h: float, begins: bool, points: bool = False) -> int:
    """Turn the friction of slow slips to where they go in the step h, s, until it agrees with the forces.

    Where forces are not unique those that are shortest have their own directions of friction: hence the repetitions.
    Where a contact that only presses would pull, friction stays against the slip as it is: its mode ends, and friction
    that is turned round with the force would drive the slip. Nor is it turned where forces would multiply: near
    Painlevé's paradox they turn the slip faster than the step resolves. Shapes wander, not only `points`, and their
    rows depend on each other; a contact of theirs that has just parted would come back at once, again and again:
    friction is not turned until it has. `ends` says whether a slip ends within the step, `begins` is whether the step
    begins here.
    """
    k = links.k
    c.problem.ends = 0.0  # what the beginning of a step decides counts in all its stages, once `save_contacts` keeps it
    for i in range(k if begins else 0):
        c.friction.next_against[i] = 0.0
    for i in range(k):
        c.scratch.start[3 * i], c.scratch.start[3 * i + 1] = c.problem.along[i, 0], c.problem.along[i, 1]
    write_bound(c, k)
    # Without the friction that soft contacts share, which is found here, others may pull.
    if (some_pull(c, k) and not some_share(c, k)) or not some_slip_slowly(c, k, h):
        return int(OK)
    c.problem.points = 1.0 if points else 0.0
    last, stalled, most = math.inf, 0, HIGH * force_size(c.rigid)
    for _ in range(ITERATIONS):
        change = turn_slips(links, c, h, begins)
        pulls = change < 0.0 or solve_closed(links, c) != OK or some_pull(c, k) or force_size(c.rigid) > most
        if pulls or (begins and not points and presses_in(c, k)):
            last = math.inf
            break
        if change <= DEPENDENT or not some_slip_slowly(c, k, h):
            return int(OK)
        stalled += 1 if change >= last else 0  # where forces are not unique it need not become less
        last = float(change)
        if stalled == REFINEMENTS:
            break
    if last <= NEAR:
        c.problem.off = max(c.problem.off, last)
        return int(OK)
    c.problem.ends = c.problem.ends if points else 0.0
    for i in range(k):
        c.problem.along[i, 0], c.problem.along[i, 1] = c.scratch.start[3 * i], c.scratch.start[3 * i + 1]
        if begins and not points:
            c.friction.next_against[i] = 1.0
    return int(solve_closed(links, c))


@kernel
def write_bound(c: Contacts, k: int) -> None:
    """Write which slips cannot begin, because contacts that stick hold all that would move them.

    So is a resistance at its limit beside one that holds the same rotation: how much each holds is not unique, and
    changes what the friction of others does.
    """
    basis, n, p = c.given.basis, c.X.shape[1], 0
    for i in range(k):
        c.friction.bound[i] = 0.0
        for r in range(3 * i + 1, 3 * i + 3 if sticks(c, i) else 0):
            first, end = joints_of(c, i)
            for j in range(n):
                basis[p, j] = c.X[r, j] if first <= j < end else 0.0
            p += 1
    rank = -1
    for i in range(k if p > 0 else 0):
        if c.problem.form[i] not in (RAY, LINE) or math.hypot(c.u[3 * i + 1], c.u[3 * i + 2]) > STILL:
            continue
        rank = orthonormal_basis(basis, p, n, NEAR) if rank < 0 else rank
        first, end = joints_of(c, i)
        row, left, least = c.scratch.sum, 0.0, NEAR * NEAR
        for r in range(3 * i + 1, 3 * i + 3):
            for j in range(n):
                row[j] = c.X[r, j] if first <= j < end else 0.0
            for m in range(rank):
                take_off(row, row_of(basis, m), n)
            left += dot(row, row, n)
        c.friction.bound[i] = 1.0 if left <= least * (c.S[i, 1, 1] + c.S[i, 2, 2]) else 0.0


@kernel
def some_pull(c: Contacts, k: int) -> bool:
    """Whether the force of a contact that slides, and only presses, would pull."""
    least = 0.0
    for i in range(k):
        least = min(least, c.F[3 * i] if c.problem.form[i] == RAY else 0.0)
    return bool(least < 0.0)


@kernel
def presses_in(c: Contacts, k: int) -> bool:
    """Whether the forces press a contact in that has just parted, and hardly moves."""
    presses = False
    write_motion(c, k, c.F)
    for i in range(k):
        n = 3 * i
        parted = c.mode[i] == FREE and c.near[i] != 0.0 and c.past_edge[i] == 0.0 and c.located[n] <= HOVERING
        if parted and c.soft[i] == 0.0 and c.friction.pulls[i] == 0.0 and abs(c.u[n]) <= STICK_SPEED:
            presses = presses or c.a[n] + added(c, n) < 0.0
    return bool(presses)


@kernel
def some_slip_slowly(c: Contacts, k: int, h: float) -> bool:
    """Whether `slips_slowly` is true of a contact."""
    slow = False
    for i in range(k):
        slow = slow or slips_slowly(c, i, h)
    return slow


@kernel
def slips_slowly(c: Contacts, i: int, h: float) -> bool:
    """Whether friction can turn the slip of contact i, or end it, within the step h, s."""
    n, S = 3 * i, c.S[i]
    if not (c.problem.form[i] in (RAY, LINE) and c.mode[i] == PRESSED and stops_slipping(c, i)):
        return False
    if c.friction.bound[i] != 0.0:
        return False
    u1, u2, trace = c.u[n + 1], c.u[n + 2], S[1, 1] + S[2, 2]
    speed = math.hypot(u1, u2)
    if c.friction.shared[i] > 0.0:  # the friction of the others of its body acts on its slip, too
        return bool(c.friction.rises == 0.0 and h * shared_friction(c) * trace > speed)
    if not h * level_of(c, i) * abs(c.F[n]) * trace > speed:
        return False
    if c.friction.rises == 0.0 and speed > STILL and not u1 * c.direction[i, 0] + u2 * c.direction[i, 1] > 0.0:
        return False  # past the end of slip
    # What moves along a line does not turn.
    return bool(S[1, 1] * S[2, 2] - S[1, 2] * S[2, 1] > IMMOBILE * trace * trace)


@kernel
def level_of(c: Contacts, i: int) -> float:
    """Return the largest |F_t|/f of contact i, which slides."""
    shared = c.friction.shared[i]
    return float(shared if shared > 0.0 else math.hypot(c.scratch.start[3 * i], c.scratch.start[3 * i + 1]))


@kernel
def turn_slips(links: ContactLinks, c: Contacts, h: float, begins: bool) -> float:
    """Write `along` of the contacts that slip slowly; return its largest change, of μ, negative if none was found."""
    s, change, count = c.stepping, -1.0, pack_problem(links, c, h, False, begins)
    found = solve_within(links, c, count, 1.0 / h)
    if found and left_of_slips(c, count) < 0.0:
        c.problem.ends = 1.0
    unpack_contacts(links, c, count)
    if found:
        change = 0.0
    for j in range(count if found else 0):
        i = int(s.number[j])
        if c.scratch.turned[i] != 0.0:
            x1, x2 = trial_friction(s, j)
            change = max(change, turn(c, i, x1, x2, begins))
    return change


@kernel
def pack_problem(links: ContactLinks, c: Contacts, h: float, ends: bool, begins: bool) -> int:
    """Write the problem, its q but for the slips divided by τ as `sought` too; return how many contacts it has.

    Contacts whose slips end may part, or begin to slip: none is held. Else what stays against its slip is not turned:
    forces of a problem that turned it would be those of another, and directions change from round to round without end.
    """
    s, k = c.stepping, links.k
    write_motion(c, k, c.viscous)
    for i in range(k):
        c.scratch.mu[i], c.scratch.start[3 * i + 2] = c.mu[i], c.problem.form[i]
        stays = stays_against(c, i, begins) and not ends
        form, slow = int(c.problem.form[i]), slips_slowly(c, i, h) and not stays
        c.scratch.turned[i] = 1.0 if slow else 0.0
        for r in range(3 * i, 3 * i + 3 if form != OFF else 0):
            c.problem.q[r] = c.a[r] - (c.b[r] if r == 3 * i or not slow else 0.0) - added(c, r)
        if slow:
            c.mu[i] = level_of(c, i)
            c.problem.form[i] = CONE if ends and form == RAY else DOUBLE
        elif not ends and form != OFF:
            c.problem.form[i] = DOUBLE if form in (CONE, DOUBLE) else LINE
    count = pack_contacts(links, c, 1.0)
    for i in range(k):
        c.mu[i], c.problem.form[i] = c.scratch.mu[i], int(c.scratch.start[3 * i + 2])
    for i in range(count):
        number = int(s.number[i])
        if not ends and c.scratch.turned[number] == 0.0 and c.problem.form[number] in (CONE, DOUBLE):
            s.tangent[i] = STICKS
        for r in range(3):  # from here the feet of one body do not press against each other
            kept = r == 0 or c.friction.shared[number] == 0.0
            s.P[3 * i + r] = c.F[3 * number + r] + c.viscous[3 * number + r] if kept else 0.0
            c.scratch.sought[3 * i + r] = s.q[3 * i + r]
        if s.normal[i] == OWNED:
            s.P[3 * i] = 0.0
    return count


@kernel
def stays_against(c: Contacts, i: int, begins: bool) -> bool:
    """Whether the friction of contact i has been found to stay against its slip, by what the step begins with."""
    return bool((c.friction.next_against[i] if begins else c.friction.against[i]) != 0.0)


@kernel
def is_turned(c: Contacts, i: int) -> bool:
    """Whether packed contact i slips slowly."""
    return bool(c.scratch.turned[int(c.stepping.number[i])] != 0.0)


@kernel
def slip_of(c: Contacts, i: int) -> tuple[float, float]:
    """Return the slip of packed contact i, m/s: zero of one that is rounding, and has no direction.

    Where the integrator chooses its steps none is: slip starts from rest, and its friction must not jump where it has
    become faster than some speed.
    """
    j = int(c.stepping.number[i])
    u1, u2 = c.u[3 * j + 1], c.u[3 * j + 2]
    counts = c.friction.shared[j] > 0.0 or c.friction.rises != 0.0 or math.hypot(u1, u2) > STILL
    return (u1, u2) if counts else (0.0 * u1, 0.0 * u2)


@kernel
def solve_within(links: ContactLinks, c: Contacts, k: int, rate: float) -> bool:
    """Solve the packed problem for τ = 1/`rate`; return whether that was possible.

    Contacts of shapes wander, and forces that follow the last ones follow them: the shortest change their directions
    from step to step, and contacts that have parted are pressed in again and again.
    """
    s, n = c.stepping, links.n
    for r in range(3 * k):
        s.q[r] = c.scratch.sought[r]
    for i in range(k):
        if is_turned(c, i):
            u1, u2 = slip_of(c, i)
            s.q[3 * i + 1] += rate * u1
            s.q[3 * i + 2] += rate * u2
    drop_contradictions(c, k)
    s.associated, s.alike = 0.0, 1.0
    if c.problem.points > 0.0:
        start_at_rest(s, k, n)
    if not solve_in_joint_space(s, k, n, FIRST_RHO if c.problem.points > 0.0 else STIFF):
        s.alike = 0.0
        if not solve_in_joint_space(s, k, n, FIRST_RHO):
            return False
    if has_derivatives(s.y[0]):
        differentiate(s, k, n)
    return True


@kernel
def trial_friction(s: JointSpace, i: int) -> tuple[float, float]:
    """Return F_t − ρ u_t of packed contact i, N: longer than μ|f|, and along its friction, while it slips."""
    n, rho = 3 * i, 1.0 / s.mobility[i]
    return s.P[n + 1] - rho * s.u[n + 1], s.P[n + 2] - rho * s.u[n + 2]


@kernel
def left_of_slips(c: Contacts, k: int) -> float:
    """Return by which share |F_t − ρ u_t| is above μ|f| where that is least: negative once a slip has ended."""
    s, least = c.stepping, math.inf
    for i in range(k):
        u1, u2 = slip_of(c, i)
        own = c.friction.shared[int(s.number[i])] == 0.0  # the others' slips end by themselves
        if own and is_turned(c, i) and math.hypot(u1, u2) > 0.0:
            x1, x2 = trial_friction(s, i)
            least = min(least, math.hypot(x1, x2) / (s.mu[i] * abs(s.P[3 * i]) + 1e-300) - 1.0)
    return float(least)


@kernel
def turn(c: Contacts, i: int, x1: float, x2: float, begins: bool) -> float:
    """Write `along` of contact i, with its `trial_friction` x, and return its change, of μ.

    It stays where a slip that has only begun does not go on: friction is against what pulls. It stays too where slip
    turns by more than a right angle: friction is against the slip until that ends. The beginning of a step decides for
    all its stages: a step that mixed both directions gained energy. Friction that would drive the slip at a later stage
    is reflected in the line across it, which is continuous. Where an integrator chooses its steps friction is a smooth
    function of the slip instead: within its limit where no slip is left, as that of soft contacts beside others is.
    """
    n = 3 * i
    level, f, shared = level_of(c, i), c.F[n], c.friction.shared[i] > 0.0
    smooth = shared or c.friction.rises != 0.0
    size, speed = math.hypot(x1, x2), math.hypot(c.u[n + 1], c.u[n + 2])
    d1, d2 = (c.u[n + 1] / speed, c.u[n + 2] / speed) if speed > STILL else (c.direction[i, 0], c.direction[i, 1])
    drives = 0.0 * size if smooth else x1 * d1 + x2 * d2
    if begins:
        c.friction.next_against[i] = 1.0 if drives > 0.0 else 0.0
    directed = size > 0.0 or (smooth and f != 0.0)  # what rolls on needs no friction
    if stays_against(c, i, begins):
        x1, x2 = c.scratch.start[n] - c.problem.along[i, 0], c.scratch.start[n + 1] - c.problem.along[i, 1]
        c.problem.along[i, 0], c.problem.along[i, 1] = c.scratch.start[n], c.scratch.start[n + 1]
        return float(math.hypot(x1, x2) / level)
    if not directed or (drives > 0.0 and speed <= STILL):
        return 0.0
    if drives > 0.0:
        x1, x2 = x1 - 2.0 * drives * d1, x2 - 2.0 * drives * d2
    within = size <= level * abs(f)
    if speed <= STILL and size <= INSIDE * level * abs(f) and not smooth:
        return 0.0
    share = -1.0 / f if within and smooth else -math.copysign(level / size, f)
    change = math.hypot(share * x1 - c.problem.along[i, 0], share * x2 - c.problem.along[i, 1])
    c.problem.along[i, 0], c.problem.along[i, 1] = share * x1, share * x2
    return 0.0 * size if shared else float(change / level)  # with f known it is found at once


@kernel
def stop_slips(links: ContactLinks, c: Contacts, h: float) -> float:
    """Return the time after which the first of several slow slips ends, s, if in this step; else infinity.

    Until then constant forces, `TimeStep.force`, act as in a time step (`closedloop.mechanics.contacts.time_step`):
    every contact is in its cone with what is left of its slip. So all that stops together does so, and no contact stops
    another. The slip of one contact alone ends where its own friction stops it.
    """
    if c.problem.ends == 0.0:
        return math.inf
    k = links.k
    for r in range(3 * k):
        c.before[r] = c.F[r]
    count, rate = pack_problem(links, c, h, True, True), 0.0 * h
    if count > 1 and solve_within(links, c, count, 1.0 / h):
        rate = shorten(links, c, count, h)
    unpack_contacts(links, c, count)
    for i in range(k):
        if c.problem.form[i] != OFF and not is_resistance(c, i):
            put_into_cone(c, i)
    for r in range(3 * k):
        c.step.force[r] = c.F[r] - c.viscous[r]
        c.F[r] = c.before[r]
    return float(1.0 / rate) if rate > 0.0 else math.inf


@kernel
def put_into_cone(c: Contacts, i: int) -> None:
    """Replace the force of contact i, which may be outside its cone by what the solution is off, by one inside."""
    F, form = c.F[3 * i : 3 * i + 3], c.problem.form[i]
    mu = level_of(c, i) if form in (RAY, LINE) else c.mu[i]
    size, most = math.hypot(F[1], F[2]), mu * abs(F[0])
    if F[0] < 0.0 and form in (RAY, CONE):
        F[0], F[1], F[2] = 0.0, 0.0, 0.0
    elif size > most:
        F[1], F[2] = F[1] * (most / size), F[2] * (most / size)


@kernel
def shorten(links: ContactLinks, c: Contacts, k: int, h: float) -> float:
    """Return 1/τ of the τ at which the first slip ends just then, s⁻¹, within the step; zero if that was not found."""
    low, at_low = 1.0 / h, left_of_slips(c, k)
    if not at_low < 0.0:
        return 0.0 * low
    high, at_high = low, at_low
    for _ in range(ITERATIONS):
        high *= WIDENING
        if not solve_within(links, c, k, high):
            return 0.0 * low
        at_high = left_of_slips(c, k)
        if at_high >= 0.0:
            break
        low, at_low = high, at_high
    if not at_high >= 0.0:
        return 0.0 * low
    rate, side = high, 0
    for _ in range(ITERATIONS if at_high > EXACT else 0):  # the method of Illinois
        rate = (low * at_high - high * at_low) / (at_high - at_low)
        if not solve_within(links, c, k, rate):
            return 0.0 * low
        now = left_of_slips(c, k)
        if abs(now) <= EXACT or high - low <= EXACT * high:
            break
        if now < 0.0:
            low, at_low, at_high, side = rate, now, at_high * (0.5 if side < 0 else 1.0), -1
        else:
            high, at_high, at_low, side = rate, now, at_low * (0.5 if side > 0 else 1.0), 1
    return settle(links, c, k, rate) if has_derivatives(rate) else rate


@kernel
def settle(links: ContactLinks, c: Contacts, k: int, rate: float) -> float:
    """Return the 1/τ that was found with its derivatives, s⁻¹, and solve the problem there once more.

    A search that ends at an end of its bracket, as where friction is on its edge at once, has found none. Its equation
    is asked a little before slip ends: at the edge itself rounding would decide between two slopes.
    """
    beside = (1.0 + FOUND) * sought(rate)
    for r in range(3 * k):
        c.scratch.best[r] = c.stepping.P[r]
    if not solve_within(links, c, k, along(beside)):
        return 0.0 * rate
    slope = slope_of(left_of_slips(c, k))
    for r in range(3 * k):
        c.stepping.P[r] = c.scratch.best[r]
    if not solve_within(links, c, k, beside):
        return 0.0 * rate
    rate = settled(sought(rate), left_of_slips(c, k), slope)
    return rate if solve_within(links, c, k, rate) else 0.0 * rate
