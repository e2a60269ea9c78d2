"""The controls of a scenario, and values to begin with of a kind whose keys have no defaults.

A control knows how to turn what it shows into a value of the scenario and back. Its bounds, unit and hint are those of
the key's field; the span of a slider starts from the value that the scenario has.
The page shows them as rows in groups by what they mean.
"""

import json
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args, get_origin

from pydantic.fields import FieldInfo

from closedloop.base.families import Family, OneOf
from closedloop.base.sections import Section, field_units
from closedloop.lab.curves import USUAL, nearest_round, span
from closedloop.mechanics.surface.placed import contact_frame, unit
from closedloop.scenario.load import toml_value
from closedloop.scenario.messages import variants
from closedloop.scenario.scenario import Scenario, families, families_in
from closedloop.scenario.tables import ALL, names_in, table_type
from robot_models import RobotModel

Changes = dict[str, Any]  # dotted key to value, as `load_scenario` takes them
# By key; what the present kind has under the same name is kept instead.
BEGIN: dict[str, Any] = {
    "reference.radius": 0.02, "reference.width": 0.06, "reference.height": 0.03, "reference.speed": 0.01,
    "reference.length": 0.06, "reference.pitch": 0.01, "reference.passes": 3,
    "law.kp": 400.0, "law.kd": 30.0,
    "friction.coefficient": 0.3, "friction.viscous": 1.0, "friction.stiffness": 1e4, "friction.kinetic": 0.3,
    "friction.static": 0.4, "friction.dead_band": 1e-3, "friction.stribeck_speed": 0.005, "friction.damping": 30.0,
    "friction.static_excess": 0.1, "friction.memory_delay": 0.005, "friction.rise_time": 0.1,
    "joint_friction.kinetic": 0.3, "joint_friction.static": 0.4, "joint_friction.viscous": 0.1,
    "joint_friction.stiffness": 1e3, "joint_friction.damping": 3.0, "joint_friction.dead_band": 1e-3,
    "joint_friction.stribeck_speed": 0.01, "joint_friction.static_excess": 0.1, "joint_friction.memory_delay": 0.005,
    "joint_friction.rise_time": 0.1,
    "surface_motion.velocity": [0.0, 0.01, 0.0], "surface_motion.speed": 0.1,
    "surface.heights": [[0.0] * 17] * 17, "surface.expression": "z", "surface.faces": [[1.0, 0.0, 0.0, 0.1]],
    "force_profile.amplitude": 2.0, "force_profile.frequency": 1.0,
}  # fmt: skip


def begin_values(scenario: Scenario, section: str, kind: str) -> dict[str, Any]:
    """Return dotted keys and values of those that a kind requires and the scenario's section does not have."""
    held = getattr(scenario, section)
    found: dict[str, Any] = {}
    for name, field in variants(section)[kind].model_fields.items():
        key = f"{section}.{name}"
        words = get_args(field.annotation) if get_origin(field.annotation) is Literal else ()
        if name != "kind" and words and getattr(held, name, words[0]) not in words:
            found[key] = field.default  # a word that the present kind has and this one does not know
        if field.is_required() and not hasattr(held, name):
            found[key] = _value(scenario, key, next(iter(field_units(field)), "").partition(" (")[0])
    return found


def _value(scenario: Scenario, key: str, unit_name: str) -> Any:
    end = scenario.time.duration
    if key in BEGIN:
        return BEGIN[key]
    if key == "reference.direction":
        return [float(x) for x in contact_frame(unit(scenario.surface.normal, "surface.normal"))[2].round(9)]
    by_name = {
        "reference.stop": 0.8 * end, "reference.times": [0.1 * end, 0.8 * end],
        "reference.points": [[0.0, 0.0, 0.0], [0.0, 0.0, 0.0]],
        "force_profile.to": 1.5 * scenario.law.force, "force_profile.at": 0.5 * end,
        "force_profile.times": [0.25 * end, 0.75 * end],
        "surface_motion.times": [0.1 * end, 0.8 * end],
        "surface_motion.poses": [[0.0, y, 0.0, 1.0, 0.0, 0.0, 0.0] for y in (0.0, 0.01)],
        "force_profile.forces": [scenario.law.force, 1.5 * scenario.law.force],
    }  # fmt: skip
    return by_name.get(key, USUAL.get(unit_name, 1.0))


# The sections of a scenario, in the order in which their controls are listed.
LISTED = (
    "law", "compensation", "sensor", "force_profile", "belief", "model_error", "surface", "surface_motion",
    "compliance", "impact", "contact", "external_force", "friction", "joint_friction", "encoder", "drives",
    "transmission", "stabiliser", "reference", "start", "tool", "time",
)  # fmt: skip
Form = Literal["linear", "log", "whole", "choice", "flag", "text"]
# Keys whose values go with each other as whole numbers of steps: their sliders move in round values.
ROUND = ("time.step",)
# Units of a joint that turns, and what they are of one that slides.
SLIDING = {"rad": "m", "rad/s": "m/s", "N m": "N", "N m/rad": "N/m", "N m s/rad": "N s/m"}
# Sections whose lists are of other things than joints, however many they have.
NO_JOINTS = ("tool", "surface", "belief", "surface_motion", "force_profile", "reference", "contact", "external_force")
DIGITS = 3  # of a value from a logarithmic slider


@dataclass(frozen=True)
class Control:
    """A control of one number, or of one choice."""

    key: str  # the dotted key
    index: int | None  # which entry of a list it sets, None where the value is no list
    # "linear", "log" and "whole" are sliders, of the value, of its decimal logarithm, of whole numbers; "choice";
    # "flag"; and "text", in TOML
    form: Form
    # label, unit, hint: for display
    label: str
    unit: str
    hint: str
    value: Any  # the value of the scenario: the whole list where there is an index
    # low, high, step: of a slider, in what it shows
    low: float = 0.0
    high: float = 1.0
    step: float = 0.01
    options: tuple[str, ...] = ()  # of a choice

    @property
    def own(self) -> Any:
        """The value of this control alone."""
        return self.value if self.index is None else self.value[self.index]

    @property
    def shown(self) -> Any:
        """What the control shows for its value."""
        if self.form == "text":
            return toml_text(self.value)
        if self.form == "log":
            return min(max(math.log10(self.own), self.low), self.high)
        if self.form == "whole":
            return int(self.own)
        return min(max(float(self.own), self.low), self.high) if self.form == "linear" else self.own

    def read(self, shown: Any) -> Any:
        """Return the value of the key for what the control shows; None: left out.

        Raises ValueError if the control cannot show that: what comes from a browser may be anything.
        """
        if self.form == "choice":
            if shown not in self.options:
                raise ValueError(f"{self.key}: must be one of {', '.join(self.options)}")
            return shown
        if self.form == "flag":
            return bool(shown)
        if self.form == "text":
            return None if not str(shown).strip() else toml_value(str(shown))
        if self.form == "whole":
            return round(float(shown))
        number = float(shown)
        if self.form == "log":
            number = nearest_round(10.0**number) if self.key in ROUND else float(f"{10.0**number:.{DIGITS}g}")
        else:
            number = float(f"{number:.9g}")
        return self.put(number)

    def put(self, number: Any) -> Any:
        """Return the value of the key with a number in place of this control's own."""
        return number if self.index is None else [*self.value[: self.index], number, *self.value[self.index + 1 :]]

    def typed(self, text: str) -> Any:
        """Return the value of the key for a number that was typed, which may be beyond the slider."""
        if self.form not in ("linear", "log", "whole"):
            return self.read(text)
        try:
            number: float = round(float(text)) if self.form == "whole" else float(text)
        except (ValueError, OverflowError):
            raise ValueError(f"{self.key}: {text.strip()[:40]!r} is no number") from None
        return self.put(number)

    def together(self, value: Sequence[float]) -> list[float]:
        """Return the list of which this control's entry is as in `value`, and all others changed by the same factor."""
        assert self.index is not None
        was, now = float(self.own), float(value[self.index])
        return [now if was == 0.0 else float(f"{now / was * each:.6g}") for each in self.value]

    def with_value(self, value: Any) -> "Control":
        """Return this control with another value, in a wider span if need be."""
        changed = replace(self, value=value)
        if self.form in ("linear", "log", "whole"):
            at = math.log10(changed.own) if self.form == "log" else float(changed.own)
            # within a step it is rounding, not another span
            if not self.low - self.step <= at <= self.high + self.step:
                changed = replace(changed, low=min(self.low, at), high=max(self.high, at))
        return changed


def controls(scenario: Scenario, section: str, model: RobotModel | None = None) -> list[Control]:
    """Return the controls of a section of a scenario, that of its kind first, then the force if it has one.

    `section`: such as "law".
    `model`: its joints' names and bounds; without it lists are counted.
    """
    held = getattr(scenario, section)
    if table_type(section):
        return list(_of_tables(section, held or (), scenario))
    found: list[Control] = []
    kinds = _kinds(section, str(getattr(held, "kind", "")))
    if len(kinds) > 1:
        about = Scenario.model_fields[section].description or ""
        own = (type(held).__doc__ or "").partition("\n")[0]
        hint = f"{about}; {own}" if own else about
        found.append(Control(f"{section}.kind", None, "choice", section, "", hint, held.kind, options=kinds))
    resolved: Mapping[str, Any] = getattr(held, "resolved", dict)()
    own_type: type[Section] = type(held)
    fields, inner_families = own_type.model_fields, families_in(own_type)
    for name in sorted(fields, key=lambda name: name != "force"):  # what most come for is at the top
        field = fields[name]
        if name in inner_families:  # a section within: the numbers of it
            inner = getattr(held, name)
            for key, part in type(inner).model_fields.items() if inner is not None else ():
                if field_units(part):
                    found += _of_field(f"{section}.{name}.{key}", part, getattr(inner, key), scenario, model)
        elif name != "kind":
            value = getattr(held, name)
            value = resolved.get(name) if value is None else value
            found += _of_field(f"{section}.{name}", field, value, scenario, model)
    return found


def _of_tables(section: str, tables: Sequence[Section], scenario: Scenario) -> Iterator[Control]:
    """Yield the controls of the numbers of each table of a list, with the table's name in their label.

    Before them, where there are several tables: one for each number that all have, and have alike. It sets all.
    """
    first = tables[0] if len(tables) > 1 else None
    for key, field in type(first).model_fields.items() if first is not None else ():
        values = [getattr(table, key, None) for table in tables]
        if field_units(field) and isinstance(values[0], float) and values.count(values[0]) == len(values):
            for control in _of_field(f"{section}.{ALL}.{key}", field, values[0], scenario, None):
                if control.form in ("linear", "log"):
                    yield replace(control, label=f"all: {key}")
    for i, (table, name) in enumerate(zip(tables, names_in(section, tables), strict=True)):
        for key, field in type(table).model_fields.items():
            if field_units(field):
                for control in _of_field(f"{section}.{i}.{key}", field, getattr(table, key), scenario, None):
                    yield replace(control, label=control.label.replace(f"{i}.", f"{name}: ", 1))


def _kinds(section: str, present: str) -> tuple[str, ...]:
    """Return the kinds of a section that ship, and that which it has."""
    family = families().get(f"{section}.kind")
    names = family.names() if isinstance(family, Family) else list(variants(section))
    return tuple(dict.fromkeys([*names, present])) if present else ()


def _of_field(key: str, field: FieldInfo, value: Any, scenario: Scenario, model: RobotModel | None) -> list[Control]:
    label, hint = key.partition(".")[2], field.description or ""
    unit = next(iter(field_units(field)), "").partition(" (")[0]

    def make(form: Form, *, of: str = label, index: int | None = None, unit: str = unit, **more: Any) -> Control:
        return Control(key, index, form, of, unit, hint, **more)

    names = next((one for one in field.metadata if isinstance(one, OneOf)), None)
    options = tuple(names.names()) if names else tuple(map(str, get_args(field.annotation)))
    if names or get_origin(field.annotation) is Literal:
        chosen = dict.fromkeys((*options, str(value)))
        return [make("choice", value=str(value), options=tuple(o for o in chosen if o != "auto"))]
    if isinstance(value, bool):
        return [make("flag", value=value)]
    if isinstance(value, float) and not math.isfinite(value):
        value = None  # what a key that is left out comes to, and no slider reaches
    if isinstance(value, int) and field.annotation is int:
        return [make("whole", value=value, low=0.0, high=float(max(3 * value, 10)), step=1.0)]
    if isinstance(value, float | int):
        return [make(**span(key, field, float(value), unit, scenario), value=float(value))]
    if isinstance(value, tuple) and value and all(isinstance(entry, float | int) for entry in value):
        of_joints, types = ((), ()) if model is None else (model.joint_names, model.joint_types)
        if model is not None and key == "start.q":
            of_joints, types = model.coordinate_names, model.coordinate_types
        by_joint = len(of_joints) == len(value) and key.partition(".")[0] not in NO_JOINTS
        counted = ("x", "y", "z") if len(value) == 3 else tuple(map(str, range(len(value))))
        entries = of_joints if by_joint else counted
        drives = [True] * len(value)
        if model is not None and by_joint and key.startswith("law."):
            drives = model.driven.tolist()  # a law moves no other joint
        known = {"prismatic": SLIDING.get(unit, unit), "quaternion": "1"}
        units = [known.get(kind, unit) for kind in types] if by_joint else [unit] * len(value)
        return [
            make(**span(key, field, float(value[k]), units[k], scenario, k, model), of=f"{label} {entries[k]}", index=k,
                 value=list(value), unit=units[k])
            for k in range(len(value)) if drives[k]
        ]  # fmt: skip
    return [make("text", value=value)]


def toml_text(value: Any) -> str:
    """Return a value as TOML has it, on one line; "" for one that is left out."""
    if value is None:
        return ""

    def within(entry: Any) -> str:
        return json.dumps(entry) if isinstance(entry, str) else toml_text(entry)

    if isinstance(value, tuple | list):
        return f"[{', '.join(map(within, value))}]"
    if isinstance(value, dict):
        return f"{{{', '.join(f'{key} = {within(entry)}' for key, entry in value.items())}}}"
    return value if isinstance(value, str) else str(value).lower() if isinstance(value, bool) else repr(value)


Row = dict[str, Any]

LAW, STIFFNESS, DAMPING, MORE = "law and force", "stiffness of the law", "damping of the law", "more of the law"
TIP, ALL_LINKS, LINKS = "friction", "all contacts of links", "contacts of links"
OUTSIDE = "forces from outside"
# Groups by the scenario's section; keys of the law are told apart by their names.
SECTIONS: dict[str, str] = {
    "force_profile": LAW, "compensation": "compensation", "model_error": "compensation",
    "belief": "compensation",
    "friction": TIP, "joint_friction": "friction of the joints",
    "surface": "surface", "surface_motion": "surface", "compliance": "surface", "impact": "surface",
    "contact": LINKS, "external_force": OUTSIDE,
    "reference": "path", "start": "start", "tool": "tool",
    "sensor": "sensors", "encoder": "sensors", "drives": "drives", "transmission": "drives",
    "stabiliser": "time and stabiliser", "time": "time and stabiliser",
}  # fmt: skip
ORDER = (LAW, STIFFNESS, DAMPING, MORE, ALL_LINKS, *dict.fromkeys(g for g in SECTIONS.values() if g != LAW))
# Groups that are open at first; contacts of links are if they have so few rows.
OPEN = (LAW, STIFFNESS, DAMPING, TIP, ALL_LINKS)
FEW = 20
# Keys of the law that mean something where it is a function.
OF_A_FUNCTION = ("law.kind", "law.force", "law.sample_period")


def group_of(key: str) -> str:
    """Return the group of a key."""
    section, _, name = key.partition(".")
    if name.startswith(ALL):
        return ALL_LINKS
    if section != "law":
        return SECTIONS.get(section, MORE)
    name = name.partition(".")[0]
    if name in ("kind", "force") or name.startswith("force_"):
        return LAW
    if name in ("kp", "stiffness") or name.endswith("stiffness"):
        return STIFFNESS
    if name in ("kd", "damping") or name.endswith(("damping", "damping_ratio")):
        return DAMPING
    return MORE


def all_controls(scenario: Scenario, model: RobotModel, law: str = "") -> dict[tuple[str, int | None], Control]:
    """Return every control of a scenario, by its key and the number of its entry.

    `law` is the name of a function that is the law in place of the scenario's, whose gains then mean nothing.
    """
    found = (control for section in LISTED for control in controls(scenario, section, model))
    absent = () if scenario.has_law else ("law.", "force_profile.")  # nothing is commanded
    there = {
        (control.key, control.index): control
        for control in found
        if control.key == "law.kind" or not control.key.startswith(absent)
    }
    if law:
        there = {at: c for at, c in there.items() if not at[0].startswith("law.") or at[0] in OF_A_FUNCTION}
        there["law.kind", None] = replace(there["law.kind", None], value=law, options=(law,))
    return there


def rows_in_groups(found: Iterable[Control], first: dict[tuple[str, int | None], Any], changes: Changes) -> list[Row]:
    """Return the groups that have controls, in order, each with its rows.

    `first`: the value with which each began, by key and number of the entry.
    """
    groups: dict[str, list[Row]] = {name: [] for name in ORDER}
    opened = set(OPEN)
    for control in found:
        groups[group_of(control.key)].append(_row(control, first, changes))
        if control.key == "surface.kind" and control.value == "none":  # the tip touches nothing
            opened.discard(TIP)
        # a law of the user's own: its gains have their own names
        if control.key == "law.kind" and ":" in control.value:
            opened.add(MORE)
    if len(groups[LINKS]) <= FEW:
        opened.add(LINKS)
    return [{"name": name, "open": name in opened, "rows": rows} for name, rows in groups.items() if rows]


def _row(control: Control, first: dict[tuple[str, int | None], Any], changes: Changes) -> Row:
    at = control.key, control.index
    began = first.get(at)
    name = control.key.partition(".")[2]
    return {
        "id": control.key if control.index is None else f"{control.key}#{control.index}",
        "key": control.key, "index": control.index, "name": name, "label": control.label.replace("_", " "),
        "form": control.form, "unit": control.unit, "hint": control.hint, "options": control.options,
        "low": control.low, "high": control.high, "step": control.step, "shown": control.shown,
        "own": control.own if control.form in ("linear", "log", "whole") else None,
        "first": toml_text(began), "changed": control.key in changes and control.own != began,
    }  # fmt: skip
