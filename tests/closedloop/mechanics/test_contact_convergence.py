"""A run in which a solution of contacts did not converge says so: planted, each where an iteration ends."""

import json
import os
import subprocess
import sys

import pytest

ROOT = os.path.dirname(os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__)))))

# A box that lands, slides and turns on its corners, in few steps. Interpreted, so that what is planted is used.
PROGRAM = """
import json, sys
import closedloop as cl
from closedloop.mechanics.contacts import stepping, turning, unknown_modes

def simulated(integrator):
    scenario = {
        "robot": {"model": "none"}, "time": {"duration": 4e-3, "step": 1e-3, "integrator": integrator},
        "body": [{"name": "box", "shape": "box", "edges": [0.2, 0.15, 0.1], "mass": 1.0,
                  "position": [0.0, 0.0, 0.05001], "velocity": [0.01, 0.02, 0.0], "spin": [0.0, 0.0, 0.8]}],
        "contact": [{"link": "box", "at": "collision", "friction": 0.5}],
    }
    run = cl.simulate(cl.Scenario.model_validate(scenario), progress=False)
    summary = run.summary()
    return {"rows": summary["rows_not_converged"], "off": float(run.residual_contacts.max()),
            "problems": {problem["name"]: problem["text"] for problem in summary["verdict"]["problems"]}}

def not_found(*args, **named):
    return False

said = {"time_stepping": simulated("time_stepping")}
kept, turning.ITERATIONS = turning.ITERATIONS, 1
said["rk4, one round"] = simulated("rk4")
turning.ITERATIONS = kept
unknown_modes.find_exactly, unknown_modes.ITERATIONS = not_found, 1
said["rk4, no modes, one round"] = simulated("rk4")
stepping.solve_step = not_found
said["time_stepping, not found"] = simulated("time_stepping")
print(json.dumps(said))
"""


@pytest.fixture(scope="module")
def said():
    """Return what each run says, by what was planted."""
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "1", "PYTHONPATH": ROOT}
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=True, timeout=300, env=environment
    )
    return json.loads(done.stdout)


@pytest.mark.parametrize("case", ["time_stepping", "rk4, one round"])
def test_what_converges_is_good(said, case):
    """Friction that one round does not turn is against the slip, and agrees with the forces."""
    assert said[case]["rows"] == 0
    assert said[case]["off"] < 1e-8
    assert "convergence" not in said[case]["problems"]


@pytest.mark.parametrize("planted", ["rk4, no modes, one round", "time_stepping, not found"])
def test_what_did_not_converge_is_counted_and_not_good(said, planted):
    """Impulses of compliant contacts, of one round, where none were found."""
    found = said[planted]
    assert found["rows"] > 0
    assert found["off"] > 1e-4
    assert f"did not converge in {found['rows']:.0f} of 5 rows" in found["problems"]["convergence"]
