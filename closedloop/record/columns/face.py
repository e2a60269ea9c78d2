"""What a face of several contacts does together: their wrench, and the centre of pressure, from the record of a run."""

from __future__ import annotations

import numpy as np

from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError
from closedloop.record.columns.record import Record
from closedloop.record.columns.touching import contacts_of, frames_in_rows
from closedloop.scenario.arm import robot_of, without_tools
from closedloop.scenario.scenario import Scenario
from closedloop.scenario.tables import names_of, patches_of
from robot_models.errors import shown


def numbers_of(scenario: Scenario, name: str) -> list[int]:
    """Return the numbers, from 0, of the contacts of a name: of all points of a face, or of one of them."""
    sections = scenario.contact or ()
    each = {own: [k] for k, own in enumerate(names_of(sections))}
    found = patches_of(sections) | each
    if name not in found:
        there = ", ".join(patches_of(sections)) or "the run has no [[contact]]"
        raise ScenarioError(f"contact_wrench: name = {shown(name)}: there is no such contact: {there}")
    return found[name]


def face_wrench(run: Record, name: str) -> Array:
    """Return force, moment and centre of pressure, (N, 9); see `closedloop.Run.contact_wrench`."""
    numbers = numbers_of(run.scenario, name)
    robot = robot_of(run.scenario, without_tools(run.model))
    mechanism = robot.passes[3]
    axes, origins, _ = frames_in_rows(mechanism, robot.pinocchios(run.q), list(range(1, mechanism.njoints)))
    contacts = contacts_of(run.scenario, mechanism)
    first = contacts[numbers[0]]
    middle = np.mean([contacts[k].point for k in numbers], axis=0)
    about = origins[:, first.point_frame] + axes[:, first.point_frame] @ middle
    force, moment, pressed = np.zeros((3, len(run), 3))
    total = np.zeros(len(run))
    for k in numbers:
        normal = run.link_forces[:, k]
        place, each = contacts[k].forces(normal, run.link_frictions[:, 2 * k : 2 * k + 2], axes, origins, run.time)
        force += each
        moment += np.cross(place - about, each)
        pressed += normal[:, None] * place
        total += normal
    centre = pressed / np.where(total > 0.0, total, np.nan)[:, None]
    return np.hstack([force, moment, centre])
