"""What every law of restitution is: of what the coefficient is the ratio, and how large it is at this impact.

    class Viscous(Restitution):
        ratio_of = "energies"

        @staticmethod
        def coefficient(restitution, speed):
            return restitution / (1.0 + speed / 2.0)

What the three ratios share, the path of an impact in impulses, is in `closedloop.mechanics.impact.phases`. The
functions are called once for each impact, by Python.
"""

from __future__ import annotations

from typing import ClassVar, Literal

from closedloop.base.errors import ScenarioError
from closedloop.base.families import Family, Member
from closedloop.jit.user_code import of_users


class Restitution(Member):
    """A law of restitution. Those that ship are in `closedloop.mechanics.impact.laws`, one file each.

    Attributes
    ----------
    ratio_of : str
        Of what the coefficient is the ratio, after to before: "velocities" along the normal; "impulses" of
        decompression to compression; "energies", the work of the normal impulse, whose ratio is its square.
    """

    folder: ClassVar[str] = "closedloop.mechanics.impact.laws"
    ratio_of: ClassVar[Literal["velocities", "impulses", "energies"]] = "energies"

    @staticmethod
    def coefficient(restitution: float, speed: float) -> float:
        """Return ε of an impact at this speed along the normal, m/s, from `impact.restitution`; 0 to 1."""
        return restitution


RESTITUTIONS = Family(Restitution)


def coefficient_at(law: type[Restitution], restitution: float, speed: float, key: str = "impact.law") -> float:
    """Return ε of an impact at a speed along the normal, m/s; `key` is what names the law, for messages.

    Raises
    ------
    ScenarioError
        If a user's law gives none from 0 to 1.
    """
    with of_users(law, key):
        given = float(law.coefficient(restitution, speed))
        if not 0.0 <= given <= 1.0:
            raise ScenarioError(
                f"{key} = {law.member_name()}: its coefficient at {speed:g} m/s is {given:g}: must be from 0 to 1"
            )
        return given
