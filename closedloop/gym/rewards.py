"""Named terms of a reward, and the reasons for which an episode ends: functions of `closedloop.gym.now.Now`.

A term returns (N,) numbers, an ending (N,) truths. Those that ship are zero or negative, so that an episode that ends
early gains nothing by it: what it would have cost at most is then due at once (`failed`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from closedloop.base.arrays import Array, Mask
from closedloop.base.errors import ScenarioError
from closedloop.gym.now import Now

Term = Callable[[Now], Array]
Ending = Callable[[Now], Mask]


def force(now: Now) -> Array:
    """−|f − f_des|/f_des, at least −1."""
    scale = np.maximum(np.abs(now.wanted_force), 1.0)
    return -np.minimum(np.abs(now.force_error) / scale, 1.0)


def path(now: Now) -> Array:
    """−(distance from the path)/10 mm, at least −1."""
    return -np.minimum(now.path_error / 0.01, 1.0)


def smooth(now: Now) -> Array:
    """−(mean square change of the action)/4: 0 to −1."""
    change = now.action - now.action_before
    return -0.25 * (change * change).mean(axis=1)


def overload(now: Now) -> Array:
    """−(how far the largest force is above twice the wanted one)/f_des, at least −1."""
    scale = np.maximum(np.abs(now.wanted_force), 1.0)
    return -np.clip((now.largest_force - 2.0 * scale) / scale, 0.0, 1.0)


def loss(now: Now) -> Array:
    """−(share of the time off the surface, once it has been touched)."""
    return np.where(now.touched, -now.free_share, 0.0)


def travel(now: Now) -> Array:
    """−(distance of the tip from the desired one)/10 mm, at least −1, contacts of links or not."""
    off = now.tip - now.wanted_tip
    return -np.minimum(np.sqrt((off * off).sum(axis=1)) / 0.01, 1.0)


def knock(now: Now) -> Array:
    """−(largest force of a contact of a link)/100 N, at least −1."""
    return -np.minimum(now.largest_link_force / 100.0, 1.0)


TERMS: dict[str, Term] = {
    "force": force, "path": path, "smooth": smooth, "overload": overload, "loss": loss, "travel": travel,
    "knock": knock,
}  # fmt: skip


def excessive_force(limit: float) -> Ending:
    """Return the ending of a contact force above `limit`, N, at any row since the control instant before.

    Of the tip's contact, and of those of links.
    """
    return lambda now: np.maximum(now.largest_force, now.largest_link_force) > limit


def jammed(after: float) -> Ending:
    """Return the ending of a tip that contacts of links hold still for so long, s, though it is wanted elsewhere."""
    return lambda now: now.jammed >= after * (1.0 - 1e-9)


def lowered(depth: float) -> Ending:
    """Return whether the tip is below z = −`depth`, m: a goal."""
    return lambda now: now.tip[:, 2] <= -depth


def contact_lost(now: Now) -> Mask:
    """Whether the tip has left the surface and was off it since the control instant before."""
    return now.touched & (now.free_share >= 1.0)


def as_terms(given: Mapping[str, Any]) -> dict[str, tuple[float, Term]]:
    """Return weights and functions of terms: each is given as a weight of one that ships, a function, or both."""
    terms = {}
    for name, value in given.items():
        weight, term = value if isinstance(value, tuple) and len(value) == 2 else (value, TERMS.get(name))
        if callable(weight):
            weight, term = 1.0, weight
        if not callable(term) or isinstance(weight, bool) or not isinstance(weight, int | float):
            raise ScenarioError(
                f"rewards[{name!r}] = {value!r}: must be a function of closedloop.gym.Now that returns (N,) numbers, "
                f"(weight, function), or the weight of one of {', '.join(TERMS)}"
            )
        terms[name] = float(weight), term
    return terms
