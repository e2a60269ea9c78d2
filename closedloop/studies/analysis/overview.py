"""What is known of a force loop at once, for a display that follows its sliders: no limits are solved for."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from closedloop.base.arrays import Array, ComplexArray
from closedloop.studies.analysis.linear_loop import LinearLoop
from closedloop.studies.analysis.margins import Margins
from closedloop.studies.analysis.page import Page
from closedloop.studies.analysis.poles import Pole


@dataclass(frozen=True, eq=False)
class Overview:
    """A force loop at an instant, as a sentence and as arrays to draw.

    Attributes
    ----------
    sentence : str
        Whether it is stable, and how far from instability, or what grows and how fast.
    stable : bool
    time : float
        The instant, s: the sample of the law nearest to the one asked for.
    poles : (k,) tuple of Pole
        The slowest to decay first. Of each `z`, `s`, `frequency`, `damping`, `part` and `participation`.
    margins : Margins
        Where the loop is cut, `margins.cut`: at the sensor, or of a law that reads no force at the torque where the
        modulus margin is least.
    frequency : (m,) array
        Of the curves, Hz, rising, up to half of the sampling rate.
    transfer : (m,) array of complex
        L where the loop is cut: real and imaginary part are Nyquist's diagram.
    gain, phase : (m,) arrays
        |L|, dB, at least −240, and the angle of L without jumps, degrees: Bode's diagram.
    sensitivity : (m,) array
        |1/(1 + L)|.
    loop : LinearLoop
        All else of it: `loop.response(...)`, `loop.port()`.
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
