# ruff: noqa: D102 - what a method returns is said once, in `interface.Engine`
"""Drake: MultibodyPlant in continuous time, for everything but the closed loop."""

from __future__ import annotations

from types import MappingProxyType
from typing import Any

import numpy as np

from validation.engines.description import bare_urdf, root_link
from validation.engines.interface import METHODS, CannotBuild, Engine, Robot, columns_of
from validation.oracle.spatial import Array


class Drake(Engine):
    """Drake's MultibodyPlant, continuous, so that no time step enters any number.

    Joint order: depth first as Drake numbers its mobilizers; mapped by name through `velocity_start`. Frames: world
    axes; Jacobians with respect to v. Armature: the reflected inertia of a `JointActuator` with gear ratio 1 and the
    armature as rotor inertia, which Drake adds to H; the actuators are never driven. Gravity: the vector of the
    plant's gravity field; `CalcBiasTerm` leaves it out and `CalcGravityGeneralizedForces` has the opposite sign, so
    C = bias term − gravity forces. Torques enter at the port for applied generalized forces. Locked joints are
    removed and their frames welded. A root link called "world" *is* Drake's world and is not welded to it.

    Free acceleration is `EvalTimeDerivatives`: the articulated body algorithm, which never forms H.

    Constraints act on discrete plants only (on a continuous one they are ignored without a word), none of them
    holds a point on a plane, and at one instant a discrete plant has impulses over a step and no
    acceleration-level multiplier. What its discrete contact allows is in `drake_slide`.

    Accuracy: rounding, times the condition number of H in q̈. Inertias are kept as mass, centre and unit inertia,
    a division that costs one rounding.
    """

    name = "drake"
    package = "pydrake"
    install = 'pip install "drake>=1.50"'
    covers = frozenset(METHODS) - {"stabilised", "constrained", "impulse"}
    cannot = MappingProxyType(
        {
            "stabilised": "it has no Baumgarte stabiliser; discrete constraints are held by compliance and relaxation",
            "constrained": "no constraint of Drake holds a point on a plane, none acts on a continuous plant",
            "impulse": "a discrete plant has impulses over a time step, compliant ones, and no restitution",
        }
    )

    def __init__(self, robot: Robot, tip: str) -> None:
        super().__init__(robot, tip)
        from pydrake.multibody.tree import JacobianWrtVariable

        self.plant = build_plant(robot, 0.0)
        self.plant.Finalize()
        self.columns = columns(self.plant, robot)
        self.context = self.plant.CreateDefaultContext()
        if not self.plant.HasBodyNamed(tip):
            raise CannotBuild(f"Drake has no body {tip!r}")
        self.tip: Any = self.plant.GetFrameByName(tip)
        self.world: Any = self.plant.world_frame()
        self.wrt: Any = JacobianWrtVariable.kV

    def _set(self, q: Array, v: Array | None = None) -> None:
        if not (np.all(np.isfinite(q)) and (v is None or np.all(np.isfinite(v)))):
            raise ValueError("q and v must be finite")
        # One variable a joint, so positions and velocities have the same order.
        both = np.zeros((2, self.n))
        both[0, self.columns] = q
        both[1, self.columns] = 0.0 if v is None else v
        self.plant.SetPositionsAndVelocities(self.context, both.ravel())

    def mass_matrix(self, q: Array) -> Array:
        self._set(q)
        return np.array(self.plant.CalcMassMatrix(self.context)[np.ix_(self.columns, self.columns)])

    def bias(self, q: Array, v: Array) -> Array:
        self._set(q, v)
        gravity = self.plant.CalcGravityGeneralizedForces(self.context)
        return np.array((self.plant.CalcBiasTerm(self.context) - gravity)[self.columns])

    def gravity_term(self, q: Array) -> Array:
        self._set(q)
        return np.array(-self.plant.CalcGravityGeneralizedForces(self.context)[self.columns])

    def position(self, q: Array) -> Array:
        self._set(q)
        return np.array(self.tip.CalcPoseInWorld(self.context).translation())

    def jacobian(self, q: Array) -> Array:
        self._set(q)
        J = self.plant.CalcJacobianTranslationalVelocity(
            self.context, self.wrt, self.tip, np.zeros(3), self.world, self.world
        )
        return np.array(J[:, self.columns])

    def drift(self, q: Array, v: Array) -> Array:
        self._set(q, v)
        a = self.plant.CalcBiasTranslationalAcceleration(
            self.context, self.wrt, self.tip, np.zeros(3), self.world, self.world
        )
        return np.array(a).reshape(3)

    def free_acceleration(self, q: Array, v: Array, torque: Array) -> Array:
        self._set(q, v)
        applied = np.zeros(self.n)
        applied[self.columns] = torque
        self.plant.get_applied_generalized_force_input_port().FixValue(self.context, applied)
        derivatives = self.plant.EvalTimeDerivatives(self.context).CopyToVector()
        return np.array(derivatives[self.n :][self.columns])


def build_plant(robot: Robot, time_step: float, scene_graph: Any = None) -> Any:
    """Return the robot as a plant that is not finalized yet, on a fixed base, locked joints welded.

    Parameters
    ----------
    time_step : 0 is a continuous plant [s]
    scene_graph : where geometry is registered, for contact
    """
    from pydrake.multibody.parsing import Parser
    from pydrake.multibody.plant import MultibodyPlant

    if robot.format != "urdf":
        raise CannotBuild(f"Drake is given URDF only here, this robot is {robot.format!r}")
    text = bare_urdf(robot.text)
    plant: Any = MultibodyPlant(time_step)
    if scene_graph is not None:
        plant.RegisterAsSourceForSceneGraph(scene_graph)
    try:
        Parser(plant).AddModelsFromString(text, "urdf")
    except RuntimeError as error:
        raise CannotBuild(f"Drake refuses it: {str(error).splitlines()[0]}") from error
    root = plant.GetBodyByName(root_link(text))
    if root.index() != plant.world_body().index():
        plant.WeldFrames(plant.world_frame(), root.body_frame())
    for name, value in robot.locked.items():
        _weld(plant, plant.GetJointByName(name), value)
    for name, armature in zip(robot.joint_names, robot.armature, strict=True):
        if not plant.HasJointNamed(name):
            raise CannotBuild(f"Drake reads no joint {name!r}")
        actuator = plant.AddJointActuator(name, plant.GetJointByName(name))
        actuator.set_default_gear_ratio(1.0)
        actuator.set_default_rotor_inertia(float(armature))
    plant.mutable_gravity_field().set_gravity_vector(np.array(robot.gravity))
    return plant


def columns(plant: Any, robot: Robot) -> Array:
    """Return the place of each joint of the robot in v."""
    joints = [plant.get_joint(index) for index in plant.GetJointIndices()]
    names = {joint.name(): joint.velocity_start() for joint in joints if joint.num_velocities() == 1}
    if plant.num_velocities() != len(names) or plant.num_positions() != len(names):
        raise CannotBuild(f"Drake made {plant.num_velocities()} velocities of {len(names)} joints of one each")
    return columns_of(names, robot, "drake")


def _weld(plant: Any, joint: Any, value: float) -> None:
    """Replace a joint by a weld at its value."""
    from pydrake.common.eigen_geometry import AngleAxis
    from pydrake.math import RigidTransform, RotationMatrix

    still: Any = np.zeros(3)
    parent, child = joint.frame_on_parent(), joint.frame_on_child()
    if joint.type_name() == "prismatic":
        pose = RigidTransform(joint.translation_axis() * value)
    else:
        pose = RigidTransform(RotationMatrix(AngleAxis(value, joint.revolute_axis())), still)
    plant.RemoveJoint(joint)
    plant.WeldFrames(parent, child, pose)
