"""Sweeps as nobody would ask for them: specifications of axes, tables and parts that are wrong in some way.

    python tests/fuzz/sweeps.py --count 500 --seed 0

Each goes through the command line. Clean is exit status 0, or 2 with one line; anything else is printed, and counted.
A table whose bytes are damaged is refused, or has all of its values; a sweep goes on from damaged parts to the same.
"""

import argparse
import contextlib
import io
import os
import random
import shutil
import tempfile
import traceback
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
from pyarrow import parquet

from closedloop.command.sweep import main

SHORT = ("--time.duration", "0.002")
KEYS = (
    "law.force", "law.kp", "law.kd", "sensor.seed", "time.integrator", "time.step", "time.duration", "start.q",
    "surface.normal", "surface.offset", "stabiliser.time_constant", "robot.model", "robot.drive_inertia", "law.kind",
    "friction.kind", "reference.kind", "impact.restitution", "law", "law.", ".force", "law.forse", "", "law.a.x", "Ω.x",
)  # fmt: skip
NUMBERS = (
    "1e400", "-1e400", "nan", "inf", "-inf", "0", "-0.0", "1", "2", "5", "15", "1e308", "-1e308", "5e-324", "1e-308",
    "9223372036854775808", "1e30", "0x10", "1_000", "", " ", "true", "a", "1.5", "1e12", "١", "1979-05-27", "07:32:00",
)  # fmt: skip
COUNTS = ("0", "1", "2", "3", "-1", "2.5", "1e12", "1000000000000", "nan", "inf", "1e400", "", "x", "1e9")
WORDS = (
    "rk4", "'rk4'", '"auto"', "[1, 2, 3, 4]", "[]", "[[[[", "{a = 1}", "panda", "/dev/null", "true", "false", "\udcff",
    "\n", "\x00", "a" * 500, "[" * 5000, "1" * 5000, "=", ":", "::", "log", "log:", ",", ",,",
)  # fmt: skip
OPTIONS: tuple[tuple[str, ...], ...] = (
    (), (), (), ("--random", "3"), ("--latin", "3"), ("--random", "0"), ("--random", "-1"), ("--latin", "1000000000"),
    ("--random", "9" * 30), ("--seed", "-1"), ("--seed", "9" * 40), ("--workers", "0"), ("--workers", "1000000000000"),
    ("--keep", "f"), ("--keep", ""), ("--keep", "f,f,nope"), ("--engine", "pinocchio"), ("--strict",),
)  # fmt: skip


def specification(rng: random.Random) -> tuple[str, ...]:
    """Return the arguments of a sweep of a few runs of two steps, most of them wrong."""
    given: list[str] = []
    for _ in range(rng.choice((0, 1, 1, 1, 2, 3))):
        key = rng.choice(KEYS)
        kind = rng.random()
        if kind < 0.4:
            spec = ":".join(
                [rng.choice(NUMBERS), rng.choice(NUMBERS), *rng.sample(COUNTS, rng.choice((0, 1, 1, 1, 2)))]
            )
            spec = rng.choice(("", "", "log:")) + spec
        else:
            spec = ",".join(rng.choice(NUMBERS + WORDS) for _ in range(rng.choice((1, 2, 3))))
        given += ["--over", key + rng.choice(("=", "=", "=", "=", " = ", "")) + spec]
    return ("wam_slide", *SHORT, *given, *rng.choice(OPTIONS))


def outcome(arguments: tuple[str, ...]) -> tuple[int | None, str, str]:
    """Return exit status, None if it raised, and what was said."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            status: int | None = main(arguments)
        except SystemExit as leaving:
            status = int(leaving.code or 0)
        except Exception:
            return None, out.getvalue(), traceback.format_exc()
    said = [line for line in err.getvalue().splitlines() if not line.startswith("compiling")]
    return status, out.getvalue(), "\n".join(said)


def fault_of(arguments: tuple[str, ...]) -> str | None:
    """Return what is wrong with how a command ended, None if nothing is."""
    status, _, err = outcome(arguments)
    if status == 0:
        return None if not err else f"exit status 0, and says {err!r}"
    lines = err.splitlines()
    if status in (2, 4) and bool(lines) == (status == 2) and all(line.startswith("closedloop") for line in lines):
        return None  # a line for each fault
    return f"exit status {status}: {err[-1500:]}"


def sweeps(count: int, seed: int) -> list[str]:
    """Run so many sweeps; return the faults."""
    rng, faults = random.Random(seed), []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for k in range(count):
            arguments = specification(rng)
            fault = fault_of((*arguments, "--out", str(folder / f"{k}.parquet")))
            stray = [p.name for p in folder.iterdir() if p.name not in (f"{k}.parquet", f"{k}.nc")]
            if fault or stray:
                faults.append(f"{arguments}: {fault}; {stray}")
            for path in folder.iterdir():
                if path.is_file():
                    path.unlink()
    return faults


def _cut(folder: Path, table: Path, rng: random.Random) -> Path:
    path = folder / "cut.parquet"
    path.write_bytes(table.read_bytes()[: rng.randrange(table.stat().st_size)])
    return path


def _flipped(folder: Path, table: Path, rng: random.Random) -> Path:
    text = bytearray(table.read_bytes())
    for _ in range(rng.choice((1, 8, 64))):
        text[rng.randrange(len(text))] = rng.randrange(256)
    path = folder / "flipped.parquet"
    path.write_bytes(text)
    return path


def _changed(folder: Path, table: Path, rng: random.Random) -> Path:
    """Write the table with rows or columns missing, repeated, empty, of another type, or all without a value."""
    rows = parquet.read_table(table)
    kind, name = rng.randrange(7), rng.choice(rows.column_names)
    at = rows.column_names.index(name)
    if kind == 0:
        rows = rows.drop_columns(name)
    elif kind == 1:
        rows = rows.set_column(at, name, pa.nulls(len(rows), rows.schema.field(name).type))
    elif kind == 2:
        rows = rows.slice(0, rng.choice((0, 1)))
    elif kind == 3:
        rows = rows.set_column(at, name, pa.array(["x"] * len(rows)))
    elif kind == 4:
        rows = rows.set_column(at, name, pa.array(np.full(len(rows), rng.choice((np.nan, np.inf, 1e308, -1e308, 0.0)))))
    elif kind == 5:
        rows = rows.select(rng.sample(rows.column_names, rng.randrange(1, 12)))
    else:
        rows = rows.append_column(name, rows[name])
    path = folder / "changed.parquet"
    parquet.write_table(rows, path)
    return path


def _odd(folder: Path, table: Path, rng: random.Random) -> Path:
    path = folder / rng.choice(
        ("pipe.parquet", "folder.parquet", "empty.parquet", "text.parquet", "null", "none.parquet")
    )
    if path.exists():
        return path
    if path.name == "pipe.parquet":
        os.mkfifo(path)
    elif path.name == "folder.parquet":
        path.mkdir()
    elif path.name == "null":
        return Path("/dev/null")
    elif path.name != "none.parquet":
        path.write_text("" if path.name == "empty.parquet" else "PAR1 no table PAR1")
    return path


def plots(count: int, seed: int) -> list[str]:
    """Draw so many tables; return the faults."""
    rng, faults = random.Random(seed), []
    kinds: tuple[Callable[[Path, Path, random.Random], Path], ...] = (
        _cut,
        _flipped,
        _changed,
        _changed,
        _changed,
        _odd,
    )
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        table = folder / "t.parquet"
        made = outcome(
            ("wam_slide", *SHORT, "--over", "law.force=5:15:3", "--over", "stabiliser.time_constant=5e-4,1e-3", "--out",
             str(table))
        )  # fmt: skip
        assert made[0] == 0, made
        for _ in range(count):
            path = rng.choice(kinds)(folder, table, rng)
            options: tuple[str, ...] = rng.choice(
                ((), (), ("--of", "min_contact_force"), ("--of", "nope"), ("--x", "law.force", "--y", "law.force"),
                 ("--y", "law.force"), ("--x", "run"), ("--of", "status"), ("--of", ",,"))
            )  # fmt: skip
            fault = fault_of(("plot", str(path), "--out", str(folder / "picture.png"), *options))
            if fault:
                faults.append(f"plot {path.name} {options}: {fault}")
    return faults


def damaged(content: bytes, rng: random.Random, others: list[bytes]) -> bytes:
    """Return a file's content as a disk or a slip may leave it."""
    data, at = bytearray(content), rng.randrange(len(content))
    length = min(len(content) - at, 2 ** rng.randrange(1, 12))
    kind = rng.randrange(8)
    if kind < 3:
        for _ in range((1, 1, 40)[kind]):
            data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    elif kind == 3:
        data[at : at + length] = bytes(length)
    elif kind == 4:
        to = rng.randrange(len(content) - length + 1)
        data[at : at + length], data[to : to + length] = content[to : to + length], content[at : at + length]
        data = data[: len(content)]
    elif kind == 5:
        del data[at:]
    elif kind == 6:
        data += rng.randbytes(length)
    else:
        return rng.choice(others)
    return bytes(data)


KEPT = (
    "wam_slide", "--time.duration", "0.02", "--over", "law.force=5:15:6", "--over", "law.kp=300:900:4", "--keep", "f,q",
)  # fmt: skip


def parts(count: int, seed: int) -> list[str]:
    """Damage the parts of a killed sweep, and its table when it is done, so many times; return the faults."""
    import closedloop.studies.sweep.store as running
    from closedloop.base.errors import OutputError

    rng, faults = random.Random(seed), []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name, "a")
        folder.mkdir()
        command, out = (*KEPT, "--out", str(folder / "t.parquet")), folder / "t.parquet"
        join = running.join

        def killed(*arguments: object) -> None:
            raise OutputError("killed")

        running.join = killed
        try:
            assert outcome(command)[0] == 2
        finally:
            running.join = join
        halves = {path: path.read_bytes() for path in sorted((folder / "t.parquet.parts").iterdir())}
        assert outcome(command)[0] == 0
        whole = {path: path.read_bytes() for path in folder.iterdir()}
        values, columns = parquet.read_table(out), _columns(folder / "t.nc")
        for k in range(count):
            if k % 2:
                fault = _gone_on(command, halves, rng) or (
                    "" if out.exists() and out.read_bytes() == whole[out] and _columns(folder / "t.nc") == columns
                    else "refused" if not out.exists() else "another table"
                )  # fmt: skip
                fault = "" if fault == "refused" else fault
            else:
                out.write_bytes(damaged(whole[out], rng, list(halves.values())))
                fault = _read_again(command, out, values)
            faults += [f"{k}: {fault}"] if fault else []
            for path in folder.iterdir():
                shutil.rmtree(path) if path.is_dir() else path.unlink()
            for path, content in whole.items():
                path.write_bytes(content)
    return faults


def _gone_on(command: tuple[str, ...], halves: dict[Path, bytes], rng: random.Random) -> str:
    """Go on with a sweep some of whose parts are damaged; return what is wrong."""
    store = next(iter(halves)).parent
    for path in store.parent.iterdir():
        path.unlink()
    store.mkdir()
    chosen = rng.sample(list(halves), rng.choice((1, 1, 2, 5)))
    for path, content in halves.items():
        path.write_bytes(damaged(content, rng, list(halves.values())) if path in chosen and content else content)
    fault = fault_of(command)
    told = [path.name for path in chosen]
    if not fault and store.exists() and "sweep.json" not in told:
        fault = "does not go on"
    return f"{told}: {fault}" if fault else ""


def _read_again(command: tuple[str, ...], out: Path, values: pa.Table) -> str:
    """Ask for a sweep whose table is damaged, and for its maps; return what is wrong."""
    from closedloop.base.errors import ScenarioError
    from closedloop.studies.sweep.maps import _read

    fault = fault_of(command)
    if fault:
        return fault
    try:
        table = _read(out)
    except ScenarioError as error:
        return "" if len(str(error).splitlines()) == 1 else f"two lines: {error}"
    except Exception:
        return traceback.format_exc()
    return "" if table.equals(values) else "the table has other values"


def _columns(path: Path) -> dict[str, bytes]:
    import h5netcdf

    with h5netcdf.File(path) as file:
        return {name: np.asarray(file.variables[name][...]).tobytes() for name in file.variables}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    found = sweeps(asked.count, asked.seed) + plots(asked.count, asked.seed) + parts(asked.count, asked.seed)
    print("\n".join(found))
    print(f"{3 * asked.count} commands, {len(found)} not clean")
