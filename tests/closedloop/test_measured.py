"""The values of a run, counted in row by row and from whole columns, are the same; so are a batch's and a summary's."""

import numpy as np
import pytest

import closedloop as cl
from closedloop.jit.interpreted import interpreted
from closedloop.report import run_values as values_module
from closedloop.report.alternation import Signal, alternation, count_signal
from closedloop.report.measured import (
    Tally,
    Values,
    begin_tally,
    count_condition,
    count_row,
    write_values,
)
from closedloop.report.row_sample import JointLimits, Scale, energy_left, friction_power, joint_limits
from closedloop.report.run_values import columns_of, run_values

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
}  # fmt: skip


def row_by_row(run):
    """The values by the kernels of a batch, interpreted, on rows taken from the run's columns."""
    n = run.model.n
    tally, values = Tally(np.zeros(Tally.count(n)), n), Values(np.zeros(Values.count(n)), n)
    interpreted(begin_tally)(tally, n, run.scenario.time.step, np.max(np.abs(run.reference_force)))
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
    events = {"events", "energy_lost_in_impacts", "largest_rate_cut"}
    for rows in (2, 3, 257, 10**6):
        monkeypatch.setattr(values_module, "ROWS", rows)
        by_columns = run_values(run)
        for part in set(Values.layout.at) - events:
            expected = pytest.approx(getattr(by_rows, part), rel=1e-11, abs=1e-15, nan_ok=True)
            assert getattr(by_columns, part) == expected, (rows, part)
        assert by_columns.events.sum() == len(run.events)


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
