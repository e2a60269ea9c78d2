"""What a run says of itself: the paper's five assumptions, and how large every error was.

An assumption is reported as held only if it was checked at every row; the figure that decides stands beside it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from closedloop.contact import FREE, STUCK
from closedloop.events import KINDS

if TYPE_CHECKING:
    from closedloop.record import Run

Array = NDArray[np.float64]

# Eq. 24 is solved to rounding: n additions of rounding 1e-16 each, with room for the conditioning of H.
RESIDUAL_TOLERANCE = 1e-12
# Below this share of its mobility the tip is within 1e-3 rad of a singular pose, and f, q̈ and Q along the normal
# grow a thousandfold; the simulation itself stops only at `closedloop.solve.SINGULAR_MOBILITY`.
NEAR_SINGULAR = 1e-6


def summarise(run: Run) -> dict[str, Any]:
    """Return the summary of a run: what summary.json holds. Quantities that do not exist (no rows) are None."""
    if len(run) == 0:
        figures: dict[str, Any] = dict.fromkeys(_measure_keys())
    else:
        figures = _measures(run)
    return {
        "scenario": run.scenario.name,
        "robot": run.model.name,
        "law": run.law,
        "steps": max(0, len(run) - 1),
        "end_time": float(run.time[-1]) if len(run) else None,
        "stopped": run.stopped,
        **figures,
        "events": {kind: sum(event.kind == kind for event in run.events) for kind in KINDS.values()},
        "assumptions": assumptions(run),
        "wall_seconds": run.wall_seconds,
    }


def _measure_keys() -> tuple[str, ...]:
    return (
        "final_contact_force",
        "peak_contact_force",
        "min_contact_force",
        "max_stabiliser_force",
        "max_abs_closure_error",
        "final_closure_error",
        "max_abs_closure_rate",
        "max_tip_speed",
        "max_kkt_residual",
        "max_kkt_condition",
        "min_normal_mobility",
        "max_energy_residual",
        "energy_exchanged",
        "deepest_penetration",
        "time_in_contact",
        "max_friction_force",
        "energy_lost_in_impacts",
        "largest_rate_cut",
    )


def _measures(run: Run) -> dict[str, Any]:
    residual, exchanged = energy_balance(run)
    # Off the surface the closure error is a gap, not an error.
    touching = run.mode != FREE
    values = (
        run.contact_force[-1],
        np.max(run.contact_force),
        np.min(run.contact_force),
        np.max(np.abs(run.stabiliser_force)),
        np.max(np.abs(run.closure_error), where=touching, initial=0.0),
        run.closure_error[-1],
        np.max(np.abs(run.closure_rate), where=touching, initial=0.0),
        np.max(np.linalg.norm(run.velocity, axis=1)),
        max(np.max(run.residual_motion), np.max(run.residual_closure)),
        np.max(run.kkt_condition),
        np.min(run.normal_mobility),
        np.max(np.abs(residual)),
        exchanged[-1],
        max(0.0, -np.min(run.closure_error)),
        run.scenario.time.step * np.count_nonzero(touching[:-1]),
        np.max(np.linalg.norm(run.friction_force, axis=1)),
        np.sum(run.event_energy_lost),
        np.max(run.event_rate_cut, initial=0.0),
    )
    return {key: float(value) for key, value in zip(_measure_keys(), values, strict=True)}


def energy_balance(run: Run) -> tuple[Array, Array]:
    """Return the residual of the energy balance and the energy exchanged, each (N,), J, from the start to each row.

    The residual is the change of kinetic and potential energy less the work of the joint torques, ∫ Qᵀq̇ dt, and of the
    contact and friction forces, ∫ f ė + F_tᵀṙ dt, by the trapezoidal rule over the rows, plus what the events lost. It
    shrinks with the step, as the integrator's order
    says, but no faster than the rule's own order, two. The energy exchanged is ∫ |Qᵀq̇| dt, what the residual is small
    or large against.
    """
    energy = run.kinetic_energy + run.potential_energy
    power = np.einsum("ij,ij->i", run.torque, run.v)
    contact = run.contact_force * run.closure_rate + np.einsum("ij,ij->i", run.friction_force, run.velocity)
    lost = np.concatenate([[0.0], np.cumsum(run.event_energy_lost)])
    work = _cumulative(power + contact, run.time) - lost[np.searchsorted(run.event_time, run.time, side="right")]
    return energy - energy[0] - work, _cumulative(np.abs(power), run.time)


def _cumulative(rate: Array, time: Array) -> Array:
    return np.concatenate([[0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]) * np.diff(time))])


def assumptions(run: Run) -> dict[str, dict[str, Any]]:
    """Return, for each of the paper's assumptions, whether it held, when it first failed (s), and what decided.

    - ``one_loop``: Eq. 24 has a single closure row, and its solution obeys it.
    - ``single_point``: the surface acts on the arm at the tip alone: the equation of motion is met with Jᵣᵀn f and no
      moment beside it.
    - ``contact_kept``: the surface never has to pull: f > 0, and a tip that may leave never does.
    - ``frictionless``: the surface acts along its normal alone: no friction force, and the same residual.
    - ``nonsingular``: the tip can move along the normal (`NEAR_SINGULAR`).
    """
    if len(run) == 0:
        missing = {"held": None, "first_failed": 0.0, "measured": "no row could be computed"}
        return {
            name: dict(missing) for name in ("one_loop", "single_point", "contact_kept", "frictionless", "nonsingular")
        }
    motion, closed = float(np.max(run.residual_motion)), float(np.max(run.residual_closure))
    lowest = int(np.argmin(run.contact_force))
    stiffest = int(np.argmin(run.normal_mobility))
    friction = np.linalg.norm(run.friction_force, axis=1)
    only_contact = f"other forces ≤ {motion:.0e}"
    report = {
        "one_loop": _judge(
            run,
            (run.residual_closure <= RESIDUAL_TOLERANCE) & (run.mode != STUCK),
            f"one row, met to {closed:.0e}" if not np.any(run.mode == STUCK) else "three rows while the tip sticks",
        ),
        "single_point": _judge(run, run.residual_motion <= RESIDUAL_TOLERANCE, only_contact),
        "contact_kept": _judge(
            run,
            (run.contact_force > 0.0) & (run.mode != FREE),
            f"f ≥ {run.contact_force[lowest]:.4g} N, at {run.time[lowest]:.4g} s",
        ),
        "frictionless": _judge(
            run,
            (run.residual_motion <= RESIDUAL_TOLERANCE) & (friction == 0.0),
            only_contact if not np.any(friction) else f"friction ≤ {np.max(friction):.3g} N",
        ),
        "nonsingular": _judge(
            run,
            run.normal_mobility > NEAR_SINGULAR,
            f"mobility ≥ {run.normal_mobility[stiffest]:.2g}, cond. ≤ {np.max(run.kkt_condition):.2g}",
        ),
    }
    if run.stopped and "singular" in run.stopped:
        verdict = report["nonsingular"]
        if verdict["held"]:  # no row was near it: the step after the last was
            verdict |= {"held": False, "first_failed": float(run.time[-1]) + run.scenario.time.step}
    return report


def _judge(run: Run, held: NDArray[np.bool_], measured: str) -> dict[str, Any]:
    failed = np.flatnonzero(~held)
    first = float(run.time[failed[0]]) if failed.size else None
    return {"held": not failed.size, "first_failed": first, "measured": measured}


def limits_exceeded(run: Run) -> str:
    """Return a line about the first joint that left its limits, or an empty string."""
    outside = (run.q < run.model.position_lower) | (run.q > run.model.position_upper)
    rows, joints = np.nonzero(outside)
    if not rows.size:
        return ""
    k, j = int(rows[0]), int(joints[0])
    limits = f"[{run.model.position_lower[j]:g}, {run.model.position_upper[j]:g}]"
    name = run.model.joint_names[j]
    return f"joint {name} leaves its limits {limits} at t = {run.time[k]:g} s (q = {run.q[k, j]:.4f})"


_TITLES = {
    "one_loop": "one loop",
    "single_point": "a single point",
    "contact_kept": "no loss of contact (f > 0)",
    "frictionless": "no friction",
    "nonsingular": "no singular pose",
}


def print_report(run: Run, width: int | None = None) -> None:
    """Print the table of assumptions and errors on standard output."""
    from rich import box
    from rich.console import Console
    from rich.table import Table

    console = Console(width=width, highlight=False)
    facts = run.summary()
    table = Table(box=box.SIMPLE_HEAD, title=f"{run.scenario.name}: the paper's assumptions", title_justify="left")
    table.add_column("assumption")
    table.add_column("held")
    table.add_column("first failed", justify="right")
    table.add_column("decided by")
    for name, verdict in facts["assumptions"].items():
        held = {True: "[green]yes[/]", False: "[bold red]NO[/]", None: "unknown"}[verdict["held"]]
        when = "" if verdict["first_failed"] is None else f"{verdict['first_failed']:.4g} s"
        table.add_row(_TITLES[name], held, when, verdict["measured"])
    console.print(table)
    if len(run) == 0:
        return
    errors = Table(box=box.SIMPLE_HEAD, title="how large every error was, at its worst", title_justify="left")
    errors.add_column("quantity", no_wrap=True)
    errors.add_column("value", justify="right", no_wrap=True)
    errors.add_column("unit", no_wrap=True)
    errors.add_column("beside it")
    for row in _error_rows(run, facts):
        errors.add_row(*row)
    console.print(errors)
    warning = limits_exceeded(run)
    if warning:
        console.print(f"[yellow]note:[/] {warning}")


def _error_rows(run: Run, facts: dict[str, Any]) -> list[tuple[str, str, str, str]]:
    commanded = f"commanded {run.scenario.law.force:g} N" if run.law == "scenario" else f"law {run.law}"
    kind = run.scenario.stabiliser.kind
    absent = {"none": "no stabiliser", "projection": "projection needs no force"}.get(kind, "")
    lowest, highest = facts["min_contact_force"], facts["peak_contact_force"]
    return [
        ("contact force f at the end", f"{facts['final_contact_force']:.9g}", "N", commanded),
        ("f, lowest and highest", f"{lowest:.4g} … {highest:.4g}", "N", ""),
        ("the stabiliser's part of f", f"{facts['max_stabiliser_force']:.2g}", "N", absent),
        (
            "closure error |e|",
            f"{facts['max_abs_closure_error']:.2g}",
            "m",
            f"{facts['final_closure_error']:.1g} m at the end",
        ),
        ("closure rate |ė|", f"{facts['max_abs_closure_rate']:.2g}", "m/s", ""),
        ("residual of Eq. 24", f"{facts['max_kkt_residual']:.1g}", "relative", "rounding is 1e-16"),
        (
            "energy unaccounted for",
            f"{facts['max_energy_residual']:.2g}",
            "J",
            f"of {facts['energy_exchanged']:.2g} J exchanged",
        ),
        ("tip speed", f"{facts['max_tip_speed']:.4g}", "m/s", ""),
        *_event_rows(run, facts),
    ]


def _event_rows(run: Run, facts: dict[str, Any]) -> list[tuple[str, str, str, str]]:
    """Return what a run in which the tip may leave the surface has to say beside the rest."""
    if run.scenario.surface.contact == "bilateral":
        return []
    counts = ", ".join(f"{count} {kind}" for kind, count in facts["events"].items() if count) or "none"
    cut = facts["largest_rate_cut"]
    rows = [
        ("events", str(len(run.events)), "", counts),
        ("time in contact", f"{facts['time_in_contact']:.4g}", "s", f"of {run.time[-1]:g} s"),
        ("deepest penetration", f"{facts['deepest_penetration']:.2g}", "m", ""),
    ]
    if facts["events"]["impact"] or facts["events"]["touchdown"]:
        what = f"bounces up to {cut:.2g} m/s were cut to rest" if cut > 0.0 else "no bounce was cut"
        rows.append(("energy lost in impacts", f"{facts['energy_lost_in_impacts']:.3g}", "J", what))
    return rows
