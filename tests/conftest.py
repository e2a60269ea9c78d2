"""What holds for all tests.

Property tests draw the same examples each time, so that a change is judged by what it changes. And nothing is compiled
in the background, where it would take a core from the tests: what tests need is compiled first, and then kept.

python -m pytest --hypothesis-profile=explore      # other examples each time, to look for what was missed
"""

import gc
import os
import re
import signal
import sys
from collections import Counter
from importlib.util import find_spec
from pathlib import Path

import pytest
from hypothesis import settings

# Before numpy is imported: xdist has a process for each core, in which threads of BLAS wait for each other, spinning.
# They doubled the processor time of tests that fit.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from closedloop.command.compile_all import main as compile_all
from closedloop.command.compile_all import pieces
from closedloop.jit.background import VARIABLE
from closedloop.jit.cache_folder import cache_folder
from closedloop.jit.kernel import jit_disabled

# A first example may load or compile kernels, and machines are shared: no deadline.
# Fifty examples, where a test names no other number; `explore` draws hypothesis' hundred.
settings.register_profile("same", derandomize=True, deadline=None, max_examples=50)
settings.register_profile("explore", deadline=None)
settings.load_profile("same")
os.environ[VARIABLE] = "0"  # for the processes that tests start, too
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # as in a suite that a shell has started in the background
    signal.signal(signal.SIGINT, signal.default_int_handler)


# Files that take longest, in either suite: begun first, so that no process is left with one of them at the end. The
# others follow by their numbers of tests, as xdist would have them. `test_gradient` compiles the loop of dual numbers,
# which others need later; two processes that need it at the same time would both compile it.
LONGEST = (
    "test_gradient", "test_pages", "test_notebooks", "test_lab_browser", "test_inside", "test_followed",
    "test_background", "test_lab_shared", "test_environments", "test_command_line", "test_sweep_killed",
    "test_scenarios", "test_mutate", "test_new", "test_identify_contact", "test_contact_random_motions",
    "test_lab_robust", "test_serve", "test_sweep_signals", "test_one_command", "test_compiled_engine",
    "test_control_compensation", "test_contact_shape_pairs", "test_compile_command", "test_passive",
    "test_gradients", "test_robot_files", "test_integrator_choice", "test_simulator", "test_contact_energy",
    "test_speed", "test_tune", "test_loops", "test_gym", "test_identify", "test_record", "test_adaptive",
    "test_study_surfaces", "test_batch_memory", "test_linearise_runs", "test_results", "test_contact_soft",
    "test_contact_events", "test_dual8", "test_break_away", "test_adaptive_order", "test_impact_spatial",
    "test_peer_slides", "test_contact_rolling", "test_harness", "test_friction_simulated", "test_figures",
    "test_repeated", "test_optional", "test_study_controllers", "test_compiled_law", "test_lower_directly",
    "test_tree_terms", "test_contact_motion", "test_run_files", "test_bodies_known", "test_lab_command",
    "test_engines_agree", "test_sweep_disk", "test_friction_own", "test_tree_kernels", "test_impact_random",
    "test_sweep_fuzz", "test_solve", "test_user_law", "test_killed",
)  # fmt: skip


@pytest.hookimpl(wrapper=True)
def pytest_collection():
    """Let the collector of garbage pass over what the tests' modules make: it is there to stay."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.collect()
        gc.freeze()
        gc.set_threshold(100_000, 50, 100)  # Python's 700 objects cost the tests a twentieth of their time
        gc.enable()


def pytest_collection_modifyitems(items):
    """Put the files in the order in which they are to be begun."""
    tests = Counter(item.path for item in items)

    def place(item):
        name = item.path.stem
        return LONGEST.index(name) if name in LONGEST else len(LONGEST), -tests[item.path], str(item.path)

    items.sort(key=place)


# With the extra `physics` alone, what says that it lacks one of these packages is passed over.
PACKAGES = {"robots": ("example_robot_data",), "tables": ("pyarrow", "pandas", "xarray"), "peers": ("sympy", "mpmath")}


def passed_over(report, path):
    """Return a report of what failed for want of a package that is not installed as one of what was skipped."""
    if not report.failed:
        return report
    for extra, packages in PACKAGES.items():
        said = "|".join([rf"closedloop\[{extra}\]", *(f"No module named '{package}[.']" for package in packages)])
        if re.search(said, str(report.longrepr)) and not all(map(find_spec, packages)):
            report.outcome, report.longrepr = "skipped", (str(path), 0, f"Skipped: needs the extra {extra}")
            break
    return report


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(collector):
    """See `passed_over`."""
    return passed_over((yield), collector.path)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item):
    """See `passed_over`."""
    return passed_over((yield), item.path)


# Files of tests from which on all that ships is needed, and compiled beforehand.
MANY = 40


def pytest_sessionstart(session):
    """Compile what ships before a whole suite, once: before xdist starts its processes, which would share it badly.

    One that needs what another is compiling compiles it too. What is kept already is not touched.
    """
    config = session.config
    if hasattr(config, "workerinput") or config.option.collectonly or jit_disabled():
        return
    given = [Path(argument.partition("::")[0]) for argument in config.args]
    if sum(len(list(path.rglob("test_*.py"))) for path in given) < MANY:
        return
    kept = {file.name.partition(".")[2].rpartition("-")[0] for file in cache_folder().glob("*.nbc")}
    if missing := {piece.kernel for piece in pieces()} - kept:
        print(f"compiling {len(missing)} kernels, once, before the tests begin")
        compile_all([])


@pytest.fixture(autouse=True)
def no_modules_left(tmp_path_factory, monkeypatch):
    """Forget the modules that a test has written and imported, and where it looked for them.

    The next test may write a module of the same name.
    """
    monkeypatch.setattr(sys, "path", list(sys.path))
    known = set(sys.modules)
    yield
    below = tmp_path_factory.getbasetemp()
    for name in sys.modules.keys() - known:
        file = getattr(sys.modules[name], "__file__", None)
        if file and Path(file).is_relative_to(below):
            del sys.modules[name]
