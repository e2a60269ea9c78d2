"""The pages that follow from the code: scenario reference, columns, commands, and the entries of public names.

Sphinx calls `write` before it reads the pages (`conf.py`).
"""

import io
import os
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import redirect_stdout, suppress
from pathlib import Path
from pkgutil import iter_modules
from types import ModuleType
from unittest.mock import patch

from PIL import Image

import closedloop
from closedloop.command.table import COMMANDS, imported, overview
from closedloop.figures.scene.scene import scene_of
from closedloop.lab.animate import Picture
from closedloop.loop.events.table import EVENT_COLUMNS
from closedloop.record.columns.derived import DERIVED
from closedloop.record.columns.record import ALL_COLUMNS, ARM_COLUMNS, COLUMNS, CONTACT_COLUMNS, OF_CONTACTS
from closedloop.record.report.verdict import names_of
from closedloop.scenario import messages
from closedloop.scenario.tables import table_type

# What each public name is for, in the order of the page; a name that is in none of these is a fault.
API = {
    "From a scenario to a run": (
        "load_scenario shipped_scenarios Scenario simulate halve simulate_batch prepare Problem Run Event load_run "
        "sweep_plot Simulator StepState serve figures lab compare"
    ),
    "Laws and surfaces of your own": "Law LawInput ControlLaw Surface SurfaceMotion Compliance",
    "The robot and the closure": "Robot Terms Plane solve_closure",
    "Identification": "identify identify_contact Log excite compare_log Recording",
    "Stability of the force loop": "linearise",
    "Derivatives and tuning": "gradient gradients sensitivities tune",
    "Errors": (
        "ClosedLoopError ScenarioError ModelError OutputError RunFileError ClusterError SimulationError "
        "SingularClosureError DivergenceError ChatterError PainleveError NoNormalError LawError InterruptedRunError"
    ),
}

# Pictures in a row, and the instant of a picture, as a share of the run.
ACROSS, SHOWN = 3, 0.6
HOME = Path(closedloop.__file__).parent
# Letters for the lengths of the dimensions of columns.
SIZES = {"time": "N", "joint": "n", "axis": "3", "event": "E", "contact": "K", "contact_tangent": "2 K"}
MODELS = {
    "Control laws": "control.laws",
    "Compensations of friction": "control.compensation",
    "Friction": "mechanics.friction.laws",
    "Restitution": "mechanics.impact.laws",
    "Surfaces": "mechanics.surface.kinds",
    "Motions of a surface": "mechanics.surface.motions",
    "Paths": "control.reference.paths",
    "Integrators": "mechanics.integrators",
}


def write(folder: Path, judged: Iterable[str] | None = None) -> None:
    """Write the pages into a folder, with verdicts and pictures of the scenarios `judged`, of all if None.

    One that has not changed is left alone, so that Sphinx need not read it again.
    """
    (folder / "gallery").mkdir(parents=True, exist_ok=True)
    facts = {}
    for name in judged or closedloop.shipped_scenarios():
        run = closedloop.simulate(closedloop.load_scenario(name), progress=False)
        facts[name] = run.summary()
        picture(run).save(folder / "gallery" / f"{name}.png")
    pages = {"scenario": scenario(), "columns": columns(), "commands": commands(), "api": api(), "models": models(),
             "verdicts": verdicts(facts), "gallery": gallery(facts)}  # fmt: skip
    for name, lines in pages.items():
        text, file = "\n".join(lines) + "\n", folder / f"{name}.md"
        if not file.exists() or file.read_text(encoding="utf-8") != text:
            file.write_text(text, encoding="utf-8")


def scenario() -> Iterator[str]:
    """Return the lines of the scenario reference: every section, kind and key."""
    yield from ("# Scenario reference", "")
    yield "All sections and keys of a scenario file. The same texts are printed by `closedloop run --help SECTION` and"
    yield "`closedloop run --explain KEY`. A number beyond its bounds, and a key that is not listed here, is an error."
    for section, text in messages.sections().items():
        head = f"[[{section}]]" if table_type(section) else f"[{section}]"
        yield from ("", f"## {head}", "", f"{sentence(text)}", "")
        kinds = messages.kinds(section)
        if kinds:
            yield from table(("kind", ""), ((f"`{kind}`", told) for kind, told in kinds.items()))
            yield ""
        rows, shared = [], tuple(kinds)
        for key in messages.keys(section):
            facts = messages.facts(key)
            of = "" if key.kinds == shared else ", ".join(f"`{kind}`" for kind in key.kinds)
            value = "; ".join(part for part in (facts["value"], facts["bounds"]) if part)
            row = [f"`{key.name}`", facts["unit"], value, facts["default"], key.field.description or ""]
            rows.append([*row, of] if kinds else row)
        if rows:
            head = ["key", "unit", "value and bounds", "default", "meaning"]
            yield from table([*head, "only in kind"] if kinds else head, rows)


def columns() -> Iterator[str]:
    """Return the lines of the page of columns."""
    yield from ("# Columns and units", "")
    yield "Each column is an attribute of a `Run` and a variable of `run.nc`, with its unit and meaning as attributes."
    yield "Row k of all columns belongs to the state at `time[k]`. A joint that slides has m, m/s, m/s² and N in"
    yield "place of rad, rad/s, rad/s² and N m. N is the number of rows, n of joints, E of events, K of link contacts."
    events = set(EVENT_COLUMNS)
    for title, names in (
        ("By time", [c for c in COLUMNS if c not in events]),
        ("With drives, encoders or elastic joints that are asked for", list(ARM_COLUMNS)),
        ("With contacts of the links, [[contact]]", [*OF_CONTACTS, *CONTACT_COLUMNS]),
        ("Events", [c for c in COLUMNS if c in events]),
    ):
        yield from ("", f"## {title}", "")
        rows = []
        for name in names:
            shape = ", ".join(SIZES[dim] for dim in ALL_COLUMNS[name].dims)
            comma = "," if len(ALL_COLUMNS[name].dims) == 1 else ""
            rows.append((f"`{name}`", f"({shape}{comma})", ALL_COLUMNS[name].units, ALL_COLUMNS[name].meaning))
        yield from table(("column", "shape", "unit", "meaning"), rows)
        if title.startswith("With contacts"):
            yield from ("", "Each contact has them by its name as well: of one called `floor left` they are")
            yield "`link_forces_floor_left` (N,), `link_slips_floor_left_t1` ..., attributes of a run and variables of"
            yield "`run.nc`. The points of one table or shape are attributes only: `run.nc` has them in `link_forces`."
            yield "Where two names would give one label, each has the number of its section behind it, the first 1: of"
            yield "`pad one` and `pad-one`, `pad_one_1` and `pad_one_2`."
    yield from ("", "## States of the law, and columns of your own", "")
    yield "`law_NAME` and `compensation_NAME`, and what `record` asked for: see"
    yield "[columns of your own](../controllers.md#columns-of-your-own)."
    yield from ("", "## Computed from the others", "")
    yield "They are attributes of a run, and columns in CSV and pandas. `run.nc` does not have them; they follow."
    shapes = {
        ("time",): "(N,)",
        ("time", "axis"): "(N, 3)",
        ("time", "component"): "(N, 6)",
        ("time", "joint"): "(N, n)",
    }
    derived = ((f"`{name}`", shapes[each.dims], each.units, each.meaning) for name, each in DERIVED.items())
    yield ""
    yield from table(("column", "shape", "unit", "meaning"), derived)
    yield from (
        "",
        "`run.events` has the same table row by row, as `closedloop.Event`, with the kind as a word.",
    )


def commands() -> Iterator[str]:
    """Return the lines of the page of commands: the overview, and the help of each."""
    yield from ("# Command line", "", "`python -m closedloop` is the same as `closedloop`.", "")
    yield from ("```text", overview(), "```")
    for command in COMMANDS:
        yield from ("", f"## closedloop {command.name}", "", "```text", help_of(command), "```")


def help_of(command) -> str:
    """Return what a command prints with --help, as wide as a page."""
    out = io.StringIO()
    with patch.dict(os.environ, {"COLUMNS": "80", "NO_COLOR": "1"}), redirect_stdout(out), suppress(SystemExit):
        imported(command)(["--help"])
    return out.getvalue().rstrip()


def models() -> Iterator[str]:
    """Return the lines of the page of models: what stands at the top of the file of each that ships."""
    yield from ("# Models and their sources", "")
    yield "Every law, surface, path and integrator of the package is one file. This page has the documentation of each:"
    yield "its equations and their sources."
    for title, package in MODELS.items():
        yield from ("", f"## {title}", "")
        for module in iter_modules([str(HOME / package.replace(".", "/"))]):
            name = f"closedloop.{package}.{module.name}"
            yield from (f"### {module.name}", "", f"`{name}`", "")
            yield from ("```{eval-rst}", f".. automodule:: {name}", "   :no-index:", "```", "")


def verdicts(facts: Mapping[str, dict]) -> Iterator[str]:
    """Return the lines of the page of both verdicts of scenarios, by their names and summaries."""
    yield from ("# Verdicts of the shipped scenarios", "")
    yield "The build runs all scenarios and makes this table; see [the verdicts of a run](../verdict.md). If control is"
    yield "bad, the scenario is meant to show that, as its file says."
    yield ""
    rows = [(f"`{name}`", *verdicts_of(each)) for name, each in facts.items()]
    yield from table(("scenario", "numbers", "control", "what is wrong with the control"), rows)


def gallery(names: Iterable[str]) -> Iterator[str]:
    """Return the lines of the page of pictures, one of each scenario."""
    yield from (
        "# Gallery",
        "",
        "Every scenario of the package, as the build has simulated it. The commands run as they stand.",
    )
    yield from ("", "<!-- pictures -->", "", "|" + " |" * ACROSS, "|" + "---|" * ACROSS)
    cells = []
    for name in names:
        about = sentence(closedloop.load_scenario(name).description)
        cells.append(f"![{escaped(about)}](gallery/{name}.png)<br>`closedloop run {name}`<br>{escaped(about)}")
    for first in range(0, len(cells), ACROSS):
        row = [*cells[first : first + ACROSS], *[""] * ACROSS][:ACROSS]
        yield f"| {' | '.join(row)} |"


def picture(run: closedloop.Run) -> Image.Image:
    """Return a picture of the bodies, forces and paths of a run, at `SHOWN` of its time."""
    pixels = Picture(scene_of(run), None).pixels(round(SHOWN * (len(run) - 1)))
    return Image.fromarray(pixels[..., :3])


def verdicts_of(facts: dict) -> tuple[str, str, str]:
    """Return how a summary judges numbers and control, and why the latter are bad."""
    numbers, control = (names_of(facts[key]["problems"]) for key in ("verdict", "control_verdict"))
    return numbers, control, "; ".join(problem["text"] for problem in facts["control_verdict"]["problems"])


def api() -> Iterator[str]:
    """Return the lines of the page of public names: a directive for each, which Sphinx fills with its docstring."""
    named = [name for names in API.values() for name in names.split()]
    if sorted(named) != closedloop.__all__:
        raise ValueError(f"public names without a place in docs/generate.py: {set(named) ^ set(closedloop.__all__)}")
    yield from ("# Public names", "", "`import closedloop as cl` gives these, each loaded when it is first used.")
    for title, names in API.items():
        yield from ("", f"## {title}", "")
        for name in names.split():
            yield from ("```{eval-rst}", *directive(name), "```", "")


def directive(name: str) -> Iterator[str]:
    """Return the directive of a public name."""
    thing = getattr(closedloop, name)
    if name == "Law":  # a type: its text stands below it in its module
        yield from (".. autodata:: closedloop.simulation.engines.user_law.Law", "   :no-value:")
    elif name == "lab":  # a package that can be called, as this function
        yield ".. autofunction:: closedloop.lab.start.lab"
    elif isinstance(thing, ModuleType):
        yield f".. automodule:: closedloop.{name}"
    elif not isinstance(thing, type):
        yield f".. autofunction:: closedloop.{name}"
    else:
        # What a section of a scenario takes stands in the reference of scenarios.
        yield f".. autoclass:: closedloop.{name}{'()' if hasattr(thing, 'model_fields') else ''}"
        if not issubclass(thing, tuple):  # the parts of a tuple stand in its docstring
            yield from ("   :members:", "   :exclude-members: model_config, n")


def sentence(text: str) -> str:
    """Return a description as a sentence."""
    return f"{text[:1].upper()}{text[1:]}." if text else ""


def table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> Iterator[str]:
    """Return a table in Markdown."""
    head = list(head)
    yield f"| {' | '.join(head)} |"
    yield f"|{'---|' * len(head)}"
    for row in rows:
        cells = (escaped(cell) for cell in row)
        yield f"| {' | '.join(cells)} |"


def escaped(text: str) -> str:
    """Return a text as a cell of a table: but for `code`, what Markdown would take for markup stands as it is."""
    parts = text.split("`")
    for outside in range(0, len(parts), 2):
        parts[outside] = re.sub(r"([\\*_<\[$])", r"\\\1", parts[outside])
    return "`".join(parts).replace("|", "\\|")
