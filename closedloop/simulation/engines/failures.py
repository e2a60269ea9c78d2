"""Statuses of the loop as errors with a message."""

import sys
from traceback import extract_tb
from typing import Any

import numpy as np

from closedloop.base import errors
from closedloop.base.arrays import Array
from closedloop.base.families import is_users
from closedloop.base.interrupts import word_for
from closedloop.jit.interpreted import interpreted
from closedloop.jit.user_code import of_users
from closedloop.loop.step.entries import CALLS
from closedloop.loop.step.evaluate import SPEED_LIMIT
from closedloop.loop.step.memory import Loop
from closedloop.mechanics.closure import solve
from closedloop.mechanics.friction.law import surface_parameters
from closedloop.mechanics.friction.laws.lugre import LuGre, is_passive, passive_damping_speed
from closedloop.mechanics.limits import MAX_IN_STEP, OUTPACED
from closedloop.mechanics.robot.pinocchio import Robot
from closedloop.record.report.verdict import DIVERGES
from closedloop.scenario.modes import feedbacks, gains_fault
from closedloop.scenario.scenario import Scenario, families_in
from closedloop.scenario.tables import patches_of
from closedloop.simulation.engines.problem import MEMBERS, Problem, contact_members


def not_finite(torque: Array) -> str:
    """Return the message for a law's torque Q (n,) with an entry that is not finite."""
    return f"the law returned Q = {torque.tolist()}, which is not finite"


def when(t: float) -> str:
    """Return the beginning of the message of a run that stopped at t, s."""
    return f"stopped at t = {t:.6g} s"


def interrupted(stop: KeyboardInterrupt, t: float) -> errors.InterruptedRunError:
    """Return the error of a run that Ctrl-C, or another signal, stopped at t, s."""
    error = errors.InterruptedRunError(f"{when(t)}: {word_for(stop)}", t)
    error.__cause__ = stop
    return error


def failure_of(
    status: int, t: float, robot: Robot, problem: Problem, law: Any, q: Array, v: Array
) -> errors.SimulationError:
    """Return the error of a status of `closedloop.mechanics.closure.solve` other than OK, at q and q̇ (n,) at t, s."""
    kind, what = _told(status, t, robot, problem, law, q, v)
    return kind(f"{when(t)}: {what}", t)


def _told(
    status: int, t: float, robot: Robot, problem: Problem, law: Any, q: Array, v: Array
) -> tuple[type[errors.SimulationError], str]:
    """Return the kind of the error of a status, and what it says."""
    contact = problem.scenario.contact
    if status == solve.PUSHED or (status == solve.SINGULAR and not contact):
        pose = (
            f"singular pose: at q = {_numbers(q)} the tip cannot move along the surface normal "
            f"{problem.surface.touching(robot.position(q), t=t).frame[0].round(4).tolist()}"
        )
        if status == solve.SINGULAR:
            pose += ", so Eq. 24 does not determine the contact force; start from, or steer through, another posture"
        else:
            pose += (
                ", and the torque pushes it that way: the contact force grows beyond all bounds; steer through another "
                "posture, or by a torque that does not push there"
            )
        return errors.SingularClosureError, pose
    if status == solve.SINGULAR:
        return errors.SingularClosureError, (
            "the contacts are inconsistent: no forces give all of them the accelerations that they require; look for "
            "contacts of bodies that cannot move, and leave one out"
        )
    if status == solve.NOT_POSITIVE_DEFINITE:
        return errors.SingularClosureError, (
            f"the mass matrix of {robot.model.name} is not positive definite; some joint moves no inertia (look at the "
            "masses and tensors of the last links)"
        )
    if status == solve.NO_NORMAL:
        return errors.NoNormalError, (
            f"the surface has no normal at {_numbers(robot.position(q))} m, where the tip is"
            f"{', or that of another contact where its point is' if contact else ''}: the gradient of its φ vanishes "
            "there, or within a step from there, or is not a number; keep the tip near the surface, away from its "
            "centre, edge or apex"
        )
    if status == solve.LOOPS_OPEN:
        return errors.SimulationError, (
            f"at q = {_numbers(q)} the joints cannot follow a [[mocap]]: the loops that hold onto it stay open; look "
            "at mocap.motion, and at the start"
        )
    if status == solve.CHATTER and problem.placed is not None:
        cure = "look at time.step" + ("" if law is None else ", and at a law that depends on the contacts")
        return errors.ChatterError, (
            f"the {'contacts' if contact else 'tip and the stops of joints'} chatter: at one instant their modes "
            f"change again and again, and no set of modes agrees with its own forces; {cure}"
        )
    if status == solve.CHATTER:
        return errors.ChatterError, (
            "the contact chatters: at one instant the torque presses the tip on while it is free, and lifts it while "
            "it touches; look at a law that depends on the contact, and at time.step"
        )
    if status == solve.RUBS:
        return errors.ChatterError, (
            "stick and slip alternate without end at one instant: no direction of slip agrees with its own friction, "
            "and friction cannot hold the tip; look at friction, at stabiliser.kind (a tip that sticks drifts without "
            "one), and at time.step"
        )
    if status == solve.CROWDED:
        return errors.ChatterError, (
            f"too many events: the contact changed its mode more than {MAX_IN_STEP} times in the last few steps, and "
            f"more than {OUTPACED} times in each, faster than time.step resolves; look at its events, at a law or a "
            "friction that acts faster than a step, and at time.step"
        )
    if status == solve.PAINLEVE and contact:
        return errors.PainleveError, (
            "Painlevé's paradox, or jamming: no forces inside the friction cones were found for any modes of the "
            "contacts (one slides so that pressing harder pulls it in, or is jammed); lower the coefficients of "
            f"friction, or change the posture or the direction of sliding{_stiff_bristles(problem.scenario)}"
        )
    if status == solve.PAINLEVE:
        jams = ", or is jammed between it and the stops of joints" if problem.placed is not None else ""
        return errors.PainleveError, (
            "Painlevé's paradox: the tip slides so that pressing harder pulls it into the surface (the coefficient of "
            f"f in Eq. 24 with friction is not positive){jams}, and no rigid contact force exists; lower the "
            "coefficient of friction, or change the posture or the direction of sliding"
        )
    name = robot.joint_names[int(np.argmax(np.abs(v))) if np.all(np.isfinite(v)) else 0]
    beyond = f"joint {name} is beyond {SPEED_LIMIT:g} rad/s (m/s) or not a number"
    return errors.DivergenceError, f"{DIVERGES}: {beyond}; {_cure(problem, robot, law)}"


def _stiff_bristles(scenario: Scenario) -> str:
    """Return what to change of contacts whose friction gives a fast slip energy, "" if there are none."""
    sections, told = scenario.contact or (), ""
    for name, numbers in patches_of(sections).items():
        law = sections[numbers[0]].friction_law
        if isinstance(law, LuGre) and not is_passive(par := surface_parameters(law)):
            told += (
                f"; contact.{name}.friction_law: bristles that are not bent resist a fast slip with damping times its "
                f"speed: lower damping, or give damping_speed = {passive_damping_speed(par):.3g} m/s or less"
            )
    return told


def _cure(problem: Problem, robot: Robot, law: Any) -> str:
    """Return what to change, or to look at, where a motion diverges."""
    scenario = problem.scenario
    if law is not None:
        causes = ["the signs and sizes in the law"]
    elif fault := gains_fault(scenario, robot):
        return fault
    else:
        causes = [f"the signs and sizes of {_gains(scenario, robot)}"] if scenario.has_law else []
        if scenario.reads_encoders:
            causes.append("what the law reads of the joints (encoder, transmission.measured)")
        if scenario.transmission.elastic:
            causes.append("transmission.stiffness")
    if np.any(getattr(scenario.joint_friction, "viscous", 0.0)):
        causes.append("joint_friction.viscous")
    if problem.tolerance is None:
        causes.append("time.step")
    return "look at " + ", and at ".join(causes or ["start.v"])


def _gains(scenario: Scenario, robot: Robot) -> str:
    keys = list(dict.fromkeys(key for each in feedbacks(scenario, robot) for key in (each.spring, each.damper)))
    return " and ".join(filter(None, (", ".join(keys[:-1]), *keys[-1:]))) or "the law's gains"


def _numbers(x: Array) -> str:
    return np.array2string(x, precision=4, separator=", ", suppress_small=True)


def raised_by_member(problem: Problem, loop: Loop) -> errors.LawError:
    """Return the error of a run in which a user's member raised something: file, line, type and message in one line.

    Compiled code keeps no message: the functions are called again, interpreted, on the memory as it is.
    """
    t = float(loop.w.time)
    problem.connect(loop, compiled=False)
    state, scenario = loop.state, problem.scenario
    # The key, the class and the entry of each, and the address that this takes.
    called: list[tuple[str, Any, Any, int]] = [
        (name, getattr(scenario, name), entry, int(state.surface.at) if name in MEMBERS else loop.address)
        for name, entry in problem.entries().items()
    ]
    for name, entry in problem.believed_entries().items():
        believed = getattr(problem.believed, MEMBERS[name])
        called.append((f"belief.{name}", believed, entry, int(state.surface.believed.at)))
    for each in contact_members(loop):
        key = f"contact.{each.contact - 1}.{each.key}" if each.contact else each.key.split("_")[0]
        called.append((key, each.member, each.entry, each.address))
    for key, member, entry, address in called:
        for what in range(CALLS) if is_users(member) else ():
            try:
                with np.errstate(all="ignore"), of_users(member, f"{key}.kind"):
                    interpreted(entry)(address, what)
            except errors.ScenarioError as error:
                return errors.LawError(f"{when(t)}: {error}", t)
    return errors.LawError(f"{when(t)}: a function of a class of your own failed", t)


def member_error(problem: Problem, error: Exception, t: float) -> errors.LawError | None:
    """Return what a user's member raised in an interpreted run as the error of the run; None if none of them did."""
    members = {f"{name}.kind": getattr(problem.scenario, name) for name in problem.entries()}
    members |= {f"belief.{name}.kind": getattr(problem.believed, MEMBERS[name]) for name in problem.believed_entries()}
    for i, section in enumerate(problem.scenario.contact or ()):
        members |= {f"contact.{i}.{key}.kind": getattr(section, key) for key in families_in(type(section))}
    for key, member in members.items():
        file = getattr(sys.modules.get(type(member).__module__), "__file__", None)
        if member is None or not is_users(member):
            continue
        if any(frame.filename == file for frame in extract_tb(error.__traceback__)):
            try:
                with of_users(member, key):
                    raise error
            except errors.ScenarioError as told:
                return errors.LawError(f"{when(t)}: {told}", t)
    return None
