"""Short chains and a tree of the Rigid Body Dynamics Library (RBDL), with the accelerations that its tests expect.

All bodies weigh 1 kg, gravity is along −y, and everything falls from rest. The values for the model of three joints
were computed with Featherstone's spatial_v1, RBDL's tests say.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from validation.anchors.description import joint, link, read, robot
from validation.anchors.problem import Case, ReferenceProblem

TOLERANCE = 1e-13
ARGUMENT = (
    "RBDL's own bound for these values, 1e-13 absolute and relative; they are printed to 15 digits and H is well "
    "conditioned (below 60)"
)
AXIS = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


def problems() -> tuple[ReferenceProblem, ...]:
    """Return one problem for each of the chains."""
    data = read("rbdl_chains")
    return tuple(_problem(chain, data["source"], data["gravity"]) for chain in data["chains"])


def _problem(chain: Mapping[str, Any], source: str, gravity: list[float]) -> ReferenceProblem:
    parts, names = [link("base")], []
    for i, body in enumerate(chain["bodies"]):
        before = "base" if body["parent"] == 0 else f"body{body['parent']}"
        names.append(f"joint{i + 1}")
        parts += [
            link(f"body{i + 1}", body["mass"], body["com"], body["I_com"]),
            joint(names[-1], "revolute", before, f"body{i + 1}", xyz=body["at"], axis=AXIS[body["axis"]]),
        ]
    n, tip = len(names), f"body{len(names)}"
    expected = np.array(chain["acceleration"], dtype=float)
    inputs = {"q": chain["q"], "v": np.zeros(n), "torque": np.zeros(n)}
    tolerance = TOLERANCE * (1.0 + np.abs(expected))
    case = Case("acceleration from rest", "forward_dynamics", inputs, expected, tolerance, ARGUMENT)
    model = robot(chain["name"].replace(" ", "_"), parts, names, tip, gravity=gravity)
    return ReferenceProblem(f"RBDL, {chain['name']}", source, model, tip, (case,))
