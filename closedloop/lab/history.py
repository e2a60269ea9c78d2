"""What was changed in the lab, step by step: the keys of a scenario that differ from where it began.

history = History(scenario, "wam_slide")
history.change("law.force", 12.0)
history.command()                   # closedloop wam_slide --law.force 12.0
"""

from __future__ import annotations

import shlex
import time as clock
from collections.abc import Callable, Mapping
from typing import Any

from closedloop.base.errors import ScenarioError
from closedloop.lab.controls import toml_text
from closedloop.scenario.load import load_scenario
from closedloop.scenario.messages import variant_keys
from closedloop.scenario.overrides import Variants
from closedloop.scenario.scenario import Scenario, families
from closedloop.scenario.tables import ALL

Changes = dict[str, Any]  # dotted key to value, as `load_scenario` takes them
# Changes of one key that follow each other so fast, s, are one step of undo: a slider that is dragged.
TOGETHER = 1.0
# The file that `closedloop.lab.keeping.save` writes.
IN_A_FILE = "scenario.toml"
# Steps that can be undone.
MOST_STEPS = 500


class History:
    """The changes of a scenario, with undo and redo.

    Parameters
    ----------
    base : Scenario
        Where it began.
    name : str
        The scenario as the command line takes it: a shipped name, a file.
    given : mapping
        The overrides that `base` was read with, beside the name.
    words : str
        More words of the command line, such as ``--law my_laws:soft``.
    now : callable
        The time, s.
    """

    def __init__(
        self, base: Scenario, name: str, given: Mapping[str, Any] | None = None, words: str = "",
        now: Callable[[], float] = clock.monotonic,
    ) -> None:  # fmt: skip
        self.base, self.name, self.given, self.words = base, name, dict(given or {}), words
        self._past: list[Changes] = []
        self._future: list[Changes] = []
        self._now, self._last_key, self._last_time = now, "", -TOGETHER
        self.changes: Changes = {}

    def change(self, key: str, value: Any, more: Mapping[str, Any] | None = None) -> Changes:
        """Change a key, None: back to where it began, and with it `more`, and return all changes."""
        now = self._now()
        if key != self._last_key or now - self._last_time > TOGETHER:
            self._past = [*self._past[-MOST_STEPS:], self.changes]
        self._last_key, self._last_time, self._future = key, now, []
        for each, its_value in {key: value, **(more or {})}.items():
            self.changes = with_change(self.changes, each, its_value)
        return self.changes

    def set_all(self, changes: Changes) -> Changes:
        """Take over other changes, as one step, and return them."""
        self._past, self._future, self._last_key = [*self._past[-MOST_STEPS:], self.changes], [], ""
        self.changes = dict(changes)
        return self.changes

    @property
    def can_undo(self) -> bool:
        """Whether there is a step back."""
        return bool(self._past)

    @property
    def can_redo(self) -> bool:
        """Whether there is a step forward."""
        return bool(self._future)

    def undo(self) -> bool:
        """Go a step back; return whether there was one."""
        return self._move(self._past, self._future)

    def redo(self) -> bool:
        """Go a step forward again; return whether there was one."""
        return self._move(self._future, self._past)

    def _move(self, source: list[Changes], other: list[Changes]) -> bool:
        self._last_key = ""
        if not source:
            return False
        other.append(self.changes)
        self.changes = source.pop()
        return True

    def scenario(self, changes: Changes | None = None) -> Scenario:
        """Return the scenario with these changes, those of now if left out."""
        changes = self.changes if changes is None else changes
        return Variants(self.base, tuple(changes)).scenario(tuple(changes.values())) if changes else self.base

    def command(self, changes: Changes | None = None, engine: str = "compiled") -> str:
        """Return the command line that repeats a run with these changes, those of now if left out."""
        merged = dict(self.given)
        for key, value in (self.changes if changes is None else changes).items():
            merged = with_change(merged, key, value)
        words = ["closedloop", self.name, *(w for k, v in merged.items() for w in (f"--{k}", toml_text(v)))]
        return " ".join([*map(quoted, words), *([self.words] if self.words else []), "--engine", engine])


def quoted(word: str) -> str:
    """Return a word as a shell reads it, on one line; with line breaks in it as bash, zsh and POSIX 2024 spell them."""
    if word.isprintable():
        return shlex.quote(word)
    plain = word.replace("\\", "\\\\").replace("'", "\\'")
    return "$'" + "".join(c if c.isprintable() else _octal(c) for c in plain) + "'"


def _octal(c: str) -> str:
    return "".join(f"\\{byte:03o}" for byte in c.encode("utf-8", "surrogateescape"))


def in_words(scenario: Scenario) -> tuple[str, Changes]:
    """Return how the command line names a scenario that was made in Python: a name, and the keys to override.

    That is the shipped scenario of this name with what differs from it; where nothing on a command line gives it, a
    file of this name, which `save` writes.
    """
    own = scenario.model_dump(mode="python")
    given: Changes = {}
    try:
        begun = load_scenario(scenario.name).model_dump(mode="python")
        for section, keys in own.items():
            other = begun.get(section)
            if isinstance(keys, dict) and isinstance(other, dict) and keys.get("kind") == other.get("kind"):
                given |= {f"{section}.{key}": value for key, value in keys.items() if value != other.get(key)}
            elif isinstance(keys, dict):
                given |= {f"{section}.{key}": value for key, value in keys.items() if value is not None}
        if load_scenario(scenario.name, given) == scenario:
            return scenario.name, given
    except ScenarioError:
        pass
    return IN_A_FILE, {}


def with_change(changes: Changes, key: str, value: Any) -> Changes:
    """Return changes with one more: kinds first, and without what another kind does not know; None takes it back."""
    section, _, name = key.partition(".")
    merged = {k: v for k, v in changes.items() if k != key}
    if f".{ALL}." in key:  # of all tables of a list: what one of them was set to would win
        before, after = key.split(ALL)
        merged = {k: v for k, v in merged.items() if not (k.startswith(before) and k.endswith(after))}
    if name == "kind":
        known = variant_keys(section, value) if value is not None else set()
        merged = {k: v for k, v in merged.items() if not k.startswith(f"{section}.") or k.partition(".")[2] in known}
    if value is None:
        return merged
    if key in families() or name == "kind":
        return {key: value} | merged
    return merged | {key: value}
