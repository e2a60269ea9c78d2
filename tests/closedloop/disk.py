"""What the tests of sweeps on a full disk share: a sweep in a process whose files may have so many bytes, no more."""

import os
import subprocess
import sys

# Nothing is compiled here: the command line begins with the limit, and so does what it writes.
LIMITED = """
import resource, sys
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[1]), resource.RLIM_INFINITY))
from closedloop.sweep.__main__ import main
sys.exit(main(sys.argv[2:]))
"""


def limited(folder, size, *arguments):
    """Run a sweep in `folder` with files of at most `size` bytes; return what became of the process."""
    return subprocess.run(
        [sys.executable, "-B", "-c", LIMITED, str(size), *map(str, arguments)],
        cwd=folder, env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}, text=True, capture_output=True,
        timeout=300,
    )  # fmt: skip
