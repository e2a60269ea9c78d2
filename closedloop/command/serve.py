"""The commands ``closedloop serve SCENARIO`` and ``closedloop lab [SCENARIO]``."""

import os
import sys
import threading
import uuid
from importlib.util import find_spec
from pathlib import Path

from closedloop.base.errors import ScenarioError, SimulationError, printable
from closedloop.base.files import what_was_written
from closedloop.base.interrupts import Terminated
from closedloop.command.border import DONE, Parser, as_command, parsed
from closedloop.command.results import Results, first_free
from closedloop.lab.app import Lab
from closedloop.lab.server import is_loopback
from closedloop.lab.start import NEEDS, lab, open_in_browser
from closedloop.scenario.user_module import import_law, member_digests
from closedloop.serve.serve import INTERFACES, Served, serve
from closedloop.serve.session import Watch

# How long a signal that comes just before the main thread waits stays unanswered at the most, s.
ANSWERED = 0.5


@as_command()
def main(arguments: list[str]) -> int:
    """Serve a scenario until Ctrl-C, save the record, and return the exit status."""
    options, overrides = parsed(_parser(), arguments)
    if options.lab and find_spec("websockets") is None:
        raise ScenarioError(NEEDS)
    served = serve(
        options.scenario, options.interface, overrides=overrides, lock_step=options.lock_step, host=options.host,
        port=options.port, limits=options.limits, say=_say,
    )  # fmt: skip
    try:
        with _results(served, options.out, options.overwrite) as results:
            if not is_loopback(options.host):
                _say(f"warning: --host {options.host} lets every computer that reaches this one drive the simulation")
            return _until_ended(served, results, Watch(served.session) if options.lab else None)
    finally:
        ended_with(served)


def ended_with(served: Served) -> SimulationError | None:
    """End the serving and return why the simulation could not go on, None if it could."""
    try:
        served.close()
    except SimulationError as failure:
        return failure
    return None


def _until_ended(served: Served, results: Results, watch: Watch | None) -> int:
    ports = " and ".join(map(str, served.ports))
    stop: KeyboardInterrupt | None = None
    try:  # who reads these lines may send a signal before `print` has returned
        if watch is not None:
            print(f"the lab shows it at {watch.url}", flush=True)
        print(f"serving on {served.host}, port {ports} (Ctrl-C ends it and saves the run)", flush=True)
        while not served.wait(ANSWERED):
            pass
    except KeyboardInterrupt as came:
        stop = came
    failure = ended_with(served)
    run = served.close() if failure is None else failure.run
    paths = results.save(run, None)
    session = served.session
    share = f", {session.lost} of {session.cycles} cycles without a command" if session.cycles else ""
    late = f", {session.late} instants skipped" if session.late else ""
    beside = results.not_first and printable(f"; {results.not_first}")
    wrote = what_was_written(*paths, folder=results.folder) + beside
    print(f"{max(0, len(run) - 1)} steps served{share}{late}; {wrote}", flush=True)
    if watch is not None:
        watch.finish(run, f"The simulation has ended, and the whole run is shown. It is saved in {results.folder}.")
    if failure is not None:
        raise failure
    if isinstance(stop, Terminated):
        raise stop
    return DONE


def _results(served: Served, out: str | None, overwrite: bool) -> Results:
    """Return where the record goes: without --out into a folder that holds no run yet."""
    from closedloop.record.save import question
    from closedloop.simulation.simulator import FROM_OUTSIDE

    simulator = served.session
    scenario = simulator.problem.scenario
    digest = "" if out else uuid.uuid4().hex  # the record depends on the client: no earlier run is the same
    inputs = question(
        scenario, simulator.problem.robot.model, FROM_OUTSIDE, digest, "pinocchio", member_digests(scenario)
    )
    if out:
        del inputs["law"], inputs["law_digest"]
        return Results(Path(out), inputs, overwrite)
    return first_free(Path("out") / scenario.name, inputs, overwrite)


def _say(line: str) -> None:
    print(f"closedloop: {printable(line)}", file=sys.stderr, flush=True)


def _parser() -> Parser:
    parser = Parser(
        prog="closedloop serve",
        description="Serve a scenario to a controller that is another program: the arm and the surface are simulated, "
        "and it drives them.",
        epilog="Any key of the scenario can be set, as --time.duration 60. Ctrl-C ends it; the run is in "
        f"DIR{os.sep}run.nc.",
        cure="see closedloop serve --help",
    )
    add = parser.add_argument
    add("scenario", metavar="SCENARIO", help="a shipped name or a .toml file")
    add("--as", dest="interface", choices=tuple(INTERFACES), default="json", metavar="INTERFACE",
        help="json: our own messages, JSON or binary (default); franka: the interface of Franka's arms; "
        "ur: the data exchange of Universal Robots' arms")  # fmt: skip
    table = {
        "--lock-step": "time goes on with each command, not with the wall clock",
        "--host HOST": "address to listen on (default: this computer alone)",
        "--port PORT": "first port (default: json any, franka 1337 and 1338, ur 30004)",
        "--limits": "limits and lost commands end a motion as on the real arm (franka)",
        "--lab": "show the run in the browser while it goes on, at an address that is printed",
        "--out DIR": "where the run goes (default: out/SCENARIO, -2 ...)",
        "--overwrite": "replace results of another scenario in that folder",
    }
    parser.options(table, host="127.0.0.1", port=int)
    return parser


@as_command()
def open_lab(arguments: list[str]) -> int:
    """Open the lab, wait for Ctrl-C, and return the exit status."""
    options, overrides = parsed(_lab_parser(), arguments)
    if find_spec("websockets") is None:
        raise ScenarioError(NEEDS)
    law = import_law(options.law) if options.law else None
    opened = lab(
        options.scenario, overrides, law=law, host=options.host, port=options.port, dark=options.dark, show=False
    )
    if not is_loopback(options.host):
        print(
            f"closedloop: warning: --host {options.host} lets every computer that reaches this one and knows the "
            "address with its token move the controls and save files; the address goes over the network unencrypted",
            file=sys.stderr, flush=True,
        )  # fmt: skip
    wait_for(opened, browser=not options.no_browser)
    return DONE


def wait_for(opened: Lab, browser: bool) -> None:
    """Say where a lab is, open it in a browser if asked for, and close it at Ctrl-C."""
    try:
        print(f"the lab is at {opened.url} (Ctrl-C closes it)", flush=True)
        if browser:
            open_in_browser(opened.url)
        forever = threading.Event()
        while not forever.wait(ANSWERED):
            pass
    except Terminated:
        raise
    except KeyboardInterrupt:
        print("closedloop: the lab is closed", file=sys.stderr)
    finally:
        opened.close()


def _lab_parser() -> Parser:
    parser = Parser(
        prog="closedloop lab",
        description="Open the lab in a browser: curves and verdicts of a scenario, and sliders for its keys.",
        epilog="Any key of the scenario can be set to begin with, as --law.force 15.",
        cure="see closedloop lab --help",
    )
    parser.add_argument(
        "scenario", nargs="?", help="a shipped name, a .toml file, or a run.nc; if left out, the page offers them"
    )
    parser.add_argument("--law", metavar="MODULE:FUNCTION", help="use this function as the control law")
    parser.add_argument("--host", default="127.0.0.1", help="address to listen on (default: this computer alone)")
    parser.add_argument("--port", type=int, default=8080, help="port; the next free one if it is in use (default 8080)")
    parser.add_argument("--dark", action="store_true", help="a dark page, whatever the system prefers")
    parser.add_argument("--no-browser", action="store_true", help="open no browser")
    return parser
