"""Every controller on every kind of friction: does it still hold 10 N when the surface is rough?

The task is wam_slide's, with the motion from rest to rest: press with 10 N and slide 108 mm in six seconds. Rows are
controllers with what they know of friction, columns are laws of friction of about the same level (kinetic 0.25, static
0.35). Measured from `SETTLED_FROM` on, when the contact has settled and the tip is about to move:

    force RMS, peak   of f − f_des, N
    path RMS          of the tip's distance from its path along the surface, mm
    settling          how long after the tip stops the force error was last over `BAND`, s
"""

from __future__ import annotations

import csv
import json
import math
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from closedloop.errors import ClosedLoopError
from closedloop.record import Run
from closedloop.scenario import load_scenario
from closedloop.simulation import simulate

Array = NDArray[np.float64]

SETTLED_FROM, BAND = 1.5, 0.2  # s, N
STOP = 6.5  # s
MEASURES = ("force_rms", "force_peak", "path_rms", "settling")

JOINT = {"law.kp": [900.0, 900.0, 400.0, 300.0], "law.kd": [60.0, 60.0, 30.0, 20.0]}
LAWS: dict[str, dict[str, Any]] = {
    "paper": {},
    "hybrid": {"law.kind": "hybrid", **JOINT, "law.force_integral": 20.0},
    "operational space": {"law.kind": "operational_space", "law.force_integral": 20.0},
    "dynamic hybrid": {"law.kind": "dynamic_hybrid", "law.force_integral": 20.0},
    "impedance": {"law.kind": "impedance", "law.force_integral": 20.0},
    "admittance": {"law.kind": "admittance", "law.force_integral": 20.0},
}
WRONG_MODEL = {  # 20 % less friction than there is
    "compensation.kind": "model",
    "compensation.kinetic": 0.2,
    "compensation.static": 0.28,
    "compensation.stribeck_speed": 0.003,
}
OBSERVER = {"compensation.kind": "observer", "compensation.rate": 100.0}
ADAPTIVE = {"compensation.kind": "adaptive"}
CONTROLLERS: dict[str, dict[str, Any]] = (
    LAWS
    | {f"{name} + observer": settings | OBSERVER for name, settings in LAWS.items() if name != "paper"}
    | {f"{name} + model, 20 % off": LAWS[name] | WRONG_MODEL for name in ("operational space", "impedance")}
    | {f"{name} + adaptive": LAWS[name] | ADAPTIVE for name in ("operational space", "impedance")}
)
FRICTIONS: dict[str, dict[str, Any]] = {
    "none": {},
    "coulomb": {"kind": "coulomb", "coefficient": 0.25},
    "viscous": {"kind": "coulomb_viscous", "coefficient": 0.25, "viscous": 5.0},
    "stribeck": {"kind": "stribeck", "kinetic": 0.25, "static": 0.35, "stribeck_speed": 0.003},
    "karnopp": {"kind": "karnopp", "kinetic": 0.25, "static": 0.35, "dead_band": 1e-4},
    "dahl": {"kind": "dahl", "coefficient": 0.25, "stiffness": 1e4},
    "lugre": {
        "kind": "lugre", "kinetic": 0.25, "static": 0.35, "stribeck_speed": 0.003, "stiffness": 1e4, "damping": 10.0,
    },
    "seven-parameter": {
        "kind": "seven_parameter", "kinetic": 0.25, "static_excess": 0.1, "stribeck_speed": 0.003, "stiffness": 1e4,
        "memory_delay": 0.005, "rise_time": 1.0,
    },
}  # fmt: skip
QUICK = ("paper", "impedance", "impedance + observer"), ("none", "stribeck")


def measures(run: Run) -> dict[str, float]:
    """Return what is measured of a run that reaches its end; see the module's text."""
    late = run.time >= SETTLED_FROM
    force = (run.contact_force - run.reference_force)[late]
    off = run.position - run.reference_tip
    normal = np.asarray(run.scenario.surface.normal) / np.linalg.norm(run.scenario.surface.normal)
    off = (off - np.outer(off @ normal, normal))[late]
    over = np.flatnonzero(np.abs(force) > BAND)
    last = float(run.time[late][over[-1]]) if over.size else 0.0
    return {
        "force_rms": float(np.sqrt(np.mean(force**2))),
        "force_peak": float(np.max(np.abs(force))),
        "path_rms": float(1e3 * np.sqrt(np.mean(np.sum(off**2, axis=1)))),
        "settling": max(0.0, last - STOP),
    }


def cell(controller: str, friction: str) -> dict[str, Any]:
    """Run one controller on one kind of friction; a run that cannot go on is its reason."""
    changes: dict[str, Any] = {"reference.timing": "minimum_jerk"} | CONTROLLERS[controller]
    changes |= {f"friction.{key}": value for key, value in FRICTIONS[friction].items()}
    row: dict[str, Any] = {"controller": controller, "friction": friction, "reason": ""}
    try:
        return row | measures(simulate(load_scenario("wam_slide", changes)))
    except ClosedLoopError as error:
        return row | dict.fromkeys(MEASURES, math.nan) | {"reason": str(error)}


def measure(quick: bool = False) -> list[dict[str, Any]]:
    """Return a row for each controller and each kind of friction."""
    controllers, frictions = QUICK if quick else (tuple(CONTROLLERS), tuple(FRICTIONS))
    return [cell(controller, friction) for controller in controllers for friction in frictions]


def run(folder: Path, quick: bool = False, as_json: bool = False) -> list[dict[str, Any]]:
    """Do the study, write controllers.json, controllers.csv and the figure into `folder`, and print the table."""
    results = measure(quick)
    plain = [{k: None if isinstance(v, float) and math.isnan(v) else v for k, v in row.items()} for row in results]
    (folder / "controllers.json").write_text(json.dumps(plain, indent=2) + "\n", encoding="utf-8")
    with (folder / "controllers.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, ["controller", "friction", *MEASURES, "reason"])
        writer.writeheader()
        writer.writerows(plain)
    figure = draw_controllers(results, folder)
    if as_json:
        print(json.dumps(plain, indent=2))
    else:
        print_table(results)
        print(f"wrote {folder}/: controllers.json, controllers.csv, {figure.name}")
    return results


def print_table(results: list[dict[str, Any]]) -> None:
    """Print each measure as a table of controllers against friction."""
    from rich import box
    from rich.console import Console
    from rich.table import Table

    frictions = list(dict.fromkeys(row["friction"] for row in results))
    console = Console(highlight=False, width=max(80, 34 + 12 * len(frictions)))
    titles = {
        "force_rms": f"force error from {SETTLED_FROM:g} s on, RMS, in N",
        "force_peak": "and its peak, in N",
        "path_rms": "path error along the surface, RMS, in mm",
        "settling": f"time after the stop until the force stays within {BAND:g} N, in s",
    }
    for key, title in titles.items():
        table = Table(box=box.SIMPLE_HEAD, title=title, title_justify="left")
        table.add_column("controller", no_wrap=True)
        for friction in frictions:
            table.add_column(friction, justify="right")
        for controller in dict.fromkeys(row["controller"] for row in results):
            mine = [row for row in results if row["controller"] == controller]
            table.add_row(controller, *("stopped" if row["reason"] else f"{row[key]:.2g}" for row in mine))
        console.print(table)


def draw_controllers(results: list[dict[str, Any]], folder: Path) -> Path:
    """Draw force RMS and path RMS as two maps; return the path of the PNG."""
    import matplotlib as mpl
    from matplotlib.colors import LogNorm
    from matplotlib.figure import Figure

    from closedloop.figures import STYLE

    controllers = list(dict.fromkeys(row["controller"] for row in results))
    frictions = list(dict.fromkeys(row["friction"] for row in results))
    with mpl.rc_context(cast(Any, {**STYLE, "axes.grid": False, "font.size": 8})):
        figure = Figure(figsize=(11.0, 1.6 + 0.3 * len(controllers)), layout="constrained")
        for axes, key, title, least, most in zip(
            figure.subplots(1, 2, sharey=True),
            ("force_rms", "path_rms"),
            ("force error, RMS [N]", "path error along the surface, RMS [mm]"),
            (1e-2, 1e-2),
            (3.0, 10.0),
            strict=True,
        ):
            values = np.array([[row[key] for row in results if row["controller"] == name] for name in controllers])
            image = axes.imshow(np.clip(values, least, most), norm=LogNorm(least, most), cmap="cividis", aspect="auto")
            for i, j in np.ndindex(values.shape):
                text = (
                    "stopped"
                    if np.isnan(values[i, j])
                    else (f"{values[i, j]:.2g}" if values[i, j] >= 1e-3 else "< 0.001")
                )
                bright = np.isfinite(values[i, j]) and values[i, j] > np.sqrt(least * most)
                axes.text(j, i, text, ha="center", va="center", color="black" if bright else "white", fontsize=7)
            axes.set_xticks(range(len(frictions)), frictions, rotation=35, ha="right")
            axes.set_yticks(range(len(controllers)), controllers)
            axes.set_title(title)
            axes.tick_params(length=0)
            figure.colorbar(image, ax=axes, shrink=0.9)
        for suffix in (".svg", ".png"):
            figure.savefig(folder / f"controllers{suffix}", metadata={"Date": None} if suffix == ".svg" else {})
    return folder / "controllers.png"
