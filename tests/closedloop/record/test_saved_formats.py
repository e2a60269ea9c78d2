"""A run in the formats of other programs, by the ending of its path, and columns by their names."""

import numpy as np
import pytest

import closedloop as cl
from closedloop.figures.export.tables import FORMATS


@pytest.fixture(scope="module")
def run():
    """Return a short slide."""
    return cl.simulate(cl.load_scenario("wam_slide", {"time.duration": 0.05}))


def test_the_ending_names_the_format(run, tmp_path):
    """Each other program reads the numbers of the run to the bit, with units; another ending is one line."""
    parquet, csv = pytest.importorskip("pyarrow.parquet"), pytest.importorskip("pyarrow.csv")
    loadmat = pytest.importorskip("scipy.io").loadmat
    force = "contact_force [N]"
    assert np.array_equal(parquet.read_table(run.save(tmp_path / "a.parquet"))[force], run.contact_force)
    assert np.array_equal(csv.read_csv(run.save(tmp_path / "a.csv"))[force], run.contact_force)
    assert np.array_equal(cl.load_run(run.save(tmp_path / "a.nc")).contact_force, run.contact_force)
    matlab = loadmat(run.save(tmp_path / "a.mat"), simplify_cells=True)
    assert np.array_equal(matlab["contact_force"], run.contact_force)
    assert np.array_equal(matlab["q"], run.q)
    assert matlab["units"]["contact_force"] == "N"
    for ending in ("", ".txt", ".h5"):
        with pytest.raises(cl.OutputError, match=r"must end in \.nc, \.csv, \.mat"):
            run.save(tmp_path / f"a{ending}")
    assert {file.suffix for file in tmp_path.iterdir()} == {".nc", *FORMATS} - {".mcap"}


def test_columns_by_their_names(run):
    """`run[name]` is the column, and what is none is a KeyError that names those there are."""
    assert run["contact_force"] is run.contact_force
    assert run["position"].shape == (51, 3)
    for name in ("contact_forze", "save", "scenario"):
        with pytest.raises(KeyError, match=rf"no column '{name}'.*contact_force"):
            run[name]


def test_a_scenario_from_tables_and_with_other_values():
    """The tables of a file are a scenario as the file is; `replace` is what overrides are."""
    scenario = cl.load_scenario("wam_slide")
    tables = scenario.model_dump(mode="python", exclude_none=True)
    assert cl.load_scenario(tables) == scenario
    changed = scenario.replace({"law.force": np.float64(12.0), "friction.kind": "coulomb", "friction.coefficient": 0.2})
    assert changed == cl.load_scenario(
        "wam_slide", {"law.force": 12.0, "friction.kind": "coulomb", "friction.coefficient": 0.2}
    )
    assert scenario.replace(**{"law.force": 12.0}).law.force == 12.0
    assert scenario.law.force == 10.0
    with pytest.raises(cl.ScenarioError, match=r"did you mean 'law\.force'"):
        scenario.replace({"law.forze": 12.0})
    with pytest.raises(cl.ScenarioError, match=r"neither \[robot\] nor \[law\]"):
        cl.load_scenario({})


@pytest.mark.parametrize("engine", ["pinocchio", "compiled"])
def test_a_prepared_problem_runs_as_its_scenario(engine):
    """`problem.run`, again, with other keys and from other starts, equals `simulate` to the bit."""
    problem = cl.prepare(cl.load_scenario("planar2_slide", {"time.duration": 0.05}))
    for changes, q in (({}, None), ({"law.force": 12.0}, None), ({}, problem.q + 0.01), ({}, None)):
        start = {} if q is None else {"start.q": q}
        same = cl.simulate(problem.scenario.replace({**changes, **start}), engine=engine)
        found = problem.run(changes, q=q, engine=engine)
        assert found.scenario == same.scenario
        for name, column in same.columns.items():
            assert np.array_equal(found[name], column, equal_nan=True), name


def test_the_version_is_that_of_the_package():
    """`cl.__version__` is what pip says."""
    from importlib.metadata import version

    assert cl.__version__ == version("closedloop")
