"""A tip on the only joint axis cannot move along the normal, however the axis is tilted and whatever rounding says."""

import numpy as np
import pytest
from budget import seeds

import closedloop as cl
from closedloop.scenario.load import scenario_of

ONE_JOINT = """<robot name="one"><link name="base"/><link name="arm"><inertial><origin xyz="0 0.1 0"/><mass value="2"/>
<inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link><link name="tip"/>
<joint name="j" type="revolute"><parent link="base"/><child link="arm"/><origin xyz="{origin}" rpy="{turn}"/>
<axis xyz="{axis}"/><limit lower="-3" upper="3" effort="100" velocity="100"/></joint>
<joint name="t" type="fixed"><parent link="arm"/><child link="tip"/><origin xyz="{tip}"/></joint></robot>"""


def arm(folder, rng, off):
    """Return the scenario of an arm of one joint on a random axis, its tip `off` metres beside that axis."""
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    side = np.cross(axis, rng.normal(size=3))
    tip = rng.uniform(-1.0, 1.0) * axis + off * side / np.linalg.norm(side)
    numbers = {"origin": rng.uniform(-1.0, 1.0, 3), "turn": rng.uniform(-3.0, 3.0, 3), "axis": axis, "tip": tip}
    path = folder / "one.urdf"
    path.write_text(ONE_JOINT.format(**{key: " ".join(map(repr, x.tolist())) for key, x in numbers.items()}))
    given = {
        "robot": {"model": str(path), "tip": "tip"},
        "surface": {"normal": rng.normal(size=3).tolist()},
        "start": {"q": [float(rng.uniform(-2.0, 2.0))]},
        "law": {"kp": 10.0, "kd": 1.0},
        "stabiliser": {"kind": "none"},  # over such a lever it turns the rounding of e into newtons
        "time": {"duration": 0.01, "step": 0.001},
    }
    return scenario_of(given, "test", {})


@pytest.mark.parametrize("seed", seeds(3, 10))
@pytest.mark.parametrize("off", [0.0, 1e-9])
def test_a_tip_on_a_tilted_axis_is_singular(seed, off, tmp_path):
    """Six random axes in each of ten draws, the tip on them or a nanometre beside: all stop at once as singular."""
    rng = np.random.default_rng(seed)
    for _ in range(6):
        with pytest.raises(cl.SingularClosureError, match="singular pose") as caught:
            cl.simulate(arm(tmp_path, rng, off))
        assert len(caught.value.run) == 0


@pytest.mark.parametrize("engine", ["pinocchio", "compiled"])
def test_a_millimetre_off_the_axis_it_runs(engine, tmp_path):
    """With a lever of a millimetre the force is determined, and that of a tip at rest is the one commanded."""
    rng = np.random.default_rng(1)
    for _ in range(10):
        run = cl.simulate(arm(tmp_path, rng, 1e-3), engine=engine)
        assert len(run) == 11
        assert run.contact_force[0] == pytest.approx(10.0, rel=1e-6)
        assert np.max(np.abs(run.contact_force)) < 100.0


def test_reach_is_the_length_of_the_arm():
    """The reach of the WAM is that of its links to the tip, and bounds the tip's distance in any posture."""
    robot = cl.prepare(cl.load_scenario("wam_slide")).robot
    rng = np.random.default_rng(0)
    far = max(np.linalg.norm(robot.position(rng.uniform(-2.0, 2.0, 4))) for _ in range(200))
    assert 0.5 * robot.reach < far <= robot.reach
