"""What a contact of a link may be, each by itself: the tip's own code says the same of it, or a closed form does.

A mass of 2 kg moves on a floor or in a bowl that is written as a [[contact]], and as [surface]; or an arm drops.
"""

import sys

import numpy as np
import pytest
from budget import others
from pydantic import Field

import closedloop as cl
from closedloop.mechanics.friction.law import SurfaceFriction
from closedloop.mechanics.surface.motion import SurfaceMotion
from closedloop.mechanics.surface.surface import Compliance, Surface

G = 9.81
FAR = {"kind": "plane", "offset": "start", "gap": 50.0, "contact": "unilateral"}
UNTOUCHED = [{"link": "tip", "through": [0, 0, -50.0]}]
LAWS = {
    "coulomb": {"kind": "coulomb", "coefficient": 0.2},
    "coulomb_viscous": {"kind": "coulomb_viscous", "coefficient": 0.2, "viscous": 1.0},
    "stribeck": {"kind": "stribeck", "kinetic": 0.2, "static": 0.3, "stribeck_speed": 1e-2},
    "karnopp": {"kind": "karnopp", "kinetic": 0.2, "static": 0.3, "dead_band": 1e-3},
    "dahl": {"kind": "dahl", "coefficient": 0.2, "stiffness": 1e4},
    "lugre": {
        "kind": "lugre", "kinetic": 0.2, "static": 0.3, "stribeck_speed": 1e-2, "stiffness": 1e4, "damping": 50.0,
    },
    "seven_parameter": {
        "kind": "seven_parameter", "kinetic": 0.2, "static_excess": 0.1, "stribeck_speed": 1e-2, "stiffness": 1e4,
        "memory_delay": 3e-3, "rise_time": 0.1,
    },
}  # fmt: skip


def thrown(surface, contacts, q=(0, 0, 0), v=(0.3, 0, 0), **changes):
    """The run of the mass, on which nothing acts but its weight and its contacts."""
    changes = {
        "robot.model": "pointmass3", "law": {"kind": "none"}, "reference": {"kind": "hold"}, "time.duration": 0.25,
        "time.step": 5e-4, "time.integrator": "semi_implicit_euler", "stabiliser.time_constant": 0.01,
        "surface": surface, "contact": contacts, "start.q": list(q), "start.v": list(v), **changes,
    }  # fmt: skip
    return cl.simulate(cl.load_scenario("planar2_drop", changes), progress=False)


def by_link_and_by_tip(contact, tip, q=(0, 0, 0), v=(0.3, 0, 0), floor=None, **changes):
    """The runs on a floor, or another surface, that is a contact's, and the tip's own."""
    own = {"kind": "plane", "offset": 0.0, "contact": "unilateral"} if floor is None else floor
    one = thrown(FAR, [{"link": "tip", **contact}], q, v, **changes)
    return one, thrown(own, UNTOUCHED, q, v, **tip, **changes)


def assert_alike(link, tip, position=1e-12, force=1e-9):
    """The same motion, force, friction and events."""
    np.testing.assert_allclose(link.q, tip.q, rtol=0.0, atol=position)
    np.testing.assert_allclose(link.link_forces[:, 0], tip.contact_force, rtol=0.0, atol=force)
    np.testing.assert_allclose(
        np.hypot(*link.link_frictions.T), np.linalg.norm(tip.friction_force, axis=1), rtol=0.0, atol=force
    )
    assert [event.kind for event in link.events] == [event.kind for event in tip.events]


@pytest.mark.parametrize(
    ("law", "scheme"),
    [
        ("lugre", "semi_implicit_euler"),
        *others(
            (law, scheme)
            for law in LAWS
            for scheme in ("semi_implicit_euler", "rk4", "dop853")
            if not (law == "lugre" and scheme == "semi_implicit_euler")
            and not (law == "seven_parameter" and scheme == "dop853")
        ),
    ],
)
def test_every_law_of_friction_is_the_one_of_the_tip(law, scheme):
    """Slip that ends, and what follows: sticking, the bristles' creep, the spring's stick-slip."""
    step = 5e-5 if scheme == "rk4" and law in ("dahl", "lugre", "seven_parameter") else 5e-4
    duration = 0.06 if step < 1e-4 else 0.25
    changes = {"time.integrator": scheme, "time.step": step, "time.duration": duration}
    v = (0.1, 0.05, 0) if duration < 0.1 else (0.3, 0.1, 0)
    link, tip = by_link_and_by_tip({"friction_law": LAWS[law]}, {"friction": LAWS[law]}, v=v, **changes)
    if law == "seven_parameter":  # each break-away is found to 1e-14 s, and moves what follows
        np.testing.assert_allclose(link.q, tip.q, atol=1e-5)
        assert {event.kind for event in link.events} <= {event.kind for event in tip.events}
    elif scheme == "dop853":  # the tip's slow slip is integrated by a scheme of its own
        np.testing.assert_allclose(link.q, tip.q, atol=1e-7)
    else:
        assert_alike(link, tip)
    assert link.summary()["verdict"]["good"] == tip.summary()["verdict"]["good"]


def test_friction_law_coulomb_is_friction():
    """To the bit: a section that says what the number says."""
    number = thrown(FAR, [{"link": "tip", "friction": 0.2}])
    section = thrown(FAR, [{"link": "tip", "friction_law": LAWS["coulomb"]}])
    assert np.array_equal(number.q, section.q)
    with pytest.raises(cl.ScenarioError, match="friction and friction_law are both given"):
        thrown(FAR, [{"link": "tip", "friction": 0.2, "friction_law": LAWS["dahl"]}])


@pytest.mark.parametrize("compliance", [None, {"kind": "kelvin_voigt", "stiffness": 2e4, "damping": 200.0}])
def test_edge_ends_a_contact_as_it_ends_the_tips(compliance):
    """A floor that ends 2 cm away, rigid or soft: the mass falls beyond it. Beside a disc it falls past."""
    soft = {} if compliance is None else {"compliance": compliance}
    depth = [0, 0, 0 if compliance is None else -2 * G / 2e4]
    contact = {"friction": 0.1, "surface": {"kind": "plane", "extent": [0.02, 1.0]}, **soft}
    floor = {"kind": "plane", "offset": 0.0, "extent": [0.02, 1.0], "contact": "unilateral"}
    if compliance is not None:
        floor["offset"] = depth[2]  # a tip starts in a soft surface as deep as it is pressed: it is not
        contact["through"] = [0, 0, depth[2]]
    link = thrown(FAR, [{"link": "tip", **contact}], depth)
    assert [event.kind for event in link.events][-1] == "edge"
    assert link.link_gaps[-1, 0] < -0.1
    assert not np.any(link.link_forces[link.link_gaps[:, 0] < -0.01])
    if compliance is None:
        tip = thrown(floor, UNTOUCHED, depth, friction=LAWS["coulomb"] | {"coefficient": 0.1})
        assert_alike(link, tip)
        assert link.events[0].time == pytest.approx(tip.events[0].time, abs=1e-13)
    disc = [{"link": "tip", "surface": {"kind": "plane", "edge_radius": 0.02}}]
    past = thrown(FAR, disc, [0.05, 0, 0.01], [-0.1, 0, 0])
    assert not past.events
    assert past.q[-1, 2] == pytest.approx(0.01 - 0.5 * G * 0.25**2, rel=5e-3)
    upon = thrown(FAR, disc, [0.0, 0, 0.01], [0, 0, 0])
    assert [event.kind for event in upon.events] == ["touchdown"]


def test_projection_keeps_contacts_closed():
    """In a bowl to rounding, and as the tip's; of the gripper's six contacts, which are not independent, too."""
    bowl = {"kind": "sphere", "radius": 0.4, "inside": True}
    start = [0.2, 0.0, 0.4 - np.sqrt(0.16 - 0.04)], [0.0, 0.3, 0.0]
    link, tip = by_link_and_by_tip(
        {"friction": 0.2, "surface": bowl}, {"friction": LAWS["coulomb"]}, *start,
        bowl | {"normal": [0, 0, 1], "point": [0, 0, 0], "contact": "unilateral"},
        **{"stabiliser": {"kind": "projection"}, "time.step": 2e-3, "time.integrator": "rk4"},
    )  # fmt: skip
    assert_alike(link, tip)
    assert np.max(np.abs(link.link_gaps)) < 1e-15
    changes = {"time.duration": 0.01, "stabiliser": {"kind": "projection"}}
    gripper = cl.simulate(cl.load_scenario("gripper_block", changes), progress=False)
    assert np.max(np.abs(gripper.link_gaps)) < 1e-15
    assert np.max(gripper.residual_motion) < 1e-13


class Bowl(Surface):
    """A paraboloid."""

    depth: float = Field(1.0, description="height at 1 m, 1/m")

    @staticmethod
    def level(at, par, gradient, hessian):
        """φ = z − d (x² + y²)."""
        gradient[0], gradient[1], gradient[2] = -2.0 * par.depth * at[0], -2.0 * par.depth * at[1], 1.0
        hessian[0, 0] = hessian[1, 1] = -2.0 * par.depth
        return at[2] - par.depth * (at[0] * at[0] + at[1] * at[1])


class Cushion(Compliance):
    """A spring and a damper."""

    stiffness: float = Field(2e4, description="k, N/m")

    def tangent(self, depth):
        """Of both."""
        return self.stiffness, 300.0

    @staticmethod
    def force(depth, speed, par):
        """k δ + c δ̇."""
        return par.stiffness * depth + 300.0 * speed


class Lift(SurfaceMotion):
    """Up with a constant acceleration."""

    rise: float = Field(2.0, description="acceleration, m/s²")

    @staticmethod
    def move(t, par, m):
        """Write it."""
        m.shift[2], m.shift_rate[2], m.shift_acceleration[2] = 0.5 * par.rise * t * t, par.rise * t, par.rise


class Smooth(SurfaceFriction):
    """Regularised."""

    coefficient: float = Field(0.2, description="μ, 1")

    @staticmethod
    def slide(x, par, z, c, w):
        """μ u/(|u| + 0.01)."""
        for k in range(c.size):
            c[k] = par.coefficient * x.u[k] / (x.speed + 0.01)


class Failing(Smooth):
    """One that fails on the way."""

    @staticmethod
    def slide(x, par, z, c, w):
        """Raise where it is slow."""
        if x.speed < 0.2:
            raise ValueError("too slow")
        for k in range(c.size):
            c[k] = par.coefficient * x.u[k] / x.speed


@pytest.mark.slow
def test_what_a_user_writes_is_a_contacts_too():
    """Surface, motion, compliance and law of friction of one's own, named by an override or in the list."""
    mine = {"friction_law": {"kind": Smooth}, "motion": {"kind": Lift}}
    lifted, tip = by_link_and_by_tip(mine, {"friction.kind": Smooth, "surface_motion.kind": Lift})
    assert_alike(lifted, tip)
    np.testing.assert_allclose(lifted.link_forces, 2.0 * (G + 2.0), atol=0.1)  # the stabiliser's part is in it
    bowl, tip = by_link_and_by_tip(
        {"surface": {"kind": Bowl}}, {}, floor={"kind": Bowl, "contact": "unilateral"}, **{"time.duration": 0.05}
    )
    assert_alike(bowl, tip)
    cushion = {"contact.0.compliance.kind": Cushion, "contact.0.through": [0, 0, 0]}
    soft = thrown(FAR, UNTOUCHED, [0, 0, 1e-3], [0, 0, 0], **cushion)
    assert soft.scenario.contact[0].compliance.stiffness == 2e4
    assert soft.link_forces[-1, 0] == pytest.approx(2.0 * G, rel=1e-6)
    with pytest.raises(cl.LawError, match=r"test_contact_features\.py:\d+: ValueError: too slow"):
        thrown(FAR, [{"link": "tip", "friction_law": {"kind": Failing}}])
    assert Failing.__module__ in sys.modules


def test_dry_friction_of_joints_beside_contacts():
    """As beside the tip's contact: a mass slides to rest on a floor, and an arm drops and rests."""
    rubs, floor = {"kind": "coulomb", "kinetic": [1.0, 2.0, 3.0]}, {"kind": "coulomb", "coefficient": 0.1}
    link, tip = by_link_and_by_tip({"friction": 0.1}, {"friction": floor}, v=(0.3, 0.2, 0), joint_friction=rubs)
    np.testing.assert_allclose(link.q, tip.q, rtol=0.0, atol=1e-12)
    same = link.link_modes[:, 0] == tip.mode  # but at the row at which it comes to rest
    assert np.sum(~same) <= 1
    np.testing.assert_allclose(link.joint_friction[same], tip.joint_friction[same], atol=1e-9)
    np.testing.assert_allclose(link.link_forces[:, 0], tip.contact_force, atol=1e-9)
    assert [event.kind for event in link.events] == [event.kind for event in tip.events] == ["stick"]


@pytest.mark.parametrize("feet", [2, pytest.param(4, marks=pytest.mark.slow)])
def test_arm_on_several_contacts_with_dry_joints_comes_to_rest(feet):
    """Each joint within its friction, each contact within its cone, and the equation of motion holds."""
    at = [[0.02 * (-1) ** i, 0.02 * (i // 2), 0.0] for i in range(feet)]
    contact = [{"link": "tip", "at": at, "friction": 0.3}]
    changes = {"contact": contact, "surface": {"kind": "none"}, "time.duration": 0.8, "time.integrator": "rk4"}
    changes["joint_friction"] = {"kind": "coulomb", "kinetic": 0.5}
    run = cl.simulate(cl.load_scenario("planar2_drop", changes), progress=False)
    assert run.stopped is None
    assert np.all(np.abs(run.joint_friction) <= 0.5 * (1 + 1e-12))
    assert np.max(np.abs(run.v[-1])) < 1e-9
    assert np.max(run.residual_motion) < 1e-12


@pytest.mark.slow
def test_a_held_tip_with_dry_friction_beside_a_contact():
    """A tip that cannot part keeps |F_t| <= μ|f| where another link touches down too, sliding or stuck."""
    changes = {
        "time.duration": 0.4, "friction": {"kind": "coulomb", "coefficient": 0.2}, "surface.contact": "bilateral",
        "reference.start": 0.05, "reference.speed": -0.1, "reference.stop": 0.3,
    }  # fmt: skip
    far = [{"link": "link2", "through": [0, 0, -50.0], "friction": 0.3}]
    start = cl.simulate(cl.load_scenario("planar2_slide", changes | {"contact": far}), progress=False)
    assert np.ptp(start.link_gaps) > 1e-4
    # A floor, or a ceiling, that the elbow comes to half of the way.
    way = start.link_gaps[:, 0] - 50.0
    height, sign = float(way[0] + way[-1]) / 2.0, 1.0 if way[-1] < way[0] else -1.0
    near = [far[0] | {"through": [0, 0, height], "normal": [0, 0, sign]}]
    run = cl.simulate(cl.load_scenario("planar2_slide", changes | {"contact": near}), progress=False)
    assert run.stopped is None
    rub = np.linalg.norm(run.friction_force, axis=1)
    assert np.all(rub <= 0.2 * np.abs(run.contact_force) * (1 + 1e-9) + 1e-8)
    assert [(event.kind, event.contact) for event in run.events] == [("slip", 0), ("touchdown", 1), ("stick", 0)]
    assert np.max(np.abs(run.closure_error)) < 1e-6
    assert np.min(run.link_gaps) > -1e-6


def test_rest_speed_of_each_contact():
    """A bounce slower than the contact's own is none, by name or number; the other bounces on."""
    feet = [{"link": "tip", "name": "foot", "restitution": 0.5}]
    changes = {"q": [0, 0, 0.05], "v": [0, 0, 0]}
    bounces = thrown(FAR, feet, **changes)
    assert [event.kind for event in bounces.events][:2] == ["impact", "impact"]
    rests = thrown(FAR, feet, **changes, **{"contact.foot.rest_speed": 1.0})
    assert [event.kind for event in rests.events] == ["touchdown"]


@pytest.mark.slow
def test_features_in_a_batch_and_in_both_engines():
    """A sweep over a parameter of a contact's law is the runs one by one; the engines agree."""
    feet = [{"link": "tip", "name": "foot", "friction_law": LAWS["dahl"]}]
    key = "contact.foot.friction_law.coefficient"
    base = {
        "robot.model": "pointmass3", "law": {"kind": "none"}, "reference": {"kind": "hold"}, "time.duration": 0.02,
        "surface": FAR, "contact": feet, "start.q": [0, 0, 0], "start.v": [0.3, 0, 0],
        "time.integrator": "semi_implicit_euler",
    }  # fmt: skip
    scenario = cl.load_scenario("planar2_drop", base)
    table = cl.simulate_batch(scenario, {key: [0.1, 0.3]}, keep=["q"], engine="pinocchio")
    for i, value in enumerate([0.1, 0.3]):
        run = cl.simulate(cl.load_scenario("planar2_drop", base | {key: value}), progress=False, engine="pinocchio")
        np.testing.assert_array_equal(np.array(table["q"][i].as_py()).reshape(run.q.shape), run.q)
    other = cl.simulate(cl.load_scenario("planar2_drop", base | {key: 0.3}), progress=False, engine="compiled")
    np.testing.assert_allclose(other.q, run.q, atol=1e-12)
