"""What [law], [compensation] and [sensor] of a scenario may say; one section for each law.

Gains of the tip's motion are accelerations per error, 1/s² and 1/s, so the same figures serve any arm: K_p = ω², K_v =
2 ζ ω gives the tip the natural frequency ω and the damping ratio ζ.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, Field, field_validator
from pydantic_core.core_schema import ValidationInfo

from closedloop.sections import (
    ACCELERATION_GAIN,
    COEFFICIENT,
    FORCE,
    INERTIA,
    PERIOD,
    RATE,
    SPEED,
    SPEED_SCALE,
    TORQUE,
    Gain,
    NotNegative,
    Number,
    Positive,
    Section,
    Size,
    gain_in,
    viscous_in,
)


def _gains_not_negative(value: float | tuple[float, ...]) -> float | tuple[float, ...]:
    for index, entry in enumerate(value if isinstance(value, tuple) else (value,)):
        if entry < 0.0:
            raise ValueError(
                f"entry {index} is {entry:g}: must not be negative"
                if isinstance(value, tuple)
                else "must not be negative"
            )
    return value


def _seed(value: Any) -> Any:
    if isinstance(value, bool) or not isinstance(value, int) or value < 0:
        raise ValueError("must be a whole number, 0 or above")
    return value


GainNotNegative = Annotated[Gain, AfterValidator(_gains_not_negative)]
Seed = Annotated[int, BeforeValidator(_seed)]
QUANTUM = Size(1e9, "N", "no sensor is so coarse", 1e-12, "no sensor is so fine")


class ForceLaw(Section):
    """What all laws share: the force, and how the force sensor is used."""

    force: Annotated[Number, FORCE] = Field(
        10.0,
        description="force f_des with which the tip presses on the surface, N; 0: it rests there without pressing; "
        "below 0: it pulls where surface.contact is bilateral, and leaves where it is unilateral",
    )
    sample_period: Annotated[NotNegative, PERIOD] = Field(
        0.0,
        description="period at which the law is evaluated and then held, s; 0: at every evaluation of Eq. 24",
    )
    force_feedback: Annotated[NotNegative, gain_in("")] = Field(
        0.0,
        description="K_f, newtons of command per newton of error in the latest reading; below 1 for a fast sensor",
    )
    force_integral: Annotated[NotNegative, RATE] = Field(
        0.0, description="K_I, 1/s: a force error settles like exp(-K_I t), to 2 % in 3.9/K_I"
    )


class Approach(ForceLaw):
    """Of a law that seeks the surface at a set speed."""

    approach_speed: Annotated[Positive, SPEED] = Field(
        0.05,
        description="largest speed along the normal off the surface, m/s: at it a tip comes down to press (force > 0); "
        "with force = 0 it follows the path, with force < 0 it leaves and stays away",
    )


class Posture(Section):
    """Of a law for the tip: what joints do that the tip leaves free (redundant arms)."""

    posture_stiffness: Annotated[GainNotNegative, ACCELERATION_GAIN] = Field(
        25.0, description="pull of free joint motion to the reference's, 1/s², one per joint or one for all"
    )
    posture_damping: Annotated[GainNotNegative, RATE] = Field(
        10.0, description="damping of free joint motion, 1/s, one per joint or one for all"
    )


class TipMotion(Posture):
    """Of a law that makes the tip's motion linear: ë + K_v ė + K_p e = 0."""

    motion_stiffness: Annotated[NotNegative, ACCELERATION_GAIN] = Field(
        400.0, description="K_p of the tip's motion along the surface, 1/s²"
    )
    motion_damping: Annotated[Positive, RATE] = Field(
        40.0, description="K_v of the tip's motion along the surface, 1/s"
    )


class HybridLawSection(Approach):
    """[law] kind = "hybrid": position and force in their own directions, gains on the joints (Raibert, Craig 1981)."""

    kind: Literal["hybrid"] = "hybrid"
    kp: Annotated[GainNotNegative, gain_in("N m/rad")] = Field(
        description="position gain K_p, N m/rad, one per joint or one for all"
    )
    kd: Annotated[GainNotNegative, gain_in("N m s/rad")] = Field(
        description="velocity gain K_d, N m s/rad, one per joint or one for all"
    )
    approach_damping: Annotated[Positive, RATE] = Field(40.0, description="how firmly the approach speed is held, 1/s")


class OperationalSpaceLawSection(Approach, TipMotion):
    """[law] kind = "operational_space": the tip's own dynamics made linear (Khatib 1987)."""

    kind: Literal["operational_space"] = "operational_space"


class DynamicHybridLawSection(Approach, TipMotion):
    """[law] kind = "dynamic_hybrid": resolved joint acceleration (Yoshikawa 1987)."""

    kind: Literal["dynamic_hybrid"] = "dynamic_hybrid"


class ImpedanceLawSection(ForceLaw, Posture):
    """[law] kind = "impedance": a spring and a damper at the tip, and a wished force (Hogan 1985)."""

    kind: Literal["impedance"] = "impedance"
    stiffness: Annotated[NotNegative, gain_in("N/m")] = Field(1200.0, description="spring K along the surface, N/m")
    damping: Annotated[NotNegative, gain_in("N s/m")] = Field(120.0, description="damper B along the surface, N s/m")
    normal_stiffness: Annotated[NotNegative, gain_in("N/m")] = Field(
        0.0, description="spring K_n along the normal, N/m"
    )
    normal_damping: Annotated[NotNegative, gain_in("N s/m")] = Field(
        200.0, description="damper B_n along the normal, N s/m; off the surface the tip comes down at force/B_n"
    )


class AdmittanceLawSection(ForceLaw, TipMotion):
    """[law] kind = "admittance": the force error moves a set point along the normal (Whitney 1977, Seraji 1994)."""

    kind: Literal["admittance"] = "admittance"
    admittance_inertia: Annotated[Positive, INERTIA] = Field(2.0, description="mass M of the set point, kg")
    admittance_damping: Annotated[NotNegative, gain_in("N s/m")] = Field(
        200.0, description="damper B of the set point, N s/m; off the surface the tip comes down at force/B"
    )
    admittance_stiffness: Annotated[NotNegative, gain_in("N/m")] = Field(
        0.0, description="spring K of the set point, N/m; above 0 some force error stays"
    )


ForceLawSection = (
    HybridLawSection | OperationalSpaceLawSection | DynamicHybridLawSection | ImpedanceLawSection | AdmittanceLawSection
)


class NoCompensationSection(Section):
    """[compensation] kind = "none": friction is not compensated."""

    kind: Literal["none"] = "none"


class ModelCompensationSection(Section):
    """[compensation] kind = "model": friction as it is believed to be, fed forward along the wanted motion."""

    kind: Literal["model"] = "model"
    kinetic: Annotated[NotNegative, COEFFICIENT] = Field(
        0.0, description="believed kinetic coefficient of the surface's friction, 1"
    )
    static: Annotated[NotNegative, COEFFICIENT] | None = Field(
        None, description="believed static coefficient, 1; the kinetic one if left out"
    )
    stribeck_speed: Annotated[Positive, SPEED_SCALE] = Field(
        0.01, description="believed slip speed of the fall from static to kinetic, m/s (Gaussian)"
    )
    viscous: Annotated[NotNegative, viscous_in("N s/m")] = Field(
        0.0, description="believed viscous coefficient of the surface's friction, N s/m"
    )
    smoothing_speed: Annotated[Positive, SPEED_SCALE] = Field(
        0.001, description="wanted speed below which the feed-forward fades, m/s"
    )
    joint_coulomb: Annotated[GainNotNegative, TORQUE] = Field(
        0.0, description="believed Coulomb torque, N m, one per joint or one for all"
    )
    joint_viscous: Annotated[GainNotNegative, viscous_in("N m s/rad")] = Field(
        0.0, description="believed viscous coefficient, N m s/rad, one per joint or one for all"
    )
    joint_smoothing_speed: Annotated[Positive, SPEED_SCALE] = Field(
        0.001, description="wanted joint speed below which its feed-forward fades, rad/s (m/s)"
    )

    @field_validator("static")
    @classmethod
    def _static_is_the_larger(cls, value: float | None, info: ValidationInfo) -> float | None:
        if value is not None and value < info.data.get("kinetic", 0.0):
            raise ValueError(f"must not be below kinetic, {info.data['kinetic']:g}: static friction is the larger")
        return value


class ObserverCompensationSection(Section):
    """[compensation] kind = "observer": friction in joints and at the tip estimated from the joints' motion."""

    kind: Literal["observer"] = "observer"
    rate: Annotated[Positive, RATE] = Field(
        100.0, description="K_o, 1/s: the estimate follows what disturbs the arm within 1/K_o"
    )


class AdaptiveCompensationSection(Section):
    """[compensation] kind = "adaptive": the surface's Coulomb and viscous coefficients learned while sliding."""

    kind: Literal["adaptive"] = "adaptive"
    gain: Annotated[Positive, gain_in("1/m")] = Field(
        100.0, description="γ, 1/m: growth of the Coulomb coefficient per metre of path error"
    )
    corner: Annotated[Positive, RATE] = Field(
        20.0, description="c, 1/s: weight of the path error beside its rate; below motion_damping"
    )
    speed_scale: Annotated[Positive, SPEED_SCALE] = Field(
        0.02, description="v_0, m/s: the speed at which both coefficients learn alike"
    )
    smoothing_speed: Annotated[Positive, SPEED_SCALE] = Field(
        0.001, description="wanted speed below which nothing is learned, m/s"
    )


CompensationSection = (
    NoCompensationSection | ModelCompensationSection | ObserverCompensationSection | AdaptiveCompensationSection
)


class SensorSection(Section):
    """[sensor]: the force sensor; as it stands, ideal: the force at the latest sample."""

    noise: Annotated[NotNegative, FORCE] = Field(0.0, description="standard deviation of white noise, N")
    bias: Annotated[Number, FORCE] = Field(0.0, description="constant error, N")
    quantisation: Annotated[NotNegative, QUANTUM] = Field(0.0, description="step between two readings, N; 0: none")
    filter_time_constant: Annotated[NotNegative, PERIOD] = Field(
        0.0, description="time constant of a first-order low-pass, s; 0: none"
    )
    delay: Annotated[NotNegative, PERIOD] = Field(
        0.0, description="age of a reading beside the sample's, s; a whole number of samples"
    )
    seed: Seed = Field(0, description="seed of the noise")


class PaperLawSection(ForceLaw):
    """[law] kind = "paper": Eq. 33; with force feedback, f_des in it becomes f_c of `closedloop.control.force`."""

    kind: Literal["paper"] = "paper"
    kp: Annotated[Gain, gain_in("N m/rad")] = Field(
        description="position gain K_p, N m/rad, one per joint or one for all"
    )
    kd: Annotated[Gain, gain_in("N m s/rad")] = Field(
        description="velocity gain K_d, N m s/rad, one per joint or one for all"
    )
    pd_start: NotNegative | None = Field(
        None,
        description="instant from which the PD part acts, s; that at which the reference starts to move if left out",
    )
