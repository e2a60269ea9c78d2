"""[law] kind = "none": no torque, so that gravity and what touches the bodies move them."""

from typing import Any, ClassVar

from pydantic import Field

from closedloop.base.arrays import Array
from closedloop.base.sections import Nothing
from closedloop.control.law import ControlLaw, LawInput


class NoLaw(ControlLaw):
    """[law] kind = "none": no torque on any joint, Q = 0."""

    states: ClassVar[tuple[str, ...]] = ()

    force: Nothing = Field(0.0, description="left out: nothing presses")
    force_feedback: Nothing = Field(0.0, description="left out: nothing is controlled")
    force_integral: Nothing = Field(0.0, description="left out: nothing is controlled")

    @staticmethod
    def torque(x: LawInput, par: Any, z: Any, torque: Array) -> None:
        """Write zeros."""
        for j in range(torque.shape[0]):
            torque[j] = 0.0

    @staticmethod
    def rates(x: LawInput, par: Any, z: Any, f: float, torque: Array, dz: Any) -> None:
        """Write nothing: it has no states."""
