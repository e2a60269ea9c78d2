"""The interface of our own: each message has one answer; see `closedloop.serve.messages`.

In lock-step a torque is one step, and its answer the state after it. In real time the clock runs from the first torque
on: a torque acts from the next instant, one period long and until the next one comes, and the answer is the state one
period after it began to act. While no client is there, time stands still.
"""

from __future__ import annotations

from typing import Any

from closedloop.base.arrays import Array
from closedloop.serve.clock import Clock
from closedloop.serve.interface import Interface
from closedloop.serve.messages import (
    DESCRIBE,
    EVENTS,
    FIELDS,
    RESET,
    STATE,
    STEP,
    TORQUE,
    WRENCH,
    Asked,
    Language,
    States,
    events_as_lists,
    language_of,
    wrench,
)
from closedloop.serve.sockets import Client, Gone, Stopped


class Plain(Interface):
    """JSON and binary messages over TCP."""

    def serve(self) -> None:
        """See `Interface`."""
        self._states = States(self.session)
        self._events: list[dict[str, Any]] = []
        port = self.ports[0]
        try:
            while True:
                self.waiting.ready(None)
                if port.client is not None:
                    try:
                        self._talk(port.client)
                    except Gone as gone:
                        port.drop(str(gone))
        except Stopped:
            pass

    def _talk(self, client: Client) -> None:
        """Answer a client until it is gone."""
        session, waiting = self.session, self.waiting
        clock = Clock(session.period)
        language: Language | None = None
        running, fresh, waits = False, False, False  # the clock; a command since the last instant; an answer is owed
        held: Array | None = None
        while True:
            if client in waiting.ready(clock.left() if running else None):
                client.receive()
            while language is None or not waits:
                language = language_of(client, self._states) if language is None else language
                asked = None if language is None else language.asked(client)
                if language is None or asked is None:
                    break
                if not isinstance(asked, Asked):
                    client.send(language.error(asked))
                elif asked.kind not in (TORQUE, STEP):
                    client.send(self._answer(language, asked.kind))
                    running = running and asked.kind != RESET
                elif session.done:
                    client.send(language.error(f"{asked.kind}: the scenario is at its end; reset begins anew"))
                elif self.lock_step:
                    session.cycles += 1
                    self._step(asked.torque)
                    client.send(self._state(language))
                else:
                    held, fresh, waits = asked.torque, True, True
                    if not running:
                        clock.begin()
                        running = True
            if running and clock.left() == 0.0:
                clock.tick()
                session.late = clock.late
                session.cycles += 1
                session.lost += not fresh
                self._step(held)
                running = not session.done
                if waits and language is not None:
                    client.send(self._state(language))
                fresh = waits = False

    def _step(self, torque: Array | None) -> None:
        state = self.session.step(torque)
        if events := state.events:
            self._events += events_as_lists(events)

    def _state(self, language: Language) -> bytes:
        session = self.session
        return language.numbers(STATE, self._states.numbers(session.state, session.done))

    def _answer(self, language: Language, kind: str) -> bytes:
        session = self.session
        if kind == DESCRIBE:
            return language.text(kind, self._description())
        if kind == EVENTS:
            events, self._events = self._events, []
            return language.text(kind, events)
        if kind == WRENCH:
            radius = session.simulator.problem.scenario.tool.radius
            return language.numbers(kind, wrench(session.state, radius))
        if kind == RESET:
            session.reset()
            self._events = []
        return self._state(language)

    def _description(self) -> dict[str, Any]:
        """Return what a client needs to know before it begins."""
        problem = self.session.simulator.problem
        return {
            "scenario": problem.scenario.name,
            "robot": problem.robot.model.name,
            "joints": list(self._states.names),
            "n": self._states.n,
            "period": problem.h,
            "steps": problem.steps,
            "lock_step": self.lock_step,
            "state": [[name, place.stop - place.start] for (name, _), place in zip(
                FIELDS, self._states.places.values(), strict=True)],
        }  # fmt: skip
