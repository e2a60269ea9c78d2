"""MuJoCo: composite rigid bodies of its own, and a soft constraint whose hard limit is extrapolated.

MuJoCo driven step by step with the law of the paper, at decreasing softness.
"""

# ruff: noqa: D102 - what a method returns is said once, in `interface.Engine`

import time as clock
from types import MappingProxyType
from typing import Any

import numpy as np

from closedloop import Problem
from robot_models.coordinates import PARTS, PLACES, RATES, coordinate_names, with_quaternions
from validation.engines import interface
from validation.engines.interface import METHODS, CannotBuild, Engine, Robot
from validation.engines.trajectories import Trajectory, law
from validation.oracle.spatial import Array

TIP, FAR, ROD = "validation/tip", "validation/far", "validation/rod"
STIFF, SOFT = 0.9, 0.5
"""Impedances d of the two solves that are extrapolated; R = (1 − d)/d times AH⁻¹Aᵀ. As the extrapolation is exact,
they need not be hard: at MuJoCo's hardest, 0.9999, f is what is left of b − A q̈ over R, and loses four digits."""


class MuJoCo(Engine):
    """MuJoCo 3.17, double precision, with everything switched off that is not rigid-body mechanics.

    Joint order: depth first in the order of the text; mapped by name. Frames: world axes; the tip is a site.
    Armature: `joint.armature`, on the diagonal of H. Gravity: `option.gravity`, inside `qfrc_bias`.
    Locked joints are deleted from the `MjSpec` and their motion put into the body's pose.

    `constrained`: a tendon, straight from a still point one metre below the tip (along −n) to the tip, is held by
    an equality constraint. Its length has the gradient nᵀJᵣ exactly, and it pulls as well as it pushes, which a
    contact does not. MuJoCo solves A q̈ + R f = a_ref; a_ref is set to b, so f(R) = F/(s + R) with
    s = AH⁻¹Aᵀ, and two softnesses give the hard limit R = 0 in closed form, not as an approximation. Sign:
    `efc_force` is the force along growing length, hence f.

    Traps. The scale of R is AH⁻¹Aᵀ *at the model's zero pose* (`tendon_invweight0`), which may be singular, and R
    then 1e-15: here it is set to that of the state. MuJoCo's own a_ref = −b ė − k e leaves J̇ᵣq̇ out. d is clamped
    to 0.9999, so the constraint is never hard; a row that is zero is not made at all. `qfrc_bias` excludes damping,
    `qacc` does not: URDF ``dynamics`` are removed. The root link is welded to the world, and without
    `fusestatic="false"` massless fixed links, the tip among them, disappear. Islands keep a second copy of the
    constraint's arrays: switched off. A state that is not a number resets the data to zero with a warning only:
    inputs are checked here.

    Accuracy: inertias are diagonalised on reading, a rounding of 1e-15 relative; then rounding times the
    condition number of H. The Newton solver is exact after one step on a problem that is quadratic.
    """

    name = "mujoco"
    turns_freely = True
    package = "mujoco"
    install = 'pip install "mujoco>=3.17,!=4.0.0"'
    covers = frozenset(METHODS) - {"stabilised", "impulse"}
    cannot = MappingProxyType({
        "stabilised": "its reference acceleration is that of a soft constraint and leaves J̇ᵣq̇ out",
        "impulse": "restitution is a side effect of damping and softness there; there is no impact law",
    })  # fmt: skip

    def __init__(self, robot: Robot, tip: str) -> None:
        super().__init__(robot, tip)
        import mujoco

        self.mj: Any = mujoco
        spec = build_spec(robot, tip)
        far = spec.worldbody.add_body(name=FAR, mocap=True)
        far.add_site(name=FAR)
        rod = spec.add_tendon(name=ROD)
        rod.wrap_site(FAR)
        rod.wrap_site(TIP)
        hold = spec.add_equality(type=mujoco.mjtEq.mjEQ_TENDON, name1=ROD, objtype=mujoco.mjtObj.mjOBJ_TENDON)
        hold.data[1] = 1.0
        spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
        solve_to_rounding(spec)
        self.model = compile_spec(spec)
        self.columns = columns(self.model, robot)
        self.types = tuple(getattr(robot, "joint_types", ()))
        known = {name: at for i in range(self.model.njnt) for name, at in _positions(self.model, i)}
        self.places = [known[name] for name in coordinate_names(robot.joint_names, self.types)]
        self.data = mujoco.MjData(self.model)
        self.site = self.model.site(TIP).id
        self.body = int(self.model.site_bodyid[self.site])

    def _set(self, q: Array, v: Array | None = None, *, held: bool = False) -> None:
        """Put the state in and evaluate everything that depends on it alone."""
        _require_finite(q, v)
        self.data.qpos[self.places] = with_quaternions(np.asarray(q), self.types)
        self.data.qvel[self.columns] = 0.0 if v is None else v
        self.data.eq_active[0] = held
        self.mj.mj_fwdPosition(self.model, self.data)
        self.mj.mj_fwdVelocity(self.model, self.data)

    def mass_matrix(self, q: Array) -> Array:
        self._set(q)
        return np.asarray(full_mass_matrix(self.model, self.data)[np.ix_(self.columns, self.columns)])

    def bias(self, q: Array, v: Array) -> Array:
        self._set(q, v)
        return np.array(self.data.qfrc_bias[self.columns])

    def gravity_term(self, q: Array) -> Array:
        return self.bias(q, np.zeros(self.n))

    def position(self, q: Array) -> Array:
        self._set(q)
        return np.array(self.data.site_xpos[self.site])

    def jacobian(self, q: Array) -> Array:
        self._set(q)
        return np.asarray(tip_jacobian(self.model, self.data, self.site)[:, self.columns])

    def drift(self, q: Array, v: Array) -> Array:
        self._set(q, v)
        return tip_drift(self.model, self.data, self.site)

    def free_acceleration(self, q: Array, v: Array, torque: Array) -> Array:
        self._set(q, v)
        return self._solve(torque)

    def constrained(self, q: Array, v: Array, torque: Array, normal: Array, b: float) -> tuple[Array, float]:
        stiff, soft = (self.softly(q, v, torque, normal, b, d) for d in (STIFF, SOFT))
        return hard_limit(*stiff, *soft)

    def softly(
        self, q: Array, v: Array, torque: Array, normal: Array, b: float, impedance: float, *, held: bool = True
    ) -> tuple[Array, float, float]:
        """Return q̈ (n,), f [N] and the softness R [1/kg] of A q̈ + R f = b as MuJoCo itself solves it.

        impedance: d of `solimp`, at most 0.9999
        """
        self.model.eq_solimp[0, :2] = impedance
        self._set(q)
        self.data.mocap_pos[0] = self.data.site_xpos[self.site] - normal
        row = (normal @ tip_jacobian(self.model, self.data, self.site))[None, :]
        back = np.zeros_like(row)
        self.mj.mj_solveM(self.model, self.data, back, row)
        self.model.tendon_invweight0[0] = (row @ back.T).item()
        self._set(q, v, held=held)
        if held and self.data.nefc == 0:
            raise np.linalg.LinAlgError("MuJoCo makes no row where A = 0: the pose is singular")
        if self.data.nefc != int(held):
            raise RuntimeError(f"MuJoCo made {self.data.nefc} constraint rows where {int(held)} is meant")
        if held:
            self.data.efc_aref[0] = b
        a = self._solve(torque)
        return (a, float(self.data.efc_force[0]), float(self.data.efc_R[0])) if held else (a, 0.0, 0.0)

    def _solve(self, torque: Array) -> Array:
        self.data.qfrc_applied[self.columns] = torque
        self.mj.mj_fwdActuation(self.model, self.data)
        self.mj.mj_fwdAcceleration(self.model, self.data)
        self.mj.mj_fwdConstraint(self.model, self.data)
        return np.array(self.data.qacc[self.columns])


def hard_limit(a_1: Array, f_1: float, R_1: float, a_2: Array, f_2: float, R_2: float) -> tuple[Array, float]:
    """Return q̈ and f at R = 0 from two softnesses: f = F/(s + R), and q̈ is a straight line in f."""
    if f_1 == f_2:  # nothing presses, at any softness
        return a_1, f_1
    f = f_1 * f_2 * (R_2 - R_1) / (f_2 * R_2 - f_1 * R_1)
    return a_1 + (a_2 - a_1) * ((f - f_1) / (f_2 - f_1)), f


def build_spec(robot: Robot, tip: str) -> Any:
    """Return the robot as an `MjSpec` with a site `TIP`, rigid bodies only, its inertias as the text has them."""
    import mujoco

    if mujoco.__version__ == "4.0.0":
        raise CannotBuild("MuJoCo 4.0.0 is refused: its sparse solver returns wrong accelerations")
    if robot.format == "urdf":
        interface.refuse_balls(robot, "mujoco, for a URDF,")
    text = interface.bare_urdf(robot.text) if robot.format == "urdf" else robot.text
    try:
        spec = mujoco.MjSpec.from_string(text)
        compiler = spec.compiler
        compiler.fusestatic = compiler.balanceinertia = compiler.discardvisual = False
        compiler.boundmass = compiler.boundinertia = 0.0
        if robot.locked:
            _weld(spec, compile_spec(spec), robot)
        for joint, armature in zip(robot.joint_names, robot.armature, strict=True):
            found = spec.joint(joint) or next(
                (spec.joint(joint.removesuffix(end)) for end in (*PLACES, *RATES) if joint.endswith(end)), None
            )
            if found is None:
                raise CannotBuild(f"MuJoCo reads no joint {joint!r}")
            found.armature = armature
    except ValueError as error:
        if isinstance(error, CannotBuild):
            raise
        raise CannotBuild(f"MuJoCo refuses it: {error}") from error
    body, site = spec.body(tip), spec.site(tip)
    if body is not None:
        body.add_site(name=TIP)
    elif site is not None:
        site.name = TIP
    else:
        raise CannotBuild(f"MuJoCo has no body or site {tip!r}")
    spec.option.gravity = np.array(robot.gravity)
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    disable(spec, "LIMIT", "FRICTIONLOSS", "SPRING", "DAMPER")
    if robot.format == "urdf":
        _require_masses(compile_spec(spec), robot)
    return spec


def solve_to_rounding(spec: Any) -> None:
    """Let the constraint solver go on to rounding, from no earlier solution: accurate, and slow."""
    import mujoco

    option = spec.option
    option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    option.solver, option.tolerance, option.iterations = mujoco.mjtSolver.mjSOL_NEWTON, 0.0, 20
    disable(spec, "REFSAFE", "EULERDAMP", "WARMSTART", "ISLAND", "AUTORESET")


def disable(spec: Any, *flags: str) -> None:
    """Switch parts of MuJoCo's step off, each an ``mjDSBL_`` flag."""
    import mujoco

    for flag in flags:
        spec.option.disableflags |= int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{flag}"))


def compile_spec(spec: Any) -> Any:
    """Compile, with MuJoCo's own message if it refuses."""
    try:
        return spec.compile()
    except ValueError as error:
        raise CannotBuild(f"MuJoCo refuses it: {str(error).strip().splitlines()[0]}") from error


def _positions(model: Any, joint: int) -> list[tuple[str, int]]:
    """Return names and places of the positions of a joint."""
    kinds = {0: (*PLACES, *PARTS), 1: PARTS}  # mjJNT_FREE, mjJNT_BALL
    name, at = str(model.joint(joint).name), int(model.jnt_qposadr[joint])
    return [(name + end, at + k) for k, end in enumerate(kinds.get(int(model.jnt_type[joint]), ("",)))]


def columns(model: Any, robot: Robot) -> Array:
    """Return the dof of each joint of the robot."""
    names = {model.joint(i).name: int(model.jnt_dofadr[i]) for i in range(model.njnt)}
    return interface.columns_of(names, robot, "mujoco")


def full_mass_matrix(model: Any, data: Any) -> Array:
    """Return H (n, n) from MuJoCo's sparse storage."""
    import mujoco

    out = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, out)
    return out


def tip_jacobian(model: Any, data: Any, site: int) -> Array:
    """Return Jᵣ (3, nv), MuJoCo's columns."""
    import mujoco

    out = np.zeros((3, model.nv))
    mujoco.mj_jacSite(model, data, out, None, site)
    return out


def tip_drift(model: Any, data: Any, site: int) -> Array:
    """Return J̇ᵣq̇ (3,) from MuJoCo's J̇ᵣ."""
    import mujoco

    out = np.zeros((3, model.nv))
    mujoco.mj_jacDot(model, data, out, None, data.site_xpos[site], int(model.site_bodyid[site]))
    return np.asarray(out @ data.qvel)


def _weld(spec: Any, model: Any, robot: Robot) -> None:
    """Replace each locked joint by the pose that it gives its body."""
    import mujoco

    for name, value in robot.locked.items():
        joint = model.joint(name)
        body = model.body(int(model.jnt_bodyid[joint.id]))
        turn, axis = np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(3)
        if model.jnt_type[joint.id] == mujoco.mjtJoint.mjJNT_HINGE:
            mujoco.mju_axisAngle2Quat(turn, joint.axis, value)
            anchor = np.zeros(3)
            mujoco.mju_rotVecQuat(anchor, joint.pos, turn)
            axis = joint.pos - anchor
        else:
            axis = joint.axis * value
        shift, quat = np.zeros(3), np.zeros(4)
        mujoco.mju_rotVecQuat(shift, axis, body.quat)
        mujoco.mju_mulQuat(quat, body.quat, turn)
        target = spec.body(body.name)
        target.pos, target.quat = body.pos + shift, quat
        target.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
        spec.delete(spec.joint(name))


def _require_masses(model: Any, robot: Robot) -> None:
    """Refuse a model from which the reader has dropped, fused or balanced mass away."""
    wanted, root = interface.masses(robot.text), interface.root_link(robot.text)
    for link, mass in wanted.items():
        if link != root and not np.isclose(model.body(link).mass[0], mass, rtol=1e-15, atol=0.0):
            raise CannotBuild(f"MuJoCo gives link {link!r} {model.body(link).mass[0]} kg, the text {mass} kg")


def _require_finite(q: Array, v: Array | None) -> None:
    if not (np.all(np.isfinite(q)) and (v is None or np.all(np.isfinite(v)))):
        raise ValueError("q and v must be finite: MuJoCo would reset the state instead of complaining")


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
