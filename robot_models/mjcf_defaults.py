"""MJCF's default classes, resolved to the attributes that an element ends up with."""

import xml.etree.ElementTree as ET

from robot_models.errors import ModelError

#: What stands in <actuator>. In a class they share one set of defaults, as for MuJoCo: a later one goes before.
ACTUATORS = (
    "general", "motor", "position", "velocity", "intvelocity", "damper", "cylinder", "muscle", "adhesion", "dcmotor",
)  # fmt: skip
_TAGS = ("joint", "geom", "site", "actuator")

# What force a <general> makes of its control; a shortcut says it itself.
_LAW = {"gaintype": "fixed", "gainprm": "1", "biastype": "none", "dyntype": "none"}
_BY_SHORTCUT = {"general": {}, "motor": _LAW}  # the force of any other is not proportional to its control


class Defaults:
    """The classes of an MJCF document.

    A class inherits what its enclosing class says. An element takes its own class, or else the `childclass`
    around it, or else the outermost class; never a mixture. What it says itself goes before.

    Raises
    ------
    ModelError
        Two outermost `<default>` sections, one that is not "main", a nested one without a class, or two of a class.
    """

    def __init__(self, root: ET.Element, where: str):
        self._where = where
        self._main: dict[str, dict[str, str]] = {tag: {} for tag in _TAGS}
        self._classes: dict[str, dict[str, dict[str, str]]] = {"main": self._main}
        sections = root.findall("default")
        if len(sections) > 1:
            raise ModelError(f"{where}: {len(sections)} <default> sections: merge them into one")
        for section in sections:
            if section.get("class", "main") != "main":
                raise ModelError(f"{where}: the outermost <default> is class 'main', not {section.get('class')!r}")
            self._main = self._classes["main"] = self._read(section, self._main)

    def _read(self, section: ET.Element, parent: dict[str, dict[str, str]]) -> dict[str, dict[str, str]]:
        own = {tag: dict(parent[tag]) for tag in _TAGS}
        for tag in _TAGS:
            for element in section.findall(tag):
                own[tag].update(element.attrib)
        for element in section:
            if element.tag in ACTUATORS:
                own["actuator"].update(element.attrib, **_law(element.tag))
        for nested in section.findall("default"):
            name = nested.get("class")
            if not name:
                raise ModelError(f"{self._where}: a nested <default> has no class")
            if name in self._classes or name == "main":
                raise ModelError(f"{self._where}: two classes are named {name!r}: names must differ")
            self._classes[name] = {}
            self._classes[name] = self._read(nested, own)
        return own

    def check_references(self, root: ET.Element) -> None:
        """Refuse a document in which an element is of a class that is not defined.

        Raises
        ------
        ModelError
            The class is not defined.
        """
        for section in root:
            for element in section.iter() if section.tag != "default" else ():
                for key in ("class", "childclass"):
                    name = element.get(key, "main")
                    if name not in self._classes:
                        raise ModelError(f"{self._where}: {key} {name!r} is not defined in <default>")

    def resolve(self, element: ET.Element, childclass: str | None) -> dict[str, str]:
        """Return an element's attributes with its class filled in.

        Raises
        ------
        ModelError
            The class is not defined.
        """
        tag = "actuator" if element.tag in ACTUATORS else element.tag
        if tag not in _TAGS:
            return dict(element.attrib)
        name = element.get("class", childclass)
        if name is None:
            chosen = self._main
        elif name in self._classes:
            chosen = self._classes[name]
        else:
            raise ModelError(f"{self._where}: class {name!r} is not defined in <default>")
        return {**(_LAW if tag == "actuator" else {}), **chosen[tag], **element.attrib, **_law(element.tag)}


def _law(tag: str) -> dict[str, str]:
    """Return what the tag of an actuator says by itself of its force."""
    return _BY_SHORTCUT.get(tag, {"biastype": "affine"}) if tag in ACTUATORS else {}
