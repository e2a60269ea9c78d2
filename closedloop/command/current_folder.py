"""The current folder is taken off `sys.path`, so that a user's file cannot shadow a module that the package needs.

``python -m closedloop.run`` puts it first, so that a user's ``numpy.py`` would be imported as numpy.
"""

from __future__ import annotations

import os
import sys

COMMANDS = ("closedloop", "validation")


def leave_out_current_folder(package_file: str) -> None:
    """Take the current folder from the head of `sys.path`, if ``python -m`` put it there to run a command of ours.

    It stays where the package itself was found in it: a checkout that is not installed.
    """
    # While `-m` looks for its module, the arguments begin with it; the module's name stands before the other arguments.
    if sys.argv[:1] != ["-m"] or sys.flags.safe_path or len(sys.orig_argv) < len(sys.argv):
        return
    word = sys.orig_argv[-len(sys.argv)]
    module = word.partition("m")[2] if word.startswith("-") else word
    if module.partition(".")[0] not in COMMANDS:
        return
    home = os.path.dirname(os.path.dirname(os.path.abspath(package_file)))
    try:
        here = os.getcwd()
        from_here = os.path.samefile(here, home)
    except OSError:  # the folder was deleted
        here, from_here = "", False
    if sys.path and sys.path[0] in (here, "") and not from_here:
        del sys.path[0]
