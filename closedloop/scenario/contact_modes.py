"""What contacts of links make bodies do by themselves: bristles and viscous friction of all of them together.

Of contacts that press with f the tangents J_t, of each, give ẍ = −H⁻¹ Σ J_tᵀ (k f J_t x + d J_t ẋ), in the joints and
the bodies, with what the rigid ones among them hold along their normals taken out of H⁻¹.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from closedloop.base.arrays import Array
from closedloop.mechanics.contacts.sections import ContactSection
from closedloop.mechanics.friction.packing import surface_parameters
from closedloop.mechanics.friction.presliding import bristle
from closedloop.mechanics.robot.pinocchio import Robot
from closedloop.scenario.contact_names import patches_of
from closedloop.scenario.gains import closed_mobility, held_at
from robot_models.loop_joint import WORLD


class Pressed(NamedTuple):
    """Where contacts of links press: q (n,), and the normal force of each there, N."""

    q: Array
    load: Array


def where_they_press(q: Array, forces: Array) -> Pressed | None:
    """Return the row of q (N, n) in which contacts press as they mostly do, of forces (N, k), N; None if never."""
    pressed = forces > 0.0
    if not np.any(pressed):
        return None
    load = np.array([np.median(f[on]) if np.any(on) else 0.0 for f, on in zip(forces.T, pressed.T, strict=True)])
    return Pressed(q[int(np.argmax(pressed.sum(axis=1)))], load)


def has_motion(section: ContactSection) -> bool:
    """Whether the friction of a contact has bristles, or a viscous part."""
    law = section.friction_law
    return any(hasattr(law, name) for name in ("stiffness", "viscous")) and not isinstance(section.at, str)


def motion_of_contacts(
    sections: tuple[ContactSection, ...], robot: Robot, pressed: Pressed
) -> tuple[str, NDArray[Any], NDArray[Any]] | None:
    """Return the key of what acts most, and stiffness and damping (n, n), 1/s² and 1/s; None where nothing does."""
    n, names = robot.n, {k: name for name, numbers in patches_of(sections).items() for k in numbers}
    terms = robot.terms(np.array(pressed.q), np.zeros(n))
    mobility = closed_mobility(robot, pressed.q, np.linalg.inv(terms.mass_matrix))
    rows = {k: _rows(section, robot, pressed.q) for k, section in enumerate(sections) if pressed.load[k] > 0.0}
    held = [rows[k][:1] for k in rows if sections[k].compliance is None and sections[k].surface is None]
    if held:
        mobility = held_at(np.vstack(held), mobility)
    K, D, most, key = np.zeros((n, n)), np.zeros((n, n)), 0.0, ""
    for k, along in rows.items():
        law = sections[k].friction_law
        if law is None or not has_motion(sections[k]):
            continue
        stiffness, damping = bristle(law, surface_parameters(law), float(pressed.load[k]))
        tangents = along[1:]
        K, D = K + stiffness * tangents.T @ tangents, D + damping * tangents.T @ tangents
        fast = float(np.linalg.norm(tangents @ mobility @ tangents.T, 2))
        rates = {"stiffness": (stiffness * fast) ** 0.5, "damping": damping * fast}
        which = max(rates, key=lambda name: rates[name])
        if rates[which] > most:
            most = rates[which]
            which = "viscous" if which == "damping" and not hasattr(law, "damping") else which
            key = f"contact.{names[k]}.friction_law.{which}"
    return (key, mobility @ K, mobility @ D) if most > 0.0 else None


def _rows(section: ContactSection, robot: Robot, q: Array) -> Array:
    """Return what the joints move a contact's point by, along its normal and two tangents, (3, n)."""
    at = section.at if not isinstance(section.at, str) else (0.0, 0.0, 0.0)
    _, axes, origin = robot.frame_at(section.link, q)
    point = origin + axes @ np.array(at)
    moves = _moves(section.link, robot, q, point) - _moves(section.against, robot, q, point)
    normal = robot.frame_at(section.against, q)[1] @ np.array(section.normal)
    return np.linalg.svd(normal[None])[2] @ moves


def _moves(frame: str, robot: Robot, q: Array, point: Array) -> Array:
    """Return the Jacobian (3, n) of a point, base axes, that a frame carries."""
    if frame == WORLD:
        return np.zeros((3, robot.n))
    carrier = Robot(robot.model, frame)
    jacobian, lever = carrier.frame_jacobian(q), point - carrier.terms(q, np.zeros(robot.n)).position
    return jacobian[:3] - np.cross(lever, jacobian[3:], axis=0)
