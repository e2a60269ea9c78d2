"""Values to begin with when another kind is chosen whose keys have no defaults, such as the radius of a circle."""

from __future__ import annotations

from typing import Any, Literal, get_args, get_origin

from closedloop.base.sections import field_units
from closedloop.lab.spans import USUAL
from closedloop.mechanics.surface.plane import contact_frame, unit
from closedloop.scenario.messages import variants
from closedloop.scenario.scenario import Scenario

# By key; what the present kind has under the same name is kept instead.
BEGIN: dict[str, Any] = {
    "reference.radius": 0.02, "reference.width": 0.06, "reference.height": 0.03, "reference.speed": 0.01,
    "reference.length": 0.06, "reference.pitch": 0.01, "reference.passes": 3,
    "law.kp": 400.0, "law.kd": 30.0,
    "friction.coefficient": 0.3, "friction.viscous": 1.0, "friction.stiffness": 1e4, "friction.kinetic": 0.3,
    "friction.static": 0.4, "friction.dead_band": 1e-3, "friction.stribeck_speed": 0.005, "friction.damping": 30.0,
    "friction.static_excess": 0.1, "friction.memory_delay": 0.005, "friction.rise_time": 0.1,
    "joint_friction.kinetic": 0.3, "joint_friction.static": 0.4, "joint_friction.viscous": 0.1,
    "joint_friction.stiffness": 1e3, "joint_friction.damping": 3.0, "joint_friction.dead_band": 1e-3,
    "joint_friction.stribeck_speed": 0.01, "joint_friction.static_excess": 0.1, "joint_friction.memory_delay": 0.005,
    "joint_friction.rise_time": 0.1,
    "surface_motion.velocity": [0.0, 0.01, 0.0], "surface_motion.speed": 0.1,
    "surface.heights": [[0.0] * 17] * 17, "surface.expression": "z", "surface.faces": [[1.0, 0.0, 0.0, 0.1]],
    "force_profile.amplitude": 2.0, "force_profile.frequency": 1.0,
}  # fmt: skip


def begin_values(scenario: Scenario, section: str, kind: str) -> dict[str, Any]:
    """Return dotted keys and values of those that a kind requires and the scenario's section does not have."""
    held = getattr(scenario, section)
    found: dict[str, Any] = {}
    for name, field in variants(section)[kind].model_fields.items():
        key = f"{section}.{name}"
        words = get_args(field.annotation) if get_origin(field.annotation) is Literal else ()
        if name != "kind" and words and getattr(held, name, words[0]) not in words:
            found[key] = field.default  # a word that the present kind has and this one does not know
        if field.is_required() and not hasattr(held, name):
            found[key] = _value(scenario, key, next(iter(field_units(field)), "").partition(" (")[0])
    return found


def _value(scenario: Scenario, key: str, unit_name: str) -> Any:
    end = scenario.time.duration
    if key in BEGIN:
        return BEGIN[key]
    if key == "reference.direction":
        normal = unit(scenario.surface.normal, "surface.normal")
        return [float(x) for x in contact_frame(normal)[2].round(9)]
    by_name = {
        "reference.stop": 0.8 * end, "reference.times": [0.1 * end, 0.8 * end],
        "reference.points": [[0.0, 0.0, 0.0], [0.0, 0.0, 0.0]],
        "force_profile.to": 1.5 * scenario.law.force, "force_profile.at": 0.5 * end,
        "force_profile.times": [0.25 * end, 0.75 * end],
        "force_profile.forces": [scenario.law.force, 1.5 * scenario.law.force],
    }  # fmt: skip
    return by_name.get(key, USUAL.get(unit_name, 1.0))
