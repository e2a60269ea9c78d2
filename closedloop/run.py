"""The command line: ``python -m closedloop.run wam_slide``.

Exit status: 0 done; 2 the input is at fault (one line on standard error); 3 the simulation could not go on (what ran
until then is saved, and the line says when and why).
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import sys
import tomllib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NoReturn

from closedloop.errors import ClosedLoopError, OutputError, ScenarioError, SimulationError, one_line
from closedloop.scenario import Scenario, load_scenario, parse_scenario, shipped_scenarios

DONE, BAD_INPUT, STOPPED = 0, 2, 3


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise ScenarioError(f"command line: {message}; a key of the scenario is set as --law.force 15; see --help")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit status."""
    try:
        return _main(sys.argv[1:] if arguments is None else list(arguments))
    except ClosedLoopError as error:
        print(f"closedloop: {one_line(str(error))}", file=sys.stderr)
        return STOPPED if isinstance(error, SimulationError) else BAD_INPUT
    except BrokenPipeError:  # the reader of our output has gone: `... --list | head -1`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return DONE


def _main(arguments: list[str]) -> int:
    overrides, rest = split_overrides(arguments)
    options = _parser().parse_args(rest)
    if options.version:
        from closedloop.simulation import package_versions

        print(", ".join(f"{name} {version}" for name, version in package_versions().items()))
        return DONE
    if options.list:
        _list()
        return DONE
    if options.scenario is None:
        raise ScenarioError(
            "command line: name a scenario, such as wam_slide, wam_touchdown or panda_slide; --list lists them"
        )
    scenario, model, recorded_law = _open(options.scenario, overrides)
    law = _import_law(options.law) if options.law else None
    if law is None and recorded_law != "scenario":
        raise ScenarioError(
            f"{options.scenario}: was made with the law {recorded_law}, which a run file does not carry; "
            "add --law MODULE:FUNCTION"
        )

    folder = Path(options.out) if options.out else Path("out") / scenario.name
    _make_writable(folder)
    from closedloop.preparation import load_model
    from closedloop.simulation import check_engine, simulate

    check_engine(scenario, options.engine, law)
    announce_compiling(scenario, (load_model(scenario) if model is None else model).n, options.engine)
    failure: SimulationError | None = None
    try:
        run = simulate(scenario, law=law, model=model, progress=not options.json, engine=options.engine)
    except SimulationError as error:
        if error.run is None:
            raise
        run, failure = error.run, error
    if options.law:
        run = replace(run, law=options.law)
    paths = [run.save(folder / "run.nc"), _write_summary(run.summary(), folder / "summary.json")]
    if not options.no_figures:
        from closedloop.figures import draw_figures

        paths += draw_figures(
            run, folder, None if failure else _without_stabiliser(scenario, law, model, options.engine)
        )
    if options.json:
        print(json.dumps(run.summary(), indent=2, allow_nan=False))
    else:
        from closedloop.report import print_report

        print_report(run)
        steps = max(0, len(run) - 1)
        print(f"{steps} steps in {run.wall_seconds:.2g} s; wrote {folder}{os.sep}: {', '.join(p.name for p in paths)}")
    if failure:
        raise failure
    return DONE


def _parser() -> argparse.ArgumentParser:
    from closedloop.explain import describe_keys

    keys = "\n".join(f"  --{key} VALUE\n        {what}" for key, what in describe_keys())
    parser = _Parser(
        prog="closedloop",
        description="Simulate a robot arm whose tip is in contact with a surface.",
        epilog="Any key of the scenario can be set, with a value as in TOML (lists in quotes):\n" + keys
        + "\n\nexit status: 0 done; 2 the input is at fault; 3 the simulation could not go on (what ran is saved)",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )  # fmt: skip
    parser.add_argument(
        "scenario",
        nargs="?",
        help="a shipped name (--list), a .toml file, or a run.nc to be repeated from itself alone",
    )
    parser.add_argument("--version", action="store_true", help="print the versions that a run depends on and stop")
    parser.add_argument("--list", action="store_true", help="list the shipped scenarios and stop")
    parser.add_argument("--out", metavar="DIR", help="where results go (default: out/SCENARIO)")
    parser.add_argument("--no-figures", action="store_true", help="write run.nc and summary.json only")
    parser.add_argument("--json", action="store_true", help="print the summary as JSON instead of tables")
    parser.add_argument(
        "--engine",
        choices=("pinocchio", "compiled"),
        default="pinocchio",
        help="who computes H, C, r, J and its drift: Pinocchio (default), or the package's own compiled terms",
    )
    parser.add_argument(
        "--law",
        metavar="MODULE:FUNCTION",
        help="use this function law(t, q, v, terms) -> Q as the control law",
    )
    return parser


def _list() -> None:
    names = shipped_scenarios()
    width = max(map(len, names))
    for name in names:
        print(f"{name:{width}}  {load_scenario(name).description}")


def split_overrides(arguments: list[str]) -> tuple[dict[str, Any], list[str]]:
    """Take --SECTION.KEY VALUE and --SECTION.KEY=VALUE out of the arguments; return them as overrides, and the rest."""
    overrides: dict[str, Any] = {}
    rest: list[str] = []
    words = iter(arguments)
    for word in words:
        key, equals, value = word.removeprefix("--").partition("=")
        if not word.startswith("--") or "." not in key:
            rest.append(word)
            continue
        if not equals:
            value = next(words, "--")
            if value.startswith("--"):
                raise ScenarioError(f"command line: {word} needs a value, such as --law.force 15")
        overrides[key] = toml_value(value)
    return overrides, rest


def toml_value(text: str) -> Any:
    """Read a value as TOML would; what is not TOML is text, so that --robot.model panda needs no quotes."""
    try:
        document = tomllib.loads(f"value = {text}")
    except (ValueError, RecursionError):  # no TOML, a number of thousands of digits, a thousand brackets
        return text
    return document["value"] if len(document) == 1 else text


def _open(name: str, overrides: dict[str, Any]) -> tuple[Scenario, Any, str]:
    """Return the scenario, the robot if it came from a run file, and the name of the law that made the file."""
    if not name.endswith(".nc"):
        return load_scenario(name, overrides), None, "scenario"
    from closedloop.runfile import load_run

    earlier = load_run(name)
    scenario = parse_scenario(earlier.scenario.to_toml(), where=name, overrides=overrides)
    changed = any(key.startswith("robot.") and key != "robot.tip" for key in overrides)
    return scenario, None if changed else earlier.model, earlier.law


def _import_law(name: str) -> Any:
    module_name, _, function_name = name.partition(":")
    if not (function_name and all(part.isidentifier() for part in module_name.split("."))):
        raise ScenarioError(f"--law {name}: must be MODULE:FUNCTION, such as my_laws:soft_touch")
    sys.path.insert(0, os.getcwd())
    try:
        module = importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        if not f"{module_name}.".startswith(f"{error.name}."):
            raise  # the module is there, and lacks one that it needs itself
        raise ScenarioError(
            f"--law {name}: there is no module '{module_name}' here or among the installed packages"
        ) from None
    law = getattr(module, function_name, None)
    if not callable(law):
        raise ScenarioError(f"--law {name}: '{module_name}' has no function '{function_name}'")
    return law


def _make_writable(folder: Path) -> None:
    """Make the output folder before anything is simulated, so that no result is lost for want of a place."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / f".writable.{os.getpid()}"
        probe.touch()
        probe.unlink()
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise OutputError(f"--out {str(folder)!r}: cannot be written: {reason}; name another folder") from None


def announce_compiling(scenario: Scenario, n: int, engine: str, runs: int = 1) -> None:
    """Say why the first run of an installation takes longer, or the first of so many; n joints, 0: any number."""
    from closedloop.compiled import needs_compiling
    from closedloop.forms import loop_of

    if needs_compiling(loop_of(scenario, engine, n, runs)):
        print("compiling the step (once for this installation, some twenty seconds) ...", file=sys.stderr, flush=True)


def _write_summary(summary: dict[str, Any], path: Path) -> Path:
    try:
        path.write_text(json.dumps(summary, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    except OSError as error:
        raise OutputError(f"{path}: cannot be written: {error.strerror}") from None
    return path


def _without_stabiliser(scenario: Scenario, law: Any, model: Any, engine: str) -> Any:
    """Run the scenario without its stabiliser, for Fig. 7; None if it has none, or cannot do without."""
    from closedloop.simulation import simulate

    if scenario.stabiliser.kind == "none":
        return None
    plain = parse_scenario(scenario.to_toml(), where=scenario.name, overrides={"stabiliser.kind": "none"})
    try:
        return simulate(plain, law=law, model=model, engine=engine)
    except SimulationError:
        return None


if __name__ == "__main__":
    sys.exit(main())
