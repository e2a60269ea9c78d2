"""The command ``closedloop tune wam_slide --vary law.kd=5:200 --minimise rms_force_error``: gains by an optimiser.

Exit status: 0 done; 2 the input is at fault; 3 no point that was tried meets the constraints.
"""

from closedloop.base.errors import ScenarioError
from closedloop.base.files import made_folder, what_was_written, write_whole
from closedloop.command.border import DONE, STOPPED, Parser, as_command, parsed, print_outcome


@as_command()
def main(words: list[str]) -> int:
    """Run the command line and return the exit status."""
    from closedloop.scenario.load import load_scenario
    from closedloop.studies.sweep.sweep import parse_axis, parse_range

    options, overrides = parsed(_parser(), words)
    if not options.vary:
        raise ScenarioError("command line: name what varies, such as --vary law.kd=5:200")
    scenario = load_scenario(options.scenario, overrides)
    ranges = [parse_range(text, "5:200 or log:1:1000") for text in options.vary]
    folder = made_folder(options.out) if options.out else None
    from closedloop.studies.tune.tune import tune

    found = {}
    for text in options.minimise or ["rms_force_error"]:
        weight, times, name = text.rpartition("*")
        try:
            found[name.strip()] = float(weight) if times else 1.0
        except ValueError:
            raise ScenarioError(
                f"--minimise {text}: must be a value, or WEIGHT*VALUE, such as 0.1*max_tip_speed"
            ) from None
    over = {axis.key: [axis.at(i) for i in range(len(axis))] for axis in map(parse_axis, options.over)}
    tuning = tune(
        scenario, {axis.key: (axis.low, axis.high) for axis in ranges}, found, options.subject_to,
        over=over, robust=options.robust, log=[axis.key for axis in ranges if axis.log],
        starts=options.starts, seed=options.seed, kept=folder / "runs.jsonl" if folder else None, progress=True,
    )  # fmt: skip
    report = print_outcome(tuning, options.json)
    if folder is not None:
        from closedloop.figures.files import write_figure

        head = "# " + "\n# ".join(tuning.lines()[:1]) + "\n"
        paths = [
            write_whole(folder / "tuned.toml", (head + tuning.scenario.to_toml()).encode()),
            write_whole(folder / "tune.json", (report + "\n").encode()),
            write_figure(tuning.figure(), folder / "tune"),
        ]
        if not options.json:
            print(what_was_written(*paths))
    return DONE if tuning.feasible else STOPPED


def _parser() -> Parser:
    parser = Parser(
        prog="closedloop tune",
        description="Find the gains, or other numbers of a scenario, that minimise a value of its runs.",
        cure="such as: closedloop tune wam_slide --vary law.kd=5:200 --minimise rms_force_error",
    )
    parser.add_argument("scenario", help="a scenario that ships, or a .toml; --SECTION.KEY VALUE changes it")
    vary = "what varies and its range, such as law.kd=5:200, law.kp[1]=log:100:3000; of a list each entry by itself"
    parser.options({"--vary KEY=LOW:HIGH ...": vary})
    parser.add_argument(
        "--minimise", "--minimize", action="append", default=[], metavar="[WEIGHT*]NAME",
        help="a value of the summary (default: rms_force_error); given several times, the weighted sum",
    )  # fmt: skip
    parser.add_argument(
        "--robust", choices=("worst", "mean"), default="worst", help="minimise the worst or the mean of all variations"
    )
    table = {
        "--subject-to NAME<=NUMBER ...": "a constraint, such as 'peak_contact_force<=12' or 'modulus_margin@3>=0.5'",
        "--over KEY=VALUES ...": "variations under which constraints hold, such as friction.coefficient=0.2,0.4,0.6",
        "--starts N": "searches from different points (4)",
        "--seed N": "seed of these points (0)",
        "--out DIR": "where tuned.toml, tune.json and a figure go; an interrupted tuning continues from its runs.jsonl",
        "--json": "print the report as JSON",
    }
    parser.options(table, starts=4, seed=0)
    return parser
