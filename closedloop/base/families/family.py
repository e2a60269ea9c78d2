"""A family: its members by name, and the validation of a section by its `kind`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from importlib import import_module
from pkgutil import iter_modules
from typing import Any, Generic, TypeVar

from pydantic import GetCoreSchemaHandler, ValidationInfo
from pydantic_core import CoreSchema, PydanticKnownError, core_schema

from closedloop.base.errors import ScenarioError
from closedloop.base.families.member import Absent, Member, users
from closedloop.base.families.refusal import KEEP_ABSENT, not_named
from closedloop.base.families.signatures import signature_faults
from closedloop.base.sections import Section
from robot_models.cached import cached_property
from robot_models.errors import shown

M = TypeVar("M", bound=Member)


class Family(Mapping[str, type[M]], Generic[M]):
    """The members of a family by name: those of its folder, and of a user's classes those that were named.

    As an annotation of a key, ``reference: Annotated[Path, PATHS]``, it validates a section by its `kind`.

    Parameters
    ----------
    base : type
        What members are derived from; it has their folder.
    usual : str, optional
        The kind of a section that names none; without it a `kind` is required.
    """

    def __init__(self, base: type[M], usual: str | None = None) -> None:
        self.base, self.usual = base, usual
        self._shipped: dict[str, type[M]] = {}  # those imported so far

    @cached_property
    def _files(self) -> tuple[str, ...]:
        """The names of the folder's modules, in the order of the alphabet."""
        return tuple(sorted(module.name for module in iter_modules(import_module(self.base.folder).__path__)))

    def __getitem__(self, name: str) -> type[M]:
        """Return the member with this name.

        Raises
        ------
        KeyError
            If there is none, or it is a user's class not named in this process.
        """
        if ":" in name:
            known: type[Member] = users[name]
            if not issubclass(known, self.base):
                raise KeyError(name)
            return known
        if name not in self._shipped:
            if name not in self._files:
                raise KeyError(name)
            found = self._in_module(import_module(f"{self.base.folder}.{name}"))
            if found is None:
                raise KeyError(name)
            self._shipped[name] = found
        return self._shipped[name]

    def _in_module(self, module: Any) -> type[M] | None:
        """Return the class that is this family's in a file of the folder, None if it has none."""
        own = [
            each
            for each in vars(module).values()
            if isinstance(each, type) and issubclass(each, self.base) and each.__module__ == module.__name__
        ]
        if len(own) > 1:
            names = ", ".join(each.__name__ for each in own)
            raise TypeError(f"{module.__name__} holds {names}: a file has one member of {self.base.__name__}")
        return own[0] if own else None

    def __iter__(self) -> Iterator[str]:
        """Go through the names, those that ship first, in the order of the alphabet; imports all of them."""
        yield from self.names()
        yield from (name for name, each in list(users.items()) if issubclass(each, self.base))

    def names(self) -> list[str]:
        """Return the names of those that ship, in the order of the alphabet; imports all of them."""
        return [name for name in self._files if name in self]

    def __contains__(self, name: object) -> bool:
        """Whether there is a member with this name."""
        return isinstance(name, str) and self.get(name) is not None

    def __len__(self) -> int:
        """Return how many there are."""
        return sum(1 for _ in self)

    def __hash__(self) -> int:
        """Families are told apart by what they are, not by their members."""
        return id(self)

    def __eq__(self, other: object) -> bool:
        """Whether it is this very family."""
        return self is other

    def named(self, value: Any, key: str) -> Any:
        """Take what the command line or Python gives for a kind; make a user's class known, and return its name.

        Parameters
        ----------
        value : str, type or other
            A name, MODULE:CLASS, or the class itself. What is none of them is returned as it is, for the validation.
        key : str
            The key it was given for, for messages.

        Raises
        ------
        ScenarioError
            If there is no such module or class, the class is none of this family, or a function of it does not take
            the arguments that it will be given. What a user's module raises
            while it is imported is raised as it is.
        """
        if isinstance(value, str) and ":" in value:
            value = self._imported(value, key)
        if not isinstance(value, type):
            return value
        if not issubclass(value, self.base) or value is self.base:
            raise ScenarioError(
                f"{key} = {value.__module__}:{value.__qualname__}: must be a class derived from "
                f"{self.base.__module__}.{self.base.__name__}"
            )
        if lacking := sorted(getattr(value, "__abstractmethods__", ())):
            raise ScenarioError(f"{key} = {value.__module__}:{value.__qualname__}: must define {', '.join(lacking)}")
        name = value.member_name()
        if ":" in name and users.get(name) is not value:
            if faults := signature_faults(value, self.base):
                raise ScenarioError(*(f"{key} = {name}: {fault}" for fault in faults))
            users[name] = value
        return name

    def _imported(self, name: str, key: str) -> Any:
        module, _, attribute = name.partition(":")
        if not (attribute.isidentifier() and all(part.isidentifier() for part in module.split("."))):
            if name in users:
                return users[name]  # a class made inside a function: it cannot be imported, but it was named itself
            raise ScenarioError(f"{key} = {shown(name)}: a class of your own is named MODULE:CLASS")
        try:
            found = getattr(import_module(module), attribute, None)
        except ModuleNotFoundError as error:
            if f"{module}.".startswith(f"{error.name}."):
                raise ScenarioError(f"{key} = {shown(name)}: there is no module '{module}'") from None
            raise
        if not isinstance(found, type):
            raise ScenarioError(f"{key} = {shown(name)}: '{module}' has no class '{attribute}'")
        return found

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        """Validate a section: its class by its `kind`, then what it says by its class."""
        return core_schema.with_info_plain_validator_function(self._validate)

    def _validate(self, value: Any, info: ValidationInfo) -> Any:
        if isinstance(value, self.base):
            self.named(type(value), "kind")  # built in Python
            return value
        if isinstance(value, Absent):
            return value
        if not isinstance(value, dict):
            raise PydanticKnownError("model_attributes_type")
        if "kind" not in value and self.usual is None:
            raise PydanticKnownError("union_tag_not_found", {"discriminator": "'kind'"})
        kind = value.get("kind", self.usual)
        member = self.get(kind) if isinstance(kind, str) else None
        if member is None and isinstance(kind, str) and ":" in kind:
            if (info.context or {}).get(KEEP_ABSENT):
                return Absent.model_validate(value)
            raise not_named(kind)
        if member is None or not issubclass(member, Section):
            expected = ", ".join(map(repr, self.names()))
            tag = {"discriminator": "'kind'", "tag": str(kind), "expected_tags": expected}
            raise PydanticKnownError("union_tag_invalid", tag)
        return member.model_validate(value, context=info.context)
