"""The kernels without the compiler: the same bits, and a run that begins with them."""

import logging
import types
from collections import Counter, defaultdict

import numba
import numpy as np
import pytest
from budget import budget

import closedloop as cl
from closedloop.control.reference.desired import follow
from closedloop.jit import background, calls, interim
from closedloop.jit.calls import call_at, forget_entry, interpreted_address
from closedloop.jit.interim import PROBE, Interim
from closedloop.jit.interpreted import interpreted
from closedloop.loop.events.transitions import collide
from closedloop.loop.step.record_row import complete_record
from closedloop.record.report.measures import measure_rows
from closedloop.simulation.engines.loops import COMPILED, ENGINES, PINOCCHIO, loop_for, proceed_at
from closedloop.simulation.parts import _kept
from closedloop.simulation.prepare import prepare

SHORT = {"time.duration": 0.06}
AT_ONCE = {"reference.start": 0.0, "reference.stop": 0.5}  # a short path: the interpreter finds the joints along it
EARLY = AT_ONCE | {"reference.start": 0.02, "law.pd_start": 0.01}
CASES = {
    "the paper's law": ("wam_slide", EARLY),
    "seven joints": ("panda_slide", EARLY | {"time.duration": 0.03}),
    "fourth order": ("planar2_slide", EARLY | {"time.integrator": "rk4", "law.sample_period": 0.002}),
    "an impact": ("wam_touchdown", {"surface.gap": 1e-6, "reference.kind": "hold"}),
    "impacts with friction": ("planar2_drop", {"surface.gap": 1e-5}),
    "a tip that leaves": ("wam_liftoff", {"time.duration": 0.1}),
    "projection": ("wam_slide", EARLY | {"stabiliser.kind": "projection"}),
    "friction": ("wam_slide_friction", AT_ONCE),
    "stick and slip": ("wam_stick_slip", AT_ONCE),
    "friction in the joints": ("joint_friction", {"time.duration": 0.03}),
    "a law of force and motion": ("wam_hybrid_friction", AT_ONCE),
    "friction with a memory": (
        "wam_slide_friction",
        AT_ONCE | {"friction.kind": "lugre", "friction.kinetic": 0.2, "friction.static": 0.3,
         "friction.stribeck_speed": 0.003, "friction.stiffness": 1e4, "friction.damping": 10.0},
    ),
    "an observer, a sensor": (
        "wam_slide_friction",
        AT_ONCE | {"law.kind": "impedance", "law.force_integral": 20.0, "compensation.kind": "observer",
         "compensation.rate": 100.0, "sensor.delay": 0.004, "sensor.noise": 0.1},
    ),
    "loops": ("four_bar", {"time.duration": 0.02}),
    "contacts of links": ("gripper_gear", {"time.duration": 0.004, "time.integrator": "semi_implicit_euler"}),
}  # fmt: skip


@pytest.fixture
def nothing_compiled(monkeypatch):
    """Let no kernel have a compiled form, and none get one; return the names of what is wanted in the background."""
    wanted = []

    def never(*arguments):
        raise AssertionError("something is compiled")

    monkeypatch.setattr(background, "refused", lambda: "")
    for module in (interim, background):
        monkeypatch.setattr(module, "needs_compiling", lambda function: True)
    monkeypatch.setattr(interim, "direct", never)
    monkeypatch.setattr(background, "start", lambda functions: wanted.append([f.__name__ for f in functions]))
    return wanted


def bits(run):
    """Return the columns of a run as bytes."""
    return {name: column.tobytes() for name, column in run.columns.items()}


@pytest.mark.parametrize(("name", "engine"), [(name, ENGINES[k % 2]) for k, name in enumerate(CASES)])
def test_an_interpreted_run_is_the_compiled_one_to_the_last_bit(name, engine, request, monkeypatch):
    """Every column and every event: laws, friction, impacts and integrators, on the two engines in turn."""
    shipped, changes = CASES[name]
    scenario = cl.load_scenario(shipped, SHORT | changes)
    compiled = cl.simulate(scenario, engine=engine)
    wanted = request.getfixturevalue("nothing_compiled")
    interim._so_far[loop_for(engine).__name__] += PROBE  # a short run asks for compiled code after others
    run = prepare(scenario).run(engine=engine)
    assert any(loop_for(engine).__name__ in names for names in wanted if len(names) > 1)
    assert np.ptp(run.contact_force) > 0.0 or np.ptp(run.q) > 0.0
    assert bits(run) == bits(compiled)


def test_a_path_of_a_mechanism_is_interpreted_to_the_last_bit(nothing_compiled, monkeypatch):
    """Postures along the path, with the loops closed, before their kernels are there."""
    problem = prepare(cl.load_scenario("five_bar"))
    compiled = problem.wanted.joints
    for module in ("closedloop.jit.kernel.Kernel.__call__", "closedloop.jit.interim.entry_address"):
        monkeypatch.setattr(module, lambda *_: pytest.fail("something is compiled"))
    with interim.not_compiled_first():
        path = follow(problem.robot, compiled.q[0], problem.wanted.tip)
    for name in ("times", "q", "v"):
        assert getattr(path, name).tobytes() == getattr(compiled, name).tobytes()


@pytest.mark.parametrize("name", ["wam_slide", "panda_scan", "four_bar", "wam_slide_friction", "gripper_gear"])
def test_all_that_the_loop_calls_is_compiled_with_it(name):
    """What gets an address in the loop's memory is known beforehand: a run waits for all of it, or for nothing."""
    problem = prepare(cl.load_scenario(name, {"time.duration": 0.01}))
    loop, connected = problem.loop(), []
    problem.connect(loop, machine=lambda entry: connected.append(entry) or 0)
    assert proceed_at in connected
    assert {id(entry) for entry in connected if entry is not proceed_at} == {id(e) for e in problem.called(loop)}


def test_a_law_of_ones_own_is_asked_as_often(nothing_compiled):
    """On the Pinocchio engine a Python law drives an interpreted run too."""
    asked = []

    def law(t, q, v, terms):
        asked.append(t)
        return terms.bias - 10.0 * terms.jacobian[2]

    run = cl.simulate(cl.load_scenario("wam_slide", {"time.duration": 0.02}), law=law)
    assert len(asked) == len(run) == 21
    assert run.contact_force == pytest.approx(10.0, abs=1e-6)


@pytest.mark.parametrize("kernel", [
    *(loop_for(engine) for engine in ENGINES), collide, complete_record, measure_rows,
])  # fmt: skip
def test_a_twin_calls_nothing_compiled(kernel):
    """Every function that a twin can reach is a twin: one that was left out would be compiled."""
    seen, waiting = set(), [interpreted(kernel)]
    while waiting:
        function = waiting.pop()
        if id(function) in seen:
            continue
        seen.add(id(function))
        assert not hasattr(function, "py_func"), function
        codes = [function.__code__, *(c for c in function.__code__.co_consts if isinstance(c, types.CodeType))]
        cells = [cell.cell_contents for cell in function.__closure__ or ()]
        found = [function.__globals__.get(name) for code in codes for name in code.co_names] + cells
        waiting += [x for x in found if isinstance(x, types.FunctionType) or hasattr(x, "py_func")]
    assert len(seen) > 1
    assert interpreted(kernel) is interpreted(kernel)


def test_hypotenuse_is_that_of_the_c_library():
    """Python's own differs from it in the last bit for one pair in some thousand."""

    @numba.njit
    def length(x, y):
        import math

        return math.hypot(x, y)

    @numba.njit
    def of(x, y):
        return interpreted_math.hypot(x, y)

    import math as interpreted_math

    x, y = np.random.default_rng(0).normal(size=(2, 20_000))
    twin = interpreted(of)
    assert all(twin(a, b) == of(a, b) for a, b in zip(x, y, strict=True))


@numba.njit(error_model="numpy")
def over(x, out):
    """Count, and divide; in Python 1.0 / 0.0 raises."""
    out[0] += 1.0
    out[1] = 1.0 / float(x)


def test_where_python_raises_the_compiled_form_goes_on():
    """It begins from what the call before has left: nothing is counted twice, nothing is lost."""
    out = np.zeros(2)
    not_compiled = numba.njit(error_model="numpy")(over.py_func)  # as `over` may be, by another test
    kernel = Interim(not_compiled, (out,), 1000)
    kernel(2.0, out)
    assert kernel.interpreting
    assert out.tolist() == [1.0, 0.5]
    kernel(0.0, out)
    assert not kernel.interpreting
    assert out.tolist() == [2.0, np.inf]
    kernel(4.0, out)
    assert out.tolist() == [3.0, 0.25]


def test_an_interrupted_call_leaves_no_trace(monkeypatch, nothing_compiled):
    """Ctrl-C comes anywhere in an interpreted call: the state is that between two calls."""
    out = np.zeros(2)
    kernel = Interim(over, (out,), 1000)
    kernel(2.0, out)

    def interrupted(x, out):
        out[0] += 1.0
        raise KeyboardInterrupt

    monkeypatch.setattr(kernel, "_twin", interrupted)
    with pytest.raises(KeyboardInterrupt):
        kernel(0.0, out)
    assert out.tolist() == [1.0, 0.5]


def decided(monkeypatch, calls, seconds):
    """Return what an interim kernel decides in its first calls: "background", "compiled" or both."""
    done = []
    monkeypatch.setattr(interim, "_so_far", Counter())
    monkeypatch.setattr(background, "start", lambda functions: done.append("background"))
    monkeypatch.setattr(background, "make_ready", lambda *functions: done.append("compiled"))
    monkeypatch.setattr(background, "seconds_left", lambda functions: seconds)
    monkeypatch.setattr(interim, "direct", lambda function, *arguments: function.py_func)
    monkeypatch.setattr(interim, "needs_compiling", lambda function: True)
    out = np.zeros(2)
    kernel = Interim(over, (out,), calls)
    for _ in range(2 * PROBE):
        kernel(2.0, out)
    assert out[0] == 2 * PROBE
    assert kernel.interpreting == ("compiled" not in done)
    return set(done)


@pytest.mark.parametrize(
    ("calls", "seconds", "does"),
    [
        (200, 100.0, {"background"}),
        (10**9, 100.0, {"background", "compiled"}),
        (10**6, 1e-6, {"background", "compiled"}),
    ],
)
def test_whether_to_wait_is_judged_by_what_is_ahead(monkeypatch, calls, seconds, does):
    """A short run goes on while another process compiles; a long one waits for the compiler."""
    assert decided(monkeypatch, calls, seconds) == does


def test_it_is_judged_again(monkeypatch):
    """A run that is slower later on, as when a body is pushed at last, waits for the compiler then."""
    time = types.SimpleNamespace(now=0.0)
    time.perf_counter = time.thread_time = lambda: time.now
    waited = []
    monkeypatch.setattr(interim, "clock", time)
    monkeypatch.setattr(background, "start", lambda functions: None)
    monkeypatch.setattr(background, "make_ready", lambda *functions: waited.append(round(time.now)))
    monkeypatch.setattr(background, "seconds_left", lambda functions: 30.0 - time.now)
    monkeypatch.setattr(interim, "direct", lambda function, *arguments: function.py_func)
    monkeypatch.setattr(interim, "needs_compiling", lambda function: True)
    out = np.zeros(2)
    kernel = Interim(over, (out,), 10_000)
    monkeypatch.setattr(kernel, "_twin", lambda *_: setattr(time, "now", time.now + (1e-3 if time.now < 5.0 else 0.1)))
    while not waited and time.now < 100.0:
        kernel(2.0, out)
    assert waited == [6]


def test_what_a_kernel_calls_is_used_as_soon_as_it_is_compiled(monkeypatch):
    """Once, before the kernel itself is, which goes on interpreted until then."""
    ready, done, out = {}, [], np.zeros(2)
    monkeypatch.setattr(interim, "PROBE", 2)
    monkeypatch.setattr(interim, "BETWEEN_LOOKS", 0.0)
    monkeypatch.setattr(interim, "needs_compiling", lambda function: not ready["all" if function is over else "called"])
    monkeypatch.setattr(interim, "direct", lambda function, *arguments: function.py_func)
    monkeypatch.setattr(background, "start", lambda functions: None)
    monkeypatch.setattr(background, "make_ready", lambda *functions: None)
    monkeypatch.setattr(background, "seconds_left", lambda functions: 1e9)
    kernel = Interim(
        over, (out,), 12, called=(collide,), on_called_compiled=lambda: done.append("called"),
        on_compiled=lambda: done.append("all"),
    )  # fmt: skip
    for call in range(12):
        ready.update(called=call >= 3, all=call >= 8)
        kernel(2.0, out)
    assert done == ["called", "all"]
    assert out[0] == 12.0
    assert not kernel.interpreting


CALLED = budget(("an observer, a sensor", "loops"), ("an observer, a sensor", "loops", "contacts of links"))


@pytest.mark.slow
@pytest.mark.parametrize("name", CALLED)
def test_an_interpreted_loop_calls_what_is_compiled(name, monkeypatch):
    """What it calls by address may be there before it: the same bits, and none of it is interpreted any more."""
    scenario = cl.load_scenario(CASES[name][0], SHORT | CASES[name][1])
    sound, called = bits(cl.simulate(scenario)), set()
    function_at = calls.function_at
    monkeypatch.setattr(calls, "function_at", lambda address: called.add(address) or function_at(address))
    monkeypatch.setattr(background, "refused", lambda: "")
    monkeypatch.setattr(background, "start", lambda functions: None)
    monkeypatch.setattr(background, "seconds_left", lambda functions: 1e9)
    monkeypatch.setattr(interim, "PROBE", 3)
    monkeypatch.setattr(interim, "BETWEEN_LOOKS", 0.0)
    monkeypatch.setattr(interim, "needs_compiling", lambda function: function is proceed_at)
    monkeypatch.setattr(interim, "direct", lambda function, *_: pytest.fail(f"{function.__name__} is compiled"))
    problem = prepare(scenario)
    assert bits(problem.run()) == sound
    assert called >= {calls.entry_address(entry) for entry in problem.called(problem.loop())}


def test_a_run_asks_again_until_its_loop_is_compiled(monkeypatch):
    """A process that compiles something else at first does not leave a long run interpreted to its end."""
    asked = []
    monkeypatch.setattr(interim, "BETWEEN_LOOKS", 0.0)
    monkeypatch.setattr(interim, "needs_compiling", lambda function: True)
    monkeypatch.setattr(background, "start", lambda functions: asked.append(functions))
    monkeypatch.setattr(background, "seconds_left", lambda functions: 1e9)
    out = np.zeros(2)
    kernel = Interim(over, (out,), 2 * PROBE)
    for _ in range(2 * PROBE):
        kernel(2.0, out)
    assert asked == [[over]] * PROBE


@pytest.mark.parametrize(
    ("brief", "spent", "does"), [(True, 0.0, "interpreted"), (True, 1e3, "compiled"), (False, 0.0, "compiled")]
)
def test_many_brief_calls_are_compiled_once_that_would_have_been_sooner(monkeypatch, brief, spent, does):
    """The inverse kinematics of a path of many parts: each is brief, and all together are not."""
    done, out = [], np.zeros(2)
    for module in (interim, background):
        monkeypatch.setattr(module, "needs_compiling", lambda function: True)
    monkeypatch.setattr(background, "refused", lambda: "")
    monkeypatch.setattr(background, "make_ready", lambda *functions: done.append("compiled"))
    monkeypatch.setattr(interim, "_spent", defaultdict(float, over=spent))
    monkeypatch.setattr(interim, "interpreted", lambda function: done.append("interpreted") or function.py_func)
    with interim.not_compiled_first():
        interim.call_once(over, (out,), brief, 2.0, out)
    assert done == [does]
    assert out.tolist() == [1.0, 0.5]
    assert (interim._spent["over"] > spent) == (does == "interpreted")


def test_many_short_runs_are_as_good_as_a_long_one(monkeypatch):
    """Runs of a few steps each do not stay interpreted for ever: their calls are counted together."""
    asked = []
    monkeypatch.setattr(interim, "_so_far", Counter())
    monkeypatch.setattr(interim, "needs_compiling", lambda function: True)
    monkeypatch.setattr(background, "start", lambda functions: asked.append(functions))
    out = np.zeros(2)
    for _ in range(PROBE):
        Interim(over, (out,), 1)(2.0, out)
    assert asked == []
    Interim(over, (out,), 1)(2.0, out)
    assert asked == [[over]]


def test_the_same_run_goes_over_to_the_compiled_form(monkeypatch):
    """As soon as it is there, without a trace in the result."""
    scenario = cl.load_scenario("wam_slide", {"time.duration": 0.3, "reference.start": 0.02, "law.pd_start": 0.0})
    sound, loops = cl.simulate(scenario), []
    monkeypatch.setattr(background, "refused", lambda: "")
    monkeypatch.setattr(background, "start", lambda functions: None)
    monkeypatch.setattr(interim, "BETWEEN_LOOKS", 0.01)
    lacking = lambda function: function is proceed_at and not (loops and loops[0]._done >= 2 * PROBE)  # noqa: E731
    monkeypatch.setattr(interim, "needs_compiling", lacking)
    init = Interim.__init__

    def noted(self, *arguments, **named):
        init(self, *arguments, **named)
        loops.append(self)

    monkeypatch.setattr(Interim, "__init__", noted)
    run = prepare(scenario).run()
    assert not loops[0].interpreting
    assert 0 < loops[0]._done < 300
    assert bits(run) == bits(sound)


def test_where_background_processes_are_refused_the_loop_is_compiled_first(monkeypatch, caplog):
    """As a batch does it, and in the same words, each of which is said once."""
    monkeypatch.setenv(background.VARIABLE, "0")
    monkeypatch.setattr(background, "needs_compiling", lambda function: True)
    monkeypatch.setattr(interim, "needs_compiling", lambda function: True)
    monkeypatch.setattr(background, "_said", set())
    monkeypatch.setattr(Interim, "__call__", lambda *_: pytest.fail("interpreted"))
    monkeypatch.setattr(_kept, "caches", [])  # which may have the path of an earlier test
    with caplog.at_level(logging.INFO, "closedloop.compiling"):
        cl.simulate(cl.load_scenario("wam_slide", {"time.duration": 0.01}))
        cl.simulate_batch(cl.load_scenario("wam_slide", {"time.duration": 0.01}), {"law.force": [1.0, 2.0, 3.0]})
    named = [line.removeprefix("compiling ").partition(" (once for this installation, ")[0] for line in caplog.messages]
    assert named == ["the inverse kinematics of a path", "the step", "the step of eight runs at a time"]


@pytest.mark.parametrize("engine", [PINOCCHIO, COMPILED])
def test_ctrl_c_in_an_interpreted_run_keeps_its_rows(engine, nothing_compiled):
    """What ran until then is there, complete, and is what an uninterrupted run has."""
    scenario = cl.load_scenario("wam_slide", {"time.duration": 0.2, "reference.start": 0.02, "law.pd_start": 0.0})
    whole = cl.simulate(scenario, engine=engine)
    calls = []

    def stop(done, total):
        calls.append(done)
        if done >= 1:
            raise KeyboardInterrupt

    with pytest.raises(cl.InterruptedRunError) as caught:
        cl.simulate(scenario, engine=engine, progress=stop)
    run = caught.value.run
    assert 1 <= len(run) <= len(whole)
    for name, column in run.columns.items():
        if len(column) == len(run):
            assert column.tobytes() == whole.columns[name][: len(run)].tobytes(), name


def test_an_entry_is_called_each_time():
    """The same call of an entry by its number is made again each time: a law is asked at every state."""
    calls = []
    number = interpreted_address(lambda loop, what: len(calls.append((loop, what)) or calls))
    assert [call_at(number, 5, 0), call_at(number, 5, 0)] == [1, 2]
    assert calls == [(5, 0), (5, 0)]
    forget_entry(number)
