"""From the sections of a law and its compensation to the numbers that the kernels read."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from closedloop.control import parameters as places
from closedloop.control.sections import (
    AdaptiveCompensationSection,
    AdmittanceLawSection,
    Approach,
    CompensationSection,
    ForceLawSection,
    HybridLawSection,
    ImpedanceLawSection,
    ModelCompensationSection,
    NoCompensationSection,
    ObserverCompensationSection,
    PaperLawSection,
    Posture,
    TipMotion,
)
from closedloop.errors import ScenarioError

Array = NDArray[np.float64]


class PackedLaw(NamedTuple):
    """A law and its compensation as `closedloop.control.laws.law_torque` reads them.

    Attributes
    ----------
    kind : int
        See `closedloop.control.parameters.LAWS`.
    par : (PARAMETERS + 2 n,) array
        See `closedloop.control.parameters`.
    gains : (2, n) array
        Per joint: K_p, N m/rad, and K_d, N m s/rad, of `paper` and `hybrid`; of the others those of the posture, 1/s²
        and 1/s.
    states : int
        How many states the law and its compensation have.
    """

    kind: int
    par: Array
    gains: Array
    states: int


def pack_law(
    law: ForceLawSection | PaperLawSection,
    compensation: CompensationSection | None = None,
    n: int = 0,
    *,
    pd_start: float = 0.0,
    joint_names: Sequence[str] = (),
) -> PackedLaw:
    """Turn a law and its compensation into numbers for n joints.

    Parameters
    ----------
    law, compensation : sections
        None: no compensation.
    n : int
        Number of joints.
    pd_start : float
        Instant from which the PD part of the paper's law acts, s.
    joint_names : sequence of str
        For messages.

    Raises
    ------
    ScenarioError
        If a list has not one entry a joint, or an adaptation cannot settle with the law's gains.
    """
    kind = places.LAWS[law.kind]
    par = np.zeros(places.PARAMETERS + 2 * n)
    par[places.PD_START] = pd_start
    par[places.K_F] = getattr(law, "force_feedback", 0.0)
    par[places.K_I] = getattr(law, "force_integral", 0.0)
    if isinstance(law, TipMotion):
        par[places.K_P], par[places.K_V] = law.motion_stiffness, law.motion_damping
    if isinstance(law, Approach):
        par[places.APPROACH] = law.approach_speed
    if isinstance(law, HybridLawSection):
        par[places.K_V] = law.approach_damping
    if isinstance(law, ImpedanceLawSection):
        par[places.DAMPING], par[places.STIFFNESS] = law.damping, law.stiffness
        par[places.NORMAL_DAMPING], par[places.NORMAL_STIFFNESS] = law.normal_damping, law.normal_stiffness
    if isinstance(law, AdmittanceLawSection):
        par[places.INERTIA] = law.admittance_inertia
        par[places.DAMPING], par[places.STIFFNESS] = law.admittance_damping, law.admittance_stiffness
    names = ("posture_stiffness", "posture_damping") if isinstance(law, Posture) else ("kp", "kd")
    gains = np.array([per_joint(f"law.{name}", getattr(law, name), n, joint_names) for name in names])
    _pack_compensation(par, law, compensation or NoCompensationSection(), n, joint_names)
    return PackedLaw(kind, par, gains, places.states(kind, par, n))


def _pack_compensation(
    par: Array,
    law: ForceLawSection | PaperLawSection,
    section: CompensationSection,
    n: int,
    joint_names: Sequence[str],
) -> None:
    par[places.COMPENSATION] = places.COMPENSATIONS[section.kind]
    if isinstance(section, ModelCompensationSection):
        par[places.KINETIC], par[places.VISCOUS] = section.kinetic, section.viscous
        par[places.STATIC] = section.kinetic if section.static is None else section.static
        par[places.STRIBECK_SPEED], par[places.SMOOTHING] = section.stribeck_speed, section.smoothing_speed
        par[places.JOINT_SMOOTHING] = section.joint_smoothing_speed
        coulomb = per_joint("compensation.joint_coulomb", section.joint_coulomb, n, joint_names)
        viscous = per_joint("compensation.joint_viscous", section.joint_viscous, n, joint_names)
        par[places.PARAMETERS :] = np.concatenate([coulomb, viscous])
    elif isinstance(section, ObserverCompensationSection):
        par[places.RATE] = section.rate
    elif isinstance(section, AdaptiveCompensationSection):
        if isinstance(law, TipMotion) and section.corner >= law.motion_damping:
            raise ScenarioError(
                f"compensation.corner = {section.corner:g}: must be below law.motion_damping, {law.motion_damping:g}, "
                "for the adaptation to settle"
            )
        par[places.ADAPTATION], par[places.CORNER] = section.gain, section.corner
        par[places.SPEED_SCALE], par[places.SMOOTHING] = section.speed_scale, section.smoothing_speed


def per_joint(key: str, value: float | tuple[float, ...], n: int, joint_names: Sequence[str] = ()) -> Array:
    """Return one number a joint (n,); `key` names it in messages.

    Raises
    ------
    ScenarioError
        If a list has another length.
    """
    if isinstance(value, float):
        return np.full(n, value)
    if len(value) != n:
        names = f", {', '.join(joint_names)}" if joint_names else ""
        raise ScenarioError(f"{key} has {len(value)} entries: the robot has {n} joints{names}")
    return np.array(value)
