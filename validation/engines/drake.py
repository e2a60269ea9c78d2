"""Drake: MultibodyPlant in continuous time, for everything but the closed loop.

Drake as its discrete scheme allows: the tip as a small sphere in frictionless, nearly rigid contact.
"""

# ruff: noqa: D102 - what a method returns is said once, in `interface.Engine`

import logging
import time as clock
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any
from xml.etree import ElementTree

import numpy as np
from scipy.spatial.transform import Rotation

from closedloop import Problem
from robot_models.coordinates import BALL, PLACES, RATES
from validation.engines import interface
from validation.engines.interface import METHODS, CannotBuild, Engine, Robot
from validation.engines.trajectories import Trajectory, law
from validation.oracle.spatial import Array


class Drake(Engine):
    """Drake's MultibodyPlant, continuous, so that no time step enters any number.

    Joint order: depth first as Drake numbers its mobilizers; mapped by name through `velocity_start`. Frames: world
    axes; Jacobians with respect to v. A joint that turns freely has its angular velocity in the parent's axes, the
    simulator's in the body's own; v_Drake = T v with an orthogonal T (a permutation beside rotations R), and Ṫ v = 0
    as Ṙ ω = R (ω × ω). A free body's velocities are those of its origin, angular ones first.

    Armature: the reflected inertia of a `JointActuator` with gear ratio 1 and the armature as rotor inertia, which
    Drake adds to H; the actuators are never driven. Gravity: the vector of the plant's gravity field; `CalcBiasTerm`
    leaves it out and `CalcGravityGeneralizedForces` has the opposite sign, so C = bias term − gravity forces. Torques
    enter at the port for applied generalized forces. Locked joints are removed and their frames welded. A root link
    called "world" *is* Drake's world and is not welded to it. Sites of MJCF are unknown to it: the tip's is added as
    a frame.

    Free acceleration is `EvalTimeDerivatives`: the articulated body algorithm, which never forms H.

    Constraints act on discrete plants only (on a continuous one they are ignored without a word), none of them
    holds a point on a plane, and at one instant a discrete plant has impulses over a step and no
    acceleration-level multiplier. What its discrete contact allows is in `drake_slide`.

    Accuracy: rounding, times the condition number of H in q̈. Inertias are kept as mass, centre and unit inertia,
    a division that costs one rounding.
    """

    name = "drake"
    turns_freely = True
    package = "pydrake"
    install = 'pip install "drake>=1.50"'
    covers = frozenset(METHODS) - {"stabilised", "constrained", "impulse"}
    cannot = MappingProxyType({
        "stabilised": "it has no Baumgarte stabiliser; discrete constraints are held by compliance and relaxation",
        "constrained": "no constraint of Drake holds a point on a plane, none acts on a continuous plant",
        "impulse": "a discrete plant has impulses over a time step, compliant ones, and no restitution",
    })  # fmt: skip

    def __init__(self, robot: Robot, tip: str) -> None:
        super().__init__(robot, tip)
        from pydrake.multibody.tree import JacobianWrtVariable

        self.plant = build_plant(robot, 0.0)
        self.plant.Finalize()
        self.parts = parts_of(self.plant, robot)
        self.context = self.plant.CreateDefaultContext()
        if not self.plant.HasFrameNamed(tip):
            raise CannotBuild(f"Drake has no body {tip!r}")
        self.tip: Any = self.plant.GetFrameByName(tip)
        self.world: Any = self.plant.world_frame()
        self.wrt: Any = JacobianWrtVariable.kV

    def _set(self, q: Array, v: Array | None = None) -> Array:
        """Put the state in and return T (n, n) of v_Drake = T v."""
        from pydrake.math import RollPitchYaw, RotationMatrix

        if not (np.all(np.isfinite(q)) and (v is None or np.all(np.isfinite(v)))):
            raise ValueError("q and v must be finite")
        positions, T = np.zeros(self.plant.num_positions()), np.zeros((self.n, self.n))
        for part in self.parts:
            if part.angles is None:
                positions[part.position], T[part.velocity, part.column] = q[part.column], 1.0
                continue
            turn = RotationMatrix(Rotation.from_rotvec(q[part.column : part.column + 3]).as_matrix())
            T[part.velocity : part.velocity + 3, part.column : part.column + 3] = turn.matrix()
            angles = RollPitchYaw(turn).vector() if part.angles == 3 else turn.ToQuaternion().wxyz()
            positions[part.position : part.position + part.angles] = angles
        self.plant.SetPositions(self.context, positions)
        self.plant.SetVelocities(self.context, T @ (np.zeros(self.n) if v is None else v))
        return T

    def mass_matrix(self, q: Array) -> Array:
        T = self._set(q)
        return np.array(T.T @ self.plant.CalcMassMatrix(self.context) @ T)

    def bias(self, q: Array, v: Array) -> Array:
        T = self._set(q, v)
        gravity = self.plant.CalcGravityGeneralizedForces(self.context)
        return np.array(T.T @ (self.plant.CalcBiasTerm(self.context) - gravity))

    def gravity_term(self, q: Array) -> Array:
        T = self._set(q)
        return np.array(-T.T @ self.plant.CalcGravityGeneralizedForces(self.context))

    def position(self, q: Array) -> Array:
        self._set(q)
        return np.array(self.tip.CalcPoseInWorld(self.context).translation())

    def jacobian(self, q: Array) -> Array:
        T = self._set(q)
        J = self.plant.CalcJacobianTranslationalVelocity(
            self.context, self.wrt, self.tip, np.zeros(3), self.world, self.world
        )
        return np.array(J @ T)

    def drift(self, q: Array, v: Array) -> Array:
        self._set(q, v)
        a = self.plant.CalcBiasTranslationalAcceleration(
            self.context, self.wrt, self.tip, np.zeros(3), self.world, self.world
        )
        return np.array(a).reshape(3)

    def free_acceleration(self, q: Array, v: Array, torque: Array) -> Array:
        T = self._set(q, v)
        self.plant.get_applied_generalized_force_input_port().FixValue(self.context, T @ torque)
        derivatives = self.plant.EvalTimeDerivatives(self.context).CopyToVector()
        return np.array(T.T @ derivatives[self.plant.num_positions() :])


@dataclass(frozen=True)
class Part:
    """Where a joint of one velocity, or the turning of one that turns freely, lies.

    column: its first velocity in the robot's order
    position, velocity: its first place in Drake's q and v
    angles: numbers of its orientation in q, 4 of a quaternion or 3 angles; None for a joint of one velocity
    """

    column: int
    position: int
    velocity: int
    angles: int | None = None


def parts_of(plant: Any, robot: Robot) -> list[Part]:
    """Return the parts of the robot's q and v."""
    types = getattr(robot, "joint_types", ("",) * len(robot.joint_names))
    joints = {joint.name(): joint for joint in map(plant.get_joint, plant.GetJointIndices())}
    joints |= {name: joints[body] for name, body in _free_joints(robot).items() if body in joints}
    found: list[Part] = []
    for column, (name, kind) in enumerate(zip(robot.joint_names, types, strict=True)):
        end = next((end for end in (*PLACES, *RATES) if name.endswith(end) and name not in joints), "")
        joint = joints.get(name.removesuffix(end))
        if joint is None or joint.num_velocities() == 0:
            raise CannotBuild(f"Drake reads no joint {name!r}")
        position, velocity = joint.position_start(), joint.velocity_start()
        free = joint.num_velocities() == 6
        if kind != BALL:
            at = PLACES.index(end) if free else 0
            found.append(Part(column, position + at + 4 * free, velocity + at + 3 * free))
        elif end == RATES[0]:
            found.append(Part(column, position, velocity, joint.num_positions() - 3 * free))
    if plant.num_velocities() != len(robot.joint_names):
        raise CannotBuild(f"Drake made {plant.num_velocities()} velocities, the robot has {len(robot.joint_names)}")
    return found


def _free_joints(robot: Robot) -> dict[str, str]:
    """Return the body of each named free joint of an MJCF: Drake calls the joint by its body's name."""
    if robot.format != "mjcf":
        return {}
    bodies = ElementTree.fromstring(robot.text.encode()).iter("body")
    free = [
        (body, joint) for body in bodies for joint in body if joint.tag == "freejoint" or joint.get("type") == "free"
    ]
    return {joint.get("name", ""): body.get("name", "") for body, joint in free if joint.get("name")}


def build_plant(robot: Robot, time_step: float, scene_graph: Any = None) -> Any:
    """Return the robot as a plant that is not finalized yet, on a fixed base, locked joints welded.

    A `time_step`, s, of 0 is a continuous plant; geometry is registered in `scene_graph`, for contact.
    """
    from pydrake.math import RigidTransform
    from pydrake.multibody.parsing import Parser
    from pydrake.multibody.plant import MultibodyPlant
    from pydrake.multibody.tree import FixedOffsetFrame

    sites: dict[str, tuple[str, Array]] = {}
    if robot.format == "urdf":
        interface.refuse_balls(robot, "drake, for a URDF,")
        text = interface.bare_urdf(robot.text)
    else:
        text, sites = interface.bare_mjcf(robot.text)
    plant: Any = MultibodyPlant(time_step)
    if scene_graph is not None:
        plant.RegisterAsSourceForSceneGraph(scene_graph)
    try:
        Parser(plant).AddModelsFromString(text, "urdf" if robot.format == "urdf" else "xml")
    except RuntimeError as error:
        raise CannotBuild(f"Drake refuses it: {str(error).splitlines()[0]}") from error
    if robot.format == "urdf":
        root = plant.GetBodyByName(interface.root_link(text))
        if root.index() != plant.world_body().index():
            plant.WeldFrames(plant.world_frame(), root.body_frame())
    place: Any  # Drake's types name an array of float64 only
    for name, (body, place) in sites.items():
        plant.AddFrame(FixedOffsetFrame(name, plant.GetBodyByName(body).body_frame(), RigidTransform(place)))
    for name, value in robot.locked.items():
        _weld(plant, plant.GetJointByName(name), value)
    for name, armature in zip(robot.joint_names, robot.armature, strict=True):
        if armature == 0.0:
            continue
        if not plant.HasJointNamed(name):
            raise CannotBuild(f"Drake has no actuator for the armature of {name!r}")
        actuator = plant.AddJointActuator(name, plant.GetJointByName(name))
        actuator.set_default_gear_ratio(1.0)
        actuator.set_default_rotor_inertia(float(armature))
    plant.mutable_gravity_field().set_gravity_vector(np.array(robot.gravity))
    return plant


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

    # Its warning that a half-space bears no deformable bodies is dropped, for good, as Drake hands its messages to
    # Python some time after they arise.
    logging.getLogger("drake").addFilter(lambda record: "deformable" not in record.getMessage())
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
