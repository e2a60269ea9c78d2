"""A served scenario: a controller in another program gets the bits of a law; nobody can stop the server."""

import itertools
import json
import random
import runpy
import signal
import socket
import struct
import subprocess
import sys
import time
from collections import deque
from contextlib import suppress
from pathlib import Path
from shutil import which
from threading import Thread
from types import SimpleNamespace

import numpy as np
import pytest
from sweep_runs import Forked

import closedloop as cl
from closedloop.__main__ import main
from closedloop.jit.kernel import jit_disabled
from closedloop.loop.events.transitions import collide
from closedloop.serve.serve import ERROR, HEAD, MAGIC, NUMBERS, REQUESTS
from closedloop.serve.session import Clock

SCENARIO = "panda_slide"
COMMAND = ("serve", SCENARIO, "--lock-step", "--out", "out")
BRIEF = {"time.duration": 0.3, "reference.start": 0.0, "reference.stop": 0.2}
KP, KD = np.array([600.0] * 4 + [100.0, 100.0, 15.0]), np.array([50.0] * 4 + [6.0, 6.0, 1.0])
HOME = np.array(cl.load_scenario(SCENARIO).start.q)


def law(t, q, v, terms):
    """A posture, held by springs about a place below the board."""
    return KP * (HOME + 0.01 * np.sin(3.0 * t) - q) - KD * v + terms.bias


class Json:
    """A client that writes lines of JSON."""

    def __init__(self, port):
        self.file = socket.create_connection(("127.0.0.1", port), 10.0).makefile("rwb")

    def ask(self, do, **more):
        """Return the answer to a message."""
        self.file.write(json.dumps({"do": do, **more}).encode() + b"\n")
        self.file.flush()
        return json.loads(self.file.readline())

    def state(self, do, torque=None):
        """Return the state that answers a message."""
        return self.ask(do) if torque is None else self.ask(do, torque=list(torque))


class Binary:
    """A client that writes binary messages."""

    def __init__(self, port):
        self.file = socket.create_connection(("127.0.0.1", port), 10.0).makefile("rwb")
        self.file.write(MAGIC)
        self.fields = json.loads(self.ask("describe")[1])["state"]

    def ask(self, do, body=b""):
        """Return the kind and the bytes of the answer to a message."""
        self.file.write(HEAD.pack(REQUESTS.index(do), len(body)) + body)
        self.file.flush()
        kind, length = HEAD.unpack(self.file.read(HEAD.size))
        return kind, self.file.read(length)

    def state(self, do, torque=None):
        """Return the state that answers a message."""
        kind, body = self.ask(do, b"" if torque is None else struct.pack(f"<{len(torque)}d", *torque))
        assert kind == NUMBERS
        numbers, at, found = np.frombuffer(body), 0, {}
        for name, size in self.fields:
            found[name] = numbers[at] if size == 1 else numbers[at : at + size]
            at += size
        return found


def same(a, b):
    """Two runs have the same rows, to the bit; in the last one acts what was asked for before it."""
    assert len(a) == len(b)
    for name, column in a.columns.items():
        last = None if name in ("q", "v", "position", "velocity", "mode") or len(column) != len(a) else -1
        assert np.array_equal(column[:last], b.columns[name][:last], equal_nan=True), name


@pytest.mark.parametrize("client", [Json, Binary])
def test_a_controller_over_a_socket_gets_the_bits_of_a_law(client):
    """In lock-step, a law in the client gives the run that the same law gives in `simulate`, also after a reset."""
    scenario = cl.load_scenario(SCENARIO, BRIEF)
    robot = cl.prepare(scenario).robot
    with cl.serve(scenario, lock_step=True) as served:
        robot_arm = client(served.port)
        for _ in range(2):
            state = robot_arm.state("reset")
            while not state["done"]:
                q, v = np.array(state["q"]), np.array(state["v"])
                state = robot_arm.state("torque", law(state["time"], q, v, robot.terms(q, v)))
        run = served.close()
    once = cl.simulate(scenario, law=law, progress=False)
    same(once, run)
    assert (run.stopped, run.law) == (None, "torque from outside")
    assert state["contact_force"] == pytest.approx(run.contact_force[-1], abs=1e-9)


def test_the_lab_shows_what_is_served_while_it_goes_on():
    """A page is sent the arm and the latest rows as they come, in the end the whole run, and no more than asked for."""
    sockets = pytest.importorskip("websockets.sync.client", reason="websockets is not installed: the extra 'lab'")
    closed = pytest.importorskip("websockets.exceptions").ConnectionClosed
    from closedloop.lab.drawn import unpack
    from closedloop.serve.session import Watch

    with cl.serve(SCENARIO, overrides=BRIEF, lock_step=True) as served:
        watch, arm = Watch(served.session), Json(served.port)
        assert watch.url.startswith("http://127.0.0.1:")
        torque, shown = arm.ask("reset")["torque"], {}
        with sockets.connect(watch.url.replace("http", "ws", 1), compression=None) as page:

            def until(there):
                while not there():
                    message = unpack(page.recv(timeout=60.0))
                    shown[message["kind"]] = message
                    if message["kind"] == "run":
                        with suppress(closed):  # at the end, when what was sent is still read
                            page.send('{"do": "shown"}')

            state = deque((arm.state("torque", torque) for _ in range(30)), 1)[0]
            until(lambda: "run" in shown and shown["run"]["end"] > 0.02)
            live = shown["run"]
            assert (live["partial"], live["stopped"], shown["hello"]["live"]) == (True, "", False)
            page.send('{"do": "columns", "names": ["v"]}')
            until(lambda: shown["run"]["panels"][-1]["name"] == "column v")
            while not state["done"]:
                state = arm.state("torque", torque)
            run = served.close()
            end = Thread(target=watch.finish, args=(run, "it is over"))
            end.start()
            until(lambda: {"goodbye", "strip"} <= shown.keys() and not shown["run"]["partial"])
            end.join()
    panels = {panel["name"]: panel for panel in live["panels"]}
    traces = {trace["label"]: trace["values"] for trace in panels["force"]["traces"]}
    at = np.searchsorted(run.time, panels["force"]["time"] - 1e-6)
    assert np.allclose(traces["f"], run.contact_force[at], rtol=1e-6)
    end = shown["run"]
    assert (end["begin"], end["end"], end["partial"]) == (0.0, run.time[-1], False)
    assert shown["strip"]["tiles"]
    frames = shown["space"]["frames"]
    assert frames["time"][-1] == pytest.approx(run.time[-1])
    assert frames["places"].size == 7 * shown["robot"]["joints"] * frames["time"].size


def test_the_latest_rows_are_those_of_the_run():
    """They have the times, the columns and the events of the run, from wherever they begin."""
    simulator = cl.Simulator(cl.load_scenario("wam_touchdown", {"time.duration": 0.5}))
    simulator.run_until(0.5)
    latest, run = simulator.latest(200), simulator.run()
    assert (len(latest), simulator.latest(10**6).time[0]) == (200, 0.0)
    for name, column in latest.columns.items():
        if len(column) == len(latest):
            there = np.isfinite(column) if name == "kkt_condition" else np.full(len(column), True)
            assert there[:100].all(), name
            assert np.array_equal(column[there], run.columns[name][-201:-1][there], equal_nan=True), name
    assert [event.time for event in latest.events] == [e.time for e in run.events if e.time >= latest.time[0]]
    simulator.reset()
    assert len(simulator.latest(200)) == 1


def test_messages_say_what_is_wrong_and_what_there_is():
    """Each message has one answer, a wrong one too; the wrench is the force of the state about the base."""
    with cl.serve(SCENARIO, overrides=BRIEF, lock_step=True) as served:
        arm = Json(served.port)
        described = arm.ask("describe")
        assert (described["n"], described["steps"], described["lock_step"]) == (7, 300, True)
        assert arm.ask("dance") == {"error": f'"do": must be one of {", ".join(REQUESTS)}, as in {{"do": "state"}}'}
        assert arm.ask("torque", torque=[1.0])["error"].startswith("torque: must be 7 finite numbers")
        assert arm.ask("state", torque=[1.0]) == {"error": '"state" takes nothing named torque'}
        state, wrench = arm.ask("step"), np.array(arm.ask("wrench")["wrench"])
        force = state["contact_force"] * np.array(state["normal"]) + state["friction_force"]
        np.testing.assert_allclose(wrench, np.r_[force, np.cross(state["position"], force)], atol=1e-12)
        for _ in range(299):
            state = arm.ask("step")
        assert state["done"]
        assert "reset begins anew" in arm.ask("step")["error"]
        assert arm.ask("events") == {"events": []}
    with cl.serve("wam_touchdown", overrides={"time.duration": 2.0}, lock_step=True) as served:
        arm = Json(served.port)
        while not (state := arm.ask("step"))["done"]:
            pass
        kinds = [event["kind"] for event in arm.ask("events")["events"]]
        assert kinds == [event.kind for event in served.close().events]
        assert "impact" in kinds


def test_real_time_goes_on_without_commands():
    """In real time the steps follow the wall clock, and those without a command of their own are counted."""
    with cl.serve(SCENARIO, overrides={"time.duration": 30.0}) as served:
        arm = Json(served.port)
        state = arm.ask("state")
        began = time.perf_counter()
        for _ in range(20):
            state = arm.ask("torque", torque=state["torque"])
        time.sleep(0.1)
        state = arm.ask("torque", torque=state["torque"])
        elapsed = time.perf_counter() - began
    session = served.session
    assert session.lost + session.late >= 50
    assert session.cycles == len(served.close()) - 1
    # What this computer was too late for is left out, so that never more time passes than on the wall.
    assert state["time"] + 1e-3 * session.late > 0.1
    assert state["time"] <= elapsed + 1e-3


def test_a_late_server_leaves_its_client_time():
    """After a stall the instants follow faster, but never so fast that no command can come between them."""
    clock = Clock(0.01)
    clock.begin()
    time.sleep(0.025)
    assert clock.left() == 0.0
    clock.tick()
    assert 0.004 < clock.left() < 0.0065
    time.sleep(0.0065)
    clock.tick()
    assert clock.late == 0
    time.sleep(0.1)
    clock.tick()
    assert clock.late >= 8


def raw(port):
    """Return a connection on which anything can be sent."""
    return socket.create_connection(("127.0.0.1", port), 10.0)


def test_nobody_can_stop_the_server():
    """Random, oversized, half-closed and second clients get a line, and the next client is served."""
    said, chance = [], random.Random(0)
    with cl.serve(SCENARIO, overrides=BRIEF, lock_step=True, say=said.append) as served:

        def still_serves():
            for _ in range(200):  # until the client before has been found gone
                arm = Binary.__new__(Binary)
                try:
                    arm.__init__(served.port)
                    arm.state("reset")
                    arm.file.close()
                    return
                except (OSError, struct.error):
                    time.sleep(0.01)
            raise AssertionError("the next client is not served")

        for begin in (b"", MAGIC, b"{"):
            for _ in range(300):
                with raw(served.port) as client:
                    try:
                        client.sendall(begin + chance.randbytes(chance.randrange(200)) + b"\n" * chance.randrange(2))
                        if chance.random() < 0.5:
                            client.shutdown(socket.SHUT_WR)
                    except OSError:
                        pass
            still_serves()
        for begin in (MAGIC + HEAD.pack(3, 2**32 - 1), b"{" + b" " * 3_000_000):
            with raw(served.port) as client:
                try:
                    client.sendall(begin)
                    assert client.recv(1) == b""
                except ConnectionError:
                    pass
            still_serves()
        first = Json(served.port)
        assert first.ask("state")["row"] == 0
        with raw(served.port) as second:
            assert second.recv(1) == b""
        assert first.ask("step")["row"] == 1
        arm = Binary.__new__(Binary)
        del first
        still_serves()
        arm = Binary(served.port)
        kind, why = arm.ask("torque", struct.pack("<7d", *[np.nan] * 7))
        assert (kind, b"must be 7 finite numbers" in why) == (ERROR, True)
    assert all("\n" not in line for line in said)
    assert any("is refused" in line for line in said)
    assert any("longer than" in line for line in said)


def test_the_command_saves_what_was_served(tmp_path):
    """Ctrl-C ends it with status 0, and run.nc has the rows that were stepped."""
    with Forked(tmp_path, *COMMAND, "--time.duration", "5", command=main) as process:
        arm = Json(int(process.readline().split("port ")[1].split()[0]))
        for _ in range(20):
            arm.ask("step")
        process.send_signal(signal.SIGINT)
        out, _ = process.communicate(timeout=60.0)
    assert process.returncode == 0
    assert "20 steps served" in out
    run = cl.load_run(tmp_path / "out" / "run.nc")
    assert (len(run), run.law) == (21, "scenario")
    assert "not stepped further" in run.stopped


@pytest.mark.parametrize("kill", [signal.SIGTERM, signal.SIGKILL])
def test_a_server_that_is_killed_leaves_no_client_waiting(tmp_path, kill):
    """A client whose server is killed while it drives gets the end of the connection; SIGTERM saves the run too."""
    with Forked(tmp_path, *COMMAND, command=main) as process:
        arm = Json(int(process.readline().split("port ")[1].split()[0]))
        torque = arm.ask("step")["torque"]
        process.send_signal(kill)
        began = time.perf_counter()
        with pytest.raises((OSError, json.JSONDecodeError)):  # an empty line is the end
            deque((arm.ask("torque", torque=torque) for _ in itertools.count()), 0)
        assert time.perf_counter() - began < 10.0
        process.communicate(timeout=60.0)
    assert process.returncode == (-kill if kill == signal.SIGKILL else 128 + kill)
    assert (tmp_path / "out" / "run.nc").exists() == (kill == signal.SIGTERM)


@pytest.mark.parametrize("lock_step", [True, False])
def test_a_client_that_is_killed_makes_room_for_the_next(lock_step):
    """A client that is killed while it drives is gone with a line, and the next one drives on from there."""
    script = (
        "import socket, sys\n"
        "arm = socket.create_connection(('127.0.0.1', int(sys.argv[1]))).makefile('rwb')\n"
        "while True:\n"
        '    arm.write(b\'{"do": "step"}\\n\'); arm.flush(); print(arm.readline(), flush=True)\n'
    )
    said = []
    with cl.serve(SCENARIO, overrides={"time.duration": 60.0}, lock_step=lock_step, say=said.append) as served:
        client = subprocess.Popen([sys.executable, "-c", script, str(served.port)], stdout=subprocess.PIPE)
        for _ in range(50):
            client.stdout.readline()
        client.kill()
        client.communicate()
        for _ in range(300):  # until it has been found gone
            try:
                row = (arm := Json(served.port)).ask("state")["row"]
                break
            except (OSError, json.JSONDecodeError):
                time.sleep(0.01)
        assert arm.ask("step")["row"] == row + 1 > 50
        del arm
    assert [line.split(" ", 2)[2] for line in said[:1]] == ["is connected"]
    assert sum("is gone" in line or "broke the connection" in line for line in said) >= 1
    assert all("\n" not in line for line in said)


@pytest.mark.parametrize(
    ("more", "why"),
    [
        ({"as_": "kuka"}, "must be one of json"),
        ({"port": 70_000}, "must be from 0 to 65534"),
        ({"host": "192.0.2.1"}, "cannot listen on port"),
        ({"overrides": {"law.force": "x"}}, "law.force"),
    ],
)
def test_what_cannot_be_served_is_said(more, why):
    """A wrong interface, port, address or key is one line."""
    with pytest.raises(cl.ClosedLoopError, match=why) as caught:
        cl.serve(SCENARIO, **more)
    assert "\n" not in str(caught.value)


PAGE = Path(__file__).resolve().parents[3] / "docs"


@pytest.mark.skipif(which("g++") is None, reason="g++ is not installed")
def test_the_page_s_controller_in_cpp_gives_the_run_of_python(tmp_path):
    """The C++ example of the page, compiled with the package's header, drives the run that Python's messages give."""
    source = (PAGE / "serve.md").read_text(encoding="utf-8").split("```cpp\n")[1].split("```")[0]
    (tmp_path / "client.cpp").write_text(source)
    header = Path(cl.__file__).parent / "serve"
    words = ["g++", "-std=c++17", "-Wall", "-Wextra", "-Werror", "-O1", f"-I{header}", "client.cpp", "-o", "client"]
    subprocess.run(words, cwd=tmp_path, check=True, timeout=120.0)
    with cl.serve(SCENARIO, overrides=BRIEF, lock_step=True) as served:
        said = subprocess.run([tmp_path / "client", str(served.port)], capture_output=True, check=True, timeout=60.0)
        run = served.close()
    with cl.serve(SCENARIO, overrides=BRIEF, lock_step=True) as served:
        arm = Json(served.port)
        state = arm.ask("reset")
        hold = np.array(state["torque"])
        while not state["done"]:
            state = arm.ask("torque", torque=list(hold - 5.0 * np.array(state["v"])))
        same(served.close(), run)
    assert said.stdout.split() == [b"%.17g" % run.time[-1], b"%.17g" % state["contact_force"]]


def test_the_example_of_ros_is_python():
    """The node of the page can be read; ROS 2 itself is not there."""
    compile((PAGE / "ros2_node.py").read_text(encoding="utf-8"), "ros2_node.py", "exec")


def test_the_robot_of_lerobot_follows_actions(tmp_path, monkeypatch):
    """The package of the page, with stand-ins for LeRobot's base classes, moves the arm to where an action says."""

    class Config:
        register_subclass = staticmethod(lambda name: lambda kind: kind)

    base = type("Robot", (), {"__init__": lambda self, config: None})
    robots = SimpleNamespace(Robot=base, RobotConfig=Config)
    monkeypatch.setitem(sys.modules, "lerobot", SimpleNamespace(robots=robots))
    monkeypatch.setitem(sys.modules, "lerobot.robots", robots)
    monkeypatch.chdir(tmp_path)
    found = runpy.run_path(str(PAGE / "lerobot_robot_closedloop.py"))
    arm = found["ClosedLoop"](found["ClosedLoopConfig"]())
    arm.connect()
    seen = arm.get_observation()
    assert set(seen) == set(arm.observation_features)
    assert seen["contact_force"] == pytest.approx(10.0, abs=1e-6)
    wanted = {name: seen[name] for name in arm.action_features} | {"panda_joint1.pos": 0.1}
    for _ in range(30):
        arm.send_action(wanted)
    assert arm.get_observation()["panda_joint1.pos"] == pytest.approx(0.1, abs=1e-3)
    arm.disconnect()
    assert len(cl.load_run("run.nc")) == 1 + 30 * 33


def test_an_impact_does_not_compile_while_a_client_waits():
    """What computes impacts is compiled, or read, before the first client can connect."""
    with cl.serve("fr3_press", "franka", port=0, lock_step=True):
        assert jit_disabled() or getattr(collide, "dispatcher", collide).signatures
