"""The values of a run's summary: their names, units and meaning, in order; first the run's, then each joint's."""

from __future__ import annotations

from typing import NamedTuple

from closedloop.scenario.scenario import Scenario

# The force has settled where it stays within this share of the largest f_des of the run.
SETTLED = 0.02


class Measure(NamedTuple):
    """Unit and meaning of a value."""

    units: str
    meaning: str


MEASURES: dict[str, Measure] = {
    "final_contact_force": Measure("N", "contact force at the end"),
    "peak_contact_force": Measure("N", "highest contact force"),
    "min_contact_force": Measure("N", "lowest contact force"),
    "max_stabiliser_force": Measure("N", "largest share of the contact force that is due to the stabiliser"),
    "max_abs_closure_error": Measure("m", "largest closure error in contact, either way"),
    "final_closure_error": Measure("m", "closure error at the end; positive off the surface"),
    "max_abs_closure_rate": Measure("m s-1", "largest closure rate in contact, either way"),
    "max_tip_speed": Measure("m s-1", "highest tip speed"),
    "max_kkt_residual": Measure("1", "largest relative residual of Eq. 24"),
    "max_kkt_condition": Measure("1", "largest condition number of the matrix of Eq. 24"),
    "min_normal_mobility": Measure("1", "lowest share of the tip's mobility along the normal; 0 at a singular pose"),
    "singular_pose_passed": Measure(
        "1", "1 if the tip came near singular poses on the way through only, with a contact force that stayed as it was"
    ),
    "max_energy_residual": Measure("J", "largest energy unaccounted for"),
    "energy_gained": Measure("J", "largest rise of kinetic and potential energy, of what moves without drives"),
    "energy_above_start": Measure("J", "how far they rise above the start's; of what moves without drives"),
    "energy_exchanged": Measure("J", "energy that the joint torques exchanged with the arm"),
    "deepest_penetration": Measure("m", "deepest that the tip was below the surface"),
    "time_in_contact": Measure("s", "time in contact"),
    "max_friction_force": Measure("N", "largest friction force on the tip"),
    "max_joint_friction": Measure("N m", "largest torque of friction in a joint"),
    "energy_lost_to_friction": Measure("J", "energy that sliding friction took, at all contacts and in the joints"),
    "energy_lost_in_impacts": Measure("J", "energy that impacts took, and what a soft surface had stored at its edge"),
    "energy_taken_at_rest": Measure("J", "part of that energy which the rule of rest removed (impact.rest_speed)"),
    "largest_rate_cut": Measure("m s-1", "fastest bounce that was cut to rest"),
    "rms_force_error": Measure("N", "RMS error of the contact force over the rows in contact"),
    "force_settled_at": Measure("s", "instant from which the contact force stays within 2 % of that desired"),
    "rms_path_error": Measure("m", "RMS distance of the tip from its path, along the surface, over the rows"),
    "max_kinetic_energy": Measure("J", "highest kinetic energy"),
    "start_closure_error": Measure("m", "closure error at the start, if in contact then; positive off the surface"),
    "largest_reference_force": Measure("N", "largest contact force asked for, either way"),
    "force_chatter": Measure("1", "share of the contact force that alternates from row to row"),
}

_OF_THE_TIP = (
    "final_contact_force", "peak_contact_force", "min_contact_force", "max_stabiliser_force", "max_abs_closure_error",
    "final_closure_error", "max_abs_closure_rate", "min_normal_mobility", "deepest_penetration", "time_in_contact",
    "max_friction_force", "rms_force_error", "force_settled_at", "start_closure_error", "force_chatter",
)  # fmt: skip


def absent_measures(scenario: Scenario, own_law: bool = False) -> tuple[str, ...]:
    """Return the measures that do not exist: without a surface those of the contact, without a law that of the path.

    What is driven, or touches something that moves by itself, may gain energy.
    """
    without_law: tuple[str, ...] = ("rms_path_error",) if not (scenario.has_law or own_law) else ()
    if own_law or not scenario.is_passive:
        without_law += ("energy_gained", "energy_above_start")
    return without_law if scenario.has_surface else (*_OF_THE_TIP, *without_law)


# Of each joint, in the robot's order; for a prismatic joint read m, m/s and N.
JOINT_MEASURES: dict[str, Measure] = {
    "position_excess": Measure("rad", "farthest that the joint was beyond its position limits"),
    "position_limit_left_at": Measure("s", "when the joint first left its position limits"),
    "max_joint_velocity": Measure("rad s-1", "highest speed of the joint"),
    "velocity_limit_exceeded_at": Measure("s", "when the joint was first faster than its velocity limit"),
    "max_joint_torque": Measure("N m", "largest torque asked of the joint"),
    "effort_limit_exceeded_at": Measure("s", "when the torque asked of the joint was first beyond its effort limit"),
    "torque_chatter": Measure("1", "share of the joint's torque that alternates from row to row"),
    "torque_limited_share": Measure("1", "share of the rows in which a limit of the drives cut the joint's torque"),
    "torque_limited_at": Measure("s", "when a limit of the drives first cut the joint's torque"),
}
# A joint's torque counts as at least this share of the joints' mean: where next to none is asked, rounding alternates.
LEAST_TORQUE = 0.01
