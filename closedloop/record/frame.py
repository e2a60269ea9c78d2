"""A run as named columns with units, for pandas and xarray, and the difference of two."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from numpy.typing import NDArray

from closedloop.base.errors import needs
from closedloop.record.columns.derived import WRENCH
from closedloop.scenario.tables import tangents_of

if TYPE_CHECKING:
    import pandas


# Characters of a key's two values that are shown.
MOST_SHOWN = 200


def difference(
    keys: Sequence[str], names: Mapping[str, str], found: Mapping[str, Any], question: Mapping[str, Any]
) -> str:
    """Return how inputs differ: of two scenarios the first key that does, with its values, else what differs.

    `names`: what they are called.
    `found`, `question`: the inputs there and those asked for; "scenario" is TOML text.
    """
    different = dict.fromkeys(names.get(key, key) for key in keys)
    if "scenario" in different:
        try:
            there, here = (_flat(tomllib.loads(str(text["scenario"]))) for text in (found, question))
        except (KeyError, ValueError, RecursionError):
            there = here = {}
        changed = [key for key in there | here if there.get(key) != here.get(key)]
        if changed:
            key, more = changed[0], len(changed) - 1
            different.pop("scenario")
            told = f"{key} is {there.get(key, 'not set')} there and {here.get(key, 'not set')} here"
            different = {told[:MOST_SHOWN] + (f", {more} more keys differ" if more else ""): None} | different
    named = [name if " is " in name else f"the {name} differs" for name in different]
    return ", ".join(named)


def _flat(table: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in table.items():
        flat |= _flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {prefix + key: value}
    return flat


AXES = ("x", "y", "z")


def part_labels(
    joints: tuple[str, ...], coordinates: tuple[str, ...], contacts: tuple[str, ...]
) -> dict[str, tuple[str, ...]]:
    """Return what the parts of a column are called, by the dimension that they are along."""
    return {
        "joint": joints, "coordinate": coordinates, "axis": AXES, "component": WRENCH,
        "contact": contacts, "contact_tangent": tangents_of(contacts),
    }  # fmt: skip


def data_frame(
    columns: Mapping[str, NDArray[Any]], dims: Mapping[str, tuple[str, ...]], joints: tuple[str, ...],
    coordinates: tuple[str, ...], contacts: tuple[str, ...], units: Callable[[str], str],
) -> pandas.DataFrame:  # fmt: skip
    """Return columns over time as a DataFrame, one for each component, its index the time, s.

    `columns`: columns (N,) or (N, k) by their names, "time" among them.
    `dims`: dimensions of each: ("time",), ("time", "joint"), ("time", "axis") or ("time", "component").
    """
    needs("pandas")
    import pandas

    parts: dict[str, NDArray[Any]] = {}
    of: dict[str, str] = {}
    labels_of_parts = part_labels(joints, coordinates, contacts)
    for name, dimensions in dims.items():
        if name == "time":
            continue
        values, labels = columns[name], labels_of_parts.get(dimensions[-1], ())
        if not labels and values.ndim == 2:  # a column of one's own
            labels = tuple(map(str, range(1, values.shape[1] + 1)))
        for k, label in enumerate(labels):
            parts[f"{name}[{label}]"], of[f"{name}[{label}]"] = values[:, k], units(name)
        if not labels:
            parts[name], of[name] = values, units(name)
    frame = pandas.DataFrame(parts, index=pandas.Index(columns["time"], name="time"))
    frame.attrs["units"] = of | {"time": units("time")}
    return frame
