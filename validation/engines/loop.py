"""This project's own loop, seen as one engine among the others.

The package's own compiled engine, `closedloop.mechanics.robot.tree` inside `closedloop.simulation.engines.loops`,
as one engine among others.

The terms are asked of `closedloop.mechanics.robot.tree` alone; q̈ and f of Eq. 24 are read from a row that the compiled
loop itself recorded, so that what is judged is the loop that runs, and not its parts put together anew.
"""

# ruff: noqa: D102 - what a method returns is said once, in `interface.Engine`

from types import SimpleNamespace

import numpy as np

import robot_models
from closedloop.base.errors import ModelError
from closedloop.jit.calls import address_of, entry_address
from closedloop.jit.interpreted import interpreted
from closedloop.jit.kernel import entry_kernel
from closedloop.loop.events.locate import DONE
from closedloop.loop.events.table import EVENT_WIDTH
from closedloop.loop.step.memory import make_loop
from closedloop.loop.step.record_row import Row
from closedloop.mechanics.closure.contact_force import (
    FREE,
    PRESSED,
    accelerate,
    baumgarte_acceleration,
    factorise,
    free_acceleration,
    into_contact_frame,
    pressed_force,
)
from closedloop.mechanics.closure.solve import OK, solve_closure
from closedloop.mechanics.integrators import INTEGRATORS
from closedloop.mechanics.robot.pinocchio import Robot as LoopRobot
from closedloop.mechanics.robot.pinocchio import Terms
from closedloop.mechanics.robot.tree import Tree, tree_of, tree_terms, work_size
from closedloop.mechanics.surface.placed import contact_frame
from closedloop.simulation.engines.loops import addresses_of, compiled_terms, compiled_work, proceed_at, run_compiled
from robot_models import RobotModel
from validation.engines.interface import METHODS, CannotBuild, Engine, Robot
from validation.oracle.spatial import Array


class ClosedLoop(Engine):
    """The simulator under test: `closedloop.Robot.terms`, and Eq. 24 through the kernels of its step.

    Joint order: Pinocchio's, mapped by name (the two differ only for a robot that was not loaded by
    `robot_models`). Frames: tip Jacobian along base axes. Armature: `RobotModel.armature`, inside H. Gravity:
    −9.81 along z unless the robot says otherwise, inside C. Sign of f: positive along +n on the robot.
    Constraint: one row A = nᵀJᵣ, Cholesky of H and the Schur complement A H⁻¹Aᵀ, exactly the step's arithmetic;
    `impulse` takes the dense `solve_closure`. Accuracy: rounding, times the condition number of H in q̈ and f.
    """

    name = "closedloop"
    turns_freely = True
    covers = frozenset(METHODS)

    def __init__(self, robot: Robot, tip: str) -> None:
        super().__init__(robot, tip)
        self.robot = LoopRobot(as_robot_model(robot, tip), tip)
        order = {joint: i for i, joint in enumerate(self.robot.joint_names)}
        self._columns = np.array([order[joint] for joint in robot.joint_names])  # robot's order → the loop's

    def _in(self, x: Array) -> Array:
        out = np.empty(self.n)
        out[self._columns] = x
        return out

    def mass_matrix(self, q: Array) -> Array:
        return np.asarray(
            self.robot.terms(self._in(q), np.zeros(self.n)).mass_matrix[np.ix_(self._columns, self._columns)]
        )

    def bias(self, q: Array, v: Array) -> Array:
        return np.asarray(self.robot.terms(self._in(q), self._in(v)).bias[self._columns])

    def gravity_term(self, q: Array) -> Array:
        return self.bias(q, np.zeros(self.n))

    def position(self, q: Array) -> Array:
        return self.robot.position(self._in(q))

    def jacobian(self, q: Array) -> Array:
        return np.asarray(self.robot.terms(self._in(q), np.zeros(self.n)).jacobian[:, self._columns])

    def drift(self, q: Array, v: Array) -> Array:
        return self.robot.terms(self._in(q), self._in(v)).drift

    def free_acceleration(self, q: Array, v: Array, torque: Array) -> Array:
        terms = self.robot.terms(self._in(q), self._in(v))
        return np.asarray(np.linalg.solve(terms.mass_matrix, self._in(torque) - terms.bias)[self._columns])

    def constrained(self, q: Array, v: Array, torque: Array, normal: Array, b: float) -> tuple[Array, float]:
        terms, n, ends = self.robot.terms(self._in(q), self._in(v)), self.n, self.robot.tree.ends
        L, X, S, y, a, F, qdd = (np.empty(k) for k in ((n, n), (3, n), (3, 3), n, 3, 3, n))
        A = contact_frame(normal) @ terms.jacobian
        status = factorise(np.array(terms.mass_matrix), A, L, X, S, 0.0, ends)
        if status == OK:
            # The closure asks A q̈ = b, whatever the drift: the kernel is told that the drift is −b.
            free_acceleration(L, X, np.array([-b, 0.0, 0.0]), self._in(torque), np.array(terms.bias), y, a, ends)
            status, _ = pressed_force(S, a, 0.0, np.zeros(2), np.zeros(2), F)
        if status != OK:
            raise np.linalg.LinAlgError("the pose is singular: the tip cannot move along the normal")
        accelerate(L, X, y, F, qdd, ends)
        return qdd[self._columns], float(F[0])

    def stabilised(self, q: Array, v: Array, normal: Array, offset: float, gains: Array) -> float:
        terms, before = self.robot.terms(self._in(q), self._in(v)), self._in(v)
        A, (p, u, drift) = np.empty((3, self.n)), np.empty((3, 3))
        J, r, moving = (np.array(x) for x in (terms.jacobian, terms.position, terms.drift))
        tip = SimpleNamespace(
            frame=contact_frame(normal), J=J, r=r, drift=moving, v=before, A=A, p=p, u=u, drift_c=drift
        )
        interpreted(into_contact_frame)(tip, tip)
        return float(-drift[0] + baumgarte_acceleration(gains[0], gains[1], u[0], p[0] - offset))

    def impulse(self, q: Array, v: Array, normal: Array, restitution: float) -> tuple[Array, float]:
        terms, before = self.robot.terms(self._in(q), self._in(v)), self._in(v)
        A = np.asarray(normal) @ terms.jacobian
        after, p = solve_closure(terms.mass_matrix, terms.mass_matrix @ before, A, -restitution * float(A @ before))
        return after[self._columns], float(p)


def as_robot_model(robot: Robot, tip: str) -> robot_models.RobotModel:
    """Return the robot as the simulator's own kind, joints in the order that the simulator gives them."""
    if isinstance(robot, robot_models.RobotModel):
        return robot
    if robot.format not in ("urdf", "mjcf"):
        raise CannotBuild(f"its description is {robot.format!r}, neither URDF nor MJCF")
    n = len(robot.joint_names)

    def build(armature: Array) -> robot_models.RobotModel:
        return robot_models.from_text(
            robot.text, "urdf" if robot.format == "urdf" else "mjcf", name="peer", armature=armature, tip=tip,
            home=np.zeros(n), locked=robot.locked, gravity=robot.gravity,
        )  # fmt: skip

    of = dict(zip(robot.joint_names, np.asarray(robot.armature), strict=True))
    # The order of the columns is known once it is built.
    return build(np.array([of[joint] for joint in build(np.asarray(robot.armature)).joint_names]))


class Compiled(ClosedLoop):
    """The terms of `closedloop.mechanics.robot.tree`, and Eq. 24 as `run_compiled` solves it.

    Joint order: Pinocchio's, mapped by name. Frames: tip Jacobian along base axes. Armature: `RobotModel.armature`,
    inside H. Gravity: the robot's, inside C. Sign of f: positive along +n on the robot. Constraint: the loop is given
    a plane, a state and a torque, and records one row; b of the closure comes in through the plane's offset, as
    b = −nᵀJ̇ᵣq̇ − s_p e with s_p = 1/s². The impulse and b_s are `closedloop`'s arithmetic on these terms. It shares
    with `closedloop` everything but the terms. Not covered: joints other than revolute, continuous and prismatic ones.
    Accuracy: rounding, times the condition number of H in q̈ and f.
    """

    name = "compiled"
    covers = frozenset(METHODS)

    def __init__(self, robot: Robot, tip: str) -> None:
        model = as_robot_model(robot, tip)
        try:
            self.tree = tree_of(model, tip)
        except ModelError as error:
            raise CannotBuild(str(error)) from None
        super().__init__(model, tip)
        order = {joint: i for i, joint in enumerate(model.joint_names)}
        self._columns = np.array([order[joint] for joint in robot.joint_names])
        self.robot = OwnTerms(self, model, tip)  # type: ignore[assignment]  # what is asked for

    def free_acceleration(self, q: Array, v: Array, torque: Array) -> Array:
        row = self._record(q, v, torque, np.array([0.0, 0.0, 1.0]), None)
        return np.asarray(row[2 * self.n : 3 * self.n][self._columns])

    def constrained(self, q: Array, v: Array, torque: Array, normal: Array, b: float) -> tuple[Array, float]:
        row = self._record(q, v, torque, normal, b)
        return row[2 * self.n : 3 * self.n][self._columns], float(row[Row.place("contact_force", self.n)])

    def _record(self, q: Array, v: Array, torque: Array, normal: Array, b: float | None) -> Array:
        """Return the row that the loop records at a state under a given torque; b None: the tip is free."""
        n, scheme = self.n, INTEGRATORS["semi_implicit_euler"]
        terms = self.robot.terms(self._in(q), self._in(v))
        loop = make_loop(n, stages=scheme.stages, ends=self.tree.ends)
        state, constants, w = loop
        constants.h = constants.node = 1e-3
        w.tip.frame[:] = contact_frame(normal)
        state.sampled, state.cleared = 0, 1  # the torque is given
        state.settings.nodes_per_step, state.settings.semi_implicit = 1, 1
        state.mode = FREE
        if b is not None:
            state.mode, constants.s_p = PRESSED, 1.0
            constants.offset = float(normal @ terms.position + b + normal @ terms.drift)
        w.q[:], w.v[:], w.torque[:] = self._in(q), self._in(v), self._in(torque)
        table, rows, events = np.zeros((1, 2 * n + 11)), np.zeros((1, Row.count(n))), np.zeros((1, EVENT_WIDTH))
        H, C, scratch = compiled_terms(compiled_work(n), n)
        addresses = addresses_of((H, C), loop, table, scheme.tableau(), rows, events)
        state.proceed = entry_address(proceed_at)
        request = run_compiled(self.tree, scratch, address_of(addresses.memory), 1)
        if request != DONE:
            raise np.linalg.LinAlgError("the pose is singular: the tip cannot move along the normal")
        return np.asarray(rows[0])


class OwnTerms:
    """Terms from `closedloop.mechanics.robot.tree`, behind what of `closedloop.Robot` an engine asks for."""

    def __init__(self, engine: Compiled, model: RobotModel, tip: str) -> None:
        self.tree, self.n = engine.tree, len(model.joint_names)
        self.joint_names, self.tip = model.joint_names, tip
        self._work = np.zeros(work_size(self.n))

    def terms(self, q: Array, v: Array) -> Terms:
        if not (np.all(np.isfinite(q)) and np.all(np.isfinite(v))):
            raise ValueError("q and v must be finite")
        n = self.n
        H, C, J, r, drift = (np.full(shape, np.nan) for shape in ((n, n), (n,), (3, n), (3,), (3,)))
        _terms(self.tree, q, v, self._work, H, C, (J, r, drift))
        return Terms(np.triu(H) + np.triu(H, 1).T, C, r, J, drift)

    def position(self, q: Array) -> Array:
        return self.terms(q, np.zeros(self.n)).position


@entry_kernel
def _terms(tree: Tree, q: Array, v: Array, work: Array, H: Array, C: Array, of_tip: tuple[Array, Array, Array]) -> None:
    """Do `tree_terms`, compiled once for all processes."""
    tree_terms(tree, q, v, work, H, C, of_tip)
