"""[surface] kind = "implicit": φ(x, y, z) = 0 with φ a formula, whose derivatives are exact (`second_order`)."""

from typing import Annotated, Any

import numpy as np
from pydantic import Field, field_validator

from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError
from closedloop.jit.interpreted import interpreted
from closedloop.jit.parameters import AS_RESOLVED
from closedloop.mechanics.surface.expression import evaluate, instructions
from closedloop.mechanics.surface.surface import Coordinate, Placed

# Newton steps from `at` to the surface, and the step, of 1 m + |at|, after which it is there.
MOST_STEPS, THERE = 50, 1e-15
# Cosine of the angle between ∇φ and the normal at `at` below which the surface is not seen from above there.
UPRIGHT = 1e-6


class Implicit(Placed):
    """Any surface that a formula describes, in x, y and z along the two tangents and the normal."""

    expression: Annotated[str, AS_RESOLVED] = Field(
        description='φ(x, y, z), zero on the surface and positive off it, such as "x**2 + y**2 + (z/2)**2 - 0.04"; '
        "x, y and z in m along the two tangents and the normal"
    )
    at: tuple[Coordinate, Coordinate, Coordinate] = Field(
        (0.0, 0.0, 0.0),
        description="x, y and z of the point of the surface that `point` places, m; the nearest point of the surface "
        "if φ is not zero there",
    )

    @field_validator("expression")
    @classmethod
    def _is_a_formula(cls, value: str) -> str:
        instructions(value)
        return value

    def list_length(self) -> int:
        """Return the length of what `resolved` gives."""
        return len(instructions(self.expression))

    def resolved(self) -> dict[str, Any]:
        """Return, in place of the text, its instructions, and `at` on the surface.

        Raises ScenarioError if there is no surface next to `at`, or it has no normal there, or is seen from inside.
        """
        tape, at = instructions(self.expression), np.array(self.at)
        memory, gradient, hessian = np.array(tape), np.zeros(3), np.zeros((3, 3))
        given = f"surface.at = {list(self.at)}"
        for _ in range(MOST_STEPS):
            with np.errstate(all="ignore"):
                level = interpreted(evaluate)(memory, float(at[0]), float(at[1]), float(at[2]), gradient, hessian)
                size = np.linalg.norm(gradient)
                step = gradient * (-level / size**2)
            if not 0.0 < size < np.inf or not np.all(np.isfinite(step)):
                raise ScenarioError(
                    f"{given}: the gradient of surface.expression is zero or not finite at "
                    f"{(at + 0.0).round(6).tolist()}: name a point on the surface, or near it, where it has a normal"
                )
            at = at + step
            if np.max(np.abs(step)) <= THERE * (1.0 + np.max(np.abs(at))):
                break
        else:
            raise ScenarioError(f"{given}: no surface was found near it; name a point on the surface, or near it")
        if gradient[2] < UPRIGHT * size:
            raise ScenarioError(
                f"surface.expression: grows along {(gradient / size).round(6).tolist()} at {at.round(6).tolist()}, and "
                "must grow along the normal, [0, 0, 1], there: change its sign, or surface.at"
            )
        return {"expression": tape, "at": at}

    @staticmethod
    def level(p: Array, par: Any, gradient: Array, hessian: Array) -> float:
        """Return φ at p + at."""
        at = par.at
        return evaluate(par.expression, p[0] + at[0], p[1] + at[1], p[2] + at[2], gradient, hessian)
