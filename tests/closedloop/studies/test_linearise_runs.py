"""The linear loop against small steps of the run itself, and the columns that disturb it."""

import itertools
import math

import numpy as np
import pytest
from budget import every
from linear_loops import mass_on_a_spring

import closedloop as cl
from closedloop.control.reference.desired import Reference
from closedloop.loop.step.record_row import ContactRow, Row
from closedloop.scenario.tables import names_of
from closedloop.simulation.prepare import prepare
from closedloop.studies.analysis.assembly import instant_of, loop_at
from closedloop.studies.analysis.here import rows_on, run_on

PULSES = {
    "wam_slide": ("wam_slide", {}),
    "soft_table": ("soft_table", {}),
    "wam_hybrid_friction": ("wam_hybrid_friction", {}),
    "integral": ("soft_table", {"law.force_integral": 20.0}),
    "late": ("soft_table", {
        "law.force_integral": 20.0, "law.force_feedback": 0.2, "sensor.delay": 0.004,
        "sensor.filter_time_constant": 0.006, "law.sample_period": 0.002,
    }),
    "elastic": ("soft_table", {
        "law.force_integral": 20.0, "transmission.stiffness": 5000.0, "transmission.damping": 10.0,
    }),
    "four bars": ("four_bar", {
        "time.duration": 1.0, "time.integrator": "semi_implicit_euler", "compliance.kind": "kelvin_voigt",
        "compliance.damping": 400.0, "law.force_integral": 10.0, "sensor.delay": 0.004,
    }),
    "delta": ("delta", {"time.duration": 2.0, "compliance.kind": "kelvin_voigt", "compliance.stiffness": 2e4,
        "encoder.velocity": "difference", "encoder.filter_time_constant": 0.003,
    }),
    "stops": ("soft_table", {"robot.stops": True}),
    "encoders": ("wam_hybrid_friction", {
        "encoder.velocity": "difference", "encoder.filter_time_constant": 0.003, "compliance.kind": "kelvin_voigt",
    }),
}  # fmt: skip


def steps_of_a_bias(make, size):
    """Return f of runs, per newton, whose sensor is wrong by ± size, and that of the linear loop, sample by sample.

    `make` gives the scenario of a bias; at rest before t = 0 all readings in the sensor have it.
    """
    runs = [cl.simulate(make(bias), progress=False) for bias in (size, -size)]
    loop = cl.linearise(make(0.0), at=0.0)
    at, by = loop.output("contact force"), loop.input("sensor noise")
    x = np.array([float(state.name.startswith("reading")) for state in loop.states])
    hold, wanted = round(loop.dt / make(0.0).time.step), []
    seen = ((runs[0].contact_force - runs[1].contact_force) / (2.0 * size))[::hold]
    for _ in seen:
        wanted.append(loop.C[at] @ x + loop.D[at, by])
        x = loop.A @ x + loop.B[:, by]
    return seen, np.array(wanted)


SCHEMES = ("rk4", "explicit_euler", "semi_implicit_euler", "dop853")


@pytest.mark.parametrize(
    ("scheme", "held", "delay", "low_pass"),
    every(5, itertools.product(SCHEMES, (0, 1, 2), (0, 1, 3), (0.0, 0.004))),
)
def test_steps_of_the_linear_loop_are_those_of_a_run(scheme, held, delay, low_pass):
    """Of a mass on a spring, whose run is linear, to 1e-9: each integrator × sampling × delay × low-pass.

    What reaches the force after many samples has passed through every state of the loop.
    """
    h = 0.0005
    changes = {
        "time__integrator": scheme, "time__step": h, "time__duration": 40 * h, "law__force_feedback": 0.3,
        "sensor__delay": delay * h * max(held, 1), "sensor__filter_time_constant": low_pass,
    }  # fmt: skip
    if held:
        changes["law__sample_period"] = held * h
    if scheme == "dop853":
        changes["time__tolerance"] = 1e-12
    seen, wanted = steps_of_a_bias(lambda bias: mass_on_a_spring(**changes, sensor__bias=bias), 0.1)
    np.testing.assert_allclose(seen, wanted, rtol=0, atol=1e-9)
    assert np.max(np.abs(seen)) > 0.3


FORCE_LAW = {"kind": "operational_space", "force": 10.0, "force_integral": 20.0, "force_feedback": 0.2}
ARMS = {
    "an admittance": {"law": {"kind": "admittance", "force": 10.0, "admittance_inertia": 2.0,
                              "admittance_damping": 200.0}, "sensor.delay": 0.002},
    "an observer": {"law": FORCE_LAW, "compensation.kind": "observer"},
    "differences of encoders": {"law": FORCE_LAW, "compensation.kind": "observer", "encoder.velocity": "difference",
                                "encoder.filter_time_constant": 0.003, "sensor.delay": 0.002},
    "elastic joints": {"law": FORCE_LAW, "transmission.stiffness": 5000.0, "transmission.damping": 10.0,
                       "sensor.delay": 0.002},
}  # fmt: skip


@pytest.mark.parametrize(
    ("arm", "scheme"), every(2, [(arm, scheme) for arm in ARMS for scheme in ("rk4", "semi_implicit_euler")])
)
def test_steps_of_an_arm_at_rest(arm, scheme):
    """What sensor, encoders and elastic joints bring into the steps of an arm, by small steps of the run, to 1e-7."""
    changes = ARMS[arm] | {
        "surface.contact": "bilateral", "reference.kind": "hold", "time.duration": 0.04, "time.integrator": scheme,
    }  # fmt: skip
    seen, wanted = steps_of_a_bias(lambda bias: cl.load_scenario("soft_table", changes | {"sensor.bias": bias}), 1e-3)
    np.testing.assert_allclose(seen, wanted, rtol=0, atol=1e-7)
    assert np.max(np.abs(seen)) > 0.1


@pytest.mark.parametrize(
    ("scheme", "held", "delay"),
    every(4, itertools.product(("rk4", "semi_implicit_euler"), (0, 1, 2), (0.0, 0.002, 0.004))),
)
def test_a_loop_that_diverges_does_so_as_its_run(scheme, held, delay):
    """Over thirty periods in which small steps grow twentyfold and more, by a share of 1e-5: a torque that is held
    from the first row on is the law's there, also where the loop is linear about the start of the run."""
    changes = {
        "law": {"kind": "operational_space", "force": 10.0, "force_integral": 20.0},
        "compliance": {"kind": "kelvin_voigt", "stiffness": 2e4, "damping": 10.0}, "reference.kind": "hold",
        "time.duration": 1.2, "time.integrator": scheme, "sensor.delay": delay,
    }  # fmt: skip
    if held:
        changes["law.sample_period"] = 0.001 * held
    seen, wanted = steps_of_a_bias(lambda bias: cl.load_scenario("soft_table", changes | {"sensor.bias": bias}), 1e-4)
    np.testing.assert_allclose(seen, wanted, rtol=0, atol=1e-5 * np.max(np.abs(seen)))
    assert np.max(np.abs(seen[-100:])) > 1.0


@pytest.mark.parametrize("scheme", ["rk4", "explicit_euler"])
@pytest.mark.parametrize("stiffness", [1e3, 1e5])
def test_bristles_of_a_steady_slip(scheme, stiffness):
    """They decay by e^(−a h) in a step, a = σ₀ u/μ, however fast; the tip's way along the slip is the run's to 1e-9."""
    h, speed, friction = 0.001, 0.1, 0.2
    scenario = mass_on_a_spring(
        time__integrator=scheme, time__duration=2.1, time__step=h, start__v=[speed, 0.0, 0.0],
        reference={"kind": "line", "direction": [1, 0, 0], "speed": speed, "start": 0.0, "stop": 5.0},
        law__kp=[400, 100, 0], law__kd=[80, 20, 0], law__force_feedback=0.2, sensor__delay=2 * h,
        friction={"kind": "lugre", "kinetic": friction, "static": 0.3, "stribeck_speed": 0.001, "damping": 1.0,
                  "stiffness": stiffness},
    )  # fmt: skip
    problem = prepare(scenario)
    instant = instant_of(problem, 2.0)
    loop, n, seen = loop_at(problem, instant), problem.robot.n, []
    command = problem.table[round(instant.time / h) * problem.nodes :, Reference.place("force", n)]
    for kick in (1e-3, -2e-3):
        command += kick
        seen.append(rows_on(problem, instant, 60)[:, Row.place("position", n)][:, 0])
    _, wanted = loop.response("force command", "tip x", 59 * h)
    np.testing.assert_allclose((seen[0] - seen[1]) / 2e-3, wanted, rtol=0, atol=1e-9 * np.max(np.abs(wanted)))
    poles = np.array([pole.z for pole in loop.poles()])
    assert np.min(np.abs(poles - math.exp(-stiffness * speed / friction * h))) < 1e-3
    assert loop.stable


@pytest.mark.parametrize("case", PULSES)
def test_small_steps_of_the_run(case):
    """After a step of f_des by a millinewton the run's force does what the linear loop's does, within one per cent."""
    name, changes = PULSES[case]
    scenario = cl.load_scenario(name, {"time.duration": 7.0} | changes)
    problem = prepare(scenario)
    instant = instant_of(problem, min(3.0, 0.6 * scenario.time.duration))
    loop = loop_at(problem, instant)
    rows, hold = 200, max(problem.hold, 1)
    apart = (run_on(problem, instant, rows, 1e-3) - run_on(problem, instant, rows, -1e-3)) / 2e-3
    seen = np.cumsum(apart[::hold])  # of a pulse: the sum is the step
    _, wanted = loop.response("force command", duration=(seen.size - 1) * loop.dt)
    assert np.max(np.abs(seen - wanted)) <= 0.01 * np.max(np.abs(seen))
    assert np.max(np.abs(seen)) > 0.5


HELD = {
    "two palms hold a bar": ("two_arms_bar", {}, 0.5),
    "feet and pusher slide": ("push_block", {}, 1.5),
    "a soft pusher": ("push_block", {"contact.pusher.compliance": {"kind": "kelvin_voigt", "stiffness": 2e4,
                                                                   "damping": 100.0}}, 1.0),
    "more contacts than are needed": ("gripper_block", {}, 0.5),
}  # fmt: skip


@pytest.mark.parametrize("case", HELD)
def test_small_steps_with_closed_contacts_of_links(case):
    """After a step of f_des the forces of links that stick, slide or sink do what those of the linear loop do."""
    name, changes, at = HELD[case]
    scenario = cl.load_scenario(name, {"time.integrator": "semi_implicit_euler"} | changes)
    problem = prepare(scenario)
    instant = instant_of(problem, at)
    loop, kick, rows = loop_at(problem, instant), 1e-4, 30
    apart = (rows_on(problem, instant, rows, kick) - rows_on(problem, instant, rows, -kick)) / (2.0 * kick)
    names = names_of(scenario.contact)
    place = ContactRow.place("link_forces", len(names))
    first = problem.row_width - problem.row_states - ContactRow.count(len(names))
    seen = np.cumsum(apart[:, first : problem.row_width - problem.row_states][:, place], axis=0)  # of a pulse
    duration = (rows - 1) * loop.dt
    outputs = [each.name for each in loop.outputs if each.name.startswith("contact force[")]
    assert len(outputs) >= 2
    for output in outputs:
        mine = seen[:, names.index(output[len("contact force[") : -1])]
        wanted = loop.response("force command", output, duration)[1]
        np.testing.assert_allclose(mine, wanted, atol=0.01 * np.max(np.abs(seen)))
    assert np.max(np.abs(seen)) > 0.01


@pytest.mark.parametrize(("name", "row"), [("soft_table", 1200), ("wam_hybrid_friction", 1200), ("joint_friction", 0)])
def test_a_run_that_goes_on_is_the_run(name, row):
    """What is run on from an instant is the rest of the run, to the last bit; at t = 0 the law has started."""
    scenario = cl.load_scenario(name, {"time.duration": 7.0, "law.force_integral": 10.0})
    problem = prepare(scenario)
    on = run_on(problem, instant_of(problem, row * 0.001), 50)
    assert np.array_equal(on, cl.simulate(scenario, progress=False).contact_force[row : row + 50])


def test_a_tip_that_has_all_but_stopped_has_no_linear_loop():
    """Friction that is about to turn has no derivative, at a slip of 1e-10 m/s: it is refused, not made up."""
    with pytest.raises(cl.SimulationError, match="the contact is about to change, or friction to turn"):
        cl.linearise(cl.load_scenario("wam_hybrid_friction"), at=8.0)


def test_a_torque_that_disturbs_the_run():
    """10 mN m beside the torque of the law, for one step, move f as the linear loop says, within one per cent."""
    scenario = cl.load_scenario("soft_table", {"law.force_integral": 20.0, "time.duration": 7.0})
    loop, seen = cl.linearise(scenario, at=3.0), []
    for sign in (1.0, -1.0):
        sim = cl.Simulator(scenario)
        disturbed = sim.run_until(3.0).torque + sign * np.array([0.0, 1e-2, 0.0, 0.0])
        seen.append([sim.step(disturbed).f, *(sim.step().f for _ in range(149))])
    apart = np.cumsum((np.array(seen[0]) - seen[1]) / 2e-2)  # of a pulse: the sum is the step
    _, wanted = loop.response("torque[J2]", duration=0.150)
    np.testing.assert_allclose(apart, wanted[1:], atol=0.01 * np.max(np.abs(wanted)))


@pytest.mark.parametrize(("name", "size"), [("soft_table", 1e-6), ("wam_slide", 1e-7)])
def test_a_surface_that_breathes(name, size):
    """The force of a run on a surface that swings at 2 Hz swings as the linear loop's does, within one per cent.

    The desired path is that on the surface at rest: what is asked is how the loop answers, not what a path adds.
    """
    still, span = cl.load_scenario(name, {"time.duration": 3.0}), 3000
    moving = cl.load_scenario(name, {
        "time.duration": 3.0, "surface_motion.kind": "breathing", "surface_motion.amplitude": 2.0 * size,
        "surface_motion.frequency": 2.0, "surface_motion.direction": [0, 0, 1],
    })  # fmt: skip
    at_rest, problem = prepare(still), prepare(moving)
    problem.table[:] = at_rest.table
    f = run_on(problem, instant_of(problem, 0.0), span)
    apart, t = (f - run_on(at_rest, instant_of(at_rest, 0.0), span))[2000:], 0.001 * np.arange(2000, span)
    seen = -2.0 * np.mean(np.exp(-4j * math.pi * t) * apart) / size  # it swings with −cos
    wanted = cl.linearise(still, at=2.5).frequency_response("surface", "contact force", 2.0)[0]
    assert abs(seen - wanted) < 0.01 * abs(wanted)
