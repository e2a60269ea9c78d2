"""What a simulation that is stepped from outside shows at an instant."""

import math
from functools import cache

from closedloop.base.arrays import Array
from closedloop.loop.events.table import event_columns
from closedloop.loop.step.record_row import ArmRow, Row
from closedloop.mechanics.closure.contact_force import FREE, PRESSED, STUCK
from closedloop.mechanics.surface.kinds.none import NoSurface
from closedloop.record.columns.record import Event, events_of
from robot_models.coordinates import with_quaternions

MODE_NAMES = {FREE: "free", PRESSED: "pressed", STUCK: "stuck"}

_place = cache(Row.place)


class StepState:
    """The state at an instant, as `closedloop.Simulator` returns it: copies, which later steps do not change.

    `f`, `torque` and `acceleration` belong together. With the scenario's own law, or a user's, the torque is the law's
    at this instant. After a step with a torque from outside it is that torque, which has acted until this instant; the
    next one acts from here, and replaces it in the record.

    Arrays are read-only. Joint quantities are in rad, rad/s, rad/s² and N m (m, m/s, m/s² and N of a joint that
    slides), vectors in space in the base frame.

    Attributes
    ----------
    time : float
        Time since the start of the run, s.
    row : int
        The row of the record that is this instant's.
    measured : float
        The force sensor's reading as a control law has it at this instant, N: `closedloop.LawInput.f_measured`.
    """

    __slots__ = ("_events", "_n", "_reads", "_row", "_types", "measured", "row", "time")

    def __init__(
        self, time: float, row: int, n: int, recorded: Array, measured: float, events: Array | None,
        reads: bool = False, types: tuple[str, ...] = (),
    ) -> None:  # fmt: skip
        recorded.flags.writeable = False
        self.time, self.row, self.measured = time, row, measured
        self._n, self._row, self._events, self._reads, self._types = n, recorded, events, reads, types

    @property
    def recorded(self) -> Array:
        """The row of the record, as it is now: the columns of `closedloop.loop.step.record_row.Row` come first."""
        return self._row

    def _part(self, name: str) -> Array:
        return self._row[_place(name, self._n)]

    @property
    def q(self) -> Array:
        """Joint positions (nq,): (n,), but for joints that turn freely, see `robot_models.coordinates`."""
        return with_quaternions(self._part("q"), self._types)

    @property
    def v(self) -> Array:
        """Joint velocities (n,)."""
        return self._part("v")

    @property
    def measured_position(self) -> Array:
        """Joint positions as the encoders read them (n,), see docs/real_arm.md; without encoders the true ones."""
        return self._read("measured_position") if self._reads else self.q

    @property
    def measured_velocity(self) -> Array:
        """Joint velocities as the controller has them (n,); without encoders the true ones."""
        return self._read("measured_velocity") if self._reads else self.v

    def _read(self, name: str) -> Array:
        return self._row[Row.count(self._n) :][ArmRow.place(name, self._n)]

    @property
    def acceleration(self) -> Array:
        """Joint accelerations (n,)."""
        return self._part("acceleration")

    @property
    def torque(self) -> Array:
        """Torque Q on the joints (n,)."""
        return self._part("torque")

    @property
    def position(self) -> Array:
        """Tip position r (3,), m."""
        return self._part("position")

    @property
    def velocity(self) -> Array:
        """Tip velocity (3,), m/s."""
        return self._part("velocity")

    @property
    def f(self) -> float:
        """Contact force along the surface's normal, N; positive pushes the tip away."""
        return float(self._part("contact_force"))

    @property
    def contact_force(self) -> float:
        """The same as `f`, by the name of a run's column."""
        return self.f

    @property
    def f_measured(self) -> float:
        """The same as `measured`, by the name of a law's input."""
        return self.measured

    @property
    def measured_force(self) -> float:
        """The same as `measured`, by the name of a run's column."""
        return self.measured

    @property
    def normal(self) -> Array:
        """Unit normal of the surface at the tip (3,)."""
        return self._part("surface_normal")

    @property
    def friction_force(self) -> Array:
        """Tangential force of the surface on the tip (3,), N."""
        return self._part("friction_force")

    @property
    def gap(self) -> float:
        """Closure error e = n·r − d, m; off the surface the gap; inf without a surface."""
        gap = float(self._part("closure_error"))
        return gap if gap < 0.5 * NoSurface.distance else math.inf

    @property
    def gap_rate(self) -> float:
        """Time derivative of the gap, m/s; 0 without a surface."""
        return float(self._part("closure_rate")) if self.gap < math.inf else 0.0

    @property
    def mode(self) -> int:
        """0 free, 1 pressed (sliding or at rest), 2 stuck, as in `Run.mode`."""
        return int(self._part("mode"))

    # By the names of a run's columns and symbols.
    closure_error = e = gap
    r, n, Q, surface_normal = position, normal, torque, normal

    @property
    def events(self) -> tuple[Event, ...]:
        """What happened to the contact since the state before, in order of time."""
        return events_of(event_columns(self._events)) if self._events is not None else ()

    def __repr__(self) -> str:
        what = ", ".join(event.kind for event in self.events)
        return (
            f"<StepState at {self.time:.6g} s: {MODE_NAMES[self.mode]}, f = {self.f:.6g} N, gap = {self.gap:.3g} m"
            f"{', ' if what else ''}{what}>"
        )
