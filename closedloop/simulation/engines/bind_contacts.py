"""What the sections [[contact]] of a scenario ask for, as the rows that the loop reads; and what is wrong with them."""

from __future__ import annotations

from difflib import get_close_matches

import numpy as np
from numpy.typing import NDArray

from closedloop.base.errors import ScenarioError
from closedloop.jit.interpreted import interpreted
from closedloop.jit.pointers import address_of
from closedloop.mechanics.contacts.memory import ContactMemory, make_contact_memory
from closedloop.mechanics.contacts.modes import HOVERING
from closedloop.mechanics.contacts.sections import ContactSection
from closedloop.mechanics.contacts.soft import compliances_of, is_soft
from closedloop.mechanics.contacts.surfaces import check_surface, contact_surfaces, surface_of, surfaces_of
from closedloop.mechanics.friction.laws.coulomb import SurfaceCoulomb
from closedloop.mechanics.loops.bind import link_poses
from closedloop.mechanics.loops.memory import POSITION, Bound, LoopMemory, make_loop_memory
from closedloop.mechanics.loops.rows import locate_rows
from closedloop.mechanics.robot.pinocchio import Robot
from closedloop.mechanics.surface.plane import contact_frame, unit
from closedloop.scenario.arm import stop_limits
from closedloop.scenario.contact_names import names_of
from closedloop.scenario.scenario import Scenario
from robot_models.errors import shown
from robot_models.loop_joint import WORLD

Array = NDArray[np.float64]

# As many contacts as a scenario may have.
MOST = 64


def contact_memory(scenario: Scenario, robot: Robot) -> ContactMemory:
    """Return a new memory of a scenario's contacts, the tip's the first of them."""
    sections = scenario.contact or ()
    rows, points = rows_of(sections, robot), len(sections) + 1
    stops = np.flatnonzero(np.isfinite(stop_limits(scenario, robot.model)).any(axis=0))
    links, contacts = memory = make_contact_memory(robot.n, points + len(stops), rows, len(stops))
    contacts.restitution[:points] = [scenario.impact.restitution, *(section.restitution for section in sections)]
    contacts.restitution[points:] = scenario.robot.stop_restitution
    contacts.mu[1:points] = [section.friction for section in sections]
    contacts.joint[points:] = stops
    if isinstance(scenario.friction, SurfaceCoulomb) and scenario.surface.contact == "unilateral":
        contacts.mu[0] = scenario.friction.coefficient
    compliances = compliances_of(scenario.compliance, sections, names_of(sections), points + len(stops))
    if compliances.members:
        contacts.soft[list(compliances.members)] = 1.0
        links.compliances = address_of(compliances.addresses)
        links.keep_alive(compliances=compliances)
    if surfaces := surfaces_of(sections, names_of(sections)):
        asked = contact_surfaces(surfaces, points + len(stops))
        links.surfaces = address_of(asked.addresses)
        links.keep_alive(surfaces=asked)
    return memory


def rows_of(sections: tuple[ContactSection, ...], robot: Robot) -> LoopMemory:
    """Return the rows of each contact: n, t1, t2 of a plane at rest; x, y, z of the frame that carries another surface.

    They say where the point is, in axes fixed to the link that has the surface.
    """
    poses = link_poses(robot.tree, robot.model.loop_home)
    sides: list[tuple[int, int]] = []
    at_a, at_b, along = [], [], []
    for section, name in zip(sections, names_of(sections), strict=True):
        a, _, point = _placed(robot, poses, section.link, section.at, f"contact {name!r}: link")
        flat = surface_of(section, name) is None
        origin = section.through if flat else (0.0, 0.0, 0.0)
        b, axes, plane = _placed(robot, poses, section.against, origin, f"contact {name!r}: against")
        frame = contact_frame(unit(section.normal, f"contact {name!r}: normal")) if flat else np.eye(3)
        for k in range(3):
            sides.append((a, b))
            at_a.append(point)
            at_b.append(plane)
            along.append(axes @ frame[k])
    m = len(sides)
    kinds = np.array(
        [*[POSITION] * m, *(a for a, _ in sides), *(b for _, b in sides), *[0, 1, 1] * len(sections)], dtype=np.int64
    )
    none = np.zeros((m, 3))
    bound = Bound(
        kinds, np.array(at_a), np.array(at_b), none, np.array(along), np.zeros((m, 5)), np.ones(m), np.zeros(robot.n)
    )
    return make_loop_memory(robot.tree, bound)


def _placed(
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


def check_contacts(scenario: Scenario, robot: Robot, q: Array) -> None:
    """Refuse contacts that cannot be, that start inside their planes, and what does not go with several contacts.

    Raises
    ------
    ScenarioError
        One line for the first thing that is wrong.
    """
    sections = scenario.contact or ()
    names = names_of(sections)
    if len(sections) > MOST:
        raise ScenarioError(f"contact: there are {len(sections)} of them; at most {MOST}")
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise ScenarioError(f"contact: two are called {twice!r}: name each")
    for name, section in zip(names, sections, strict=True):
        if section.link == section.against:
            raise ScenarioError(f"contact {name!r}: link and against are both {section.link!r}: name two frames")
    sides = rows_of(sections, robot).links.kept["bound"].sides.reshape(4, -1)[:, ::3]
    for i, (name, section, gap) in enumerate(zip(names, sections, start_gaps(sections, robot, q), strict=True)):
        if sides[1, i] == sides[2, i]:
            raise ScenarioError(f"contact {name!r}: no joint is between link and against: name frames that move apart")
        if gap < -HOVERING and not is_soft(section):
            raise ScenarioError(
                f"contact {name!r}: the point starts {-gap:.4g} m inside the surface: start it outside, or move the "
                "surface with through"
            )
    _refuse_together(scenario)


def start_gaps(sections: tuple[ContactSection, ...], robot: Robot, q: Array) -> list[float]:
    """Return the gap of each contact at q (n,), m."""
    rows, names = rows_of(sections, robot), names_of(sections)
    rows.rows.q[:] = q
    interpreted(locate_rows)(rows.links, rows.rows)
    surfaces, gaps = surfaces_of(sections, names), []
    for i, name in enumerate(names):
        place, surface = rows.rows.error[3 * i : 3 * i + 3], surfaces.get(i + 1)
        gaps.append(float(place[0]) if surface is None else check_surface(surface, place, name))
    return gaps


def starts_closed(scenario: Scenario, robot: Robot, q: Array) -> bool:
    """Whether a contact of a link is closed at the start."""
    return any(gap <= HOVERING for gap in start_gaps(scenario.contact or (), robot, q))


def _refuse_together(scenario: Scenario) -> None:
    """Refuse what does not go with several contacts."""
    bilateral = scenario.surface.contact == "bilateral"
    kind = scenario.friction.kind
    tip = scenario.friction.sticks == "elastic" if bilateral else kind in ("none", "coulomb")
    for key, wrong, right in (
        (f"friction.kind = {kind!r}", not tip, "none or one without sticking" if bilateral else "none or coulomb"),
        ("joint_friction.kind", scenario.joint_friction.sticks == "rigid", "none, or one that sticks as a spring"),
        ("stabiliser.kind", scenario.stabiliser.kind in ("projection", "both"), "baumgarte or none"),
        ("surface.extent", scenario.surface.extent is not None, "left out"),
        ("surface.edge_radius", scenario.surface.edge_radius is not None, "left out"),
        ("robot.friction", scenario.robot.friction, "false: give joint_friction"),
    ):
        if wrong:
            raise ScenarioError(f"{key}: cannot be combined with [[contact]]: must be {right}")
