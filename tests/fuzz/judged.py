"""What is clean: a scenario file is loaded and run, and what comes out is looked at.

Clean is a refusal in one printable line (exit status 2), or a run that ended (0) or said that it stopped (3, one line):
its summary is strict JSON, all of its columns are numbers, and its scenario has the values that were asked for, also
when it is written and read again. Most cases are run through `load_scenario` and `simulate`, which is quick; some, and
those with odd texts, through the command line, with its files.
"""

import contextlib
import io
import json
import tempfile
import traceback
import warnings
import zlib
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import tomli_w
from scenario_cases import Case

from closedloop.base.errors import ClosedLoopError, SimulationError, one_line
from closedloop.mechanics.integrators import ADAPTIVE
from closedloop.record.report.verdict import names_of
from closedloop.record.run import Run, load_run
from closedloop.scenario.arm import with_all_entries
from closedloop.scenario.load import load_scenario, parse_scenario, scenario_of
from closedloop.scenario.scenario import Scenario
from closedloop.simulation.simulate import beside_half, simulate

LONGEST_LINE = 1000  # characters: more is not read
FASTEST = 1e4  # rad/s, m/s: what moves faster without having been asked to is nonsense, and must not be called good
FAST = {"start.v", "reference.speed", "surface_motion.velocity", "surface_motion.speed", "surface_motion.frequency"}
REFUSED, RAN, STOPPED, FAULTY = "refused", "ran", "stopped", "FAULTY"
# Of a run and the same at half its step.
HELD, BAD, NO_STEP = "held", "not good", "chooses its steps"
BY_STATUS = {0: RAN, 2: REFUSED, 3: STOPPED}
ONE_IN = 20  # goes through the command line


def judge(case: Case) -> tuple[str, str]:
    """Return one of the outcomes above, and the line that was said or what is not clean."""
    through = by_command_line if chosen(case) else directly
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        file = Path(folder, "fuzz.toml")
        file.write_text(case.text(), encoding="utf-8", newline="")
        for name, content in case.files.items():
            text = content if isinstance(content, str) else tomli_w.dumps(content)
            Path(folder, name).write_text(text, encoding="utf-8")
        try:
            outcome, words = through(case, file)
        except BaseException as error:  # whatever comes out is what is being looked for
            where = traceback.extract_tb(error.__traceback__)[-1]
            return FAULTY, f"{type(error).__name__}: {str(error)[:200]} ({Path(where.filename).name}:{where.lineno})"
    if warned:
        return FAULTY, f"warned: {warned[0].category.__name__}: {warned[0].message}"
    return outcome, words


def chosen(case: Case) -> bool:
    """Whether the case goes through the command line."""
    odd = any(isinstance(value, str) for value in case.asked.values())
    return odd or not case.asked or zlib.crc32(case.name.encode()) % ONE_IN == 0


def directly(case: Case, file: Path) -> tuple[str, str]:
    """Judge a case as a program meets it that uses the package."""
    said, outcome = "", RAN
    try:
        scenario = load_scenario(file)
        run = simulate(scenario)
    except SimulationError as error:
        if error.run is None:
            return FAULTY, f"stopped without a run: {error}"
        run, said, outcome = error.run, f"closedloop: {one_line(str(error))}", STOPPED
    except ClosedLoopError as error:
        said = f"closedloop: {one_line(str(error))}"
        fault = of_line(said)
        return (FAULTY, fault) if fault else (REFUSED, said)
    fault = of_line(said) or of_json(json.dumps(run.summary())) or of_run(run, scenario, case)
    fault = fault or ("" if parse_scenario(scenario.to_toml()) == scenario else "reads back another from its own text")
    return (FAULTY, fault) if fault else (outcome, said)


def judge_halved(case: Case) -> tuple[str, str]:
    """Return `HELD` where a run is good at half the step too, and in the other engine, and by how much f differs, N."""
    try:
        scenario = scenario_of(case.content, "fuzz", {})
        if scenario.time.integrator in ADAPTIVE:
            return NO_STEP, scenario.time.integrator
        run = simulate(scenario, engine="compiled")
    except SimulationError as error:
        return STOPPED, one_line(str(error))
    except ClosedLoopError as error:
        return REFUSED, one_line(str(error))
    problems = run.summary()["verdict"]["problems"]
    if not problems:
        try:
            run = beside_half(run, engine="compiled")
        except ClosedLoopError as error:  # a delay that is no whole number of half steps, or unstable there: none is
            return FAULTY, f"refused at half the step: {error}"
        problems = run.summary()["verdict"]["problems"]
    if problems:
        return BAD, names_of(problems)
    if apart := of_engines(run):
        return FAULTY, apart
    return HELD, f"{run.halved['force'] or 0.0:.3g}"


# Two engines differ by rounding, which a run may amplify: as a share of the largest value of a column, and beside it.
EQUAL, NOTHING = 1e-6, 1e-9


def of_engines(run: Run) -> str:
    """Return by how much a run in the other engine differs, where it is more than rounding."""
    try:
        other = simulate(run.scenario, engine="pinocchio")
    except ClosedLoopError as error:
        return f"not in the other engine: {one_line(str(error))}"
    if problems := other.summary()["verdict"]["problems"]:
        return f"not good in the other engine: {names_of(problems)}"
    apart = {}
    for name in ("q", "v", "torque", "contact_force", "link_forces"):
        if name in run.columns and run.columns[name].size:
            own = run.columns[name]
            off = float(np.max(np.abs(own - other.columns[name])))
            if off > EQUAL * float(np.max(np.abs(own))) + NOTHING:
                apart[name] = f"{off:.3g} (at half the step {run.halved['columns'][name]['max']:.3g})"
    return f"engines differ: {apart}" if apart else ""


# Lines that may stand beside the one that says what became of the command.
BESIDE = ("compiling the step", "closedloop: warning: ")


def by_command_line(case: Case, file: Path) -> tuple[str, str]:
    """Judge a case as a user meets it who types a command."""
    from closedloop.run import main

    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        status = main([str(file), "--out", str(file.parent), "--no-figures", "--json"])
    said = [line for line in err.getvalue().split("\n") if line and not line.startswith(BESIDE)]
    if status not in BY_STATUS:
        return FAULTY, f"exit status {status}"
    # A refused scenario has a line for each of its faults.
    if len(said) != (status != 0) and not (status == 2 and all(line.startswith("closedloop: ") for line in said)):
        return FAULTY, f"{len(said)} lines on standard error: {said[:2]}"
    fault = next(filter(None, map(of_line, said)), "")
    if status == 2:
        fault = fault or (f"refused, but wrote {out.getvalue()[:100]!r}" if out.getvalue() else "")
    else:
        texts = (out.getvalue(), Path(file.parent, "summary.json").read_text(encoding="utf-8"))
        fault = fault or of_json(*texts) or of_run(load_run(file.parent / "run.nc"), load_scenario(file), case)
    return (FAULTY, fault) if fault else (BY_STATUS[status], "".join(said))


def of_line(line: str) -> str:
    """Return what is wrong with a line on standard error, or ""."""
    if (line.isprintable() or not line) and len(line) <= LONGEST_LINE:
        return ""
    return f"no printable line of fewer than {LONGEST_LINE} characters: {line[:200]!a}"


def of_json(*texts: str) -> str:
    """Return what is wrong with JSON, or ""."""
    for text in texts:
        try:
            json.loads(text, parse_constant=_refuse)
        except ValueError as error:
            return f"not strict JSON: {error}"
    return ""


def _refuse(constant: str) -> NoReturn:
    raise ValueError(f"has {constant}")


def of_run(run: Run, scenario: Scenario, case: Case) -> str:
    """Return what is wrong with a run of this scenario, or ""."""
    for name, column in run.columns.items():
        if not np.all(np.isfinite(column)):
            return f"column {name} is not finite"
    fastest = max(np.max(np.abs(run.v), initial=0.0), np.max(np.abs(run.velocity), initial=0.0))
    if run.summary()["verdict"]["good"] and fastest > FASTEST and not case.asked.keys() & FAST:
        return f"good, at {fastest:.3g} rad/s (m/s)"
    if run.scenario != with_all_entries(scenario, run.model):  # zeros for free bodies, of which the law asks nothing
        return "the scenario of the run is another"
    for key, value in case.asked.items():
        got: Any = scenario
        for part in key.split("."):
            got = getattr(got, part, None)
        if not same(value, got) and (key, value) != ("time.integrator", "auto"):  # which becomes what it stands for
            return f"{key} = {str(value)[:60]!r} was asked for, and is {str(got)[:60]!r}"
    return ""


def same(asked: Any, got: Any) -> bool:
    """Whether a value of a scenario is the one that the file has."""
    if isinstance(asked, dict):
        look = got.get if isinstance(got, dict) else lambda key, none: getattr(got, key, none)
        return all(same(value, look(key, None)) for key, value in asked.items())
    if isinstance(asked, list):
        return isinstance(got, tuple) and len(asked) == len(got) and all(map(same, asked, got))
    if isinstance(asked, (bool, str)) or isinstance(got, (bool, str)):
        return type(asked) is type(got) and asked == got
    return isinstance(got, (int, float)) and got == (float(asked) if isinstance(got, float) else asked)
