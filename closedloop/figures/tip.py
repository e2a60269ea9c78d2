"""The tip position, Fig. 4 of the paper."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from closedloop.figures.style import (
    COLOURS,
    STROKES,
    contact_changes,
    dress,
    explain_contact,
    legend_beside_title,
    length_unit,
    new_figure,
)
from closedloop.record.run import Run

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Displacements below this share of the largest are not seen beside it, and get a panel of their own; what is below
# ROUNDING, m, is what many steps have rounded off.
SMALL, ROUNDING = 0.01, 1e-12


def tip_position(run: Run) -> Figure:
    """Draw the tip's displacement from its start along x, y and z against time, its small components apart (Fig. 4)."""
    moved = run.position - run.position[0]
    sizes = np.max(np.abs(moved), axis=0)
    if length_unit(float(sizes.max()))[1] == "mm":
        small = [k for k in range(3) if ROUNDING < sizes[k] < SMALL * sizes.max()]
    else:
        small = [0, 1, 2]
    slide = run.scenario.reference.kind == "line" and not contact_changes(run)
    figure = new_figure(height=4.6 if small else 3.4)
    ratios = [2, 1] if small else [1]
    panels = figure.subplots(len(ratios), 1, sharex=True, height_ratios=ratios, squeeze=False)[:, 0]
    above = panels[0]
    for k, axis in enumerate("xyz"):
        name = f"{axis} from {round(run.position[0, k], 4) + 0.0:.4f} m"
        above.plot(run.time, 1e3 * moved[:, k], STROKES[k], color=COLOURS[k], label=name)
    above.margins(y=0.15)
    dress(above, run, "Tip, base frame", "displacement [mm]", show_events=not small)
    legend_beside_title(above)
    if small:
        above.set_xlabel("")
        below = panels[1]
        factor, unit = length_unit(float(sizes[small].max()))
        for k in small:
            below.plot(run.time, factor * moved[:, k], STROKES[k], color=COLOURS[k], label="xyz"[k])
        dress(
            below,
            run,
            "Displacement off the path" if slide else "Small components of the displacement",
            f"[{unit}]",
            label_marks=False,
        )
        legend_beside_title(below)
    explain_contact(figure, run)
    return figure
