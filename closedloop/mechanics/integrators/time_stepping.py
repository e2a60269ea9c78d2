"""Moreau and Jean's time stepping: the semi-implicit Euler scheme with one problem of impulses for each step."""

from closedloop.mechanics.integrators import Integrator


class TimeStepping(Integrator):
    """No events within a step, see `closedloop.mechanics.contacts.stepping`."""

    order = 1
    a = ((),)
    b = (1.0,)
    semi_implicit = True
    time_stepping = True
    source = "Moreau, in Nonsmooth Mechanics and Applications, Springer, 1988"
