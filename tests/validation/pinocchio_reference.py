# ruff: noqa: D102 - the methods bear the names of those of validation.oracle.Oracle, which says what they are.
"""Pinocchio behind the names of the oracle, for the tests only: the oracle itself never sees it.

Two conventions of Pinocchio matter here. Its joint order is its own (depth first, names sorted), and a
continuous joint takes two numbers, cos and sin, in q. Both are mapped from joint names.
"""

import numpy as np
import pinocchio as pin


class PinocchioEngine:
    """The reference that the oracle is compared with, in the column order of the robot."""

    complex_step = False

    def __init__(self, robot, tip):
        full = pin.buildModelFromXML(robot.text)
        if robot.locked:
            at = pin.neutral(full)
            for name, value in robot.locked.items():
                joint = full.joints[full.getJointId(name)]
                at[joint.idx_q : joint.idx_q + joint.nq] = _coordinates(joint.nq, value)
            full = pin.buildReducedModel(full, [full.getJointId(name) for name in robot.locked], at)
        self.model = full
        self.data = self.model.createData()
        self.joints = [self.model.joints[self.model.getJointId(name)] for name in robot.joint_names]
        self.columns = np.array([joint.idx_v for joint in self.joints])
        assert sorted(self.columns) == list(range(self.model.nv))
        armature = np.zeros(self.model.nv)
        armature[self.columns] = robot.armature
        self.model.armature = armature
        self.model.gravity.linear = np.asarray(robot.gravity)
        self.frame = self.model.getFrameId(tip)
        assert self.frame < self.model.nframes

    def _q(self, q):
        out = np.zeros(self.model.nq)
        for joint, value in zip(self.joints, q, strict=True):
            out[joint.idx_q : joint.idx_q + joint.nq] = _coordinates(joint.nq, value)
        return out

    def _v(self, v):
        out = np.zeros(self.model.nv)
        out[self.columns] = v
        return out

    def mass_matrix(self, q):
        upper = np.triu(pin.crba(self.model, self.data, self._q(q)))
        return (upper + np.triu(upper, 1).T)[np.ix_(self.columns, self.columns)]

    def bias(self, q, v):
        return pin.nonLinearEffects(self.model, self.data, self._q(q), self._v(v))[self.columns].copy()

    def gravity_term(self, q):
        return pin.computeGeneralizedGravity(self.model, self.data, self._q(q))[self.columns].copy()

    def coriolis_matrix(self, q, v):
        matrix = pin.computeCoriolisMatrix(self.model, self.data, self._q(q), self._v(v))
        return matrix[np.ix_(self.columns, self.columns)]

    def inverse_dynamics(self, q, v, a):
        return pin.rnea(self.model, self.data, self._q(q), self._v(v), self._v(a))[self.columns].copy()

    def pushed_inverse_dynamics(self, q, v, a, force):
        frame = self.model.frames[self.frame]
        pin.framesForwardKinematics(self.model, self.data, self._q(q))
        joint, tip = self.data.oMi[frame.parentJoint], self.data.oMf[self.frame].translation
        push = joint.actInv(pin.Force(force, np.cross(tip, force)))
        pushes = pin.StdVec_Force()
        for i in range(self.model.njoints):
            pushes.append(push if i == frame.parentJoint else pin.Force.Zero())
        args = (self._q(q), self._v(v), self._v(a), pushes)
        return pin.rnea(self.model, self.data, *args)[self.columns].copy()

    def forward_dynamics(self, q, v, torque):
        return pin.aba(self.model, self.data, self._q(q), self._v(v), self._v(torque))[self.columns].copy()

    def kinetic_energy(self, q, v):
        return pin.computeKineticEnergy(self.model, self.data, self._q(q), self._v(v))

    def potential_energy(self, q):
        return pin.computePotentialEnergy(self.model, self.data, self._q(q))

    def position(self, q):
        pin.framesForwardKinematics(self.model, self.data, self._q(q))
        return self.data.oMf[self.frame].translation.copy()

    def rotation(self, q):
        pin.framesForwardKinematics(self.model, self.data, self._q(q))
        return self.data.oMf[self.frame].rotation.copy()

    def jacobian(self, q):
        frame = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        return pin.computeFrameJacobian(self.model, self.data, self._q(q), self.frame, frame).reshape(6, -1)[
            :3, self.columns
        ]

    def spatial_jacobian(self, q):
        """Return Pinocchio's WORLD Jacobian with its linear and angular rows exchanged: angular first."""
        frame = pin.ReferenceFrame.WORLD
        J = pin.computeFrameJacobian(self.model, self.data, self._q(q), self.frame, frame).reshape(6, -1)[
            :, self.columns
        ]
        return np.concatenate([J[3:], J[:3]])

    def drift(self, q, v):
        nothing = np.zeros(self.model.nv)
        pin.forwardKinematics(self.model, self.data, self._q(q), self._v(v), nothing)
        frame = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        return pin.getFrameClassicalAcceleration(self.model, self.data, self.frame, frame).linear.copy()

    def spatial_drift(self, q, v):
        nothing = np.zeros(self.model.nv)
        pin.forwardKinematics(self.model, self.data, self._q(q), self._v(v), nothing)
        motion = pin.getFrameAcceleration(self.model, self.data, self.frame, pin.ReferenceFrame.WORLD)
        return np.concatenate([motion.angular, motion.linear])


def _coordinates(nq, value):
    """Return a joint's own coordinates: itself, or the cosine and sine of a continuous joint."""
    return [value] if nq == 1 else [np.cos(value), np.sin(value)]
