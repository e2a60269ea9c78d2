"""What a scenario needs of the loop: a law at its address, columns of the record, readings of encoders."""

from __future__ import annotations

from typing import Any

from closedloop.control.compensation.none import NoCompensation
from closedloop.control.drives import DrivesSection
from closedloop.control.encoder import MEASURED_VELOCITY, NO_ENCODER, encoder_kind
from closedloop.control.sensor import SensorSection
from closedloop.loop.step.entries import friction_entry, joint_friction_entry, law_entry
from closedloop.loop.step.soft_contact import compliance_entry
from closedloop.mechanics.friction.laws.none import NoFriction
from closedloop.mechanics.surface.compliances.none import Rigid
from closedloop.scenario.arm import has_stops, joint_friction_of
from closedloop.scenario.robot_sections import ModelErrorSection
from closedloop.scenario.scenario import Scenario
from robot_models import RobotModel

# Sections that ask for nothing.
_DRIVES, _SENSOR, _MODEL_ERROR = DrivesSection(), SensorSection(), ModelErrorSection()


def needs_general_form(scenario: Scenario) -> bool:
    """Whether a scenario is more than the paper's law on a smooth surface, see `closedloop.loop.step.evaluate`."""
    return (
        scenario.law.kind != "paper"
        or scenario.law.force_feedback > 0.0
        or scenario.law.force_integral > 0.0
        or scenario.compensation.kind != "none"
        or scenario.friction.kind != "none"
        or scenario.rubs_in_joints
        or scenario.sensor != _SENSOR
        or scenario.model_error != _MODEL_ERROR
        or bool(arm_columns(scenario))
        or bool(scenario.contact)
    )


def calls_law(scenario: Scenario, model: RobotModel) -> bool:
    """Whether the law is called by address: see `needs_general_form`."""
    undriven = not model.loops and not all(model.driven)
    return needs_general_form(scenario) or has_stops(scenario, model) or undriven


def entries_of(scenario: Scenario, model: RobotModel, user_law: bool = False) -> dict[str, Any]:
    """Return what the loop calls by address of the members of a scenario, by the names that `State` has for it."""
    found: dict[str, Any] = {}
    if calls_law(scenario, model) and not user_law:
        found["law"] = law_entry(type(scenario.law))
        if not isinstance(scenario.compensation, NoCompensation):
            found["compensation"] = law_entry(type(scenario.compensation))
    if not isinstance(scenario.compliance, Rigid):
        found["compliance"] = compliance_entry(type(scenario.compliance))
    if not isinstance(scenario.friction, NoFriction):
        found["friction"] = friction_entry(type(scenario.friction))
    if not isinstance(joints := joint_friction_of(scenario, model), NoFriction):
        found["joint_friction"] = joint_friction_entry(type(joints))
    return found


def arm_columns(scenario: Scenario) -> tuple[str, ...]:
    """Return the columns beyond `closedloop.loop.step.record_row.RECORDED` that a run of a scenario has."""
    drives = ("torque_limited",) if scenario.drives != _DRIVES else ()
    encoder = ("measured_position", "measured_velocity") if scenario.reads_encoders else ()
    motors = ("motor_position", "motor_velocity", "transmitted_torque") if scenario.transmission.elastic else ()
    return drives + encoder + motors


def reading_kind(scenario: Scenario) -> int:
    """Return whether the controller reads encoders, see `closedloop.control.encoder.encoder_kind`."""
    kind = encoder_kind(scenario.encoder)
    return MEASURED_VELOCITY if kind == NO_ENCODER and scenario.transmission.on_motors else kind
