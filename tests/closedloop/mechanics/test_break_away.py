"""Break-away: every law of friction under every integrator and stabiliser passes it, and friction drives no tip."""

import json
import os
import subprocess
import sys

import break_away
import numpy as np
import pytest
from break_away import INTEGRATORS, LAWS, PULLED, STABILISERS, check, scenario
from budget import budget

import closedloop as cl

FIXED = INTEGRATORS[:3]


SCHEMES = [(integrator, stabiliser) for integrator in FIXED for stabiliser in STABILISERS]


@pytest.mark.parametrize(
    ("law", "schemes"),
    [
        *((law, SCHEMES[k % 4 :: 4]) for k, law in enumerate(LAWS)),
        *(pytest.param(law, SCHEMES, marks=pytest.mark.slow) for law in LAWS),
    ],
)
def test_a_block_breaks_away_in_steps_of_fixed_length(law, schemes):
    """Schemes and stabilisers, quickly in turn: from rest half round a circle, and in every row against the slip."""
    for integrator, stabiliser in schemes:
        check(cl.simulate(scenario(law, integrator, stabiliser)), law)


@pytest.fixture(scope="module")
def adaptive():
    """Return what the adaptive integrator makes of break-away; interpreted, which is quicker than to compile it."""
    done = subprocess.run(
        [sys.executable, break_away.__file__],
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | {"NUMBA_DISABLE_JIT": "1", "PYTHONPATH": os.pathsep.join(sys.path)},
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.slow
@pytest.mark.parametrize(("law", "tolerance"), PULLED)
def test_an_adaptive_step_breaks_away_along_the_pull(adaptive, law, tolerance):
    """Pulled askew ever harder, a block slides off when and as the closed form says, straight along the pull.

    With karnopp the acceleration jumps, with coulomb it starts from zero; either way there is one event at any
    tolerance. An error in the normal force is in the instant of break-away: 1e-6 of 10 N at 100 N/s.
    """
    found, allowed = adaptive[f"{law} {tolerance:g}"], tolerance
    assert found["rows"] == 41
    assert found["kinds"] == ["slip"]
    assert found["late"] < 1e-13 + allowed
    assert found["across"] < 1e-13 + 0.1 * allowed
    assert found["along"] < 1e-13 + allowed
    assert found["driven"] <= 1e-14


@pytest.mark.slow
def test_an_adaptive_step_breaks_away_on_a_path_that_turns(adaptive):
    """With friction that falls smoothly from its static level slip starts as t², and its direction turns: one event."""
    assert adaptive["turning"]["rows"] == 31
    assert adaptive["turning"]["kinds"] == ["slip"]
    assert adaptive["turning"]["driven"] <= 1e-14


@pytest.mark.parametrize("changes", [{"friction": {"kind": "seven_parameter"} | LAWS["seven_parameter"]}])
def test_friction_that_lags_by_rows_is_refused_in_one_line(changes):
    """The memory of seven_parameter reads the recorded rows: a scheme that chooses its own steps has none to read."""
    with pytest.raises(cl.ScenarioError, match=r"friction\.kind = 'seven_parameter': depends on the step") as caught:
        cl.prepare(cl.load_scenario("wam_stick_slip", {"time.integrator": "dop853"} | changes))
    assert "\n" not in str(caught.value)


# On the arm each law, with the stabilisers in turn: what differs between them there, differs on the block, where each
# law has two of them in turn, with the full budget all.
MATRIX = [
    ("pointmass3", law, stabiliser)
    for k, law in enumerate(LAWS)
    for stabiliser in budget(tuple(STABILISERS)[k % 2 :: 2], STABILISERS)
]
MATRIX += [("wam4", law, tuple(STABILISERS)[k % len(STABILISERS)]) for k, law in enumerate(LAWS)]


@pytest.mark.slow  # compiles the adaptive scheme with friction
@pytest.mark.parametrize(("arm", "law", "stabiliser"), MATRIX)
def test_every_law_scheme_and_stabiliser_passes_break_away(law, stabiliser, arm):
    """The whole matrix, on a block and on an arm; the block in steps of fixed length is in the test further above."""
    for integrator in INTEGRATORS if arm == "wam4" else ("dop853",):
        if integrator == "dop853" and law == "seven_parameter":
            continue  # refused, see above
        check(cl.simulate(scenario(law, integrator, stabiliser, arm)), law)


@pytest.mark.slow
@pytest.mark.parametrize("law", ["coulomb", "stribeck", "karnopp"])
def test_rk4_converges_to_the_adaptive_run_through_break_away(law):
    """Half the step leaves less than half the error of position and force, down to a nanometre.

    The friction of a slow tip points to where slip is at the end of RK4's step: that is its error, and of order one
    where slip is slow, two and more in the path.
    """
    time = {"duration": 0.2, "step": 2e-3}
    truth = cl.simulate(scenario(law, "dop853", "projection", **time))
    found = []
    for h in (1e-3, 5e-4, 2.5e-4, 1.25e-4):
        run = cl.simulate(scenario(law, "rk4", "projection", **time | {"step": h}))
        assert [event.kind for event in run.events] == [event.kind for event in truth.events]
        every = round(2e-3 / h)
        late = truth.time > truth.event_time[0] + 0.02
        found.append(
            [
                np.max(np.abs(run.position[::every] - truth.position)),
                np.max(np.abs(run.friction_force[::every] - truth.friction_force)[late]),
            ]
        )
    found = np.array(found)
    assert found[-1, 0] < 1e-9, found
    assert np.all(np.log2(found[0] / found[-1]) / 3 > (1.8, 0.9)), found
