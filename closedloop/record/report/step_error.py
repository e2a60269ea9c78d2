"""By how much the contact force and the tip's position of a run miss those of a run at a much shorter step.

A decaying motion a e^λt is off by ½ (hλ)² a e^λt a step of order one, which is half of what its second difference from
row to row is. What earlier steps left decays as the motion does, so the error of a row is at most the sum of what the
steps before it added: half of the total variation of the first difference. It is taken of the force less that asked for
and of the tip's distance from its reference, so that what the path itself does is no error, and anew in each mode of
contact. Where a path, a force or a law jumps at a row, the difference is an isolated one, and exact: it counts with no
more than the nearer of its neighbours, and with order one the change to it and from it does not count. Of a torque
that is held for k steps every k-th row counts.

A scheme of order p adds (hλ)ᵖ⁻¹ of that where the signal is smooth. Where it has a kink, as after a jump of the path,
in friction or at a sample of a sensor, the order is lost, and how smooth it is the rows themselves say
(`closedloop.record.report.step_variation.local_error`). A law that is sampled, or reads encoders, makes every scheme
one of order one.

To this is added what variations do not show. Events, and paths that start between two rows, move by up to a step, and
the force with them, by its steepest change from row to row; with order one the force lags by as much anyway. With a
higher order a path or a force that jumps at a row comes up to a third of a step early (`LATE`), which f hides where
joints are elastic. Where contact begins, with order one, the force asked for in that step may be that of either of its
rows. A torque that is held lets the force drift until the next sample, where it comes back by what the torque changes;
and contact that begins beside a sample may begin on the other side of it, so that the error of the force in that row
counts. In steady motion a run lags by a share of a step behind: the tip by as much of its way, and the force, which
depends on the pose, by about itself for each radian. The stabiliser's part of f is none at short steps. A law that
feeds the force back reads it a step late. And rounding.

Where an error grows it is no sum of what the steps add. Break-away multiplies it (`AGAIN`); where bounces go on, f and
the tip may be anywhere in their ranges (`bounces_on`); where f grows exponentially, nothing is stated (`grows`).

It is an estimate, not a bound that is proved: `tests/closedloop/test_step_error.py` compares it with runs at short
steps. It is about rows apart from those where contact begins, ends, sticks or slips: there the force jumps, at an
instant that moves with the step.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from closedloop.base.arrays import Array
from closedloop.base.plain import plain
from closedloop.control.compensation.observer import ObserverCompensation
from closedloop.loop.events.table import IMPACT, LIFTOFF, TOUCHDOWN
from closedloop.mechanics.closure.contact_force import FREE
from closedloop.mechanics.integrators import ADAPTIVE, scheme_of
from closedloop.record.columns.record import Record
from closedloop.record.report.growth import AT_REST, bounces_on, comes_out, grows, starts_again
from closedloop.record.report.step_columns import resolution_of
from closedloop.record.report.step_variation import Swing, Swings
from closedloop.scenario.scenario import Scenario

# All after a jump that the last stage of rk4 already has comes a sixth of a step early, of a jump within a step up to a
# third. Where joints are elastic the motors take the jump, and the rows of f do not show it.
LATE = 1.0 / 3.0
# Where friction is in joints, f comes in as many steps to what it is as joints come to rest or begin to move: each in a
# step of its own with a scheme of order one. Where the tip strikes, what friction was before decides over the next
# flight with any scheme: f and the tip are late by a step for each strike.
IN_TURN = 2.0
# A touchdown on a soft surface is found within its step, and f begins at nothing there. What is left of its steepest
# change, after a jump that a damper makes, is the tip's own error.
LOCATED = 0.05
# A soft surface that moves takes the tip along late with order one, and a law's damper along n answers what it is late
# by in each row: so many rows of f's steepest change are assumed, up to its range.
TAKEN_ALONG = 20.0
# Friction at the tip bends with the slip within a step, and rows do not show how much: so many times what they show.
BENT = 3.0
# A joint that comes to rest is off by the error of f there, and breaks away again earlier or later for it: where
# friction is less in motion, the error of f grows, as does that of the tip, and that of a tip that breaks away. So many
# times more is assumed each time, up to the range. (4.4 times in all was seen, of a joint that sticks and slips ever
# farther.)
AGAIN = 4.0
# What comes out of rounding so many times is no path, and the error of f is as large as what comes out, up to `AGAIN`
# times: it grows faster at another step.
COME_OUT = 100.0
# What stages leave the surface by, a stabiliser takes back, and a law with a memory of f keeps: up to so many times the
# stabiliser's part of f. (49 times was seen, of an admittance near a singular pose.)
FED_BACK = 60.0
# Starts of a joint from rest of which each multiplies the error of f; more, and it is beyond the range of f.
LASTS = 20
# Where links or bodies strike, several contacts do so in a row, and which is the first moves by a step each time: the
# tip is late by so many.
IN_A_ROW = 3.0
# Encoders read what is a step old, or the mean of two: the tip is off by as much in feedback.
OLD = 2.0
# Contact that ended within so many rows before the last may begin in it at another step.
BOUNCED = 20
# Why neither the error of f nor that of the tip is known.
GROWS = "f grows exponentially: with it the error of each step, and of rounding"
# Why that of f is not.
STRIKES_ONLY = "the tip strikes, and no row is in contact: at another step one may be"
BESIDE_OTHERS = "contacts of links change while the tip is in contact: f follows their friction between two rows"
# Why that of its extremes is not.
BESIDE_CHANGES = "where the tip sticks, slips or still bounces, f changes for a moment, and a row may fall there or not"


def why_not_known(scenario: Scenario, singular: bool) -> str:
    """Return why the error of the step in f is not estimated, "" where it is; `singular`: near such a pose."""
    name = scenario.time.integrator
    if name in ADAPTIVE:
        return f"{name} chooses its steps: its error is set by time.tolerance"
    if scheme_of(name) is None:
        return f"the order of {name}, a user's, is not in a file"
    if scenario.reads_encoders and np.any(scenario.encoder.quantisation):
        return "encoder.quantisation: when a reading changes, and the torque with it, depends on every step before"
    return "near a singular pose f depends on how near to it the rows are" if singular else ""


def why_position_not_known(scenario: Scenario) -> str:
    """Return why the error of the step in the tip's position is not estimated besides, "" where it is."""
    if scenario.sensor.noise or np.any(scenario.encoder.noise) or np.any(scenario.encoder.velocity_noise):
        return "noise is drawn at each step: the tip of a run at another step follows another noise"
    return ""


def why_force_not_known(
    scenario: Scenario, off: Array, events: tuple[Array, Array], touching: Array, speed: float
) -> str:
    """Return why the rows do not say what the error of f is, "" where they do.

    Parameters
    ----------
    scenario : Scenario
    off : (N,) array
        f − f_des, N.
    events : two (E,) arrays
        The kinds of the run's events, and their contacts, of which 0 is the tip.
    touching : (N,) array of bool
        Whether the tip is in contact.
    speed : float
        The fastest joint's in the last row, rad/s (m/s).
    """
    kinds, contacts = events
    strikes = np.isin(kinds, (IMPACT, TOUCHDOWN))
    if np.any(strikes & (contacts == 0)) and not np.any(touching):
        return STRIKES_ONLY
    if scenario.contact and np.any(contacts != 0) and np.any(touching):
        return BESIDE_OTHERS
    if np.any(strikes) and touching[-1] and speed < AT_REST and scenario.rubs_in_joints:
        return "joint_friction: what friction bears at rest depends on the last of the motion after an impact"
    return GROWS if grows(off) else ""


class Beside(NamedTuple):
    """What events and rows say of the errors besides the variation of f and of the tip."""

    off_at_the_end: bool  # whether the tip is off the surface, and was on it in the last `BOUNCED` rows before
    bounces_on: bool  # whether its bounces go on
    struck: int  # how often it struck
    links_struck: bool  # whether other contacts struck
    starts_again: int  # how often the joint that did so most came to rest, and moved again
    asked: float  # the largest change of f_des from row to row, N
    comes_out: bool  # whether f − f_des grows out of rounding


def beside_of(
    scenario: Scenario, events: Sequence[Array], mode: float, v: Array, forces: tuple[Array, Array]
) -> Beside:
    """Return what events and rows say besides.

    Parameters
    ----------
    scenario : Scenario
    events : four (E,) arrays
        Kinds, instants, s, rates ė before them, m/s, and contacts, of which 0 is the tip.
    mode : float
        Of contact, in the last row.
    v : (N, n) array
        Velocities of the joints, rad/s (m/s).
    forces : two (N,) arrays
        f and f_des, N.
    """
    (kinds, times, rates, contacts), (force, wanted) = events, forces
    struck = np.isin(kinds, (IMPACT, TOUCHDOWN)) & (contacts == 0)
    late = (struck | ((kinds == LIFTOFF) & (contacts == 0))) & (times > scenario.time.step * (len(v) - 1 - BOUNCED))
    return Beside(
        bool(mode == FREE and np.any(late)),
        bounces_on(np.abs(rates[struck])),
        int(np.count_nonzero(struck)),
        bool(np.any(np.isin(kinds, (IMPACT, TOUCHDOWN)) & (contacts != 0))),
        starts_again(v) if scenario.rubs_in_joints else 0,
        float(np.max(np.abs(np.diff(wanted)), initial=0.0)) if fed_back(scenario) else 0.0,
        comes_out(force - wanted) >= COME_OUT,
    )


def fed_back(scenario: Scenario) -> float:
    """Return by how much of a change of f_des the law's torque changes a step late, by feedback and by the integral."""
    return float(scenario.law.force_feedback + scenario.law.force_integral * scenario.time.step)


def write_beside(scenario: Scenario, swings: Swings, values: Any, beside: Beside) -> None:
    """Write what of the errors depends on what the scenario has besides, see `LATE` and the shares below it."""
    if why_position_not_known(scenario) and swings.ended > 2.0 * swings.steepest:
        # Noise enters in the last row: no other shows how much.
        values.step_error_force = values.step_error_extremes = math.nan
    higher, moved = resolution_of(scenario)[1] > 1, min(swings.jump, swings.steepest)
    force = Swing(swings.each[0])
    more = 0.0
    if scenario.transmission.elastic and higher and swings.stretches <= 1.0:
        more += max(0.0, LATE * swings.steepest - moved)
    if scenario.compensation.kind == "adaptive" and higher and swings.stretches <= 1.0:
        more += max(0.0, swings.steepest - moved)  # a coefficient that is held at zero bends f within a step
    if scenario.compliance.kind != "none" and swings.stretches <= 1.0:
        more += max(0.0, swings.jump - (moved if higher else swings.steepest))  # f of a soft surface does not jump
        if scenario.surface_motion.kind != "none" and not higher:
            more += min(TAKEN_ALONG * swings.steepest, force.highest - force.lowest)
    if scenario.compliance.kind != "none" and higher and swings.stretches > 1.0:
        more -= max(0.0, (1.0 - LOCATED) * swings.steepest - moved)
    if scenario.rubs_in_joints:
        more += 0.0 if higher else IN_TURN * swings.steepest
        more += min(beside.struck * swings.steepest, force.highest - force.lowest)
    if scenario.friction.kind != "none" and higher:
        more += BENT * force.error
    ranges = [each.highest - each.lowest for each in map(Swing, swings.each[1:])]
    if not beside.bounces_on:
        grown = (1.0 + AGAIN) ** min(beside.starts_again, LASTS) - 1.0  # so often is more than any range
        more += min(grown * values.step_error_force, values.peak_contact_force - values.min_contact_force)
        values.step_error_position += min(grown * values.step_error_position, math.hypot(*ranges))
    if isinstance(scenario.compensation, ObserverCompensation) and higher and scenario.stabiliser.kind == "both":
        # What stages leave the surface by, the observer takes for a disturbance, and comes back from at its rate.
        more += swings.steepest / min(1.0, scenario.compensation.rate * scenario.time.step)
    if higher and (scenario.law.kind == "admittance" or scenario.law.force_integral):
        more += min(FED_BACK * values.max_stabiliser_force, force.highest - force.lowest)
    more += fed_back(scenario) * beside.asked
    if beside.comes_out:
        more += AGAIN * (force.highest - force.lowest)
    if beside.bounces_on:  # f and the tip may be anywhere in their ranges
        more = max(more, values.peak_contact_force - min(values.min_contact_force, 0.0) - values.step_error_force)
        values.step_error_position = max(values.step_error_position, math.hypot(*ranges))
    values.step_error_force += more
    values.step_error_extremes += math.nan if beside.off_at_the_end else more
    if scenario.reads_encoders:
        values.step_error_position *= OLD
    if swings.sticks or (beside.struck and scenario.transmission.elastic):
        values.step_error_position *= 1.0 + AGAIN
    if beside.struck and scenario.rubs_in_joints:
        late = beside.struck * scenario.time.step * values.max_tip_speed
        values.step_error_position += min(late, math.hypot(*ranges))
    if beside.links_struck:
        values.step_error_position += IN_A_ROW * scenario.time.step * values.max_tip_speed
    rubs = scenario.friction.kind != "none" or scenario.rubs_in_joints
    if why_position_not_known(scenario) or (math.isnan(values.step_error_force) and rubs):
        values.step_error_position = math.nan


def unknown_because(why: str) -> tuple[str, ...]:
    """Return which values of the summary are not known for what `why_force_not_known` says: none where it says "".

    An error that grows with f is the tip's too.
    """
    return ("step_error_force", "step_error_extremes", "step_error_position")[: 2 * (why != "") + (why == GROWS)]


def run_force_not_known(run: Record) -> str:
    """Return `why_force_not_known` of a run that has rows."""
    off, events = run.contact_force - run.reference_force, (run.event_kind, run.event_contact)
    return why_force_not_known(run.scenario, off, events, run.mode != FREE, float(np.max(np.abs(run.v[-1]))))


def step_error(run: Record, values: dict[str, Any]) -> dict[str, Any]:
    """Return the part ``step_error`` of the summary, of its values.

    ``contact_force``, N, None without a surface, and ``position``, m; ``extremes``, N, of the highest, lowest and last
    f, which may lie beside a change of contact, None too where that is not known; ``measured``: whether they are the
    difference of the run at half the step, see `closedloop.record.report.halved`, and no estimate; ``why_not``: why f
    or the position is not known, or None.
    """
    force, extremes, position = (plain(values[f"step_error_{name}"]) for name in ("force", "extremes", "position"))
    why = None
    if not len(run):
        why = "no row could be computed"
    elif position is None or (force is None and run.scenario.has_surface):
        why = why_not_known(run.scenario, False) or run_force_not_known(run)
        why = why or why_position_not_known(run.scenario)
        why = why or why_not_known(run.scenario, values["step_error_force"] is None) or "it is not a finite number"
    found = {"contact_force": force, "position": position, "extremes": extremes}
    return found | {"measured": run.halved is not None, "why_not": why}


def step_rows(found: dict[str, Any]) -> list[tuple[str, str, str, str]]:
    """Return the rows of the table of errors, see `closedloop.record.report.report_rows`."""
    beside = "measured, of the run at half the step" if found["measured"] else "estimate, of a run at a shorter step"
    said = [("f is within", found["contact_force"], "N"), ("tip is within", found["position"], "m")]
    known = [(label, f"±{error:.2g}", unit, beside) for label, error, unit in said if error is not None]
    missing = [("error of the step", "not known", "", found["why_not"])] if found["why_not"] else []
    force, extremes = found["contact_force"], found["extremes"]
    if force is not None and extremes is None:
        missing.append(("error of peak and last f", "not known", "", BESIDE_CHANGES))
    elif force is not None and extremes > force:
        known.insert(1, ("peak and last f are within", f"±{extremes:.2g}", "N", "beside changes of contact too"))
    return missing + known
