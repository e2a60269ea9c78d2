"""What the tests of sweeps share: a small sweep, the command line in this process, and as a process to be killed.

A process of its own takes two seconds to import and load what a fork of this one has already: it is for what happens
while it starts, and for what has to hold from one process to another.
"""

import contextlib
import io
import os
import re
import resource
import signal
import subprocess
import sys
import threading
import traceback
from pathlib import Path

from closedloop.command.sweep import main

# 12 runs, of which one axis is refused at its short end.
SMALL = (
    "wam_slide", "--time.duration", "0.02",
    "--over", "law.force=5:15:4", "--over", "stabiliser.time_constant=5e-4,0.001,0.01",
)  # fmt: skip


def sweep(capsys, *arguments):
    """Run the command line here; return exit status, standard output and standard error."""
    capsys.readouterr()
    status = main([str(a) for a in arguments])
    captured = capsys.readouterr()
    # Where nothing is compiled yet, that is said, and takes so long that how far it is is said too.
    said = [
        line for line in captured.err.splitlines(True) if not re.match(r"compiling |closedloop sweep: \d+ of", line)
    ]
    return status, captured.out, "".join(said)


def refusal(capsys, *arguments):
    """Return the one line on standard error, having checked that it is one, and that the exit status is 2."""
    status, out, err = sweep(capsys, *arguments)
    assert status == 2, err
    assert not out
    assert len(err.splitlines()) == 1, err
    return err.removeprefix("closedloop sweep: ")


def _heed_interrupts():
    """Undo what a shell does to the tests if it runs them in the background."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def process(folder: Path, *arguments):
    """Start the command line as a process of its own in `folder`."""
    return subprocess.Popen(
        [sys.executable, "-m", "closedloop.command.sweep", *map(str, arguments)],
        cwd=folder, env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, preexec_fn=_heed_interrupts,
    )  # fmt: skip


def here(*arguments):
    """Run the command line here, where nothing captures what it prints; return exit status and standard output.

    Forks made afterwards have loaded what it needs.
    """
    with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.redirect_stderr(io.StringIO()):
        return main([str(a) for a in arguments]), out.getvalue()


class Forked:
    """A command, that of sweeps or another, in a fork of this process, in `folder`; with parts of `subprocess.Popen`.

    `most_bytes` is how large a file it may write; pipes know no such limit.
    """

    def __init__(self, folder: Path, *arguments, most_bytes=None, command=main):
        self.returncode = None
        said = [os.pipe(), os.pipe()]
        self._pid = os.fork()
        if self._pid == 0:
            self._child(folder, arguments, most_bytes, [into for _, into in said], command)
        for _, into in said:
            os.close(into)
        self._said = [os.fdopen(read) for read, _ in said]

    def __enter__(self):
        return self

    def __exit__(self, *_):
        if self.poll() is None:
            self.send_signal(signal.SIGKILL)
            self.communicate()

    def readline(self):
        """Return the next line on standard output."""
        return self._said[0].readline()

    @staticmethod
    def _child(folder, arguments, most_bytes, said, command):
        status = 98
        try:
            signal.signal(signal.SIGINT, signal.default_int_handler)
            for number, into in enumerate(said, 1):
                os.dup2(into, number)
            sys.stdout, sys.stderr = os.fdopen(1, "w"), os.fdopen(2, "w")
            os.chdir(folder)
            if most_bytes is not None:
                resource.setrlimit(resource.RLIMIT_FSIZE, (most_bytes, resource.RLIM_INFINITY))
            status = command([str(a) for a in arguments])
            sys.stdout.flush()
        except KeyboardInterrupt:  # before or after the command: what Python does
            signal.signal(signal.SIGINT, signal.SIG_DFL)
            os.kill(os.getpid(), signal.SIGINT)
        except BaseException:
            traceback.print_exc()
        finally:
            sys.stderr.flush()
            os._exit(status)

    def poll(self):
        """Return the exit status, None while it runs."""
        if self.returncode is None:
            ended, status = os.waitpid(self._pid, os.WNOHANG)
            self.returncode = os.waitstatus_to_exitcode(status) if ended else None
        return self.returncode

    def send_signal(self, number):
        """Send a signal."""
        os.kill(self._pid, number)

    def communicate(self, timeout=120.0):
        """Return what it said on standard output and error, when it has ended; it is killed after `timeout` s."""
        clock = threading.Timer(timeout, os.kill, (self._pid, signal.SIGKILL))
        clock.start()
        texts = []
        for file in self._said:
            with file:
                texts.append(file.read())
        if self.returncode is None:
            self.returncode = os.waitstatus_to_exitcode(os.waitpid(self._pid, 0)[1])
        clock.cancel()
        return tuple(texts)
