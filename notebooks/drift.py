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
# # How far does the tip leave the surface?
#
# Eq. 24 holds the *acceleration* of the closure: $\ddot e = 0$. What an integrator leaves out of a step stays in $e$.
# The paper observes that the drift is worse at a lower sampling rate and at a higher speed. Here both are measured, as
# exponents, on the paper's slide without its stabiliser.

# %%
# %matplotlib inline
import matplotlib.pyplot as plt

from closedloop.figures import STYLE
from closedloop.mechanics.closure.baumgarte import recommended_ratio, spectral_radius
from validation.studies.drift import measure, power_laws, print_tables, stability_map

plt.rcParams.update(STYLE)
plt.rcParams["figure.dpi"] = 120
results = measure(quick=True)
print_tables(results)

# %% [markdown]
# ## Drift against step and speed
#
# An integrator of order $p$ leaves $h^p$ in $e$: a straight line of slope $p$ on logarithmic axes. What it leaves out
# is made of the velocity products of the closure, so the slope against the speed is 2, whatever the integrator. At ten
# times the sampling rate an Euler scheme drifts ten times less, RK4 ten thousand times less. Neither stops drifting.
#
# With Baumgarte's stabiliser $e$ settles instead of growing. A step of an Euler scheme leaves
# $\delta \sim h^2 v^2$ in $e$, and it takes $e = 2 \zeta T \delta / h$ to pull it back at that rate; RK4 errs by
# $h^4/T^2$ where it follows the stabiliser. With a $T$ of two steps both are $h^2$ (second table). The adaptive
# DOP853 has a tolerance in place of a step, and drifts in proportion to it (third table).

# %%
figure, (left, right) = plt.subplots(1, 2, figsize=(7.2, 5.4), sharey=True, layout="constrained")
power_laws(left, results["against_step"], 1e3, "step h [ms]", "h")
power_laws(right, results["against_speed"], 1e3, "tip speed v [mm/s]", "v")
left.set_ylabel("largest |e| [m]")
plt.show()

# %% [markdown]
# ## Where Baumgarte's stabiliser shakes loose
#
# $\ddot e + s_v \dot e + s_p e = 0$ is an oscillator, and an integrator turns it into a linear map of
# $(e, h \dot e)$. It is stable inside the line where the largest eigenvalue of that map has size one. The marks are
# measured: a two-joint arm is pressed on a surface from a start 1 µm off it, and the limit found by bisection of runs.
# The paper's choice, $s_v = 1414$ 1/s and $s_p = 10^6$ 1/s² at 1 kHz, stands just inside the limit of semi-implicit
# Euler.

# %%
figure, axes = plt.subplots(figsize=(7.2, 3.8), layout="constrained")
stability_map(axes, results["limits"])
plt.show()

# %% [markdown]
# ## What to choose
#
# `stabiliser.time_constant = "auto"` takes a $T$ of two steps, or twice the shortest stable one if that is longer: far
# enough from the limit for $e$ not to ring, and long enough for the stabiliser not to move $f$. The paper's choice
# multiplies an error by −0.88 at every step.

# %%
ratio = recommended_ratio("semi_implicit_euler", 0.707)
print(f"auto: T = {1 / ratio:.3f} h, e falls to {spectral_radius('semi_implicit_euler', 0.707, ratio):.3f} in a step")
print(f"the paper at 1 kHz: T = h, e falls to {spectral_radius('semi_implicit_euler', 0.707, 1.0):.3f} in a step")
