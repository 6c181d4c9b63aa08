"""The parameter files of TORCS: XML that holds sections of named numbers and texts.

Numbers come in SI units. There are two ways to read. :func:`read_params` is for tracks and robots,
files that may be anybody's: their common surfaces come from a file of the installation, nothing
else is ever opened, and nothing over a network; what the game's loader would read otherwise than it
is written is refused, and so is what could keep a parser busy for long.
:class:`~sb3_torcs.torcs.nodes.Node` is for what the game brings or writes itself, and for what is
written for the game.
"""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple
from xml.parsers import expat

from sb3_torcs.errors import TrackFileError

__all__ = ["UNITS", "Keys", "Section", "digests", "read_bounded", "read_params"]

UNITS = {  # to SI; foot and rpm are TORCS's own
    "m": 1.0,
    "rad": 1.0,
    "s": 1.0,
    "deg": math.pi / 180.0,
    "rpm": 0.104719755,
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
NUMBER = re.compile(r"\s*[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?\s*", re.ASCII)
HEX = re.compile(r"0x[0-9a-fA-F]+")
LARGEST = 1e9  # [-] of a value in SI; the game computes in single precision
MAX_BYTES = 4 << 20  # of a file; the largest of the game's has 205 kB
MAX_DEPTH = 16  # of tags in tags; the game's tracks have 6
MAX_ATTRIBUTES = 16  # of one tag; the game knows five
MAX_NAME = 100  # characters; the game's loader cuts paths of sections at 255
SHARED_SURFACES = "surfaces.xml"
UNREAD_ENTITIES = ("objects.xml",)  # trees and houses
UNREAD_NAMES = ("default-objects",)  # the names in the game's tracks


_LAST_SURFACES: dict[tuple[Path, bytes, int], dict[str, Section]] = {}
"""The sections of the shared surfaces that were read last, by file, content and depth."""


@dataclass(slots=True)
class Section:
    """A section of a file, with its contents."""

    place: str
    """File and line, for complaints."""
    numbers: dict[str, float] = field(default_factory=dict)
    unreadable: dict[str, str] = field(default_factory=dict)
    """Numbers that are none, with what is wrong: many stand in sections that the game ignores."""
    texts: dict[str, str] = field(default_factory=dict)
    names: set[str] = field(default_factory=set)
    """Of numbers and texts."""
    children: dict[str, Section] = field(default_factory=dict)

    def number(self, name: str, default: float) -> float:
        """
        Return a number.

        :param name: of the number
        :param default: if it is not there
        :raises TrackFileError: if its text is not a number
        """
        if name in self.unreadable:
            raise TrackFileError(self.unreadable[name])
        return self.numbers.get(name, default)

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


class Keys(NamedTuple):
    """Values of a section whose names have a common beginning."""

    section: Section
    prefix: str

    def number(self, name: str, default: float) -> float:
        """
        Return a number.

        :param name: after the prefix
        :param default: if it is not there
        """
        return self.section.number(self.prefix + name, default)

    def text(self, name: str, default: str = "") -> str:
        """
        Return a text.

        :param name: after the prefix
        :param default: if it is not there
        """
        return self.section.texts.get(self.prefix + name, default)


class _Parser:
    """Builds the tree of sections of one file, with the shared surfaces in their place."""

    def __init__(self, path: Path, data: Sequence[Path]) -> None:
        self.path = path
        self._data = data
        self.root = Section(str(path))
        self._open = [self.root]
        self._depth = 0
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
        """Build the error for the present line."""
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
        parser.AttlistDeclHandler = self._declare_attribute
        parser.ExternalEntityRefHandler = self._include
        parser.SkippedEntityHandler = self._skip
        self._parsing.append((path, parser))
        try:
            parser.Parse(read_bounded(path), True)
        except expat.ExpatError as error:
            reason = expat.ErrorString(error.code)
            raise TrackFileError(
                f"{path}, line {error.lineno}: this is not well-formed XML ({reason})"
            ) from error
        except TrackFileError:
            raise
        except (LookupError, ValueError) as error:  # of Python's codecs
            raise self._fail(
                f"its encoding cannot be read ({error}); write the file in UTF-8, and say so in "
                'its first line: <?xml version="1.0" encoding="UTF-8"?>'
            ) from error
        self._parsing.pop()

    def _declare(
        self, name: str, is_parameter: int, value: str | None, base: str | None,
        system_id: str | None, public_id: str | None, notation: str | None,
    ) -> None:  # fmt: skip
        """Refuse entities with a text of their own, which TORCS does not use and can explode."""
        del is_parameter, base, system_id, public_id, notation
        if value is not None:
            raise self._fail(f"entity '{name}' has a text of its own; only files are supported")

    def _declare_attribute(
        self, tag: str, name: str, kind: str, default: str | None, required: int
    ) -> None:
        """Refuse default attributes: TORCS does not use them, and they can grow without limit."""
        del kind, default, required
        raise self._fail(f"declares the attribute '{name}' of <{tag}>; write it where it belongs")

    def _skip(self, name: str, is_parameter: bool) -> None:
        """
        Refuse an entity that is not declared, unless the game ignores it, too.

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
        Include another file for an entity. Only known files of this machine are included.

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
        self._include_surfaces(self._shared_surfaces(), context)
        return 1

    def _include_surfaces(self, path: Path, context: str | None) -> None:
        """
        Read the shared surfaces, or take those that the last track has read from the same file.

        They are most of what the files of all tracks hold. A file that uses entities means what the
        track declares, and one with values outside of sections belongs to where it is included.

        :param path: of the file
        :param context: for the parser
        """
        inside, content = self._open[-1], read_bounded(path)
        key = path, content, self._depth
        known = _LAST_SURFACES.get(key, {})
        if known and known.keys().isdisjoint(inside.children):
            inside.children.update(known)
            return
        names, before = set(inside.names), set(inside.children)
        _, parser = self._parsing[-1]
        self._feed(path, parser.ExternalEntityParserCreate(context))
        if inside.names == names and b"&" not in content:
            read = inside.children.items()
            _LAST_SURFACES.clear()
            _LAST_SURFACES[key] = {name: each for name, each in read if name not in before}

    def _shared_surfaces(self) -> Path:
        """Find the file of surfaces that all tracks of an installation share."""
        candidates = _surface_files(self.path, self._data)
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
        if (tag == "params") != (self._depth == 0):
            raise self._fail(f"<{tag}>; everything stands in one <params>")
        self._depth += 1
        if self._depth > MAX_DEPTH:
            raise self._fail(f"<{tag}> lies {self._depth} tags deep, at most {MAX_DEPTH} may")
        if len(attributes) > MAX_ATTRIBUTES:
            raise self._fail(
                f"<{tag}> has {len(attributes)} attributes, at most {MAX_ATTRIBUTES} may be"
            )
        inside = self._open[-1]
        if tag == "section":
            name = self._name(tag, attributes)
            if name in inside.children:
                raise self._fail(f"section '{name}' is already at {inside.children[name].place}")
            inside.children[name] = Section(self._place)
            self._open.append(inside.children[name])
        elif tag in ("attnum", "attstr"):
            name = self._name(tag, attributes)
            # If a name has two values, the game's loader takes the first.
            if name in inside.names:
                return
            inside.names.add(name)
            text = self._attribute(tag, attributes, "val")
            if tag == "attnum":
                self._take_number(inside, name, text, attributes.get("unit", ""))
            elif text:  # an empty one counts as missing
                inside.texts[name] = text

    def _end(self, tag: str) -> None:
        """Take in a closing tag."""
        self._depth -= 1
        if tag == "section":
            self._open.pop()

    def _name(self, tag: str, attributes: dict[str, str]) -> str:
        """
        Read a name, and check that the game's loader can find it.

        :param tag: that has it
        :param attributes: of the tag
        :return: the name
        """
        name = self._attribute(tag, attributes, "name")
        if not name or "/" in name or len(name.encode()) > MAX_NAME:
            raise self._fail(
                f"<{tag}> is named '{name[:MAX_NAME]}'; expected 1 to {MAX_NAME} letters, and no "
                "'/', at which the game would cut the name in two"
            )
        return name

    def _attribute(self, tag: str, attributes: dict[str, str], name: str) -> str:
        """Read an attribute that has to be there."""
        if name not in attributes:
            raise self._fail(f"<{tag}> without '{name}'")
        return attributes[name]

    def _take_number(self, inside: Section, name: str, text: str, unit: str) -> None:
        """Keep a number, or what is wrong with it, until it is needed."""
        try:
            inside.numbers[name] = self._number(text, unit)
        except TrackFileError as error:
            inside.unreadable[name] = str(error)

    def _number(self, text: str, unit: str) -> float:
        """
        Read the value of an ``attnum`` in SI units.

        :param text: the value as it is written
        :param unit: of the file
        :return: the value
        """
        if unit and unit not in UNITS:
            raise self._fail(f"unknown unit '{unit}'; known are {', '.join(UNITS)}")
        value = math.nan
        if len(text) <= MAX_NAME:
            if NUMBER.fullmatch(text):
                value = float(text)
            elif HEX.fullmatch(text):
                value = float(int(text, 16))
        value *= UNITS.get(unit, 1.0)
        if math.isnan(value):
            raise self._fail(f"'{text[:MAX_NAME]}' is not a finite number")
        if abs(value) > LARGEST:
            raise self._fail(f"{text} is too large a number; at most {LARGEST:g} makes sense")
        return value


def read_bounded(path: Path) -> bytes:
    """
    Read a file up to a limit of size.

    :param path: of the file
    :return: its bytes
    :raises TrackFileError: if it cannot be read, or is larger than any track
    """
    try:
        with path.open("rb") as file:
            content = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise TrackFileError(f"{path}: cannot be read: {error.strerror}") from error
    if len(content) > MAX_BYTES:
        raise TrackFileError(f"{path}: has more than {MAX_BYTES >> 20} MB, which no track has")
    return content


def digests(path: Path, data: Sequence[Path] = ()) -> tuple[str, ...]:
    """
    Compute digests of a track's file, which identify its content.

    :param path: of the file
    :param data: folders of TORCS's data, in which shared surfaces are looked for
    :return: SHA-256 of the file, and of the surfaces that it may include
    """
    files = [path]
    if path.suffix.lower() == ".xml":
        files += [candidate for candidate in _surface_files(path, data) if candidate.is_file()][:1]
    return tuple(hashlib.sha256(read_bounded(file)).hexdigest() for file in files)


def _surface_files(path: Path, data: Sequence[Path]) -> list[Path]:
    """List the possible paths of the surfaces that a track includes; the first one counts."""
    real = path.resolve()
    folders = [real.parent, *real.parents[3:4], *data]
    shared = [folder / "data" / "tracks" / SHARED_SURFACES for folder in folders]
    return [path.parent / SHARED_SURFACES, *shared]


def read_params(path: Path, data: Sequence[Path] = ()) -> Section:
    """
    Read a parameter file.

    :param path: of the file
    :param data: folders of TORCS's data, in which the surfaces that a track includes are looked for
    :return: the section around everything
    :raises TrackFileError: naming file and line
    """
    return _Parser(path, data).parse()
