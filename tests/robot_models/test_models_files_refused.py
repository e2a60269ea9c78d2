"""Files, sidecars, names, locks and frames that cannot be used are refused in one line."""

import os

import numpy as np
import pytest
from model_texts import arm, mjcf

import robot_models
from robot_models import ModelError


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda p: None, "no such file"),
        (lambda p: p.mkdir(), "folder"),
        (lambda p: p.write_bytes(b""), "empty"),
        (lambda p: p.write_bytes('<robot name="é"/>'.encode("latin-1")), "not UTF-8"),
        (lambda p: p.write_bytes(b" " * 16_000_001), "larger than 16 MB"),
    ],
)
def test_unreadable_files(tmp_path, make, says):
    """A file that is no text is refused for what it is."""
    path = tmp_path / "robot.urdf"
    make(path)
    with pytest.raises(ModelError, match=says):
        robot_models.load(path)


def test_pipes_and_devices_are_no_files(tmp_path):
    """Refused before they are opened: a pipe that nobody writes to never answers, and /dev/zero never ends."""
    os.mkfifo(tmp_path / "robot.urdf")
    (tmp_path / "zero.urdf").symlink_to("/dev/zero")
    (tmp_path / "folder.xml").mkdir()
    for name, says in (("robot.urdf", "pipe"), ("zero.urdf", "device"), ("folder.xml", "folder")):
        with pytest.raises(ModelError, match=says):
            robot_models.load(tmp_path / name)
    (tmp_path / "arm.urdf").write_text(arm())
    os.mkfifo(tmp_path / "arm.toml")
    with pytest.raises(ModelError, match=r"arm\.toml is a pipe"):
        robot_models.load(tmp_path / "arm.urdf")
    (tmp_path / "arm.xml").write_text(mjcf(head='<include file="robot.urdf"/>'))
    with pytest.raises(ModelError, match=r"included robot\.urdf: .*pipe"):
        robot_models.load(tmp_path / "arm.xml")


def test_includes_are_bounded(tmp_path):
    """Three hundred files, each including the next, are no robot."""
    for k in range(300):
        (tmp_path / f"{k}.xml").write_text(f'<mujocoinclude><include file="{k + 1}.xml"/></mujocoinclude>')
    (tmp_path / "robot.xml").write_text(mjcf(head='<include file="0.xml"/>'))
    with pytest.raises(ModelError, match="100 files"):
        robot_models.load(tmp_path / "robot.xml")


@pytest.mark.parametrize(
    ("toml", "says"),
    [
        (f"[home]\nelbow = {10**400}", ["elbow", "finite number"]),
        (f"[home]\nelbow = 1{'0' * 5000}", ["not valid TOML"]),
        (f"tip = {'[' * 5000}", ["not valid TOML"]),
        ("colour = 1", ["unknown key 'colour'", "drive_inertia"]),
        ("tip = 3", ["tip is 3"]),
        ("drive_inertia = 3", ["table"]),
        ("[drive_inertia]\nelbo = 1.0", ["'elbo'", "did you mean 'elbow'?"]),
        ("[drive_inertia]\nelbow = -1.0", ["elbow", "-1.0", "zero or more"]),
        ("[drive_inertia]\nelbow = nan", ["elbow", "nan"]),
        ("[drive_inertia]\nelbow = true", ["elbow", "True"]),
        ("[home]\nelbow = inf", ["elbow", "inf"]),
        ("[lock]\nend = 0.0", ["'end'", "no moving joint"]),
        ("tip = 'hand'", ["'hand'", "did you mean"]),
        ("tip = ", ["not valid TOML"]),
        ("[home]\nelbow = 1" + "0" * 400, ["elbow", "at most 1e+06 rad (m)"]),
        ("[home]\nelbow = 0x" + "f" * 10_000, ["elbow is a number of thousands of digits", "at most 1e+06 rad (m)"]),
        ("[home]\nelbow = 1" + "0" * 5000, ["not valid TOML"]),
        ("[lock]\nelbow = 1e300", ["elbow", "1e+300", "at most 1e+06 rad (m)"]),
        ("[drive_inertia]\nelbow = 9223372036854775808000000000", ["elbow", "zero or more, at most 1e+09 kg m²"]),
        ("tip = " + "[" * 100_000, ["not valid TOML: nested too deeply"]),
        ("tip" + ".a" * 50_000 + " = 1", ["not valid TOML: a key has more than 20 parts"]),
        ("tip = [" + "1, " * 10_000 + "]", ["tip is [1, 1, 1, 1, 1, 1, ...]"]),
    ],
)
def test_sidecar_is_read_strictly(tmp_path, toml, says):
    """A sidecar says what the robot's joints bear, or is refused."""
    (tmp_path / "robot.urdf").write_text(arm())
    (tmp_path / "robot.toml").write_text(toml)
    with pytest.raises(ModelError) as caught:
        robot_models.load(tmp_path / "robot.urdf")
    for words in says:
        assert words in str(caught.value)


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("wam", "wam4"),
        ("pandas", "'panda'"),
        ("zzzzzzzz", "wam4, panda"),
        ("Panda", "'panda'"),
        ("", "no robot"),
    ],
)
def test_unknown_names_come_with_a_suggestion(name, says):
    """A slip of the pen costs one look."""
    with pytest.raises(ModelError, match=says):
        robot_models.load(name)


def test_locks_are_checked(tmp_path):
    """A lock names a joint and a finite value."""
    (tmp_path / "robot.urdf").write_text(arm())
    for lock, says in (
        (["elbo"], "did you mean 'elbow'"),
        ({"elbow": np.nan}, "finite"),
        ({"elbow": "open"}, "'open'"),
        ("elbow", "must be a list"),
        (["elbow", "shoulder"], "no joint that moves"),
    ):
        with pytest.raises(ModelError, match=says):
            robot_models.load(tmp_path / "robot.urdf", lock=lock)


def test_frames_are_checked():
    """A tip that is not there is refused with the nearest that is."""
    robot = robot_models.load("wam4")
    assert robot.require_frame("tip") == "tip"
    with pytest.raises(ModelError, match="did you mean 'tip'"):
        robot.require_frame("tipp")
    with pytest.raises(ModelError, match="wam4 has no frame"):
        robot.require_frame("J1")


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"armature": [1.0]}, "4 finite"),
        ({"armature": [1.0, 1, 1, -1]}, "negative"),
        ({"home": [np.nan] * 4}, "finite"),
        ({"home": "abcd"}, "4 numbers"),
        ({"tip": "nose"}, "no frame 'nose'"),
        ({"format": "sdf"}, "'sdf'"),
        ({"gravity": [0, 0]}, "3 finite"),
        ({"locked": {"J9": 0.0}}, "'J9'"),
        ({"locked": {"J4": "x"}}, "'x'"),
        ({"text": "\ud800"}, "UTF-8"),
        ({"text": "\0"}, "well-formed"),
    ],
)
def test_stored_fields_are_checked(change, says):
    """What a run file says is a stranger's word."""
    robot = robot_models.load("wam4")
    stored = {
        "text": robot.text,
        "format": "urdf",
        "name": "wam4",
        "armature": robot.armature,
        "tip": "tip",
        "home": robot.home,
        "locked": {},
        **change,
    }
    with pytest.raises(ModelError, match=says):
        robot_models.from_text(**stored)
