"""Files that are damaged, foreign, newer or absent are refused in one line."""

import shutil

import h5py
import numpy as np
import pytest

import closedloop as cl
import robot_models
from closedloop.record.save import seal


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """Return the file of a run with the velocity step in it."""
    run = cl.simulate(cl.load_scenario("wam_slide", {"time.duration": 0.6}))
    return run.save(tmp_path_factory.mktemp("run") / "run.nc")


def copy_of(saved, tmp_path, change):
    """Return a copy in which `change` has done its work, with a seal anew."""
    file = tmp_path / "changed.nc"
    shutil.copy(saved, file)
    with h5py.File(file, "r+") as h5:
        change(h5)
    file.write_bytes(file.read_bytes() + seal(file.read_bytes()))
    return file


def set_attribute(name, value):
    """Return a change of one attribute."""
    return lambda h5: h5.attrs.__setitem__(name, value)


def shorter(h5):
    """Cut a column."""
    values = h5["contact_force"][:5]
    del h5["contact_force"]
    h5.create_dataset("contact_force", data=values)


DAMAGE = {
    "no checksum": lambda h5: h5.attrs.__delitem__("checksum"),
    "no scenario": lambda h5: h5.attrs.__delitem__("scenario"),
    "scenario is a number": set_attribute("scenario", 5),
    "scenario is an array": set_attribute("scenario", np.arange(3)),
    "robot's text is no XML": set_attribute("robot_text", "<robot"),
    "robot is deep": set_attribute("robot", "[" * 100_000),
    "added is no table": set_attribute("added", "[1"),
    "seconds are not finite": set_attribute("wall_seconds", float("nan")),
    "format version is no number": set_attribute("format_version", "x"),
    "format version is huge": set_attribute("format_version", "9" * 5000),
    "format is another": set_attribute("format", "another"),
    "a column is missing": lambda h5: h5.__delitem__("torque"),
    "a column is shorter": shorter,
}
# The command line prints what `load_run` raises, whatever it is; these are of its different sources.
SHOWN = ("no checksum", "format version is no number", "a column is shorter")


@pytest.mark.parametrize("damage", DAMAGE)
def test_damaged_file_is_refused_in_one_line(damage, saved, tmp_path, command_line):
    """A run file that was changed raises RunFileError with its name; the command line prints that one line."""
    file = copy_of(saved, tmp_path, DAMAGE[damage])
    with pytest.raises(cl.RunFileError) as caught:
        cl.load_run(file)
    assert "changed.nc" in str(caught.value)
    assert "\n" not in str(caught.value)
    if damage in SHOWN:
        assert command_line(file, "--out", "again", "--no-figures", "--json").refusal() == str(caught.value)


def test_newer_format_is_told_apart_from_damage(saved, tmp_path):
    """A file of a later format is refused as newer, with both version numbers."""
    file = copy_of(saved, tmp_path, set_attribute("format_version", 99))
    with pytest.raises(cl.RunFileError, match=r"newer.*99.*2"):
        cl.load_run(file)


@pytest.mark.parametrize(
    ("content", "words"),
    [(b"", "is not a run file"), (b"hello", "is not a run file"), (None, "damaged"), ("hdf5", "is not a run file")],
    ids=["empty", "foreign", "cut off", "another HDF5"],
)
def test_foreign_file_is_refused_in_one_line(content, words, saved, tmp_path, command_line):
    """An empty file, a foreign one, half of one and someone else's HDF5 are refused by name."""
    file = tmp_path / "foreign.nc"
    if content == "hdf5":
        with h5py.File(file, "w") as h5:
            h5["mine"] = np.arange(3)
    else:
        file.write_bytes(saved.read_bytes()[:5000] if content is None else content)
    with pytest.raises(cl.RunFileError, match=r"foreign\.nc") as caught:
        cl.load_run(file)
    assert words in str(caught.value)
    if content == b"":
        assert "foreign.nc" in command_line(file).refusal()


@pytest.mark.parametrize("name", ["nowhere.nc", "."])
def test_file_that_is_not_there(name, tmp_path):
    """A missing file, or a folder, is said to be none."""
    with pytest.raises(cl.RunFileError, match=r"no such file|is a folder, not a run file"):
        cl.load_run(tmp_path / name)
    (tmp_path / "run.nc").touch()
    with pytest.raises(cl.RunFileError, match=r"is a folder, not a run file; name the run\.nc in it|no such file"):
        cl.load_run(tmp_path / name)


def test_loaded_robot_is_inspected_like_a_strangers_text(saved):
    """The robot in a run file passes the same door as any text: it is built, and it is the one that ran."""
    loaded = cl.load_run(saved)
    fresh = robot_models.load("wam4")
    assert loaded.model.text == fresh.text
    assert np.array_equal(loaded.model.armature, fresh.armature)
