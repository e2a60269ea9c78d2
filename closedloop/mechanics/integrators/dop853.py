"""Dormand and Prince's scheme of order 8 with step control and dense output, stepped by scipy.integrate.DOP853."""

from closedloop.mechanics.integrators import AdaptiveIntegrator


class DOP853(AdaptiveIntegrator):
    """Twelve stages, order 8, error estimates of order 5 and 3."""

    order = 8
    source = (
        "Prince and Dormand 1981 as DOP853; Hairer, Norsett, Wanner, Solving Ordinary Differential Equations I, II.5 "
        "and II.6"
    )
