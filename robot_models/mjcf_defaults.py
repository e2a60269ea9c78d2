"""MJCF's default classes, resolved to the attributes that an element ends up with."""

import xml.etree.ElementTree as ET

from robot_models.errors import ModelError

_TAGS = ("joint", "geom", "site")


class Defaults:
    """The classes of an MJCF document.

    A class inherits what its enclosing class says. An element takes its own class, or else the `childclass`
    around it, or else the outermost class; never a mixture. What it says itself goes before.

    Raises
    ------
    ModelError
        Two outermost `<default>` sections, or a nested one without a class.
    """

    def __init__(self, root: ET.Element, where: str):
        self._where = where
        self._main: dict[str, dict[str, str]] = {tag: {} for tag in _TAGS}
        self._classes: dict[str, dict[str, dict[str, str]]] = {"main": self._main}
        sections = root.findall("default")
        if len(sections) > 1:
            raise ModelError(f"{where}: {len(sections)} <default> sections: merge them into one")
        for section in sections:
            name = section.get("class", "main")
            self._main = self._classes[name] = self._read(section, self._main)

    def _read(self, section: ET.Element, parent: dict[str, dict[str, str]]) -> dict[str, dict[str, str]]:
        own = {tag: dict(parent[tag]) for tag in _TAGS}
        for tag in _TAGS:
            for element in section.findall(tag):
                own[tag].update(element.attrib)
        for nested in section.findall("default"):
            name = nested.get("class")
            if not name:
                raise ModelError(f"{self._where}: a nested <default> has no class")
            self._classes[name] = self._read(nested, own)
        return own

    def resolve(self, element: ET.Element, childclass: str | None) -> dict[str, str]:
        """Return an element's attributes with its class filled in.

        Raises
        ------
        ModelError
            The class is not defined.
        """
        if element.tag not in _TAGS:
            return dict(element.attrib)
        name = element.get("class", childclass)
        if name is None:
            chosen = self._main
        elif name in self._classes:
            chosen = self._classes[name]
        else:
            raise ModelError(f"{self._where}: class {name!r} is not defined in <default>")
        return {**chosen[element.tag], **element.attrib}
