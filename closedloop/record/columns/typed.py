"""The columns of a run: dimensions, unit and meaning of each, and its type as an attribute.

An editor completes them, and a type checker refuses other names; a test compares them with what a run has. Columns that
only some runs have, such as states of a law of one's own, are not among them: ``run["law_error"]``.
"""

from __future__ import annotations

from typing import Annotated, Any, NamedTuple, Protocol, get_type_hints

from numpy.typing import NDArray


class Column(NamedTuple):
    """Dimensions, unit and meaning of a column."""

    dims: tuple[str, ...]
    units: str
    meaning: str


Values = NDArray[Any]
ROWS, JOINTS, AXES = ("time",), ("time", "joint"), ("time", "axis")
CONTACTS, TANGENTS = ("time", "contact"), ("time", "contact_tangent")


class EveryRun(Protocol):
    """What every run records.

    Joint quantities are in rad, rad/s, rad/s² and N m for revolute joints; for prismatic ones m, m/s, m/s² and N.
    """

    time: Annotated[Values, Column(ROWS, "s", "time since the start of the run")]
    q: Annotated[Values, Column(JOINTS, "rad", "joint positions")]
    v: Annotated[Values, Column(JOINTS, "rad s-1", "joint velocities")]
    acceleration: Annotated[Values, Column(JOINTS, "rad s-2", "joint accelerations, solution of Eq. 24")]
    torque: Annotated[Values, Column(JOINTS, "N m", "torque Q of the control law on the joints (Eq. 33)")]
    reference_position: Annotated[Values, Column(JOINTS, "rad", "q_des")]
    reference_velocity: Annotated[Values, Column(JOINTS, "rad s-1", "time derivative of q_des")]
    reference_tip: Annotated[Values, Column(AXES, "m", "desired tip position, base frame")]
    reference_force: Annotated[Values, Column(ROWS, "N", "desired contact force f_des")]
    position: Annotated[Values, Column(AXES, "m", "tip position r, base frame")]
    velocity: Annotated[Values, Column(AXES, "m s-1", "tip velocity, base frame")]
    surface_normal: Annotated[Values, Column(AXES, "1", "unit normal n of the surface at the tip, base frame")]
    slip_velocity: Annotated[
        Values, Column(AXES, "m s-1", "velocity of the tip along the surface and relative to it, base frame")
    ]
    contact_force: Annotated[
        Values,
        Column(ROWS, "N", "force of the surface on the tip along the surface normal; positive pushes the robot away"),
    ]
    stabiliser_force: Annotated[Values, Column(ROWS, "N", "part of contact_force that is due to the stabiliser")]
    friction_force: Annotated[Values, Column(AXES, "N", "tangential force of the surface on the tip, base frame")]
    joint_friction: Annotated[Values, Column(JOINTS, "N m", "torque of friction on the joints")]
    measured_force: Annotated[
        Values, Column(ROWS, "N", "reading of the force sensor that the law gets at the next row")
    ]
    closure_error: Annotated[Values, Column(ROWS, "m", "e = n.r - d; positive off the surface")]
    closure_rate: Annotated[Values, Column(ROWS, "m s-1", "time derivative of closure_error")]
    mode: Annotated[Values, Column(ROWS, "1", "0 free, 1 pressed (sliding or at rest), 2 stuck")]
    residual_motion: Annotated[Values, Column(ROWS, "1", "relative residual of the equation of motion in Eq. 24")]
    residual_closure: Annotated[Values, Column(ROWS, "1", "relative residual of the closure row in Eq. 24")]
    kkt_condition: Annotated[Values, Column(ROWS, "1", "condition number of the matrix of Eq. 24, 1-norm, SI units")]
    normal_mobility: Annotated[
        Values, Column(ROWS, "1", "A H^-1 A^T over the trace of J H^-1 J^T; 0 at a singular pose")
    ]
    kinetic_energy: Annotated[Values, Column(ROWS, "J", "kinetic energy, drives included")]
    potential_energy: Annotated[Values, Column(ROWS, "J", "potential energy of gravity")]
    energy_supplied: Annotated[
        Values,
        Column(ROWS, "J", "work of torque, contact force and friction since row 0, less what the events after it took"),
    ]


class OfArm(Protocol):
    """What a run has if its scenario asks for it, see `closedloop.simulation.engines.scenario_numbers.arm_columns`."""

    torque_limited: Annotated[
        Values,
        Column(JOINTS, "1", "0: torque is what the law asked for; 1: cut by the torque limit; 2: by the rate limit"),
    ]
    measured_position: Annotated[Values, Column(JOINTS, "rad", "joint positions as the encoders read them")]
    measured_velocity: Annotated[Values, Column(JOINTS, "rad s-1", "joint velocities as the controller has them")]
    motor_position: Annotated[
        Values, Column(JOINTS, "rad", "angles of the motors behind elastic joints, at the joints")
    ]
    motor_velocity: Annotated[
        Values, Column(JOINTS, "rad s-1", "rates of the motors behind elastic joints, at the joints")
    ]
    transmitted_torque: Annotated[Values, Column(JOINTS, "N m", "torque that elastic joints pass on to the links")]


class OfContacts(Protocol):
    """What it has if its links have contacts besides the tip."""

    link_modes: Annotated[Values, Column(CONTACTS, "1", "mode of each contact of a link: 0 free, 1 sliding, 2 stuck")]
    link_gaps: Annotated[Values, Column(CONTACTS, "m", "gap of each, positive off its plane")]
    link_forces: Annotated[
        Values, Column(CONTACTS, "N", "force of each along its normal, on the link that has the point")
    ]
    link_frictions: Annotated[
        Values,
        Column(TANGENTS, "N", "force of each along the two tangents, which are fixed in the link that has the surface"),
    ]
    link_slips: Annotated[
        Values, Column(TANGENTS, "m s-1", "velocity of each relative to its surface, along the two tangents")
    ]
    link_rolling_moments: Annotated[
        Values, Column(TANGENTS, "N m", "resistance of each to rolling, about the two tangents")
    ]
    link_pivoting_moments: Annotated[
        Values, Column(CONTACTS, "N m", "resistance of each to pivoting, about its normal")
    ]


class TypedColumns(EveryRun, OfArm, OfContacts, Protocol):
    """All that a run may have, with its table of events, the derived columns and the symbols."""

    event_time: Values
    event_kind: Values
    event_rate_before: Values
    event_rate_after: Values
    event_rate_cut: Values
    event_compression: Values
    event_decompression: Values
    event_tangential: Values
    event_energy_lost: Values
    event_energy_rested: Values
    event_position: Values
    event_slip_before: Values
    event_slip_after: Values
    event_restitution: Values
    event_contact: Values
    tip_force: Values
    wrist_wrench: Values
    tool_angle: Values
    orientation_error: Values
    stop_torque: Values
    f: Values
    f_des: Values
    f_measured: Values
    e: Values
    r: Values
    r_des: Values
    n: Values
    Q: Values
    q_des: Values
    v_des: Values


def columns_of(group: type) -> dict[str, Column]:
    """Return what each of a group of columns is."""
    return {name: hint.__metadata__[0] for name, hint in get_type_hints(group, include_extras=True).items()}
