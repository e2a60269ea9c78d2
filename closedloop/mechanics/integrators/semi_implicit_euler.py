"""The semi-implicit (symplectic) Euler scheme, the paper's: v⁺ = v + h q̈(q, v), q⁺ = q + h v⁺."""

from closedloop.mechanics.integrators import Integrator


class SemiImplicitEuler(Integrator):
    """The position advances with the new velocity."""

    order = 1
    a = ((),)
    b = (1.0,)
    semi_implicit = True
    source = "Hairer, Lubich, Wanner, Geometric Numerical Integration, I.1"
