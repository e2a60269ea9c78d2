"""What was recorded of a robot in contact: a log from a file, or a run, of this simulator or of another program."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from closedloop.base.arguments import fields_checked
from closedloop.base.arrays import Array
from closedloop.studies.identify.log import LogError, check_motion, check_positions, check_time, check_torques
from closedloop.studies.identify.read import columns_named, factors_of, joints_of, listed, run_of, table_of, time_of

if TYPE_CHECKING:
    from closedloop.record.run import Run
    from robot_models import RobotModel

# What the column of the tip's speed is called.
SPEED = ("speed", "tip_speed", "tcp_speed")
# What the columns of a force are called: one that is along the surface's normal, or three along the base's axes.
FORCE = ("contact_force", "normal_force", "force", "f", "fn", "f_n")
FORCES = (("force_{}", "xyz"), ("f{}", "xyz"), ("f_{}", "xyz"), ("force.{}", "xyz"), ("wrench.force.{}", "xyz"))
FEWEST = 50


@dataclass(frozen=True, eq=False)
@fields_checked
class Recording:
    """A recording of N rows, to compare with a scenario.

    Attributes
    ----------
    time : (N,)
        s, increasing.
    q : (N, n), optional
        Joint positions, rad (m); None where only the force, or the tip's speed, was recorded.
    torque : (N, n), optional
        Torques of the drives at the joints, N m (N).
    force : (N,) or (N, 3), optional
        Contact force, N: along the surface's normal, or along the axes of the base.
    source : str
        Named in messages.
    v : (N, n), optional
        Joint velocities, rad/s (m/s): only compared with the rates of the positions, to find wrong units and orders.
    speed : (N,), optional
        Size of the tip's velocity, m/s.
    """

    time: Array
    q: Array | None = None
    torque: Array | None = None
    force: Array | None = None
    source: str = "the log"
    v: Array | None = None
    speed: Array | None = None

    @property
    def positions(self) -> Array:
        """Joint positions q (N, n); LogError if the recording has none."""
        if self.q is None:
            raise LogError(
                f"{self.source}: has no joint positions q: a contact is identified from how deep the tip is, which "
                "force and speed alone do not tell; where the tip's path is known, it is q of --robot pointmass3"
            )
        return self.q

    @property
    def step(self) -> float:
        """Median time between two rows, s."""
        return float(np.median(np.diff(self.time)))


def of_run(run: Run, source: str = "the run") -> Recording:
    """Return what a run recorded, with the force along the normal of its surface."""
    force = np.array(run.contact_force) if run.scenario.has_surface else None
    return Recording(np.array(run.time), np.array(run.q), np.array(run.torque), force, source)


def read_recording(
    path: str | Path,
    robot: RobotModel,
    *,
    columns: Mapping[str, str] | None = None,
    degrees: bool = False,
    gain: float | Sequence[float] = 1.0,
) -> Recording:
    """Read a log or a run file.

    Parameters
    ----------
    path : str or Path
        .csv, .parquet, .nc, .mcap, .db3 or a folder of rosbag2.
    robot : RobotModel
        Whose joints the columns are of.
    columns : mapping, optional
        Of "time", "q", "torque", "force", "speed" to names, as `closedloop.studies.identify.read.read_log` takes them;
        of "force" one name, or three with commas between.
    degrees : bool
        Whether angles are in degrees.
    gain : float or (n,)
        What torques are multiplied by.

    Raises
    ------
    LogError
        If the file cannot be read, a column is missing, a value is not finite, or time jumps.
    """
    path, given, factors = Path(path), dict(columns or {}), factors_of(gain)
    if unknown := set(given) - {"time", "q", "torque", "force", "speed"}:
        raise LogError(f"--columns {sorted(unknown)[0]}: is none of time, q, torque, force, speed")
    if path.suffix.lower() == ".nc" and not given:
        run = run_of(path)
        if run is not None:
            if run.model.joint_names != robot.joint_names:
                raise LogError(
                    f"{path}: its joints are {', '.join(run.model.joint_names)}: those of the scenario's robot are "
                    f"{', '.join(robot.joint_names)}"
                )
            return checked(of_run(run, str(path)), robot)
    table = table_of(path)
    force_names, speed_name = given.pop("force", None), given.pop("speed", None)
    time = time_of(table, given.get("time"), path)
    q, torque, v = (joints_of(table, what, given, robot, path, degrees) for what in ("q", "torque", "v"))
    if q is not None:
        check_positions(q, robot, str(path))
    force, speed = _force(table, force_names, path), _speed(table, speed_name, path)
    if q is None and force is None and speed is None:
        raise LogError(
            f"{path}: no columns for q of the joints {', '.join(robot.joint_names)}, for force or for speed: name "
            f"them, as in --columns q='q_{{}}'; it has {listed(table)}"
        )
    return checked(Recording(time, q, None if torque is None else torque * factors, force, str(path), v, speed), robot)


def _speed(table: dict[str, Array], asked: str | None, path: Path) -> Array | None:
    """Return the column of the tip's speed, m/s, or None if there is none."""
    for name in [asked] if asked else SPEED:
        found = columns_named(table, [name], "speed", path)
        if found is not None:
            return found[0]
    if asked:
        raise LogError(f"{path}: --columns speed={asked}: no column {asked!r}; it has {listed(table)}")
    return None


def _force(table: dict[str, Array], asked: str | None, path: Path) -> Array | None:
    """Return the columns of the force, N, (N,) or (N, 3), or None if there are none."""
    usual = [[name] for name in FORCE] + [[form.format(axis) for axis in axes] for form, axes in FORCES]
    named = [name.strip() for name in asked.split(",")] if asked else []
    for names in [named] if asked else usual:
        found = columns_named(table, names, "force", path) if len(names) in (1, 3) else None
        if found is not None:
            return found[0] if len(found) == 1 else np.stack(found, axis=1)
    if asked:
        missing = next((name for name in named if columns_named(table, [name], "force", path) is None), None)
        reason = f"no column {missing!r}" if missing else f"{len(named)} names: one, or three"
        raise LogError(f"{path}: --columns force={asked}: {reason}; it has {listed(table)}")
    return None


def checked(recording: Recording, robot: RobotModel) -> Recording:
    """Return the recording, of this robot, with every value finite and rows evenly spaced.

    Raises
    ------
    LogError
        If it has another number of rows or joints, a value that is not finite, or time that jumps.
    """
    where, time = recording.source, np.asarray(recording.time, dtype=np.float64)
    N = len(time)
    if N < FEWEST:
        raise LogError(f"{where}: {N} rows: a comparison needs at least {FEWEST}")
    for name, x, shapes in (
        ("time", time, [(N,)]),
        ("q", recording.q, [(N, robot.n)]),
        ("torque", recording.torque, [(N, robot.n)]),
        ("force", recording.force, [(N,), (N, 3)]),
        ("v", recording.v, [(N, robot.n)]),
        ("speed", recording.speed, [(N,)]),
    ):
        if x is None:
            continue
        if np.shape(x) not in shapes:
            raise LogError(f"{where}: {name} has shape {np.shape(x)}: must be {' or '.join(map(str, shapes))}")
        if not np.isfinite(x).all():
            raise LogError(f"{where}: {name} in row {int(np.argwhere(~np.isfinite(x))[0][0])} is not finite")
    step = check_time(time, where)
    if recording.q is None:
        if recording.force is None and recording.speed is None:
            raise LogError(f"{where}: has neither q nor force nor speed: there is nothing to compare")
        return recording
    check_motion(recording.q, recording.v, step, robot, where)
    if recording.torque is not None:
        check_torques(recording.q, recording.torque, robot, where)
    return recording
