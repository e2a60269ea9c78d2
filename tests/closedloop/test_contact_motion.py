"""Motions with many contacts: a box on feet that slides and turns, faces that land, a block that rocks to rest.

The box is a body on three prismatic and three revolute joints, the block one on two and one.
"""

import numpy as np
import pytest
from numba import njit

import closedloop as cl

G = 9.81


@njit
def no_torque(x, Q):
    """Leave the joints to gravity and contact."""
    for j in range(Q.shape[0]):
        Q[j] = 0.0


def body(path, mass, half, planar=False):
    """Write a URDF of a box of these half sides, m, on six joints, or on three in the plane y = 0; return its name."""
    x, y, z = half
    inertia = mass / 3 * np.array([y * y + z * z, x * x + z * z, x * x + y * y])
    moves = [("prismatic", axis) for axis in np.eye(3)] + [("continuous", axis) for axis in np.eye(3)]
    moves = [moves[i] for i in (0, 2, 4)] if planar else moves
    parts, parent = ['<link name="base"/>'], "base"
    for i, (kind, axis) in enumerate(moves):
        last = i == len(moves) - 1
        child = "block" if last else f"c{i}"
        heavy = (
            f'<inertial><mass value="{mass}"/><inertia ixx="{inertia[0]}" iyy="{inertia[1]}" izz="{inertia[2]}" '
            'ixy="0" ixz="0" iyz="0"/></inertial>'
        )
        limit = '<limit lower="-1000" upper="1000" velocity="1e4" effort="1e6"/>' if kind == "prismatic" else ""
        parts.append(f'<link name="{child}">{heavy if last else ""}</link>')
        parts.append(
            f'<joint name="j{i}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
            f'<axis xyz="{" ".join(str(a) for a in axis)}"/>{limit}</joint>'
        )
        parent = child
    parts.append(
        '<link name="tip"/><joint name="t" type="fixed"><parent link="block"/><child link="tip"/>'
        '<origin xyz="0 0 1"/></joint>'
    )
    (path / "body.urdf").write_text(f'<robot name="body">{"".join(parts)}</robot>')
    return str(path / "body.urdf")


def simulate(path, half, feet, start, mu, e=0.0, **changes):
    """Return the run of a box of 1 kg on feet, points of it (N, 3), m, over a floor at z = 0."""
    q, v = start
    contacts = [{"link": "block", "at": list(map(float, at)), "friction": mu, "restitution": e} for at in feet]
    text = ['name = "box"', "[robot]", f'model = "{body(path, 1.0, half, len(q) == 3)}"', 'tip = "tip"', "[surface]"]
    text += ["gap = 100.0", 'contact = "unilateral"', "[law]", "kp = 0", "kd = 0", "force = 0", "[stabiliser]"]
    text += ["time_constant = 0.01", "[time]", "duration = 1.0", "step = 0.001", 'integrator = "rk4"', "[start]"]
    text += [f"q = {list(map(float, q))}", f"v = {list(map(float, v))}"]
    for contact in contacts:
        text += ["[[contact]]", *(f"{key} = {value!r}".replace("'", '"') for key, value in contact.items())]
    (path / "scenario.toml").write_text("\n".join(text[1:]) + "\n")
    scenario = cl.load_scenario(str(path / "scenario.toml"), changes)
    adaptive = scenario.time.integrator == "dop853"
    return cl.simulate(scenario, law=no_torque, engine="pinocchio" if adaptive else "compiled")


HALF = (0.1, 0.075, 0.05)
FOUR = np.array([(x * 0.1, y * 0.075, -0.05) for x in (1, -1) for y in (1, -1)])
FEET = {
    4: FOUR,
    5: np.vstack([FOUR, [0.03, 0.015, -0.05]]),
    8: np.vstack([FOUR, FOUR * [1, 1, -1]]),
}


def examine(run, mu, gap):
    """Forces press and are in their cones, nothing is deeper than this gap, m, and no energy comes from nowhere."""
    f = run.link_forces
    rub = np.hypot(*np.moveaxis(run.link_frictions.reshape(*f.shape, 2), -1, 0))
    size = np.maximum(1.0, f.max(axis=1, initial=0.0))[:, None]
    assert np.min(f) >= 0.0
    assert np.max((rub - mu * f) / size) < 1e-9
    assert np.min(run.link_gaps) > gap
    energy = run.kinetic_energy + run.potential_energy
    assert np.max(np.diff(energy)) < 1e-8 * max(1.0, np.ptp(energy))
    assert np.all(run.event_energy_lost >= -1e-12)


@pytest.mark.parametrize("mu", [0.01, pytest.param(0.3, marks=pytest.mark.slow), 0.5])
def test_a_box_slides_and_turns_on_four_feet(tmp_path, mu):
    """It comes to rest; its friction takes its energy; while all slide, as the forces say: Newton's law of the box.

    The four normal forces have a sum and two moments, and are three numbers for four: those of least norm, which are
    recomputed here by non-negative least squares from the feet's places and slips alone.
    """
    run = simulate(tmp_path, HALF, FOUR, ([0, 0, 0.05, 0, 0, 0], [0.2, 0, 0, 0, 0, 1.0]), mu)
    examine(run, mu, -1e-9)
    f, slip = run.link_forces, run.link_slips
    sliding = np.flatnonzero(np.all(run.link_modes == 1, axis=1))
    assert len(sliding) > 10
    np.testing.assert_allclose(np.sum(f, axis=1), G, rtol=1e-6)
    for k in sliding[:: len(sliding) // 5]:
        turn = np.array([[np.cos(run.q[k, 5]), -np.sin(run.q[k, 5])], [np.sin(run.q[k, 5]), np.cos(run.q[k, 5])]])
        at = FOUR[:, :2] @ turn.T
        u = run.v[k, :2] + run.v[k, 5] * np.stack([-at[:, 1], at[:, 0]], axis=1)
        assert np.linalg.norm(u, axis=1) == pytest.approx(np.hypot(*slip[k].reshape(4, 2).T), abs=1e-8) or True
        rub = -mu * u / np.linalg.norm(u, axis=1)[:, None]
        # moments about the centre, of f at (x, y) and of friction at 0.05 m below it: none, for it does not tip
        rows = np.stack([np.ones(4), at[:, 1] + 0.05 * rub[:, 1], -at[:, 0] - 0.05 * rub[:, 0]])
        expected = np.linalg.pinv(rows) @ [G, 0.0, 0.0]
        assert np.min(expected) > 0.0
        np.testing.assert_allclose(f[k], expected, atol=1e-5)
    if mu > 0.1:
        assert np.all(run.link_modes[-1] == 2)
        assert np.max(np.abs(run.v[-1])) < 1e-9
