"""Logs of a simulated robot whose parameters are known."""

import numpy as np
import pinocchio as pin

import robot_models
from closedloop.studies.identify.motion import Log
from closedloop.studies.identify.regressor import Regressor, Terms

FRICTION = {"viscous": 1.5, "dry": 2.0, "offset": 0.4}


def excitation(n, count, step, seed=0, harmonics=4, base=0.35, size=0.5, still=()):
    """Return q, v, a (count, n) of random Fourier series, smooth and exactly differentiated."""
    rng = np.random.default_rng(seed)
    t = np.arange(count) * step
    w = 2 * np.pi * base * np.arange(1, harmonics + 1)
    c, s = rng.normal(size=(2, n, harmonics)) * size / np.arange(1, harmonics + 1)
    q = np.einsum("jh,th->tj", c, np.cos(np.outer(t, w))) + np.einsum("jh,th->tj", s, np.sin(np.outer(t, w)))
    v = np.einsum("jh,th->tj", -c * w, np.sin(np.outer(t, w))) + np.einsum("jh,th->tj", s * w, np.cos(np.outer(t, w)))
    a = np.einsum("jh,th->tj", -c * w**2, np.cos(np.outer(t, w))) - np.einsum(
        "jh,th->tj", s * w**2, np.sin(np.outer(t, w))
    )
    for j in still:
        q[:, j], v[:, j], a[:, j] = 0.3, 0.0, 0.0
    return q, v, a


def truth(robot, names, friction=FRICTION):
    """Return the parameters χ of a robot with friction, in the order of a regressor's names."""
    model = robot.pinocchio_model()
    links = dict(zip(robot.joint_names, list(model.inertias)[1:], strict=True))
    drives = dict(zip(robot.joint_names, robot.armature, strict=True))
    order = ("m", "mx", "my", "mz", "Ixx", "Ixy", "Iyy", "Ixz", "Iyz", "Izz")
    found = []
    for name in names:
        kind, joint = next((name[: -len(j) - 1], j) for j in robot.joint_names if name.endswith(f"_{j}"))
        if kind in order:
            found.append(links[joint].toDynamicParameters()[order.index(kind)])
        else:
            found.append(drives[joint] if kind == "drive_inertia" else friction.get(kind, 0.0))
    return np.array(found)


def simulated(name="wam4", count=8000, step=0.002, noise=(0.0, 0.0), seed=0, friction=FRICTION, motion=None, **excited):
    """Return a log of a robot in which everything is known, (log, robot): noise of positions, rad, and torques, N m."""
    robot = robot_models.load(name) if isinstance(name, str) else name
    q, v, a = excitation(robot.n, count, step, **excited) if motion is None else motion
    model = robot.pinocchio_model()
    data = model.createData()
    torque = np.array([pin.rnea(model, data, *row) for row in zip(q, v, a, strict=True)])
    torque += friction.get("viscous", 0) * v + friction.get("dry", 0) * np.sign(v) + friction.get("offset", 0)
    if "stribeck" in friction:
        torque += friction["stribeck"] * np.sign(v) * np.exp(-((v / friction["speed"]) ** 2))
    if "load" in friction:  # τ = D + μ |τ| sign q̇
        torque /= 1.0 - friction["load"] * np.sign(v * torque)
    rng = np.random.default_rng(1000 + seed)
    q = q + noise[0] * rng.normal(size=q.shape)
    return Log(np.arange(count) * step, q, torque + noise[1] * rng.normal(size=q.shape), robot.joint_names), robot


def true_base(found):
    """Return the true base parameters of an identification of a simulated log."""
    return found.base.grouping @ truth(found.robot, found.regressor.names)


def names_of(robot):
    """Return the names of the parameters of a robot with the usual terms."""
    return Regressor(robot, Terms()).names
