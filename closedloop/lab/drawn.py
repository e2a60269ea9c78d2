"""Messages to the page: what it draws of a run, and how messages are packed.

The curves go first: they are what a slider is moved for. A run in space is its replay at some rows.

A message is a tree of plain values and arrays as bytes, which both a socket and a file can hold. Four bytes give the
length of the header, which is JSON, padded to whole words; behind it are the arrays, which the header names by where
they begin and how many numbers they have. `web/numbers.js` reads them.
"""

import base64
import json
import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from closedloop.base.arrays import evenly
from closedloop.figures.motion import AT_REST
from closedloop.figures.scene import scene as space
from closedloop.figures.scene.scene import JOINTS, LOOP, OUTSIDE, PATH, TOUCH, WANTED, Scene
from closedloop.figures.scene.solids import COLOUR, OPACITY, Shape
from closedloop.lab.curves import CELLS, Panel, column_names, column_panel, panels, reduced
from closedloop.mechanics.closure.contact_force import FREE, PRESSED, STUCK
from closedloop.record.clearance import passing_note
from closedloop.record.run import Run
from closedloop.scenario.scenario import NO_ROBOT

# Of an array in the header, by its type: 32-bit numbers, the least significant byte first; NaN stays NaN.
FLOATS, WHOLE = "$f", "$u"
WORD = 4


def pack(message: Any) -> bytes:
    """Return a message as bytes: dicts, lists, text, numbers, None, and arrays of any shape, which are read flat.

    A number that is not finite, outside of an array, is sent as null.
    """
    arrays: list[bytes] = []
    count = 0

    def plain(value: Any) -> Any:
        nonlocal count
        if isinstance(value, np.ndarray):
            kind, form = (WHOLE, "<u4") if value.dtype.kind in "ui" else (FLOATS, "<f4")
            with np.errstate(over="ignore"):
                arrays.append(np.ascontiguousarray(value.astype(form)).tobytes())
            found = {kind: [count, value.size]}
            count += value.size
            return found
        if isinstance(value, dict):
            return {str(key): plain(each) for key, each in value.items()}
        if isinstance(value, list | tuple):
            return [plain(each) for each in value]
        if isinstance(value, float | np.floating):
            return float(value) if np.isfinite(value) else None
        return value.item() if isinstance(value, np.generic) else value

    header = json.dumps(plain(message), allow_nan=False, ensure_ascii=False).encode("utf-8", "replace")
    header += b" " * (-len(header) % WORD)
    return struct.pack("<I", len(header)) + header + b"".join(arrays)


def unpack(data: bytes) -> Any:
    """Return the message of `pack`, with flat arrays of 32 bits."""
    (length,) = struct.unpack_from("<I", data)
    begin = WORD + length

    def arrays(value: dict[str, Any]) -> Any:
        for kind, form in ((FLOATS, "<f4"), (WHOLE, "<u4")):
            if kind in value:
                return np.frombuffer(data, form, value[kind][1], begin + WORD * value[kind][0])
        return value

    return json.loads(data[WORD:begin], object_hook=arrays)


def in_text(messages: Iterator[Any] | list[Any]) -> str:
    """Return messages as lines of base64, as a page holds them."""
    return "\n".join(base64.b64encode(pack(message)).decode("ascii") for message in messages)


def from_text(text: str) -> list[Any]:
    """Return the messages of `in_text`."""
    return [unpack(base64.b64decode(line)) for line in text.split()]


Message = dict[str, Any]
Rows = Sequence[int] | NDArray[np.int64]

# Rows of a replay in the lab, points of a path, and events that are listed.
FRAMES, MOST_POINTS, MOST_MARKS = 200, 600, 1000
# After so many rows of a replay other work may go first.
FEW_ROWS = 10
# What the arrows and lines in space are, by the names of `closedloop.figures.scene.scene`.
MEANINGS = {
    "contact force": "contact force on the tip",
    "friction": "friction on the tip",
    "commanded force": "force commanded",
    LOOP: "force of a loop joint",
    TOUCH: "force on a link that touches",
    OUTSIDE: "force from outside",
    JOINTS: "loop joint",
    "actual path": "path of the tip",
    "desired path": "path desired",
}
MODES = {FREE: "free", PRESSED: "slides", STUCK: "sticks"}
# The view of the contact shows the path and this share of the robot's size about it.
NEAR, FAR_PATH = 0.22, 0.65


def curves(
    run: Run, window: tuple[float, float] | None = None, more: Sequence[str] = (), cells: int = CELLS,
    there: Sequence[Panel] | None = None,
) -> list[Message]:  # fmt: skip
    """Return the panels of a run, `there` if they are known, and of the columns `more`, within a window of time, s."""
    begin, end = (float(run.time[0]), float(run.time[-1])) if window is None else window
    columns = set(column_names(run))
    found = [*(panels(run) if there is None else there), *(column_panel(run, name) for name in more if name in columns)]
    return [
        {
            "name": panel.name, "title": panel.title, "time": panel.time, "band": panel.band,
            "main": panel.main.label, "factor": panel.factor, "traces": [vars(trace) for trace in panel.traces],
        }
        for panel in (reduced(each, begin, end, cells) for each in found)
    ]  # fmt: skip


def run_message(run: Run, panels_of_it: list[Message], **more: Any) -> Message:
    """Return the message that a run is there: its curves, modes and events."""
    touching = run.scenario.contact or ()
    found = []
    for event in run.events[:MOST_MARKS]:
        of = touching[event.contact - 1].name if 0 < event.contact <= len(touching) else "tip"
        place = [round(float(x), 6) for x in event.position]
        found.append({"time": event.time, "kind": event.kind, "of": of, "place": place})
    return {
        "kind": "run", "begin": float(run.time[0]), "end": float(run.time[-1]), "step": run.scenario.time.step,
        "stopped": run.stopped or "", "panels": panels_of_it, "modes": _modes(run), "marks": found,
        "events": len(run.event_time), "columns": column_names(run), **more,
    }  # fmt: skip


def _modes(run: Run) -> Message | None:
    """Return when the mode of the tip's contact changes, s, and to which; None without a surface."""
    if not run.scenario.has_surface:
        return None
    change = np.flatnonzero(np.diff(run.mode)) + 1
    begins = np.concatenate([[0], change])[: 4 * MOST_MARKS]
    return {"time": run.time[begins], "mode": run.mode[begins].astype(float), "names": list(MODES.values())}


def robot_message(scene: Scene) -> Message:
    """Return what of a scene is the robot's: shapes, marks of loop joints, and what the arrows and colours mean."""
    ground = len(scene.joint_places(0)[0])
    joints = ground + 1 + len(scene.joined.loops) + len(scene.ghosts)
    return {
        "kind": "robot", "joints": joints, "ground": ground, "meanings": MEANINGS,
        "clear": sorted(scene.hiding) if scene.arm_hides_force else [],
        "shapes": [
            {"joint": joint, "kind": kind, "colour": s.colour, "vertices": s.vertices,
             "faces": np.asarray(s.faces, np.uint32), **more} for joint, kind, s, more in _shapes(scene)
        ],
    }  # fmt: skip


def space_message(
    scene: Scene, rows: Rows, passing: Message | None = None, between: Callable[[], object] = lambda: None
) -> Message:
    """Return a run in space: replay at `rows`, surface, paths, and what passes through what, as `passing` says.

    `between` is called after every few rows, so that other work may go first.
    """
    (vertices, faces), (middle, radius), (near, close) = scene.surface, scene.ball, focus(scene)
    first = scene.arrows([0])[0]
    scenario = scene.run.scenario
    lines = [("actual path", PATH, scene.run.position)] if scenario.robot.model != NO_ROBOT else []
    if scenario.has_law or scenario.has_surface:
        lines.append(("desired path", WANTED, scene.run.reference_tip))
    lines = [line for line in lines if np.max(np.ptp(line[2], axis=0)) > AT_REST]
    through = None  # what passes through what, in words, with the joints whose shapes do
    if passing is not None and (text := passing_note(passing)):
        model = scene.model.pinocchio_model()
        links = [name for name in passing["between"] if model.existFrame(name)]
        joints = [int(model.frames[model.getFrameId(name)].parentJoint) for name in links]
        through = {"text": text, "joints": joints, "surface": len(links) < len(passing["between"])}
    return {
        "kind": "space", "size": scene.size, "usual": scene.usual_force,
        "whole": {"centre": middle, "radius": radius}, "near": {"centre": near, "radius": close},
        "normal": scene.run.surface_normal[0] if scene.ground.there else [0.0, 0.0, 1.0],
        "surface": {"vertices": vertices, "faces": np.asarray(faces, np.uint32)},
        "arrows": [{"name": a.name, "kind": a.kind, "colour": space.ARROWS[a.kind]} for a in first],
        "kinds": scene.kinds, "passing": through,
        "paths": [{"name": n, "colour": c, "points": space.thin_out(points, MOST_POINTS)} for n, c, points in lines],
        "frames": frames(scene, rows, between),
    }  # fmt: skip


def focus(scene: Scene) -> tuple[NDArray[np.float64], float]:
    """Return the middle (3,) and radius, m, of what the view of the contact shows: where forces act."""
    run, (whole, radius) = scene.run, scene.ball
    rows = evenly(len(run), 12)
    if scene.ground.there:
        points = space.thin_out(run.position, 50)
    elif scene.touching:
        points = np.array([a.tail for each in scene.arrows(rows) for a in each if a.kind == TOUCH])
    elif scene.joined.loops:
        return whole, radius
    else:  # bodies that move
        points = np.vstack([scene.joint_places(int(row))[1][1:] for row in rows])
    points = points[np.all(np.isfinite(points), axis=1)]
    if not len(points):
        return whole, radius
    low, high = points.min(axis=0), points.max(axis=0)
    near = FAR_PATH * float(np.linalg.norm(high - low)) + NEAR * scene.size
    return 0.5 * (low + high), min(near, radius)


def frames(scene: Scene, rows: Rows, between: Callable[[], object] = lambda: None) -> Message:
    """Return a replay: instants, places of joints, surface and marks (quaternion, origin), forces and their tails.

    `between` is called after every few rows.
    """
    run = scene.run
    arrows: list[Any] = []
    places: list[NDArray[np.float64]] = []
    last: NDArray[np.float64] | None = None
    for k, row in enumerate(rows):
        if k % FEW_ROWS == 0:
            arrows += scene.arrows(rows[k : k + FEW_ROWS])
            between()
        there = scene.joint_places(int(row))
        (turn, shift), marks = scene.ground.place(int(row)), scene.joined.places(*there)
        ghosts = [ghost.place(float(run.time[row])) for ghost in scene.ghosts]
        turns = space.quaternions(np.vstack([there[0], turn[None], marks[0], *(axes[None] for axes, _ in ghosts)]))
        if last is not None:  # of the two quaternions of a rotation that which is near the one before
            turns *= np.where(np.sum(turns * last, axis=1, keepdims=True) < 0.0, -1.0, 1.0)
        last = turns
        places.append(np.hstack([turns, np.vstack([there[1], shift, marks[1], *(origin for _, origin in ghosts)])]))
    tails, forces = (np.array([[arrow[part] for arrow in each] for each in arrows]) for part in (0, 1))
    return {"time": run.time[np.asarray(rows)], "places": np.array(places), "tails": tails, "forces": forces}


def _shapes(scene: Scene) -> Iterator[tuple[int, str, Shape, Message]]:
    """Yield the robot's shapes, the marks of its loop joints and the ghosts, each with the number of its place.

    Then what it is, and for a ghost how much it hides.
    """
    for shape in scene.shapes:
        yield shape.joint, "", shape, {}
    after = len(scene.joint_places(0)[0]) + 1
    for k, loop in enumerate(scene.joined.loops):
        yield after + k, JOINTS, loop.shape, {}
    for k, ghost in enumerate(scene.ghosts):
        for shape in ghost.shapes:
            yield after + len(scene.joined.loops) + k, ghost.name, replace(shape, colour=COLOUR), {"opacity": OPACITY}
