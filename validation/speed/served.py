"""The command ``python -m validation.speed.served``: what a step costs when another program asks for it.

`closedloop.Simulator.step` in this process, and the same steps in lock-step for a client in a process of its own, take
turns. So do servers that simulate nothing: they bound what any server reaches with this client on this computer. The
processor's time is that of this process alone, so without the client's. No test asserts a time.
"""

import os
import socket
import struct
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from importlib.util import find_spec

import numpy as np

import closedloop as cl
from closedloop.command.border import Parser, as_command
from closedloop.serve.franka.server import Franka
from closedloop.serve.session import Session
from validation.run import InputError, say
from validation.speed.contestants import Contestant
from validation.speed.measure import race, ratio

SCENARIOS = ("panda_slide", "fr3_press")
LONG = {"time.duration": 600.0}
ELSEWHERE = "127.0.0.2"  # libfranka's port is fixed: an address of its own for the second server

# Clients: each reads how many steps it is to ask for, and says how many seconds they took.
BINARY = """
import socket, struct, sys, time
arm = socket.create_connection(("127.0.0.1", int(sys.argv[1])))
arm.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
def ask(message, count):
    arm.sendall(message)
    while count > 0:
        count -= len(arm.recv(count))
n = int(sys.argv[2])
size = 8 * (20 + 4 * n)
reset = struct.pack("<II", 1, 0)
arm.sendall(b"CLB1" + reset)
message = struct.pack("<II", 3, 8 * n) + arm.recv(8 + size, socket.MSG_WAITALL)[-8 * n :]
for line in sys.stdin:
    ask(reset, 8 + size)
    began = time.perf_counter()
    for _ in range(int(line)):
        ask(message, 8 + size)
    print(time.perf_counter() - began, flush=True)
"""
LIBFRANKA = """
import sys, time
import pylibfranka as p
robot = p.Robot(sys.argv[3], p.RealtimeConfig.kIgnore)
control, command = robot.start_torque_control(), p.Torques([0.0] * 7)
for line in sys.stdin:
    began = time.perf_counter()
    for _ in range(int(line)):
        control.readOnce()
        control.writeOnce(command)
    print(time.perf_counter() - began, flush=True)
"""


def stepped(name: str, steps: int) -> Contestant:
    """Return `closedloop.Simulator.step` with a torque that is held, in this process."""
    simulator = cl.Simulator(cl.load_scenario(name, LONG))
    torque = np.array(simulator.reset().torque)

    def lap() -> tuple[float | None, None]:
        simulator.reset()
        for _ in range(steps):
            simulator.step(torque)
        return None, None

    return Contestant("step", name, len(torque), steps, lap, what="Simulator.step")


@contextmanager
def served(name: str, steps: int, interface: str, client: str, what: str) -> Iterator[Contestant]:
    """Yield the same steps for a client of an interface, in lock-step."""
    port = 0 if interface == "json" else None
    with cl.serve(name, interface, overrides=LONG, lock_step=True, port=port) as server:
        n = server.session.problem.robot.n
        with asked(client, server.port, "127.0.0.1", name, n, steps, what) as contestant:
            yield contestant


@contextmanager
def asked(client: str, port: int, host: str, name: str, n: int, steps: int, what: str) -> Iterator[Contestant]:
    """Yield steps that a client in a process of its own asks a server for."""
    words = [sys.executable, "-c", client, str(port), str(n), host]
    process = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdin is not None
        assert process.stdout is not None
        to, back = process.stdin, process.stdout

        def lap() -> tuple[float | None, None]:
            to.write(f"{steps}\n")
            to.flush()
            return float(back.readline()), None

        yield Contestant(what, name, n, steps, lap, what=what)
    finally:
        process.kill()
        process.communicate()


@contextmanager
def constant(name: str, n: int, steps: int) -> Iterator[Contestant]:
    """Yield the binary client with a server that answers whatever comes with zeros of the length of a state."""
    size = 8 * (20 + 4 * n)
    answer = struct.pack("<II", 0, size) + bytes(size)
    listener = socket.create_server(("127.0.0.1", 0))

    def serve() -> None:
        talk, _ = listener.accept()
        talk.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        talk.recv(4, socket.MSG_WAITALL)
        while talk.recv(4096):
            talk.sendall(answer)

    threading.Thread(target=serve, daemon=True).start()
    with listener, asked(BINARY, listener.getsockname()[1], "", name, n, steps, "binary, empty") as contestant:
        yield contestant


class Empty(Franka):
    """Franka's interface of an arm that stands still: neither a simulation nor a model of the controller."""

    def _advance(self, torque: object) -> None:
        pass


@contextmanager
def standing(name: str, n: int, steps: int) -> Iterator[Contestant]:
    """Yield libfranka with `Empty`."""
    session = Session(cl.load_scenario(name, LONG))
    server = Empty(session, host=ELSEWHERE, port=None, lock_step=True, limits=False, say=lambda line: None)
    thread = threading.Thread(target=server.serve, daemon=True)
    thread.start()
    try:
        with asked(LIBFRANKA, 0, ELSEWHERE, name, n, steps, "libfranka, empty") as contestant:
            yield contestant
    finally:
        server.stop()
        thread.join()
        server.close()


@as_command("validation.speed.served", stopped=())
def main(words: list[str]) -> int:
    """Measure, and print a table."""
    parser = Parser(prog="python -m validation.speed.served", description=__doc__)
    parser.add_argument("--steps", type=int, default=2000, help="steps of a lap (default 2000)")
    parser.add_argument("--repeats", type=int, default=15, help="laps of each, in turns (default 15)")
    parser.add_argument("--core", type=int, help="the core on which this process and all clients run (default: any)")
    parser.add_argument("--scenarios", nargs="+", default=SCENARIOS, metavar="SCENARIO", help="(default: %(default)s)")
    options = parser.parse_args(words)
    if min(options.steps, options.repeats) < 1 or options.steps * (options.repeats + 1) > 600_000:
        raise InputError("--steps, --repeats: must be at least 1, and together fewer than 600 000 steps")
    if options.core is not None:
        if options.core not in os.sched_getaffinity(0):
            raise InputError(f"--core {options.core}: must be one of {sorted(os.sched_getaffinity(0))}")
        os.sched_setaffinity(0, {options.core})
    for name in options.scenarios:
        with ExitStack() as opened:
            everyone = [stepped(name, options.steps)]
            n = everyone[0].joints
            everyone.append(opened.enter_context(constant(name, n, options.steps)))
            everyone.append(opened.enter_context(served(name, options.steps, "json", BINARY, "binary socket")))
            if find_spec("pylibfranka") is not None:
                everyone.append(opened.enter_context(standing(name, n, options.steps)))
                everyone.append(opened.enter_context(served(name, options.steps, "franka", LIBFRANKA, "libfranka")))
            timings = race(everyone, options.repeats, say)
        plain = timings[name, "step"]
        print(f"{name}: median of {options.repeats} laps of {options.steps} steps, in turns")
        for timing in timings.values():
            print(
                f"  {timing.contestant.what:17s} {1.0 / timing.median:7.0f} a second "
                f"({1.0 / timing.wall.min():.0f} at best), {1e6 * timing.processor:6.1f} µs of the processor, "
                f"{ratio(timing, plain):5.2f} times that of Simulator.step"
            )
    return 0


if __name__ == "__main__":
    sys.exit(main())
