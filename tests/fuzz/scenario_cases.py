"""Scenarios with wrong and with extreme values, made from the section types themselves.

Every key of every kind of every section is found in `closedloop.scenario.scenario.Scenario`, so a key that is added
later is tried without a word here. One that must be given needs an example in `EXAMPLES` unless 1.0 will do.

    one_wrong_value()        each key with each of `wrong_values`
    legal_extremes(count)    two to four keys at once, each at an edge of what is accepted
    odd_files()              texts that are no scenario
"""

import datetime
import math
import random
from collections.abc import Callable, Iterator
from copy import deepcopy
from dataclasses import dataclass, field
from functools import cache, partial
from typing import Any

import tomli_w

from closedloop.base.errors import ScenarioError
from closedloop.scenario.load import scenario_of
from closedloop.scenario.messages import variants
from closedloop.scenario.scenario import Scenario

SEED = 20_240_611

# Values for keys that must be given: a legal scenario is made of them.
EXAMPLES: dict[str, Any] = {
    "reference.direction": [0.0, 1.0, 0.0],
    "surface_motion.velocity": [0.0, 0.1, 0.0],
    "reference.speed": 0.02,
    "reference.start": 0.001,
    "reference.stop": 0.008,
    "reference.radius": 0.001,
    "reference.width": 0.001,
    "reference.height": 0.001,
    "reference.length": 0.001,
    "reference.pitch": 0.0005,
    "reference.passes": 2,
    "reference.times": [0.001, 0.008],
    "surface.expression": "z + 0.5*x**2 - 0.3*x*y",
    "surface.heights": [[0.0] * 17] * 17,
    "surface.faces": [[1, 0, 0, 0.5], [-1, 0, 0, 0.5], [0, 1, 0, 0.5], [0, -1, 0, 0.5], [0, 0, -1, 1]],
    "reference.points": [[0.0, 0.0, 0.0], [0.0, 0.0002, 0.0]],
    "surface_motion.times": [0.001, 0.02],
    "surface_motion.poses": [[0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0], [0.0, 0.0002, 0.0, 1.0, 0.001, 0.0, 0.0]],
    "law.kp": 100.0,
    "law.kd": 5.0,
    "friction.stribeck_speed": 0.01,
    "friction.stiffness": 1e4,
    "friction.damping": 10.0,
    "friction.rise_time": 0.1,
    "friction.memory_delay": 0.003,
    "joint_friction.memory_delay": 0.003,
    "joint_friction.stribeck_speed": 0.01,
    "force_profile.times": [0.0, 0.004],
    "force_profile.forces": [10.0, 12.0],
    "force_profile.to": 12.0,
    "force_profile.at": 0.004,
    "force_profile.frequency": 50.0,
}

# What the other sections are while one is tried. The first is the paper's, the second may lift off and has friction.
ROBOTS: dict[str, dict[str, Any]] = {
    "wam4": {
        "robot": {"model": "wam4"},
        "start": {"q": [1.5707963267948966, 1.0, 0.0, 2.0], "v": [0.0, 0.0, 0.0, 0.0]},
        "reference": {"kind": "line"},
        "time": {"duration": 0.01, "step": 0.001, "integrator": "semi_implicit_euler"},
    },
    "pointmass3": {
        "robot": {"model": "pointmass3"},
        "start": {"q": [0.0, 0.0, 0.0], "v": [0.0, 0.01, 0.0]},
        "surface": {"contact": "unilateral"},
        "friction": {"kind": "coulomb", "coefficient": 0.2},
        "reference": {"kind": "line"},
        "law": {"kind": "hybrid"},
        "time": {"duration": 0.01, "step": 0.001, "integrator": "rk4"},
    },
    "planar2": {
        "robot": {"model": "planar2"},
        "start": {"q": [0.6, -1.4], "v": [0.0, 0.0]},
        "reference": {"kind": "line", "direction": [1.0, 0.0, 0.0]},
        "law": {"kind": "impedance"},
        "time": {"duration": 0.01, "step": 0.001, "integrator": "dop853"},
    },
}

# Extremes of these make the motion stiff, and an integrator that chooses its steps takes as many as that asks for,
# up to a hundred thousand between two rows: minutes, as asked. They are tried with fixed steps.
STIFF = {"law", "compensation", "sensor", "friction", "joint_friction", "force_profile", "stabiliser"}

Place = tuple[str, str, str]
"""Section, kind ("" where there is one) and key ("" for a key that stands outside the sections)."""


@dataclass(frozen=True)
class Case:
    """A scenario file.

    Attributes
    ----------
    name : str
        What was done, for messages.
    content : str or dict
        The file's text, or the tables that it is to hold.
    asked : dict of str to value
        Dotted keys and the values that an accepted scenario must have there.
    files : dict of str to str or dict
        Files that stand beside it: name and text, or tables.
    """

    name: str
    content: str | dict[str, Any]
    asked: dict[str, Any]
    files: dict[str, str | dict[str, Any]] = field(default_factory=dict)

    def text(self) -> str:
        """Return the file's text, TOML."""
        return self.content if isinstance(self.content, str) else tomli_w.dumps(self.content)


def places() -> list[Place]:
    """Return every key that a scenario may have."""
    found: list[Place] = []
    for section in Scenario.model_fields:
        kinds = variants(section)
        if not kinds:
            found.append((section, "", ""))
        for kind, variant in kinds.items():
            found += [(section, kind, key) for key in variant.model_fields]
            found.append((section, kind, "no_such_key"))
    return found


def tables(robot: str, kinds: dict[str, str]) -> dict[str, Any]:
    """Return a legal scenario of this robot in which the sections named are of these kinds, as tables."""
    data = deepcopy(ROBOTS[robot])
    data["name"] = "fuzz"
    for section, kind in kinds.items():
        data[section] = ({"kind": kind} if kind else {}) | (data.get(section, {}) if not kind else {})
    data.setdefault("law", {"kind": "paper"})
    data.setdefault("surface", {"kind": "plane"})
    for section, table in data.items():
        if not isinstance(table, dict):
            continue
        types = variants(section)
        variant = types.get(table.get("kind", ""), next(iter(types.values())))
        for key, info in variant.model_fields.items():
            dotted = f"{section}.{key}"
            if key not in table and (info.is_required() or (section == "reference" and dotted in EXAMPLES)):
                table[key] = deepcopy(EXAMPLES.get(dotted, 1.0))
    if STIFF & set(kinds) and data["time"]["integrator"] == "dop853":
        data["time"]["integrator"] = "explicit_euler"
    if robot == "planar2" and "direction" in data["reference"]:
        data["reference"]["direction"] = [1.0, 0.0, 0.0]
    return data


def wrong_values() -> Iterator[tuple[str, Any]]:
    """Return (name, value): wrong, extreme and a few good ones, for whatever key."""
    numbers = {
        "nan": math.nan, "inf": math.inf, "-inf": -math.inf, "0": 0, "0.0": 0.0, "-0.0": -0.0, "-1": -1, "1": 1,
        "-0.5": -0.5, "0.5": 0.5, "5e-324": 5e-324, "-5e-324": -5e-324, "1e-308": 1e-308, "1e-300": 1e-300,
        "1e-100": 1e-100, "1e-30": 1e-30, "1e-15": 1e-15, "1e-12": 1e-12, "1e-9": 1e-9, "1e-6": 1e-6, "1e-3": 1e-3,
        "1e3": 1e3, "1e6": 1e6, "1e9": 1e9, "1e12": 1e12, "1e15": 1e15, "1e100": 1e100, "-1e100": -1e100,
        "1e300": 1e300, "1e308": 1e308, "-1e308": -1e308, "2**31": 2**31, "2**53+1": 2**53 + 1, "2**63-1": 2**63 - 1,
        "2**63": 2**63, "-2**63-1": -(2**63) - 1, "2**64": 2**64, "10**400": 10**400, "-10**400": -(10**400),
    }  # fmt: skip
    yield from numbers.items()
    texts = {
        "empty text": "", "blank": " ", "text": "text", "number as text": "1.0", "unicode": "Ω → ∞ 机", "null": "a\0b",
        "line end": "a\nb", "escape": "\x1b[31mred", "right to left": "\u202eabc", "long text": "x" * 100_000,
        "path": "../../etc/passwd", "surrogate pair": "\U0001f916", "auto": "auto", "start": "start", "none": "none",
    }  # fmt: skip
    yield from texts.items()
    yield from {
        "true": True, "false": False, "empty list": [], "a list of one": [1.0], "two numbers": [1.0, 2.0],
        "three numbers": [0.0, 0.0, 1.0], "four numbers": [0.1, 0.2, 0.3, 0.4], "nan in a list": [0.0, math.nan, 1.0],
        "inf in a list": [math.inf, 0.0, 0.0, 0.0], "huge in a list": [0, 0, 1e308], "tiny in a list": [0, 0, 5e-324],
        "huge whole number in a list": [2**63, 0, 1], "true in a list": [True, 0.0, 1.0], "text in a list": ["a", "b"],
        "nested list": [[1.0, 0.0, 0.0]], "deeply nested": [[[[[[[[1.0]]]]]]]], "long list": [1.0] * 100_000,
        "long list of lists": [[0.0, 0.0, 0.0]] * 20_000, "mixed list": [1, "a", True, [2]],
        "empty table": {}, "table": {"a": 1}, "table of kind": {"kind": "none"}, "table of a joint": {"J1": 1e308},
        "odd table": {"\0": {"": [math.nan]}},
        "date": datetime.date(2024, 2, 29), "time of day": datetime.time(1, 2, 3),
        "date and time": datetime.datetime(2024, 2, 29, 1, 2, 3),
        "date and time of a zone": datetime.datetime(2024, 2, 29, tzinfo=datetime.UTC),
    }.items()  # fmt: skip


def one_wrong_value() -> Iterator[Case]:
    """Return each key with each wrong value, on one robot or another."""
    return (make() for make in _wrong_one_by_one())


def _wrong_one_by_one() -> Iterator[Callable[[], Case]]:
    """Return what makes each of `one_wrong_value`."""
    values = list(wrong_values())
    for at, place in enumerate(places()):
        for index, (name, value) in enumerate(values):
            yield partial(_with_value, tuple(ROBOTS)[(at + index) % len(ROBOTS)], place, name, value)


def _with_value(robot: str, place: Place, name: str, value: Any) -> Case:
    section, kind, key = place
    data = tables(robot, {section: kind} if key else {})
    if key:
        data.setdefault(section, {})[key] = value
    else:
        data[section] = value
    dotted = f"{section}.{key}" if key else section
    return Case(f"{robot}: {dotted} [{kind}] = {name}", data, {dotted: value})


EDGES = [sign * float(f"1e{power}") for sign in (1, -1) for power in (-300, -30, *range(-15, 16, 3), 30, 300)]


@cache
def legal(robot: str, place: Place) -> tuple[Any, ...]:
    """Return values at and within the edges of what a key accepts: the smallest, the largest, and some between."""
    section, kind, key = place
    sizes = [*EDGES, 0.0, 5e-324, 1e308, 0.5, 1.0, 2.0]
    n = len(ROBOTS[robot]["start"]["q"])
    tried: list[Any] = [*sizes, *(round(x) for x in sizes if 1.0 <= abs(x) < 1e20), 2**63, True, False]
    tried += [[x] * n for x in sizes] + [[0.0, 0.0, x] for x in sizes] + [[x, x, x] for x in sizes]
    tried += [value for _, value in wrong_values() if isinstance(value, str)]
    field = variants(section)[kind].model_fields[key]
    tried += [word for word in getattr(field.annotation, "__args__", ()) if isinstance(word, str)]
    accepted = []
    for value in tried:
        data = tables(robot, {section: kind})
        data.setdefault(section, {})[key] = value
        try:
            scenario_of(data, "fuzz", {})
        except ScenarioError:
            continue
        accepted.append(value)
    fitting = [value for value in accepted if not isinstance(value, list) or len(value) == n]
    return tuple(fitting or accepted)


def legal_extremes(count: int, seed: int = SEED) -> Iterator[Case]:
    """Return scenarios in which two to four keys are at values that each alone would be accepted."""
    draw = random.Random(seed)
    every = [place for place in places() if place[2] not in ("", "kind", "no_such_key", "description")]
    while count > 0:
        robot = draw.choice(tuple(ROBOTS))
        chosen = draw.sample(every, draw.choice((2, 2, 3, 4)))
        kinds: dict[str, str] = {}
        for section, kind, _ in chosen:
            kinds.setdefault(section, kind)
        data = tables(robot, kinds)
        asked: dict[str, Any] = {}
        for section, kind, key in chosen:
            values = legal(robot, (section, kind, key))
            if kinds[section] == kind and values:
                asked[f"{section}.{key}"] = value = draw.choice(values)
                data.setdefault(section, {})[key] = value
        if len(asked) < 2:
            continue
        shown = ", ".join(f"{key} = {str(value)[:24]!r}" for key, value in asked.items())
        yield Case(f"{robot}: {shown} {kinds}", data, asked)
        count -= 1


def odd_files() -> Iterator[Case]:
    """Return texts that are no scenario, or hardly one."""
    good = tomli_w.dumps(tables("planar2", {}))
    for name, text in {
        "empty": "", "a byte order mark": "\ufeff" + good, "nested deeply": "a = " + "[" * 100_000,
        "dotted deeply": "a" + ".a" * 50_000 + " = 1", "tables nested deeply": "[a" + ".a" * 20_000 + "]\n",
        "inline tables nested deeply": "x = " + "{a = " * 20_000, "a key twice": good + "\n[time]\nstep = 1\n",
        "half": good[: len(good) // 2], "a number of 5000 digits": "name = " + "1" * 5000,
        "a number of 40000 bits": good.replace("step = 0.001", "step = 0x" + "f" * 10_000),
        "a list of numbers of 40000 bits": good.replace("step = 0.001", "step = [0x" + "f" * 10_000 + "]"),
        "a gain of 40000 bits": good.replace("q = [", "q = [0x" + "f" * 10_000 + ","),
        "many sections": "".join(f"[s{i}]\n" for i in range(20_000)), "old line ends": good.replace("\n", "\r"),
        "carriage returns": good.replace("\n", "\r\n"), "null": "name = 'a\0b'", "long key": "x" * 100_000 + " = 1",
        "binary": "".join(chr(i) for i in range(256)), "only a comment": "# nothing", "kind beside": "kind = 'line'",
    }.items():  # fmt: skip
        yield Case(f"file: {name}", text, {})


def all_cases(extremes: int = 6000, seed: int = SEED, count: int | None = None) -> list[Case]:
    """Return all scenarios, or the first `count`, in an order that only the seed decides."""
    made = [
        partial(Case, case.name, case.content, case.asked) for case in (*odd_files(), *legal_extremes(extremes, seed))
    ]
    makers = [*made, *_wrong_one_by_one()]
    random.Random(seed).shuffle(makers)
    return [make() for make in makers[:count]]
