"""Any law with any compensation, for the step: torque before Eq. 24 is solved, rates of the states after it.

start_states   z at the beginning of a run
law_torque     Q of an instant
law_rates      ż of the same instant, once Eq. 24 has said what the contact force is
restart        z after an impact that the controller knows of
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from closedloop.control.admittance import admittance, admittance_rates
from closedloop.control.compensation.adaptive import adaptive_rates, add_adapted
from closedloop.control.compensation.model import add_model
from closedloop.control.compensation.observer import add_observed, observer_rates, restart_observer
from closedloop.control.dynamic_hybrid import dynamic_hybrid
from closedloop.control.force import commanded_force, integral_rate
from closedloop.control.hybrid import hybrid
from closedloop.control.impedance import impedance
from closedloop.control.law_input import LawInput
from closedloop.control.operational_space import operational_space
from closedloop.control.paper import paper_law
from closedloop.control.parameters import (
    ADAPTIVE,
    ADMITTANCE,
    COMPENSATION,
    DYNAMIC_HYBRID,
    HYBRID,
    IMPEDANCE,
    MODEL,
    OBSERVER,
    OPERATIONAL_SPACE,
    PAPER,
    PD_START,
    VECTORS,
    compensation_place,
    law_place,
)
from closedloop.jit.kernel import kernel

Array = NDArray[np.float64]


@kernel
def law_torque(kind: int, x: LawInput, par: Array, gains: Array, z: Array, work: Array, torque: Array) -> None:
    """Write Q (n,), N m.

    Parameters
    ----------
    kind : int
        See `closedloop.control.parameters.LAWS`.
    x : LawInput
    par, gains : (PARAMETERS + 2 n,), (2, n) arrays
        From `closedloop.control.pack.pack_law`.
    z : (states(kind, par, n),) array
        States of the law and its compensation; read.
    work : (work_size(n),) array
        Scratch.
    torque : (n,) array
        Written.
    """
    n = torque.shape[0]
    f = commanded_force(x, par, z)
    if kind == PAPER:
        work[0], work[1] = f, par[PD_START]
        path = work[VECTORS : VECTORS + 2 * n].reshape(2, n)
        for j in range(n):
            path[0, j], path[1, j] = x.q_des[j], x.v_des[j]
        paper_law(x.t, work, gains, path, x.q, x.v, x.C, x.A, torque)
    elif kind == HYBRID:
        hybrid(x, par, gains, f, work, torque)
    elif kind == OPERATIONAL_SPACE:
        operational_space(x, par, gains, f, work, torque)
    elif kind == DYNAMIC_HYBRID:
        dynamic_hybrid(x, par, gains, f, work, torque)
    elif kind == IMPEDANCE:
        impedance(x, par, gains, f, work, torque)
    elif kind == ADMITTANCE:
        at = law_place(par)
        admittance(x, par, gains, f, z[at : at + 2], work, torque)
    compensation = int(par[COMPENSATION])
    at = compensation_place(kind, par)
    if compensation == MODEL:
        add_model(x, par, torque)
    elif compensation == OBSERVER:
        add_observed(x, par, z[at : at + n], work, torque)
    elif compensation == ADAPTIVE:
        add_adapted(x, par, z[at : at + 2], torque)


@kernel
def law_rates(kind: int, x: LawInput, par: Array, z: Array, f: float, torque: Array, work: Array, dz: Array) -> None:
    """Write ż.

    Parameters
    ----------
    kind, x, par, z, work
        As for `law_torque`.
    f : float
        Contact force of this instant as the force sensor gives it, N.
    torque : (n,) array
        Q that acts at this instant (a held one, where the law is sampled), N m.
    dz : (states(kind, par, n),) array
        Written.
    """
    n = torque.shape[0]
    integral_rate(x, par, z, f, dz)
    if kind == ADMITTANCE:
        at = law_place(par)
        admittance_rates(x, par, z[at : at + 2], f, dz[at : at + 2])
    compensation = int(par[COMPENSATION])
    at = compensation_place(kind, par)
    if compensation == OBSERVER:
        observer_rates(x, par, z[at : at + n], f, torque, work, dz[at : at + n])
    elif compensation == ADAPTIVE:
        adaptive_rates(x, par, z[at : at + 2], dz[at : at + 2])


@kernel
def start_states(kind: int, x: LawInput, par: Array, z: Array) -> None:
    """Write z at the start: nothing learned, the set point of an admittance at the tip, the observer at rest."""
    for i in range(z.shape[0]):
        z[i] = 0.0
    if kind == ADMITTANCE and x.pressed == 0.0:
        z[law_place(par)] = x.p[0] - x.p_des[0]
    if int(par[COMPENSATION]) == OBSERVER:
        at = compensation_place(kind, par)
        for j in range(x.v.shape[0]):
            z[at + j] = x.v[j]


@kernel
def restart(kind: int, par: Array, dv: Array, z: Array) -> None:
    """Tell the states of an impact that changed the joint velocity by dv (n,), rad/s: no force is read into it."""
    if int(par[COMPENSATION]) == OBSERVER:
        at = compensation_place(kind, par)
        restart_observer(dv, z[at : at + dv.shape[0]])
