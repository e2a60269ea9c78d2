"""The shipped hand and quadruped: weight carried, nothing slips, energy, by closed forms. A gripper: virtual work."""

from importlib.resources import files

import mujoco
import numpy as np
import pytest

import closedloop as cl

G, BLOCK, WEIGHT = 9.81, 0.3, 8.912 * 9.81


def test_a_hand_carries_a_block_by_friction_and_then_by_its_lower_finger():
    """The tendon's spring gives 250 (0.04 + 0.08) N on either side; the block stays where it is in the hand."""
    run = cl.simulate(cl.load_scenario("hand_turns"), progress=False)
    pressed, rubbed = run.link_forces.reshape(-1, 2, 4).sum(axis=2), run.link_frictions.reshape(len(run.time), 2, 4, 2)
    assert pressed.sum(axis=1) == pytest.approx(np.full(len(run.time), 2 * 30.0), abs=0.02)  # m r ω² of the fingers
    assert pressed[0] == pytest.approx([30.0, 30.0], rel=1e-9)
    carried = np.linalg.norm(rubbed.sum(axis=2), axis=2)
    assert carried[0] == pytest.approx([BLOCK * G / 2, BLOCK * G / 2], rel=1e-9)
    assert abs(pressed[-1, 1] - pressed[-1, 0]) == pytest.approx(BLOCK * G, rel=1e-4)
    assert np.all(carried[-1] <= 1e-2 * BLOCK * G)
    assert run.q[-1, 0] == pytest.approx(np.pi / 2, abs=1e-3)
    # the block turns about the hand's axis as the hand does, and its centre is on it
    half = 0.5 * (run.q[:, 0] - run.q[0, 0])
    turned = run.q[:, 6:10] * np.sign(run.q[:, 6:7])
    assert turned == pytest.approx(np.column_stack([np.cos(half), np.sin(half), 0 * half, 0 * half]), abs=1e-7)
    assert run.q[:, 3:6] == pytest.approx(np.tile([0.1034, 0.0, 0.4], (len(half), 1)), abs=1e-7)
    balance = run.energy_supplied - run.kinetic_energy - run.potential_energy
    assert np.ptp(balance) <= 1e-7 * WEIGHT
    assert run.summary()["verdict"]["good"]


def test_a_block_too_heavy_for_the_friction_falls():
    """With nine tenths of the friction that would hold it, it falls with a tenth of g."""
    more = {"time.duration": 0.05, "contact.*.friction": 0.9 * BLOCK * G / 60.0}
    run = cl.simulate(cl.load_scenario("hand_turns", more), progress=False)
    assert run.q[:, 5] == pytest.approx(0.4 - 0.05 * G * run.time**2, abs=1e-6)


def test_a_hand_with_four_fingers_holds_a_bar_and_rolls_it():
    """It turns by the thumb's way over its radius, less what the fingers give way; then it rests, and is carried."""
    run = cl.simulate(cl.load_scenario("hand_rolls"), progress=False)
    place, quaternion = run.q[:, 16:19], run.q[:, 19:]
    closed, end = 200, len(run.time) - 1  # row before the thumb goes, and the last one
    turned = 2.0 * np.arccos(abs(quaternion[closed] @ quaternion[end]))
    assert 0.5 * 0.015 / 0.0199 < turned < 0.015 / 0.0199
    assert np.abs(place[end] - place[end - 100]).max() < 1e-4
    assert np.abs(run.v[end]).max() < 1e-3
    # the forces of the pads on the bar, from the torques of the joints alone: together they bear its weight
    model = mujoco.MjModel.from_xml_path(str(files("closedloop") / "scenario/shipped/bodies/allegro_hand.xml"))
    data, total, J = mujoco.MjData(model), np.zeros(3), np.zeros((3, 16))
    data.qpos[:] = run.q[end, :16]
    mujoco.mj_forward(model, data)
    w, x, y, z = quaternion[end]
    axis = np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
    for k, finger in enumerate(("index", "middle", "ring", "thumb")):
        tip = data.site(f"{finger}_tip").xpos
        out = tip - place[end] - axis * (axis @ (tip - place[end]))
        normal = out / np.linalg.norm(out)
        mujoco.mj_jac(model, data, J, None, tip - 0.012 * normal, model.site(f"{finger}_tip").bodyid[0])
        joints = slice(4 * k, 4 * k + 4)
        force = np.linalg.lstsq(J.T[joints], (run.torque[end, :16] - data.qfrc_bias)[joints])[0]
        assert -force @ normal == pytest.approx(run.link_forces[end, k], abs=0.01)
        total += force
    assert total == pytest.approx([0.0, 0.0, 0.1 * G], abs=0.01)
    balance = run.energy_supplied - run.kinetic_energy - run.potential_energy
    assert np.ptp(balance[closed:]) <= 1e-6
    assert run.summary()["verdict"]["good"]


@pytest.mark.slow
def test_a_quadruped_carries_its_weight_before_and_after_a_push():
    """The feet carry m g at rest, stay where they stand, and no torque acts on the trunk but through them."""
    run = cl.simulate(cl.load_scenario("quadruped"), progress=False)
    feet = run.link_forces[:, :4].sum(axis=1)
    assert feet[-1] == pytest.approx(WEIGHT, rel=1e-3)
    assert run.torque[:, :6] == pytest.approx(np.zeros((len(run.time), 6)))
    pushed = [event for event in run.events if event.kind == "impact"]
    assert len(pushed) == 1
    after = run.time > pushed[0].time
    assert np.max(np.abs(run.q[after, 1])) > 5e-3
    assert abs(run.q[-1, 1]) < 1e-3
    assert np.abs(run.q[:, 2] - 0.279).max() < 0.01
    assert run.summary()["verdict"]["good"]
    assert run.summary()["control_verdict"]["good"]


# A finger as of common grippers: the driver carries a coupler, whose stop a spring holds, and the spring link the pad.
FINGER = """<body name="{0} driver" pos="0 {1} .05" quat="{2}"><joint name="{0} driver" axis="1 0 0" range="0 .9"/>
 <inertial pos="0 .01 0" mass=".01" diaginertia="2e-6 2e-6 2e-6"/>
 <body name="{0} coupler" pos="0 .03 -.004"><joint name="{0} coupler" axis="1 0 0" range="-1.5 0"/>
  <inertial pos="0 .003 .02" mass=".015" diaginertia="4e-6 4e-6 4e-6"/></body></body>
<body name="{0} link" pos="0 {3} .056" quat="{2}">
 <joint name="{0} link" axis="1 0 0" stiffness=".05" springref="2.6"/>
 <inertial pos="0 .02 .02" mass=".02" diaginertia="8e-6 8e-6 8e-6"/>
 <body name="{0} pad" pos="0 .052 .036"><joint name="{0} pad" axis="1 0 0" pos="0 -.017 .006"/>
  <inertial pos="0 -.01 .02" mass=".016" diaginertia="4e-6 4e-6 4e-6"/><site name="{0} tip" pos="0 -.026 .042"/>
 </body></body>"""
GRIPPER = (
    '<mujoco><compiler angle="radian" autolimits="true"/><option gravity="0 1 -9"/><worldbody>'
    + FINGER.format("right", ".03", "1 0 0 0", ".013")
    + FINGER.format("left", "-.03", "0 0 0 1", "-.013")
    + "</worldbody><equality>"
    + "".join(f'<connect body1="{s} pad" body2="{s} coupler" anchor="0 -.001 .002"/>' for s in ("right", "left"))
    + '<joint joint1="right driver" joint2="left driver"/></equality><tendon><fixed name="both">'
    '<joint joint="right driver" coef=".5"/><joint joint="left driver" coef=".5"/></fixed></tendon>'
    '<actuator><motor tendon="both"/></actuator></mujoco>'
)


@pytest.mark.parametrize("sides", [("right", "left"), ("right",)])
def test_a_tendon_presses_each_pad_of_a_gripper_as_virtual_work_says(tmp_path, sides):
    """F L' = Σ N s', less what gravity and springs give, along the one motion that loops, gear and stops leave.

    Motion, springs and gravity are MuJoCo's; F pulls both drivers, though it is asked of one alone.
    """
    (tmp_path / "gripper.xml").write_text(GRIPPER)
    model = mujoco.MjModel.from_xml_string(GRIPPER)
    data, held = mujoco.MjData(model), [1, 5]  # the couplers, at their stops
    data.qpos[[0, 4]] = 0.3
    for _ in range(30):  # Newton's steps on MuJoCo's errors, the drivers and the couplers held
        mujoco.mj_forward(model, data)
        equalities = data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY
        rows = data.efc_J.reshape(-1, model.nv)[equalities]
        bound = np.vstack([rows, np.eye(model.nv)[[0, 4, *held]]])
        data.qpos -= np.linalg.lstsq(bound, np.append(data.efc_pos[equalities], np.zeros(4)))[0]
    assert np.abs(data.efc_pos[equalities]).max() < 1e-12
    _, sizes, motions = np.linalg.svd(np.vstack([rows, np.eye(model.nv)[held]]))
    assert np.count_nonzero(sizes > 1e-9) == model.nv - 1
    v, force, pad = motions[-1] / motions[-1][0], 3.0, np.zeros((3, model.nv))
    speeds = {}
    for side in ("right", "left"):
        mujoco.mj_jacSite(model, data, pad, None, model.site(f"{side} tip").id)
        speeds[side] = (pad @ v)[1]
    power = force * 0.5 * (v[0] + v[4]) - (data.qfrc_bias - data.qfrc_passive) @ v
    text = f'[robot]\nmodel = "gripper.xml"\ntip = "right tip"\nstops = true\n[start]\nq = {data.qpos.tolist()}\n'
    for side in sides:
        normal, place = [0.0, -float(np.sign(speeds[side])), 0.0], data.site(f"{side} tip").xpos.tolist()
        text += f'[[contact]]\nlink = "{side} tip"\nnormal = {normal}\nthrough = {place}\n'
    (tmp_path / "run.toml").write_text(text + "[time]\nduration = 0.005\nstep = 0.001\n")
    asked = np.zeros(8)
    asked[0] = force
    run = cl.simulate(cl.load_scenario(tmp_path / "run.toml"), law=lambda *_: asked)
    assert run.torque[:, [0, 4]] == pytest.approx(np.full((len(run), 2), 0.5 * force))
    assert run.link_forces @ [abs(speeds[side]) for side in sides] == pytest.approx(np.full(len(run), power), rel=1e-8)
    assert run.link_forces == pytest.approx(np.full(run.link_forces.shape, run.link_forces[0, 0]), rel=1e-5)
    assert run.link_forces[0, 0] > 10.0
