"""Several contacts: modes, forces, impacts and events against closed forms, enumeration, and what no motion may do."""

import numpy as np
import pytest
from box_in_plane import HEIGHT, MASS, WIDTH, G, block, corners, moved, total_energy

import closedloop as cl
import robot_models
from closedloop.mechanics.closure.contact_force import FREE, PRESSED, STUCK
from closedloop.mechanics.robot.pinocchio import Robot
from closedloop.record.run import load_run


def on_incline(angle, friction):
    """The run of the block at rest on an incline."""
    s, c = np.sin(angle), np.cos(angle)
    at = [-s * HEIGHT / 2, c * HEIGHT / 2, angle]
    return moved(at, [0, 0, 0], corners(friction, (-s, 0, c)), 0.01)


@pytest.mark.parametrize(("angle", "friction"), [(0.3, 0.31), (0.3, 0.305), (0.3, 0.1), (0.3, 0.0)])
def test_block_on_an_incline_slips_where_friction_is_less_than_the_slope(angle, friction):
    """tan 0.3 = 0.3093: at rest above it, though the upper corner alone would slip; below it as m g (sin − μ cos)."""
    run = on_incline(angle, friction)
    s, c = np.sin(angle), np.cos(angle)
    slides = friction < np.tan(angle)
    down = G * (s - friction * c) if slides else 0.0
    np.testing.assert_allclose(run.acceleration, np.tile([-down * c, -down * s, 0.0], (len(run), 1)), atol=1e-9)
    assert np.all(run.link_modes == (PRESSED if slides else STUCK))
    rub = MASS * (G * s - down)
    f, t = run.link_forces, run.link_frictions[:, ::2]
    np.testing.assert_allclose(np.sum(t, axis=1), rub, atol=1e-8)
    np.testing.assert_allclose(f[:, 0] - f[:, 1], rub * HEIGHT / WIDTH, atol=1e-8)  # no moment about the centre
    np.testing.assert_allclose(np.sum(f, axis=1), MASS * G * c, atol=1e-8)
    assert np.all(np.hypot(t, run.link_frictions[:, 1::2]) <= friction * f + 1e-10)
    assert np.max(run.residual_motion) < 1e-14


@pytest.mark.parametrize(("angle", "tips"), [(1.10, False), (1.12, True)])
def test_block_on_a_steep_incline_tips_where_its_weight_is_outside_its_base(angle, tips):
    """tan = width/height = 2 at 1.107: beyond it the upper corner parts, and it turns about the lower."""
    run = on_incline(angle, 3.0)
    assert list(run.link_modes[0]) == ([STUCK, FREE] if tips else [STUCK, STUCK])
    lever, s, c = np.hypot(WIDTH, HEIGHT) / 2, np.sin(angle), np.cos(angle)
    turning = MASS * G * (s * HEIGHT / 2 - c * WIDTH / 2) / (0.02 + MASS * lever**2) if tips else 0.0
    np.testing.assert_allclose(run.acceleration[0, 2], turning, atol=1e-8)


def test_block_slides_and_stops_and_a_tall_one_tips():
    """v/(μ g) later both corners stick at one instant; with μ above width/height the rear corner leaves at once."""
    run = moved([0, HEIGHT / 2, 0], [0.1, 0, 0], corners(0.5), 0.03)
    assert [(event.kind, event.contact) for event in run.events] == [("stick", 1), ("stick", 2)]
    assert run.events[0].time == pytest.approx(0.1 / (0.5 * G), abs=1e-10)
    assert np.all(run.link_modes[-1] == STUCK)
    assert np.ptp(total_energy(run)) < 1e-12
    tall = moved([0, 0.1, 0], [0.5, 0, 0], corners(0.7, width=0.1, height=0.2), 0.02)
    assert list(tall.link_modes[0]) == [FREE, PRESSED]
    assert tall.acceleration[0, 2] < 0.0


@pytest.mark.parametrize("restitution", [0.0, 0.5])
def test_block_falls_on_two_corners_at_one_instant(restitution):
    """Both impacts at √(2 h/g), each rate reversed by e, the energy lost ½ m v² (1 − e²), and no spin."""
    drop = 1e-3
    run = moved([0, HEIGHT / 2 + drop, 0], [0, 0, 0], corners(0.3, restitution=restitution))
    first, second = run.events[:2]
    t, v = np.sqrt(2 * drop / G), np.sqrt(2 * G * drop)
    assert (first.contact, second.contact) == (1, 2)
    assert first.kind == second.kind == ("impact" if restitution else "touchdown")
    assert first.time == second.time == pytest.approx(t, abs=1e-9)
    assert first.rate_after == pytest.approx(restitution * v, abs=1e-6)
    np.testing.assert_allclose([sorted([first.position[0], second.position[0]])], [[-WIDTH / 2, WIDTH / 2]], atol=1e-12)
    np.testing.assert_allclose([first.position[1:], second.position[1:]], 0.0, atol=1e-9)
    assert first.energy_lost + second.energy_lost == pytest.approx(0.5 * MASS * v**2 * (1 - restitution**2), rel=1e-6)
    assert np.max(np.abs(run.v[:, 2])) < 1e-12
    assert np.ptp(total_energy(run)) < 1e-12


def test_a_scheme_of_one_stage_meets_the_floor_where_it_is():
    """The gap is asked for at the end of each trial step: at the first blow a corner is on the floor."""
    changes = {"time.integrator": "semi_implicit_euler"}
    run = moved([0, HEIGHT / 2 + 0.006, 0.05], [0.3, 0, 0.5], corners(0.3, restitution=0.3), 0.03, **changes)
    blow = run.events[0]
    assert blow.kind == "impact"
    assert abs(blow.position[2]) < 1e-9
    np.testing.assert_allclose(
        np.abs(blow.tangential), [0.3 * (blow.compression + blow.decompression), 0.0, 0.0], atol=1e-9
    )  # it slides


def test_tilted_block_rattles_without_energy_or_penetration():
    """Impacts of one corner and the other, slip and its end: the energy balance holds and no corner goes through."""
    run = moved([0, HEIGHT / 2 + 0.01, 0.05], [0.3, 0, 0.5], corners(0.3, restitution=0.3), 0.12, 2e-3)
    assert {1, 2} <= {event.contact for event in run.events}
    assert all(event.energy_lost > -1e-12 for event in run.events)
    assert np.min(run.link_gaps) > -1e-8
    assert np.min(run.link_forces) > -1e-8
    assert np.ptp(total_energy(run)) < 1e-6


def test_painleves_rod_is_named():
    """A rod pushed so that pressing harder pulls its end in: no force, no number that is none; pulled, it goes on."""
    end = [{"name": "end", "link": "block", "at": [0, 0, -1], "friction": 2.0}]
    start = [0, np.cos(0.5), 0.5]
    with pytest.raises(cl.PainleveError, match="Painlevé"):
        moved(start, [3, 0, 0], end, model=block(0.05))
    run = moved(start, [-3, 0, 0], end, model=block(0.05))
    assert run.stopped is None
    assert np.all(np.isfinite(run.link_forces))


def test_bar_between_two_arms_is_held_by_friction():
    """Newton and Euler of the bar with the recorded forces, and least norm: nothing else is known of them."""
    run = cl.simulate(cl.load_scenario("two_arms_bar", {"time.duration": 0.02, "time.step": 0.002}))
    f, t = run.link_forces, run.link_frictions[:, ::2]
    assert np.all(run.link_modes == STUCK)
    bar = [run.model.joint_names.index(f"bar_{name}_joint") for name in ("x", "z", "turn")]
    x, z, turn = run.acceleration[:, bar].T
    angle = run.q[:, bar[2]]
    # normals −x and +x of the bar; their tangents t1 are +z and −z there, see `contact_frame`
    push, lift = f[:, 0] - f[:, 1], t[:, 1] - t[:, 0]
    c, s = np.cos(angle), np.sin(angle)
    np.testing.assert_allclose(c * push - s * lift, 1.002 * x, atol=1e-8)
    np.testing.assert_allclose(s * push + c * lift, 1.001 * (z + G), atol=1e-8)
    inertia = (0.3**2 + 0.05**2) / 12
    np.testing.assert_allclose(0.15 * (t[:, 1] + t[:, 0]), inertia * turn, atol=1e-8)
    assert np.ptp(total_energy(run)) < 1e-4


@pytest.mark.slow
def test_palms_let_go_where_their_force_ends():
    """Pressed less and less until nothing presses at 1 s: both contacts end there, and the run goes on to 1.1 s."""
    run = cl.simulate(cl.load_scenario("two_arms_bar", {"time.duration": 1.1, "time.step": 0.01}))
    assert run.stopped is None
    ends = {event.contact: event.time for event in run.events if event.kind == "liftoff" and event.time < 1.01}
    assert set(ends) == {1, 2}
    assert list(ends.values()) == pytest.approx([1.0, 1.0], abs=2e-3)
    assert np.min(run.link_gaps) > -1e-6  # what the stabiliser leaves of the load at so long a step
    assert np.min(run.link_forces) > -1e-8


def test_batch_of_contacts_is_the_runs_one_by_one():
    """Each row, and a column kept whole, to the last bit."""
    base = cl.load_scenario("two_arms_bar", {"time.duration": 0.004})
    forces = [40.0, 30.0]
    table = cl.simulate_batch(base, {"law.force": forces}, keep=["q"], engine="pinocchio")
    for i, force in enumerate(forces):
        run = cl.simulate(cl.load_scenario("two_arms_bar", {"time.duration": 0.004, "law.force": force}))
        assert table["status"][i].as_py() == "done"
        np.testing.assert_array_equal(np.array(table["q"][i].as_py()).reshape(run.q.shape), run.q)


def test_gripper_lifts_the_block_with_a_loop_and_forces_that_are_not_unique():
    """Ten newtons in each of four contacts, half of the weight below each corner; the gear of the fingers holds."""
    run = cl.simulate(cl.load_scenario("gripper_gear", {"time.duration": 0.01}))
    np.testing.assert_allclose(run.link_forces[0], [10, 10, 10, 10, 0.501 * G / 2, 0.501 * G / 2], atol=1e-9)
    assert np.max(np.abs(run.loops.errors)) < 1e-14
    assert np.max(run.residual_motion) < 1e-14


def test_loop_and_contact_with_friction_in_one_run():
    """A four-bar falls on the floor by its coupler: the loop closed, force in its cone, energy and motion accounted."""
    model = robot_models.load("four_bar")
    position = Robot(model).position(model.home)
    floor = [{"name": "floor", "link": model.tip, "through": [0, 0, float(position[2]) - 2e-6], "friction": 0.3}]
    changes = {"contact": floor, "time.duration": 0.03, "surface.gap": 5.0, "stabiliser.time_constant": 0.01}
    run = cl.simulate(cl.load_scenario("four_bar", changes), law=lambda x: 0.0 * x.q)
    assert "touchdown" in {event.kind for event in run.events}
    assert np.max(np.abs(run.loops.errors)) < 1e-13
    assert np.all(np.hypot(*run.link_frictions.T) <= 0.3 * run.link_forces[:, 0] + 1e-10)
    assert np.max(run.link_forces) > 0.1
    assert np.max(run.residual_motion) < 1e-13
    assert np.ptp(total_energy(run)) < 1e-6


def test_order_of_rk4_between_events():
    """A block that turns about a corner while it slides: half the step, a sixteenth of the error."""
    one = corners(0.2)[:1]
    ends = [
        moved([0, HEIGHT / 2, 0], [1.0, 0, 0], one, 0.08, h, **{"stabiliser.kind": "none"}).q[-1]
        for h in (0.02, 0.01, 0.0025)
    ]
    coarse, fine = (np.max(np.abs(end - ends[2])) for end in ends[:2])
    assert 10.0 < coarse / fine < 26.0


def test_engines_and_repetition_agree(tmp_path):
    """Both engines to rounding; a run read from its file has contacts, events and names, and repeats to the bit."""
    scenario = cl.load_scenario("gripper_gear", {"time.duration": 0.005})
    run = cl.simulate(scenario)
    other = cl.simulate(scenario, engine="compiled")
    np.testing.assert_allclose(other.link_forces, run.link_forces, atol=1e-8)
    again = load_run(run.save(tmp_path / "run.nc"))
    np.testing.assert_array_equal(again.link_forces, run.link_forces)
    repeated = cl.simulate(again.scenario, model=again.model)
    np.testing.assert_array_equal(repeated.q, run.q)
    np.testing.assert_array_equal(repeated.link_frictions, run.link_frictions)
    assert "link_forces[left_below]" in again.to_pandas().columns


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"link": "blok"}, "did you mean 'block'"),
        ({"normal": [0, 0, 0]}, "has no direction"),
        ({"friction": -0.1}, "greater than or equal to 0|negative"),
        ({"through": [0, 0, 0.01]}, "inside the surface"),
        ({"against": "block"}, "both 'block'"),
        ({"against": "tip"}, "no joint is between"),
    ],
)
def test_what_is_wrong_with_a_contact_is_said_in_one_line(change, said):
    """A name, a number or a place that cannot be."""
    contact = corners(0.3)[0] | change
    with pytest.raises(cl.ScenarioError, match=said) as told:
        moved([0, HEIGHT / 2, 0], [0, 0, 0], [contact])
    assert "\n" not in str(told.value)
