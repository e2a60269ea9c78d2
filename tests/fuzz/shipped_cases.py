"""The shipped scenarios, and the mechanisms in their sidecars, with wrong values in the tables that they have.

`scenario_cases` tries each key on three plain robots. Here what stands around a key is what it is meant for: tools,
curved and moving surfaces, loops, contacts of links, encoders. With what is not tried there: the tables of a list,
`[[contact]]` of a scenario and `[[closed_loop]]` of a robot.
"""

import random
import tomllib
from collections.abc import Iterator
from copy import deepcopy
from functools import cache
from pathlib import Path
from typing import Any

from scenario_cases import SEED, Case, wrong_values

import robot_models
from closedloop.scenario.load import shipped_scenarios
from closedloop.scenario.messages import variants
from closedloop.scenario.scenario import ContactSection, Scenario
from robot_models.described import path_of

SCENARIOS = Path(robot_models.__file__).parents[1] / "closedloop" / "scenario" / "shipped"
# One loop of every type, on the tree of a robot that ships with a loop; where it does not close, that is said.
LOOPS: tuple[dict[str, Any], ...] = (
    {"type": "point", "frames": ["A", "B"]}, {"type": "hinge", "frames": ["A", "B"], "axis": [0, 1, 0]},
    {"type": "slider", "frames": ["A", "world"], "axis": [1, 0, 0]}, {"type": "cylinder", "frames": ["A", "B"]},
    {"type": "universal", "frames": ["A", "B"], "axes": [[1, 0, 0], [0, 1, 0]]},
    {"type": "planar", "frames": ["A", "world"]}, {"type": "weld", "frames": ["A", "world"]},
    {"type": "distance", "frames": ["A", "world"], "length": 0.3},
    {"type": "gear", "joints": ["A", "B"], "polynomial": [0.0, 1.0, 0.0, 0.0, 0.0]},
)  # fmt: skip
LOOP_KEYS = (
    "name",
    "type",
    "frames",
    "points",
    "axis",
    "axes",
    "turn",
    "length",
    "joints",
    "polynomial",
    "no_such_key",
)
MECHANISMS = ("five_bar", "four_bar", "delta", "stewart", "gripper")


@cache
def shipped_tables(name: str) -> dict[str, Any]:
    """Return a shipped scenario's tables, ten steps long."""
    data = tomllib.loads((SCENARIOS / f"{name}.toml").read_text(encoding="utf-8"))
    data.pop("description", None)
    data["time"]["duration"] = 10.0 * data["time"]["step"]
    return data


def scenario_draw(draw: random.Random, values: list[tuple[str, Any]]) -> Case:
    """Return a shipped scenario with one to three wrong values."""
    name = draw.choice(shipped_scenarios())
    data, asked, said = deepcopy(shipped_tables(name)), {}, []
    for _ in range(draw.choice((1, 1, 1, 2, 3))):
        section = draw.choice([key for key in Scenario.model_fields if variants(key)] + ["contact"] * 3)
        label, value = draw.choice(values)
        if section == "contact":
            entries = data.setdefault("contact", [{"link": "world", "at": [0.0, 0.0, 0.0]}])
            at = draw.randrange(len(entries))
            key = draw.choice((*ContactSection.model_fields, "no_such_key"))
            entries[at][key] = value
            said.append(f"contact[{at}].{key} = {label}")
            continue
        kinds = variants(section)
        kind = data.get(section, {}).get("kind", next(iter(kinds)))
        kind = kind if isinstance(kind, str) and kind in kinds else next(iter(kinds))
        if draw.random() < 0.2:
            kind = draw.choice(list(kinds))
            data.setdefault(section, {})["kind"] = kind
        key = draw.choice(list(kinds[kind].model_fields))
        data.setdefault(section, {})[key] = asked[f"{section}.{key}"] = value
        said.append(f"{section}.{key} [{kind}] = {label}")
    if any(key.endswith((".integrator", ".step", ".duration", ".kind")) for key in asked):
        asked = {}
    return Case(f"{name}: {', '.join(said)}", data, asked)


def loop_draw(draw: random.Random, values: list[tuple[str, Any]]) -> Case:
    """Return a scenario of a mechanism whose loop has one or two wrong values, or is of another type."""
    name = draw.choice(MECHANISMS)
    sidecar = tomllib.loads(path_of(name).with_suffix(".toml").read_text(encoding="utf-8"))
    said = []
    if draw.random() < 0.4:
        model = robot_models.load(name)
        links, joints = [frame for frame in model.frames if frame != "universe"], list(model.joint_names)
        loop = deepcopy(draw.choice(LOOPS))
        for key, known in (("frames", links), ("joints", joints)):
            if key in loop:
                loop[key] = [word if word == "world" else draw.choice(known) for word in loop[key]]
        sidecar.setdefault("closed_loop", []).append(loop)
        said.append(f"a {loop['type']} more")
    for _ in range(draw.choice((0, 1, 1, 2)) if said else draw.choice((1, 1, 2))):
        entry, key = draw.choice(sidecar["closed_loop"]), draw.choice(LOOP_KEYS)
        label, entry[key] = draw.choice(values)
        said.append(f"{key} = {label}")
    files = {"robot.urdf": path_of(name).read_text(encoding="utf-8"), "robot.toml": sidecar}
    data = {"name": "fuzz", "robot": {"model": "robot.urdf"}, "start": {"assemble": draw.random() < 0.5},
            "surface": {"normal": [1, 0, 0], "offset": "start", "gap": 0.5, "contact": "unilateral"},
            "reference": {"kind": "hold"}, "law": {"kind": "paper", "kp": 0, "kd": 0.01},
            "time": {"duration": 0.01, "step": 0.001, "integrator": "rk4"}}  # fmt: skip
    return Case(f"{name}: {', '.join(said)}", data, {}, files)


def shipped_cases(count: int, seed: int = SEED) -> Iterator[Case]:
    """Return so many scenarios, four of five of them of shipped ones."""
    draw, values = random.Random(seed), list(wrong_values())
    for _ in range(count):
        yield scenario_draw(draw, values) if draw.random() < 0.8 else loop_draw(draw, values)
