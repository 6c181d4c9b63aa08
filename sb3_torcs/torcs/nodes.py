"""The parameter files that the game brings or writes itself, and those that it shall read."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from sb3_torcs.torcs.params import UNITS

__all__ = ["Node"]


class Node:
    """
    A section of a file that the game brings, wrote or shall read, with all that it holds.

    :param element: of the file
    """

    def __init__(self, element: ElementTree.Element) -> None:
        self._element = element

    @classmethod
    def new(cls, name: str, kind: str) -> Node:
        """
        Begin a file.

        :param name: of what it describes
        :param kind: of file, as the game calls it
        :return: the section around everything
        """
        return cls(ElementTree.Element("params", name=name, type=kind))

    @classmethod
    def read(cls, path: Path) -> Node:
        """
        Read a file.

        :param path: of the file
        :return: the section around everything
        :raises OSError: if there is no such file
        :raises ValueError: if it is not well-formed
        """
        try:
            return cls(ElementTree.parse(path).getroot())
        except ElementTree.ParseError as error:
            raise ValueError(str(error)) from error

    def write(self, path: Path) -> None:
        """
        Write a file, with this section around everything.

        :param path: of the file
        """
        ElementTree.ElementTree(self._element).write(path, encoding="UTF-8", xml_declaration=True)

    def as_text(self) -> str:
        """Return the text of a file with this section around everything."""
        return ElementTree.tostring(self._element, encoding="unicode")

    @property
    def name(self) -> str:
        """The name of the section."""
        return self._element.get("name", "")

    def sections(self) -> Iterator[Node]:
        """Yield the sections inside this one."""
        yield from map(Node, self._element.iterfind("section"))

    def find(self, *names: str) -> Node:
        """
        Find a section inside this one.

        :param names: from the outside in
        :raises LookupError: naming what is not there
        """
        node = self
        for name in names:
            inner = next((section for section in node.sections() if section.name == name), None)
            if inner is None:
                raise LookupError(f"no section '{name}'")
            node = inner
        return node

    def child(self, *names: str) -> Node:
        """
        Find a section inside this one.

        :param names: from the outside in
        :return: the section, an empty one if it is not there
        """
        try:
            return self.find(*names)
        except LookupError:
            return Node(ElementTree.Element("section"))

    def make(self, *names: str) -> Node:
        """
        Find a section inside this one, or make it.

        :param names: from the outside in
        """
        node = self
        for name in names:
            try:
                node = node.find(name)
            except LookupError:
                node = Node(ElementTree.SubElement(node._element, "section", name=name))
        return node

    def number_sections(self, entries: int) -> list[Node]:
        """
        Put numbered sections instead of all that are inside this one.

        :param entries: how many
        :return: the new sections
        """
        for old in self._element.findall("section"):
            self._element.remove(old)
        return [self.make(str(number)) for number in range(1, entries + 1)]

    def text(self, name: str, default: str = "") -> str:
        """
        Read a value.

        :param name: of the value
        :param default: if it is not there
        :return: its text, whatever kind it is of
        """
        value = self._value(name)
        return default if value is None else value.get("val", "")

    def number(self, name: str, default: float = 0.0, real: Callable[[Any], Any] = float) -> float:
        """
        Read a number in SI units; unknown units count as SI.

        :param name: of the value
        :param default: if it is not there
        :param real: what to compute with; the game does with ``numpy.float32``
        :raises ValueError: if it is not a number
        """
        value = self._value(name)
        return default if value is None else float(_in_si(value, "val", real))

    def largest(self, name: str) -> float:
        """
        Read the upper limit of a number, in SI units; without ``max`` its value is the limit.

        :param name: of the value
        :return: infinity if the value is not there
        :raises ValueError: if it is not a number
        """
        value = self._value(name)
        if value is None:
            return math.inf
        return float(_in_si(value, "max" if "max" in value.attrib else "val", float))

    def _value(self, name: str) -> ElementTree.Element | None:
        values = (value for value in self._element if value.tag in ("attnum", "attstr"))
        return next((value for value in values if value.get("name") == name), None)

    def set(self, name: str, value: str | float) -> None:
        """
        Set a value.

        :param name: of the value
        :param value: a text, or a number in SI units
        """
        tag = "attstr" if isinstance(value, str) else "attnum"
        for old in self._element.findall(tag):
            if old.get("name") == name:
                self._element.remove(old)
        ElementTree.SubElement(self._element, tag, name=name, val=str(value))


def _in_si(value: ElementTree.Element, attribute: str, real: Callable[[Any], Any]) -> Any:
    """Convert an attribute of a value into SI units; unknown units count as SI."""
    return real(value.get(attribute, "")) * real(UNITS.get(value.get("unit", ""), 1.0))
