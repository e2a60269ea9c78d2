"""Each key of a scenario in turn: what is prepared and stepped after other scenarios is what a fresh call makes."""

import random
from copy import deepcopy
from zlib import crc32

import numpy as np
import pytest
from budget import budget
from combinations import FIXED, LISTS, WITHIN, add_bodies, change_in_list, value_of
from scenario_cases import EXAMPLES, SEED
from shipped_cases import SCENARIOS, shipped_tables

from closedloop.base.errors import ClosedLoopError, ScenarioError
from closedloop.scenario.load import scenario_of, shipped_scenarios
from closedloop.scenario.messages import variants
from closedloop.scenario.scenario import Scenario
from closedloop.simulation.ensemble.ensemble import Ensemble
from closedloop.simulation.parts import Cache, Watched
from closedloop.simulation.prepare import problem_of
from closedloop.simulation.simulate import as_run, run_loop

# Rigid, rough and soft surfaces, flat, curved and moving; touchdown, loops, supply at the start, contacts of links and
# bodies beside a mechanism, a controller that is wrong, an axis that is held, friction of joints, drives.
NAMES = (
    "wam_slide", "wam_touchdown", "wam_sphere", "soft_table", "five_bar", "push_block", "cube_toss", "panda_polish",
    "hidden_bump", "joint_friction", "gripper_block", "planar2_drop",
)  # fmt: skip
ENGINES, STEPS = ("compiled", "pinocchio"), 4
ENCODER = {"noise": 2e-5, "velocity_noise": 1e-3}
# Beside a table: what another has in its place, or a list where there was none.
MORE = (
    {"external_force": [{"force": [0.0, 0.5, 1.0], "start": 0.0}]}, {"encoder": ENCODER},
    {"encoder": ENCODER | {"velocity": "difference", "filter_time_constant": 0.004}},
    {"transmission": {"stiffness": 3e4, "motor_inertia": 0.1}, "encoder": ENCODER | {"side": "motor"}},
    {"tool": {"mass": 0.3, "offset": [0.0, 0.0, 0.05]}}, {"force_profile": {"kind": "step", "at": 0.002, "to": 12.0}},
)  # fmt: skip


def variations(name):
    """Return (what, tables) of a scenario with another value of each key that it may have, of each kind of a section.

    Beside these, tables that it has not, and lists of them, of which some are changed once more.
    """
    draw, given = random.Random(SEED), shipped_tables(name)
    given["time"]["duration"] = STEPS * given["time"]["step"]
    if "/" in given["robot"]["model"]:
        given["robot"]["model"] = str(SCENARIOS / given["robot"]["model"])
    for section in (each for each in Scenario.model_fields if variants(each)):
        kinds, held = variants(section), given.get(section, {})
        for kind in (each for each in kinds if ":" not in each):
            table = {key: value for key, value in held.items() if key in kinds[kind].model_fields}
            table |= {"kind": kind} if kind else {}
            for key, field in kinds[kind].model_fields.items():
                if field.is_required() and key not in table:
                    table[key] = deepcopy(EXAMPLES.get(dotted := f"{section}.{key}")) or value_of(
                        draw, dotted, field, None
                    )
            yield f"{section}.kind = {kind}", given | {section: table}
            for key, field in kinds[kind].model_fields.items():
                dotted = f"{section}.{key}"
                if key == "kind" or dotted in FIXED - {"start.q", "time.duration"}:
                    continue
                value = (
                    draw.choice(WITHIN[dotted]) if dotted in WITHIN else value_of(draw, dotted, field, table.get(key))
                )
                if dotted == "start.q":
                    value = [x + 1e-3 for x in table.get(key) or []]
                yield f"{dotted} = {value}", given | {section: table | {key: value}}
    for more in MORE:
        yield f"{more}", given | more
    for _ in range(3):
        data = deepcopy(given)
        yield add_bodies(draw, data), data
        yield change_in_list(draw, data), data
    for section in given.keys() & LISTS:
        yield f"no {section}", {key: value for key, value in given.items() if key != section}


class Followed:
    """What is kept from scenario to scenario: a cache, simulations side by side, constants of a loop."""

    def __init__(self):
        self._cache, self._together, self._constants = Cache(), {}, {}

    def outcome(self, scenario, engine, kept=True):
        """Return all that is known of a run, arrays by name, or why there is none."""
        try:
            problem = problem_of(scenario, None, self._cache, kept)
            engine = "pinocchio" if problem.tolerance is not None else engine
            rows, events, failure, _ = run_loop(problem, engine=engine)
            run = as_run(problem, rows, events, 0.0, engine)
            found = {name: np.array(run[name]) for name in run.columns}
            constants = problem.constants(self._constants.get(sizes := (problem.robot.n, *problem.shape.sizes)))
            self._constants[sizes] = constants
            found |= {"table": problem.table.copy(), "constants": constants.memory.copy(), "failure": [str(failure)]}
            if problem.tolerance is None:
                found["together"] = self._stepped(problem)
        except ClosedLoopError as error:
            return str(error)
        return found | {"scenario": [run.scenario.model_dump_json()]}

    def _stepped(self, problem):
        """Return the rows of a simulation side by side."""
        width = problem.row_width
        if width not in self._together:
            self._together[width] = Ensemble(1, 1, np.zeros((0, 3), dtype=np.int64), 0)
        together, rows = self._together[width], np.full((STEPS + 1, width), np.nan)
        together.begin(0, problem)
        together.start([0])
        for row in rows:
            if together.failed[0]:
                break
            row[:] = together.rows[0]
            if together.left(0):
                together.step([0])
        return rows


def differences(one, other):
    """Return in what two outcomes differ."""
    if isinstance(one, str) or isinstance(other, str):
        return [] if isinstance(one, str) and one == other else ["outcome"]
    if one.keys() != other.keys():
        return sorted(one.keys() ^ other.keys())
    return [name for name in one if np.asarray(one[name]).tobytes() != np.asarray(other[name]).tobytes()]


def walk(name, of):
    """Return how many of a scenario's variations ran, and what was other than in a call that finds nothing made."""
    followed, ran, wrong = Followed(), 0, []
    for k, (what, data) in enumerate(variations(name)):
        if not of(k, what):
            continue
        try:
            scenario = scenario_of(data, "fuzz", {})
        except ScenarioError:
            continue
        engine, kept = ENGINES[k % 2], k % 3 > 0
        again, alone = followed.outcome(scenario, engine, kept), Followed().outcome(scenario, engine)
        ran += not isinstance(alone, str)
        wrong += [f"{what}: {', '.join(found[:5])}" for found in (differences(again, alone),) if found]
    return ran, wrong


def tried(place, every):
    """Return which variations one scenario of many takes: a key's values are for those whose place it falls to."""

    def of(_, what):
        key = what if ".kind = " in what else what.partition(" = ")[0]
        return crc32(key.encode()) % every == place % every

    return of


# Each with an eighth of the keys, so that each key is tried in one or two of the twelve; with the full budget all of
# them in all scenarios.
WALKS = [(name, 8) for name in NAMES]
WALKS += [pytest.param(name, 1, marks=pytest.mark.slow) for name in budget((), shipped_scenarios())]


@pytest.mark.parametrize(("name", "every"), WALKS)
def test_what_is_taken_over_from_other_scenarios_is_what_a_fresh_call_makes(name, every):
    """To the bit, for any key that changes: the table, the constants, each column of the run, and what is refused."""
    ran, wrong = walk(name, tried(NAMES.index(name) if name in NAMES else 0, every))
    assert not wrong, "\n".join(wrong)
    assert ran >= 80 / every


@pytest.mark.parametrize("forgotten", ["model_error", "stabiliser", "force_profile"])
def test_a_section_that_is_read_and_not_noted_would_show(forgotten, monkeypatch):
    """With a planted fault the walk finds it; the section says nothing of how much memory there is to be."""
    noted = Watched.__getattr__

    def forgets(scenario, name):
        found = noted(scenario, name)
        scenario._readers.get(forgotten, set()).clear()
        return found

    monkeypatch.setattr(Watched, "__getattr__", forgets)
    assert walk("wam_slide", lambda k, what: what.startswith(forgotten))[1]
