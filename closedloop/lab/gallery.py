"""The scenarios that ship, as cards with a picture: the robot at its start, in space."""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache

from closedloop.base.errors import ClosedLoopError
from closedloop.figures.scene.scene import scene_of
from closedloop.lab.drawn import Message, pack, robot_message, space_message
from closedloop.scenario.load import load_scenario, shipped_scenarios
from closedloop.simulation.simulate import simulate

# Steps of the run of which a picture is.
STEPS = 2
# The first card: an arm above its table that comes down on it. (The paper's slide has its elbow below the table.)
FIRST = "wam_touchdown"


@lru_cache(maxsize=1)
def cards() -> list[Message]:
    """Return name and description of each."""
    names = sorted(shipped_scenarios(), key=lambda name: name != FIRST)
    found = ((name, load_scenario(name).description) for name in names)
    return [{"name": name, "about": about[:1].upper() + about[1:]} for name, about in found]


def pictures() -> Iterator[tuple[str, bytes]]:
    """Yield each scenario's name and the message of its picture, of those that can be drawn."""
    for card in cards():
        data = picture(card["name"])
        if data:
            yield card["name"], data


@lru_cache(maxsize=64)
def picture(name: str) -> bytes:
    """Return the message of a scenario's picture, empty if it cannot be drawn."""
    scenario = load_scenario(name)
    step = scenario.time.step
    try:
        few = scenario.time.model_copy(update={"duration": STEPS * step})
        run = simulate(scenario.model_copy(update={"time": few}))
        scene = scene_of(run)
        space = space_message(scene, [0])
    except (ClosedLoopError, ValueError):
        return b""
    return pack({"kind": "picture", "name": name, "robot": robot_message(scene), "space": space, "whole": True})
