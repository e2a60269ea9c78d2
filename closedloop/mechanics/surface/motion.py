"""The base class of motions of a surface: a section of the scenario, and the displacement as a function of time.

The surface is turned by an angle about an axis, and then shifted; both are functions of time, zero at t = 0. Where the
axis turns too, `spin` has what angle and axis leave out of the angular velocity. Its material may also flow along it,
as a belt does, which moves nothing but what rubs on it. A motion of one's own is a class derived from `SurfaceMotion`,
with its parameters as typed fields and the one function `move`. Those that ship are in
`closedloop.mechanics.surface.motions`, one file each, written the same way.
"""

import math
from typing import Annotated, Any, ClassVar

from pydantic import AfterValidator

from closedloop.base.arrays import Array
from closedloop.base.families import Family, Parameters
from closedloop.base.sections import SPEED, Number
from closedloop.jit.blocks import Block
from closedloop.jit.kernel import kernel
from closedloop.mechanics.surface.geometry import Pose


class Move(Block):
    """A displacement and its derivatives: what a motion writes. All are zero when it is asked, and the axis is z."""

    angle: float  # rad, about `axis` through `centre`
    rate: float  # rad/s
    acceleration: float  # rad/s²
    axis: Annotated[Array, 3]  # unit vector, base frame
    centre: Annotated[Array, 3]  # m, base frame
    # angular velocity beside that about a fixed axis, rad/s, base frame, and its rate, rad/s²: of an axis that turns
    spin: Annotated[Array, 3]
    spin_rate: Annotated[Array, 3]
    shift: Annotated[Array, 3]  # m, base frame
    shift_rate: Annotated[Array, 3]  # m/s
    shift_acceleration: Annotated[Array, 3]  # m/s²
    flow: Annotated[Array, 3]  # m/s, base frame at t = 0; it turns with the surface, and acts along the tangents alone
    flow_rate: Annotated[Array, 3]  # m/s²


class SurfaceMotion(Parameters):
    """[surface_motion]: how the surface moves (v₀ and a₀ of Eqs. 2-3)."""

    folder: ClassVar[str] = "closedloop.mechanics.surface.motions"

    def list_length(self) -> int:
        """Return how many entries each parameter has that is a list."""
        return 0

    @staticmethod
    def move(t: float, par: Any, m: Any) -> None:
        """Write the displacement at t, s, into the `Move` m; nothing written is at rest."""


MOTIONS = Family(SurfaceMotion, usual="none")


def moving(value: Any) -> Any:
    """Return the number, or the tuple of numbers, by which a surface moves; refuse zero."""
    if not any(value if isinstance(value, tuple) else (value,)):
        raise ValueError('must not be zero; a surface at rest is kind = "none"')
    return value


#: How fast a surface, or what runs along it, moves, m/s: not zero.
Velocity = Annotated[
    tuple[Annotated[Number, SPEED], Annotated[Number, SPEED], Annotated[Number, SPEED]], AfterValidator(moving)
]


@kernel
def begin_move(m: Move) -> None:
    """Write a displacement of nothing."""
    m.angle, m.rate, m.acceleration = 0.0, 0.0, 0.0
    for i in range(3):
        m.axis[i] = 1.0 if i == 2 else 0.0
        m.centre[i] = m.shift[i] = m.shift_rate[i] = m.shift_acceleration[i] = m.flow[i] = m.flow_rate[i] = 0.0
        m.spin[i] = m.spin_rate[i] = 0.0


@kernel
def displace(m: Move, origin: Array, axes: Array, pose: Pose) -> None:
    """Write where a surface is that was at `origin` (3,), m, with `axes` (3, 3), rows, before the displacement m."""
    c, s = math.cos(m.angle), math.sin(m.angle)
    k = m.axis
    for row in range(4):  # Rodrigues: x cos + k × x sin + k (k·x)(1 − cos), of each axis and of the origin
        x0 = axes[row, 0] if row < 3 else origin[0] - m.centre[0]
        x1 = axes[row, 1] if row < 3 else origin[1] - m.centre[1]
        x2 = axes[row, 2] if row < 3 else origin[2] - m.centre[2]
        along = (k[0] * x0 + k[1] * x1 + k[2] * x2) * (1.0 - c)
        y0 = x0 * c + (k[1] * x2 - k[2] * x1) * s + k[0] * along
        y1 = x1 * c + (k[2] * x0 - k[0] * x2) * s + k[1] * along
        y2 = x2 * c + (k[0] * x1 - k[1] * x0) * s + k[2] * along
        if row < 3:
            pose.axes[row, 0], pose.axes[row, 1], pose.axes[row, 2] = y0, y1, y2
        else:
            pose.origin[0], pose.origin[1], pose.origin[2] = y0, y1, y2  # from the centre, until it is added below
    o, p = pose.spin, pose.origin
    for i in range(3):
        o[i], pose.spin_rate[i] = k[i] * m.rate + m.spin[i], k[i] * m.acceleration + m.spin_rate[i]
    a = pose.spin_rate
    c0, c1, c2 = o[1] * p[2] - o[2] * p[1], o[2] * p[0] - o[0] * p[2], o[0] * p[1] - o[1] * p[0]
    pose.velocity[0], pose.velocity[1], pose.velocity[2] = c0, c1, c2
    pose.acceleration[0] = a[1] * p[2] - a[2] * p[1] + o[1] * c2 - o[2] * c1
    pose.acceleration[1] = a[2] * p[0] - a[0] * p[2] + o[2] * c0 - o[0] * c2
    pose.acceleration[2] = a[0] * p[1] - a[1] * p[0] + o[0] * c1 - o[1] * c0
    for i in range(3):
        pose.origin[i] += m.centre[i] + m.shift[i]
        pose.velocity[i] += m.shift_rate[i]
        pose.acceleration[i] += m.shift_acceleration[i]
        pose.flow[i] = axes[i, 0] * m.flow[0] + axes[i, 1] * m.flow[1] + axes[i, 2] * m.flow[2]
        pose.flow_rate[i] = axes[i, 0] * m.flow_rate[0] + axes[i, 1] * m.flow_rate[1] + axes[i, 2] * m.flow_rate[2]
