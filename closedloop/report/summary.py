"""The summary of a run: how large every error was, what the contact did, and the balance of energy."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from closedloop.contact import FREE
from closedloop.events import KINDS
from closedloop.report.assumptions import assumptions
from closedloop.report.measures import MEASURES, SETTLED
from closedloop.surface import unit

if TYPE_CHECKING:
    from closedloop.record import Run

Array = NDArray[np.float64]


def summarise(run: Run) -> dict[str, Any]:
    """Return the summary of a run: what summary.json holds, which is strict JSON.

    Quantities that do not exist (no rows) are None. So is a figure that is no finite number; `not_finite` names it.
    """
    if len(run) == 0:
        figures: dict[str, Any] = dict.fromkeys(MEASURES)
    else:
        figures = _measures(run)
    return {
        "scenario": run.scenario.name,
        "robot": run.model.name,
        "law": run.law,
        "steps": max(0, len(run) - 1),
        "end_time": float(run.time[-1]) if len(run) else None,
        "stopped": run.stopped,
        **{name: figure if _exists(figure) else None for name, figure in figures.items()},
        "not_finite": [name for name, figure in figures.items() if not _exists(figure)],
        "events": {kind: sum(event.kind == kind for event in run.events) for kind in KINDS.values()},
        "assumptions": assumptions(run),
        "wall_seconds": run.wall_seconds,
    }


def _exists(figure: float | None) -> bool:
    """Whether a figure is a number, or is known not to exist."""
    return figure is None or math.isfinite(figure)


@np.errstate(all="ignore")  # what overflows is named
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
        np.max(np.abs(run.joint_friction)),
        -_cumulative(friction_power(run), run.time)[-1],
        np.sum(run.event_energy_lost),
        np.max(run.event_rate_cut, initial=0.0),
        *_against_what_is_desired(run),
    )
    return {key: None if value is None else float(value) for key, value in zip(MEASURES, values, strict=True)}


def _against_what_is_desired(run: Run) -> tuple[float | None, float | None, float]:
    """Return the RMS of the force error in contact, N, the instant from which it stays small, s, and the path's, m."""
    miss, touching = run.contact_force - run.reference_force, run.mode != FREE
    rms = float(np.sqrt(np.mean(miss[touching] ** 2))) if np.any(touching) else None
    largest = np.max(np.abs(run.reference_force))
    missed = np.flatnonzero(np.abs(miss) > SETTLED * largest)
    first = int(missed[-1]) + 1 if missed.size else 0
    settled = float(run.time[first]) if largest > 0.0 and first < len(run) else None
    normal = unit(run.scenario.surface.normal, "surface.normal")
    off = run.position - run.reference_tip
    off = off - np.outer(off @ normal, normal)
    return rms, settled, float(np.sqrt(np.mean(np.sum(off**2, axis=1))))


def energy_balance(run: Run) -> tuple[Array, Array]:
    """Return the residual of the energy balance and the energy exchanged, each (N,), J, from the start to each row.

    The residual is the change of kinetic and potential energy less the work of the joint torques, ∫ Qᵀq̇ dt, and of the
    contact force, ∫ f ė dt, and of friction at the tip and in the joints, by the trapezoidal rule over the rows, plus
    what the events lost. It shrinks with the step, as the integrator's order says, but no faster than the rule's own
    order, two. The energy exchanged is ∫ |Qᵀq̇| dt, what the residual is small or large against.
    """
    energy = run.kinetic_energy + run.potential_energy
    power = np.einsum("ij,ij->i", run.torque, run.v)
    contact = run.contact_force * run.closure_rate + friction_power(run)
    lost = np.concatenate([[0.0], np.cumsum(run.event_energy_lost)])
    work = _cumulative(power + contact, run.time) - lost[np.searchsorted(run.event_time, run.time, side="right")]
    return energy - energy[0] - work, _cumulative(np.abs(power), run.time)


def friction_power(run: Run) -> Array:
    """Return the power of friction at the tip and in the joints, F_tᵀṙ + τᵀq̇, (N,), W: negative where it takes energy.

    Bristles and springs of friction give back what they store, so the power of dahl, lugre and seven_parameter may be
    positive for a while.
    """
    power: Array = np.einsum("ij,ij->i", run.friction_force, run.velocity)
    power += np.einsum("ij,ij->i", run.joint_friction, run.v)
    return power


def _cumulative(rate: Array, time: Array) -> Array:
    return np.concatenate([[0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]) * np.diff(time))])
