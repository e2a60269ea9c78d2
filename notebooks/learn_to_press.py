# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Learning to press
#
# An arm comes down 4 mm and is to press with 10 N. How stiff and how rough the surface is, and what the arm carries, is
# not known to it, and differs from episode to episode. A policy of four weights sees the error of the measured force,
# its sum, and whether there is contact, and commands the desired force of an impedance law a hundred times a second.
# The cross-entropy method finds the weights: candidates are drawn, the best are kept, and the next are drawn about
# them.
#
# The training here is short. `python -m validation.learning` trains longer and compares the policy with six control
# laws whose gains are tuned; its table is on the page about [environments](../docs/gym.md).

# %%
# %matplotlib inline
import sys
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import closedloop as cl
from closedloop.figures import STYLE
from closedloop.gym import TASKS
from validation.policy import Episodes, learn_to_press

plt.rcParams.update(STYLE)
plt.rcParams["figure.dpi"] = 100

policy, learned = learn_to_press(seconds=1.0, generations=6, candidates=16, worlds=4, of=12)
print("weights:", ", ".join(f"{weight:.2f}" for weight in policy.weights))
_, axes = plt.subplots(figsize=(6.0, 2.6))
axes.semilogy(range(1, 7), np.sqrt(learned.costs), "o-")
axes.set(xlabel="generation", ylabel="RMS error of the best [N]", title="learning")
# %% [markdown]
# ## On surfaces that it has not met
#
# Twelve held-out surfaces, each its own episode. For comparison: the impedance law that the policy commands, with a
# constant command of 10 N. It has no integral, so the unknown load and the bias of the sensor stay in the force.

# %%
task = TASKS["press"].changed({"overrides": {"time.duration": 1.0}})
held_out = Episodes(task, policies=1, worlds=12)
errors = held_out.errors(np.asarray(policy.weights)[None, :], range(5000, 5012))[0]
parameters = [dict(each) for each in held_out.core.parameters]
path = TASKS["press"].scenario


def press(changes, parameters):
    """Return the run of a law on a surface."""
    return cl.simulate(cl.load_scenario(path, {**parameters, "time.duration": 1.0, **changes}), progress=False)


def rms(run):
    """Return the RMS error of the force from 0.5 s on, N."""
    return float(np.sqrt(np.mean((run.contact_force[run.time > 0.5] - 10.0) ** 2)))


plain = [rms(press({}, each)) for each in parameters]
print(f"RMS error from 0.5 s on: policy {np.mean(errors):.2f} N, at the worst {np.max(errors):.2f} N")
print(f"constant command {np.mean(plain):.2f} N, at the worst {np.max(plain):.2f} N")

# %% [markdown]
# ## The policy as a control law
#
# The policy is written as a control law in a file of its own. `closedloop run SCENARIO --law.kind learned:Policy` uses
# it as any other; here `cl.simulate` does. The forces are those of the environment.

# %%
folder = tempfile.mkdtemp()
policy.write_law(Path(folder) / "learned.py", held_out.core)
sys.path.append(folder)  # the folder that a user would stand in
runs = [press({"law.kind": "learned:Policy"}, each) for each in parameters[:6]]
off = max(abs(rms(run) - error) for run, error in zip(runs, errors, strict=False))
print("as a law: the RMS error of six surfaces differs from the environment's by less than 0.01 N:", bool(off < 0.01))
_, axes = plt.subplots(figsize=(7.0, 3.0))
for run, each in zip(runs, parameters, strict=False):
    stiffness = each["compliance.stiffness"]
    axes.plot(run.time, run.contact_force, linewidth=1.0, label=f"{stiffness / 1e3:.0f} kN/m")
axes.axhline(10.0, color="0.6", linewidth=0.8)
axes.set(xlabel="t [s]", ylabel="f [N]", ylim=(0.0, 20.0), title="the learned law on held-out surfaces")
_ = axes.legend(title="stiffness", fontsize=8)
