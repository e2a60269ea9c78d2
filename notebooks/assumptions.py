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
# # The paper's five assumptions, one at a time
#
# The method is derived for one closed loop, contact in one point that is never lost, a surface without friction, and
# postures that are not singular. Each section lifts one of the five: before, the run that keeps to it; after, one that
# does not. Every run watches all five and says which held.

# %%
# %matplotlib inline
import matplotlib.pyplot as plt
import numpy as np

import closedloop as cl
from closedloop.figures import STYLE

plt.rcParams.update(STYLE)
plt.rcParams["figure.dpi"] = 110


def simulate(name, **changes):
    """Return a run of a shipped scenario with some keys changed; `__` stands for the dot."""
    keys = {key.replace("__", "."): value for key, value in changes.items()}
    return cl.simulate(cl.load_scenario(name, keys))


def held(run):
    """Print which of the assumptions held, and what decided."""
    for name, found in run.summary()["assumptions"].items():
        print(f"  {name:13} {'held' if found['held'] else 'did not hold':13} {found['measured']}")


def draw(before, after, label, of, names=("before", "after"), scale="linear"):
    """Draw a quantity of two runs against time."""
    _, axes = plt.subplots(figsize=(7.0, 2.6), layout="constrained")
    axes.plot(before.time, of(before), color="0.6", label=names[0])
    axes.plot(after.time, of(after), label=names[1])
    axes.set(xlabel="time [s]", ylabel=label, yscale=scale)
    axes.legend()
    plt.show()


def force(run):
    """Return f, N."""
    return run.contact_force


paper = simulate("wam_slide")
print("wam_slide")
held(paper)

# %% [markdown]
# ## One loop
#
# The chain of links from the base to the tip and back through the surface is the only loop. `five_bar` presses and
# slides as the paper's arm does, on an arm which is a loop itself: two drives, four bars, a pin that closes them. The
# loop is closed to rounding, and the reaction of its pin is a result like the contact force
# ([mechanisms with loops](../docs/loops.md)).

# %%
five = simulate("five_bar", time__duration=2.0)
loops = five.loops
print(f"rows of the loop {len(loops.labels)}, independent {loops.rank[0]}")
print(f"largest error of the closed loop {np.max(np.abs(loops.errors)):.0e} m")
print(f"torque that neither law, contact nor loop explains {np.max(loops.unexplained):.0e} N m")
for label, unit, reaction in zip(loops.labels, loops.units, loops.reactions.T, strict=True):
    print(f"  {label:28} {reaction[-1]:9.3f} {unit}")
_, axes = plt.subplots(figsize=(7.0, 2.6), layout="constrained")
axes.plot(five.time, force(five), color="0.6", label="on the tip")
axes.plot(five.time, np.linalg.norm(loops.reactions[:, :3], axis=1), label="in the pin")
axes.set(xlabel="time [s]", ylabel="force [N]")
axes.legend()
plt.show()
held(five)

# %% [markdown]
# ## Contact in one point
#
# `gripper_gear` has six contacts: two fingers with two points each, and two feet of the block on the floor. All are
# solved for at once, each free, sliding or stuck. Four forces of the fingers hold one block, so they are not unique:
# those of least norm are given ([several contacts](../docs/contacts.md)).

# %%
gripped = simulate("gripper_gear")
names = [contact.name for contact in gripped.scenario.contact]
for name, modes, forces in zip(names, gripped.link_modes.T, gripped.link_forces.T, strict=True):
    state = ("free", "sliding", "stuck")[int(modes[-1])]
    print(f"  {name:12} {state:8} at the end, f at most {np.max(forces):7.3f} N, at the end {forces[-1]:7.3f} N")
print("lifted off the floor at", ", ".join(f"{e.time:.4f} s" for e in gripped.events if e.kind == "liftoff"))
_, axes = plt.subplots(figsize=(7.0, 2.6), layout="constrained")
for k, (name, forces) in enumerate(zip(names, gripped.link_forces.T, strict=True)):
    axes.plot(gripped.time, forces, label=name, linestyle=("-", "--")[k % 2])
axes.set(xlabel="time [s]", ylabel="normal force [N]")
axes.legend(ncols=3)
plt.show()
held(gripped)

# %% [markdown]
# ## No loss of contact
#
# A closure holds the tip whatever the sign of f. The force that is commanded in `wam_edge` goes from 10 N to −4 N and
# back: a closure pulls with it; a surface (`surface.contact = "unilateral"`) lets the tip go where f is zero, and it
# comes back with impacts, each an event at its own instant.

# %%
after = simulate("wam_edge")
before = simulate("wam_edge", surface__contact="bilateral")
print(f"least f: closure {np.min(force(before)):.3f} N, surface {np.min(force(after)):.3f} N")
kinds = [event.kind for event in after.events]
print("events:", ", ".join(f"{kinds.count(kind)} {kind}" for kind in dict.fromkeys(kinds)))
draw(before, after, "contact force f [N]", force, names=("closure", "surface"))
held(after)

# %% [markdown]
# ## No friction
#
# With friction the tip sticks until the controller pulls hard enough, slides, and sticks again at the end; f and the
# force along the surface are solved for together, in Eq. 24.

# %%
rubbing = simulate("wam_slide_friction")
along = np.linalg.norm(rubbing.friction_force, axis=1)
print(f"largest friction {np.max(along):.3f} N; stuck for {np.mean(rubbing.mode == 2):.0%} of the time")
print(f"f at the end: without friction {force(paper)[-1]:.3f} N, with it {force(rubbing)[-1]:.3f} N")
draw(paper, rubbing, "friction [N]", lambda run: np.linalg.norm(run.friction_force, axis=1), names=("without", "with"))
held(rubbing)

# %% [markdown]
# ## No singular pose
#
# Where A = nᵀJᵣ vanishes, Eq. 24 has no row and f no value. Passed at speed, the pose is an instant of a motion that f
# cannot change; if the torque does not push the tip along n there, f has the same limit from both sides, and the run
# goes on. If it pushes, f grows as one over the distance from the pose, and the run stops there.

# %%
through = simulate("wam_through_singularity")
at = int(np.argmin(through.normal_mobility))
exact = through.q[0, 1] + 0.2 * through.time
print(
    f"in the pose at {through.time[at]:.3f} s: mobility {through.normal_mobility[at]:.0f}, f {force(through)[at]:.2f} N"
)
print(f"f on either side: {force(through)[at - 100]:.4f} N, {force(through)[at + 100]:.4f} N")
print(f"q2 is that of the closed form to within {max(np.max(np.abs(through.q[:, 1] - exact)), 1e-10):.0e} rad")
held(through)
try:
    simulate("wam_through_singularity", law__kd=5.0, law__pd_start=0.59)
except cl.SingularClosureError as error:
    braked = error.run
    print("with brakes:", error)
draw(through, braked, "|f| [N]", lambda run: np.abs(force(run)), names=("glides", "brakes from 0.59 s on"), scale="log")
