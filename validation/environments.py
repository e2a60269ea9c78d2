"""Control steps a second of environments for learning: ``python -m validation.environments``.

The vector environment of `closedloop.gym`, beside `gymnasium.vector.SyncVectorEnv` over MuJoCo with the same arm,
plane, friction, torques and reward, and beside the steps a second of `closedloop.simulate_batch`. Laps alternate, so
that what else the computer does slows all alike; ratios are of neighbouring laps, their median is told.
"""

import argparse
import json
import statistics
import time
from typing import Any
from xml.etree import ElementTree

import gymnasium
import numpy as np

import closedloop as cl
import closedloop.gym  # registers the environments
from closedloop.base.arrays import Array
from closedloop.base.files import write_whole
from closedloop.figures.export.mjcf import mjcf_of

TORQUE = 60.0
# Of the policy: it holds the posture and presses.
STIFFNESS, DAMPING = np.array([900.0, 900.0, 400.0, 300.0]), np.array([60.0, 60.0, 30.0, 20.0])


class MujocoSlide(gymnasium.Env[Array, Any]):
    """The slide of `closedloop.gym` in MuJoCo: torques held over a control period, the same observations and reward."""

    def __init__(self, xml: str, step: float, steps: int, start: Array, episode: int, wanted: float) -> None:
        import mujoco

        self._mujoco: Any = mujoco
        self._model = mujoco.MjModel.from_xml_string(xml)
        self._model.opt.timestep = step
        self._data = mujoco.MjData(self._model)
        self._steps, self._start, self._episode, self._wanted = steps, start, episode, wanted
        n = self._model.nv
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (n,), np.float32)
        self.observation_space = gymnasium.spaces.Box(-1e6, 1e6, (2 * n + 2,), np.float64)
        self._force = np.zeros(6)
        self._count = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """Begin an episode."""
        super().reset(seed=seed)
        self._mujoco.mj_resetData(self._model, self._data)
        self._data.qpos[:] = self._start
        self._mujoco.mj_forward(self._model, self._data)
        self._count = 0
        return self._observed(), {}

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Hold the torques for a control period."""
        self._data.qfrc_applied[:] = TORQUE * np.clip(action, -1.0, 1.0)
        self._mujoco.mj_step(self._model, self._data, self._steps)
        self._count += 1
        seen = self._observed()
        cost = -min(abs(seen[-2] - self._wanted) / self._wanted, 1.0)
        return seen, cost, False, self._count >= self._episode, {}

    def _observed(self) -> Array:
        force = 0.0
        if self._data.ncon:
            self._mujoco.mj_contactForce(self._model, self._data, 0, self._force)
            force = self._force[0]
        return np.concatenate([self._data.qpos, self._data.qvel, [force, self._count / self._episode]])


def policy(q: Array, v: Array, start: Array, hold: Array) -> Array:
    """Return actions (N, n) that hold the posture `start` with the torques `hold` before all else."""
    torque = hold + STIFFNESS * (start - q) - DAMPING * v
    return np.asarray(np.clip(torque / TORQUE, -1.0, 1.0), dtype=np.float32)


def contestants(count: int, rate: float, threads: int | None) -> dict[str, Any]:
    """Return what is measured: by name a function of a number of control steps, and the physics steps in each."""
    fixed: dict[str, Any] = {"ranges": {}, "control_rate": rate, "actions": {"torque": (-TORQUE, TORQUE)}}
    # What MuJoCo's environment observes and is rewarded for, and no more.
    fixed |= {"endings": {}, "observations": ("q", "v", "f_measured", "phase"), "rewards": {"force": 1.0}}
    scenario = closedloop.gym.TASKS["slide"].load_scenario()
    short = cl.load_scenario(str(closedloop.gym.TASKS["slide"].scenario), {"time.duration": 10.0 * scenario.time.step})
    run = cl.simulate(short)
    start, hold, n = run.q[0].copy(), run.torque[0].copy(), run.q.shape[1]
    ours = gymnasium.make_vec("closedloop/Slide-v0", num_envs=count, threads=threads, worlds=1, **fixed)
    seen = [ours.reset(seed=0)[0]]
    steps = round(1.0 / (rate * scenario.time.step))
    episode = round(scenario.time.duration * rate)
    xml = ElementTree.tostring(mjcf_of(run), encoding="unicode")

    def make() -> MujocoSlide:
        return MujocoSlide(xml, scenario.time.step, steps, start, episode, scenario.law.force)

    theirs = gymnasium.vector.SyncVectorEnv([make] * count)
    told = [theirs.reset(seed=0)[0]]

    def closed(laps: int) -> int:
        for _ in range(laps):
            seen[0] = ours.step(policy(seen[0][:, :n], seen[0][:, n : 2 * n], start, hold))[0]
        return int(laps * count * steps)

    def mujoco(laps: int) -> int:
        for _ in range(laps):
            told[0] = theirs.step(policy(told[0][:, :n], told[0][:, n : 2 * n], start, hold))[0]
        return int(laps * count * steps)

    def batch(laps: int) -> int:
        runs = max(2, round(laps * count * steps / (scenario.time.duration / scenario.time.step)))
        cl.simulate_batch(scenario, {"law.force": np.linspace(9.0, 11.0, runs).tolist()}, workers=threads)
        return round(float(runs * scenario.time.duration / scenario.time.step))

    return {"closedloop.gym": closed, "mujoco": mujoco, "simulate_batch": batch}


def measure(some: dict[str, Any], laps: int, rounds: int) -> dict[str, list[tuple[float, float]]]:
    """Return physics steps a second of wall time and of processor time, of each in each round."""
    found: dict[str, list[tuple[float, float]]] = {name: [] for name in some}
    for name, lap in some.items():
        lap(2 if name != "simulate_batch" else laps)  # warm
    for _ in range(rounds):
        for name, lap in some.items():
            wall, processor = time.perf_counter(), time.process_time()
            done = lap(laps)
            found[name].append((done / (time.perf_counter() - wall), done / (time.process_time() - processor)))
    return found


def main(arguments: list[str] | None = None) -> int:
    """Print the figures, and return 0."""
    parser = argparse.ArgumentParser(prog="python -m validation.environments", description=__doc__.splitlines()[0])
    parser.add_argument("--envs", type=int, default=256, help="environments side by side")
    parser.add_argument("--rate", type=float, default=500.0, help="control steps a second of simulated time, Hz")
    parser.add_argument("--laps", type=int, default=100, help="control steps in a lap")
    parser.add_argument("--rounds", type=int, default=7, help="laps of each")
    parser.add_argument("--threads", type=int, default=None, help="threads of ours; one a core if left out")
    parser.add_argument("--json", help="file for the figures")
    given = parser.parse_args(arguments)
    found = measure(contestants(given.envs, given.rate, given.threads), given.laps, given.rounds)
    steps = round(1000.0 / given.rate)
    table: dict[str, Any] = {}
    for name, laps in found.items():
        wall, processor = (statistics.median(each) for each in zip(*laps, strict=True))
        table[name] = {"physics_steps_per_second": wall, "control_steps_per_second": wall / steps}
        table[name]["physics_steps_per_processor_second"] = processor
        print(f"{name:16} {wall:12,.0f} physics steps/s {wall / steps:12,.0f} control steps/s", end="")
        print(f" {processor:12,.0f} physics steps per second of processor")
    for name in ("mujoco", "simulate_batch"):
        pairs = list(zip(found["closedloop.gym"], found[name], strict=True))
        wall, processor = (statistics.median(a[k] / b[k] for a, b in pairs) for k in range(2))
        table[f"ratio to {name}"] = {"wall": wall, "processor": processor}
        print(f"closedloop.gym / {name}: {wall:.2f} of wall time, {processor:.2f} of processor time")
    if given.json:
        write_whole(given.json, f"{json.dumps(table, indent=2)}\n".encode())
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
