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

import inspect
from collections.abc import Iterator, Mapping
from functools import cache
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules
from typing import Any, ClassVar, Generic, TypeVar

from pydantic import ConfigDict, GetCoreSchemaHandler, TypeAdapter, ValidationInfo, model_validator
from pydantic_core import CoreSchema, PydanticCustomError, PydanticKnownError, core_schema

from closedloop.base.errors import ScenarioError
from closedloop.base.sections import Section
from robot_models.cached import cached_property
from robot_models.errors import shown

users: "dict[str, type[Member]]" = {}  # name -> class of every user's member that was named in this process


class Member:
    """Base of all members of families.

    `folder`: of a family's base class: the package whose modules are the members that ship.
    """

    folder: ClassVar[str] = ""

    @classmethod
    def member_name(cls) -> str:
        """Return the kind that picks this class: the name of its file, or of a user's class MODULE:CLASS."""
        package, _, file = cls.__module__.rpartition(".")
        return file if package == cls.folder else f"{cls.__module__}:{cls.__qualname__}"


OF_THIS_KIND = "_of_this_kind"  # the validator of `Parameters`, which looks at no key but `kind`


class Parameters(Member, Section):
    """A member with parameters: a section of the scenario, typed, frozen, with units and bounds."""

    kind: str = ""

    @model_validator(mode="before")
    @classmethod
    def _of_this_kind(cls, data: Any) -> Any:
        if not isinstance(data, dict):
            return data
        name = cls.member_name()
        if data.get("kind", name) != name:
            raise ValueError(f"kind = {shown(data['kind'])}: this is {name!r}")
        return {"kind": name} | data


@cache
def field_alone(section: type[Section], key: str) -> TypeAdapter[Any] | None:
    """Return what validates a key of a section by itself; None if the section looks at several keys at once."""
    said, fields = section.__pydantic_decorators__, section.model_fields
    looked_at = {each for validator in said.field_validators.values() for each in validator.info.fields}
    if not fields.keys().isdisjoint(looked_at) or not said.model_validators.keys() <= {OF_THIS_KIND}:
        return None
    return TypeAdapter(fields[key].rebuild_annotation(), config=ConfigDict(allow_inf_nan=False))


class Absent(Section):
    """A section of a run file whose `kind` is a user's class not named in this process: kept, and never run."""

    model_config = ConfigDict(extra="allow")
    kind: str

    def member_name(self) -> str:
        """Return the name of the class, MODULE:CLASS, as of a member that is there."""
        return self.kind


def users_named() -> tuple[str, ...]:
    """Return the names of all users' classes that were named in this process."""
    return tuple(users)


def is_users(member: Member | type[Member] | Absent) -> bool:
    """Whether a member is a user's class."""
    return ":" in member.member_name()


# Context of a validation: keep the section of a class that has not been named in this process, as `Absent`, unrun.
KEEP_ABSENT = "keep absent members"
NOT_NAMED = "not_named"


def not_named(name: str) -> PydanticCustomError:
    """Return the refusal of a user's class that only a file names; see `how_to_name`."""
    return PydanticCustomError(NOT_NAMED, "names a class", {"name": name})


def how_to_name(key: str, name: str) -> str:
    """Return, in words, why a file's `key` = `name` is refused, and what would be right."""
    return (
        "names a class of a user's own, and a file can make no code run: name it yourself, with "
        f'--{key} {name} on the command line or {{"{key}": "{name}"}} in Python'
    )


_POSITIONAL = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
_HOW = {staticmethod: "@staticmethod ", classmethod: "@classmethod "}


def _functions(base: type[Any]) -> Iterator[str]:
    """Return the names of the functions that a class of the package defines, itself or in a base of the package."""
    for name in dict.fromkeys(name for each in base.__mro__ if _is_ours(each) for name in vars(each)):
        made = inspect.getattr_static(base, name)
        if not name.startswith("_") and (isinstance(made, (staticmethod, classmethod)) or inspect.isfunction(made)):
            yield name


def _is_ours(each: type[Any]) -> bool:
    return each.__module__.partition(".")[0] == __name__.partition(".")[0]


def _fault(name: str, member: type[Any], base: type[Any]) -> str:
    """Return what is wrong with one function, "" if nothing: its kind, or how many arguments it takes by place."""
    owner = next((each for each in member.__mro__ if name in vars(each)), base)
    if _is_ours(owner):
        return ""
    given, wanted = inspect.getattr_static(member, name), inspect.getattr_static(base, name)
    right = f"{_HOW.get(type(wanted), '')}def {name}({', '.join(_names(wanted))})"
    if not isinstance(given, (staticmethod, classmethod)) and not callable(given):
        return f"{name} is not a function: must be {right}"
    here = _place(given)
    try:
        inspect.signature(_plain(given)).bind(*_names(wanted))
    except TypeError:
        return f"{here}{name}({', '.join(_names(given))}): must be {right}"
    except ValueError:  # a function of C, which does not say
        return ""
    static = isinstance(wanted, staticmethod)
    if static and not isinstance(given, staticmethod) and inspect.isfunction(given):
        return f"{here}{name}: must be {right}"
    return ""


def _plain(function: Any) -> Any:
    """Return the Python function of a method, or of what numba has made of one."""
    function = getattr(function, "__func__", function)
    return getattr(function, "py_func", function)


def _names(function: Any) -> list[str]:
    """Return the names of the arguments that are given by place."""
    parameters = inspect.signature(_plain(function)).parameters.values()
    return [each.name for each in parameters if each.kind in _POSITIONAL and each.default is each.empty]


def _place(function: Any) -> str:
    """Return "file:line: " of a function, "" if it has no file."""
    code = getattr(_plain(function), "__code__", None)
    return "" if code is None else f"{Path(code.co_filename).name}:{code.co_firstlineno}: "


M = TypeVar("M", bound=Member)


class Family(Mapping[str, type[M]], Generic[M]):
    """The members of a family by name: those of its folder, and of a user's classes those that were named.

    As an annotation of a key, ``reference: Annotated[Path, PATHS]``, it validates a section by its `kind`.

    `base`: what members are derived from; it has their folder.
    `usual`: the kind of a section that names none; without it a `kind` is required.
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

        Raises KeyError if there is none, or it is a user's class not named in this process.
        """
        if ":" in name:
            known: type[Member] = users[name]
            if not issubclass(known, self.base):
                raise KeyError(name)
            return known
        if name not in self._shipped:
            if name not in self._files:
                raise KeyError(name)
            module = import_module(f"{self.base.folder}.{name}")
            own = [
                each
                for each in vars(module).values()
                if isinstance(each, type) and issubclass(each, self.base) and each.__module__ == module.__name__
            ]
            if len(own) > 1:
                names = ", ".join(each.__name__ for each in own)
                raise TypeError(f"{module.__name__} holds {names}: a file has one member of {self.base.__name__}")
            found = own[0] if own else None
            if found is None:
                raise KeyError(name)
            self._shipped[name] = found
        return self._shipped[name]

    def __iter__(self) -> Iterator[str]:
        """Go through the names, those that ship first, in the order of the alphabet; imports all of them."""
        yield from self.names()
        yield from (name for name, each in list(users.items()) if issubclass(each, self.base))

    def names(self) -> list[str]:
        """Return the names of those that ship, in the order of the alphabet; imports all of them."""
        return [name for name in self._files if name in self]

    def __contains__(self, name: object) -> bool:
        if not isinstance(name, str) or (":" not in name and name not in self._files):
            return False
        return name in self._shipped or self.get(name) is not None

    def __len__(self) -> int:
        return sum(1 for _ in self)

    def __hash__(self) -> int:
        """Families are told apart by what they are, not by their members."""
        return id(self)

    def __eq__(self, other: object) -> bool:
        return self is other

    def named(self, value: Any, key: str) -> Any:
        """Take what the command line or Python gives for a kind; make a user's class known, and return its name.

        `value`: a name, MODULE:CLASS, or the class itself. What is none of them is returned as it is, for the
            validation.
        `key`: the key it was given for, for messages.
        Raises ScenarioError if there is no such module or class, the class is none of this family, or a function of it
            does not take the arguments that it will be given. What a user's module raises while it is imported is
            raised as it is.
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
            if faults := [fault for name in _functions(self.base) if (fault := _fault(name, value, self.base))]:
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


class OneOf:
    """The annotation of a key whose value is the name of a member without parameters, such as time.integrator.

    `families`: whose names it takes.
    `words`: what else it may say.
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
