"""Damage to a run file is told from its bytes, by its seal, and from what it holds, by its checksum."""

import dataclasses
import hashlib
import hmac
import io
import os
import shutil
import signal
import stat
import threading
import time

import h5py
import numpy as np
import pytest

import closedloop as cl
from closedloop.__main__ import main
from closedloop.figures import draw_figures
from closedloop.record import sealed
from closedloop.record.columns.recorded import COLUMNS
from closedloop.record.hdf5_reader import read_hdf5
from closedloop.record.report import print_report
from closedloop.record.save import attributes
from closedloop.record.sealed import seal_key


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """Return the file of a short run."""
    run = cl.simulate(cl.load_scenario("planar2_slide", {"time.duration": 0.05}))
    return run.save(tmp_path_factory.mktemp("run") / "run.nc")


@pytest.fixture
def copy(saved, tmp_path):
    """Return a copy of the file."""
    return shutil.copy(saved, tmp_path / "copy.nc")


@pytest.fixture
def no_other_process(monkeypatch):
    """Let a file that would be read by a process of its own fail the test."""

    def refuse(*arguments):
        raise AssertionError("read by another process")

    monkeypatch.setattr(sealed, "_read_apart", refuse)


@pytest.fixture
def read_here(monkeypatch):
    """Read a file that nothing vouches for in this process, where HDF5 is known to bear it: a process takes 0.4 s."""

    def read(path, size, names):
        return read_hdf5(io.BytesIO(path.read_bytes()), size, names)

    monkeypatch.setattr(sealed, "_read_apart", read)


def same(file, saved):
    """Whether a file holds the run of another."""
    one, other = cl.load_run(file), cl.load_run(saved)
    return all(np.array_equal(one.columns[name], other.columns[name]) for name in COLUMNS)


@pytest.mark.usefixtures("no_other_process")
def test_every_changed_byte_is_told_before_hdf5_reads_it(copy, saved):
    """One bit anywhere in front of the seal is one line, at once."""
    whole = bytearray(saved.read_bytes())
    rng = np.random.default_rng(2)
    for at in rng.integers(0, len(whole) - sealed.SEAL_LENGTH, 100):
        damaged = whole.copy()
        damaged[at] ^= 1 << int(rng.integers(8))
        copy.write_bytes(damaged)
        with pytest.raises(cl.RunFileError, match=r"copy.nc: is damaged: its bytes are not those"):
            cl.load_run(copy)


@pytest.mark.usefixtures("no_other_process")
def test_intact_file_needs_no_other_process(saved):
    """What was written is read here, and quickly."""
    assert len(cl.load_run(saved)) == 51


@pytest.fixture
def not_ours(monkeypatch):
    """Let another user have written what there is."""
    monkeypatch.setattr(sealed, "seal_key", lambda: b"another user's")


@pytest.mark.usefixtures("not_ours")
def test_a_seal_is_no_reason_to_read_a_file_here(saved, monkeypatch):
    """Anyone can seal a damaged file: what this process did not write is read by one that can be ended."""
    expected, asked = cl.load_run(saved), []
    monkeypatch.setattr(
        sealed, "_read_apart", lambda path, size, names: asked.append(path) or read_hdf5(str(path), size, names)
    )
    assert np.array_equal(cl.load_run(saved).q, expected.q)
    assert asked == [saved]


@pytest.mark.usefixtures("not_ours")
@pytest.mark.parametrize("ended_by", ["the limit", "Ctrl-C"])
def test_a_sealed_file_that_hdf5_never_finishes_is_ended(saved, ended_by, monkeypatch, tmp_path):
    """The reader of a resealed file loops for ever: after the time for its size, or at Ctrl-C, it is gone."""
    program, begun = tmp_path / "python", tmp_path / "begun"
    program.write_text(
        f"#!/bin/sh\ntrap '' INT\necho $$ >{begun}.new; mv {begun}.new {begun}\nwhile :; do sleep 1; done\n"
    )
    program.chmod(0o700)
    monkeypatch.setattr(sealed.sys, "executable", str(program))
    if ended_by == "the limit":
        monkeypatch.setattr(sealed, "PATIENCE", 2.0)
        with pytest.raises(cl.RunFileError, match="HDF5 did not finish reading it"):
            cl.load_run(saved)
    else:

        def interrupt():
            while not begun.exists():
                time.sleep(0.01)
            os.kill(os.getpid(), signal.SIGINT)

        threading.Thread(target=interrupt, daemon=True).start()
        with pytest.raises(KeyboardInterrupt):
            cl.load_run(saved)
    with pytest.raises(ProcessLookupError):
        os.kill(int(begun.read_text()), 0)


def test_the_line_of_the_seal_says_what_it_is(saved):
    """Anybody can check it: the digest of all bytes before the line."""
    content, _, line = saved.read_bytes().rpartition(b"\nclosedloop SHA-256 of all bytes before this line: ")
    digest, signed = line.decode().split()
    assert digest == hashlib.sha256(content).hexdigest()
    assert signed == hmac.new(seal_key(), bytes.fromhex(digest), "sha256").hexdigest()


@pytest.mark.usefixtures("read_here")
def test_a_seal_without_a_signature_is_one(copy, saved):
    """Files of earlier versions end in the digest alone; in them, too, a bit that changed is told."""
    whole = saved.read_bytes()
    copy.write_bytes(whole[:-66] + b"\n")
    assert same(copy, saved)
    copy.write_bytes(whole[:500] + bytes([whole[500] ^ 1]) + whole[501:-66] + b"\n")
    with pytest.raises(cl.RunFileError, match=r"copy.nc: is damaged: its bytes are not those"):
        cl.load_run(copy)


def test_the_key_is_the_users_alone(tmp_path, monkeypatch):
    """Made once for this user to read; one that others can read or write is not used, nor one of another length."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    key, file = seal_key.__wrapped__(), tmp_path / "cache" / sealed.NAME
    assert seal_key.__wrapped__() == key == file.read_bytes()
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    for mode in (0o640, 0o604, 0o620):
        file.chmod(mode)
        assert seal_key.__wrapped__() != key
    file.chmod(0o600)
    (tmp_path / "cache").chmod(0o777)
    assert seal_key.__wrapped__() != key
    (tmp_path / "cache").chmod(0o700)
    assert seal_key.__wrapped__() == key
    file.write_bytes(b"short")
    assert len(seal_key.__wrapped__()) == sealed.LENGTH
    assert list((tmp_path / "cache").iterdir()) == [file]


def test_additions_of_others_are_no_damage(copy, saved):
    """A comment or a column that another program adds, or bytes behind the end, leave the run what it was."""
    with h5py.File(copy, "r+") as h5:
        h5.attrs["comment"] = "the good one"
        h5["mine"] = np.arange(3)
    assert same(copy, saved)
    copy.write_bytes(saved.read_bytes() + b"more")
    assert same(copy, saved)


@pytest.mark.usefixtures("read_here")
@pytest.mark.parametrize("what", ["column", "scenario", "engine", "no law", "no column", "no added column"])
def test_changes_by_others_are_told(what, copy):
    """A number, a text or an attribute changed or removed through h5py is told by the checksum."""
    with h5py.File(copy, "r+") as h5:
        if what == "column":
            h5["q"][3, 1] += 1e-15
        elif what == "no law":
            del h5.attrs["law"]
        elif what == "no column":
            del h5["kinetic_energy"]
        elif what == "no added column":
            del h5["energy_supplied"]
        else:
            h5.attrs[what] = "compiled" if what == "engine" else h5.attrs[what].replace("10", "11")
    with pytest.raises(cl.RunFileError, match=r"copy.nc: is .*damaged"):
        cl.load_run(copy)


@pytest.mark.usefixtures("read_here")
def test_file_from_before_there_was_a_checksum_is_read(copy, saved):
    """Neither seal nor checksum nor the attributes that came with them: the run is there all the same."""
    with h5py.File(copy, "r+") as h5:
        for name in ("checksum", "engine", "law_digest", "not_finite"):
            del h5.attrs[name]
    assert same(copy, saved)
    assert cl.load_run(copy).engine == "pinocchio"


@pytest.mark.usefixtures("read_here")
def test_file_from_before_there_were_all_columns_is_read(copy, saved):
    """What an earlier version did not write is no number, and whatever is made of it says so; the rest is the same."""
    with h5py.File(copy, "r+") as h5:
        for name in ("checksum", "engine", "law_digest", "not_finite"):
            del h5.attrs[name]
        for name in ("energy_supplied", "event_restitution"):
            del h5[name]
    old, run = cl.load_run(copy), cl.load_run(saved)
    assert np.all(np.isnan(old.energy_supplied))
    assert len(old) == len(run)
    figures, whole = old.summary(), run.summary()
    assert figures["not_finite"] == ["max_energy_residual"]
    assert figures["max_energy_residual"] is None
    assert whole["verdict"]["good"]
    assert [problem["name"] for problem in figures["verdict"]["problems"]] == ["energy"]
    assert "not known" in figures["verdict"]["problems"][0]["text"]
    assert {name for name in whole if whole[name] != figures[name]} == {"max_energy_residual", "not_finite", "verdict"}


@pytest.mark.slow
def test_everything_is_made_of_a_file_of_an_earlier_version(tmp_path, capsys):
    """A bouncing run without the columns added since: its report, its figures and its file are made all the same."""
    path = cl.simulate(cl.load_scenario("planar2_drop", {"time.duration": 0.5})).save(tmp_path / "run.nc")
    with h5py.File(path, "r+") as h5:
        for name in ("checksum", "not_finite"):
            del h5.attrs[name]
        for name in ("energy_supplied", "event_restitution"):
            del h5[name]
    old = cl.load_run(path)
    assert len(old.events) >= 2
    assert np.isnan(old.events[0].restitution)
    print_report(old)
    said = capsys.readouterr().out
    assert "verdict: BAD: energy" in said
    assert "gave less" not in said
    assert len(draw_figures(old, tmp_path)) >= 4
    again = cl.load_run(old.save(tmp_path / "again.nc"))
    assert np.array_equal(again.energy_supplied, old.energy_supplied, equal_nan=True)


@pytest.mark.usefixtures("read_here")
def test_column_that_all_versions_wrote_is_asked_for(copy):
    """Only what was added since may be missing."""
    with h5py.File(copy, "r+") as h5:
        del h5.attrs["checksum"]
        del h5["kinetic_energy"]
    with pytest.raises(cl.RunFileError, match="'kinetic_energy' is missing"):
        cl.load_run(copy)


@pytest.mark.usefixtures("read_here")
def test_columns_of_the_links_contacts_are_asked_for(tmp_path):
    """Where the scenario has contacts they may not be missing."""
    file = cl.simulate(cl.load_scenario("two_arms_bar", {"time.duration": 0.001})).save(tmp_path / "run.nc")
    with h5py.File(file, "r+") as h5:
        del h5.attrs["checksum"], h5["link_forces"]
    with pytest.raises(cl.RunFileError, match="'link_forces' is missing"):
        cl.load_run(file)


def test_reading_that_does_not_end_is_ended(copy, saved, monkeypatch):
    """A file over which HDF5 would sit for ever is refused after a while."""
    copy.write_bytes(saved.read_bytes()[: -sealed.SEAL_LENGTH])
    monkeypatch.setattr(sealed, "PATIENCE", 1e-3)
    monkeypatch.setattr(sealed, "BYTES_A_SECOND", np.inf)
    with pytest.raises(cl.RunFileError, match="HDF5 did not finish reading it"):
        cl.load_run(copy)


def test_reading_that_breaks_down_breaks_down_alone(copy, saved, monkeypatch, tmp_path):
    """A file over which HDF5 ends its process is refused."""
    program = tmp_path / "python"
    program.write_text("#!/bin/sh\nkill -SEGV $$\n")
    program.chmod(0o700)
    copy.write_bytes(saved.read_bytes()[: -sealed.SEAL_LENGTH])
    monkeypatch.setattr(sealed.sys, "executable", str(program))
    with pytest.raises(cl.RunFileError, match="HDF5 failed while reading it"):
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


@pytest.mark.parametrize(("name", "where", "value", "words"), [
    ("time", slice(None, None), 0.0, "'time' does not go"),
    ("time", 3, 0.0, "'time' does not go"),
    ("time", 0, -1.0, "'time' does not go"),
    ("mode", 2, 77, "'mode' has 77"),
    ("mode", 2, -1, "'mode' has -1"),
    ("event_kind", 0, 99, "'event_kind' has 99"),
    ("event_time", 0, -1.0, "'event_time' does not go"),
    ("event_time", -1, 0.6, "'event_time' has 0.6 s, and the run ends at 0.5 s"),
    ("event_time", -1, 0.500001, "'event_time' has 0.500001 s, and the run ends at 0.5 s"),
    ("event_contact", 0, -1, "'event_contact' has -1: the run has contacts 0 to 2"),
    ("event_contact", 0, 3, "'event_contact' has 3: the run has contacts 0 to 2"),
])  # fmt: skip
def test_what_no_run_can_hold_is_refused(bounced, tmp_path, read_here, capsys, name, where, value, words):
    """In a file without digests: time backwards or standing still, modes and kinds that there are not."""
    copy = shutil.copy(bounced, tmp_path / "copy.nc")
    with h5py.File(copy, "r+") as file:
        del file.attrs["checksum"]
        file[name][where] = value
    with pytest.raises(cl.RunFileError, match=words) as caught:
        cl.load_run(copy)
    assert "\n" not in str(caught.value)
    assert main(["show", str(copy)]) == 2
    assert capsys.readouterr().err.count("\n") == 1


@pytest.mark.parametrize("kind", [">f8", ">f4"])
def test_numbers_of_another_machine_are_read_as_this_ones(saved, tmp_path, read_here, kind):
    """Another program may write them with the first byte first: what uses the run, as a table of text, takes them."""
    copy, run = shutil.copy(saved, tmp_path / "copy.nc"), cl.load_run(saved)
    with h5py.File(copy, "r+") as file:
        del file.attrs["checksum"], file["q"]
        file["q"] = run.q.astype(kind)
    loaded = cl.load_run(copy)
    assert loaded.q.dtype.isnative
    np.testing.assert_array_equal(loaded.q, run.q.astype(kind))
    assert main(["export", str(copy), "--to", "csv", "--out", str(tmp_path / "run.csv")]) == 0


@pytest.fixture(scope="module")
def bounced(tmp_path_factory):
    """Return the file of a short run with an event."""
    run = cl.simulate(cl.load_scenario("planar2_drop", {"time.duration": 0.5}))
    assert len(run.events)
    return run.save(tmp_path_factory.mktemp("bounced") / "run.nc")


@pytest.mark.parametrize("how", ["external storage", "external link", "virtual dataset", "soft link", "circle"])
def test_a_column_in_another_file_is_refused(copy, tmp_path, read_here, how):
    """Bytes of another file are never read as numbers of a run, whatever way HDF5 has to refer to them."""
    secret, name = tmp_path / "secret", "contact_force"
    with h5py.File(copy, "r+") as file:
        length, dtype = file[name].shape[0], file[name].dtype
        secret.write_bytes(bytes(8 * length))
        with h5py.File(tmp_path / "other.nc", "w") as other:
            other[name] = np.zeros(length)
        del file.attrs["checksum"], file[name]
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
