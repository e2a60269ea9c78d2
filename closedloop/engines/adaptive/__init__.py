"""The adaptive integrator of high order: the truth that steps of fixed length are held against.

scipy's DOP853 runs through each stretch on which all that acts is smooth, choosing its steps by `time.tolerance`. Law,
contact and Eq. 24 are those of `closedloop.step.evaluate`. Inside a step the state is the solver's own interpolant:
events are located on it, and rows are taken from it, with force and acceleration evaluated anew at the row's state.
What an event does is left to `closedloop.events`, as though it were at a row; so is the projection, where the scenario
has one, at every step and every row.

smooth      what is desired, as a polynomial between jumps
crossing    the first instant at which an event function falls below zero
slow        slow slip, where dry friction is stiff: an implicit scheme takes over
kernels     the kernels of a step, to be asked about any state at any instant
memory      the loop's memory, and the calls on it
run         stretches, steps, events and rows
"""

from __future__ import annotations

from closedloop.engines.adaptive.drive import run_adaptive

__all__ = ["run_adaptive"]
