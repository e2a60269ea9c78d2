"""The current folder is taken off `sys.path`, so that a user's file cannot shadow a module that the package needs.

``python -m closedloop.run`` puts it first, so that a user's ``numpy.py`` would be imported as numpy.
"""

import os
import sys

COMMANDS = ("closedloop", "validation")


def runs_a_command() -> bool:
    """Whether this process was started as a command of ours: by its console script, or with ``python -m``."""
    if sys.argv[:1] == ["-m"]:
        return _module_asked_for().partition(".")[0] in COMMANDS
    return (
        os.path.basename(sys.argv[0]).partition(".")[0].removesuffix("-script") == "closedloop" if sys.argv else False
    )


def _module_asked_for() -> str:
    """Return the module that ``python -m`` looks for: meanwhile the arguments begin with "-m", its name before them."""
    if len(sys.orig_argv) < len(sys.argv):
        return ""
    word = sys.orig_argv[-len(sys.argv)]
    return word.partition("m")[2] if word.startswith("-") else word


def leave_out_current_folder(package_file: str) -> None:
    """Take the current folder from the head of `sys.path`, if ``python -m`` put it there to run a command of ours.

    It stays where the package itself was found in it: a checkout that is not installed.
    """
    if sys.argv[:1] != ["-m"] or sys.flags.safe_path or not runs_a_command():
        return
    home = os.path.dirname(os.path.dirname(os.path.abspath(package_file)))
    try:
        here = os.getcwd()
        from_here = os.path.samefile(here, home)
    except OSError:  # the folder was deleted
        here, from_here = "", False
    if sys.path and sys.path[0] in (here, "") and not from_here:
        del sys.path[0]
