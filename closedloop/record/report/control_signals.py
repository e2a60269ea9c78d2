"""What the control of a run is judged by, from its columns, or from the rows of a batch."""

from __future__ import annotations

from typing import Any

import numpy as np

from closedloop.base.arrays import Array, Mask
from closedloop.base.families import is_users
from closedloop.loop.events.table import IMPACT, TOUCHDOWN
from closedloop.mechanics.closure.contact_force import FREE
from closedloop.mechanics.integrators import ADAPTIVE
from closedloop.record.columns.record import Record
from closedloop.record.report.control_verdict import SPARSE, Signals
from closedloop.scenario.scenario import Scenario

# A path leads off the surface where it lies so much farther from it than it did, m: what the stiffness of an arm's law,
# some 1e4 N/m, turns into a tenth of a newton.
RELEASE = 1e-5
# Gains of the laws that ship with which they lead the tip along its path.
_LEADS = ("kp", "motion_stiffness", "stiffness")
_FEEDBACK = (*_LEADS, "kd", "motion_damping", "damping", "force_feedback", "force_integral")


def follows_path(scenario: Scenario, own_law: bool = False) -> bool:
    """Whether something leads the tip along the path: a gain of the law; of a law of one's own, a path that moves."""
    if own_law or is_users(scenario.law):
        return scenario.reference.kind != "hold"
    return any(np.any(np.asarray(getattr(scenario.law, name, 0.0)) != 0.0) for name in _LEADS)


def negative_gain(scenario: Scenario) -> str:
    """Return the key of a gain of a law that ships which is below zero, "" if none is."""
    if is_users(scenario.law):
        return ""
    return next((f"law.{name}" for name in _FEEDBACK if _below(getattr(scenario.law, name, None))), "")


def _below(gain: Any) -> bool:
    """Whether a gain, or one of several, is below zero; without numpy, for batches ask it of every run."""
    if isinstance(gain, tuple | list):
        return any(map(_below, gain))
    return gain is not None and bool(gain < 0.0 if isinstance(gain, float) else np.any(gain < 0.0))


def run_signals(run: Record) -> Signals | None:
    """Return the signals of a run; None if it has no rows."""
    if not len(run):
        return None
    off = run.position - run.reference_tip
    out = np.einsum("ij,ij->i", off, run.surface_normal)
    off = off - out[:, None] * run.surface_normal
    began = run.event_time[np.isin(run.event_kind, (IMPACT, TOUCHDOWN))]
    return signals_of(
        run.scenario, run.scenario.time.step, run.contact_force, run.reference_force, run.mode != FREE,
        (off, run.closure_error - out, run.reference_tip), began, run.law != "scenario",
    )  # fmt: skip


def signals_of(
    scenario: Scenario, h: float, force: Array, wanted: Array, touching: Mask, path: tuple[Array, Array, Array],
    touchdowns: Array, own_law: bool = False,
) -> Signals:  # fmt: skip
    """Return the signals of N rows.

    Contact is commanded where f_des > 0 (on a surface that can pull, where f_des is not zero), but for where the
    paper's law is led off the surface again by its path: by more than `RELEASE` from where it was nearest until
    then. Without a surface, and where links have contacts and the tip never had one, nothing is commanded of the tip:
    its force moves the arm.

    Parameters
    ----------
    h : float
        Time between two rows, s.
    force, wanted, touching : (N,) arrays
        f, f_des, N, and whether in contact.
    path : (N, 3), (N,) and (N, 3) arrays
        The tip less its path, along the surface; how far off the surface the path is; the path; m.
    touchdowns : (E,) array
        When contact began or the tip bounced, s.
    own_law : bool
        Whether the law is a function, and not the scenario's.
    """
    off, gap, tip = path
    led = follows_path(scenario, own_law)
    one_sided = scenario.surface.contact == "unilateral"
    commanded = wanted > 0.0 if one_sided else wanted != 0.0
    approaching = False
    if one_sided and led and (own_law or is_users(scenario.law) or scenario.law.kind == "paper"):
        nearest = np.minimum.accumulate(gap)
        commanded = commanded & (gap <= nearest + RELEASE)
        tenth = min(max(1, len(gap) // 10), len(gap) - 1)
        approaching = bool(gap[-1] > RELEASE and nearest[-1] < nearest[-1 - tenth])
    if scenario.contact and not np.any(touching):
        commanded, led = np.zeros(len(force), dtype=bool), led and not scenario.contact
    sparse = scenario.time.integrator in ADAPTIVE and h > SPARSE
    return Signals(
        h, force, wanted, touching, commanded, approaching, off if led else None, tip, touching | (wanted == 0.0),
        touchdowns, sparse, "" if own_law else negative_gain(scenario),
    )  # fmt: skip


def limited_joints(names: Any, share: Any, at: Any) -> dict[str, tuple[float, float]]:
    """Return by joint how often a limit of the drives cut its torque, and when first, s."""
    return {name: (float(s), float(t)) for name, s, t in zip(names, share, at, strict=True)}
