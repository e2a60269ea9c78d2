"""The command: ``python -m validation.speed``. Exit status: 0 measured, whatever came out; 2 bad input."""

import json
import sys
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from closedloop.base.errors import OutputError
from closedloop.base.files import write_whole
from closedloop.command.border import Parser, as_command
from validation.run import InputError, say
from validation.speed.contestants import ARMS, Contestant, slide
from validation.speed.loops import MECHANISMS
from validation.speed.scenes import SCENES

INSTALL = 'not installed: pip install "closedloop[peers]"'
KNOWN = (*ARMS, *MECHANISMS, *SCENES)
# Drake takes so much longer that a tenth of the steps is enough.
DRAKE_SHARE = 10
# Nothing is set up for each, so a few are as good as many.
MOST_ROLLOUTS = 16


@as_command("validation.speed", stopped=())
def main(words: list[str]) -> int:
    """Measure, print the tables, and write JSON if asked."""
    options = _parser().parse_args(words)
    for name in ("repeats", "steps", "runs"):
        if getattr(options, name) is not None and getattr(options, name) < 1:
            raise InputError(f"--{name} {getattr(options, name)}: must be at least 1")
    unknown = [arm for arm in options.arms if arm not in KNOWN]
    if unknown:
        raise InputError(f"--arms {unknown[0]}: must be of {', '.join(KNOWN)}")
    file = Path(options.json) if options.json else None
    if file and (not file.parent.is_dir() or file.is_dir()):
        raise InputError(f"--json {file}: cannot be written: name a file in a folder that exists")
    data = measure(
        arms=options.arms,
        steps=options.steps or (500 if options.quick else 4000),
        repeats=options.repeats or (3 if options.quick else 15),
        runs=options.runs or (16 if options.quick else 256),
        cold=not (options.quick or options.no_cold_start),
    )
    from validation.speed.measure import show

    show(data)
    if file:
        try:
            write_whole(file, (json.dumps(data, indent=2, allow_nan=False) + "\n").encode())
        except OutputError as error:
            raise InputError(f"--json {error}") from None
    return 0


def _parser() -> Parser:
    parser = Parser(
        prog="python -m validation.speed",
        description="Measure a step of our engines beside peers that do the same work; the method is docs/speed.md.",
    )
    parser.add_argument("--quick", action="store_true", help="few steps and laps, no cold start: rough numbers")
    parser.add_argument("--repeats", type=int, help="laps of each contestant, in turns (default 15; 3 with --quick)")
    parser.add_argument("--steps", type=int, help="steps of a lap (default 4000; 500 with --quick)")
    parser.add_argument("--runs", type=int, help="runs of a batch (default 256; 16 with --quick)")
    parser.add_argument("--arms", nargs="+", default=[*KNOWN], metavar="ARM", help=f"of {', '.join(KNOWN)}")
    parser.add_argument("--no-cold-start", action="store_true", help="leave out the start of whole processes")
    parser.add_argument("--json", metavar="FILE", help="write every value")
    return parser


def line_up(arms: Sequence[str], steps: int, runs: int) -> tuple[list[Contestant], dict[str, str]]:
    """Return everyone who races, and why the others do not."""
    from validation.speed import contestants, loops, repeated, scenes

    there = {name: find_spec(module) is not None for name, module in (("mujoco", "mujoco"), ("drake", "pydrake"))}
    missing = {name: INSTALL for name, found in there.items() if not found}
    everyone: list[Contestant] = [repeated.arithmetic(threads) for threads in (1, 2)]
    for arm in arms:
        say(f"preparing {arm}")
        if arm not in ARMS:
            everyone += (loops if arm in MECHANISMS else scenes).racing(arm, there["mujoco"])
            continue
        problem = slide(arm, steps)
        racing = [contestants.our_engine(arm, problem, "compiled")]
        if arm == "wam4":
            racing.append(repeated.in_lanes(arm, problem))
        racing += [
            contestants.our_engine(arm, problem, "pinocchio"),
            contestants.bare_calls(arm, problem),
            contestants.bare_algorithms(arm, problem),
            contestants.pinocchio_loop(arm, problem),
        ]
        if there["mujoco"]:
            racing.append(contestants.driven(arm, problem))
            racing += [contestants.bare(arm, problem, exact) for exact in (False, True)]
        everyone += contestants.with_errors(racing, problem)
        everyone += [contestants.composite_bodies(arm, problem), contestants.newton_euler_columns(arm, problem)]
        if there["drake"]:
            shorter = slide(arm, max(1, steps // DRAKE_SHARE))
            everyone += contestants.with_errors([contestants.drake_loop(arm, shorter)], shorter)
        if arm == "wam4":
            everyone.append(contestants.user_law(arm, problem))
            everyone += repeated.racing(arm, problem) + repeated.with_events(arm)
            whole = slide(arm, 2 * steps)  # by default as long as `wam_slide`
            everyone += contestants.whole_call(arm, whole)
            everyone += repeated.from_elsewhere(arm, problem) + repeated.with_other_values(arm, problem)
            everyone += repeated.episodes(arm)
            everyone += [repeated.compiled_batch(arm, whole, runs, threads) for threads in (1, 2)]
            if there["mujoco"]:
                most = min(runs, MOST_ROLLOUTS)
                everyone += [contestants.rollout(arm, problem, most, threads) for threads in (1, 2)]
    return everyone, missing


def measure(*, arms: Sequence[str], steps: int, repeats: int, runs: int, cold: bool) -> dict[str, Any]:
    """Measure everything and return it as it goes into the JSON file."""
    from validation.speed.measure import as_data, race, ratio, targets
    from validation.speed.repeated import first_result, first_result_ever

    everyone, missing = line_up(arms, steps, runs)
    timings = race(everyone, repeats, say)
    two = ratio(timings["machine", "arithmetic_1"], timings["machine", "arithmetic_2"], wall=True)
    starts: dict[str, float] = {}
    if cold:
        for engine in ("compiled", "pinocchio"):
            say(f"starting cold with the {engine} engine")
            starts[f"{engine} engine, compiled before"] = first_result(engine, 3)
            starts[f"{engine} engine, nothing compiled"] = first_result_ever(engine)
    more = {"repeats": repeats, "cold_start_seconds": starts, "missing": missing, "two_threads": two}
    return as_data(timings, targets(timings), more)


if __name__ == "__main__":
    sys.exit(main())
