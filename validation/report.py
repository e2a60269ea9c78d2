"""The findings of the harness: held together, printed as tables, written as JSON, Markdown or HTML.

Headers and rows of the harness's tables, as text: of a robot's comparison, and of a section of checks.
"""

import json
import math
import shlex
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from html import escape
from textwrap import shorten
from typing import Any

from closedloop.base.arrays import plain
from validation.comparison import Cell, Comparison
from validation.states import QUANTITIES

MARKS = {"agrees": "✓", "disagrees": "✗"}
SHORT = {"not covered": "–", "not installed": "not installed", "not usable": "–"}


@dataclass(frozen=True)
class Check:
    """One line of a section: a value, its bound, and whether it holds.

    name, of: what was checked, and on what or on whom
    value, tolerance: the worst error and its bound, in the same unit; nan if nothing was computed
    passed: None: not covered, or not installed; `note` says which
    note: the argument for the bound, or the reason
    """

    name: str
    of: str
    value: float
    tolerance: float
    passed: bool | None
    note: str = ""


@dataclass
class Section:
    """A group of checks under a title."""

    title: str
    checks: list[Check] = field(default_factory=list)


def title_of(c: Comparison) -> str:
    """Return the title of a robot's tables."""
    return f"{c.robot} at its frame {c.tip}: {c.states} states of seed {c.seed} against {c.reference}"


def details(c: Comparison) -> tuple[list[str], list[list[str]]]:
    """Return header and rows of one robot's long table: a line for each quantity of each engine."""
    header = ["quantity", "engine", "worst absolute", "worst relative", "tolerance", "at state", "states", ""]
    rows = [
        [
            cell.quantity, cell.engine, f"{cell.absolute:.2e}", f"{cell.relative:.2e}", f"{cell.tolerance:.2e}",
            f"{cell.robot.partition(':')[2]} {cell.state}".strip(), str(cell.states), MARKS[cell.status],
        ]
        for cell in c.cells
        if cell.status in MARKS
    ]  # fmt: skip
    return header, rows


def grid(c: Comparison) -> tuple[list[str], list[list[str]], list[str]]:
    """Return header, rows and remarks of one robot's table: quantity by engine, worst relative error."""
    engines = list(dict.fromkeys(cell.engine for cell in c.cells))
    at = {(cell.quantity, cell.engine): cell for cell in c.cells}
    rows = []
    for quantity in QUANTITIES:
        cells = [at[quantity, engine] for engine in engines]
        bounds = [cell.tolerance for cell in cells if math.isfinite(cell.tolerance)]
        lowest, highest = (f"{f(bounds):.0e}" if bounds else "" for f in (min, max))
        rows.append(
            [
                quantity,
                *(SHORT.get(cell.status) or f"{cell.relative:.0e} {MARKS[cell.status]}" for cell in cells),
                lowest if lowest == highest else f"{lowest} … {highest}",
            ]
        )
    fewer = {cell.engine: cell.states for cell in c.cells if 0 < cell.states < c.states}
    remarks = {f"{engine}: slow, compared at {count} of {c.states} states": None for engine, count in fewer.items()}
    remarks |= dict.fromkeys(
        f"{cell.engine}: {cell.status}: {cell.reason}" for cell in c.cells if cell.reason and cell.status != "agrees"
    )
    return ["worst relative error", *engines, "tolerance"], rows, list(remarks)


def _verdict(passed: bool | None) -> str:
    return {True: "✓", False: "✗", None: "–"}[passed]


def _number(x: float) -> str:
    return "" if math.isnan(x) else f"{x:.1e}"


def check_rows(section: Section) -> tuple[list[str], list[list[str]]]:
    """Return header and rows of a section."""
    rows = [
        [check.name, check.of, _number(check.value), _number(check.tolerance), _verdict(check.passed), check.note]
        for check in section.checks
    ]
    return ["check", "of", "worst", "tolerance", "", "why, or why not"], rows


@dataclass
class Report:
    """Everything that one run of the harness found; prints itself.

    sections: identities, published numbers, trajectories, faults
    command: what reproduces the run
    details: whether the printed tables have a line for each quantity of each engine, as Markdown and HTML always have
    """

    comparisons: list[Comparison] = field(default_factory=list)
    sections: list[Section] = field(default_factory=list)
    command: str = ""
    details: bool = False

    @property
    def passed(self) -> bool:
        """Whether something was compared and nothing is out of tolerance."""
        checks = [check for section in self.sections for check in section.checks]
        decided = [check for check in checks if check.passed is not None]
        return (
            bool(self.comparisons or decided)
            and all(comparison.passed for comparison in self.comparisons)
            and all(check.passed for check in decided)
        )

    @property
    def worst(self) -> Cell | None:
        """The compared cell that uses the largest part of its tolerance."""
        cells = [c.worst for c in self.comparisons if c.worst is not None]
        return max(cells, key=lambda cell: cell.margin, default=None)

    def reproduce(self) -> str:
        """Return the command that looks again at the worst state; empty if there is none."""
        worst = self.worst
        if worst is None or worst.state is None:
            return ""
        found = next(c for c in self.comparisons if c.worst is worst)
        # The cell of a table over many random trees names its own tree, whose seed is that of its states.
        seed = worst.robot.removeprefix("random:") if worst.robot != found.robot else str(found.seed)
        words = ("--robot", worst.robot, "--tip", found.tip, "--seed", seed, "--state", str(worst.state))
        return f"python -m validation.run {shlex.join(words)}"

    def to_json(self) -> str:
        """Return everything as JSON; what is no finite number is null."""
        data = {
            "passed": self.passed,
            "command": self.command,
            "reproduce_worst": self.reproduce(),
            "comparisons": [asdict(c) | {"passed": c.passed} for c in self.comparisons],
            "sections": [asdict(s) for s in self.sections],
        }
        return json.dumps(plain(data), indent=2, ensure_ascii=False)

    def to_markdown(self) -> str:
        """Return the tables in Markdown, for the appendix of a paper."""
        return "\n".join(_markdown(self))

    def to_html(self) -> str:
        """Return one self-contained page."""
        return _html(self)

    def __rich_console__(self, console: Any, options: Any) -> Iterable[Any]:
        """Draw the tables, for ``rich.print`` and `show`."""
        yield from _rich(self)

    def show(self) -> None:
        """Print the tables on standard output."""
        from rich.console import Console

        console = Console(highlight=False)
        # A table that is cut off is worse than one that a file's reader must scroll.
        Console(highlight=False, width=None if console.is_terminal else 160).print(self)

    def __str__(self) -> str:
        return self.to_markdown()


def _ending(report: Report) -> str:
    cells = [cell for c in report.comparisons for cell in c.cells]
    checks = [check for section in report.sections for check in section.checks]
    compared = sum(cell.status in MARKS for cell in cells) + sum(check.passed is not None for check in checks)
    failed = sum(cell.status == "disagrees" for cell in cells) + sum(check.passed is False for check in checks)
    left = len(cells) + len(checks) - compared
    return f"{compared} comparisons, {failed} out of tolerance, {left} not covered or not installed (each named above)"


def _rich(report: Report) -> Iterable[Any]:
    from rich import box
    from rich.table import Table
    from rich.text import Text

    said: set[str] = set()

    def colour(text: str) -> Text:
        return Text(text, style="bold red" if "✗" in text else "")  # as it is: a unit in brackets is no markup

    for c in report.comparisons:
        header, rows, remarks = grid(c)
        table = Table(box=box.SIMPLE_HEAD, title=title_of(c), title_justify="left")
        for k, name in enumerate(header):
            table.add_column(name, justify="left" if k == 0 else "right", no_wrap=True)
        for row in rows:
            table.add_row(*map(colour, row))
        yield table
        for remark in remarks:
            if remark not in said:  # the same engines lack the same things for every robot
                yield Text(f"  {remark}", style="dim")
            said.add(remark)
        if report.details:
            header, rows = details(c)
            table = Table(*header, box=box.SIMPLE_HEAD)
            for row in rows:
                table.add_row(*map(colour, row))
            yield table
    for section in report.sections:
        header, rows = check_rows(section)
        table = Table(box=box.SIMPLE_HEAD, title=section.title, title_justify="left")
        for k, name in enumerate(header):
            table.add_column(name, justify="right" if k in (2, 3) else "left", no_wrap=k in (2, 3, 4))
        for row in rows:
            # A terminal gets the beginning of an argument; JSON, Markdown and HTML have it whole.
            table.add_row(*map(colour, [*row[:-1], shorten(row[-1], 100, placeholder=" …")]))
        yield table
    yield Text("")
    yield Text(_ending(report), style="bold green" if report.passed else "bold red")
    if report.reproduce():
        yield Text(f"the worst case again: {report.reproduce()}")


def _tables(report: Report) -> Iterable[tuple[str, list[str], list[list[str]], list[str]]]:
    for c in report.comparisons:
        yield (title_of(c), *grid(c))
        yield (f"{c.robot} against {c.reference}, in full", *details(c), [])
    for section in report.sections:
        yield (section.title, *check_rows(section), [])


def _markdown(report: Report) -> Iterable[str]:
    yield f"# Cross-check: {'passed' if report.passed else 'FAILED'}\n"
    yield f"`{report.command}`\n"
    for title, header, rows, remarks in _tables(report):
        yield f"## {title}\n"
        yield "| " + " | ".join(header) + " |"
        yield "|" + "---|" * len(header)
        for row in rows:
            yield "| " + " | ".join(entry.replace("|", "\\|") for entry in row) + " |"
        yield ""
        for remark in remarks:
            yield f"- {remark}"
        yield ""
    yield _ending(report) + "."
    if report.reproduce():
        yield f"\nThe worst case again: `{report.reproduce()}`"


_PAGE = """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><title>Cross-check: {verdict}</title><style>
body {{ font: 15px/1.45 system-ui, sans-serif; margin: 2em auto; max-width: 75em; padding: 0 1em; color: #1a1a1a }}
table {{ border-collapse: collapse; margin: .5em 0 1em; font-variant-numeric: tabular-nums }}
th, td {{ padding: .2em .7em; text-align: left; border-bottom: 1px solid #ddd; vertical-align: top }}
th {{ border-bottom: 2px solid #888 }} h2 {{ font-size: 1.1em; margin: 2em 0 .3em }}
.bad {{ color: #b00020; font-weight: bold }} .good {{ color: #00661f; font-weight: bold }} li {{ color: #555 }}
</style></head><body><h1>Cross-check: <span class="{style}">{verdict}</span></h1>
<p><code>{command}</code></p>
{body}
<p class="{style}">{ending}</p>{again}
</body></html>
"""


def _html(report: Report) -> str:
    body = []
    for title, header, rows, remarks in _tables(report):
        body.append(f"<h2>{escape(title)}</h2><table><tr>{''.join(f'<th>{escape(h)}</th>' for h in header)}</tr>")
        for row in rows:
            cells = "".join(f"<td{' class=bad' if '✗' in entry else ''}>{escape(entry)}</td>" for entry in row)
            body.append(f"<tr>{cells}</tr>")
        body.append("</table>")
        if remarks:
            body.append(f"<ul>{''.join(f'<li>{escape(remark)}</li>' for remark in remarks)}</ul>")
    again = report.reproduce()
    return _PAGE.format(
        verdict="passed" if report.passed else "FAILED", style="good" if report.passed else "bad",
        command=escape(report.command), body="\n".join(body), ending=escape(_ending(report)),
        again=f"<p>The worst case again: <code>{escape(again)}</code></p>" if again else "",
    )  # fmt: skip
