"""A closed loop in plain numpy around the compiled control laws: the arm, a rigid plane, friction, a fixed step.

It shares no line with the simulator but Pinocchio's terms: Eq. 24 goes through `closedloop.solve_closure` with as many
rows as the tip is held in.
"""

import dataclasses
from functools import cache

import numpy as np

import closedloop as cl
import robot_models
from closedloop.control.compensation.none import NoCompensation
from closedloop.control.law import Compensation, LawInput
from closedloop.control.sensor import SensorSection, pack_sensor
from closedloop.jit.calls import entry_address
from closedloop.jit.interpreted import interpreted
from closedloop.jit.parameters import parameter_block, state_block
from closedloop.loop.step.entries import RESTART, START, TORQUE, law_entry, law_input
from closedloop.loop.step.memory import make_loop
from closedloop.mechanics.closure.contact_force import FREE, PRESSED
from closedloop.mechanics.friction.answers import RATES
from closedloop.mechanics.surface.placed import contact_frame
from closedloop.simulation.engines.scenario_numbers import pack_law

# Where the arms press, and how their surface lies.
NORMALS = {
    "wam4": (0.0, 0.0, 1.0),
    "panda": (-0.342, 0.0, 0.94),
    "ur5": (0.0, 0.2, 1.0),
    "planar2": (0.0, 0.0, 1.0),
}
POSES = {
    "wam4": (np.pi / 2, 1.0, 0.0, 2.0),
    "panda": (0.0, -0.785398, 0.0, -2.35619, 0.0, 1.5707, 0.785398),
    "ur5": (0.3, -1.2, 1.5, -1.9, -1.57, 0.2),
    "planar2": (0.6, -1.4),
}


@cache
def functions(member, n):
    """Return torque, rates, start and restart of a law or a compensation, of n joints and of flat arrays.

    They go through the entry that the simulator's loop calls, in a memory of their own: nothing is compiled for them.
    """
    entry, compensates = law_entry(member), issubclass(member, Compensation)
    entry_address(entry)  # compiled as the loop has it
    states, size = state_block(member).count(n), parameter_block(member).count(n)
    loop = make_loop(n, extra=states, **{"compensation" if compensates else "law": size})
    state, constants, w = loop
    state.law.states, state.law_states = 0 if compensates else states, states
    parameters = constants.compensation if compensates else constants.law
    places = [(name, place) for name, place in interpreted(law_input)(*loop)._asdict().items() if np.ndim(place)]

    def call(what, x, par, z):
        if x is not None:
            for name, place in places:
                place[...] = getattr(x, name)
            w.time, w.reference.force, w.sensing.measured = x.t, x.f_des, x.f_measured
            state.mode = PRESSED if x.pressed else FREE
        parameters[:], w.z[:] = par, z
        entry(loop.address, what)
        z[:] = w.z

    def torque(x, par, z, Q):
        w.torque[:] = Q
        call(TORQUE, x, par, z)
        Q[:] = w.torque

    def rates(x, par, z, f, Q, dz):
        w.sensing.reading, w.torque[:] = f, Q
        call(RATES, x, par, z)
        dz[:] = w.dz

    def start(x, par, z):
        call(START, x, par, z)

    def restart(dv, par, z):
        w.scratch.column[:] = dv
        call(RESTART, None, par, z)

    return torque, rates, start, restart


@cache
def arm(name):
    """Return the robot with its tip."""
    model = robot_models.load(name)
    tip = model.tip if model.tip is not None else {"ur5": "tool0"}[name]
    return cl.Robot(model, tip)


@dataclasses.dataclass
class Friction:
    """Friction of surface and joints as they truly are."""

    kinetic: float = 0.0
    static: float = 0.0
    stribeck_speed: float = 0.01
    viscous: float = 0.0
    joint_coulomb: float = 0.0
    joint_viscous: float = 0.0

    def coefficient(self, speed):
        """Return μ at this slip speed."""
        return self.kinetic + (self.static - self.kinetic) * np.exp(-((speed / self.stribeck_speed) ** 2))


class Loop:
    """One arm, one surface, one law."""

    def __init__(self, name, law, compensation=None, *, friction=None, turn=0.0, q=None, v=None, force=None):
        self.robot = arm(name)
        n = self.n = self.robot.n
        self.friction = friction or Friction()
        frame = contact_frame(np.array(NORMALS[name]) / np.linalg.norm(NORMALS[name]))
        c, s = np.cos(turn), np.sin(turn)
        self.frame = np.array([[1.0, 0, 0], [0, c, s], [0, -s, c]]) @ frame
        self.q = np.array(POSES[name] if q is None else q, dtype=float)
        self.v = np.zeros(n) if v is None else np.array(v, dtype=float)
        self.q_start = self.q.copy()
        self.p_start = self.frame @ self.robot.position(self.q)
        if getattr(law, "pd_start", 0.0) is None:
            law = law.model_copy(update={"pd_start": 0.0})
        self.law, self.compensation = law, NoCompensation() if compensation is None else compensation
        self.compensation.check(law)
        self.packed = [pack_law(section, n) for section in (self.law, self.compensation)]
        self.z = np.zeros(sum(each.states for each in self.packed))
        self.f_des = law.force if force is None else force
        self.f_measured = self.f_des
        self.t = 0.0
        self.pressed = 1.0
        self.scratch = np.zeros(n * n + 3 * n + 224)
        # Wanted motion: displacement, velocity, acceleration from the start, contact frame.
        self.path = lambda t: (np.zeros(3), np.zeros(3), np.zeros(3))
        self.joints = lambda t: (self.q_start, np.zeros(n))
        self.disturbance = np.zeros(n)  # joint torque that no model knows
        self.stuck = None  # where the tip sticks
        self._last = None, None
        self.restart()

    def parts(self, z):
        """Return the law's functions, parameters and states, and the compensation's."""
        own = self.packed[0].states
        return [
            (functions(packed.member, self.n), packed.numbers, states)
            for packed, states in zip(self.packed, (z[:own], z[own:]), strict=True)
        ]

    def restart(self):
        """Write the law's states as they are at the start of a run from this state."""
        self.z[:] = 0.0
        x = self.moment(self.t, self.q, self.v)[0]
        for (_, _, start, _), par, z in self.parts(self.z):
            start(x, par, z)

    def jump(self, dv):
        """Tell the law of an impact."""
        for (*_, restart), par, z in self.parts(self.z):
            restart(dv, par, z)

    def moment(self, t, q, v):
        """Return what the law knows at this state, and the terms; a step asks for the same moment up to four times."""
        state, given = (t, q.tobytes(), v.tobytes()), (self.f_des, self.f_measured, self.pressed)
        key = state, given, self.path, self.joints, self.p_start.tobytes(), self.q_start.tobytes()
        if self._last[0] != key:
            self._last = key, self._moment(t, q, v)
        return self._last[1]

    def _moment(self, t, q, v):
        terms = self.robot.terms(q, v)
        H, C = terms.mass_matrix.copy(), terms.bias.copy()
        L = np.linalg.cholesky(H)
        A = np.ascontiguousarray(self.frame @ terms.jacobian)
        X = np.ascontiguousarray(np.linalg.solve(L, A.T).T)
        L[np.diag_indices(self.n)] = 1.0 / np.diag(L)
        shift, u_des, a_des = self.path(t)
        q_des, v_des = self.joints(t)
        x = LawInput(
            t=float(t), q=q.copy(), v=v.copy(), H=H, C=C, L=np.ascontiguousarray(L), A=A, X=X, S=X @ X.T,
            drift=self.frame @ terms.drift, p=self.frame @ terms.position, u=A @ v, r=terms.position.copy(),
            J=np.ascontiguousarray(terms.jacobian), Jdot_v=terms.drift.copy(), frame=np.ascontiguousarray(self.frame),
            q_des=np.array(q_des), v_des=np.array(v_des), qdd_des=np.zeros(len(q_des)),
            p_des=self.p_start + shift, u_des=np.array(u_des), a_des=np.array(a_des),
            f_des=float(self.f_des), f_measured=float(self.f_measured), f_tangential=np.zeros(2),
            pressed=float(self.pressed), scratch=self.scratch,
        )  # fmt: skip
        return x, terms

    def torque(self, x, z=None):
        """Return Q."""
        torque = np.zeros(self.n)
        for (write, *_), par, states in self.parts(self.z if z is None else z):
            write(x, par, states, torque)
        return torque

    def rates(self, x, f, torque, z=None):
        """Return ż."""
        z = self.z if z is None else z
        dz = np.zeros_like(z)
        own = self.packed[0].states
        for ((_, write, *_), par, states), rates in zip(self.parts(z), (dz[:own], dz[own:]), strict=True):
            write(x, par, states, float(f), torque, rates)
        return dz

    def evaluate(self, t, q, v, z):
        """Return q̈, F (3,), ż and Q of this state: Eq. 24 with friction."""
        x, _ = self.moment(t, q, v)
        torque = self.torque(x, z)
        loss = self.friction.joint_coulomb * np.sign(v) + self.friction.joint_viscous * v
        rhs = torque - x.C - loss + self.disturbance
        F = np.zeros(3)
        if self.pressed:
            qdd, F = self._pressed(x, rhs)
        else:
            qdd = np.linalg.solve(x.H, rhs)
        dz = self.rates(x, F[0], torque, z)
        return qdd, F, dz, torque

    def _pressed(self, x, rhs):
        # The closure with a stabiliser of 20 ms: it does no more here than to keep rounding away.
        e, rate = x.p[0] - self.p_start[0], x.u[0]
        b = -x.drift[0] - 100.0 * rate - 2500.0 * e
        F = np.zeros(3)
        speed = np.hypot(x.u[1], x.u[2])
        if self.friction.static or self.friction.kinetic or self.friction.viscous:
            if self.stuck is not None:
                b3 = np.array([b, *(-x.drift[1:] - 100.0 * x.u[1:] - 2500.0 * (x.p[1:] - self.stuck))])
                held = np.linalg.norm(x.A, axis=1) > 1e-9  # a planar arm cannot be held sideways
                qdd, F[held] = cl.solve_closure(x.H, rhs, x.A[held], b3[held])
                return qdd, F
            direction = x.u[1:] / speed if speed > 0 else np.zeros(2)
            c = self.friction.coefficient(speed) * direction
            w = self.friction.viscous * x.u[1:]
            # [H, -(A_n - c A_t)^T; A_n, 0] [q̈; f] = [rhs - A_t^T w; b], by elimination
            push = x.A[0] - c @ x.A[1:]
            y = np.linalg.solve(x.H, np.column_stack([rhs - x.A[1:].T @ w, push]))
            F[0] = (b - x.A[0] @ y[:, 0]) / (x.A[0] @ y[:, 1])
            F[1:] = -c * F[0] - w
            return y[:, 0] + y[:, 1] * F[0], F
        qdd, f = cl.solve_closure(x.H, rhs, x.A[0], b)
        F[0] = f
        return qdd, F

    def step(self, h, scheme="euler"):
        """Take a step and return F (3,) and Q at its beginning."""
        if self.pressed and self.friction.static:
            self._stick_or_slip()
        q, v, z, t = self.q, self.v, self.z, self.t
        if scheme == "euler":
            qdd, F, dz, torque = self.evaluate(t, q, v, z)
            self.v = v + h * qdd
            self.q = q + h * self.v
            self.z = z + h * dz
        else:
            slopes = []
            for share in (0.0, 0.5, 0.5, 1.0):
                last = [share * h * x for x in slopes[-1]] if slopes else [0.0, 0.0, 0.0]
                qdd, f, dz, Q = self.evaluate(t + share * h, q + last[0], v + last[1], z + last[2])
                slopes.append((v + last[1], qdd, dz))
                if len(slopes) == 1:
                    F, torque = f, Q
            weights = (1 / 6, 1 / 3, 1 / 3, 1 / 6)
            self.q, self.v, self.z = (
                old + h * sum(w * slope[k] for w, slope in zip(weights, slopes, strict=True))
                for k, old in enumerate((q, v, z))
            )
        self.t = t + h
        self.f_measured = F[0]
        return F, torque

    def _stick_or_slip(self, slow=1e-4):
        """Karnopp's rule: a tip slower than `slow` sticks as long as the force that holds it is within the cone."""
        x, _ = self.moment(self.t, self.q, self.v)
        if self.stuck is None and np.hypot(x.u[1], x.u[2]) < slow:
            self.stuck = x.p[1:].copy()
        if self.stuck is not None:
            F = self.evaluate(self.t, self.q, self.v, self.z)[1]
            if np.hypot(F[1], F[2]) > self.friction.static * F[0]:
                self.stuck = None

    def run(self, duration, h=1e-3, scheme="euler"):
        """Return a dict of arrays: t, f, e (N, 3) in the contact frame, its rate, F, torque, z."""
        rows = {key: [] for key in ("t", "f", "e", "rate", "F", "torque", "z", "q", "v")}
        for _ in range(round(duration / h)):
            t, q, v, z = self.t, self.q.copy(), self.v.copy(), self.z.copy()
            x, _ = self.moment(t, q, v)
            F, torque = self.step(h, scheme)
            shift, u_des, _ = self.path(t)
            e, rate = self.p_start + shift - x.p, u_des - x.u
            for key, value in zip(rows, (t, F[0], e, rate, F, torque, z, q, v), strict=True):
                rows[key].append(value)
        return {key: np.array(value) for key, value in rows.items()}


def rms(x):
    """Return the root mean square."""
    return float(np.sqrt(np.mean(np.square(x))))


def force_loop_radius(feedback: float, integral: float, sensor: SensorSection, period: float) -> float:
    """Return the largest modulus of an eigenvalue of the sampled force loop: it converges below 1.

        f_k = f_des + K_f (f_des − m_{k−1}) + K_I z_k + d        m: reading, through low-pass and delay
        z_{k+1} = z_k + h (f_des − s_k)                          s: reading without the sampling, or m

    Parameters
    ----------
    feedback, integral : float
        K_f, and K_I, 1/s.
    sensor : SensorSection
    period : float
        Time between two samples, s.

    Raises
    ------
    ScenarioError
        If the sensor does not fit the period.
    """
    packed = pack_sensor(sensor, period)
    # State: low-passed force y, integral z, and the readings r_1 (the latest) .. r_D+1 (the one that reaches the law).
    size = 2 + packed.ring
    y, z, latest, oldest = 0, 1, 2, size - 1
    force = np.zeros(size)  # f as a row on the state, without its constants
    force[oldest] -= feedback
    force[z] += integral
    unit = np.eye(size)
    time_constant = sensor.filter_time_constant
    now = unit[y] if time_constant > 0.0 else force  # what the sensor feels now
    step = np.zeros((size, size))
    share = period / time_constant if time_constant > 0.0 else 1.0  # Euler's, a little above the true one
    step[y] = (1.0 - share) * unit[y] + share * force
    step[z] = unit[z] - period * (unit[oldest] if packed.sampled else now)
    step[latest] = now
    for place in range(latest + 1, size):
        step[place] = unit[place - 1]
    if integral == 0.0:  # z is then not part of the loop
        step = np.delete(np.delete(step, z, axis=0), z, axis=1)
    return float(np.max(np.abs(np.linalg.eigvals(step))))
