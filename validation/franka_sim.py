"""The command ``python -m validation.franka_sim --peer PYTHON``: one client presses here and in franka-sim.

franka-sim (package franka-sim, over MuJoCo) answers libfranka's clients as `closedloop serve --as franka` does. It has
no surface, so its arm is given here: the same FR3, to six digits, with a ball at its tip, above a table. What holds
the ball is MuJoCo's contact as it is by default. It runs in the Python that `--peer` names, and would run in real time:
here it waits, as ours does in lock-step, for a command before each step and for the step before each state, so that
the load of the computer does not matter. The client is `pylibfranka`, unchanged: springs at the joints move the arm in
free space, then press.
"""

import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

import closedloop as cl
from closedloop.base.arrays import Array
from closedloop.command.border import Parser, as_command
from validation.engines.mujoco import build_spec
from validation.run import InputError, say

# Where franka-sim's arm begins, rad; the ball at the tip, and how far above the table it is at first, m.
START = (0.0, 0.0, 0.0, -1.57, 0.0, 1.57, 0.785)
RADIUS, ABOVE = 0.01, 0.02
# How far the springs at the joints pull below the table, m; how far each joint moves in free space, rad.
DEPTH, SWAY = 0.01, (0.3, -0.1, 0.2, 0.1, 0.2, 0.1, 0.3)
# When the arm, which is held where both begin until then, moves in free space, until when it does, begins to go down,
# wants to be down, and presses, s.
BEGIN, FREE, DOWN, LOW, END = 3.0, 6.0, 6.5, 7.5, 9.0
LAST, INTEGRATORS = 0.5, ("rk4", "semi_implicit_euler")
FRICTION, PERIOD, UP = 0.2, 0.001, np.array([0.0, 0.0, 1.0])

CLIENT = """
import sys
import numpy as np
import pylibfranka as p
wanted = np.load(sys.argv[1])
K, D = np.array([600.0] * 4 + [250.0, 150.0, 50.0]), np.array([50.0] * 4 + [30.0, 25.0, 15.0])
robot = p.Robot("127.0.0.1", p.RealtimeConfig.kIgnore)
robot.set_collision_behavior([1e3] * 7, [1e3] * 7, [1e3] * 6, [1e3] * 6)
control, read = robot.start_torque_control(), []
for k, row in enumerate(wanted):
    state, _ = control.readOnce()
    read.append([0.001 * k, state.O_F_ext_hat_K[2], *state.q])
    q, dq = row.reshape(2, 7)
    command = p.Torques((K * (q - np.array(state.q)) + D * (dq - np.array(state.dq))).tolist())
    command.motion_finished = k == len(wanted) - 1
    control.writeOnce(command)
np.save(sys.argv[2], read)
"""
PEER = """
import sys, threading
import mujoco
import numpy as np
from franka_sim import FrankaSimServer
from franka_sim.mujoco_franka_sim import MujocoFrankaSim
step, record, force = mujoco.mj_step, [], np.zeros(6)
given, told = MujocoFrankaSim.update_torques, MujocoFrankaSim.get_robot_state
commands, published, begun = threading.Semaphore(0), threading.Event(), threading.Event()
def noted(self, torques):
    given(self, torques)
    begun.set()
    commands.release()
def stepped(self):
    if begun.is_set() and sys._getframe(1).f_code.co_filename.endswith("state_stream.py"):
        published.wait(0.5)
        published.clear()
    return told(self)
MujocoFrankaSim.update_torques, MujocoFrankaSim.get_robot_state = noted, stepped
def recorded(model, data):
    published.set()
    if begun.is_set():
        commands.acquire(timeout=0.5)
    step(model, data)
    total = 0.0
    for k in range(data.ncon):
        mujoco.mj_contactForce(model, data, k, force)
        total += force[0]
    record.append([data.time, total, *data.qpos])
mujoco.mj_step = recorded
server = FrankaSimServer(enable_gripper=False)
threading.Thread(target=server.start, daemon=True).start()
sys.stdin.read()
np.save(sys.argv[1], record)
server.stop()
"""


def table_height() -> float:
    """Return how high the table is, m."""
    robot = cl.prepare(cl.load_scenario("fr3_press")).robot
    return float(robot.position(np.array(START))[2]) - RADIUS - ABOVE


def scenario(table: float, integrator: str) -> cl.Scenario:
    """Return the arm above a table, without a motion of its own."""
    return cl.load_scenario("fr3_press", {
        "start.q": START, "surface.offset": table, "tool.radius": RADIUS, "friction.coefficient": FRICTION,
        "law.kind": "none", "reference.kind": "hold", "time.duration": END + 1.0, "time.integrator": integrator,
    })  # fmt: skip


def wanted_motion(robot: Any, table: float) -> Array:
    """Return positions and velocities of the joints (N, 14) that the client's springs pull to, one a millisecond."""
    q, low = np.array(START), table + RADIUS - DEPTH
    above = robot.position(q)
    times, found = PERIOD * np.arange(round(END / PERIOD) + 1), []
    for t in times:
        if t <= FREE:
            phase = 2.0 * np.pi * max(0.0, t - BEGIN) / (FREE - BEGIN)
            found.append(np.array(START) + np.array(SWAY) * 0.5 * (1.0 - np.cos(phase)))
            continue
        u = float(np.clip((t - DOWN) / (LOW - DOWN), 0.0, 1.0))
        target = above + (low - above[2]) * u * u * (3.0 - 2.0 * u) * UP
        for _ in range(3):
            r, J = robot.position_and_jacobian(q)
            q = q + np.linalg.pinv(J) @ (target - r)
        found.append(q)
    positions = np.array(found)
    return np.hstack([positions, np.gradient(positions, PERIOD, axis=0)])


def arm_for_peer(robot: Any, table: float) -> str:
    """Return the arm as MJCF for franka-sim, with a ball at its tip and a table below it."""
    import mujoco

    spec, usual = build_spec(robot.model, robot.tip), mujoco.MjSpec().option
    for name in ("disableflags", "tolerance", "iterations", "jacobian", "solver", "integrator"):
        setattr(spec.option, name, getattr(usual, name))
    friction, geom = [FRICTION, 0.005, 0.0001], mujoco.mjtGeom
    spec.body(robot.tip).add_geom(type=geom.mjGEOM_SPHERE, size=[RADIUS, 0.0, 0.0], mass=0.0, friction=friction)
    x, y, _ = robot.position(np.array(START))
    spec.worldbody.add_geom(
        type=geom.mjGEOM_BOX, size=[0.3, 0.3, 0.05], pos=[x, y, table - 0.05], friction=friction
    )  # fmt: skip
    spec.compile()
    return str(spec.to_xml())


def client(motion: Path, read: Path) -> Array:
    """Run the client, and return what it read: time, s, force of O_F_ext_hat_K along z, N, and positions of joints."""
    done = subprocess.run(
        [sys.executable, "-c", CLIENT, str(motion), str(read)], capture_output=True, text=True, timeout=300.0,
        check=False,
    )  # fmt: skip
    if done.returncode:
        raise InputError(f"the client failed: {done.stderr.strip().splitlines()[-1] if done.stderr else 'no word'}")
    return np.asarray(np.load(read))


def peer(python: str, arm: str, motion: Path, folder: Path) -> tuple[Array, Array]:
    """Return what the client read from franka-sim, and what was true there: time, force on the ball, joints."""
    (folder / "arm.xml").write_text(arm, encoding="utf-8")
    words = [python, "-c", PEER, str(folder / "true.npy")]
    env = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"} | {"FR3_MJCF": str(folder / "arm.xml")}
    with subprocess.Popen(words, stdin=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=env) as process:
        try:
            for attempt in range(20):
                try:
                    read = client(motion, folder / "peer.npy")
                    break
                except InputError:
                    if attempt == 19 or process.poll() is not None:
                        raise
            process.communicate("", timeout=60.0)
        finally:
            process.kill()
    true = np.load(folder / "true.npy")
    sway = read[: round(FREE / PERIOD), 2:]
    lags = range(len(true) - len(sway) + 1)
    lag = min(lags, key=lambda k: float(np.abs(true[k : k + len(sway), 2:] - sway).max()))
    true[:, 0] = PERIOD * (np.arange(len(true)) - lag) + read[0, 0]
    return read, true


def draw(path: Path, ours: Array, run: cl.Run, other: Array, true: Array, heights: tuple[Array, Array]) -> Path:
    """Draw forces, the height of the ball above the table, and the difference of the joints in free space."""
    from matplotlib.figure import Figure

    from closedloop.figures.files import write_figure
    from closedloop.figures.style import COLOURS, styled

    with styled():
        figure = Figure(figsize=(7.2, 7.0), layout="constrained")
        force, height, free = figure.subplots(3, 1)
        force.plot(true[:, 0], true[:, 1], color=COLOURS[1], label="franka-sim, on the ball")
        force.plot(other[:, 0], -other[:, 1], "--", color=COLOURS[1], label="franka-sim, read by the client")
        force.plot(run.time, run.contact_force, color=COLOURS[0], label="closedloop, on the tip")
        force.plot(ours[:, 0], -ours[:, 1], "--", color="black", linewidth=0.8, label="closedloop, read by the client")
        force.set(xlim=(LOW - 0.6, LOW + 0.4), ylabel="force [N]", title="pressing on a rigid table")
        height.plot(true[:, 0], 1e3 * heights[1], color=COLOURS[1], label="franka-sim")
        height.plot(run.time, 1e3 * heights[0], color=COLOURS[0], label="closedloop")
        height.set(xlim=force.get_xlim(), ylim=(-0.5, 1.5), ylabel="ball above the table [mm]", xlabel="time [s]")
        at, difference = differences(ours, other)
        free.plot(at, 1e3 * difference, color=COLOURS[2], label="the joint that differs most")
        free.set(xlim=(BEGIN, FREE), ylim=(0.0, None), ylabel="difference of q [mrad]", xlabel="time [s]")
        free.set_title("free space")
        for axes in (force, height, free):
            axes.legend(fontsize=8)
        return write_figure(figure, path)


def differences(ours: Array, other: Array) -> tuple[Array, Array]:
    """Return times in free space, s, and how far apart the joints were that the client read, the largest, rad."""
    mine = ours[(ours[:, 0] >= BEGIN) & (ours[:, 0] <= FREE)]
    there = np.array([np.interp(mine[:, 0], other[:, 0], other[:, 2 + j]) for j in range(7)]).T
    return mine[:, 0], np.abs(mine[:, 2:] - there).max(axis=1)


@as_command("validation.franka_sim", stopped=())
def main(words: list[str]) -> int:
    """Run the client against both, print what differs, and draw it."""
    parser = Parser(prog="python -m validation.franka_sim", description=__doc__)
    parser.add_argument("--peer", required=True, metavar="PYTHON", help="a Python in which franka-sim is installed")
    parser.add_argument("--figure", type=Path, metavar="FILE", help="where the figure goes, without .png")
    options = parser.parse_args(words)
    table = table_height()
    robot = cl.prepare(scenario(table, INTEGRATORS[0])).robot
    runs: list[tuple[Array, cl.Run]] = []
    with tempfile.TemporaryDirectory(prefix="closedloop-") as name:
        folder = Path(name)
        motion = folder / "motion.npy"
        np.save(motion, wanted_motion(robot, table))
        for integrator in INTEGRATORS:
            say(f"closedloop, {integrator} ...")
            with cl.serve(scenario(table, integrator), "franka", lock_step=True) as served:
                runs.append((client(motion, folder / "ours.npy"), served.close()))
        say("franka-sim ...")
        other, true = peer(options.peer, arm_for_peer(robot, table), motion, folder)
    for integrator, (read, _) in zip(INTEGRATORS, runs, strict=True):
        differs = 1e3 * differences(read, other)[1].max()
        print(f"free space: with {integrator}, q differs from that of franka-sim by {differs:.3f} mrad at most")
    ours, run = runs[0]
    heights = [np.array([robot.position(q)[2] for q in each]) - RADIUS - table for each in (run.q, true[:, 2:])]
    forces = (run.time, run.contact_force), (true[:, 0], true[:, 1])
    for what, (time, force), read, height in zip(
        ("closedloop", "franka-sim"), forces, (ours, other), heights, strict=True
    ):
        last, end = force[(time > END - LAST) & (time <= END)], read[read[:, 0] > END - LAST]
        print(
            f"{what}: peak {force.max():.1f} N, in the last {LAST:g} s {last.mean():.3f} N, of which the client reads "
            f"{abs(end[:, 1].mean()):.3f} N; lowest {1e6 * height.min():.1f} µm"
        )
    if options.figure:
        say(f"wrote {draw(options.figure, ours, run, other, true, (heights[0], heights[1]))}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
