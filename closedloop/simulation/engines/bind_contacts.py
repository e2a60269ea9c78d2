"""What the sections [[contact]] of a scenario ask for, as the rows that the loop reads; and what is wrong with them.

And what else touches the links: the round end of a tool, and forces from outside.
"""

import math
from difflib import get_close_matches
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError
from closedloop.jit.calls import address_of
from closedloop.jit.interpreted import interpreted
from closedloop.jit.user_code import of_users
from closedloop.loop.step.external import BEGIN, END, FELT, SHARE
from closedloop.loop.step.locate import BALL_TIP, BallTip
from closedloop.loop.step.memory import Constants
from closedloop.loop.step.tendons import rate_along, stops_of
from closedloop.mechanics.contacts import rolling
from closedloop.mechanics.contacts.edges import COUNT, PARTNER, choose_crossing, edges_of, reach_of_edges
from closedloop.mechanics.contacts.friction import (
    STICKING,
    contact_friction_entry,
    contact_frictions,
    coulomb_of,
    law_at,
    plain_friction,
)
from closedloop.mechanics.contacts.memory import ContactMemory, Contacts, make_contact_memory
from closedloop.mechanics.contacts.sections import BoxSection, ContactSection
from closedloop.mechanics.contacts.soft import compliances_of, depth_entry, is_soft
from closedloop.mechanics.contacts.surfaces import check_surface, contact_surfaces, surface_of, surfaces_of
from closedloop.mechanics.friction.contact import Contact
from closedloop.mechanics.friction.law import SurfaceFriction
from closedloop.mechanics.friction.laws.coulomb import SurfaceCoulomb
from closedloop.mechanics.friction.laws.none import NoFriction
from closedloop.mechanics.integrators import steps_impulses
from closedloop.mechanics.limits import CLOSED, HOVERING
from closedloop.mechanics.loops.bind import link_poses
from closedloop.mechanics.loops.boxes import MOST_POINTS
from closedloop.mechanics.loops.memory import BOXES, POSITION, ROWS, Bound, LoopMemory, bound_points, make_loop_memory
from closedloop.mechanics.loops.rows import locate_rows
from closedloop.mechanics.robot.pinocchio import Robot
from closedloop.mechanics.robot.tree import layout
from closedloop.mechanics.surface.placed import PlacedSurface, contact_frame, unit
from closedloop.mechanics.surface.surface import largest_mobility
from closedloop.scenario.arm import acting_tendons, joint_friction_of, stop_limits
from closedloop.scenario.scenario import Scenario
from closedloop.scenario.tables import names_of
from robot_models.errors import shown
from robot_models.loop_joint import WORLD
from robot_models.tendon import STOPS

# A point is on the edge of a disc to this share of its size: both are given in few digits.
ON_EDGE = 1e-6
# A quarter turn about z.
QUARTER = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
# As many contacts as a scenario may have.
MOST = 16384


class ContactRows(NamedTuple):
    """Where the contacts of a scenario are on the links."""

    # the rows of each contact: n, t1, t2 of a plane at rest; x, y, z of the frame that carries another surface. They
    # say where the point is, in axes fixed to the link that has the surface.
    bound: Bound
    # shapes, edges (k, SHAPE), (k, EDGE): the shapes of the contacts, those of the sections from the second on; see
    # `make_shape_memory`
    shapes: Array
    edges: Array


class ContactPlaces(NamedTuple):
    """Where the contacts of a scenario are on the links, and at the start."""

    rows: ContactRows
    # the gap of each section's contact at the start, m, and how far inside the edge of its surface it is, m
    start: tuple[tuple[float, float], ...]

    @property
    def starts_closed(self) -> bool:
        """Whether a contact of a link is closed at the start."""
        return any(gap <= HOVERING and inside >= 0.0 for gap, inside in self.start)


def entries_of_contacts(scenario: Scenario) -> list[Any]:
    """Return what the contacts of the links call by address."""
    sections = scenario.contact or ()
    names = names_of(sections)
    surfaces = surfaces_of(sections, names).values()
    compliances = compliances_of(scenario.compliance, sections, names, len(sections) + 1)
    return [
        *(entry for surface in surfaces for entry in surface.entries().values()),
        *(depth_entry(type(section)) for section, _ in compliances.members.values()),
        *(contact_friction_entry(type(section)) for section, _ in laws_of(scenario, names).values()),
    ]


def contact_memory(scenario: Scenario, robot: Robot, placed: ContactRows) -> ContactMemory:
    """Return a new memory of a scenario's contacts, the tip's the first of them."""
    sections = scenario.contact or ()
    rows, points = make_loop_memory(robot.tree, placed.bound), len(sections) + 1
    tendons = acting_tendons(scenario, robot.model)
    limits = np.hstack([stop_limits(scenario, robot.model), tendons[:, STOPS : STOPS + 2].T])
    stops = np.flatnonzero(np.isfinite(limits).any(axis=0))
    held = robot.n + len(tendons) if joint_friction_of(scenario, robot.model).sticks == "rigid" else 0
    turns = resistances_of(sections)
    names, k = names_of(sections), points + len(stops) + len(turns) + held
    laws = laws_of(scenario, names)
    asked = {i: law_at(section, where) for i, (section, where) in laws.items()}
    past = max((math.ceil(each.lag / scenario.time.step) + 3 for each in asked.values() if each.lag > 0.0), default=0)
    links, contacts = memory = make_contact_memory(robot.n, k, rows, len(stops), held, past, turns)
    contacts.restitution[:points] = [scenario.impact.restitution, *(section.restitution for section in sections)]
    contacts.restitution[points : points + len(stops)] = scenario.robot.stop_restitution
    contacts.mu[:points] = [plain_friction(scenario.friction, 0.0), *map(coulomb_of, sections)]
    contacts.rest_speed[1:points] = [section.rest_speed or 0.0 for section in sections]
    contacts.joint[points : points + len(stops)] = stops
    for edged in np.flatnonzero(placed.edges[:, COUNT]):
        contacts.gaps.extent[edged] = reach_of_edges(placed.edges[edged])
    write_joints(contacts, robot, placed.bound, stops, turns, held)
    if laws:
        frictions = contact_frictions(laws, k)
        links.frictions = address_of(frictions.addresses)
        links.keep_alive(frictions=frictions)
        write_laws(contacts, asked)
    compliances = compliances_of(scenario.compliance, sections, names, k)
    if compliances.members:
        contacts.soft[list(compliances.members)] = 1.0
        links.compliances = address_of(compliances.addresses)
        links.keep_alive(compliances=compliances)
    if turns or any(section.rolls or section.edge for section in sections):
        more = ((0, k - points), (0, 0))
        shapes = rolling.make_shape_memory(robot.n, np.pad(placed.shapes, more), np.pad(placed.edges, more))
        write_feet(shapes.shapes, placed.bound)
        write_spins(shapes.shapes, robot, placed.bound, scenario.has_surface)
        links.shapes = shapes.address
        links.keep_alive(shapes=shapes)
    if surfaces := surfaces_of(sections, names):
        given = contact_surfaces(surfaces, k)
        for i, (surface, _) in given.placed.items():
            contacts.gaps.extent[i] = surface.extent
        links.surfaces = address_of(given.addresses)
        links.keep_alive(surfaces=given)
    return memory


def write_feet(shapes: rolling.Shapes, bound: Bound) -> None:
    """Write of each point that is on the edge of a disc, beside the same plane, the contact of that edge."""
    rim, ends = shapes.rim, bound.sides.reshape(4, -1)[1:3, ::3]
    for i in np.flatnonzero(rim.radius):
        M = rolling.square_of(shapes.shape[i])
        for j in range(1, 1 + ends.shape[1]):
            a, b = slice(3 * i - 3, 3 * i), slice(3 * j - 3, 3 * j)
            alike = np.array_equal(ends[:, i - 1], ends[:, j - 1]) and not np.any(shapes.shape[j])
            alike = alike and all(np.array_equal(x[a], x[b]) for x in (bound.at_b, bound.along_b))
            off = bound.at_a[b][0] - bound.at_a[a][0]
            within = abs(off @ rim.axis[i]) <= ON_EDGE * rim.radius[i]
            if alike and within and abs(off @ np.linalg.pinv(M, 1e-12) @ off - 1.0) <= ON_EDGE:
                rim.foot_of[j] = i


def write_spins(shapes: rolling.Shapes, robot: Robot, bound: Bound, tip_touches: bool) -> None:
    """Write which joints turn a wheel: a link whose mass and whose contacts are symmetric about its axis.

    It carries no other link, no tip that may touch a surface, and no surface that others touch. Feet of a disc count as
    its edge.
    """
    tree, (own, others) = robot.tree, bound.sides.reshape(4, -1)[1:3, ::3]
    kinds, supports, parents = (
        tree.links[row * tree.n : (row + 1) * tree.n] for row in (layout.REVOLUTE, layout.SUPPORT, layout.PARENT)
    )
    for j in np.flatnonzero((kinds == layout.TURNS) & ((supports == 0) | (not tip_touches))):
        x, mixed = (
            tree.constants[tree.links[layout.CONSTANT * tree.n + j] :],
            (layout.XY, layout.XZ, layout.YZ, layout.HX, layout.HY),
        )
        even = not np.any(x[list(mixed)]) and abs(x[layout.HALF_XX] - x[layout.HALF_YY]) <= ON_EDGE * x[layout.HALF_XX]
        carries = bool(np.any(parents == j) or np.any(others == j))
        for i in np.flatnonzero(own == j) + 1:
            M, place = rolling.square_of(shapes.shape[i]), bound.at_a[3 * i - 3]
            size = ON_EDGE * max(float(np.linalg.norm(place)), ON_EDGE)
            alike = np.max(np.abs(M - QUARTER @ M @ QUARTER.T)) <= ON_EDGE * np.max(np.abs(M))
            on_axis = np.hypot(place[0], place[1]) <= size and not np.any(shapes.edge[i])
            even = even and (shapes.rim.foot_of[i] > 0 or (alike and on_axis))
        shapes.spins[j] = float(even and not carries)


def write_joints(
    contacts: Contacts, robot: Robot, bound: Bound, stops: NDArray[np.intp],
    turns: tuple[tuple[int, float, bool], ...], held: int,
) -> None:  # fmt: skip
    """Write which joints each contact moves: all, where loops, stops or dry friction of joints couple them.

    And whether some of those of its own groups have dry friction: a free body has no joints that could.
    """
    if robot.model.loops:
        return
    ends, rows = robot.tree.ends, len(bound.scale)
    first = np.searchsorted(ends, np.arange(robot.n), side="right")  # of the joints of its group
    for i, links in enumerate(bound.sides.reshape(4, rows)[1:3, ::3].T, 1):
        moved = [link for link in links if link >= 0]
        begin, end = first[moved].min(), ends[moved].max()
        contacts.moves.dry[i] = held > 0 and not np.all(robot.model.of_bodies[begin:end])
        if held == 0 and len(stops) == 0:
            contacts.moves.first[i], contacts.moves.end[i] = begin, end
            contacts.moves.upto[i], contacts.moves.again[i] = ends[begin], first[end - 1]
    for i, (owner, _, _) in enumerate(turns, 1 + rows // 3):
        for each in (getattr(contacts.moves, name) for name in ("first", "end", "upto", "again", "dry")):
            each[i] = each[owner]


def resistances_of(sections: tuple[ContactSection, ...]) -> tuple[tuple[int, float, bool], ...]:
    """Return the resistances of each contact: its number, the arm, m, and whether it is to pivoting, not to rolling."""
    return tuple(
        (i, arm, pivots)
        for i, section in enumerate(sections, 1)
        for arm, pivots in ((section.rolling, False), (section.pivoting, True))
        if arm > 0.0
    )


def laws_of(scenario: Scenario, names: tuple[str, ...]) -> dict[int, tuple[SurfaceFriction, str]]:
    """Return the laws of friction that are not Coulomb's μ alone, by their contact, and what each is called."""
    given: list[SurfaceFriction | None] = [scenario.friction, *(each.friction_law for each in scenario.contact or ())]
    called = ("friction", *(f"contact {name!r}: friction_law" for name in names))
    return {
        i: (law, called[i])
        for i, law in enumerate(given)
        if law is not None and not isinstance(law, SurfaceCoulomb | NoFriction)
    }


def write_laws(c: Contacts, laws: dict[int, Contact]) -> None:
    """Write what laws of friction say of their contacts once, by the number of the contact."""
    for i, law in laws.items():
        with of_users(law.member, "friction_law.kind" if i else "friction.kind"):
            c.friction.sticks[i], c.friction.kinetic[i], c.friction.lag[i] = (
                STICKING[law.member.sticks],
                law.kinetic_level,
                law.lag,
            )
            c.friction.capture[i], c.friction.states[i] = law.capture_speed, law.states.size


def place_states(contacts: Contacts, tip_at: int, at: int) -> int:
    """Write where states of laws are in `Work.z`, the tip's at `tip_at`, others from `at` on; return the end."""
    contacts.friction.states_at[0] = tip_at
    for i in range(1, contacts.friction.states.size):
        contacts.friction.states_at[i] = at
        at += int(contacts.friction.states[i])
    return at


def rest_states(scenario: Scenario, placed: ContactPlaces, v: Array, memory: ContactMemory, z: Array) -> None:
    """Write into z the states of the laws of friction of contacts that are closed and, as q̇ (n,), at rest."""
    c, laws = memory.contacts, laws_of(scenario, names_of(scenario.contact or ()))
    for i, (gap, inside) in enumerate(placed.start, 1):
        c.past_edge[i] = 1.0 if gap <= HOVERING and inside < 0.0 else 0.0
        if i in laws and c.friction.states[i] > 0.0 and gap <= HOVERING and inside >= 0.0 and not np.any(v):
            at = int(c.friction.states_at[i])
            with of_users(laws[i][0], "friction_law.kind"):
                z[at : at + int(c.friction.states[i])] = law_at(*laws[i]).rested()


def stops_at_start(memory: ContactMemory, constants: Constants, q: Array, v: Array) -> bool:
    """Return whether a joint is at a stop at the start, at rest or leaving; one that moves on strikes it at once."""
    links, c, held = memory.links, memory.contacts, False
    for i in range(links.points, links.points + links.stops):
        r = int(c.joint[i])
        (lower, upper), place = interpreted(stops_of)(constants, r), interpreted(rate_along)(constants, r, q)
        low, high, rate = place - lower, upper - place, interpreted(rate_along)(constants, r, v)
        if min(low, high) <= HOVERING:
            moves_on = (rate if low <= high else -rate) < 0.0
            if moves_on:
                c.gaps.cleared[i], c.gaps.floor[i] = 1.0, min(low, high) + 2.0 * CLOSED
            held = held or not moves_on
    return held


def bind_rows(sections: tuple[ContactSection, ...], robot: Robot) -> Bound:
    """Return the rows of each contact, see `ContactRows`."""
    poses = link_poses(robot.tree, robot.model.loop_home)
    sides: list[tuple[int, int, int, int]] = []
    at_a, at_b, along, along_a, half = [], [], [], [], []
    for section, name in zip(sections, names_of(sections), strict=True):
        a, turn, point = placed_on_link(robot, poses, section.link, section.point, f"contact {name!r}: link")
        flat = surface_of(section, name) is None and section.edge is None and section.box is None
        origin = section.through if flat or section.edge or section.box else (0.0, 0.0, 0.0)
        b, axes, plane = placed_on_link(robot, poses, section.against, origin, f"contact {name!r}: against")
        frame = contact_frame(unit(section.normal, f"contact {name!r}: normal")) if flat else np.eye(3)
        box, halves = section.box, np.zeros((2, 3, 3))
        if box is not None:
            halves[:] = box.half, box.onto
        lengths = np.linalg.norm(halves, axis=2)
        own, other = halves / np.where(lengths > 0.0, lengths, 1.0)[..., None]
        for k in range(3):
            kind = POSITION if box is None else BOXES
            sides.append((kind, a, b, int(k > 0 or (box is not None and box.point > 0))))
            at_a.append(point)
            at_b.append(plane)
            along.append(axes @ (frame[k] if box is None else other[k]))
            along_a.append(turn @ own[k])
            half.append(np.pad(lengths[min(k, 1)], (0, 2)))
    m = len(sides)
    kinds = np.array(sides, dtype=np.int64).reshape(m, 4).T.ravel()
    points_a, points_b, directions = (np.array(rows, dtype=np.float64).reshape(m, 3) for rows in (at_a, at_b, along))
    bound = bound_points(robot.n, kinds, points_a, points_b, directions)
    return bound._replace(along_a=np.array(along_a).reshape(m, 3), value=np.array(half).reshape(m, 5))


def shapes_of(sections: tuple[ContactSection, ...], robot: Robot) -> tuple[Array, Array]:
    """Return the shapes and the edges of the contacts, see `ContactRows`."""
    k = len(sections) + 1
    poses, found, edges = (
        link_poses(robot.tree, robot.model.loop_home),
        np.zeros((k, rolling.SHAPE)),
        np.zeros((k, rolling.EDGE)),
    )
    for i, (section, name) in enumerate(zip(sections, names_of(sections), strict=True), 1):
        if section.rolls or section.edge is not None:
            turn = placed_on_link(robot, poses, section.link, section.point, f"contact {name!r}: link")[1]
        if section.edge is not None:
            edges[i] = edges_of(section, turn)
            edges[i, PARTNER] = partner_of(sections, i)
        elif section.rolls:
            found[i] = rolling.shape_of(section, turn)
    return found, edges


def partner_of(sections: tuple[ContactSection, ...], i: int) -> int:
    """Return the number of the contact of the same edge with the other crossing, beside contact i; 0 if none is."""
    own = sections[i - 1]
    for k in (i - 1, i + 1):
        if 1 <= k <= len(sections):
            other, edge = sections[k - 1], sections[k - 1].edge
            alike = (own.link, own.against, own.at) == (other.link, other.against, other.at)
            if alike and edge and own.edge and edge.half == own.edge.half and edge.crossing != own.edge.crossing:
                return k
    return 0


def placed_on_link(
    robot: Robot, poses: list[tuple[Array, Array]], frame: str, at: tuple[float, ...], where: str
) -> tuple[int, Array, Array]:
    """Return the link that carries a frame, the frame's axes and a point of it, m, both in the link's own axes."""
    link, rotation, origin = -1, np.eye(3), np.zeros(3)
    if frame != WORLD:
        known = (*robot.model.frames, WORLD)
        if frame not in known:
            near = get_close_matches(frame, known, n=1)
            hint = f"did you mean {near[0]!r}?" if near else f"there are {', '.join(known[-8:])}"
            raise ScenarioError(f"{where} names no frame of {robot.model.name}, {shown(frame)}: {hint}")
        link, rotation, origin = robot.frame_at(frame, robot.model.home)
    axes, place = poses[link]
    return link, axes.T @ rotation, axes.T @ (origin + rotation @ np.array(at) - place)


def contact_rows(scenario: Scenario, robot: Robot) -> ContactRows:
    """Return where the contacts are on the links; refuse those that cannot be.

    Raises ScenarioError: one line for the first thing that is wrong.
    """
    sections = scenario.contact or ()
    names = names_of(sections)
    if len(sections) > MOST:
        raise ScenarioError(f"contact: there are {len(sections)} of them; at most {MOST}")
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise ScenarioError(f"contact: two are called {twice!r}: name each")
    moved = {name for frame in robot.moved for name in frame.names}
    for name, section in zip(names, sections, strict=True):
        if section.link == section.against:
            raise ScenarioError(f"contact {name!r}: link and against are both {section.link!r}: name two frames")
        if section.box is not None and not steps_impulses(scenario.time.integrator):
            raise ScenarioError(f"contact {name!r}: box: must be left out; time.integrator = 'time_stepping' has it")
        if section.link in moved:
            raise ScenarioError(
                f"contact {name!r}: link {section.link!r} moves as a [[mocap]] says: name it as against"
            )
        if section.against in moved and section.motion is None:
            raise ScenarioError(
                f"contact {name!r}: {section.against!r} moves as a [[mocap]] says: give the contact that motion too, "
                "in the axes of this frame at the start"
            )
    for k, (name, section) in enumerate(zip(names, sections, strict=True)):
        if section.box is not None and not stands_in_order(sections, k, section.box):
            raise ScenarioError(
                f"contact {name!r}: box: two boxes have a contact for each point, from 0 to 7, one after the other"
            )
    return ContactRows(bind_rows(sections, robot), *shapes_of(sections, robot))


def stands_in_order(sections: tuple[ContactSection, ...], k: int, box: BoxSection) -> bool:
    """Whether contact k, of two boxes, stands between those of the points before and after its own."""
    for j, point in ((k - 1, box.point - 1), (k + 1, box.point + 1)):
        if 0 <= point < MOST_POINTS:
            beside = {"box": box.model_copy(update={"point": point}), "name": ""}
            if not 0 <= j < len(sections) or sections[j].model_copy(update={"name": ""}) != sections[k].model_copy(
                update=beside
            ):
                return False
    return True


def placed_contacts(scenario: Scenario, robot: Robot, on: ContactRows, q: Array) -> ContactPlaces:
    """Return where the contacts are at q (n,); refuse those that start inside their planes.

    Raises ScenarioError: one line for the first thing that is wrong.
    """
    sections = scenario.contact or ()
    names = names_of(sections)
    sides = on.bound.sides.reshape(4, -1)[:, ::3]
    memory = make_loop_memory(robot.tree, on.bound)
    places = start_places(sections, memory, rolling.make_shape_memory(robot.n, on.shapes, on.edges).shapes, q)
    for i, (name, section, (gap, inside, n)) in enumerate(zip(names, sections, places, strict=True)):
        if sides[1, i] == sides[2, i]:
            raise ScenarioError(f"contact {name!r}: no joint is between link and against: name frames that move apart")
        if gap < -HOVERING and inside >= 0.0:
            thrown, what = "", "shape" if section.rolls else "point"
            if section.compliance is not None and is_soft(section):
                H, rows = robot.terms(q, np.zeros(robot.n)).mass_matrix, memory.rows.G[3 * i : 3 * i + 3]
                thrown = section.compliance.thrown_out(-gap, largest_mobility(H, n[None] @ rows))
                if not thrown:
                    continue
            if section.box is not None:
                raise ScenarioError(
                    f"contact {name!r}: the boxes start {-gap:.4g} m inside each other{thrown}: move one away"
                )
            raise ScenarioError(
                f"contact {name!r}: the {what} starts {-gap:.4g} m inside the surface{thrown}: "
                "start it outside, or move the surface with through"
            )
    return ContactPlaces(on, tuple((gap, inside) for gap, inside, _ in places))


def start_places(
    sections: tuple[ContactSection, ...], rows: LoopMemory, shapes: rolling.Shapes, q: Array
) -> list[tuple[float, float, Array]]:
    """Return the gap of each contact at q (n,), m, how far inside the edge of its surface it is, m, and its normal.

    The normal is in the axes of its rows. At the start these are those of `bind_rows`.
    """
    names = names_of(sections)
    rows.rows.q[:] = q
    interpreted(locate_rows)(rows.links, rows.rows)
    surfaces, places = surfaces_of(sections, names), []
    for i, (name, section) in enumerate(zip(names, sections, strict=True)):
        place, surface = rows.rows.error[3 * i : 3 * i + 3], surfaces.get(i + 1)
        if section.box is not None:
            there = rows.rows.written[3 * i] == ROWS  # these rows are along the normal already
            places.append((float(place[0]), math.inf if there else -1.0, np.eye(3)[0]))
            continue
        if section.edge is not None:
            interpreted(rolling.turn_against)(rows.links, rows.rows, 3 * i, shapes)
            interpreted(choose_crossing)(shapes, i + 1, place, True, -1)
            places.append((float(shapes.crossing[0]), float(shapes.crossing[1]), shapes.frame[i + 1][0].copy()))
            continue
        if section.rolls and surface is None:
            interpreted(rolling.roll_on_plane)(rows.links, rows.rows, shapes, i + 1, 0.0)
        now = None if surface is None else check_surface(surface, place, name)
        places.append((float(place[0]), math.inf, np.eye(3)[0]) if now is None else (now.gap, now.inside, now.frame[0]))
    return places


class BallMemory(NamedTuple):
    """The memory of a tip with a round end, kept as long as its address is used."""

    links: BallTip
    kept: tuple[Any, ...]


def ball_memory(robot: Robot, surface: PlacedSurface, radius: float, loop: int) -> BallMemory:
    """Return a new memory of a tip with an end of this radius, m, on a surface; `loop` is the address of the loop."""
    poses = link_poses(robot.tree, robot.model.loop_home)
    link, _, point = placed_on_link(robot, poses, robot.tip, (0.0, 0.0, 0.0), "robot.tip")
    kinds = np.array([POSITION] * 3 + [link] * 3 + [-1] * 3 + [0, 1, 1], dtype=np.int64)
    along = surface.frame if surface.fixed_plane else np.eye(3)
    bound = bound_points(robot.n, kinds, np.tile(point, (3, 1)), np.zeros((3, 3)), along)
    shape = np.zeros((1, rolling.SHAPE))
    shape[0, rolling.RADIUS] = radius
    rows, shapes = make_loop_memory(robot.tree, bound), rolling.make_shape_memory(robot.n, shape)
    links = BallTip(np.zeros(BALL_TIP, dtype=np.int64))
    links.address, links.loop, links.rows, links.shapes = address_of(links.memory), loop, rows.address, shapes.address
    return BallMemory(links, (rows, shapes))


def external_memory(scenario: Scenario, robot: Robot) -> LoopMemory:
    """Return a new memory of forces from outside, see `closedloop.loop.step.external`."""
    sections = scenario.external_force or ()
    poses, m = link_poses(robot.tree, robot.model.loop_home), len(sections)
    places: list[tuple[int, int, Array, Array, Array]] = []
    for i, section in enumerate(sections):
        where, (frame, at) = f"external_force[{i}]", section.place(robot.tip, scenario.tool.offset)
        link, _, point = placed_on_link(robot, poses, frame, at, f"{where}.link")
        other, turn, _ = placed_on_link(robot, poses, section.axes, (0.0, 0.0, 0.0), f"{where}.axes")
        if link < 0:
            raise ScenarioError(f"{where}.link = {shown(frame)}: no joint moves it: name a frame that moves")
        places.append((link, other, point, turn @ section.force, turn @ section.moment))
    links, others, points, forces, moments = map(np.array, zip(*places, strict=True))
    sides = np.concatenate([np.full(m, POSITION), links, others, np.zeros(m)]).astype(np.int64)
    bound = bound_points(robot.n, sides, points, np.zeros((m, 3)), moments)
    memory = make_loop_memory(robot.tree, bound._replace(along_a=forces))
    span = memory.rows.value
    span[:, BEGIN] = [section.start for section in sections]
    span[:, END] = [section.end for section in sections]
    span[:, SHARE], span[:, FELT] = span[:, BEGIN] <= 0.0, [section.link is None for section in sections]
    return memory
