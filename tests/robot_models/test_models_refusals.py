"""What cannot be simulated is refused by name, in one line, with the cure; it is never built otherwise."""

import pytest
from model_texts import ARM, INERTIAL, LIMIT, MJCF_INERTIAL, arm, joint, link, mjcf, urdf

import robot_models
from robot_models import ModelError


def weighing(mass="2", tensor='ixx="0.1" iyy="0.12" izz="0.05" ixy="0" ixz="0" iyz="0"'):
    """Return an `<inertial>` with this mass and tensor."""
    return f'<inertial><mass value="{mass}"/><inertia {tensor}/></inertial>'


def tensor(ixx, iyy, izz, ixy=0, ixz=0, iyz=0):
    """Return an `<inertial>` of 2 kg with this tensor."""
    return weighing(tensor=f'ixx="{ixx}" iyy="{iyy}" izz="{izz}" ixy="{ixy}" ixz="{ixz}" iyz="{iyz}"')


def elbow(**options):
    """Return the sample arm with another elbow."""
    return arm(elbow=joint("elbow", "upper", "fore", **options))


URDF = {
    "negative mass": (arm(fore=link("fore", weighing("-1"))), ["'fore'", "-1 kg", "positive"]),
    "negative mass on the base": (arm(base=link("base", weighing("-1"))), ["'base'", "-1 kg"]),
    "zero mass on a link that moves": (arm(fore=link("fore", weighing("0"))), ["'fore'", "0 kg", "positive"]),
    "nothing moves with the last joint": (arm(fore=link("fore", "")), ["'elbow'", "moves no mass"]),
    "a free body without inertia": (
        arm(
            fore=link("fore", ""),
            elbow='<joint name="free" type="floating"><parent link="upper"/><child link="fore"/></joint>',
        ),
        ["free joint 'free' moves no mass", "give its links an <inertial>"],
    ),
    "point mass on the axis": (
        arm(fore=link("fore", tensor(0, 0, 0))),
        ["'elbow'", "no inertia along its own axis"],
    ),
    "inertia without mass at the tip": (
        arm(tip=link("tip", weighing("0"))),
        ["'tip'", "rotational inertia", "0 kg"],
    ),
    "mass is nan": (arm(fore=link("fore", weighing("nan"))), ["'fore'", "mass", "'nan'", "finite"]),
    "mass with a comma": (arm(fore=link("fore", weighing("1,5"))), ["'fore'", "mass", "'1,5'"]),
    "mass with an underscore": (arm(fore=link("fore", weighing("1_0"))), ["'fore'", "'1_0'"]),
    "mass overflows": (arm(fore=link("fore", weighing("1e999"))), ["'fore'", "finite"]),
    "centre of mass is infinite": (
        arm(fore=link("fore", INERTIAL.replace("0.3", "inf"))),
        ["'fore'", "origin xyz", "'inf'"],
    ),
    "origin of two numbers": (elbow(origin="0 1"), ["'elbow'", "origin xyz", "3 numbers"]),
    "no tensor": (
        arm(fore=link("fore", '<inertial><mass value="1"/></inertial>')),
        ["'fore'", "inertia ixx"],
    ),
    "tensor lacks an entry": (arm(fore=link("fore", INERTIAL.replace('iyz="0.003"', ""))), ["'fore'", "iyz"]),
    "two inertials": (arm(fore=link("fore", INERTIAL * 2)), ["'fore'", "2 <inertial>"]),
    "indefinite tensor": (arm(fore=link("fore", tensor(1, 1, 1, 2))), ["'fore'", "not positive definite"]),
    "negative tensor": (arm(fore=link("fore", tensor(-1, -1, -1))), ["'fore'", "not positive definite"]),
    "triangle inequality": (
        arm(fore=link("fore", tensor(1, 1, 3))),
        ["'fore'", "triangle inequality", "3 kg m²"],
    ),
    "zero axis": (elbow(axis="0 0 0"), ["'elbow'", "axis", "direction"]),
    "axis of no length": (elbow(axis="0 0 1e200"), ["'elbow'", "axis"]),
    "two masses": (arm(fore=link("fore", INERTIAL.replace("<mass", '<mass value="3"/><mass'))), ["'fore'", "2 <mass>"]),
    "two origins": (elbow(extra='<origin xyz="1 0 0"/>'), ["'elbow'", "2 <origin>"]),
    "a turn by quaternion": (
        elbow().replace("<origin", '<origin quat_xyzw="0 0 0 1"'),
        ["'upper'", "quat_xyzw", "rpy"],
    ),
    "an angle beyond reason": (elbow().replace("<origin", '<origin rpy="0 0 1e9"'), ["origin rpy", "must be at most"]),
    "another version": (arm().replace("<robot", '<robot version="2.0"'), ["version '2.0'"]),
    "a namespace": (arm().replace("<mass", '<mass xmlns="u"'), ["<mass>", "namespace"]),
    "mass too small for a double": (arm(fore=link("fore", weighing("1e-400"))), ["'fore'", "too small"]),
    "empty geometry": (arm(tip=link("tip", "<visual><geometry/></visual>")), ["yourdfpy cannot read"]),
    "axis without xyz": (arm().replace('<axis xyz="0 0 1"/>', "<axis/>"), ["'elbow'", "axis xyz"]),
    "damping is nan": (elbow(extra='<dynamics damping="nan"/>'), ["'elbow'", "dynamics damping", "'nan'"]),
    "robot without a name": (arm().replace(' name="sample"', ""), ["<robot> has no name"]),
    "another encoding": ('<?xml version="1.0" encoding="ISO-8859-1"?>' + arm(), ["'ISO-8859-1'", "UTF-8"]),
    "axis is nan": (elbow(axis="0 nan 0"), ["'elbow'", "axis", "'nan'"]),
    "limits reversed": (
        elbow(limit=LIMIT.replace('lower="-1"', 'lower="2"')),
        ["'elbow'", "lower limit 2", "upper limit 1"],
    ),
    "no limit": (elbow(limit=""), ["'elbow'", "no <limit>"]),
    "no lower limit": (elbow(limit=LIMIT.replace('lower="-1"', "")), ["'elbow'", "'lower'", "continuous"]),
    "no effort": (elbow(limit=LIMIT.replace('effort="5"', "")), ["'elbow'", "'effort'"]),
    "negative velocity limit": (
        elbow(limit=LIMIT.replace('velocity="2"', 'velocity="-2"')),
        ["'elbow'", "velocity", "-2"],
    ),
    "floating joint that mimics": (
        elbow(kind="floating", extra='<mimic joint="shoulder"/>'),
        ["'elbow'", "floating", "mimics", "drop"],
    ),
    "planar joint": (elbow(kind="planar"), ["'elbow'", "'planar'", "not simulated"]),
    "unknown joint": (elbow(kind="hinge"), ["'elbow'", "'hinge'", "not simulated"]),
    "mimic": (elbow(extra='<mimic joint="shoulder"/>'), ["'elbow'", "mimics 'shoulder'", "lock=['elbow']"]),
    "missing child": (arm(without="fore"), ["'elbow'", "child link 'fore'"]),
    "missing parent": (elbow().replace('parent link="upper"', 'parent link="uper"'), ["'elbow'", "'uper'"]),
    "no parent element": (elbow().replace('<parent link="upper"/>', ""), ["'elbow'", "parent link None"]),
    "two links of a name": (arm(plus=link("fore")), ["'fore'", "differ"]),
    "two joints of a name": (arm(plus=joint("elbow", "upper", "tip")), ["'elbow'", "differ"]),
    "link without a name": (arm(plus="<link/>"), ["<link> has no name"]),
    "two roots": (arm(plus=link("stray")), ["2 links have no parent", "base, stray"]),
    "two parents": (arm(plus=joint("again", "base", "fore")), ["'again'", "'fore'", "already has a parent"]),
    "cycle": (
        arm(plus=link("a") + link("b") + joint("ab", "a", "b") + joint("ba", "b", "a")),
        ["its own ancestor", "tree"],
    ),
    "nothing moves": (urdf(link("base")), ["no joint that moves"]),
    "no links": (urdf(), ["no links"]),
    "xacro": (
        '<robot name="a" xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:include filename="b"/></robot>',
        ["xacro", "expand"],
    ),
    "doctype": ('<!DOCTYPE robot [<!ENTITY a "b">]>' + arm(), ["DOCTYPE"]),
    "external entity": (
        '<!DOCTYPE robot [<!ENTITY x SYSTEM "file:///etc/hostname">]><robot name="&x;"/>',
        ["DOCTYPE"],
    ),
    "malformed": ('<robot name="a">\n  <link name="b">\n</robot>', ["mismatched tag", "line 3", "column 3"]),
    "deeply nested": ("<robot>" + "<a>" * 500 + "</a>" * 500 + "</robot>", ["nested deeper"]),
    "empty": ("  \n", ["empty"]),
    "another root": ("<sdf/>", ["<sdf>", "<robot>"]),
    "broken visual": (
        arm(tip=link("tip", "<visual><geometry><sphere radius='big'/></geometry></visual>")),
        ["yourdfpy cannot read", "big"],
    ),
}
MESH = '<asset><mesh name="a" vertex="0 0 0 1 0 0 0 1 0 0 0 1"/></asset>'
HINGE = '<joint name="shoulder" axis="0 1 0"/>'
MJCF = {
    "free body without inertia": (
        mjcf(base='<body name="base"><freejoint/>'),
        ["'base'", "moves and has no mass or no inertia", "<inertial>"],
    ),
    "ball joint with a range": (
        mjcf(joint='<joint name="shoulder" type="ball" range="0 60"/>'),
        ["'shoulder'", "range", "ball joint", "drop it"],
    ),
    "free joint on a body that another carries": (
        mjcf(joint='<joint name="shoulder" type="free"/>'),
        ["'shoulder'", "free joint", "body of the world"],
    ),
    "free joint that is turned to the principal axes": (
        mjcf(base='<body name="base"><freejoint align="true"/>'),
        ["'base'", "align", "principal axes"],
    ),
    "two joints on a body": (mjcf(joint=HINGE + '<joint name="b"/>'), ["'upper'", "2 joints"]),
    "spring": (mjcf(joint='<joint name="shoulder" stiffness="3"/>'), ["'shoulder'", "stiffness", "'3'"]),
    "spring by class": (
        mjcf(head='<default><joint stiffness="3"/></default>'),
        ["'shoulder'", "stiffness"],
    ),
    "ref": (mjcf(joint='<joint name="shoulder" ref="30"/>'), ["'shoulder'", "ref"]),
    "limited off": (
        mjcf(joint='<joint name="shoulder" limited="false"/>'),
        ["'shoulder'", "limited", "range"],
    ),
    "gravity compensation": (mjcf(base='<body name="base" gravcomp="1">'), ["'base'", "gravcomp"]),
    "frame": (mjcf(inner='<frame pos="0 0 1"/>'), ["'upper'", "<frame>"]),
    "equality": (mjcf(tail='<equality><flex flex="skin"/></equality>'), ["<equality>", "<flex>", "not simulated"]),
    "tendon": (mjcf(tail="<tendon/>"), ["<tendon>"]),
    "no gravity by flag": (mjcf(head='<option><flag gravity="disable"/></option>'), ["gravity", "0 0 0"]),
    "medium": (mjcf(head='<option density="1000"/>'), ["density", "medium"]),
    "inertia from geoms": (
        mjcf(head='<compiler inertiafromgeom="true"/>'),
        ["inertiafromgeom", "<inertial>"],
    ),
    "old limits": (mjcf(head='<compiler autolimits="false"/>'), ["autolimits"]),
    "negative mass": (mjcf(inertial=MJCF_INERTIAL.replace('"2"', '"-2"')), ["'upper'", "-2 kg"]),
    "nan": (mjcf(inertial=MJCF_INERTIAL.replace('"2"', '"nan"')), ["inertial", "mass", "'nan'"]),
    "triangle": (
        mjcf(inertial='<inertial pos="0 0 0" mass="1" diaginertia="1 1 3"/>'),
        ["'upper'", "triangle"],
    ),
    "indefinite": (
        mjcf(inertial='<inertial pos="0 0 0" mass="1" fullinertia="1 1 1 2 0 0"/>'),
        ["'upper'", "not positive definite"],
    ),
    "no inertia in the inertial": (
        mjcf(inertial='<inertial pos="0 0 0" mass="1"/>'),
        ["'upper'", "diaginertia"],
    ),
    "mesh weighs": (
        mjcf(head=MESH, inertial='<geom type="mesh" mesh="a"/>'),
        ["'upper'", "mesh", "<inertial>"],
    ),
    "mesh that is not there": (mjcf(inner='<geom type="mesh" mesh="a"/>'), ["<geom>", "mesh 'a'", "not in the model"]),
    "visual geom weighs": (
        mjcf(inertial='<geom size="0.1" contype="0" conaffinity="0"/>'),
        ["'upper'", "without contact"],
    ),
    "zero axis": (mjcf(joint='<joint name="shoulder" axis="0 0 0"/>'), ["'shoulder'", "axis"]),
    "pose of two numbers": (mjcf(base='<body name="base" pos="1 2">'), ["'base'", "pos", "3 numbers"]),
    "turned twice": (
        mjcf(base='<body name="base" quat="1 0 0 0" euler="0 0 1">'),
        ["'base'", "quat and euler"],
    ),
    "fixed-axis euler": (mjcf(head='<compiler eulerseq="XYZ"/>'), ["eulerseq", "'XYZ'", "capitals"]),
    "angle in gradians": (mjcf(head='<compiler angle="grad"/>'), ["angle", "'grad'"]),
    "site by its ends": (mjcf(inner='<site name="s" fromto="0 0 0 0 0 1"/>'), ["'s'", "fromto"]),
    "pose is nan": (mjcf(base='<body name="base" quat="1 0 nan 0">'), ["'base'", "quat", "'nan'"]),
    "far too large": (
        mjcf(inertial=MJCF_INERTIAL.replace("0.1 0.02", "1e200 0")),
        ["'upper'", "centre of mass has 1e+200", "at most 1e+06 m"],
    ),
    "limits reversed": (mjcf(joint='<joint name="shoulder" range="1 -1"/>'), ["'shoulder'", "lower limit 1"]),
    "negative armature": (mjcf(joint='<joint name="shoulder" armature="-1"/>'), ["'shoulder'", "armature"]),
    "joint without a name": (mjcf(joint="<joint/>"), ["'upper'", "joint has no name"]),
    "quaternion of length zero": (mjcf(base='<body name="base" quat="0 0 0 0">'), ["'base'", "quat", "a length"]),
    "axis of a turn of length zero": (mjcf(base='<body name="base" axisangle="0 0 0 1">'), ["'base'", "axisangle"]),
    "parallel axes": (mjcf(base='<body name="base" xyaxes="1 0 0 2 0 0">'), ["'base'", "xyaxes"]),
    "zaxis of length zero": (mjcf(base='<body name="base" zaxis="0 0 0">'), ["'base'", "zaxis"]),
    "misspelt attribute": (mjcf(joint='<joint name="shoulder" rnage="0 1"/>'), ["'shoulder'", "'rnage'", "'range'"]),
    "misspelt section": (mjcf(tail="<keyframes/>"), ["<keyframes>", "'keyframe'"]),
    "unknown word": (mjcf(inner='<geom type="ball" size="1"/>'), ["type", "'ball'", "sphere"]),
    "no whole number": (mjcf(inner='<geom contype="0.5" size="1"/>'), ["contype", "whole number"]),
    "a size of zero": (mjcf(inner='<geom size="0"/>'), ["size", "positive"]),
    "two numbers of a size": (mjcf(inner='<geom type="box" size="1 1"/>'), ["size", "3 positive"]),
    "a weightless body that moves": (
        mjcf(inertial='<inertial pos="0 0 0" mass="0" diaginertia="0 0 0"/>'),
        ["'upper'", "moves", "<inertial>"],
    ),
    "inertia said twice": (
        mjcf(inertial='<inertial pos="0 0 0" mass="1" diaginertia="1 1 1" fullinertia="1 1 1 0 0 0"/>'),
        ["'upper'", "fullinertia", "one of them"],
    ),
    "sites of one name": (mjcf(inner='<site name="touch"/>'), ["'touch'", "differ"]),
    "motor of no joint": (mjcf(tail='<actuator><motor joint="knee"/></actuator>'), ["<motor>", "'knee'"]),
    "motor of nothing": (mjcf(tail='<actuator><motor name="m"/></actuator>'), ["'m'", "drives nothing"]),
    "world with a pose": (mjcf().replace("<worldbody", '<worldbody pos="1 0 0"'), ["<worldbody>", "no attributes"]),
    "class said twice": (mjcf(head="<default>" + "<default class='k'/>" * 2 + "</default>"), ["'k'", "differ"]),
    "range of one point": (mjcf(joint='<joint name="shoulder" range="1 1"/>'), ["'shoulder'", "range"]),
    "names clash": (mjcf(joint='<joint name="elbow"/>'), ["'elbow'", "differ"]),
    "unknown class": (mjcf(joint='<joint name="shoulder" class="k"/>'), ["'k'", "<default>"]),
    "two defaults": (mjcf(head="<default/><default/>"), ["2 <default>"]),
    "keyframe is no posture": (mjcf(tail='<keyframe><key qpos="1 x"/></keyframe>'), ["<key>", "qpos", "'x'"]),
    "doctype": ('<!DOCTYPE mujoco [<!ENTITY a "b">]>' + mjcf(), ["DOCTYPE"]),
    "include of a missing file": (mjcf(head='<include file="gone.xml"/>'), ["gone.xml", "no such file"]),
    "nothing moves": ("<mujoco><worldbody><body name='a'/></worldbody></mujoco>", ["no joint that moves"]),
}
CASES = [(f"{kind}: {name}", suffix, *case) for kind, suffix, table in
         (("urdf", ".urdf", URDF), ("mjcf", ".xml", MJCF)) for name, case in table.items()]  # fmt: skip


@pytest.mark.parametrize(("suffix", "text", "says"), [case[1:] for case in CASES], ids=[c[0] for c in CASES])
def test_refused_by_name(tmp_path, suffix, text, says):
    """One line that names the file and the culprit; the same from text alone."""
    path = tmp_path / f"robot{suffix}"
    path.write_text(text)
    with pytest.raises(ModelError) as caught:
        robot_models.load(path)
    message = str(caught.value)
    assert "\n" not in message
    assert "robot" in message
    for words in says:
        assert words in message
    with pytest.raises(ModelError):
        robot_models.from_text(
            text,
            "urdf" if suffix == ".urdf" else "mjcf",
            name="robot",
            armature=[0, 0],
            tip=None,
            home=[0, 0],
            locked={},
        )


def test_keyframe_of_another_length(tmp_path):
    """A keyframe has one value for each joint."""
    (tmp_path / "robot.xml").write_text(mjcf(tail='<keyframe><key qpos="1 2 3"/></keyframe>'))
    with pytest.raises(ModelError, match="3 values for 2 joints"):
        robot_models.load(tmp_path / "robot.xml")


def test_the_samples_themselves_are_accepted(tmp_path):
    """The refusals above are refusals of their one flaw."""
    for name, text in (("a.urdf", urdf(*ARM)), ("a.xml", mjcf())):
        path = tmp_path / name
        path.write_text(text)
        assert robot_models.load(path).joint_names == ("shoulder", "elbow")


@pytest.mark.parametrize(
    ("moments", "accepted"),
    [
        ((0.0, 1, 1), True),
        ((1, 1, 2), True),
        ((1, 1, 2.001), True),
        ((1, 1, 2.01), False),
        ((1, 1, 2.1), False),
    ],
)
def test_triangle_inequality_from_both_sides(tmp_path, moments, accepted):
    """Rods and plates lie on the bound; rounding of the fourth digit is forgiven, and no more."""
    path = tmp_path / "a.urdf"
    path.write_text(arm(fore=link("fore", tensor(*moments))))
    if accepted:
        robot_models.load(path)
    else:
        with pytest.raises(ModelError, match="triangle"):
            robot_models.load(path)
