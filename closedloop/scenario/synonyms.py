"""What others call the sections and the keys of a scenario: the one table from which a refusal says what was meant."""

from __future__ import annotations

import difflib
from collections.abc import Collection

# Words of textbooks, of other simulators and of code, in small letters; the names here, the likeliest first.
_KEYS: dict[str, tuple[str, ...]] = {
    "mu": ("coefficient", "friction", "kinetic"), "μ": ("coefficient", "friction", "kinetic"),
    "friction_coefficient": ("coefficient", "friction", "kinetic"), "coulomb": ("coefficient", "kinetic"),
    "mu_k": ("kinetic", "coefficient"), "mu_d": ("kinetic", "coefficient"), "mu_c": ("kinetic", "coefficient"),
    "dynamic": ("kinetic", "coefficient"), "mu_s": ("static",), "static_friction": ("static",),
    "vs": ("stribeck_speed",), "v_s": ("stribeck_speed",), "stribeck_velocity": ("stribeck_speed",),
    "sigma_0": ("stiffness",), "sigma0": ("stiffness",), "sigma_1": ("damping",), "sigma1": ("damping",),
    "sigma_2": ("viscous",), "sigma2": ("viscous",),
    "k": ("stiffness", "normal_stiffness", "motion_stiffness", "kp"), "spring": ("stiffness",),
    "stiffness": ("normal_stiffness", "motion_stiffness", "admittance_stiffness", "kp"),
    "c": ("damping", "viscous", "dissipation"), "b": ("damping", "viscous", "admittance_damping"),
    "d": ("damping", "motion_damping", "kd", "viscous"), "damper": ("damping",),
    "damping": ("motion_damping", "dissipation", "viscous", "kd"), "viscosity": ("viscous",),
    "p": ("kp", "motion_stiffness"), "p_gain": ("kp", "motion_stiffness", "stiffness"),
    "proportional": ("kp", "motion_stiffness", "stiffness"), "position_gain": ("kp", "motion_stiffness", "stiffness"),
    "kp": ("motion_stiffness", "stiffness"), "kv": ("kd", "motion_damping", "damping"),
    "kd": ("motion_damping", "damping"), "d_gain": ("kd", "motion_damping", "damping"),
    "derivative": ("kd", "motion_damping", "damping"), "velocity_gain": ("kd", "motion_damping", "damping"),
    "ki": ("force_integral",), "kfi": ("force_integral",), "integral": ("force_integral",),
    "i_gain": ("force_integral",), "kf": ("force_feedback",), "kfp": ("force_feedback",),
    "force_gain": ("force_feedback",), "fd": ("force",), "f_des": ("force",), "f_d": ("force",),
    "desired_force": ("force",), "force_setpoint": ("force",), "setpoint": ("force", "to"), "target": ("force", "to"),
    "admittance_mass": ("admittance_inertia",), "virtual_mass": ("admittance_inertia",), "m": ("mass", "masses"),
    "dt": ("step",), "h": ("step",), "timestep": ("step",), "time_step": ("step",), "step_size": ("step",),
    "stepsize": ("step",), "sample_time": ("sample_period", "step"), "ts": ("sample_period", "step"),
    "control_period": ("sample_period",), "sampling_time": ("sample_period", "step"),
    "t": ("duration",), "tend": ("duration", "stop"), "t_end": ("duration", "stop"), "tf": ("duration", "stop"),
    "t_final": ("duration", "stop"), "t_f": ("duration", "stop"), "end": ("stop", "duration"),
    "end_time": ("duration", "stop"), "stop_time": ("stop", "duration"), "length": ("duration",),
    "time": ("duration",), "simulation_time": ("duration",), "t0": ("start",), "start_time": ("start",),
    "scheme": ("integrator",), "solver": ("integrator",), "method": ("integrator",), "rtol": ("tolerance",),
    "atol": ("tolerance",), "tol": ("tolerance",), "reltol": ("tolerance",),
    "pose": ("q",), "posture": ("q",), "q0": ("q",), "configuration": ("q",), "joint_positions": ("q",),
    "position": ("q", "at", "offset"), "qd": ("v",), "v0": ("v",), "dq": ("v",), "qdot": ("v",),
    "velocity": ("v", "speed"),
    "e": ("restitution",), "epsilon": ("restitution",), "cor": ("restitution",), "bounce": ("restitution",),
    "n": ("normal", "exponent"), "r": ("radius",), "diameter": ("radius",), "origin": ("point", "offset", "centre"),
    "center": ("centre",), "com": ("centre",), "centre_of_mass": ("centre",), "height": ("offset",),
    "amp": ("amplitude",), "freq": ("frequency",), "omega": ("frequency", "speed"), "hz": ("frequency",),
    "zeta": ("damping_ratio",), "ζ": ("damping_ratio",), "alpha": ("damping_ratio",), "tau": ("time_constant",),
    "std": ("noise",), "sigma": ("noise",), "stddev": ("noise",), "resolution": ("quantisation",),
    "quantization": ("quantisation",), "latency": ("delay",), "offset": ("bias",), "cutoff": ("filter_time_constant",),
    "lowpass": ("filter_time_constant",), "filter": ("filter_time_constant",), "max_torque": ("torque_limit",),
    "torque_max": ("torque_limit",), "effort": ("torque_limit",), "saturation": ("torque_limit",),
    "inertia": ("motor_inertia", "drive_inertia", "admittance_inertia"), "armature": ("drive_inertia", "motor_inertia"),
    "g": ("gravity",), "urdf": ("model",), "mjcf": ("model",), "file": ("model",), "name": ("model", "kind"),
    "end_effector": ("tip",), "ee": ("tip",), "tcp": ("tip", "offset"), "frame": ("tip", "link"), "type": ("kind",),
    "body": ("link",), "parent": ("against",), "unilateral": ("contact",), "bilateral": ("contact",),
}  # fmt: skip
_SECTIONS: dict[str, str] = {
    "controller": "law", "control": "law", "gains": "law", "arm": "robot", "manipulator": "robot", "model": "robot",
    "plane": "surface", "wall": "surface", "table": "surface", "environment": "surface", "ground": "surface",
    "contacts": "contact", "contact_model": "compliance", "soft": "compliance", "stiffness": "compliance",
    "trajectory": "reference", "path": "reference", "motion": "reference", "initial": "start", "init": "start",
    "state": "start", "simulation": "time", "sim": "time", "solver": "time", "integration": "time", "options": "time",
    "baumgarte": "stabiliser", "stabilizer": "stabiliser", "stabilisation": "stabiliser", "stabilization": "stabiliser",
    "ft": "sensor", "force_sensor": "sensor", "encoders": "encoder", "elastic": "transmission",
    "joints": "transmission",
    "actuator": "drives", "actuators": "drives", "motors": "drives", "limits": "drives", "restitution": "impact",
    "bounce": "impact", "force": "force_profile", "friction_compensation": "compensation", "end_effector": "tool",
    "payload": "model_error", "uncertainty": "model_error",
}  # fmt: skip
ALIKE = 0.5  # of difflib's ratio, from which on a word is taken for a misspelt one


def called(word: str) -> tuple[str, ...]:
    """Return the keys that others call so, the likeliest first."""
    return _KEYS.get(_plain(word), ())


def key_meant(word: str, known: Collection[str]) -> str | None:
    """Return which of the known keys is most likely meant by a word, None if none is."""
    alike = [name for name in known if name.lower() == _plain(word)]
    meant = [name for name in called(word) if name in known]
    near = difflib.get_close_matches(word, known, n=1, cutoff=ALIKE)
    return next(iter([*alike, *meant, *near]), None)


def section_meant(word: str, known: Collection[str]) -> str | None:
    """Return which of the known sections is most likely meant by a word, None if none is."""
    other = _SECTIONS.get(_plain(word))
    if other in known:
        return other
    return next(iter(difflib.get_close_matches(word, known, n=1, cutoff=ALIKE)), None)


def is_called(word: str, section: str) -> bool:
    """Whether others call a section so; else the word is a misspelt one."""
    return _SECTIONS.get(_plain(word)) == section


def _plain(word: str) -> str:
    return word.lower().replace("-", "_").replace(" ", "_")
