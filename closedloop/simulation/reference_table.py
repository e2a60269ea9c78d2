"""The reference at every instant at which a stage is evaluated, as a table."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import replace

import numpy as np

from closedloop.base.arrays import Array
from closedloop.control.encoder import encoder_draws
from closedloop.control.reference.desired import Desired, desired
from closedloop.control.reference.force import force_at
from closedloop.control.reference.table import DrawnRow, Reference, TableRow
from closedloop.control.sensor import draws
from closedloop.mechanics.robot.pinocchio import Robot
from closedloop.mechanics.surface.placed import PlacedSurface
from closedloop.mechanics.surface.plane import unit
from closedloop.scenario.scenario import Scenario
from closedloop.simulation.cache import Cache

# A path on a surface that moves goes on this much longer than the run, so that its last row is no end of it.
BEYOND = 1.001


def reference_table(
    scenario: Scenario, robot: Robot, surface: PlacedSurface, q: Array, steps: int, nodes: int, cache: Cache
) -> tuple[Desired, Array]:
    """Return what is desired, and the table of it, `nodes` rows to a step, with noise in its last columns."""
    n = robot.n
    instants = (scenario.time.step / nodes) * np.arange(steps * nodes + 1, dtype=np.float64)
    row = DrawnRow if scenario.reads_encoders else TableRow
    spare = row.count(n) - Reference.count(n)
    motion = (
        scenario.robot.model_dump_json(),
        scenario.tool.model_dump_json(),
        scenario.reference.model_dump_json(),
        q.tobytes(),
        _path_key(scenario, surface),
    )
    tool = unit(scenario.tool.axis, "tool.axis"), scenario.tool.radius
    wanted = cache.get_shared(
        ("desired", *motion),
        lambda: desired(scenario, robot, surface, q, scenario.force_profile, scenario.time.duration * BEYOND, *tool),
        lambda made: 3 * made.joints.q.nbytes,
    )
    wanted = replace(wanted, profile=scenario.force_profile, force=scenario.law.force)
    noisy = scenario.sensor.noise > 0.0
    table = cache.get(
        ("table", *motion, instants.size, float(instants[1]), spare, noisy),
        lambda: wanted.table(instants, spare=spare),
        lambda made: made.nbytes,
    )
    table[:, Reference.place("force", n)] = force_at(wanted.profile, wanted.force, instants)
    if noisy:  # else its column has the zeros that it was made with
        table[::nodes, TableRow.place("noise", n)] = draws(scenario.sensor, steps + 1)
    if scenario.reads_encoders:
        table[::nodes, DrawnRow.place("draws", n)] = encoder_draws(scenario.encoder, steps + 1, n)
    return wanted, table


def _path_key(scenario: Scenario, surface: PlacedSurface) -> Hashable:
    """Return what of the surface the path depends on."""
    if surface.fixed_plane:
        return surface.normal.tobytes()
    sections = scenario.surface.model_dump_json(), scenario.surface_motion.model_dump_json()
    return (*sections, surface.origin.tobytes(), scenario.time.duration)
