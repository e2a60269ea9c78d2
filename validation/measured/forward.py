"""Forward: a robot with identified parameters is simulated, driven by the torques of a log, and may drift from it.

From several instants of the log, for a while: once with the measured torques alone, where every error of the model adds
up, and once with a weak spring and damper to the measured path beside them. The first tells how long a model can
predict; the second what torque it lacks, where a simulation stays on the path.
"""

import tempfile
from pathlib import Path

import numpy as np
import tomli_w

import closedloop as cl
from closedloop.base.arrays import Array
from closedloop.studies.identify.identify import Identification
from closedloop.studies.identify.log import Log
from closedloop.studies.identify.motion import motion
from closedloop.studies.identify.written import physical, robot_files
from validation.measured.judged import Judged

# Instants of the log that are begun at, how long each is simulated, s, and the step, s.
STARTS, LASTS, STEP = 10, 2.0, 1e-3
# How far a joint may go from the measured path, rad.
NEAR = 0.05
# The spring and damper: natural frequency, rad/s, of each joint's inertia at the start, and damping ratio.
FREQUENCY, RATIO = 20.0, 1.0


def add_forward(judged: Judged, found: Identification, log: Log) -> None:
    """Add how long the simulated robot stays within `NEAR` of the log, and what it needs to stay on its path.

    The parameters are those of bodies that can be, all of one fit: friction, offset and extra terms of it too.
    """
    n = found.robot.n
    x = motion(log, found.motion.cutoff)
    step = float(x.time[1] - x.time[0]) / x.size
    t = x.time[0] - 0.5 * (x.size - 1) * step + step * np.arange(len(x.q))
    chi = physical(found).parameters
    value = dict(zip(found.regressor.names, map(float, chi), strict=True))
    offset = np.array([value[f"offset_{joint}"] for joint in found.robot.joint_names])
    extra = found.regressor.terms.extra
    starts = np.linspace(t[0], t[-1] - LASTS, STARTS)
    alone, held, needed, used = [], [], [], []
    with tempfile.TemporaryDirectory() as folder:
        scenario = _scenario(found, chi, Path(folder))
        for start in starts:
            rows = np.arange(round(LASTS / STEP) + 1) * STEP + start
            q, v, torque = (_at(rows, at, y) for at, y in ((t, x.q), (t, x.v), (log.time, log.torque)))
            begun = {"start.q": q[0].tolist(), "start.v": v[0].tolist()}
            given = cl.load_scenario(str(scenario), begun)
            inertia = np.diag(cl.prepare(given).robot.terms(q[0], v[0]).mass_matrix)
            for stiff in (0.0, FREQUENCY):
                sim = cl.Simulator(given)
                state = sim.reset()
                error, feedback = np.zeros((len(rows), n)), np.zeros((len(rows), n))
                for k in range(len(rows) - 1):
                    pull = stiff * stiff * (q[k] - state.q) + 2.0 * RATIO * stiff * (v[k] - state.v)
                    feedback[k] = inertia * pull
                    now = (state.q[None], state.v[None], np.zeros((1, n)))
                    other = sum((value[name] * of(*now)[0] for name, of in extra.items()), start=offset)
                    state = sim.step(torque[k] - other + feedback[k])
                    error[k + 1] = state.q - q[k + 1]
                    if stiff == 0.0 and np.abs(error[k + 1]).max() > NEAR:
                        alone.append((k + 1) * STEP)
                        break
                else:
                    if stiff == 0.0:
                        alone.append(LASTS)
                if stiff > 0.0:
                    held.append(np.sqrt(np.mean(error**2, axis=0)))
                    needed.append(np.mean(feedback**2, axis=0))
                    used.append(np.mean(torque**2, axis=0))
    share = np.sqrt(np.mean(needed, axis=0) / np.mean(used, axis=0))
    on_path = np.sqrt(np.mean(np.square(held), axis=0))
    judged.numbers["forward"] = {
        "near_rad": NEAR, "seconds": [float(s) for s in alone], "median_seconds": float(np.median(alone)),
        "held_error_rad": on_path.tolist(), "feedback_over_torque": share.tolist(),
        "starts": [float(s) for s in starts],
    }  # fmt: skip
    names = found.robot.joint_names
    judged.lines += [
        "",
        f"forward, from {STARTS} instants of the log, {LASTS:g} s each",
        f"  driven by the measured torques alone within {NEAR:g} rad for {min(alone):.2g} to {max(alone):.2g} s, "
        f"median {np.median(alone):.2g} s",
        f"  {'with spring and damper':22}" + "".join(f"{name[:14]:>15}" for name in names),
        f"  {'from the path, mrad':22}" + "".join(f"{1e3 * e:15.2g}" for e in on_path),
        f"  {'feedback over torque':22}" + "".join(f"{100 * s:13.1f} %" for s in share),
    ]


def _scenario(found: Identification, chi: Array, folder: Path) -> Path:
    """Write the robot and a scenario of it, without a surface, and return the scenario's path."""
    urdf, sidecar = robot_files(found, chi, "a log")
    (folder / "robot.urdf").write_text(urdf, encoding="utf-8")
    (folder / "robot.toml").write_text(sidecar, encoding="utf-8")
    names, joints = found.regressor.names, found.robot.joint_names
    friction = {
        key: [max(0.0, float(chi[names.index(f"{kind}_{joint}")])) for joint in joints]
        for key, kind in (("kinetic", "dry"), ("viscous", "viscous"))
    }
    told = {
        "robot": {"model": (folder / "robot.urdf").as_posix()},
        "joint_friction": {"kind": "coulomb_viscous", **friction},
        "time": {"duration": LASTS + STEP, "step": STEP, "integrator": "semi_implicit_euler"},
    }
    path = folder / "forward.toml"
    path.write_text(tomli_w.dumps(told), encoding="utf-8")
    return path


def _at(times: Array, known: Array, values: Array) -> Array:
    return np.stack([np.interp(times, known, column) for column in values.T], axis=1)
