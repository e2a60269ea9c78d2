"""What an identification writes: a robot file of bodies that can be, the friction of a scenario, a report, figures.

Base parameters are combinations; many full sets of parameters give the same, and with noise none of them may be of a
real body. Each link's ten parameters are written by its pseudo-inertia, J = [Σ h; hᵀ m] with Σ = tr(I)/2 − I, which is
positive definite exactly if there is a mass distribution with them, as a product of triangular matrices with
exponentials on their diagonal (log-Cholesky): there every ten numbers are a body. The numbers minimise

    (G χ − χ̂)ᵀ C⁻¹ (G χ − χ̂) + ε |z − z₀|²

with the covariance C of the estimates χ̂, so that well-known combinations stay where they are, and a small pull to the
robot's file where nothing is known. Friction and drive inertia are kept at zero or above. Source: C. Rucker,
P. M. Wensing, Smooth parameterization of rigid-body inertia, IEEE Robotics and Automation Letters 7 (2022) 2771-2778.
"""

from __future__ import annotations

import json
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import tomli_w
from scipy import linalg, optimize

from closedloop.base.arrays import Array
from closedloop.base.errors import ModelError
from closedloop.base.files import write_whole
from closedloop.studies.identify.regressor import BOUNDED, LOAD

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from closedloop.studies.identify.identify import Identification


# ε: a change of the logarithms by one weighs as much as a tenth of a standard deviation of one estimate.
PULL = 0.01
# Of a link of the file without inertia: a gram, and a sphere of a centimetre.
LEAST = 1e-7
# Steps of the solver (each asks for a derivative by every number).
ROUNDS = 60


@dataclass(frozen=True, eq=False)
class Physical:
    """Parameters that a robot can have."""

    parameters: Array  # (p,): in the order of the regressor's names, all of them
    distance: float  # RMS distance of the base parameters from their estimates, in standard deviations
    relative_error: Array  # (n,): RMS error of the torque over its RMS, as `Identification.relative_error`


def _logarithms(inertia: Any) -> Array:
    """Return z, Pinocchio's `LogCholeskyParameters`, of an inertia; of one that no body has, of the nearest."""
    values, vectors = linalg.eigh(inertia.toPseudoInertia().toMatrix())
    J = (vectors * np.maximum(values, LEAST)) @ vectors.T
    flip = J[::-1, ::-1]
    U = linalg.cholesky(flip, lower=True)[::-1, ::-1]
    alpha = np.log(U[3, 3])
    U = U / U[3, 3]
    return np.array([alpha, *np.log(np.diag(U)[:3]), U[0, 1], U[1, 2], U[0, 2], U[0, 3], U[1, 3], U[2, 3]])


def physical(found: Identification) -> Physical:
    """Return the parameters of a robot that can be, nearest to what was identified."""
    import pinocchio as pin

    names, n, base = found.regressor.names, found.robot.n, found.base
    solution, links = found.solution, 10 * found.robot.n
    told = solution.told
    grouping, value = base.grouping[told], solution.value[told]
    deviation = solution.deviation[told]
    scaled = solution.covariance[np.ix_(told, told)] / deviation / deviation[:, None]
    root = linalg.solve_triangular(linalg.cholesky(scaled, lower=True), np.diag(1.0 / deviation), lower=True)
    start = np.concatenate([_logarithms(each) for each in list(found.robot.pinocchio_model().inertias)[1:]])
    rest = np.zeros(len(names) - links)
    armature = dict(
        zip((f"drive_inertia_{joint}" for joint in found.robot.joint_names), found.robot.armature, strict=True)
    )
    known = {names[base.kept[k]]: solution.value[k] for k in np.flatnonzero(told)}
    floor = np.full(len(rest), -np.inf)
    for k, name in enumerate(names[links:]):
        rest[k] = known.get(name, armature.get(name, 0.0))
        if name.startswith(BOUNDED):
            floor[k], rest[k] = 0.0, max(rest[k], 0.0)
    size = np.maximum(np.abs(rest), 1e-3)
    held = np.isfinite(floor)  # what cannot be negative is a square
    x0 = np.concatenate([start, np.where(held, np.sqrt(rest * held / size), rest / size)])

    def parameters(x: Array) -> Array:
        others = x[links:]
        bodies = [pin.LogCholeskyParameters(z).toDynamicParameters() for z in x[:links].reshape(n, 10)]
        return np.concatenate([*bodies, np.where(held, others * others, others) * size])

    def residual(x: Array) -> Array:
        return np.concatenate([root @ (grouping @ parameters(x) - value), np.sqrt(PULL) * (x - x0)])

    with np.errstate(over="ignore", invalid="ignore"):  # a step that is far too long is taken back
        best = optimize.least_squares(residual, x0, method="lm", xtol=1e-6, ftol=1e-6, gtol=1e-6, max_nfev=ROUNDS)
    chi = parameters(best.x)
    distance = float(np.sqrt(np.mean((root @ (grouping @ chi - value)) ** 2)))
    change = base.grouping @ chi - solution.value
    W = found.regressor.averaged(found.motion)[:, :, base.kept]
    left = (solution.residual - W @ np.where(told, change, 0.0)) * found.used
    torque = found.measured * found.used
    error = np.sqrt((left**2).sum(axis=0) / np.maximum((torque**2).sum(axis=0), 1e-300))
    return Physical(chi, distance, error)


# So many standard deviations (RMS) from the nearest bodies that can be, values are those of no robot.
FAR = 2.0
# What a friction and an inertia below zero would do.
_WRONG = ("it would drive the joint", "it would accelerate by itself")


def report(found: Identification) -> list[str]:
    """Return what was found, as lines for a reader."""
    names = found.robot.joint_names
    lines = [
        f"{found.robot.name}: {int(found.solution.told.sum())} of {len(found.estimates)} base parameters, "
        f"{len(found.time)} windows, low-pass {found.motion.cutoff:.3g} Hz, condition {found.solution.condition:.3g}",
        "",
        f"  {'joint':24}{'fitted':>9}{'not fitted':>12}{'over noise':>12}{'white':>10}{'used':>8}",
    ]
    for j, name in enumerate(names):
        lines.append(
            f"  {name:24}{_percent(found.relative_error[j]):>9}{_percent(found.held_out[j]):>12}"
            f"{found.above_noise[j]:12.3g}{found.whiteness[j]:10.2g}{100 * found.used[:, j].mean():6.0f} %"
        )
    lines += [
        "  (RMS error of the torque over its RMS; residual over the torque's noise; probability of a white residual)"
    ]
    if found.misses:
        lines.append(
            f"  the model misses something in {', '.join(found.misses)}: the intervals allow for it, the values may not"
        )
    for e in found.not_physical:
        lines.append(
            f"  NOT PHYSICAL: {e.name} is {e.value:.4g} {e.unit}, and surely negative: {_WRONG['inertia' in e.name]}; "
            "the log has an effect that the model lacks, or torques of another gain or instant, or hardly moves what "
            "tells it from others"
        )
    lines += ["", f"  {'parameter':30}{'value':>12}  {100 * found.confidence:.0f} % interval"]
    for e in found.estimates:
        lines.append(f"  {e.name:30}{'-':>12}  not identifiable: {e.why}" if e.why else e.line(30))
    return lines


def friction_section(found: Identification) -> str:
    """Return the [joint_friction] of a scenario, and its friction of the load; what is not known is 0, and said so."""
    lines = ["# Friction identified from a log; intervals are in report.txt."]

    def row(kind: str) -> list[float]:
        if kind not in found.regressor.terms.friction:
            return [0.0] * found.robot.n
        values = found.joints(kind)
        for e in values:
            if e.why or e.value < 0.0:
                lines.append(f"# {e.name} is 0 here: {e.why or f'{e.value:.3g} was found, which no friction can be'}")
        return [0.0 if e.why or e.value < 0.0 else float(f"{e.value:.6g}") for e in values]

    rows = {"kinetic": row("dry"), "viscous": row("viscous")}
    if "offset" in found.regressor.terms.friction:
        offsets = ", ".join("?" if e.why else f"{e.value:.4g}" for e in found.joints("offset"))
        lines.append(f"# No law of friction has an offset; found were, N m: {offsets}")
    lines += ["[joint_friction]", 'kind = "coulomb_viscous"', *(f"{key} = {row}" for key, row in rows.items())]
    if LOAD in found.regressor.terms.friction:
        shares = row(LOAD)
        lines += ["", "[transmission]", f"load_friction = {shares}"]
    return "\n".join(lines) + "\n"


def robot_files(found: Identification, parameters: Array, source: str) -> tuple[str, str]:
    """Return a URDF with the inertia of parameters (p,), all of the regressor's, and its sidecar, as texts.

    What is fixed to a link is part of it, as it was in the log, and has no inertia of its own any more.
    """
    import pinocchio as pin

    robot = found.robot
    if robot.format != "urdf" or robot.locked:
        what = "is an MJCF" if robot.format != "urdf" else f"has locked joints ({', '.join(robot.locked)})"
        raise ModelError(f"{robot.name} {what}: a robot file is written of a URDF of which all joints move")
    root = ET.fromstring(robot.text)
    joints = {joint.get("name"): joint for joint in root.findall("joint")}
    for link in root.findall("link"):
        for inertial in link.findall("inertial"):
            link.remove(inertial)
    for j, name in enumerate(robot.joint_names):
        body = pin.Inertia.FromDynamicParameters(parameters[10 * j : 10 * j + 10])
        link = next(each for each in root.findall("link") if each.get("name") == joints[name].find("child").get("link"))  # type: ignore[union-attr]
        inertial = ET.SubElement(link, "inertial")
        ET.SubElement(inertial, "mass", value=repr(float(body.mass)))
        ET.SubElement(inertial, "origin", xyz=" ".join(repr(float(x)) for x in body.lever), rpy="0 0 0")
        entries = {"ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2), "iyy": (1, 1), "iyz": (1, 2), "izz": (2, 2)}
        ET.SubElement(inertial, "inertia", {key: repr(float(body.inertia[at])) for key, at in entries.items()})
    ET.indent(root)
    drives = {
        joint: max(0.0, float(parameters[found.regressor.names.index(f"drive_inertia_{joint}")]))
        for joint in robot.joint_names
        if found.regressor.terms.drive_inertia
    }
    sidecar = {
        "description": f"{robot.name}, with inertia identified from a log",
        "source": source,
        **({"tip": robot.tip} if robot.tip else {}),
        "home": dict(zip(robot.joint_names, map(float, robot.home), strict=True)),
        **({"drive_inertia": drives} if drives else {}),
    }
    return ET.tostring(root, encoding="unicode") + "\n", tomli_w.dumps(sidecar)


def _percent(share: float) -> str:
    """Return a share in words, "-" where no row counts."""
    return f"{100 * share:.1f} %" if np.isfinite(share) else "-"


def torque_figure(found: Identification) -> Figure:
    """Draw the torque of each joint, measured and predicted, and what is left."""
    from closedloop.figures.style import COLOURS, new_figure

    n = found.robot.n
    figure = new_figure(1.5 * n + 0.6)
    axes = figure.subplots(n, 1, sharex=True, squeeze=False)[:, 0]
    sure, unsure = np.where(found.used, 1.0, np.nan), np.where(found.used, np.nan, 1.0)
    for j, name in enumerate(found.robot.joint_names):
        axes[j].plot(found.time, found.measured[:, j], color="0.3", label="measured")
        axes[j].plot(found.time, sure[:, j] * found.predicted[:, j], color=COLOURS[1], lw=0.9, label="predicted")
        axes[j].plot(found.time, sure[:, j] * found.solution.residual[:, j], color=COLOURS[0], lw=0.8, label="residual")
        axes[j].plot(found.time, unsure[:, j] * found.measured[:, j], color="0.75", lw=2.5, label="not counted")
        error = f"{_percent(found.held_out[j])} RMS error where held out" if found.used[:, j].any() else "not counted"
        axes[j].set(ylabel="torque, N m", title=f"{name}: {error}")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper right", ncol=4, fontsize="small")
    axes[-1].set_xlabel("time, s")
    return figure


def write(found: Identification, folder: Path, source: str) -> list[Path]:
    """Write all that was found into a folder that is there; return the paths.

    report.txt, identified.json, friction.toml, torque and intervals as figures; and, of a URDF, robot.urdf and
    robot.toml, whose inertia is that of bodies that can be (`closedloop.studies.identify.regressor`).
    """
    from closedloop.figures.files import write_figure
    from closedloop.figures.style import COLOURS, new_figure, styled

    lines, texts = report(found), {}
    if found.robot.format == "urdf" and not found.robot.locked:
        body = physical(found)
        texts["robot.urdf"], texts["robot.toml"] = robot_files(found, body.parameters, source)
        errors = ", ".join(f"{100 * x:.1f}" for x in body.relative_error)
        lines += [
            "",
            f"robot.urdf has possible bodies, {body.distance:.2f} standard deviations (RMS) from the values above; "
            f"their torque errs by {errors} %",
        ]
        if body.distance > FAR:
            lines.append("so far from them the values above are physically impossible: do not use them for a model")
    texts |= {
        "report.txt": "\n".join(lines) + "\n",
        "identified.json": json.dumps(found.summary(), indent=2, allow_nan=False) + "\n",
        "friction.toml": friction_section(found),
    }
    paths = [write_whole(folder / name, text.encode()) for name, text in texts.items()]
    with styled():
        paths.append(write_figure(torque_figure(found), folder / "torque"))
        known = [e for e in found.estimates if not e.why]
        figure = new_figure(0.16 * len(known) + 1.0)
        figure.set_layout_engine("constrained", w_pad=0.12)  # small text is wider in the PNG than where it is laid out
        axes = figure.subplots()
        for k, e in enumerate(known):
            size = max(abs(e.value), (e.high - e.low) / 2.0)
            axes.plot([e.low / size, e.high / size], [k, k], color=COLOURS[0], lw=2)
            axes.plot(e.value / size, k, "o", ms=3, color=COLOURS[1])
        axes.axvline(0.0, color="0.5", lw=0.8)
        axes.set_yticks(range(len(known)), [e.name for e in known], fontsize=6)
        axes.set_xlabel("estimate and interval; 1 is the larger of |estimate| and half the interval")
        axes.invert_yaxis()
        paths.append(write_figure(figure, folder / "intervals"))
    return paths
