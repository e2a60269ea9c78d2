"""The summary of a run: its verdict, how large every error was, what the contact did, and the balance of energy."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from closedloop.closure.contact_force import FREE
from closedloop.events.table import KINDS
from closedloop.report.assumptions import assumptions
from closedloop.report.measures import JOINT_MEASURES, LEAST_TORQUE, MEASURES, SETTLED
from closedloop.report.verdict import Facts, judge
from closedloop.surface.plane import unit

if TYPE_CHECKING:
    from closedloop.record.run import Run

Array = NDArray[np.float64]


def summarise(run: Run) -> dict[str, Any]:
    """Return the summary of a run: what summary.json holds, which is strict JSON.

    Quantities that do not exist (no rows) are None. So is a figure that is no finite number; `not_finite` names it.
    """
    values: dict[str, Any] = _measures(run) if len(run) else dict.fromkeys(MEASURES)
    joints = joint_measures(run)
    held = assumptions(run)
    problems = judge(_facts(run, values, joints, held), lambda: run_gains_fault(run))
    return {
        "verdict": {"good": not problems, "problems": problems},
        "scenario": run.scenario.name,
        "robot": run.model.name,
        "law": run.law,
        "steps": max(0, len(run) - 1),
        "end_time": float(run.time[-1]) if len(run) else None,
        "stopped": run.stopped,
        **{name: value if _exists(value) else None for name, value in values.items()},
        "not_finite": [name for name, value in values.items() if not _exists(value)],
        "events": {kind: sum(event.kind == kind for event in run.events) for kind in KINDS.values()},
        "assumptions": held,
        "joints": {
            name: {key: _finite(column[j]) for key, column in joints.items()}
            for j, name in enumerate(run.model.joint_names if len(run) else ())
        },
        "wall_seconds": run.wall_seconds,
    }


def _facts(run: Run, values: dict[str, Any], joints: dict[str, Array], held: dict[str, dict[str, Any]]) -> Facts:
    failed = {
        name: (v["first_failed"], v["measured"]) for name, v in held.items() if v["held"] is False and v["expected"]
    }
    columns = {name: column.tolist() for name, column in joints.items()}
    return Facts(run.scenario, run.model, run.stopped, len(run) - 1, values, len(run.events), failed, columns)


def run_gains_fault(run: Run) -> str:
    """Return what is wrong with the gains for this step; of a law of one's own nothing is known."""
    if run.law != "scenario":
        return ""
    from closedloop.robot.pinocchio import Robot
    from closedloop.scenario.gains import gains_fault

    return gains_fault(run.scenario, Robot(run.model, run.scenario.robot.tip))


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def joint_measures(run: Run) -> dict[str, Array]:
    """Return `JOINT_MEASURES`, each (n,); an instant is NaN where there is none. Without rows nothing exists: NaN."""
    model, n = run.model, run.model.n
    if len(run) == 0:
        return {name: np.full(n, np.nan) for name in JOINT_MEASURES}
    excess = np.maximum(run.q - model.position_upper, model.position_lower - run.q)
    speed, torque = np.abs(run.v), np.abs(run.torque)
    alternating, size = alternation(run.torque), np.sum(torque, axis=0)
    size = np.maximum(size, LEAST_TORQUE * np.mean(size))
    values = (
        np.maximum(np.max(excess, axis=0), 0.0),
        _first(run, excess > 0.0),
        np.max(speed, axis=0),
        _first(run, speed > model.velocity_limit),
        np.max(torque, axis=0),
        _first(run, torque > model.effort_limit),
        np.divide(alternating, size, where=size > 0.0, out=np.zeros(n)),
    )
    return dict(zip(JOINT_MEASURES, values, strict=True))


def _first(run: Run, beyond: NDArray[np.bool_]) -> Array:
    """Return the instant of the first row in which each column (N, n) is true, NaN if none is, (n,)."""
    return np.where(np.any(beyond, axis=0), run.time[np.argmax(beyond, axis=0)], np.nan)


def alternation(signal: Array) -> Array:
    """Return how much of each column (N, n) alternates from row to row, summed over the rows, (n,).

    See `closedloop.report.joint_values.count_signal`.
    """
    turn = np.diff(signal, 2, axis=0)
    alternates = turn[1:] * turn[:-1] < 0.0
    amplitude: Array = 0.25 * np.minimum(np.abs(turn[1:]), np.abs(turn[:-1]))
    total: Array = np.sum(amplitude, axis=0, where=alternates)
    return total


def _exists(value: float | None) -> bool:
    """Whether a figure is a number, or is known not to exist."""
    return value is None or math.isfinite(value)


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
        np.max(run.kinetic_energy),
        run.closure_error[0] if touching[0] else 0.0,
        _force_chatter(run),
    )
    return {key: None if value is None else float(value) for key, value in zip(MEASURES, values, strict=True)}


def _force_chatter(run: Run) -> float:
    size = float(np.sum(np.abs(run.contact_force)))
    return float(alternation(run.contact_force[:, None])[0]) / size if size > 0.0 else 0.0


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

    The residual is the change of kinetic and potential energy less the energy that the arm was given: the work of the
    joint torques, ∫ Qᵀq̇ dt, of the contact force, ∫ f ė dt, and of friction at the tip and in the joints, less what
    the events took (`closedloop.step.energy_supplied`). It shrinks with the step, impacts or not, as the integrator's
    order says. The energy exchanged is ∫ |Qᵀq̇| dt, by the trapezoidal rule over the rows: what the residual is small
    or large against.
    """
    energy, supplied = run.kinetic_energy + run.potential_energy, run.energy_supplied
    power = np.einsum("ij,ij->i", run.torque, run.v)
    return energy - energy[0] - (supplied - supplied[0]), _cumulative(np.abs(power), run.time)


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
