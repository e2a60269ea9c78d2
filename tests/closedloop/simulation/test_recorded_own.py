"""Columns of one's own, the states of a law, and the columns named by the contacts of links, in a run and its file."""

from typing import Annotated

import h5py
import numpy as np
import pytest
from pydantic import Field

import closedloop as cl
from closedloop.base.errors import LawError, RunFileError, ScenarioError
from closedloop.base.sections import RATE, Positive
from closedloop.figures.export.files import write_csv
from closedloop.scenario.tables import labels_of
from tests.rounding import rounding

SHORT = {"time.duration": 0.02}


class Clock(cl.ControlLaw):
    """A law that integrates 1, 2 q̇, and notes in its torque the time and what it asks of the first joint."""

    rate: Annotated[Positive, RATE] = Field(1.0, description="rate of `passed`")
    states = ("passed", "noted")
    joint_states = ("way",)

    @staticmethod
    def torque(x, par, z, torque):
        """Write Q, which moves the arm."""
        for j in range(torque.size):
            torque[j] = x.C[j] - x.A[0, j] * x.f_des + 1.0
        z.noted = torque[0]

    @staticmethod
    def rates(x, par, z, f, torque, dz):
        """Write the rates."""
        dz.passed = par.rate
        for j in range(x.q.size):
            dz.way[j] = 2.0 * x.v[j]


def power(run):
    """Power of the torque."""
    return np.sum(run.torque * run.v, axis=1)


@pytest.fixture(scope="module", params=["pinocchio", "compiled"])
def recorded(request):
    """Return a run with such a law and two columns of one's own, in either engine."""
    scenario = cl.load_scenario("wam_slide", SHORT | {"law.kind": Clock, "time.integrator": "rk4", "law.rate": 3.0})
    record = {"power": (power, "W"), "both": lambda run: run.q[:, :2]}
    return cl.simulate(scenario, engine=request.param, record=record)


def test_states_of_a_law_are_columns(recorded):
    """What it integrates is the integral, what it notes belongs to the row; by joint where there is one a joint."""
    run = recorded
    assert np.all(np.abs(run.law_passed - 3.0 * run.time) <= rounding(20, 3.0 * run.time))
    assert np.array_equal(run.law_noted, run.torque[:, 0])
    assert np.ptp(run.law_noted) > 0.0
    moved = 2.0 * (run.q - run.q[0])
    assert run.law_way.shape == run.q.shape
    assert np.abs(moved).max() > 1e-6
    assert np.all(np.abs(run.law_way - moved) <= 1e-3 * np.abs(moved).max())
    assert not cl.simulate(cl.load_scenario("wam_slide", SHORT)).added


def test_own_columns_are_in_the_run_and_its_file(recorded, tmp_path):
    """They are attributes with units, in run.nc by their names, in CSV, pandas and xarray; and read again."""
    run = recorded
    assert np.array_equal(run.power, power(run))
    assert run.units("power") == "W"
    again = cl.load_run(run.save(tmp_path / "run.nc"))
    for name in ("power", "both", "law_passed", "law_noted", "law_way"):
        assert np.array_equal(getattr(again, name), getattr(run, name)), name
    assert again.added == run.added
    assert "Power of the torque" in again.added["power"].meaning
    with h5py.File(tmp_path / "run.nc") as file:
        assert np.array_equal(file["power"], run.power)
        assert file["power"].attrs["units"] == "W"
    header = write_csv(run, tmp_path / "run.csv")[0].read_text().partition("\n")[0]
    assert all(f'"{name}"' in header for name in ("power [W]", "both 1", "both 2", "law_passed"))
    assert {"power", "both[2]", "law_passed"} <= set(run.to_pandas().columns)
    assert np.array_equal(run.to_xarray()["power"], run.power)


def test_a_changed_own_column_is_noticed(recorded, tmp_path):
    """The checksum covers them."""
    path = recorded.save(tmp_path / "run.nc")
    with h5py.File(path, "a") as file:
        file["power"][3] += 1.0
    with pytest.raises(RunFileError, match="checksum"):
        cl.load_run(path)


def raises(run):
    """Divide by zero."""
    return 1 // 0


@pytest.mark.parametrize(
    ("function", "said"),
    [
        (raises, r"record: 'mine': test_recorded_own.py:\d+: ZeroDivisionError: integer division"),
        (lambda run: np.where(run.time > 0.005, np.nan, 0.0), "row 6, t = 0.006 s, it is nan: must be finite"),
        (lambda run: run.q[1:, 0], r"shape \(20,\): must be one real number a row, \(21,\)"),
        (lambda run: run.q.T, r"shape \(4, 21\)|shape \(7, 21\)"),
        (lambda run: "text", "returned 'text'"),
        (lambda run: [[1.0], [2.0, 3.0]], "must be one real number a row"),
        (lambda run: run.q[:, 0] + 1j, "must be one real number a row"),
    ],
)
def test_a_function_at_fault_says_so_and_loses_nothing(function, said):
    """One line; the run without that column is the error's."""
    with pytest.raises(LawError, match=said) as caught:
        cl.simulate(cl.load_scenario("wam_slide", SHORT), record={"mine": function})
    assert "\n" not in str(caught.value)
    assert len(caught.value.run) == 21
    assert "mine" not in caught.value.run.columns


@pytest.mark.parametrize(
    ("record", "said"),
    [
        ({"q": power}, "'q': a run has this already"),
        ({"summary": power}, "has this already"),
        ({"my power": power}, "must be a letter"),
        ({"power": 3.0}, "must be a function of the run"),
        ({"power": (power, 3)}, "must be a function of the run"),
        ({"joint": power}, "has this already"),
    ],
)
def test_names_are_refused_before_the_run(record, said):
    """Names that are taken, or are none for CSV and MATLAB, are a fault of the input."""
    with pytest.raises(ScenarioError, match=said):
        cl.simulate(cl.load_scenario("wam_slide", {"time.duration": 1e4, "time.step": 0.1}), record=record)


def sections(*names):
    """Return what has names as sections do."""
    return tuple({"name": name} for name in names)


@pytest.mark.parametrize(
    ("names", "labels"),
    [
        (("floor left", "toe"), ("floor_left", "toe")),
        (("", ""), ("contact_1", "contact_2")),
        (("foot", "toe", "foot"), ("foot_1", "toe", "foot_3")),
        (("a b", "a-b"), ("a_b_1", "a_b_2")),
        (("Füße", "∞"), ("F_e", "2")),
    ],
)
def test_labels_are_names_and_tell_contacts_apart(names, labels):
    """Letters of ASCII, digits, underscores; numbers where a name repeats."""
    assert labels_of(sections(*names)) == labels


def test_labels_are_never_the_same():
    """Whatever the names, with numbers of others in them."""
    for names in (("foot", "foot", "foot_2"), ("foot_2", "foot", "foot", "foot_2_1"), ("x" * 50, "x" * 40)):
        assert len(set(labels_of(sections(*names)))) == len(names)


def test_points_of_one_table_are_in_the_file_once(tmp_path):
    """Twenty boxes have thousands of points: each a variable of its own took two minutes to write."""
    run = cl.simulate(cl.load_scenario("cube_toss", {"time.duration": 0.004}))
    assert run.link_forces.shape == (len(run), 8)
    with h5py.File(run.save(tmp_path / "run.nc")) as file:
        assert file["link_forces"].shape == run.link_forces.shape
        assert [name for name in file if name.startswith("link_forces")] == ["link_forces"]
    label = labels_of(run.scenario.contact)[3]
    assert np.array_equal(getattr(run, f"link_forces_{label}"), run.link_forces[:, 3])


def test_contacts_have_columns_by_their_names(tmp_path):
    """In run.nc, as attributes, and in CSV, where two names that differ in a space have columns of their own."""
    short = {"time.duration": 0.004}
    scenario = cl.load_scenario("gripper_gear", short)
    parts = zip(scenario.contact, ("pad one", "pad-one", "pad_one", "pad.one"), strict=False)
    twins = [{**each.model_dump(exclude_none=True), "name": name} for each, name in parts]
    twins += [each.model_dump(exclude_none=True) for each in scenario.contact[4:]]
    for given in (scenario, cl.load_scenario("gripper_gear", short | {"contact": twins})):
        run = cl.simulate(given)
        with h5py.File(run.save(tmp_path / "run.nc")) as file:
            for k, label in enumerate(labels_of(given.contact)):
                name = f"link_forces_{label}"
                assert np.array_equal(file[name], run.link_forces[:, k])
                assert file[name].attrs["units"] == "N"
                assert np.array_equal(getattr(run, name), run.link_forces[:, k])
                assert np.array_equal(file[f"link_slips_{label}_t2"], run.link_slips[:, 2 * k + 1])
        header = write_csv(run, tmp_path / "run.csv")[0].read_text().partition("\n")[0]
        assert header.count('"link_forces ') == len(given.contact)
        assert run.to_pandas()[f"link_forces[{labels_of(given.contact)[-1]}]"].to_numpy()[0] == run.link_forces[0, -1]
    assert len(run.link_forces[0]) > 1


def test_column_of_ones_own_from_the_command_line(command_line, tmp_path, monkeypatch):
    """--record MODULE:FUNCTION adds the column of that name; what names no function, or one twice, is one line."""
    (tmp_path / "my_columns.py").write_text(
        'def speed(run):\n    """|q̇|, rad/s."""\n    return (run.v**2).sum(axis=1) ** 0.5\n', encoding="utf-8"
    )
    monkeypatch.chdir(tmp_path)
    options = ["--time.duration", "0.01", "--no-figures", "--json", "--out", "o"]
    assert command_line("wam_slide", *options, "--record", "my_columns:speed").status == 0
    run = cl.load_run(tmp_path / "o" / "run.nc")
    np.testing.assert_array_equal(run.to_pandas()["speed"], np.sqrt(np.sum(run.v**2, axis=1)))
    assert "has no function 'sped'" in command_line("wam_slide", *options, "--record", "my_columns:sped").refusal(2)
    twice = ["--record", "my_columns:speed"] * 2
    assert "there is a column 'speed' already" in command_line("wam_slide", *options, *twice).refusal(2)
