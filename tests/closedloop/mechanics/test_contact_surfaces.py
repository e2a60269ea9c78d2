"""Contacts of links with surfaces that are curved or move: the tip's own, closed forms, and what is conserved."""

import numpy as np
import pytest
from box_in_plane import G, body, total_energy

import closedloop as cl
import robot_models
from closedloop.mechanics.closure.contact_force import FREE, PRESSED, STUCK
from closedloop.record.columns.touching import Touching, contact_torques
from closedloop.scenario.arm import robot_of
from validation.loops.cases import joint, point

FAR = {"kind": "plane", "offset": "start", "gap": 50.0, "contact": "unilateral"}


def thrown(contacts, q, v, duration=0.2, surface=FAR, model=None, **changes):
    """The run of a mass of 2 kg, or another model, on which nothing acts but its weight and its contacts."""
    changes = {
        "robot.model": "pointmass3", "law.kp": 0, "law.kd": 0, "law.force": 0, "time.duration": duration,
        "time.step": 2e-3, "time.integrator": "rk4", "stabiliser.time_constant": 0.01, "reference.kind": "hold",
        "surface": surface, "contact": contacts, "start.q": list(q), "start.v": list(v), **changes,
    }  # fmt: skip
    return cl.simulate(cl.load_scenario("planar2_drop", changes), model=model, law=lambda x: 0.0 * x.q)


def test_mass_in_a_bowl_is_the_tip_in_a_bowl():
    """With friction, sliding round it: a [[contact]] with a sphere, and the tip on the same one, to rounding."""
    R, bowl = 0.4, {"kind": "sphere", "radius": 0.4, "inside": True}
    start = [0.2, 0.0, R - np.sqrt(R * R - 0.04)], [0.0, 0.3, 0.0]
    contact = [{"link": "tip", "friction": 0.2, "surface": bowl}]
    one = thrown(contact, *start)
    ground = bowl | {"normal": [0, 0, 1], "point": [0, 0, 0], "contact": "unilateral"}
    rough = {"friction": {"kind": "coulomb", "coefficient": 0.2}}
    far = [{"link": "tip", "through": [0, 0, -50.0]}]
    for other in (thrown(None, *start, surface=ground, **rough), thrown(far, *start, surface=ground, **rough)):
        np.testing.assert_allclose(one.q, other.q, atol=1e-13)
        np.testing.assert_allclose(one.link_forces[:, 0], other.contact_force, atol=1e-10)
    assert np.all(one.link_modes == PRESSED)
    assert np.ptp(total_energy(one)) < 1e-8
    assert np.max(np.abs(one.link_gaps)) < 1e-8


@pytest.mark.parametrize(("normal", "axis"), [([0, -1, 0], [0, 0, 1]), ([0, -1, 0], [1, 0, 0]), ([1, 0, 0], [0, 3, 4])])
def test_the_axis_of_a_surface_is_in_the_axes_of_the_frame_that_carries_it(normal, axis):
    """A mass that flies past a cylinder is as far from it as from its axis, less the radius."""
    pipe = {"kind": "cylinder", "radius": 0.3, "axis": axis}
    run = thrown(
        [{"link": "tip", "normal": normal, "surface": pipe}], np.array([0.1, 0.2, 0.3]) + normal, [0.2, 0.1, 0.3]
    )
    along = np.array(axis) / np.linalg.norm(axis)
    from_axis = run.q + 0.3 * np.array(normal)
    distance = np.linalg.norm(from_axis - np.outer(from_axis @ along, along), axis=1)
    np.testing.assert_allclose(run.link_gaps[:, 0], distance - 0.3, atol=1e-12)


def test_belt_takes_a_mass_along_and_a_turntable_holds_it():
    """v/(μ g) until it sticks; on the disc friction is m ω² r towards the axis. A bounce on a belt gains its speed."""
    for kind in ("conveyor", "belt"):
        belt = [{"link": "tip", "friction": 0.3, "motion": {"kind": kind, "velocity": [0.5, 0, 0]}}]
        run = thrown(belt, [0, 0, 0], [0, 0, 0])
        (stick,) = run.events
        assert stick.time == pytest.approx(0.5 / (0.3 * G), abs=1e-12)
        np.testing.assert_allclose(run.v[-1], [0.5, 0, 0], atol=1e-12)
        assert np.ptp(total_energy(run)) < 1e-12  # the work of the belt is counted
    disc = [{"link": "tip", "friction": 0.3, "motion": {"kind": "turntable", "speed": 3.0}}]
    round_ = thrown(disc, [0.1, 0, 0], [0, 0.3, 0])
    np.testing.assert_allclose(np.hypot(round_.q[:, 0], round_.q[:, 1]), 0.1, atol=1e-7)
    np.testing.assert_allclose(np.hypot(*round_.link_frictions.T), 2.0 * 9.0 * 0.1, rtol=1e-4)
    assert np.all(round_.link_modes == STUCK)
    bouncing = thrown([disc[0] | {"restitution": 0.5}], [0.1, 0, 0.02], [0, 0, 0])
    assert sum(event.kind == "impact" for event in bouncing.events) > 3
    assert np.ptp(total_energy(bouncing)) < 1e-8


def two_bodies():
    """Two bodies that may go anywhere in the plane x-z: three joints each."""
    text = '<robot name="pair"><link name="base"/>'
    for name, mass in (("a", 1.0), ("b", 2.0)):
        text += body(f"{name}x", 1e-9, 1e-12) + body(f"{name}z", 1e-9, 1e-12) + body(name, mass, 0.01)
        text += joint(f"{name}X", "base", f"{name}x", axis="1 0 0", kind="prismatic")
        text += joint(f"{name}Z", f"{name}x", f"{name}z", axis="0 0 1", kind="prismatic")
        text += joint(f"{name}T", f"{name}z", name)
    return robot_models.from_text(
        text + point("tip", "a") + "</robot>", "urdf", name="pair", armature=np.zeros(6), tip="tip", home=[0.0] * 6,
        locked={},
    )  # fmt: skip


@pytest.mark.parametrize("friction", [0.0, 0.1])
def test_body_strikes_and_slides_in_a_bowl_that_another_carries(friction):
    """Momentum is kept along both axes and about the origin, energy with its losses counted: no external force acts."""
    bowl = {"kind": "sphere", "radius": 0.4, "inside": True}
    contact = [
        {"link": "a", "at": [0.05, 0, -0.05], "against": "b", "through": [0, 0, -0.4], "friction": friction,
         "surface": bowl},
    ]  # fmt: skip
    q, v = [0.1, -0.2, 0.1, 0.0, 0.0, 0.0], [2.0, -0.5, 0.0, 0.0, 0.3, 0.4]
    changes = {"robot.gravity": [0, 0, 0], "time.step": 1e-3}
    model = two_bodies()
    run = thrown(contact, q, v, 0.15, model=model, **changes)
    assert run.events[0].kind == "touchdown"
    assert np.any(run.link_modes != FREE)
    mass, (vx, vz, spin) = np.array([1.0, 2.0]), (run.v[:, i::3] for i in range(3))
    x, z = run.q[:, 0::3], run.q[:, 1::3]
    for kept in (vx @ mass, vz @ mass, np.sum(0.01 * spin, axis=1) + (x * vz - z * vx) @ mass):
        assert np.ptp(kept) < 1e-8
    assert np.ptp(total_energy(run)) < 1e-8
    assert np.min(run.link_gaps) > -1e-8
    robot = robot_of(run.scenario, model)
    given = contact_torques(run.scenario, model.pinocchio_model(), run.time, run.q, run.link_forces, run.link_frictions)
    needed = robot.needed_torque(run.q, run.v, run.acceleration, np.zeros((len(run), 3)))
    missing = needed - run.torque - given
    assert np.max(np.abs(missing)) < 1e-11


@pytest.mark.parametrize(("name", "flat"), [("tower", True), ("ball_on_turntable", False)])
def test_torques_of_all_rows_are_those_of_each_and_points_on_planes_are_asked_once(monkeypatch, name, flat):
    """Row by row in Python, the summary of 22 000 rows with six contacts took 24 s, and the run itself 3 s."""
    run = cl.simulate(cl.load_scenario(name, {"time.duration": 0.02}), engine="compiled")
    mechanism, robot = run.model.pinocchio_model(), robot_of(run.scenario, run.model)
    of = run.scenario, mechanism
    q = robot.pinocchios(run.q)
    rows = run.link_forces + 0.1 * np.arange(len(run))[:, None], run.link_frictions + 0.3
    one_by_one = [contact_torques(*of, *(part[k : k + 1] for part in (run.time, q, *rows))) for k in range(len(run))]
    asked, force = [], Touching.force

    def counted(touching, *arguments):
        asked.append(touching.name)
        return force(touching, *arguments)

    monkeypatch.setattr(Touching, "force", counted)
    np.testing.assert_allclose(
        contact_torques(*of, run.time, q, *rows), np.concatenate(one_by_one), rtol=1e-12, atol=1e-12
    )
    assert len(asked) == rows[0].shape[1] * (1 if flat else len(run))


@pytest.mark.parametrize(
    ("contact", "said"),
    [
        ({"surface": {"kind": "sphre"}}, r"contact\[0\]\.surface\.kind = 'sphre': must be .*'sphere'"),
        ({"surface": {"kind": "sphere", "radis": 1.0}}, r"did you mean 'contact\[0\]\.surface\.radius'"),
        ({"friction": -1.0}, r"contact\[0\]\.friction = -1\.0: must not be negative"),
        ({"surface": {"kind": "sphere", "gap": 1.0}}, r"contact 'c': surface\.gap: must be left out"),
        ({"surface": {"kind": "cylinder", "axis": [0, 0, 1]}}, r"contact 'c': surface\.axis .* right angles"),
        (
            {"surface": {"kind": "sphere", "radius": 50.0}, "through": [0, 0, 5.0]},
            r"contact 'c': the point starts .* inside the surface",
        ),
        ({"motion": {"kind": "conveyor"}}, r"'contact\[0\]\.motion\.velocity' is missing"),
    ],
)
def test_what_is_wrong_with_a_surface_is_said_in_a_line(contact, said):
    """By the key of the contact's own table, or the name of the contact."""
    changes = {"surface.gap": 5.0, "contact": [{"name": "c", "link": "tip", "through": [0, 0, -9.0], **contact}]}
    with pytest.raises(cl.ScenarioError, match=said) as error:
        cl.prepare(cl.load_scenario("planar2_drop", changes))
    assert len(str(error.value).splitlines()) == 1


WAYS = {
    "transfer": (
        {"shift": [0.1, 0.0, 0.2], "start": 0.1, "stop": 0.9},
        lambda x: x - np.sin(2.0 * np.pi * x) / (2.0 * np.pi),
        lambda x: 2.0 * np.pi * np.sin(2.0 * np.pi * x),
    ),
    "poses": (
        {"times": [0.1, 0.9], "poses": [[5.0, 4.0, 3.0, 0.0, 2.0, 0.0, 1.0], [5.1, 4.0, 3.2, 0.0, -2.0, 0.0, -1.0]]},
        lambda x: x**3 * (10.0 - 15.0 * x + 6.0 * x * x),  # of two poses the quintic of minimum jerk
        lambda x: 60.0 * x * (1.0 - x) * (1.0 - 2.0 * x),
    ),
}


@pytest.mark.parametrize("kind", WAYS)
def test_a_mocap_body_moves_as_the_section_of_its_contact_says(tmp_path, kind):
    """A lift that is turned in the file carries a box along its own axes, and presses with m (g + s̈)."""
    keys, way, acceleration = WAYS[kind]
    path = tmp_path / "lift.xml"
    path.write_text(
        '<mujoco><worldbody><body name="lift" mocap="true" pos="1 2 .5" euler="0 0 90">'
        '<geom type="box" size=".2 .2 .1"/></body><body name="box" pos="1 2 .65"><freejoint/>'
        '<geom type="box" size=".05 .05 .05" mass="2"/></body>'
        "</worldbody></mujoco>"
    )
    moving = {"kind": kind, **keys}
    lift = {"name": "lift", "link": "box", "at": "collision", "against": "lift", "through": [0, 0, 0.1]}
    run = cl.simulate(
        cl.load_scenario(
            {
                "robot": {"model": str(path)}, "contact": [lift | {"friction": 1.0, "motion": moving}],
                "time": {"duration": 1.0, "integrator": "rk4"},
                "stabiliser": {"kind": "baumgarte", "time_constant": 0.01},
            }
        ),
        progress=False,
    )  # fmt: skip
    x = np.clip((run.time - 0.1) / 0.8, 0.0, 1.0)
    along = np.outer(way(x), [0.0, 0.1, 0.2])  # x of the lift is y of the base
    np.testing.assert_allclose(run.q[:, :3], np.array([1.0, 2.0, 0.65]) + along, atol=1e-8)
    rising = 0.2 * acceleration(x) / 0.64
    np.testing.assert_allclose(run.link_forces.sum(axis=1)[1:-1], 2.0 * (9.81 + rising)[1:-1], rtol=1e-6)
