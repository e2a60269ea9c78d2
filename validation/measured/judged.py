"""What a comparison with measurements found: numbers for a program, and a table for a reader.

The measured data that come with the package, or a file of a user in the same format.

Two engines judged by the same tests: whether their errors differ by more than the tests scatter.

Forward: a robot with identified parameters is simulated, driven by the torques of a log, and may drift from it.

From several instants of the log, for a while: once with the measured torques alone, where every error of the model adds
up, and once with a weak spring and damper to the measured path beside them. The first tells how long a model can
predict; the second what torque it lacks, where a simulation stays on the path.
"""

import tempfile
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple
from zipfile import BadZipFile

import numpy as np
import tomli_w
from numpy.typing import NDArray

import closedloop as cl
from closedloop.base.arrays import Array
from closedloop.base.errors import ModelError
from closedloop.base.files import reason_of
from closedloop.studies.identify.identify import Estimate, Identification
from closedloop.studies.identify.motion import Log, motion
from closedloop.studies.identify.regressor import BOUNDED
from closedloop.studies.identify.written import physical, robot_files

# The relative RMS error of the torque, in the part that was not fitted, that a model may have.
HELD_OUT = 0.10


@dataclass
class Judged:
    """A comparison of a robot's model with its log.

    numbers: for a program; as JSON has them, so that what is not known is None
    lines: for a reader
    faults: what does not agree with the measurement, a line each; agreement if empty
    notes: why values are not given, a line each
    """

    robot: str
    source: str
    numbers: dict[str, Any] = field(default_factory=dict)
    lines: list[str] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def possible(e: Estimate) -> Estimate:
    """Return an estimate, or one that says why it is not given if it is negative beyond its interval and cannot be."""
    if e.why or e.high >= 0.0 or not e.name.startswith(BOUNDED):
        return e
    why = f"it comes out as {with_half(e)}, which cannot be: the model lacks something that looks like it"
    return e._replace(value=np.nan, low=-np.inf, high=np.inf, why=why)


def entries(estimates: Sequence[Estimate]) -> dict[str, Any]:
    """Return the values and intervals of estimates as lists; None where the log does not tell, with the reason."""
    told = {
        "value": [number_or_none(e.value) for e in estimates],
        "interval": [[number_or_none(e.low), number_or_none(e.high)] for e in estimates],
        "unit": estimates[0].unit,
    }
    reasons = {e.name: e.why for e in estimates if e.why}
    return told | ({"not_identifiable": reasons} if reasons else {})


def with_half(e: Estimate) -> str:
    """Return the value of an estimate and half of its interval, as text."""
    return f"{e.value:.4g} ± {(e.high - e.low) / 2:.2g}"


def number_or_none(x: float) -> float | None:
    """Return a number as JSON has it."""
    return float(x) if np.isfinite(x) else None


def add_torques(judged: Judged, found: Identification, tested: str) -> None:
    """Add the errors of the torque, joint by joint, and a fault for each joint beyond `HELD_OUT`."""
    names = found.robot.joint_names
    summary = found.summary()
    judged.numbers["torque"] = {
        "joints": list(names),
        "held_out_error": [number_or_none(x) for x in found.held_out],
        "fitted_error": [number_or_none(x) for x in found.relative_error],
        "used_share": [float(x) for x in found.used.mean(axis=0)],
        "held_out": tested,
    }
    for key in ("condition", "cutoff_hz", "windows", "correlation", "model_misses_something"):
        judged.numbers[key] = summary[key]
    judged.lines += ["", f"torque, RMS of the error over that of the torque (condition {found.solution.condition:.1f})"]
    judged.lines += [f"  {'':22}" + "".join(f"{name[:14]:>15}" for name in names)]
    rows = {"not fitted": found.held_out, "fitted": found.relative_error, "share of rows used": found.used.mean(axis=0)}
    for label, row in rows.items():
        judged.lines.append(f"  {label:22}" + "".join(f"{100 * x:13.1f} %" for x in row))
    judged.lines.append(f"  not fitted: {tested}")
    for name, error in zip(names, found.held_out, strict=True):
        if not error <= HELD_OUT:
            judged.faults.append(f"torque of {name}: {100 * error:.1f} % where not fitted, over {100 * HELD_OUT:.0f} %")
    if found.misses:
        judged.lines.append(f"  residual not white, the model misses something: {', '.join(found.misses)}")


def add_parameters(judged: Judged, found: Identification, kinds: Sequence[str]) -> None:
    """Add values and intervals of what each joint has."""
    judged.lines += ["", f"by joint, with {100 * found.confidence:.0f} % intervals"]
    for kind in kinds:
        estimates = [possible(e) for e in found.joints(kind)]
        judged.numbers[kind] = entries(estimates)
        judged.notes += [f"{e.name}: {e.why}" for e in estimates if "cannot be" in e.why]
        texts = ["-" if e.why else with_half(e) for e in estimates]
        judged.lines.append(f"  {kind:14} {estimates[0].unit:9}" + "".join(f"{text:>18}" for text in texts))


DATA = Path(__file__).parent / "data"


def columns(file: str, names: Mapping[str, int], given: Path | None = None) -> dict[str, NDArray[np.float64]]:
    """Return columns of an .npz file, double precision.

    file: in the folder `data`
    names: each column that is needed, and how many entries a row of it has; 0 of one that is a vector
    given: a file to read in place of it
    Raises `ModelError` if it cannot be read, a column is missing, or has another shape.
    """
    path = DATA / file if given is None else given
    try:
        with np.load(path) as found:
            missing = [name for name in names if name not in found]
            if missing:
                raise ModelError(f"{path}: has no column {missing[0]!r}: it needs {', '.join(names)}")
            read = {name: np.asarray(found[name], dtype=np.float64) for name in names}
    except OSError as error:
        raise ModelError(f"{path}: cannot be read: {reason_of(error)}") from None
    except (ValueError, EOFError, BadZipFile, AttributeError) as error:
        if isinstance(error, ModelError):
            raise
        raise ModelError(f"{path}: is no .npz file of numbers, as numpy.savez writes it") from None
    rows = len(next(iter(read.values())))
    for name, width in names.items():
        shape = (rows, width) if width else (rows,)
        if read[name].shape != shape:
            raise ModelError(f"{path}: {name} has shape {read[name].shape}: it must be {shape}")
    return read


CONFIDENCE = 0.95
# Of more kinds of tests, several count as one, so that there are 2¹⁶ subsets at most.
MOST_KINDS = 16
BETTER, WORSE, EQUAL = "better", "worse", "equal within the scatter of the tests"


class Paired(NamedTuple):
    """The mean difference over the tests, the interval from `low` to `high`, its confidence, and what it says."""

    mean: float
    low: float
    high: float
    confidence: float
    verdict: str


def paired(first: Array, second: Array, kinds: Sequence[Hashable]) -> Paired:
    """Compare the sizes of two engines' errors, (N,) each, over N tests; a test without a figure has NaN.

    Tests of one kind are repeats, which are no new evidence: they count together. If the sums over the kinds are
    independent and symmetric about their means, the means over all subsets of the kinds cut the line into parts that
    hold the true mean with the same chance (J. Hartigan, Using subsample values as typical values, J. American
    Statistical Association 64, 1969). So the interval needs neither a normal distribution nor random numbers. Fewer
    than six kinds have none of 95 %: the widest that they have is given, and decides nothing.
    """
    difference = np.asarray(first) - np.asarray(second)
    known = np.isfinite(difference)
    if not known.any():
        return Paired(np.nan, -np.inf, np.inf, 0.0, EQUAL)
    difference, kept = difference[known], [kind for kind, ok in zip(kinds, known, strict=True) if ok]
    numbers = {kind: i % MOST_KINDS for i, kind in enumerate(dict.fromkeys(kept))}
    group = np.array([numbers[kind] for kind in kept])
    sums, counts = np.zeros(1), np.zeros(1)
    for one in range(group.max() + 1):
        part = difference[group == one]
        sums, counts = np.append(sums, sums + part.sum()), np.append(counts, counts + len(part))
    means = np.sort(sums[1:] / counts[1:])
    cut = max(1, int(0.5 * (1.0 - CONFIDENCE) * len(sums)))
    low, high, confidence = float(means[cut - 1]), float(means[-cut]), 1.0 - 2.0 * cut / len(sums)
    decided = confidence >= CONFIDENCE
    verdict = BETTER if decided and high < 0.0 else WORSE if decided and low > 0.0 else EQUAL
    return Paired(float(difference.mean()), low, high, confidence, verdict)


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
