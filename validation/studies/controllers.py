"""Force error and path error of every controller with every kind of friction.

The task is wam_slide's with the elbow up, the motion from rest to rest: press with 10 N and slide 108 mm in six
seconds. Rows are controllers with what they know of friction, columns are laws of friction of about the same level
(kinetic 0.25, static 0.35). The law works at 1 kHz, the arm moves in steps of a quarter of that. The force sensor is
noisy (`NOISE`), and no controller's model has the friction that the joints have (`JOINT_FRICTION`). When the path has
ended the desired force rises by `FORCE_STEP` within `RISE`. Measured of the true force and the true tip:

    force RMS, peak   of f − f_des, N, from `SETTLED_FROM` on, when the tip has broken away, until the force rises
    path RMS          of the tip's distance from its path along the surface in that time, mm
    settling          how long after the rise began the force error was last over `BAND`, s; infinite if it still is
"""

import math
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from closedloop.record.run import Run
from closedloop.scenario.load import load_scenario
from closedloop.scenario.scenario import Scenario
from validation.studies.results import ELBOW_UP, conclude, each, force_and_path, measured

SETTLED_FROM, BAND = 1.5, 0.05  # s, N
RISES_AT, RISE, FORCE_STEP, END = 7.0, 0.05, 3.0, 9.0  # s, s, N, s; the path ends at 6.5 s
NOISE = 0.05  # N, standard deviation of each reading
# Coulomb's, N m, and viscous, N m s/rad, of each joint: a tenth of what motors have, as a compensation leaves it.
JOINT_FRICTION = {
    "joint_friction.kind": "coulomb_viscous",
    "joint_friction.kinetic": [0.2, 0.2, 0.1, 0.1],
    "joint_friction.viscous": [0.5, 0.5, 0.3, 0.2],
}
STEP, SAMPLE = 0.00025, 0.001  # s
SPEED = 0.018  # m/s, mean: 108 mm, within the workspace with the elbow up
MEASURES = ("force_rms", "force_peak", "path_rms", "settling")

JOINT = {"law.kp": [900.0, 900.0, 400.0, 300.0], "law.kd": [60.0, 60.0, 30.0, 20.0]}
LAWS: dict[str, dict[str, Any]] = {
    "paper": {},
    "paper + integral": {"law.force_integral": 20.0},
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
    late = (run.time >= SETTLED_FROM) & (run.time < RISES_AT)
    error = run.contact_force - run.reference_force
    after = run.time >= RISES_AT
    normal = np.asarray(run.scenario.surface.normal) / np.linalg.norm(run.scenario.surface.normal)
    over = np.abs(error[after]) > BAND
    last = float(np.max(run.time[after], where=over, initial=0.0)) if not over[-1] else math.inf
    found = force_and_path(error[late], (run.position - run.reference_tip)[late], normal)
    return found | {"settling": max(0.0, last - RISES_AT)}


def scenario_of(controller: str, friction: str, ideal: bool = False) -> Scenario:
    """Return the slide of one controller on one kind of friction; `ideal` without noise and friction in joints."""
    changes: dict[str, Any] = {
        "start.q": ELBOW_UP,
        "reference.speed": SPEED,
        "reference.timing": "minimum_jerk",
        "time.step": STEP,
        "law.sample_period": SAMPLE,
        "time.duration": END,
        "force_profile.kind": "waypoints",
        "force_profile.times": [RISES_AT, RISES_AT + RISE],
        "force_profile.forces": [10.0, 10.0 + FORCE_STEP],
    }
    if not ideal:
        changes |= {"sensor.noise": NOISE} | JOINT_FRICTION
    changes = CONTROLLERS[controller] | changes  # a kind first: the keys that it does not know are dropped
    changes |= {f"friction.{key}": value for key, value in FRICTIONS[friction].items()}
    return load_scenario("wam_slide", changes)


def cell(controller: str, friction: str, ideal: bool = False) -> dict[str, Any]:
    """Run one controller on one kind of friction; a run that cannot go on is its reason."""
    row = {"controller": controller, "friction": friction}
    return measured(row, scenario_of(controller, friction, ideal), measures, MEASURES)


def measure(quick: bool = False) -> list[dict[str, Any]]:
    """Return a row for each controller and each kind of friction; a bar on standard error says how far it is."""
    controllers, frictions = QUICK if quick else (tuple(CONTROLLERS), tuple(FRICTIONS))
    return each("controllers", list(product(controllers, frictions)), cell)


def run(folder: Path, quick: bool = False, as_json: bool = False) -> list[dict[str, Any]]:
    """Do the study, write controllers.json, controllers.csv and the figure into `folder`, and print the table."""
    results = measure(quick)
    columns = ["controller", "friction", *MEASURES, "control_verdict", "reason"]
    figure = draw_controllers(results, folder)
    conclude(folder, "controllers", results, columns, [figure], None if as_json else print_table)
    return results


TITLES = {
    "force_rms": "force error, RMS [N]",
    "force_peak": "force error, peak [N]",
    "path_rms": "path error along the surface, RMS [mm]",
    "settling": "settling after a rise of the force [s]",
}
CONTROL = "verdict of the control, see docs/verdict.md"
CAPTION = (
    f"errors from {SETTLED_FROM:g} s to {RISES_AT:g} s; settling: from there, where f_des rises by {FORCE_STEP:g} N, "
    f"until the force keeps to {BAND:g} N"
)


def cell_text(row: dict[str, Any], key: str) -> str:
    """Return a measure in two digits, or in a word what there is instead."""
    if row["reason"]:
        return "stopped"
    value = row.get(key, "stopped")
    if isinstance(value, str):
        return value
    if math.isinf(value):
        return "never"
    return f"{value:.2g}" if value >= 1e-3 else ("0" if value == 0.0 else "<0.001")


def print_table(results: list[dict[str, Any]]) -> None:
    """Print one table: a block a measure, controllers down, friction across."""
    from rich import box
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    frictions = list(dict.fromkeys(row["friction"] for row in results))
    console = Console(highlight=False, width=max(80, 42 + 12 * len(frictions)))
    table = Table(box=box.SIMPLE_HEAD, caption=CAPTION, caption_justify="left")
    table.add_column("controller", no_wrap=True)
    for friction in frictions:
        table.add_column(friction, justify="right")
    for key, title in (TITLES | {"control_verdict": CONTROL}).items():
        table.add_row(Text(title, style="bold"))
        for controller in dict.fromkeys(row["controller"] for row in results):
            mine = [row for row in results if row["controller"] == controller]
            table.add_row(f"  {controller}", *(cell_text(row, key) for row in mine))
        table.add_section()
    console.print(table)


def draw_controllers(results: list[dict[str, Any]], folder: Path) -> Path:
    """Draw the four measures as maps into controllers.svg and .png; return the path of the latter."""
    from matplotlib.figure import Figure

    from closedloop.figures.files import write_figure
    from closedloop.figures.style import styled

    with styled({"axes.grid": False, "font.size": 8}):
        count = len({row["controller"] for row in results})
        figure = Figure(figsize=(11.0, 2.4 + 0.52 * count), layout="constrained")
        maps(figure, results)
        return write_figure(figure, folder / "controllers")


# Least and greatest of the colours, what matters of each measure: logarithmic, but for the settling's.
RANGES = {"force_rms": (3e-3, 1.0), "force_peak": (1e-2, 3.0), "path_rms": (1e-3, 10.0), "settling": (0.0, 0.3)}


def maps(figure: Any, results: list[dict[str, Any]], keys: tuple[str, ...] = MEASURES) -> None:
    """Draw measures as maps of controllers against friction, two beside each other, on a matplotlib figure."""
    from matplotlib.colors import LogNorm, Normalize

    controllers = list(dict.fromkeys(row["controller"] for row in results))
    frictions = list(dict.fromkeys(row["friction"] for row in results))
    grid = figure.subplots((len(keys) + 1) // 2, 2, sharey=True, sharex=True, squeeze=False)
    for axes, key in zip(grid.ravel(), keys, strict=True):
        least, most = RANGES[key]
        rows = [[row for row in results if row["controller"] == name] for name in controllers]
        values = np.array([[row[key] for row in mine] for mine in rows])
        norm = LogNorm(least, most) if least > 0.0 else Normalize(least, most)
        image = axes.imshow(np.clip(values, least, most), norm=norm, cmap="cividis", aspect="auto")
        for i, j in np.ndindex(values.shape):
            bright = norm(values[i, j]) > 0.5
            colour = "black" if bright else "white" if np.isfinite(values[i, j]) else "firebrick"
            axes.text(j, i, cell_text(rows[i][j], key), ha="center", va="center", color=colour, fontsize=7)
        axes.set_xticks(range(len(frictions)), frictions, rotation=35, ha="right")
        axes.set_yticks(range(len(controllers)), controllers)
        axes.set_title(TITLES[key], fontsize=9)
        axes.tick_params(length=0)
        axes.grid(visible=False)
        figure.colorbar(image, ax=axes, shrink=0.9)
