"""The maker's own client drives the simulation: what it commands acts, and what it reads is the run's."""

import json
import os
import random
import signal
import socket
import struct
import subprocess
import sys
import time
from contextlib import closing
from importlib.util import find_spec

import numpy as np
import pytest

import closedloop as cl
from closedloop.serve.franka import wire
from closedloop.serve.franka.generator import Arm, Generator, Impedance, turned

needs_client = pytest.mark.skipif(
    find_spec("pylibfranka") is None, reason='pylibfranka is not installed: pip install "closedloop[franka]" (Linux)'
)
# libfranka has a fixed port: each process of the tests has an address of this computer of its own.
HOST = f"127.{1 + os.getpid() // 65536 % 200}.{os.getpid() // 256 % 256}.{1 + os.getpid() % 254}"

CLIENT = """
import json, sys
import numpy as np
import pylibfranka as p

HOST = sys.argv[1]
robot = p.Robot(HOST, p.RealtimeConfig.kIgnore)
model = robot.load_model()
robot.set_collision_behavior([100.0] * 7, [100.0] * 7, [100.0] * 6, [100.0] * 6)

def jacobian(state):
    return np.array(model.zero_jacobian(state)).reshape((6, 7), order="F")

def press(force, cycles, sideways=0.0):
    "Press along -z with integral control of the external torque, as libfranka's example force_control."
    control, integral, ramp, read = robot.start_torque_control(), np.zeros(7), 0.0, []
    for k in range(cycles):
        state, _ = control.readOnce()
        wanted = jacobian(state).T @ np.array([0.0, 0.0, -ramp, 0.0, 0.0, 0.0])
        integral += 0.001 * (wanted - np.array(state.tau_J) + np.array(model.gravity(state)))
        ramp = 0.01 * force + 0.99 * ramp
        torque = wanted + 2.0 * integral + sideways - np.array([8.0] * 4 + [3.0] * 3) * np.array(state.dq)
        command = p.Torques(torque.tolist())
        command.motion_finished = k == cycles - 1
        control.writeOnce(command)
        read.append(state.O_F_ext_hat_K[2])
    return state, read

def say(**found):
    print(json.dumps({k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in found.items()}))

"""


def driven(scenario, script, overrides=None, **options):
    """Return what a client's script says, and the run."""
    with cl.serve(scenario, "franka", overrides=overrides, host=HOST, **{"lock_step": True, **options}) as served:
        done = subprocess.run(
            [sys.executable, "-c", CLIENT + script, HOST], capture_output=True, text=True, timeout=240.0, check=False
        )
        assert done.returncode == 0, done.stderr
        run = served.close()
    return json.loads(done.stdout.splitlines()[-1]), run


TABLES = {
    "rigid": {},
    "moving": {"surface_motion.kind": "conveyor", "surface_motion.velocity": [0.0, 0.05, 0.0]},
    "soft": {"compliance.kind": "kelvin_voigt", "compliance.stiffness": 1e4, "compliance.damping": 100.0},
}


@needs_client
@pytest.mark.parametrize("table", TABLES)
def test_a_force_controller_settles(table):
    """The client's force control settles to 10 N, and what it reads is the run's force, to the filter."""
    said, run = driven("fr3_press", "state, read = press(10.0, 3000)\nsay(read=read)", TABLES[table])
    assert run.contact_force[-1] == pytest.approx(10.0, abs=0.1)
    # The force that the arm applies points down. The filter of 100 Hz is 1.6 ms late.
    read = -np.array(said["read"])
    np.testing.assert_allclose(read[200:], run.contact_force[201 : len(read) + 1], atol=0.2)
    assert read[-1] == pytest.approx(run.contact_force[-1], abs=1e-3)


@needs_client
def test_the_state_and_the_model_are_the_arm():
    """Pose, Jacobian, gravity and mass matrix of libfranka's model, of our description, are the scenario's."""
    said, run = driven(
        "fr3_press",
        "s = robot.read_once()\n"
        "say(q=list(s.q), pose=list(s.O_T_EE), J=jacobian(s), g=np.array(model.gravity(s)),\n"
        "    H=np.array(model.mass(s)), tau=list(s.tau_J))",
    )
    robot = cl.prepare(cl.load_scenario("fr3_press")).robot
    q = run.q[-1]
    T, J = robot.tip_frame(q)
    axes, origin = T[:3, :3], T[:3, 3]
    rest = np.zeros(7)
    np.testing.assert_allclose(said["q"], q, atol=1e-6)
    pose = wire.pose_of(said["pose"])
    np.testing.assert_allclose(pose[:3, :3], axes, atol=1e-6)
    np.testing.assert_allclose(pose[:3, 3], origin, atol=1e-6)
    np.testing.assert_allclose(said["J"], J, atol=1e-5)
    np.testing.assert_allclose(said["g"], robot.inverse_dynamics(q, rest, rest), atol=1e-3)
    H = np.array(said["H"]).reshape(7, 7)
    np.testing.assert_allclose(H, robot.mass_matrix(q) - np.diag(robot.model.armature), atol=1e-5)
    np.testing.assert_allclose(said["tau"], run.torque[-1], atol=1e-5)


@needs_client
def test_a_reflex_ends_the_motion_and_recovery_allows_the_next():
    """Above the client's threshold the motion ends with cartesian_reflex; until recovery no other begins."""
    said, run = driven(
        "fr3_press",
        "robot.set_collision_behavior([100.0] * 7, [100.0] * 7, [4.0] * 6, [8.0] * 6)\n"
        "errors = []\n"
        "for force in (20.0, 3.0):\n"
        "    try:\n"
        "        press(force, 1000)\n"
        "    except Exception as error:\n"
        "        errors.append(str(error))\n"
        "robot.automatic_error_recovery()\n"
        "state, read = press(6.0, 600)\n"
        "say(errors=errors, contact=list(state.cartesian_contact), collision=list(state.cartesian_collision),\n"
        "    last=read[-1])",
    )
    assert "cartesian_reflex" in said["errors"][0]
    assert "not possible in the current mode" in said["errors"][1]
    assert said["contact"] == [0.0, 0.0, 1.0, 0.0, 0.0, 0.0]
    assert said["collision"] == [0.0] * 6
    assert said["last"] == pytest.approx(-6.0, abs=0.1)
    assert 8.0 < run.contact_force.max() < 12.0


@needs_client
def test_motions_are_followed():
    """Joint positions and poses, with springs at the joints or at the end effector, end where they should."""
    said, run = driven(
        "fr3_press",
        "def follow(start, command, controller, cycles=800):\n"
        "    control, first = start(controller), None\n"
        "    for k in range(cycles):\n"
        "        state, _ = control.readOnce()\n"
        "        if first is None: first = state\n"
        "        made = command(first, 0.5 - 0.5 * np.cos(np.pi * min(1.0, k / (cycles - 200))))\n"
        "        made.motion_finished = k == cycles - 1\n"
        "        control.writeOnce(made)\n"
        "def joints(first, s):\n"
        "    return p.JointPositions([q + d * s for q, d in zip(first.q_d, [0.1, -0.05, 0.05, 0.0, 0.05, 0.1, 0.2])])\n"
        "def pose(first, s):\n"
        "    T = list(first.O_T_EE); T[12] += 0.03 * s; T[13] -= 0.02 * s; T[14] += 0.01 * s\n"
        "    return p.CartesianPose(T)\n"
        "begun = robot.read_once()\n"
        "follow(robot.start_joint_position_control, joints, p.ControllerMode.JointImpedance)\n"
        "mid = robot.read_once()\n"
        "import time; time.sleep(0.05); mid = robot.read_once()\n"
        "follow(robot.start_cartesian_pose_control, pose, p.ControllerMode.CartesianImpedance)\n"
        "time.sleep(0.05); end = robot.read_once()\n"
        "say(begun=list(begun.q), mid=list(mid.q), pose=list(mid.O_T_EE), end=list(end.O_T_EE))",
        {"surface.kind": "none", "friction.kind": "none"},
    )
    np.testing.assert_allclose(
        np.subtract(said["mid"], said["begun"]), [0.1, -0.05, 0.05, 0.0, 0.05, 0.1, 0.2], atol=2e-4
    )
    moved = np.subtract(said["end"], said["pose"])
    np.testing.assert_allclose(moved[12:15], [0.03, -0.02, 0.01], atol=2e-4)
    np.testing.assert_allclose(moved[:12], 0.0, atol=2e-3)
    assert len(run) == 1602


@needs_client
def test_limits_end_a_motion_where_they_are_switched_on():
    """A jump of the torque is a discontinuity; a joint that comes to its end is stopped there."""
    script = (
        "def jump():\n"
        "    control = robot.start_torque_control()\n"
        "    for k in range(40):\n"
        "        control.readOnce(); control.writeOnce(p.Torques([0.0] * 6 + [5.0 if k > 20 else 0.0]))\n"
        "def turn():\n"
        "    control = robot.start_joint_velocity_control(p.ControllerMode.JointImpedance)\n"
        "    for k in range(4000):\n"
        "        control.readOnce(); control.writeOnce(p.JointVelocities([0.0] * 6 + [min(2.0, 0.005 * k)]))\n"
        "errors = []\n"
        "for motion in (jump, turn):\n"
        "    try: motion()\n"
        "    except Exception as error: errors.append(str(error))\n"
        "    robot.automatic_error_recovery()\n"
        "say(errors=errors)"
    )
    free = {"surface.kind": "none", "friction.kind": "none"}
    said, run = driven("fr3_press", script, free, limits=True)
    assert "controller_torque_discontinuity" in said["errors"][0]
    assert "joint_position_limits_violation" in said["errors"][1]
    upper = cl.prepare(cl.load_scenario("fr3_press")).robot.model.position_upper[6]
    assert upper < run.q[:, 6].max() < upper + 0.05


@needs_client
def test_a_contact_is_lost():
    """A client that pulls up leaves the table: the force that it reads ends, and the run has a liftoff."""
    said, run = driven("fr3_press", "press(10.0, 800)\nstate, read = press(-8.0, 150)\nsay(read=read)")
    assert "liftoff" in [event.kind for event in run.events]
    assert run.contact_force[790] == pytest.approx(10.0, abs=0.5)
    assert run.mode[-1] == 0
    assert run.position[-1, 2] > run.position[0, 2] + 1e-4
    np.testing.assert_allclose(said["read"][-50:], 0.0, atol=0.05)


FOREVER = """
print("moving", flush=True)
try:
    press(5.0, 10**9)
except Exception as error:
    print(type(error).__name__, str(error).splitlines()[0], flush=True)
"""


@needs_client
def test_a_client_that_is_killed_makes_room_for_the_next():
    """After a client that is killed while it presses, the arm stands still, and the next client presses."""
    said = []
    with cl.serve("fr3_press", "franka", host=HOST, lock_step=True, say=said.append) as served:
        words = [sys.executable, "-c", CLIENT + FOREVER, HOST]
        client = subprocess.Popen(words, stdout=subprocess.PIPE)
        assert client.stdout.readline() == b"moving\n"
        while served.session.cycles < 200:
            time.sleep(0.01)
        client.kill()
        client.communicate()
        script = CLIENT + "state, read = press(6.0, 600)\nsay(last=read[-1])"
        done = subprocess.run([*words[:2], script, HOST], capture_output=True, text=True, timeout=60.0, check=False)
        assert done.returncode == 0, done.stderr

        def gone():
            return sum("is gone" in line or "broke the connection" in line for line in said)

        until = time.monotonic() + 10.0
        while gone() < 2 and time.monotonic() < until:  # the server learns of the second end a little later
            time.sleep(0.01)
        assert gone() == 2
    assert json.loads(done.stdout)["last"] == pytest.approx(-6.0, abs=0.1)


@needs_client
@pytest.mark.parametrize("kill", [signal.SIGTERM, signal.SIGKILL])
def test_a_server_that_is_killed_leaves_no_client_waiting(tmp_path, kill):
    """libfranka says that the connection has ended."""
    words = [sys.executable, "-m", "closedloop", "serve", "fr3_press", "--as", "franka", "--lock-step", "--host", HOST]
    server = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, cwd=tmp_path)
    client = None
    try:
        assert server.stdout.readline().startswith(b"serving on")
        words = [sys.executable, "-c", CLIENT + FOREVER, HOST]
        client = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
        assert client.stdout.readline() == "moving\n"
        time.sleep(0.3)
        os.kill(server.pid, kill)
        out, _ = client.communicate(timeout=30.0)
        server.communicate(timeout=60.0)
    finally:
        server.kill()
        if client is not None:
            client.kill()
    assert out.startswith(("NetworkException", "ControlException"))


HAND = """
[robot]
model = "panda"
lock = { panda_finger_joint2 = 0.0 }
[start]
q = [0, -0.785398, 0, -2.35619, 0, 1.5707, 0.785398, 0.01]
[time]
duration = 100.0
step = 0.001
integrator = "semi_implicit_euler"
"""


@needs_client
def test_the_hand_moves_and_grasps(tmp_path):
    """The gripper's server moves the free finger, and a grasp of nothing fails."""
    (tmp_path / "hand.toml").write_text(HAND)
    said, _ = driven(
        tmp_path / "hand.toml",
        "hand = p.Gripper(HOST)\n"
        "found = [hand.homing(), hand.read_once().width, hand.move(0.02, 0.2), hand.read_once().width,\n"
        "         hand.grasp(0.01, 0.2, 20.0, 0.005, 0.005), hand.read_once().is_grasped, hand.read_once().max_width]\n"
        "say(found=found)",
    )
    homed, wide, moved, width, grasped, holds, widest = said["found"]
    assert (homed, moved, grasped, holds) == (True, True, False, False)
    assert (wide, width, widest) == (pytest.approx(0.04, abs=1e-3), pytest.approx(0.02, abs=1e-3), 0.04)


OBJECT = """
[[contact]]
link = "panda_leftfinger"
at = [0, 0, 0.045]
normal = [0, -1, 0]
through = [0.306871, -0.015, 0.486876]
"""


@needs_client
def test_a_grasp_holds_what_is_in_the_way(tmp_path):
    """A finger stops at an object and presses with the commanded force; the width decides whether it is grasped."""
    (tmp_path / "hand.toml").write_text(HAND.replace("0.01]", "0.03]") + OBJECT)
    said, run = driven(
        tmp_path / "hand.toml",
        "hand = p.Gripper(HOST)\n"
        "found = [hand.move(0.03, 0.2), hand.grasp(0.03, 0.1, 20.0, 0.005, 0.005), hand.read_once().is_grasped,\n"
        "         hand.grasp(0.015, 0.1, 20.0, 0.005, 0.005), hand.read_once().is_grasped, hand.read_once().width]\n"
        "say(found=found)",
    )
    assert said["found"][:5] == [True, False, False, True, True]
    assert said["found"][5] == pytest.approx(0.015, abs=2e-3)  # the springs of the arm yield
    assert run.link_forces[-1].sum() == pytest.approx(20.0, abs=0.2)


class Raw:
    """A client of the arm's port, which writes the bytes itself."""

    def __init__(self, port):
        self.tcp = socket.create_connection((HOST, port), 10.0)
        self.udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.udp.bind((self.tcp.getsockname()[0], 0))
        self.udp.settimeout(10.0)
        self.number = 0

    def ask(self, command, *given):
        """Return the body of the answer to a command."""
        body = wire.REQUESTS[command].pack(*given)
        self.number += 1
        self.tcp.sendall(wire.HEAD.pack(command, self.number, wire.HEAD.size + len(body)) + body)
        found = self.tcp.makefile("rb")
        head = wire.HEAD.unpack(found.read(wire.HEAD.size))
        assert head[:2] == (command, self.number)
        return found.read(head[2] - wire.HEAD.size)

    def close(self):
        """Leave."""
        self.tcp.close()
        self.udp.close()


def test_nobody_can_stop_the_server():
    """Random messages, half-closed sockets and second clients get a line; a client of the right kind is served then."""
    said, chance = [], random.Random(1)
    with cl.serve("fr3_press", "franka", host=HOST, port=0, lock_step=True, say=said.append) as served:

        def connected():
            for _ in range(300):  # until the client before has been found gone
                arm = Raw(served.port)
                try:
                    answer = arm.ask(wire.CONNECT, wire.ROBOT_VERSION, arm.udp.getsockname()[1])
                    assert answer == bytes([wire.SUCCESS, wire.ROBOT_VERSION, 0])
                    return arm
                except (OSError, struct.error):
                    arm.close()
                    time.sleep(0.01)
            raise AssertionError("the next client is not served")

        def still_serves():
            with closing(connected()) as arm:
                assert len(arm.udp.recv(4096)) == 1377
                assert b'name="joint7"' in arm.ask(wire.GET_MODEL)

        for k in range(600):
            with socket.create_connection((HOST, served.ports[k % 2]), 10.0) as client:
                known = wire.HEAD.pack(chance.randrange(14), k, chance.choice((12, 16, 20, 999_999_999)))
                try:
                    client.sendall((known if k % 3 else b"") + chance.randbytes(chance.randrange(300)))
                    if k % 5 == 0:
                        client.shutdown(socket.SHUT_WR)
                except OSError:
                    pass
        still_serves()
        with closing(connected()) as arm:
            move = (wire.EXTERNAL, wire.NO_GENERATOR, *[0.0] * 6, False, *[0.0] * 7)
            assert arm.ask(wire.MOVE, *move) == bytes([wire.MOVE_STARTED])
            arm.udp.recv(4096)
            source = arm.udp.recvfrom(4096)[1]
            for _ in range(200):  # datagrams that are no commands
                arm.udp.sendto(chance.randbytes(chance.choice((0, 1, 371, 400, 1400))), source)
            nan = np.full(1, np.nan).tobytes()
            newest = (2**40).to_bytes(8, "little")
            arm.udp.sendto(newest + nan * 38 + bytes(2) + nan * 7 + bytes(1), source)
            head = arm.tcp.recv(wire.HEAD.size)
            assert wire.HEAD.unpack(head)[0] == wire.MOVE
            assert arm.tcp.recv(1) == bytes([wire.MOVE_INPUT_ERROR])
            with socket.create_connection((HOST, served.port), 10.0) as second:
                assert second.recv(1) == b""
        still_serves()
        assert len(served.close()) > 1
    assert all("\n" not in line for line in said)
    assert any("no command of libfranka" in line for line in said)


def arm_at(seed):
    """Return an arm and a posture within its limits, far from singular ones."""
    scenario = cl.load_scenario("fr3_press")
    arm = Arm(scenario, cl.prepare(scenario).robot)
    return arm, np.array(scenario.start.q) + np.random.default_rng(seed).uniform(-0.3, 0.3, 7)


def test_the_wrench_is_that_of_the_torque():
    """A wrench at K, turned into torques by the Jacobian, is found again, in both axes, wherever the client puts K."""
    for seed in range(5):
        arm, q = arm_at(seed)
        chance = np.random.default_rng(seed)
        F = chance.normal(size=6)
        frames = []
        for _ in range(2):
            T = np.eye(4)
            T[:3, :3] = np.linalg.qr(chance.normal(size=(3, 3)))[0]
            T[:3, :3] *= np.linalg.det(T[:3, :3])
            T[:3, 3] = 0.1 * chance.normal(size=3)
            frames.append(T)
        arm.set_frames(*frames)
        T, J = arm.end_effector(q)
        K = T @ frames[1]
        r = K[:3, 3] - T[:3, 3]
        at_ee = np.concatenate((F[:3], F[3:] + np.cross(r, F[:3])))
        base, own = arm.wrench(J.T @ at_ee, T, J)
        np.testing.assert_allclose(base, F, atol=1e-9)
        np.testing.assert_allclose(own, np.concatenate((K[:3, :3].T @ F[:3], K[:3, :3].T @ F[3:])), atol=1e-9)
        step = 1e-6 * chance.normal(size=7)
        moved, _ = arm.end_effector(q + step)
        twist = np.concatenate((moved[:3, 3] - T[:3, 3], turned(T[:3, :3], moved[:3, :3])))
        np.testing.assert_allclose(twist, J @ step, atol=1e-10)


def test_springs_are_those_that_were_set():
    """At rest the torque is gravity and stiffness times distance, of the joints or of the end effector."""
    arm, q = arm_at(3)
    springs, rest = Impedance(arm, 1e-3), np.zeros(7)
    off = 1e-4 * np.arange(1.0, 8.0)
    gravity = arm.gravity(q)
    np.testing.assert_allclose(springs.at_joints(q, rest, q + off, rest) - gravity, springs.joints * off, rtol=1e-9)
    T, J = arm.end_effector(q)
    wanted = T.copy()
    wanted[:3, 3] += (1e-3, -2e-3, 5e-4)
    torque = springs.at_end_effector(q, rest, q, rest, wanted) - gravity
    np.testing.assert_allclose(torque, J.T @ np.array([3.0, -6.0, 1.5, 0.0, 0.0, 0.0]), atol=1e-9)


def test_the_generator_reaches_poses_and_elbows():
    """Commanded poses are reached to rounding, and with an elbow joint 3 is where the elbow says."""
    arm, q = arm_at(4)
    motion = Generator(arm, 1e-3)
    motion.rest_at(q)
    begun = motion.pose
    empty = wire.command_of(bytes(371))
    for k in range(200):
        pose = begun.copy()
        pose[:3, 3] += 1e-4 * k * np.array([1.0, -0.5, 0.5])
        elbow = (q[2] + 5e-4 * k, -1.0)
        motion.follow(wire.CARTESIAN_POSE, empty._replace(pose=pose.T.ravel(), elbow=elbow))
    T, _ = arm.end_effector(motion.q)
    np.testing.assert_allclose(T, pose, atol=1e-8)
    assert motion.q[2] == pytest.approx(elbow[0], abs=1e-8)
    np.testing.assert_allclose(motion.twist[:3], [0.1, -0.05, 0.05], atol=1e-9)
    motion.follow(wire.CARTESIAN_VELOCITY, empty._replace(twist=(0.0, 0.0, 0.0, 0.0, 0.0, 0.5)))
    after, _ = arm.end_effector(motion.q)
    np.testing.assert_allclose(turned(T[:3, :3], after[:3, :3]), [0.0, 0.0, 5e-4], atol=1e-8)


def test_what_is_no_arm_of_franka_is_said():
    """A robot without seven turning joints, and a step that no millisecond is made of, are refused in a line."""
    with pytest.raises(cl.ScenarioError, match="must have seven joints that turn"):
        cl.serve("wam_slide", "franka", host=HOST, port=0)
    with pytest.raises(cl.ScenarioError, match=r"must be 0\.001, or a whole share of it"):
        cl.serve("fr3_press", "franka", host=HOST, port=0, overrides={"time.step": 0.0003, "time.duration": 3.0})
