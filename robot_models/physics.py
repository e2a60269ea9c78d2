"""What a rigid body and a mechanism must satisfy to exist.

Pinocchio accepts a negative mass, a tensor that no body can have and a mechanism whose mass matrix is
singular, and answers with plausible numbers. Both formats pass through here.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robot_models.coordinates import PLACES
from robot_models.errors import ModelError

if TYPE_CHECKING:
    import pinocchio as pin

    from robot_models.mechanism import Link

#: A tensor printed with four significant digits is off by at most 5e-4 of its largest entry per entry, and a thin rod
#: or plate lies exactly on the bound λ₁ + λ₂ = λ₃. One part in a thousand of λ₃ forgives that rounding. No robot of
#: example-robot-data lies between: those that break the inequality do so by 9 % of λ₃ or more.
ROUNDING = 1e-3

#: A body smaller than this, m, is a point: moments below mass × length² are noise of a CAD export.
POINT = 1e-6

#: Smallest eigenvalue of the mass matrix scaled to a unit diagonal. A double carries 16 digits; below this
#: the accelerations of Eq. 24 would have fewer than six left.
SINGULAR = 1e-10

#: Inertia along a joint's axis at or below this, kg m² (kg), is none. The same bound as MuJoCo's mjMINVAL.
LEAST_INERTIA = 1e-15


def check_tensor(tensor: NDArray[np.float64], mass: float, what: str) -> str:
    """Refuse a rotational inertia with a negative moment, and say of one that no mass distribution can have why not.

    A tensor about the centre of mass belongs to a body if and only if its principal moments are not
    negative and each is at most the sum of the other two (Wensing, Kim, Slotine, "Linear matrix
    inequalities for physically consistent inertial parameter identification", 2018). The bounds themselves
    are reached by point masses (zero), thin rods and thin plates, which are honest idealisations and are
    accepted.

    tensor: (3, 3), about the centre of mass, kg m²
    mass: of the body, kg
    what: how to name its owner in a message
    Raises `ModelError` if a number is so large that the moments cannot be found, or a principal moment is negative, by
    more than rounding of printed digits.
    """
    try:
        low, mid, high = np.linalg.eigvalsh(tensor)
    except np.linalg.LinAlgError:
        low = mid = high = np.nan
    if not np.isfinite([low, mid, high]).all():
        raise ModelError(f"{what} is not finite: some number is far too large")
    slack = ROUNDING * max(high, 0.0) + POINT**2 * max(mass, 0.0)
    moments = f"principal moments {low:.4g}, {mid:.4g}, {high:.4g} kg m²"
    if not low >= -slack:
        raise ModelError(f"{what} is not positive definite ({moments}): check the signs of its entries")
    if not low + mid >= high - slack:
        return f"breaks the triangle inequality ({moments}): none may exceed the sum of the other two"
    return ""


#: The largest numbers of a robot, and why there are no larger ones: products and squares of these stay far inside the
#: range of a double, where 1e308 kg has an infinite energy.
MOST = {
    "mass": (1e9, "kg", "no arm moves so much"),
    "centre of mass": (1e6, "m", "no arm reaches so far"),
    "inertia tensor": (1e9, "kg m²", "no arm moves so much"),
    "origin": (1e6, "m", "no arm reaches so far"),
    "armature": (1e9, "kg m² (kg)", "no drive is so heavy"),
    "home": (1e6, "rad (m)", "no joint turns or reaches so far"),
    "gravity": (1e4, "m/s²", "no body pulls so hard"),
    "damping": (1e12, "N m s/rad (N s/m)", "nothing is so viscous"),
    "friction": (1e9, "N m (N)", "no joint bears so much"),
}


def check_size(what: str, value: ArrayLike, owner: str) -> None:
    """Refuse a number, or an array with one, beyond `MOST[what]`, whose products might be none, and say whose it is.

    Raises `ModelError` if one is larger, or is none.
    """
    most, unit, why = MOST[what]
    for number in np.ravel(np.asarray(value, dtype=np.float64)):
        if not abs(number) <= most:
            raise ModelError(f"{owner}: its {what} has {number:g}: at most {most:g} {unit}: {why}")


def check_sizes(links: "Sequence[Link]", where: str) -> None:
    """Refuse links with numbers beyond `MOST`. Raises `ModelError` if a number of one is larger, or is none."""
    for link in links:
        at = f"{where}: {'site' if link.site else 'link'} {link.name!r}"
        check_size("mass", link.weight.mass, at)
        check_size("centre of mass", link.weight.centre, at)
        check_size("inertia tensor", link.weight.tensor, at)
        check_size("origin", [link.placement[:3, 3], link.offset[:3, 3]], at)
        check_size("armature", link.armature, f"{where}: joint {link.joint!r}")


def massless(model: "pin.Model") -> list[str]:
    """Return the hinges and sliders that move no mass and have no armature, unless a free joint does or all do."""
    names, found = list(model.names), []
    for j in range(1, model.njoints):
        if not sum(model.inertias[k].mass for k in model.subtrees[j]) > 0.0:
            if model.nvs[j] > 1 or any(names[j].removesuffix(end) in names for end in PLACES if names[j].endswith(end)):
                return []
            found += [names[j]] if not model.armature[model.idx_vs[j]] > 0.0 else []
    return found if len(found) < model.njoints - 1 else []


def least_inertia(H: NDArray[np.float64]) -> float:
    """Return the smallest eigenvalue of a mass matrix (n, n) scaled to a unit diagonal, see `SINGULAR`."""
    scale = 1.0 / np.sqrt(np.diag(H))
    return float(np.linalg.eigvalsh(scale[:, None] * H * scale).min())


def check_mechanism(model: "pin.Model", home: NDArray[np.float64], where: str) -> None:
    """Refuse a mechanism that some joint can move without any inertia answering.

    model: the built model with its armature
    home: (nq,), a posture, as Pinocchio orders it
    Raises `ModelError` if what a joint carries has no mass or an impossible tensor, or the mass matrix is singular at
    every posture tried.
    """
    import pinocchio as pin

    names = list(model.names)
    for joint in range(1, model.njoints):
        body = model.inertias[joint]
        at = model.idx_vs[joint]
        what = f"{where}: the inertia of what joint {names[joint]!r} carries"
        check_tensor(body.inertia, body.mass, what)
        mass = sum(model.inertias[k].mass for k in model.subtrees[joint])
        if not mass > 0.0 and not model.armature[at] > 0.0:
            stem = names[joint].removesuffix(PLACES[0])
            free = all(stem + end in names for end in PLACES)
            moved = f"free joint {stem!r} moves" if free else f"joint {names[joint]!r} moves"
            cure = "give its links an <inertial>" + ("" if free else ", or lock it")
            raise ModelError(f"{where}: {moved} no mass: {cure}")
    # Singular at one posture may be the posture; singular at several generic ones is the model.
    generic = np.random.default_rng(0).uniform(-1.0, 1.0, size=(3, model.nv))
    data = model.createData()
    best, culprit = -np.inf, ""
    owners = [name for j, name in enumerate(names) for _ in range(model.nvs[j])]
    for posture in (home, *(pin.integrate(model, home, step) for step in generic)):
        upper = np.triu(pin.crba(model, data, posture))
        H = upper + np.triu(upper, 1).T
        if not np.isfinite(H).all():
            raise ModelError(f"{where}: the mass matrix is not finite: some number is far too large")
        diagonal = np.diag(H)
        if diagonal.min() <= LEAST_INERTIA:
            culprit = f"joint {owners[int(np.argmin(diagonal))]!r} moves no inertia along its own axis"
            continue
        best = max(best, least_inertia(H))
    if not best > SINGULAR:
        reason = culprit or "some joints that move together have no inertia"
        raise ModelError(f"{where}: the mass matrix is singular: {reason}; give its links their inertia")
