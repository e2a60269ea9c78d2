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
# # One step away from the paper's plane
#
# The paper slides a tip over one rigid, level plane at rest. Each section below changes one thing of that: the surface
# is tilted, curved, moves, breathes, gives way, or ends; the arm holds a tool that its controller does not know. Before
# is always the paper's slide, after is the same scenario with the few keys that are shown.

# %%
# %matplotlib inline
import matplotlib.pyplot as plt
import numpy as np

import closedloop as cl
from closedloop.figures import STYLE

plt.rcParams.update(STYLE)
plt.rcParams["figure.dpi"] = 110


def run_with(**changes):
    """Return the paper's slide with some keys changed; `__` stands for the dot."""
    return cl.simulate(
        cl.load_scenario("wam_slide", {key.replace("__", "."): value for key, value in changes.items()}),
        engine="compiled",
    )


before = run_with()


def compare(after, *panels, name="after"):
    """Draw quantities of the paper's slide, and of another run, against time."""
    _, grid = plt.subplots(1, len(panels), figsize=(4.6 * len(panels), 2.8), layout="constrained", squeeze=False)
    for axes, (label, of) in zip(grid[0], panels, strict=True):
        axes.plot(before.time, of(before), color="0.6", label="before")
        axes.plot(after.time, of(after), label=name)
        axes.set(xlabel="time [s]", ylabel=label)
    grid[0, 0].legend()
    plt.show()


def say(run, what):
    """Print how far f is from what is commanded while the tip slides, after its start and before its stop."""
    error = (run.contact_force - run.reference_force)[(run.time > 1.0) & (run.time < 6.0)]
    rms, peak = np.sqrt(np.mean(error**2)), np.max(np.abs(error))
    print(f"{what:46} f off by {rms:8.4f} N RMS, {peak:8.4f} N at most")


FORCE = ("contact force f [N]", lambda run: run.contact_force)
say(before, "the paper's plane")

# %% [markdown]
# ## Tilted
#
# `surface.normal` is any vector. The path stays along the surface; n stands in Eq. 24 and in the law, and nothing else
# changes: f is as steady as on the level plane.

# %%
tilted = run_with(surface__normal=[0.34, 0.0, 0.94])
say(tilted, "tilted by 20 degrees")
compare(tilted, FORCE, ("joint torque Q2 [N m]", lambda run: run.torque[:, 1]))

# %% [markdown]
# ## Curved
#
# On a ball of 0.3 m the normal turns as the tip goes along it, so R in Eq. 2 depends on q, and Ṙ in Eq. 3 is no longer
# empty: ë has the term $\dot n^T \dot r$. Dropped, it would leave the tip off by a distance that grows with the
# square of the speed. The line of the path is laid onto the ball, and the tip keeps to it.


# %%
def turned(run):
    """Return by how much the normal has turned, degrees."""
    return np.degrees(np.arccos(np.clip(run.surface_normal @ run.surface_normal[0], -1.0, 1.0)))


ball = run_with(surface__kind="sphere", surface__radius=0.3)
say(ball, "a ball of 0.3 m")
print(f"the tip is off the ball by {np.max(np.abs(ball.closure_error)):.1e} m at most")
compare(
    ball, FORCE, ("normal turned by [degrees]", turned), ("height of the tip [mm]", lambda r: 1e3 * r.position[:, 2])
)

# %% [markdown]
# ## Moving along: a belt
#
# A belt that goes with 5 mm/s where the tip goes with 10 mm/s: v₀ of Eq. 2 is along the surface. Friction looks at the
# velocity of the tip *on the belt*. As long as the tip stays, the belt drags it forward; as it moves, it overtakes the
# belt and friction holds it back.

# %%
belt = run_with(
    surface_motion__kind="conveyor", surface_motion__velocity=[0.0, 0.005, 0.0],
    friction__kind="coulomb", friction__coefficient=0.1,
    law__pd_start=0.0,  # or the belt would take the tip along until the motion begins
)  # fmt: skip
say(belt, "a belt that rubs")
compare(belt, FORCE, ("friction along the path [N]", lambda run: run.friction_force[:, 1]))

# %% [markdown]
# ## Moving up and down: a patient who breathes
#
# Now v₀ and a₀ are along the normal. The paper's law presses with the force it computes from C, and has no term for a
# surface that takes the arm along. What that costs is the tip's mass times the surface's acceleration: little, as
# breath is slow. The path is laid onto the surface as it moves, so that the joint gains do not work against it.

# %%
breath = {"surface_motion__kind": "breathing", "surface_motion__amplitude": 0.01, "surface_motion__frequency": 0.5}
breathing = run_with(**breath, law__pd_start=0.0)
held = run_with(**breath, law__kind="operational_space", law__force_integral=20.0)
say(breathing, "breathes by 10 mm, the paper's law")
say(held, "breathes by 10 mm, operational space, integral")
compare(breathing, FORCE, ("height of the tip [mm]", lambda run: 1e3 * run.position[:, 2]), name="the paper's law")

# %% [markdown]
# ## Soft
#
# `[compliance]` puts a spring and a damper in place of the constraint. As the stiffness grows, f approaches the
# multiplier of Eq. 24 in proportion to 1/k.

# %%
rigid = run_with(time__integrator="rk4", reference__timing="minimum_jerk", time__duration=2.0)
stiffnesses, off = [1e3, 1e4, 1e5, 1e6], []
for k in stiffnesses:
    soft = run_with(
        time__integrator="rk4", reference__timing="minimum_jerk", time__duration=2.0, time__step=0.00025,
        compliance__kind="kelvin_voigt", compliance__stiffness=k, compliance__damping=2.0 * np.sqrt(k),
    )  # fmt: skip
    off.append(np.max(np.abs(soft.contact_force[::4] - rigid.contact_force)))
    print(f"k = {k:.0e} N/m: f is off the rigid surface's by {off[-1]:.1e} N at most")

figure, axes = plt.subplots(figsize=(4.6, 2.8), layout="constrained")
axes.loglog(stiffnesses, off, "o-", label="largest difference of f")
axes.loglog(stiffnesses, off[-1] * stiffnesses[-1] / np.array(stiffnesses), ":", color="0.4", label="slope −1")
axes.set(xlabel="stiffness k [N/m]", ylabel="difference [N]")
axes.legend()
plt.show()

# %% [markdown]
# ## With a tool, and a payload nobody mentioned
#
# A tool of 0.3 kg, 80 mm long, which the controller knows, changes nothing that can be seen. 200 g more which it does
# not know of press on the surface with their weight, and with what they do to the posture's lever. A force sensor and
# an integral find that out.

# %%
tool = {"tool__offset": [0.0, 0.0, 0.08], "tool__mass": 0.3, "tool__centre": [0.0, 0.0, 0.04]}
unknown = {**tool, "model_error__payload": 0.2, "law__pd_start": 0.0}
say(run_with(**tool), "a tool that is known")
loaded, felt = run_with(**unknown), run_with(**unknown, law__force_integral=20.0)
say(loaded, "and 200 g that are not")
say(felt, "the same, with an integral on the force")
compare(loaded, FORCE, name="200 g more")

# %% [markdown]
# ## Where the surface ends
#
# With `surface.extent` the plane is a plate. A path that would leave it is refused before anything is simulated, in one
# line. A plate that is drawn away from below the tip is left over its edge: contact ends at that instant, which is an
# event as a liftoff is.

# %%
try:
    run_with(surface__extent=[0.1, 0.04])
except cl.ScenarioError as error:
    print(error)

drawn = {
    "surface_motion__kind": "conveyor",
    "surface_motion__velocity": [0.02, 0.0, 0.0],
    "reference": {"kind": "hold"},
}
plate = run_with(**drawn, surface__extent=[0.05, 0.05], surface__contact="unilateral", time__duration=4.0)
for event in plate.events:
    print(f"{event.kind} at {event.time:.6f} s")
compare(plate, FORCE, ("height of the tip [mm]", lambda run: 1e3 * run.position[:, 2]))
