"""What other engines make of a mechanism whose loops they can hold: q̈ of a state, the tip away from everything.

Each is given the tree and the loop joints as its own kinds of constraint, and finds rows, drift and solution itself.

Exudyn with the loops of a mechanism.

MuJoCo with the loops of a mechanism.
"""

from importlib import import_module
from itertools import pairwise
from typing import Any, ClassVar

import numpy as np

from robot_models.loop_joint import WORLD, LoopJoint
from validation.engines.exudyn import Exudyn, add_marker, add_tree, quiet_settings
from validation.engines.interface import CannotBuild, Tolerance
from validation.engines.mujoco import MuJoCo, build_spec, columns, compile_spec, solve_to_rounding
from validation.engines.pinocchio_cpp import PinocchioCpp
from validation.loops.cases import Case, mechanism_called, oracle_of
from validation.oracle.loops import COUPLES, FORCES, joint_axes
from validation.oracle.spatial import Array
from validation.oracle.tree import GROUND


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


# A row is independent of those before it if more than this share of it is outside their span.
INDEPENDENT = 1e-6


class ExudynLoops(LoopPeer):
    """A `JointGeneric` between two links, and a `ConnectorDistance` for a rod.

    Its multipliers are exact, but rows that depend on others make its system singular: such axes are left unlocked
    here, forces kept before couples. What it knows of the drift is a difference quotient.
    """

    name, package, install = Exudyn.name, Exudyn.package, Exudyn.install
    bound = Tolerance("Exudyn's drift", 1e-5, "a difference quotient, good to 1e-7 or so of the rows' own drift")
    kinds = ("point", "hinge", "slider", "cylinder", "planar", "weld", "distance")

    def __init__(self, mechanism: str) -> None:
        self.robot, self.oracle = mechanism_called(mechanism), oracle_of(mechanism)
        for joint in self.robot.loops:
            refuse_other(joint, self.kinds, "JointGeneric")

    def __call__(self, case: Case) -> Array:
        """Return q̈ (n,) of a case."""
        exudyn: Any = import_module("exudyn")
        tree = self.oracle.oracle.tree
        container = exudyn.SystemContainer()
        system: Any = container.AddSystem()
        body, _ = add_tree(system, tree, str(self.robot.tip), case.q, case.v)
        system.SetObjectParameter(body, "jointForceVector", case.torque)
        ground = system.AddObject(import_module("exudyn.itemInterface").ObjectGround())
        for joint, locked in zip(self.robot.loops, self._independent(case), strict=True):
            self._add(system, body, ground, joint, locked)
        system.Assemble()
        solver: Any = exudyn.MainSolverImplicitSecondOrder()
        loud = exudyn.config.suppressWarnings
        exudyn.config.suppressWarnings = True  # what it would warn of is checked
        started = bool(solver.InitializeSolver(system, quiet_settings()))
        exudyn.config.suppressWarnings = loud
        acceleration = np.array(system.systemData.GetODE2Coordinates_tt())
        if not started or not np.any(np.abs(acceleration) > 0.0):
            raise np.linalg.LinAlgError("Exudyn finds no initial accelerations")
        return acceleration

    def _independent(self, case: Case) -> list[list[bool]]:
        """Return which rows of each loop joint are locked: those that depend on the ones before them are not."""
        taken: list[Array] = []
        chosen = []
        for rows in self.oracle.all_rows(case.q, case.v):
            locked = []
            for row in rows.A:
                left, size = row.copy(), float(np.linalg.norm(row))
                for _ in range(2):
                    for direction in taken:
                        left = left - direction * (direction @ left)
                locked.append(bool(np.linalg.norm(left) > INDEPENDENT * max(size, INDEPENDENT)))
                if locked[-1]:
                    taken.append(left / np.linalg.norm(left))
            chosen.append(locked)
        return chosen

    def _add(self, system: Any, body: Any, ground: Any, joint: LoopJoint, locked: list[bool]) -> None:
        items = import_module("exudyn.itemInterface")
        markers, tree = [], self.oracle.oracle.tree
        for k in (1, 0):  # its axes are those of the first
            frame, pose = joint.frames[k], np.eye(4)
            pose[:3, :3], pose[:3, 3] = joint_axes(joint, k), joint.points[k]
            if frame != WORLD and tree.frame(frame).body != GROUND:
                markers.append(add_marker(system, body, tree, frame, pose))
                continue
            if frame != WORLD:
                place = np.eye(4)
                place[:3, :3], place[:3, 3] = tree.frame(frame).rotation, tree.frame(frame).translation
                pose = place @ pose
            markers.append(system.AddMarker(items.MarkerBodyRigid(bodyNumber=ground, localHT=pose)))
        if joint.type == "distance":
            system.AddObject(items.ObjectConnectorDistance(markerNumbers=markers, distance=joint.length))
            return
        names = [*FORCES[joint.type], *(x.upper() for x in COUPLES[joint.type])]
        held = {name for name, yes in zip(names, locked, strict=True) if yes}
        axes = [int(x in held) for x in "xyzXYZ"]
        system.AddObject(items.ObjectJointGeneric(markerNumbers=markers, constrainedAxes=axes))


class MuJoCoLoops(LoopPeer):
    """`equality`: connect, weld, joint, and a tendon of a fixed length; two connects on its axis for a hinge.

    MuJoCo solves G q̈ + R λ = a_ref. a_ref is set to −drift, which its own `mj_jacDot` gives, and R to a share of the
    diagonal of G H⁻¹Gᵀ; q̈ is analytic in that share, rows that depend on others included, and is extrapolated to none
    from three. Its own R, at the hardest impedance of 0.9999, leaves q̈ wrong by 1e-4 or so.
    """

    name, package, install = MuJoCo.name, MuJoCo.package, MuJoCo.install
    bound = Tolerance(
        "MuJoCo's limit", 1e-7, "three softnesses down to 1e-6 of the diagonal, whose rounding it divides by"
    )
    kinds = ("point", "hinge", "weld", "distance", "gear")
    shares = (4e-6, 2e-6, 1e-6)

    def __init__(self, mechanism: str) -> None:
        import mujoco

        self.mj: Any = mujoco
        self.robot = mechanism_called(mechanism)
        spec = build_spec(self.robot, str(self.robot.tip))
        solve_to_rounding(spec)
        # Of each equality, as MuJoCo numbers them: the type of its loop joint, and the sites or joints that it binds.
        self.made: list[tuple[str, tuple[str, ...]]] = []
        for k, joint in enumerate(self.robot.loops):
            refuse_other(joint, self.kinds, "equality")
            self._add(spec, joint, f"loop{k}")
        self.model = compile_spec(spec)
        self.data = mujoco.MjData(self.model)
        self.columns = columns(self.model, self.robot)

    def _add(self, spec: Any, joint: LoopJoint, name: str) -> None:
        mj = self.mj
        if joint.coefficients:
            sides = [f"{name} {side}" for side in range(2)]
            for side, row in zip(sides, joint.coefficients, strict=True):
                length = spec.add_tendon(name=side)
                for bound, coefficient in zip(joint.joints, row, strict=True):
                    length.wrap_joint(bound, coefficient)
            kinds = {"type": mj.mjtEq.mjEQ_TENDON, "objtype": mj.mjtObj.mjOBJ_TENDON}
            made = spec.add_equality(name1=sides[0], name2=sides[1], **kinds)
            made.data[:5] = joint.polynomial
            self.made.append(("sums", tuple(sides)))
            return
        if joint.type == "gear":
            names = dict(zip(("name1", "name2"), joint.joints, strict=False))
            made = spec.add_equality(type=mj.mjtEq.mjEQ_JOINT, objtype=mj.mjtObj.mjOBJ_JOINT, **names)
            made.data[:5] = joint.polynomial
            self.made.append(("gear", joint.joints))
            return
        for end in range(2 if joint.type == "hinge" else 1):
            sites = []
            for k, (frame, point) in enumerate(zip(joint.frames, joint.points, strict=True)):
                body = spec.worldbody if frame == WORLD else spec.body(frame)
                sites.append(f"{name}/{end}/{k}")
                site = body.add_site(name=sites[-1], pos=np.array(point) + 0.2 * end * np.array(joint.axes[k]))
                if joint.type == "weld" and k == 1:
                    mj.mju_mat2Quat(site.quat, np.array(joint.turn).ravel())
            if joint.type == "distance":
                rod = spec.add_tendon(name=name)
                for site in sites:
                    rod.wrap_site(site)
                spec.add_equality(type=mj.mjtEq.mjEQ_TENDON, objtype=mj.mjtObj.mjOBJ_TENDON, name1=name).data[1] = 1.0
            else:
                kind = mj.mjtEq.mjEQ_WELD if joint.type == "weld" else mj.mjtEq.mjEQ_CONNECT
                made = spec.add_equality(type=kind, objtype=mj.mjtObj.mjOBJ_SITE, name1=sites[0], name2=sites[1])
                if joint.type == "weld":
                    made.data[10] = 1.0
            self.made.append((joint.type, tuple(sites)))

    def __call__(self, case: Case) -> Array:
        """Return q̈ (n,) of a case."""
        found = [self.softly(case, share) for share in self.shares]
        while len(found) > 1:  # Neville's scheme at zero, each share half the one before
            order = 2.0 ** (len(self.shares) - len(found) + 1)
            found = [(order * b - a) / (order - 1.0) for a, b in pairwise(found)]
        return np.asarray(found[0])

    def softly(self, case: Case, share: float) -> Array:
        """Return q̈ (n,) at a softness R of a share of the diagonal of G H⁻¹Gᵀ."""
        mj, model, data = self.mj, self.model, self.data
        data.qpos[self.columns], data.qvel[self.columns] = case.q, case.v
        mj.mj_fwdPosition(model, data)
        mj.mj_fwdVelocity(model, data)
        n, m = model.nv, data.nefc
        G = np.array(data.efc_J).reshape(m, n)
        back = np.zeros((m, n))
        mj.mj_solveM(model, data, back, G.copy())
        diagonal = np.einsum("ij,ij->i", G, back)
        data.efc_R[:] = share * np.maximum(diagonal, 1e-9 * np.max(diagonal))
        data.efc_D[:] = 1.0 / data.efc_R
        data.efc_aref[:] = -self._drift(G)
        data.qfrc_applied[self.columns] = case.torque
        mj.mj_fwdActuation(model, data)
        mj.mj_fwdAcceleration(model, data)
        mj.mj_fwdConstraint(model, data)
        return np.array(data.qacc[self.columns])

    def _drift(self, G: Array) -> Array:
        """Return the drift (m,) of MuJoCo's rows G, from its own derivatives of Jacobians."""
        data, drift = self.data, np.zeros(len(G))
        for index, (kind, names) in enumerate(self.made):
            rows = np.flatnonzero(data.efc_id[: len(G)] == index)
            if kind in ("gear", "sums"):
                drift[rows] = self._gear_drift(index, names)
                continue
            J, rate = (a - b for a, b in zip(self._jacobians(names[0]), self._jacobians(names[1]), strict=True))
            moving, speeding = J @ data.qvel, rate @ data.qvel
            if kind == "distance":
                apart = data.site(names[0]).xpos - data.site(names[1]).xpos
                length = float(np.linalg.norm(apart))
                stretching = float(apart @ moving[:3]) / length
                drift[rows] = (apart @ speeding[:3] + moving[:3] @ moving[:3] - stretching**2) / length
            else:  # its rows are those of the points, or of the links as they do not move against each other
                used = slice(None if kind == "weld" else 3)
                drift[rows] = G[rows] @ np.linalg.pinv(J[used], rcond=1e-10) @ speeding[used]
        return drift

    def _jacobians(self, site: str) -> tuple[Array, Array]:
        """Return the Jacobian (6, n) of a site's frame, its point's part first, and the Jacobian's rate."""
        mj, model, data = self.mj, self.model, self.data
        made = np.zeros((2, 6, model.nv))
        number = data.site(site).id
        mj.mj_jacSite(model, data, made[0, :3], made[0, 3:], number)
        at = np.array(data.site_xpos[number])
        mj.mj_jacDot(model, data, made[1, :3], made[1, 3:], at, int(model.site_bodyid[number]))
        return made[0], made[1]

    def _gear_drift(self, index: int, names: tuple[str, ...]) -> float:
        """Return −P″(x₂) ẋ₂² of a gear."""
        if len(names) == 1:
            return 0.0
        ratio = np.polynomial.Polynomial(self.model.eq_data[index, :5])
        if self.made[index][0] == "sums":
            second = self.data.tendon(names[1])
            x, rate = float(second.length[0]), float(second.velocity[0])
        else:
            joint = self.data.joint(names[1])
            x, rate = float(joint.qpos[0]), float(joint.qvel[0])
        return -float(ratio.deriv(2)(x)) * rate**2
