"""Drake as its discrete scheme allows: the tip as a small sphere in frictionless, nearly rigid contact."""

import logging
import time as clock
from dataclasses import replace
from typing import Any

import numpy as np

from closedloop import Problem
from validation.engines.drake import build_plant, parts_of
from validation.engines.trajectories import Trajectory, law
from validation.oracle.spatial import Array

RADIUS = 1e-2
STIFFNESS = 1e4
"""S of k = S/h² [kg]: over one step the contact's compliance is 1/S [1/kg], and the penetration f/k vanishes with h².
Ten times as much, and the penetration, 1e-10 m at 1 ms, drowns in rounding: the contact flickers."""


def slide_drake(of: Problem, *, stiffness: float = STIFFNESS, contact: bool = True) -> Trajectory:
    """Slide a sphere around the tip along a half-space, with Drake's SAP contact and no friction.

    Drake has no point-on-plane constraint, but a frictionless sphere on a half-space is one as long as it is pressed:
    its normal row is nᵀJᵣ whatever the radius. A step is v⁺ = v + H⁻¹ (h (Q − C) + Aᵀ γ) with an impulse
    γ = h k (penetration at the step's end), f = γ/h: semi-implicit Euler with A v⁺ + γ/S = −e/h where k = S/h², so
    the closure is held at the level of velocities, an error e is undone in one step, and there is no Baumgarte
    stabiliser to be had. The half-space is raised by the penetration under the wanted force, so that the run starts
    in equilibrium. As 1/S → 0 and h → 0 this is the motion of the hard constraint.

    Traps. Geometries that touch without overlapping are not in contact. Outputs are sampled, that is, of the step
    before, unless told otherwise. The "near rigid" regularisation overrules k unless it is set to zero.

    stiffness: S [kg]
    contact: False leaves the half-space out, for the proof that it acts
    """
    from pydrake.geometry import SceneGraph
    from pydrake.multibody.plant import DiscreteContactApproximation
    from pydrake.systems.framework import DiagramBuilder

    # For good, as Drake hands its messages to Python some time after they arise.
    logging.getLogger("drake").addFilter(_not_about_deformables)
    builder: Any = DiagramBuilder()
    scene: Any = builder.AddSystem(SceneGraph())
    plant: Any = builder.AddSystem(build_plant(of.robot.model, of.h, scene))
    plant.set_discrete_contact_approximation(DiscreteContactApproximation.kSap)
    plant.SetUseSampledOutputPorts(False)  # the contact force of this state, not of the step before
    plant.set_sap_near_rigid_threshold(0.0)  # else β decides the compliance, not k
    if contact:
        _add_contact(plant, of, stiffness / of.h**2)
    plant.Finalize()
    builder.Connect(plant.get_geometry_pose_output_port(), scene.get_source_pose_port(plant.get_source_id()))
    builder.Connect(scene.get_query_output_port(), plant.get_geometry_query_input_port())
    return replace(_run(of, plant, builder.Build()), softness=1.0 / stiffness)


def _not_about_deformables(record: logging.LogRecord) -> bool:
    """Drop Drake's warning that a half-space bears no deformable bodies, of which there are none here."""
    return "deformable" not in record.getMessage()


def _add_contact(plant: Any, of: Problem, stiffness: float) -> None:
    from pydrake.geometry import HalfSpace, ProximityProperties, Sphere
    from pydrake.math import RigidTransform
    from pydrake.multibody.plant import CoulombFriction

    properties: Any = ProximityProperties()
    for name, value in (("point_contact_stiffness", stiffness), ("relaxation_time", 0.0)):
        properties.AddProperty("material", name, value)
    properties.AddProperty("material", "coulomb_friction", CoulombFriction(0.0, 0.0))
    normal: Any = of.plane.normal
    ground = HalfSpace.MakePose(normal, normal * (of.plane.offset + of.settings[0] / stiffness - RADIUS))
    plant.RegisterCollisionGeometry(plant.world_body(), ground, HalfSpace(), "surface", properties)
    tip = plant.GetBodyByName(of.robot.tip)
    plant.RegisterCollisionGeometry(tip, RigidTransform(), Sphere(RADIUS), "tip", properties)


def _run(of: Problem, plant: Any, diagram: Any) -> Trajectory:
    from pydrake.multibody.tree import JacobianWrtVariable
    from pydrake.systems.analysis import Simulator

    simulator = Simulator(diagram)
    context = plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    order, n, normal = [part.velocity for part in parts_of(plant, of.robot.model)], len(of.q), of.plane.normal
    tip, world, origin = plant.GetFrameByName(of.robot.tip), plant.world_frame(), np.zeros(3)
    both = np.zeros((2, n))
    both[:, order] = of.q, of.v
    plant.SetPositionsAndVelocities(context, both.ravel())
    results = plant.get_contact_results_output_port()
    count = of.steps + 1
    q, v, f, e = np.empty((count, n)), np.empty((count, n)), np.zeros(count), np.empty(count)
    began = clock.perf_counter()
    for k in range(count):
        both = plant.GetPositionsAndVelocities(context).reshape(2, n)
        q[k], v[k] = both[:, order]
        J = plant.CalcJacobianTranslationalVelocity(context, JacobianWrtVariable.kV, tip, origin, world, world)
        bias = plant.CalcBiasTerm(context) - plant.CalcGravityGeneralizedForces(context)
        e[k] = normal @ tip.CalcPoseInWorld(context).translation() - of.plane.offset
        torque = np.zeros(n)
        torque[order] = law(of, k, q[k], v[k], bias[order], (normal @ J)[order])
        plant.get_applied_generalized_force_input_port().FixValue(context, torque)
        f[k] = _force(results.Eval(context), normal)
        simulator.AdvanceTo((k + 1) * of.h)
    seconds = clock.perf_counter() - began
    return Trajectory("drake", np.arange(count) * of.h, q, v, f, e, of.h, 0.0, seconds)


def _force(results: Any, normal: Array) -> float:
    """Return the force of the surface on the tip along n [N], 0 where nothing touches."""
    total = 0.0
    for i in range(results.num_point_pair_contacts()):
        info = results.point_pair_contact_info(i)
        total += abs(float(normal @ info.contact_force()))
    return total
