"""Reading a run that `closedloop.record.save` wrote: what its checksum does not vouch for is refused."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

import robot_models
from closedloop.base.arguments import arguments_checked
from closedloop.base.errors import ClosedLoopError, RunFileError, faults_on_one_line
from closedloop.base.files import reason_of
from closedloop.record.columns.derived import from_text
from closedloop.record.columns.record import ALL_COLUMNS
from closedloop.record.netcdf_file import read_sealed
from closedloop.record.run import Run
from closedloop.record.save import ADDED, ATTRIBUTES, CHECKSUM, FORMAT, FORMAT_VERSION, HALVED, MEMBERS, checksum
from closedloop.scenario.load import parse_scenario
from closedloop.scenario.user_module import lacks_members


@arguments_checked()
def load_run(path: str | Path) -> Run:
    """Read a run that `save_run` wrote.

    A user's class that its scenario picks is not imported: the run can be looked at, and repeated once the class is
    named, as ``load_scenario`` and ``--reference.kind my_module:MyPath`` do. Until then the summary is that
    of the file.

    Raises
    ------
    RunFileError
        If there is no such file, or it is not a run, or it is damaged.
    """
    path = Path(path)
    try:
        run = _run_of(*read_sealed(path, list(ALL_COLUMNS)))
    except KeyError as error:
        raise RunFileError(f"{path}: is not a run file, or is damaged: {error} is missing") from None
    except ClosedLoopError as error:
        raise RunFileError(f"{path}: {faults_on_one_line(error)}") from None
    except RecursionError:
        raise RunFileError(f"{path}: is damaged: an attribute is nested too deep") from None
    except (OSError, ValueError, TypeError, AttributeError, ArithmeticError, LookupError, RuntimeError) as error:
        raise RunFileError(f"{path}: is not a run file, or is damaged: {reason_of(error)}") from None
    return run


def _run_of(found: Mapping[str, Any], columns: dict[str, NDArray[Any]]) -> Run:
    """Make a run of what a file holds, which may be anything until its checksum is compared."""
    if found.get("format") != FORMAT:
        raise RunFileError(f"is not a run file (its 'format' attribute is not '{FORMAT}')")
    version = int(found["format_version"])
    if version != FORMAT_VERSION:
        age, cure = ("a newer", "") if version > FORMAT_VERSION else ("an older", "; run its scenario again")
        raise RunFileError(f"was written by {age} version: format {version}, this one reads {FORMAT_VERSION}{cure}")
    if CHECKSUM not in found:
        raise RunFileError("has no checksum, so it cannot be checked for damage; run its scenario again")
    # Of what was written, whatever else another program has added since.
    ours = {name: value for name, value in found.items() if name in ATTRIBUTES}
    if found[CHECKSUM] != checksum(ours, columns):
        raise RunFileError("is damaged, or was changed: its checksum is not that of its columns and attributes")
    run = Run(  # type: ignore[abstract]  # its columns are there by their names
        scenario=parse_scenario(found["scenario"], where="attribute 'scenario'", keep_absent=True),
        model=robot_models.from_text(found["robot_text"], **json.loads(found["robot"])),
        columns=columns,
        law=found["law"],
        versions=json.loads(found["versions"]),
        stopped=found["stopped"] or None,
        wall_seconds=float(found["wall_seconds"]),
        engine=found["engine"],
        law_digest=found["law_digest"],
        member_digests=json.loads(found.get(MEMBERS, "{}")),
        added=from_text(found[ADDED]) if ADDED in found else {},
        halved=json.loads(found[HALVED]) if HALVED in found else None,
    )
    if lacks_members(run.scenario):
        vars(run)["_summary"] = json.loads(found["summary"])
    return run
