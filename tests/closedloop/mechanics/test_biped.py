"""A biped that is put down on flat feet: contacts share what they carry, and two legs nearly hold each other twice."""

import pytest

import closedloop as cl

FOOT = ((-0.035, 0.0, -0.056), (0.115, 0.0, -0.056), (0.14, -0.03, -0.056), (0.14, 0.03, -0.056))
RADIUS = 0.014
LENGTH = 0.17 + 0.4 + 0.4 + 0.056 + RADIUS  # from the pelvis to the soles


def leg(side, y, joint):
    """A leg in MJCF: yaw, roll, pitch, knee and ankle, all with springs; no ankle rolls."""
    parts = [("yaw", "0 0 1", f"0 {y} -0.17", 2.2, 0.0), ("roll", "1 0 0", "0.04 0 0", 2.2, 0.0),
             ("thigh", "0 1 0", f"0 {0.115 if y > 0 else -0.115} 0", 4.2, -0.17),
             ("shin", "0 1 0", "0 0 -0.4", 1.7, -0.15)]  # fmt: skip
    text = "".join(
        f'<body name="{side}_{name}" pos="{at}"><joint name="{side}_{name}" axis="{axis}" {joint}/>'
        f'<inertial pos="0 0 {z}" mass="{m}" diaginertia="{0.01 * m} {0.01 * m} {0.004 * m}"/>'
        for name, axis, at, m, z in parts
    )
    return text + (
        f'<body name="{side}_foot" pos="0 0 -0.4"><joint name="{side}_ankle" axis="0 1 0" {joint}/>'
        '<inertial pos="0.04 0 -0.04" mass="0.6" diaginertia="0.0003 0.0022 0.0024"/>' + 5 * "</body>"
    )


@pytest.mark.parametrize(("stiffness", "damping", "friction"), [(500.0, 3.0, 0.6), (500.0, 10.0, 1.0)])
def test_a_biped_is_put_down_without_chatter(tmp_path, stiffness, damping, friction):
    """Each foot has four points: a point that carries nothing goes with the others, and is no event of its own."""
    joint = f'stiffness="{stiffness}" damping="{damping}" armature="0.02"'
    (tmp_path / "biped.xml").write_text(
        f'<mujoco><worldbody><body name="pelvis" pos="0 0 {LENGTH + 0.05}"><freejoint/>'
        '<inertial pos="0 0 0.25" mass="20" diaginertia="1.2 0.9 0.3"/>'
        f"{leg('left', 0.087, joint)}{leg('right', -0.087, joint)}</body></worldbody></mujoco>"
    )
    contacts = [
        {"link": f"{side}_foot", "at": list(at), "radius": RADIUS, "friction": friction, "normal": [0, 0, 1]}
        for side in ("left", "right") for at in FOOT
    ]  # fmt: skip
    scenario = {
        "robot": {"model": str(tmp_path / "biped.xml")}, "surface": {"kind": "none"}, "law": {"kind": "none"},
        "contact": contacts, "time": {"duration": 0.3, "step": 1e-3, "integrator": "semi_implicit_euler"},
    }  # fmt: skip
    run = cl.simulate(cl.Scenario.model_validate(scenario), progress=False)
    assert run.summary()["verdict"]["good"]
    assert sum(event.kind == "touchdown" for event in run.events) >= 8
    assert len(run.events) <= 40
    assert run.link_gaps.min() > -1e-6
