"""A run: named columns with units, and with them everything that made them.

Row k holds the state at time[k] and what acted in that state: the acceleration, torque and contact force of a row
belong to the q and q̇ of the same row. The file is NetCDF-4, which is HDF5: xarray, h5py and MATLAB open it. What its
checksum does not vouch for is not read.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

import robot_models
from closedloop.base.arguments import arguments_checked
from closedloop.base.errors import ClosedLoopError, RunFileError, ScenarioError, faults_on_one_line, needs
from closedloop.base.files import reason_of
from closedloop.base.upwards import called
from closedloop.mechanics.loops.reactions import LoopReactions
from closedloop.mechanics.surface.placed import unit
from closedloop.record import save as stored
from closedloop.record.columns import derived
from closedloop.record.columns.derived import DERIVED, columns_by_contact
from closedloop.record.columns.record import (
    ALL_COLUMNS,
    OF_CONTACTS,
    SURFACE_COLUMNS,
    SYMBOLS,
    ColumnsOnDemand,
    Record,
)
from closedloop.record.report.summary import summarise
from closedloop.scenario.arm import robot_of
from closedloop.scenario.load import parse_scenario
from closedloop.scenario.user_module import lacks_members
from robot_models.cached import cached_property
from robot_models.errors import shown

if TYPE_CHECKING:
    import pandas
    import xarray
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def units_by_kind(units: str, kind: str) -> str:
    """Return the unit of an entry of a joint's column: of a joint or coordinate of this kind, from that for turning."""
    return {"prismatic": units.replace("rad", "m").replace("N m", "N"), "quaternion": "1"}.get(kind, units)


@dataclass(frozen=True, eq=False)
class Run(Record):
    """The record of a simulation, and what produced it.

    Every column in `COLUMNS`, and in `SOMETIMES` where the scenario asks for it, is also an attribute: `run.time` (N,),
    `run.q` (N, nq), `run.position` (N, 3), `run.contact_force` (N,) ... The columns of `SURFACE_COLUMNS` exist without
    a surface too, but the file then does not have them. Every column of the table of events
    (`closedloop.loop.events.table.EVENT_COLUMNS`) is an attribute too; `run.events` reads that table row by row. So are
    the columns that are computed from the others, `closedloop.record.columns.derived.DERIVED`, such as
    `run.wrist_wrench` (N, 6). Symbols of the equations name columns too (`SYMBOLS`): `run.f`, `run.f_measured`,
    `run.f_des`. All are read-only.

    Attributes
    ----------
    scenario : Scenario
        What was asked for.
    model : RobotModel
        The robot, whole: the run can be repeated without any other file.
    columns : mapping of str to array
        The record.
    law : str
        "scenario" for the scenario's own law, else the name of the user's.
    versions : mapping of str to str
        Packages that made the run.
    stopped : str or None
        Why the simulation could not go on; None if it ran to its end.
    wall_seconds : float
        Time the simulation took, s.
    engine : "pinocchio" or "compiled"
        The source of the terms; the last bits of a run depend on it.
    law_digest : str
        SHA-256 of the text of the user's law, see `closedloop.simulation.engines.law_source.law_digest`; "" if it is
        not known.
    member_digests : mapping of str to str
        For each user's class that the scenario names, MODULE:CLASS, the SHA-256 of its text.
    added : mapping of str to Column
        Dimensions, unit and meaning of the columns that not every run has: states of its law, ``law_NAME``, and what
        `record` of `closedloop.simulate` asked for.
    halved : mapping, optional
        By how much it differs from the same run at half the step, see `closedloop.simulation.simulate`.
    """

    def __post_init__(self) -> None:
        if isinstance(self.columns, ColumnsOnDemand):
            return
        if not isinstance(self.columns, Mapping) or not all(isinstance(x, np.ndarray) for x in self.columns.values()):
            raise ScenarioError(f"columns = {shown(self.columns)}: must be a dictionary from names to arrays")
        made = (self.__dict__[name] for name in DERIVED if name in self.__dict__)
        for column in (*self.columns.values(), *made):
            column.setflags(write=False)
        object.__setattr__(self, "columns", MappingProxyType(dict(self.columns)))

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "columns": dict(self.columns)}  # a read-only view cannot be pickled

    def __setstate__(self, state: dict[str, Any]) -> None:
        # An array that was pickled or copied may be written to again.
        self.__dict__.update(state)
        self.__post_init__()

    def _column(self, name: str) -> NDArray[Any]:
        """Return the column of a name that is no attribute."""
        there = self.__dict__.get("columns", {})  # none while it is being copied
        if name in there:
            return there[name]
        if there and name in SYMBOLS:
            return getattr(self, SYMBOLS[name])
        if there and ((name in SURFACE_COLUMNS and not self.scenario.has_surface) or name in OF_CONTACTS):
            return self._without_surface(name)
        if name in DERIVED:
            column = self.__dict__[name] = DERIVED[name].of(self)  # once: then it is found without asking here
            column.setflags(write=False)
            return column
        if there and self.scenario.contact and name in (of_contacts := columns_by_contact(self.scenario.contact)):
            base, k = of_contacts[name]
            return there[base][:, k]
        if hasattr(type(self), name):  # a property raised it: what it lacked is what is to be said
            return object.__getattribute__(self, name)
        raise AttributeError(f"a Run has no '{name}'; its columns are {', '.join((*there, *DERIVED))}")

    if not TYPE_CHECKING:  # which knows the columns by `TypedColumns`, and refuses other names
        __getattr__ = _column

    def __getitem__(self, name: str) -> NDArray[Any]:
        """Return a column by its name: ``run["contact_force"]`` is ``run.contact_force``.

        Raises
        ------
        KeyError
            If there is no such column; it names those there are.
        """
        column = getattr(self, name, None)
        if not isinstance(column, np.ndarray):
            raise KeyError(f"a Run has no column '{name}'; there are {', '.join((*self.columns, *DERIVED))}")
        return column

    def _without_surface(self, name: str) -> NDArray[Any]:
        """Return what stands for a column of a contact where there is none: no force, and `surface.normal`."""
        normal = name == "surface_normal"
        shape = (len(self), 3) if "axis" in ALL_COLUMNS[name].dims else (len(self),)
        value = unit(self.scenario.surface.normal, "surface.normal") if normal else 0.0
        column = np.full(shape, value, dtype=np.int8 if name == "mode" else np.float64)
        column.setflags(write=False)
        return column

    def __dir__(self) -> list[str]:
        return [*super().__dir__(), *self.specs, *columns_by_contact(self.scenario.contact or ()), *DERIVED, *SYMBOLS]

    def __repr__(self) -> str:
        end = self.columns["time"][-1] if len(self) else 0.0
        early = ", stopped early" if self.stopped else ""
        return f"<Run of {self.scenario.name}: {len(self)} rows, 0 to {end:g} s{early}>"

    @cached_property
    def _summary(self) -> dict[str, Any]:
        return summarise(self)

    @cached_property
    def loops(self) -> LoopReactions | None:
        """Reactions of the loop joints of a mechanism, computed on first access; None for a tree."""
        if not self.model.loops:
            return None
        return derived.reactions_of(self, robot_of(self.scenario, replace(self.model, whole=True)))

    def state(self, row: int) -> dict[str, list[float]]:
        """Return positions and velocities of a row as keys of a scenario, ``{"start.q": ..., "start.v": ...}``.

        ``scenario.replace(run.state(-1))`` begins where the run ended. States of the law, the sensor and the friction
        begin anew; `closedloop.Simulator.save` has them all.

        Raises
        ------
        ScenarioError
            If there is no such row.
        """
        if not -len(self) <= row < len(self):
            raise ScenarioError(f"state: row = {row}: the run has {len(self)} rows")
        return {"start.q": self.q[row].tolist(), "start.v": self.v[row].tolist()}

    def summary(self) -> dict[str, Any]:
        """Return what the command line prints and writes as summary.json; see `closedloop.record.report`."""
        return deepcopy(self._summary)

    def units(self, name: str) -> str:
        """Return the unit of a column; of a robot that turns and slides both, by joint type ("rad | m")."""
        name = SYMBOLS.get(name, name)
        if name in (of_contacts := columns_by_contact(self.scenario.contact or ())):
            name = of_contacts[name][0]
        spec = self.specs[name] if name in self.specs else DERIVED[name]
        sliding = units_by_kind(spec.units, "prismatic")
        if "coordinate" in spec.dims:
            return " | ".join(dict.fromkeys(units_by_kind(spec.units, kind) for kind in self.model.coordinate_types))
        if "joint" not in spec.dims or sliding == spec.units:
            return spec.units
        kinds = {kind == "prismatic" for kind in self.model.joint_types}
        return f"{spec.units} | {sliding}" if len(kinds) == 2 else (sliding if kinds == {True} else spec.units)

    def to_xarray(self) -> xarray.Dataset:
        """Return the run as an xarray Dataset with units and the attributes of the file."""
        needs("xarray")
        import xarray

        found = stored.variables_of(self)
        labels = {name: (each.dims, list(each.data)) for name, each in found.items() if each.data.dtype == object}
        columns = {name: each for name, each in found.items() if name not in labels and name != "time"}
        attributes = stored.CONVENTIONS | stored.attributes(self)
        return xarray.Dataset(columns, {"time": found["time"], **labels}, attributes)

    def to_pandas(self) -> pandas.DataFrame:
        """Return the columns over time as a pandas DataFrame; the events are in `events`.

        The index is the time, s. A column (N, k) becomes k, named after joints and axes, such as
        ``q[wam/base_yaw_joint]`` and ``position[z]``; ``attrs["units"]`` has the unit of each.
        """
        needs("pandas")
        import pandas

        parts: dict[str, NDArray[Any]] = {}
        of = {"time": self.units("time")}
        known: dict[str, Any] = {**self.specs, **DERIVED}
        for name in [name for name, spec in known.items() if spec.dims[0] == "time" and name != "time"]:
            values, labels = getattr(self, name), derived.part_labels(self, name)
            found = {f"{name}[{label}]": values[:, k] for k, label in enumerate(labels)} if labels else {name: values}
            parts |= found
            of |= dict.fromkeys(found, self.units(name))
        frame = pandas.DataFrame(parts, index=pandas.Index(self.time, name="time"))
        frame.attrs["units"] = of
        return frame

    def plot(self, ax: Axes | Sequence[Axes] | None = None) -> Figure:
        """Return a matplotlib figure of the force's error, the tip's errors and the path from above.

        Its panels are `figure.axes`; with `ax` they are axes of the caller's, see `closedloop.figures`. Jupyter shows
        it inline. It is not registered with pyplot, so it is freed when you delete it.
        `closedloop.figures` has the other figures.

        Raises
        ------
        ValueError
            If the run has no row.
        """
        return called("plot", self, ax)

    def _repr_html_(self) -> str:
        return str(called("html", self))

    @arguments_checked()
    def save(self, path: str | Path) -> Path:
        """Write the run in the format that the path's ending names, and return the path.

        ``.nc`` and ``.h5`` are NetCDF-4, which is HDF5, and which `closedloop.load_run` reads, see
        `closedloop.record.save.save_run`; ``.csv``, ``.mat``, ``.mcap`` and ``.parquet`` are for other programs, see
        `closedloop.figures.export`.

        Raises
        ------
        OutputError
            If the path has another ending, or the file cannot be written.
        """
        if Path(path).suffix in stored.HDF5:
            return stored.save_run(self, path)
        written: list[Path] = called("save", self, path)
        return written[0]

    @arguments_checked()
    def show(self, path: str | Path | None = None) -> Any:
        """Show the replay in a browser, or below a notebook's cell; with `path`, write its page there instead.

        Returns
        -------
        Path or IPython.display.HTML
            The page's file; in a notebook, without `path`, what it displays.

        Raises
        ------
        ScenarioError
            If the run has no rows.
        OutputError
            If the file cannot be written.
        """
        return called("show", self, path)

    @arguments_checked()
    def joint_wrench(self, joint: str, frame: str = "joint") -> NDArray[np.float64]:
        """Return the reaction wrench at a joint, (N, 6): force, N, and moment, N m, of its inner on its outer side.

        It is what moves all that hangs on the joint, less weight, contacts, loop joints and forces from outside. The
        moment is about the joint's origin; along the axis it is what drive, friction and stop give together. It is
        computed from the record.

        Parameters
        ----------
        joint : str
            A joint of the robot.
        frame : str
            Whose axes it is in: "joint", those of the joint's outer side; "world", the base's; or a frame of the robot.

        Raises
        ------
        ScenarioError
            If the tree has no such joint, or the robot no such frame.
        """
        return derived.joint_wrench(self, joint, frame)

    @arguments_checked()
    def contact_wrench(self, name: str) -> NDArray[np.float64]:
        """Return what the contacts of a name do together, (N, 9): force, N, moment, N m, and centre of pressure, m.

        The force is that on the link that has the points, axes of the base. The moment is about the middle of the
        points. The centre of pressure is the mean of the places, weighted by the normal forces; NaN where nothing
        touches. Moments against rolling and pivoting of single points are left out.

        Parameters
        ----------
        name : str
            Of a [[contact]]: of a face or a list of points that of all of them.

        Raises
        ------
        ScenarioError
            If there is no such contact.
        """
        return derived.face_wrench(self, name)

    def step_error(self, law: Any = None) -> dict[str, float | None]:
        """Return by how much the same run at half the step differs: ``force``, N, and ``position`` of the tip, m.

        Rows beside a change of contact do not count (`closedloop.record.report.halved`); what is not known is None. The
        run is simulated again, unless it has the comparison. `law` is the callable of a run that was made with one.

        Raises
        ------
        ScenarioError
            If the integrator chooses its steps, or the law is missing.
        SimulationError
            If the run at half the step stops before its first row.
        """
        return called("step_error", self, law)

    @arguments_checked()
    def animate(self, path: str | Path, *, speed: float = 1.0, frames_per_second: int = 25) -> Path:
        """Write a film of the run, .gif or .mp4, and return its path; see `closedloop.lab.animate.animate`.

        `speed` is how many seconds of the run a second of the film shows.

        Raises
        ------
        ScenarioError
            If the path has another ending, or the run has no rows.
        OutputError
            If the file cannot be written, or there is no ffmpeg for a .mp4.
        """
        return called("animate", self, path, speed=speed, frames_per_second=frames_per_second)


@arguments_checked()
def load_run(path: str | Path) -> Run:
    """Read a run that `save_run` wrote.

    A user's class that its scenario picks is not imported: the run can be looked at, and repeated once the class is
    named, as ``load_scenario`` and ``--reference.kind my_module:MyPath`` do. Until then the summary is that
    of the file.

    Raises
    ------
    RunFileError
        If there is no such file, or it is not a run, or it is damaged.
    """
    path = Path(path)
    try:
        run = _run_of(*stored.read_sealed(path, list(ALL_COLUMNS)))
    except KeyError as error:
        raise RunFileError(f"{path}: is not a run file, or is damaged: {error} is missing") from None
    except ClosedLoopError as error:
        raise RunFileError(f"{path}: {faults_on_one_line(error)}") from None
    except RecursionError:
        raise RunFileError(f"{path}: is damaged: an attribute is nested too deep") from None
    except (OSError, ValueError, TypeError, AttributeError, ArithmeticError, LookupError, RuntimeError) as error:
        raise RunFileError(f"{path}: is not a run file, or is damaged: {reason_of(error)}") from None
    return run


def _run_of(found: Mapping[str, Any], columns: dict[str, NDArray[Any]]) -> Run:
    """Make a run of what a file holds, which may be anything until its checksum is compared."""
    if found.get("format") != stored.FORMAT:
        raise RunFileError(f"is not a run file (its 'format' attribute is not '{stored.FORMAT}')")
    version = int(found["format_version"])
    if version != stored.FORMAT_VERSION:
        age, cure = ("a newer", "") if version > stored.FORMAT_VERSION else ("an older", "; run its scenario again")
        raise RunFileError(
            f"was written by {age} version: format {version}, this one reads {stored.FORMAT_VERSION}{cure}"
        )
    if stored.CHECKSUM not in found:
        raise RunFileError("has no checksum, so it cannot be checked for damage; run its scenario again")
    # Of what was written, whatever else another program has added since.
    ours = {name: value for name, value in found.items() if name in stored.ATTRIBUTES}
    if found[stored.CHECKSUM] != stored.checksum(ours, columns):
        raise RunFileError("is damaged, or was changed: its checksum is not that of its columns and attributes")
    run = Run(  # type: ignore[abstract]  # its columns are there by their names
        scenario=parse_scenario(found["scenario"], where="attribute 'scenario'", keep_absent=True),
        model=robot_models.from_text(found["robot_text"], **json.loads(found["robot"])),
        columns=columns,
        law=found["law"],
        versions=json.loads(found["versions"]),
        stopped=found["stopped"] or None,
        wall_seconds=float(found["wall_seconds"]),
        engine=found["engine"],
        law_digest=found["law_digest"],
        member_digests=json.loads(found.get(stored.MEMBERS, "{}")),
        added=derived.from_text(found[stored.ADDED]) if stored.ADDED in found else {},
        halved=json.loads(found[stored.HALVED]) if stored.HALVED in found else None,
    )
    if lacks_members(run.scenario):
        vars(run)["_summary"] = json.loads(found["summary"])
    return run
