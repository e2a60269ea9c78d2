"""The values of a run, counted in row by row and from whole columns, are the same; so are a batch's and a summary's."""

import itertools
from types import SimpleNamespace

import numpy as np
import pytest

import closedloop as cl
from closedloop.jit.interpreted import interpreted
from closedloop.loop.step.record_row import RECORDED
from closedloop.mechanics.closure.contact_force import FREE, PRESSED, STUCK
from closedloop.record.report import summary as values_module
from closedloop.record.report.measures import (
    LEAST_TORQUE,
    MOST_GROWTH,
    NAMES,
    NEAR_SINGULAR,
    ON_THE_WAY,
    RESIDUAL_TOLERANCE,
    SETTLED,
    JointLimits,
    Scale,
    Signal,
    Tally,
    Values,
    alternation,
    assumptions_met,
    begin_tally,
    count_condition,
    count_row,
    count_signal,
    energy_left,
    friction_power,
    joint_limits,
    write_values,
)
from closedloop.record.report.summary import columns_of, run_values

SLIDE = {"time.duration": 0.3, "law.pd_start": 0.1, "reference.start": 0.1}  # the motion starts within
RUNS = {
    "a slide": ("wam_slide", SLIDE | {"law.sample_period": 0.004}),
    "friction everywhere": (
        "wam_slide",
        SLIDE
        | {
            "friction.kind": "stribeck", "friction.static": 0.5, "friction.kinetic": 0.3,
            "friction.stribeck_speed": 0.01, "joint_friction.kind": "coulomb", "joint_friction.kinetic": 0.2,
        },
    ),
    "bounces": ("planar2_drop", {"time.duration": 0.6}),
    "of order four": ("wam_slide", SLIDE | {"time.integrator": "rk4"}),
}  # fmt: skip


def row_by_row(run):
    """The values by the kernels of a batch, interpreted, on rows taken from the run's columns."""
    n = run.model.n
    tally, values = Tally(np.zeros(Tally.count(n)), n), Values(np.zeros(Values.count(n)), n)
    interpreted(begin_tally)(tally, run.scenario.time.step, np.max(np.abs(run.reference_force)))
    limits = JointLimits(joint_limits(run.model), n)
    for i in range(len(run)):
        row, wanted = columns_of(run, i), columns_of(run, i)
        wanted.position, wanted.force = run.reference_tip[i], run.reference_force[i]
        interpreted(count_row)(row, n, run.potential_energy[i], wanted, limits, i, tally)
        interpreted(count_condition)(row, tally)
    interpreted(write_values)(row, n, len(run), tally, values)
    return values


@pytest.mark.parametrize("name", RUNS)
def test_columns_and_rows_come_to_the_same(name, monkeypatch):
    """However many rows the columns are taken at a time."""
    run = cl.simulate(cl.load_scenario(*RUNS[name]))
    by_rows = row_by_row(run)
    events = {"events", "energy_lost_in_impacts", "energy_taken_at_rest", "largest_rate_cut"}
    for rows in (2, 3, 257, 10**6):
        monkeypatch.setattr(values_module, "ROWS", rows)
        by_columns = run_values(run)
        for part in set(Values.layout.at) - events:
            expected = pytest.approx(getattr(by_rows, part), rel=1e-11, abs=1e-15, nan_ok=True)
            assert getattr(by_columns, part) == expected, (rows, part)
        assert by_columns.events.sum() == len(run.events)


H, LIMITS = 0.01, ("position_lower", "position_upper", "velocity", "effort")


def made_up(case, n=3, count=60):
    """Return rows that nothing has simulated, as columns by their names, what is desired, limits and V."""
    rng = np.random.default_rng(MADE_UP.index(case))
    joints, vectors = ("q", "v", "torque", "joint_friction"), ("position", "velocity", "surface_normal",
                                                               "slip_velocity", "friction_force")  # fmt: skip
    row = {name: rng.normal(size=(count, n if name in joints else 3)) for name in (*joints, *vectors)}
    row |= {name: rng.normal(size=count) for name in RECORDED if name not in row}
    row["surface_normal"] /= np.linalg.norm(row["surface_normal"], axis=1)[:, None]
    row["torque"][:, 0] *= 1e-4  # next to none is asked of this joint
    row["mode"] = rng.choice([FREE, PRESSED, STUCK], count).astype(float)
    row["normal_mobility"] = 10.0 ** rng.uniform(-8.0, 0.0, count)
    row["residual_motion"], row["residual_closure"] = 10.0 ** rng.uniform(-14.0, -11.0, (2, count))
    row["residual_contacts"] = 10.0 ** rng.uniform(-7.0, -2.0, count)
    wanted = SimpleNamespace(position=rng.normal(size=(count, 3)), force=10.0 + rng.normal(size=count))
    limits = np.abs(rng.normal(size=(4, n))) * [[-1.0], [1.0], [1.0], [1.0]]
    if case == "free":
        row["mode"][:] = FREE
    elif case == "no force wanted":
        row["contact_force"][:], wanted.force[:] = 0.0, 0.0
    elif case == "as the paper assumes":
        row["mode"][:], limits = PRESSED, 1e3 * limits
        just_settled = 0.99 * SETTLED * np.max(wanted.force)
        row["contact_force"] = wanted.force + np.where(np.arange(count) < 20, 1.0, just_settled)
        row["friction_force"][:] = row["joint_friction"][:] = 0.0
        row["residual_motion"], row["residual_closure"] = np.full((2, count), RESIDUAL_TOLERANCE)
        row["normal_mobility"] = np.maximum(row["normal_mobility"], 2.0 * NEAR_SINGULAR)
    elif case != "anything":  # a pass of a singular pose, on the way to which the force is 2 N
        row["normal_mobility"], row["contact_force"] = np.full(count, 0.1), np.full(count, 3.0 * MOST_GROWTH)
        row["normal_mobility"][19:23], row["contact_force"][19:23] = (
            [ON_THE_WAY, 1e-7, 1e-7, 0.1],
            [-2.0, 1.0, 0.0, 9.0],
        )
        row["contact_force"][21] = -2.0 * MOST_GROWTH * (1.01 if case == "a force that grows" else 1.0)
        if case == "an end in a singular pose":
            row["normal_mobility"][-1] = NEAR_SINGULAR
    return row, wanted, limits, rng.normal(size=count)


MADE_UP = ("anything", "free", "as the paper assumes", "no force wanted", "a singular pose", "a force that grows",
           "an end in a singular pose")  # fmt: skip


def alternating(x):
    """Return a quarter of the smaller of two neighbouring second differences of opposite signs, summed."""
    turns = [x[i + 1] - 2.0 * x[i] + x[i - 1] for i in range(1, len(x) - 1)]
    return sum(min(abs(a), abs(b)) / 4.0 for a, b in itertools.pairwise(turns) if a * b < 0.0)


def trapezoids(x):
    """Return the integral over time."""
    return H * np.sum(x[1:] + x[:-1]) / 2.0


def first_of(bad):
    """Return the first instant at which something is so; NaN: never."""
    return H * np.argmax(bad) if np.any(bad) else np.nan


def written_out(row, wanted, limits, V):
    """Return the values of such rows by their definitions, with numpy."""
    r, count = SimpleNamespace(**row), len(V)
    f, e, touching, least = r.contact_force, r.closure_error, r.mode != FREE, r.normal_mobility
    miss, off = f - wanted.force, r.position - wanted.position
    off = off - np.sum(off * r.surface_normal, axis=1)[:, None] * r.surface_normal
    size = np.sum(np.abs(r.torque), axis=0)
    far = np.flatnonzero(np.abs(miss) > SETTLED * np.max(np.abs(wanted.force)))
    settles = np.any(wanted.force) and far[-1] < count - 1
    settled = np.nan
    if settles:
        around = np.abs(miss[far[-1] : far[-1] + 2])
        bound = SETTLED * np.max(np.abs(wanted.force))
        settled = H * (far[-1] + (around[0] - bound) / (around[0] - around[1]))
    risen = r.kinetic_energy + V - r.kinetic_energy[0] - V[0]
    left = risen - r.energy_supplied + r.energy_supplied[0]
    friction = np.sum(r.friction_force * r.slip_velocity, axis=1) + np.sum(r.joint_friction * r.v, axis=1)
    near, way = least <= NEAR_SINGULAR, (least > NEAR_SINGULAR) & (least <= ON_THE_WAY)
    grown = np.max(np.abs(f[near]), initial=0.0) > MOST_GROWTH * np.max(np.abs(f[way]), initial=0.0)
    solved = r.residual_motion <= RESIDUAL_TOLERANCE
    slippery = np.all(r.friction_force == 0.0, axis=1) & np.all(r.joint_friction == 0.0, axis=1)
    met = {
        "one_loop": (r.residual_closure <= RESIDUAL_TOLERANCE) & (r.mode != STUCK), "single_point": solved,
        "contact_kept": touching & (f > 0.0), "frictionless": solved & slippery, "nonsingular": (least >
        NEAR_SINGULAR) | ~touching,
    }  # fmt: skip
    failed = ~met["nonsingular"]
    lower, upper, fast, strong = limits
    excess = np.maximum(r.q - upper, lower - r.q)
    return {
        "final_contact_force": f[-1],
        "peak_contact_force": np.max(f),
        "min_contact_force": np.min(f),
        "max_stabiliser_force": np.max(np.abs(r.stabiliser_force)),
        "final_closure_error": e[-1],
        "max_abs_closure_error": np.max(np.abs(e[touching]), initial=0.0),
        "max_abs_closure_rate": np.max(np.abs(r.closure_rate[touching]), initial=0.0),
        "max_tip_speed": np.max(np.linalg.norm(r.velocity, axis=1)),
        "max_kkt_condition": np.max(r.kkt_condition),
        "max_kkt_residual": max(np.max(r.residual_motion), np.max(r.residual_closure)),
        "rows_not_converged": np.count_nonzero(r.residual_contacts > 1e-4),
        "min_normal_mobility": np.min(least),
        "singular_pose_passed": float(failed.any() and not failed[0] and not near[-1] and not grown),
        "max_energy_residual": np.max(np.abs(left)),
        "energy_gained": max(risen[i] - min(risen[: i + 1]) for i in range(count)),
        "energy_above_start": max(risen),
        "energy_exchanged": trapezoids(np.abs(np.sum(r.torque * r.v, axis=1))),
        "deepest_penetration": max(0.0, np.max(-e)),
        "time_in_contact": H * np.sum(touching[:-1]),
        "max_friction_force": np.max(np.linalg.norm(r.friction_force, axis=1)),
        "max_joint_friction": np.max(np.abs(r.joint_friction)),
        "energy_lost_to_friction": -trapezoids(friction),
        "energy_lost_in_impacts": 0.0,
        "energy_taken_at_rest": 0.0,
        "largest_rate_cut": 0.0,
        "max_kinetic_energy": np.max(r.kinetic_energy),
        "rms_force_error": np.sqrt(np.mean(miss[touching] ** 2)) if np.any(touching) else np.nan,
        "force_settled_at": settled,
        "rms_path_error": np.sqrt(np.mean(np.sum(off**2, axis=1))),
        "start_closure_error": e[0] if touching[0] else 0.0,
        "largest_reference_force": np.max(np.abs(wanted.force)),
        "force_chatter": alternating(f) / np.sum(np.abs(f)) if np.any(f) else 0.0,
        "failed_at": [first_of(~met[name]) for name in NAMES],
        "position_excess": np.maximum(np.max(excess, axis=0), 0.0),
        "max_joint_velocity": np.max(np.abs(r.v), axis=0),
        "max_joint_torque": np.max(np.abs(r.torque), axis=0),
        "torque_limited_share": [0.0] * 3,
        "torque_limited_at": [np.nan] * 3,
        "position_limit_left_at": [first_of(bad) for bad in excess.T > 0.0],
        "velocity_limit_exceeded_at": [first_of(bad) for bad in (np.abs(r.v) > fast).T],
        "effort_limit_exceeded_at": [first_of(bad) for bad in (np.abs(r.torque) > strong).T],
        "torque_chatter": [
            alternating(x) / max(own, LEAST_TORQUE * np.mean(size)) for x, own in zip(r.torque.T, size, strict=True)
        ],
    }


@pytest.mark.parametrize("case", MADE_UP)
def test_values_are_what_they_are_called(case):
    """Every value of rows made up by a generator, and of such in which each assumption holds, by its definition."""
    row, wanted, limits, V = made_up(case)
    n, count = 3, len(V)
    tally, values = Tally(np.full(Tally.count(n), 7.0), n), Values(np.full(Values.count(n), 7.0), n)
    interpreted(begin_tally)(tally, H, np.max(np.abs(wanted.force)))
    joint = JointLimits(limits.ravel().copy(), n)
    for i in range(count):
        now = SimpleNamespace(**{name: column[i] for name, column in row.items()})
        desired = SimpleNamespace(position=wanted.position[i], force=wanted.force[i])
        interpreted(count_row)(now, n, V[i], desired, joint, i, tally)
        interpreted(count_condition)(now, tally)
    interpreted(write_values)(now, n, count, tally, values)
    expected = written_out(row, wanted, limits, V)
    assert set(Values.layout.at) == {*expected, "events"}
    for name, value in expected.items():
        assert getattr(values, name) == pytest.approx(value, rel=1e-11, abs=1e-14, nan_ok=True), name
    assert not np.any(values.events)


@pytest.mark.parametrize(
    ("change", "fail"),
    [
        ({}, set()),
        ({"residual_motion": 1.01 * RESIDUAL_TOLERANCE}, {"single_point", "frictionless"}),
        ({"residual_closure": 1.01 * RESIDUAL_TOLERANCE}, {"one_loop"}),
        ({"mode": STUCK}, {"one_loop"}),
        ({"mode": FREE}, {"contact_kept"}),
        ({"contact_force": 0.0}, {"contact_kept"}),
        ({"friction": 1e-9}, {"frictionless"}),
        ({"in_joints": 1e-9}, {"frictionless"}),
        ({"normal_mobility": NEAR_SINGULAR}, {"nonsingular"}),
    ],
)
def test_every_assumption_by_itself(change, fail):
    """In a row that is just within all of them, one number that is just not fails those that it is about."""
    row = {
        "residual_motion": RESIDUAL_TOLERANCE, "residual_closure": RESIDUAL_TOLERANCE, "mode": PRESSED,
        "contact_force": 1e-9, "normal_mobility": 1.01 * NEAR_SINGULAR, "friction": 0.0, "in_joints": 0.0,
    } | change  # fmt: skip
    met = interpreted(assumptions_met)(SimpleNamespace(**row), row["friction"], row["in_joints"])
    assert {name for name, holds in zip(NAMES, met, strict=True) if not holds} == fail


@pytest.mark.parametrize("count", range(1, 9))
def test_alternation_is_that_of_the_values_one_by_one(count):
    """Of short signals too, which have no fourth value."""
    values = np.random.default_rng(count).normal(size=count)
    signal = Signal(np.zeros(Signal.count()))
    for i, x in enumerate(values):
        interpreted(count_signal)(x, i, signal)
    assert signal.alternating == pytest.approx(alternation(values[:, None])[0], rel=1e-14)


def test_powers_and_energy_of_columns():
    """What the columns say, against sums written out."""
    run = cl.simulate(cl.load_scenario(*RUNS["friction everywhere"]))
    row, n, scale = columns_of(run), run.model.n, Scale(np.array([10.0, 2.0, 0.5]))
    power = np.sum(run.friction_force * run.velocity, axis=1) + np.sum(run.joint_friction * run.v, axis=1)
    assert interpreted(friction_power)(row, n) == pytest.approx(power, rel=1e-12, abs=1e-14)
    left = run.kinetic_energy + run.potential_energy - 2.0 - (run.energy_supplied - 0.5)
    assert interpreted(energy_left)(row, run.potential_energy, scale) == pytest.approx(left, rel=1e-13, abs=1e-13)
