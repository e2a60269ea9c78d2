"""What was changed in the lab, step by step; the runs that are kept beside the one that changes; and a run as a page.

    history = History(scenario, "wam_slide")
    history.change("law.force", 12.0)
    history.command()                   # closedloop wam_slide --law.force 12.0

A run's page is the page of the lab without its server, in a file that needs no network.
"""

import html
import secrets
import shlex
import tempfile
import threading
import time as clock
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path
from typing import Any

from closedloop.base.arrays import evenly
from closedloop.base.errors import OutputError, ScenarioError, printable
from closedloop.base.files import reason_of, write_whole
from closedloop.figures.scene.scene import scene_of
from closedloop.figures.scene.solids import Ghost
from closedloop.lab.controls import Changes, toml_text
from closedloop.lab.curves import Panel, panels, tiles
from closedloop.lab.drawn import Message, curves, in_text, pack, robot_message, run_message, space_message
from closedloop.lab.server import FIRST_PORT, RUN, Client, Server, in_notebook
from closedloop.record.report.control_verdict import told
from closedloop.record.report.measures import MEASURES
from closedloop.record.report.verdict import names_of
from closedloop.record.run import Run
from closedloop.scenario.load import Variants, load_scenario
from closedloop.scenario.messages import variant_keys, with_unit
from closedloop.scenario.scenario import Scenario, families
from closedloop.scenario.tables import ALL
from robot_models import RobotModel

# Frames of the replay at most, parts of the time of which a curve shows the extremes, and columns besides the panels.
MOST_FRAMES, CELLS = 500, 400
COLUMNS = ("q", "v", "torque", "position", "kinetic_energy")
SCRIPTS = (
    "numbers.js", "space.js", "draw_space.js", "plots.js", "controls.js", "map.js", "tabs.js", "gallery.js", "page.js",
)  # fmt: skip


def page_of(run: Run, command: str = "", ghosts: Sequence[Ghost] = ()) -> str:
    """Return the page of a run; `command` is the command line that repeats it, `ghosts` are shown beside its bodies."""
    if not len(run):
        raise ScenarioError(f"{run.scenario.name}: the run has no rows: there is nothing to show")
    scene, summary = scene_of(run, ghosts), run.summary()
    drawn = curves(run, None, COLUMNS, CELLS)
    messages = [
        hello(run.scenario, run.model, live=False) | {"scenario": run.scenario.to_toml(), "command": command},
        run_message(run, drawn, line="", n=1, partial=False) | {"columns": list(COLUMNS)},
        {"kind": "strip", "tiles": tiles(run, summary)},
        robot_message(scene),
        space_message(scene, evenly(len(run), MOST_FRAMES), summary["clearance"]) | {"n": 1},
    ]
    return page(f"{run.scenario.name}, {run.model.name}", messages)


def hello(scenario: Scenario, model: RobotModel, **more: Any) -> dict[str, Any]:
    """Return the message with what a page is about: its title, the scenario in words, and more."""
    name, about = scenario.name, scenario.description
    title = name if name == model.name else f"{name} ({model.name})"
    return {"kind": "hello", "name": name, "title": title, "about": about[:1].upper() + about[1:], **more}


def page(title: str, messages: Sequence[Any] = (), theme: str = "", nonce: str = "") -> str:
    """Return the page with messages inside; without any it opens a socket below its own address.

    `theme` is "dark", "light", or "" for what the system prefers; `nonce` is the word by which the policy of a server
    knows the page's own script and style. No text of a run can end the script it stands in.
    """
    web = files("closedloop.lab") / "web"
    parts = {
        "TITLE": html.escape(title),
        "THEME": theme,
        "NONCE": nonce,
        "STYLE": (web / "style.css").read_text(encoding="utf-8"),
        "SCRIPT": "\n".join((web / name).read_text(encoding="utf-8") for name in SCRIPTS),
        "DATA": in_text(list(messages)),
    }
    found, *rest = (web / "page.html").read_text(encoding="utf-8").split("@")
    for name, text in zip(rest[::2], rest[1::2], strict=True):
        found += parts[name] + text
    return found


def share(run: Run, path: str | Path, command: str = "", ghosts: Sequence[Ghost] = ()) -> Path:
    """Write the page of a run, see `page_of`, and return its path."""
    return write_whole(path, page_of(run, command, ghosts).encode())


HEIGHT = 640  # px in a notebook


def show_run(run: Run, path: str | Path | None = None) -> Path | Any:
    """Show the replay of a run, see `closedloop.record.run.Run.show`."""
    if path is not None:
        return share(run, path)
    if in_notebook():
        from IPython.display import HTML

        inside = html.escape(page_of(run), quote=True)
        return HTML(f'<iframe srcdoc="{inside}" width="100%" height="{HEIGHT}" style="border:0"></iframe>')  # type: ignore[no-untyped-call]
    import webbrowser

    page = share(run, Path(tempfile.mkdtemp(prefix="closedloop-")) / f"{run.scenario.name}.html")
    webbrowser.open(page.as_uri())
    return page


MOST_FOLDERS = 10_000


def new_folder(name: str, parent: Path | None = None) -> Path:
    """Make and return the first folder out/NAME-lab/1, 2, 3 ... that is not there yet."""
    parent = (Path("out") if parent is None else parent) / f"{name}-lab"
    try:
        parent.mkdir(parents=True, exist_ok=True)
        for number in range(1, MOST_FOLDERS):
            folder = parent / str(number)
            try:
                folder.mkdir()
            except FileExistsError:
                continue
            return folder
    except OSError as error:
        raise OutputError(f"{parent}: cannot be made: {reason_of(error)}") from None
    raise OutputError(f"{parent}: holds {MOST_FOLDERS} folders already; move some of them away")


def save(run: Run, command: str, parent: Path | None = None) -> list[Path]:
    """Write a run and its scenario into a new folder, and return the files.

    `command`, which repeats the run, stands in the scenario's first line.
    """
    folder = new_folder(run.scenario.name, parent)
    text = f"# {printable(command)}\n{run.scenario.to_toml()}"
    return [write_whole(folder / "scenario.toml", text.encode()), run.save(folder / "run.nc")]


# Changes of one key that follow each other so fast, s, are one step of undo.
TOGETHER = 1.0
# The file that `closedloop.lab.history.save` writes.
IN_A_FILE = "scenario.toml"
# Steps that can be undone.
MOST_STEPS = 500


class History:
    """The changes of a scenario, with undo and redo.

    `base`: where it began.
    `name`: the scenario as the command line takes it: a shipped name, a file.
    `given`: the overrides that `base` was read with, beside the name.
    `words`: more words of the command line, such as ``--law my_laws:soft``.
    `now`: the time, s.
    """

    def __init__(
        self, base: Scenario, name: str, given: Mapping[str, Any] | None = None, words: str = "",
        now: Callable[[], float] = clock.monotonic,
    ) -> None:  # fmt: skip
        self.base, self.name, self.given, self.words = base, name, dict(given or {}), words
        self.past: list[Changes] = []  # the steps back
        self.future: list[Changes] = []  # and forward again
        self._now, self._last_key, self._last_time = now, "", -TOGETHER
        # which press of the pointer what follows belongs to, None: to none
        self.press: tuple[int, str] | int | None = None
        self._last_press: tuple[int, str] | int | None = None
        self.changes: Changes = {}

    def change(self, key: str, value: Any, more: Mapping[str, Any] | None = None) -> Changes:
        """Change a key, None: back to where it began, and with it `more`, and return all changes.

        What one press of the pointer does to a key is one step, however slowly a slider is dragged.
        """
        now, held = self._now(), self.press is not None and self.press == self._last_press
        if key != self._last_key or not (held or now - self._last_time <= TOGETHER):
            self.past = [*self.past[-MOST_STEPS:], self.changes]
        self._last_key, self._last_time, self._last_press, self.future = key, now, self.press, []
        for each, its_value in {key: value, **(more or {})}.items():
            self.changes = with_change(self.changes, each, its_value)
        return self.changes

    def begin_again(self) -> bool:
        """Take back all changes, as one step; return whether there were any."""
        if not self.changes:
            return False
        self.past, self.future, self._last_key = [*self.past[-MOST_STEPS:], self.changes], [], ""
        self.changes = {}
        return True

    def undo(self) -> bool:
        """Go a step back; return whether there was one."""
        return self._move(self.past, self.future)

    def redo(self) -> bool:
        """Go a step forward again; return whether there was one."""
        return self._move(self.future, self.past)

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
    octal = ("".join(f"\\{byte:03o}" for byte in c.encode("utf-8", "surrogateescape")) for c in plain)
    return "$'" + "".join(c if c.isprintable() else its for c, its in zip(plain, octal, strict=True)) + "'"


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
            if isinstance(keys, dict):
                known = other if isinstance(other, dict) and keys.get("kind") == other.get("kind") else {}
                given |= {f"{section}.{key}": value for key, value in keys.items() if value != known.get(key)}
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


MOST_PINS = 4
# Reddish purple, sky blue and orange of Okabe and Ito's palette, which the run itself does not have, and violet.
COLOURS = ("#CC79A7", "#56B4E9", "#E69F00", "#7B61C4")
ROUNDING = 1e-9  # values that differ by no more than this share are equal
# What the table compares: values of `Run.summary`.
VALUES = (
    "rms_force_error", "peak_contact_force", "min_contact_force", "force_settled_at", "rms_path_error",
    "max_abs_closure_error", "max_tip_speed", "energy_lost_to_friction", "time_in_contact",
)  # fmt: skip


@dataclass(frozen=True)
class Pin:
    """A run that is kept: its name, its colour, the changes that made it, the run, and its curves."""

    name: str
    colour: str
    changes: Changes
    run: Run
    panels: tuple[Panel, ...]


@dataclass
class Pins:
    """The runs that are kept, in the order in which they were."""

    held: list[Pin] = field(default_factory=list)
    _count: int = 0

    def add(self, run: Run, changes: Changes) -> Pin | None:
        """Keep a run; return it, or None if as many are kept as can be."""
        if len(self.held) >= MOST_PINS:
            return None
        self._count += 1
        taken = {pin.colour for pin in self.held}
        colour = next(colour for colour in COLOURS if colour not in taken)
        pin = Pin(f"pin {self._count}", colour, dict(changes), run, tuple(panels(run)))
        self.held.append(pin)
        return pin


def compared(pins: Sequence[Pin], run: Run, changes: Changes) -> list[tuple[str, list[str]]]:
    """Return the rows of the table: a key that differs or a value, and what it is in each pin and now.

    A value that is a number has its difference from the present run beside it.
    """
    every = [*((pin.run, pin.changes) for pin in pins), (run, changes)]
    keys = dict.fromkeys(key for _, made in every for key in made)
    rows = []
    for section, dot, name in (key.partition(".") for key in keys):
        held = [getattr(getattr(each.scenario, section), name, None) for each, _ in every]
        rows.append((f"{section}{dot}{name}", [toml_text(value) for value in held]))
    summaries = [each.summary() for each, _ in every]
    for name in VALUES:
        numbers = [summary.get(name) for summary in summaries]
        cells = [_with_difference(number, numbers[-1], k < len(pins)) for k, number in enumerate(numbers)]
        rows.append((with_unit(name, MEASURES[name].units), cells))
    rows.append(("verdict", [names_of(summary["verdict"]["problems"]) for summary in summaries]))
    return [*rows, ("control_verdict", [told(summary) for summary in summaries])]


def _with_difference(number: float | None, now: float | None, differs: bool) -> str:
    if number is None:
        return "-"
    text = f"{number + 0.0:.4g}"  # no "-0"
    if not differs or now is None or abs(number - now) <= ROUNDING * max(abs(number), abs(now)):
        return text
    return f"{text} ({number - now:+.2g})"


# How long a page may take to be sent what is left at the end, s.
PATIENCE = 10.0


class Pages:
    """The lab's page in any number of browsers; one that opens later is sent the newest message of each kind."""

    def __init__(self) -> None:
        self.clients: list[Client] = []
        self._last: dict[str, bytes | Callable[[], bytes]] = {}
        self._lock = threading.RLock()

    def listen(
        self, host: str, port: int, page: Callable[[str], str], said: Callable[[Client, Any], None],
        framed: bool = False,
    ) -> None:  # fmt: skip
        """Serve the page, see `closedloop.lab.server.Server`, with a token of its own."""
        self._token = secrets.token_hex(24)
        self.server = Server(host, port, self._token, page, self._opened, said, self._closed, framed)

    @property
    def url(self) -> str:
        """The address of the page, with the token that lets in."""
        host = self.server.host
        host = "127.0.0.1" if host == "0.0.0.0" else f"[{host}]" if ":" in host else host
        return f"http://{host}:{self.server.port}/?token={self._token}"

    def tell(self, kind: str, message: Message, keep: bool = True) -> None:
        """Send a message to every page, and to those that open later if it is to be kept."""
        data = pack({"kind": kind, **message})
        with self._lock:  # a page that opens now has it among what is kept, or is sent it
            if keep:
                self._last[kind] = data
            for client in list(self.clients):
                client.put(kind, data)

    def _opened(self, client: Client) -> None:
        with self._lock:
            for kind, kept in self._last.items():
                client.put(kind, kept if isinstance(kept, bytes) else kept())
            self.clients.append(client)

    def _closed(self, client: Client) -> None:
        with self._lock:
            if client in self.clients:
                self.clients.remove(client)


class Shown(Pages):
    """The page of what another part of the program simulates: it is told what to draw, and moves nothing there.

    `title`: the page's title until a message says another.
    `port`: where it listens, for this computer alone; the next free one is taken if it is in use.
    `run`: returns the message of the run for a page, by the part of the time and the columns that it has chosen.
    Raises OutputError if it cannot listen there.
    """

    def __init__(
        self, title: str, port: int = FIRST_PORT, run: Callable[[Client], Message | None] = lambda client: None
    ) -> None:  # fmt: skip
        super().__init__()
        self._run = run
        self.listen("127.0.0.1", port, lambda nonce: page(title, nonce=nonce), self._said)

    def tell_run(self) -> None:
        """Send each page the run as it is now."""
        for client in list(self.clients):
            self._send_run(client)

    def close(self) -> None:
        """Send what is left, and stop listening."""
        for client in list(self.clients):
            client.wait(PATIENCE)
            client.close()
        self.server.close()

    def _send_run(self, client: Client) -> None:
        message = self._run(client)
        if message is not None:
            client.put(RUN, pack({"kind": RUN, **message}))

    def _opened(self, client: Client) -> None:
        super()._opened(client)
        self._send_run(client)

    def _said(self, client: Client, said: dict[str, Any]) -> None:
        if said.get("do") == "shown":
            client.drawn()
        elif said.get("do") in ("window", "columns"):
            client.choose(said)
            self._send_run(client)
