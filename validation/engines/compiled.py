# ruff: noqa: D102 - what a method returns is said once, in `interface.Engine`
"""The package's own compiled engine, `closedloop.mechanics.robot.tree` inside `closedloop.simulation.engines.compiled`,
as one engine among others.

The terms are asked of `closedloop.mechanics.robot.tree` alone; q̈ and f of Eq. 24 are read from a row that the compiled
loop itself recorded, so that what is judged is the loop that runs, and not its parts put together anew.
"""

import numpy as np

from closedloop.base.errors import ModelError
from closedloop.jit.calls import address_of, entry_address
from closedloop.jit.kernel import entry_kernel
from closedloop.loop.events.locate import DONE
from closedloop.loop.events.table import EVENT_WIDTH
from closedloop.loop.step.memory import make_loop
from closedloop.loop.step.record_row import Row
from closedloop.mechanics.closure.contact_force import FREE, PRESSED
from closedloop.mechanics.integrators import INTEGRATORS
from closedloop.mechanics.robot.pinocchio import Terms
from closedloop.mechanics.robot.tree import Tree, tree_of, tree_terms, work_size
from closedloop.mechanics.surface.placed import contact_frame
from closedloop.simulation.engines.compiled import compiled_terms, compiled_work, run_compiled
from closedloop.simulation.engines.proceed import addresses_of, proceed_at
from robot_models import RobotModel
from validation.engines.interface import METHODS, CannotBuild, Robot
from validation.engines.loop import ClosedLoop, as_robot_model
from validation.oracle.spatial import Array


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
