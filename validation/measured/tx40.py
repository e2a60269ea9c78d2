"""A Stäubli TX40: friction and drive inertia identified from its log, beside the published ones.

Motor positions are turned into joint positions by the reduction ratios, with the coupling of the wrist,
θ₆ = N₆(q₅ + q₆), and motor torques into joint torques by the transpose. Axes 2 and 3 of the model are a quarter turn
from those of the log.
The published coefficients are those that figaroh-examples gives for this robot and this log; they were identified by
others, by least squares without leaving out the changes of sign, so they are no truth, but an independent answer.
"""

from pathlib import Path

import numpy as np

from closedloop.studies.identify.identify import Identification, identify
from closedloop.studies.identify.motion import Log
from validation.measured.judged import DATA, Judged, add_parameters, add_torques, columns, entries, with_half

RATE = 2500.0  # Hz
RATIOS = np.array([32.0, 32.0, 45.0, -48.0, 45.0, 32.0])
CUTOFF = 100.0  # Hz, of the published configuration
PUBLISHED = {
    "viscous": [8.05, 5.53, 1.97, 1.11, 1.86, 0.65],
    "dry": [7.14, 8.26, 6.34, 2.48, 3.03, 0.282],
    "drive_inertia": [0.362, 0.362, 0.0988, 0.0313, 0.0468, 0.0105],
    "offset": [0.392, 1.37, 0.326, -0.102, -0.0288, 0.127],
}
PUBLISHED_COUPLED = {"coupled_inertia": 0.00964, "coupled_viscous": 0.616, "coupled_dry": 1.95}
# A published coefficient agrees if it lies in an interval so many times as wide, or within this share.
WIDENED, CLOSE = 3.0, 0.10
# Half of an interval over the value, above which a coefficient is called uncertain.
CERTAIN = 0.20


def log(given: Path | None = None) -> Log:
    """Return the log at the joints."""
    read = columns("tx40_log.npz", {"motor_position": 6, "motor_current": 6}, given)
    turns = np.diag(RATIOS)
    turns[5, 4] = RATIOS[5]
    q = read["motor_position"] @ np.linalg.inv(turns).T
    q[:, 1] -= np.pi / 2.0
    q[:, 2] += np.pi / 2.0
    time = np.arange(len(q)) / RATE
    return Log(time, q, read["motor_current"] @ turns, source="tx40_log.npz" if given is None else str(given))


def found(given: Path | None = None) -> Identification:
    """Return what is identified from the log."""
    return identify(log(given), DATA / "tx40.urdf", coupled=[("joint_5", "joint_6")], cutoff=CUTOFF)


def judge(given: Path | None = None) -> Judged:
    """Identify the robot and compare with what is published."""
    result = found(given)
    judged = Judged("Stäubli TX40", "thanhndv212/figaroh-examples, Apache-2.0")
    add_parameters(judged, result, tuple(PUBLISHED))
    judged.lines += ["", "published, and by how much the value above differs"]
    for kind, published in PUBLISHED.items():
        judged.numbers[kind]["published"] = published
        value = np.array([np.nan if x is None else x for x in judged.numbers[kind]["value"]])
        both = zip(published, value, strict=True)
        by = [f"{p:g}" + ("" if np.isnan(x) else f" ({100 * (x / p - 1):+.0f} %)") for p, x in both]
        judged.lines.append(f"  {kind:14} {'':9}" + "".join(f"{text:>18}" for text in by))
        if kind in ("viscous", "dry"):
            _compare(judged, kind, result)
    coupled = [result[f"{kind}_joint_5_joint_6"] for kind in PUBLISHED_COUPLED]
    judged.numbers["coupled"] = entries(coupled) | {"published": list(PUBLISHED_COUPLED.values())}
    judged.lines += ["", "wrist, motor 6 turns with joints 5 and 6"]
    for e, theirs in zip(coupled, PUBLISHED_COUPLED.values(), strict=True):
        judged.lines.append(f"  {e.name:32} {with_half(e)} {e.unit}, published {theirs:g}")
    add_torques(judged, result, "the last quarter of each tenth of the log")
    judged.faults = [fault for fault in judged.faults if not fault.startswith("torque")]  # friction is what is judged
    return judged


def _compare(judged: Judged, kind: str, result: Identification) -> None:
    """Add whether each published coefficient agrees, and which are uncertain."""
    estimates, published = result.joints(kind), PUBLISHED[kind]
    half = [(e.high - e.low) / 2.0 for e in estimates]
    inside = [abs(e.value - p) <= h for e, p, h in zip(estimates, published, half, strict=True)]
    wide = [abs(e.value - p) <= WIDENED * h for e, p, h in zip(estimates, published, half, strict=True)]
    close = [abs(e.value - p) <= CLOSE * abs(p) for e, p in zip(estimates, published, strict=True)]
    judged.numbers[kind] |= {
        "published_inside": inside, "published_inside_3": wide, "published_within_10_percent": close,
        "relative_half_width": [h / abs(e.value) for e, h in zip(estimates, half, strict=True)],
    }  # fmt: skip
    for e, p, near, agrees, h in zip(estimates, published, close, wide, half, strict=True):
        if not (near or agrees):
            judged.faults.append(f"{e.name}: {e.value:.4g} ± {h:.2g}, published {p:g}")
        if h > CERTAIN * abs(e.value):
            judged.lines.append(f"  uncertain: {e.name}, half its interval is {100 * h / abs(e.value):.0f} % of it")
