"""What the parts of the lab need of the whole."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Protocol

from closedloop.figures.scene.solids import Ghost
from closedloop.lab.answers import Answer, Answers
from closedloop.lab.controls import Control
from closedloop.lab.drawn import Message
from closedloop.lab.history import History, Pins
from closedloop.lab.server import Client


class Lab(Protocol):
    """A lab, as far as a part of it is concerned; see `closedloop.lab.app.Lab`."""

    history: History
    answers: Answers
    answer: Answer | None
    pins: Pins
    folder: Path | None
    clients: list[Client]
    front: bool
    ghosts: tuple[Ghost, ...]
    controls: dict[tuple[str, int | None], Control]
    details: Any
    map: Any

    def changed(self, key: str, value: Any) -> None:
        """Take a change of a key, and run the scenario with it."""

    def first_value(self, key: str, index: int | None) -> Any:
        """Return the value with which a key, or an entry of its list, began."""

    def open(self, name: str) -> None:
        """Go over to another scenario that ships."""

    def refresh(self) -> None:
        """Let all controls show the scenario as it is now."""

    def ask(self, key: str = "") -> None:
        """Run the scenario as it is now."""

    def command(self, answer: Answer) -> str:
        """Return the command line that repeats the run of an answer."""

    def tell(self, slot: str, message: Message, keep: bool = True) -> None:
        """Send a message to every page."""

    def forget(self, *slots: str) -> None:
        """Do not send these to pages that open later."""

    def wait_for_plots(self, seconds: float = 60.0) -> bool:
        """Wait until the curves of the newest change have been sent; return whether they have."""

    def computes(self) -> bool:
        """Whether a run is being computed, or waits for it."""

    def tell_controls(self, forced: bool = False) -> None:
        """Send the controls as they are."""

    def show_again(self, client: Client) -> None:
        """Send the run to one page again."""

    def show_gallery(self, client: Client, front: bool = False) -> None:
        """Send one page the scenarios that ship."""
