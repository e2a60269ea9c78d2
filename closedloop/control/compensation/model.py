"""Friction fed forward from a model of it.

Surface, against F_t:  F̂_t = −[f_des (μ_k + (μ_s − μ_k) exp(−(|u|/v_s)²)) + b |u|] û
Joints:                τ̂_j = c_j v̂_j + b_j v_j

u and v are the wanted velocities, which carry no noise and do not chatter about zero; the unit vectors are smoothed,
û = u/√(|u|² + ε²), so that the torque does not jump where the motion begins.

Source: the Stribeck curve in the form of Armstrong-Hélouvry, Dupont and Canudas de Wit, Automatica 30(7), 1994.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from closedloop.control.law_input import Moment
from closedloop.control.parameters import (
    JOINT_SMOOTHING,
    KINETIC,
    PARAMETERS,
    SMOOTHING,
    STATIC,
    STRIBECK_SPEED,
    VISCOUS,
)
from closedloop.jit.kernel import kernel

Array = NDArray[np.float64]


@kernel
def wanted_direction(x: Moment, smoothing: float) -> tuple[float, float, float]:
    """Return the two components of û, without unit, and |u|, m/s, of the wanted motion along the surface."""
    speed = math.hypot(x.u_des[1], x.u_des[2])
    scale = math.hypot(speed, smoothing)
    if scale == 0.0:
        return 0.0, 0.0, 0.0
    return x.u_des[1] / scale, x.u_des[2] / scale, speed


@kernel
def add_model(x: Moment, par: Array, torque: Array) -> None:
    """Add the torque that overcomes friction as it is believed to be, N m."""
    n = torque.shape[0]
    if x.pressed != 0.0:
        d1, d2, speed = wanted_direction(x, par[SMOOTHING])
        mu = par[KINETIC]
        if par[STRIBECK_SPEED] > 0.0:
            ratio = speed / par[STRIBECK_SPEED]
            mu += (par[STATIC] - par[KINETIC]) * math.exp(-(ratio * ratio))
        size = x.f_des * mu + par[VISCOUS] * speed
        for j in range(n):
            torque[j] += size * (x.A[1, j] * d1 + x.A[2, j] * d2)
    for j in range(n):
        coulomb, viscous = par[PARAMETERS + j], par[PARAMETERS + n + j]
        if coulomb != 0.0:
            torque[j] += coulomb * x.v_des[j] / math.hypot(x.v_des[j], par[JOINT_SMOOTHING])
        torque[j] += viscous * x.v_des[j]
