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
# # From a log to a controller
#
# A robot presses on a table that nobody has measured. This notebook takes a log of it, identifies the contact, builds a
# scenario from what was found, chooses the gain of the force integral on that scenario, and tries it on the robot.
# The robot here is a simulation too, with parameters that the rest of the notebook does not use. With a log of a
# real one, in CSV, Parquet, NetCDF, MCAP or rosbag2, begin at the second section.

# %%
# %matplotlib inline
import matplotlib.pyplot as plt
import numpy as np

import closedloop as cl
import robot_models
from closedloop.figures import STYLE
from closedloop.mechanics.robot.pinocchio import Robot

plt.rcParams.update(STYLE)
plt.rcParams["figure.dpi"] = 110

ARM = {
    "start.q": [np.pi / 2, 1.0, 0.0, 2.0],
    "surface.contact": "unilateral", "stabiliser.kind": "none", "time.integrator": "rk4", "time.step": 0.0005,
    "law": {"kind": "impedance", "force": 10.0, "sample_period": 0.001},
}  # fmt: skip
TABLE = {
    "compliance": {"kind": "kelvin_voigt", "stiffness": 8000.0, "damping": 60.0},
    "friction": {"kind": "coulomb_viscous", "coefficient": 0.3, "viscous": 8.0},
    "sensor": {"noise": 0.1, "delay": 0.002, "bias": 0.0},
}
PROBE = {
    "surface.gap": 0.005, "time.duration": 3.4,
    "law": {
        "kind": "impedance", "force": 0.0, "normal_stiffness": 2000.0, "normal_damping": 60.0, "stiffness": 2000.0,
        "damping": 120.0, "sample_period": 0.001,
    },
    "reference": {
        "kind": "waypoints",
        "times": [0.0, 0.5, 0.8, 1.0, 1.4, 1.6, 2.0, 2.15, 2.4, 2.6, 3.0],
        "points": [
            [0, 0, 0], [0, 0, 0.002], [0, 0, -0.012], [0, 0.01, -0.016], [0, 0.05, -0.010], [0, 0.06, -0.018],
            [0, 0.02, -0.009], [0, -0.02, -0.015], [0, -0.03, -0.009], [0, 0, -0.014], [0, 0, 0.003],
        ],
    },
}  # fmt: skip


def scenario(*parts):
    """Return the paper's slide with sections and keys of the parts in place of its own."""
    return cl.load_scenario("wam_slide", {key: value for part in parts for key, value in part.items()})


# %% [markdown]
# ## A log
#
# A careful motion: above the table, down, to and fro at several speeds and depths, and up. Such a motion tells friction
# from viscous friction, stiffness from damping, and the sensor's bias from both. The log has joint positions with the
# noise of encoders, torques, and a force with noise that comes 2 ms late.

# %%
robot = cl.simulate(scenario(ARM, TABLE, PROBE), progress=False)
rng = np.random.default_rng(0)
late = np.stack([np.interp(robot.time - 0.002, robot.time, column) for column in robot.tip_force.T], axis=1)
axes, _ = Robot(robot.model).frame_poses("tip", robot.q)
force = late + axes @ [0.0, 0.0, 0.4] + 0.1 * rng.normal(size=late.shape)
log = cl.Recording(robot.time, robot.q + 1e-5 * rng.normal(size=robot.q.shape), robot.torque, force, "probe")

_, panels = plt.subplots(1, 2, figsize=(9, 2.8), layout="constrained")
panels[0].plot(log.time, log.force, label=["x", "y", "z"])
panels[0].set(xlabel="time [s]", ylabel="force on the tip [N]")
panels[0].legend()
panels[1].plot(robot.time, 1e3 * (robot.position - robot.position[0]), label=["x", "y", "z"])
panels[1].set(xlabel="time [s]", ylabel="tip from its start [mm]")
plt.show()

# %% [markdown]
# ## What the log says
#
# Every value has a 95 % interval. What the log does not tell has a reason and a cure, here the payload: the tool never
# turned. The model misses nothing: no residual is left that is not noise.

# %%
found = cl.identify_contact(log, robot_models.load("wam4"))
print("\n".join(found.lines()))
found.figure()

# %% [markdown]
# ## A scenario from it
#
# The values found take the place of the table, and those of the sensor too, with its delay in whole samples.

# %%
value = {e.name: e.value for e in found.estimates if not e.why}
MODEL = {
    "compliance": {"kind": "kelvin_voigt", "stiffness": value["stiffness"], "damping": value["damping"]},
    "friction": {"kind": "coulomb_viscous", "coefficient": value["friction"], "viscous": value["viscous_friction"]},
    "sensor": {"noise": 0.1, "delay": 0.001 * round(1e3 * value["sensor_delay"]), "bias": 0.0},
}
SLIDE = {
    "time.duration": 2.5,
    "reference": {
        "kind": "line", "direction": [0, 1, 0], "speed": 0.05, "start": 0.5, "stop": 2.0, "timing": "minimum_jerk",
    },
}  # fmt: skip


def slide(table, gain):
    """Return a slide with a gain of the force integral, 1/s."""
    return cl.simulate(scenario(ARM, table, SLIDE, {"law.force_integral": float(gain)}), progress=False)


def off(run):
    """Return the RMS of the force error while the tip slides, N."""
    sliding = (run.time > 0.5) & (run.time < 2.0)
    return float(np.sqrt(np.mean((run.contact_force - 10.0)[sliding] ** 2)))


# %% [markdown]
# ## A gain, chosen on the scenario
#
# Without the integral the force is off by what the law does not know. A larger gain takes that away sooner, until
# the delay of the sensor makes the loop swing.

# %%
gains = [2, 5, 10, 20, 40, 80, 160, 240]
predicted = [off(slide(MODEL, gain)) for gain in gains]
best = gains[int(np.argmin(predicted))]
print(f"best on the scenario: K_I = {best} 1/s, {min(predicted):.3f} N RMS")

# %% [markdown]
# ## On the robot
#
# The same gains on the robot: the scenario has predicted its error, and its best gain is the robot's.

# %%
measured = [off(slide(TABLE, gain)) for gain in gains]
run = slide(TABLE, best)
_, panels = plt.subplots(1, 2, figsize=(9, 2.8), layout="constrained")
panels[0].loglog(gains, predicted, "o-", label="predicted by the scenario")
panels[0].loglog(gains, measured, "x--", label="robot")
panels[0].set(xlabel="gain of the force integral [1/s]", ylabel="force off by [N RMS]")
panels[0].legend()
panels[1].plot(run.time, run.contact_force, color="0.7", label="force")
panels[1].plot(run.time, slide(MODEL, best).contact_force, label="predicted")
panels[1].axhline(10.0, color="k", lw=0.8)
panels[1].set(xlabel="time [s]", ylabel="contact force [N]")
panels[1].legend()
plt.show()
for gain, p, m in zip(gains, predicted, measured, strict=True):
    print(f"K_I = {gain:4} 1/s: predicted {p:.3f} N, robot {m:.3f} N")

# %% [markdown]
# ## The robot's run over the scenario
#
# `compare_log` lays the run of the robot over the scenario, names what explains the difference, and says whether the
# force of the log is consistent with its own motion and torques. The delay was rounded to whole samples.

# %%
compared = cl.compare_log(run, scenario(ARM, MODEL, SLIDE, {"law.force_integral": float(best)}))
difference = compared.differences["force"]
print(f"force of the robot less the scenario's: {difference.rms[0]:.2g} N RMS of {difference.size[0]:.1f} N")
for reason in difference.reasons:
    print(f"explained by {reason.name}: {100 * reason.alone:.0f} %")
print(compared.audit.lines()[-1])
