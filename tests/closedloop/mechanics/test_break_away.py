"""Break-away: every law of friction under every integrator and stabiliser passes it, and friction drives no tip."""

import numpy as np
import pytest
from break_away import INTEGRATORS, LAWS, STABILISERS, check, scenario
from budget import budget

import closedloop as cl

FIXED = INTEGRATORS[:3]


SCHEMES = [(integrator, stabiliser) for integrator in FIXED for stabiliser in STABILISERS]


@pytest.mark.parametrize(("law", "schemes"), [(law, SCHEMES[k % 4 :: budget(4, 1)]) for k, law in enumerate(LAWS)])
def test_a_block_breaks_away_in_steps_of_fixed_length(law, schemes):
    """Schemes and stabilisers in turn: from rest half round a circle, and in every row against the slip."""
    for integrator, stabiliser in schemes:
        check(cl.simulate(scenario(law, integrator, stabiliser)), law)


@pytest.mark.parametrize("changes", [{"friction": {"kind": "seven_parameter"} | LAWS["seven_parameter"]}])
def test_friction_that_lags_by_rows_is_refused_in_one_line(changes):
    """The memory of seven_parameter reads the recorded rows: a scheme that chooses its own steps has none to read."""
    with pytest.raises(cl.ScenarioError, match=r"friction\.kind = 'seven_parameter': depends on the step") as caught:
        cl.prepare(cl.load_scenario("wam_stick_slip", {"time.integrator": "dop853"} | changes))
    assert "\n" not in str(caught.value)


# Each law with the stabilisers in turn; on the block, with the full budget, with all.
MATRIX = [
    ("pointmass3", law, stabiliser)
    for k, law in enumerate(LAWS)
    for stabiliser in budget(STABILISERS[k % 4 :: 4], STABILISERS)
]
MATRIX += [("wam4", law, STABILISERS[(k + 1) % 4]) for k, law in enumerate(LAWS)]


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
