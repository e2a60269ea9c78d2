"""A tool on the tip, or a load in it: where its own tip is, and its mass."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from robot_models.errors import ModelError

if TYPE_CHECKING:
    import pinocchio as pin

Vector = NDArray[np.float64]


@dataclass(frozen=True)
class Tool:
    """A rigid body fixed to a frame of the robot; all vectors in the axes of that frame.

    Attributes
    ----------
    frame : str
        The frame it is fixed to. Mounted, the frame's origin is the tool's tip.
    offset : (3,) tuple
        The tool's tip, m.
    mass : float
        kg.
    centre : (3,) tuple
        Centre of mass, m.
    inertia : (6,) tuple
        Tensor about the centre of mass, kg m²: xx, yy, zz, xy, xz, yz.
    """

    frame: str
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    mass: float = 0.0
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)
    inertia: tuple[float, float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)

    def tensor(self) -> Vector:
        """Return the tensor (3, 3).

        Raises `ModelError` if no body has such a tensor: its principal moments must be >= 0, and none may exceed the
        sum of the other two.
        """
        xx, yy, zz, xy, xz, yz = self.inertia
        tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        if not any(self.inertia):
            return tensor
        low, middle, high = np.linalg.eigvalsh(tensor)
        slack = 1e-9 * max(abs(high), abs(low))
        if low < -slack or high > low + middle + slack:
            raise ModelError(
                f"the tool's tensor has principal moments {low:.4g}, {middle:.4g}, {high:.4g} kg m²: none may be "
                "negative, or larger than the other two together"
            )
        return tensor

    def mount(self, model: "pin.Model") -> None:
        """Fix the tool to its frame in a Pinocchio model, which is modified."""
        import pinocchio as pin

        index = model.getFrameId(self.frame)
        frame = model.frames[index]
        body = pin.Inertia(self.mass, np.array(self.centre), self.tensor())
        model.appendBodyToJoint(frame.parentJoint, body, frame.placement)
        model.frames[index].placement = frame.placement * pin.SE3(np.eye(3), np.array(self.offset))


def carried_by(tools: "tuple[Tool, ...]", frame: str) -> "tuple[pin.Inertia, Vector]":
    """Return the inertia of all bodies fixed to a frame, in its axes and about its origin, and the tip (3,), m, in it.

    Each body but the first is fixed to the tip of the one before it, as `Tool.mount` does it.
    """
    import pinocchio as pin

    carried, tip = pin.Inertia.Zero(), np.zeros(3)
    for tool in tools:
        if tool.frame == frame:
            body = pin.Inertia(tool.mass, np.array(tool.centre), tool.tensor())
            carried = carried + pin.SE3(np.eye(3), tip).act(body)
            tip = tip + np.array(tool.offset)
    return carried, tip
