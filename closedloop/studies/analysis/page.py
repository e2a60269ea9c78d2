"""A page about a force loop, and what a display shows at once."""

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from closedloop.base.arrays import Array, ComplexArray, plain
from closedloop.base.errors import ClosedLoopError
from closedloop.scenario.messages import key_unit
from closedloop.studies.analysis.linear_loop import LinearLoop, Margins, Pole
from closedloop.studies.analysis.stability import Limit, Range, Stability, Trial

# Up to how many times their value gains and stiffnesses are looked for limits, and at how many values.
MOST_GAIN, MOST_STIFFNESS, LOOKS = 1e3, 1e4, 13
# The longest delay that is tried, in samples.
MOST_DELAY = 512
# Gains of the force loop, and what their limits are called.
GAINS = {"law.force_integral": "1/s", "law.force_feedback": "", "compensation.rate": "1/s"}
# The poles that a table shows.
SHOWN_POLES = 6


@dataclass
class Page:
    """What is known of a force loop."""

    loop: LinearLoop
    margins: dict[str, Margins]  # by where the loop is cut
    limits: dict[str, Limit | str] = field(default_factory=dict)  # largest stable values by key, or why none was found
    # the longest stable `sensor.delay` of those tried, s; infinite if all are; None if the law reads no force
    delay: float | None = None
    tried: float = math.inf  # the longest that was tried, s

    @property
    def weakest(self) -> Margins:
        """The margins at the sensor, if the law reads it, else those at the torque whose modulus margin is least."""
        sensor = self.margins["sensor"]
        return sensor if sensor.closed else min(self.margins.values(), key=lambda one: one.modulus)

    @property
    def fed_back(self) -> bool:
        """Whether anything is fed back, force or motion."""
        return any(one.closed for one in self.margins.values())

    def sentence(self) -> str:
        """Return the verdict in one sentence."""
        loop = self.loop
        if not loop.stable:
            pole = next(pole for pole in loop.poles() if pole.grows)
            how = f"oscillates at {pole.frequency:.3g} Hz and " if abs(pole.s.imag) > 1e-9 * abs(pole.s) else ""
            what = f"a mode, mostly of the {pole.part}," if self.fed_back else "a motion that nothing controls"
            grows = f"unstable: {what} {how}grows with exp({pole.s.real:.3g} t)"
            ways = [
                f"{name} {'below' if limit.upwards else 'above'} {limit.value:.3g} makes it stable"
                for name, limit in self._limits()
            ]
            return "; ".join([grows, *ways])
        margins = self.weakest
        if not margins.closed:
            return "stable; nothing is fed back"
        decibels = "no gain" if math.isinf(margins.decibels) else f"{margins.decibels:.1f} dB"
        degrees = "no phase lag" if math.isinf(margins.phase) else f"{margins.phase:.0f}°"
        far = f"{decibels} and {degrees} from instability"
        if margins.decibels == math.inf and margins.phase == math.inf:
            far = "no gain and no phase lag makes it unstable"
        where = "" if margins.cut == "sensor" else f"the law reads no force; at {margins.cut} "
        said = [f"stable; {where}{far}"]
        for name, limit in self._limits():
            if limit.upwards:
                if name == "compliance.stiffness":
                    said.append(f"a surface stiffer than {limit.value:.3g} N/m makes it unstable")
                else:
                    unit = GAINS.get(name, "")
                    said.append(f"{name} above {limit.value:.3g}{' ' + unit if unit else ''} makes it unstable")
        return "; ".join(said)

    def _limits(self) -> list[tuple[str, Limit]]:
        return [(name, limit) for name, limit in self.limits.items() if isinstance(limit, Limit)]

    def lines(self) -> list[str]:
        """Return the page as lines of text."""
        loop = self.loop
        found = [self.sentence(), ""]
        kind = "soft" if loop.soft else "rigid"
        mode = {0: "free", 1: "pressed", 2: "stuck"}[loop.mode]
        at = f"{kind} surface, tip {mode}" if loop.mode else f"tip {mode}"
        found.append(f"t = {loop.time:g} s, {at}; {len(loop.states)} states, every {loop.dt:g} s")
        wide = max(22, *map(len, self.margins))
        found += ["", f"{'cut at':{wide}}{'gain':>10}{'phase':>10}{'delay':>12}{'modulus':>10}{'max |S|':>10}"]
        for name, one in self.margins.items():
            if not one.closed:
                found.append(f"{name:{wide}}{'nothing is fed back':>20}")
                continue
            gain = "any" if math.isinf(one.decibels) else f"{one.decibels:.1f} dB"
            phase = "any" if math.isinf(one.phase) else f"{one.phase:.0f}°"
            delay = "any" if math.isinf(one.delay) else f"{1e3 * one.delay:.3g} ms"
            size = f"{one.modulus:>10.3f}{one.peak_sensitivity:>10.2f}"
            found.append(f"{name:{wide}}{gain:>10}{phase:>10}{delay:>12}{size}")
        shown = [pole for pole in loop.poles() if pole.s.imag >= 0.0 and not pole.at_rest][:SHOWN_POLES]
        if shown:
            found += ["", f"{'pole, 1/s':28}{'Hz':>9}{'damping':>9}  belongs to"]
        for pole in shown:
            parts = sorted(pole.participation.items(), key=lambda item: -item[1])
            belongs = ", ".join(f"{name} {100 * share:.0f} %" for name, share in parts if share >= 0.05)
            if math.isinf(pole.s.real):
                text = "over at once"
                found.append(f"{text:28}{'':>9}{'':>9}  {belongs}")
                continue
            text = f"{pole.s.real:.4g}" + (f" ± {pole.s.imag:.4g}i" if pole.s.imag > 0.0 else "")
            found.append(f"{text:28}{pole.frequency:>9.3g}{pole.damping:>9.3f}  {belongs}")
        rest = sum(pole.at_rest for pole in loop.poles())
        if rest:
            found.append(f"{rest} more neither grow nor decay: friction blocks these motions, or no gain acts on them")
        if loop.mode == 0:
            found += ["", "the tip touches nothing: f has no bandwidth, and there is no port"]
            return found + self._limit_lines()
        band = loop.bandwidth()
        found += ["", "bandwidth of the command: " + (f"{band:.3g} Hz" if math.isfinite(band) else
                  f"beyond {0.5 / loop.dt:.3g} Hz, half of the sampling rate")]  # fmt: skip
        port = loop.port()
        found.append(
            "port: passive, so stable on every passive surface"
            if port.passive
            else f"port: not passive, most active at {port.active_at:.3g} Hz"
        )
        return found + self._limit_lines()

    def _limit_lines(self) -> list[str]:
        found = []
        for name, limit in self.limits.items():
            if isinstance(limit, str):
                found.append(f"{name}: {limit}")
            else:
                side = "largest" if limit.upwards else "smallest"
                found.append(f"{name}: {side} stable value {limit.value:.6g}, then {limit.pole.frequency:.3g} Hz")
        if self.delay is not None:
            longest = f"longest stable value {self.delay:.4g} s"
            found.append(f"sensor.delay: {f'no limit up to {self.tried:.3g} s' if math.isinf(self.delay) else longest}")
        return found

    def as_dict(self) -> dict[str, Any]:
        """Return the page as plain values, for JSON: what is infinite, or not known, is None."""
        loop, port = self.loop, self.loop.port()
        band = loop.bandwidth() if loop.mode else math.inf
        return plain({
            "sentence": self.sentence(), "time": loop.time, "dt": loop.dt, "stable": loop.stable,
            "states": loop.states,
            "poles": [pole.as_dict() for pole in loop.poles()],
            "margins": {name: one.as_dict() for name, one in self.margins.items()},
            "bandwidth": band,
            "passive": port.passive if loop.mode else None, "active_at": port.active_at if loop.mode else None,
            "limits": {k: v if isinstance(v, str) else v.as_dict() for k, v in self.limits.items()},
            "longest_delay": self.delay,
        })  # fmt: skip


def trial_line(trial: Trial) -> str:
    """Return one line about whole runs beside the boundary."""
    values = ", ".join(f"{key} = {value:.4g}" for key, value in trial.values.items())
    if math.isinf(trial.seen) and trial.seen > 0.0:
        seen = "a whole run from there on stops"
    else:
        seen = f"two neighbouring runs diverge with exp({trial.seen:+.3g} t)"
    verdict = "" if trial.agrees else ": the two DISAGREE"
    return f"  {values}: linear exp({trial.expected:+.3g} t), {seen}{verdict}"


def page_of(study: Stability, limits: bool = True) -> Page:
    """Return the page of a scenario's loop.

    `limits`: whether the largest stable gains, stiffness and delay are solved for.
    """
    loop = study.base
    cuts = ["sensor", *(each.name for each in loop.inputs if each.name.startswith("torque["))]
    margins = {cut: loop.margins(cut) for cut in cuts}  # of joints without a drive nothing is fed back
    page = Page(loop, {cut: each for cut, each in margins.items() if each.closed or cut == "sensor"})
    if limits:
        page.limits = _limits_of(study)
        if page.margins["sensor"].closed and loop.stable:
            page.delay, page.tried = _longest_delay(study)
    return page


def _limits_of(study: Stability) -> dict[str, Limit | str]:
    scenario, stable = study.scenario, study.base.stable
    wanted: dict[str, float] = {}
    for key in GAINS:
        section, _, name = key.partition(".")
        value = getattr(getattr(scenario, section), name, 0.0)
        if isinstance(value, float | int) and value > 0.0:
            wanted[key] = MOST_GAIN
    if study.base.soft and hasattr(scenario.compliance, "stiffness"):
        wanted["compliance.stiffness"] = MOST_STIFFNESS
    found: dict[str, Limit | str] = {}
    for key, most in wanted.items():
        section, _, name = key.partition(".")
        value = float(getattr(getattr(scenario, section), name))
        end = value * most if stable else value / most
        over = Range(key, value, end, log=True)
        try:
            limits, refused = study.limits(over, looks=LOOKS)
        except ClosedLoopError as error:
            found[key] = str(error)
            continue
        if limits:
            found[key] = limits[0]
        elif refused:
            found[key] = (
                f"{'stable' if stable else 'unstable'} at all values that can be run; others are refused: {refused}"
            )
        else:
            found[key] = f"no limit {'up' if stable else 'down'} to {end:.3g} {key_unit(key)}".rstrip()
    return found


def _longest_delay(study: Stability) -> tuple[float, float]:
    """Return the longest stable delay of the sensor among whole samples, s, and the longest that was tried.

    It is infinite if all up to `MOST_DELAY` samples are stable.
    """
    period = study.scenario.law.sample_period or study.scenario.time.step
    h = study.scenario.time.step
    start = round(study.scenario.sensor.delay / h)

    def stable(samples: int) -> bool:
        try:
            return study.growth({"sensor.delay": samples * h}) < 0.0
        except ClosedLoopError:
            return False

    step = max(1, round(period / h))
    low, high = start, start + step
    while stable(high):
        low, high = high, start + 2 * (high - start)
        if high > start + MOST_DELAY * step:
            return math.inf, low * h
    while high - low > step:
        middle = low + (high - low) // (2 * step) * step
        low, high = (middle, high) if stable(middle) else (low, middle)
    return low * h, high * h


@dataclass(frozen=True, eq=False)
class Overview:
    """A force loop at an instant, as a sentence and as arrays to draw.

    `sentence`: whether it is stable, and how far from instability, or what grows and how fast.
    `time`: the instant, s: the sample of the law nearest to the one asked for.
    `poles`, (k,) tuple of Pole: the slowest to decay first. Of each `z`, `s`, `frequency`, `damping`, `part` and
        `participation`.
    `margins`: where the loop is cut, `margins.cut`: at the sensor, or of a law that reads no force at the torque where
        the modulus margin is least.
    `frequency` (m,): of the curves, Hz, rising, up to half of the sampling rate.
    `transfer`, (m,) array of complex: L where the loop is cut: real and imaginary part are Nyquist's diagram.
    `gain`, `phase`, (m,) arrays: |L|, dB, at least −240, and the angle of L without jumps, degrees: Bode's diagram.
    `sensitivity` (m,): |1/(1 + L)|.
    `loop`: all else of it: `loop.response(...)`, `loop.port()`.
    """

    sentence: str
    stable: bool
    time: float
    poles: tuple[Pole, ...]
    margins: Margins
    frequency: Array
    transfer: ComplexArray
    gain: Array
    phase: Array
    sensitivity: Array
    loop: LinearLoop


def overview(loop: LinearLoop) -> Overview:
    """Return the sentence, margins, poles and Bode's curves of a loop, from `linearise`.

    With compiled kernels both take 5 µs for each step of the run up to the instant, and some 25 ms for the loop and its
    margins, 40 ms for one that is cut at its torques. Interpreted, as before the kernels are compiled, it is 0.3 ms a
    step.
    """
    margins = {"sensor": loop.margins("sensor")}
    if not margins["sensor"].closed:
        torques = [each.name for each in loop.inputs if each.name.startswith("torque[")]
        margins |= {cut: loop.margins(cut) for cut in torques}
    page = Page(loop, margins)
    weakest = page.weakest
    f = loop.grid
    L = loop.loop_transfer(f, weakest.cut)
    size = 20.0 * np.log10(np.maximum(np.abs(L), 1e-12))
    with np.errstate(divide="ignore"):
        S = 1.0 / np.abs(1.0 + L)
    return Overview(
        page.sentence(), loop.stable, loop.time, loop.poles(), weakest, f, L, size,
        np.degrees(np.unwrap(np.angle(L))), S, loop,
    )  # fmt: skip
