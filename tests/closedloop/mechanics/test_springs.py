"""Springs, dampers, dry friction and ranges of joints and tendons: MuJoCo, closed forms, energy, every engine."""

import re

import mujoco
import numpy as np
import pytest

import closedloop as cl
import robot_models
from closedloop.jit.interpreted import interpreted
from closedloop.jit.kernel import plain
from closedloop.mechanics.robot.pinocchio import Robot
from closedloop.mechanics.robot.tree import energies_of_rows, tree_potential_energy, tree_terms, work_size
from closedloop.simulation.prepare import prepare
from closedloop.studies.analysis.assembly import instant_of, loop_at
from closedloop.studies.analysis.here import run_on

# Two hinges and a slider with a tip, and a body that moves freely; springs with all coefficients, rest lengths apart.
ARM = """<mujoco><option integrator="RK4" timestep="0.001"><flag contact="disable"/></option><worldbody>
<body name="free" pos="0 0 1"><freejoint name="free"/><geom size=".1"/></body>
<body name="l1"><joint name="a" axis="0 1 0" stiffness="10 3 2" springref="20" ref="10"/>
<geom type="capsule" fromto="0 0 0 .3 0 0" size=".03" mass="1"/>
<body name="l2" pos=".3 0 0"><joint name="b" axis="0 1 .2" stiffness="4"/>
<geom type="capsule" fromto="0 0 0 .3 0 0" size=".03" mass=".5"/>
<body name="l3" pos=".3 0 0"><joint name="c" type="slide" axis="1 0 0"/><geom size=".05" mass=".3"/>
<site name="tip" pos=".1 0 0"/></body></body></body></worldbody>
<tendon><fixed name="t" stiffness="30 1 2" springlength="-.1 .2"><joint joint="a" coef=".5"/><joint joint="c" coef="2"/>
</fixed></tendon></mujoco>"""


@pytest.fixture
def write(tmp_path):
    """Return what writes an MJCF and returns its path, or the scenario that is given with it."""

    def write(text, scenario="", duration=0.3):
        path = tmp_path / "arm.xml"
        path.write_text(text)
        if not scenario:
            return str(path)
        (tmp_path / "run.toml").write_text(
            f'{scenario}[time]\nduration = {duration}\nstep = 0.001\nintegrator = "rk4"\n'
        )
        return cl.load_scenario(tmp_path / "run.toml")

    return write


def states(compiled, count=6):
    """Yield MuJoCo's data at random states."""
    random, data = np.random.default_rng(0), mujoco.MjData(compiled)
    for _ in range(count):
        data.qpos[:], data.qvel[:] = random.normal(size=compiled.nq), random.normal(size=compiled.nv)
        mujoco.mj_normalizeQuat(compiled, data.qpos)
        mujoco.mj_forward(compiled, data)
        yield data


@pytest.mark.parametrize("lock", [{}, {"b": 0.4, "a": -0.3}])
def test_bias_and_energy_are_those_of_mujoco_in_both_engines(write, lock):
    """C has the torques of springs, and the potential energy theirs; a joint that is held still stretches a tendon."""
    path = write(ARM)
    robot = Robot(robot_models.load(path, lock=lock), "tip")
    compiled, energies = mujoco.MjModel.from_xml_path(path), []
    kept = [compiled.joint(name.removesuffix("_x")).id for name in ("a", "b", "c") if name not in lock]
    columns = [*range(6), *(int(compiled.jnt_dofadr[j]) for j in kept)]
    work, n = np.zeros(int(plain(work_size)(robot.n))), robot.n
    for data in states(compiled):
        for name, value in lock.items():
            data.joint(name).qpos, data.joint(name).qvel = value, 0.0
        mujoco.mj_forward(compiled, data)
        q = np.concatenate([data.qpos[:7], [data.qpos[compiled.jnt_qposadr[j]] for j in kept]])
        v, wanted = data.qvel[columns].copy(), (data.qfrc_bias - data.qfrc_spring)[columns]
        assert robot.terms(q, v).bias == pytest.approx(wanted, rel=1e-12, abs=1e-11)
        C, inside = np.zeros(n), robot.rotation_vectors(q)
        interpreted(tree_terms)(
            robot.tree, inside, v, work, np.zeros((n, n)), C, (np.zeros((3, n)), np.zeros(3), np.zeros(3))
        )
        assert pytest.approx(wanted, rel=1e-12, abs=1e-11) == C
        mujoco.mj_energyPos(compiled, data)
        ours = [robot.potential_energy(inside[None])[0], energies_of_rows(robot.tree, inside[None])[0]]
        ours.append(interpreted(tree_potential_energy)(robot.tree, inside, work))
        energies.append([*ours, data.energy[0]])
    energies = np.array(energies)
    assert np.ptp(energies[:, :3] - energies[:, 3:]) <= 1e-11 * np.abs(energies).max()


@pytest.mark.parametrize("engine", ["pinocchio", "compiled"])
def test_the_motion_is_that_of_mujoco_and_keeps_its_energy(write, engine):
    """Both integrate by rk4 with the same step: they differ by rounding."""
    start = [0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.9, -0.7, 0.1]
    scenario = write(ARM, f'[robot]\nmodel = "arm.xml"\ntip = "tip"\n[start]\nq = {start}\n')
    run = cl.simulate(scenario, engine=engine, progress=False)
    compiled = mujoco.MjModel.from_xml_string(ARM)
    data = mujoco.MjData(compiled)
    data.qpos[:] = start
    for _ in range(300):
        mujoco.mj_step(compiled, data)
    assert run.q[-1] == pytest.approx(data.qpos, abs=1e-9)
    total = run.kinetic_energy + run.potential_energy
    assert np.ptp(total) <= 1e-5 * np.ptp(run.potential_energy)  # of rk4, where a spring comes to its rest length
    assert np.ptp(run.potential_energy) > 1.0
    assert run.summary()["verdict"]["good"]


def test_a_mass_on_a_tendon_swings_as_a_closed_form_says(write):
    """x = A cos ωt about m g c/(k c²), with ω² = k c²/m."""
    k, c, m = 80.0, 1.5, 0.4
    mass = f"""<mujoco><worldbody><body name="mass"><joint name="x" type="slide" axis="0 0 1"/>
        <geom size=".05" mass="{m}"/></body></worldbody><tendon><fixed name="t" stiffness="{k}" springlength="0">
        <joint joint="x" coef="{c}"/></fixed></tendon></mujoco>"""
    run = cl.simulate(write(mass, '[robot]\nmodel = "arm.xml"\n[start]\nq = [0.05]\n'), progress=False)
    sag, rate = -9.81 * m / (k * c * c), np.sqrt(k * c * c / m)
    assert run.q[:, 0] == pytest.approx(sag + (0.05 - sag) * np.cos(rate * run.time), abs=1e-7)
    spring = 0.5 * k * (c * run.q[:, 0]) ** 2
    assert run.potential_energy == pytest.approx(m * 9.81 * run.q[:, 0] + spring, abs=1e-12)


def test_what_cannot_act_is_said(write):
    """A spring of a joint that turns freely is named, an inertia of a tendon refused."""
    ball = ARM.replace('<joint name="b" axis="0 1 .2" stiffness="4"/>', '<joint name="b" type="ball" stiffness="4"/>')
    assert any("b" in each and "spring" in each for each in robot_models.load(write(ball)).warnings)
    assert robot_models.load(write(ARM)).warnings == []
    with pytest.raises(robot_models.ModelError, match="armature of tendon 't'"):
        robot_models.load(write(ARM.replace('<fixed name="t"', '<fixed name="t" armature="1"')))


# A slider and a hinge, bound by a tendon that rubs and has a range; no gravity.
PAIR = """<mujoco><option gravity="0 0 0" integrator="RK4" timestep="0.001"/><worldbody>
<body name="x"><joint name="x" type="slide" axis="1 0 0"/><geom size=".05" mass="2"/></body>
<body name="y" pos="0 1 0"><joint name="y" type="slide" axis="0 0 1" damping="{joint}"/>
<geom size=".05" mass="3"/></body>
</worldbody><tendon><fixed name="t" {what}><joint joint="x" coef="2"/><joint joint="y" coef="-.5"/></fixed></tendon>
</mujoco>"""
MOBILITY = 4.0 / 2.0 + 0.25 / 3.0  # c M⁻¹ c


def pair(write, what, start, more="", joint="0"):
    """Return a run of the pair with both flags, from a velocity."""
    robot = f'[robot]\nmodel = "arm.xml"\ntip = "x"\n{more}[start]\nq = [0.0, 0.0]\nv = {start}\n'
    return cl.simulate(write(PAIR.format(what=what, joint=joint), robot), progress=False)


def test_dampers_with_all_coefficients_are_those_of_mujoco(write):
    """Of a joint and of a tendon; what they take is the energy lost to friction."""
    what, joint = 'damping="1 .5 .25"', "2 1 .5"
    run = pair(write, what, [0.7, -0.4], "friction = true\n", joint)
    compiled = mujoco.MjModel.from_xml_string(PAIR.format(what=what, joint=joint))
    data = mujoco.MjData(compiled)
    data.qvel[:] = 0.7, -0.4
    for _ in range(300):
        mujoco.mj_step(compiled, data)
    assert run.v[-1] == pytest.approx(data.qvel, abs=1e-10)
    assert run.energy_supplied[-1] == pytest.approx(run.kinetic_energy[-1] - run.kinetic_energy[0], rel=1e-9)
    assert not np.any(pair(write, what, [0.7, -0.4]).joint_friction)


def test_dry_friction_of_a_tendon_slows_it_and_then_holds_it(write):
    """L̇ falls by f_c c M⁻¹ c a second until the tendon rests; across it nothing acts. Energy is f_c |L|."""
    level, v = 0.9, np.array([0.3, -0.4])
    run = pair(write, f'frictionloss="{level}"', v.tolist(), "friction = true\n")
    rate, across = 2.0 * run.v[:, 0] - 0.5 * run.v[:, 1], 2.0 * run.v[:, 0] * 0.5 + 3.0 * run.v[:, 1] * 2.0
    first, end = 2.0 * v[0] - 0.5 * v[1], (2.0 * v[0] - 0.5 * v[1]) / (level * MOBILITY)
    assert 0.0 < end < 1.0
    wanted = np.maximum(first - level * MOBILITY * run.time, 0.0)
    assert np.abs(rate - wanted).max() <= 1e-3 * level * MOBILITY
    assert across == pytest.approx(np.full(len(across), across[0]), abs=1e-12)
    assert run.summary()["verdict"]["good"]


def test_a_tendon_stops_at_its_range_and_is_held_there(write):
    """It strikes without rebound, M across it is kept, and the stop's torque is along the tendon; with stops alone."""
    what = 'range="-.05 .04" limited="true"'
    run = pair(write, what, [0.3, -0.4], "stops = true\n")
    length = 2.0 * run.q[:, 0] - 0.5 * run.q[:, 1]
    assert length.max() == pytest.approx(0.04, abs=1e-9)
    assert length[-1] == pytest.approx(0.04, abs=1e-9)
    assert 2.0 * run.v[-1, 0] - 0.5 * run.v[-1, 1] == pytest.approx(0.0, abs=1e-9)
    impulse = -(2.0 * 0.3 + 0.5 * 0.4) / MOBILITY
    assert run.v[-1] == pytest.approx([0.3 + 2.0 * impulse / 2.0, -0.4 - 0.5 * impulse / 3.0], abs=1e-9)
    again = pair(write, what, [0.3, -0.4])
    assert np.max(2.0 * again.q[:, 0] - 0.5 * again.q[:, 1]) > 0.2


def test_a_weight_hangs_on_the_range_of_a_tendon(write):
    """Its force is the weight over the coefficient, in the joint's row of stop_torque, in both engines."""
    hanging = PAIR.format(what='range="-1 .2" limited="true"', joint="0").replace("0 0 0", "0 0 -9.81", 1)
    robot = '[robot]\nmodel = "arm.xml"\ntip = "x"\nstops = true\n[start]\nq = [0.0, -0.4]\n'
    for engine in ("pinocchio", "compiled"):
        run = cl.simulate(write(hanging, robot), engine=engine, progress=False)
        push = run.stop_torque[1:]  # λ c with λ = m g / (c M⁻¹ c) of what the tendon alone accelerates
        force = -0.5 * 9.81 / MOBILITY
        assert push == pytest.approx(np.tile([2.0 * force, -0.5 * force], (len(push), 1)), rel=1e-8)
        assert run.acceleration[1:, 1] == pytest.approx(-9.81 - 0.5 * force / 3.0, rel=1e-9)


# Two fingers, each a parallelogram closed by a `connect`, driven by one fixed tendon: the mechanism of a Robotiq 2F-85.
FINGER = """<body name="{0}_driver" pos="{1}.03 0 0"><joint name="{0}_driver" axis="0 {2}1 0" range="0 80"/>
<geom type="capsule" fromto="0 0 0 0 0 .1" size=".005" mass=".02"/><body name="{0}_pad" pos="0 0 .1">
<joint name="{0}_pad" axis="0 {2}1 0"/><geom type="box" size=".005 .01 .02" pos="{3}.005 0 .02" mass=".03"/></body>
</body><body name="{0}_link" pos="{1}.05 0 0"><joint name="{0}_link" axis="0 {2}1 0" stiffness=".4" springref="60"/>
<geom type="capsule" fromto="0 0 0 0 0 .1" size=".005" mass=".02"/></body>"""
GRIPPER = (
    '<mujoco><compiler angle="degree"/><option gravity="0 0 0"/><worldbody>'
    + FINGER.format("right", "", "-", "-") + FINGER.format("left", "-", "", "")
    + '</worldbody><equality><connect body1="right_pad" body2="right_link" anchor=".02 0 0"/>'
    '<connect body1="left_pad" body2="left_link" anchor="-.02 0 0"/>'
    '<joint joint1="right_driver" joint2="left_driver"/></equality><tendon><fixed name="split">'
    '<joint joint="right_driver" coef=".5"/><joint joint="left_driver" coef=".5"/></fixed></tendon>'
    '<actuator><motor tendon="split" ctrlrange="-5 5"/></actuator></mujoco>'
)  # fmt: skip


@pytest.mark.parametrize("angle", [0.1, 0.4])
def test_a_gripper_presses_by_virtual_work(write, angle):
    """Each pad moves by r cos θ along its normal: f r cos θ is half the tendon's force less the spring's torque.

    So it is, too, of a torque that is asked of one of the drivers: the tendon's force with the same power acts.
    """
    pull, radius, x = 2.0, 0.1, 0.03 - 0.1 * np.sin(angle) - 0.01
    contacts = "".join(
        f'[[contact]]\nname = "{side}"\nlink = "{side}_pad"\nat = [[{-sign * 0.01}, 0, 0], [{-sign * 0.01}, 0, 0.04]]\n'
        f"normal = [{sign}, 0, 0]\nthrough = [{sign * float(x)!r}, 0, 0]\n"
        for side, sign in (("right", 1), ("left", -1))
    )
    finger = f"{angle}, {-angle}, {angle}"
    robot = f'[robot]\nmodel = "arm.xml"\ntip = "left_pad"\nstops = true\n{contacts}[start]\nq = [{finger}, {finger}]\n'
    torque = np.array([pull / 2, 0.0, 0.0, pull / 2, 0.0, 0.0])
    scenario = write(GRIPPER, robot, 0.02)
    run, one = (cl.simulate(scenario, law=lambda x, Q=Q: Q, progress=False) for Q in (torque, pull * np.eye(6)[0]))
    np.testing.assert_allclose(one.torque, np.tile(torque, (len(one.time), 1)), atol=1e-12)
    spring = 0.4 * (angle - np.radians(60.0))
    force = run.link_forces.reshape(len(run.time), 2, 2).sum(axis=2)
    assert force == pytest.approx(np.full(force.shape, (pull / 2 - spring) / (radius * np.cos(angle))), rel=1e-8)
    assert run.summary()["verdict"]["good"]


PRESSING = """[robot]
model = "arm.xml"
tip = "tip"
[start]
q = [0.1, 0.5, 0.7]
[surface]
kind = "plane"
[reference]
kind = "hold"
[law]
kind = "paper"
kp = [2.0, 2.0, 1.0]
kd = [0.2, 0.2, 0.1]
force_integral = 10.0
force_feedback = 0.2
"""
SOFT = {
    "law.sample_period": 0.004, "compliance": {"kind": "kelvin_voigt", "stiffness": 5e3, "damping": 50.0},
    "sensor.delay": 0.004, "encoder.velocity": "difference", "encoder.filter_time_constant": 0.003,
    "time.duration": 0.7, "time.integrator": "semi_implicit_euler",
}  # fmt: skip
THREE = """<mujoco><worldbody><body name="l1"><joint name="a" axis="0 0 1" stiffness="80 3 2" springref="20"/>
<geom type="capsule" fromto="0 0 0 .3 0 0" size=".03" mass="1"/><body name="l2" pos=".3 0 0">
<joint name="b" axis="0 1 0" stiffness="40"/><geom type="capsule" fromto="0 0 0 .3 0 0" size=".03" mass=".5"/>
<body name="l3" pos=".3 0 0"><joint name="c" axis="0 1 0"/>
<geom type="capsule" fromto="0 0 0 .3 0 0" size=".03" mass="0.3"/><site name="tip" pos=".3 0 0"/></body></body></body>
</worldbody><tendon><fixed name="t" stiffness="30 1 2" springlength="-.1 .2"><joint joint="b" coef="1"/>
<joint joint="c" coef="2"/></fixed></tendon></mujoco>"""


def test_the_linear_loop_of_an_arm_with_springs_is_that_of_its_run(write):
    """By small steps of the run: encoders lag, so that compensation does not cancel the springs."""
    steps = []
    rigid = re.sub(r' (stiffness|springref)="[^"]*"', "", THREE[: THREE.index("<tendon>")]) + "</mujoco>"
    for text in (THREE, rigid):
        problem = prepare(write(text, PRESSING).replace(SOFT))
        instant = instant_of(problem, 0.25)
        loop = loop_at(problem, instant)
        apart = (run_on(problem, instant, 400, 1e-4) - run_on(problem, instant, 400, -1e-4)) / 2e-4
        found = np.cumsum(apart[:: problem.hold])
        np.testing.assert_allclose(
            found, loop.response("force command", duration=(found.size - 1) * loop.dt)[1], rtol=0, atol=1e-6
        )
        steps.append(found)
    assert np.max(np.abs(steps[0] - steps[1])) > 1e-2


def test_derivatives_of_a_run_with_springs_are_those_of_differences(write):
    """By the start, of an arm that swings by itself."""
    scenario = write(THREE, '[robot]\nmodel = "arm.xml"\ntip = "tip"\n[start]\nq = [0.1, 0.5, 0.7]\n')
    found = cl.gradient(scenario, ["start.q"], of=["q@end"])
    assert found.method["q@end"]["start.q"].startswith("dual numbers")
    h, columns = 1e-5, []
    for j in range(3):
        ends = []
        for side in (h, -h):
            q = np.array(scenario.start.q) + side * np.eye(3)[j]
            ends.append(cl.simulate(scenario.replace({"start.q": q.tolist()}), progress=False).q[-1])
        columns.append((ends[0] - ends[1]) / (2.0 * h))
    np.testing.assert_allclose(found.derivative["q@end"]["start.q"], np.transpose(columns), rtol=1e-6, atol=1e-8)
