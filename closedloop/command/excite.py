"""The command ``closedloop excite --robot NAME|FILE``: a motion within limits that identifies parameters best."""

from closedloop.base.errors import ModelError, printable
from closedloop.command.border import DONE, Parser, as_command


@as_command()
def main(words: list[str]) -> int:
    """Run the command line and return the exit status."""
    options = _parser().parse_args(words)
    from closedloop.base.errors import needs
    from closedloop.base.files import made_folder, what_was_written, write_whole
    from closedloop.studies.identify.excite import excite

    needs("pandas")  # which writes the motion, once it has been found
    folder = made_folder(options.out)
    found = excite(
        options.robot, [name.strip() for name in options.target.split(",") if name.strip()],
        duration=options.duration, harmonics=options.harmonics, rate=options.rate,
        noise=_numbers(options.noise, "--noise"), acceleration=_numbers(options.acceleration, "--acceleration"),
        share=options.share, seed=options.seed,
    )  # fmt: skip
    print("\n".join(map(printable, found.lines())))
    write_whole(folder / "excitation.csv", found.to_pandas().to_csv(index=False).encode())
    write_whole(folder / "report.txt", ("\n".join(found.lines()) + "\n").encode())
    print("\n" + what_was_written("excitation.csv", "report.txt", folder=folder))
    return DONE


def _parser() -> Parser:
    parser = Parser(
        prog="closedloop excite",
        description="Design a motion of all joints, within their limits and from rest to rest, from whose log "
        "parameters can be identified best, and print half of the 95 % interval of each base parameter.",
        cure="such as: closedloop excite --robot ur10 --for dry_shoulder_pan_joint",
    )
    parser.add_argument("--robot", required=True, metavar="NAME|FILE", help="a robot, a URDF or an MJCF")
    parser.add_argument("--for", dest="target", default="", metavar="P,...", help="base parameters (default: all)")
    table = {
        "--duration S": "duration of the motion, s (default: 10)",
        "--harmonics N": "harmonics of its Fourier series (default: 5)",
        "--rate HZ": "sampling rate of the log (default: 100)",
        "--noise N,...": "noise of the torques, N m, one or one for each joint (default: a hundredth of the effort "
        "limit)",
        "--acceleration A,...": "largest acceleration, rad/s², one or one for each joint (default: top speed in "
        "0.25 s)",
    }
    parser.options(table, duration=10.0, harmonics=5, rate=100.0)
    parser.add_argument("--share", type=float, default=0.9, help="share of the limits that is used (default: 0.9)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the initial motions of the search")
    parser.add_argument("--out", metavar="DIR", default="out/excite", help="where results go (default: out/excite)")
    return parser


def _numbers(text: str | None, what: str) -> list[float] | float | None:
    """Read numbers with commas between."""
    if text is None:
        return None
    try:
        read = [float(word) for word in text.split(",")]
    except ValueError:
        raise ModelError(f"{what} {text!r}: must be a number, or one for each joint with commas between") from None
    return read[0] if len(read) == 1 else read
