"""The explicit Euler scheme: v⁺ = v + h q̈(q, v), q⁺ = q + h v."""

from closedloop.mechanics.integrators import Integrator


class ExplicitEuler(Integrator):
    """Position and velocity advance with the rates at the beginning of the step."""

    order = 1
    a = ((),)
    b = (1.0,)
    source = "Euler 1768; Hairer, Norsett, Wanner, Solving Ordinary Differential Equations I, I.7"
