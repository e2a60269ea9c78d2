"""Headers and rows of the harness's tables, as text: of a robot's comparison, and of a section of checks."""

import math
from dataclasses import dataclass, field

from validation.cells import Cell, Comparison
from validation.truth import QUANTITIES

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


def _engines(comparison: Comparison) -> list[str]:
    return list(dict.fromkeys(cell.engine for cell in comparison.cells))


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


def _cell_text(cell: Cell) -> str:
    if cell.status in SHORT:
        return SHORT[cell.status]
    return f"{cell.relative:.0e} {MARKS[cell.status]}"


def grid(c: Comparison) -> tuple[list[str], list[list[str]], list[str]]:
    """Return header, rows and remarks of one robot's table: quantity by engine, worst relative error."""
    engines = _engines(c)
    at = {(cell.quantity, cell.engine): cell for cell in c.cells}
    rows = []
    for quantity in QUANTITIES:
        cells = [at[quantity, engine] for engine in engines]
        bounds = [cell.tolerance for cell in cells if math.isfinite(cell.tolerance)]
        lowest, highest = (f"{f(bounds):.0e}" if bounds else "" for f in (min, max))
        rows.append([quantity, *map(_cell_text, cells), lowest if lowest == highest else f"{lowest} … {highest}"])
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
