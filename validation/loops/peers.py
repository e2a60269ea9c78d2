"""What other engines make of a mechanism whose loops they can hold: q̈ of a state, the tip away from everything.

Each is given the tree and the loop joints as its own kinds of constraint, and finds rows, drift and solution itself.
"""

from typing import Any, ClassVar

import numpy as np

from robot_models.loop_joint import WORLD, LoopJoint
from validation.engines.interface import CannotBuild
from validation.engines.pinocchio_cpp import PinocchioCpp
from validation.loops.cases import Case, mechanism_called
from validation.oracle.spatial import Array
from validation.tolerances import Tolerance


class LoopPeer:
    """An engine with the loops of one mechanism.

    name, package, install: see `validation.engines.interface.Engine`
    bound: how far from the truth it may be, relative to what q̈ is summed from, and why
    """

    name: ClassVar[str]
    package: ClassVar[str | None]
    install: ClassVar[str]
    bound: ClassVar[Tolerance]

    def __init__(self, mechanism: str) -> None:
        """Build it; raises CannotBuild."""
        raise NotImplementedError

    def __call__(self, case: Case) -> Array:
        """Return q̈ (n,) of a case."""
        raise NotImplementedError


def refuse_other(joint: LoopJoint, kinds: tuple[str, ...], engine: str) -> None:
    """Refuse a loop joint that an engine has no constraint for."""
    if joint.type not in kinds:
        raise CannotBuild(f"{engine} has no constraint that is a {joint.type}: it knows {', '.join(kinds)}")


class PinocchioLoops(LoopPeer):
    """`constraintDynamics` with a contact of three rows for a point and of six for a weld.

    Its μ adds to the diagonal of G H⁻¹Gᵀ, and proximal iterations take its effect away again. At 0 and 1e-12 rows that
    depend on others gave answers that were wrong by anything without an exception; at 1e-6 and a hundred iterations it
    converges to the least motion in their span, which is the right one.
    """

    name, package, install = PinocchioCpp.name, PinocchioCpp.package, PinocchioCpp.install
    bound = Tolerance("Pinocchio's proximal solver", 1e-7, "its μ of 1e-6, iterated away while its residual shrinks")
    kinds = ("point", "weld")

    def __init__(self, mechanism: str) -> None:
        import pinocchio as pin

        self.pin, self.robot = pin, mechanism_called(mechanism)
        engine = PinocchioCpp(self.robot, str(self.robot.tip))
        self.engine, self.model = engine, engine.model
        self.data: Any = self.model.createData()
        self.joints: Any = pin.StdVec_RigidConstraintModel()
        self.datas: Any = pin.StdVec_RigidConstraintData()
        for joint in self.robot.loops:
            refuse_other(joint, self.kinds, "constraintDynamics")
            kind = pin.ContactType.CONTACT_6D if joint.type == "weld" else pin.ContactType.CONTACT_3D
            made = pin.RigidConstraintModel(kind, self.model, *self._side(joint, 0), *self._side(joint, 1), pin.LOCAL)
            self.joints.append(made)
            self.datas.append(made.createData())
        pin.initConstraintDynamics(self.model, self.data, self.joints, self.datas)

    def _side(self, joint: LoopJoint, k: int) -> tuple[int, Any]:
        pin, turn = self.pin, np.eye(3) if k == 0 else np.array(joint.turn)
        here = pin.SE3(turn, np.array(joint.points[k]))
        if joint.frames[k] == WORLD:
            return 0, here
        frame = self.model.frames[self.model.getFrameId(joint.frames[k], pin.FrameType.BODY)]
        return int(frame.parentJoint), frame.placement * here

    def __call__(self, case: Case) -> Array:
        """Return q̈ (n,) of a case."""
        proximal = self.pin.ProximalSettings(1e-14, 1e-6, 100)
        state = self.engine._q(case.q), self.engine._in(case.v), self.engine._in(case.torque)
        found = self.pin.constraintDynamics(self.model, self.data, *state, self.joints, self.datas, proximal)
        return np.array(found)[self.engine.columns]
