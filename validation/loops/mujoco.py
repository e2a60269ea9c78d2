"""MuJoCo with the loops of a mechanism."""

from itertools import pairwise
from typing import Any

import numpy as np

from robot_models.loop_joint import WORLD, LoopJoint
from validation.engines.mujoco import MuJoCo, build_spec, columns, compile_spec, solve_to_rounding
from validation.loops.cases import Case, mechanism_called
from validation.loops.peers import LoopPeer, refuse_other
from validation.oracle.spatial import Array
from validation.tolerances import Tolerance


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
