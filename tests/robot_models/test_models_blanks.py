"""Blanks, tabs and line ends around the words and numbers of attributes change nothing."""

import itertools
import xml.etree.ElementTree as ET

import pytest
from budget import budget, others

import robot_models
from robot_models import described, example_robots, urdf
from robot_models.xml_text import parse

BLANKS = {
    "blank": " ",
    "tab": "\t",
    "line end": "\n",
    "carriage return": "\r\n",
    "no-break space": "\u00a0",
    "em space": "\u2003",
    "ideographic space": "\u3000",
}
NAMES = (*robot_models.shipped_names(), "panda", "ur5", "kinova")
# Every blank in a small robot, and every robot that ships with one of them: the rest belongs to the longer tests.
QUICK = {("planar2", kind) for kind in BLANKS} | set(zip(robot_models.shipped_names(), 2 * list(BLANKS), strict=False))


def text_of(name):
    """Return the text of a robot as it lies in its file."""
    if name in robot_models.shipped_names():
        return described.path_of(name).read_text(encoding="utf-8")
    return example_robots.find(name).text


def padded(value, blank):
    """Return a value with a blank before it, behind it, and between its numbers."""
    words = value.split()
    numbers = len(words) > 1 and all(word.lstrip("-").replace(".", "").replace("e-", "").isdigit() for word in words)
    return [blank + value, value + blank] + ([blank.join(words)] if numbers else [])


@pytest.mark.parametrize(
    ("name", "kind"),
    [*sorted(QUICK), *others((name, kind) for name in NAMES for kind in BLANKS if (name, kind) not in QUICK)],
)
def test_all_attributes_at_once(tmp_path, name, kind):
    """A robot whose every attribute is padded is the same robot to the last bit, by file and by fields."""
    root = parse(text_of(name), name)
    for element in root.iter():
        for key, value in element.attrib.items():
            element.set(key, padded(value, BLANKS[kind])[-1])
            element.set(key, BLANKS[kind] + element.attrib[key] + BLANKS[kind])
    path = tmp_path / "robot.urdf"
    path.write_bytes(ET.tostring(root, encoding="utf-8"))
    (tmp_path / "plain.urdf").write_text(text_of(name), encoding="utf-8")
    lock = dict.fromkeys(robot_models.load(name).locked, 0.0)
    robot, plain = (robot_models.load(p, lock=lock) for p in (path, tmp_path / "plain.urdf"))
    for field in ("joint_names", "joint_types", "frames", "tip", "notes"):
        assert getattr(robot, field) == getattr(plain, field)
    for field in ("position_lower", "position_upper", "velocity_limit", "effort_limit", "home"):
        assert getattr(robot, field).tobytes() == getattr(plain, field).tobytes()
    assert urdf.for_pinocchio(robot.text) == urdf.for_pinocchio(plain.text)


# The long texts of the parallel robots hold no element that the others lack.
SHORT = ("wam4", "planar2", "pointmass3", "five_bar")


@pytest.mark.slow
@pytest.mark.parametrize("name", budget(SHORT, robot_models.shipped_names()))
def test_each_attribute_by_itself(name):
    """Every attribute of every shipped robot, with a blank at every place: Pinocchio gets the very same text.

    The kinds of blanks take turns; with the full budget each is tried with each attribute.
    """
    root = parse(text_of(name), name)
    wanted = urdf.for_pinocchio(urdf.read(text_of(name), name))
    tried, turns = 0, itertools.cycle(BLANKS.values())
    for element in root.iter():
        for key, value in element.attrib.items():
            for blank in budget((next(turns), next(turns)), tuple(BLANKS.values())):
                for other in padded(value, blank):
                    element.set(key, other)
                    text = ET.tostring(root, encoding="unicode")
                    assert urdf.for_pinocchio(urdf.read(text, name)) == wanted, (element.tag, key, other)
                    tried += 1
            element.set(key, value)
    assert tried > budget(80, 300)


def test_a_blank_that_is_none_is_refused(tmp_path):
    """A zero-width space is no blank to anyone, and no number holds one."""
    path = tmp_path / "robot.urdf"
    text = text_of("planar2")
    first = parse(text, "planar2").find("link/inertial/mass").attrib["value"]
    path.write_text(text.replace(f'value="{first}"', f'value="{first}\u200b"', 1), encoding="utf-8")
    with pytest.raises(robot_models.ModelError, match=r"mass value is .*u200b"):
        robot_models.load(path)
