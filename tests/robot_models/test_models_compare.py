"""What Pinocchio built is held against the text: each way to differ is named, with its link or joint."""

import numpy as np
import pinocchio as pin
import pytest
from model_texts import INERTIAL, LIMIT, arm, joint, link

import robot_models
from robot_models import ModelError, urdf
from robot_models.build import check_built
from robot_models.mechanism import MAX_JOINTS, MAX_LINKS

WELDED = joint("end", "fore", "tip", kind="fixed", limit="")


def check(held, said, locked=None):
    """Hold Pinocchio's model of one text against another text."""
    model = pin.buildModelFromXML(urdf.for_pinocchio(held))
    names = list(locked or {})
    if names:
        posture = np.zeros(model.nq)
        for name in names:
            posture[model.idx_qs[model.getJointId(name)]] = locked[name]
        model = pin.buildReducedModel(model, [model.getJointId(name) for name in names], posture)
    check_built(model, urdf.mechanism(said), locked or {}, "robot")


def elbow(**options):
    """Return the sample arm with another elbow."""
    return arm(elbow=joint("elbow", "upper", "fore", **{"axis": "0 0 1", **options}))


TURNED = '<origin rpy="0 0 1e-6"'
WEIGHT = ("upper", INERTIAL.replace("0.1 0.02 0.3", "0.1 0.02 0.3001"))
DIFFERENT = {
    "mass": (arm(upper=link("upper", INERTIAL.replace('"2"', '"2.000001"'))), ["link 'upper'", "mass", "2.000001"]),
    "no mass": (arm(upper=link("upper", "")), ["link 'upper'", "mass (0)"]),
    "centre": (arm(upper=link(*WEIGHT)), ["link 'upper'", "centre of mass", "0.3001"]),
    "tensor": (arm(upper=link("upper", INERTIAL.replace("0.12", "0.120001"))), ["link 'upper'", "tensor", "0.120001"]),
    "place of a joint": (elbow(origin="0 0 0.50001"), ["joint 'elbow'", "place", "0.50001"]),
    "axis": (elbow(axis="0 1e-6 1"), ["joint 'elbow'", "axis"]),
    "kind": (elbow(kind="prismatic"), ["joint 'elbow'", "axis"]),
    "limit": (elbow(limit=LIMIT.replace('"1"', '"1.1"')), ["joint 'elbow'", "upper limit (1.1)"]),
    "effort": (elbow(limit=LIMIT.replace('"5"', '"6"')), ["joint 'elbow'", "effort limit (6)"]),
    "another parent": (arm(elbow=joint("elbow", "base", "fore", axis="0 0 1")), ["joint 'elbow'"]),
    "missing joint": (arm(without="end"), ["'tip'", "not in Pinocchio's model"]),
    "place of a welded link": (arm(end=WELDED.replace("0 0 0.5", "0 0 0.6")), ["link 'tip'", "place", "0 0 0.6"]),
    "turn of a welded link": (arm(end=WELDED.replace("<origin", TURNED)), ["link 'tip'", "orientation"]),
    "a link more": (arm(plus=link("more") + joint("new", "tip", "more")), ["'new'", "not in the text"]),
}  # fmt: skip


@pytest.mark.parametrize("case", DIFFERENT)
def test_what_differs_is_named(case):
    """The model of another text is refused, in one line; that of the text itself is not."""
    held, says = DIFFERENT[case]
    if case == "missing joint":
        held = held.replace(link("tip", ""), "")
    check(held, held)
    with pytest.raises(ModelError) as caught:
        check(held, arm())
    for words in ("robot: ", *says):
        assert words in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("value", [0.0, 0.7])
def test_locked_joints_are_compared_where_they_are_held(value):
    """A locked link weighs in at its angle; at another angle, the model is another."""
    check(arm(), arm(), {"elbow": value})
    model = pin.buildModelFromXML(arm())
    model = pin.buildReducedModel(model, [model.getJointId("elbow")], np.array([0.0, value + 0.1]))
    with pytest.raises(ModelError, match="link 'fore'"):
        check_built(model, urdf.mechanism(arm()), {"elbow": value}, "robot")


def test_of_links_held_together_the_missing_one_is_named():
    """Two links on one joint: the one that was dropped."""
    heavy = arm(tip=link("tip", INERTIAL.replace('"2"', '"0.3"')))
    with pytest.raises(ModelError, match=r"link 'tip': .*mass \(2\).*\(2\.3\)"):
        check(arm(), heavy)


def test_a_dropped_inertial_does_not_pass(tmp_path, monkeypatch):
    """The fault that this is for: urdfdom drops an <inertial> whose mass ends with a blank."""
    path = tmp_path / "robot.urdf"
    path.write_text(arm())
    plainly = urdf.for_pinocchio
    monkeypatch.setattr(urdf, "for_pinocchio", lambda text: plainly(text).replace('value="2"', 'value="2 "', 1))
    with pytest.raises(ModelError, match=r"link 'upper': Pinocchio read another mass \(0\) than the text says \(2\)"):
        robot_models.load(path)


def chain(joints, fixed=0):
    """Return a chain of hinges with frames welded to its end."""
    parts = [link("l0", "")]
    for k in range(joints + fixed):
        kind, limit = ("revolute", LIMIT) if k < joints else ("fixed", "")
        parts += [
            link(f"l{k + 1}", INERTIAL if k < joints else ""),
            joint(f"j{k}", f"l{k}", f"l{k + 1}", kind=kind, limit=limit),
        ]
    return "<robot name='chain'>" + "".join(parts) + "</robot>"


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (chain(MAX_JOINTS + 1), f"{MAX_JOINTS + 1} joints that move: at most {MAX_JOINTS}"),
        (chain(500), "500 joints that move"),
        (chain(2, MAX_LINKS), f"{MAX_LINKS + 3} links: at most {MAX_LINKS}"),
        ("<robot name='a'>" + "<link/>" * 100_001 + "</robot>", "more than 100000 elements"),
    ],
)
def test_what_is_too_large_is_refused_before_it_is_built(tmp_path, monkeypatch, text, says):
    """The bound is said in one line, and nothing expensive was begun."""
    monkeypatch.setattr(pin, "buildModelFromXML", None)
    path = tmp_path / "robot.urdf"
    path.write_text(text)
    with pytest.raises(ModelError, match=says):
        robot_models.load(path)


@pytest.mark.slow
def test_the_largest_that_is_accepted_loads(tmp_path):
    """At both bounds at once."""
    path = tmp_path / "robot.urdf"
    path.write_text(chain(MAX_JOINTS, MAX_LINKS - MAX_JOINTS - 1))
    assert robot_models.load(path).n == MAX_JOINTS
