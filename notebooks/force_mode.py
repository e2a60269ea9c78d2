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
# # An industrial arm that presses
#
# Most industrial arms take set points, not torques. Their force mode moves the set points of a position servo until the
# force is the wanted one. This notebook simulates a UR10e with elastic joints that comes down in such a mode. Its
# numbers are near those of a fit to measured forces, see the page *Against a robot that presses*; the measurements
# themselves have another licence and are not shown.

# %%
# %matplotlib inline
import matplotlib.pyplot as plt
import numpy as np

import closedloop as cl
from closedloop.figures import STYLE
from validation.measured.pressing.judging import swing_pole
from validation.measured.pressing.machine import CONTACT, MACHINE, Touchdown, contact_time, scenario

plt.rcParams.update(STYLE)
plt.rcParams["figure.dpi"] = 100

VALUES = {p.name: p.first for p in (*MACHINE, *CONTACT)}
NONE = np.zeros(0)


def pressed(force, gain, place="straight", speed=0.2):
    """Return a touchdown of this force, N, gain scaling and speed, m/s."""
    return Touchdown(f"{force:g} N, gain {gain:g}", place, force, gain, 0.25, speed, 3.2, NONE, NONE)


def touchdown(one, changes=None):
    """Return time since the first contact, s, and force, N."""
    run = cl.simulate(scenario(VALUES, one).replace(changes or {}), engine="compiled")
    return run.time - contact_time(run.time, run.contact_force), run.contact_force


# %% [markdown]
# ## Touchdown
#
# The tool strikes with several times the commanded force, because the arm has to be stopped and the force mode is too
# slow to help. Then it bounces, swings and settles. With half the gain scaling it swings more slowly, and longer.

# %%
figure, axes = plt.subplots(1, 2, figsize=(9, 3.2), layout="constrained")
for gain in (0.5, 1.0):
    time, force = touchdown(pressed(55.0, gain))
    for axis, span in zip(axes, (0.06, 2.0), strict=True):
        shown = time < span
        axis.plot(time[shown], force[shown], label=f"gain scaling {gain:g}")
    print(f"gain scaling {gain:g}: first peak {force[time < 0.06].max():.0f} N of 55 N commanded")
axes[1].set_ylim(-5.0, 180.0)
axes[1].legend()
for axis in axes:
    axis.set(xlabel="time from first contact, s", ylabel="force, N")

# %% [markdown]
# ## Friction makes it swing faster
#
# While the tip sticks, it cannot move along the surface. The arm cannot yield sideways then, and is stiffer along the
# normal. How long it sticks depends on the force: friction holds at most $\mu f$.

# %%
figure, axis = plt.subplots(figsize=(9, 3.2), layout="constrained")
for label, changes in (("friction 0.15", {}), ("no friction", {"friction": {"kind": "none"}})):
    time, force = touchdown(pressed(55.0, 1.0), changes)
    shown = time < 1.5
    axis.plot(time[shown], force[shown], label=label)
axis.set(xlabel="time from first contact, s", ylabel="force, N", ylim=(0.0, 150.0))
legend = axis.legend()
# %% [markdown]
# ## Why it swings
#
# The slowest pole of the loop at rest belongs to the law: the mass of its set point swings on the stiffness of servo
# and joints. The gain scaling divides that mass. No gain scaling stops the swing: a small one makes it slow, and above
# about 2.2 the loop is unstable. The stiffness of the surface hardly matters, because servo and joints are much softer.

# %%
figure, axes = plt.subplots(1, 2, figsize=(9, 3.2), layout="constrained")
gains = (0.125, 0.25, 0.5, 1.0)
for stiffer in (0.1, 1.0, 10.0):
    VALUES["stiffness_direct"] *= stiffer
    poles = [swing_pole(VALUES, pressed(100.0, gain, "direct", 0.09)) for gain in gains]
    VALUES["stiffness_direct"] /= stiffer
    axes[0].plot(gains, [pole.frequency for pole in poles], "o-", label=f"surface {stiffer:g} times as stiff")
    axes[1].plot(gains, [pole.damping for pole in poles], "o-")
    if stiffer == 1.0:
        for gain, pole in zip(gains, poles, strict=True):
            print(f"gain scaling {gain:.3g}: {pole.frequency:.2f} Hz, damping ratio {pole.damping:.3f}")
axes[0].set(xlabel="gain scaling", ylabel="frequency, Hz")
axes[1].set(xlabel="gain scaling", ylabel="damping ratio")
legend = axes[0].legend()
# %% [markdown]
# ## What stops it
#
# Damping does: the manual of the force mode has a key for it, which was set to 0 in the tests.

# %%
figure, axis = plt.subplots(figsize=(9, 3.2), layout="constrained")
for damping in (0.0, 500.0, 1000.0):
    time, force = touchdown(pressed(55.0, 1.0), {"law.admittance_damping": damping})
    shown = time < 1.5
    axis.plot(time[shown], force[shown], label=f"damping {damping:g} N s/m more")
axis.set(xlabel="time from first contact, s", ylabel="force, N", ylim=(0.0, 150.0))
legend = axis.legend()
