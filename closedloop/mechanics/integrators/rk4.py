"""The classical Runge-Kutta scheme: k₁ at 0, k₂ and k₃ at h/2, k₄ at h; y⁺ = y + h (k₁ + 2 k₂ + 2 k₃ + k₄)/6."""

from closedloop.mechanics.integrators import Integrator


class RK4(Integrator):
    """Four stages, order 4."""

    order = 4
    a = ((), (0.5,), (0.0, 0.5), (0.0, 0.0, 1.0))
    b = (1 / 6, 1 / 3, 1 / 3, 1 / 6)
    first = ((), (0.5,), (0.0, 0.5), (0.5, 0.0, 0.0), (1 / 4, 1 / 6, 1 / 6, -1 / 12))
    source = (
        "Kutta 1901; Hairer, Norsett, Wanner, Solving Ordinary Differential Equations I, II.1; first: Celledoni, "
        "Marthinsen, Owren 2003"
    )
