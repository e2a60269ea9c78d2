"""Other engines behind one small interface: one file each, and the one written map of its conventions in its docstring.

    from validation.engines import available, probe
    for engine in available(robot, "tip"):   # an Engine, a Missing or a Refused
        ...

Read `interface` first. A new engine is a subclass of `Engine` in a file of its own and a line in `registry.ENGINES`.
"""

from validation.engines.interface import (
    METHODS,
    CannotBuild,
    Engine,
    Missing,
    NotCovered,
    ProbeResult,
    Refused,
    installed,
    probe,
)
from validation.engines.registry import ENGINES, available

__all__ = [
    "ENGINES", "METHODS", "CannotBuild", "Engine", "Missing", "NotCovered", "ProbeResult", "Refused", "available",
    "installed", "probe",
]  # fmt: skip
