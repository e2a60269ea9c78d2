"""What is printed of a run: verdict, assumptions, how large every error was, and what happened to the contact."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from closedloop.control.drives import AT_RATE_LIMIT, AT_TORQUE_LIMIT, OF_THE_ROBOT
from closedloop.loop.events.table import IMPACT, TIME_STEPPING, TOUCHDOWN
from closedloop.mechanics.closure.contact_force import FREE
from closedloop.mechanics.friction.law import FrictionLaw
from closedloop.mechanics.integrators import ADAPTIVE, scheme_of
from closedloop.record.clearance import passing_note
from closedloop.record.columns.record import Event, Record
from closedloop.record.report.control_verdict import unknown_text
from closedloop.record.report.halved import halved_rows
from closedloop.record.report.summary import contact_faults, joint_measures, run_gains_fault, share_not_determined
from closedloop.record.report.verdict import GOOD, energy_at_stake, names_of, probable_reason
from closedloop.scenario.tables import names_in
from robot_models.described import notes as robot_notes

if TYPE_CHECKING:
    from rich.console import Console


# Quantity, value, unit, and what stands beside it.
Row = tuple[str, str, str, str]
_LIMITS = {AT_TORQUE_LIMIT: "torque limit", AT_RATE_LIMIT: "rate limit"}


def report_rows(run: Record) -> list[Row]:
    """Return the rows of the table of errors: quantity, value, unit, and what stands beside it; the run has rows."""
    facts = run.summary()
    parts = _error_rows, _undriven_rows, _loop_rows, _link_rows, _arm_rows, _contact_rows
    return [row for part in parts for row in part(run, facts)]


def _error_rows(run: Record, facts: dict[str, Any]) -> Iterator[Row]:
    """Yield how large the errors of the tip, of the equation of motion and of the step were."""
    touching, time, surface = run.mode != FREE, run.scenario.time, run.scenario.has_surface

    def row(label: str, key: str, form: str, unit: str, beside: str = "") -> Row:
        return label, _shown(facts[key], form), unit, beside

    if surface:
        commanded = f"commanded {run.reference_force[-1]:.6g} N" if run.law == "scenario" else f"law {run.law}"
        force = run.contact_force[touching] if np.any(touching) else np.zeros(1)
        where = "" if np.all(touching) else "in contact" if np.any(touching) else "never in contact"
        stated = commanded if touching[-1] else f"free; {commanded}"
        yield row("contact force f at the end", "final_contact_force", ".9g", "N", stated)
        yield "f, lowest and highest", f"{np.min(force):.4g} … {np.max(force):.4g}", "N", where
        if (at := facts["force_not_determined_from"]) is not None:
            what = "at rest; that of least friction is recorded"
            yield "f not determined by rigid bodies", f"from {at:.4g}", "s", what
        if (off := facts["friction_off_slip"]) is not None:  # the step does not resolve how the slip turns
            what = f"at {off['at']:.4g} s; of slip slower than {off['below_speed']:.2g} m/s, which turns within a step"
            yield "friction off the slip, at most", f"{off['max_angle']:.2g}", "deg", what
        yield row("force error, RMS", "rms_force_error", ".2g", "N", "while it touches")
    if run.scenario.has_law or run.law != "scenario":
        along = "along the surface" if surface else "across surface.normal"
        yield row("path error, RMS", "rms_path_error", ".2g", "m", along)
    if surface:
        absent = {"none": "no stabiliser", "projection": "projection needs no force"}
        depth = "closure error |e|" if run.scenario.compliance.kind == "none" else "depth in the surface |e|"
        end = facts["final_closure_error"]
        last = f"{_shown(end, '.1g')} m at the end" if touching[-1] else f"a gap of {_shown(end, '.3g')} m at the end"
        beside = absent.get(run.scenario.stabiliser.kind, "")
        yield row("the stabiliser's part of f", "max_stabiliser_force", ".2g", "N", beside)
        yield row(depth, "max_abs_closure_error", ".2g", "m", last)
        yield row("closure rate |ė|", "max_abs_closure_rate", ".2g", "m/s")
    exchanged = f"of {energy_at_stake(facts, facts['energy_gained'] is not None):.2g} J exchanged"
    yield row("residual of Eq. 24", "max_kkt_residual", ".1g", "relative", "rounding is 1e-16")
    yield row("energy unaccounted for", "max_energy_residual", ".2g", "J", exchanged)
    gained = facts["energy_above_start" if run.scenario.stores_energy else "energy_gained"]
    if gained is not None:  # of what nothing drives, in good runs too; what is stored comes back
        yield "energy grows by", f"{gained:.2g}", "J", f"of {energy_at_stake(facts, True):.2g} J; nothing drives it"
    scheme = scheme_of(time.integrator)
    step = "steps of its own" if time.integrator in ADAPTIVE else f"step {time.step:g} s"
    order = "not known" if scheme is None else f"{scheme.order}"
    yield "order of the integrator", order, "", f"{time.integrator}, {step}"
    errors = facts["step_error"]
    for label, error, unit in (("f differs by", errors["force"], "N"), ("tip differs by", errors["position"], "m")):
        if error is not None:
            yield label, f"{error:.2g}", unit, "from the run at half the step"
    if errors["force"] is None and errors["position"] is None:
        yield "error of the step", "not known", "", errors["why_not"]
    yield row("tip speed", "max_tip_speed", ".4g", "m/s")


def _undriven_rows(run: Record, facts: dict[str, Any]) -> Iterator[Row]:
    """Yield what becomes of the law's torque on joints without a drive: the drives give it, or it is lost."""
    of_bodies = run.model.of_bodies
    lost = facts["motions_without_drive"] - int(np.sum(of_bodies))
    undriven = np.flatnonzero(~run.model.driven & ~of_bodies)
    if len(undriven):  # nobody expects a drive of a free body
        names = ", ".join(run.model.joint_names[j] for j in undriven)
        if lost:
            yield "motions without a drive", f"{lost}", "", f"torque asked there is lost: {names}"
        else:
            where = "torque asked there is given by the drives, through the loops"
            yield "joints without a drive", f"{len(undriven)}", "", f"{where}: {names}"


def _loop_rows(run: Record, facts: dict[str, Any]) -> Iterator[Row]:
    """Yield how far the loops of a mechanism were from closed, and what they carried."""
    found = run.loops
    if found is None:
        return
    worst = int(np.argmax(np.max(np.abs(found.errors), axis=0)))
    m, least, most = found.errors.shape[1], int(np.min(found.rank)), int(np.max(found.rank))
    yield "loops: error", f"{np.max(np.abs(found.errors)):.2g}", "m (rad)", found.joints[worst]
    sizes = np.max(np.abs(found.reactions), axis=0)
    for unit in ("N", "N m"):
        at = [k for k, own in enumerate(found.units) if own == unit]
        if at:
            largest = max(at, key=sizes.__getitem__)
            yield "loops: reaction", f"{float(sizes[largest]):.4g}", unit, found.labels[largest]
    ranks, spare = f"{least}" if least == most else f"{least} to {most}", "; reactions of least norm"
    yield "loops: independent rows", ranks, "", f"of {m}{spare if least < m else ''}"


def _link_rows(run: Record, facts: dict[str, Any]) -> Iterator[Row]:
    """Yield what the contacts of links bore, and by how much they miss their conditions."""
    found = contact_faults(run)
    if found is None:
        return
    largest = np.max(run.link_forces, axis=0)
    most, cone, product, deep = (int(np.argmax(part)) for part in (largest, *found[1:]))
    if (shares := share_not_determined(run)) is not None:
        at, count, rank = shares
        what = f"{rank} of {count} rows are independent; the forces of least norm are recorded"
        yield "share of each contact not determined", f"from {at:.4g}", "s", what
    yield "contacts: largest force", f"{largest[most]:.4g}", "N", found.names[most]
    yield "contacts: outside the cone", f"{found.cone[cone]:.1g}", "N", found.names[cone]
    yield "contacts: force times gap", f"{found.complementarity[product]:.1g}", "N m", found.names[product]
    yield "contacts: depth in a rigid surface", f"{found.depth[deep]:.1g}", "m", found.names[deep]


def _arm_rows(run: Record, facts: dict[str, Any]) -> Iterator[Row]:
    """Yield how near to its limits the arm came, where it has any, how its tool is turned, and what limits cut."""
    found = joint_measures(run)
    for title, key, limit in (
        ("joint speed, of its limit", "max_joint_velocity", run.model.velocity_limit),
        ("joint torque, of its limit", "max_joint_torque", run.model.effort_limit),
    ):
        share = np.divide(found[key], limit, where=limit > 0.0, out=np.full(run.model.n, np.inf))
        j = int(np.argmax(share))
        if np.any(np.isfinite(limit)):
            yield title, f"{100.0 * share[j]:.3g}", "%", f"joint {run.model.joint_names[j]}"
    if (tool := facts["tool"]) is not None:
        error, angle = _shown(tool["max_orientation_error"], ".3g"), _shown(tool["max_angle"], ".3g")
        yield "tool from its orientation", error, "deg", f"its axis {angle} deg from the normal"
    if (wrist := facts["wrist"]) is not None:
        force, moment = _shown(wrist["max_force"], ".4g"), _shown(wrist["max_moment"], ".4g")
        at = f"at the frame {run.scenario.robot.tip or run.model.tip}"
        yield "force between arm and tool", force, "N", f"moment {moment} N m, {at}"

    for j in map(int, np.flatnonzero(np.isfinite(found["torque_limited_at"]))):
        kinds = np.unique(run.torque_limited[:, j])
        what = " and ".join(word for kind, word in _LIMITS.items() if kind in kinds)
        where = f"joint {run.model.joint_names[j]}, first at {found['torque_limited_at'][j]:.4g} s: {what}"
        yield "torque cut, of the time", f"{100.0 * found['torque_limited_share'][j]:.3g}", "%", where


def _shown(value: float | None, form: str) -> str:
    """Return a value of the summary as text; None is one that is no finite number."""
    return "not known" if value is None else format(value, form)


def _contact_rows(run: Record, facts: dict[str, Any]) -> Iterator[Row]:
    """Yield what a run in which contact changes has to say beside the rest."""
    if run.events:
        counts = ((kind.replace("_", " "), count) for kind, count in facts["events"].items() if count)
        yield "events", str(len(run.events)), "", ", ".join(f"{n} {kind}{'s' * (n > 1)}" for kind, n in counts)
    at_links = bool(run.scenario.contact) and np.any(run.link_frictions)
    if facts["max_friction_force"] or facts["max_joint_friction"] or at_links:
        yield "energy lost to friction", _shown(facts["energy_lost_to_friction"], ".3g"), "J", ""
    if run.scenario.surface.contact == "bilateral":
        return
    if run.scenario.has_surface:
        yield "time in contact", _shown(facts["time_in_contact"], ".4g"), "s", f"of {run.time[-1]:g} s"
        yield "deepest penetration", _shown(facts["deepest_penetration"], ".2g"), "m", ""
    if facts["events"]["impact"] or facts["events"]["touchdown"]:
        cut = facts["largest_rate_cut"] or 0.0
        what = f"bounce cut: {cut:.2g} m/s" if cut > 0.0 else "no bounce was cut"
        if rested := facts["energy_taken_at_rest"]:
            what += f", {rested:.2g} J taken to rest"
        yield "energy lost in impacts", _shown(facts["energy_lost_in_impacts"], ".3g"), "J", what


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


def stepped_in_time(run: Record) -> str:
    """Return a line about steps of impulses that took the place of events, or an empty string."""
    count = np.count_nonzero(run.event_kind == TIME_STEPPING)
    if count == 0:
        return ""
    often = "once" if count == 1 else f"{count} times"
    return (
        f"where modes of contacts changed too often ({often}) steps of impulses followed, which are of order 1; "
        "time.integrator = 'time_stepping' takes such steps alone, in less time"
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
    pressing = np.max(run.link_forces, axis=0, initial=0.0) if run.scenario.contact else ()
    by_contact = zip(run.scenario.contact or (), pressing, strict=True)
    faults = (
        ("friction", _energy_fault(run.scenario.friction, load)),
        ("joint_friction", _energy_fault(run.scenario.joint_friction, 1.0, run.v.shape[1])),
        *((f"contact.{i}.friction_law", _energy_fault(one.friction_law, f)) for i, (one, f) in enumerate(by_contact)),
        ("gains", run_gains_fault(run)),
    )
    told = {problem["name"] for problem in run.summary()["verdict"]["problems"]}
    passing = passing_note(run.summary()["clearance"])
    lines = [*_robot_notes(run), restitution_cut(run), shifted_events(run), stepped_in_time(run), passing]
    return [text for text in lines if text] + [f"{key}: {fault}" for key, fault in faults if fault and key not in told]


Heads = Mapping[str, Mapping[str, Any]]
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
    from rich.console import Console
    from rich.markup import escape

    console = Console(width=width, highlight=False)
    facts = run.summary()
    _print_verdict(facts, console)
    rows: list[Sequence[str]] = []
    for name, verdict in facts["assumptions"].items():
        held = {True: "[green]yes[/]", False: "[bold red]NO[/]", None: "unknown"}[verdict["held"]]
        if verdict["held"] is False and not verdict["expected"]:
            held = "outside,\npassed" if name == "nonsingular" else "outside, by\nthe scenario"
        when = "" if verdict["first_failed"] is None else f"{verdict['first_failed']:.4g} s"
        rows.append((_TITLES[name], held, when, verdict["measured"]))
    heads: Heads = {"assumption": {}, "held": {}, "first failed": {"justify": "right"}, "decided by": {}}
    _print_table(f"{run.scenario.name}: the paper's assumptions", heads, rows, console)
    if len(run) == 0:
        return
    values = [("how large every error was, at its worst", "value", report_rows(run))]
    if comparison and run.halved is not None:
        title = f"at half the step, {run.halved['step']:g} s, by how much it differs"
        escaped = [(escape(a), escape(b), escape(c), escape(d)) for a, b, c, d in halved_rows(run.halved)]
        values.append((title, "differs by", escaped))
    whole = {"no_wrap": True}
    for title, what, found in values:
        heads = {"quantity": whole, what: {"justify": "right", **whole}, "unit": whole, "beside it": {}}
        _print_table(title, heads, found, console)
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


def _print_table(title: str, heads: Heads, rows: Iterable[Sequence[str]], console: Console, **look: Any) -> None:
    """Print a table; `heads` are the titles of its columns, each with how it is to look."""
    from rich import box
    from rich.table import Column, Table

    columns = [Column(head, **how) for head, how in heads.items()]
    table = Table(*columns, box=box.SIMPLE_HEAD, title=title, title_justify="left", **look)
    for row in rows:
        table.add_row(*row)
    console.print(table)


def _print_events(run: Record, console: Console) -> None:
    """Print the first events as a table, columns that would be empty left out."""
    shown = run.events[:MOST_EVENTS]
    heads = ("time\ns", "event", "contact", "rate\nbefore\nm/s", "rate\nafter\nm/s", "com-\npression\nN s",
             "decom-\npression\nN s", "energy\nlost\nJ")  # fmt: skip
    names = ("tip", *names_in("contact", run.scenario.contact or ()))
    rows = [_event_row(event, names) for event in shown]
    kept = [k for k in range(len(heads)) if any(row[k] for row in rows)]
    if NAMED in kept and DECOMPRESSION in kept:  # of both there is no room; the rates say the restitution
        kept.remove(DECOMPRESSION)
    look = {k: {"justify": "left" if k in (1, 2) else "right", "no_wrap": True, "vertical": "bottom"} for k in kept}
    cells = [[row[k] for k in kept] for row in rows]
    # Nothing between the columns but one blank: seven fit into 80.
    _print_table("events", {heads[k]: how for k, how in look.items()}, cells, console, padding=(0, 1, 0, 0))
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
