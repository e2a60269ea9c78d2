"""A box or block of points on a floor, as a body on prismatic and revolute joints: its URDF, its scenario, its run."""

import numpy as np
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
    contacts = [
        {"link": "block", "at": list(map(float, at)), "friction": float(mu), "restitution": float(e)} for at in feet
    ]
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


def any_rotation(rng):
    """Return angles of x, y and z, in this order from the floor, of a rotation that may be any, rad."""
    return float(rng.uniform(-np.pi, np.pi)), float(np.arcsin(rng.uniform(-1.0, 1.0))), float(rng.uniform(-3.0, 3.0))


def turned(x, y, z):
    """Return the rotation Rx Ry Rz."""
    R = np.eye(3)
    for angle, (a, b) in ((x, (1, 2)), (y, (2, 0)), (z, (0, 1))):
        one = np.eye(3)
        one[[a, b], [a, b]], one[a, b], one[b, a] = np.cos(angle), -np.sin(angle), np.sin(angle)
        R = R @ one
    return R


def drop_in_any_pose(feet, seed):
    """Return half sides, feet, start, μ and e of a drop."""
    rng = np.random.default_rng([seed, feet])
    half = np.array(HALF) * np.exp(rng.uniform(-0.7, 0.7, size=3))
    at = FEET[feet] / HALF * half
    angles = any_rotation(rng)
    height = float(10 ** rng.uniform(-4.0, -0.8) - np.min(at @ turned(*angles)[2]))
    v = np.concatenate([rng.normal(size=3) * 0.7, rng.normal(size=3) * 3.0])
    mu = float(rng.choice([0.0, 0.05, 1.0, rng.uniform(), rng.uniform()]))
    e = float(rng.choice([0.0, rng.uniform(0.0, 0.9), rng.uniform(0.0, 0.9)]))
    return half, at, ([0.0, 0.0, height, *angles], v), mu, e
