"""The run file: whole, exact, readable by others, repeatable from itself alone, and refused where damaged."""

import copy
import dataclasses
import json
import os
import pickle
import shutil
import subprocess
import sys

import h5netcdf
import h5py
import numpy as np
import pytest
import xarray

import closedloop as cl
from closedloop.record.columns.record import COLUMNS
from robot_models.described import path_of


@pytest.fixture(scope="module")
def run():
    """Return a run with the velocity step in it."""
    return cl.simulate(cl.load_scenario("wam_slide", {"time.duration": 0.6}))


@pytest.fixture(scope="module")
def saved(run, tmp_path_factory):
    """Return the file of that run."""
    return run.save(tmp_path_factory.mktemp("run") / "run.nc")


def same(one, other):
    """Whether two runs agree in every column to the last bit, types included."""
    assert set(one.columns) == set(other.columns) == set(COLUMNS)
    for name in COLUMNS:
        a, b = one.columns[name], other.columns[name]
        assert a.dtype == b.dtype, name
        assert a.shape == b.shape, name
        assert np.array_equal(a, b), name
    return True


@pytest.mark.parametrize("name", ["wam_slide", "planar2_slide", "panda_slide"])
def test_round_trip_is_exact(name, tmp_path):
    """What is loaded is what was saved: columns to the last bit, scenario, robot, law, versions."""
    run = cl.simulate(cl.load_scenario(name, {"time.duration": 0.55}))
    loaded = cl.load_run(run.save(tmp_path / "run.nc"))
    assert same(run, loaded)
    assert loaded.scenario == run.scenario
    assert loaded.law == run.law == "scenario"
    assert loaded.versions == run.versions
    assert loaded.stopped is None
    assert loaded.wall_seconds == run.wall_seconds
    assert loaded.summary() == run.summary()
    for field in ("name", "text", "format", "joint_names", "tip", "joint_types", "frames", "description", "source"):
        assert getattr(loaded.model, field) == getattr(run.model, field), field
    for field in ("armature", "position_lower", "position_upper", "home", "gravity"):
        assert np.array_equal(getattr(loaded.model, field), getattr(run.model, field)), field
    assert dict(loaded.model.locked) == dict(run.model.locked)


def test_every_variable_has_a_unit_and_a_name(saved):
    """h5py finds every column, with its unit, its meaning and its dimensions."""
    with h5py.File(saved) as h5:
        for name, column in COLUMNS.items():
            assert h5[name].attrs["units"] == column.units
            assert h5[name].attrs["long_name"] == column.meaning
            assert len(h5[name].dims) == len(column.dims)
        assert h5["contact_force"].attrs["units"] == "N"
        assert h5["closure_error"].attrs["units"] == "m"
        assert h5["q"].shape == (601, 4)


def test_units_are_those_of_the_joints():
    """A joint that slides has metres and newtons: no column says radians of it."""
    changes = {"robot.model": "pointmass3", "start.q": [0.0] * 3, "start.v": [0.0] * 3, "reference.kind": "hold"}
    changes |= {"law.kp": 1.0, "law.kd": 1.0, "time.duration": 0.01}
    run = cl.simulate(cl.load_scenario("planar2_slide", changes))
    assert set(run.model.joint_types) == {"prismatic"}
    data = run.to_xarray()
    for name in ("q", "v", "acceleration", "reference_position", "reference_velocity"):
        assert "rad" not in data[name].attrs["units"].split(), name
    assert data["torque"].attrs["units"] != "N m"


def test_file_carries_what_made_it(run, saved):
    """The attributes hold the scenario, the robot's text, the seed and the versions, as plain text."""
    with h5py.File(saved) as h5:
        attributes = dict(h5.attrs)
    assert attributes["format"] == "closedloop run"
    assert attributes["scenario"] == run.scenario.to_toml()
    assert attributes["robot_text"] == run.model.text
    assert attributes["robot_text"].count("<joint") >= 4
    assert {"python", "closedloop", "pin", "numpy", "numba"} <= set(json.loads(attributes["versions"]))
    assert "seed" in attributes
    assert json.loads(attributes["summary"]) == run.summary()


def test_xarray_opens_the_file(run, saved):
    """xarray opens the file, times as plain seconds, and finds what `to_xarray` gives."""
    with xarray.open_dataset(saved, engine="h5netcdf") as data:
        assert data.time.dtype == np.float64
        assert np.array_equal(data.time, run.time)
        assert np.array_equal(data.contact_force, run.contact_force)
        assert data.contact_force.attrs["units"] == "N"
    ours = run.to_xarray()
    assert set(ours.data_vars) | {"time"} == set(COLUMNS)
    assert float(ours.q.sel(joint="J2").sel(time=0.5, method="nearest")) == run.q[500, 1]
    assert ours.attrs["scenario"] == run.scenario.to_toml()


def test_xarray_labels_work_in_the_file_too(saved):
    """A joint can be picked by its name in the file as it can in `to_xarray`."""
    with xarray.open_dataset(saved, engine="h5netcdf") as data:
        assert np.array_equal(data.q.sel(joint="J2"), data.q[:, 1])
        assert np.array_equal(data.position.sel(axis="y"), data.position[:, 1])


@pytest.mark.parametrize("rows", [600, 0])
def test_dimensions_are_those_of_netcdf(rows, run, tmp_path):
    """h5netcdf finds every dimension by its name, also one without a variable, and one of length zero."""
    columns = {name: column[:rows] for name, column in run.columns.items()}
    path = dataclasses.replace(run, columns=columns).save(tmp_path / "run.nc")
    with h5netcdf.File(path) as file:
        sizes = {name: dimension.size for name, dimension in file.dimensions.items()}
        assert sizes == {"time": rows, "joint": 4, "axis": 3, "event": 0}
        found = {name: variable.dimensions for name, variable in file.variables.items()}
        labels = {"joint": ("joint",), "joint_type": ("joint",), "axis": ("axis",)}
        assert found == {name: spec.dims for name, spec in COLUMNS.items()} | labels
        assert [name.decode() for name in file.variables["joint"][...]] == list(run.model.joint_names)
    with h5py.File(path) as file:
        assert file["event_time"].maxshape == (None,)  # NetCDF takes an empty dimension for one that grows
    with xarray.open_dataset(path, engine="h5netcdf") as data:
        assert set(data.coords) == {"time", "joint", "axis"}
        assert data.sizes["time"] == rows


def test_the_columns_of_a_run_cannot_be_exchanged(run, saved):
    """Neither in the run nor in a copy of it; the dictionary that it was made of is another's and may change."""
    given = dict(run.columns)
    copies = (
        copy.copy(run),
        copy.deepcopy(run),
        pickle.loads(pickle.dumps(run)),
        dataclasses.replace(run, columns=given),
    )
    for held in (run, cl.load_run(saved), *copies):
        with pytest.raises(TypeError, match="item assignment"):
            held.columns["q"] = 3
        with pytest.raises(AttributeError):
            held.columns.pop("q")
        assert np.array_equal(held.q, run.q)
    last = dataclasses.replace(run, columns=given)
    given["q"] = 3
    assert np.array_equal(last.q, run.q)


def test_columns_are_attributes_and_read_only(run, saved):
    """Every column is an attribute, of a fresh run and of a loaded one, and cannot be written."""
    for record in (run, cl.load_run(saved)):
        for name in COLUMNS:
            column = getattr(record, name)
            assert len(record) == 601
            assert len(column) == (601 if COLUMNS[name].dims[0] == "time" else 0)  # the slide has no events
            assert name in dir(record)
            with pytest.raises(ValueError, match="read-only"):
                column[...] = 0


def test_unknown_column_is_refused_with_the_known():
    """A column that there is not is refused as an attribute, with those there are."""
    run = cl.simulate(cl.load_scenario("wam_slide", {"time.duration": 0.001}))
    with pytest.raises(AttributeError, match=r"no 'force'.*contact_force"):
        run.force  # noqa: B018


def test_run_can_be_sent_to_another_process(run):
    """A run survives pickling, which a study in parallel does to it."""
    assert same(run, pickle.loads(pickle.dumps(run)))


def test_run_is_repeated_from_its_file_alone(run, saved, command_line, tmp_path):
    """Another person, in another folder, with nothing but run.nc, gets every column to the last bit."""
    alone = tmp_path / "inbox" / "run.nc"
    alone.parent.mkdir()
    shutil.copy(saved, alone)
    outcome = command_line("inbox/run.nc", "--out", "again", "--no-figures")
    assert outcome.status == 0, outcome.err
    assert same(run, cl.load_run(tmp_path / "again" / "run.nc"))


@pytest.mark.parametrize(
    "changes",
    [
        {"time.integrator": "rk4", "law.sample_period": 0.002},
        {"robot.drive_inertia": False},
        {
            "robot.lock": {"J3": 0.1},
            "start.q": [1.5, 1.0, 2.0],
            "start.v": [0.0, -0.0158520976, 0.0974205757],  # along the surface
            "law.kp": 100.0,
            "law.kd": 10.0,
            "reference.kind": "hold",
        },
    ],
    ids=["rk4, sampled", "no drives", "a locked joint"],
)
def test_options_are_repeated_too(changes, command_line, tmp_path):
    """Integrator, drives and locked joints come back from the file as they were."""
    run = cl.simulate(cl.load_scenario("wam_slide", {"time.duration": 0.55} | changes))
    run.save(tmp_path / "run.nc")
    assert command_line("run.nc", "--out", "again", "--no-figures").status == 0
    assert same(run, cl.load_run(tmp_path / "again" / "run.nc"))


def test_run_of_a_deleted_robot_is_repeated(command_line, tmp_path):
    """A run of a user's own URDF is repeated from its file after the URDF and its sidecar are gone."""
    for suffix in (".urdf", ".toml"):
        shutil.copy(path_of("planar2").with_suffix(suffix), tmp_path / f"mine{suffix}")
    options = ("planar2_slide", "--robot.model", "mine.urdf", "--time.duration", "0.55", "--no-figures")
    assert command_line(*options, "--out", "first").status == 0
    for suffix in (".urdf", ".toml"):
        (tmp_path / f"mine{suffix}").unlink()
    outcome = command_line("first/run.nc", "--out", "again", "--no-figures")
    assert outcome.status == 0, outcome.err
    first = cl.load_run(tmp_path / "first" / "run.nc")
    assert first.model.armature == pytest.approx([0.02, 0.01])
    assert same(first, cl.load_run(tmp_path / "again" / "run.nc"))
    assert command_line(*options, "--out", "not").status == 2  # the file is indeed gone


def test_run_can_be_repeated_with_a_change(saved, command_line, tmp_path):
    """A dotted option lays a change over the scenario in the file."""
    assert command_line(saved, "--law.force", "15", "--out", "again", "--no-figures").status == 0
    again = cl.load_run(tmp_path / "again" / "run.nc")
    assert again.scenario.law.force == 15.0
    assert again.contact_force[0] == pytest.approx(15.0)
    assert again.scenario.name == "wam_slide"


def test_run_of_a_users_law_is_not_repeated_without_it(command_line, tmp_path):
    """A file made with a user's law says which, and refuses to be repeated without one."""
    (tmp_path / "laws_of_record.py").write_text("def soft(t, q, v, terms):\n    return terms.bias\n")
    assert (
        command_line(
            "wam_slide", "--law", "laws_of_record:soft", "--time.duration", "0.01", "--no-figures", "--out", "one"
        ).status
        == 0
    )
    first = cl.load_run(tmp_path / "one" / "run.nc")
    assert first.law == "laws_of_record:soft"
    refusal = command_line("one/run.nc", "--out", "two", "--no-figures").refusal()
    assert "laws_of_record:soft" in refusal
    assert "--law" in refusal
    assert command_line("one/run.nc", "--law", "laws_of_record:soft", "--out", "two", "--no-figures").status == 0
    assert same(first, cl.load_run(tmp_path / "two" / "run.nc"))


def test_run_without_rows_is_saved_and_loaded(tmp_path):
    """A run that stopped at t = 0 is a file like any other, of no rows."""
    changes = {"start.q": [0.0, 0.0], "surface.normal": [1, 0, 0], "reference.kind": "hold"}
    with pytest.raises(cl.SingularClosureError) as caught:
        cl.simulate(cl.load_scenario("planar2_slide", changes))
    loaded = cl.load_run(caught.value.run.save(tmp_path / "run.nc"))
    assert len(loaded) == 0
    assert loaded.q.shape == (0, 2)
    assert loaded.stopped == caught.value.run.stopped


def test_saving_replaces_an_older_file_and_leaves_no_other(run, tmp_path):
    """Saving over an older file replaces it, and no unfinished file stays beside it."""
    file = tmp_path / "run.nc"
    file.write_bytes(b"older")
    run.save(file)
    assert same(run, cl.load_run(file))
    assert [p.name for p in tmp_path.iterdir()] == ["run.nc"]


GROWTH = """
import os, resource, sys
from pathlib import Path
import numpy as np
from closedloop.record.save import Variable, write_netcdf
from closedloop.record.save import seal_file
columns = {f"c{k}": Variable(("time", "joint"), np.random.default_rng(k).normal(size=(125000, 8))) for k in range(9)}
most = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
def write(rows):
    some = {name: Variable(column.dims, column.data[:rows]) for name, column in columns.items()}
    write_netcdf(Path(sys.argv[1]), {"time": rows, "joint": 8}, some, {"what": "text"}, seal_file)
write(10)  # the libraries
before = most()
write(125000)
print(most() - before, os.path.getsize(sys.argv[1]) / 2**20)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="ru_maxrss is in KiB on Linux")
def test_saving_takes_no_memory_beside_the_columns(tmp_path):
    """Nine columns of 8 MB: less than one of them more, where twice the file was."""
    out = subprocess.run([sys.executable, "-c", GROWTH, tmp_path / "a.nc"], capture_output=True, text=True, check=True)
    grew, size = map(float, out.stdout.split())
    assert size > 68.0
    assert grew < 8.0


FULL = """
import resource, sys
from pathlib import Path
import numpy as np
from closedloop.base.errors import OutputError
from closedloop.record.save import Variable, write_netcdf
from closedloop.record.save import seal_file
columns = {name: Variable(("time",), np.zeros(9000), {"units": "m"}) for name in ("time", "q", "v")}
texts = {"words": "of some length" * 100}
write_netcdf(Path("whole.nc"), {"time": 9000}, columns, texts, seal_file)
for size in (0, 1, 100, 5000, 100_000, 215_000):
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))
    try:
        write_netcdf(Path("full.nc"), {"time": 9000}, columns, texts, seal_file)
    except OutputError as error:
        print(error)
"""


@pytest.mark.skipif(not hasattr(os, "posix_fallocate"), reason="this system reserves no room")
def test_a_disk_that_is_full_ends_saving_and_not_the_process(tmp_path):
    """The room for a file is reserved before HDF5 begins, which a failed write would end with its process."""
    out = subprocess.run([sys.executable, "-c", FULL], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert out.stdout == "full.nc: cannot be written: File too large\n" * 6
    assert [path.name for path in tmp_path.iterdir()] == ["whole.nc"]
    assert (tmp_path / "whole.nc").stat().st_size < 3 * 8 * 9000 + 20_000, "what was not needed is given back"


@pytest.mark.parametrize("place", ["missing/run.nc", "file/run.nc", "folder.nc"])
def test_place_that_cannot_be_written_is_an_output_error(place, run, tmp_path):
    """A missing folder, a file in the way and a folder in the file's place are OutputErrors of one short line."""
    (tmp_path / "file").write_text("in the way")
    (tmp_path / "folder.nc").mkdir()
    with pytest.raises(cl.OutputError, match="cannot be written") as caught:
        run.save(tmp_path / place)
    message = str(caught.value)
    assert "\n" not in message
    assert place in message
    assert "errno" not in message  # the words of the operating system, not the inside of a library
    assert sorted(p.name for p in tmp_path.iterdir()) == ["file", "folder.nc"]
