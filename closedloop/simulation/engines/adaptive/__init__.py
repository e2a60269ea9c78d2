"""The adaptive integrator of high order: the reference for integrators of fixed step.

scipy's DOP853 integrates each interval on which the right-hand side is smooth, with steps chosen by `time.tolerance`.
Law, contact and Eq. 24 are those of `closedloop.loop.step.evaluate`. Inside a step the state is the solver's dense
output: events are located on it, and rows are taken from it, with force and acceleration evaluated again at the row's
state. Events are applied by `closedloop.loop.events`, as though they were at a row; so is the projection, where the
scenario has one, at every step and every row.

smooth      the reference as a polynomial between its discontinuities; the first root of an event function in a step
memory      the loop's memory, and the calls on it
drive       intervals, steps, events and rows; slow slip, where dry friction is stiff: an implicit scheme
"""
