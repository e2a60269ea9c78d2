"""RTDE: a client of Universal Robots' arms reads the simulation, and what it sets drives it."""

import os
import random
import socket
import struct
import subprocess
import sys
import time
from importlib.util import find_spec
from types import SimpleNamespace

import numpy as np
import pytest

import closedloop as cl
from closedloop.serve import ur
from closedloop.serve.serve import wrench

ARM = """
[robot]
model = "ur5"
[surface]
kind = "plane"
normal = [0, 0, 1]
offset = "start"
contact = "unilateral"
[impact]
restitution = 0.0
rest_speed = 1e-4
[start]
q = [0, -1.2, 1.9, -2.2708, -1.5708, 0]
[law]
kind = "paper"
kp = [900, 900, 900, 200, 200, 100]
kd = [90, 90, 90, 20, 20, 10]
force = 10.0
[time]
duration = 100.0
step = 0.001
integrator = "semi_implicit_euler"
"""
# The maker's client has a fixed port: each process of the tests has an address of this computer of its own.
HOST = f"127.{1 + os.getpid() // 65536 % 200}.{os.getpid() // 256 % 256}.{1 + os.getpid() % 254}"


@pytest.fixture
def scenario(tmp_path):
    """A UR5 that presses on a table."""
    (tmp_path / "arm.toml").write_text(ARM)
    return tmp_path / "arm.toml"


class Rtde:
    """A client that writes the messages itself, from the maker's guide."""

    def __init__(self, host, port, version=2):
        self.file = socket.create_connection((host, port), 10.0).makefile("rwb")
        assert self.ask("V", struct.pack(">H", version)) == bytes([version == 2])

    def send(self, letter, body=b""):
        """Send a message."""
        self.file.write(struct.pack(">HB", 3 + len(body), ord(letter)) + body)
        self.file.flush()

    def ask(self, letter, body=b""):
        """Return the body of the answer to a message."""
        self.send(letter, body)
        return self.read(letter)

    def read(self, letter="U"):
        """Return the body of the next message of a kind."""
        while True:
            size, kind = struct.unpack(">HB", self.file.read(3))
            body = self.file.read(size - 3)
            if kind == ord(letter):
                return body

    def state(self):
        """Return time, position of joint 2, height of the tip and force along z."""
        body = self.read()
        assert body[0] == 1
        time_, *rest = struct.unpack(">d6d6d6d6i", body[1:])
        assert rest[18:] == [253] * 6
        return time_, rest[1], rest[8], rest[14]


FIELDS = b"timestamp,actual_q,actual_TCP_pose,actual_TCP_force,joint_mode"


def test_a_client_reads_the_run_and_presses_with_what_it_sets(scenario):
    """Fields are those of the run; a force in the registers is the force on the table, torques are torques."""
    with cl.serve(scenario, "ur", host=HOST, port=0) as served:
        arm, other = Rtde(HOST, served.port), Rtde(HOST, served.port)
        assert arm.ask("v") == struct.pack(">4I", *ur.CONTROLLER)
        assert arm.ask("O", struct.pack(">d", 500.0) + FIELDS + b",dance").endswith(b",NOT_FOUND")
        answer = arm.ask("O", struct.pack(">d", 250.0) + FIELDS)
        assert answer == b"\x01DOUBLE,VECTOR6D,VECTOR6D,VECTOR6D,VECTOR6INT32"
        registers = b"input_int_register_18,input_double_register_18,input_double_register_19,input_double_register_20"
        assert arm.ask("I", registers) == b"\x01INT32,DOUBLE,DOUBLE,DOUBLE"
        assert other.ask("I", b"input_int_register_18") == b"\x00IN_USE"
        assert arm.ask("S") == b"\x01"
        seen = [arm.state() for _ in range(5)]
        np.testing.assert_allclose(np.diff([time_ for time_, *_ in seen]), 0.004, atol=1e-9)
        assert seen[-1][3] == pytest.approx(10.0, abs=1e-6)
        arm.send("U", struct.pack(">Bi3d", 1, ur.FORCE, 0.0, 0.0, -25.0))
        for _ in range(200):
            last = arm.state()
        assert last[3] == pytest.approx(25.0, abs=0.5)
        arm.file.close()
        for _ in range(300):  # until the client that has the register has been found gone
            if other.ask("I", b"input_int_register_18") == b"\x01INT32":
                break
            time.sleep(0.01)
        other.ask("O", struct.pack(">d", 250.0) + FIELDS)
        other.ask("S")
        after = [other.state()[3] for _ in range(200)]
        run = served.close()
    assert after[-1] == pytest.approx(10.0, abs=0.5)  # of the scenario's law again
    row = round(last[0] / 0.001)
    assert (last[1], last[2]) == pytest.approx((run.q[row, 1], run.position[row, 2]), abs=1e-12)
    assert last[3] == pytest.approx(run.contact_force[row - 10], abs=0.5)
    assert run.law == "scenario and torque from outside"


def test_the_raw_wrench_is_that_at_the_flange(scenario):
    """Of an arm at rest: the force on the tip and the weight of the tool, in the flange's axes, about its origin."""
    tool = {"tool.mass": 2.0, "tool.centre": [0.01, 0.0, 0.06], "tool.offset": [0.0, 0.02, 0.15]}
    fields = b"actual_TCP_force,ft_raw_wrench,actual_q,payload,payload_cog,tcp_offset"
    with cl.serve(scenario, "ur", host=HOST, port=0, overrides=tool) as served:
        arm = Rtde(HOST, served.port)
        arm.ask("O", struct.pack(">d", 500.0) + fields)
        arm.ask("S")
        arm.file.flush()
        size, _, _, *found = struct.unpack(">HBB28d", arm.file.read(4 + 28 * 8))
        robot = served.session.problem.robot
    assert size == 4 + 28 * 8
    pressed, raw, q, load = (np.array(part) for part in (found[:6], found[6:12], found[12:18], found[18:]))
    assert load == pytest.approx([2.0, *tool["tool.centre"], *tool["tool.offset"], 0.0, 0.0, 0.0])
    down = robot.tip_frame(q)[0][:3, :3].T  # the tool is fixed to the tip's frame, and has its axes
    force, weight = down @ pressed[:3], down @ [0.0, 0.0, -2.0 * 9.81]
    moment = np.cross(tool["tool.offset"], force) + np.cross(tool["tool.centre"], weight)
    assert pressed[2] == pytest.approx(10.0, abs=1e-6)
    assert raw == pytest.approx([*(force + weight), *moment], abs=1e-3)


# What the maker's driver for ROS 2 asks for, in its order, with the types of the maker's client library.
DRIVER = {
    "timestamp": "DOUBLE", "actual_q": "VECTOR6D", "actual_qd": "VECTOR6D", "speed_scaling": "DOUBLE",
    "target_speed_fraction": "DOUBLE", "runtime_state": "UINT32", "actual_TCP_force": "VECTOR6D",
    "actual_TCP_pose": "VECTOR6D", "actual_digital_input_bits": "UINT64", "actual_digital_output_bits": "UINT64",
    "standard_analog_input0": "DOUBLE", "standard_analog_input1": "DOUBLE", "standard_analog_output0": "DOUBLE",
    "standard_analog_output1": "DOUBLE", "analog_io_types": "UINT32", "tool_mode": "UINT32",
    "tool_analog_input_types": "UINT32", "tool_analog_input0": "DOUBLE", "tool_analog_input1": "DOUBLE",
    "tool_output_voltage": "INT32", "tool_output_current": "DOUBLE", "tool_temperature": "DOUBLE",
    "robot_mode": "INT32", "safety_mode": "INT32", "robot_status_bits": "UINT32", "safety_status_bits": "UINT32",
    "actual_current": "VECTOR6D", "tcp_offset": "VECTOR6D", "output_bit_register_127": "BOOL",
    "input_bit_register_3": "BOOL",
}  # fmt: skip


def test_the_driver_of_ros_finds_its_fields(scenario):
    """Each field has the maker's type; bits that a client sets come back, and are as long as the maker has them."""
    with cl.serve(scenario, "ur", host=HOST, port=0) as served:
        arm = Rtde(HOST, served.port)
        answer = arm.ask("O", struct.pack(">d", 500.0) + ",".join(DRIVER).encode())
        assert answer == b"\x01" + ",".join(DRIVER.values()).encode()
        assert arm.ask("I", b"input_bit_register_127,input_bit_register_63") == b"\x00BOOL,NOT_FOUND"
        assert arm.ask("I", b"input_bit_register_127") == b"\x01BOOL"
        assert arm.ask("S") == b"\x01"
        size = 1 + sum(struct.calcsize(">" + ur.TYPES[kind]) for kind in DRIVER.values())
        assert (len(body := arm.read()), body[-2:]) == (size, b"\x00\x00")
        arm.send("U", struct.pack(">B?", 1, True))
        for _ in range(200):
            if (body := arm.read())[-2:] == b"\x01\x00":
                break
        assert body[-2:] == b"\x01\x00"


needs_client = pytest.mark.skipif(
    find_spec("rtde_receive") is None, reason='ur-rtde is not installed: pip install "closedloop[ur]" (Linux)'
)
CLIENT = """
import sys, time
import rtde_io, rtde_receive
receive, io = rtde_receive.RTDEReceiveInterface(sys.argv[1]), rtde_io.RTDEIOInterface(sys.argv[1])
began = receive.getTimestamp()
io.setInputDoubleRegister(18, 0.0)
io.setInputDoubleRegister(19, 0.0)
io.setInputDoubleRegister(20, -20.0)
io.setInputIntRegister(18, 2)
time.sleep(1.0)
print(receive.getTimestamp() - began, receive.getActualTCPForce()[2], receive.getRobotMode(), receive.getSafetyMode(),
    receive.getOutputIntRegister(18), *receive.getActualQ())
"""


@needs_client
def test_the_package_of_users_reads_and_sets(scenario):
    """rtde_receive and rtde_io, unchanged, read the simulation and press with a force."""
    with cl.serve(scenario, "ur", host=HOST) as served:
        done = subprocess.run(
            [sys.executable, "-c", CLIENT, HOST], capture_output=True, text=True, timeout=60.0, check=False
        )
        assert done.returncode == 0, done.stderr
        run = served.close()
    elapsed, force, mode, safety, register, *q = map(float, done.stdout.split())
    assert (mode, safety, register) == (7, 1, ur.FORCE)
    assert elapsed > 0.2
    assert force == pytest.approx(20.0, abs=0.5)
    assert np.abs(run.q - q).max(axis=1).min() < 1e-12


def test_nobody_can_stop_the_server(scenario):
    """Random messages and half-closed sockets get a line, and the next client is served."""
    said, chance = [], random.Random(2)
    with cl.serve(scenario, "ur", host=HOST, port=0, say=said.append) as served:
        for k in range(300):
            with socket.create_connection((HOST, served.port), 10.0) as client:
                head = struct.pack(">HB", chance.choice((0, 3, 5, 11, 4000)), chance.choice(b"VvMUOISPx"))
                try:
                    client.sendall((struct.pack(">HBH", 5, ord("V"), 2) if k % 2 else b"") + head)
                    client.sendall(chance.randbytes(chance.randrange(60)))
                    if k % 5 == 0:
                        client.shutdown(socket.SHUT_WR)
                except OSError:
                    pass
        arm = Rtde(HOST, served.port)
        assert arm.ask("O", struct.pack(">d", 500.0) + FIELDS).startswith(b"\x01DOUBLE")
        assert arm.ask("S") == b"\x01"
        arm.state()
        Rtde(HOST, served.port, version=1)
    assert all("\n" not in line for line in said)
    assert any("no message of RTDE" in line for line in said)


def test_a_round_tip_rubs_where_it_touches(scenario):
    """The moment of the wrench about the centre of a tip of 30 mm is that of its friction, 30 mm along −n from it."""
    problem = cl.prepare(cl.load_scenario(scenario))
    normal, rubs, zeros = np.array([0.0, 0.6, 0.8]), np.array([2.0, -4.0, 3.0]), np.zeros(6)
    state = SimpleNamespace(
        time=0.0, q=problem.robot.model.home, v=zeros, acceleration=zeros, torque=zeros, f=10.0, normal=normal,
        friction_force=rubs, measured_position=problem.robot.model.home, measured_velocity=zeros,
    )  # fmt: skip
    arm = SimpleNamespace(session=SimpleNamespace(state=state), _robot=problem.robot, _radius=0.03, _set={}, _tool={})
    found = ur.Ur._values(arm)["actual_TCP_force"]
    np.testing.assert_allclose(found[:3], 10.0 * normal + rubs)
    np.testing.assert_allclose(found[3:], np.cross(-0.03 * normal, rubs), atol=1e-15)
    state.position = np.array([0.4, 0.1, 0.03])
    about_base = wrench(state, 0.03)
    np.testing.assert_allclose(about_base[3:], np.cross(state.position, found[:3]) + found[3:], atol=1e-15)


def test_what_is_no_such_arm_is_said(scenario):
    """Seven joints, a step that no cycle is made of, and lock-step are refused in a line."""
    with pytest.raises(cl.ScenarioError, match="must have six joints that turn"):
        cl.serve("panda_slide", "ur", host=HOST, port=0)
    with pytest.raises(cl.ScenarioError, match=r"must be 0\.002, or a whole share of it"):
        cl.serve(scenario, "ur", host=HOST, port=0, overrides={"time.step": 0.003})
    with pytest.raises(cl.ScenarioError, match="has no lock-step"):
        cl.serve(scenario, "ur", host=HOST, port=0, lock_step=True)
