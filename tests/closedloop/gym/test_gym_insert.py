"""The insertion of a peg: what it touches, how it ends, and that random play does not stop it."""

from collections import Counter

import gymnasium
import numpy as np
import pytest

import closedloop as cl
import closedloop.gym as clgym
from closedloop.figures.scene.scene import scene_of
from closedloop.gym.env import ContactVectorEnv
from closedloop.gym.terms import Range, as_ranges, drawn
from closedloop.gym.view import shown_forces
from closedloop.mechanics.contacts.surfaces import surface_of

SCENARIO = clgym.TASKS["insert"].scenario


def inserted(**changes):
    """Return a run of the scenario, with keys of it whose dots are two underscores."""
    return cl.simulate(cl.load_scenario(SCENARIO, {k.replace("__", "."): v for k, v in changes.items()}))


def test_a_peg_in_the_middle_touches_nothing():
    """Without an offset it goes in without a contact; its corners are then half of the clearance from the walls."""
    run = inserted()
    assert np.max(run.link_forces) == 0.0
    assert run.position[-1, 2] == pytest.approx(-0.019, abs=1e-5)
    assert run.link_gaps[-1, :2] == pytest.approx([1e-4, 1e-4], abs=2e-6)


def test_the_chamfer_guides_a_peg_that_is_beside_the_hole():
    """One corner slides down the chamfer, whose normal is inclined by 45 degrees; then the peg is in the hole."""
    run = inserted(start__q=[0.0015, 0.003, 0.0])
    assert run.position[-1, 2] < -0.015
    assert abs(run.position[-1, 0]) < 2e-4
    touching = run.link_modes[:, 1] > 0
    on_chamfer = touching & (run.position[:, 2] > -0.0015)
    assert on_chamfer.sum() > 20
    assert not run.link_modes[on_chamfer, 0].any()
    tip, tilt = run.position[on_chamfer], run.q[on_chamfer, 2]  # the corner is 10 mm to the right of it
    x, z = tip[:, 0] + 0.01 * np.cos(tilt), tip[:, 2] - 0.01 * np.sin(tilt)
    assert x - z == pytest.approx(0.01225 - 0.00015 * np.sqrt(2.0), abs=1e-5)


def test_friction_wedges_a_tilted_peg():
    """Two contacts on opposite sides hold a tilted peg in a narrow hole, deeper without friction than with it."""
    tilted = {"start__q": [0.002, 0.003, 0.02], "contact.*.surface.oversize": 0.0002}
    rough, smooth = (inserted(**tilted, **{"contact.*.friction": mu}) for mu in (0.4, 0.0))
    assert smooth.position[-1, 2] < rough.position[-1, 2] - 0.001
    held = rough.link_modes[-1] > 0
    assert held[:2].any()
    assert held[2:].any()


def test_random_play_does_not_stop():
    """Every episode of random actions ends for one of the reasons that there are, and some do not succeed."""
    many = ContactVectorEnv(8, "insert", threads=2, worlds=6)
    many.reset(seed=0)
    random, ends = np.random.default_rng(0), Counter()
    for k in range(300):
        size = 1.0 if k % 100 < 50 else 0.2
        seen, rewards, _, _, infos = many.step(size * random.uniform(-1.0, 1.0, (8, 3)))
        assert np.isfinite(seen).all()
        assert np.isfinite(rewards).all()
        ends.update(infos["reason"][infos["_reason"]] if "reason" in infos else ())
    many.close()
    assert set(ends) <= {"success", "jammed", "excessive force", "time is up"}
    assert ends["success"] > 0
    assert sum(ends.values()) > ends["success"]


def test_how_an_insertion_fails():
    """A peg that stands on the plate is jammed after 0.3 s; pushed down hard the force is excessive."""
    env = gymnasium.make("closedloop/Insert-v0").unwrapped
    ended = {}
    for name, down in (("jammed", 0.0), ("excessive force", -1.0)):
        env.reset(seed=0, options={"start.q": [0.0035, 0.003, 0.0]})
        over = False
        while not over:
            _, _, terminated, truncated, info = env.step(np.array([0.0, down, 0.0]))
            over = terminated or truncated
        ended[name] = info
        assert info["reason"] == name
        assert terminated
        assert not info["is_success"]
    assert ended["jammed"]["largest_link_force"] < 100.0
    env.close()


def test_a_posture_is_drawn_joint_by_joint():
    """A range of a posture may have numbers for each joint; another count is refused, and other keys have one."""
    home, random = np.array([0.0, 0.003, 0.0]), np.random.default_rng(0)
    ranges = as_ranges(clgym.TASKS["insert"].ranges)
    q = np.array([drawn(ranges, home, random, {})["start.q"] for _ in range(50)])
    assert np.ptp(q[:, 1]) == 0.0
    assert 2e-3 < np.ptp(q[:, 0]) <= 3e-3
    assert 0.03 < np.ptp(q[:, 2]) <= 0.04
    with pytest.raises(cl.ScenarioError, match="has 2 numbers: must be one, or 3"):
        drawn({"start.q": Range((0.0, 0.0), (1.0, 1.0))}, home, random, {})
    with pytest.raises(cl.ScenarioError, match=r"ranges\['friction.coefficient'\]"):
        as_ranges({"friction.coefficient": Range((0.0, 0.0), (1.0, 1.0))})


def test_joints_are_displaced_by_an_action():
    """A displacement of desired joints acts until the next action, and the path is as it was after it."""
    env = gymnasium.make("closedloop/Insert-v0", ranges={}).unwrapped
    wanted = []
    for shift in (0.0, 1.0):
        env.reset(seed=0)
        for k in range(3):
            env.step(np.array([shift if k == 1 else 0.0, 0.0, 0.0]))
            wanted.append(env.core.now.wanted_q[0].copy())
    moved = np.array(wanted[3:]) - np.array(wanted[:3])
    assert moved == pytest.approx(np.array([[0, 0, 0], [0.004, 0, 0], [0, 0, 0]]), abs=1e-15)
    assert env.core.actions.names == ("joint.X", "joint.Z", "joint.tilt")
    with pytest.raises(cl.ScenarioError, match="no such joint; there are X, Z, tilt"):
        gymnasium.make("closedloop/Insert-v0", actions={"joint.Y": (0.0, 1.0)})


def test_what_is_shown_has_the_forces_of_the_contacts():
    """A task without a surface shows the force at each contact by its name; on a surface it is the force on the tip."""
    env = gymnasium.make("closedloop/Insert-v0", render_mode="rgb_array").unwrapped
    env.reset(seed=4)
    for _ in range(60):
        env.step(np.zeros(3))
    names, forces = shown_forces(env.core, 0)
    assert names == ["left corner", "right corner", "edge 1", "edge 2"]
    assert forces.max() == env.core.now.link_forces[0].max() > 0.1
    press = gymnasium.make("closedloop/Press-v0").unwrapped
    press.reset(seed=0)
    press.step(np.zeros(1))
    assert shown_forces(press.core, 0) == (["f"], press.core.now.f[:1])


def test_the_hole_is_drawn_where_the_peg_touches_it():
    """Two walls with chamfers, closed, in a box about the contacts; each corner is on the surfaces that strike."""
    scenario = cl.load_scenario(SCENARIO, {"time.duration": 0.3})
    scene = scene_of(cl.simulate(scenario))
    vertices, faces = scene.surface
    sides = np.sort(np.vstack([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    corners = np.unique(vertices.round(9), axis=0)
    assert len(faces) == 32
    assert len(sides) == 96
    inner = corners[np.abs(corners[:, 0]) < 0.0102]
    assert np.unique(inner[:, 0]) == pytest.approx([-0.0101, 0.0101])  # 20 mm and the clearance of 0.2 mm
    assert inner[:, 2].max() == pytest.approx(-0.002 + np.sqrt(2) * 0.00015 - 0.00015, abs=1e-9)
    assert corners[:, 2].max() == 0.0
    for name, side in (("left corner", -1.0), ("right corner", 1.0)):
        (contact,) = (each for each in scenario.contact if each.name == name)
        placed = surface_of(contact)
        mine = corners[side * corners[:, 0] > 0.0]
        levels = [placed.touching(corner).level for corner in mine]
        assert max(levels) < 2.0 * placed.section.rounding
        assert sum(abs(level) < 2.0 * placed.section.rounding for level in levels) >= 8
        assert placed.touching(np.array([0.0, 0.0, -0.01])).gap == pytest.approx(0.0101, abs=1e-6)
    env = gymnasium.make("closedloop/Insert-v0", render_mode="rgb_array").unwrapped
    env.reset(seed=4)
    env.step(np.zeros(3))
    picture = env.render()
    assert np.unique(picture.reshape(-1, 3), axis=0).shape[0] > 100
    assert scene_of(cl.simulate(cl.load_scenario("tower", {"time.duration": 0.01}))).surface[1].shape == (2, 3)
