"""[surface] kind = "polyhedron": a convex body with flat faces and rounded edges, touched from outside.

With gᵢ = nᵢ·p − dᵢ the distance from face i and s the rounding

    φ = max gᵢ + s log Σ exp((gᵢ − max gᵢ)/s),  ∇φ = Σ wᵢ nᵢ,  ∇∇φ = (Σ wᵢ nᵢ nᵢᵀ − ∇φ ∇φᵀ)/s,  Σ wᵢ = 1

so a face is flat, but for exp(−a/s) at the distance a from an edge. An edge at which the normals turn by 2 α has the
radius s cos α/sin² α, which is 1.4 s at 90 degrees.

Source: S. Boyd and L. Vandenberghe, Convex Optimization, 2004, section 3.1.5 (the log-sum-exp function).
"""

import math
from typing import Annotated, Any

import numpy as np
from pydantic import Field, field_validator

from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError
from closedloop.base.sections import LENGTH, PLACE, Number, Positive
from closedloop.mechanics.surface.surface import Placed

# Roundings from the origin to the other faces: φ there is e⁻²⁰ roundings.
CLEAR = 20


class Polyhedron(Placed):
    """The intersection of half spaces: z ≤ 0, with the surface's origin on this face, and those of `faces`."""

    faces: tuple[tuple[Number, Number, Number, Annotated[Number, PLACE]], ...] = Field(
        description="the other faces: lists [nx, ny, nz, d] of a normal out of the body, of any length, and d, m, "
        "with n·p = d on the face; x, y, z are along the two tangents and the normal"
    )
    oversize: Annotated[Number, PLACE] = Field(
        0.0, description="by how much the other faces lie further out than `faces` says, m"
    )
    rounding: Annotated[Positive, LENGTH] = Field(
        0.0001, description="s by which edges are rounded, m: the radius of one of 90 degrees is 1.4 s"
    )

    @field_validator("faces")
    @classmethod
    def _have_normals(cls, value: tuple[tuple[float, float, float, float], ...]) -> Any:
        for face in value:
            if not 0.0 < math.hypot(*face[:3]) < math.inf:
                raise ValueError(f"{list(face)}: its normal must not be zero")
        return value

    def list_length(self) -> int:
        """Return the length of what `resolved` gives."""
        return 4 * (1 + len(self.faces))

    def resolved(self) -> dict[str, Any]:
        """Return all faces with unit normals, that at z = 0 first.

        Raises ScenarioError if an edge is so near to the origin that the surface does not go through it.
        """
        faces = np.array(self.faces).reshape(-1, 4)
        faces = faces / np.linalg.norm(faces[:, :3], axis=1)[:, None]
        for face, outside in zip(self.faces, faces[:, 3] + self.oversize, strict=True):
            if outside < CLEAR * self.rounding:
                raise ScenarioError(
                    f"surface.faces: {list(face)}: is {outside:g} m outside the origin: must be "
                    f"{CLEAR * self.rounding:g} m, {CLEAR} times the rounding, or more"
                )
        return {"faces": (0.0, 0.0, 1.0, 0.0, *faces.ravel())}

    @staticmethod
    def level(p: Array, par: Any, gradient: Array, hessian: Array) -> float:
        """Return φ."""
        faces, s, out = par.faces, par.rounding, par.oversize
        most = p[2]
        for i in range(4, faces.shape[0], 4):
            most = max(most, faces[i] * p[0] + faces[i + 1] * p[1] + faces[i + 2] * p[2] - faces[i + 3] - out)
        total = 0.0
        for i in range(0, faces.shape[0], 4):
            g = faces[i] * p[0] + faces[i + 1] * p[1] + faces[i + 2] * p[2] - faces[i + 3] - (out if i > 0 else 0.0)
            w = math.exp((g - most) / s)
            total += w
            for j in range(3):
                gradient[j] += w * faces[i + j]
                for k in range(3):
                    hessian[j, k] += w * faces[i + j] * faces[i + k]
        for j in range(3):
            gradient[j] /= total
        for j in range(3):
            for k in range(3):
                hessian[j, k] = (hessian[j, k] / total - gradient[j] * gradient[k]) / s
        return float(most + s * math.log(total))
