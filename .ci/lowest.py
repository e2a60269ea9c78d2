"""With the lowest versions that pyproject.toml allows: all modules are imported, and each library is used once."""

from importlib import import_module
from pathlib import Path
from pkgutil import walk_packages

import gymnasium
import numpy as np

import closedloop as cl
import closedloop.gym
from closedloop.__main__ import main

for package in ("closedloop", "robot_models", "validation"):
    for module in walk_packages(import_module(package).__path__, f"{package}."):
        if not module.name.endswith("__main__"):
            import_module(module.name)
assert main(["run", "planar2_slide", "--strict", "--time.duration", "0.6", "--out", "out"]) == 0  # with its figures
run = cl.load_run(Path("out/run.nc"))
assert len(run.to_pandas()) == len(run) == 601
for kind in ("csv", "mcap"):
    assert main(["export", "out/run.nc", "--to", kind, "--out", f"out/run.{kind}"]) == 0
assert cl.linearise(cl.load_scenario("planar2_slide")).to_control().dt == 0.001
assert main(["completion", "bash"]) == 0
cl.load_scenario("wam_slide", {"robot.model": "panda", "start.q": None}).to_toml()
env = gymnasium.make("closedloop/Press-v0")
env.reset(seed=0)
assert np.isfinite(env.step(env.action_space.sample())[1])
print("the lowest versions do")
