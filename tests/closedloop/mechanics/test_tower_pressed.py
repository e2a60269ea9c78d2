"""A tower of three boxes that a tip presses and pushes: inner forces are many times what its slips ask for."""

import numpy as np

import closedloop as cl
from closedloop.scenario.load import parse_scenario

HALF = (0.06, 0.06, 0.045)
ARM = """
[robot]
model = "wam4"
[start]
q = [1.5707963267948966, 0.94, 0.0, 2.0]
[surface]
kind = "none"
normal = [0, 0, 1]
[reference]
kind = "waypoints"
times = [0.0, 0.6, 1.0, 2.0]
points = [[0, 0, 0], [0, 0, -0.04], [0, 0, -0.04], [0.05, 0.05, -0.04]]
[law]
kind = "paper"
kp = [900, 900, 400, 300]
kd = [60, 60, 30, 20]
force = 10.0
[stabiliser]
time_constant = 0.01
[time]
duration = 0.38
integrator = "rk4"
[[contact]]
name = "press"
link = "tip"
against = "box2"
through = [0, 0, 0.045]
friction = 0.4
restitution = 0.3
"""


def pressed(step):
    """Return the run of the tower, from before the tip comes down on it until the box on top has stopped."""
    feet = [[x * HALF[0], y * HALF[1], -HALF[2]] for y in (-1, 1) for x in (-1, 1)]
    parts = [ARM.replace("[time]", f"[time]\nstep = {step}")]
    for i in range(3):
        below, through = ("world", 0.0) if i == 0 else (f"box{i - 1}", HALF[2])
        parts.append(
            f'[[body]]\nname = "box{i}"\nshape = "box"\nedges = {[2 * x for x in HALF]}\nmass = 1.0\n'
            f"position = [0, 0.585, {HALF[2] * (2 * i + 1)}]\n"
            f'[[contact]]\nname = "on{i}"\nlink = "box{i}"\nagainst = "{below}"\nat = {feet}\n'
            f"through = [0, 0, {through}]\nfriction = 0.3"
        )
    return cl.simulate(parse_scenario("\n".join(parts)), progress=False)


def test_a_tip_that_slips_on_the_tower_sticks_at_its_instant():
    """At 1 ms the slip of the tip ends, as at 0.25 ms, and nothing moves aside: friction is turned with the slips."""
    long, short = pressed(1e-3), pressed(2.5e-4)
    assert np.max(np.abs(long.q - short.q[::4])) < 1e-5
    ended = long.time > 0.366
    press = [str(event.kind) for event in long.events if event.contact == 1]
    assert press[-1] == "stick"
    assert np.all(long.link_modes[ended][:, 0] == 2)
    assert np.max(np.abs(long.v[ended])) < 0.01
    assert len(long.events) < 300
