"""The masses, centres and tensors that Pinocchio holds equal the text's, link by link, for every robot."""

import io
import xml.etree.ElementTree as ET

import numpy as np
import pinocchio as pin
import pytest

import robot_models
from robot_models import described, example_robots, urdf

#: Relative to the link: two readers turn a tensor by angles of their own sines.
EQUAL = 1e-12

# Their files are not a URDF that is read: an SDF, two that are made by code, and two whose joints lack bounds.
UNREAD = {"cassie", "human", "talos_legs", "centauro", "quadruped"}
NAMES = [*robot_models.shipped_names(), *sorted(set(example_robots.example_names()) - UNREAD)]


def unwelded(text):
    """Return what Pinocchio gets of a text, every welded link on a hinge of its own, so that nothing is lumped."""
    root = ET.fromstring(urdf.for_pinocchio(text))
    for joint in root.findall("joint[@type='fixed']"):
        joint.set("type", "revolute")
        for element in [*joint.findall("axis"), *joint.findall("limit")]:
            joint.remove(element)
        ET.SubElement(joint, "axis", xyz="0 0 1")
        ET.SubElement(joint, "limit", lower="-1", upper="1", effort="1", velocity="1")
    return ET.tostring(root, encoding="unicode")


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_every_link_weighs_what_its_text_says(name):
    """Against yourdfpy's reading of the file as it lies there; robots that are refused as mechanisms included."""
    own = name in robot_models.shipped_names()
    raw = described.path_of(name).read_text(encoding="utf-8") if own else example_robots.find(name).text
    model = pin.buildModelFromXML(unwelded(urdf.read(raw, name)))
    import yourdfpy

    theirs = yourdfpy.URDF.load(io.BytesIO(raw.encode()), build_scene_graph=False, load_meshes=False).robot
    hung = {joint.child: joint for joint in theirs.joints}
    weighed = 0
    for link in theirs.links:
        joint = hung.get(link.name)
        held = model.inertias[model.getJointId(joint.name) if joint is not None else 0]
        if joint is not None and joint.origin is not None:
            place = model.jointPlacements[model.getJointId(joint.name)].homogeneous
            np.testing.assert_allclose(place, joint.origin, atol=EQUAL * max(1.0, np.abs(joint.origin).max()))
        if link.inertial is None:
            assert held.mass == 0.0
            continue
        pose = np.eye(4) if link.inertial.origin is None else link.inertial.origin
        tensor = pose[:3, :3] @ link.inertial.inertia @ pose[:3, :3].T
        assert held.mass == pytest.approx(link.inertial.mass, rel=EQUAL)
        if link.inertial.mass:
            np.testing.assert_allclose(held.lever, pose[:3, 3], atol=EQUAL * max(1.0, np.abs(pose[:3, 3]).max()))
            np.testing.assert_allclose(held.inertia, tensor, atol=EQUAL * np.abs(tensor).max())
        weighed += 1
    assert weighed > 0
