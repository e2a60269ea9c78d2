"""The command ``closedloop lab [SCENARIO]``."""

from __future__ import annotations

import sys
import threading
from importlib.util import find_spec
from typing import TYPE_CHECKING

from closedloop.base.errors import ScenarioError
from closedloop.base.interrupts import Terminated
from closedloop.command.border import DONE, Parser, as_command, parsed
from closedloop.lab.server import is_loopback
from closedloop.lab.start import NEEDS, lab, open_in_browser
from closedloop.scenario.user_module import import_law

if TYPE_CHECKING:
    from closedloop.lab.app import Lab

# How long a signal that comes just before the main thread waits stays unanswered at the most, s.
ANSWERED = 0.5


@as_command()
def main(arguments: list[str]) -> int:
    """Open the lab, wait for Ctrl-C, and return the exit status."""
    options, overrides = parsed(_parser(), arguments)
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
    serve(opened, browser=not options.no_browser)
    return DONE


def serve(opened: Lab, browser: bool) -> None:
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


def _parser() -> Parser:
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
