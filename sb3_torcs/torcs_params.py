"""The parameter files of TORCS: XML that holds sections of named numbers and texts.

Numbers come in SI units. Track files take their common surfaces from a file of the installation;
nothing else is ever opened, and nothing over a network.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from xml.parsers import expat

from sb3_torcs.errors import TrackFileError
from sb3_torcs.game import torcs_folders

__all__ = ["Section", "read_params"]

UNITS = {  # to SI; a foot is TORCS's own
    "m": 1.0,
    "rad": 1.0,
    "s": 1.0,
    "deg": math.pi / 180.0,
    "%": 0.01,
    "percent": 0.01,
    "km": 1000.0,
    "cm": 0.01,
    "mm": 0.001,
    "ft": 0.304801,
    "feet": 0.304801,
    "in": 0.0254,
    "inch": 0.0254,
    "inches": 0.0254,
    "h": 3600.0,
    "hour": 3600.0,
    "hours": 3600.0,
}
SHARED_SURFACES = "surfaces.xml"
UNREAD_ENTITIES = ("objects.xml",)  # trees and houses
UNREAD_NAMES = ("default-objects",)  # what the game's tracks call them


@dataclass
class Section:
    """A section of the file, with all that it holds."""

    place: str
    """File and line, for complaints."""
    numbers: dict[str, float] = field(default_factory=dict)
    texts: dict[str, str] = field(default_factory=dict)
    children: dict[str, Section] = field(default_factory=dict)

    def child(self, *names: str) -> Section:
        """
        Find a section inside this one.

        :param names: from the outside in
        :return: the section, an empty one if it is not there
        """
        section = self
        for name in names:
            section = section.children.get(name) or Section(section.place)
        return section


class _Parser:
    """Builds the tree of sections of one file, with the shared surfaces in their place."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.root = Section(str(path))
        self._open = [self.root]
        self._parsing: list[tuple[Path, expat.XMLParserType]] = []

    def parse(self) -> Section:
        """Read the file and return the outermost section."""
        self._feed(self.path, expat.ParserCreate())
        return self.root

    @property
    def _place(self) -> str:
        """File and line that are being read."""
        path, parser = self._parsing[-1]
        return f"{path}, line {parser.CurrentLineNumber}"

    def _fail(self, message: str) -> TrackFileError:
        """
        Build the error for the present line.

        :param message: what is wrong
        :return: the error, to be raised
        """
        return TrackFileError(f"{self._place}: {message}")

    def _feed(self, path: Path, parser: expat.XMLParserType) -> None:
        """
        Read one file into the tree.

        :param path: of the file
        :param parser: for it
        """
        parser.StartElementHandler = self._start
        parser.EndElementHandler = self._end
        parser.EntityDeclHandler = self._declare
        parser.ExternalEntityRefHandler = self._include
        parser.SkippedEntityHandler = self._skip
        self._parsing.append((path, parser))
        try:
            parser.Parse(path.read_bytes(), True)
        except expat.ExpatError as error:
            reason = expat.ErrorString(error.code)
            raise TrackFileError(
                f"{path}, line {error.lineno}: this is not well-formed XML ({reason})"
            ) from error
        self._parsing.pop()

    def _declare(
        self, name: str, is_parameter: int, value: str | None, base: str | None,
        system_id: str | None, public_id: str | None, notation: str | None,
    ) -> None:  # fmt: skip
        """Refuse entities with a text of their own: TORCS has none, and they can explode."""
        del is_parameter, base, system_id, public_id, notation
        if value is not None:
            raise self._fail(f"entity '{name}' has a text of its own; only files are supported")

    def _skip(self, name: str, is_parameter: bool) -> None:
        """
        Refuse an entity that nothing has declared, unless it would not be read anyway.

        The game passes over such entities; one of its own tracks, e-track-4, has one.

        :param name: of the entity
        :param is_parameter: whether it stands in the declarations themselves
        """
        if not is_parameter and name not in UNREAD_NAMES:
            raise self._fail(f"entity '{name}' is not declared at the top of the file")

    def _include(
        self, context: str, base: str | None, system_id: str | None, public_id: str | None
    ) -> int:
        """
        Put another file in the place of an entity: only known ones, only from this machine.

        :param context: for the parser
        :param base: unused
        :param system_id: where the file is, seen from the track's file
        :param public_id: unused
        :return: 1, which lets the parser go on
        """
        del base, public_id
        name = (system_id or "").rpartition("/")[2]
        if name in UNREAD_ENTITIES:
            return 1
        if name != SHARED_SURFACES:
            raise self._fail(
                f"includes '{system_id}'; only {SHARED_SURFACES} and "
                f"{', '.join(UNREAD_ENTITIES)} can be included"
            )
        _, parser = self._parsing[-1]
        self._feed(self._shared_surfaces(), parser.ExternalEntityParserCreate(context))
        return 1

    def _shared_surfaces(self) -> Path:
        """Find the file of surfaces that all tracks of an installation share."""
        folders = [self.path.resolve().parent, *self.path.resolve().parents[3:4], *torcs_folders()]
        candidates = [folder / "data" / "tracks" / SHARED_SURFACES for folder in folders]
        candidates.insert(0, self.path.parent / SHARED_SURFACES)
        for candidate in candidates:
            if candidate.is_file():
                return candidate
        raise self._fail(
            f"needs the file data/tracks/{SHARED_SURFACES} of TORCS, which is in none of "
            f"{', '.join(str(candidate.parent) for candidate in candidates)}; copy it beside the "
            "track, install TORCS (`sb3-torcs install-torcs`), or set SB3_TORCS_HOME"
        )

    def _start(self, tag: str, attributes: dict[str, str]) -> None:
        """
        Take in an opening tag.

        :param tag: its name
        :param attributes: name, val, unit
        """
        if tag == "section":
            siblings = self._open[-1].children
            name = self._attribute(tag, attributes, "name")
            if name in siblings:
                raise self._fail(f"section '{name}' is already at {siblings[name].place}")
            siblings[name] = Section(self._place)
            self._open.append(siblings[name])
        elif tag == "attnum":
            name = self._attribute(tag, attributes, "name")
            # Of two values with the same name, the game's loader finds the first.
            self._open[-1].numbers.setdefault(name, self._number(attributes))
        elif tag == "attstr":
            name = self._attribute(tag, attributes, "name")
            self._open[-1].texts.setdefault(name, self._attribute(tag, attributes, "val"))

    def _end(self, tag: str) -> None:
        """
        Take in a closing tag.

        :param tag: its name
        """
        if tag == "section":
            self._open.pop()

    def _attribute(self, tag: str, attributes: dict[str, str], name: str) -> str:
        """
        Read an attribute that has to be there.

        :param tag: that has it
        :param attributes: of the tag
        :param name: of the attribute
        :return: its text
        """
        if name not in attributes:
            raise self._fail(f"<{tag}> without '{name}'")
        return attributes[name]

    def _number(self, attributes: dict[str, str]) -> float:
        """
        Read the value of an ``attnum`` in SI units.

        :param attributes: of the tag
        :return: the value
        """
        text = self._attribute("attnum", attributes, "val")
        unit = attributes.get("unit", "")
        try:
            value = float(int(text, 16)) if text[:2].lower() == "0x" else float(text)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise self._fail(f"'{text}' is not a finite number")
        if unit and unit not in UNITS:
            raise self._fail(f"unknown unit '{unit}'; known are {', '.join(UNITS)}")
        return value * UNITS.get(unit, 1.0)


def read_params(path: Path) -> Section:
    """
    Read a parameter file.

    :param path: of the file
    :return: the section around everything
    :raises TrackFileError: naming file and line
    """
    return _Parser(path).parse()
