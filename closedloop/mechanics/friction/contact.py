"""A law of friction at one contact, for use from Python: its functions, interpreted, on states of its own.

contact = surface_contact(SurfaceLuGre(kinetic=0.2, static=0.3, stribeck_speed=1e-3, stiffness=1e4, damping=30.0))
contact.advance(np.array([0.01, 0.0]), 1e-3)
c, w = contact.slide(np.array([0.01, 0.0]))
"""

from typing import Any

import numpy as np

from closedloop.base.arrays import Array
from closedloop.jit.interpreted import interpreted
from closedloop.jit.kernel import kernel_of
from closedloop.jit.parameters import state_block
from closedloop.mechanics.friction.law import FrictionLaw, Slip, joint_parameters, surface_parameters


class Contact:
    """One contact, of the tip (d = 2) or in a joint (d = 1), with its parameters and states.

    A simulator that uses every law

        start          `rested` for a contact that has been there for long; else its states are zero
        each state     stuck and sticks "rigid": u = 0 is a constraint; "spring": `hold`; otherwise: `slide`
        each step      `rates` in a Runge-Kutta scheme, or `advance` with the slip of the step
        slip ends      |u| = 0, or <= `capture_speed`, and `stick_limit` f is enough to hold it: `stick`, stuck
        stick ends     the force reaches `stick_limit` f: no longer stuck

    Parameters
    ----------
    d : int
        Length of a slip vector.

    Attributes
    ----------
    states : (k,) array
        The states, zero at first; `z` has them by name.
    """

    def __init__(self, member: type[FrictionLaw], par: Any, d: int) -> None:
        self.member, self.par, self.d = member, par, d
        self._kind = state_block(member)
        self.states = np.zeros(self._kind.count(d))
        self.z: Any = self._kind(self.states, d)
        self._functions: dict[str, Any] = {}

    def _call(self, name: str, *arguments: Any) -> Any:
        if name not in self._functions:
            self._functions[name] = interpreted(kernel_of(self.member, name))
        return self._functions[name](*arguments)

    def _slip(self, u: Array, delayed_speed: float | None = None, direction: Array | None = None) -> Slip:
        speed = float(abs(u[0]) if u.size == 1 else np.hypot(u[0], u[1]))
        along = np.zeros_like(u) if direction is None else direction
        return Slip(u, speed, speed if delayed_speed is None else delayed_speed, along)

    def slide(
        self, u: Array, delayed_speed: float | None = None, direction: Array | None = None
    ) -> tuple[Array, Array]:
        """Return c and w (d,) of slip u (d,), m/s; what is left out is |u|, and zero."""
        c, w = np.zeros(self.d), np.zeros(self.d)
        self._call("slide", self._slip(u, delayed_speed, direction), self.par, self.z, c, w)
        return c, w

    def hold(self) -> Array:
        """Return c (d,) while it is stuck on a spring."""
        c = np.zeros(self.d)
        self._call("hold", self.par, self.z, c)
        return c

    def rates(self, u: Array, stuck: bool = False) -> Array:
        """Return ż (k,)."""
        dz = np.zeros_like(self.states)
        self._call("rates", self._slip(u), self.par, self.z, stuck, self._kind(dz, self.d))
        return dz

    def advance(self, u: Array, h: float, stuck: bool = False) -> None:
        """Let h seconds pass at slip u (d,)."""
        self._call("advance", self._slip(u), self.par, self.z, stuck, h)

    def stick(self, direction: Array, delayed_speed: float = 0.0) -> None:
        """Let slip along the unit vector `direction` (d,) end and sticking begin."""
        self._call("stick", self._slip(np.zeros(self.d), delayed_speed, direction), self.par, self.z)

    def rested(self) -> Array:
        """Let it have rested for long, and return its states (k,)."""
        self.states[:] = 0.0
        self._call("rest", self.par, self.z)
        return self.states

    def stored_energy(self, stuck: bool = False) -> float:
        """Return the energy stored per newton of normal force, m; of a joint, J."""
        return float(self._call("stored_energy", self.par, self.z, stuck))

    @property
    def stick_limit(self) -> float:
        """The largest |F_t|/f that sticking resists."""
        return float(self._call("stick_limit", self.par, self.z))

    @property
    def kinetic_level(self) -> float:
        """|F_t|/f of fast slip without its viscous part."""
        return float(self._call("kinetic_level", self.par))

    @property
    def capture_speed(self) -> float:
        """The slip speed up to which sticking is tried, m/s (rad/s)."""
        return float(self._call("capture_speed", self.par))

    @property
    def lag(self) -> float:
        """By how much the friction lags the slip, s."""
        return float(self._call("lag", self.par))


def surface_contact(section: FrictionLaw) -> Contact:
    """Return the contact of the tip on a surface."""
    return Contact(type(section), surface_parameters(section), 2)


def joint_contacts(section: FrictionLaw, n: int | None = None) -> list[Contact]:
    """Return the contacts in joints, see `closedloop.mechanics.friction.law.joint_parameters`."""
    return [Contact(type(section), par, 1) for par in joint_parameters(section, n)]
