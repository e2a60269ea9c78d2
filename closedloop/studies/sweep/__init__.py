"""Sweeps: a scenario with some keys changed, thousands of times, into one table; a sweep can be killed and resumed.

    closedloop sweep wam_slide --over law.force=5:15:101 --out force.parquet
    closedloop sweep plot force.parquet

The table is made of parts, and a part of rows. A part is written atomically, into a folder beside the table; a sweep
that was killed keeps the parts that exist, and runs the others. The content of a part depends on its number and on the
sweep's identity alone, so threads and workers of a cluster give the same table.

Names are loaded when they are first used, so that the command line can answer an interruption from its start.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from closedloop.studies.sweep.axes import Axis as Axis
    from closedloop.studies.sweep.axes import parse_axis as parse_axis
    from closedloop.studies.sweep.design import Design as Design
    from closedloop.studies.sweep.maps import sweep_plot as sweep_plot
    from closedloop.studies.sweep.run import run_sweep as run_sweep
    from closedloop.studies.sweep.sweep import Sweep as Sweep

_HOME = {
    "Axis": "axes",
    "Design": "design",
    "Sweep": "sweep",
    "parse_axis": "axes",
    "run_sweep": "run",
    "sweep_plot": "maps",
}

__all__ = sorted(_HOME)


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'closedloop.studies.sweep' has no attribute '{name}'")
    value = getattr(import_module(f"closedloop.studies.sweep.{_HOME[name]}"), name)
    globals()[name] = value
    return value
