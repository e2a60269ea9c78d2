"""The tab "keep" of the lab: undo and redo, pinned runs and their table, saving, sharing, and the command line."""

from __future__ import annotations

import html
from collections.abc import Callable
from pathlib import Path
from typing import Any

from closedloop.base.errors import ClosedLoopError, one_line
from closedloop.lab.answers import Answer
from closedloop.lab.for_tabs import LabForTabs
from closedloop.lab.history import IN_A_FILE
from closedloop.lab.keeping import save, save_page
from closedloop.lab.look import KEEP, paragraph
from closedloop.lab.newest import Newest
from closedloop.lab.pins import MOST_PINS, Pin, Pins, table_html
from closedloop.record.run import Run

UNSAVED = "This scenario was made in Python: press <b>save</b>, and run the command in the folder that it names."
STEPS = ("undo", "redo", "begin again")
# A page that does not come from this computer has no clipboard: the text is selected instead, for Ctrl-C.
COPY = """(function(b){var p=b.nextElementSibling;
function say(t){b.textContent=t;setTimeout(function(){b.textContent='copy command'},1500)}
function select(){getSelection().selectAllChildren(p);say('selected: press Ctrl-C')}
if(navigator.clipboard)navigator.clipboard.writeText(p.textContent).then(function(){say('copied')},select);
else select();})(this)"""


class KeepTab:
    """The tab, in a lab that is laid out.

    Parameters
    ----------
    lab : LabForTabs
        The lab.
    tab : viser.GuiTabHandle
    """

    def __init__(self, lab: LabForTabs, tab: Any) -> None:
        self._lab, self.pins, gui = lab, Pins(), lab.server.gui
        self.folder: Path | None = None  # where folders are made; the current one's "out" if None
        self._table: Newest[tuple[list[Pin], Run, Any], str] = Newest(_table_of, self._show_table)
        with tab:
            gui.add_html(paragraph(KEEP.format(name=html.escape(lab.history.base.name))))
            self.pinned = gui.add_button_group(
                "runs", ("pin", "unpin the last"), hint="keep a run beside the next ones"
            )
            self.files = gui.add_button_group("files", ("save", "share"), hint="write the run shown")
            self._said = gui.add_html("")
            self._command = gui.add_html("")
            self._rows = gui.add_html("")
        # In a thread, not in viser's loop: they write files.
        self.steps = lab.steps
        self.steps.on_click(lambda event: self.step(self.steps.value))
        self.pinned.on_click(lambda event: self.pin(self.pinned.value))
        self.files.on_click(lambda event: self.write(self.files.value))
        lab.after_show.append(self._shown)

    def step(self, word: str) -> None:
        """Undo, redo, or go back to where the scenario began."""
        history = self._lab.history
        moved = history.undo() if word == "undo" else history.redo() if word == "redo" else bool(history.changes)
        if word == "begin again" and moved:
            history.set_all({})
        if moved:
            self._lab.refresh()
            self._lab.ask()
        else:
            self.say(f"there is nothing to {word}" if word != "begin again" else "nothing was changed")

    def pin(self, word: str) -> None:
        """Keep the run shown, or the latest pinned one no longer."""
        answer = self._lab.answer
        if word != "pin":
            self.pins.remove_last()
        elif answer is not None and answer.run is not None and self.pins.add(answer.run, answer.changes) is None:
            self.say(f"{MOST_PINS} runs are pinned already: unpin the last first")
        held = self.pins.held
        self._lab.plots.show_pins([(pin.name, pin.colour, pin.run) for pin in held])
        self._lab.space.pinned([(pin.name, _rgb(pin.colour), pin.run.position) for pin in held])
        if not held:
            self._rows.content = ""
        elif answer is not None:
            self._shown(answer)

    def write(self, word: str) -> None:
        """Write the run shown, as a scenario and a run file, or as a page."""
        answer = self._lab.answer
        if answer is None or answer.run is None:
            self.say("there is no run yet")
            return
        command = self._lab.command(answer)
        self._try(lambda run: save(run, command, self.folder) if word == "save" else
                  [save_page(run, command, self.folder)], answer.run)  # fmt: skip

    def _try(self, act: Callable[[Run], list[Path]], run: Run) -> None:
        try:
            self.say(f"wrote {', '.join(map(str, act(run)))}")
        except ClosedLoopError as error:
            self.say(one_line(str(error)))

    def say(self, line: str) -> None:
        """Show a line below the buttons."""
        self._said.content = f'<div style="font-size:0.8em;padding:0.3em 0.8em">{html.escape(line)}</div>'

    def _shown(self, answer: Answer) -> None:
        if answer.run is None or not len(answer.run):
            return
        unsaved = self._lab.history.name == IN_A_FILE
        self._command.content = command_html(self._lab.command(answer)) + (paragraph(UNSAVED) if unsaved else "")
        if self.pins.held:
            self._table.ask((list(self.pins.held), answer.run, answer.changes))

    def _show_table(self, text: str) -> None:
        if self.pins.held:
            self._rows.content = text

    def close(self) -> None:
        """Stop its thread."""
        self._table.close()


def command_html(command: str) -> str:
    """Return a command line with a button that copies it; where a browser copies nothing unasked, it selects it."""
    button = "margin:0.3em 0.8em 0;padding:0.15em 0.8em;font-size:0.85em;cursor:pointer"
    text = "font-size:0.75em;margin:0.3em 0.8em;white-space:pre-wrap;user-select:all"
    hint = "the command line that repeats the run shown"
    return (
        f'<button style="{button}" title="{hint}" onclick="{html.escape(COPY, quote=True)}">copy command</button>'
        f'<pre id="closedloop-command" title="{hint}" style="{text}">{html.escape(command)}</pre>'
    )


def _table_of(request: tuple[list[Pin], Run, Any]) -> str:
    return table_html(*request)


def _rgb(colour: str) -> tuple[float, float, float]:
    red, green, blue = (int(colour[k : k + 2], 16) / 255.0 for k in (1, 3, 5))
    return red, green, blue
