"""What a page may ask of the lab, and what comes of it: a slider is moved, a run is pinned, a file is written."""

import logging
import math
import sys
from collections.abc import Callable
from typing import Any

import numpy as np

from closedloop.base.errors import ClosedLoopError, one_line
from closedloop.base.files import what_was_written
from closedloop.figures.scene.scene import mechanism_of, scene_of
from closedloop.lab.app import Lab
from closedloop.lab.drawn import pack
from closedloop.lab.history import MOST_PINS, save, save_page
from closedloop.lab.server import Client
from closedloop.scenario.load import shipped_scenarios

logger = logging.getLogger(__name__)

Said = dict[str, Any]
MOST_COLUMNS = 8


def act(lab: Lab, client: Client, said: Said) -> None:
    """Do what a page asks; what is at fault is a line on the page, also what is no request."""
    try:
        action = ACTIONS.get(str(said.get("do")))
        if action is None:
            client.put("status", pack(_status("what the page sent is no request of the lab's: nothing was done", True)))
            return
        client.time = _number(said.get("t"), client.time)
        lab.history.press = None if said.get("press") is None else (id(client), str(said["press"]))
        action(lab, client, said)
    except ClosedLoopError as error:
        _say(lab, one_line(str(error)), loud=True)
    except Exception:  # the page goes on: what comes from a browser may be anything
        client.put("status", pack(_status("what the page asked for failed: see the terminal", True)))
        logger.exception("a request of the page failed")


def _set(lab: Lab, client: Client, said: Said) -> None:
    """Set a key to what its control shows, or to what was typed beside it."""
    index = said.get("index")
    control = lab.controls.get((str(said.get("key")), index if isinstance(index, int) else None))
    if control is None:
        return
    try:
        value = control.typed(str(said.get("text"))) if said["do"] == "type" else control.read(said.get("shown"))
    except (ValueError, TypeError, OverflowError, ClosedLoopError) as error:
        lab.tell("fault", {"kind": "fault", "key": control.key, "line": one_line(str(error))}, keep=False)
        return
    if said.get("together") and control.index is not None:
        value = control.together(value)
    lab.changed(control.key, value)


def _reset(lab: Lab, client: Client, said: Said) -> None:
    """Set a key back to where it began; of a list one entry, or all."""
    key, index = str(said.get("key")), said.get("index")
    control = lab.controls.get((key, index if isinstance(index, int) else None)) or lab.controls.get((key, 0))
    if control is None:
        return
    if isinstance(index, int) and control.index == index:
        lab.changed(key, [*control.value[:index], lab.first.get((key, index)), *control.value[index + 1 :]])
        lab.refresh()
    else:
        lab.changed(key, None)


def _step(lab: Lab, client: Client, said: Said) -> None:
    """Undo, redo, or go back to where the scenario began."""
    history, word = lab.history, said["do"]
    moved = history.undo() if word == "undo" else history.redo() if word == "redo" else bool(history.changes)
    if word == "begin again" and moved:
        history.set_all({})
    if moved:
        lab.refresh()
        lab.ask()
    else:
        _say(lab, f"there is nothing to {word}" if word != "begin again" else "nothing was changed")


def _pin(lab: Lab, client: Client, said: Said) -> None:
    """Keep the run shown, or the latest pinned one no longer."""
    answer = lab.answer
    if said["do"] == "unpin":
        del lab.pins.held[-1:]
    elif answer is None or answer.run is None:
        return
    elif lab.pins.add(answer.run, answer.changes) is None:
        _say(lab, f"{MOST_PINS} runs are pinned already: unpin the last first", loud=True)
        return
    lab.details.pinned()


def _write(lab: Lab, client: Client, said: Said) -> None:
    """Write the run shown, as a scenario and a run file, or as a page."""
    answer = lab.answer
    if answer is None or answer.run is None:
        _say(lab, "there is no run yet")
        return
    command = lab.command(answer)
    if said["do"] == "save":
        written = save(answer.run, command, lab.folder)
    else:
        written = [save_page(answer.run, command, lab.folder, lab.ghosts)]
    _say(lab, what_was_written(*written))


def choose(client: Client, said: Said) -> None:
    """Take the part of the time, or the further columns, that a page is to show."""
    if said["do"] == "columns":
        names = said.get("names")
        client.columns = tuple(map(str, names[:MOST_COLUMNS])) if isinstance(names, list) else ()
        return
    given = said.get("range")
    client.window = None
    if isinstance(given, list) and len(given) == 2:
        begin, end = (_number(each, math.nan) for each in given)
        client.window = (begin, end) if begin < end else None


def _choose(lab: Lab, client: Client, said: Said) -> None:
    choose(client, said)
    lab.show_again(client)


def _map(lab: Lab, client: Client, said: Said) -> None:
    if said["do"] == "stop map":
        lab.map.stop()
    else:
        lab.map.start(str(said.get("x")), str(said.get("y")), str(said.get("quantity")))


def _point(lab: Lab, client: Client, said: Said) -> None:
    lab.map.go(_number(said.get("u"), 0.5), _number(said.get("v"), 0.5), bool(said.get("last")))


# How long a pull acts, s; nearer to the tip than this share of the robot's size it is one at the tip.
PULL, AT_TIP = 0.2, 0.05


def _pull(lab: Lab, client: Client, said: Said) -> None:
    """Pull at a point of a link, from the instant that the page shows: a force from outside."""
    answer = lab.answer
    if answer is None or answer.run is None:
        return
    at, force = (np.array([_number(x, math.nan) for x in said.get(key) or ()]) for key in ("at", "force"))
    frames = [each for each in mechanism_of(answer.run.model).frames if each.parentJoint == said.get("joint")]
    if at.shape != (3,) or force.shape != (3,) or not np.all(np.isfinite([at, force])) or not frames:
        return
    scene, named = scene_of(answer.run), [each for each in frames if each.name in answer.run.model.frames]
    start = _number(said.get("start"), client.time)
    row = min(max(round(start / answer.run.scenario.time.step), 0), len(answer.run) - 1)
    axes, origins = (part[frames[0].parentJoint] for part in scene.joint_places(row))
    pulled: dict[str, Any] = {"force": _rounded(force), "duration": PULL}
    pulled["start"] = float(f"{max(min(start, answer.run.scenario.time.duration - PULL), 0.0):.6g}")
    if np.linalg.norm(origins + axes @ at - scene.tip_place(row)) > AT_TIP * scene.size and named:
        pulled |= {"link": named[0].name, "at": _rounded(named[0].placement.actInv(at))}
    given = [force.model_dump(exclude_none=True) for force in lab.history.scenario().external_force or ()]
    if said.get("first"):  # what follows is the same pull, a moment later
        client.pulls = len(given)
    lab.changed("external_force", [*given[: client.pulls], pulled])
    if said.get("last"):
        lab.refresh()


def _rounded(vector: Any) -> list[float]:
    return [float(f"{x:.3g}") for x in vector]


def _analyse(lab: Lab, client: Client, said: Said) -> None:
    at = said.get("at")
    lab.details.at = None if at is None else _number(at, 0.0)
    if lab.answer is not None:
        lab.details.ask(lab.answer)


def _open(lab: Lab, client: Client, said: Said) -> None:
    """Go over to another scenario that ships, and to no other file."""
    if said.get("name") in shipped_scenarios():
        lab.open(str(said["name"]))


def _say(lab: Lab, line: str, loud: bool = False) -> None:
    lab.tell("status", _status(line, loud), keep=False)


def _status(line: str, loud: bool) -> Said:
    return {"kind": "status", "line": line, "loud": loud}


def _number(value: Any, otherwise: float) -> float:
    """Return a finite number; an integer beyond every float is none."""
    good = isinstance(value, int | float) and abs(value) <= sys.float_info.max
    return float(value) if good else otherwise


ACTIONS: dict[str, Callable[[Lab, Client, Said], None]] = {
    "set": _set, "type": _set, "reset": _reset, "undo": _step, "redo": _step, "begin again": _step,
    "pin": _pin, "unpin": _pin, "save": _write, "share": _write, "window": _choose, "columns": _choose,
    "map": _map, "stop map": _map, "point": _point, "analyse": _analyse, "open": _open, "pull": _pull,
    "shown": lambda lab, client, said: client.drawn(),
    "gallery": lambda lab, client, said: lab.show_gallery(client),
}  # fmt: skip
