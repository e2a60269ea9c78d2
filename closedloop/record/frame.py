"""The columns of a run over time as a pandas DataFrame."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from numpy.typing import NDArray

from closedloop.base.optional import needs
from closedloop.record.columns.derived import WRENCH
from closedloop.scenario.contact_names import tangents_of

if TYPE_CHECKING:
    import pandas

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

    Parameters
    ----------
    columns : mapping of str to array
        Columns (N,) or (N, k) by their names, "time" among them.
    dims : mapping of str to tuple of str
        Dimensions of each: ("time",), ("time", "joint"), ("time", "axis") or ("time", "component").
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
