"""A KUKA KR300 with elastic joints: torques of two runs, and the stiffness of its transmissions from two encoders.

Rigid-body model, dry and viscous friction, drives, and the hydraulic counterbalance of axis 2: a nitrogen accumulator
that pulls on a lever, with the geometry that the authors measured on the CAD model and a factor that is identified,

    τ₂ = c h(q₂) p(q₂) A,   ℓ² = D² + k² − 2Dk cos δ,   h = Dk sin δ/ℓ,   p = Z m R T/(V − (ℓ − D + k) A)

with δ = q₂ + 95°. Stiffness: with θ of the motor's encoder and q of the link's,

    θ − q = τ_l/k + c_run + b sign(q̇) + T q̇,   τ_l = τ − I_a q̈ − F_v q̇ − F_c sign(q̇) − offset

where τ_l is the torque that passes through the transmission, b is of backlash and of what friction winds up, and T is
the time between the two readings: without it a quarter of the difference's variance stays, with it below a hundredth.
I_a of axes 1 and 2 is not told from the link's inertia by any log, and is the published one for all three. Source:
J. Weigand, J. Ulmen, A. Janot, M. Ruskowski, Robot_Identification (2021), MIT.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import robot_models
from closedloop.base.arrays import Array
from closedloop.base.errors import ModelError
from closedloop.studies.identify.identify import Identification, identify
from closedloop.studies.identify.motion import Log, joined, motion
from closedloop.studies.identify.regressor import fit
from validation.measured.judged import DATA, Judged, add_forward, add_parameters, add_torques, columns

STEP = 0.004  # s
RATIOS: Array = np.array([1798 / 7, 1872 / 7, 757 / 3, 221.0, 5032 / 21, 206793 / 1340])
MOTORS: Array = np.array([0.00923, 0.0118, 0.0118, 0.00173, 0.00173, 0.00173])  # kg m², published
START: Array = np.array([0.0, -np.pi / 2.0, np.pi / 2.0, 0.0, 0.0, 0.0])  # where the angles of the log are zero
CUTOFF = 6.0  # Hz
SLOW = 0.02
RUNS = ("A", "B")
NAMES = {"act_pos_mot_deg": 6, "act_pos_se_deg": 6, "act_torque_abs_nm": 6}


def counterbalance(q: Array, v: Array, a: Array) -> Array:
    """Return the nominal torque of the counterbalance, (N, 6), N m."""
    D, k, area = 0.8, 0.2, np.pi * (0.055**2 - 0.03**2) / 4.0
    delta = q[:, 1] + np.deg2rad(95.0)
    length = np.sqrt(D * D + k * k - 2.0 * D * k * np.cos(delta))
    pressure = 1.01 * 296.8 * 328.0 * 2.0 * 0.0795 / (2.0 * 0.00048 - (length - D + k) * area)
    torque = np.zeros_like(q)
    torque[:, 1] = D * k * np.sin(delta) / length * pressure * area
    return torque


def judge(given: Path | None = None) -> Judged:
    """Identify the robot from its runs, and judge its torques where they were not fitted."""
    if given is not None:
        raise ModelError(f"--data {given}: kr300 needs two runs, and takes those that come with it only")
    runs = [columns(f"kr300_{run}.npz", NAMES) for run in RUNS]
    logs = [_log(read, run) for read, run in zip(runs, RUNS, strict=True)]
    robot = robot_models.load(DATA / "kr300.urdf")
    result = identify(logs, robot, extra={"counterbalance": counterbalance}, cutoff=CUTOFF, slow=SLOW)
    judged = Judged("KUKA KR300", "JonasWeigand/Robot_Identification, MIT")
    add_parameters(judged, result, ("viscous", "dry", "offset", "drive_inertia"))
    nominal = MOTORS * RATIOS**2
    judged.numbers["drive_inertia"]["published"] = nominal.tolist()
    judged.lines.append(f"  {'published':14} {'kg m²':9}" + "".join(f"{x:>18.4g}" for x in nominal))
    factor = result["counterbalance"]
    judged.numbers["counterbalance"] = {"value": factor.value, "interval": [factor.low, factor.high]}
    judged.lines.append(
        f"  counterbalance, over its nominal torque: {factor.value:.2f} ± {(factor.high - factor.low) / 2:.2f}"
    )
    _stiffness(judged, result, runs)
    add_torques(judged, result, "the last quarter of each tenth of both runs")
    add_forward(judged, result, logs[0])
    return judged


def _log(read: dict[str, Array], run: str) -> Log:
    q: Array = read["act_pos_mot_deg"] * (np.pi / 180.0) + START
    return Log(
        np.linspace(0.0, STEP * (len(q) - 1), len(q)), q, read["act_torque_abs_nm"] * RATIOS, source=f"kr300_{run}.npz"
    )


def _stiffness(judged: Judged, result: Identification, runs: list[dict[str, Array]]) -> None:
    """Add the stiffness of the transmissions of axes 1 to 3."""
    wound = []
    for read, name in zip(runs, RUNS, strict=True):
        log = _log(read, name)
        twist: Array = (read["act_pos_mot_deg"] - read["act_pos_se_deg"]) * (np.pi / 180.0)
        wound.append(motion(Log(log.time, log.q, twist), CUTOFF).torque)
    x = joined([motion(_log(read, name), CUTOFF) for read, name in zip(runs, RUNS, strict=True)])
    v, a = (each.reshape(len(x.time), x.size, -1).mean(axis=1) for each in (x.v, x.a))
    friction = {kind: np.array([e.value for e in result.joints(kind)]) for kind in ("viscous", "dry", "offset")}
    through = (
        x.torque - MOTORS * RATIOS**2 * a - friction["viscous"] * v - friction["dry"] * np.sign(v) - friction["offset"]
    )
    run: NDArray[np.bool_] = np.arange(len(x.time)) < len(x.time) - len(wound[1])
    first, second = run.astype(np.float64), (~run).astype(np.float64)
    stiffness: list[float | None] = []
    intervals, shares, delays = [], [], []
    judged.lines += ["", "stiffness of the transmissions, from the difference of both encoders"]
    for j, name in enumerate(result.robot.joint_names[:3]):
        W = np.stack([through[:, j], first, second, np.sign(v[:, j]), v[:, j]], axis=1)[:, None, :]
        of_axis, used = np.concatenate(wound)[:, j : j + 1], result.used[:, j : j + 1]
        found = fit(W, of_axis, used)
        give, half = float(found.value[0]), 1.96 * float(found.deviation[0])
        shares.append(1.0 - float(found.residual[used].var() / of_axis[used].var()))
        delays.append(float(found.value[4]))
        told = give > half
        stiffness.append(1.0 / give if told else None)
        intervals.append([1.0 / (give + half), 1.0 / (give - half)] if told else [None, None])
        text = (
            f"{1.0 / give:.3g} N m/rad, {1.0 / (give + half):.3g} to {1.0 / (give - half):.3g}"
            if told
            else f"not identifiable, {through[used[:, 0], j].std():.0f} N m pass, too little"
        )
        explained = f"{100 * shares[-1]:.1f} % of the variance explained"
        judged.lines.append(f"  {name}: {text}; encoders {1e3 * delays[-1]:.2f} ms apart; {explained}")
    judged.numbers["stiffness"] = {
        "joints": list(result.robot.joint_names[:3]), "value": stiffness, "interval": intervals, "unit": "N m/rad",
        "explained": shares, "encoder_delay_s": delays,
    }  # fmt: skip
