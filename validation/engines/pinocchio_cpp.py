# ruff: noqa: D102 - what a method returns is said once, in `interface.Engine`
"""Pinocchio's own C++ algorithms, built from the text by Pinocchio's own reader."""

from types import MappingProxyType
from typing import Any

import numpy as np

import robot_models
from robot_models.coordinates import balls, in_pinocchios_order, with_quaternions
from validation.engines.interface import METHODS, CannotBuild, Engine, Robot, columns_of
from validation.oracle.spatial import Array


class PinocchioCpp(Engine):
    """Pinocchio: `aba` for the free arm, `forwardDynamics` and `impulseDynamics` for the closed loop.

    Joint order: depth first with siblings sorted by name; mapped by name. A continuous URDF joint has two
    coordinates, (cos q, sin q), and one velocity; mapped. Frames: LOCAL_WORLD_ALIGNED at the tip. Armature:
    `Model.armature`, inside `crba`, `rnea` and `aba`. Gravity: `Model.gravity.linear`. Constraint: any (1, n)
    Jacobian A with its drift γ, solving A q̈ + γ = 0, here γ = −b; `Data.lambda_c` has the sign of f, since
    H q̈ + C = Q + Aᵀ λ. Impact: A q̇⁺ = −ε A q̇, `Data.impulse_c`.

    Traps. `crba` fills the upper triangle. NaN in is NaN out, or worse, a finite number (the mass matrix of one
    joint does not depend on q): inputs are checked here. A singular pose gives NaN without an exception: results
    are checked here. Locked joints go through `buildReducedModel`, which adds their armature nowhere: rigid.

    Accuracy: rounding, times the condition number of H (Cholesky) in q̈ and f. The simulator calls the same
    library, so agreement with it says nothing about Pinocchio's crba and rnea; that `aba` and `forwardDynamics`
    take other paths than Eq. 24 in the loop is what is tested here.
    """

    name = "pinocchio"
    turns_freely = True
    package = "pinocchio"
    install = "pip install pin"
    covers = frozenset(METHODS) - {"stabilised"}
    cannot = MappingProxyType({"stabilised": "its Baumgarte corrector belongs to contacts of three and six rows"})

    def __init__(self, robot: Robot, tip: str) -> None:
        super().__init__(robot, tip)
        import pinocchio as pin

        self.pin: Any = pin
        self.types = getattr(robot, "joint_types", ()) if isinstance(robot, robot_models.RobotModel) else ()
        if robot.format == "urdf" and not balls(self.types):
            model = pin.buildModelFromXML(robot.text)
            if robot.locked:
                model = self._weld(model, robot)
        elif isinstance(robot, robot_models.RobotModel):
            model = robot.pinocchio_model()  # Pinocchio reads MJCF otherwise than MuJoCo does, unless helped
        else:
            raise CannotBuild(f"its description is {robot.format!r} and it is no RobotModel")
        self.model = model
        self.joints = [model.joints[model.getJointId(name)] for name in robot.joint_names if model.existJointName(name)]
        names = {name: int(model.joints[i].idx_v) for i, name in enumerate(model.names) if i}
        self.columns = columns_of(names, robot, self.name)
        model.armature = self._in(np.asarray(robot.armature))
        model.gravity.linear = np.array(robot.gravity)
        self.data = model.createData()
        # A joint may share its name with a link: only links, bodies and sites are asked for.
        kinds = [kind for kind in (pin.FrameType.BODY, pin.FrameType.OP_FRAME) if model.existFrame(tip, kind)]
        if not kinds:
            raise CannotBuild(f"Pinocchio reads no frame {tip!r}")
        self.frame = model.getFrameId(tip, kinds[0])

    def _weld(self, model: Any, robot: Robot) -> Any:
        at = self.pin.neutral(model)
        for name, value in robot.locked.items():
            joint = model.joints[model.getJointId(name)]
            at[joint.idx_q : joint.idx_q + joint.nq] = _coordinates(joint.nq, value)
        return self.pin.buildReducedModel(model, [model.getJointId(name) for name in robot.locked], at)

    def _q(self, q: Array) -> Array:
        _require_finite(q, "q")
        if balls(self.types):
            return in_pinocchios_order(with_quaternions(np.asarray(q), self.types), self.types)
        out = np.empty(self.model.nq)
        for joint, value in zip(self.joints, q, strict=True):
            out[joint.idx_q : joint.idx_q + joint.nq] = _coordinates(joint.nq, value)
        return out

    def _in(self, x: Array) -> Array:
        """Put a vector of joint rates, torques or inertias into Pinocchio's order."""
        _require_finite(x, "v, torque or armature")
        out = np.empty(self.n)
        out[self.columns] = x
        return out

    def mass_matrix(self, q: Array) -> Array:
        upper = np.triu(self.pin.crba(self.model, self.data, self._q(q)))
        return np.asarray((upper + np.triu(upper, 1).T)[np.ix_(self.columns, self.columns)])

    def bias(self, q: Array, v: Array) -> Array:
        return np.array(self.pin.nonLinearEffects(self.model, self.data, self._q(q), self._in(v)))[self.columns]

    def gravity_term(self, q: Array) -> Array:
        return np.array(self.pin.computeGeneralizedGravity(self.model, self.data, self._q(q)))[self.columns]

    def position(self, q: Array) -> Array:
        self.pin.framesForwardKinematics(self.model, self.data, self._q(q))
        return np.array(self.data.oMf[self.frame].translation)

    def jacobian(self, q: Array) -> Array:
        aligned = self.pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        # Pinocchio hands out the one column of a single joint as a vector.
        J = self.pin.computeFrameJacobian(self.model, self.data, self._q(q), self.frame, aligned).reshape(6, -1)
        return np.array(J[:3, self.columns])

    def drift(self, q: Array, v: Array) -> Array:
        aligned = self.pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        self.pin.forwardKinematics(self.model, self.data, self._q(q), self._in(v), np.zeros(self.n))
        motion = self.pin.getFrameClassicalAcceleration(self.model, self.data, self.frame, aligned)
        return np.array(motion.linear)

    def free_acceleration(self, q: Array, v: Array, torque: Array) -> Array:
        a = self.pin.aba(self.model, self.data, self._q(q), self._in(v), self._in(torque))
        return np.array(a)[self.columns]

    def constrained(self, q: Array, v: Array, torque: Array, normal: Array, b: float) -> tuple[Array, float]:
        _require_finite(np.array([*normal, b]), "normal or b")
        A = self._row(q, normal)
        state = self._q(q), self._in(v), self._in(torque)
        a = self.pin.forwardDynamics(self.model, self.data, *state, A, np.array([-b]), 0.0)
        return self._checked(a, self.data.lambda_c)

    def impulse(self, q: Array, v: Array, normal: Array, restitution: float) -> tuple[Array, float]:
        A = self._row(q, normal)
        state = self._q(q), self._in(v)
        after = self.pin.impulseDynamics(self.model, self.data, *state, A, restitution, 0.0)
        return self._checked(after, self.data.impulse_c)

    def _row(self, q: Array, normal: Array) -> Array:
        """Return A = nᵀJᵣ (1, n) in Pinocchio's order."""
        return self._in(np.asarray(normal) @ self.jacobian(q))[None, :]

    def _checked(self, rates: Array, multiplier: Array) -> tuple[Array, float]:
        if not (np.all(np.isfinite(rates)) and np.all(np.isfinite(multiplier))):
            raise np.linalg.LinAlgError("Pinocchio returned NaN: the pose is singular")
        return np.array(rates)[self.columns], float(multiplier[0])


def _coordinates(nq: int, value: float) -> list[float]:
    """Return a joint's own coordinates: itself, or the cosine and sine of a continuous joint."""
    return [value] if nq == 1 else [float(np.cos(value)), float(np.sin(value))]


def _require_finite(x: Array, what: str) -> None:
    if not np.all(np.isfinite(x)):
        raise ValueError(f"{what} = {np.asarray(x).tolist()}: must be finite")
