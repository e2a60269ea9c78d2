"""Damage to a run file is told from its bytes, by its last line, and from what it holds, by its checksum."""

import dataclasses
import hashlib
import os
import shutil

import h5py
import numpy as np
import pytest

import closedloop as cl
from closedloop.record import save
from closedloop.record.columns.record import COLUMNS
from closedloop.record.save import attributes


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """Return the file of a short run."""
    run = cl.simulate(cl.load_scenario("planar2_slide", {"time.duration": 0.05}))
    return run.save(tmp_path_factory.mktemp("run") / "run.nc")


@pytest.fixture
def copy(saved, tmp_path):
    """Return a copy of the file."""
    return shutil.copy(saved, tmp_path / "copy.nc")


def same(file, saved):
    """Whether a file holds the run of another."""
    one, other = cl.load_run(file), cl.load_run(saved)
    return all(np.array_equal(one.columns[name], other.columns[name]) for name in COLUMNS)


def test_every_changed_byte_is_told_before_hdf5_reads_it(copy, saved, monkeypatch):
    """One bit anywhere in front of the last line is one line, at once."""
    monkeypatch.setattr(save, "_read_hdf5", None)
    whole = bytearray(saved.read_bytes())
    rng = np.random.default_rng(2)
    for at in rng.integers(0, len(whole) - save.SEAL_LENGTH, 100):
        damaged = whole.copy()
        damaged[at] ^= 1 << int(rng.integers(8))
        copy.write_bytes(damaged)
        with pytest.raises(cl.RunFileError, match=r"copy.nc: is damaged: its bytes are not those"):
            cl.load_run(copy)


def test_the_last_line_says_what_it_is(saved):
    """Anybody can check it: the digest of all bytes before the line."""
    content, _, line = saved.read_bytes().rpartition(b"\nclosedloop SHA-256 of all bytes before this line: ")
    assert line.decode() == hashlib.sha256(content).hexdigest() + "\n"


def test_additions_of_others_are_no_damage(copy, saved):
    """A comment or a column that another program adds, or bytes behind the end, leave the run what it was."""
    with h5py.File(copy, "r+") as h5:
        h5.attrs["comment"] = "the good one"
        h5["mine"] = np.arange(3)
    assert same(copy, saved)
    copy.write_bytes(saved.read_bytes() + b"more")
    assert same(copy, saved)


@pytest.mark.parametrize("what", ["column", "scenario", "engine", "no law", "no column", "no checksum"])
def test_changes_by_others_are_told(what, copy):
    """A number, a text or an attribute changed or removed through h5py is told by the checksum."""
    with h5py.File(copy, "r+") as h5:
        if what == "column":
            h5["q"][3, 1] += 1e-15
        elif what == "no law":
            del h5.attrs["law"]
        elif what == "no column":
            del h5["kinetic_energy"]
        elif what == "no checksum":
            del h5.attrs["checksum"]
        else:
            h5.attrs[what] = "compiled" if what == "engine" else h5.attrs[what].replace("10", "11")
    with pytest.raises(cl.RunFileError, match=r"copy.nc: (is damaged|has no checksum)"):
        cl.load_run(copy)


def test_column_larger_than_its_file_is_refused(copy):
    """A column that claims a petabyte is not given one."""
    with h5py.File(copy, "r+") as h5:
        del h5["contact_force"]
        h5.create_dataset("contact_force", shape=(2**47,), chunks=(1024,), dtype="f8")
    with pytest.raises(cl.RunFileError, match="contact_force"):
        cl.load_run(copy)


def test_what_a_run_says_is_not_finite_is_read(tmp_path):
    """An infinity that the run itself came to is in the file, and the file says in which column."""
    run = cl.simulate(cl.load_scenario("planar2_slide", {"time.duration": 0.01}))
    force = run.contact_force.copy()
    force[3] = np.inf
    odd = cl.Run(run.scenario, run.model, {**run.columns, "contact_force": force})
    loaded = cl.load_run(odd.save(tmp_path / "odd.nc"))
    assert np.isinf(loaded.contact_force[3])


@pytest.mark.parametrize("kind", ["a pipe", "a folder", "a device", "a link to a pipe"])
def test_what_is_no_file_is_refused_at_once(kind, tmp_path):
    """Opening a pipe would wait for ever, reading a device too."""
    place = tmp_path / "run.nc"
    if kind == "a folder":
        place.mkdir()
    elif kind == "a device":
        place = "/dev/zero"
    elif kind == "a pipe":
        os.mkfifo(place)
    else:
        os.mkfifo(tmp_path / "pipe")
        place.symlink_to("pipe")
    with pytest.raises(cl.RunFileError, match=f"is {kind.removeprefix('a link to ')}, not a run file"):
        cl.load_run(place)


def test_seed_is_that_of_the_sensors_noise(saved):
    """Where something is random, the file says what and from which seed."""
    run = cl.load_run(saved)
    assert attributes(run)["seed"].startswith("none")
    noisy = cl.load_scenario("planar2_slide", {"sensor.noise": 0.1, "sensor.seed": 7})
    assert attributes(dataclasses.replace(run, scenario=noisy))["seed"].startswith("7: ")


@pytest.mark.parametrize("how", ["external storage", "external link", "virtual dataset", "soft link", "circle"])
def test_a_column_in_another_file_is_refused(copy, tmp_path, how):
    """Bytes of another file are never read as numbers of a run, whatever way HDF5 has to refer to them."""
    secret, name = tmp_path / "secret", "contact_force"
    with h5py.File(copy, "r+") as file:
        length, dtype = file[name].shape[0], file[name].dtype
        secret.write_bytes(bytes(8 * length))
        with h5py.File(tmp_path / "other.nc", "w") as other:
            other[name] = np.zeros(length)
        del file[name]
        if how == "external storage":
            file.create_dataset(name, (length,), dtype, external=[(str(secret), 0, 8 * length)])
        elif how == "external link":
            file[name] = h5py.ExternalLink(str(tmp_path / "other.nc"), name)
        elif how == "virtual dataset":
            layout = h5py.VirtualLayout((length,), dtype)
            layout[:] = h5py.VirtualSource(str(tmp_path / "other.nc"), name, (length,))
            file.create_virtual_dataset(name, layout)
        else:
            file[name] = h5py.SoftLink("/measured_force" if how == "soft link" else f"/{name}")
    with pytest.raises(cl.RunFileError, match=f"column '{name}' (is in another file|is a link)"):
        cl.load_run(copy)
