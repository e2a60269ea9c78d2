"""The text of a scenario, of a shipped one by its name or of a file, and the robot's file that it names."""

from __future__ import annotations

import difflib
import os
import stat
from importlib import resources
from pathlib import Path
from typing import Any

from closedloop.base.errors import ScenarioError
from robot_models.described import names_a_file
from robot_models.errors import shown

# A scenario is a few kilobytes, one with ten thousand waypoints less than a megabyte. Larger ones take the parser long.
MOST_BYTES = 4_000_000


def shipped_scenarios() -> list[str]:
    """Return the names of the scenarios that come with the package, sorted."""
    folder = resources.files("closedloop.scenario") / "shipped"
    return sorted(f.name.removesuffix(".toml") for f in folder.iterdir() if f.name.endswith(".toml"))


def scenario_text(name: str | Path) -> tuple[str, str, str, Path | None]:
    """Return (TOML text, stem, how to call it in messages, its folder) of a file, or of a shipped scenario."""
    as_path = Path(name)
    if as_path.suffix == ".toml" or isinstance(name, Path):
        return _read(as_path), as_path.stem, str(as_path), as_path.parent
    shipped = shipped_scenarios()
    if name not in shipped:
        part = [each for each in shipped if name and str(name) in each]  # "wipe" of panda_wipe
        near = part or difflib.get_close_matches(str(name)[:100], shipped, n=1, cutoff=0.6)
        every = f"wam_slide is one of {len(shipped)}, 'closedloop scenarios' lists them"
        hint = f"did you mean '{near[0]}'?" if near else every
        raise ScenarioError(f"no scenario named {shown(str(name))}; {hint} (a file of your own must end in .toml)")
    folder = Path(str(resources.files("closedloop.scenario") / "shipped"))
    return (folder / f"{name}.toml").read_text(encoding="utf-8"), str(name), str(name), folder


def robot_file(model: Any, folder: Path, where: str) -> Any:
    """Return the absolute path of a robot's file that a scenario in `folder` names, and any other value as it is."""
    if not isinstance(model, str) or not names_a_file(model):
        return model
    there = absolute(folder / model)
    if not os.path.exists(there) and os.path.exists(model):
        try:
            right = os.path.relpath(model, folder)
        except (OSError, ValueError):  # no current folder, or another drive
            right = absolute(model)
        raise ScenarioError(
            f"{where}: robot.model = {model!r}: is looked up from the folder of the scenario, and is not there but in "
            f"the current folder: write {Path(right).as_posix()!r}, or give --robot.model {model}"
        )
    return there


def absolute(path: str | Path) -> str:
    """Return the path from the root, so that it names the same file whoever reads it; as it is, if that is unknown."""
    try:
        return os.path.abspath(path)
    except OSError:  # the current folder was deleted
        return str(path)


def _read(path: Path) -> str:
    """Return the text of a file; one that would block, never end or fill the memory is not opened."""
    try:
        about = path.stat()
        if stat.S_ISDIR(about.st_mode):
            raise ScenarioError(f"{path}: cannot be read: is a folder; name the .toml file in it")
        if not stat.S_ISREG(about.st_mode):
            raise ScenarioError(f"{path}: cannot be read: is a device, pipe or socket; a scenario is a TOML file")
        if about.st_size > MOST_BYTES:
            raise ScenarioError(
                f"{path}: is {about.st_size / 1e6:.4g} MB; a scenario is a TOML file of at most {MOST_BYTES / 1e6:g} MB"
            )
        return path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise ScenarioError(f"{path}: cannot be read: {error.strerror}") from None
    except UnicodeDecodeError:
        raise ScenarioError(f"{path}: is not UTF-8 text; a scenario is a TOML file") from None
    except ScenarioError:
        raise
    except ValueError as error:  # a null in the name
        raise ScenarioError(f"{str(path)!r}: cannot be read: {error}") from None
