"""A key whose value is the name of a member, without parameters."""

from __future__ import annotations

from typing import Any

from pydantic import GetCoreSchemaHandler, ValidationInfo
from pydantic_core import CoreSchema, PydanticKnownError, core_schema

from closedloop.base.families.family import Family
from closedloop.base.families.member import Member
from closedloop.base.families.refusal import KEEP_ABSENT, not_named


class OneOf:
    """The annotation of a key whose value is the name of a member without parameters, such as time.integrator.

    Parameters
    ----------
    families : Family
        Whose names it takes.
    words : tuple of str
        What else it may say.
    """

    def __init__(self, *families: Family[Any], words: tuple[str, ...] = ()) -> None:
        self.families, self.words = families, words

    def names(self) -> list[str]:
        """Return all that the key may say, without the users' classes that happen to be known in this process."""
        return [*self.words, *(name for family in self.families for name in family.names())]

    def named(self, value: Any, key: str) -> Any:
        """See `Family.named`; a user's class is of the first family."""
        return self.families[0].named(value, key)

    def get(self, name: str) -> type[Member] | None:
        """Return the member with this name, None if there is none."""
        return next((family[name] for family in self.families if name in family), None)

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        """Validate a name."""
        return core_schema.with_info_plain_validator_function(self._validate)

    def _validate(self, value: Any, info: ValidationInfo) -> str:
        if isinstance(value, type):
            value = self.named(value, "value")  # built in Python
        if isinstance(value, str) and (value in self.words or any(value in family for family in self.families)):
            return value
        if isinstance(value, str) and ":" in value:
            if (info.context or {}).get(KEEP_ABSENT):
                return value
            raise not_named(value)
        *most, last = map(repr, self.names())
        raise PydanticKnownError("literal_error", {"expected": f"{', '.join(most)} or {last}"})
