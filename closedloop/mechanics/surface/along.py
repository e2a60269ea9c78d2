"""What a motion along a surface needs: how it is bent from point to point, and how it carries what lies on it.

And the gradient of φ at points of a motion: where it vanishes or jumps the surface has no normal; and whether
a motion of a surface of a user's own moves as it says.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError
from closedloop.base.families import is_users
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

    `times` (N,): s.
    `motion`, tuple of (N, 3) arrays: position, m, velocity, m/s, and acceleration, m/s², on the surface as it lies at t
        = 0, base frame.
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


# Shares of the run's duration at which it is looked at, and of it between two displacements.
INSTANTS, APART = (0.1234, 0.4321, 0.7531), 1e-6
# Share by which a velocity may differ from differences of what it is the velocity of; and m/s.
WRONG_RATE = 1e-2


def check_rates(surface: PlacedSurface, duration: float) -> None:
    """Refuse a motion of a user's own whose velocity is not the rate of its displacement, from 0 to `duration`, s.

    It is compared with differences, to a hundredth: a velocity that was forgotten is meant, not its last digits.
    """
    if not is_users(surface.motion):
        return
    h = APART * duration
    for share in INSTANTS:
        t = share * duration
        moved = (_ends_of_axes(surface, t + h) - _ends_of_axes(surface, t - h)) / (2.0 * h)
        now, pose = _ends_of_axes(surface, t), surface.pose(t)
        said = pose.velocity + np.cross(pose.spin, now - pose.origin)
        if np.max(np.abs(moved - said)) > WRONG_RATE * max(float(np.max(np.abs(moved))), WRONG_RATE):
            worst = int(np.argmax(np.max(np.abs(moved - said), axis=1)))
            raise ScenarioError(
                f"surface_motion.kind = {surface.motion.kind}: at t = {t:.4g} s the surface moves with "
                f"{np.round(moved[worst], 6).tolist()} m/s, but its rates give "
                f"{np.round(said[worst], 6).tolist()} m/s: `rate` and `shift_rate` must be the "
                "derivatives of `angle` and `shift`"
            )


def _ends_of_axes(surface: PlacedSurface, t: float) -> Array:
    """Return where the surface's origin and the ends of its axes are at t, s: (4, 3), m, base frame."""
    turn, shift = surface.displacement(t)
    return (surface.origin + np.vstack([np.zeros(3), surface.frame])) @ turn.T + shift
