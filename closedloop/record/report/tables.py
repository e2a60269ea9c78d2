"""What is printed of a run: verdict, assumptions, how large every error was, and what happened to the contact."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from closedloop.control.drives import AT_RATE_LIMIT, AT_TORQUE_LIMIT, OF_THE_ROBOT
from closedloop.loop.events.table import IMPACT, TOUCHDOWN
from closedloop.mechanics.closure.contact_force import FREE
from closedloop.mechanics.friction.law import FrictionLaw
from closedloop.mechanics.integrators import ADAPTIVE, scheme_of
from closedloop.record.clearance import passing_note
from closedloop.record.columns.record import Event, Record
from closedloop.record.report.control_verdict import unknown_text
from closedloop.record.report.halved import halved_rows
from closedloop.record.report.run_values import contact_rows
from closedloop.record.report.summary import joint_measures, run_gains_fault
from closedloop.record.report.verdict import GOOD, energy_at_stake, names_of, probable_reason
from closedloop.scenario.tables import names_in
from robot_models.notes import notes as robot_notes

if TYPE_CHECKING:
    from rich.console import Console


# Quantity, value, unit, and what stands beside it.
Row = tuple[str, str, str, str]
_LIMITS = {AT_TORQUE_LIMIT: "torque limit", AT_RATE_LIMIT: "rate limit"}


def report_rows(run: Record) -> list[Row]:
    """Return the rows of the table of errors: quantity, value, unit, and what stands beside it; the run has rows."""
    facts = run.summary()
    touching = run.mode != FREE
    commanded = f"commanded {run.reference_force[-1]:.6g} N" if run.law == "scenario" else f"law {run.law}"
    kind = run.scenario.stabiliser.kind
    absent = {"none": "no stabiliser", "projection": "projection needs no force"}.get(kind, "")
    force = run.contact_force[touching] if np.any(touching) else np.zeros(1)
    where = "" if np.all(touching) else "in contact" if np.any(touching) else "never in contact"
    end = facts["final_closure_error"]
    time = run.scenario.time
    scheme = scheme_of(time.integrator)
    step = "steps of its own" if time.integrator in ADAPTIVE else f"step {time.step:g} s"
    where_to = "along the surface" if run.scenario.has_surface else "across surface.normal"
    has_law = run.scenario.has_law or run.law != "scenario"

    def row(label: str, key: str, form: str, unit: str, beside: str = "") -> Row:
        return label, _shown(facts[key], form), unit, beside

    path = [row("path error, RMS", "rms_path_error", ".2g", "m", where_to)] if has_law else []
    last = f"{_shown(end, '.1g')} m at the end" if touching[-1] else f"a gap of {_shown(end, '.3g')} m at the end"
    depth = "closure error |e|" if run.scenario.compliance.kind == "none" else "depth in the surface |e|"
    stated = commanded if touching[-1] else f"free; {commanded}"
    tip: list[Row] = [
        row("contact force f at the end", "final_contact_force", ".9g", "N", stated),
        ("f, lowest and highest", f"{np.min(force):.4g} … {np.max(force):.4g}", "N", where),
        *_undetermined_rows(facts),
        *_direction_rows(facts),
        row("force error, RMS", "rms_force_error", ".2g", "N", "while it touches"),
        *path,
        row("the stabiliser's part of f", "max_stabiliser_force", ".2g", "N", absent),
        row(depth, "max_abs_closure_error", ".2g", "m", last),
        row("closure rate |ė|", "max_abs_closure_rate", ".2g", "m/s"),
    ]
    exchanged = f"of {energy_at_stake(facts, facts['energy_gained'] is not None):.2g} J exchanged"
    order = "not known" if scheme is None else f"{scheme.order}"
    return [
        *(tip if run.scenario.has_surface else path),
        row("residual of Eq. 24", "max_kkt_residual", ".1g", "relative", "rounding is 1e-16"),
        row("energy unaccounted for", "max_energy_residual", ".2g", "J", exchanged),
        *_gain_rows(run, facts),
        ("order of the integrator", order, "", f"{time.integrator}, {step}"),
        *_step_rows(facts["step_error"]),
        row("tip speed", "max_tip_speed", ".4g", "m/s"),
        *_undriven_rows(run, facts),
        *_loop_rows(run),
        *contact_rows(run),
        *_joint_rows(run),
        *_tool_rows(run, facts),
        *_limited_rows(run),
        *_contact_rows(run, facts),
    ]


def _gain_rows(run: Record, facts: dict[str, Any]) -> list[Row]:
    """Return by how much the energy of what nothing drives grows, in good runs too; what is stored comes back."""
    gained = facts["energy_above_start" if run.scenario.stores_energy else "energy_gained"]
    if gained is None:
        return []
    return [("energy grows by", f"{gained:.2g}", "J", f"of {energy_at_stake(facts, True):.2g} J; nothing drives it")]


def _undetermined_rows(facts: dict[str, Any]) -> list[Row]:
    """Return since when f is not determined by rigid bodies, at an arm that rests on friction in its joints."""
    at = facts["force_not_determined_from"]
    if at is None:
        return []
    return [("f not determined by rigid bodies", f"from {at:.4g}", "s", "at rest; that of least friction is recorded")]


def _direction_rows(facts: dict[str, Any]) -> list[Row]:
    """Return by how much friction points away from the slip, where the step does not resolve how the slip turns."""
    off = facts["friction_off_slip"]
    if off is None:
        return []
    what = f"at {off['at']:.4g} s; of slip slower than {off['below_speed']:.2g} m/s, which turns within a step"
    return [("friction off the slip, at most", f"{off['max_angle']:.2g}", "deg", what)]


def _undriven_rows(run: Record, facts: dict[str, Any]) -> list[Row]:
    """Return what becomes of the law's torque on joints without a drive: the drives give it, or it is lost."""
    of_bodies = run.model.of_bodies
    lost = facts["motions_without_drive"] - int(np.sum(of_bodies))
    undriven = np.flatnonzero(~run.model.driven & ~of_bodies)
    if not len(undriven):  # nobody expects a drive of a free body
        return []
    names = ", ".join(run.model.joint_names[j] for j in undriven)
    if lost:
        return [("motions without a drive", f"{lost}", "", f"torque asked there is lost: {names}")]
    where = "torque asked there is given by the drives, through the loops"
    return [("joints without a drive", f"{len(undriven)}", "", f"{where}: {names}")]


def _loop_rows(run: Record) -> list[Row]:
    """Return how far the loops of a mechanism were from closed, and what they carried."""
    found = run.loops
    if found is None:
        return []
    worst = int(np.argmax(np.max(np.abs(found.errors), axis=0)))
    m, least, most = found.errors.shape[1], int(np.min(found.rank)), int(np.max(found.rank))
    ranks = f"{least}" if least == most else f"{least} to {most}"
    rows = [("loops: error", f"{np.max(np.abs(found.errors)):.2g}", "m (rad)", found.joints[worst])]
    for unit in ("N", "N m"):
        at = [k for k, own in enumerate(found.units) if own == unit]
        if at:
            largest = max(at, key=lambda k: float(np.max(np.abs(found.reactions[:, k]))))
            size = float(np.max(np.abs(found.reactions[:, largest])))
            rows.append(("loops: reaction", f"{size:.4g}", unit, found.labels[largest]))
    spare = "; reactions of least norm" if least < m else ""
    return [*rows, ("loops: independent rows", ranks, "", f"of {m}{spare}")]


def _joint_rows(run: Record) -> list[Row]:
    """Return how near to its limits the arm came, where it has any."""
    found = joint_measures(run)
    rows = []
    for title, key, limit in (
        ("joint speed, of its limit", "max_joint_velocity", run.model.velocity_limit),
        ("joint torque, of its limit", "max_joint_torque", run.model.effort_limit),
    ):
        share = np.divide(found[key], limit, where=limit > 0.0, out=np.full(run.model.n, np.inf))
        j = int(np.argmax(share))
        if np.any(np.isfinite(limit)):
            rows.append((title, f"{100.0 * share[j]:.3g}", "%", f"joint {run.model.joint_names[j]}"))
    return rows


def _tool_rows(run: Record, facts: dict[str, Any]) -> list[Row]:
    """Return how the tool is turned, where that is asked for, and what it bears, if the arm carries one."""
    rows, wrist, tool = [], facts["wrist"], facts["tool"]
    if tool is not None:
        error, angle = _shown(tool["max_orientation_error"], ".3g"), _shown(tool["max_angle"], ".3g")
        rows.append(("tool from its orientation", error, "deg", f"its axis {angle} deg from the normal"))
    if wrist is not None:
        force, moment = _shown(wrist["max_force"], ".4g"), _shown(wrist["max_moment"], ".4g")
        at = f"at the frame {run.scenario.robot.tip or run.model.tip}"
        rows.append(("force between arm and tool", force, "N", f"moment {moment} N m, {at}"))
    return rows


def _limited_rows(run: Record) -> list[Row]:
    """Return a row for each joint whose torque a limit of the drives cut."""
    found, rows = joint_measures(run), []
    for j, at in enumerate(found["torque_limited_at"]):
        if np.isfinite(at):
            kinds = np.unique(run.torque_limited[:, j])
            what = " and ".join(word for kind, word in _LIMITS.items() if kind in kinds)
            share = f"{100.0 * found['torque_limited_share'][j]:.3g}"
            where = f"joint {run.model.joint_names[j]}, first at {at:.4g} s: {what}"
            rows.append(("torque cut, of the time", share, "%", where))
    return rows


def _shown(value: float | None, form: str) -> str:
    """Return a value of the summary as text; None is one that is no finite number."""
    return "not known" if value is None else format(value, form)


def _contact_rows(run: Record, facts: dict[str, Any]) -> list[Row]:
    """Return what a run in which contact changes has to say beside the rest."""
    counts = ", ".join(
        f"{count} {kind.replace('_', ' ')}{'s' * (count > 1)}" for kind, count in facts["events"].items() if count
    )
    rows = [("events", str(len(run.events)), "", counts)] if run.events else []
    at_links = bool(run.scenario.contact) and np.any(run.link_frictions)
    if facts["max_friction_force"] or facts["max_joint_friction"] or at_links:
        rows.append(("energy lost to friction", _shown(facts["energy_lost_to_friction"], ".3g"), "J", ""))
    if run.scenario.surface.contact == "bilateral":
        return rows
    cut = facts["largest_rate_cut"] or 0.0
    if run.scenario.has_surface:
        rows += [
            ("time in contact", _shown(facts["time_in_contact"], ".4g"), "s", f"of {run.time[-1]:g} s"),
            ("deepest penetration", _shown(facts["deepest_penetration"], ".2g"), "m", ""),
        ]
    if facts["events"]["impact"] or facts["events"]["touchdown"]:
        what = f"bounce cut: {cut:.2g} m/s" if cut > 0.0 else "no bounce was cut"
        if rested := facts["energy_taken_at_rest"]:
            what += f", {rested:.2g} J taken to rest"
        rows.append(("energy lost in impacts", _shown(facts["energy_lost_in_impacts"], ".3g"), "J", what))
    return rows


def _step_rows(found: dict[str, Any]) -> list[tuple[str, str, str, str]]:
    """Return the rows of the error of the step, see `closedloop.record.report.halved.step_error`."""
    said = [("f differs by", found["force"], "N"), ("tip differs by", found["position"], "m")]
    known = [
        (label, f"{error:.2g}", unit, "from the run at half the step")
        for label, error, unit in said
        if error is not None
    ]
    return known or [("error of the step", "not known", "", found["why_not"])]


# How many events are printed: a bouncing tip has dozens.
MOST_EVENTS = 8


def restitution_cut(run: Record) -> str:
    """Return a line about impacts that gave less restitution than was asked for, or an empty string."""
    asked, impacts = run.scenario.impact.restitution, run.event_kind == IMPACT
    if run.scenario.impact.law != "newton":
        return ""  # a law of one's own may give what it likes
    given = run.event_restitution[impacts & (run.event_restitution < asked)]
    if not given.size:
        return ""
    return (
        f"impact.restitution = {asked:g}: {given.size} of {np.count_nonzero(impacts)} impacts gave less, at least "
        f"{np.min(given):.3g}: with friction Newton's law would have created energy; poisson and stronge never do"
    )


def shifted_events(run: Record) -> str:
    """Return a line about a scheme of order 1 in a run with impacts, or an empty string."""
    name = run.scenario.time.integrator
    scheme = scheme_of(name)
    if scheme is None or scheme.order > 1 or not np.any(np.isin(run.event_kind, (IMPACT, TOUCHDOWN))):
        return ""
    return (
        f"time.integrator = {name!r} is of order 1: impacts are off by up to several steps of "
        f"{run.scenario.time.step:g} s, and small ones may be missed; rk4 and dop853 locate them"
    )


def _energy_fault(law: Any, load: float, n: int | None = None) -> str | None:
    """Return what `FrictionLaw.energy_fault` says; nothing of a user's class that is not there."""
    return law.energy_fault(load, n) if isinstance(law, FrictionLaw) else None


def _robot_notes(run: Record) -> tuple[str, ...]:
    """Return what the robot's file says and the run did not act on."""
    model, limited, rough = run.model, run.scenario.drives.torque_limit == OF_THE_ROBOT, run.scenario.robot.friction
    if not (limited or rough):
        return model.notes
    effort = np.full(model.n, np.inf) if limited else model.effort_limit
    return robot_notes(model.text, model.format, () if rough else model.joint_names, model.velocity_limit, effort)


def notes(run: Record) -> list[str]:
    """Return what a reader of the run should know beside its values: what was left out, friction that may drive ..."""
    load = float(np.max(np.abs(run.contact_force)))
    faults = (
        ("friction", _energy_fault(run.scenario.friction, load)),
        ("joint_friction", _energy_fault(run.scenario.joint_friction, 1.0, run.v.shape[1])),
        *(
            (
                f"contact.{i}.friction_law",
                _energy_fault(section.friction_law, np.max(run.link_forces[:, i], initial=0.0)),
            )
            for i, section in enumerate(run.scenario.contact or ())
        ),
        ("gains", run_gains_fault(run)),
    )
    told = {problem["name"] for problem in run.summary()["verdict"]["problems"]}
    passing = passing_note(run.summary()["clearance"])
    lines = [*_robot_notes(run), restitution_cut(run), shifted_events(run), passing]
    return [text for text in lines if text] + [f"{key}: {fault}" for key, fault in faults if fault and key not in told]


# Letters of a contact's name for which a table of 80 has room, and the columns of the name and of the decompression.
WIDEST_NAME, NAMED, DECOMPRESSION = 16, 2, 6

_TITLES = {
    "one_loop": "one loop",
    "single_point": "a single point",
    "contact_kept": "no loss of contact (f > 0)",
    "frictionless": "no friction",
    "nonsingular": "no singular pose",
}


def print_report(run: Record, width: int | None = None, comparison: bool = False) -> None:
    """Print the verdict, in the first line, and the tables of assumptions and errors on standard output.

    With `comparison` also the whole comparison with the run at half the step, of a run that has it.
    """
    from rich import box
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    console = Console(width=width, highlight=False)
    facts = run.summary()
    _print_verdict(facts, console)
    table = Table(box=box.SIMPLE_HEAD, title=f"{run.scenario.name}: the paper's assumptions", title_justify="left")
    table.add_column("assumption")
    table.add_column("held")
    table.add_column("first failed", justify="right")
    table.add_column("decided by")
    for name, verdict in facts["assumptions"].items():
        held = {True: "[green]yes[/]", False: "[bold red]NO[/]", None: "unknown"}[verdict["held"]]
        if verdict["held"] is False and not verdict["expected"]:
            held = "outside,\npassed" if name == "nonsingular" else "outside, by\nthe scenario"
        when = "" if verdict["first_failed"] is None else f"{verdict['first_failed']:.4g} s"
        table.add_row(_TITLES[name], held, when, verdict["measured"])
    console.print(table)
    if len(run) == 0:
        return
    _print_values("how large every error was, at its worst", "value", report_rows(run), console)
    if comparison and run.halved is not None:
        title = f"at half the step, {run.halved['step']:g} s, by how much it differs"
        _print_values(title, "differs by", [tuple(map(escape, row)) for row in halved_rows(run.halved)], console)
    if run.events:
        _print_events(run, console)
    for note in notes(run):
        console.print(f"[yellow]note:[/] {note}")


def _print_verdict(facts: dict[str, Any], console: Console) -> None:
    """Print the verdicts of numbers and control in a line each, at any width, and then what is wrong."""
    from rich.markup import escape

    problems, control = facts["verdict"]["problems"], facts["control_verdict"]
    if facts["verdict"]["good"]:
        left = facts["assumptions"]["nonsingular"]
        outside = left["held"] is False and left["measured"].startswith("passed")
        passed = f", outside the paper's assumptions: singular pose {left['measured'].split(';')[0]}"
        console.print(f"verdict: [green]{GOOD}[/]{passed if outside else ''}", soft_wrap=True)
    else:
        reason = probable_reason(problems)
        why = f" ({reason})" if reason else ""
        console.print(f"verdict: [bold red]BAD[/]: {names_of(problems)}{why}", soft_wrap=True)
    said = f"[green]{GOOD}[/]" if control["good"] else f"[bold red]BAD[/]: {names_of(control['problems'])}"
    console.print(f"control: {said}{escape(unknown_text(control['not_known']))}", soft_wrap=True)
    for problem in problems + control["problems"]:
        when = "" if problem["at"] is None else f" (from {problem['at']:.4g} s)"
        console.print(f"  [bold red]{problem['name']}[/]: {escape(problem['text'])}{when}")


def _print_values(title: str, what: str, rows: Iterable[Sequence[str]], console: Console) -> None:
    """Print a table of values: the name of each, the value, called `what`, its unit, and what stands beside it."""
    from rich import box
    from rich.table import Table

    table = Table(box=box.SIMPLE_HEAD, title=title, title_justify="left")
    table.add_column("quantity", no_wrap=True)
    table.add_column(what, justify="right", no_wrap=True)
    table.add_column("unit", no_wrap=True)
    table.add_column("beside it")
    for row in rows:
        table.add_row(*row)
    console.print(table)


def _print_events(run: Record, console: Console) -> None:
    """Print the first events as a table, columns that would be empty left out."""
    from rich import box
    from rich.table import Table

    shown = run.events[:MOST_EVENTS]
    heads = ("time\ns", "event", "contact", "rate\nbefore\nm/s", "rate\nafter\nm/s", "com-\npression\nN s",
             "decom-\npression\nN s", "energy\nlost\nJ")  # fmt: skip
    names = ("tip", *names_in("contact", run.scenario.contact or ()))
    rows = [_event_row(event, names) for event in shown]
    kept = [k for k in range(len(heads)) if any(row[k] for row in rows)]
    if NAMED in kept and DECOMPRESSION in kept:  # of both there is no room; the rates say the restitution
        kept.remove(DECOMPRESSION)
    # Nothing between the columns but one blank: seven fit into 80.
    table = Table(box=box.SIMPLE_HEAD, title="events", title_justify="left", padding=(0, 1, 0, 0))
    for k in kept:
        table.add_column(heads[k], justify="left" if k in (1, 2) else "right", no_wrap=True, vertical="bottom")
    for row in rows:
        table.add_row(*(row[k] for k in kept))
    console.print(table)
    more = len(run.events) - len(shown)
    if more:
        console.print(f"  and {more} more, the last at {run.events[-1].time:.6f} s")


def _event_row(event: Event, names: tuple[str, ...]) -> tuple[str, ...]:
    """Return the cells of an event: rates where contact begins or ends, impulses and energy of an impact.

    `names` are those of the tip and of the contacts of links; the tip's alone need not be said.
    """
    normal = event.kind in ("impact", "touchdown", "liftoff", "edge")
    impact = event.kind in ("impact", "touchdown")
    return (
        f"{event.time:.6f}",
        event.kind,
        (names[event.contact] if event.contact < len(names) else "stop")[:WIDEST_NAME] if len(names) > 1 else "",
        _short(event.rate_before) if normal else "",
        _short(event.rate_after) if normal else "",
        _short(event.compression) if impact else "",
        _short(event.decompression) if impact else "",
        _short(event.energy_lost) if impact else "",
    )


def _short(value: float) -> str:
    """Return a number in three digits; what is below 1e-15 is rounding."""
    return f"{value:.3g}" if abs(value) >= 1e-15 else "0"
