"""Published benchmarks of multibody dynamics that have loops, held against their printed values."""

import numpy as np

import closedloop as cl
import robot_models
from closedloop.record.run import Run
from robot_models import RobotModel
from validation.anchors.description import read
from validation.loops.andrews import by_its_equations, coasting, printed, squeezed
from validation.loops.four_bars import falling, lean, lean_of_a_pendulum
from validation.loops.mechanisms import joint, loop
from validation.oracle.spatial import Array
from validation.report_tables import Check, Section

LOOP = "closedloop"
ANDREWS_STEP = 5e-6
"""s: rk4 leaves 1e-11 of the velocities, as half and double this step show."""
ANDREWS_START = {"acceleration": 1e-12, "forces": 1e-12}
ANDREWS_PRINTED = {"position": 2e-10, "velocity": 1e-9, "acceleration": 2e-7, "forces": 2e-7}
"""Relative to the largest of each. What is printed is the motion 1.0e-12 s later, to all its digits: the error of its
own integration, at tolerances of 1e-14; the test set's equations end where ours do."""
ANDREWS_EQUATIONS = {"position": 5e-12, "velocity": 5e-11, "acceleration": 5e-10, "forces": 5e-10}
FALLING_STEP = 0.005
FALLING_PRINTED = 1e-6
"""m: six digits are printed, and ADAMS errs by less than one of the last."""
FALLING_EQUATION = 2e-8
"""rad: rk4 over two seconds at this step."""
ENERGY = 1e-8
CLOSED = 1e-12


def compare_with_published(quick: bool) -> Section:
    """Compare runs of published mechanisms with what is printed of them, and with their own equations.

    quick: leaves out what takes more than a few seconds: the forty windows, and energy over a minute
    """
    section = Section("published mechanisms with loops: values as printed")
    section.checks += _andrews()
    section.checks += _windows(2)
    if not quick:
        section.checks += _windows(read("n_four_bar")["windows"])
        section.checks += _for_long("IFToMM A02, two windows", falling(2, 60.0, FALLING_STEP))
        section.checks += _for_long("IFToMM A04, Bricard", bricard_of_rods(10.0, 0.002))
    return section


def _andrews() -> list[Check]:
    data = read("andrews")
    (start, end), (start_printed, end_printed) = squeezed(ANDREWS_STEP, data["time"]), printed()
    cases = (
        ("at the start", start, start_printed, ANDREWS_START, data["source"]),
        ("as printed", end, end_printed, ANDREWS_PRINTED, data["source"]),
        ("by the test set's equations", end, by_its_equations(), ANDREWS_EQUATIONS, "rk4 beside scipy's DOP853"),
    )
    checks = []
    for what, found, truth, bounds, note in cases:
        for name, bound in bounds.items():
            error = apart(getattr(found, name), getattr(truth, name))
            checks.append(Check(f"Andrews' squeezer, {name} {what}", LOOP, error, bound, error <= bound, note))
    return checks


def apart(found: Array, truth: Array) -> float:
    """Return the worst error, relative to the largest entry of the truth."""
    return float(np.max(np.abs(found - truth)) / np.max(np.abs(truth)))


def _windows(count: int) -> list[Check]:
    data = read("n_four_bar")
    rows = np.array(data["positions"])
    run = falling(count, float(rows[-1, 0]), FALLING_STEP)
    leans, times = lean(run), np.asarray(run.time)
    title = f"IFToMM A02, {count} windows"
    error = float(np.max(np.abs(leans - lean_of_a_pendulum(count, times)[:, None])))
    why = "two passes flat; the equation of its one coordinate, by scipy's DOP853"
    checks = [Check(f"{title}, angle of each upright", LOOP, error, FALLING_EQUATION, error <= FALLING_EQUATION, why)]
    if count != data["windows"]:
        return checks
    at = np.searchsorted(times, rows[:, 0] - 1e-9)
    where = data["length"] * np.stack([np.sin(leans[at, 0]), np.cos(leans[at, 0])], axis=1)
    error = float(np.max(np.abs(where - rows[:, 1:])))
    passed = error <= FALLING_PRINTED
    return [*checks, Check(f"{title}, B0 as printed", LOOP, error, FALLING_PRINTED, passed, data["source"])]


def _for_long(title: str, run: Run) -> list[Check]:
    """Check energy and closure of a run in which nothing is driven."""
    kinetic = np.asarray(run.kinetic_energy)
    energy = kinetic + np.asarray(run.potential_energy)
    drift = float(np.max(np.abs(energy - energy[0])) / np.max(kinetic))
    assert run.loops is not None
    open_by = float(np.max(np.abs(run.loops.errors)))
    why = f"over {run.time[-1]:g} s, of the largest kinetic energy; no values of this motion were found"
    return [
        Check(f"{title}, energy", LOOP, drift, ENERGY, drift <= ENERGY, why),
        Check(f"{title}, closure, m", LOOP, open_by, CLOSED, open_by <= CLOSED, f"over {run.time[-1]:g} s"),
    ]


def bricard_of_rods(duration: float, step: float) -> Run:
    """Return Bricard's mechanism of the IFToMM library (A04) as it falls: five rods along edges of a cube of 1 m.

    Six hinges at right angles, where counting leaves no freedom. Its y, up, is z here.
    """
    ends = np.array([[0, 0, 0], [1, 0, 0], [1, 0, -1], [1, -1, -1], [0, -1, -1], [0, -1, 0]], dtype=float)
    axes = ("0 0 1", "0 -1 0", "1 0 0", "0 0 1", "0 -1 0")
    body = ""
    for k in range(5):
        along = ends[k + 1] - ends[k]
        before = ends[k] - ends[max(k - 1, 0)]
        body += _rod(f"rod{k}", along)
        body += joint(f"J{k}", f"rod{k - 1}" if k else "base", f"rod{k}", " ".join(map(str, before)), axes[k])
    points = [list(ends[5] - ends[4]), list(ends[5])]
    loops = [loop("last", "hinge", ["rod4", "world"], points=points, axis=[1, 0, 0])]
    text = f'<robot name="bricard_of_rods"><link name="base"/>{body}</robot>'
    model: RobotModel = robot_models.from_text(
        text, "urdf", name="bricard_of_rods", armature=np.zeros(5), tip="rod2", home=np.zeros(5), locked={}, loops=loops
    )

    def no_torque(t: float, q: Array, v: Array, terms: object) -> Array:
        return np.zeros(model.n)

    return cl.simulate(coasting(model, [0.0] * 5, [0.0] * 5, duration, step), model=model, law=no_torque)


def _rod(name: str, along: Array) -> str:
    """Return a rod of 1 kg with a square section of 0.1 m, from its origin along an edge (3,), m."""
    side = 0.1
    thin, long = side**2 / 6.0, (float(along @ along) + side**2) / 12.0
    moments = [thin if a else long for a in along]
    xyz, (x, y, z) = " ".join(map(str, along / 2.0)), moments
    return (
        f'<link name="{name}"><inertial><origin xyz="{xyz}"/><mass value="1"/>'
        f'<inertia ixx="{x!r}" iyy="{y!r}" izz="{z!r}" ixy="0" ixz="0" iyz="0"/></inertial></link>'
    )
