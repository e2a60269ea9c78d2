"""The Puma 560 of the Robotics Toolbox for Python, as its authors test it.

**Frames.** Standard Denavit–Hartenberg: a joint turns about z, then d along z, a along x, α about x lead to the link
frame, in which centre of mass and inertia are given. In URDF: the joint, a massless link, a fixed joint, the link.

**Inertia.** Two published links are no possible bodies: link 1 has moments (0, 0.35, 0) without mass (Armstrong found
only the moment about axis 1), link 3 breaks the triangle inequality (0.066 + 0.0125 < 0.086). Engines that inspect
what they read refuse them. `_possible` moves inertia between neighbours without changing the motion: a moment δ about
both normals of a joint's axis belongs as well to the link before the joint as to the one behind it, since both turn
alike about those normals; on the first joint, it and any mass on the axis belong to the ground and may be added
freely.

**Drives.** Jₘ G² each, as armature.

**Friction.** `rne` and `accel` of the toolbox include joint friction whenever q̇ ≠ 0: B G² q̇ + |G| T_c, with T_c by
the sign of q̇. It is no part of H and C, so `_friction` is subtracted here, from the torques expected and from the
torques put in.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from validation.anchors.problem import Case, ReferenceProblem, Robot, joint, link, read, robot, with_triad
from validation.oracle.spatial import Array

N = 6
TIP = "link6"

MOVED = 0.01
"""δ [kg m²] moved from link 2 to link 3 about the normals of axis 3: any of 0.00375 to 0.0575 makes both possible."""

ADDED_MASS, ADDED_MOMENT = 1.0, 0.2
"""Put on axis 1 [kg], and about the normals of axis 1 [kg m²], where they move nothing but the ground."""

PRINTED = "half a unit of the last digit that the source prints: it gives no more than that away"


def problems() -> tuple[ReferenceProblem, ...]:
    """Return the Puma 560 with gravity and without."""
    data = read("puma560")
    states, source = data["states"], data["source"]
    still, one = np.zeros(N), np.ones(N)
    q, v, qdd, turning, pulled = (np.array(states[x]) for x in ("qn", "qd", "qdd", "accel_qd", "accel_torque"))

    def case(name: str, quantity: str, key: str, plus: Array | float = 0.0, **inputs: Array) -> Case:
        published = data["published"][key]
        value = np.array(published["value"], dtype=float)
        return Case(name, quantity, {"q": q, **inputs}, value + plus, _half_unit(value, published), PRINTED)

    with_gravity = (
        case("gravity load", "gravity_term", "gravload"),
        case("inertia matrix", "mass_matrix", "inertia"),
        case("Coriolis matrix", "coriolis_matrix", "coriolis", v=v),
        _coriolis_torque(data, q, v),
        case("torque of unit accelerations", "inverse_dynamics", "rne_a", v=still, a=one),
        case("torque of unit rates", "inverse_dynamics", "rne_v", -_friction(data, one), v=one, a=still),
        case("torque of both", "inverse_dynamics", "rne_va", -_friction(data, one), v=one, a=one),
        case("acceleration", "forward_dynamics", "accel", v=turning, torque=pulled - _friction(data, turning)),
        case("torque under a tool load", "loaded_gravity_term", "rne_fext", wrench=np.array(states["fext"])),
        case("Cartesian inertia", "cartesian_inertia", "cinertia"),
        case("manipulability", "manipulability", "yoshikawa"),
        case("dexterity", "inertia_ellipsoid", "asada"),
    )
    without = (
        case("torque of both", "inverse_dynamics", "rne_va_g0", -_friction(data, one), v=one, a=one),
        case("inertia torque", "inverse_dynamics", "itorque", v=still, a=qdd),
    )
    g = data["gravity"]
    return (
        ReferenceProblem("Puma 560", source, build(data, g), TIP, with_gravity),
        ReferenceProblem("Puma 560 without gravity", source, build(data, 0.0), TIP, without),
    )


def build(data: Mapping[str, Any], g: float, *, possible: bool = True) -> Robot:
    """Write the arm as URDF, with gravity g along −z, m/s², from the content of puma560.json.

    `possible`: every link a body that can exist, the motion unchanged; else as printed, which most engines refuse.
    """
    masses, moments = list(data["m"]), [list(row) for row in data["I"]]
    if possible:
        _possible(masses, moments)
    parts, before = [link("base")], "base"
    for i in range(N):
        axis, name = f"axis{i + 1}", f"link{i + 1}"
        parts += [
            link(axis),
            joint(f"joint{i + 1}", "revolute", before, axis),
            _any_link(name, masses[i], data["r"][i], moments[i]),
            joint(
                f"dh{i + 1}",
                "fixed",
                axis,
                name,
                xyz=(data["a"][i], 0.0, data["d"][i]),
                rpy=(data["alpha"][i], 0.0, 0.0),
            ),
        ]
        before = name
    armature = np.array(data["Jm"]) * np.array(data["G"]) ** 2
    names = [f"joint{i + 1}" for i in range(N)]
    return robot("puma560", [*parts, *with_triad(TIP)], names, TIP, gravity=(0.0, 0.0, -g), armature=armature)


def _possible(masses: list[float], moments: list[list[float]]) -> None:
    """Regroup inertia between links, in place.

    Axis 1 is along y of link 1; axis 3 along z of link 2 and along −y of link 3.
    """
    masses[0] += ADDED_MASS
    for i, sign, normals in ((0, ADDED_MOMENT, (0, 2)), (1, -MOVED, (0, 1)), (2, MOVED, (0, 2))):
        for k in normals:
            moments[i][k] += sign


def _any_link(name: str, mass: float, centre: Sequence[float], moments: Sequence[float]) -> str:
    """Return a link; one without mass keeps its moments, as printed."""
    if mass or not any(moments):
        return link(name, mass, centre, moments)
    return link(name, 1.0, centre, moments).replace('<mass value="1.0"/>', '<mass value="0.0"/>')


def _friction(data: Mapping[str, Any], v: Array) -> Array:
    """Return the joint friction torque of the toolbox (n,), resisting v: B G² q̇ + |G| T_c."""
    G, B, coulomb = (np.array(data[name]) for name in ("G", "B", "Tc"))
    return np.asarray(B * G**2 * v + np.abs(G) * np.select([v > 0.0, v < 0.0], [coulomb[:, 0], coulomb[:, 1]]))


def _coriolis_torque(data: Mapping[str, Any], q: Array, v: Array) -> Case:
    """Return the printed matrix times q̇, which every engine has even if it has no such matrix."""
    published = data["published"]["coriolis"]
    value = np.array(published["value"])
    tolerance = _half_unit(value, published) @ np.abs(v)
    argument = f"in each entry of the matrix {PRINTED}; the errors of a row add up with |q̇|"
    return Case("Coriolis torque", "coriolis_torque", {"q": q, "v": v}, value @ v, tolerance, argument)


def _half_unit(value: Array, published: Mapping[str, Any]) -> Array:
    """Return half a unit of the last printed digit, for so many decimals or so many significant digits."""
    if "decimals" in published:
        return np.broadcast_to(0.5 * 10.0 ** -np.array(published["decimals"], dtype=float), value.shape)
    leading = np.floor(np.log10(np.abs(value)))  # no value printed with significant digits is zero
    return np.asarray(0.5 * 10.0 ** (leading - published["significant"] + 1))
