"""Force error of every controller on a surface that curves away and breathes, and against the stiffness of a soft one.

The task is panda_scan's: a seven-joint arm slides 65 mm across a round body that rises and falls by 12 mm every four
seconds, and presses with 10 N. The arm carries 1 kg, of which the controller takes 10 % less for true; the surface rubs
with 0.2 and a little viscosity, of which a controller that compensates friction by a model knows 80 %. The law works at
1 kHz, and leaves the probe's orientation free. Measured of the true force and the true tip, from `SETTLED_FROM` on to
the end:

    force RMS, peak   of f − f_des, N
    path RMS          of the tip's distance from its path along the surface, mm

On a soft surface (Kelvin-Voigt, d = √k N s/m) the same is asked for stiffnesses from 1e2 to 1e7 N/m, without the
compensation of friction, so that each law is seen by itself.
"""

import math
from pathlib import Path
from typing import Any

from closedloop.record.run import Run
from closedloop.scenario.load import load_scenario
from closedloop.scenario.scenario import Scenario
from validation.studies.results import conclude, each, force_and_path, measured, print_table

SETTLED_FROM = 1.5  # s
STEP, SAMPLE = 0.00025, 0.001  # s
MEASURES = ("force_rms", "force_peak", "path_rms")
STIFFNESSES = tuple(10.0**power for power in range(2, 8))

JOINT = {
    "law.kp": [600.0, 600.0, 600.0, 600.0, 100.0, 100.0, 15.0],
    "law.kd": [50.0, 50.0, 50.0, 50.0, 6.0, 6.0, 1.0],
    "law.pd_start": 0.0,
}
HYBRID = {key: JOINT[key] for key in ("law.kp", "law.kd")}
INTEGRAL = 5.0  # 1/s: of the integral action on the measured force
LAWS: dict[str, dict[str, Any]] = {
    "paper": {"law.kind": "paper", **JOINT, "law.force_integral": 0.0},
    "paper + integral": {"law.kind": "paper", **JOINT, "law.force_integral": INTEGRAL},
    "hybrid": {"law.kind": "hybrid", **HYBRID, "law.force_integral": INTEGRAL},
    "operational space": {"law.kind": "operational_space", "law.force_integral": INTEGRAL},
    "dynamic hybrid": {"law.kind": "dynamic_hybrid", "law.force_integral": INTEGRAL},
    "impedance": {"law.kind": "impedance", "law.force_integral": INTEGRAL},
    "admittance": {"law.kind": "admittance", "law.force_integral": INTEGRAL},
}
FRICTION = {"friction.kind": "coulomb_viscous", "friction.coefficient": 0.2, "friction.viscous": 2.0}
COMPENSATIONS: dict[str, dict[str, Any]] = {
    "": {"compensation.kind": "none"},
    " + model, 20 % off": {"compensation.kind": "model", "compensation.kinetic": 0.16, "compensation.viscous": 1.6},
    " + observer": {"compensation.kind": "observer", "compensation.rate": 50.0},
}
PAYLOAD = {"tool.mass": 0.9, "model_error.payload": 0.1}
TASK: dict[str, Any] = {
    "time.step": STEP, "law.sample_period": SAMPLE, "law.force": 10.0, "surface.gap": 0.0, "surface.radius": 0.3,
    "reference.orientation": "free",
}  # fmt: skip
QUICK = ("paper", "impedance"), (1e3, 1e5)


def breathing(law: str, compensation: str) -> Scenario:
    """Return the task on the rigid body that breathes; without compensation the paper's law alone has no sensor."""
    return load_scenario("panda_scan", LAWS[law] | COMPENSATIONS[compensation] | FRICTION | PAYLOAD | TASK)


def soft(law: str, stiffness: float) -> Scenario:
    """Return the task on a smooth soft body that breathes, of a stiffness in N/m."""
    compliance = {
        "compliance.kind": "kelvin_voigt", "compliance.stiffness": stiffness,
        "compliance.damping": math.sqrt(stiffness),
    }  # fmt: skip
    alone = COMPENSATIONS[""] | {"friction.kind": "none", "stabiliser.kind": "none"}
    return load_scenario("panda_scan", LAWS[law] | alone | PAYLOAD | TASK | compliance)


def measures(run: Run) -> dict[str, float]:
    """Return what is measured of a run that reaches its end; see the module's text."""
    late = run.time >= SETTLED_FROM
    error, off = run.contact_force - run.reference_force, run.position - run.reference_tip
    return force_and_path(error[late], off[late], run.surface_normal[late])


def cell(law: str, on: str, scenario: Scenario) -> dict[str, Any]:
    """Run one law on one surface, which `on` names; a run that cannot go on is its reason."""
    return measured({"law": law, "on": on}, scenario, measures, MEASURES)


def measure(quick: bool = False) -> list[dict[str, Any]]:
    """Return a row for each law and each surface; a bar on standard error says how far it is."""
    laws, stiffnesses = QUICK if quick else (tuple(LAWS), STIFFNESSES)
    cells = [
        (f"{law}{name}", BREATHING, breathing(law, name))
        for law in laws
        for name in COMPENSATIONS
        if not name or law != "paper"
    ]
    cells += [(law, f"{k:.0e} N/m", soft(law, k)) for law in laws for k in stiffnesses]
    return each("surfaces", cells, cell)


BREATHING = "rigid, breathes, rubs"
TITLES = {"force_rms": "force RMS\nN", "force_peak": "force peak\nN", "path_rms": "path RMS\nmm"}


def run(folder: Path, quick: bool = False, as_json: bool = False) -> list[dict[str, Any]]:
    """Do the study, write surfaces.json, surfaces.csv and the figure into `folder`, and print the tables."""
    results = measure(quick)
    columns = ["law", "on", *MEASURES, "control_verdict", "reason"]
    figure = draw_surfaces(results, folder)
    conclude(folder, "surfaces", results, columns, [figure], None if as_json else print_tables)
    return results


def text_of(row: dict[str, Any], key: str) -> str:
    """Return a measure in two digits, or a word where there is none."""
    if row["reason"]:
        return "stopped"
    return f"{row[key]:.2g}" if row[key] >= 1e-4 else "<0.0001"


def print_tables(results: list[dict[str, Any]]) -> None:
    """Print a table of the laws on the surface that breathes, and one of the force error against stiffness."""
    print_table(
        BREATHING,
        ["law", *TITLES.values(), "control"],
        [
            [row["law"], *(text_of(row, key) for key in MEASURES), row.get("control_verdict") or "stopped"]
            for row in results
            if row["on"] == BREATHING
        ],
        width=110,
    )
    soft_rows = [row for row in results if row["on"] != BREATHING]
    by_law: dict[str, list[str]] = {}
    for row in soft_rows:
        by_law.setdefault(row["law"], []).append(f"{text_of(row, 'force_rms')} {_short(row)}")
    print_table(
        "soft, breathes: force RMS, N, and the control",
        ["law", *dict.fromkeys(row["on"] for row in soft_rows)],
        [[law, *said] for law, said in by_law.items()],
        width=110,
    )


def _short(row: dict[str, Any]) -> str:
    """Return "" for a good control, else what is wrong."""
    said = row.get("control_verdict", "")
    return "" if said == "good" else said


def draw_surfaces(results: list[dict[str, Any]], folder: Path) -> Path:
    """Draw the force error against stiffness, a line for each law, into surfaces.svg and .png; return the latter."""
    from matplotlib.figure import Figure

    from closedloop.figures.files import write_figure
    from closedloop.figures.style import styled

    with styled():
        figure = Figure(figsize=(7.0, 4.0), layout="constrained")
        axes = figure.subplots()
        soft_rows = [row for row in results if row["on"] != BREATHING]
        for law, marker in zip(dict.fromkeys(row["law"] for row in soft_rows), "osv^D<>", strict=False):
            mine = [row for row in soft_rows if row["law"] == law]
            stiffness = [float(row["on"].split()[0]) for row in mine]
            axes.plot(stiffness, [row["force_rms"] for row in mine], marker=marker, label=law)
        axes.set(xscale="log", yscale="log", xlabel="stiffness of the surface [N/m]", ylabel="force error, RMS [N]")
        axes.legend(fontsize=8)
        return write_figure(figure, folder / "surfaces")
