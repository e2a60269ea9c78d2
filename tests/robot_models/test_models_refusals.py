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
    "joint that mimics itself": (elbow(extra='<mimic joint="elbow"/>'), ["'elbow'", "no other joint"]),
    "mimic by no number": (elbow(extra='<mimic joint="shoulder" offset="x"/>'), ["'elbow'", "mimic offset", "'x'"]),
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
MUSCLE = '<actuator><muscle name="m" joint="shoulder" lengthrange="0 1"/></actuator>'
PLUGIN = '<extension><plugin plugin="mujoco.pid"/></extension>'
SPATIAL = '<tendon><spatial name="cable" stiffness="3"><site site="touch"/><site site="other"/></spatial></tendon>'
ITSELF = (
    '<tendon><fixed name="t"><joint joint="shoulder" coef="1"/></fixed>'
    '<fixed name="u"><joint joint="shoulder" coef="2"/></fixed></tendon>'
    '<equality><tendon name="held" tendon1="t" tendon2="u" polycoef="0 .5 0 0 0"/></equality>'
)
CLOTH = (
    '<worldbody><flexcomp name="cloth" type="grid" count="3 3 1" spacing=".1 .1 .1" mass="1" radius=".01" pos="0 0 2"/>'
    "</worldbody>"
)
MJCF = {
    "muscle": (mjcf(tail=MUSCLE), ["'m'", "muscle", "motor"]),
    "spatial tendon": (
        mjcf(world='<site name="other"/>', tail=SPATIAL),
        ["tendon 'cable'", "spatial", "not simulated"],
    ),
    "tendon held to itself": (mjcf(tail=ITSELF), ["'held'", "binds no joint"]),
    "cloth": (mjcf(tail=CLOTH), ["<flex>", "not simulated"]),
    "medium": (mjcf(head='<option density="1000"/>'), ["density 1000", "medium"]),
    "free body without inertia": (mjcf(base='<body name="base"><freejoint/>'), ["'base'", "mass and inertia"]),
    "free joint on a body that another carries": (
        mjcf(joint='<joint name="shoulder" type="free"/>'),
        ["'upper'", "free joint"],
    ),
    "negative mass": (mjcf(inertial=MJCF_INERTIAL.replace('"2"', '"-2"')), ["'upper'", "mass"]),
    "nan": (mjcf(inertial=MJCF_INERTIAL.replace('"2"', '"nan"')), ["'upper'", "mass"]),
    "pose is nan": (mjcf(base='<body name="base" pos="1 0 nan">'), ["'base'", "pos", "not finite"]),
    "turn is nan": (mjcf(base='<body name="base" quat="1 0 nan 0">'), ["'base'", "quat", "not finite"]),
    "triangle": (mjcf(inertial='<inertial pos="0 0 0" mass="1" diaginertia="1 1 3"/>'), ["'upper'", "balanceinertia"]),
    "indefinite": (
        mjcf(inertial='<inertial pos="0 0 0" mass="1" fullinertia="1 1 1 2 0 0"/>'),
        ["'upper'", "positive"],
    ),
    "zero axis": (mjcf(joint='<joint name="shoulder" axis="0 0 0"/>'), ["'shoulder'", "axis"]),
    "pose of two numbers": (mjcf(base='<body name="base" pos="1 2">'), ["'pos'", "'body', line 1"]),
    "far too large": (
        mjcf(inertial=MJCF_INERTIAL.replace("0.1 0.02", "1e200 0")),
        ["'upper'", "centre of mass has 1e+200", "at most 1e+06 m"],
    ),
    "negative armature": (mjcf(joint='<joint name="shoulder" armature="-1"/>'), ["'shoulder'", "armature"]),
    "misspelt attribute": (mjcf(joint='<joint name="shoulder" rnage="0 1"/>'), ["'rnage'", "'joint', line 1"]),
    "misspelt section": (mjcf(tail="<keyframes/>"), ["'keyframes'"]),
    "unknown word": (mjcf(inner='<geom type="ball" size="1"/>'), ["'ball'"]),
    "a weightless body that moves": (
        mjcf(inertial='<inertial pos="0 0 0" mass="0" diaginertia="0 0 0"/>'),
        ["'upper'", "mass and inertia"],
    ),
    "motor of no joint": (mjcf(tail='<actuator><motor joint="knee"/></actuator>'), ["'knee'"]),
    "names clash": (mjcf(joint='<joint name="elbow"/>'), ["'elbow'", "repeated"]),
    "unknown class": (mjcf(joint='<joint name="shoulder" class="k"/>'), ["'k'", "class"]),
    "keyframe of another length": (mjcf(tail='<keyframe><key qpos="1 2 3"/></keyframe>'), ["expected 2, got 3"]),
    "a mesh that weighs and is not there": (
        mjcf(head='<asset><mesh name="a" file="gone.stl"/></asset>', inertial='<geom type="mesh" mesh="a"/>'),
        ["gone.stl"],
    ),
    "doctype": ('<!DOCTYPE mujoco [<!ENTITY a "b">]>' + mjcf(), ["DOCTYPE"]),
    "include of a missing file": (mjcf(head='<include file="gone.xml"/>'), ["gone.xml", "no such file"]),
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
    assert any("triangle" in line for line in robot_models.load(path).warnings) != accepted
