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
# # Why it is unstable on steel
#
# A controller integrates the force error, $f_c = f_{des} + K \int (f_{des} - f)\,dt$. On a soft table it holds 10 N.
# On steel the same gain oscillates, and the oscillation grows. This notebook shows why, and what
# delay, sampling and elastic joints change.
#
# Each section has one figure of three parts. The first is a map: the gain at which a pole reaches the unit circle, for
# each value of one key. It is solved for, not sampled. The second shows the poles of two loops, one on either side of
# the boundary. The third shows whole nonlinear runs of the same two scenarios. A force sensor that reads 0.5 N too much
# gives both the same disturbance at t = 0.

# %%
# %matplotlib inline
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.ticker import NullFormatter

import closedloop as cl
from closedloop.figures import STYLE
from closedloop.studies.analysis.stability import Range, Stability

plt.rcParams.update(STYLE)
plt.rcParams["figure.dpi"] = 100

TABLE, STEEL = 5e4, 1e6  # N/m
GAIN = Range("law.force_integral", 1.0, 1000.0, log=True)
POINTS = 9


def press(**changes):
    """Return the soft table, pressed in one place, with keys of the scenario whose dots are two underscores."""
    fixed = {
        "reference.kind": "hold",
        "law.force_integral": 10.0,
        "compliance.damping": 60.0,
        "time.duration": 0.6,
        "time.step": 0.0005,
        "time.integrator": "rk4",
    }
    return cl.load_scenario("soft_table", fixed | {key.replace("__", "."): value for key, value in changes.items()})


def section(scenario, along, place, gains, label, scale=1.0):
    """Draw the boundary over a key, and the poles and runs of two gains at one value of it."""
    study = Stability(scenario, 0.1)
    boundary = study.boundary(GAIN, along, POINTS)
    x, y = np.array([(value, limit.value) for value, limit in boundary]).T
    _, (left, middle, right) = plt.subplots(1, 3, figsize=(11.0, 3.2), layout="constrained")
    left.plot(scale * x, y, color="k")
    left.fill_between(scale * x, y, GAIN.high, color="C1", alpha=0.15, linewidth=0.0)
    left.set(xscale="log" if along.log else "linear", yscale="log", xlabel=label, ylabel="K [1/s]")
    left.set(xlim=(scale * along.low, scale * along.high), ylim=(10.0, GAIN.high), title="unstable in the shaded part")
    for gain, colour in zip(gains, ("C0", "C1"), strict=True):
        values = {along.key: place, GAIN.key: gain}
        left.plot(scale * place, gain, "o", color=colour)
        poles = [pole for pole in study.loop(values).poles() if abs(pole.s) < 3e3 and not pole.at_rest]
        middle.plot([p.s.real for p in poles], [p.s.imag / (2.0 * np.pi) for p in poles], "x", color=colour)
        last = poles[0]
        run = cl.simulate(study.changed({**values, "sensor.bias": 0.5}), progress=False)
        right.plot(run.time, run.contact_force, color=colour, linewidth=1.0, label=f"K = {gain:g}")
        swing = np.ptp(run.contact_force[-200:]) / 2.0
        print(f"K = {gain:3.0f} 1/s: poles up to exp({last.s.real:+.1f} t), at {last.frequency:.1f} Hz", end="; ")
        print(f"f swings by {swing:.2g} N at the end" if swing > 1e-3 else "f is at rest at the end")
    left.xaxis.set_minor_formatter(NullFormatter())
    middle.axvline(0.0, color="0.6", linewidth=0.8)
    middle.set(xlabel="Re s [1/s]", ylabel="Im s [Hz]", xlim=(-200.0, 60.0), title="poles")
    right.set(xlabel="t [s]", ylabel="f [N]", ylim=(7.0, 13.0), title="two runs")
    right.legend(loc="upper right")
    return boundary


# %% [markdown]
# ## Stiffness
#
# A tip of mass $m$ on a surface $k, c$ has the poles of $m s^3 + (k + c s)(s + K)$, and is stable below
#
# $$ K = \frac{c k}{m k - c^2}. $$
#
# On a soft surface, with $k < c^2/m$, no gain is too large. The stiffer it is, the lower is the limit, down to $c/m$.
# So on steel the damping, and not the stiffness, says how fast the force may be controlled. The arm shows the same. Its
# own damping gains act on the tip too, so its limit on steel is above $c/m$.

# %%
stiffness = Range("compliance.stiffness", 1.2e4, STEEL, log=True)
boundary = section(press(), stiffness, STEEL, (100.0, 350.0), "stiffness k [N/m]")
for k, limit in boundary[::2]:
    print(f"k = {k:7.3g} N/m: unstable above K = {limit.value:5.1f} 1/s, then {limit.pole.frequency:5.1f} Hz")

# %% [markdown]
# ## Delay
#
# A sensor that is late by $T$ turns the loop by $\omega T$ at the frequency $\omega$. Where the loop is damped by the
# contact, this takes its damping away. On a table of 50 kN/m the limit falls by more than a third with the first
# millisecond.

# %%
delay = Range("sensor.delay", 0.0, 0.008)
table = press(compliance__stiffness=TABLE)
_ = section(table, delay, 0.002, (100.0, 200.0), "delay [ms]", 1e3)
# %% [markdown]
# ## Sampling
#
# A law that is evaluated every $T$ and held in between is late by $T/2$ on average. But its sensor is read at once. So
# a period costs less than a delay of the same length.

# %%
period = Range("law.sample_period", 0.0005, 0.0045)
_ = section(table, period, 0.004, (150.0, 250.0), "sample period [ms]", 1e3)
# %% [markdown]
# ## Elastic joints
#
# With a spring between motor and link the torque reaches the tip through another mass on a spring. The table of 10 kN/m
# is stable for every gain under an arm with stiff joints. With soft joints there is a limit. The positions are measured
# at the motors, as they are on most arms.

# %%
joints = Range("transmission.stiffness", 5e3, 1e5, log=True)
elastic = press(transmission__stiffness=1e4, transmission__damping=2.0, transmission__measured="motor")
_ = section(elastic, joints, 1e4, (100.0, 300.0), "joint stiffness [N m/rad]")
# %% [markdown]
# ## The gain, and the damping that allows it
#
# The last map has the damping of the contact along its axis, on steel. The limit grows with it along a straight line,
# $K = (c + c_0)/m$. Here $c_0$ is what the arm's own gains add, and $m$ the mass of the tip. So a controller for steel
# needs a lower gain, a pad on its tool, or damping of its own. The lines below the figure ask the other way: how stiff
# may the surface be for a given gain?

# %%
damping = Range("compliance.damping", 20.0, 200.0, log=True)
steel = press(compliance__stiffness=STEEL)
boundary = section(steel, damping, 40.0, (100.0, 250.0), "damping of the contact c [N s/m]")
c, K = np.array([(value, limit.value) for value, limit in boundary]).T
slope, first = np.polyfit(c, K, 1)
off = np.max(np.abs(slope * c + first - K) / K)
print(f"m = {1.0 / slope:.2f} kg, c0 = {first / slope:.0f} N s/m; the line is off by {100.0 * off:.1f} % at the most")
for gain in (200.0, 250.0, 400.0):
    limits, _ = Stability(press(law__force_integral=gain), 0.1).limits(stiffness)
    print(f"K = {gain:3.0f} 1/s: " + (f"a surface stiffer than {limits[0].value:.3g} N/m makes it unstable" if limits
                                      else f"stable up to {stiffness.high:.0e} N/m"))  # fmt: skip
