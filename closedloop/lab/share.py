"""A run as one page of HTML: the replay in space and the curves, in a file that needs no server and no network."""

from __future__ import annotations

import base64
import html
import json
from collections.abc import Iterator
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from closedloop.base.errors import ScenarioError
from closedloop.base.files import write_whole
from closedloop.figures.scene.ground import thin_out
from closedloop.figures.scene.scene import ARROWS, JOINTS, PATH, WANTED, Scene, quaternions, scene_of
from closedloop.figures.scene.shapes import Shape
from closedloop.lab.curves import panels, reduced
from closedloop.lab.look import MEANINGS
from closedloop.record.report.control_verdict import told
from closedloop.record.report.verdict import names_of
from closedloop.record.run import Run

# Frames of the replay at most, points of a path, and parts of the time of which a curve shows the extremes.
MOST_FRAMES, MOST_POINTS, CELLS = 500, 600, 400
SCRIPTS = ("numbers.js", "space.js", "plots.js", "page.js")


def page_of(run: Run, command: str = "") -> str:
    """Return the page of a run; `command` is the command line that repeats it.

    Raises
    ------
    ScenarioError
        If the run has no rows.
    """
    if not len(run):
        raise ScenarioError(f"{run.scenario.name}: the run has no rows: there is nothing to show")
    # No text of the run can end the script it stands in.
    data = json.dumps(_data(run, command), allow_nan=False).replace("<", "\\u003c")
    web = files("closedloop.lab") / "web"
    parts = {
        "TITLE": html.escape(f"{run.scenario.name}, {run.model.name}"),
        "STYLE": (web / "style.css").read_text(encoding="utf-8"),
        "SCRIPT": "\n".join((web / name).read_text(encoding="utf-8") for name in SCRIPTS),
        "DATA": data,
    }
    page, *rest = (web / "page.html").read_text(encoding="utf-8").split("@")
    for name, text in zip(rest[::2], rest[1::2], strict=True):
        page += parts[name] + text
    return page


def share(run: Run, path: str | Path, command: str = "") -> Path:
    """Write the page of a run, see `page_of`, and return its path.

    Raises
    ------
    ScenarioError
        If the run has no rows.
    OutputError
        If the file cannot be written.
    """
    return write_whole(path, page_of(run, command).encode())


def _data(run: Run, command: str) -> dict[str, Any]:
    scene = scene_of(run)
    begin, end = float(run.time[0]), float(run.time[-1])
    curves = [reduced(panel, begin, end, CELLS) for panel in panels(run)]
    (vertices, faces), (middle, radius) = scene.surface, scene.ball
    ground = len(scene.joint_places(0)[0])  # the number of the surface's place, after those of base and joints
    name, robot, about = run.scenario.name, run.model.name, run.scenario.description
    return {
        "title": name if name == robot else f"{name} ({robot})",
        "about": about[:1].upper() + about[1:],
        "stopped": run.stopped or "",
        "verdicts": [f"verdict: {names_of(run.summary()['verdict']['problems'])}", f"control: {told(run.summary())}"],
        "command": command,
        "scenario": run.scenario.to_toml(),
        "end": end, "step": run.scenario.time.step, "joints": ground + 1 + len(scene.joined.loops),
        "size": scene.size, "centre": middle.tolist(), "radius": radius, "metres_per_newton": scene.metres_per_newton,
        "surface": {"joint": ground, "vertices": _numbers(vertices), "faces": _numbers(faces, np.uint32)},
        "arrows": [{"name": a.name, "kind": a.kind, "colour": ARROWS[a.kind]} for a in scene.arrows([0])[0]],
        "kinds": scene.kinds, "meanings": MEANINGS,
        "paths": [
            {"name": "actual path", "colour": PATH, "points": _numbers(thin_out(run.position, MOST_POINTS))},
            {"name": "desired path", "colour": WANTED, "points": _numbers(thin_out(run.reference_tip, MOST_POINTS))},
        ],
        "shapes": [
            {"joint": joint, "kind": kind, "colour": s.colour, "vertices": _numbers(s.vertices),
             "faces": _numbers(s.faces, np.uint32)} for joint, kind, s in _shapes(scene)
        ],
        "frames": _frames(scene),
        "marks": [{"time": mark.time, "kind": mark.kind} for mark in scene.marks],
        "panels": [
            {"title": p.title, "time": _numbers(p.time), "traces": [
                {"label": t.label, "colour": t.colour, "limit": t.limit, "values": _numbers(t.values)} for t in p.traces
            ]} for p in curves
        ],
    }  # fmt: skip


def _shapes(scene: Scene) -> Iterator[tuple[int, str, Shape]]:
    """Yield the robot's shapes and the marks of its loop joints, each with the number of its place and what it is."""
    for shape in scene.shapes:
        yield shape.joint, "", shape
    for k, loop in enumerate(scene.joined.loops):
        yield len(scene.joint_places(0)[0]) + 1 + k, JOINTS, loop.shape


def _frames(scene: Scene) -> dict[str, str]:
    """Return the replay: instants, places of joints, surface and marks (quaternion, origin), forces and their tails."""
    run = scene.run
    rows = np.unique(np.linspace(0, len(run) - 1, min(MOST_FRAMES, len(run))).round().astype(int))
    places, last = [], None
    for row in rows:
        there = scene.joint_places(int(row))
        (turn, shift), marks = scene.ground.place(int(row)), scene.joined.places(*there)
        turns = quaternions(np.vstack([there[0], turn[None], marks[0]]))
        if last is not None:  # of the two quaternions of a rotation that which is near the one before
            turns *= np.where(np.sum(turns * last, axis=1, keepdims=True) < 0.0, -1.0, 1.0)
        last = turns
        places.append(np.hstack([turns, np.vstack([there[1], shift, marks[1]])]))
    arrows = scene.arrows(rows)
    tails, forces = ([[arrow[part] for arrow in each] for each in arrows] for part in (0, 1))
    parts = {"time": run.time[rows], "places": places, "tails": tails, "forces": forces}
    return {name: _numbers(part) for name, part in parts.items()}


def _numbers(values: ArrayLike, kind: type[np.generic] = np.float32) -> str:
    """Return numbers as the page reads them: bytes in base64, the least significant first."""
    array: NDArray[Any] = np.nan_to_num(np.asarray(values)) if kind is np.float32 else np.asarray(values)
    with np.errstate(over="ignore"):
        narrow = array.astype(np.dtype(kind).newbyteorder("<"))
    return base64.b64encode(np.ascontiguousarray(narrow).tobytes()).decode("ascii")
