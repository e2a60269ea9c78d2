"""The controls of a scenario as the page shows them: rows with their spans and values, in groups by what they mean."""

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

from closedloop.lab.controls import TABS, Control, controls, toml_text
from closedloop.lab.history import Changes
from closedloop.scenario.scenario import Scenario
from closedloop.scenario.tables import ALL
from robot_models import RobotModel

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
    sections = (section for tab in TABS.values() for section in tab)
    found = (control for section in sections for control in controls(scenario, section, model))
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

    Parameters
    ----------
    first : dict
        The value with which each began, by key and number of the entry.
    """
    groups: dict[str, list[Row]] = {name: [] for name in ORDER}
    opened = set(OPEN)
    for control in found:
        groups[group_of(control.key)].append(_row(control, first, changes))
        if control.key == "surface.kind" and control.value == "none":  # the tip touches nothing
            opened.discard(TIP)
        if (
            control.key == "law.kind" and ":" in control.value
        ):  # a law of the user's own: its gains have their own names
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
