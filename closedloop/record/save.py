"""Writing a run as a file: NetCDF-4, which is HDF5, with everything that is needed to repeat it as attributes.

xarray, h5py and MATLAB open it. Two digests tell damage: the file's seal, of all its bytes, and the attribute
`checksum`, of what a run is made of, which still holds when another program has added to the file.

HDF5 does not survive a failed write: it ends the process when the file is closed. So the room is reserved before it
begins (`closedloop.base.files.write_whole`), and what was not needed is given back.

Behind the HDF5, where no reader looks, stands

    closedloop SHA-256 of all bytes before this line: 0123...

HDF5 trusts what it reads, and may loop for ever over damaged bytes or end the process: so the line is checked first. A
file without one was changed by another program, which cuts it off; HDF5 opens that as it is. Numbers that are in
another file are not read. `closedloop.record.run.load_run` reads a run.
"""

import hashlib
import io
import json
import stat
import sys
import tomllib
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

import robot_models
from closedloop.base.errors import RunFileError
from closedloop.base.files import kind_of, reason_of, write_whole
from closedloop.jit.cache_folder import cache_folder
from closedloop.jit.user_code import source_digest
from closedloop.record.columns.derived import as_text, columns_by_contact
from closedloop.record.columns.record import Record, in_order
from closedloop.scenario.scenario import NO_ROBOT, Scenario, families
from closedloop.scenario.tables import labels_of, patches_of, tangents_of
from closedloop.scenario.user_module import members_of_users
from robot_models import RobotModel
from robot_models.collision import digest_of

# Bytes that HDF5 takes beside numbers and texts at most: for a file, and for each variable.
OF_FILE, OF_VARIABLE = 100_000, 10_000


class Variable(NamedTuple):
    """What is written of a variable."""

    dims: tuple[str, ...]  # the names of its dimensions
    data: NDArray[Any]  # numbers, or text as an array of objects
    attributes: Mapping[str, str] = {}  # texts by name


def write_netcdf(
    path: Path, dimensions: Mapping[str, int], variables: Mapping[str, Variable], attributes: Mapping[str, Any],
    then: Callable[[BinaryIO], None],
) -> Path:  # fmt: skip
    """Write a NetCDF-4 file whole, or not at all.

    `dimensions`: lengths by name.
    `variables`: by name; one with the name of a dimension has that dimension alone.
    `attributes`: the file's own attributes.
    `then`: writes what goes behind it.
    Raises OutputError.
    """
    import h5py

    def write(out: Any) -> None:
        out.dimensions = {name: length or None for name, length in dimensions.items()}  # it knows no empty one
        for name, (dims, data, texts) in variables.items():
            kind = h5py.string_dtype() if data.dtype == object else data.dtype
            out.create_variable(name, dims, kind, data=data).attrs.update(texts)
        out.attrs.update(attributes)

    texts = [*attributes.values(), *(text for each in variables.values() for text in each.attributes.values())]
    numbers = sum(each.data.nbytes + OF_VARIABLE for each in variables.values())
    return write_reserved(path, numbers + 4 * sum(len(str(text)) for text in texts), write, then)


def write_reserved(
    path: Path, room: int, write: Callable[[Any], None], then: Callable[[BinaryIO], None] = lambda file: None
) -> Path:
    """Let a function write an `h5netcdf.File` for which so many bytes are reserved, beside those for an empty one."""
    import h5netcdf

    def whole(file: BinaryIO) -> None:
        empty = io.BytesIO()
        h5netcdf.File(empty, "w").close()
        file.write(empty.getbuffer())  # a file that HDF5 makes it would truncate, and so give the room back
        with h5netcdf.File(file, "r+") as out:
            write(out)
        file.seek(0, io.SEEK_END)
        then(file)

    return write_whole(path, whole, reserve=OF_FILE + room)


_WORDS = b"\nclosedloop SHA-256 of all bytes before this line: "
SEAL_LENGTH = len(_WORDS) + 64 + 1
# A column that says it is larger than its file, compressed at best, is not read.
BEST_COMPRESSION = 1100

Attributes = dict[str, str | int | float]
Columns = dict[str, NDArray[Any]]


def seal(content: bytes | memoryview) -> bytes:
    """Return the line that goes behind the content of a file."""
    return _WORDS + hashlib.sha256(content).hexdigest().encode() + b"\n"


def seal_file(file: BinaryIO) -> None:
    """Write the line behind the content of an open file."""
    file.seek(0)
    total = hashlib.file_digest(file, "sha256")  # type: ignore[arg-type]
    file.write(_WORDS + total.hexdigest().encode() + b"\n")


def unsealed(whole: memoryview) -> memoryview | None:
    """Return what stands before the line at the end of a file's bytes, None if there is no line.

    Raises ValueError if its SHA-256 is another.
    """
    content, line = whole[:-SEAL_LENGTH], bytes(whole[-SEAL_LENGTH:])
    if not line.startswith(_WORDS):
        return None
    if line != seal(content):
        raise ValueError("is damaged: its bytes are not those that were written (their SHA-256 differs)")
    return content


def read_sealed(path: Path, names: list[str]) -> tuple[Attributes, Columns]:
    """Return the attributes of a file that are text or one number, and those of the columns named that it has.

    Columns that the attribute `added` names are read as well.

    Raises RunFileError if it is no file, or damaged, or a column is no numbers, larger than the file can hold, or not
        in the file itself; the message does not name the file.
    Raises OSError if the system refuses it.
    """
    try:
        found = path.stat()
    except (FileNotFoundError, NotADirectoryError, ValueError):  # ValueError: a null byte in the name
        raise RunFileError("there is no such file") from None
    if not stat.S_ISREG(found.st_mode):
        inside = "; name the run.nc in it" if (path / "run.nc").exists() else ""
        raise RunFileError(f"is {kind_of(found.st_mode)}, not a run file{inside}")
    with path.open("rb") as file:
        file.seek(max(0, found.st_size - SEAL_LENGTH))
        source: str | BinaryIO = str(path)
        if file.read().startswith(_WORDS):
            file.seek(0)
            whole = file.read()
            try:
                unsealed(memoryview(whole))
            except ValueError as error:
                raise RunFileError(str(error)) from None
            source = io.BytesIO(whole)  # of bytes this is no copy
    try:
        return _read_hdf5(source, found.st_size, names)
    except Exception as error:  # whatever HDF5 and h5py may say of a damaged file
        raise RunFileError(f"is not a run file, or is damaged: {reason_of(error)}") from None


def _read_hdf5(source: str | BinaryIO, size: int, names: list[str]) -> tuple[Attributes, Columns]:
    """Return the attributes and the columns of a file of so many bytes."""
    import h5py

    attributes: Attributes = {}
    columns: Columns = {}
    with h5py.File(source, "r") as file:
        for name in file.attrs:
            try:
                value = _plain(file.attrs[name])
            except (OSError, TypeError, ValueError):
                continue  # of a type that is not ours
            if value is not None:
                attributes[name] = value
        with suppress(TypeError, ValueError, RecursionError):  # of what is no table the caller says so
            names = [*names, *dict(json.loads(str(attributes.get("added", "{}"))))]
        for name in names:
            link = file.get(name, getlink=True)
            if link is not None and not isinstance(link, h5py.HardLink):
                raise ValueError(f"column '{name}' is a link to another place: a run file must contain its numbers")
            column = file.get(name)
            if not isinstance(column, h5py.Dataset):
                continue
            if column.external or column.is_virtual:
                raise ValueError(f"column '{name}' is in another file: a run file must contain its numbers")
            if column.dtype.kind not in "iuf" or column.shape is None:
                raise ValueError(f"column '{name}' is {column.dtype}, not numbers")
            if column.nbytes > BEST_COMPRESSION * size:
                raise ValueError(f"column '{name}' claims {column.nbytes} bytes, in a file of {size}")
            columns[name] = np.ascontiguousarray(column[()])
    return attributes, columns


def _plain(value: Any) -> str | int | float | None:
    """Return an attribute as text or number, None if it is anything else."""
    import h5py

    if isinstance(value, h5py.Empty):
        return "" if value.dtype.kind in "SO" else None
    if isinstance(value, np.ndarray) and value.size == 1:  # netCDF has arrays only
        value = value.reshape(-1)[0]
    if isinstance(value, np.number):
        value = value.item()
    if isinstance(value, bytes):
        return value.decode("utf-8", "replace")
    return value if isinstance(value, str | int | float) else None


def package_versions() -> dict[str, str]:
    """Return the versions of Python and of the packages whose arithmetic a run depends on."""
    names = ("closedloop", "pin", "numpy", "numba", "llvmlite")
    return {"python": sys.version.split()[0]} | {name: _version(name) for name in names}


@cache
def _version(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return "not installed"


FORMAT, FORMAT_VERSION = "closedloop run", 2
# Endings of files in this format, and the metadata conventions that their units and names follow.
HDF5 = (".nc", ".h5")
CONVENTIONS = {"Conventions": "CF-1.11"}
CHECKSUM = "checksum"
# Attributes that are text.
TEXTS = ("scenario", "robot_text", "robot", "law", "versions", "stopped", "engine", "law_digest", "not_finite")
# An attribute of a run with users' classes only: JSON of their names and the SHA-256 of their texts.
MEMBERS = "members"
# An attribute of a run that has columns beyond those of all runs: see `closedloop.record.columns.derived`.
ADDED = "added"
# An attribute of a run that was compared with one at half its step: JSON, see `closedloop.record.report.halved`.
HALVED = "halved"
# What the checksum is of.
ATTRIBUTES = {ADDED, "format", "format_version", "seed", "wall_seconds", "summary", *TEXTS, MEMBERS, HALVED}


def question(
    scenario: Scenario, model: RobotModel, law: str, law_digest: str, engine: str, members: Mapping[str, str]
) -> dict[str, str]:
    """Return what determines a run to the last bit, on one machine, as the texts that its file has as attributes.

    `members` are the digests of the users' classes, see `closedloop.scenario.user_module.member_digests`.
    """
    robot = {name: getattr(model, name) for name in ("name", "format", "tip", "description", "source")}
    robot |= {name: getattr(model, name).tolist() for name in ("armature", "home", "gravity")}
    robot["locked"] = dict(model.locked)
    if model.loops or model.drives:  # a tree has none, in files of any version
        robot |= {"loops": [loop.as_table() for loop in model.loops], "drives": list(model.drives or ())}
    if model.drives == ():
        robot["undriven"] = True
    return {
        "scenario": scenario.to_toml(),
        "robot_text": model.text,
        "robot": json.dumps(robot),  # floats in their shortest exact form
        "law": law,
        "law_digest": law_digest,
        "engine": engine,
    } | ({MEMBERS: json.dumps(dict(sorted(members.items())))} if members else {})


def identity_of(scenario: Scenario, changes: Mapping[str, Sequence[Any]], engine: str) -> dict[str, Any]:
    """Return what the numbers of a scenario's runs depend on, as JSON has it, by the names `NAMES`.

    `changes`: values of the keys that change from run to run.
    `engine`: see `closedloop.simulate`.
    Raises ModelError if the robot is at fault, and no other is asked for.
    """
    # The text of a user's class, or a robot's file, may change between a kill and what follows.
    digests = {name: source_digest(families()[key].get(name)) for key, name in members(scenario, changes)}
    return {
        "scenario": scenario.to_toml(), "robot": _robots(scenario, changes), "engine": engine,
        "versions": package_versions(), "kernels": cache_folder().name, **({"members": digests} if digests else {}),
    }  # fmt: skip


def members(scenario: Scenario, changes: Mapping[str, Sequence[Any]]) -> tuple[tuple[str, str], ...]:
    """Return the keys that pick a user's class in any run, with its name."""
    found = list(members_of_users(scenario).items())
    for key, values in changes.items():
        if key in families():
            found += [(key, name) for name in values if isinstance(name, str) and ":" in name]
    return tuple(found)


def _robots(scenario: Scenario, changes: Mapping[str, Sequence[Any]]) -> dict[str, str]:
    """Return a digest of each robot that a run may load."""
    names = {str(value) for value in changes.get("robot.model", [scenario.robot.model])}
    digests = {}
    for name in sorted(names - {NO_ROBOT}):
        try:
            digests[name] = digest_of(robot_models.load(name))
        except Exception as error:  # of the runs with this robot, which say it, as long as there are others
            if len(names) == 1:
                raise
            digests[name] = f"{type(error).__name__}: {error}"
    return digests


# What the results of runs depend on, in words.
NAMES = {
    "scenario": "scenario", "robot_text": "robot", "robot": "robot", "engine": "engine", "law": "law",
    "law_digest": "text of the law", MEMBERS: "text of a class of your own", "versions": "list of versions",
    "kernels": "text of closedloop", "design": "design", "axes": "list of keys and values", "runs": "number of runs",
    "seed": "seed", "keep": "list of columns kept", "vary": "list of ranges", "names": "list of values",
    "over": "list of variations",
}  # fmt: skip
# Characters of a key's two values that are shown.
MOST_SHOWN = 200


def difference(found: Mapping[str, Any], asked: Mapping[str, Any]) -> str:
    """Return in words how inputs differ from those asked for, "" if they do not; "scenario" is TOML text.

    Of two scenarios it is the first key that differs, with its values.
    """
    different = dict.fromkeys(NAMES.get(key, key) for key in {**asked, **found} if found.get(key) != asked.get(key))
    if "scenario" in different:
        try:
            there, here = (_flat(tomllib.loads(str(text["scenario"]))) for text in (found, asked))
        except (KeyError, ValueError, RecursionError):
            there = here = {}
        changed = [key for key in there | here if there.get(key) != here.get(key)]
        if changed:
            key, more = changed[0], len(changed) - 1
            different.pop("scenario")
            told = f"{key} is {there.get(key, 'not set')} there and {here.get(key, 'not set')} here"
            different = {told[:MOST_SHOWN] + (f", {more} more keys differ" if more else ""): None} | different
    return ", ".join(name if " is " in name else f"the {name} differs" for name in different)


def _flat(table: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in table.items():
        flat |= _flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {prefix + key: value}
    return flat


def attributes(run: Record) -> dict[str, Any]:
    """Return what made the run, as plain text and numbers."""
    return {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        **question(run.scenario, run.model, run.law, run.law_digest, run.engine, run.member_digests),
        "seed": _seed(run),
        "versions": json.dumps(dict(run.versions)),
        "stopped": run.stopped or "",
        "wall_seconds": run.wall_seconds,
        "not_finite": json.dumps(not_finite(run.columns)),
        "summary": json.dumps(run.summary()),
        **({ADDED: as_text(run.added)} if run.added else {}),
        **({HALVED: json.dumps(dict(run.halved))} if run.halved is not None else {}),
    }


def _seed(run: Record) -> str:
    sensor, encoder = run.scenario.sensor, run.scenario.encoder
    noisy = np.max(encoder.noise) > 0.0 or np.max(encoder.velocity_noise) > 0.0
    drawn = [f"{sensor.seed}: the noise of the force sensor"] if sensor.noise > 0.0 else []
    drawn += [f"{encoder.seed}: the noise of the encoders"] if noisy else []
    if drawn:
        return f"{', '.join(drawn)}; nothing else in this run is random"
    return "none: nothing in this run is random"


def not_finite(columns: Mapping[str, NDArray[Any]]) -> list[str]:
    """Return the columns in which a number is infinite or none at all."""
    return [name for name in in_order(columns) if not np.all(np.isfinite(columns[name]))]


def checksum(found: Mapping[str, Any], columns: Mapping[str, NDArray[Any]]) -> str:
    """Return the SHA-256 of the attributes of a file, its own left out, and of the columns of a run that it has.

    Each attribute in order of the alphabet as the JSON of [name, value]; each column as that of [name, type, shape] and
    its bytes, rows first.
    """
    total = hashlib.sha256()
    for name in sorted(found):
        total.update(json.dumps([name, found[name]]).encode())
    for name in in_order(columns):
        column = np.ascontiguousarray(columns[name])
        total.update(json.dumps([name, column.dtype.str, column.shape]).encode())
        total.update(column.data.cast("B") if column.size else b"")
    return f"sha256:{total.hexdigest()}"


def variables_of(run: Record) -> dict[str, Variable]:
    """Return the columns of a run, and the names along their dimensions, which are text."""
    found = {
        name: Variable(spec.dims, np.asarray(run.columns[name]), {"units": run.units(name), "long_name": spec.meaning})
        for name, spec in run.specs.items()
    }
    labels = {"joint": run.model.joint_names, "joint_type": run.model.joint_types, "axis": ("x", "y", "z")}
    if run.model.balls:
        labels["coordinate"] = run.model.coordinate_names
    if run.scenario.contact:
        labels["contact"] = labels_of(run.scenario.contact)
        labels["contact_tangent"] = tangents_of(labels["contact"])
    dims = {name: (name.removesuffix("_type"),) for name in labels}
    return found | {name: Variable(dims[name], np.array(words, dtype=object)) for name, words in labels.items()}


def save_run(run: Record, path: str | Path) -> Path:
    """Write a run and return the path; an older file is replaced only once the new one is whole.

    Raises OutputError if the file cannot be written.
    """
    variables = variables_of(run)
    sections = run.scenario.contact or ()
    alone = {points[0] for points in patches_of(sections).values() if len(points) == 1}
    for name, (whole, k) in columns_by_contact(sections).items():  # again, of a single point, by its contact's name
        if k // (2 if "contact_tangent" in variables[whole].dims else 1) in alone:
            variables[name] = Variable(("time",), run.columns[whole][:, k], variables[whole].attributes)
    dimensions = {"time": len(run), "joint": run.model.n, "axis": 3, "event": len(run.events)}
    if run.model.balls:
        dimensions["coordinate"] = len(run.model.coordinate_names)
    if contacts := len(sections):
        dimensions |= {"contact": contacts, "contact_tangent": 2 * contacts}
    own = {spec.dims[1]: run.columns[name].shape[1] for name, spec in run.added.items() if len(spec.dims) == 2}
    dimensions = own | dimensions
    made = attributes(run)
    made |= {CHECKSUM: checksum(made, run.columns)}
    return write_netcdf(Path(path), dimensions, variables, CONVENTIONS | made, seal_file)
