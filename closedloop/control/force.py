"""The force that a law commands: what is wanted, with feedback from the force sensor if asked for.

    f_c = f_des + K_f (f_des − f_s) + K_I ∫ (f_des − f) dt

f_s is the latest reading, so K_f acts with a delay; the integral is a state. With an exact model and a rigid
surface f = f_c + d, d being what the model leaves out. Then e_f = f_des − f obeys, without K_f, ė_f = −K_I e_f:
the force settles like exp(−K_I t) whatever the arm. A reading that is one sample old makes of K_f alone the
iteration f ← (1 + K_f) f_des − K_f f + d, which converges for K_f < 1 only; behind a low-pass of time
constant T sampled every h, K_f may be up to T/h (`closedloop.control.stability`).

Source: the integral force servo of Yoshikawa, IEEE J. Robotics and Automation 3(5), 1987, and of Volpe and
Khosla, IEEE Trans. Automatic Control 38(11), 1993, who compare the explicit force laws.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from closedloop.control.law_input import LawInput
from closedloop.control.parameters import K_F, K_I
from closedloop.jit.kernel import kernel

Array = NDArray[np.float64]


@kernel
def commanded_force(x: LawInput, par: Array, z: Array) -> float:
    """Return f_c, N.

    In free motion there is no force to be fed back, and f_c = f_des; but feedback that drew the tip off the surface, as
    after too high a reading, does not press it back in the same instant: what it takes from f_des it takes there too,
    until the reading is that of free motion and the integral has recovered.
    """
    feedback = 0.0
    if par[K_F] != 0.0:
        feedback += par[K_F] * (x.f_des - x.f_measured)
    if par[K_I] != 0.0:
        feedback += par[K_I] * z[0]
    if x.pressed == 0.0:
        feedback = min(feedback, 0.0)
    return x.f_des + feedback


@kernel
def integral_rate(x: LawInput, par: Array, z: Array, f: float, dz: Array) -> None:
    """Write the rate of z[0] = ∫ (f_des − f) dt, N s.

    In free motion it rests, so that it does not wind up; only what is below zero recovers, if the tip is to press.
    """
    if par[K_I] != 0.0:
        rate = x.f_des - f
        dz[0] = rate if x.pressed != 0.0 or (z[0] < 0.0 < min(rate, x.f_des)) else 0.0
