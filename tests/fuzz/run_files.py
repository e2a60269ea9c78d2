"""Damaged run files, from a seed: what a disk, a transfer or a hand may do to one.

    python -m tests.fuzz.run_files 1000 0        # so many files from this seed; prints counts and what is not clean

Clean is a `RunFileError` of one line, or a load that gives what was saved. Another answer, any other exception, a
process that ends or does not come back are not.
"""

import io
import json
import os
import subprocess
import sys
import tempfile
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np

from closedloop.record.save import SEAL_LENGTH, seal

# Longer than a file takes that HDF5 does not come back from, s.
LIMIT = 120.0


class Damaged(NamedTuple):
    """A damaged file.

    Attributes
    ----------
    what : str
        What was done to it.
    content : bytes
        All of it.
    """

    what: str
    content: bytes


def damaged_files(whole: bytes, count: int, seed: int) -> Iterator[Damaged]:
    """Yield so many damaged copies of a run file, always the same from a seed."""
    for i in range(count):
        rng = np.random.default_rng([seed, i])
        kind = i % 20
        if kind < 12:
            yield Damaged(f"{i}: bytes", _bytes(whole[:-SEAL_LENGTH], rng) + whole[-SEAL_LENGTH:])
        else:
            change = _CHANGES[int(rng.integers(len(_CHANGES)))]
            yield Damaged(f"{i}: {change.__name__.strip('_')}", _through_h5py(whole, rng, change))


def _bytes(whole: bytes, rng: np.random.Generator) -> bytes:
    data = bytearray(whole)
    size = len(data)
    # Half of it at the beginning, where the structure of the file is.
    at = int(rng.integers(size if rng.random() < 0.5 else min(size, 4096)))
    length = int(min(size - at, 2 ** rng.integers(1, 13)))
    match int(rng.integers(9)):
        case 0 | 1:
            data[at] ^= 1 << int(rng.integers(8))
        case 2:
            for place in rng.integers(0, size, int(rng.integers(2, 50))):
                data[place] ^= 1 << int(rng.integers(8))
        case 3:
            data[at : at + length] = bytes(length)
        case 4:
            data[at : at + length] = rng.bytes(length)
        case 5:
            other = int(rng.integers(size - length + 1))
            one, two = data[at : at + length], data[other : other + length]
            data[at : at + length], data[other : other + length] = two, one
            data = data[:size]
        case 6:
            data = data[: int(rng.integers(size))]
        case 7:
            data[at:at] = rng.bytes(length)
        case _:
            data += rng.bytes(length)
    return bytes(data)


def _through_h5py(whole: bytes, rng: np.random.Generator, change: Callable[[Any, np.random.Generator], None]) -> bytes:
    """Change a file as a program would that knows HDF5, and vouch for its bytes, so that they come to be read."""
    image = io.BytesIO(whole[:-SEAL_LENGTH])
    with h5py.File(image, "r+") as file:
        change(file, rng)
    content = image.getvalue()
    return content + seal(content)


_TEXTS = ("scenario", "robot_text", "robot", "law", "versions", "stopped", "engine", "law_digest", "not_finite")
_ODD: tuple[Any, ...] = (
    2**63 - 1, -(2**63), 1e308, float("nan"), float("inf"), "", "9" * 5000, "[" * 50_000, '{"a":' * 2000, "null", "[]",
    "{}", "1e999", "NaN", "\x00", "é" * 30_000, np.arange(7), np.arange(6.0).reshape(2, 3), b"\xff\xfe", True, 1 + 2j,
)  # fmt: skip


def _odd_attribute(file: Any, rng: np.random.Generator) -> None:
    name = list(file.attrs)[int(rng.integers(len(file.attrs)))]
    value = _ODD[int(rng.integers(len(_ODD)))]
    del file.attrs[name]
    try:
        file.attrs[name] = value
    except (OSError, ValueError, RuntimeError):  # HDF5 holds no text with a null, nor so large a number
        file.attrs[name] = 0


def _no_attribute(file: Any, rng: np.random.Generator) -> None:
    del file.attrs[list(file.attrs)[int(rng.integers(len(file.attrs)))]]


def _damaged_text(file: Any, rng: np.random.Generator) -> None:
    name = _TEXTS[int(rng.integers(4))]
    text = file.attrs[name]
    at = int(rng.integers(max(1, len(text))))
    inserted = str(rng.choice(["", "\t", "9" * 400, "[", "<", '"', "-", "\u00a0", "1e400", "nan", "="]))
    file.attrs[name] = text[:at] + inserted + text[at + int(rng.integers(0, 40)) :]


def _odd_robot(file: Any, rng: np.random.Generator) -> None:
    robot = json.loads(file.attrs["robot"])
    key = str(rng.choice(list(robot)))
    robot[key] = [10**400, -1, None, [], {}, [[1]], "x" * 9000, [1e308] * 4, True][int(rng.integers(9))]
    file.attrs["robot"] = json.dumps(robot)


def _columns(file: Any) -> list[str]:
    return [name for name in file if file[name].dtype.kind in "fi"]


def _replace(file: Any, name: str, values: Any) -> None:
    del file[name]
    file.create_dataset(name, data=values)


def _changed_number(file: Any, rng: np.random.Generator) -> None:
    name = str(rng.choice([name for name in _columns(file) if file[name].size]))
    values = file[name][()]
    values.reshape(-1)[int(rng.integers(values.size))] += 1
    file[name][...] = values


def _not_finite(file: Any, rng: np.random.Generator) -> None:
    name = str(rng.choice([name for name in _columns(file) if file[name].size and file[name].dtype.kind == "f"]))
    values = file[name][()]
    values.reshape(-1)[int(rng.integers(values.size))] = rng.choice([np.nan, np.inf, -np.inf])
    file[name][...] = values


def _other_shape(file: Any, rng: np.random.Generator) -> None:
    name = str(rng.choice(_columns(file)))
    values = file[name][()]
    shapes = [
        values[:-1],
        values[..., None],
        values.reshape(-1)[:1],
        np.float64(1.0),
        np.zeros((0, 3)),
        values.T[..., :2],
    ]
    _replace(file, name, shapes[int(rng.integers(len(shapes)))])


def _other_type(file: Any, rng: np.random.Generator) -> None:
    name = str(rng.choice(_columns(file)))
    size = len(file[name])
    kinds = [np.full(size, b"x"), np.ones(size, dtype=bool), np.ones(size, dtype=complex), np.ones(size, dtype=">f4")]
    _replace(file, name, kinds[int(rng.integers(len(kinds)))])


def _no_column(file: Any, rng: np.random.Generator) -> None:
    del file[str(rng.choice(_columns(file)))]


def _something_else(file: Any, rng: np.random.Generator) -> None:
    name = str(rng.choice(_columns(file)))
    del file[name]
    match int(rng.integers(4)):
        case 0:
            file.create_group(name)
        case 1:
            file[name] = h5py.SoftLink(f"/{name}")  # to itself
        case 2:
            file[name] = h5py.ExternalLink("/dev/zero", "/q")
        case _:
            file.create_dataset(name, shape=(2**45,), chunks=(64,), dtype="f8")


_CHANGES = (
    _odd_attribute, _no_attribute, _damaged_text, _odd_robot, _changed_number, _not_finite, _other_shape, _other_type,
    _no_column, _something_else,
)  # fmt: skip

# Runs of every kind of file: a plane, a mechanism with loops, contacts of links, a curved surface, joints and events.
KINDS: dict[str, dict[str, float]] = {
    "planar2_slide": {"time.duration": 0.1},
    "five_bar": {"time.duration": 0.02},
    "two_arms_bar": {"time.duration": 0.02},
    "wam_sphere": {"time.duration": 0.02},
    "planar2_drop": {"time.duration": 0.3},
}

_LOADER = """
import os, sys
import numpy as np
import closedloop as cl
whole = cl.load_run(sys.argv[1])

print("ready", flush=True)
for line in sys.stdin:
    try:
        run = cl.load_run(line.strip())
        same = all(np.array_equal(run.columns[k], whole.columns[k]) for k in whole.columns)
        same = same and run.scenario == whole.scenario and run.model.text == whole.model.text
        same = same and (run.law, run.engine, run.stopped) == (whole.law, whole.engine, whole.stopped)
        print("same" if same else "other", flush=True)
    except cl.RunFileError as error:
        print("refused" if str(error).count(chr(10)) == 0 else "several lines", flush=True)
    except BaseException as error:
        at = error.__traceback__
        while at.tb_next:
            at = at.tb_next
        where = f"{os.path.basename(at.tb_frame.f_code.co_filename)}:{at.tb_lineno}"
        print(f"{type(error).__name__}: {error} ({where})".replace(chr(10), " ")[:300], flush=True)
"""


class Loader:
    """A process that loads one file after the other, and is replaced when it ends or does not come back."""

    def __init__(self, whole: Path) -> None:
        self._whole, self._process = whole, None

    def load(self, path: Path) -> str:
        """Return what came of it: same, other, refused, or what went wrong."""
        if self._process is None or self._process.poll() is not None:
            self._process = subprocess.Popen(
                [sys.executable, "-c", _LOADER, self._whole], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL, text=True, errors="replace",
            )  # fmt: skip
            assert self._process.stdout.readline() == "ready\n"
        process = self._process
        clock = threading.Timer(LIMIT, process.kill)
        clock.start()
        process.stdin.write(f"{path}\n")
        process.stdin.flush()
        answer = process.stdout.readline().strip()
        late = not clock.is_alive()
        clock.cancel()
        return answer or ("hangs" if late else f"ended with {process.wait()}")

    def close(self) -> None:
        """End the process."""
        if self._process is not None:
            self._process.stdin.close()
            self._process.stdout.close()
            self._process.wait()


def judge(whole: Path, count: int, seed: int) -> tuple[Counter[str], list[str]]:
    """Load so many damaged copies of a run file; return how often each came of it, and what is not clean."""
    counts: Counter[str] = Counter()
    faults: list[str] = []
    loader = Loader(whole)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "damaged.nc"
        for damaged in damaged_files(whole.read_bytes(), count, seed):
            path.write_bytes(damaged.content)
            came = loader.load(path)
            kind = came if came in ("same", "refused") else "fault"
            counts[f"{damaged.what.partition(': ')[2]}: {kind}"] += 1
            if kind == "fault":
                faults.append(f"{damaged.what}: {came}")
            if os.listdir(folder) != [path.name]:
                faults.append(f"{damaged.what}: left {os.listdir(folder)}")
        loader.close()
    return counts, faults


def main() -> None:
    """Judge as many files as the command line says, of each kind in turn."""
    import closedloop as cl

    count, seed = int(sys.argv[1]), int(sys.argv[2])
    counts: Counter[str] = Counter()
    faults: list[str] = []
    for place, (name, changes) in enumerate(KINDS.items()):
        share = count // len(KINDS) + (place < count % len(KINDS))
        with tempfile.TemporaryDirectory() as folder:
            run = cl.simulate(cl.load_scenario(name, changes))
            some, wrong = judge(run.save(Path(folder) / "run.nc"), share, seed + place)
        counts, faults = counts + some, faults + [f"{name}: {fault}" for fault in wrong]
        print(f"{name}: {share} files, {len(wrong)} not clean", flush=True)
    print(*(f"{number:5}  {what}" for what, number in sorted(counts.items())), *faults, sep="\n")
    print(f"{count} files, {len(faults)} not clean")


if __name__ == "__main__":
    main()
