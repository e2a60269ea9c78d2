"""The interface to Pinocchio: the only file that calls it for a robot's mechanics."""

import math
from collections.abc import Callable, Iterable
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

from closedloop.base.arguments import arguments_checked
from closedloop.base.arrays import Array
from closedloop.base.errors import ModelError
from closedloop.jit.interpreted import interpreted
from closedloop.jit.kernel import plain
from closedloop.mechanics.robot.tree import Tree, tree_kinematics, tree_of, tree_turning, work_size
from closedloop.mechanics.robot.tree.energy import spring_energy
from closedloop.mechanics.robot.tree.model import last_velocity
from robot_models import RobotModel
from robot_models.cached import cached_property
from robot_models.coordinates import BALL, in_pinocchios_order, with_quaternions, with_rotation_vectors
from robot_models.loop_joint import WORLD
from robot_models.model import carried_by
from robot_models.tendon import spring_torque


class Terms(NamedTuple):
    """The terms of the equation of motion and the closure at one state (q, q̇); arrays are read-only copies.

    Attributes
    ----------
    mass_matrix : (n, n) array
        H, kg m² (kg for prismatic joints), drive inertia included (Eq. 8).
    bias : (n,) array
        C, N m: Coriolis, centrifugal and gravity terms, and those of the springs of the robot's file (Eq. 8).
    position : (3,) array
        r, tip in the base frame, m.
    jacobian : (3, n) array
        Jᵣ, tip velocity per joint velocity, base axes (Eq. 13).
    drift : (3,) array
        J̇ᵣq̇, m/s², base axes (Eq. 18).
    """

    mass_matrix: Array
    bias: Array
    position: Array
    jacobian: Array
    drift: Array


class Robot:
    """A robot model with a tip, ready to be evaluated.

    Attributes
    ----------
    reach : float
        Length of the arm stretched out, from the base frame to the tip, m; a sliding joint counts 1 m.

    Parameters
    ----------
    model : RobotModel
        From `robot_models.load`.
    tip : str, optional
        Frame whose origin touches the surface; the model's own default if left out.
    moved : tuple of MovedFrame
        Frames of loop joints that move as they are told, `closedloop.mechanics.loops.moved`.

    Raises
    ------
    ModelError
        If the robot has no such frame, or no default tip.
    """

    @arguments_checked()
    def __init__(self, model: RobotModel, tip: str | None = None, moved: tuple[Any, ...] = ()) -> None:
        self.model, self.moved = model, moved
        if not model.n:
            raise ModelError(f"{model.source or model.name}: has no joint that moves: name a robot that has one")
        name = tip if tip is not None else model.tip
        if name is None:
            raise ModelError(f"{model.name} has no default tip: name one of its frames, {', '.join(model.frames)}")
        self.tip = model.require_frame(name)
        self.joint_names = model.joint_names
        self.n = len(model.joint_names)
        self.turns_freely = bool(model.balls)
        self._pin: Any = model.pinocchio_model()
        self._data: Any = self._pin.createData()
        self._frame: int = self._pin.getFrameId(self.tip)
        self._rest = np.zeros(self.n)
        self._latest: tuple[tuple[bytes, bytes], Terms] | None = None
        self._latest_tip: tuple[bytes, tuple[Array, Array]] | None = None
        self._upper = _upper(self.n)
        self.tip_offset: Array = np.array(self._pin.frames[self._frame].placement.translation)
        self.gravity: Array = np.array(self._pin.gravity.linear)
        if ("chain", self.tip) not in model.known:
            model.known["chain", self.tip] = self._chain()
        self._carrier, self.support, length, sliding = model.known["chain", self.tip]
        self.reach: float = length + math.sqrt(self.tip_offset @ self.tip_offset) + sliding

    @cached_property
    def views(self) -> tuple[Array, ...]:
        """Views into Pinocchio's own memory: valid, and always current, as long as `_data` lives."""
        data, carrier = self._data, self._carrier
        return (
            data.M,
            data.nle,
            data.J.reshape(6, self.n),  # Pinocchio hands out the one column of a single joint as a vector
            data.oMi[carrier].rotation,
            data.oMi[carrier].translation,
            data.v[carrier].vector,
            data.a_gf[carrier].vector,
        )

    def again(self) -> "Robot":
        """Return the same robot with memory of its own."""
        return Robot(self.model, self.tip, self.moved)

    def _chain(self) -> tuple[int, Array, float, int]:
        """Return the joint that carries the tip, what moves it, (n,), and how long and of how many sliders that is."""
        carrier, support, length, sliding = self._pin.frames[self._frame].parentJoint, np.zeros(self.n), 0.0, 0
        for joint in map(int, list(self._pin.supports[carrier])[1:]):
            velocities, along = self._pin.joints[joint], self._pin.jointPlacements[joint].translation
            support[velocities.idx_v : velocities.idx_v + velocities.nv] = 1.0
            length += math.sqrt(along @ along)
            sliding += self.model.joint_types[velocities.idx_v] == "prismatic"
        return carrier, _frozen(support), length, sliding

    @cached_property
    def tree(self) -> Tree:
        """The same robot for the compiled kernels of `closedloop.mechanics.robot.tree`; its arrays are not to be
        written to.

        Raises
        ------
        ModelError
            If a joint has a type that `closedloop.mechanics.robot.tree.layout` does not have; no file gives such a
            type.
        """
        return tree_of(self.model, self.tip, self._pin)

    @property
    def passes(self) -> tuple[Any, Any, Any, Any, Any]:
        """Pinocchio's two passes over the tree, with their arguments; see `evaluator`."""
        bias = self._bias if self.model.springs.size else pin.nonLinearEffects
        return pin.crba, bias, pin.Convention.WORLD, self._pin, self._data

    def _bias(self, model: Any, data: Any, q: Array, v: Array) -> None:
        """Do as `pinocchio.nonLinearEffects`, and add the torques of springs to what it writes."""
        pin.nonLinearEffects(model, data, q, v)
        self._add_springs(q, data.nle)

    def _add_springs(self, q: Array, torque: Array) -> None:
        """Add the torques of springs at positions as Pinocchio has them to a torque (n,), N m (N)."""
        if self.turns_freely:  # no spring is on a joint that does
            single, places = self._single
            own = np.zeros(self.n)
            own[single] = q[places]
            q = own
        torque += spring_torque(self.model.springs, q)

    @property
    def _single(self) -> tuple[list[int], list[int]]:
        """The joints of one velocity, and where Pinocchio has their positions."""
        single = [j for j, kind in enumerate(self.model.joint_types) if kind != BALL]
        return single, [j + sum(ball < j for ball in self.model.balls) for j in single]

    def evaluator(self, q: Array, v: Array) -> Callable[[], None]:
        """Return a function that evaluates H, C and the motion of the tip's link into `views`.

        `q` and `v`, each (n,), as the loop has them (`robot_models.coordinates`), are read at each call, and nothing is
        checked: this is the inner loop's call. The tip's motion follows from `closedloop.mechanics.robot.tip`.
        """
        crba, bias, convention, model, data = self.passes
        q, turned = self.configuration(q)

        def evaluate() -> None:
            if turned is not None:
                turned()
            crba(model, data, q, convention)  # H, and the Jacobian of every joint
            bias(model, data, q, v)  # C: recursive Newton-Euler with q̈ = 0

        return evaluate

    def configuration(self, q: Array) -> tuple[Array, Callable[[], None] | None]:
        """Return the positions that Pinocchio is to read, and what writes them from q (n,) as the loop has it.

        Where no joint turns freely they are q itself, and nothing need be written.
        """
        if not self.turns_freely:
            return q, None
        model = self.model
        found = self.pinocchios(q)
        balls = tuple((j, j + k) for k, j in enumerate(model.balls))
        single, places = self._single

        def write() -> None:
            found[places] = q[single]
            for j, at in balls:
                x, y, z = q[j : j + 3].tolist()
                half = 0.5 * math.sqrt(x * x + y * y + z * z)
                share = 0.5 * math.sin(half) / half if half > 1e-8 else 0.5
                found[at : at + 4] = share * x, share * y, share * z, math.cos(half)

        return found, write

    def pinocchios(self, q: Array) -> Array:
        """Return positions as Pinocchio has them: q (..., nq), or (..., n) as the loop has them.

        The two differ only where a joint turns freely, see `robot_models.coordinates`.
        """
        if not self.turns_freely:
            return q
        types = self.model.joint_types
        return in_pinocchios_order(with_quaternions(q, types) if q.shape[-1] == self.n else q, types)

    def rotation_vectors(self, q: Array) -> Array:
        """Return positions (..., n) as the loop has them: q (..., nq), or (..., n) as it is."""
        if q.shape[-1] == self.n:
            return q
        return with_rotation_vectors(q, self.model.joint_types)

    def terms(self, q: ArrayLike, v: ArrayLike) -> Terms:
        """Return H, C, r, Jᵣ and J̇ᵣq̇ of one state, from Pinocchio's frame functions.

        Parameters
        ----------
        q, v : (nq,) and (n,) arrays
            Joint positions, rad (m), and velocities, rad/s (m/s), see `robot_models.coordinates`; q may also be (n,),
            as the loop has it.

        Raises
        ------
        ValueError
            If a length is wrong or an entry is not finite (Pinocchio itself would let NaN pass).
        """
        return self.known_terms(self._checked(q, "q"), self._checked(v, "v"))

    def known_terms(self, q: Array, v: Array) -> Terms:
        """Return what `terms` does, at positions as Pinocchio has them; nothing is checked."""
        state = q.tobytes(), v.tobytes()
        if self._latest is None or self._latest[0] != state:  # what begins a run is asked several times
            self._latest = state, self._terms(q, v)
        return self._latest[1]

    def known_tip(self, q: Array) -> tuple[Array, Array]:
        """Return r and Jᵣ of `terms`, to the bit, at positions as Pinocchio has them; nothing is checked."""
        state = q.tobytes()
        if self._latest_tip is None or self._latest_tip[0] != state:
            data, frame = self._data, self._frame
            pin.computeJointJacobians(self._pin, data, q)
            pin.updateFramePlacement(self._pin, data, frame)
            J = pin.getFrameJacobian(self._pin, data, frame, _ALIGNED).reshape(6, self.n)[:3]
            tip = _frozen(data.oMf[frame].translation.copy()), _frozen(np.ascontiguousarray(J))
            self._latest_tip = state, tip
        return self._latest_tip[1]

    def _terms(self, q: Array, v: Array) -> Terms:
        model, data, frame = self._pin, self._data, self._frame
        pin.crba(model, data, q, pin.Convention.WORLD)
        self.passes[1](model, data, q, v)
        H = np.where(self._upper, data.M, data.M.T) + 0.0  # only that half is filled; no zero has a sign
        bias = data.nle.copy()
        pin.forwardKinematics(model, data, q, v, self._rest)  # q̈ = 0 leaves the velocity-product accelerations
        pin.updateFramePlacement(model, data, frame)
        return Terms(
            _frozen(H),
            _frozen(bias),
            _frozen(data.oMf[frame].translation.copy()),
            _frozen(np.ascontiguousarray(pin.getFrameJacobian(model, data, frame, _ALIGNED).reshape(6, self.n)[:3])),
            _frozen(pin.getFrameClassicalAcceleration(model, data, frame, _ALIGNED).linear.copy()),
        )

    def position(self, q: ArrayLike) -> Array:
        """Return the tip position r (3,), m, base frame, at joint positions q (n,)."""
        pin.framesForwardKinematics(self._pin, self._data, self._checked(q, "q"))
        return np.array(self._data.oMf[self._frame].translation)

    def position_and_jacobian(self, q: Array) -> tuple[Array, Array]:
        """Return r (3,) and Jᵣ (3, n), base axes, at q (n,); nothing is checked."""
        jacobian = pin.computeFrameJacobian(self._pin, self._data, self.pinocchios(q), self._frame, _ALIGNED)
        jacobian = jacobian.reshape(6, self.n)
        pin.updateFramePlacement(self._pin, self._data, self._frame)
        return self._data.oMf[self._frame].translation.copy(), jacobian[:3]

    def frame_jacobian(self, q: Array) -> Array:
        """Return the Jacobian of the tip's frame (6, n) at q (n,): Jᵣ above the angular velocity's, base axes."""
        jacobian = pin.computeFrameJacobian(self._pin, self._data, self.pinocchios(q), self._frame, _ALIGNED)
        return np.array(jacobian).reshape(6, self.n)

    def tip_frame(self, q: Array) -> tuple[Array, Array]:
        """Return the pose of the tip's frame in the base at q (n,), homogeneous (4, 4), and its Jacobian (6, n).

        The Jacobian is that of `frame_jacobian`; nothing is checked.
        """
        jacobian = self.frame_jacobian(q)
        return pin.updateFramePlacement(self._pin, self._data, self._frame).homogeneous, jacobian

    def inverse_dynamics(self, q: Array, v: Array, a: Array) -> Array:
        """Return H q̈ + C (n,), N m (N), at one state, each (n,); nothing is checked."""
        return np.array(pin.rnea(self._pin, self._data, self.pinocchios(q), v, a))

    def mass_matrix(self, q: Array) -> Array:
        """Return H (n, n) at q (n,); nothing is checked."""
        H = pin.crba(self._pin, self._data, self.pinocchios(q), pin.Convention.WORLD)
        return np.where(self._upper, H, H.T)

    def link_axes(self, q: Array) -> Array:
        """Return the axes of the tip's link as `tree` has them, columns (3, 3), base frame, at q (n,)."""
        n, tree = self.n, self.tree
        work, J, r, axes = np.zeros(int(plain(work_size)(n))), np.zeros((3, n)), np.zeros(3), np.zeros((3, 3))
        interpreted(tree_kinematics)(tree, q, self._rest, work, J, r, np.zeros(3))
        interpreted(tree_turning)(tree, work, axes, J)
        return axes

    def potential_energy(self, q: Array) -> Array:
        """Return the potential energy of each row of q (N, n), J, that of springs included."""
        model, data = self._pin, self._data
        springs = np.array([interpreted(spring_energy)(self.tree, row) for row in self.rotation_vectors(q)])
        return springs + np.array([pin.computePotentialEnergy(model, data, row) for row in self._rows(q)])

    def needed_torque(self, q: Array, v: Array, a: Array, tip_force: Array) -> Array:
        """Return H q̈ + C − Jᵣᵀ F in each row of q, v, q̈ (N, n) and F (N, 3), base axes: (N, n), N m (N)."""
        found = np.empty((len(q), self.n))
        for k, (qk, vk, ak) in enumerate(zip(self._rows(q), *map(np.ascontiguousarray, (v, a)), strict=True)):
            found[k] = pin.rnea(self._pin, self._data, qk, vk, ak)
            self._add_springs(qk, found[k])
            if tip_force[k].any():
                jacobian = pin.computeFrameJacobian(self._pin, self._data, qk, self._frame, _ALIGNED)
                found[k] -= jacobian.reshape(6, self.n)[:3].T @ tip_force[k]
        return found

    def wrist_wrench(self, q: Array, v: Array, a: Array, tip_force: Array, tip_moment: Array | None = None) -> Array:
        """Return what a force-torque sensor between the arm and its tool reads, (N, 6), N and N m.

        The force and the moment with which the arm moves all that is fixed to the tip's frame, tool and payload: their
        rate of momentum, less gravity and less the force on the tip,

            f = Y a + v ×* Y v - Y g - f_tip        spatial vectors in the sensor's frame

        The sensor's frame is the frame `tip` of the arm without a tool. The moment is about its origin.

        Parameters
        ----------
        q, v, a : (N, n) arrays
            Joint positions, rad (m), velocities, rad/s (m/s), and accelerations, rad/s² (m/s²).
        tip_force : (N, 3) array
            Force of the surface on the tip, N, base axes.
        tip_moment : (N, 3) array, optional
            Its moment about the tip, N m, base axes.
        """
        model, data, frame = self._pin, self._data, self._frame
        Y, offset = carried_by(self.model.tools, self.tip)
        back = pin.SE3(np.eye(3), offset)  # the tip in the sensor's frame
        found = np.empty((len(q), 6))
        moments = np.zeros((len(q), 3)) if tip_moment is None else tip_moment
        for k, (qk, vk, ak) in enumerate(zip(self._rows(q), *map(np.ascontiguousarray, (v, a)), strict=True)):
            pin.forwardKinematics(model, data, qk, vk, ak)
            turn = pin.updateFramePlacement(model, data, frame).rotation.T
            motion = back.act(pin.getFrameVelocity(model, data, frame, pin.LOCAL))
            rate = back.act(pin.getFrameAcceleration(model, data, frame, pin.LOCAL))
            rate.linear -= turn @ self.gravity
            contact = back.act(pin.Force(turn @ tip_force[k], turn @ moments[k]))
            found[k] = (Y * rate + motion.cross(Y * motion) - contact).vector
        return found

    def frame_at(self, name: str, q: Array) -> tuple[int, Array, Array]:
        """Return the number of the velocity that moves a frame, and the frame's axes, as columns, and origin, m, at q.

        The frame is that of the robot's file: a tool on it does not move it. For the base the number is −1; for a joint
        with several velocities it is that of the last.
        """
        number = 0 if name == WORLD else self._pin.getFrameId(self.model.require_frame(name))
        pin.framesForwardKinematics(self._pin, self._data, self.pinocchios(q))
        place = self._data.oMf[number]
        return (
            last_velocity(self._pin, self._pin.frames[number].parentJoint),
            np.array(place.rotation),
            place.act(-carried_by(self.model.tools, name)[1]),
        )

    def frame_poses(self, name: str, q: Array) -> tuple[Array, Array]:
        """Return the axes of a frame of the robot's file, as columns, and its origin, m, base frame, at each row of q.

        q is (N, n), they are (N, 3, 3) and (N, 3); "world" is the base.
        """
        return self.poses_of([name], q)[name]

    def poses_of(self, names: Iterable[str], q: Array) -> dict[str, tuple[Array, Array]]:
        """Return the poses of several frames of the robot's file by their names, each as `frame_poses` returns it."""
        numbers = {name: 0 if name == WORLD else self._pin.getFrameId(self.model.require_frame(name)) for name in names}
        tips = {name: carried_by(self.model.tools, name)[1] for name in numbers}
        found = {name: (np.empty((len(q), 3, 3)), np.empty((len(q), 3))) for name in numbers}
        for k, row in enumerate(self._rows(q)):
            pin.forwardKinematics(self._pin, self._data, row)
            for name, number in numbers.items():
                place = pin.updateFramePlacement(self._pin, self._data, number)
                found[name][0][k], found[name][1][k] = place.rotation, place.act(-tips[name])
        return found

    def frames_at_rest(self) -> set[str]:
        """Return the names of the frames that are fixed to the world."""
        return {frame.name for frame in self._pin.frames if frame.parentJoint == 0} & {*self.model.frames}

    def fixed_to(self, name: str) -> tuple[str, ...]:
        """Return a frame, and those that are fixed to it, by their names."""
        found = [self._pin.getFrameId(self.model.require_frame(name))]
        for number, frame in enumerate(self._pin.frames):
            if frame.type != pin.FrameType.JOINT and frame.parentFrame in found and number not in found:
                found.append(number)
        return tuple(self._pin.frames[number].name for number in found)

    def link_below(self, joint: str) -> tuple[str, Array]:
        """Return the name of the link that a joint hangs on, and where on it (3,), m, in the axes of that link."""
        number = self._pin.getJointId(joint)
        frames = (each for each in self._pin.frames if each.type == pin.FrameType.JOINT)
        link = self._pin.frames[next(each for each in frames if each.parentJoint == number).parentFrame]
        placement = self._pin.jointPlacements[number]
        return str(link.name), np.array(link.placement.actInv(placement).translation)

    def tip_axes(self, q: Array) -> Array:
        """Return the axes of the tip's frame at each row of q (N, n): columns, base frame, (N, 3, 3)."""
        found = np.empty((len(q), 3, 3))
        for k, row in enumerate(self._rows(q)):
            pin.forwardKinematics(self._pin, self._data, row)
            found[k] = pin.updateFramePlacement(self._pin, self._data, self._frame).rotation
        return found

    def _rows(self, q: Array) -> Array:
        return np.ascontiguousarray(self.pinocchios(q))

    def _checked(self, x: ArrayLike, name: str) -> Array:
        array = np.ascontiguousarray(x, dtype=np.float64)
        if array.shape == (self.n,) and not self.turns_freely and np.isfinite(array).all():
            return array
        names = self.model.coordinate_names
        if name == "q" and self.turns_freely and array.shape in ((self.n,), (len(names),)) and np.isfinite(array).all():
            return self.pinocchios(array)
        if array.shape != (self.n,):
            raise ValueError(
                f"{name} has shape {array.shape}: {self.model.name} has {self.n} joints {list(self.joint_names)}"
            )
        if not np.all(np.isfinite(array)):
            raise ValueError(f"{name} = {array.tolist()}: must be finite")
        return array


_ALIGNED = pin.LOCAL_WORLD_ALIGNED


def _frozen(array: Array) -> Array:
    array.setflags(write=False)
    return array


@lru_cache(maxsize=64)
def _upper(n: int) -> NDArray[np.bool_]:
    """Return (n, n) which entries are in the upper half, and on the diagonal."""
    return np.triu(np.ones((n, n), dtype=bool))
