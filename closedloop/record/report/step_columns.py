"""The errors that the steps of a run add, of its whole columns, see `closedloop.record.report.step_variation`."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from closedloop.base.arrays import Array
from closedloop.jit.interpreted import interpreted
from closedloop.mechanics.closure.contact_force import FREE
from closedloop.mechanics.integrators import scheme_of
from closedloop.record.columns.record import Record
from closedloop.record.report.step_variation import ENDING, SPAN, Swing, Swings, cut_slope, local_error
from closedloop.scenario.scenario import Scenario

# Rows in one mode of contact of which the signals are taken one by one.
LONG = 2048


def write_swings(run: Record, swings: Swings) -> None:
    """Write what the rows of a run, at least one, come to, see `closedloop.record.report.step_variation`."""
    signals = np.empty((1 + run.position.shape[1], len(run)))
    np.multiply(run.contact_force - run.reference_force, run.mode != FREE, out=signals[0])
    np.subtract(run.position.T, run.reference_tip.T, out=signals[1:])
    (held, order, sampled), total = resolution_of(run.scenario), np.zeros(signals.shape[0])
    ends = [0, *(np.flatnonzero(np.diff(run.mode)) + 1), len(run)]
    swings.stretches, swings.steepest, swings.jump, swings.struck, swings.begun = len(ends) - 1, 0.0, 0.0, 0.0, 0.0
    swings.changed = swings.sticks = swings.ended = 0.0
    for begin, end in pairwise(ends):
        # Of long stretches one signal after the other: what is between would take as much memory as half the columns.
        each = 1 if end - begin > LONG else signals.shape[0]
        for k in range(0, signals.shape[0], each):
            stretch = signals[k : k + each, -(-begin // held) * held : end : held]
            cut = cut_slopes(stretch)
            total[k : k + each] += _errors(stretch, cut, order) / held
            if k == 0:
                sizes, size = np.abs(np.diff(stretch[0])), np.abs(cut[0])
                last = np.max(size[-1:] + ENDING * (sizes[-1:] - size[-1:]), initial=0.0)
                swings.steepest = max(swings.steepest, np.max(size, initial=last) / held)
                swings.jump = max(swings.jump, np.max(sizes - size[: sizes.size], initial=0.0))
                swings.ended = sizes[-1] - size[-1] if sizes.size else 0.0
        if begin:
            around = run.contact_force[begin - 1 : begin + 1] * (run.mode[begin - 1 : begin + 1] != FREE)
            swings.changed = max(swings.changed, abs(around[1] - around[0]))
            swings.sticks = max(swings.sticks, float(np.all(run.mode[begin - 1 : begin + 1] != FREE)))
        if begin and run.mode[begin] != FREE and run.mode[begin - 1] == FREE:
            swings.begun = max(swings.begun, abs(run.reference_force[begin] - run.reference_force[begin - 1]))
            swings.struck = max(swings.struck, abs(signals[0, begin]) if sampled else 0.0)
    swings.kick = _kick(run, held) if sampled else 0.0
    swings.ramp = np.max(np.abs(cut_slopes(run.reference_force[None])[:, :-1]), initial=0.0)
    low, high = np.min(signals, axis=1), np.max(signals, axis=1)
    for k, error in enumerate(total):
        swing = Swing(swings.each[k])
        swing.error, swing.lowest, swing.highest = error, low[k], high[k]


def _kick(run: Record, held: int) -> float:
    """Return `Swings.kick` of a run whose torque is held for so many rows."""
    torque, touching = run.torque[::held], run.mode[::held] != FREE
    size = np.zeros(max(0, len(torque) - 2))
    for column in torque.T:
        size += np.abs(cut_slopes(column[None])[0, : size.size])
    return float(np.max(size * touching[2:], initial=0.0))


def resolution_of(scenario: Scenario) -> tuple[int, int, int]:
    """Return for how many steps the law's torque is held, at least 1, the order of the scheme, and whether it is held.

    A law that is sampled leaves every scheme the order one.
    """
    period, scheme = scenario.law.sample_period, scheme_of(scenario.time.integrator)
    held = max(1, round(period / scenario.time.step)) if period else 1
    sampled = bool(period or scenario.reads_encoders)
    return held, 1 if scheme is None or sampled else scheme.order, int(sampled)


def cut_slopes(signals: Array) -> Array:
    """Return the differences of signals (k, N) from row to row, isolated ones cut, (k, max(N - 1, 0))."""
    steps = np.zeros((signals.shape[0], max(signals.shape[1], 1) + 1))  # beside the first and the last there is none
    np.subtract(signals[:, 1:], signals[:, :-1], out=steps[:, 1:-1])
    return interpreted(cut_slope)(steps[:, :-2], steps[:, 1:-1], steps[:, 2:])


def variation(signal: Array, order: int = 1) -> float:
    """Return what the steps of a scheme of this order add to the error of a signal (N,), summed.

    Of fewer than four rows it is half of their range: nothing is known of what they resolve.
    """
    return float(_errors(signal[None], cut_slopes(signal[None]), order)[0])


def _errors(signals: Array, cut: Array, order: int) -> Array:
    """Return `variation` of signals (k, N) with these cut differences, (k,)."""
    if signals.shape[1] < SPAN:
        return 0.5 * np.ptp(signals, axis=1) if signals.shape[1] else np.zeros(signals.shape[0])
    turns = np.zeros((cut.shape[0], cut.shape[1] + 1))
    np.subtract(cut[:, 1:], cut[:, :-1], out=turns[:, 1:-1])
    if order == 1:
        whole = cut == np.diff(signals)  # see `closedloop.record.report.step_variation.turn_of`
        turns = np.abs(turns, out=turns)
        turns[:, 1:-1] *= whole[:, 1:] & whole[:, :-1]
        return np.asarray(interpreted(local_error)(0.0, np.sum(turns, axis=1), 0.0, order))
    # One signal after the other: what is between stays in the processor's cache.
    return np.array([np.sum(interpreted(local_error)(x[:-2], x[1:-1], x[2:], order)) for x in turns])
