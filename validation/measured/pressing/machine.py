"""The UR10e of the tests as a scenario: the maker's arm, a tool, elastic joints, a position servo and a force mode.

What is public is taken: kinematics and inertia of the maker (data/ur10e.urdf), mass, centre and tip of the tool and the
poses of the tests from the scripts and settings of the measurements' repository, the servo's cycle of 2 ms. What is not
public, is fitted: `PARAMETERS`. The tool's own tensor is a guess, that of a body of its size.

MuJoCo: the same machine, with its soft contact in place of Hunt and Crossley's.

The arm is MuJoCo's, from the same URDF. Motors, servo and force mode are written out here, as `scenario` of `machine`
has them. All their numbers are fitted to MuJoCo's own forces, beside those of its contact.

The measured touchdowns: a file of arrays TEST/SIGNAL, each (2, N), time in s and value.

TEST is PLACE_F*_g*_v*: where it comes down, the commanded force in N, the gain scaling of the force mode, and the speed
that the program has, m/s. Time is 0 at the first contact.

Figures of a force that comes down, swings and settles, of measured and of simulated ones alike.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, ClassVar, NamedTuple
from zipfile import BadZipFile

import numpy as np
from scipy.optimize import least_squares

import closedloop as cl
import robot_models
from closedloop.base.arrays import Array
from closedloop.base.errors import ClosedLoopError, ModelError
from closedloop.base.files import reason_of
from closedloop.scenario.scenario import Scenario
from validation.measured.judged import DATA

# How long the tool rests after the first contact, s, before it slides or leaves; how fast it may come down, m/s, where
# that is not the speed of the name.
REST = {"direct": 5.0, "straight": 3.2, "ramp": 3.2}
DOWN = {"straight": 0.25}
NAME = re.compile(r"(?P<place>[a-z]+)_F(?P<force>[\d.]+)_g(?P<gain>[\d.]+)_v(?P<speed>[\d.]+)")
# The speed before the contact is the mean over this time, s.
BEFORE = (-0.03, -0.004)


@dataclass(frozen=True, eq=False)
class Touchdown:
    """A test: what was commanded, and what was measured.

    force: commanded, N
    gain, limit: gain scaling and speed limit, m/s, of the force mode
    speed: with which it comes to the surface, measured, m/s
    rest: time from the first contact to the end of what is compared, s
    time, measured: (N,), s, and the force at the sensor under the surface, N
    desired: (2, M), s, and the size of the speed that the force mode asks for, m/s, as its controller logs it
    """

    name: str
    place: str
    force: float
    gain: float
    limit: float
    speed: float
    rest: float
    time: Array
    measured: Array
    desired: Array | None = None


def read(path: Path) -> list[Touchdown]:
    """Return the tests of a file, by name.

    Raises `ModelError` if it cannot be read, or an array is missing or has another shape.
    """
    try:
        with np.load(path) as found:
            arrays = {key: np.asarray(found[key], dtype=np.float64) for key in found}
    except OSError as error:
        raise ModelError(f"{path}: cannot be read: {reason_of(error)}") from None
    except (ValueError, EOFError, BadZipFile, AttributeError):
        raise ModelError(f"{path}: is no .npz file of numbers, as numpy.savez writes it") from None
    names = sorted({key.rpartition("/")[0] for key in arrays})
    if not names:
        raise ModelError(f"{path}: has no test; arrays are called TEST/force_measured and TEST/speed_measured")
    return [_touchdown(path, name, arrays) for name in names]


def _touchdown(path: Path, name: str, arrays: dict[str, Array]) -> Touchdown:
    said = NAME.fullmatch(name)
    if said is None or said["place"] not in REST:
        raise ModelError(
            f"{path}: test {name!r}: must be PLACE_F*_g*_v*, such as direct_F100_g0.5_v0.10, with PLACE one of "
            f"{', '.join(REST)}"
        )
    series = []
    for signal in ("force_measured", "speed_measured", "speed_desired"):
        one = arrays.get(f"{name}/{signal}")
        if one is None and signal == "speed_desired":
            continue
        if one is None or one.ndim != 2 or len(one) != 2 or not np.all(np.isfinite(one)):
            raise ModelError(f"{path}: {name}/{signal}: must be (2, N), time in s and finite values")
        series.append(one)
    (time, force), (at, speed), *desired = series
    place, rest = said["place"], REST[said["place"]]
    if not (np.all(np.diff(time) > 0.0) and time[0] <= 0.0 and time[-1] >= rest):
        raise ModelError(f"{path}: {name}/force_measured: its time must rise, from 0 or before to {rest:g} s or later")
    before = speed[(at >= BEFORE[0]) & (at <= BEFORE[1])]
    if not (len(before) and before.mean() > 0.0):
        raise ModelError(f"{path}: {name}/speed_measured: has no speed above 0 in the {-BEFORE[0]:g} s before contact")
    limit = DOWN.get(place, float(said["speed"]))
    return Touchdown(
        name, place, float(said["force"]), float(said["gain"]), limit, float(before.mean()), rest, time, force, *desired
    )


SAMPLE = 8e-4  # s, between two samples of the force
FIRST = 0.06  # s: the first peak is the largest force until then
SMOOTH, SHORT = 0.02, 0.004  # s: means for swing and settling, and for losses of contact
LOST, LEAST = 3.0, 0.01  # N: below it there is no contact; s: shorter losses do not count
SWING = (0.1, 1.3)  # s, in which the swing is looked at
BAND = (0.8, 40.0)  # Hz, in which its frequency is sought
# Settled within the larger of 5 N and 10 % of the commanded force. The published definition is the same, the time after
# which the force stays within a band about the commanded one; the width of the band is ours.
WITHIN, SHARE = 5.0, 0.1
LAST = 1.5  # s at the end, of mean and deviation: where the force hunts, it does so more slowly than 1 Hz


class Figures(NamedTuple):
    """What a force does: N, s and Hz; `settling` is the whole time where it does not settle."""

    peak: float
    losses: int
    lost: float  # s without contact, of all losses
    frequency: float  # of the largest line in the spectrum of the swing
    decay: float  # 1/s, of the amplitude of the swing
    settling: float
    mean: float
    deviation: float


def smoothed(force: Array, span: float) -> Array:
    """Return the moving mean over a span, s."""
    count = max(1, round(span / SAMPLE))
    return np.convolve(force, np.full(count, 1.0 / count), "same")


def figures(time: Array, force: Array, commanded: float, rest: float) -> Figures:
    """Return the figures of a force (N,), N, at times (N,), s, 0 at first contact, until `rest`, s."""
    t = np.arange(0.0, rest, SAMPLE)
    f = np.interp(t, time, force)
    mean, short = smoothed(f, SMOOTH), smoothed(f, SHORT)
    ends = np.flatnonzero(np.diff(np.concatenate([[0], ((short < LOST) & (t > LEAST)).astype(int), [0]])))
    losses = [SAMPLE * (b - a) for a, b in zip(ends[::2], ends[1::2], strict=True) if SAMPLE * (b - a) > LEAST]
    inner = (t > SMOOTH) & (t < rest - SMOOTH)
    outside = np.flatnonzero((np.abs(mean - commanded) > max(WITHIN, SHARE * commanded)) & inner)
    swing = (mean - commanded)[(t > SWING[0]) & (t < SWING[1])]
    # The mean under the window is taken away: of any other mean the window makes a line at 0 Hz, which is wider than
    # the band is far from it.
    window = np.hanning(len(swing))
    swing -= np.average(swing, weights=window)
    lines = np.abs(np.fft.rfft(swing * window, 2**15))
    at = np.fft.rfftfreq(2**15, SAMPLE)
    seen = (at > BAND[0]) & (at < BAND[1])
    half = len(swing) // 2
    sizes = [float(np.sqrt(np.mean(part * part))) for part in (swing[:half], swing[half:])]
    last = f[t > rest - LAST]
    return Figures(
        float(f[t < FIRST].max()), len(losses), float(sum(losses)), float(at[seen][np.argmax(lines[seen])]),
        float(np.log(max(sizes[0], 1e-9) / max(sizes[1], 1e-9)) / (half * SAMPLE)),
        float(t[outside[-1]]) if len(outside) else 0.0, float(last.mean()), float(last.std()),
    )  # fmt: skip


URDF, FLANGE = DATA / "ur10e.urdf", "tool0"
# Tool centre point and centre of mass in the flange's axes, m, and its turn about the flange's axis; mass, kg.
TIP, CENTRE, TURN, MASS = (0.07188, -0.0415, 0.2594), (0.001, -0.002, 0.15), np.radians(-30.0), 6.86
TENSOR = (0.05, 0.05, 0.02, 0.0, 0.0, 0.0)
# Where the tip is in contact, m, in the arm's base frame. The tool points down, turned half about its axis in one.
PLACES = {"direct": (-0.734, 0.0, 0.0438), "straight": (-0.727, 0.265, 0.082), "ramp": (-0.708, 0.25, 0.183)}
HALF_TURNED = ("direct",)
NEAR = (-0.4, -1.4, 2.0, -2.1, -np.pi / 2.0, 0.0)  # rad: elbow up
CYCLE, STEP, GAP = 0.002, 4e-4, 5e-4  # s, s, and the height from which a run starts, m
# The sizes of the joints, largest first: stiffness, inertia and gains of a wrist are this share of those of the others.
WRIST = 0.2
SIZES = np.array([1.0, 1.0, 1.0, WRIST, WRIST, WRIST])


class Parameter(NamedTuple):
    """A number that is fitted: name, unit, first value, and bounds."""

    name: str
    unit: str
    first: float
    low: float
    high: float


MACHINE = (
    Parameter("joint_stiffness", "N m/rad", 1.9e4, 5e3, 5e5),  # of the three large joints
    Parameter("joint_damping", "N m s/rad", 100.0, 5.0, 600.0),
    Parameter("motor_inertia", "kg m²", 7.5, 0.5, 60.0),
    Parameter("servo_stiffness", "N m/rad", 1.4e4, 2e3, 2e5),
    Parameter("servo_damping", "N m s/rad", 53.0, 30.0, 6e3),
    Parameter("mode_inertia", "kg", 39.0, 15.0, 150.0),
    Parameter("mode_damping", "N s/m", 250.0, 5.0, 4e3),
    Parameter("delay", "s", 0.011, 0.002, 0.03),  # of the reading: the time constant of its low-pass
)
# The stiffness is the mean one at this depth, m: f = k d (depth/d)^exponent.
DEPTH = 1e-3
SURFACES = {"direct": (2.0e6, 1.0), "straight": (1.6e4, 4.6), "ramp": (1.9e5, 1.1)}  # N/m, and the exponent
# μ of steel on steel, as of handbooks. A tip that sticks is held along the surface, which makes the arm stiffer along
# the normal for as long as μf holds it: the frequency of the swing rises with the force.
FRICTION = 0.15
CONTACT = (
    *(Parameter(f"stiffness_{place}", "N/m", k, 1e4, 1e8) for place, (k, _) in SURFACES.items()),
    *(Parameter(f"exponent_{place}", "1", n, 1.0, 6.0) for place, (_, n) in SURFACES.items()),
    Parameter("dissipation", "s/m", 0.87, 1e-2, 30.0),
)


@cache
def pose(place: str) -> tuple[Array, Array]:
    """Return q (6,), rad, with the tip at a place, and q̇ (6,), rad/s, at which it comes down upright at 1 m/s."""
    arm = cl.Robot(robot_models.load(str(URDF)), FLANGE)
    turn = TURN + (0.0 if place in HALF_TURNED else np.pi)
    down = np.array([[np.cos(turn), np.sin(turn), 0.0], [np.sin(turn), -np.cos(turn), 0.0], [0.0, 0.0, -1.0]])

    def tip(q: Array) -> Array:
        (axes,), (at,) = arm.frame_poses(FLANGE, q[None])
        return np.concatenate([at + axes @ TIP - PLACES[place], (axes - down).ravel()])

    found = least_squares(tip, NEAR, xtol=1e-15, ftol=1e-15, gtol=1e-15)
    rates = np.linalg.lstsq(found.jac, -np.eye(12)[2], rcond=None)[0]
    return found.x, rates


def scenario(values: Mapping[str, float], test: Touchdown) -> Scenario:
    """Return the scenario of a test, from `GAP` above the surface on."""
    q, rates = pose(test.place)
    exponent = values[f"exponent_{test.place}"]
    return cl.load_scenario("soft_table", {
        "description": test.name,
        "robot": {"model": str(URDF), "tip": FLANGE, "drive_inertia": False},
        "tool": {"offset": TIP, "mass": MASS, "centre": CENTRE, "inertia": TENSOR},
        "surface": {"kind": "plane", "normal": [0, 0, 1], "offset": "start", "gap": GAP, "contact": "unilateral"},
        "compliance": {
            "kind": "hunt_crossley", "exponent": exponent, "dissipation": values["dissipation"],
            "stiffness": values[f"stiffness_{test.place}"] * DEPTH ** (1.0 - exponent),
        },
        "friction": {"kind": "coulomb", "coefficient": FRICTION},
        "transmission": {
            "stiffness": list(values["joint_stiffness"] * SIZES), "damping": list(values["joint_damping"] * SIZES),
            "motor_inertia": list(values["motor_inertia"] * SIZES), "measured": "motor",
        },
        "sensor": {"filter_time_constant": values["delay"]},
        "reference": {"kind": "hold"},
        "law": {
            "kind": "servo_admittance", "force": test.force, "gain_scaling": test.gain, "speed_limit": test.limit,
            "kp": list(values["servo_stiffness"] * SIZES), "kd": list(values["servo_damping"] * SIZES),
            "admittance_inertia": values["mode_inertia"], "admittance_damping": 0.0,
            "contact_damping": values["mode_damping"], "sample_period": CYCLE,
        },
        "start": {"q": list(q), "v": list(test.speed * rates)},
        "stabiliser": {"kind": "none"},
        "time": {"duration": test.rest + 0.01, "step": STEP, "integrator": "rk4"},
    })  # fmt: skip


def contact_time(time: Array, force: Array) -> float:
    """Return the instant of the first force, s."""
    return float(time[np.argmax(force > 0.0)])


class ClosedLoopArm:
    """The scenario in this package's compiled engine."""

    name: ClassVar = "closedloop"
    parameters: ClassVar[Sequence[Parameter]] = (*MACHINE, *CONTACT)

    def simulate(self, values: Mapping[str, float], test: Touchdown) -> tuple[Array, Array]:
        """Return time (N,), s, 0 at the first contact, and force (N,), N; none of a run that could not go on."""
        try:
            run = cl.simulate(scenario(values, test), progress=False, engine="compiled")
        except ClosedLoopError:
            return np.zeros(1), np.zeros(1)
        return run.time - contact_time(run.time, run.contact_force), run.contact_force


RADIUS = 0.01  # m
START = {"direct": 1.7e5, "straight": 6e4, "ramp": 1.7e4}  # 1/s²


class MuJoCoArm:
    """Fitted: the machine, and the contact: stiffness, 1/s², at each place and one damping ratio (solref)."""

    name: ClassVar = "mujoco"
    parameters: ClassVar[Sequence[Parameter]] = (
        *MACHINE,
        *(Parameter(f"stiffness_{place}", "1/s²", k, 1e2, 5e6) for place, k in START.items()),
        Parameter("damping_ratio", "1", 0.5, 0.01, 5.0),
    )  # fmt: skip

    def simulate(self, values: Mapping[str, float], test: Touchdown) -> tuple[Array, Array]:
        """Return time (N,), s, 0 at the first contact, and force (N,), N."""
        import mujoco

        m, k = values, values[f"stiffness_{test.place}"]
        reference = (-k, -2.0 * values["damping_ratio"] * float(np.sqrt(k)))
        model = _model(mujoco, test.place, reference)
        data = mujoco.MjData(model)
        tip = model.site("tip").id
        q, rates = pose(test.place)
        data.qpos[:], data.qvel[:] = q, test.speed * rates
        mujoco.mj_forward(model, data)
        spring, damper, inertia = (m[name] * SIZES for name in ("joint_stiffness", "joint_damping", "motor_inertia"))
        kp, kd = m["servo_stiffness"] * SIZES, m["servo_damping"] * SIZES
        motor, turning = q + data.qfrc_bias / spring, test.speed * rates
        held, at, speed, reading, pressed = motor.copy(), GAP, -test.speed, 0.0, 0.0
        jacobian, force, wrench = np.zeros((3, 6)), 0.0, np.zeros(6)
        steps = round((test.rest + 0.01) / STEP)
        forces: Array = np.zeros(steps)
        torque = np.zeros(6)
        for i in range(steps):
            if i % round(CYCLE / STEP) == 0:
                mujoco.mj_jacSite(model, data, jacobian, None, tip)
                up = np.linalg.pinv(jacobian)[:, 2]
                torque = data.qfrc_bias + kp * (held + up * (at - GAP) - motor) + kd * (up * speed - turning)
            passed = spring * (motor - data.qpos) + damper * (turning - data.qvel)
            turning = turning + STEP * (torque - passed) / inertia
            motor = motor + STEP * turning
            data.qfrc_applied[:] = passed
            mujoco.mj_step(model, data)
            force = 0.0
            for j in range(data.ncon):
                mujoco.mj_contactForce(model, data, j, wrench)
                force += wrench[0]
            pressed = 1.0 if force > 0.0 else 0.0
            reading += STEP * (force - reading) / m["delay"]
            error = reading - test.force - pressed * m["mode_damping"] * speed
            speed += STEP * test.gain * error / m["mode_inertia"]
            speed = min(max(speed, -test.limit), test.limit)
            at += STEP * speed
            forces[i] = force
        time: Array = STEP * np.arange(steps, dtype=np.float64)
        return time - contact_time(time, forces), forces


def _model(mujoco: Any, place: str, reference: tuple[float, float]) -> Any:
    """Return the arm with its tool over a plane, with solref (−stiffness, −damping) of their contact."""
    spec = mujoco.MjSpec.from_string(URDF.read_text(encoding="utf-8"))
    spec.compiler.fusestatic = False
    spec.option.timestep, spec.option.cone = STEP, mujoco.mjtCone.mjCONE_ELLIPTIC
    flange = spec.body(FLANGE)
    tool = flange.add_body(name="tool")
    tool.mass, tool.ipos, tool.explicitinertial = MASS, CENTRE, True
    tool.inertia = TENSOR[:3]
    kept = {"solref": reference, "condim": 3, "friction": [FRICTION, 0.0, 0.0]}
    tool.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[RADIUS, 0, 0], pos=[TIP[0], TIP[1], TIP[2] - RADIUS], **kept)
    tool.add_site(name="tip", pos=TIP)
    height = PLACES[place][2] - GAP
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[5, 5, 1], pos=[0, 0, height], **kept)
    return spec.compile()
