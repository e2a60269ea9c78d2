"""Files that are damaged, foreign, newer or absent are refused in one line."""

import json
import shutil

import h5py
import numpy as np
import pytest

import closedloop as cl
import robot_models
from closedloop.record.netcdf_file import seal


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """Return the file of a run with the velocity step in it."""
    run = cl.simulate(cl.load_scenario("wam_slide", {"time.duration": 0.6}))
    return run.save(tmp_path_factory.mktemp("run") / "run.nc")


def copy_of(saved, tmp_path, change):
    """Return a copy in which `change` has done its work, without a checksum that would tell, and with a seal anew."""
    file = tmp_path / "changed.nc"
    shutil.copy(saved, file)
    with h5py.File(file, "r+") as h5:
        del h5.attrs["checksum"]
        change(h5)
    file.write_bytes(file.read_bytes() + seal(file.read_bytes()))
    return file


def set_attribute(name, value):
    """Return a change of one attribute."""
    return lambda h5: h5.attrs.__setitem__(name, value)


def set_robot(**fields):
    """Return a change of the robot's figures."""
    return lambda h5: h5.attrs.__setitem__("robot", json.dumps(json.loads(h5.attrs["robot"]) | fields))


def replace_column(name, make):
    """Return a change of a column to what `make` makes of it, its dimensions kept where the length is."""

    def change(h5):
        values, units = make(h5[name][...]), dict(h5[name].attrs)["units"]
        del h5[name]
        h5.create_dataset(name, data=values).attrs["units"] = units
        if len(values) == len(h5["q"]):
            h5[name].dims[0].attach_scale(h5["time"])

    return change


DAMAGE = {
    "no scenario": lambda h5: h5.attrs.__delitem__("scenario"),
    "scenario is no TOML": set_attribute("scenario", "not toml ["),
    "scenario has an unknown key": set_attribute("scenario", "law = {kp = 1, kd = 1, kq = 1}"),
    "scenario is a number": set_attribute("scenario", 5),
    "robot is no JSON": set_attribute("robot", "{bad"),
    "robot is a list": set_attribute("robot", "[]"),
    "robot is empty": set_attribute("robot", "{}"),
    "robot knows more": set_robot(extra=1),
    "armature too short": set_robot(armature=[1.0]),
    "armature negative": set_robot(armature=[-1.0, 1.0, 1.0, 1.0]),
    "gravity is NaN": set_robot(gravity=[0.0, 0.0, float("nan")]),
    "format of the robot": set_robot(format="sdf"),
    "locked joint unknown": set_robot(locked={"J9": 1.0}),
    "locked is a number": set_robot(locked=3),
    "tip unknown": set_robot(tip="toe"),
    "tip is a number": set_robot(tip=3),
    "name is a number": set_robot(name=3),
    "robot's text is a number": set_attribute("robot_text", 5),
    "robot's text is no XML": set_attribute("robot_text", "<robot"),
    "a mass is negative": lambda h5: h5.attrs.__setitem__(
        "robot_text", h5.attrs["robot_text"].replace('mass value="1.06513649"', 'mass value="-1"')
    ),
    "versions are no table": set_attribute("versions", "[1]"),
    "versions are no JSON": set_attribute("versions", "{"),
    "seconds are not finite": set_attribute("wall_seconds", float("nan")),
    "seconds are no number": set_attribute("wall_seconds", "abc"),
    "format version is no number": set_attribute("format_version", "x"),
    "format is another": set_attribute("format", "another"),
    "a column is missing": lambda h5: h5.__delitem__("torque"),
    "a column is shorter": replace_column("contact_force", lambda x: x[:5]),
    "a column is text": replace_column("contact_force", lambda x: np.array([b"x"] * len(x))),
    "a number is none": replace_column("contact_force", lambda x: np.where(np.arange(len(x)) == 7, np.nan, x)),
    "a number is infinite": replace_column("v", lambda x: x + np.inf),
    "robot is deep": set_attribute("robot", "[" * 100_000),
    "versions are numbers": set_attribute("versions", '{"numpy": 2}'),
    "versions are deep": set_attribute("versions", '{"a":' * 5_000 + "1" + "}" * 5_000),
    "a whole number is huge": set_robot(armature=[10**400, 1, 1, 1]),
    "format version is huge": set_attribute("format_version", "9" * 5000),
    "engine is unknown": set_attribute("engine", "warp"),
    "scenario has a huge number": set_attribute("scenario", "law = {kp = " + "9" * 5000 + "}"),
    "a column has another shape": replace_column("torque", lambda x: x[:, :2].copy()),
}
# The command line prints what `load_run` raises, whatever it is; these are of its different sources.
SHOWN = ("no scenario", "robot's text is no XML", "a column is shorter", "a number is none")


@pytest.mark.parametrize("damage", DAMAGE)
def test_damaged_file_is_refused_in_one_line(damage, saved, tmp_path, command_line):
    """A run file that was tampered with raises RunFileError with its name; the command line prints that one line."""
    file = copy_of(saved, tmp_path, DAMAGE[damage])
    with pytest.raises(cl.RunFileError) as caught:
        cl.load_run(file)
    assert "changed.nc" in str(caught.value)
    assert "\n" not in str(caught.value)
    if damage in SHOWN:
        assert command_line(file, "--out", "again", "--no-figures", "--json").refusal() == str(caught.value)


def test_the_mass_that_was_tampered_with_is_in_the_text(saved):
    """The negative control of the tampering above: the text it replaces is there."""
    with h5py.File(saved) as h5:
        assert 'mass value="1.06513649"' in h5.attrs["robot_text"]


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


def test_loaded_robot_is_inspected_like_a_strangers_text(saved):
    """The robot in a run file passes the same door as any text: it is built, and it is the one that ran."""
    loaded = cl.load_run(saved)
    fresh = robot_models.load("wam4")
    assert loaded.model.text == fresh.text
    assert np.array_equal(loaded.model.armature, fresh.armature)
