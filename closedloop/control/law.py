"""The base classes of laws and compensations, and what a law sees at one instant.

A user's law is a class derived from `ControlLaw`, with its parameters as typed fields. Those that ship are in
`closedloop.control.laws`, one file each, written the same way.

    class Damper(ControlLaw):
        damping: Annotated[NotNegative, gain_in("N m s/rad")] = Field(5.0, description="joint damping")

        @staticmethod
        def torque(x, par, z, torque):
            for j in range(x.q.size):
                torque[j] = x.C[j] - x.A[0, j] * par.force - par.damping * x.v[j]

The functions are compiled: they take arrays and numbers, call functions of numpy, math and numba's own, and write into
the arrays that they are given.
"""

from typing import Annotated, Any, ClassVar, NamedTuple

from pydantic import Field

from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError
from closedloop.base.families import Family, Parameters
from closedloop.base.sections import FORCE, PERIOD, RATE, NotNegative, Number, gain_in
from closedloop.jit.blocks import Block, Count
from closedloop.jit.kernel import kernel


class LawInput(NamedTuple):
    """The state of the arm, its terms, the reference, and the reading of the force sensor.

    Contact frame: axes n (out of the surface), t1, t2; the three numbers of every (3,) array are in that order, unless
    it is said to be in base axes.

    With `[encoder]` the state is computed from the encoders' readings. With `[model_error]` the terms are those of the
    controller's own model. With `[transmission]` H includes the motors. See docs/real_arm.md.

    Attributes
    ----------
    t : float
        Time, s.
    q, v : (n,) arrays
        Joint positions, rad (m), and velocities.
    H : (n, n) array
        Mass matrix.
    C : (n,) array
        Bias torque (Coriolis, centrifugal, gravity), N m.
    L : (n, n) array
        Lower Cholesky factor of H whose diagonal holds reciprocals, see `closedloop.mechanics.closure.solve.cholesky`.
    A : (3, n) array
        Tip Jacobian, contact frame: u = A q̇. Its first row is nᵀJᵣ.
    X : (3, n) array
        L⁻¹Aᵀ, transposed.
    S : (3, 3) array
        A H⁻¹Aᵀ, the tip's mobility, 1/kg; positive semi-definite.
    drift : (3,) array
        Ȧ q̇, m/s².
    p, u : (3,) arrays
        Tip position, m, and velocity, m/s.
    r : (3,) array
        Tip position, m, base axes.
    J : (3, n) array
        Tip Jacobian Jᵣ, base axes.
    Jdot_v : (3,) array
        J̇ᵣq̇, m/s², base axes.
    frame : (3, 3) array
        The contact frame: rows n, t1, t2, base axes; p = frame r.
    q_des, v_des : (n,) arrays
        Desired joint motion.
    qdd_des : (n,) array
        Desired joint acceleration, rad/s² (m/s²), where `reference.orientation` holds the tool; else zero.
    p_des, u_des, a_des : (3,) arrays
        Desired motion of the tip, m, m/s, m/s².
    f_des : float
        Desired contact force, N, of the surface on the tip along +n.
    f_measured : float
        Latest reading of the force sensor, N, as modelled by [sensor]; it belongs to an earlier instant.
    f_tangential : (2,) array
        Readings of the same instant along t1 and t2 of `frame`, N, of a sensor of three axes; else zero.
    pressed : float
        1 while the tip is in contact, else 0.
    scratch : array
        Scratch, (n² + 3 n + 224,); it is not kept from call to call.
    """

    t: float
    q: Array
    v: Array
    H: Array
    C: Array
    L: Array
    A: Array
    X: Array
    S: Array
    drift: Array
    p: Array
    u: Array
    r: Array
    J: Array
    Jdot_v: Array
    frame: Array
    q_des: Array
    v_des: Array
    qdd_des: Array
    p_des: Array
    u_des: Array
    a_des: Array
    f_des: float
    f_measured: float
    f_tangential: Array
    pressed: float
    scratch: Array


N = Count.of("n")


class Perceived(Block, sizes=("n",)):
    """The parts of a `closedloop.control.law.LawInput` of n joints that depend on the state, but H and C."""

    r: Annotated[Array, 3]
    drift: Annotated[Array, 3]  # base axes
    frame: Annotated[Array, 3, 3]
    p: Annotated[Array, 3]  # contact frame, as the next four
    u: Annotated[Array, 3]
    drift_c: Annotated[Array, 3]
    carried: Annotated[Array, 3]
    turning: Annotated[Array, 3]
    S: Annotated[Array, 3, 3]
    q: Annotated[Array, N]
    v: Annotated[Array, N]
    J: Annotated[Array, 3, N]
    A: Annotated[Array, 3, N]
    X: Annotated[Array, 3, N]
    L: Annotated[Array, N, N]


@kernel
def commanded_force(x: LawInput, par: Any, z: Any) -> float:
    """Return f_c, N, of a law's parameters and states.

        f_c = f_des + K_f (f_des − f_s) + K_I ∫ (f_des − f) dt

    f_s is the latest reading, so K_f acts with a delay; the integral is a state. With an exact model and a rigid
    surface f = f_c + d, d the disturbance. Then e_f = f_des − f obeys, without K_f, ė_f = −K_I e_f: the force settles
    like exp(−K_I t), independently of the arm. With a reading that is one sample old, K_f alone gives the iteration
    f ← (1 + K_f) f_des − K_f f + d, which converges for K_f < 1 only; behind a low-pass of time constant T sampled
    every h, K_f may be up to T/h (`closedloop.simulation.time_step`).

    In free motion there is no force feedback, and f_c = f_des. But after liftoff due to feedback, as after too high a
    reading, f_c does not return to f_des at once, which would chatter: negative feedback terms act there too, until the
    reading is that of free motion and the integral has recovered.

    Source: the integral force servo of Yoshikawa, IEEE J. Robotics and Automation 3(5), 1987, and of Volpe and
    Khosla, IEEE Trans. Automatic Control 38(11), 1993, who compare the explicit force laws.
    """
    feedback = 0.0
    if par.force_feedback != 0.0:
        feedback += par.force_feedback * (x.f_des - x.f_measured)
    if par.force_integral != 0.0:
        feedback += par.force_integral * z.force_error
    if x.pressed == 0.0:
        feedback = min(feedback, 0.0)
    return x.f_des + feedback


@kernel
def force_error_rate(x: LawInput, par: Any, z: Any, f: float) -> float:
    """Return the rate of z.force_error = ∫ (f_des − f) dt, N.

    In free motion it is zero, against wind-up, but a negative integral recovers if f_des > 0. Without an integral gain
    it is zero.
    """
    if par.force_integral == 0.0:
        return 0.0
    rate = x.f_des - f
    return rate if x.pressed != 0.0 or (z.force_error < 0.0 < min(rate, x.f_des)) else 0.0


class Controller(Parameters):
    """What a control law and a compensation have in common: states, and functions; see `ControlLaw`."""

    states: ClassVar[tuple[str, ...]] = ()
    joint_states: ClassVar[tuple[str, ...]] = ()

    @classmethod
    def check_functions(cls, key: str) -> None:
        """Refuse names of states that are no tuple of names: ("error") without a comma is a text."""
        for attribute in ("states", "joint_states"):
            names: Any = getattr(cls, attribute)
            if not (isinstance(names, tuple | list) and all(isinstance(n, str) and n.isidentifier() for n in names)):
                what = f"{key} = {cls.member_name()}: {attribute} = {names!r}"
                raise ScenarioError(f'{what}: must be a tuple of names, such as ("error",)')

    @staticmethod
    def torque(x: LawInput, par: Any, z: Any, torque: Array) -> None:
        """Write Q (n,), N m."""

    @staticmethod
    def rates(x: LawInput, par: Any, z: Any, f: float, torque: Array, dz: Any) -> None:
        """Write ż."""

    @staticmethod
    def start(x: LawInput, par: Any, z: Any) -> None:
        """Write z at the start of a run."""

    @staticmethod
    def restart(dv: Array, par: Any, z: Any) -> None:
        """Tell z of an impact."""


class ControlLaw(Controller):
    """[law]: base of all control laws: the desired force, and the force feedback.

    A law has these functions. `par` has its parameters by name, one for each joint as arrays (n,); `z` its states and
    `dz` their rates.

        torque(x, par, z, torque)           write Q (n,), N m, at the instant x (`LawInput`)
        rates(x, par, z, f, torque, dz)     write ż: f is the force reading at this instant, N, torque the applied Q
        start(x, par, z)                    write z at the start of a run, where it is zero
        restart(dv, par, z)                 update z after an impact that changed q̇ by dv (n,), rad/s

    What `torque` writes into z at a row of the record is kept, what it writes within a step is not: a sampled law,
    with a `sample_period`, keeps its memory there.

    Attributes
    ----------
    states, joint_states : tuple of str
        Names of the states beside q and q̇: numbers, and arrays with one for each joint. `ControlLaw` has one itself,
        the integral of the force error, which `rates` of `ControlLaw` integrates.
    """

    folder: ClassVar[str] = "closedloop.control.laws"
    states: ClassVar[tuple[str, ...]] = ("force_error",)

    force: Annotated[Number, FORCE] = Field(
        10.0,
        description="force f_des with which the tip presses on the surface, N; 0: it rests there without pressing; "
        "below 0: it pulls where surface.contact is bilateral, and leaves where it is unilateral",
    )
    sample_period: Annotated[NotNegative, PERIOD] = Field(
        0.0, description="period at which the law is evaluated and then held, s; 0: at every evaluation of Eq. 24"
    )
    force_feedback: Annotated[NotNegative, gain_in("")] = Field(
        0.0, description="K_f, newtons of command per newton of error in the latest reading; below 1 for a fast sensor"
    )
    force_integral: Annotated[NotNegative, RATE] = Field(
        0.0, description="K_I, 1/s: a force error settles like exp(-K_I t), to 2 % in 3.9/K_I"
    )

    @classmethod
    def check_functions(cls, key: str) -> None:
        """Refuse a law without a torque, or with states that nothing integrates."""
        super().check_functions(key)
        if cls.torque is ControlLaw.torque:
            raise ScenarioError(
                f"{key} = {cls.member_name()}: must define @staticmethod def torque(x, par, z, torque), which writes Q"
            )
        if cls.rates is ControlLaw.rates and (cls.states or cls.joint_states) and "force_error" not in cls.states:
            raise ScenarioError(
                f"{key} = {cls.member_name()}: has states ({', '.join((*cls.states, *cls.joint_states))}) and must "
                "define @staticmethod def rates(x, par, z, f, torque, dz), which writes their rates into dz"
            )

    @staticmethod
    def torque(x: LawInput, par: Any, z: Any, torque: Array) -> None:
        """Write Q (n,), N m."""
        raise NotImplementedError("a control law needs a function torque(x, par, z, torque)")

    @staticmethod
    def rates(x: LawInput, par: Any, z: Any, f: float, torque: Array, dz: Any) -> None:
        """Write ż."""
        dz.force_error = force_error_rate(x, par, z, f)


class Compensation(Controller):
    """[compensation]: a torque against friction, or for a surface that is not as believed, added to that of the law.

    Its functions are those of a law (see `ControlLaw`), but `torque` adds to Q.
    """

    folder: ClassVar[str] = "closedloop.control.compensation"
    # Parameters that are values of friction as the controller believes it to be, see `model_error.friction`.
    friction_values: ClassVar[tuple[str, ...]] = ()
    # Whether it needs what a force sensor of three axes reads along the tangents.
    reads_tangential: ClassVar[bool] = False

    def check(self, law: ControlLaw) -> None:
        """Refuse parameters that do not go with a law's."""


LAWS, COMPENSATIONS = Family(ControlLaw, usual="paper"), Family(Compensation, usual="none")
