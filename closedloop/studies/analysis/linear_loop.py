"""The linear loop with its poles, its margins, and the port that the surface sees.

Margins say how far a loop is from instability, from its transfer L where it is cut:

gain margin      by which a gain may rise, or fall, until L = −1
phase margin     by which the phase at |L| = 1 may lag
delay margin     the delay that the loop may have in addition: phase margin over frequency, the least of all crossings
modulus margin   the least distance of L from −1, 1/max|S|: it bounds all of them from below
"""

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import brentq, minimize_scalar
from scipy.signal import dlsim

from closedloop.base.arrays import Array, ComplexArray, plain
from closedloop.base.errors import ScenarioError, missing_line
from closedloop.scenario.scenario import Scenario
from robot_models.cached import cached_property

# |z − 1| up to which a pole is one at rest: it changes nothing within a million samples. It is the square root of the
# rounding that a double pole at 1 splits by.
AT_REST = 1e-6
# |z| below which a mode is over at the next samples: it has no continuous equivalent.
DEADBEAT = 1e-6


@dataclass(frozen=True)
class Pole:
    """A pole of the loop.

    `z`, `s`: from sample to sample, and the continuous equivalent ln(z)/dt, 1/s; −∞ for a pole at z = 0.
    `frequency`: natural frequency |s|, Hz.
    `damping`: damping ratio −Re s/|s|; 1 for a real pole that decays.
    `participation`: share of each part: arm, contact, law, compensation, filter, sensor, delay, hold, transmission,
        friction, encoder; the sum is 1. The share of a state is |l_k r_k| with the left and the right eigenvector,
        normalised.
    """

    z: complex
    s: complex
    frequency: float
    damping: float
    participation: dict[str, float]

    @property
    def part(self) -> str:
        """The part with the largest share."""
        return max(self.participation, key=self.participation.__getitem__)

    @property
    def at_rest(self) -> bool:
        """Whether it neither decays nor grows: a joint that friction holds, a motion that nothing controls."""
        return abs(self.z - 1.0) < AT_REST

    @property
    def grows(self) -> bool:
        """Whether it is unstable."""
        return not self.at_rest and abs(self.z) >= 1.0

    def as_dict(self) -> dict[str, Any]:
        """Return it as plain numbers; a pole at z = 0 has no s."""
        over = not math.isfinite(self.s.real)
        return {
            "z": [self.z.real, self.z.imag], "s": None if over else [self.s.real, self.s.imag],
            "frequency": None if over else self.frequency, "damping": self.damping,
            "part": self.part, "participation": self.participation,
        }  # fmt: skip


def pole_at(z: complex, dt: float, participation: dict[str, float]) -> Pole:
    """Return the pole at z, of a loop whose samples are dt apart, s."""
    if abs(z) < DEADBEAT:
        return Pole(z, complex(-math.inf, 0.0), math.inf, 1.0, participation)
    s = complex(np.log(z)) / dt
    size = abs(s)
    return Pole(z, s, size / (2.0 * math.pi), -s.real / size if size > 0.0 else 1.0, participation)


# |L| below which there is no loop.
OPEN = 1e-12


@dataclass(frozen=True)
class Margins:
    """Margins of a loop cut at one place.

    `cut`: "sensor", or "torque[JOINT]".
    `stable`, `closed`: whether the loop is stable, and whether anything is fed back there.
    `gain`, `gain_at`: the factor by which the gain may rise, infinite if any, and the frequency at which it then
        oscillates, Hz.
    `least_gain`: the factor by which the gain may fall, 0 if any: above it the loop is stable.
    `phase`, `phase_at`: phase margin, degrees, infinite if |L| is below 1 everywhere, and its frequency, Hz.
    `delay`: delay margin, s.
    `modulus`, `peak_sensitivity`, `peak_at`: min |1 + L|, max |S| = 1/that, and where, Hz.
    """

    cut: str
    stable: bool
    closed: bool
    gain: float
    gain_at: float
    least_gain: float
    phase: float
    phase_at: float
    delay: float
    modulus: float
    peak_sensitivity: float
    peak_at: float

    @property
    def decibels(self) -> float:
        """Gain margin, dB: of a rise or a fall, whichever is nearer."""
        down = -20.0 * math.log10(self.least_gain) if self.least_gain > 0.0 else math.inf
        return min(20.0 * math.log10(self.gain) if self.gain < math.inf else math.inf, down)

    def as_dict(self) -> dict[str, Any]:
        """Return them as plain values; what is infinite, or has no place, is None."""
        return plain(asdict(self) | {"decibels": self.decibels})


def margins_of(transfer: Callable[[Array], ComplexArray], grid: Array, cut: str, stable: bool) -> Margins:
    """Return the margins of a loop transfer L.

    `transfer`: L at frequencies, Hz.
    `grid` (k,): frequencies, Hz, in order, close enough to each other that L turns little from one to the next.
    """
    L = transfer(grid)
    closed = bool(np.max(np.abs(L)) > OPEN)
    nan = math.nan
    if not closed:
        return Margins(cut, stable, False, math.inf, nan, 0.0, math.inf, nan, math.inf, 1.0, 1.0, nan)

    def at(f: float) -> complex:
        return complex(transfer(np.array([f]))[0])

    crossings = np.flatnonzero((L.imag[:-1] * L.imag[1:] < 0.0) & ((L.real[:-1] < 0.0) | (L.real[1:] < 0.0)))
    real = [float(brentq(lambda f: at(f).imag, *grid[i : i + 2], xtol=1e-14, rtol=1e-13)) for i in crossings]
    gain, gain_at, least = math.inf, nan, 0.0
    for f, value in [*((f, at(f)) for f in real), (float(grid[-1]), L[-1])]:  # at half of the sampling rate it is, too
        if value.real < 0.0 and abs(value.imag) <= 1e-3 * abs(value.real):
            factor = float(-1.0 / value.real)
            if 1.0 <= factor < gain:
                gain, gain_at = factor, f
            elif least < factor < 1.0:
                least = factor
    phase, phase_at, delay = math.inf, nan, math.inf
    size = np.log(np.maximum(np.abs(L), 1e-300))
    for i in np.flatnonzero(size[:-1] * size[1:] < 0.0):
        f = float(brentq(lambda f: math.log(abs(at(f))), *grid[i : i + 2], xtol=1e-14, rtol=1e-13))
        angle = math.degrees(math.atan2(at(f).imag, at(f).real))
        ahead = (angle + 180.0) % 360.0  # by which it may lag
        nearest = min(ahead, 360.0 - ahead)
        if nearest < phase:
            phase, phase_at = nearest, f
        delay = min(delay, math.radians(ahead) / (2.0 * math.pi * f))
    distance = np.abs(1.0 + L)
    k = int(np.argmin(distance))
    low, high = grid[max(k - 1, 0)], grid[min(k + 1, grid.size - 1)]
    best = minimize_scalar(lambda f: abs(1.0 + at(f)), bounds=(low, high), method="bounded", options={"xatol": 1e-10})
    modulus, peak_at = (float(best.fun), float(best.x)) if best.fun < distance[k] else (distance[k], grid[k])
    modulus = float(modulus)
    return Margins(
        cut, stable, True, gain, gain_at, least, phase, phase_at, delay, modulus,
        1.0 / modulus if modulus > 0.0 else math.inf, float(peak_at),
    )  # fmt: skip


# −Re Y/|Y| up to which a port is passive: the rounding of a response; and what sampling makes of one that is 0, per
# frequency in samples.
PASSIVE, SAMPLING = 1e-6, 0.1


@dataclass(frozen=True)
class Port:
    """How the tip yields to a force along the normal, as the surface sees it: Y = v/f.

    Attributes
    ----------
    frequency : (k,) array
        Hz, up to half of the sampling rate.
    admittance : (k,) array of complex
        Y, m/s/N: the velocity of the tip along n to f.
    passive : bool
        Whether Re Y ≥ 0 at all of them: then the loop is stable on every passive surface.
    active_at : float or None
        The frequency at which Re Y is the most negative, relative to |Y|, Hz; None if it is passive.
    """

    frequency: Array
    admittance: ComplexArray
    passive: bool
    active_at: float | None


# Parts that are no part of the loop.
OUTSIDE = "surface"
# Points of a frequency response to a decade, at first.
POINTS = 60


class Quantity(NamedTuple):
    """A state, an input or an output: its name, its unit and, of a state, the part that it belongs to."""

    name: str
    unit: str
    part: str = ""


@dataclass(frozen=True, eq=False)
class LinearLoop:
    """The force loop, linear about the motion at an instant.

    `A`, `B`, `C`, `D`: x⁺ = A x + B u, y = C x + D u, from one sample of the law to the next; inputs are held in
        between.
    `dt`: time between two samples, s.
    `states`, `inputs`, `outputs`: their names, with units, and the part that a state belongs to.
    `time`: the instant, s.
    `mode`: mode of the contact, as in `Run.mode`: 1 pressed, 2 stuck.
    `soft`: whether the surface gives way.
    `closure`, (k,) array of complex: poles of Baumgarte's stabiliser, from step to step: they are no part of the loop,
        which stays on the closure.
    `normal` (x,): the tip's velocity along n, m/s, by the states.
    `held_force`: whether f acts unchanged over a step, as in a scheme of one stage, and on a rigid surface: its power
        is then f times the mean of the velocities before and after.
    """

    A: Array
    B: Array
    C: Array
    D: Array
    dt: float
    states: tuple[Quantity, ...]
    inputs: tuple[Quantity, ...]
    outputs: tuple[Quantity, ...]
    time: float
    scenario: Scenario
    mode: int
    soft: bool
    closure: ComplexArray
    normal: Array
    held_force: bool

    def __repr__(self) -> str:
        kind = "stable" if self.stable else "unstable"
        return f"LinearLoop(t = {self.time:g} s, {len(self.states)} states, every {self.dt:g} s, {kind})"

    def __post_init__(self) -> None:
        for array in (self.A, self.B, self.C, self.D, self.closure, self.normal):
            array.flags.writeable = False

    def input(self, name: str) -> int:
        """Return the column of an input; a name that is not there is refused with those that are."""
        return _place(self.inputs, name, "input")

    def output(self, name: str) -> int:
        """Return the row of an output."""
        return _place(self.outputs, name, "output")

    @property
    def _inside(self) -> NDArray[np.intp]:
        return np.array([i for i, state in enumerate(self.states) if state.part != OUTSIDE], dtype=np.intp)

    @cached_property
    def _poles(self) -> tuple[Pole, ...]:
        inside = self._inside
        if not inside.size:
            return ()
        values, right = np.linalg.eig(self.A[np.ix_(inside, inside)])
        left = np.linalg.pinv(right)
        shares = np.abs(left.T * right)
        found = []
        for k, z in enumerate(values):
            share: dict[str, float] = {}
            total = float(np.sum(shares[:, k])) or 1.0
            for i, value in zip(inside, shares[:, k], strict=True):
                part = self.states[i].part
                share[part] = share.get(part, 0.0) + float(value) / total
            found.append(pole_at(complex(z), self.dt, share))
        return tuple(sorted(found, key=lambda pole: (-abs(pole.z), -pole.z.real, -pole.z.imag)))

    def poles(self) -> tuple[Pole, ...]:
        """Return the poles, the slowest to decay first. Those of Baumgarte's stabiliser are in `closure`."""
        return self._poles

    @property
    def radius(self) -> float:
        """Largest |z| of the poles that do not rest: below 1 the loop is stable."""
        return max((abs(pole.z) for pole in self._poles if not pole.at_rest), default=0.0)

    @property
    def stable(self) -> bool:
        """Whether every pole decays, or rests."""
        return self.radius < 1.0

    def frequency_response(self, input: str, output: str, frequency: ArrayLike) -> ComplexArray:
        """Return the response of an output to an input at frequencies, Hz, (k,).

        The input "surface" is the displacement of the surface along n, m, and the output "normal velocity" the
        velocity of the tip along n with which f has its power, m/s.

        Raises ScenarioError if there is no such input or output.
        """
        f = np.atleast_1d(np.asarray(frequency, dtype=float))
        z = np.exp(2j * math.pi * f * self.dt)
        column = self.input("surface acceleration" if input == "surface" else input)
        if output == "normal velocity":
            row, direct = self.normal, 0.0
        else:
            at = self.output(output)
            row, direct = self.C[at], float(self.D[at, column])
        y: ComplexArray = _at(self.A, self.B[:, column], row, z) + direct
        if output == "normal velocity" and self.held_force:
            y = y * (z + 1.0) / 2.0
        if input == "surface":  # h²/2 (z + 1)/(z − 1)² of the acceleration is the displacement
            y = y * 2.0 * (z - 1.0) ** 2 / (self.dt * self.dt * (z + 1.0))
        return y

    @cached_property
    def grid(self) -> Array:
        """Frequencies, Hz, up to half of the sampling rate: even in their logarithm, and dense about each pole."""
        nyquist = 0.5 / self.dt
        low = min(1e-2, 1e-4 * nyquist)
        points: list[Array] = [np.geomspace(low, nyquist * (1.0 - 1e-9), int(POINTS * math.log10(nyquist / low)))]
        for pole in self._poles:
            peak = abs(pole.s.imag) / (2.0 * math.pi)
            if math.isfinite(peak) and low < peak < nyquist:
                width = max(abs(pole.s.real) / (2.0 * math.pi), 1e-6 * peak)
                points.append(peak + width * np.linspace(-4.0, 4.0, 33))
        joined = np.unique(np.concatenate(points))
        return joined[(joined >= low) & (joined < nyquist)]

    def loop_transfer(self, frequency: ArrayLike, cut: str = "sensor") -> ComplexArray:
        """Return L at frequencies, Hz, (k,), with the loop cut at the sensor, or at the torque of a joint.

            L = −T/(1 + T),  T the response of what is fed back to what is added to it

        At "torque[JOINT]" the loops of the other joints stay closed.

        Raises ScenarioError if there is no such place.
        """
        if cut == "sensor":
            T = self.frequency_response("sensor noise", "force felt", frequency)
        else:
            T = self.frequency_response(cut, cut, frequency)
        return -T / (1.0 + T)

    def margins(self, cut: str = "sensor") -> Margins:
        """Return how far the loop is from instability, cut at the sensor, or at the torque of a joint.

        See `Margins`. They also say whether the loop is unstable, or open at that place.
        """
        return margins_of(lambda f: self.loop_transfer(f, cut), self.grid, cut, self.stable)

    def bandwidth(self) -> float:
        """Return up to which frequency, Hz, f follows the command: |f/f_des| within 3 dB of its value at rest.

        It is infinite if f follows up to half of the sampling rate, for example if the command acts on f directly.
        """
        f = self.grid
        T = np.abs(self.frequency_response("force command", "contact force", f))
        low = np.flatnonzero(T[0] / math.sqrt(2.0) > T)
        return float(f[low[0]]) if low.size else math.inf

    def peak_sensitivity(self, cut: str = "sensor") -> float:
        """Return max |S| = max |1/(1 + L)|, the largest factor by which the loop amplifies a disturbance."""
        return self.margins(cut).peak_sensitivity

    def response(
        self, input: str = "force command", output: str = "contact force", duration: float = 0.5, rise: float = 0.01
    ) -> tuple[Array, Array]:
        """Return the times, s, and the response of an output to a unit step of an input.

        `input`, `output`: names of `inputs` and `outputs`. For the input "surface" the surface moves by 1 mm along n in
            the time `rise`, because no surface jumps. A step of another input is 1 of its unit at t = 0.
        `duration`, `rise`: length of the response, and the time in which the surface moves, s.
        Raises ScenarioError if there is no such input or output.
        """
        steps = max(1, round(duration / self.dt))
        surface = input == "surface"
        column = self.input("surface acceleration" if surface else input)
        row = self.output(output)
        t = np.linspace(0.0, steps * self.dt, steps + 1)
        u = np.ones(steps + 1)
        if surface:
            moving = max(2, round(rise / self.dt))
            share = np.clip(np.arange(steps + 2) / moving, 0.0, 1.0)
            speed = 1e-3 * 30.0 * share**2 * (1.0 - share) ** 2 / (moving * self.dt)  # of minimum jerk
            speed *= 1e-3 / (0.5 * self.dt * float(np.sum(speed[1:] + speed[:-1])))
            u = np.diff(speed) / self.dt
        system = self.A, self.B[:, [column]], self.C[[row]], self.D[[row]][:, [column]], self.dt
        return t, np.asarray(dlsim(system, u)[1][:, 0])

    def port(self) -> Port:
        """Return the admittance of the tip along the normal, and whether it is passive."""
        f = self.grid
        v, force = (self.frequency_response("surface", name, f) for name in ("normal velocity", "contact force"))
        with np.errstate(divide="ignore", invalid="ignore"):
            Y = v / force
        known = np.isfinite(Y)
        share = np.where(known, Y.real / np.where(known, np.abs(Y), 1.0), 0.0)
        if not self.held_force:  # by so much Re Y is uncertain, and beyond a quarter of the sampling rate not known
            share = np.where(f < 0.25 / self.dt, share + SAMPLING * f * self.dt, 0.0)
        worst = int(np.argmin(share))
        passive = bool(share[worst] >= -PASSIVE)
        return Port(f, Y, passive, None if passive else float(f[worst]))

    def to_control(self) -> Any:
        """Return it as a `control.StateSpace`.

        Raises ScenarioError if python-control is not installed.
        """
        try:
            import control
        except ImportError:
            raise ScenarioError(missing_line("to_control needs", "python-control", "analysis")) from None
        names = {key: [each.name for each in getattr(self, key)] for key in ("states", "inputs", "outputs")}
        return control.ss(self.A, self.B, self.C, self.D, self.dt, **names, name=self.scenario.name)


def _place(quantities: tuple[Quantity, ...], name: str, what: str) -> int:
    for i, quantity in enumerate(quantities):
        if quantity.name == name:
            return i
    known = ", ".join(quantity.name for quantity in quantities)
    raise ScenarioError(f"{what} {name!r}: there is none; there are {known}")


def _at(A: Array, b: Array, c: Array, z: ComplexArray) -> ComplexArray:
    """Return c (z − A)⁻¹ b at each z (k,)."""
    eye = np.eye(A.shape[0])
    found = np.empty(z.size, dtype=complex)
    most = max(1, 4_000_000 // max(1, A.size))  # a few tens of megabytes at a time
    for first in range(0, z.size, most):
        part = z[first : first + most]
        x = np.linalg.solve(part[:, None, None] * eye - A, np.broadcast_to(b[:, None], (part.size, b.size, 1)))
        found[first : first + most] = x[:, :, 0] @ c
    return found
