"""The versions that a run depends on."""

from __future__ import annotations

import sys
from functools import cache
from importlib import metadata


def package_versions() -> dict[str, str]:
    """Return the versions of Python and of the packages whose arithmetic a run depends on."""
    names = ("closedloop", "pin", "numpy", "numba", "llvmlite")
    return {"python": sys.version.split()[0]} | {name: _version(name) for name in names}


@cache
def _version(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return "not installed"
