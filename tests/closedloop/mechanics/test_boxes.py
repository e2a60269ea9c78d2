"""Two boxes that touch, with time stepping: normal and points against brute force, and bodies that stay apart."""

import itertools

import numpy as np
import pinocchio as pin
import pytest
from scipy.spatial.transform import Rotation

import closedloop as cl
from closedloop.jit.interpreted import interpreted
from closedloop.mechanics.contacts.memory import make_contact_memory
from closedloop.mechanics.contacts.stepping import order_joints
from closedloop.mechanics.loops.boxes import BoxPair, touch_boxes
from closedloop.record.columns.touching import contact_torques
from closedloop.record.report.summary import contact_faults
from robot_models.coordinates import in_pinocchios_order
from validation.speed.scenes import bodies_of, scenario_of

SIGNS = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))


def corners(half, axes, middle):
    """Return the corners (8, 3) of a box with these half edges, axes as rows, and middle."""
    return middle + (SIGNS * half) @ axes


def distances(one, other, axes):
    """Return how far two sets of corners are apart along each of some unit vectors (m, 3)."""
    a, b = one @ axes.T, other @ axes.T
    return np.maximum(a.min(axis=0) - b.max(axis=0), b.min(axis=0) - a.max(axis=0))


def separation(half_a, axes_a, half_b, axes_b, apart):
    """Return how far two boxes are apart along the best of fifteen directions, those of faces and pairs of edges."""
    tried = [*axes_a, *axes_b]
    for a, b in itertools.product(axes_a, axes_b):
        across = np.cross(a, b)
        if np.linalg.norm(across) > 0.02:
            tried.append(across / np.linalg.norm(across))
    return np.max(distances(corners(half_a, axes_a, apart), corners(half_b, axes_b, np.zeros(3)), np.array(tried)))


def turn_of(q):
    """Return the matrix of a quaternion w, x, y, z of any length."""
    return Rotation.from_quat(np.roll(q, -1)).as_matrix()


def pair_that_touches(rng, near):
    """Return a pair that overlaps by 1e-6 of its distance: turned at random, or hardly against each other."""
    pair = BoxPair(np.zeros(BoxPair.count()))
    pair.half_a[:], pair.half_b[:] = rng.uniform(0.02, 0.1, size=(2, 3))
    pair.axes_b[:] = turn_of(rng.normal(size=4))
    tilt = 1e-5 * rng.normal(size=3)
    little = turn_of([1.0, *tilt])
    pair.axes_a[:] = little @ pair.axes_b if near else turn_of(rng.normal(size=4))
    along, low, high = rng.normal(size=3), 0.0, 1.0
    for _ in range(60):
        middle = 0.5 * (low + high)
        apart = separation(pair.half_a, pair.axes_a, pair.half_b, pair.axes_b, middle * along) > 0.0
        low, high = (low, middle) if apart else (middle, high)
    pair.apart[:] = (1.0 - 1e-6) * high * along
    return pair


@pytest.mark.parametrize("near", [False, True])
def test_they_touch_where_they_overlap_least(near):
    """The normal is the best of fifteen directions, and every point is in both boxes, but for its gap."""
    for seed in range(200):
        pair = pair_that_touches(np.random.default_rng(seed), near)
        count, apart = interpreted(touch_boxes)(pair)
        best = separation(pair.half_a, pair.axes_a, pair.half_b, pair.axes_b, pair.apart)
        assert best - 1e-6 * 0.3 <= apart <= best + 1e-12  # of directions that are hardly different it takes a face
        np.testing.assert_allclose(pair.frames[0] @ pair.frames[0].T, np.eye(3), atol=1e-13)
        own = corners(pair.half_a, pair.axes_a, pair.apart)
        assert distances(own, corners(pair.half_b, pair.axes_b, np.zeros(3)), pair.frames[0, :1])[0] == pytest.approx(
            apart, abs=1e-12
        )
        assert pair.frames[0, 0] @ pair.apart > 0.0
        assert 1 <= count <= 8
        assert np.min(pair.gaps[:count]) == pytest.approx(apart, abs=1e-6)
        for point, gap in zip(pair.points[:count], pair.gaps[:count], strict=True):
            for half, axes, middle in (
                (pair.half_a, pair.axes_a, pair.apart),
                (pair.half_b, pair.axes_b, np.zeros(3)),
            ):
                assert np.all(np.abs(axes @ (point - middle)) <= half + abs(gap) + 1e-12)


def test_edges_that_do_not_cross_are_no_contact():
    """A box that falls flat about its lower edge touches there, though another edge, beside it, is as far apart.

    In one step of a heap there was no point between the boxes, and a corner came 0.8 mm deep in the next.
    """
    pair = BoxPair(np.zeros(BoxPair.count()))
    pair.half_a[:], pair.half_b[:] = (0.029601821, 0.04884932, 0.025568242), (0.038700846, 0.044386693, 0.020904053)
    pair.axes_a[:] = turn_of([0.008649087783, 0.728506421254, 0.684864681408, -0.012804516063]).T
    pair.axes_b[:] = turn_of([-0.377308716705, 0.005724501741, -0.007601889054, -0.926038645879]).T
    pair.apart[:] = 0.00585327090199, 0.0445183014098, 0.045850629024
    count, apart = interpreted(touch_boxes)(pair)
    assert 0.0 < apart < 2e-6
    assert count >= 3  # the edge, and both corners that come down
    assert np.max(pair.gaps[:count]) > 5e-4


def test_boxes_that_are_apart_have_gaps():
    """No point is inside; where there is none, as past the ends of edges, the distance is that of the boxes."""
    seen = none = 0
    for seed in range(1200):
        rng, pair = np.random.default_rng(seed), BoxPair(np.zeros(BoxPair.count()))
        pair.half_a[:], pair.half_b[:] = rng.uniform(0.02, 0.05, size=(2, 3))
        pair.axes_a[:], pair.axes_b[:] = (turn_of(rng.normal(size=4)) for _ in range(2))
        pair.apart[:] = 0.06 * rng.normal(size=3)
        best = separation(pair.half_a, pair.axes_a, pair.half_b, pair.axes_b, pair.apart)
        if not 0.0 < best < 0.01:
            continue
        count, apart = interpreted(touch_boxes)(pair)
        seen, none = seen + 1, none + (count == 0)
        assert np.all(pair.gaps[:count] > 0.0)
        assert count > 0 or apart == pytest.approx(best, abs=1e-12)
    assert seen > 50
    assert none > 3


def test_the_same_points_when_they_change_places():
    """Boxes in the other order have the opposite normal, the same separation, and as many points."""
    for seed in range(100):
        one = pair_that_touches(np.random.default_rng(seed), False)
        other = BoxPair(np.zeros(BoxPair.count()))
        other.half_a[:], other.half_b[:], other.apart[:] = one.half_b, one.half_a, -one.apart
        other.axes_a[:], other.axes_b[:] = one.axes_b, one.axes_a
        (count, apart), (counted, other_apart) = interpreted(touch_boxes)(one), interpreted(touch_boxes)(other)
        assert count == counted
        assert apart == pytest.approx(other_apart, abs=1e-13)
        np.testing.assert_allclose(one.frames[0, 0], -other.frames[0, 0], atol=1e-10)


@pytest.mark.parametrize(("name", "deepest"), [("dominoes", 1e-4), ("bin_4", 2e-3)])
def test_bodies_do_not_go_into_each_other(name, deepest):
    """Boxes that fall, of one width or turned at random, overlap by what they move in a step, and not at rest.

    Two dominoes of one width were 22 mm inside each other while each corner took its normal from the nearest face.
    """
    run = cl.simulate(scenario_of(name), engine="compiled")
    bodies, pairs = bodies_of(name)
    half = [0.5 * np.array(body["edges"]) for body in bodies]
    for row in [*range(0, 1501, 25), 1500]:
        q = run.q[row].reshape(-1, 7)
        axes = [turn_of(each[3:]).T for each in q]
        for i, j in pairs:
            apart = separation(half[i], axes[i], half[j], axes[j], q[i, :3] - q[j, :3])
            assert apart > -(deepest if row < 1500 else 1e-8)
    assert np.max(np.abs(run.v[-1])) < 1e-5
    # Points of a pair are numbered anew at each row: a force of one beside the gap of another, 1 m, counted 100 N m.
    found = contact_faults(run)
    assert np.max(found.complementarity) < 0.2 * np.max(run.link_forces) * deepest


def test_forces_in_space_are_those_on_the_joints():
    """Places and forces of the points, made anew from the bodies' poses, are what moves the bodies, by Pinocchio."""
    run = cl.simulate(scenario_of("bin_4").replace({"time.duration": 0.6}), engine="compiled")
    model = run.model.pinocchio_model()
    data, rows = model.createData(), slice(200, 600, 7)
    q = np.array([in_pinocchios_order(each, run.model.joint_types) for each in run.q[rows]])
    v, a = run.v[rows], run.acceleration[rows]
    wanted = np.array([pin.rnea(model, data, *of) for of in zip(q, v, a, strict=True)])
    found = contact_torques(run.scenario, model, run.time[rows], q, run.link_forces[rows], run.link_frictions[rows])
    pairs = [i for i, section in enumerate(run.scenario.contact) if section.box is not None]
    assert np.count_nonzero(run.link_forces[rows][:, pairs]) > 50
    np.testing.assert_allclose(found, wanted, atol=1e-9 * np.max(np.abs(wanted)))


def test_boxes_of_a_contact_are_given_whole():
    """Points left out, in another order, or with events are refused in one line."""
    run = cl.simulate(scenario_of("stack_3").replace({"time.duration": 0.01}))
    sections = run.scenario.contact
    first = next(i for i, section in enumerate(sections) if section.box is not None)
    for wrong in (
        sections[: first + 5],
        (*sections[:first], sections[first + 1], sections[first], *sections[first + 2 :]),
    ):
        with pytest.raises(cl.ScenarioError, match="a contact for each point, from 0 to 7, one after the other"):
            cl.simulate(run.scenario.model_copy(update={"contact": tuple(wrong)}))
    with pytest.raises(cl.ScenarioError, match=r"box: must be left out; time.integrator = 'time_stepping' has it"):
        cl.simulate(run.scenario.replace({"time.integrator": "rk4"}))


def test_boxes_that_start_inside_each_other_are_refused():
    """In one line that says by how much."""
    scenario = scenario_of("stack_3")
    low = scenario.body[1].model_copy(update={"position": (0.0, 0.0, 0.15)})
    with pytest.raises(cl.ScenarioError, match=r"the boxes start 0\.002 m inside each other: move one away"):
        cl.simulate(scenario.model_copy(update={"body": (scenario.body[0], low, scenario.body[2])}))


def test_bodies_that_touch_stand_near_each_other():
    """The order of the joints keeps bodies whole; of a row of bodies, numbered at random, each is beside the next."""
    for seed in range(30):
        rng = np.random.default_rng(seed)
        bodies, row = int(rng.integers(2, 9)), seed % 2 == 0
        names = rng.permutation(bodies)
        pairs = [(names[i], names[i + 1]) for i in range(bodies - 1)] if row else rng.integers(0, bodies, size=(7, 2))
        memory = make_contact_memory(6 * bodies, len(pairs))
        moves = memory.contacts.moves
        for i, (one, other) in enumerate(np.sort(pairs, axis=1)):
            moves.first[i], moves.upto[i], moves.again[i], moves.end[i] = 6 * np.array([one, one + 1, other, other + 1])
        memory.contacts.near[:] = 1.0
        interpreted(order_joints)(memory.contacts, memory.contacts.stepping, len(pairs), 6 * bodies)
        places = memory.contacts.stepping.order.reshape(bodies, 6)
        assert np.array_equal(np.sort(places, axis=None), np.arange(6 * bodies))
        np.testing.assert_array_equal(np.diff(places, axis=1), 1.0)
        if row:
            assert all(abs(places[one, 0] - places[other, 0]) == 6.0 for one, other in pairs)
