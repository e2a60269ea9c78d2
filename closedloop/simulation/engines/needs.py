"""What a scenario needs of the loop: a law at its address, columns of the record, readings of encoders."""

from __future__ import annotations

from closedloop.control.drives import DrivesSection
from closedloop.control.encoder import MEASURED_VELOCITY, NO_ENCODER, encoder_kind
from closedloop.control.sensor import SensorSection
from closedloop.scenario.robot_sections import ModelErrorSection
from closedloop.scenario.scenario import Scenario

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
