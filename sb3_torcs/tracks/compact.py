"""The compact track file: one line per segment, all figures in SI units.

A file is text, UTF-8, one record per line, fields separated by commas; lines that begin with
``#`` are comments, empty lines are skipped. The records, in this order::

    sb3-torcs track,1
    name,aalborg
    category,road
    start,X,Y,HEADING                     [m], [m], [rad]; may be left out
    grid,DISTANCE,OFFSET                  [m] before the start line, [m] left of the axis
    surface,NAME,FRICTION,ROLLING RESISTANCE,REBOUND,DAMAGE
    segment,LENGTH,CURVATURE,WIDTH START,WIDTH END,LEFT START,LEFT END,RIGHT START,RIGHT END,
            ROAD,LEFT,RIGHT,LEFT WALL,RIGHT WALL          (on one line; surfaces by name)

Writing and reading back gives the same numbers to the last bit. The bundled tracks stand in this
format because TORCS's own cannot promise that: it says a bend by radius and arc, from which the
length of 186 of their 804 bends comes back otherwise rounded, and it takes the surfaces from
another file of the game, without which these tracks have to be read, too.
"""

from __future__ import annotations

import csv
import io
import math
from pathlib import Path

from sb3_torcs.errors import TrackFileError
from sb3_torcs.files import IN_A_FOLDER, atomic_file
from sb3_torcs.torcs.params import read_bounded
from sb3_torcs.tracks.track import Grid, Segment, Surface, Track

__all__ = ["read_track_file", "surfaces_of", "write_track_file"]

MAGIC = ["sb3-torcs track", "1"]
NUMBERS_PER_SEGMENT = 8
MAX_SEGMENTS = 20_000
LARGEST = 1e9  # [-] of any number
LONGEST = 40  # [characters] of a number that a message shows
MIN_CURVATURE = 1e-9  # [1/m] a radius of a million kilometres
FIELDS = {
    "name": 1,
    "category": 1,
    "start": 3,
    "grid": 2,
    "surface": 5,
    "segment": len(Segment._fields),
}


class _Reader:
    """Reads one file line by line, and names the line in its errors."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.line = 0
        self.texts: dict[str, str] = {}
        self.start = (0.0, 0.0, 0.0)
        self.grid = Grid(10.0, 0.0)
        self.surfaces: dict[str, Surface] = {}
        self.seen: set[str] = set()  # what stands once
        self.segments: list[Segment] = []

    def fail(self, message: str) -> TrackFileError:
        """
        Build the error for the present line.

        :param message: what is wrong and what is allowed
        :return: the error, to be raised
        """
        return TrackFileError(f"{self.path}, line {self.line}: {message}")

    def number(self, text: str) -> float:
        """
        Read one finite number.

        :param text: of the field
        :return: its value
        """
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise self.fail(f"'{text[:LONGEST]}' is not a finite number")
        if abs(value) > LARGEST:
            raise self.fail(f"{text[:LONGEST]} is too large; at most {LARGEST:g} makes sense")
        return value

    def surface(self, name: str) -> Surface:
        """
        Find a surface that an earlier line has defined.

        :param name: of the surface
        :return: the surface
        """
        if name not in self.surfaces:
            raise self.fail(
                f"surface '{name}' is not defined above; add a line "
                f"'surface,{name},FRICTION,ROLLING RESISTANCE,REBOUND,DAMAGE' before it"
            )
        return self.surfaces[name]

    def segment(self, values: list[str]) -> Segment:
        """
        Read a segment.

        :param values: the fields after the keyword
        :return: the segment
        """
        numbers = [self.number(text) for text in values[:NUMBERS_PER_SEGMENT]]
        surfaces = [self.surface(name) for name in values[NUMBERS_PER_SEGMENT:]]
        segment = Segment(*numbers, *surfaces)  # type: ignore[arg-type] # FIELDS has counted them
        if segment.length <= 0.0:
            raise self.fail(f"a segment's length is {segment.length} m; it has to be above 0")
        if 0.0 < abs(segment.curvature) < MIN_CURVATURE:
            raise self.fail(f"a curvature of {segment.curvature} 1/m is none; write 0")
        if min(segment.width_start, segment.width_end) <= 0.0:
            raise self.fail("the road's width has to be above 0")
        half = 0.5 * max(segment.width_start, segment.width_end)
        if abs(segment.curvature) * half > 1.0:  # its inner edge would run backwards
            raise self.fail(
                f"the radius of the bend is {1.0 / abs(segment.curvature):.3g} m, less than half "
                f"the road's width, {half:.3g} m; make the bend wider or the road narrower"
            )
        if min(numbers[4:]) < 0.0:
            raise self.fail("the width of the ground beside the road may not be negative")
        return segment

    def record(self, fields: list[str]) -> None:
        """
        Take in one line.

        :param fields: of the line
        """
        keyword, *values = fields
        if keyword not in FIELDS:
            raise self.fail(f"unknown record '{keyword}'; allowed are {', '.join(FIELDS)}")
        if len(values) != FIELDS[keyword]:
            raise self.fail(f"'{keyword}' has {len(values)} fields, expected {FIELDS[keyword]}")
        if keyword == "segment":
            if len(self.segments) == MAX_SEGMENTS:
                raise self.fail(
                    f"there are more than {MAX_SEGMENTS} segments, more than any road needs"
                )
            self.segments.append(self.segment(values))
        elif keyword == "surface":
            self.define(*values)
        else:
            self.header(keyword, values)

    def define(self, name: str, *texts: str) -> None:
        """
        Define a surface.

        :param name: of the surface
        :param texts: its numbers
        """
        numbers = [self.number(text) for text in texts]
        if min(numbers) < 0.0:
            raise self.fail("the numbers of a surface may not be negative")
        if name in self.surfaces:
            raise self.fail(f"there is a second surface '{name}'; give it another name")
        self.surfaces[name] = Surface(name, *numbers)

    def header(self, keyword: str, values: list[str]) -> None:
        """
        Take in what stands once in a file.

        :param keyword: of the line
        :param values: the fields after it
        """
        if keyword in self.seen:
            raise self.fail(f"there is a second '{keyword}'; expected one")
        self.seen.add(keyword)
        if keyword == "grid":
            self.grid = Grid(*map(self.number, values))
        elif keyword == "start":
            x, y, heading = map(self.number, values)
            if abs(heading) > math.tau:
                raise self.fail(f"the heading is {heading} rad; expected -2 pi to 2 pi")
            self.start = (x, y, heading)
        else:
            self.texts[keyword] = values[0]

    def track(self) -> Track:
        """Build the track once all lines are in."""
        if not self.segments:
            raise self.fail("the file ends without a segment")
        track = Track(
            self.texts.get("name", self.path.stem),
            self.texts.get("category", "road"),
            tuple(self.segments),
            "file",
            *self.start,
            self.grid,
        )
        self._check_grid(track)
        return track

    def _check_grid(self, track: Track) -> None:
        """Make sure that the first grid slot is on the road."""
        distance, offset = track.grid
        if not 0.0 <= distance <= track.length:
            raise TrackFileError(
                f"{self.path}: the grid is {distance:g} m before the line; expected 0 to "
                f"{track.length:g} m"
            )
        index, along = track.find(track.length - distance)
        segment = track.segments[index]
        half = 0.5 * segment.width_at(along / segment.length)
        if abs(offset) > half:
            raise TrackFileError(
                f"{self.path}: the grid is {offset:g} m from the axis, and there the road ends at "
                f"{half:g} m"
            )


def read_track_file(path: Path) -> Track:
    """
    Read a compact track file.

    :param path: of the file
    :return: the track, as written: not checked for being closed
    :raises TrackFileError: naming file and line
    """
    reader = _Reader(path)
    try:
        text = read_bounded(path).decode("utf-8-sig")  # spreadsheets put a mark before the text
    except UnicodeDecodeError as error:
        raise TrackFileError(f"{path}: is not UTF-8 text: {error}") from error
    begun = False
    for reader.line, line in enumerate(text.splitlines(), start=1):
        if not line.strip() or line.startswith("#"):
            continue
        try:
            fields = next(csv.reader([line]))
        except csv.Error as error:
            raise reader.fail(f"the line cannot be split into fields ({error})") from error
        if begun:
            reader.record(fields)
        elif fields != MAGIC:
            raise reader.fail(f"'{line}' instead of the first record '{','.join(MAGIC)}'")
        begun = True
    return reader.track()


def surfaces_of(track: Track) -> list[Surface]:
    """
    Return the different surfaces of a track, each once.

    :param track: whose file names them
    :raises TrackFileError: if two have one name
    """
    surfaces: dict[str, Surface] = {}
    for segment in track.segments:
        for surface in _surfaces(segment):
            if surfaces.setdefault(surface.name, surface) != surface:
                raise TrackFileError(
                    f"two different surfaces of the track '{track.name}' are called "
                    f"'{surface.name}'; rename one"
                )
    return list(surfaces.values())


def _surfaces(segment: Segment) -> tuple[Surface, ...]:
    """List the surfaces of a segment in the order of the file."""
    return segment.road, segment.left, segment.right, segment.left_wall, segment.right_wall


def write_track_file(track: Track, path: str | Path, comment: str = "") -> None:
    """
    Write a compact track file.

    :param track: to write
    :param path: of the file
    :param comment: for the top of the file, e.g. where the figures come from
    :raises TrackFileError: if two surfaces have one name
    :raises OutputNotWritable: if the file cannot be written; the previous one is kept
    """
    surfaces = surfaces_of(track)
    text = io.StringIO()
    text.writelines(f"# {line}".rstrip() + "\n" for line in comment.splitlines())
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(MAGIC)
    rows.writerow(["name", track.name])
    rows.writerow(["category", track.category])
    rows.writerow(["start", track.start_x, track.start_y, track.start_heading])
    rows.writerow(["grid", *track.grid])
    rows.writerows(["surface", *surface] for surface in surfaces)
    for segment in track.segments:
        names = [surface.name for surface in _surfaces(segment)]
        rows.writerow(["segment", *segment[:NUMBERS_PER_SEGMENT], *names])
    with atomic_file(Path(path), IN_A_FOLDER) as aside:
        aside.write_text(text.getvalue(), encoding="utf-8")
