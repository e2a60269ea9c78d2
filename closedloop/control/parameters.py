"""Which law, which compensation, and where each of their numbers stands in the arrays that a step works on."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from closedloop.jit.kernel import kernel, plain

Array = NDArray[np.float64]

PAPER, HYBRID, OPERATIONAL_SPACE, DYNAMIC_HYBRID, IMPEDANCE, ADMITTANCE = range(6)
LAWS = {
    "paper": PAPER,
    "hybrid": HYBRID,
    "operational_space": OPERATIONAL_SPACE,
    "dynamic_hybrid": DYNAMIC_HYBRID,
    "impedance": IMPEDANCE,
    "admittance": ADMITTANCE,
}

NONE, MODEL, OBSERVER, ADAPTIVE = range(4)
COMPENSATIONS = {"none": NONE, "model": MODEL, "observer": OBSERVER, "adaptive": ADAPTIVE}

# --- parameters: par (PARAMETERS + 2 n,) -----------------------------------------------------------------------------
K_F, K_I = 0, 1  # force feedback: proportional, no unit; integral, 1/s
PD_START = 2  # paper: instant from which the PD part acts, s
K_P, K_V = 3, 4  # motion of the tip: 1/s², 1/s
APPROACH = 5  # speed at which a tip that is to press seeks the surface, m/s
INERTIA, DAMPING, STIFFNESS = 6, 7, 8  # admittance: kg, N s/m, N/m; impedance along the surface: the last two
NORMAL_DAMPING, NORMAL_STIFFNESS = 9, 10  # impedance along the normal: N s/m, N/m
COMPENSATION = 11
# model: friction as it is believed to be
KINETIC, STATIC, STRIBECK_SPEED, VISCOUS, SMOOTHING, JOINT_SMOOTHING = range(12, 18)
RATE = 12  # observer: 1/s
ADAPTATION, CORNER, SPEED_SCALE = 12, 13, 14  # adaptive: 1/m, 1/s, m/s (and SMOOTHING)
PARAMETERS = 18  # then n joint Coulomb torques and n viscous coefficients (model)

# --- scratch: work (work_size(n),) -----------------------------------------------------------------------------------
INVERSE, EIGEN, WANTED, FORCE, SPARE, VECTORS = 0, 9, 27, 30, 33, 36


@kernel
def work_size(n: int) -> int:
    """Return how many numbers of scratch a law needs for n joints."""
    return VECTORS + 3 * n


# --- states: z = [force integral, if any; the law's own; the compensation's] -----------------------------------------
@kernel
def law_place(par: Array) -> int:
    """Return where the law's own states begin."""
    return 1 if par[K_I] != 0.0 else 0


@kernel
def compensation_place(kind: int, par: Array) -> int:
    """Return where the compensation's states begin."""
    return law_place(par) + law_states(kind)


@kernel
def law_states(kind: int) -> int:
    """Return how many states the law has of its own."""
    return 2 if kind == ADMITTANCE else 0


def states(kind: int, par: Array, n: int) -> int:
    """Return how many states the law and its compensation have together for n joints."""
    compensation = int(par[COMPENSATION])
    own = n if compensation == OBSERVER else (2 if compensation == ADAPTIVE else 0)
    return plain(law_place)(par) + plain(law_states)(kind) + own
