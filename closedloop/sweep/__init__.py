"""Sweeps: a scenario with some keys changed, thousands of times over, into one table that no kill can spoil.

    python -m closedloop.sweep wam_slide --over law.force=5:15:101 --out force.parquet
    python -m closedloop.sweep plot force.parquet

The table is made of parts, and a part of rows. A part is written whole or not at all, in a folder beside the table; a
sweep that was killed finds the parts that are there, and runs the others. What a part holds depends on its number and
on the sweep's identity alone, never on who ran it, so threads here and workers of a cluster give the same table.
"""

from closedloop.sweep.axes import Axis, parse_axis
from closedloop.sweep.design import Design
from closedloop.sweep.maps import sweep_plot
from closedloop.sweep.run import Sweep, run_sweep

__all__ = ["Axis", "Design", "Sweep", "parse_axis", "run_sweep", "sweep_plot"]
