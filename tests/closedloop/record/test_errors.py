"""Errors travel: between processes, into copies and back, with all that they carry."""

import copy
import importlib
import multiprocessing
import pickle
import pkgutil

import numpy as np
import pytest

import closedloop as cl
import robot_models

OURS = ("closedloop.", "robot_models.")
SHORT = {"time.duration": 0.02}
# Gains of a sign and size that diverge after a while, so that there is a run to be carried.
DIVERGES = {"time.duration": 0.6, "stabiliser.kind": "none", "law.kd": 4e4}


def classes():
    """Return the root of our errors and every class beneath it, the modules that define them imported first."""
    for package in (robot_models, cl):
        for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            if not module.name.endswith("__main__"):
                importlib.import_module(module.name)
    found, waiting = [], [cl.ClosedLoopError]
    while waiting:
        found.append(waiting.pop())
        waiting += [below for below in found[-1].__subclasses__() if below.__module__.startswith(OURS)]
    return found


@pytest.fixture(scope="module")
def stopped_run():
    """Return a run that stopped, from the error that says so."""
    with pytest.raises(cl.SimulationError) as stopped:
        cl.simulate(cl.load_scenario("wam_slide", DIVERGES))
    return stopped.value.run


def copies(error):
    """Yield the error as other processes and copies have it."""
    for protocol in range(pickle.HIGHEST_PROTOCOL + 1):
        yield pickle.loads(pickle.dumps(error, protocol))
    yield copy.deepcopy(error)
    yield copy.copy(error)


def test_every_error_travels_whole(stopped_run):
    """Class, message, arguments and what was attached, of every class of the hierarchy."""
    assert len(classes()) >= 11
    for kind in classes():
        simulation = issubclass(kind, cl.SimulationError)
        error = kind("what, where, what would be right", 1.5, stopped_run) if simulation else kind("what, where")
        error.add_note("seen by a test")
        error.attached = [1, 2]
        for travelled in copies(error):
            assert type(travelled) is kind
            assert str(travelled) == str(error)
            assert travelled.args == error.args
            assert travelled.__notes__ == ["seen by a test"]
            assert travelled.attached == [1, 2]
            if simulation:
                assert travelled.time == 1.5
                assert_same_run(travelled.run, stopped_run)


def assert_same_run(mine, theirs):
    """Compare two runs, whatever is in them."""
    assert mine.scenario == theirs.scenario
    assert mine.stopped == theirs.stopped
    assert (mine.law, mine.wall_seconds, dict(mine.versions)) == (
        theirs.law,
        theirs.wall_seconds,
        dict(theirs.versions),
    )
    assert mine.columns.keys() == theirs.columns.keys()
    for name, column in theirs.columns.items():
        np.testing.assert_array_equal(mine.columns[name], column)
        assert mine.columns[name].dtype == column.dtype
        assert not mine.columns[name].flags.writeable, name
    for name in ("text", "tip", "joint_names", "locked", "source"):
        assert getattr(mine.model, name) == getattr(theirs.model, name)
    np.testing.assert_array_equal(mine.model.armature, theirs.model.armature)
    assert not mine.model.armature.flags.writeable
    assert mine.summary() == theirs.summary()


def test_a_run_travels_before_and_after_its_summary(stopped_run):
    """A run can be pickled and copied, whether or not what is worked out once has been worked out."""
    run = cl.simulate(cl.load_scenario("wam_slide", SHORT))
    for travelled in (pickle.loads(pickle.dumps(run)), copy.deepcopy(run)):
        assert_same_run(travelled, run)
    assert run.events == ()
    assert_same_run(pickle.loads(pickle.dumps(run)), run)


def final_force(values):
    """Return the last contact force of a short slide: what a process of a pool does."""
    return float(cl.simulate(cl.load_scenario("wam_slide", values)).contact_force[-1])


@pytest.mark.slow
@pytest.mark.parametrize(
    "method", [method for method in ("fork", "spawn") if method in multiprocessing.get_all_start_methods()]
)
def test_a_run_that_diverges_does_not_hang_a_pool(method):
    """Of three runs in a pool the second diverges: its error comes back with what ran, and the others do."""
    with multiprocessing.get_context(method).Pool(1) as pool:
        waiting = [pool.apply_async(final_force, (values,)) for values in (SHORT, DIVERGES, SHORT)]
        good, bad, also = waiting
        assert good.get(timeout=120) == also.get(timeout=120)
        with pytest.raises(cl.DivergenceError) as stopped:
            bad.get(timeout=120)
    assert stopped.value.time > 0.0
    assert len(stopped.value.run) > 10
    assert stopped.value.run.model.name == "wam4"


def test_divergence_of_joints_that_rub_is_not_laid_to_a_law():
    """Friction takes the speed of an arm many times in a step; there is no law whose gains could be looked at."""
    rubs = {"kind": "coulomb_viscous", "kinetic": 0.1, "viscous": 700.0}
    with pytest.raises(cl.DivergenceError, match=r"look at joint_friction\.viscous, and at time\.step$"):
        cl.simulate(cl.load_scenario("planar2_drop", {"law.kind": "none", "joint_friction": rubs}))
