"""Warnings on standard error before a run is simulated; none of them stops it."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any

from closedloop.base.errors import ClosedLoopError, ScenarioError, one_line, printable
from closedloop.scenario.scenario import Scenario

if TYPE_CHECKING:
    from closedloop.record.run import Run


def warn_of_other_texts(file: str, earlier: Run, now: dict[str, str]) -> None:
    """Say which of the user's functions and classes, MODULE:NAME to digest, have another text than in a run file."""
    before = {earlier.law: earlier.law_digest, **earlier.member_digests}
    for name, digest in now.items():
        if digest != before.get(name, "") != "":
            said = f"closedloop: the text of {name} is not the one that {file} was made with"
            print(printable(said), file=sys.stderr)


def warn_of_no_surface(scenario: Scenario) -> None:
    """Say which sections and which force are about the tip's contact, where there is no surface for it."""
    if scenario.has_surface:
        return
    force = getattr(scenario.law, "force", 0.0)
    if force and not scenario.contact:
        said = f"law.force = {force:g}: there is no [surface], so the tip presses on nothing; add one, or leave it out"
        print(f"closedloop: warning: {said}", file=sys.stderr)
    idle = [name for name in ("friction", "compliance", "surface_motion") if getattr(scenario, name).kind != "none"]
    if idle:
        named = " and ".join(f"[{name}]" for name in idle)
        print(f"closedloop: warning: {named}: there is no [surface], so nothing acts at the tip", file=sys.stderr)


def warn_of_hulls(scenario: Scenario, model: Any) -> None:
    """Say which collision meshes are not convex, so that their hulls touch."""
    from closedloop.scenario.collision import hulls_taken

    try:
        lines = hulls_taken(scenario, model)
    except ClosedLoopError:  # it cannot be prepared, and `simulate` says why
        return
    for line in lines:
        print(f"closedloop: warning: {one_line(line)}", file=sys.stderr, flush=True)


def warn_of_gains(scenario: Scenario, model: Any) -> None:
    """Say before anything is simulated that the step does not carry or resolve the gains; contact may: no refusal."""
    from closedloop.scenario.arm import robot_of
    from closedloop.scenario.gains import gains_fault
    from closedloop.scenario.modes import unresolved_feedback

    try:
        robot = robot_of(scenario, model)
        fault = gains_fault(scenario, robot)
        faults = [fault] if fault else unresolved_feedback(scenario, robot)
    except ScenarioError:  # it cannot be prepared, and `simulate` says why
        return
    for fault in faults:
        print(f"closedloop: warning: {one_line(fault)}", file=sys.stderr, flush=True)
