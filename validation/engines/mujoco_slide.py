"""MuJoCo driven step by step with the law of the paper, at decreasing softness."""

import time as clock
from typing import Any

import numpy as np

from closedloop import Problem
from validation.engines.mujoco import TIP, build_spec, columns, compile_spec, solve_to_rounding, tip_drift, tip_jacobian
from validation.engines.trajectories import Trajectory, law

RADIUS, MARGIN = 1e-3, 1e-3

IMPEDANCES = (0.9999, 0.9998, 0.9996)
"""Softnesses R in the ratio 1 : 2 : 4, the first the least that MuJoCo takes."""


def slide_mujoco(of: Problem, impedance: float, *, contact: bool = True) -> Trajectory:
    """Slide a sphere around the tip along a frictionless plane of MuJoCo's.

    A contact of dimension one between a sphere and a plane is one row: along the normal through the sphere's
    centre all points of the body move alike, so the row is nᵀJᵣ whatever the radius. It can only push, so it is a
    point on a plane as long as f > 0. The plane stands back by the radius and by a margin within which the row is
    made, so that e = 0 is its zero; a_ref is set to b_s of Eq. 23, with J̇ᵣq̇, which MuJoCo's own a_ref leaves
    out. H, C, Jᵣ, J̇ᵣ, the solve A q̈ + R f = a_ref, and the step (semi-implicit Euler, no damping) are MuJoCo's.

    impedance: d of `solimp`, the same at any depth: R = (1 − d)/d times MuJoCo's estimate of AH⁻¹Aᵀ
    contact: False leaves the plane out, for the proof that it acts
    """
    if not of.integrator.semi_implicit:
        raise ValueError("MuJoCo's Euler is the semi-implicit one")
    import mujoco

    n_, d_ = of.plane.normal, of.plane.offset
    spec = build_spec(of.robot.model, of.robot.tip)
    solve_to_rounding(spec)
    spec.option.timestep = of.h
    site = spec.site(TIP)
    ball = site.parent.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[RADIUS, 0, 0], pos=site.pos, mass=0.0)
    plane = spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_PLANE, size=[5, 5, 1], zaxis=n_, pos=n_ * (d_ - RADIUS - MARGIN)
    )
    for geom in spec.geoms:
        geom.contype = geom.conaffinity = 0
    for geom, mine, others in ((ball, 1, 2), (plane, 2, 1)):
        geom.condim, geom.margin = 1, MARGIN
        geom.solimp = [impedance, impedance, 1e-3, 0.5, 2.0]
        geom.contype, geom.conaffinity = (mine, others) if contact else (0, 0)
    model = compile_spec(spec)
    return _run(of, model, float(contact))


def _run(of: Problem, model: Any, rows_wanted: float) -> Trajectory:
    import mujoco

    data = mujoco.MjData(model)
    order, site, normal = columns(model, of.robot.model), model.site(TIP).id, of.plane.normal
    data.qpos[order], data.qvel[order] = of.q, of.v
    count, n = of.steps + 1, len(of.q)
    q, v, f, e = np.empty((count, n)), np.empty((count, n)), np.zeros(count), np.empty(count)
    softness = 0.0
    began = clock.perf_counter()
    for k in range(count):
        mujoco.mj_step1(model, data)
        q[k], v[k] = data.qpos[order], data.qvel[order]
        row = normal @ tip_jacobian(model, data, site)
        e[k] = normal @ data.site_xpos[site] - of.plane.offset
        if data.nefc != rows_wanted:
            raise RuntimeError(f"MuJoCo has {data.nefc} constraint rows at t = {k * of.h:g} s: the tip left the plane")
        if data.nefc:
            s_v, s_p = of.stabiliser
            data.efc_aref[0] = -normal @ tip_drift(model, data, site) - s_v * (row @ data.qvel) - s_p * e[k]
        data.qfrc_applied[order] = law(of, k, q[k], v[k], data.qfrc_bias[order], row[order])
        mujoco.mj_step2(model, data)
        if data.nefc:
            f[k], softness = data.efc_force[0], float(data.efc_R[0])
    seconds = clock.perf_counter() - began
    return Trajectory("mujoco", np.arange(count) * of.h, q, v, f, e, of.h, softness, seconds)
