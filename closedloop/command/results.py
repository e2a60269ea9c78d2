"""The folder of a run's results: run.nc, summary.json and the figures; replacing an earlier run's results.

Results of the same inputs (scenario, robot, law, engine) may be overwritten. Those of other inputs are replaced only
with --overwrite, and then none of their files is left. Where no folder was named, results go beside them: FOLDER-2 ...
A lock on the folder keeps two runs at once out of one folder.
"""

import itertools
import json
from contextlib import suppress
from pathlib import Path

from closedloop.base import files
from closedloop.base.errors import ClosedLoopError, InterruptedRunError, OutputError, RunFileError
from closedloop.base.interrupts import held_back
from closedloop.record.run import Run
from closedloop.record.save import difference, read_sealed

RUN, SUMMARY = "run.nc", "summary.json"
# Metadata near the beginning or the end of a figure's file.
MARK = b"closedloop"
_MARKED_WITHIN = 16_384


class TakenError(OutputError):
    """A folder holds what may not be replaced, or another run is being written into it."""

    why = ""


def _taken(folder: Path, why: str) -> TakenError:
    """Return the refusal of a folder, and what it holds as its `why`."""
    error = TakenError(f"--out {str(folder)!r}: {why}; name another folder with --out, or replace it with --overwrite")
    error.why = f"{folder}: {why}"
    return error


def first_free(folder: Path, question: dict[str, str], overwrite: bool) -> "Results":
    """Return where results go if no folder was named: `folder`, or the first of FOLDER-2, FOLDER-3 ... that is free.

    Free is what holds no other run, and what no other run is being written into. See `Results`.
    """
    why = ""
    for number in itertools.count(1):
        place = folder if number == 1 else folder.with_name(f"{folder.name}-{number}")
        try:
            found = Results(place, question, overwrite)
        except TakenError as error:
            why = why or error.why
        else:
            found.not_first = why
            break
    return found


class Results:
    """Where the results of a run go; at the end of a ``with`` block no folder is left that was made for nothing.

    `not_first`, str: why they do not go into the folder that is tried first, see `first_free`; "" if they do.
    `folder`: it is made if need be, and what killed writers left in it is removed; this process has it locked until the
        end of the ``with`` block.
    `question`: the inputs of the run, see `closedloop.record.save.question`.
    `overwrite`: whether results of another question may be replaced.
    """

    def __init__(self, folder: Path, question: dict[str, str], overwrite: bool) -> None:
        self.folder, self.not_first = folder, ""
        lock = None
        while lock is None:
            self._made = _make_writable(folder)
            with suppress(FileNotFoundError):  # removed in between by another run that gave nothing
                lock = files.FolderLock.of(folder)
                if lock is None:
                    raise _taken(folder, "another run is being written there")
        self._lock = lock
        try:
            files.remove_unfinished(folder)
            self._rows, self._other = -1, False
            fault = self._look(question)
            if fault and not overwrite:
                raise _taken(folder, fault)
            self._other = bool(fault)
        except BaseException:
            self.__exit__()
            raise

    def __enter__(self) -> "Results":
        return self

    def __exit__(self, *_: object) -> None:
        _remove_empty(self._made)  # while it is locked, so that nobody else is at work in it
        self._lock.release()

    def _look(self, question: dict[str, str]) -> str:
        """Return why what is in the folder may not be replaced, and "" if it may."""
        file, summary = self.folder / RUN, self.folder / SUMMARY
        files.refuse_special(file)
        files.refuse_special(summary)
        if file.is_symlink() or file.exists():
            try:
                found, columns = read_sealed(file, ["time"])
            except (RunFileError, OSError) as error:
                words = str(error) if isinstance(error, RunFileError) else files.reason_of(error)
                return f"its {RUN} {words}"
            if told := difference({key: found.get(key, value) for key, value in question.items()}, question):
                return f"holds another run: {told}"
            if found.get("format") is None:
                return f"its {RUN} is not a run file"
            self._rows = columns["time"].size if "time" in columns else -1
        elif (summary.is_symlink() or summary.exists()) and not _is_summary(summary):
            return f"its {SUMMARY} is not that of a run"
        return ""

    def save(self, run: Run, failure: ClosedLoopError | None) -> list[Path]:
        """Write run.nc and summary.json, and return their paths; none if an earlier run already holds more of this.

        Ctrl-C and SIGTERM wait until both are there.
        """
        if isinstance(failure, InterruptedRunError) and not self._other and len(run) <= self._rows:
            return []
        with held_back():
            with suppress(OSError):  # a run beside this one, that was refused, may have removed it
                self.folder.mkdir(parents=True, exist_ok=True)
            if self._other:
                self._clear()
            summary = json.dumps(run.summary(), indent=2, allow_nan=False) + "\n"
            return [run.save(self.folder / RUN), files.write_whole(self.folder / SUMMARY, summary.encode())]

    def _clear(self) -> None:
        """Remove files of an earlier run that the new one would not overwrite: its summary and its figures."""
        for path in [self.folder / SUMMARY, *self.folder.glob("fig*.*")]:
            if path.is_symlink() or not path.is_file():
                continue
            try:
                with path.open("rb") as file:
                    head = file.read(_MARKED_WITHIN)
                    file.seek(max(0, path.stat().st_size - _MARKED_WITHIN))
                    ours = path.name == SUMMARY or MARK in head or MARK in file.read()  # a PDF has it at its end
                if ours:
                    path.unlink()
            except OSError as error:
                raise OutputError(f"{path}: cannot be removed: {files.reason_of(error)}") from None


def _make_writable(folder: Path) -> list[Path]:
    """Make the output folder before anything is simulated, so that no result is lost if that fails.

    Returns the folders that were not there, the innermost first.
    """
    missing: list[Path] = []
    try:
        missing += [place for place in (folder, *folder.parents) if not place.exists()]
        with held_back():
            files.probe_folder(folder)
        return missing
    except (OSError, ValueError) as error:
        _remove_empty(missing)
        raise OutputError(
            f"--out {str(folder)!r}: cannot be written: {files.reason_of(error)}; name another folder"
        ) from None


def _remove_empty(folders: list[Path]) -> None:
    for folder in folders:
        with suppress(OSError, ValueError):  # something is in it
            folder.rmdir()


def why_not_writable(folder: Path) -> str:
    """Return why nothing can be written into a folder that need not be there yet, "" if something can; makes nothing.

    A file that is there already is no fault yet: whose it is depends on the scenario.
    """
    why = files.why_not_there((folder, *folder.absolute().parents))
    return why and f"--out {str(folder)!r}: cannot be written: {why}; name another folder"


def _is_summary(path: Path) -> bool:
    if not path.is_file():
        return True  # writing it will say what it is
    try:
        found = json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError):
        return False
    return isinstance(found, dict) and {"scenario", "assumptions"} <= set(found)
