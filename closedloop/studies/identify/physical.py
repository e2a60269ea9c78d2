"""Inertial parameters that a body can have, nearest to the base parameters that were identified.

Base parameters are combinations; many full sets of parameters give the same, and with noise none of them may be of a
real body. Each link's ten parameters are written by its pseudo-inertia, J = [Σ h; hᵀ m] with Σ = tr(I)/2 − I, which is
positive definite exactly if there is a mass distribution with them, as a product of triangular matrices with
exponentials on their diagonal (log-Cholesky): there every ten numbers are a body. The numbers minimise

    (G χ − χ̂)ᵀ C⁻¹ (G χ − χ̂) + ε |z − z₀|²

with the covariance C of the estimates χ̂, so that well-known combinations stay where they are, and a small pull to the
robot's file where nothing is known. Friction and drive inertia are kept at zero or above. Source: C. Rucker,
P. M. Wensing, Smooth parameterization of rigid-body inertia, IEEE Robotics and Automation Letters 7 (2022) 2771-2778.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy import linalg, optimize

from closedloop.base.arrays import Array
from closedloop.studies.identify.regressor import BOUNDED

if TYPE_CHECKING:
    from closedloop.studies.identify.identify import Identification

# ε: a change of the logarithms by one weighs as much as a tenth of a standard deviation of one estimate.
PULL = 0.01
# Of a link of the file without inertia: a gram, and a sphere of a centimetre.
LEAST = 1e-7
# Steps of the solver (each asks for a derivative by every number).
ROUNDS = 60


@dataclass(frozen=True, eq=False)
class Physical:
    """Parameters that a robot can have."""

    parameters: Array  # (p,): in the order of the regressor's names, all of them
    distance: float  # RMS distance of the base parameters from their estimates, in standard deviations
    relative_error: Array  # (n,): RMS error of the torque over its RMS, as `Identification.relative_error`


def pseudo_inertia(parameters: Array) -> Array:
    """Return J (4, 4) of ten parameters m, m c, Ixx, Ixy, Iyy, Ixz, Iyz, Izz."""
    m, hx, hy, hz, xx, xy, yy, xz, yz, zz = parameters
    inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    J = np.empty((4, 4))
    J[:3, :3] = 0.5 * np.trace(inertia) * np.eye(3) - inertia
    J[:3, 3] = J[3, :3] = hx, hy, hz
    J[3, 3] = m
    return J


def _of_pseudo_inertia(J: Array) -> Array:
    inertia = np.trace(J[:3, :3]) * np.eye(3) - J[:3, :3]
    return np.array([
        J[3, 3], *J[:3, 3], inertia[0, 0], inertia[0, 1], inertia[1, 1], inertia[0, 2], inertia[1, 2], inertia[2, 2],
    ])  # fmt: skip


def _body(z: Array) -> Array:
    """Return the ten parameters of ten logarithms and shears: J = U Uᵀ, U upper triangular."""
    alpha, d1, d2, d3, s12, s23, s13, t1, t2, t3 = z
    e1, e2, e3 = np.exp([d1, d2, d3])
    U = np.exp(alpha) * np.array([[e1, s12, s13, t1], [0.0, e2, s23, t2], [0.0, 0.0, e3, t3], [0.0, 0.0, 0.0, 1.0]])
    return _of_pseudo_inertia(U @ U.T)


def _logarithms(parameters: Array) -> Array:
    """Return z of ten parameters; of those that no body has, of the nearest that one has."""
    values, vectors = linalg.eigh(pseudo_inertia(parameters))
    J = (vectors * np.maximum(values, LEAST)) @ vectors.T
    flip = J[::-1, ::-1]
    U = linalg.cholesky(flip, lower=True)[::-1, ::-1]
    alpha = np.log(U[3, 3])
    U = U / U[3, 3]
    return np.array([alpha, *np.log(np.diag(U)[:3]), U[0, 1], U[1, 2], U[0, 2], U[0, 3], U[1, 3], U[2, 3]])


def physical(found: Identification) -> Physical:
    """Return the parameters of a robot that can be, nearest to what was identified."""
    names, n, base = found.regressor.names, found.robot.n, found.base
    solution, links = found.solution, 10 * found.robot.n
    told = solution.told
    grouping, value = base.grouping[told], solution.value[told]
    deviation = solution.deviation[told]
    scaled = solution.covariance[np.ix_(told, told)] / deviation / deviation[:, None]
    root = linalg.solve_triangular(linalg.cholesky(scaled, lower=True), np.diag(1.0 / deviation), lower=True)
    inertias = list(found.robot.pinocchio_model().inertias)[1:]
    start = np.concatenate([_logarithms(np.asarray(each.toDynamicParameters())) for each in inertias])
    rest = np.zeros(len(names) - links)
    armature = dict(
        zip((f"drive_inertia_{joint}" for joint in found.robot.joint_names), found.robot.armature, strict=True)
    )
    known = {names[base.kept[k]]: solution.value[k] for k in np.flatnonzero(told)}
    floor = np.full(len(rest), -np.inf)
    for k, name in enumerate(names[links:]):
        rest[k] = known.get(name, armature.get(name, 0.0))
        if name.startswith(BOUNDED):
            floor[k], rest[k] = 0.0, max(rest[k], 0.0)
    size = np.maximum(np.abs(rest), 1e-3)
    held = np.isfinite(floor)  # what cannot be negative is a square
    x0 = np.concatenate([start, np.where(held, np.sqrt(rest * held / size), rest / size)])

    def parameters(x: Array) -> Array:
        others = x[links:]
        return np.concatenate(
            [*(_body(z) for z in x[:links].reshape(n, 10)), np.where(held, others * others, others) * size]
        )

    def residual(x: Array) -> Array:
        return np.concatenate([root @ (grouping @ parameters(x) - value), np.sqrt(PULL) * (x - x0)])

    with np.errstate(over="ignore", invalid="ignore"):  # a step that is far too long is taken back
        best = optimize.least_squares(residual, x0, method="lm", xtol=1e-6, ftol=1e-6, gtol=1e-6, max_nfev=ROUNDS)
    chi = parameters(best.x)
    distance = float(np.sqrt(np.mean((root @ (grouping @ chi - value)) ** 2)))
    change = base.grouping @ chi - solution.value
    W = found.regressor.averaged(found.motion)[:, :, base.kept]
    left = (solution.residual - W @ np.where(told, change, 0.0)) * found.used
    torque = found.measured * found.used
    error = np.sqrt((left**2).sum(axis=0) / np.maximum((torque**2).sum(axis=0), 1e-300))
    return Physical(chi, distance, error)
