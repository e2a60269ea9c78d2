"""What follows the curves of a run when the slider rests: the strip of values, the run in space, the loop's analysis.

None of it may delay the next curves, so it waits for a rest, or for a while where the slider goes on moving.
"""

from contextlib import suppress
from typing import Any

import numpy as np

from closedloop.base.errors import ClosedLoopError, one_line
from closedloop.figures.scene.scene import Scene, scene_of
from closedloop.lab.app import Answer, Lab
from closedloop.lab.controls import Changes
from closedloop.lab.curves import margin_tiles, reduced, tiles, values
from closedloop.lab.drawn import Message, robot_message, space_message, spread
from closedloop.lab.history import Pin, compared
from closedloop.lab.server import Newest
from closedloop.record.run import Run
from closedloop.simulation.parts import Cache
from closedloop.simulation.prepare import prepare
from closedloop.simulation.simulate import beside_half
from closedloop.studies.analysis.assembly import instant_of, loop_at
from closedloop.studies.analysis.page import Overview, overview

# The strip follows when no other run has come for so long, s, and while a slider moves so often; then the rest.
REST, OFTEN = 0.2, 0.7
# Between two parts it waits until no run is being computed, but no longer than this, s.
GIVE_WAY = 0.3
LATER = 0.3
# Poles that are listed, and points of a curve over the frequency.
POLES, POINTS = 12, 400
LESS_IS_BETTER = ("rms_force_error", "force_settled_at", "rms_path_error", "max_abs_closure_error")
NO_LOOP = "a law that is a function is not linearised: make it a class of ControlLaw"


class Details:
    """What follows the curves."""

    def __init__(self, lab: Lab) -> None:
        self._lab = lab
        self._robot = 0
        self._cache = Cache()
        self.begin()
        self._work: Newest[Answer, None] = Newest(self._follow, rest=REST, most=OFTEN, held=lab.computes)
        self._loop: Newest[Answer, None] = Newest(self._analyse, rest=LATER, most=5.0, held=lab.computes)

    def begin(self) -> None:
        """Forget what was before: another scenario is shown."""
        self._shapes: Any = None
        self.at: float | None = None  # the instant of the analysis, s; half of the run if None
        self._margins: dict[str, Any] | None = None
        self._began: tuple[str, dict[str, float | None], dict[str, Any] | None] | None = None
        self._pinned: dict[str, dict[str, Any] | None] = {}

    def ask(self, answer: Answer) -> None:
        """Let what follows the curves of this answer follow."""
        self._work.ask(answer)
        self._loop.ask(answer)

    def wait(self, seconds: float) -> bool:
        """Wait until all has followed; return whether it has."""
        return self._work.wait(seconds) and self._loop.wait(seconds)

    def close(self) -> None:
        """Stop the threads."""
        self._work.close()
        self._loop.close()

    def robot_of(self, scene: Scene) -> int:
        """Return the number of the robot that the pages have, 0 if this scene has another."""
        return self._robot if scene.shapes is self._shapes else 0

    def pinned(self) -> None:
        """Send the runs that are kept, and what is compared with them."""
        lab = self._lab
        found: list[Message] = []
        for pin in lab.pins.held:  # of each panel the curve that stands for the run
            few = [reduced(panel, float(pin.run.time[0]), float(pin.run.time[-1])) for panel in pin.panels]
            mains = {p.name: {"time": p.time, "values": p.main.values, "factor": p.factor} for p in few}
            found.append({"name": pin.name, "colour": pin.colour, "panels": mains})
        lab.tell("pins", {"kind": "pins", "pins": found})
        names = {pin.name for pin in lab.pins.held}
        self._pinned = {name: margins for name, margins in self._pinned.items() if name in names}
        if lab.pins.held:
            self._pinned.setdefault(lab.pins.held[-1].name, self._margins)
        if lab.answer is not None:
            self.ask(lab.answer)

    def _follow(self, answer: Answer) -> None:
        run, lab = answer.run, self._lab
        if run is None or answer is not lab.answer:
            return
        summary = run.summary()
        self._send_strip(run, summary)
        lab.wait_for_plots(GIVE_WAY)
        lab.tell_controls()
        held = list(lab.pins.held)
        lab.tell("compare", compare_message(held, run, answer.changes))
        lab.wait_for_plots(GIVE_WAY)
        scene = scene_of(run, lab.ghosts)
        if scene.shapes is not self._shapes:
            self._shapes = scene.shapes
            self._robot += 1
            lab.tell("robot", robot_message(scene) | {"robot": self._robot})
        found = space_message(scene, spread(run), summary["clearance"], lambda: lab.wait_for_plots(GIVE_WAY))
        lab.tell("space", found | {"robot": self._robot})

    def _send_strip(self, run: Run, summary: Message) -> None:
        lab, held = self._lab, self._lab.pins.held
        margins = self._margins
        if self._began is None or self._began[0] != lab.history.base.name:
            self._began = (lab.history.base.name, values(run, summary), margins)  # the analysis may come before
        name, before, known = "the start", self._began[1], self._began[2]
        if held:
            name, before = held[-1].name, values(held[-1].run, held[-1].run.summary())
            known = self._pinned.get(name)
        found = tiles(run, summary, before, name)
        if margins is not None and run.scenario.has_law:  # without one nothing is a loop that could be unstable
            found[2:2] = margin_tiles(margins, margins["stable"], known, name)
        lab.tell("strip", {"kind": "strip", "tiles": found})

    def _analyse(self, answer: Answer) -> None:
        run, lab = answer.run, self._lab
        lab.wait_for_plots(GIVE_WAY)
        if run is None or answer is not lab.answer:
            return
        margins, message = None, {"kind": "analysis", "line": NO_LOOP}
        try:
            if lab.answers.law is None:
                end = run.scenario.time.duration
                at = 0.5 * end if self.at is None else min(self.at, end)
                model = lab.answers.model(run.scenario)
                problem = prepare(run.scenario, model, self._cache)
                lab.wait_for_plots(GIVE_WAY)
                instant = instant_of(problem, at, model)
                lab.wait_for_plots(GIVE_WAY)
                loop = loop_at(problem, instant)
                lab.wait_for_plots(GIVE_WAY)
                found = overview(loop)
                margins, message = found.margins.as_dict(), analysis_message(found)
        except ClosedLoopError as error:
            message["line"] = one_line(str(error))
        if run.scenario.name != lab.history.base.name:
            return  # of a scenario that was left meanwhile
        self._margins = margins
        lab.tell("analysis", message)
        if answer is lab.answer:
            if self._began is not None and self._began[2] is None and not answer.changes:
                self._began = (*self._began[:2], self._margins)
            lab.wait_for_plots(GIVE_WAY)
            with suppress(ClosedLoopError):  # the run itself stays where none at half its step can be simulated
                run = beside_half(run, law=lab.answers.law, model=run.model)
            self._send_strip(run, run.summary())
            if lab.clients and not lab.front:
                lab.map.begin_by_itself(answer)


def analysis_message(found: Overview) -> Message:
    """Return the message of a loop's analysis."""
    some = np.unique(np.linspace(0, len(found.frequency) - 1, min(POINTS, len(found.frequency))).round().astype(int))
    return {
        "kind": "analysis", "line": "", "sentence": found.sentence, "margins": found.margins.as_dict(),
        "frequency": found.frequency[some], "gain": found.gain[some], "phase": found.phase[some],
        "poles": [_pole(pole) for pole in found.poles[:POLES]],
    }  # fmt: skip


def _pole(pole: Any) -> Message:
    s = pole.s
    over = not np.isfinite(s.real)
    number = "over at once" if over else f"{s.real:.4g}" + (f" ± {abs(s.imag):.4g}i" if s.imag else "")
    return {
        "s": number, "frequency": "-" if over else f"{pole.frequency:.4g}",
        "damping": "-" if over else f"{pole.damping:.3g}", "part": pole.part,
    }  # fmt: skip


def compare_message(pins: list[Pin], run: Run, changes: Changes) -> Message:
    """Return the table of the pinned runs and that of now: in each cell its text, and whether the pin is better."""

    def cell(name: str, text: str) -> list[Any]:
        lower = text.partition("(")[2][:1] == "-"
        told = "(" in text and name.partition(" ")[0] in LESS_IS_BETTER
        return [text, lower if told else None]

    table = compared(pins, run, changes) if pins else []
    rows = [[name, *(cell(name, text) for text in cells)] for name, cells in table]
    return {"kind": "compare", "columns": [{"name": p.name, "colour": p.colour} for p in pins], "rows": rows}
