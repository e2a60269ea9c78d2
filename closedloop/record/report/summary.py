"""The summary of a run: verdict, the paper's five assumptions, how large every error was, and the balance of energy.

An assumption is reported as held only if it was checked at every row; the value that decides stands beside it. What a
row has to say is `closedloop.record.report.measures`, interpreted on columns; the largest, the sum, the first of it
over the rows is numpy's here.
"""

import math
from collections.abc import Mapping
from functools import partial
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from closedloop.base.arrays import Array, Mask, plain
from closedloop.jit.interpreted import interpreted
from closedloop.loop.events.table import KINDS
from closedloop.loop.step.record_row import RECORDED
from closedloop.mechanics.closure.contact_force import FREE, STUCK
from closedloop.mechanics.contacts.friction import coulomb_of, has_other_law
from closedloop.mechanics.contacts.soft import is_soft
from closedloop.mechanics.integrators import steps_impulses
from closedloop.mechanics.loops.reactions import parts_of
from closedloop.record.clearance import clearance
from closedloop.record.columns.record import POSITIONS, Record
from closedloop.record.columns.touching import contact_rows
from closedloop.record.report import measures as of_rows
from closedloop.record.report import verdict as of_numbers
from closedloop.record.report.control_verdict import judge_control, limited_joints, run_signals
from closedloop.record.report.halved import step_error
from closedloop.scenario import modes
from closedloop.scenario.arm import robot_of
from closedloop.scenario.tables import names_of
from closedloop.scenario.user_module import lacks_members
from robot_models.coordinates import in_pinocchios_order, with_rotation_vectors

# Sets of modes that are looked at; and what is left of a row, of the largest, that depends on others.
MOST_SETS, SAME_ROW = 20, 1e-9


class ContactFaults(NamedTuple):
    """By how much the k contacts of links miss their conditions, over all rows of a run."""

    names: tuple[str, ...]  # what they are called
    cone: Array  # (k,): the largest |F_t| − μ f, and −f, N; not below zero
    complementarity: Array  # (k,): the largest |f| times the gap, N m; zero of a soft one
    depth: Array  # (k,): how deep one that presses is in its surface at most, m; zero of a soft one


def lost_to_slips(time: Array, frictions: Array, slips: Array) -> float:
    """Return the energy that sliding friction took at contacts of links, J, from (N,) instants and (N, 2 k) columns.

    It counts with the slip, as `closedloop.record.report.measures.friction_power` does at the tip.
    """
    power = np.sum(frictions * slips, axis=1)
    return -float(np.sum(0.5 * (power[1:] + power[:-1]) * np.diff(time)))


def contact_faults(run: Record) -> ContactFaults | None:
    """Return by how much the contacts of links miss their conditions; None if there are none."""
    sections = run.scenario.contact
    if not sections or not len(run):
        return None
    f, friction = run.link_forces, run.link_frictions.reshape(len(run), len(sections), 2)
    mu = np.array([coulomb_of(section) for section in sections])
    others = np.array([has_other_law(section) for section in sections])  # which have bounds of their own
    soft = np.array([is_soft(section) for section in sections])
    outside = np.maximum(np.where(others, 0.0, np.hypot(friction[..., 0], friction[..., 1]) - mu * f), -f)
    gaps = run.link_gaps
    if steps_impulses(run.scenario.time.integrator):  # whose forces go with the gaps at the step's end
        f, gaps = f[:-1], gaps[1:]
        # Two boxes touch in other points after a step, which are numbered anew: the nearest counts.
        pair = [k - (section.box.point if section.box else 0) for k, section in enumerate(sections)]
        firsts, at = np.unique(pair, return_inverse=True)
        gaps = np.minimum.reduceat(gaps, firsts, axis=1)[:, at]
    missed = np.max(np.abs(f * gaps * ~soft), axis=0, initial=0.0)
    depth = np.max(np.where((f > 0.0) & ~soft, -gaps, 0.0), axis=0, initial=0.0)
    return ContactFaults(names_of(sections), np.max(np.maximum(outside, 0.0), axis=0), missed, depth)


def share_not_determined(run: Record) -> tuple[float, int, int] | None:
    """Return from when on rigid bodies do not determine the share of each contact; None if they do, or there are loops.

    That is the instant, s, how many rows there are then, and how many of them depend on no others, see `shares_at`.
    Looked at is the first row of each set of modes, of at most `MOST_SETS` of them.
    """
    if not run.scenario.contact or not len(run) or run.loops is not None:
        return None
    firsts = np.sort(np.unique(run.link_modes, axis=0, return_index=True)[1])
    for row in firsts[:MOST_SETS]:
        _, count, rank = shares_at(run, int(row))
        if rank < count:
            return float(run.time[row]), count, rank
    return None


def shares_at(run: Record, row: int) -> tuple[NDArray[np.bool_], int, int]:
    """Return of which contacts rigid bodies do not determine the share at a row, the number of rows, and their rank.

    The rows are those of the contacts that are closed, along their normals and, where they stick, along the surface:
    those that depend on each other have no unique forces. What soft contacts bear follows from how deep they are.
    """
    sections = run.scenario.contact or ()
    k, modes = len(sections), run.link_modes[row]
    held = [coulomb_of(each) > 0.0 or getattr(each.friction_law, "sticks", "") == "rigid" for each in sections]
    rigid = np.array([not is_soft(each) for each in sections])
    units = [(i, 0) for i in np.flatnonzero(rigid & (modes != FREE))]
    units += [(i, j) for i in np.flatnonzero(rigid & (modes == STUCK)) if held[i] for j in (1, 2)]
    undetermined = np.zeros(k, dtype=bool)
    if not units:
        return undetermined, 0, 0
    along = np.array(units)
    rows = _contact_rows(run, row, rigid & (modes != FREE))[along[:, 0], along[:, 1]]
    ways, sizes, _ = np.linalg.svd(rows)
    rank = int(np.count_nonzero(sizes > SAME_ROW * float(np.max(np.abs(rows), initial=0.0))))
    for at, (i, _) in enumerate(units):
        undetermined[i] |= bool(np.max(np.abs(ways[at, rank:]), initial=0.0) > SAME_ROW)
    return undetermined, len(units), rank


def _contact_rows(run: Record, row: int, some: Mask) -> Array:
    q = in_pinocchios_order(run.q[row], run.model.joint_types)
    return contact_rows(run.scenario, run.model.pinocchio_model(), float(run.time[row]), q, some)


# So many rows at a time: their samples stay in the processor's cache.
ROWS = 2048

_LAST = ("contact_force", "closure_error", "mode", "normal_mobility")
_COLUMNS = tuple(name for name in RECORDED if name not in ("acceleration", "measured_force"))


def columns_of(run: Record, rows: slice = slice(None)) -> Any:
    """Return these rows of a run as `sample_row` reads them: columns (N,) and (k, N) by their names."""
    found = {name: getattr(run, name)[rows].T for name in _COLUMNS}
    for name in found.keys() & set(POSITIONS) if run.model.balls else ():
        found[name] = with_rotation_vectors(found[name].T, run.model.joint_types).T
    return SimpleNamespace(**found)


@np.errstate(all="ignore")  # what overflows is named in the summary
def run_values(run: Record) -> Any:
    """Return the values of a run of at least one row, see `closedloop.record.report.measures.Values`."""
    n, count, h = run.model.n, len(run), run.scenario.time.step
    tally, values = (
        of_rows.Tally(np.zeros(of_rows.Tally.count(n)), n),
        of_rows.Values(np.zeros(of_rows.Values.count(n)), n),
    )
    limits = of_rows.JointLimits(of_rows.joint_limits(run.model), n)
    interpreted(of_rows.begin_tally)(tally, h, float(np.max(np.abs(run.reference_force))))
    of_rows.Scale(tally.scale).start_energy = run.kinetic_energy[0] + run.potential_energy[0]
    of_rows.Scale(tally.scale).start_supplied = run.energy_supplied[0]
    memory, signals = np.empty((of_rows.Sample.count(n), min(ROWS, count))), np.empty((1 + n, 0))
    for rows in (slice(begin, min(begin + ROWS, count)) for begin in range(0, count, ROWS)):
        sample = of_rows.Sample(memory[:, : rows.stop - rows.start], n)
        wanted = SimpleNamespace(position=run.reference_tip[rows].T, force=run.reference_force[rows])
        row, potential = columns_of(run, rows), run.potential_energy[rows]
        interpreted(of_rows.sample_row)(row, n, potential, wanted, limits, of_rows.Scale(tally.scale), sample)
        if rows.start == 0:
            tally.start_error = float(memory[of_rows.Sample.place("contact_error", n), 0])
            tally.powers_before[:] = sample.powers[:, 0]
        _count_rows(run.time[max(rows.start - 1, 0) : rows.stop], rows.start, sample, tally)
        signals = np.hstack([signals[:, 1 - of_rows.SPAN :], sample.signals])
        tally.signals[:, -1] += of_rows.alternation(signals.T)
    tally.condition = np.max(run.kkt_condition)
    last = SimpleNamespace(**{name: getattr(run, name)[-1] for name in _LAST})
    interpreted(of_rows.write_values)(last, n, count, tally, values)
    if "torque_limited" in run.columns:
        of_numbers.count_limited(run.torque_limited, h, values)
    values.energy_lost_in_impacts = np.sum(run.event_energy_lost)
    values.energy_taken_at_rest = np.sum(run.event_energy_rested)
    if run.scenario.contact:
        values.energy_lost_to_friction += lost_to_slips(run.time, run.link_frictions, run.link_slips)
    values.largest_rate_cut = np.max(run.event_rate_cut, initial=0.0)
    values.events[:] = np.bincount(run.event_kind, minlength=values.events.size + 1)[1:]
    return values


def _count_rows(time: Array, begin: int, sample: of_rows.Sample, tally: of_rows.Tally) -> None:
    """Count in the rows from row `begin` on; `time` is theirs and, unless it is the first, the one's before."""
    np.maximum(tally.greatest, np.max(sample.greatest, axis=1), out=tally.greatest)
    lowest = np.minimum(np.minimum.accumulate(sample.energy), tally.lowest_energy)
    tally.energy_gained = max(tally.energy_gained, np.max(sample.energy - lowest))
    tally.lowest_energy = lowest[-1]
    tally.sums += np.sum(sample.sums, axis=1)
    powers = np.hstack([tally.powers_before[:, None], sample.powers]) if begin > 0 else sample.powers
    tally.work += np.sum(0.5 * (powers[:, 1:] + powers[:, :-1]) * np.diff(time), axis=1)
    tally.powers_before[:] = sample.powers[:, -1]
    flagged = sample.flags > 0.0
    when = np.where(np.any(flagged, axis=1), time[-flagged.shape[1] :][np.argmax(flagged, axis=1)], np.nan)
    tally.first[:] = np.where(np.isnan(tally.first), when, tally.first)
    excess = np.concatenate([[tally.excess_before], sample.unsettled])
    enters = np.flatnonzero((excess[1:] <= 0.0) & (excess[:-1] > 0.0))
    if enters.size:
        at = enters[-1]
        tally.settled = begin + at - 1.0 + interpreted(of_rows.share_inside)(excess[at], excess[at + 1])
    unsettled = np.flatnonzero(excess[1:] > 0.0)
    if unsettled.size:
        tally.last_unsettled = begin + unsettled[-1]
    tally.excess_before = excess[-1]


def assumptions(run: Record, measures: Mapping[str, float | None]) -> dict[str, dict[str, Any]]:
    """Return, for each of the paper's assumptions, whether it held, when it first failed (s), and what decided.

    ``expected`` says whether it should hold: False where the scenario itself gives it up, see
    `closedloop.record.report.verdict.outside_by_the_scenario`, or the run left it in a determined way. `measures` are
    the run's, see `closedloop.record.report.measures.MEASURES`.

    - ``one_loop``: Eq. 24 has a single closure row, and its solution obeys it.
    - ``single_point``: the surface acts on the arm at the tip alone: the equation of motion is met with Jᵣᵀn f and no
      moment beside it.
    - ``contact_kept``: the surface never has to pull: f > 0, and a tip that may leave never does.
    - ``frictionless``: the surface acts along its normal alone and the joints turn freely: no friction of either, and
      the same residual.
    - ``nonsingular``: the tip can move along the normal (`NEAR_SINGULAR`).
    """
    outside = of_numbers.outside_by_the_scenario(run.scenario, run.model)
    if len(run) == 0:
        missing = {"held": None, "first_failed": 0.0, "measured": "no row could be computed"}
        return {name: missing | {"expected": name not in outside} for name in of_rows.NAMES}
    motion = float(np.max(run.residual_motion))
    # the row at which the tip moves least along the normal; the middle of those of a pose that it passes
    stiffest = int(np.argmin(run.normal_mobility))
    stiffest += int(np.sum(np.cumprod(run.normal_mobility[stiffest:] == run.normal_mobility[stiffest]))) // 2
    friction = np.linalg.norm(run.friction_force, axis=1)
    in_joints = np.max(np.abs(run.joint_friction), axis=1)
    only_contact = f"other forces ≤ {motion:.0e}"
    measured = (
        _rows_of_the_closure(run),
        only_contact,
        _contact(run),
        _friction(friction, in_joints) or only_contact,
        f"mobility ≥ {run.normal_mobility[stiffest]:.2g}, cond. ≤ {np.max(run.kkt_condition):.2g}",
    )
    met = interpreted(of_rows.assumptions_met)(run, friction, in_joints)
    report = {name: _judge(run, *verdict) for name, *verdict in zip(of_rows.NAMES, met, measured, strict=True)}
    if run.stopped and "singular" in run.stopped:
        verdict = report["nonsingular"]
        if verdict["held"]:  # no row was near it: the step after the last was
            verdict |= {"held": False, "first_failed": float(run.time[-1]) + run.scenario.time.step}
    if run.model.loops:
        rows = sum(loop.rows for loop in run.model.loops)
        count = len(run.model.loops)
        said = f"{measured[0]}; {_counted(rows, 'row')} in {_counted(count, 'loop')} of the mechanism"
        report["one_loop"] = {"held": False, "first_failed": 0.0, "measured": said}
        outside |= {"one_loop"}
    if found := contact_faults(run):
        cone, product = np.max(found.cone), np.max(found.complementarity)
        many = _counted(len(found.names), "contact")
        said = f"{many} besides: cone to {cone:.0e} N, force times gap {product:.0e} N m"
        report["single_point"] = {"held": False, "first_failed": 0.0, "measured": said}
        outside |= {"single_point"}
        friction = np.hypot(run.link_frictions[:, ::2], run.link_frictions[:, 1::2])
        if np.any(friction):
            before = report["frictionless"]
            first = float(run.time[np.argmax(np.any(friction > 0.0, axis=1))])
            first = first if before["first_failed"] is None else min(first, before["first_failed"])
            said = f"friction at the contacts ≤ {np.max(friction):.3g} N"
            said = said if before["held"] else f"{before['measured']}; {said}"
            report["frictionless"] = {"held": False, "first_failed": first, "measured": said}
            outside |= {"frictionless"}
    if passed := of_numbers.outside_by_the_run(measures, run.stopped):
        verdict = report["nonsingular"]
        verdict["measured"] = f"passed at t = {run.time[stiffest]:.4g} s; {verdict['measured']}"
        outside |= passed
    for name, verdict in report.items():
        verdict["expected"] = name not in outside
    return report


def _judge(run: Record, held: NDArray[np.bool_], measured: str) -> dict[str, Any]:
    failed = np.flatnonzero(~held)
    first = float(run.time[failed[0]]) if failed.size else None
    return {"held": not failed.size, "first_failed": first, "measured": measured}


def _friction(at_tip: NDArray[np.float64], in_joints: NDArray[np.float64]) -> str:
    """Return how much friction there was, N and N m, or an empty string."""
    parts = [(at_tip, "N"), (in_joints, "N m in joints")]
    return ", ".join(f"friction ≤ {np.max(size):.3g} {unit}" for size, unit in parts if np.any(size))


def _rows_of_the_closure(run: Record) -> str:
    if np.all(run.mode == FREE):
        return "no row: the tip is free" if run.scenario.has_surface else "no row: there is no surface"
    if np.any(run.mode == STUCK):
        return "three rows while the tip sticks"
    return f"one row, met to {np.max(run.residual_closure):.0e}"


def _contact(run: Record) -> str:
    """Return what decides whether contact was kept: how long the tip was off the surface, else the lowest force."""
    touching = run.mode != FREE
    if not np.any(touching):
        return "free from start to end" if run.scenario.has_surface else "there is no surface"
    held = np.where(touching, run.contact_force, np.inf)
    lowest = int(np.argmin(held))
    if np.all(touching) or not held[lowest] > 0.0:
        return f"f ≥ {held[lowest]:.4g} N, at {run.time[lowest]:.4g} s"
    free = run.scenario.time.step * np.count_nonzero(~touching[:-1])
    return f"free for {free:.4g} of {run.time[-1]:g} s"


def _counted(count: int, what: str) -> str:
    """Return how many there are of something, in words."""
    return f"{count} {what}" + ("s" if count != 1 else "")


def summarise(run: Record) -> dict[str, Any]:
    """Return the summary of a run: what summary.json holds, which is strict JSON.

    Quantities that do not exist (no rows) are None. So is a value that is no finite number; `not_finite` names it.
    """
    found = run_values(run) if len(run) else None
    values: dict[str, Any] = dict.fromkeys(of_rows.MEASURES) if found is None else _measures(run, found)
    joints = {name: getattr(found, name, np.full(run.model.n, np.nan)) for name in of_rows.JOINT_MEASURES}
    held = assumptions(run, values)
    failed = {
        name: (v["first_failed"], v["measured"]) for name, v in held.items() if v["held"] is False and v["expected"]
    }
    columns = {name: column.tolist() for name, column in joints.items()}
    facts = of_numbers.Facts(
        run.scenario, run.model, run.stopped, len(run) - 1, values, len(run.events), failed, columns, _unresolved(run),
        run.halved, run.scenario.is_passive and run.law == "scenario",
    )  # fmt: skip
    problems, near = of_numbers.judge(facts, lambda: run_gains_fault(run)), clearance(run)
    limited = limited_joints(run.model.joint_names, joints["torque_limited_share"], joints["torque_limited_at"])
    of_control, not_known = judge_control(run_signals(run), limited, run.stopped)
    return {
        "verdict": {"good": not problems, "problems": problems},
        "control_verdict": {"good": not of_control, "problems": of_control, "not_known": not_known},
        "scenario": run.scenario.name,
        "robot": run.model.name,
        "law": run.law,
        "steps": max(0, len(run) - 1),
        "end_time": float(run.time[-1]) if len(run) else None,
        "stopped": run.stopped,
        **{name: value if _exists(value) else None for name, value in values.items()},
        "not_finite": [name for name, value in values.items() if not _exists(value)],
        "step_error": step_error(run),
        "halved": None if run.halved is None else dict(run.halved),
        "wrist": _wrist(run),
        "tool": _tool(run),
        "force_not_determined_from": of_numbers.not_determined_from(run),
        "friction_off_slip": of_numbers.friction_off_slip(run),
        "motions_without_drive": of_numbers.motions_without_drive(run),
        "clearance": None if near is None else {**near._asdict(), "between": list(near.between)},
        "events": {kind: sum(event.kind == kind for event in run.events) for kind in KINDS.values()},
        "assumptions": held,
        "joints": {
            name: {key: plain(column[j]) for key, column in joints.items()}
            for j, name in enumerate(run.model.joint_names if len(run) else ())
        },
        "loops": _loops(run),
        "wall_seconds": run.wall_seconds,
    }


def _unresolved(run: Record) -> list[str]:
    if not len(run):
        return []
    robot, own_law = robot_of(run.scenario, run.model), run.law != "scenario"
    start = run.q[0], run.surface_normal[0], -float(run.closure_error[0])
    lines = modes.unresolved(
        run.scenario, robot, *start,
        lambda: modes.where_it_slides(run.q, run.surface_normal, run.contact_force, run.friction_force, run.mode),
        own_law, lambda: modes.where_they_press(run.q, run.link_forces, partial(_contact_rows, run)),
    )  # fmt: skip
    return lines if own_law else lines + modes.unresolved_feedback(run.scenario, robot)


def _loops(run: Record) -> dict[str, dict[str, float]]:
    """Return the largest of each part of a mechanism's reactions, N or N m, and of its joint's errors, m or rad."""
    if run.loops is None or not len(run):
        return {}
    found = run.loops
    worst: dict[str, float] = {}
    for name, error in zip(found.joints, np.max(np.abs(found.errors), axis=0).tolist(), strict=True):
        worst[name] = max(error, worst.get(name, 0.0))
    most = np.max(np.abs(found.reactions), axis=0).tolist()
    joints = [loop.name for loop in run.model.loops for _ in parts_of(run.model, loop)]
    return {
        label: {"max_reaction": size, "max_error": worst[name]}
        for label, size, name in zip(found.labels, most, joints, strict=True)
    }


def _wrist(run: Record) -> dict[str, float | None] | None:
    """Return the largest force, N, and moment, N m, between the arm and what it carries; None if it carries nothing."""
    if len(run) == 0 or not (run.scenario.tool.mass or run.scenario.model_error.payload):
        return None
    parts = {"max_force": run.wrist_wrench[:, :3], "max_moment": run.wrist_wrench[:, 3:]}
    return {name: plain(np.max(np.linalg.norm(part, axis=1))) for name, part in parts.items()}


def _tool(run: Record) -> dict[str, float | None] | None:
    """Return how far the tool turned from its reference and from the normal at most, degrees; None if it is free."""
    if len(run) == 0 or getattr(run.scenario.reference, "orientation", "free") == "free":
        return None
    return {"max_orientation_error": plain(np.max(run.orientation_error)), "max_angle": plain(np.max(run.tool_angle))}


def run_gains_fault(run: Record) -> str:
    """Return what is wrong with the gains for this step; nothing is known of a law or a class of one's own."""
    if run.law != "scenario" or lacks_members(run.scenario):
        return ""
    return modes.gains_fault(run.scenario, robot_of(run.scenario, run.model))


def joint_measures(run: Record) -> dict[str, Array]:
    """Return `JOINT_MEASURES`, each (n,); an instant is NaN where there is none. Without rows nothing exists: NaN."""
    values = run_values(run) if len(run) else None
    return {name: getattr(values, name, np.full(run.model.n, np.nan)) for name in of_rows.JOINT_MEASURES}


def _exists(value: float | None) -> bool:
    """Whether a value is a number, or is known not to exist."""
    return value is None or math.isfinite(value)


def _measures(run: Record, values: Any) -> dict[str, float | None]:
    """Return `MEASURES`; None is what does not exist, and a number that is not finite what overflowed."""
    found: dict[str, float | None] = {name: float(getattr(values, name)) for name in of_rows.MEASURES}
    if np.all(run.mode == FREE):
        found["rms_force_error"] = None
    if np.isnan(values.force_settled_at):
        found["force_settled_at"] = None
    return found | dict.fromkeys(of_rows.absent_measures(run.scenario, run.law != "scenario"))


def energy_balance(run: Record) -> tuple[Array, Array]:
    """Return the residual of the energy balance and the energy exchanged, each (N,), J, from the start to each row.

    The residual is the change of kinetic and potential energy less the energy that the arm was given: the work of the
    joint torques, ∫ Qᵀq̇ dt, of the contact force, ∫ f ė dt, and of friction at the tip and in the joints, less what
    the events took (`closedloop.loop.step.energy_supplied`). It shrinks with the step, impacts or not, as the
    integrator's order says. The energy exchanged is ∫ |Qᵀq̇| dt, by the trapezoidal rule over the rows: what the
    residual is small or large against.
    """
    row, n, scale = columns_of(run), run.model.n, of_rows.Scale(np.zeros(of_rows.Scale.count()))
    scale.start_energy, scale.start_supplied = run.kinetic_energy[0] + run.potential_energy[0], run.energy_supplied[0]
    left = interpreted(of_rows.energy_left)(row, run.potential_energy, scale)
    power = np.abs(interpreted(of_rows.torque_power)(row, n))
    return left, np.concatenate([[0.0], np.cumsum(0.5 * (power[1:] + power[:-1]) * np.diff(run.time))])
