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
# # Figures 4–7: an arm slides along a plane and presses on it
#
# A Barrett WAM with four joints presses on a horizontal plane with 10 N. After half a second its tip starts to slide
# along +y at 10 mm/s; six seconds later it stops. At every step the equation of motion and the contact constraint
# are solved together,
#
# $$
# \begin{bmatrix} H & J_r^T n \\ n^T J_r & 0 \end{bmatrix}
# \begin{bmatrix} \ddot q \\ -f \end{bmatrix}
# = \begin{bmatrix} Q - C \\ b_s \end{bmatrix} \qquad \text{(Eq. 24)}
# $$
#
# so the contact force $f$ is the multiplier of a rigid constraint. The normal $n$ points out of the surface, and
# $f > 0$ means that the surface pushes the arm. The closure error $e = n \cdot r - d$ is the height of the tip above
# the surface. Row $k$ of every column belongs to the state at `time[k]`; units are SI.
#
# Two runs are compared. They differ in one line: the second is without Baumgarte's stabiliser.

# %%
# %matplotlib inline
import matplotlib.pyplot as plt
import numpy as np

import closedloop as cl
from closedloop.figures import STYLE, closure_error, contact_force, tip_position
from closedloop.record.report import energy_balance, print_report

plt.rcParams.update(STYLE)
plt.rcParams["figure.dpi"] = 120

stabilised = cl.halve(cl.load_scenario("wam_slide"))
unstabilised = cl.simulate(cl.load_scenario("wam_slide_unstabilised"))

scenario = stabilised.scenario
time, f = stabilised.time, stabilised.contact_force
h = scenario.time.step
start, stop = (round(t / h) for t in (scenario.reference.start, scenario.reference.stop))  # rows
print(stabilised)
print(unstabilised)

# %% [markdown]
# The stabiliser, the step, the 10 N and the half second are the paper's. It prints neither posture, path nor gains:
# these are the scenario's own, chosen so that the arm stretches out along y. The figures belong to these values: other
# gains give other transients, and with the elbow up the overshoot at the start would be a dip.

# %%
for section in ("start", "reference", "law", "stabiliser", "time"):
    print(f"{section:10}  {getattr(scenario, section)}")

# %% [markdown]
# ## Fig. 4: tip position

# %%
tip_position(stabilised)

# %%
moved = stabilised.position - stabilised.position[0]
print(f"y at the end      {1e3 * moved[-1, 1]:.3f} mm")
print(f"y at its largest  {1e3 * moved[:, 1].max():.3f} mm, at {time[moved[:, 1].argmax()]:.3f} s")
print(f"highest speed     {1e3 * np.linalg.norm(stabilised.velocity, axis=1).max():.2f} mm/s")
print(f"|x| at most       {1e9 * np.abs(moved[:, 0]).max():.1f} nm")
print(f"|z| at most       {1e9 * np.abs(moved[:, 2]).max():.2f} nm")

# %% [markdown]
# The tip follows the path. When the path stops, the tip runs on by some hundredths of a millimetre and is drawn back:
# the PD part of the law (Eq. 33) cannot stop a mass at once. The lower panel shows the two directions in which nothing
# should move. Along x the law alone holds the tip; along z the constraint does.

# %% [markdown]
# ## Fig. 5: contact force

# %%
contact_force(stabilised)

# %%
commanded = scenario.law.force
away = np.abs(f - commanded)


def back_within(tolerance, begin, end):
    """Return how long after row `begin` the force is out of the tolerance (N) for the last time, ms."""
    return 1e3 * h * (1 + np.flatnonzero(away[begin:end] > tolerance)[-1])


print(f"before the motion    f = {commanded:g} N to {away[:start].max():.0e} N")
print(f"lowest               f = {f.min():.2f} N, at {time[f.argmin()]:g} s")
print(f"highest              f = {f.max():.2f} N, at {time[f.argmax()]:g} s")
print(f"back within 0.01 N   {back_within(0.01, start, stop):.0f} ms and {back_within(0.01, stop, None):.0f} ms later")
print(f"in steady motion     |f - {commanded:g} N| up to {1e3 * away[start + 1000 : stop].max():.1f} mN")
print(f"at the end           f = {commanded:g} N to {away[-1]:.0e} N")

# %% [markdown]
# While the arm rests, the law asks for exactly the torque that balances gravity and presses with 10 N, and Eq. 24
# returns 10 N to rounding (the rounding of $r$, which the stabiliser multiplies by $s_p = 10^6\,\mathrm{s}^{-2}$). At
# both ends of the motion the velocity of the path jumps. The derivative term turns that jump into a jump of torque,
# $\Delta Q = K_d\, \Delta \dot q_{des}$, and a rigid contact answers in the same instant. With $A = n^T J_r$,
# Eq. 24 gives the size of the answer:
#
# $$ \Delta f = -\frac{A H^{-1} K_d\, \Delta \dot q_{des}}{A H^{-1} A^T} $$

# %%
arm = cl.Robot(stabilised.model, scenario.robot.tip)
n = np.array(scenario.surface.normal)
for name, k in (("start", start), ("stop", stop)):
    terms = arm.terms(stabilised.q[k], stabilised.v[k])
    A = n @ terms.jacobian
    HA = np.linalg.solve(terms.mass_matrix, A)
    step = stabilised.reference_velocity[k] - stabilised.reference_velocity[k - 1]
    predicted = -HA @ (np.array(scenario.law.kd) * step) / (HA @ A)
    print(f"{name:5}  predicted {predicted:+.4f} N, simulated {f[k] - f[k - 1]:+.4f} N")

# %% [markdown]
# The overshoot and the dip are therefore the law's answer to a path with velocity steps, not a property of the
# contact; they differ in size because the arm's pose does. A path that starts and stops with a continuous velocity has
# no such jump. The millinewtons in steady motion come from the inertia torque $H \ddot q_{des}$, which the law leaves
# out.

# %% [markdown]
# ## Fig. 6: closure error with the stabiliser

# %%
closure_error(stabilised)

# %%
e = stabilised.closure_error
part = np.abs(stabilised.stabiliser_force).max()
print(f"|e| at most                   {1e9 * np.abs(e).max():.2f} nm, at {time[np.abs(e).argmax()]:g} s")
middle = (start + stop) // 2
balance = -2 * scenario.stabiliser.damping_ratio * scenario.stabiliser.time_constant * stabilised.closure_rate
print(f"e halfway                     {1e9 * e[middle]:.4f} nm")
print(f"-2ζT times the rate of e      {1e9 * balance[middle]:.4f} nm")
print(f"the stabiliser's part of f    {1e3 * part:.2f} mN at most")

# %% [markdown]
# Differentiated twice, the constraint holds accelerations only; the stabiliser adds a damper on $\dot e$ and a spring
# on $e$ to it. Each step of the integrator leaves a little truncation error. In steady motion it shows as a rate
# $\dot e < 0$, and the spring balances the damper, $s_p e = -s_v \dot e$, which is $e = -2 \zeta T \dot e$: the tip
# runs a tenth of a nanometre above the surface. `stabiliser_force` is the share of $f$ that this costs.

# %% [markdown]
# ## Fig. 7: closure error without it

# %%
closure_error(unstabilised)

# %%
half = cl.simulate(cl.load_scenario("wam_slide_unstabilised", {"time.step": h / 2}))
drift = unstabilised.closure_error
slope = (drift[stop] - drift[start]) / (time[stop] - time[start])
print(f"e when the motion stops       {1e6 * drift[stop]:.2f} µm, a rate of {1e6 * slope:.2f} µm/s")
print(f"e at the end                  {1e6 * drift[-1]:.2f} µm")
print(f"the same with half the step   {1e6 * half.closure_error[-1]:.2f} µm")
print(f"f at the end                  {unstabilised.contact_force[-1]:.4f} N")
print(f"f differs from Fig. 5 by up to {1e3 * np.abs(unstabilised.contact_force - f).max():.1f} mN")

# %% [markdown]
# Nothing removes the truncation error now, and the tip sinks through the surface as long as it moves. Half the step
# gives half the drift: it is the error of a first-order integrator, not of the model. After the stop a small rate
# $\dot e$ remains, and $e$ goes on growing with it. The law sees the lowered tip as a position error and lifts it,
# which is why $f$ does not return to 10 N exactly. Eq. 24 still reports the force of a rigid contact although the tip
# has left the surface by half a micrometre; only the column `closure_error` tells.

# %% [markdown]
# ## Energy, and the assumptions
#
# What the joint torques and the contact force put in must be found again as kinetic and potential energy. The
# difference is the integrator's error, and falls with the step.

# %%
finer = cl.simulate(cl.load_scenario("wam_slide", {"time.step": h / 2}))
for run in (stabilised, finer):
    residual, exchanged = energy_balance(run)
    print(
        f"step {1e3 * run.scenario.time.step:g} ms: {1e6 * np.abs(residual).max():.0f} µJ unaccounted for at most, "
        f"of {exchanged[-1]:.3f} J exchanged"
    )

# %% [markdown]
# The paper assumes one loop, contact in a single point, no loss of contact, no friction and no singular pose. Every run
# checks them at every row.

# %%
print_report(stabilised)

# %% [markdown]
# Without the stabiliser they count as held too: they concern Eq. 24, which is solved to rounding in that run as well.
# The drift of Fig. 7 is no breach of an assumption but an error of the integration, and stands in the second table of
# its report.

# %%
for name, verdict in unstabilised.summary()["assumptions"].items():
    print(f"{name:13}  {'held' if verdict['held'] else 'NOT held':8}  {verdict['measured']}")
print(f"closure error  {unstabilised.summary()['max_abs_closure_error']:.1e} m at most")
