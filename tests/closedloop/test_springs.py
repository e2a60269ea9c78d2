"""Springs, dampers, dry friction and ranges of joints and tendons: MuJoCo, closed forms, energy, every engine."""

import mujoco
import numpy as np
import pytest

import closedloop as cl
import robot_models
from closedloop.jit.interpreted import interpreted
from closedloop.jit.kernel import plain
from closedloop.mechanics.robot.pinocchio import Robot
from closedloop.mechanics.robot.tree import energies_of_rows, tree_potential_energy, tree_terms, work_size

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
TIME = '[time]\nduration = 0.3\nstep = 0.001\nintegrator = "rk4"\n'


@pytest.fixture
def write(tmp_path):
    """Return what writes an MJCF and returns its path, or the scenario that is given with it."""

    def write(text, scenario=""):
        path = tmp_path / "arm.xml"
        path.write_text(text)
        if not scenario:
            return str(path)
        (tmp_path / "run.toml").write_text(scenario + TIME)
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
