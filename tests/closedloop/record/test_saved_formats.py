"""A run in the formats of other programs, by the ending of its path, and columns by their names."""

from typing import get_type_hints

import numpy as np
import pytest

import closedloop as cl
from closedloop.figures.export.files import FORMATS, write_rosbag2
from closedloop.record.columns.derived import DERIVED
from closedloop.record.columns.record import ALL_COLUMNS, SYMBOLS, TypedColumns


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
    h5py = pytest.importorskip("h5py")
    with h5py.File(run.save(tmp_path / "a.h5")) as file:
        assert np.array_equal(file["contact_force"], run.contact_force)
        assert file["contact_force"].attrs["units"] == "N"
        assert file.attrs["Conventions"] == "CF-1.11"
    assert np.array_equal(cl.load_run(tmp_path / "a.h5").q, run.q)
    assert run.to_xarray().attrs["Conventions"] == "CF-1.11"
    for ending in ("", ".txt", ".hdf"):
        with pytest.raises(cl.OutputError, match=r"must end in \.nc, \.h5, \.csv, \.mat"):
            run.save(tmp_path / f"a{ending}")
    assert {file.suffix for file in tmp_path.iterdir()} == {".nc", ".h5", *FORMATS} - {".mcap"}


def test_a_bag_of_ros_2(run, tmp_path):
    """Its metadata name each topic with its type and count, and the messages are those of the MCAP file."""
    pytest.importorskip("mcap_ros2")
    import yaml
    from mcap.reader import make_reader

    file, metadata = write_rosbag2(run, tmp_path / "slide")
    assert [each.name for each in (file, metadata)] == ["slide_0.mcap", "metadata.yaml"]
    about = yaml.safe_load(metadata.read_text(encoding="utf-8"))["rosbag2_bagfile_information"]
    with file.open("rb") as opened:
        messages = [(channel.topic, schema.name) for schema, channel, _ in make_reader(opened).iter_messages()]
    topics = {each["topic_metadata"]["name"]: each for each in about["topics_with_message_count"]}
    assert {topic for topic, _ in messages} == set(topics)
    assert all(topics[topic]["topic_metadata"]["type"] == kind for topic, kind in messages)
    assert topics["/joint_states"]["message_count"] == len(run)
    assert sum(each["message_count"] for each in topics.values()) == len(messages) == about["message_count"]
    assert about["duration"]["nanoseconds"] == 50_000_000
    assert about["relative_file_paths"] == [file.name]
    assert {each["topic_metadata"]["serialization_format"] for each in topics.values()} == {"cdr"}


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


def test_the_columns_that_a_type_checker_knows_are_those_there_are(run):
    """Each is an attribute of a run with a surface and none is missing, the events' and the derived ones included."""
    assert set(get_type_hints(TypedColumns)) == {*ALL_COLUMNS, *DERIVED, *SYMBOLS}
    assert all(name in get_type_hints(TypedColumns) for name in run.specs)
    with pytest.raises(AttributeError, match="a Run has no 'contact_forze'"):
        run.contact_forze  # noqa: B018


def test_a_property_that_lacks_something_says_what(run, monkeypatch):
    """And not that the run has no such property: a missing attribute inside it is its own."""
    monkeypatch.setattr(cl.Run, "wide", property(lambda run: run.scenario.width), raising=False)
    with pytest.raises(AttributeError, match="'Scenario' object has no attribute 'width'"):
        run.wide  # noqa: B018
