"""How a law of friction is asked: in one way for the surface's, for that of joints and for contacts of links.

An entry of a law has its numbers from where its loop has them, and calls what `answers` makes of the law.
"""

from collections.abc import Callable
from typing import Any

from closedloop.base.arrays import Array
from closedloop.jit.kernel import kernel_inlined
from closedloop.jit.user_code import function_of
from closedloop.mechanics.friction.law import FrictionLaw, Slip
from robot_models.cached import cached

# What is asked: the rates of the states and their decay; c and w while it slides, or while a spring holds it; the
# states `span` seconds later; the limit of sticking; the states where slip along `direction` has ended. A control law
# is asked for the first too, and for others that come before, see `closedloop.loop.step.entries`.
RATES, SLIDE, HOLD, ADVANCE_STATES, LIMIT, STICK = range(3, 9)


@cached
def answers(member: type[FrictionLaw]) -> Callable[..., float]:
    """Return the function that asks a law for what its first argument says, and returns the limit, or 0.

    It takes the slip, the parameters and states by name, whether it is stuck, c and w, the rates of the states and
    their decay by name, and the span, s. Of what it writes c and w are zero at first.
    """
    slide, hold, rates, decay = (function_of(member, name) for name in ("slide", "hold", "rates", "decay"))
    advance, stick_limit, stick = (function_of(member, name) for name in ("advance", "stick_limit", "stick"))

    @kernel_inlined
    def answer(
        what: int, x: Slip, par: Any, z: Any, stuck: bool, c: Array, w: Array, dz: Any, decays: Any, span: float
    ) -> float:
        if what in (SLIDE, HOLD):
            for k in range(c.shape[0]):
                c[k], w[k] = 0.0, 0.0
            if what == SLIDE:
                slide(x, par, z, c, w)
            else:
                hold(par, z, c)
        elif what == RATES:
            rates(x, par, z, stuck, dz)
            decay(x, par, z, stuck, decays)
        elif what == ADVANCE_STATES:
            advance(x, par, z, stuck, span)
        elif what == STICK:
            stick(x, par, z)
        elif what == LIMIT:
            return stick_limit(par, z)
        return 0.0

    return answer
