"""Families of plug-ins: paths, integrators, control laws, laws of friction ... A member of a family is one file.

    class Circle(Path):                        closedloop/control/reference/paths/circle.py: the kind "circle"
        radius: Annotated[Positive, LENGTH] = Field(description="radius of the circle, m")
        def tip_path(self, origin, normal): ...

A family has a base class, which says what all members share: a folder, the functions and their signature. A file of
that folder holds one member, a class derived from the base, and the file's name is the member's `kind`: there is no
list of members, and nothing else to edit when one is added. A file is imported when its kind is first asked for, or
when all members are listed. Two families may share a folder (a law of friction for a surface and one for joints): a
file then has a class of either.

A user's class is a member like any other, with the name MODULE:CLASS. It is known in a process once the command line or
Python has *named* it (`Family.named`): as that text, as the class, or by an instance inside a `Scenario`. A file is
data and can make no code run, so a name that stands in a file alone is refused (`not_named`), and nothing is imported.
"""

from closedloop.base.families.family import (
    KEEP_ABSENT,
    NOT_NAMED,
    Absent,
    Family,
    Member,
    OneOf,
    Parameters,
    how_to_name,
    is_users,
    not_named,
    users_named,
)

__all__ = [
    "KEEP_ABSENT",
    "NOT_NAMED",
    "Absent",
    "Family",
    "Member",
    "OneOf",
    "Parameters",
    "how_to_name",
    "is_users",
    "not_named",
    "users_named",
]
