"""Calls one after the other, of which a later one reuses what an earlier one has made."""

import gc
import pickle
import weakref
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from budget import budget, others

import closedloop as cl
import robot_models
from closedloop.mechanics.robot.pinocchio import Robot
from closedloop.scenario.load import shipped_scenarios
from closedloop.simulation import prepare as prepare_module
from closedloop.simulation.loop_calls import Driver
from closedloop.simulation.parts import Cache, Parts, law_as, without
from closedloop.simulation.simulate import run_loop

# A soft and rough surface, a sampled law and a sensor with noise; see `closedloop.gym.terms`.
SCENARIOS = Path(cl.__file__).parent / "gym" / "scenarios"

CHANGES = (
    {},
    {"law.force": 12.0},
    {"start.q": [0.1, -1.5, 0.05, 2.4]},
    {"surface.tilt": 5.0},
    {"time.step": 5e-4},
    {"sensor.noise": 0.1, "sensor.seed": 3},
    {"friction": {"kind": "coulomb", "mu": 0.2}},
    {"robot.drive_inertia": False},
    {"robot.model": "panda", "start.q": None},
)


def columns_of(run):
    """Return all columns of a run, by name."""
    return {name: np.asarray(run[name]) for name in run.columns}


def same(one, other):
    """Whether two runs have the same columns, to the bit."""
    a, b = columns_of(one), columns_of(other)
    return a.keys() == b.keys() and all(np.array_equal(a[name], b[name], equal_nan=True) for name in a)


def scenario_with(changes, duration=0.02):
    """Return the slide with changes that go together; None if they do not."""
    return cl.load_scenario("wam_slide", {"time.duration": duration, **changes})


@pytest.mark.parametrize("engine", ["pinocchio", "compiled"])
def test_a_call_equals_one_in_a_thread_of_its_own(engine):
    """Whatever came before, a run equals one that finds nothing made: in a new thread nothing is."""
    scenarios = []
    for changes in CHANGES:
        try:
            scenarios.append(scenario_with(changes))
        except cl.ClosedLoopError:
            continue
    assert len(scenarios) >= 6
    for scenario in [*scenarios, *reversed(scenarios)]:
        with ThreadPoolExecutor(1) as pool:
            fresh = pool.submit(outcome, scenario, engine).result()
        here = outcome(scenario, engine)
        assert type(here) is type(fresh)
        assert same(here, fresh) if isinstance(here, cl.Run) else str(here) == str(fresh)


# Paths and none, a sensor with noise and delay, bristles, touchdown and impacts, moving and soft surfaces, loops of a
# mechanism, stops, contacts of links and of shapes, encoders, elastic joints, a controller that is wrong.
FROM_ELSEWHERE = (
    "wam_slide", "wam_slide_friction", "planar2_drop", "five_bar", "push_block", "gripper_block", "hidden_bump",
    "cube_toss",
)  # fmt: skip
BRISTLES = {"kind": "lugre", "static": 0.5, "kinetic": 0.3, "stribeck_speed": 0.01, "stiffness": 1e4, "damping": 10.0}
RUBBING = {"friction": BRISTLES, "sensor.noise": 0.1, "sensor.delay": 0.003}


def starts(problem):
    """Return changes that start a problem elsewhere, and where it starts: next to that, moving or not, and beyond."""
    scenario, model = problem.scenario, problem.robot.model
    q, v = scenario.start.q, scenario.start.v
    rates = np.array(v if v is not None else np.zeros(int(np.sum(~model.free)) or model.n))
    near = {} if q is None or model.balls else {"start.q": [x + 2e-7 * (-1) ** i for i, x in enumerate(q)]}
    far = {} if q is None or model.balls else {"start.q": [x + 0.02 * (-1) ** i for i, x in enumerate(q)]}
    slower = {"start.v": (0.5 * rates).tolist()}
    wrong = {"start.q": [0.1] * 99, "start.v": [0.1] * 98}
    fast = {"start.v": [1e2] * len(rates)}
    return [near | slower, {"start.v": rates.tolist()}, far, wrong, near, fast, near | slower]


ENGINES = ("compiled", "pinocchio")


def from_elsewhere():
    """Return the scenarios that are started elsewhere, and engines: those above on both, others in turn.

    With the full budget all on both.
    """
    more = [name for name in shipped_scenarios() if name not in FROM_ELSEWHERE]
    slow = [(name, engine) for k, name in enumerate(more) for engine in budget((ENGINES[k % 2],), ENGINES)]
    quick = [(name, engine) for name in FROM_ELSEWHERE for engine in ENGINES]
    return [*quick, *others(slow)]


@pytest.mark.parametrize(("name", "engine"), from_elsewhere())
def test_a_run_from_another_start_equals_one_that_finds_nothing_made(name, engine):
    """What steps a problem is taken over for the next start, and nothing of the run before is left in it."""
    given = cl.load_scenario(name)
    steps = 40 * max(1, round((given.law.sample_period or 0.0) / given.time.step))
    noisy = RUBBING if name == "wam_slide_friction" else {}
    problem, cache = cl.prepare(given.replace({"time.duration": steps * given.time.step, **noisy})), Cache()
    if problem.tolerance is not None and engine == "compiled":
        pytest.skip("its integrator chooses its steps")
    model, ran = problem.robot.model, 0
    for change in starts(problem):
        scenario, found = problem.scenario.replace(change), []
        for kept in (cache, Cache()):
            try:
                started = prepare_module.prepare(scenario, model, kept)
                rows, events, failure, _ = run_loop(started, engine=engine)
                found.append((started.scenario, rows.copy(), events, str(failure), started.table.copy()))
                taken_over = started.spare
            except cl.ClosedLoopError as error:
                found.append(str(error))
        again, alone = found
        if isinstance(alone, str):
            assert again == alone
            continue
        ran += 1
        assert again[0] == alone[0]
        assert again[3] == alone[3]
        for one, other in zip((again[1], again[2], again[4]), (alone[1], alone[2], alone[4]), strict=True):
            np.testing.assert_array_equal(one, other)
    assert ran >= 2
    assert problem.tolerance is not None or engine in taken_over


def test_other_starts_are_run_by_the_same_memory():
    """`Problem.run` from other starts and `simulate` of their scenarios are the same runs, of one loop's memory."""
    problem = cl.prepare(scenario_with({"sensor.noise": 0.1}))
    runs, memories = [], set()
    for shift in (1e-3, -2e-3, 1e-3):
        cl.simulate(scenario_with({}), engine="compiled")  # of another model, in turns
        q = problem.q + shift
        runs.append(problem.run(q=q, engine="compiled"))
        with ThreadPoolExecutor(1) as pool:
            fresh = pool.submit(outcome, problem.scenario.replace({"start.q": q}), "compiled").result()
        assert same(runs[-1], fresh)
        assert runs[-1].scenario == fresh.scenario
        (calls,) = problem.spare.values()
        memories.add(calls.loop.address)
    assert same(runs[0], runs[2])
    assert not same(runs[0], runs[1])
    assert len(memories) == 1


# Values of many sections, some of which are back at what they were; those of the base are the last.
VALUES = (
    {"law.force": 12.0}, {"law.force": 13.0}, {"model_error.payload": 0.3}, {"model_error.payload": 0.0},
    {"tool.mass": 0.2}, {"friction.coefficient": 0.4}, {"compliance.stiffness": 2e4}, {"sensor.noise": 0.1},
    {"sensor.noise": 0.1, "sensor.seed": 4, "start.q": [1.5, 1.1, 0.0, 1.9]}, {"law.kind": "none"}, {"time.step": 5e-4},
    {"time.duration": 0.03, "law.force": 11.0}, {"law.stiffness": 500.0, "stabiliser.kind": "baumgarte"},
    {"surface.gap": 0.0}, {"encoder.velocity_noise": 1e-3}, {},
)  # fmt: skip


@pytest.mark.parametrize("engine", ENGINES)
def test_other_values_give_the_runs_of_their_scenarios(engine):
    """Whatever was run before, `Problem.run` with other values equals a call that finds nothing made."""
    given = {"time.duration": 0.02, "model_error.payload": 0.5}
    problem = cl.prepare(cl.load_scenario(SCENARIOS / "press.toml", given))
    ran = 0
    for changes in (*VALUES, *reversed(VALUES)):
        with ThreadPoolExecutor(1) as pool:
            alone = pool.submit(lambda changes=changes: cl.simulate(problem.scenario.replace(changes), engine=engine))
        here, fresh = attempt(lambda changes=changes: problem.run(changes, engine=engine)), attempt(alone.result)
        if isinstance(fresh, cl.Run):
            ran += 1
            assert same(here, fresh), changes
            assert here.scenario == fresh.scenario
        else:
            assert str(here) == str(fresh)
    assert ran >= 20


def test_threads_start_one_problem_elsewhere():
    """Each thread has a robot of its own for it, and the runs are those of one thread."""
    problem = cl.prepare(scenario_with({"reference.kind": "hold"}))
    starts = [problem.q + 1e-3 * k for k in range(12)]
    for engine in ENGINES:
        alone = [problem.run(q=q, engine=engine) for q in starts]
        with ThreadPoolExecutor(4) as pool:
            together = list(pool.map(lambda q, engine=engine: problem.run(q=q, engine=engine), starts))
        assert all(map(same, alone, together))
        assert len({run.q.tobytes() for run in alone}) == len(starts)


def test_what_is_made_of_sections_follows_them():
    """It is made anew where a section or a part that was read says other things, and nowhere else."""
    made = []

    def makes(name, make):
        return name, lambda given, parts: made.append(name) or make(given, parts)

    parts = Parts(
        dict([
            makes("force", lambda given, of: given.law.force if given.has_surface else 0.0),
            makes("large", lambda given, of: of.force > 11.0),
            makes("both", lambda given, of: (of.large, of.beside)),
        ]),
        ("beside",),
    )  # fmt: skip
    scenario = scenario_with({})
    stronger, longer = scenario.replace({"law.force": 12.0}), scenario.replace({"time.duration": 0.03})
    still = scenario.replace({"law.force": 10.5})
    for each, beside, anew in (
        (scenario, 1, "force large both"), (longer, 1, ""), (stronger, 1, "force large both"), (stronger, 2, "both"),
        (stronger, 2, ""), (scenario, 2, "force large both"), (still, 2, "force large"),
    ):  # fmt: skip
        found = parts.turn_to(each, beside=beside)
        assert found["force"] == each.law.force
        assert found["both"] == (each.law.force > 11.0, beside)
        assert made == anew.split()
        made.clear()
    parts.forget("large")
    parts.turn_to(still, beside=2)
    assert made == ["large"]


def test_what_is_made_of_a_law_without_its_force_cannot_depend_on_it():
    """It is made anew where another gain is said and not for another force, and fails where it reads the force."""
    made = []
    makers = {
        "forceless": lambda given, of: without(given.law, "force"),
        "gain": law_as("forceless", lambda given, of: made.append(given.law.kp) or (given.law.kp, given.has_surface)),
    }
    parts, scenario = Parts(makers, ()), scenario_with({})
    for changes in ({}, {"law.force": 12.0}, {"law.kp": 700.0}, {"law.kp": 700.0, "law.force": 3.0}):
        now = scenario.replace(changes) if changes else scenario
        assert parts.turn_to(now)["gain"] == (now.law.kp, True)
    assert made == [scenario.law.kp, 700.0]
    wrong = Parts(makers | {"gain": law_as("forceless", lambda given, of: given.law.force)}, ())
    with pytest.raises(AttributeError, match="force"):
        wrong.turn_to(scenario)


def test_what_could_not_be_made_is_made_next_time():
    """A part that is refused stays to be made, with all that follows, from the same scenario or from another."""

    def least(given, parts):
        if given.law.force < 5.0:
            raise cl.ScenarioError("too small")
        return given.law.force

    parts = Parts({"least": least, "twice": lambda given, of: 2.0 * of.least}, ())
    small, enough = scenario_with({"law.force": 3.0}), scenario_with({})
    for _ in range(2):
        with pytest.raises(cl.ScenarioError, match="too small"):
            parts.turn_to(small)
    for each in (enough, scenario_with({"law.force": 6.0})):
        assert parts.turn_to(each)["twice"] == 2.0 * each.law.force
        with pytest.raises(cl.ScenarioError, match="too small"):
            parts.turn_to(small)


@pytest.mark.parametrize("name", ["wam4", "planar2", "delta", "peg_gantry", "panda", "box"])
def test_the_tip_alone_is_that_of_all_terms(name):
    """A start asks for r and Jᵣ without H and C: they are the same to the bit."""
    robot = Robot(robot_models.load(name)) if name != "box" else cl.prepare(cl.load_scenario("cube_toss")).robot
    rng = np.random.default_rng(0)
    for _ in range(20):
        q, v = rng.uniform(-1.0, 1.0, robot.n), rng.normal(size=robot.n)
        terms, (position, jacobian) = robot.terms(q, v), robot.known_tip(robot.pinocchios(q))
        assert np.array_equal(position, terms.position)
        assert np.array_equal(jacobian, terms.jacobian)
        assert np.array_equal(position, robot.position(q))


def test_columns_are_made_once_and_stay():
    """A column is made when it is first asked for, and cannot be written to; a copy of the run has all of them."""
    run = cl.simulate(scenario_with({"law.force_integral": 1.0}))
    assert run.columns["q"] is run.q is run["q"]
    with pytest.raises(ValueError, match="read-only"):
        run.q[:] = 0.0
    with pytest.raises(KeyError):
        run.columns["no_such"]
    assert "no_such" not in run.columns
    assert "law_force_error" in run.columns
    again = pickle.loads(pickle.dumps(run))
    assert same(run, again)
    assert list(again.columns) == list(run.columns)
    assert (run.columns | {"q": 0})["q"] == 0


def test_what_a_run_leaves_in_the_memory_would_show(monkeypatch):
    """If the memory were not put back, the run from the next start would be another: the tests above see that."""
    begin = Driver.begin
    monkeypatch.setattr(Driver, "begin", lambda calls, *of: (calls._before.clear(), begin(calls, *of)))
    scenario, cache = scenario_with(RUBBING), Cache()
    runs = [run_loop(prepare_module.prepare(scenario, None, cache), engine="compiled")[0] for _ in range(2)]
    assert not np.array_equal(*runs)


def test_what_is_kept_for_another_start_holds_no_problem():
    """Tables and rows of runs of other forces and starts are not kept: they are most of the memory."""
    cache, seen = Cache(), []
    for changes in ({}, {"law.force": 3.0}, {"start.q": [0.1, -1.5, 0.05, 2.4]}, {"law.force": 4.0}):
        problem = prepare_module.prepare(scenario_with(changes), None, cache)
        rows = run_loop(problem, engine="compiled")[0]
        seen += [weakref.ref(problem), weakref.ref(rows.base)]
    del problem, rows
    gc.collect()
    assert [each() is None for each in seen] == [*[True] * (len(seen) - 2), False, True]  # but for the last one


def attempt(call):
    """Return what a call returns, or why it fails."""
    try:
        return call()
    except cl.ClosedLoopError as error:
        return error


def outcome(scenario, engine):
    """Return the run of a scenario, or why there is none."""
    return attempt(lambda: cl.simulate(scenario, engine=engine))


def test_a_robot_file_that_has_changed_is_read_again(tmp_path):
    """A file of the user's may be another one in the next call, with the same name."""
    file = tmp_path / "mine.urdf"
    text = robot_models.load("planar2").text
    file.write_text(text)
    scenario = cl.load_scenario("planar2_slide", {"robot.model": str(file), "time.duration": 0.01})
    before = cl.simulate(scenario)
    assert 'mass value="' in text
    head, _, rest = text.partition('mass value="')
    mass, _, tail = rest.partition('"')
    file.write_text(f'{head}mass value="{2.0 * float(mass)}"{tail}')
    after = cl.simulate(scenario)
    assert not np.array_equal(before.torque, after.torque)


def test_a_run_within_a_law_leaves_the_outer_one_alone():
    """A law of one's own may simulate the same robot: as a prediction, for example."""
    scenario = scenario_with({})
    problem = cl.prepare(scenario)

    def law(t, q, v, terms):
        return terms.bias - 10.0 * problem.plane.normal @ terms.jacobian

    def looks_ahead(t, q, v, terms):
        if t in (0.0, 0.01):
            cl.simulate(scenario_with({"law.force": 3.0}))
        return law(t, q, v, terms)

    plain, nested = cl.simulate(scenario, law=law), cl.simulate(scenario, law=looks_ahead)
    assert all(np.array_equal(plain[name], nested[name], equal_nan=True) for name in plain.columns)


def test_a_run_keeps_its_numbers():
    """What a later call overwrites is not what a run has recorded."""
    first = cl.simulate(scenario_with({}))
    kept = {name: values.copy() for name, values in columns_of(first).items()}
    cl.simulate(scenario_with({"law.force": 30.0, "sensor.noise": 0.5}))
    assert all(np.array_equal(kept[name], first[name], equal_nan=True) for name in kept)


def test_the_same_scenario_is_prepared_once(monkeypatch):
    """A second call of the same scenario reuses its problem; after another scenario, or a refused one, it does not."""
    scenario, made = scenario_with({}), []
    of = prepare_module.Problem.of
    monkeypatch.setattr(prepare_module.Problem, "of", lambda numbers: made.append(1) or of(numbers))
    louder = scenario_with({"sensor.noise": 0.1, "law.force": 30.0})
    refused = scenario_with({"compensation.kind": "normal", "law.force": 30.0})
    runs = [outcome(one, "pinocchio") for one in (scenario, scenario, louder, scenario, refused, scenario)]
    assert isinstance(runs[4], cl.ScenarioError)
    assert len(made) == 4
    assert all(same(runs[k], runs[0]) for k in (1, 3, 5))
