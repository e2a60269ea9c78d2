"""Numbers whose products overflow are refused where a robot is read: with the owner, the bound, its unit and why."""

import json
import re

import numpy as np
import pytest
from model_texts import mjcf

import robot_models
from robot_models import described

URDF = described.path_of("planar2").read_text()


@pytest.mark.parametrize("value", ["1e308", "1e200", "1e100", "2e9"])
def test_a_huge_mass_of_a_urdf_is_refused(tmp_path, value):
    """A mass of 1e308 kg had an infinite energy."""
    path = tmp_path / "robot.urdf"
    path.write_text(re.sub(r'mass value="[^"]*"', f'mass value="{value}"', URDF))
    with pytest.raises(robot_models.ModelError, match=r"mass has .*: at most 1e.09 kg: no arm moves") as caught:
        robot_models.load(path)
    assert "\n" not in str(caught.value)


CASES = {
    "mass": (mjcf(inertial='<inertial pos="0 0 0" mass="1e100" diaginertia="1 1 1"/>'), "mass has 1e.100: at most"),
    "place of a body": (mjcf(base='<body name="base" pos="1e100 0 0">'), "origin has 1e.100: at most 1e.06 m"),
    "centre of mass": (mjcf(inertial='<inertial pos="1e7 0 0" mass="1" diaginertia="1 1 1"/>'), "centre of mass has"),
    "tensor": (mjcf(inertial='<inertial pos="0 0 0" mass="1" diaginertia="1e99 1e99 1e99"/>'), "inertia tensor has"),
    "armature": (mjcf(joint='<joint name="shoulder" armature="1e100"/>'), "armature has 1e.100: at most 1e.09"),
    "gravity": (mjcf(head='<option gravity="0 0 -1e100"/>'), "gravity has -1e.100: at most 10000 m/s²: no body pulls"),
    "home": (
        mjcf(joint='<joint name="shoulder"/>', tail='<keyframe><key qpos="1e100 1e100"/></keyframe>'), "home has 1e.100"
    ),
    "coefficients of a gear": (
        mjcf(tail='<equality><joint joint1="shoulder" polycoef="1e100 0 0 0 0"/></equality>'),
        "joint 1. has the number 1e.100: .* at most"
    ),
}  # fmt: skip


@pytest.mark.parametrize(("text", "line"), CASES.values(), ids=CASES)
def test_a_huge_number_of_an_mjcf_is_refused(tmp_path, text, line):
    """Each with its own line."""
    path = tmp_path / "robot.xml"
    path.write_text(text)
    with pytest.raises(robot_models.ModelError, match=line):
        robot_models.load(path)


def test_the_bounds_themselves_are_accepted(tmp_path):
    """The energy of the heaviest robot is a number."""
    path = tmp_path / "robot.xml"
    path.write_text(mjcf(inertial='<inertial pos="1e6 0 0" mass="1e9" diaginertia="1e9 1e9 1e9"/>'))
    model = robot_models.load(path).pinocchio_model()
    assert np.isfinite(0.5 * (model.inertias[1].mass * 1e6**2) * 1e4**2)


@pytest.mark.parametrize(("key", "value"), [("armature", 1e100), ("home", 1e100), ("gravity", -1e100)])
def test_a_huge_number_of_a_run_file_is_refused(key, value):
    """What a file of a run says of its robot is a stranger's."""
    robot = robot_models.load("planar2")
    said = {name: getattr(robot, name).tolist() for name in ("armature", "home", "gravity")}
    said[key] = [value] * len(said[key])
    with pytest.raises(robot_models.ModelError, match=f"its {key} has"):
        robot_models.from_text(robot.text, "urdf", name="p", tip=robot.tip, locked={}, **json.loads(json.dumps(said)))


def test_more_rows_of_loops_than_there_is_room_for_are_refused():
    """24 hinges take 120 rows; one more is refused in one line that says how many there are and may be."""
    own = robot_models.load("four_bar")

    def with_pins(count):
        pins = [own.loops[0].as_table() | {"name": f"pin {k}"} for k in range(count)]
        return robot_models.from_text(
            own.text, "urdf", name="four_bar", armature=own.armature, tip=own.tip, home=own.home, locked={}, loops=pins
        )

    assert sum(loop.rows for loop in with_pins(24).loops) == 120
    with pytest.raises(robot_models.ModelError, match=r"^four_bar: the 25 loops take 125 rows, and 120 is the most"):
        with_pins(25)
