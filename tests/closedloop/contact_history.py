"""Consistency of the events of a run with the modes of its rows."""

import numpy as np

FREE, PRESSED = 0, 1
# An event nearer to a row than this, s, happens at the row: just before it is recorded, or just after.
AT_ROW = 1e-13


def assert_one_story(run):
    """Fail unless the events of a run without friction follow from each other, and the modes of its rows from them.

    Contact begins with a touchdown and ends with a liftoff, in turn, and a tip bounces only while it is free. The mode
    of every row is the one that the events up to it have left.
    """
    kinds, times = [event.kind for event in run.events], run.event_time
    assert np.all(np.diff(times) >= 0.0)
    if not kinds:
        assert np.all(run.mode == run.mode[:1])
        return
    modes = [PRESSED if kinds[0] == "liftoff" else FREE]
    for event, kind in enumerate(kinds):
        assert kind in ("impact", "touchdown", "liftoff")
        begins = PRESSED if kind == "liftoff" else FREE
        assert modes[-1] == begins, f"event {event} of {kinds} is a {kind} of a tip in mode {modes[-1]}"
        modes.append(PRESSED if kind == "touchdown" else FREE)
    first = np.searchsorted(times, run.time - AT_ROW, side="left")
    last = np.searchsorted(times, run.time + AT_ROW, side="right")
    for k, mode in enumerate(run.mode):
        assert mode in modes[first[k] : last[k] + 1], f"row {k} is in mode {mode} among {kinds} at {times}"
