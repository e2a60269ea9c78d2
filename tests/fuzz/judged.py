"""What is clean: a scenario file goes through the command line, and what comes out is looked at.

Clean is a refusal in one printable line (exit status 2), or a run that ended (0) or said that it stopped (3, one line):
its summary.json and its output are strict JSON, all of its columns are numbers, and the scenario that its file carries
has the values that were asked for.
"""

from __future__ import annotations

import contextlib
import io
import json
import math
import tempfile
import traceback
import warnings
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from scenario_cases import Case

LONGEST_LINE = 1000  # characters: more is not read
REFUSED, RAN, STOPPED, FAULTY = "refused", "ran", "stopped", "FAULTY"
BY_STATUS = {0: RAN, 2: REFUSED, 3: STOPPED}


def judge(case: Case) -> tuple[str, str]:
    """Return one of the outcomes above, and the line on standard error or what is not clean."""
    out, err = io.StringIO(), io.StringIO()
    with (
        tempfile.TemporaryDirectory() as folder,
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
        warnings.catch_warnings(record=True) as warned,
    ):
        warnings.simplefilter("always")
        file = Path(folder, "fuzz.toml")
        file.write_text(case.text(), encoding="utf-8", newline="")
        try:
            from closedloop.run import main

            status = main([str(file), "--out", folder, "--no-figures", "--json"])
            problem = _problem(case, status, out.getvalue(), err.getvalue(), Path(folder))
        except BaseException as error:  # whatever comes out of the command line is what is being looked for
            where = traceback.extract_tb(error.__traceback__)[-1]
            return FAULTY, f"{type(error).__name__}: {str(error)[:200]} ({Path(where.filename).name}:{where.lineno})"
    if warned:
        problem = problem or f"warned: {warned[0].category.__name__}: {warned[0].message}"
    return (FAULTY, problem) if problem else (BY_STATUS[status], err.getvalue().strip())


def _problem(case: Case, status: int, out: str, err: str, folder: Path) -> str:
    """Return what is not clean, or ""."""
    if status not in BY_STATUS:
        return f"exit status {status}"
    said = [line for line in err.split("\n") if line and not line.startswith("compiling the step")]
    if len(said) != (status != 0):
        return f"{len(said)} lines on standard error: {said[:2]}"
    if said and not (said[0].isprintable() and len(said[0]) <= LONGEST_LINE):
        return f"no printable line of fewer than {LONGEST_LINE} characters: {said[0][:200]!a}"
    if status == 2:
        return f"refused, but wrote {out[:100]!r}" if out else ""
    return _of_run(case, out, folder)


def _of_run(case: Case, out: str, folder: Path) -> str:
    from closedloop.runfile import load_run
    from closedloop.scenario import load_scenario

    for text in (out, Path(folder, "summary.json").read_text(encoding="utf-8")):
        try:
            json.loads(text, parse_constant=_refuse)
        except ValueError as error:
            return f"not strict JSON: {error}"
    run = load_run(Path(folder, "run.nc"))
    for name, column in run.columns.items():
        if not np.all(np.isfinite(column)):
            return f"column {name} is not finite"
    if run.scenario != load_scenario(Path(folder, "fuzz.toml")):
        return "the scenario in run.nc is another"
    for key, value in case.asked.items():
        got: Any = run.scenario
        for part in key.split("."):
            got = getattr(got, part, None)
        if not same(value, got):
            return f"{key} = {str(value)[:60]!r} was asked for, and is {str(got)[:60]!r}"
    return ""


def _refuse(constant: str) -> NoReturn:
    raise ValueError(f"has {constant}")


def same(asked: Any, got: Any) -> bool:
    """Whether a value of a scenario is the one that the file has."""
    if isinstance(asked, dict):
        return all(same(value, got.get(key) if isinstance(got, dict) else getattr(got, key, None))
                   for key, value in asked.items())  # fmt: skip
    if isinstance(asked, list):
        return isinstance(got, tuple) and len(asked) == len(got) and all(map(same, asked, got))
    if isinstance(asked, bool) or isinstance(got, (bool, str)):
        return type(asked) is type(got) and asked == got
    return isinstance(got, (int, float)) and (asked == got or (isinstance(got, float) and float(asked) == got)) and (
        math.isfinite(got)
    )  # fmt: skip
