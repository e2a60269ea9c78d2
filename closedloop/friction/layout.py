"""The laws of friction by number, and where each parameter and state lies in the arrays that the kernels read."""

from __future__ import annotations

from closedloop.jit.kernel import kernel

NONE, COULOMB, COULOMB_VISCOUS, STRIBECK, KARNOPP, DAHL, LUGRE, SEVEN_PARAMETER = range(8)

KINDS: dict[str, int] = {
    "none": NONE,
    "coulomb": COULOMB,
    "coulomb_viscous": COULOMB_VISCOUS,
    "stribeck": STRIBECK,
    "karnopp": KARNOPP,
    "dahl": DAHL,
    "lugre": LUGRE,
    "seven_parameter": SEVEN_PARAMETER,
}
"""Name of a law, as in `kind` of a section, to the number that the kernels take."""

STICKS: dict[int, str] = {
    NONE: "elastic",
    COULOMB: "rigid",
    COULOMB_VISCOUS: "rigid",
    STRIBECK: "rigid",
    KARNOPP: "rigid",
    DAHL: "elastic",
    LUGRE: "elastic",
    SEVEN_PARAMETER: "spring",
}
"""How a law sticks.

rigid    sticking is a constraint, u = 0, which the simulator solves; it ends at `stick_limit`
elastic  no mode of its own: one smooth law, with states (none has neither force nor states)
spring   a mode in which the force is that of a spring (`holding`); it ends at `stick_limit`
"""

# A row of parameters, (PARAMETERS,). For a surface the first block is without unit and is multiplied by the normal
# force f; for a joint it is in N m, and f = 1. Lengths and speeds are m and m/s for a surface, rad, rad/s for a joint.
KINETIC = 0  # level at sliding, F_C
STATIC = 1  # level that sliding starts from, F_S
STATIC_EXCESS = 2  # seven_parameter: excess of the static level over F_C after a long rest, F_S∞
STRIBECK_SPEED = 3  # v_s, m/s
EXPONENT = 4  # of the Stribeck curve, 1
VISCOUS = 5  # N s/m for a surface (not multiplied by f), N m s/rad for a joint
STIFFNESS = 6  # σ_0, k_t: 1/m for a surface, N m/rad for a joint
DAMPING = 7  # σ_1: s/m for a surface, N m s/rad for a joint
DAMPING_SPEED = 8  # v_d, m/s; infinite: σ_1 does not fall
DEAD_BAND = 9  # karnopp: D_v, m/s
MEMORY_DELAY = 10  # seven_parameter: τ_L, s
RISE_TIME = 11  # seven_parameter: γ, s
PARAMETERS = 12

# States of seven_parameter: dwell time t_d, s; F_Sa; then the displacement x (d,), m. Of dahl and lugre: z (d,), m.
DWELL, LAST, DISPLACEMENT = 0, 1, 2

# Slip below this speed, m/s or rad/s, has no direction of its own: it is rounding.
STILL = 1e-12


@kernel
def state_count(kind: int, d: int) -> int:
    """Return the number of states z of a law for slip vectors of length d (1: a joint, 2: a surface)."""
    if kind in (DAHL, LUGRE):
        return d
    return DISPLACEMENT + d if kind == SEVEN_PARAMETER else 0
