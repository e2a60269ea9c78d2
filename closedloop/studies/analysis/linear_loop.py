"""The force loop as x⁺ = A x + B u, y = C x + D u, and what follows from it: poles, responses, the port."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from closedloop.base.arrays import Array, ComplexArray
from closedloop.base.errors import ScenarioError
from closedloop.base.optional import missing_line
from closedloop.scenario.scenario import Scenario
from closedloop.studies.analysis.margins import Margins, margins_of
from closedloop.studies.analysis.poles import Pole, pole_at
from closedloop.studies.analysis.port import Port, port_of
from robot_models.cached import cached_property

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

    Attributes
    ----------
    A, B, C, D : arrays
        x⁺ = A x + B u, y = C x + D u, from one sample of the law to the next; inputs are held in between.
    dt : float
        Time between two samples, s.
    states, inputs, outputs : tuples of Quantity
        Their names, with units, and the part that a state belongs to.
    time : float
        The instant, s.
    mode : int
        Mode of the contact, as in `Run.mode`: 1 pressed, 2 stuck.
    soft : bool
        Whether the surface gives way.
    closure : (k,) array of complex
        Poles of Baumgarte's stabiliser, from step to step: they are no part of the loop, which stays on the closure.
    normal : (x,) array
        The tip's velocity along n, m/s, by the states.
    held_force : bool
        Whether f acts unchanged over a step, as in a scheme of one stage, and on a rigid surface: its power is then f
        times the mean of the velocities before and after.
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

        Raises
        ------
        ScenarioError
            If there is no such input or output.
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

        Raises
        ------
        ScenarioError
            If there is no such place.
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

        Parameters
        ----------
        input, output : str
            Names of `inputs` and `outputs`. For the input "surface" the surface moves by 1 mm along n in the time
            `rise`, because no surface jumps. A step of another input is 1 of its unit at t = 0.
        duration, rise : float
            Length of the response, and the time in which the surface moves, s.

        Raises
        ------
        ScenarioError
            If there is no such input or output.
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
        x, y = np.zeros(self.A.shape[0]), np.empty(steps + 1)
        for k in range(steps + 1):
            y[k] = self.C[row] @ x + self.D[row, column] * u[k]
            x = self.A @ x + self.B[:, column] * u[k]
        return t, y

    def port(self) -> Port:
        """Return the admittance of the tip along the normal, and whether it is passive."""
        f = self.grid
        v, force = (self.frequency_response("surface", name, f) for name in ("normal velocity", "contact force"))
        return port_of(f, v, force, None if self.held_force else self.dt)

    def to_control(self) -> Any:
        """Return it as a `control.StateSpace`.

        Raises
        ------
        ScenarioError
            If python-control is not installed.
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
