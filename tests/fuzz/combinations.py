"""Combinations of keys, each of them valid by itself on a shipped scenario: what one leaves out another may need."""

import random
from collections.abc import Iterator
from copy import deepcopy
from typing import Any, Literal, get_args, get_origin

from scenario_cases import EXAMPLES, SEED, Case
from shipped_cases import MECHANISMS, SCENARIOS, shipped_tables

from closedloop.base.errors import ScenarioError
from closedloop.base.families import OneOf
from closedloop.base.sections import field_units
from closedloop.lab.curves import USUAL
from closedloop.mechanics.contacts.sections import ContactSection
from closedloop.scenario.load import scenario_of, shipped_scenarios
from closedloop.scenario.messages import variants
from closedloop.scenario.scenario import BodySection, Scenario

MOST = 6  # changes of a scenario
# A robot and a start go with each other, and the duration is what a case costs.
FIXED = {"robot.model", "robot.tip", "start.q", "time.duration", "surface.heights", "surface.expression"}


# The tables of a list, of which one is changed, and the keys whose values depend on a place.
LISTS: dict[str, Any] = {"contact": ContactSection, "body": BodySection}
PLACES = {"name", "link", "at", "against", "normal", "through", "half_axes", "shape", "position", "surface", "motion",
          "radius", "edges", "length", "quaternion", "inertia", "edge"}  # fmt: skip
# Laws of a contact, in the words of the section of the tip's.
LAWS = {
    "compliance": ({"kind": "kelvin_voigt", "stiffness": 2e4, "damping": 40.0},
                   {"kind": "hunt_crossley", "stiffness": 1e6, "dissipation": 1.0}),
    "friction_law": ({"kind": "stribeck", "kinetic": 0.2, "static": 0.3, "stribeck_speed": 0.01},
                     {"kind": "coulomb_viscous", "coefficient": 0.2, "viscous": 1.0},
                     {"kind": "lugre", "kinetic": 0.2, "static": 0.3, "stribeck_speed": 0.01, "stiffness": 1e3,
                      "damping": 10.0}),
}  # fmt: skip


def value_of(draw: random.Random, dotted: str, field: Any, held: Any) -> Any:
    """Return a value that a key may well have: another of its words, or numbers of the size that its unit suggests."""
    names = next((one for one in field.metadata if isinstance(one, OneOf)), None)
    if names is not None or get_origin(field.annotation) is Literal:
        return draw.choice(names.names() if names else list(get_args(field.annotation)))
    if field.annotation is bool:
        return draw.random() < 0.5
    held = EXAMPLES.get(dotted, field.default) if held is None else held
    if isinstance(held, list | tuple):
        return [x * draw.uniform(0.5, 2.0) if isinstance(x, float | int) else x for x in held]
    if field.annotation is int:
        return draw.randrange(5)
    usual = next((USUAL.get(unit.partition(" (")[0], 1.0) for unit in field_units(field)), 1.0)
    size = abs(held) if isinstance(held, float | int) and held else usual
    return draw.choice((1, 1, 1, -1)) * size * 10.0 ** draw.uniform(-2.0, 1.0)


# Members of a family within a section: surfaces and motions that the controller believes in.
WITHIN: dict[str, tuple[dict[str, Any], ...]] = {
    "belief.surface": ({"kind": "plane", "normal": [0.05, -0.02, 1.0]}, {"kind": "plane", "offset": 0.002}),
    "belief.surface_motion": tuple({"kind": kind, "velocity": [0.0, 0.01, 0.0]} for kind in ("belt", "conveyor")),
}


def change(draw: random.Random, data: dict[str, Any]) -> str:
    """Change a kind or a key of a scenario's tables, and return what was changed."""
    section = draw.choice([name for name in Scenario.model_fields if variants(name)])
    kinds, table = variants(section), data.setdefault(section, {})
    if len(kinds) > 1 and draw.random() < 0.4:
        kind = draw.choice([name for name in kinds if ":" not in name])
        data[section] = table = {k: v for k, v in table.items() if k in kinds[kind].model_fields} | {"kind": kind}
        for key, field in kinds[kind].model_fields.items():
            if field.is_required() and key not in table:
                dotted = f"{section}.{key}"
                table[key] = deepcopy(EXAMPLES.get(dotted)) or value_of(draw, dotted, field, None)
        return f"{section}.kind = {kind}"
    family = next((each for each in Scenario.model_fields[section].metadata if hasattr(each, "usual")), None)
    kind = table.get("kind", getattr(family, "usual", None) or next(iter(kinds)))
    key = draw.choice(list(kinds[kind].model_fields))
    if key == "kind" or f"{section}.{key}" in FIXED:
        return ""
    if f"{section}.{key}" in WITHIN:
        table[key] = deepcopy(draw.choice(WITHIN[f"{section}.{key}"]))
    else:
        table[key] = value_of(draw, f"{section}.{key}", kinds[kind].model_fields[key], table.get(key))
    return f"{section}.{key} = {table[key]}"


def change_in_list(draw: random.Random, data: dict[str, Any]) -> str:
    """Change a key of a contact or of a body of a scenario that has some, and return what was changed."""
    section = draw.choice([name for name in LISTS if data.get(name)])
    at = draw.randrange(len(data[section]))
    key = draw.choice([key for key in LISTS[section].model_fields if key not in PLACES])
    table, field = data[section][at], LISTS[section].model_fields[key]
    if key in LAWS:
        table.pop("friction", None) if key == "friction_law" else None
        table[key] = deepcopy(draw.choice(LAWS[key]))
    elif key in ("velocity", "spin", "quaternion"):
        table[key] = [draw.uniform(-0.5, 0.5) for _ in range(4 if key == "quaternion" else 3)]
    elif key in ("restitution", "friction"):
        table[key] = draw.random()
    else:
        table[key] = value_of(draw, f"{section}.{key}", field, table.get(key))
    return f"{section}[{at}].{key} = {table[key]}"


def add_bodies(draw: random.Random, data: dict[str, Any]) -> str:
    """Put a ball or a box over a floor beside what a scenario has, so that it lands, rolls, slides or stands."""
    size, gap = draw.uniform(0.02, 0.1), draw.choice((0.0, 0.0, draw.uniform(0.0, 0.02)))
    ball = draw.random() < 0.5
    half = size if ball else 0.5 * size
    shape = {"shape": "ball", "radius": size} if ball else {"shape": "box", "edges": [size, 1.2 * size, size]}
    body = {"name": "thing", "mass": draw.uniform(0.1, 3.0), "position": [3.0, 3.0, half + gap], **shape}
    corners = [[x * 0.5 * size, y * 0.6 * size, -half] for x in (-1, 1) for y in (-1, 1)]
    contact: dict[str, Any] = {"name": "floor", "link": "thing", "friction": draw.choice((0.0, 0.1, 0.5))}
    contact |= {"radius": size} if ball else {"at": corners}
    if not ball and draw.random() < 0.3:
        face = draw.choice(({"disc": 0.4 * size, "rings": 2}, {"rectangle": [size, 1.2 * size], "points": [3, 2]}))
        contact |= {"at": face | {"centre": [0.0, 0.0, -half]}, "compliance": deepcopy(draw.choice(LAWS["compliance"]))}
    if draw.random() < 0.6:
        body["velocity"] = [draw.uniform(-0.5, 0.5), draw.uniform(-0.5, 0.5), 0.0]
    data.setdefault("body", []).append(body)
    data.setdefault("contact", []).append(contact)
    return f"a {shape['shape']} of {size:.3g} m, {gap:.3g} m above the floor"


def combinations(count: int, seed: int = SEED, duration: float | None = None, contacts: bool = False) -> Iterator[Case]:
    """Return so many shipped scenarios with two changes and more, none of which is refused by itself.

    They last ten steps, or from a fifth of `duration`, s, to twice it, and then half of them have another scheme than
    their own. With `contacts` each has contacts of links, loops or free bodies, and some of the changes are theirs.
    """
    draw, names = random.Random(seed), shipped_scenarios()
    for number in range(count):
        name = draw.choice(names)
        data, said = deepcopy(shipped_tables(name)), []
        if contacts:
            looped = data.get("robot", {}).get("model") in MECHANISMS
            if not (looped or "contact" in data) or draw.random() < 0.3:
                said.append(add_bodies(draw, data))
            for _ in range(draw.randint(0, 2) if "contact" in data else 0):
                said.append(change_in_list(draw, data))
        for _ in range(draw.randint(2, MOST)):
            seed_of_this = draw.random()
            alone = deepcopy(shipped_tables(name))
            if not change(random.Random(seed_of_this), alone):
                continue
            try:
                scenario_of(alone, "fuzz", {})
            except ScenarioError:
                continue
            said.append(change(random.Random(seed_of_this), data))
        model = data.get("robot", {}).get("model", "")
        if "/" in model:  # a file beside the shipped scenarios
            data["robot"]["model"] = str(SCENARIOS / model)
        if duration is not None:
            step = data["time"]["step"]
            data["time"]["duration"] = max(1, round(duration * draw.uniform(0.2, 2.0) / step)) * step
            data["time"]["integrator"] = draw.choice(["rk4", data["time"].get("integrator", "semi_implicit_euler")])
        yield Case(f"{number} {name}: {', '.join(said)}", data, {})
