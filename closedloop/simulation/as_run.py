"""From the rows of a problem to its run: columns, energies, and what made it."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import count
from typing import Any

import numpy as np
from numpy.typing import NDArray

from closedloop.base.arrays import Array
from closedloop.control.reference.desired import Reference
from closedloop.jit.interim import at_hand
from closedloop.jit.kernel import plain
from closedloop.loop.events.table import event_columns
from closedloop.loop.step.record_row import CONTACT_RECORDED, RECORDED, recorded
from closedloop.mechanics.robot.tree import Tree, energies_of_rows, potential_energies, work_size
from closedloop.record.columns.derived import state_columns
from closedloop.record.columns.record import POSITIONS, RESISTANCE_COLUMNS, SURFACE_COLUMNS, Column
from closedloop.record.run import Run
from closedloop.record.save import package_versions
from closedloop.scenario.arm import start_positions, without_tools
from closedloop.scenario.user_module import member_digests
from closedloop.simulation.engines.needs import arm_columns
from closedloop.simulation.engines.problem import Problem
from closedloop.simulation.engines.user_law import Law
from robot_models.coordinates import continuous, with_quaternions

# Runs of one process after which it is worth reading the compiled form of `potential_energies` from the disk.
FEW_RUNS = 3
_runs = count(1)


def as_run(
    problem: Problem,
    rows: Array,
    events: Array,
    seconds: float,
    engine: str,
    *,
    law: tuple[str, str] = ("scenario", ""),
    with_states: bool = True,
    stopped: str | None = None,
) -> Run:
    """Return the rows and events of a problem, see `run_loop`, as a run; the rest as in `Run`.

    `law` is the name and the digest of what drove it, `with_states` whether the rows have the states of the scenario's.
    """
    model = problem.robot.model
    columns, states = columns_of_rows(problem, rows, problem.table, with_states)
    if "link_modes" in columns:
        columns["link_modes"] = columns["link_modes"].astype(np.int8)
    columns["mode"] = columns["mode"].astype(np.int8)
    if not problem.scenario.has_surface:
        for name in SURFACE_COLUMNS:
            del columns[name]
    columns["potential_energy"] = _potential_energies(problem.robot.tree, columns["q"])
    columns |= positions_told(problem, columns)
    return Run(
        scenario=problem.scenario,
        model=without_tools(model),
        columns=columns | event_columns(events),
        law=law[0],
        versions=package_versions(),
        stopped=stopped,
        wall_seconds=seconds,
        engine=engine,
        law_digest=law[1],
        member_digests=member_digests(problem.scenario),
        added=states,
    )


def columns_of_rows(
    problem: Problem, rows: Array, table: Array, with_states: bool = True
) -> tuple[dict[str, NDArray[Any]], dict[str, Column]]:
    """Return the columns that rows and the table of what is desired have as they are, and what those of states are.

    They are copies of parts of both: of derivatives of rows and table they are the derivatives of the columns.
    """
    n, length = problem.robot.n, rows.shape[0]
    wanted = table[:: problem.nodes][:length]
    reference_rows = wanted[:, : 2 * n].reshape(-1, 2, n)
    columns: dict[str, NDArray[Any]] = {
        "time": problem.h * np.arange(length),
        "reference_position": reference_rows[:, 0].copy(),
        "reference_velocity": reference_rows[:, 1].copy(),
        "reference_tip": wanted[:, Reference.place("position", n)].copy(),
        "reference_force": wanted[:, Reference.place("force", n)].copy(),
    }
    sections = problem.scenario.contact or ()
    left_out = () if any(section.resists for section in sections) else RESISTANCE_COLUMNS
    of_contacts = [name for name in CONTACT_RECORDED if sections and name not in left_out]
    there = (*RECORDED, *arm_columns(problem.scenario), *of_contacts)
    columns |= {name: recorded(rows, n, name, len(sections), problem.row_states) for name in there}
    states = state_columns(problem.scenario, n) if with_states else {}
    first = rows.shape[1] - problem.row_states
    columns |= {name: rows[:, first:][:, place].copy() for name, (_, place) in states.items()}
    return columns, {name: column for name, (column, _) in states.items()}


def positions_told(problem: Problem, columns: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Return those of a run's columns that are positions as the run tells them, (N, nq), from what the loop has."""
    model = problem.robot.model
    if not model.balls:
        return {}
    start, types = start_positions(problem.scenario, model), model.joint_types
    return {
        name: continuous(with_quaternions(column, types), types, start)
        for name, column in columns.items()
        if name in POSITIONS
    }


def _potential_energies(tree: Tree, q: Array) -> Array:
    """Return the potential energy (N,) at each row of q (N, n), J."""
    if next(_runs) <= FEW_RUNS or not at_hand(potential_energies):
        return energies_of_rows(tree, q)
    energies = np.empty(q.shape[0])
    potential_energies(tree, q, np.zeros(plain(work_size)(tree.n)), energies)
    return energies


def law_name(law: Law) -> str:
    """Return the name of a user's law, MODULE:NAME."""
    module, name = getattr(law, "__module__", "?"), getattr(law, "__qualname__", type(law).__name__)
    return f"{module}:{name}"
