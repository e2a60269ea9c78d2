"""What a motion along a surface needs: how it is bent from point to point, and how it carries what lies on it.

And the gradient of φ at points of a motion: where it vanishes or jumps the surface has no normal.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from closedloop.base.arrays import Array
from closedloop.jit import background
from closedloop.jit.calls import call_at, entry_address
from closedloop.jit.interim import at_hand
from closedloop.jit.interpreted import interpreted, twin_address
from closedloop.jit.kernel import entry_kernel
from closedloop.jit.user_code import of_users
from closedloop.mechanics.surface.contact import LEVEL, ask_at, motion_entry, normals_on_surface, surface_entry
from closedloop.mechanics.surface.geometry import Pose, Touch
from closedloop.mechanics.surface.placed import PlacedSurface


@entry_kernel
def gradients_on_surface(entry: int, address: int, times: Array, r: Array, gradients: Array) -> int:
    """Write ∇φ (N, 3), surface's axes, at points r (N, 3), m, base frame, at times (N,), s; return N.

    `entry` and `address` are of the surface and of its memory.
    """
    _, ask = ask_at(address)
    touch = Touch(ask.touch)
    for k in range(times.size):
        ask.time = times[k]
        for i in range(3):
            ask.r[i] = r[k, i]
        call_at(entry, address, LEVEL)
        for i in range(3):
            gradients[k, i] = touch.gradient[i]
    return int(times.size)


def gradients(surface: PlacedSurface, times: Array, r: Array) -> Array:
    """Return ∇φ (N, 3), surface's axes, 0 for no number, at points r (N, 3), m, base frame, at times (N,), s."""
    found, _ = surface.at_each(gradients_on_surface, (), times, (r, np.zeros((times.size, 3))))
    return np.where(np.isfinite(found[1]), found[1], 0.0)


def shape_at(surface: PlacedSurface) -> Callable[[Array, Array], tuple[Array, Array, float, float]]:
    """Return a function that says how the surface is bent, as it lies at t = 0.

    It takes a point (3,), m, and a velocity of it (3,), m/s, and returns n and its rate, φ and |∇φ|: all numbers
    are NaN where there is no normal. All in the base frame.
    """
    memory = surface.memory()  # which has no motion
    kernels: list[Callable[..., Any]] = [normals_on_surface, surface_entry(type(surface.section))]
    ready = all(map(at_hand, kernels))
    if not ready:
        background.start([each for each in kernels if not at_hand(each)])
    place = (entry_address if ready else twin_address)(surface_entry(type(surface.section)))
    call, touch = normals_on_surface if ready else interpreted(normals_on_surface), Touch(memory.ask.touch)
    none, now = np.full(3, np.nan), np.zeros(1)

    def shape(r: Array, velocity: Array) -> tuple[Array, Array, float, float]:
        n, rate = r[None].copy(), velocity[None].copy()
        with np.errstate(all="ignore"), of_users(surface.section, "surface.kind"):
            if not call(place, memory.address, now, n, rate):
                return none, none, np.nan, np.nan
        return n[0], rate[0], float(touch.level), float(touch.size)

    return shape


def carry(surface: PlacedSurface, times: Array, motion: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
    """Return the motion of a point that moves on the surface, which carries it along.

    Parameters
    ----------
    times : (N,) array
        s.
    motion : tuple of (N, 3) arrays
        Position, m, velocity, m/s, and acceleration, m/s², on the surface as it lies at t = 0, base frame.
    """
    memory = surface.memory()
    move, ask = interpreted(motion_entry(type(surface.motion))), memory.ask
    poses = np.empty((times.size, ask.pose.size))
    with of_users(surface.motion, "surface_motion.kind"):
        for k, t in enumerate(times):
            ask.time = t
            move(memory.address, 0)
            poses[k] = ask.pose
    moved = Pose(poses.T)
    turn = np.einsum("ijn,ik->njk", np.asarray(moved.axes), ask.axes)
    d, v, a = (np.einsum("njk,nk->nj", turn, each) for each in (motion[0] - surface.origin, *motion[1:]))
    spin, spin_rate = moved.spin.T, moved.spin_rate.T
    whirl = np.cross(spin, d)
    acceleration = moved.acceleration.T + np.cross(spin_rate, d) + np.cross(spin, whirl + 2.0 * v) + a
    return moved.origin.T + d, moved.velocity.T + whirl + v, acceleration
