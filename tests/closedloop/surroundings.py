"""Surroundings in which every command must behave: see `test_environments`, which runs them.

A case is a shell's line, run in a folder of its own. `{run}`, `{sweep}`, `{study}` and `{validation}` are the commands,
SHORT a run of ten steps at rest: a path would take longer than they do. The kernels are interpreted. Cases that stand
for their kind belong to the quick suite.
"""

import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import zip_longest
from pathlib import Path

import closedloop as cl

ROOT = Path(cl.__file__).parent.parent
COMMANDS = {
    "run": f'"{sys.executable}" -m closedloop.run',
    "sweep": f'"{sys.executable}" -m closedloop.command.sweep',
    "study": f'"{sys.executable}" -m validation.studies',
    "validation": f'"{sys.executable}" -m validation.run',
}
SHORT = "{run} planar2_slide --reference.kind hold --time.duration 0.01 --out r --no-figures"
DRAWN = "{run} planar2_slide --reference.kind hold --time.duration 0.01 --out r"
SWEPT = (
    "{sweep} planar2_slide --reference.kind hold --time.duration 0.01 --over law.force=1:2:2 --engine pinocchio "
    "--out r/t.parquet"
)
# A process that root's right to pass over permissions has been taken from.
UNPRIVILEGED = "setpriv --inh-caps=-all --bounding-set=-dac_override,-dac_read_search"
NO_SPACE = "standard output: cannot be written: No space left on device"


@dataclass(frozen=True)
class Case:
    """One command in one surrounding.

    Attributes
    ----------
    name : str
    line : str
        The command.
    where : str
        Redirections of it, and what reads it.
    env : dict
        Variables; None: not set.
    status : int
    says : str
        Pattern of the one line on standard error; none with "".
    before : str
        What the shell does before.
    check : callable
        Of the folder and the standard output.
    quick : bool
        Part of the quick suite.
    """

    name: str
    line: str
    where: str = ""
    env: dict[str, str | None] = field(default_factory=dict)
    status: int = 0
    says: str = ""
    before: str = ":"
    check: Callable[[Path, str], None] = lambda folder, out: None
    quick: bool = False


def saved(folder, out):
    """The run is there and whole."""
    assert len(cl.load_run(folder / "r" / "run.nc")) == 11


def drawn(folder, out):
    """The figures are there."""
    assert (folder / "r" / "fig_contact_force.png").stat().st_size > 10_000


def helpful(folder, out):
    """The page is there, to its last line."""
    assert "exit status" in out


C_LOCALE = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
PLANT = "for m in numpy json argparse scipy pydantic; do echo 'raise RuntimeError(\"not ours\")' >$m.py; done"
PLANT_FOLDERS = (
    "mkdir robot_models closedloop; echo 'raise RuntimeError' >robot_models/__init__.py; echo mine >closedloop/results"
)
LAW = "printf 'import numpy as np\\ndef f(t, q, v, terms):\\n    return terms.bias\\n' >mine.py"
GONE = "mkdir gone; cd gone; rmdir ../gone"


def one_of_ours(text):
    """A pattern of one line of a command."""
    return rf"(closedloop|closedloop \w+|validation): {text}"


ENCODINGS = [
    Case("C locale, help", "{run} --help stabiliser", env=C_LOCALE, quick=True),
    Case("C locale, run", SHORT, env=C_LOCALE, check=saved),
    Case("utf-16, help", "{run} --help", env={"PYTHONIOENCODING": "utf-16"}),
    Case("refusal in ascii", "{run} wam_slide --law.force ζ", env={"PYTHONIOENCODING": "ascii"}, status=2,
         says=one_of_ours(r"wam_slide: law.force = '\\u03b6': .*")),
    Case("bytes that are no text", "{run} $(printf 'a\\377b')", status=2, says=one_of_ours("no scenario named.*")),
    Case("Greek file in the C locale", "{run} μ.toml", env=C_LOCALE, status=2, says=one_of_ours(".*No such file.*")),
    Case("Greek folder in the C locale", SHORT.replace("--out r", "--out μ"), env=C_LOCALE),
]  # fmt: skip
OUTPUTS = [
    Case("| true", "{run} --list", "| true", quick=True),
    Case("json | head -1", f"{SHORT} --json", "| head -1", check=saved),
    Case("list to a full device", "{run} --list", ">/dev/full", status=2, says=one_of_ours(NO_SPACE), quick=True),
    Case("run to a full device", SHORT, ">/dev/full", status=2, says=one_of_ours(NO_SPACE), check=saved),
    Case("sweep to a full device", SWEPT, ">/dev/full", status=2, says=one_of_ours(NO_SPACE)),
    Case("output closed", SHORT, ">&-", check=saved),
]  # fmt: skip
FOLDERS = [
    Case("folder deleted, list", "{run} --list", before=GONE),
    Case("folder deleted, run", SHORT, before=GONE, status=2, says=one_of_ours("--out 'r': cannot be written.*")),
    Case("folder deleted, out elsewhere, no such backend", DRAWN.replace("--out r", '--out "$OLDPWD/r"'), before=GONE,
         env={"MPLBACKEND": "nosuch"}, check=drawn),
    Case("folder deleted, law", f"{SHORT} --law mine:f", before=GONE, status=2, says=one_of_ours(".*no module.*")),
    Case("folder deleted, study", "{study} drift", before=GONE, status=2, says=one_of_ours("--out .*be written.*")),
    Case("folder read-only", f"{UNPRIVILEGED} {SHORT}", before="chmod 500 .", status=2,
         says=one_of_ours("--out 'r': cannot be written: Permission denied.*")),
    Case("modules of the same name here", SHORT, before=f"{PLANT}; {PLANT_FOLDERS}", check=saved, quick=True),
    Case("modules of the same name, law", f"{SHORT} --law mine:f --json", before=f"{PLANT}; {PLANT_FOLDERS}; {LAW}",
         check=saved),
]  # fmt: skip
# Variables of which none undoes another share a process, which takes longer to start than to run.
TERMINALS: list[dict[str, str | None]] = [
    {"TERM": "dumb", "NO_COLOR": "1", "COLUMNS": "1"}, {"TERM": "nosuch", "FORCE_COLOR": "1", "COLUMNS": "0"},
    {"TERM": None, "COLUMNS": "-5", "LINES": "0"}, {"COLUMNS": "wide"}, {"COLUMNS": "1000000"},
]  # fmt: skip
PYTHONS: list[dict[str, str | None]] = [
    {"PYTHONOPTIMIZE": "1", "PYTHONHASHSEED": "0", "PYTHONDONTWRITEBYTECODE": "1", "PYTHONSAFEPATH": "1"},
    {"PYTHONOPTIMIZE": "2", "PYTHONHASHSEED": "4294967295", "PYTHONPATH": f"{ROOT}:/proc/nowhere"},
    {"PYTHONFAULTHANDLER": "1", "PYTHONMALLOC": "debug", "PYTHONWARNINGS": "error"},
    {"PYTHONINTMAXSTRDIGITS": "640", "PYTHONUTF8": "1", "PYTHONPATH": f"{ROOT}:", "PYTHONWARNINGS": "ignore"},
]
OTHERS: list[dict[str, str | None]] = [
    {"TZ": "No/Where", "NUMBA_CACHE_DIR": "/dev/null", "SHELL": ""},
    {"TZ": "", "NUMBA_CACHE_DIR": "/proc/nowhere", "LANGUAGE": "el:zh"},
    {"LC_NUMERIC": "de_DE.UTF-8", "NUMBA_CACHE_DIR": "relative", "PATH": ""},
    {"NUMBA_CACHE_DIR": "", "NUMBA_NUM_THREADS": "1", "USER": None, "LOGNAME": None},
]
PLACES: list[dict[str, str | None]] = [  # those of texts and files
    {"HOME": "/proc/nowhere", "MPLCONFIGDIR": None}, {"TMPDIR": "/proc/nowhere", "PYTHONIOENCODING": "cp1252"},
    {"PYTHONIOENCODING": "ascii"}, {"PYTHONIOENCODING": "utf-16"}, {"LC_ALL": "nosuch", "LANG": "nosuch"},
]  # fmt: skip
VARIABLES = [
    Case("settings of matplotlib here, no folder for it, a backend without a screen, warnings are errors", DRAWN,
         before="echo 'backend: nosuch' >matplotlibrc", check=drawn,
         env={"MPLBACKEND": "TkAgg", "DISPLAY": None, "PYTHONWARNINGS": "error", "MPLCONFIGDIR": "/proc/nowhere"}),
    *(
        Case(" ".join(f"{key}={value}" for key, value in env.items()), SHORT, env=env, check=saved)
        for env in [terminal | python | other | place for terminal, python, other, place in zip_longest(
            TERMINALS, PYTHONS, OTHERS, PLACES, fillvalue={})]
    ),
    Case("help without docstrings, one column", "{run} --help", env={"PYTHONOPTIMIZE": "2", "COLUMNS": "1"},
         check=helpful),
    Case("sweep without docstrings, C locale, warnings are errors", SWEPT,
         env={**C_LOCALE, "PYTHONOPTIMIZE": "2", "PYTHONWARNINGS": "error"}),
    Case("validation, C locale, warnings are errors", "{validation} --help", check=helpful,
         env={**C_LOCALE, "PYTHONWARNINGS": "error"}),
]  # fmt: skip
FILES = [
    Case("scenario with a byte order mark", "{run} bom.toml --time.duration 0.01 --out r --no-figures", check=saved,
         before="printf '\\357\\273\\277' >bom.toml; "
                f"cat '{ROOT}/closedloop/scenario/shipped/planar2_slide.toml' >>bom.toml"),
    Case("scenario in UTF-16", "{run} wide.toml", status=2, says=one_of_ours("wide.toml: is not UTF-8 text.*"),
         before="printf '\\377\\376[\\000' >wide.toml"),
    Case("few files may be open", "{run} --list", before="ulimit -n 24"),
    Case("no file may grow", f"(ulimit -f 0; {SHORT})", status=2,
         says=one_of_ours("r/.*: cannot be written: File too.*")),
]  # fmt: skip
CASES = [*ENCODINGS, *OUTPUTS, *FOLDERS, *VARIABLES, *FILES]
