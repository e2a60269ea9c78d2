"""Elements of MJCF, whose attributes are numbers."""

from __future__ import annotations

from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import ArrayLike, NDArray

from closedloop.figures.scene.scene import quaternions


def element(into: ElementTree.Element, tag: str, **attributes: Any) -> ElementTree.Element:
    """Add an element; numbers have as many digits as tell them apart from all others, and None is left out."""
    text = {
        name: value if isinstance(value, str) else numbers(value)
        for name, value in attributes.items()
        if value is not None
    }
    return ElementTree.SubElement(into, tag, text)


def numbers(values: ArrayLike, digits: int = 17) -> str:
    """Return a number, or those of an array in their order, as text with so many digits."""
    return " ".join(repr(x) if digits > 16 or isinstance(x, int) else f"{x:.{digits}g}" for x in _listed(values))


def _listed(values: ArrayLike) -> list[Any]:
    return np.asarray(values).ravel().tolist()


def quaternion(axes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the unit quaternion (4,), the real part first, of a rotation matrix (3, 3)."""
    return quaternions(np.asarray(axes)[None])[0]
