"""Exudyn: a differential-algebraic engine whose contact force is a Lagrange multiplier of its own solver.

Exudyn's own integrator on the slide: a hard constraint in a differential-algebraic system of index 3.
"""

# ruff: noqa: D102 - what a method returns is said once, in `interface.Engine`

from __future__ import annotations

import time as clock
from importlib import import_module
from types import MappingProxyType
from typing import Any

import numpy as np

from closedloop import Problem
from validation.engines.interface import METHODS, CannotBuild, Engine, Robot
from validation.engines.trajectories import Trajectory, law
from validation.oracle import UnsupportedModel, read_urdf
from validation.oracle.spatial import Array, about_centre, axes_about
from validation.oracle.tree import GROUND, Tree

SOLVED = 1e-9
"""Largest relative residual of the equations of motion that counts as solved: rounding over the pivots of a
system that is not singular leaves 1e-12; what Exudyn leaves when it gave up is of order one."""


class Exudyn(Engine):
    """Exudyn's `ObjectKinematicTree` with a `JointGeneric` that locks the tip along n, and nothing else.

    The tree comes from the oracle's URDF reader (Exudyn's own loses the order of joints); all mechanics is
    Exudyn's. Joint order: the robot's own. Frames: a link's frame is turned so that its joint axis is z, as Exudyn
    knows joints about x, y and z; inertias about the centre of mass. Armature: an `ObjectGenericODE2` with a
    diagonal mass matrix on the tree's node. Gravity: a parameter of the tree. Torques: `jointForceVector`.

    Constraint: a multiplier, hard. The solver's initial accelerations solve
    [[H, Aᵀ], [A, 0]] [q̈; λ] = [Q − C; b₀]; sign: f = −λ. b₀ is −nᵀJ̇ᵣq̇ as a *difference quotient* of the
    velocity-level closure, good to 1e-7 relative. For the b that is asked for, the torque is shifted by −H w with
    A w = b − A q̈₀, and w is added to the answer: as Eq. 24 is linear, that is its solution for b exactly, and the
    quotient, the same in both solves, drops out. H and A in this are Exudyn's.

    Traps. Where the system is singular `InitializeSolver` succeeds, prints a warning and leaves *zero*
    accelerations: the residual is checked here. A prescribed offset of a joint enters the initial accelerations
    wrongly, so an accelerating plane cannot be had that way. Multipliers come as six numbers, inactive axes
    included. The solver prints and writes files unless told otherwise.

    Accuracy: rounding, times the condition number of the bordered matrix.
    """

    name = "exudyn"
    package = "exudyn"
    install = 'pip install "exudyn>=1.13"'
    covers = frozenset(METHODS) - {"stabilised", "drift", "impulse"}
    cannot = MappingProxyType({
        "stabilised": "it holds constraints at position level in every step, by Newton, and needs no stabiliser",
        "drift": "it has J̇ᵣq̇ as a difference quotient only, good to 1e-7 and undefined where A = 0",
        "impulse": "joints know no impact; motions are smooth between steps",
    })  # fmt: skip

    def __init__(self, robot: Robot, tip: str) -> None:
        super().__init__(robot, tip)
        try:
            self.tree = read_urdf(robot)
        except UnsupportedModel as error:
            raise CannotBuild(str(error)) from error
        self.tip = tip
        if self.tree.frame(tip).body == GROUND:
            raise CannotBuild(f"the tip {tip!r} does not move")

    def mass_matrix(self, q: Array) -> Array:
        return self._solver(q).mass_matrix()

    def bias(self, q: Array, v: Array) -> Array:
        solver = self._solver(q, v)
        solver.solver.ComputeODE2RHS(solver.system)
        return -np.array(solver.solver.GetSystemResidual())[: self.n]

    def gravity_term(self, q: Array) -> Array:
        return self.bias(q, np.zeros(self.n))

    def position(self, q: Array) -> Array:
        made = self._solver(q)
        kind = made.exudyn.OutputVariableType.Position
        return np.array(made.system.GetMarkerOutput(made.marker, kind, made.exudyn.ConfigurationType.Current))

    def jacobian(self, q: Array) -> Array:
        return self._solver(q, locks=np.eye(3)).jacobian()

    def free_acceleration(self, q: Array, v: Array, torque: Array) -> Array:
        return self._solver(q, v, torque).acceleration()

    def constrained(self, q: Array, v: Array, torque: Array, normal: Array, b: float) -> tuple[Array, float]:
        made = self._solver(q, v, torque, np.asarray(normal)[None, :])
        A = made.jacobian()[0]
        shift = A * ((b - float(A @ made.acceleration())) / float(A @ A))
        again = self._solver(q, v, torque - made.mass_matrix() @ shift, np.asarray(normal)[None, :])
        return again.acceleration() + shift, again.force()

    def _solver(
        self, q: Array, v: Array | None = None, torque: Array | None = None, locks: Array | None = None
    ) -> Solver:
        """Build the system at a state and let Exudyn's solver find its initial accelerations and multipliers."""
        nothing = np.zeros(self.n)
        state = np.array([q, nothing if v is None else v, nothing if torque is None else torque], dtype=float)
        if not np.all(np.isfinite(state)):
            raise ValueError("q, v and torque must be finite")
        return Solver(self.tree, self.tip, state[0], state[1], state[2], locks)


class Solver:
    """A system with its solver started: the state is set, accelerations and multipliers are known.

    q, v, torque: (n,)
    locks: (k, 3) orthonormal directions in which the tip is held where it is; None leaves it free
    """

    def __init__(self, tree: Tree, tip: str, q: Array, v: Array, torque: Array, locks: Array | None) -> None:
        exudyn: Any = import_module("exudyn")  # its stub files lack every `self`
        self.exudyn = exudyn
        self.n = tree.size
        self.count = 0 if locks is None else len(locks)
        container = exudyn.SystemContainer()
        self.container = container  # the system dies with it
        self.system: Any = container.AddSystem()
        self.object, self.marker = add_tree(self.system, tree, tip, q, v)
        self.system.SetObjectParameter(self.object, "jointForceVector", torque)
        self.joint = None if locks is None else add_lock(self.system, self.marker, np.zeros(3), locks)
        self.system.Assemble()
        self.settings = quiet_settings()
        self.solver: Any = exudyn.MainSolverImplicitSecondOrder()
        loud = exudyn.config.suppressWarnings
        exudyn.config.suppressWarnings = True  # what it would warn of is checked in `acceleration`
        self.started = bool(self.solver.InitializeSolver(self.system, self.settings))
        exudyn.config.suppressWarnings = loud

    def residual(self) -> float:
        """Return the largest entry of H q̈ − (Q − C) − Aᵀf over the largest of its parts."""
        self.solver.ComputeODE2RHS(self.system)
        forcing = np.array(self.solver.GetSystemResidual())[: self.n]
        inertial = self.mass_matrix() @ np.array(self.system.systemData.GetODE2Coordinates_tt())
        closure = np.zeros(self.n)
        if self.count:
            forces = -np.array(self.system.systemData.GetAECoordinates())[3 - self.count : 3]
            closure = self.jacobian().T @ forces
        size = np.abs(np.array([forcing, inertial, closure])).max()
        return float(np.abs(inertial - forcing - closure).max() / size) if size else 0.0

    def acceleration(self) -> Array:
        """Return q̈ (n,). Raises `numpy.linalg.LinAlgError` if the solver gave up, whatever it says itself."""
        if not self.started or self.residual() > SOLVED:
            raise np.linalg.LinAlgError("Exudyn finds no initial accelerations: the pose is singular")
        return np.array(self.system.systemData.GetODE2Coordinates_tt())

    def force(self) -> float:
        """Return the force on the robot along the first locked direction [N]."""
        return -float(self.system.systemData.GetAECoordinates()[3 - self.count])

    def mass_matrix(self) -> Array:
        """Return H (n, n)."""
        self.solver.ComputeMassMatrix(self.system, 1.0)
        return np.array(self.solver.GetSystemMassMatrix())[: self.n, : self.n]

    def jacobian(self) -> Array:
        """Return the rows of the locked directions, (k, n), from the derivative of the closure equations."""
        size = self.n + 6
        self.solver.SetSystemJacobian(np.zeros((size, size)))
        self.solver.ComputeJacobianAE(self.system, 1.0, 1.0, 0.0)
        rows = np.array(self.solver.GetSystemJacobian())[self.n : self.n + 3, : self.n]
        return rows[3 - self.count :]


def add_tree(system: Any, tree: Tree, tip: str, q: Array, v: Array) -> tuple[Any, Any]:
    """Add the robot at a state; return the numbers of the tree and of the marker at the tip."""
    exudyn, items = import_module("exudyn"), import_module("exudyn.itemInterface")
    n = tree.size
    node = system.AddNode(
        items.NodeGenericODE2(
            referenceCoordinates=np.zeros(n), initialCoordinates=q, initialCoordinates_t=v, numberOfODE2Coordinates=n
        )
    )
    turned = [axes_about(axis) for axis in tree.axis]
    transforms, offsets, masses, centres, tensors = [], [], [], [], []
    for i, above in enumerate(tree.parent):
        back = np.eye(3) if above == GROUND else turned[above].T
        transforms.append(back @ tree.rotation[i] @ turned[i])
        offsets.append(back @ tree.translation[i])
        mass, centre, tensor = about_centre(tree.inertia[i])
        masses.append(mass)
        centres.append(turned[i].T @ centre)
        tensors.append(turned[i].T @ tensor @ turned[i])
    kinds = {"prismatic": exudyn.JointType.PrismaticZ}
    body = system.AddObject(
        items.ObjectKinematicTree(
            nodeNumber=node,
            gravity=tree.gravity,
            jointTypes=[kinds.get(kind, exudyn.JointType.RevoluteZ) for kind in tree.kinds],
            linkParents=list(tree.parent),
            jointTransformations=exudyn.Matrix3DList(transforms),
            jointOffsets=exudyn.Vector3DList(offsets),
            linkInertiasCOM=exudyn.Matrix3DList(tensors),
            linkCOMs=exudyn.Vector3DList(centres),
            linkMasses=masses,
            jointForceVector=np.zeros(n),
        )
    )
    system.AddObject(items.ObjectGenericODE2(nodeNumbers=[node], massMatrix=np.diag(tree.armature)))
    return body, add_marker(system, body, tree, tip)


def add_marker(system: Any, body: Any, tree: Tree, link: str, pose: Array | None = None) -> Any:
    """Add a marker at a pose (4, 4) in the frame of a moving link, by default that frame itself."""
    items, frame = import_module("exudyn.itemInterface"), tree.frame(link)
    place = np.eye(4)
    turned = axes_about(tree.axis[frame.body]).T
    place[:3, :3], place[:3, 3] = turned @ frame.rotation, turned @ frame.translation
    place = place @ pose if pose is not None else place
    return system.AddMarker(items.MarkerKinematicTreeRigid(objectNumber=body, linkNumber=frame.body, localHT=place))


def add_lock(system: Any, marker: Any, point: Array, locks: Array) -> Any:
    """Hold the tip level with `point` (3,) [m] along the orthonormal rows of `locks` (k, 3)."""
    items = import_module("exudyn.itemInterface")
    ground = system.AddObject(items.ObjectGround())
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = complete(locks), point
    return system.AddObject(
        items.ObjectJointGeneric(
            markerNumbers=[system.AddMarker(items.MarkerBodyRigid(bodyNumber=ground, localHT=pose)), marker],
            constrainedAxes=[int(i >= 3 - len(locks)) for i in range(3)] + [0, 0, 0],
        )
    )


def quiet_settings() -> Any:
    """Return solver settings that print and write nothing."""
    settings = import_module("exudyn").SimulationSettings()
    settings.timeIntegration.verboseMode = 0
    settings.solution.file.write = False
    return settings


def complete(locks: Array) -> Array:
    """Return a rotation (3, 3) whose last columns are the k orthonormal rows of `locks`."""
    if len(locks) == 3:
        return np.array(locks).T
    if len(locks) == 2:
        return np.stack([np.cross(locks[0], locks[1]), *locks], axis=1)
    return axes_about(locks[0])


def slide_exudyn(of: Problem, *, contact: bool = True) -> Trajectory:
    """Slide with Exudyn's generalized-α scheme, spectral radius 0.9: implicit, second order, in f too.

    The closure holds at the level of positions at every step, n·r = d, and f is minus its multiplier. There is no
    stabiliser, as none is needed: this is the motion that every stabilised scheme tends to as h → 0. The law is
    evaluated inside Newton's iteration, at the end of the step, with C and A of a second Exudyn system that is
    held at the same state: nothing of Pinocchio or of the simulator takes part but the reference q_des(t).

    The reference may not jump inside the run: at a jump an implicit step would use the later value from the step's
    beginning on, an error of first order.

    Index 3 magnifies the rounding of positions by 1/h²: f has a floor of 4e-6 N at 0.25 ms and of 2e-5 N at 0.125 ms.
    """
    tree, tip, n, lock = read_urdf(of.robot.model), of.robot.tip, len(of.q), of.plane.normal[None, :]
    exudyn: Any = import_module("exudyn")
    container, place, now = (
        exudyn.SystemContainer(),
        exudyn.OutputVariableType.Position,
        exudyn.ConfigurationType.Current,
    )
    system = container.AddSystem()
    body, marker = add_tree(system, tree, tip, of.q, of.v)
    if contact:
        add_lock(system, marker, of.plane.normal * of.plane.offset, lock)
    terms = Solver(tree, tip, of.q, of.v, np.zeros(n), lock)

    def torque(_system: Any, t: float, _item: Any, q: Any, v: Any) -> Array:
        state = np.array(q), np.array(v)
        bias, A = _bias_and_row(terms, *state)
        return law(of, round(t / of.h), *state, bias, A)

    system.SetObjectParameter(body, "forceUserFunction", torque)
    system.Assemble()
    rows: dict[int, list[float]] = {}

    def store(its_system: Any, t: float) -> bool:
        data = its_system.systemData
        f = -data.GetAECoordinates()[2] if contact else 0.0
        tip_now = its_system.GetMarkerOutput(marker, place, now)
        e = float(of.plane.normal @ np.array(tip_now)) - of.plane.offset
        rows[round(t / of.h)] = [*data.GetODE2Coordinates(), *data.GetODE2Coordinates_t(), f, e]
        return True

    settings = quiet_settings()
    time = settings.timeIntegration
    time.numberOfSteps, time.endTime, time.adaptiveStep = of.steps, of.steps * of.h, False
    time.generalizedAlpha.spectralRadius = 0.9
    time.newton.relativeTolerance, time.newton.absoluteTolerance = 1e-10, 1e-12
    system.SetPostStepUserFunction(store)
    solver = exudyn.MainSolverImplicitSecondOrder()
    began = clock.perf_counter()
    if not (solver.InitializeSolver(system, settings) and store(system, 0.0) and solver.SolveSteps(system, settings)):
        raise RuntimeError("Exudyn's Newton iteration did not converge")
    solver.FinalizeSolver(system, settings)
    seconds = clock.perf_counter() - began
    table = np.array([rows[k] for k in range(of.steps + 1)])
    return Trajectory(
        "exudyn", np.arange(of.steps + 1) * of.h, table[:, :n], table[:, n : 2 * n], table[:, 2 * n],
        table[:, 2 * n + 1], of.h, seconds=seconds,
    )  # fmt: skip


def _bias_and_row(terms: Solver, q: Array, v: Array) -> tuple[Array, Array]:
    """Return C (n,) and A = nᵀJᵣ (n,) at a state, from a system of Exudyn's that bears no torque."""
    data = terms.system.systemData
    data.SetODE2Coordinates(q)
    data.SetODE2Coordinates_t(v)
    terms.solver.ComputeODE2RHS(terms.system)
    return -np.array(terms.solver.GetSystemResidual())[: len(q)], terms.jacobian()[0]
