"""Closure drift: the closure error against step, speed, integrator and stabiliser.

Eq. 24 constrains the acceleration of the closure only. The local error of an integrator of order p accumulates in e, so
without a stabiliser e grows like h^p. It consists of the velocity products of the closure, so e grows like v², where v
is the speed of the tip. The study measures both exponents.

With Baumgarte's stabiliser e is bounded. A step of an Euler scheme has the local error δ ~ h² v² in e, which the
stabiliser removes at the rate δ/h: s_p e = s_v δ/h, so e = 2 ζ T δ/h. RK4 errs by h⁴/T² in following the stabiliser.
The T that the study takes is two steps, "auto", and e grows like h² v² under all of them.

The adaptive scheme has a tolerance in place of h. The study also measures the step beyond which Baumgarte's stabiliser
itself is unstable and puts it beside the theory of `closedloop.mechanics.closure.baumgarte`.

Figures of the study of drift.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from closedloop.base.errors import ClosedLoopError, InterruptedRunError, faults_on_one_line
from closedloop.figures.files import write_figure
from closedloop.figures.style import COLOURS, styled
from closedloop.loop.step.record_row import recorded
from closedloop.mechanics.closure import baumgarte
from closedloop.mechanics.integrators import INTEGRATORS
from closedloop.scenario.load import load_scenario
from closedloop.scenario.scenario import Scenario
from closedloop.simulation.prepare import prepare
from closedloop.simulation.simulate import run_loop, simulate
from validation.studies.results import ELBOW_UP, conclude, print_table

if TYPE_CHECKING:
    from matplotlib.axes import Axes

NAMES = {"semi_implicit_euler": "semi-implicit Euler", "explicit_euler": "explicit Euler", "rk4": "RK4"}
MARKERS = ("o", "s", "^")


def draw_drift(results: dict[str, Any], folder: Path) -> list[Path]:
    """Draw drift against step and speed, and the map of Baumgarte's stability; return the paths of the PNGs."""
    from matplotlib.figure import Figure

    with styled():
        slopes = Figure(figsize=(7.2, 5.4), layout="constrained")
        left, right = slopes.subplots(1, 2, sharey=True)
        power_laws(left, results["against_step"], 1e3, "step h [ms]", "h")
        power_laws(right, results["against_speed"], 1e3, "tip speed v [mm/s]", "v")
        left.set_ylabel("largest |e| [m]")
        stability = Figure(figsize=(7.2, 3.8), layout="constrained")
        stability_map(stability.add_subplot(), results["limits"])
        written = []
        for name, figure in (("drift_slopes", slopes), ("baumgarte_stability", stability)):
            written.append(write_figure(figure, folder / name))
    return written


def power_laws(axes: Axes, rows: list[dict[str, Any]], factor: float, label: str, symbol: str) -> None:
    """Draw |e| against the setting varied, with the fitted exponent: full lines without stabiliser, broken with it."""
    look = dict(zip(NAMES, zip(COLOURS, MARKERS, strict=True), strict=True))
    for row in rows:
        (colour, marker), free = look[row["integrator"]], row["stabiliser"] == "none"
        axes.loglog(
            factor * np.array(row["values"]), row["errors"], marker, color=colour, linestyle="-" if free else "--",
            fillstyle="full" if free else "none",
            label=f"{NAMES[row['integrator']]}{'' if free else ', Baumgarte'}: {symbol}$^{{{row['slope']:.2f}}}$",
        )  # fmt: skip
    axes.set_xlabel(label)
    ticks = [f"{factor * x:g}" for x in rows[0]["values"]]
    axes.set_xticks([factor * x for x in rows[0]["values"]], ticks)
    axes.minorticks_off()
    axes.legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.16))
    axes.set_title("worse with a longer step" if symbol == "h" else "worse at a higher speed")


def stability_map(axes: Axes, limits: list[dict[str, Any]]) -> None:
    """Draw where Baumgarte is stable in the plane of (s_v h, s_p h²), and the limits that were measured."""
    x, y = np.meshgrid(np.linspace(0.02, 6.5, 220), np.linspace(0.02, 9.5, 220))  # s_v h, s_p h²
    for scheme, colour, marker in zip(NAMES, COLOURS, MARKERS, strict=True):
        radii = baumgarte.spectral_radii(scheme, x / (2.0 * np.sqrt(y)), np.sqrt(y))
        axes.contour(x, y, radii, levels=[1.0], colors=[colour], linewidths=1.4)
        mine = [row for row in limits if row["integrator"] == scheme]
        measured = np.array([row["measured"] for row in mine])
        damping = np.array([row["damping_ratio"] for row in mine])
        axes.plot(
            2.0 * damping * measured, measured**2, marker, color=colour, linestyle="none", label=f"{NAMES[scheme]}"
        )
    axes.plot([1.414], [1.0], "k*", markersize=10, label="the paper, at 1 kHz")
    axes.set_xlabel("s_v h = 2 ζ h/T")
    axes.set(ylabel="s_p h² = (h/T)²", title="Baumgarte is stable inside the line; marks: the limit measured on an arm")
    axes.legend(fontsize=8, loc="center right")


SCHEMES = ("semi_implicit_euler", "explicit_euler", "rk4")
STABILISERS = ("none", "baumgarte", "projection", "both")
STEPS = (0.00025, 0.0005, 0.001, 0.002)
SPEEDS = (0.0045, 0.009, 0.018, 0.036, 0.072)
PAPER_STEP, PAPER_SPEED = 0.001, 0.018
TOLERANCES = (1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8)
DAMPING = (0.3, 0.5, 0.707, 1.0, 1.5)


def slide(
    step: float = PAPER_STEP, speed: float = PAPER_SPEED, scheme: str = "semi_implicit_euler",
    stabiliser: str = "none", tolerance: float | None = None,
) -> Scenario:  # fmt: skip
    """Return wam_slide, elbow up, for four seconds, the tip moving in three of them, with these settings (s, m/s)."""
    changes: dict[str, Any] = {
        "start.q": ELBOW_UP, "time.step": step, "time.integrator": scheme, "time.duration": 4.0,
        "reference.speed": speed, "reference.stop": 3.5, "stabiliser.kind": stabiliser,
    }  # fmt: skip
    if stabiliser in ("baumgarte", "both"):
        changes["stabiliser.time_constant"] = "auto"
    if tolerance is not None:
        changes["time.tolerance"] = tolerance
    return load_scenario("wam_slide", changes)


def largest_error(scenario: Scenario) -> tuple[float, str]:
    """Return the largest |e| of a run, m, and why there is none if it could not be run."""
    engine = "compiled" if scenario.time.integrator in INTEGRATORS else "pinocchio"
    try:
        return float(np.max(np.abs(simulate(scenario, engine=engine).closure_error))), ""
    except InterruptedRunError:
        raise
    except ClosedLoopError as error:
        return math.nan, faults_on_one_line(error)


def fitted_slope(x: Sequence[float], y: Sequence[float]) -> tuple[float, float]:
    """Return the exponent of the power law y ~ x^p through the points, and the largest deviation of log y from it."""
    good = np.isfinite(y) & (np.asarray(y) > 0.0)
    if np.count_nonzero(good) < 2:
        return math.nan, math.nan
    a, b = np.log(np.asarray(x)[good]), np.log(np.asarray(y)[good])
    slope, offset = np.polyfit(a, b, 1)
    return float(slope), float(np.max(np.abs(slope * a + offset - b)))


def power_law(setting: str, values: Sequence[float], theory: float, scheme: str, stabiliser: str) -> dict[str, Any]:
    """Return the largest |e| of the slide, m, against one of its settings, and the exponent beside that of theory.

    setting: "step", "speed" or "tolerance", see `slide`; the others are the paper's
    values: of the setting, s, m/s or without unit
    theory: the exponent expected
    scheme, stabiliser: see `slide`
    """
    errors = [largest_error(slide(scheme=scheme, stabiliser=stabiliser, **{setting: value})) for value in values]
    slope, misfit = fitted_slope(values, [e for e, _ in errors])
    return {
        "integrator": scheme, "stabiliser": stabiliser, "setting": setting, "values": list(values),
        "errors": [e for e, _ in errors], "reasons": [why for _, why in errors], "slope": slope, "theory": theory,
        "misfit": misfit,
    }  # fmt: skip


def measured_limit(scheme: str, damping: float, steps: int = 1500) -> float:
    """Return the largest h/T at which a real arm's closure error does not grow, by bisection of runs to 1e-3.

    planar2 is pressed on the surface from a start 1 µm off it, and its closure watched over `steps` steps.
    """
    h = 0.001
    tip = prepare(load_scenario("planar2_slide", {"time.duration": h})).plane
    scenario = load_scenario(
        "planar2_slide",
        {
            "reference.kind": "hold",
            "law.kp": 0,
            "law.kd": 0,
            "time.integrator": scheme,
            "time.step": h,
            "time.duration": steps * h,
            "surface.offset": tip.offset - 1e-6,
            "stabiliser.damping_ratio": damping,
            "stabiliser.time_constant": 1.0,
        },
    )
    problem = prepare(scenario)

    def stable(ratio: float) -> bool:
        gains = np.array(baumgarte.baumgarte_gains(damping, h / ratio))
        rows, _, failure, _ = run_loop(dataclasses.replace(problem, stabiliser=gains), engine="compiled")
        return failure is None and bool(np.max(np.abs(recorded(rows[-100:], problem.robot.n, "closure_error"))) < 1e-6)

    low, high = 0.02, 4.0
    while high - low > 1e-3 * low:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if stable(middle) else (low, middle)
    return low


def measure(quick: bool = False) -> dict[str, Any]:
    """Return all results of the study; see `print_tables` for their meaning."""
    schemes, speeds = SCHEMES, SPEEDS[1:4] if quick else SPEEDS
    kinds = [(stabiliser, scheme) for stabiliser in ("none", "baumgarte") for scheme in schemes]
    against_step = [
        power_law("step", STEPS, INTEGRATORS[scheme].order if stabiliser == "none" else 2, scheme, stabiliser)
        for stabiliser, scheme in kinds
    ]
    against_speed = [power_law("speed", speeds, 2, scheme, stabiliser) for stabiliser, scheme in kinds]
    against_tolerance = [power_law("tolerance", TOLERANCES, 1, "dop853", "none")]
    stabilisers = [
        {"integrator": scheme, "stabiliser": kind, "error": error, "reason": why}
        for scheme in schemes
        for kind in STABILISERS
        for error, why in [largest_error(slide(PAPER_STEP, PAPER_SPEED, scheme, kind))]
    ]
    limits = []
    for scheme in schemes:
        for damping in DAMPING[2:3] if quick else DAMPING:
            theory = baumgarte.largest_stable_ratio(scheme, damping)
            best = baumgarte.recommended_ratio(scheme, damping)
            limits.append(
                {
                    "integrator": scheme,
                    "damping_ratio": damping,
                    "theory": theory,
                    "measured": measured_limit(scheme, damping),
                    "recommended": best,
                    "spectral_radius": baumgarte.spectral_radius(scheme, damping, best),
                }
            )
    return {
        "against_step": against_step, "against_speed": against_speed, "against_tolerance": against_tolerance,
        "stabilisers": stabilisers, "limits": limits,
    }  # fmt: skip


def run(folder: Path, quick: bool = False, as_json: bool = False) -> dict[str, Any]:
    """Do the study, write drift.json, drift.csv and the figures into `folder`, and print the tables."""
    results = measure(quick)
    columns = ["integrator", "stabiliser", "step [s]", "speed [m/s]", "tolerance", "largest |e| [m]"]
    figures = draw_drift(results, folder)
    conclude(folder, "drift", results, columns, figures, None if as_json else print_tables, _csv_rows(results))
    return results


def _csv_rows(results: dict[str, Any]) -> Iterable[list[Any]]:
    for row in [*results["against_step"], *results["against_speed"], *results["against_tolerance"]]:
        for value, e in zip(row["values"], row["errors"], strict=True):
            settings = {"step": PAPER_STEP, "speed": PAPER_SPEED, "tolerance": ""} | {row["setting"]: value}
            yield [row["integrator"], row["stabiliser"], *settings.values(), e]
    for row in results["stabilisers"]:
        yield [row["integrator"], row["stabiliser"], PAPER_STEP, PAPER_SPEED, "", row["error"]]


def print_tables(results: dict[str, Any]) -> None:
    """Print what was measured beside what theory says."""
    for stabiliser, title in (
        ("none", "drift without stabiliser: |e| grows like h^p and v^q"),
        ("baumgarte", "with Baumgarte's (T: auto): where |e| settles grows like h^p and v^q"),
    ):
        print_table(
            title,
            ("integrator", "p measured", "p theory", "q measured", "q theory", "|e| at 1 ms, 18 mm/s"),
            (
                (
                    a["integrator"],
                    f"{a['slope']:.2f}",
                    f"{a['theory']}",
                    f"{b['slope']:.2f}",
                    f"{b['theory']}",
                    f"{a['errors'][a['values'].index(PAPER_STEP)]:.2g} m",
                )
                for a, b in zip(results["against_step"], results["against_speed"], strict=True)
                if a["stabiliser"] == stabiliser
            ),
        )
    for row in results["against_tolerance"]:
        print_table(
            "largest |e| in m without stabiliser, by time.tolerance",
            ("integrator", *(f"{tolerance:g}" for tolerance in row["values"])),
            [(row["integrator"], *(f"{e:.1g}" for e in row["errors"]))],
        )
    print_table(
        "largest |e| in m at 1 ms and 18 mm/s, by stabiliser (Baumgarte's T: auto)",
        ("integrator", *STABILISERS),
        (
            (scheme, *(f"{r['error']:.2g}" for r in results["stabilisers"] if r["integrator"] == scheme))
            for scheme in SCHEMES
        ),
    )
    print_table(
        'Baumgarte: largest stable h/T, and what time_constant = "auto" takes',
        ("integrator", "ζ", "limit, theory", "limit, measured", "h/T of auto", "e per step at most ×"),
        (
            (
                r["integrator"],
                f"{r['damping_ratio']:g}",
                f"{r['theory']:.4f}",
                f"{r['measured']:.4f}",
                f"{r['recommended']:.3f}",
                f"{r['spectral_radius']:.3f}",
            )
            for r in results["limits"]
        ),
    )
