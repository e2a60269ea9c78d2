"""What is printed: one table of all rows, one of the targets."""

from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table

from validation.speed.measure import ratio
from validation.speed.targets import Target, Timings


def as_data(timings: Timings, found: list[Target], extra: dict[str, Any]) -> dict[str, Any]:
    """Return everything that was measured, for JSON; times in seconds."""
    rows = [
        {
            "arm": arm, "name": name, "what": t.contestant.what, "joints": t.contestant.joints,
            "steps": t.contestant.steps, "seconds_per_step": t.median, "processor_seconds_per_step": t.processor,
            "processor_seconds_per_step_and_joint": t.processor / t.contestant.joints, "spread": t.spread,
            "cores_busy": float(t.share.mean()), "laps": t.wall.tolist(), "processor_laps": t.busy.tolist(),
            "error": t.error,
            "over_mujoco": ratio(t, timings[arm, "mujoco"]) if (arm, "mujoco") in timings else None,
        }
        for (arm, name), t in timings.items()
    ]  # fmt: skip
    marks = [
        {"what": t.what, "wanted": t.wanted, "at_least": t.least, "measured": t.measured, "met": t.met} for t in found
    ]
    return {"rows": rows, "targets": marks, **extra}


def show(data: dict[str, Any]) -> None:
    """Print both tables, the cold starts and what is missing."""
    table = Table(box=box.SIMPLE_HEAD, title=f"one step of a slide, median of {data['repeats']} laps in turns")
    columns = ("arm", "who", "µs", "±%", "CPU µs", "a joint", "× MuJoCo", "error")
    for column in columns:
        table.add_column(column, justify="left" if column in ("arm", "who") else "right")
    last = ""
    for row in data["rows"]:
        if row["arm"] == "machine":
            continue
        over = row["over_mujoco"]
        times = ("seconds_per_step", "processor_seconds_per_step", "processor_seconds_per_step_and_joint")
        micro = [1e6 * row[key] for key in times]
        if last and row["arm"] != last:
            table.add_section()
        table.add_row(
            f"{row['arm']} ({row['joints']})" if row["arm"] != last else "", row["what"], f"{micro[0]:.3g}",
            f"{100 * row['spread']:.0f}", f"{micro[1]:.3g}", f"{micro[2]:.3g}", f"{1 / over:.2f}" if over else "–",
            "–" if row["error"] is None else f"{row['error']:.1e}",
        )  # fmt: skip
        last = row["arm"]
    console = Console(highlight=False)
    console.width = max(100, console.width)
    console.print(table)
    console.print("error: of q at the end, rad or m, from the answer with a rigid contact and endlessly short steps\n")
    marks = Table(box=box.SIMPLE_HEAD, title="targets")
    for column in ("ratio", "wanted", "measured", ""):
        marks.add_column(column, justify="left" if column == "ratio" else "right")
    for mark in data["targets"]:
        measured = "not measured" if mark["measured"] is None else f"{mark['measured']:.2f}"
        sign = {True: "✓", False: "✗", None: ""}[mark["met"]]
        marks.add_row(mark["what"], f"{'≥' if mark['at_least'] else '≤'} {mark['wanted']:g}", measured, sign)
    console.print(marks)
    console.print(f"two threads of bare arithmetic do {data['two_threads']:.2f} times the work of one on this machine")
    for name, seconds in data["cold_start_seconds"].items():
        console.print(f"cold start, {name}: {seconds:.2f} s")
    for name, reason in data["missing"].items():
        console.print(f"{name}: {reason}", markup=False)  # [peers] is no style
