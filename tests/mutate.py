"""Faults planted in a module, one at a time: which of them do its tests see?

    python -m tests.mutate --module closedloop.closure.contact_force --limit 40 --seed 0

A mutant is the module with one small change: + for −, < for ≤, a constant of the other sign, `and` for `or`, a term
left out, min for max, an index off by one, a statement left out. Each is put into a copy of the tree, and the tests of
`TESTS` run on it, interpreted (NUMBA_DISABLE_JIT=1): a mutant is killed if one fails, or if they take much longer than
without it. Survivors are printed with their line: a hole in the tests, or a change that changes nothing.

Every mutant runs in a process forked from one in which the packages are imported already, so that it costs little more
than its tests.
"""

from __future__ import annotations

import argparse
import ast
import copy
import os
import random
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
COPIED = ("closedloop", "robot_models", "validation", "tests", "docs", "pyproject.toml", "README.md", "CONTRIBUTING.md")
HEAVY = ("numpy", "scipy.linalg", "numba", "pinocchio", "hypothesis", "pytest", "pydantic", "xarray", "yourdfpy")
OURS = ("closedloop", "robot_models", "validation", "tests", "conftest")
IN = "tests/closedloop/"

# The quick tests that hold each module, or options of pytest that choose them.
TESTS: dict[str, tuple[str, ...]] = {
    "closedloop.closure.contact_force": (f"{IN}test_solve.py",),
    "closedloop.closure.solve": (f"{IN}test_solve.py",),
    "closedloop.integrators.rk4": (f"{IN}test_integrate.py",),
    "closedloop.step.advance": (f"{IN}test_integrate.py",),
    "closedloop.step.tip_friction": (
        f"{IN}test_friction_stop.py",
        f"{IN}test_kernel_faults.py",
        f"{IN}test_friction_turning.py",
    ),
    "closedloop.closure.residuals": (f"{IN}test_solve.py",),
    "closedloop.step.evaluate": (f"{IN}test_reference_desired.py", f"{IN}test_kernel_faults.py"),
    "closedloop.step.reference_row": (f"{IN}test_reference_desired.py", f"{IN}test_kernel_faults.py"),
    "closedloop.step.solve_contact": (f"{IN}test_friction_stop.py", f"{IN}test_kernel_faults.py"),
    "closedloop.events.substep": (
        f"{IN}test_friction_stop.py",
        f"{IN}test_kernel_faults.py",
        f"{IN}test_contact_events.py",
    ),
    "closedloop.events.locate": (
        f"{IN}test_friction_stop.py",
        f"{IN}test_kernel_faults.py",
        f"{IN}test_contact_events.py",
    ),
    "closedloop.impact.phases": (f"{IN}test_impact_planar.py", f"{IN}test_impact.py"),
    "closedloop.impact.single": (f"{IN}test_impact.py", f"{IN}test_impact_planar.py"),
    "closedloop.friction.bristle": (f"{IN}test_friction_laws.py", f"{IN}test_friction_bristles.py"),
    "closedloop.friction.laws.stribeck": (f"{IN}test_friction_laws.py",),
    "closedloop.friction.laws.dahl": (f"{IN}test_friction_laws.py", f"{IN}test_friction_bristles.py"),
    "closedloop.friction.laws.seven_parameter": (f"{IN}test_friction_seven_parameter.py", f"{IN}test_friction_laws.py"),
    "closedloop.control.tip_space": (f"{IN}test_control_laws.py",),
    "closedloop.control.law": (
        f"{IN}test_control_force.py",
        f"{IN}test_contact_command.py::test_no_law_presses_when_free_where_it_lets_go_in_contact",
    ),
    "closedloop.reference.timing": (f"{IN}test_reference_tip_path.py", f"{IN}test_reference_follow.py"),
    "closedloop.surface.contact": (f"{IN}test_surfaces.py::test_rates_are_the_derivatives",),
    "closedloop.surface.geometry": (
        f"{IN}test_surfaces.py::test_rates_are_the_derivatives",
        f"{IN}test_surfaces.py::test_rows_solve_the_constraint",
    ),
    "closedloop.loops.passing": (
        f"{IN}test_loop_passing.py",
        f"{IN}test_loops.py::test_a_flat_mechanism_passes_at_speed[parallelogram-5.0]",
        f"{IN}test_loops.py::test_a_flat_mechanism_passes_at_speed[change_point-5.03]",
    ),
    "closedloop.loops.factor": (f"{IN}test_loop_factor.py",),
    "closedloop.loops.close": (
        f"{IN}test_loops.py::test_open_start_is_refused_or_assembled",
        f"{IN}test_loops.py::test_loop_that_cannot_close_is_refused",
        f"{IN}test_loops.py::test_a_row_that_no_joint_can_move_is_kept_where_it_is_open",
        f"{IN}test_loops.py::test_a_state_is_closed_with_its_velocity",
        f"{IN}test_loops.py::test_drives_move_the_mechanism_as_the_law_asks",
    ),
    "closedloop.contacts.continuation": (f"{IN}test_contact_continuation.py", f"{IN}test_contact_forces.py"),
    "closedloop.reference.no_normal": (
        f"{IN}test_reference_no_normal.py",
        f"{IN}test_surfaces.py::test_what_does_not_go_is_refused_in_one_line",
        f"{IN}test_surfaces.py::test_a_surface_without_a_normal_ends_the_run",
    ),
    "closedloop.simulation.loop_entries": (f"{IN}test_loop_coordinates.py::test_each_list_is_filled_by_itself",),
    "robot_models.loop_coordinate": (
        f"{IN}test_loop_coordinates.py::test_wrong_tables_are_refused",
        f"{IN}test_loop_coordinates.py::test_lists_without_the_coordinate",
        f"{IN}test_loop_coordinates.py::test_coordinates_change_nothing_in_space",
        f"{IN}test_loop_coordinates.py::test_sliders_and_cylinders",
        f"{IN}test_loop_coordinates.py::test_the_smallest_rotation_from_one_direction_to_another",
    ),
    "closedloop.loops.rows": (f"{IN}test_loops.py::test_rows_are_the_derivatives_of_their_errors",),
    "closedloop.contacts.complementarity": (
        f"{IN}test_contacts.py::test_solution_is_one_of_those_that_enumeration_of_modes_finds",
    ),
    "closedloop.contacts.given_modes": (f"{IN}test_contact_forces.py",),
    "closedloop.contacts.least_norm": (f"{IN}test_contact_forces.py",),
    "closedloop.contacts.linear": (f"{IN}test_contact_forces.py",),
    "closedloop.contacts.modes": (
        f"{IN}test_contact_modes.py",
        f"{IN}test_contacts.py::test_block_on_an_incline_slips_where_friction_is_less_than_the_slope[0.3-0.1]",
        f"{IN}test_contacts.py::test_block_on_a_steep_incline_tips_where_its_weight_is_outside_its_base",
        f"{IN}test_contacts.py::test_block_slides_and_stops_and_a_tall_one_tips",
    ),
    "closedloop.contacts.impact": (
        f"{IN}test_contact_modes.py",
        f"{IN}test_contacts.py::test_block_falls_on_two_corners_at_one_instant",
        f"{IN}test_contacts.py::test_impulses_with_restitution_are_missed_only_where_there_are_none",
    ),
    "closedloop.robot.tree.dynamics": (f"{IN}test_tree_kernels.py", f"{IN}test_tree_terms.py"),
    "closedloop.events.impacts": (
        f"{IN}test_contact_impulse.py",
        f"{IN}test_restitution_given.py",
        f"{IN}test_kernel_faults.py::test_what_an_event_at_a_row_takes_is_booked_in_that_row",
        f"{IN}test_joint_stops.py::test_several_stops_and_the_tip_at_once",
        f"{IN}test_joint_stops.py::test_the_tip_strikes_an_arm_whose_joints_are_at_stops",
        f"{IN}test_event_kernels.py",
    ),
    "closedloop.events.stops": (
        f"{IN}test_event_kernels.py",
        f"{IN}test_joint_stops.py::test_several_stops_and_the_tip_at_once",
        f"{IN}test_joint_stops.py::test_the_tip_strikes_an_arm_whose_joints_are_at_stops",
        f"{IN}test_joint_stops.py::test_tip_in_contact_takes_part",
        f"{IN}test_joint_stops.py::test_mass_falls_onto_a_stop",
    ),
    "closedloop.impact.begin": (
        f"{IN}test_impact_spatial.py::test_random_impacts_are_those_of_an_ode_solver",
        f"{IN}test_impact_spatial.py::test_from_rest_along_the_plane_the_direction_is_the_only_one",
        f"{IN}test_impact_spatial.py::test_a_second_compression",
        f"{IN}test_impact_planar.py::test_rounding_in_the_immobile_direction_changes_nothing",
        f"{IN}test_impact_planar.py::test_slip_that_stops_and_sticks_by_hand",
    ),
    "closedloop.impact.rest": (
        f"{IN}test_impact_spatial.py::test_from_rest_along_the_plane_the_direction_is_the_only_one",
        f"{IN}test_impact_spatial.py::test_the_direction_from_rest_is_exact_where_a_tangent_is_light",
        f"{IN}test_impact_planar.py::test_random_planar_impacts_are_rouths[poisson]",
    ),
    "closedloop.impact.taylor": (
        f"{IN}test_impact_spatial.py::test_random_impacts_are_those_of_an_ode_solver",
        f"{IN}test_impact_spatial.py::test_balanced_impacts_follow_their_hodograph",
        f"{IN}test_impact_planar.py::test_slip_that_stops_and_sticks_by_hand",
    ),
    "closedloop.events.contacts": (
        f"{IN}test_contact_modes.py",
        f"{IN}test_contacts.py::test_block_on_an_incline_slips_where_friction_is_less_than_the_slope[0.3-0.305]",
        f"{IN}test_contacts.py::test_block_falls_on_two_corners_at_one_instant",
        f"{IN}test_contacts.py::test_painleves_rod_is_named",
        f"{IN}test_contact_stops.py::test_block_slides_into_a_stop[0.5]",
    ),
    "closedloop.events.projection": (
        f"{IN}test_event_kernels.py",
        f"{IN}test_contact_events.py::test_a_pull_between_all_evaluations_is_seen_by_the_adaptive_integrator_only[rk4]",
        f"{IN}test_friction_stop.py::test_a_block_stops_when_and_where_the_closed_form_says[120-coulomb]",
        f"{IN}test_contact_random.py::test_a_tiny_hop_ends_on_the_surface",
        f"{IN}test_projection.py::test_a_start_beside_the_surface_is_put_on_it_by_the_smallest_move",
    ),
    "closedloop.events.transitions": (
        f"{IN}test_event_kernels.py",
        f"{IN}test_friction_loop.py::test_where_friction_wedges_the_tip_the_run_ends_in_words",
        f"{IN}test_joint_stops.py::test_several_stops_and_the_tip_at_once",
        f"{IN}test_contact_events.py::test_liftoff_at_an_instant_inside_a_step",
        f"{IN}test_contact_events.py::test_a_dip_is_found_in_steps_of_first_order_too",
        f"{IN}test_friction_stop.py::test_a_block_breaks_away_when_the_pull_is_too_strong",
        f"{IN}test_friction_stop.py::test_a_block_stops_when_and_where_the_closed_form_says",
        f"{IN}test_surface_edges.py::test_it_falls_off_the_edge[adaptive-unilateral]",
        f"{IN}test_contact_random.py::test_a_tiny_hop_ends_on_the_surface",
        f"{IN}test_compliance.py::test_the_spring_at_an_edge_is_booked[law0]",
    ),
    "closedloop.events.proceed": (
        f"{IN}test_contact_events.py::test_a_dip_is_found_in_steps_of_first_order_too",
        f"{IN}test_contact_events.py::test_a_pull_inside_a_step_lets_go",
        f"{IN}test_contact_events.py::test_a_held_torque_acts_until_the_step_in_which_an_event_is_ends[rk4]",
        f"{IN}test_joint_stops.py::test_several_stops_and_the_tip_at_once",
        f"{IN}test_contact_random.py::test_a_singular_start_on_the_surface_stops_at_once",
        f"{IN}test_encoder.py::test_encoders_go_with_events_inside_a_step",
        f"{IN}test_transmission.py::test_the_controller_sees_its_side_and_rigid_joints[motor]",
        f"{IN}test_contacts.py::test_painleves_rod_is_named",
        f"{IN}test_contacts.py::test_a_scheme_of_one_stage_meets_the_floor_where_it_is",
        f"{IN}test_contact_events.py::test_a_tip_that_leaves_once_leaves_once",
        f"{IN}test_friction_bristles.py::test_bristles_of_tip_and_joints_are_advanced_with_the_step",
    ),
    "closedloop.step.locate": (
        f"{IN}test_step_kernels.py",
        f"{IN}test_restitution_given.py::test_what_is_no_bounce_has_no_restitution",
        f"{IN}test_surface_edges.py::test_it_falls_off_the_edge[adaptive-unilateral]",
        f"{IN}test_kernel_faults.py::test_a_stuck_tip_is_put_back_on_its_anchor_by_projection",
        f"{IN}test_contact_surfaces.py::test_mass_in_a_bowl_is_the_tip_in_a_bowl",
    ),
    "closedloop.step.singular": (
        f"{IN}test_singular.py::test_folded_arm_goes_through[scheme2-1e-07-0.05]",
        f"{IN}test_singular.py::test_a_step_far_shorter_than_the_pose_is_wide_goes_through",
        f"{IN}test_singular.py::test_a_tip_that_stays_there_stops",
        f"{IN}test_singular.py::test_force_in_the_pose_is_that_of_a_push_linear_in_the_distance",
        f"{IN}test_singular.py::test_a_way_that_is_none_or_too_long_ago_gives_no_force",
        f"{IN}test_singular.py::test_a_push_is_told_from_both_sides_of_the_pose",
        f"{IN}test_singular.py::test_what_is_remembered_of_the_way",
        f"{IN}test_singular.py::test_what_counts_as_a_push_is_bounded_from_both_sides",
        f"{IN}test_singular.py::test_brakes_push_the_tip_along_the_normal",
    ),
    "closedloop.step.seen": (
        f"{IN}test_step_kernels.py",
        f"{IN}test_encoder.py::test_a_velocity_by_differences_is_that_of_the_readings",
        f"{IN}test_encoder.py::test_the_law_computes_everything_from_its_readings",
        f"{IN}test_tool.py::test_a_controller_wrong_about_the_normal_presses_along_its_own",
        f"{IN}test_transmission.py::test_the_controller_sees_its_side_and_rigid_joints[motor]",
    ),
    "closedloop.step.belief": (f"{IN}test_step_kernels.py",),
    "closedloop.step.joint_friction": (
        f"{IN}test_step_kernels.py",
        f"{IN}test_friction_loop.py::test_a_joint_with_coulomb_friction_comes_to_rest_without_chatter",
        f"{IN}test_loops.py::test_friction_in_joints_acts_through_the_loop",
    ),
    "closedloop.step.soft_contact": (
        f"{IN}test_step_kernels.py",
        f"{IN}test_compliance.py::test_a_compliance_of_ones_own",
        f"{IN}test_compliance.py::test_the_spring_at_an_edge_is_booked[law0]",
        f"{IN}test_compliance.py::test_it_sticks_and_slips_on_a_soft_surface",
        f"{IN}test_compliance.py::test_friction_is_against_the_slip_where_a_soft_surface_pulls",
    ),
    "closedloop.step.energy_supplied": (
        f"{IN}test_step_kernels.py",
        f"{IN}test_contact_events.py::test_a_dip_is_found_in_steps_of_first_order_too",
        f"{IN}test_contacts.py::test_block_on_an_incline_slips_where_friction_is_less_than_the_slope[0.3-0.1]",
        f"{IN}test_contacts.py::test_block_slides_and_stops_and_a_tall_one_tips",
        f"{IN}test_supply.py::test_an_impact_at_the_start_is_accounted_for",
        f"{IN}test_supply.py::test_supplied_is_the_sum_of_what_the_rows_say",
    ),
    "closedloop.step.contact_rows": (
        f"{IN}test_contacts.py::test_block_on_an_incline_slips_where_friction_is_less_than_the_slope[0.3-0.305]",
        f"{IN}test_contact_stops.py::test_weight_is_shared_by_a_foot_and_a_stop",
        f"{IN}test_contact_surfaces.py::test_mass_in_a_bowl_is_the_tip_in_a_bowl",
        f"{IN}test_contact_surfaces.py::test_belt_takes_a_mass_along_and_a_turntable_holds_it",
        f"{IN}test_contact_surfaces.py::test_body_strikes_and_slides_in_a_bowl_that_another_carries[0.1]",
        f"{IN}test_contacts.py::test_a_scheme_of_one_stage_meets_the_floor_where_it_is",
        f"{IN}test_contacts.py::test_block_falls_on_two_corners_at_one_instant[0.5]",
    ),
    "closedloop.step.contacts": (
        f"{IN}test_contact_modes.py",
        f"{IN}test_contacts.py::test_block_on_an_incline_slips_where_friction_is_less_than_the_slope",
        f"{IN}test_contacts.py::test_block_on_a_steep_incline_tips_where_its_weight_is_outside_its_base",
        f"{IN}test_contacts.py::test_block_slides_and_stops_and_a_tall_one_tips",
        f"{IN}test_contacts.py::test_a_scheme_of_one_stage_meets_the_floor_where_it_is",
    ),
    "closedloop.step.closed_loops": (
        f"{IN}test_step_kernels.py",
        f"{IN}test_event_kernels.py",
        f"{IN}test_loop_factor.py",
        f"{IN}test_joint_stops.py::test_several_stops_and_the_tip_at_once",
        f"{IN}test_loops.py::test_open_start_is_refused_or_assembled",
        f"{IN}test_loop_control.py::test_no_error_changes_nothing[changes2]",
    ),
    "closedloop.loops.solve": (f"{IN}test_loop_factor.py", f"{IN}test_loop_passing.py"),
    "closedloop.loops.reactions": (
        f"{IN}test_loops.py::test_open_start_is_refused_or_assembled",
        f"{IN}test_loops.py::test_mechanism_falls_as_its_null_space_does[four_bar]",
        f"{IN}test_loops.py::test_reaction_of_dependent_rows_is_of_least_norm",
        f"{IN}test_loops.py::test_what_loops_and_stops_cannot_explain_is_told",
    ),
    "closedloop.closure.conditioning": (f"{IN}test_solve.py",),
    "closedloop.control.laws.hybrid": (
        f"{IN}test_control_laws.py::test_hybrid_is_its_formula",
        f"{IN}test_control_laws.py::test_at_rest_the_force_is_the_wanted_one",
        f"{IN}test_control_laws.py::test_torque_does_not_depend_on_the_tangents",
        f"{IN}test_control_laws.py::test_a_tip_off_the_surface_comes_down_at_a_set_speed[hybrid-]",
    ),
    "closedloop.control.laws.paper": (
        f"{IN}test_control_laws.py::test_at_rest_the_force_is_the_wanted_one",
        f"{IN}test_control_laws.py::test_paper_law_through_the_family_is_eq_33_to_the_last_bit",
    ),
    "closedloop.control.sensor": (f"{IN}test_control_sensor.py",),
    "closedloop.control.encoder": (
        f"{IN}test_encoder.py::test_a_perfect_encoder_samples_the_law_and_nothing_else",
        f"{IN}test_encoder.py::test_the_law_computes_everything_from_its_readings",
        f"{IN}test_encoder.py::test_readings_are_quantised_and_as_noisy_as_asked_for",
        f"{IN}test_encoder.py::test_a_velocity_by_differences_is_that_of_the_readings",
        f"{IN}test_encoder.py::test_what_does_not_go_is_refused_in_one_line",
    ),
    "closedloop.control.drives": (
        f"{IN}test_drives.py::test_a_cut_is_the_nearest_torque_within_the_limits",
        f"{IN}test_drives.py::test_a_torque_that_is_cut_is_the_limit_to_the_bit",
        f"{IN}test_drives.py::test_limits_of_the_robots_file_act_on_request",
        f"{IN}test_drives.py::test_a_torque_from_outside_is_cut_too",
        f"{IN}test_drives.py::test_what_does_not_go_is_refused_in_one_line",
        f"{IN}test_drives.py::test_a_file_without_effort_limits_has_none_to_act",
    ),
    "closedloop.control.compensation.model": (
        f"{IN}test_control_compensation.py::test_the_model_is_its_formula",
        f"{IN}test_control_compensation.py::test_compensation_rests_without_friction",
        f"{IN}test_control_sections.py",
    ),
    "closedloop.friction.laws.lugre": (
        f"{IN}test_friction_laws.py",
        f"{IN}test_friction_lugre.py",
        f"{IN}test_friction_sections.py::test_energy_fault_says_what_would_be_right",
        f"{IN}test_friction_sections.py::test_energy_fault_names_the_joint",
    ),
    "closedloop.friction.law": (
        f"{IN}test_friction_laws.py",
        f"{IN}test_friction_sections.py::test_bad_figures_are_refused",
        f"{IN}test_friction_sections.py::test_static_friction_may_equal_kinetic",
        f"{IN}test_friction_own.py::test_what_a_law_must_define",
    ),
    "closedloop.robot.tree.kinematics": (f"{IN}test_tree_terms.py", f"{IN}test_tree_kernels.py"),
    "closedloop.robot.tree.terms": (f"{IN}test_tree_terms.py", f"{IN}test_tree_kernels.py"),
    "closedloop.robot.tree.energy": (f"{IN}test_tree_terms.py", f"{IN}test_tree_kernels.py"),
    "closedloop.robot.tree.angles": (f"{IN}test_tree_terms.py", f"{IN}test_tree_kernels.py"),
    "closedloop.robot.tip": (f"{IN}test_robot.py",),
    "closedloop.reference.least_norm": (f"{IN}test_reference_least_norm.py",),
    "closedloop.surface.second_order": (
        f"{IN}test_surface_expression.py::test_derivatives_are_exact",
        f"{IN}test_surface_expression.py::test_where_there_is_no_value_there_is_none",
    ),
    "closedloop.surface.motion": (
        f"{IN}test_surfaces.py::test_a_displacement_is_a_rotation_and_then_a_shift",
        f"{IN}test_surfaces.py::test_rates_are_the_derivatives",
    ),
    "closedloop.surface.gradient": (f"{IN}test_surfaces.py::test_gradients_at_many_instants",),
    "closedloop.surface.kinds.height_field": (
        f"{IN}test_surfaces.py::test_a_height_field_is_scipys_spline",
        f"{IN}test_surfaces.py::test_a_height_field_goes_through_its_heights",
        f"{IN}test_surface_edges.py::test_a_height_field_ends_where_its_grid_does",
        f"{IN}test_surface_edges.py::test_what_does_not_go_with_an_edge_is_refused",
    ),
    "closedloop.reference.joint_path": (
        f"{IN}test_reference_follow.py::test_path_between_knots_is_the_cubic_of_hermite[wam4-circle]",
        f"{IN}test_reference_follow.py::test_joint_velocity_and_acceleration_are_the_derivatives[wam4-linear]",
        f"{IN}test_reference.py::test_velocity_begins_and_ends_with_a_step",
        f"{IN}test_reference.py::test_instants_that_rounding_moved_count_as_the_instant_itself",
        f"{IN}test_reference.py::test_hold_stays",
    ),
    "closedloop.reference.inverse_kinematics": (
        f"{IN}test_reference_follow.py::test_tip_is_on_the_path_between_knots[wam4-linear]",
        f"{IN}test_reference_follow.py::test_tip_is_on_the_path_at_the_knots_to_rounding[wam4-linear]",
        f"{IN}test_reference_follow.py::test_joint_motion_gives_the_tip_its_velocity_and_acceleration[wam4-linear]",
        f"{IN}test_reference_follow.py::test_path_is_the_solution_of_least_joint_motion[linear]",
        f"{IN}test_reference.py::test_path_is_the_solution_of_least_joint_motion",
        f"{IN}test_reference.py::test_leaving_the_joint_limits_is_refused_with_the_joint_and_the_instant",
        f"{IN}test_reference_orientation.py::test_rows_of_the_axis_and_of_the_frame",
        f"{IN}test_reference_orientation.py::test_a_frame_is_held[start]",
        f"{IN}test_reference_orientation.py::test_another_axis_of_the_tool",
    ),
    "closedloop.step.transmission": (
        f"{IN}test_transmission.py::test_spring_damper_and_motor_are_their_formulas",
        f"{IN}test_transmission.py::test_a_motor_and_a_mass_swing_as_two_masses_do",
    ),
    "closedloop.report.row_sample": (f"{IN}test_measured.py",),
    "closedloop.report.measured": (
        f"{IN}test_measured.py",
        f"{IN}test_verdict.py::test_planted_nonsense_is_named_everywhere[singular pose passed]",
    ),
    "closedloop.report.row_assumptions": (
        f"{IN}test_measured.py::test_every_assumption_by_itself",
        f"{IN}test_measured.py::test_values_are_what_they_are_called",
    ),
    "closedloop.report.alternation": (
        f"{IN}test_measured.py::test_values_are_what_they_are_called",
        f"{IN}test_measured.py::test_alternation_is_that_of_the_values_one_by_one",
        f"{IN}test_verdict.py::test_alternation_is_the_amplitude_of_what_alternates",
    ),
    "closedloop.step.record_row": (
        f"{IN}test_simulation.py::test_columns_of_a_slip_on_a_slope",
        f"{IN}test_transmission.py::test_a_motor_and_a_mass_swing_as_two_masses_do",
        f"{IN}test_encoder.py::test_a_velocity_by_differences_is_that_of_the_readings",
        f"{IN}test_simulation.py::test_every_row_has_its_own_condition",
        f"{IN}test_blocks.py::test_recorded_columns_are_those_written",
        f"{IN}test_contacts.py::test_block_on_an_incline_slips_where_friction_is_less_than_the_slope[0.3-0.1]",
    ),
    "closedloop.step.entries": (
        f"{IN}test_friction_laws.py::test_an_entry_is_the_law_of_each_contact",
        f"{IN}test_simulation.py::test_columns_of_a_slip_on_a_slope",
        f"{IN}test_control_force.py::test_proportional_and_integral_feedback",
        f"{IN}test_control_force.py::test_observer_takes_a_constant_load_out",
        f"{IN}test_encoder.py::test_the_law_computes_everything_from_its_readings",
        f"{IN}test_encoder.py::test_what_is_wanted_is_not_measured",
        f"{IN}test_friction_own.py::test_drag_in_the_joints[compiled]",
    ),
}

ARITHMETIC = {ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult}
COMPARISONS = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
}  # fmt: skip
NAMES = {"min": "max", "max": "min", "sin": "cos", "cos": "sin", "floor": "ceil", "LOW": "HIGH", "HIGH": "LOW"}


class Mutant(NamedTuple):
    """One change.

    Attributes
    ----------
    line : int
        Where, in the module as it is.
    change : str
        What, in words.
    text : str
        The whole module with it.
    """

    line: int
    change: str
    text: str


def mutants(source: str) -> Iterator[Mutant]:
    """Yield every mutant of a module: of what stands in its functions, but for annotations, decorators and messages."""
    tree = ast.parse(source)
    for function in [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]:
        for node in _inside(function):
            for change, replacement in _changes(node):
                yield Mutant(getattr(node, "lineno", function.lineno), change, _with(tree, node, replacement))


def _inside(function: ast.FunctionDef) -> Iterator[ast.AST]:
    """Yield the nodes of a function's body that say what it does; nested functions come by themselves."""
    waiting: list[ast.AST] = list(function.body)
    while waiting:
        node = waiting.pop(0)
        if isinstance(node, (ast.Raise, ast.Assert, ast.FunctionDef, ast.Import, ast.ImportFrom, ast.JoinedStr)):
            continue
        yield node
        if isinstance(node, ast.AnnAssign):
            waiting += [node.target] + ([node.value] if node.value else [])
        else:
            waiting += ast.iter_child_nodes(node)


def _changes(node: ast.AST) -> Iterator[tuple[str, ast.AST]]:
    """Yield what a node may be replaced by, and that in words."""
    text = ast.unparse(node) if isinstance(node, (ast.expr, ast.stmt)) else ""
    short = text.splitlines()[0][:60] if text else ""
    match node:
        case ast.BinOp(left=left, op=op) | ast.AugAssign(target=left, op=op):
            if type(op) in ARITHMETIC:
                yield (
                    f"{type(op).__name__} -> {ARITHMETIC[type(op)].__name__} in {short}",
                    _set(node, op=ARITHMETIC[type(op)]()),
                )
            if isinstance(node, ast.BinOp) and isinstance(op, (ast.Add, ast.Sub)):
                yield f"last term left out of {short}", left
        case ast.Compare(ops=[op, *_]) if type(op) in COMPARISONS:
            other = COMPARISONS[type(op)]
            yield f"{type(op).__name__} -> {other.__name__} in {short}", _set(node, ops=[other(), *node.ops[1:]])
        case ast.BoolOp(op=op):
            other_op = ast.Or() if isinstance(op, ast.And) else ast.And()
            yield f"and <-> or in {short}", _set(node, op=other_op)
        case ast.UnaryOp(op=ast.USub() | ast.Not(), operand=operand):
            yield f"sign or not left out of {short}", operand
        case ast.Constant(value=float(value)):
            yield f"{short} -> {-value if value else 1.0}", ast.Constant(-value if value else 1.0)
        case ast.Subscript(slice=ast.Constant(value=int(index))):
            yield f"index of {short} off by one", _set(node, slice=ast.Constant(index - 1 if index else 1))
        case ast.Name(id=name, ctx=ast.Load()) if name in NAMES:
            yield f"{name} -> {NAMES[name]}", ast.Name(NAMES[name], ast.Load())
        case ast.Attribute(attr=name) if name in NAMES:
            yield f"{name} -> {NAMES[name]} in {short}", _set(node, attr=NAMES[name])
        case ast.Assign() | ast.AugAssign() | ast.Expr(value=ast.Call()):
            yield f"left out: {short}", ast.Pass()
        case _:
            pass
    if isinstance(node, ast.AugAssign):
        yield f"left out: {short}", ast.Pass()


def _set(node: ast.AST, **fields: object) -> ast.AST:
    changed = copy.copy(node)
    for name, value in fields.items():
        setattr(changed, name, value)
    return changed


def _with(tree: ast.Module, node: ast.AST, replacement: ast.AST) -> str:
    """Return the text of the module in which one node is replaced."""

    class Replace(ast.NodeTransformer):
        def visit(self, here: ast.AST) -> ast.AST:
            return replacement if here is node else self.generic_visit(_set(here, **_lists(here)))

    return ast.unparse(ast.fix_missing_locations(Replace().visit(tree)))


def _lists(node: ast.AST) -> dict[str, list[object]]:
    """Return copies of a node's lists: the transformer writes into them."""
    return {name: list(value) for name, value in ast.iter_fields(node) if isinstance(value, list)}


def sample(source: str, limit: int, seed: int) -> list[Mutant]:
    """Return so many of a module's mutants, drawn evenly, in order of their lines."""
    different = {mutant.text: mutant for mutant in mutants(source) if mutant.text != ast.unparse(ast.parse(source))}
    found = list(different.values())
    return sorted(random.Random(seed).sample(found, min(limit, len(found))), key=lambda mutant: mutant.line)


def tests_fail(folder: Path, tests: Sequence[str], seconds: float) -> tuple[bool | None, float]:
    """Return whether one of the tests fails in a copy of the tree, None if they were ended, and how long they took."""
    began = time.monotonic()
    child = os.fork()
    if child == 0:
        _run_tests(folder, tests)
    while time.monotonic() - began < seconds:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status) != 0, time.monotonic() - began
        time.sleep(0.05)
    os.kill(child, 9)
    os.waitpid(child, 0)
    return None, time.monotonic() - began


def _run_tests(folder: Path, tests: Sequence[str]) -> None:
    """Run the tests of a folder in this process, quietly, and end it with pytest's exit status."""
    status = 1
    try:
        import pytest

        nothing = os.open(os.devnull, os.O_RDWR)
        for stream in (0, 1, 2):
            os.dup2(nothing, stream)
        os.chdir(folder)
        # What the caller has imported of its own tree is not what is measured.
        for name in [name for name in sys.modules if name.partition(".")[0] in OURS]:
            del sys.modules[name]
        sys.path[:] = [str(folder), *(path for path in sys.path if path not in ("", str(ROOT)))]
        options = ["-x", "-q", "-p", "no:cacheprovider", "-o", "addopts=", "-m", "not slow", "--import-mode=prepend"]
        status = int(pytest.main([*options, *tests]))
    finally:
        os._exit(status)


def measure(path: Path, tests: Sequence[str], limit: int, seed: int, root: Path = ROOT) -> tuple[int, list[Mutant]]:
    """Return how many of a module's mutants were killed, and those that survived; say how it goes on.

    Parameters
    ----------
    path : Path
        The module's file, inside `root`.
    tests : sequence of str
        What pytest is given.
    limit, seed : int
        How many mutants are drawn.
    root : Path
        The tree that is copied.

    Raises
    ------
    SystemExit
        If the tests fail without any mutant.
    """
    source, place = path.read_text(encoding="utf-8"), path.relative_to(root)
    killed, survivors = 0, []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for entry in COPIED:
            if (root / entry).is_dir():
                shutil.copytree(root / entry, folder / entry, ignore=shutil.ignore_patterns("__pycache__", "*.nbc"))
            elif (root / entry).exists():
                shutil.copy(root / entry, folder / entry)
        (folder / place).write_text(ast.unparse(ast.parse(source)), encoding="utf-8")
        fails, seconds = tests_fail(folder, tests, 1800.0)
        if fails is not False:
            raise SystemExit(f"{place}: the tests fail without any mutant: {' '.join(tests)}")
        print(f"{place}: the tests take {seconds:.1f} s: {' '.join(tests)}", flush=True)
        for mutant in sample(source, limit, seed):
            (folder / place).write_text(mutant.text, encoding="utf-8")
            fails, _ = tests_fail(folder, tests, 20.0 + 5.0 * seconds)
            killed += fails is not False
            survivors += [mutant] if fails is False else []
            verdict = {True: "killed", False: "SURVIVED", None: "killed (took too long)"}[fails]
            print(f"  {place}:{mutant.line}: {mutant.change}: {verdict}", flush=True)
    print(f"{place}: {killed} of {killed + len(survivors)} killed", flush=True)
    return killed, survivors


def main() -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(
        prog="tests.mutate", description="Plant faults in a module and see what sees them."
    )
    parser.add_argument("--module", action="append", choices=sorted(TESTS), required=True, help="once for each module")
    parser.add_argument("--limit", type=int, default=40, help="mutants of each (default 40)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--tests", nargs="*", help="other tests than those of the table")
    options = parser.parse_args()
    os.environ["NUMBA_DISABLE_JIT"] = "1"
    for name in HEAVY:
        __import__(name)
    scores = {}
    for module in options.module:
        path = ROOT / (module.replace(".", "/") + ".py")
        killed, survivors = measure(path, options.tests or TESTS[module], options.limit, options.seed)
        scores[module] = f"{killed} of {killed + len(survivors)}"
    print("\n".join(f"{module:32} {score}" for module, score in scores.items()))


if __name__ == "__main__":
    main()
