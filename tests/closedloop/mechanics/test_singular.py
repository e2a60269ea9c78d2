"""A tip that passes a pose in which it cannot move along the normal: it goes on where f has a limit, else it stops.

The small arm is `planar2`, folded upright: its tip slides on a level plane 0.1 m above the shoulder, and where both
links stand upright no joint has a lever along the normal. With x the angle of the first link from there and φ that of
the second, sin(φ/2) = √(4/3) sin(x/2). A torque H q̈ + C − Aᵀf along that motion gives the force f, whatever the pose.
"""

import dataclasses

import numpy as np
import pytest
from random_loop import loop_at_random

import closedloop as cl
import robot_models
from closedloop.jit.interpreted import interpreted
from closedloop.loop.step.solve_contact import Approach, force_in_singular_pose, pushed_on_the_way, remember_approach
from closedloop.mechanics.closure.solve import OK, PUSHED, SINGULAR
from closedloop.record.report import print_report

FORCE, RATE, BEGIN = 10.0, 0.5, 0.05  # N, rad/s, rad before the pose
AT_POSE = BEGIN / RATE
WAM_POSE = 0.6  # s


@pytest.fixture(scope="module")
def arm():
    """`planar2`, whose second joint may fold."""
    model = robot_models.load("planar2")
    text = model.text.replace('lower="-3.0" upper="3.0"', 'lower="-7.0" upper="7.0"')
    return robot_models.from_text(
        text, "urdf", name="planar2", armature=model.armature, tip="tip", home=model.home, locked={}
    )


def folded(x):
    """q, q̇ and q̈ of the folded arm on the plane at x, rad, with ẋ = RATE."""
    k = np.sqrt(4.0 / 3.0)
    s = k * np.sin(0.5 * x)
    c = np.sqrt(1.0 - s * s)
    slope = k * np.cos(0.5 * x) / c
    bend = (0.5 * k * np.cos(0.5 * x) * s * slope - 0.5 * k * np.sin(0.5 * x) * c) / c**2
    q = [0.5 * np.pi + x, np.pi + 2.0 * np.arcsin(s) - x]
    return np.array(q), np.array([RATE, (slope - 1.0) * RATE]), np.array([0.0, bend * RATE**2])


def fold(arm, begin=BEGIN, push=0.0, engine="pinocchio", **changes):
    """A run from x = −begin, with a torque `push` on the second joint beside that of the motion, N m."""
    q, v, _ = folded(-begin)
    scenario = {
        "start.q": q.tolist(), "start.v": v.tolist(), "reference.kind": "hold", "time.duration": 0.2,
        "time.integrator": "rk4",
    }  # fmt: skip
    if "stabiliser.kind" not in changes:
        scenario["stabiliser.time_constant"] = "auto"

    def along(t, q, v, terms):
        wanted = folded(RATE * t - begin)[2]
        return terms.mass_matrix @ wanted + terms.bias - FORCE * terms.jacobian[2] + np.array([0.0, push])

    return cl.simulate(cl.load_scenario("planar2_slide", scenario | changes), model=arm, law=along, engine=engine)


@pytest.mark.parametrize("begin", [BEGIN, 0.04975, 0.05013])
@pytest.mark.parametrize(
    ("scheme", "bound"),
    [
        ({}, 1e-9),
        ({"stabiliser.kind": "projection"}, 1e-9),
        ({"time.integrator": "semi_implicit_euler"}, 1e-7),
    ],
)
def test_folded_arm_goes_through(arm, begin, scheme, bound):
    """On the other side the motion is that of the closed form and f is 10 N, whether a row falls on the pose or not."""
    run = fold(arm, begin, **scheme)
    truth = np.array([folded(RATE * t - begin)[0] for t in run.time])
    assert np.max(np.abs(run.q - truth)) < bound
    assert np.min(run.normal_mobility) < 1e-6
    assert np.max(run.residual_motion) < 1e-14
    assert np.max(run.residual_closure) < 1e-13
    away = np.abs(run.time - begin / RATE) > 0.01
    np.testing.assert_allclose(run.contact_force[away], FORCE, atol=1e-2)
    np.testing.assert_allclose(run.contact_force, FORCE, atol=1.0)


def test_force_in_the_pose_is_its_limit(arm):
    """The row in the pose has no row of Eq. 24, f to three digits, and no share of the stabiliser in it."""
    run = fold(arm)
    at = int(np.argmin(run.normal_mobility))
    assert run.time[at] == pytest.approx(AT_POSE)
    assert run.normal_mobility[at] == 0.0
    assert run.contact_force[at] == pytest.approx(FORCE, rel=1e-3)
    assert run.stabiliser_force[at] == 0.0
    assert np.all(np.isfinite(run.kkt_condition))
    held = run.summary()["assumptions"]["nonsingular"]
    assert not held["held"]
    assert held["first_failed"] == pytest.approx(AT_POSE, abs=0.005)


@pytest.mark.parametrize("begin", [BEGIN, 0.04975, 0.05013])
@pytest.mark.parametrize("push", [1.0, 0.01])
def test_pushed_along_the_normal_it_stops(arm, begin, push):
    """A torque that pushes the tip along the normal ends the run at the pose, wherever the steps fall."""
    with pytest.raises(
        cl.SingularClosureError, match=r"singular pose.* pushes it that way.* beyond all bounds"
    ) as caught:
        fold(arm, begin, push)
    assert caught.value.time == pytest.approx(begin / RATE, abs=0.006)
    force = caught.value.run.contact_force
    assert force[-2] > 2.0 * FORCE
    assert force[-1] - FORCE > 1.5 * (force[-2] - FORCE)  # as 1/t


@pytest.mark.parametrize("begin", [BEGIN, 0.04975])
def test_what_counts_as_a_push_is_bounded_from_both_sides(arm, begin):
    """A push of 0.1 mN m is none, and moves the arm as it must; one of 1 mN m ends the run."""
    pushed, free = fold(arm, begin, 1e-4), fold(arm, begin)
    np.testing.assert_allclose(pushed.q, free.q, atol=2e-6)
    with pytest.raises(cl.SingularClosureError, match="pushes it that way"):
        fold(arm, begin, 1e-3)


def test_what_is_pulled_off_leaves(arm):
    """On a surface that cannot pull, the other sign of the push lifts the tip off before the pose."""
    run = fold(arm, push=-0.1, **{"surface.contact": "unilateral"})
    assert run.events[0].kind == "liftoff"
    assert run.events[0].time < AT_POSE
    assert np.all(run.contact_force >= 0.0)


def test_a_step_far_shorter_than_the_pose_is_wide_goes_through(arm):
    """Several rows in a row within the bound of what is singular."""
    begin = 2e-5
    run = fold(arm, begin, **{"time.step": 1e-6, "time.duration": 8e-5, "stabiliser.kind": "none"})
    assert np.count_nonzero(run.normal_mobility == 0.0) > 1
    truth = np.array([folded(RATE * t - begin)[0] for t in run.time])
    assert np.max(np.abs(run.q - truth)) < 1e-12


@pytest.mark.parametrize("speed", [0.0, 1e-9])
def test_a_tip_that_stays_there_stops(arm, speed):
    """Without a way through the pose no force can be told."""
    q, v, _ = folded(0.0)
    changes = {"start.q": q.tolist(), "start.v": (speed * v).tolist(), "reference.kind": "hold"}
    with pytest.raises(cl.SingularClosureError, match=r"t = 0 s.*does not determine") as caught:
        cl.simulate(cl.load_scenario("planar2_slide", changes), model=arm)
    assert len(caught.value.run) == 0


def wam(**changes):
    """A run of the shipped scenario."""
    return cl.simulate(cl.load_scenario("wam_through_singularity", changes))


def test_wam_glides_through():
    """q₂ = 0.2 t − 0.12 and f = 10 N, also in the pose."""
    run = wam()
    truth = np.tile(run.q[0], (len(run), 1)) + np.outer(run.time, [0.0, 0.2, 0.0, 0.0])
    np.testing.assert_allclose(run.q, truth, atol=1e-10)
    np.testing.assert_allclose(run.contact_force, 10.0, atol=0.05)
    at = int(np.argmin(np.abs(run.time - WAM_POSE)))
    assert run.normal_mobility[at] == 0.0
    assert run.contact_force[at] == pytest.approx(10.0, abs=1e-2)


@pytest.mark.parametrize("step", [0.0005, 0.000125, 0.0000625])
@pytest.mark.parametrize("speed", [0.2, 0.2148])
def test_rounding_near_the_pose_does_not_decide_over_the_force(step, speed):
    """Also with steps that have rows where rounding of the tip's position makes hundreds of N of Eq. 24's row."""
    run = wam(**{"time.step": step, "start.v": [0.0, speed, 0.0, 0.0], "time.duration": 0.65})
    np.testing.assert_allclose(run.contact_force, 10.0, atol=0.1)
    np.testing.assert_allclose(run.q[:, 1], speed * run.time - 0.12, atol=1e-12)
    passed = np.flatnonzero(run.normal_mobility == 0.0) * step
    assert passed.size > 1
    np.testing.assert_allclose(passed, 0.12 / speed, atol=2e-3)
    assert run.summary()["verdict"]["good"]


@pytest.mark.parametrize("step", [0.000125, 0.0000625])
def test_brakes_are_a_push_at_short_steps_too(step):
    """Where f is taken from the way, what pushes only there is seen behind the pose."""
    with pytest.raises(cl.SingularClosureError, match="pushes it that way") as caught:
        wam(**{"law.kd": 5.0, "law.pd_start": 0.599, "time.step": step})
    assert caught.value.time == pytest.approx(WAM_POSE, abs=3e-3)


def test_wam_on_the_other_branch_is_what_shorter_steps_give():
    """Two motions lead through the pose. On the one in which all joints turn, rk4 agrees with itself on the other side.

    The start, 0.5 s before the pose, is from an integration away from it with DOP853, |δq| some 1e-12.
    """
    start = {
        "start.q": [1.2943284445810679, -0.10008566590531996, 1.5717973386031001, 1.6985856235713168],
        "start.v": [0.5529448209924667, 0.20051686083069795, -0.006027751892233619, 0.0006479757539757995],
        "time.duration": 1.0,
    }
    run, fine = wam(**start), wam(**start, **{"time.step": 0.00025})
    at = int(np.argmin(run.normal_mobility))
    assert run.time[at] == pytest.approx(0.5)
    assert run.normal_mobility[at] == 0.0
    np.testing.assert_allclose(run.q, fine.q[::4], atol=1e-9)
    away = np.abs(run.time - 0.5) > 0.02
    np.testing.assert_allclose(run.contact_force[away], fine.contact_force[::4][away], atol=1e-4)
    mirrored = (run.q - run.q[at]) * [-1.0, -1.0, -1.0, 1.0]
    np.testing.assert_allclose(mirrored[::-1], run.q - run.q[at], atol=1e-6)


def test_a_pose_that_is_passed_leaves_the_paper_and_is_no_fault(capsys):
    """The run is good, and says when."""
    run = wam(**{"time.duration": 0.7})
    held = run.summary()["assumptions"]["nonsingular"]
    assert (held["held"], held["expected"]) == (False, False)
    assert held["first_failed"] == pytest.approx(WAM_POSE, abs=0.01)
    assert run.summary()["verdict"]["good"]
    print_report(run, width=120)
    said = capsys.readouterr().out
    assert said.startswith("verdict: good, outside the paper's assumptions: singular pose passed at t = 0.6 s\n")


def stays(run):
    """Whether a run near a singular pose is at fault."""
    return "nonsingular" in [problem["name"] for problem in run.summary()["verdict"]["problems"]]


def test_a_pose_that_is_not_passed_is_a_fault(arm):
    """A run that stops in it, ends in it, begins near it, or near which the force grows."""
    with pytest.raises(cl.SingularClosureError) as caught:
        wam(**{"law.kd": 5.0, "law.pd_start": 0.599})
    assert stays(caught.value.run)
    assert not stays(wam(**{"time.duration": 0.61}))
    assert stays(wam(**{"time.duration": 0.6}))
    passed = fold(arm)
    begun, force = passed.normal_mobility.copy(), passed.contact_force.copy()
    begun[0] = 1e-9
    force[passed.normal_mobility < 1e-6] *= 3.0
    for planted in ({"normal_mobility": begun}, {"contact_force": force}):
        assert stays(dataclasses.replace(passed, columns=passed.columns | planted))


def test_brakes_push_the_tip_along_the_normal():
    """Its twin, whose brakes take hold on the way, stops in the pose."""
    with pytest.raises(cl.SingularClosureError, match="pushes it that way") as caught:
        wam(**{"law.kd": 5.0, "law.pd_start": 0.599})
    assert caught.value.time == pytest.approx(WAM_POSE, abs=2e-3)


def near_the_pose(seed):
    """The memory of a tip near a singular pose, with viscous friction too, and what counts as no push there."""
    loop, _, rng = loop_at_random("wam_slide", {"time.duration": 0.01}, seed)
    constants, w = loop.constants, loop.w
    constants.gravity[:], w.scratch.column[:], w.friction.c[:], w.friction.viscous[:] = (
        rng.normal(size=(4, 3))[0],
        3.0,
        [0.3, -0.2],
        [0.5, 0.7],
    )
    C, L = rng.normal(size=4), np.tril(w.L, -1) + np.diag(1.0 / np.diag(w.L))
    w.tip.S[0, 0] = 0.0
    size = np.sqrt(np.trace(w.tip.S))

    def most(rate):
        loads = np.linalg.norm(np.linalg.solve(L, w.scratch.column)) + np.linalg.norm(np.linalg.solve(L, C))
        moving = np.linalg.norm(L.T @ w.v) * rate
        return 1e-3 * (loads + (np.linalg.norm(constants.gravity) + moving) / size)

    w.approach[:] = 0.0
    return loop, Approach(w.approach, 4), C, most


@pytest.mark.parametrize("pushed", [0.0, 0.9, -0.9, 1.1, -1.1])
@pytest.mark.parametrize("along", [0.0, 0.9, -0.9, 1.1, -1.1])
def test_force_in_the_pose_is_that_of_a_push_linear_in_the_distance(pushed, along):
    """g = f ℓ + p gives f, with friction, as long as p and the tip's acceleration along n count as none."""
    loop, way, C, most = near_the_pose(1)
    state, constants, w = loop.state, loop.constants, loop.w
    way.time[:], way.lever[:], w.time, state.approached, rate = [0.2, 0.1], [0.03, 0.04], 0.45, 2, 0.1
    way.push[:] = 7.0 * way.lever + pushed * most(rate)
    w.tip.a[0] = along * most(rate) * np.sqrt(np.trace(w.tip.S)) + w.tip.S[0, 1:] @ w.friction.viscous
    found = interpreted(force_in_singular_pose)(C, w, constants, state)
    if abs(pushed) > 1.0 or abs(along) > 1.0:
        assert found == PUSHED
        return
    assert found == OK
    np.testing.assert_allclose(w.tip.F, [7.0, *(-7.0 * w.friction.c - w.friction.viscous)], rtol=1e-10)
    assert (w.tip.rigid_force, w.tip.stabiliser_force[0], w.tip.b[0]) == (w.tip.F[0], 0.0, 0.0)


def test_a_way_that_is_none_or_too_long_ago_gives_no_force():
    """Two substeps that came nearer, of which the later would have been in the pose a quarter of the time ago."""
    for lever, time, approached, expected in (
        ([0.03, 0.04], 0.2 + 3.9 * 0.3, 2, OK), ([0.03, 0.04], 0.2 + 4.1 * 0.3, 2, SINGULAR),
        ([0.03, 0.04], 0.3, 1, SINGULAR), ([0.04, 0.03], 0.3, 2, SINGULAR), ([0.03, 0.03], 0.3, 2, SINGULAR),
    ):  # fmt: skip
        loop, way, C, _ = near_the_pose(2)
        state, constants, w = loop.state, loop.constants, loop.w
        way.time[:], way.lever[:], way.push[:], w.time = [0.2, 0.1], lever, -7.0 * np.array(lever), time
        state.approached, state.settings.unilateral, w.tip.a[0] = approached, 1, w.tip.S[0, 1:] @ w.friction.viscous
        assert interpreted(force_in_singular_pose)(C, w, constants, state) == expected
        if expected == OK:
            np.testing.assert_allclose(w.tip.F, [0.0, *-w.friction.viscous], atol=1e-12)  # it cannot pull


@pytest.mark.parametrize("push", [0.0, 0.9, -0.9, 1.1, -1.1])
def test_a_push_is_told_from_both_sides_of_the_pose(push):
    """Where A has turned round, g on the line between both sides is compared with what counts as none."""
    loop, way, C, most = near_the_pose(3)
    constants, w, before, after = loop.constants, loop.w, 0.03, 0.05
    way.time[0], way.lever[0], w.time, rate = 0.2, before, 0.3, (before + after) / 0.1
    w.tip.S[0, 0] = after * after
    w.tip.S[1, 1] -= after * after  # the trace as it was
    way.push[0] = 7.0 * before + push * most(rate)
    way.row[:] = -w.tip.X[0]
    rigid = (-7.0 * after + push * most(rate)) / -after  # of g with the other sign
    assert interpreted(pushed_on_the_way)(C, w, constants, rigid) == (abs(push) > 1.0)
    way.row[:] = w.tip.X[0]
    assert not interpreted(pushed_on_the_way)(C, w, constants, rigid)


def test_what_is_remembered_of_the_way():
    """Of a substep's beginning: its instant, ℓ, g without the stabiliser and L⁻¹Aᵀ; what was before it is next."""
    loop, way, _, _ = near_the_pose(4)
    state, w = loop.state, loop.w
    remember = interpreted(remember_approach)
    remember(w, state)
    assert state.approached == 0
    for k, lever in enumerate((0.04, 0.03)):
        w.tip.S[0, 0], w.start.time, w.tip.F[0], w.tip.stabiliser_force[0] = lever**2, 0.1 * (k + 1), 7.0, 2.0
        remember(w, state)
    assert state.approached == 2
    np.testing.assert_allclose([way.time, way.lever, way.push], [[0.2, 0.1], [0.03, 0.04], [0.15, 0.2]], rtol=1e-14)
    np.testing.assert_array_equal(way.row, w.tip.X[0])
