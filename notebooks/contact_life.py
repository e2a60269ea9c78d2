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
# # The life of a contact
#
# With `surface.contact = "unilateral"` the tip may touch the surface and leave it. It is free, with
# $H \ddot q + C = Q$, or constrained, with Eq. 24 and $f > 0$. Between the two there are four ways to go:
#
# | from | to | what happens | event |
# |---|---|---|---|
# | free | free | the tip meets the surface and bounces | impact |
# | free | constrained | it meets the surface and stays | touchdown |
# | constrained | constrained | it rests or slides, $f > 0$ | none |
# | constrained | free | $f$ has fallen to zero, and the tip leaves | liftoff |
#
# Events happen at their own instants, between the rows of the record. A tip that arrives with the rate $\dot e^-< 0$
# gets an impulse, which is no part of $f$: with the coefficient of restitution $\varepsilon$ and the effective mass of
# the tip along the normal, $m = (A H^{-1} A^T)^{-1}$,
#
# $$ \dot e^+ = -\varepsilon\, \dot e^-, \qquad P = (1 + \varepsilon)\, m\, |\dot e^-|, \qquad
#    \Delta E = \tfrac{1}{2} (1 - \varepsilon^2)\, m\, (\dot e^-)^2 . $$

# %%
# %matplotlib inline
import matplotlib.pyplot as plt
import numpy as np

import closedloop as cl
from closedloop.figures import STYLE, closure_error, contact_force, impacts
from closedloop.record.report import print_report

plt.rcParams.update(STYLE)
plt.rcParams["figure.dpi"] = 100

names = ("wam_touchdown", "wam_bounce", "wam_edge", "wam_liftoff")
touchdown, bounce, edge, liftoff = (cl.simulate(cl.load_scenario(name)) for name in names)

print("                 free     free  constr.  constr.")
print("               > free  > cons.  > cons.  > free")
for run in (touchdown, bounce, edge, liftoff):
    count = run.summary()["events"]
    kept = np.count_nonzero((run.mode[:-1] == 1) & (run.mode[1:] == 1))
    print(f"{run.scenario.name:13}  {count['impact']:6}   {count['touchdown']:6}   {kept:6}   {count['liftoff']:5}")

# %% [markdown]
# ## A ball, for which everything is known
#
# A point of 2 kg falls from $h = 1$ m and bounces with $\varepsilon = 0.9$. It arrives at $t_1 = \sqrt{2h/g}$, each
# flight is $\varepsilon$ times as long as the one before, and impact $n$ is at
# $t_1 + 2 t_1 \sum_{k=1}^{n-1} \varepsilon^k$. There are infinitely many of them before the Zeno time
# $t_1 (1 + \varepsilon)/(1 - \varepsilon)$. The law is a function of our own: no torque at all.


# %%
def no_torque(t, q, v, terms):
    return np.zeros(3)


g, h, eps, mass = 9.81, 1.0, 0.9, 2.0
scenario = cl.load_scenario(
    "planar2_drop",
    {
        "robot.model": "pointmass3",
        "surface.offset": 0.0,
        "surface.gap": 0.0,
        "start.q": [0.0, 0.0, h],
        "start.v": [0.0, 0.0, 0.0],
        "impact.restitution": eps,
        "stabiliser.kind": "projection",
        "time.integrator": "rk4",
        "time.step": 0.01,
        "time.duration": 9.5,
    },
)
ball = cl.simulate(scenario, law=no_torque)
closure_error(ball)

# %%
t1 = np.sqrt(2 * h / g)
closed = t1 + 2 * t1 * np.concatenate([[0.0], np.cumsum(eps ** np.arange(1, len(ball.events)))])
print("impact   simulated [s]   closed form [s]   difference [s]")
for n in (1, 2, 3, 10, 50, len(ball.events)):
    simulated, exact = ball.event_time[n - 1], closed[n - 1]
    print(f"{n:6}   {simulated:13.10f}   {exact:15.10f}   {simulated - exact:14.0e}")

last = ball.events[-1]
left = 2 * last.rate_cut / (g * (1 - eps))
print(f"Zeno time, closed form       {t1 * (1 + eps) / (1 - eps):.12f} s")
print(f"the last event               {last.time:.12f} s, a {last.kind}")
print(f"bounces that were cut away   {left:.12f} s")
print(f"together                     {last.time + left:.12f} s")

# %% [markdown]
# RK4 follows a parabola exactly, whatever its step, so what remains is rounding. No simulator can go through
# infinitely many bounces: one that would leave with less than `impact.rest_speed` is cut, and the ball rests. The
# bounces that were still to come are known from the rate that was cut off, and with them the Zeno time comes out.

# %%
impacts(ball)

# %%
u = ball.event_rate_before[:-1]
lost = 0.5 * (1 - eps**2) * mass * u**2
worst = np.max(np.abs(ball.event_energy_lost[:-1] / lost - 1))
print(f"energy lost in the first impact   {ball.event_energy_lost[0]:.9f} J, by the formula {lost[0]:.9f} J")
print(f"in all impacts                    {np.sum(ball.event_energy_lost):.9f} J, of m g h = {mass * g * h:.2f} J")
print(f"impacts                           {len(u)}, each as the formula says to {worst:.0e} of itself")

# %% [markdown]
# Rates and impulses fall by 0.9 from one impact to the next, losses by 0.81. In time the impacts crowd together before
# the Zeno time: that is why all three curves end in a fall.

# %% [markdown]
# ## Free to constrained: an arm comes down (`wam_touchdown`)

# %%
contact_force(touchdown)

# %%
arm = cl.Robot(touchdown.model, touchdown.scenario.robot.tip)
n = np.array(touchdown.scenario.surface.normal)


def effective_mass(run, t):
    """Return the tip's effective mass along the normal in the last row before t, kg."""
    k = np.searchsorted(run.time, t) - 1
    terms = arm.terms(run.q[k], run.v[k])
    A = n @ terms.jacobian
    return 1 / (A @ np.linalg.solve(terms.mass_matrix, A))


print("time [s]   event        rate [m/s]   after/before   loss [J]   by the formula [J]")
for event in touchdown.events:
    share = -event.rate_after / event.rate_before
    formula = 0.5 * (1 - share**2) * effective_mass(touchdown, event.time) * event.rate_before**2
    print(
        f"{event.time:.6f}   {event.kind:9}   {event.rate_before:11.3e}   {share:12.2f}   "
        f"{event.energy_lost:.2e}   {formula:.2e}"
    )
first = np.flatnonzero(touchdown.mode == 1)[0]
arrival = touchdown.scenario.reference.times[1]
print(f"f in the first row of contact   {touchdown.contact_force[first]:.2f} N")
print(f"f when the path arrives, {arrival:g} s   {touchdown.contact_force[round(arrival / 0.001)]:.2f} N")
print(f"f at the end                    {touchdown.contact_force[-1]:.4f} N")

# %% [markdown]
# The law presses with 10 N even while the tip is free, so the tip runs ahead of its path and meets the surface half a
# second early. It bounces three times, each time more slowly; a fourth bounce would be slower than `impact.rest_speed`,
# and that is the touchdown. The force does not start at 10 N because the PD part still holds the tip back on its path;
# it has 10 N when the path arrives.

# %% [markdown]
# ## Free to free: an arm bounces (`wam_bounce`)

# %%
closure_error(bounce)

# %%
m = effective_mass(bounce, bounce.event_time[0])
fall = np.sqrt(2 * bounce.closure_error[0] * m / bounce.scenario.law.force)
ratios = -bounce.event_rate_after[:-1] / bounce.event_rate_before[:-1]
print(f"effective mass of the tip          {m:.3f} kg")
print(f"first impact                       {bounce.event_time[0]:.4f} s; a ball of that mass under 10 N {fall:.4f} s")
print(f"after/before, least and greatest   {ratios.min():.6f} and {ratios.max():.6f}")
print(f"bouncing                           {len(ratios)} times, to {bounce.event_time[-1]:.4f} s")
print(f"f after that                       {bounce.contact_force[-1]:.4f} N")

# %% [markdown]
# With its weight compensated and $K_p = 0$ the arm falls under the pressing force alone, as a ball of the tip's
# effective mass would, but for the change of that mass on the way and the damping $K_d$. In the lower panel the error
# of the constraint exists only in contact: before that, $e$ is a gap.

# %% [markdown]
# ## Constrained to free: the surface lets go (`wam_liftoff`)

# %%
contact_force(liftoff)

# %%
(event,) = liftoff.events
k = np.searchsorted(liftoff.time, event.time) - 1  # the last row before it
f, time = liftoff.contact_force, liftoff.time
straight = time[k] - f[k] * (time[k] - time[k - 1]) / (f[k] - f[k - 1])
print(f"f in the last row of contact   {f[k]:.4f} N, at {time[k]:.3f} s")
print(f"f drawn on to zero             {straight:.5f} s")
print(f"liftoff                        {event.time:.5f} s")
print(f"f in the first free row        {f[k + 1]:.4f} N")
print(f"impulse and energy lost        {event.compression + event.decompression:.0e} N s, {event.energy_lost:.0e} J")

# %% [markdown]
# Leaving is gentle: no impulse, no jump of the velocity, only a force that arrives at zero between two rows. A surface
# that could pull (`contact = "bilateral"`) would go on holding the tip with a negative $f$.

# %% [markdown]
# ## All four in one run (`wam_edge`)
#
# The commanded force runs from 10 N to −4 N and back while the tip slides.

# %%
contact_force(edge)

# %%
leaves = next(e for e in edge.events if e.kind == "liftoff")
returns = next(e for e in edge.events if e.kind == "touchdown")
profile = edge.scenario.force_profile
(a, b, c, d), (high, low, _, _) = profile.times, profile.forces
down, up = a + (b - a) * high / (high - low), c + (d - c) * low / (low - high)
print(f"commanded force below zero    from {down:.4f} to {up:.4f} s")
print(f"tip off the surface           from {leaves.time:.4f} to {returns.time:.4f} s")
print(f"largest gap                   {1e3 * edge.closure_error.max():.2f} mm")
print(f"energy lost as it comes back  {1e6 * np.sum(edge.event_energy_lost):.1f} µJ")

# %% [markdown]
# The tip leaves a millisecond before the command changes its sign: some millinewtons of the force answer the inertia
# torque of the sliding motion, which the law leaves out. While the tip is free the PD part alone holds it against 4 N,
# and that is the gap. The tip is back later than the command, since it has the gap to come down.

# %% [markdown]
# ## Constrained all along
#
# A contact that never breaks is the paper's: with a unilateral surface `wam_slide` is the same run to the last bit.

# %%
held = cl.simulate(cl.load_scenario("wam_slide"))
loose = cl.simulate(cl.load_scenario("wam_slide", {"surface.contact": "unilateral"}))
print(f"number of events         {len(loose.events)}")
print(f"largest difference of f  {np.max(np.abs(held.contact_force - loose.contact_force)):.0e} N")
print(f"largest difference of q  {np.max(np.abs(held.q - loose.q)):.0e} rad")

# %% [markdown]
# ## What the report says
#
# Of the paper's five assumptions one does not hold in such a run, and the report says for how long. The table of
# events follows.

# %%
print_report(cl.halve(touchdown.scenario))
