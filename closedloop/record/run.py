"""A run: named columns with units, and with them everything that made them.

Row k holds the state at time[k] and what acted in that state: the acceleration, torque and contact force of a row
belong to the q and q̇ of the same row. The file is NetCDF-4, which is HDF5: xarray, h5py and MATLAB open it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from copy import deepcopy
from dataclasses import dataclass, field, replace
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from closedloop.contacts.names import names_of, tangents_of
from closedloop.events.table import EVENT_COLUMNS, KINDS
from closedloop.loops.reactions import LoopReactions
from closedloop.record.derived import DERIVED, reactions_of
from closedloop.scenario.arm import robot_of
from closedloop.scenario.scenario import Scenario
from robot_models import RobotModel

if TYPE_CHECKING:
    import pandas
    import xarray
    from matplotlib.figure import Figure

Array = NDArray[np.float64]


class Column(NamedTuple):
    """Dimensions, unit and meaning of a column."""

    dims: tuple[str, ...]
    units: str
    meaning: str


# Joint quantities are in rad, rad/s, rad/s² and N m for revolute joints; for prismatic ones m, m/s, m/s² and N.
_BY_TIME: dict[str, Column] = {
    "time": Column(("time",), "s", "time since the start of the run"),
    "q": Column(("time", "joint"), "rad", "joint positions"),
    "v": Column(("time", "joint"), "rad s-1", "joint velocities"),
    "acceleration": Column(("time", "joint"), "rad s-2", "joint accelerations, solution of Eq. 24"),
    "torque": Column(("time", "joint"), "N m", "torque Q of the control law on the joints (Eq. 33)"),
    "reference_position": Column(("time", "joint"), "rad", "q_des"),
    "reference_velocity": Column(("time", "joint"), "rad s-1", "time derivative of q_des"),
    "reference_tip": Column(("time", "axis"), "m", "desired tip position, base frame"),
    "reference_force": Column(("time",), "N", "desired contact force f_des"),
    "position": Column(("time", "axis"), "m", "tip position r, base frame"),
    "velocity": Column(("time", "axis"), "m s-1", "tip velocity, base frame"),
    "surface_normal": Column(("time", "axis"), "1", "unit normal n of the surface at the tip, base frame"),
    "slip_velocity": Column(
        ("time", "axis"), "m s-1", "velocity of the tip along the surface and relative to it, base frame"
    ),
    "contact_force": Column(
        ("time",),
        "N",
        "force of the surface on the tip along the surface normal; positive pushes the robot away",
    ),
    "stabiliser_force": Column(("time",), "N", "the part of contact_force that answers the stabiliser"),
    "friction_force": Column(("time", "axis"), "N", "tangential force of the surface on the tip, base frame"),
    "joint_friction": Column(("time", "joint"), "N m", "torque of friction on the joints"),
    "measured_force": Column(("time",), "N", "what the force sensor says after this row, for the next"),
    "closure_error": Column(("time",), "m", "e = n.r - d; positive off the surface"),
    "closure_rate": Column(("time",), "m s-1", "time derivative of closure_error"),
    "mode": Column(("time",), "1", "0 free, 1 pressed (sliding or at rest), 2 stuck"),
    "residual_motion": Column(("time",), "1", "relative residual of the equation of motion in Eq. 24"),
    "residual_closure": Column(("time",), "1", "relative residual of the closure row in Eq. 24"),
    "kkt_condition": Column(("time",), "1", "condition number of the matrix of Eq. 24, 1-norm, SI units"),
    "normal_mobility": Column(("time",), "1", "A H^-1 A^T over the trace of J H^-1 J^T; 0 at a singular pose"),
    "kinetic_energy": Column(("time",), "J", "kinetic energy, drives included"),
    "potential_energy": Column(("time",), "J", "potential energy of gravity"),
    "energy_supplied": Column(
        ("time",), "J", "work of torque, contact force and friction since the start, less what the events took"
    ),
}


# What draws a run: MODULE:FUNCTION, found when it is asked for, as drawing is above the record (tests/test_layers.py).
DRAWN_BY = {
    "plot": "closedloop.figures.overview:plot",
    "html": "closedloop.figures.html:html",
    "show": "closedloop.lab.show:show_run",
    "animate": "closedloop.lab.animate:animate",
}

# What a run has if its scenario asks for it, see `closedloop.engines.needs.arm_columns`.
ARM_COLUMNS: dict[str, Column] = {
    "torque_limited": Column(
        ("time", "joint"),
        "1",
        "0: torque is what the law asked for; 1: cut by the torque limit; 2: by the rate limit",
    ),
    "measured_position": Column(("time", "joint"), "rad", "joint positions as the encoders read them"),
    "measured_velocity": Column(("time", "joint"), "rad s-1", "joint velocities as the controller has them"),
    "motor_position": Column(("time", "joint"), "rad", "angles of the motors behind elastic joints, at the joints"),
    "motor_velocity": Column(("time", "joint"), "rad s-1", "rates of the motors behind elastic joints, at the joints"),
    "transmitted_torque": Column(("time", "joint"), "N m", "torque that elastic joints pass on to the links"),
}

# What it has if its links have contacts besides the tip.
CONTACT_COLUMNS: dict[str, Column] = {
    "link_modes": Column(("time", "contact"), "1", "mode of each contact of a link: 0 free, 1 sliding, 2 stuck"),
    "link_gaps": Column(("time", "contact"), "m", "gap of each, positive off its plane"),
    "link_forces": Column(("time", "contact"), "N", "force of each along its normal, on the link that has the point"),
    "link_frictions": Column(
        ("time", "contact_tangent"), "N", "force of each along the two tangents, in the axes of the plane's link"
    ),
    "link_slips": Column(("time", "contact_tangent"), "m s-1", "velocity of each along the two tangents"),
}
SOMETIMES = ARM_COLUMNS | CONTACT_COLUMNS

COLUMNS: dict[str, Column] = _BY_TIME | {name: Column(*spec) for name, spec in EVENT_COLUMNS.items()}
ALL_COLUMNS = COLUMNS | SOMETIMES


def columns_there(columns: Iterable[str]) -> dict[str, Column]:
    """Return `COLUMNS`, and those of `SOMETIMES` that are among the columns of a run."""
    return COLUMNS | {name: spec for name, spec in SOMETIMES.items() if name in columns}


class Event(NamedTuple):
    """One event of the contact: an impact, the beginning or the end of contact, of sticking or of slip.

    Attributes
    ----------
    time : float
        Instant, s.
    kind : str
        "impact", "touchdown", "liftoff", "stick", "slip", "reversal" or "edge".
    rate_before, rate_after : float
        Rate of the closure error just before and just after it, m/s.
    rate_cut : float
        Rate of a bounce that `impact.rest_speed` turned into contact, m/s.
    compression, decompression : float
        Impulses of both phases on the tip along the normal, N s.
    tangential : (3,) array
        Impulse on the tip along the surface, N s, base frame.
    energy_lost : float
        Kinetic energy lost, J; at an edge that of the spring of a soft surface.
    position : (3,) array
        Where the tip is, m, base frame.
    slip_before, slip_after : float
        Speed of the tip along the surface, m/s.
    restitution : float
        What an impact gave: what `impact.restitution` asks for, but where Newton's law would have created energy; 0 of
        all other events.
    contact : int
        Of which contact: 0 the tip, then the scenario's sections [[contact]] in their order.
    """

    time: float
    kind: str
    rate_before: float
    rate_after: float
    rate_cut: float
    compression: float
    decompression: float
    tangential: Array
    energy_lost: float
    position: Array
    slip_before: float
    slip_after: float
    restitution: float
    contact: int = 0


def events_of(columns: Mapping[str, NDArray[Any]]) -> tuple[Event, ...]:
    """Return the events of columns that have those of `EVENT_COLUMNS`, in order of time."""
    parts = [columns[name] for name in EVENT_COLUMNS]
    rows = zip(*(part if part.ndim == 2 else part.tolist() for part in parts), strict=True)
    return tuple(Event(row[0], KINDS[row[1]], *row[2:]) for row in rows)


@dataclass(frozen=True, eq=False)
class Run:
    """The record of a simulation, and what produced it.

    Every column in `COLUMNS`, and in `SOMETIMES` where the scenario asks for it, is also an attribute: `run.time`
    (N,), `run.q` (N, n), `run.position` (N, 3), `run.contact_force` (N,) ... So is every column of the table of events
    (`closedloop.events.table.EVENT_COLUMNS`), which `run.events` reads row by row; and what follows from them,
    `closedloop.record.derived.DERIVED`, such as `run.wrist_wrench` (N, 6). All are read-only.

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
        Who computed the terms; the last bits of a run depend on it.
    law_digest : str
        SHA-256 of the text of the user's law, see `closedloop.engines.law_source.law_digest`; "" if it is not known.
    member_digests : mapping of str to str
        Name, MODULE:CLASS, of each user's class that the scenario picks, to the same of its text.
    """

    scenario: Scenario
    model: RobotModel
    columns: Mapping[str, NDArray[Any]]
    law: str = "scenario"
    versions: Mapping[str, str] = field(default_factory=dict)
    stopped: str | None = None
    wall_seconds: float = 0.0
    engine: str = "pinocchio"
    law_digest: str = ""
    member_digests: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        derived = (self.__dict__[name] for name in DERIVED if name in self.__dict__)
        for column in (*self.columns.values(), *derived):
            column.setflags(write=False)

    def __setstate__(self, state: dict[str, Any]) -> None:
        # An array that was pickled or copied may be written to again.
        self.__dict__.update(state)
        self.__post_init__()

    def __getattr__(self, name: str) -> NDArray[Any]:
        if name in COLUMNS or (name in SOMETIMES and name in self.columns):
            column: NDArray[Any] = self.columns[name]
            return column
        if name in DERIVED:
            column = self.__dict__[name] = DERIVED[name].of(self)  # once: then it is found without asking here
            column.setflags(write=False)
            return column
        there = ", ".join((*columns_there(self.columns), *DERIVED))
        raise AttributeError(f"a Run has no '{name}'; its columns are {there}")

    def __dir__(self) -> list[str]:
        return [*super().__dir__(), *columns_there(self.columns), *DERIVED]

    def __len__(self) -> int:
        return int(self.columns["time"].size)

    def __repr__(self) -> str:
        end = self.columns["time"][-1] if len(self) else 0.0
        early = ", stopped early" if self.stopped else ""
        return f"<Run of {self.scenario.name}: {len(self)} rows, 0 to {end:g} s{early}>"

    @cached_property
    def events(self) -> tuple[Event, ...]:
        """What happened to the contact, in order of time."""
        return events_of(self.columns)

    @cached_property
    def _summary(self) -> dict[str, Any]:
        from closedloop.report import summarise

        return summarise(self)

    @cached_property
    def loops(self) -> LoopReactions | None:
        """What the loop joints of a mechanism carried, worked out when it is asked for; None of a tree."""
        if not self.model.loops:
            return None
        return reactions_of(self, robot_of(self.scenario, replace(self.model, whole=True)))

    def summary(self) -> dict[str, Any]:
        """Return what the command line prints and writes as summary.json; see `closedloop.report`."""
        return deepcopy(self._summary)

    def units(self, name: str) -> str:
        """Return the unit of a column; of a robot that turns and slides both, by joint type ("rad | m")."""
        spec = ALL_COLUMNS[name] if name in ALL_COLUMNS else DERIVED[name]
        sliding = spec.units.replace("rad", "m").replace("N m", "N")
        if "joint" not in spec.dims or sliding == spec.units:
            return spec.units
        kinds = {kind == "prismatic" for kind in self.model.joint_types}
        return f"{spec.units} | {sliding}" if len(kinds) == 2 else (sliding if kinds == {True} else spec.units)

    def to_xarray(self) -> xarray.Dataset:
        """Return the run as an xarray Dataset with units and the attributes of the file."""
        import xarray

        from closedloop.record.netcdf import attributes

        contacts = names_of(self.scenario.contact or ())

        def variable(name: str) -> tuple[tuple[str, ...], NDArray[Any], dict[str, str]]:
            spec = ALL_COLUMNS[name]
            return spec.dims, np.asarray(self.columns[name]), {"units": self.units(name), "long_name": spec.meaning}

        return xarray.Dataset(
            {name: variable(name) for name in columns_there(self.columns) if name != "time"},
            {
                "time": variable("time"),
                "joint": list(self.model.joint_names),
                "joint_type": ("joint", list(self.model.joint_types)),
                "axis": ["x", "y", "z"],
                **({"contact": list(contacts), "contact_tangent": list(tangents_of(contacts))} if contacts else {}),
            },
            attributes(self),
        )

    def to_pandas(self) -> pandas.DataFrame:
        """Return the columns over time as a pandas DataFrame; the events are in `events`.

        The index is the time, s. A column (N, k) becomes k, named after joints and axes, such as
        ``q[wam/base_yaw_joint]`` and ``position[z]``; ``attrs["units"]`` has the unit of each.
        """
        from closedloop.record.frame import data_frame

        known = columns_there(self.columns) | DERIVED
        dims = {name: spec.dims for name, spec in known.items() if spec.dims[0] == "time"}
        contacts = names_of(self.scenario.contact or ())
        return data_frame(
            {name: getattr(self, name) for name in dims}, dims, self.model.joint_names, contacts, self.units
        )

    def plot(self) -> Figure:
        """Return a matplotlib figure of the force's error, the tip's errors and the path from above.

        Jupyter shows it inline; nothing else holds it, and pyplot is not involved. `closedloop.figures` has the others.

        Raises
        ------
        ValueError
            If the run has no row.
        """
        figure: Figure = _drawn(self, "plot")
        return figure

    def _repr_html_(self) -> str:
        return str(_drawn(self, "html"))

    def save(self, path: str | Path) -> Path:
        """Write the run as NetCDF-4 (HDF5) and return the path; see `closedloop.record.netcdf.save_run`."""
        from closedloop.record.netcdf import save_run

        return save_run(self, path)

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
        return _drawn(self, "show", path)

    def animate(self, path: str | Path, *, speed: float = 1.0, frames_per_second: int = 25) -> Path:
        """Write a film of the run, .gif or .mp4, and return its path; see `closedloop.lab.animate.animate`.

        `speed` is how many seconds of the run a second of the film shows.

        Raises
        ------
        ScenarioError
            If the path has another ending, or the run has no rows.
        OutputError
            If the file cannot be written, or a .mp4 is asked for and there is no ffmpeg.
        """
        film: Path = _drawn(self, "animate", path, speed=speed, frames_per_second=frames_per_second)
        return film


def _drawn(run: Run, how: str, *arguments: Any, **options: Any) -> Any:
    """Return what draws a run, see `DRAWN_BY`, of it."""
    module, _, function = DRAWN_BY[how].partition(":")
    return getattr(import_module(module), function)(run, *arguments, **options)
