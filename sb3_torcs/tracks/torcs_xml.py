"""The track files of TORCS: XML, versions 3 and 4 of the format.

A track file is a tree of sections holding numbers and texts. The road is a list of segments:
``str`` has a length, ``lft`` and ``rgt`` have a radius, an arc and perhaps another radius at the
end. A segment inherits missing values of its sides from the segment before it. The rules
are those of the game's loader (``src/modules/track/track3.cpp`` and ``track4.cpp`` of TORCS
1.3.7); elevation, banking, cameras and graphics are not read: the world is a plane. A file that
that loader would read differently, or could not read at all, is refused.

Beside the road come a border (a kerb), a side (grass, sand, more asphalt) and the barrier. Border
and side become one strip of ground with the surface of the wider one, and the barrier stands at
its outer edge.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sb3_torcs.errors import TrackFileError
from sb3_torcs.torcs.installation import torcs_folders
from sb3_torcs.torcs.params import Keys, Section, read_params
from sb3_torcs.tracks.pits import check_pits
from sb3_torcs.tracks.track import Grid, Segment, Surface, Track

__all__ = ["read_track_xml"]

LEFT, RIGHT = "left", "right"
MAX_STEPS = 20_000  # [-] of the whole road; the longest of the game's tracks has 2,956
MAX_WIDTH = 1000.0  # [m] of road or ground; the game's tracks have 101
MAX_LENGTH = 100_000.0  # [m] of one segment; the game computes in single precision
LEAST = 1e-6  # [m] or [rad] of a length, a radius or an arc: less is lost in rounding
SAMPLES_PER_ARC = 36  # as TORCS does when it looks for the corner of its map


@dataclass
class _Verge:
    """The border, side and barrier on one side of the road; segments inherit them."""

    side: str
    end_width: float = 0.0  # [m] of the side
    material: str = "grass"
    border_width: float = 0.0  # [m]
    border_material: str = "grass"
    barrier_material: str = "barrier"


class _Strip(NamedTuple):
    """The ground beside one segment."""

    border: float  # [m]
    start: float  # [m] with the border
    end: float  # [m] with the border
    surface: Surface
    wall: Surface

    @property
    def is_linear(self) -> bool:
        """Whether its width changes linearly: the side beyond the border has no negative width."""
        return min(self.start, self.end) >= self.border

    def at(self, fraction: float) -> float:
        """
        Return the width of the strip [m].

        :param fraction: of the segment's length
        """
        return max(self.border, self.start + fraction * (self.end - self.start))


class _Builder:
    """Lays the road segment by segment."""

    def __init__(self, root: Section, version: int) -> None:
        self.root = root
        self.version = version
        self.main = root.child("Main Track")
        self.width = self.main.number("width", 15.0)
        if not 0.0 < self.width <= MAX_WIDTH:
            raise TrackFileError(
                f"{self.main.place}: the road's width is {self.width:g} m; it has to be above 0, "
                f"and {MAX_WIDTH:g} at most"
            )
        self.step_length = self.main.number("profil steps length", 0.0)
        self.material = self.main.texts.get("surface", "asphalt")
        self.verges = {side: _Verge(side) for side in (LEFT, RIGHT)}
        for verge in self.verges.values():
            verge.end_width = _side_width(self._of(self.main, verge, "side"), "width", 0.0)
            self._update(self.main, verge)
        self.segments: list[Segment] = []
        self.fine: list[Segment] = []
        """The same road in the steps of the game's loader."""
        self.names: list[str] = []
        """Of the segments that these steps are of."""
        self._surfaces: dict[str, Surface] = {}

    def _of(self, section: Section, verge: _Verge, part: str) -> Keys:
        """Find what a section says of a part of the verge."""
        if self.version >= 4:
            return Keys(section.child(f"{verge.side.title()} {part.title()}"), "")
        return Keys(section, f"{verge.side[0]}{part} ")

    def _update(self, section: Section, verge: _Verge) -> None:
        """
        Hand on what a section changes of the verge, but for the side's width.

        :param section: of the segment, or the one with the defaults
        :param verge: is changed
        """
        border = self._of(section, verge, "border")
        # Version 3 knows one barrier for the whole track.
        barrier = self._of(section if self.version >= 4 else self.main, verge, "barrier")
        verge.material = self._of(section, verge, "side").text("surface", verge.material)
        verge.border_width = _width(border, "width", verge.border_width)
        verge.border_material = border.text("surface", verge.border_material)
        verge.barrier_material = barrier.text("surface", verge.barrier_material)

    def _strip(self, section: Section, verge: _Verge) -> _Strip:
        """
        Work out the ground beside a segment.

        :param section: of the segment
        :param verge: is handed on to the next segment
        :return: the ground
        """
        self._update(section, verge)
        side = self._of(section, verge, "side")
        start = _side_width(side, "start width", verge.end_width)
        end = start if self.version < 4 else _side_width(side, "width", start)
        end = _side_width(side, "end width", end)
        verge.end_width = end
        border = verge.border_width
        wider = verge.material if start + end >= 2.0 * border else verge.border_material
        return _Strip(
            border,
            border + start,
            border + end,
            self.surface(wider),
            self.surface(verge.barrier_material),
        )

    def surface(self, name: str) -> Surface:
        """
        Look up a surface; one that is not defined has the game's defaults.

        :param name: of the surface
        :return: the surface
        """
        if name in self._surfaces:
            return self._surfaces[name]
        inside = () if self.version >= 4 else ("List",)
        section = self.root.child("Surfaces", *inside, name)
        surface = Surface(
            name,
            section.number("friction", 0.8),
            section.number("rolling resistance", 0.001),
            section.number("rebound", 0.5 if self.version >= 4 else 1.0),
            section.number("dammage", 10.0),
        )
        if min(surface[1:]) < 0.0:
            raise TrackFileError(f"{section.place}: the surface '{name}' has a negative number")
        self._surfaces[name] = surface
        return surface

    def add(self, name: str, section: Section) -> None:
        """
        Add one segment of the file.

        :param name: of the segment
        :param section: of the segment
        """
        self.material = section.texts.get("surface", self.material)
        road = self.surface(self.material)
        left, right = (self._strip(section, verge) for verge in self.verges.values())
        bends = list(self._bends(section))
        fine = []
        for i, (length, curvature) in enumerate(bends):
            begin, end = i / len(bends), (i + 1) / len(bends)
            step = Segment(
                length=length,
                curvature=curvature,
                width_start=self.width,
                width_end=self.width,
                left_start=left.at(begin),
                left_end=left.at(end),
                right_start=right.at(begin),
                right_end=right.at(end),
                road=road,
                left=left.surface,
                right=right.surface,
                left_wall=left.wall,
                right_wall=right.wall,
            )
            fine.append(step)
        self.fine += fine
        self.names += [name] * len(fine)
        self.segments += _joined(fine) if left.is_linear and right.is_linear else fine

    def _bends(self, section: Section) -> Iterator[tuple[float, float]]:
        """
        Cut a segment into the steps of the game's loader.

        :param section: of the segment
        :return: lengths [m] and curvatures [1/m]
        """
        kind = section.texts["type"]
        if kind == "str":
            length = _positive(section, "lg")
            steps = self._steps(section, length)
            yield from [(length / steps, 0.0)] * steps
            return
        if kind not in ("lft", "rgt"):
            raise TrackFileError(
                f"{section.place}: unknown type '{kind}' of a segment; it is str, lft or rgt"
            )
        sign = 1.0 if kind == "lft" else -1.0
        radius, arc = _positive(section, "radius"), _positive(section, "arc")
        end_radius = _positive(section, "end radius") if "end radius" in section.names else radius
        length = 0.5 * (radius + end_radius) * arc
        steps = self._steps(section, length)
        if steps == 1 or end_radius == radius:
            yield from [(length / steps, sign / radius)] * steps
            return
        # A spiral is a row of arcs of equal length; that length makes them turn by the arc.
        change = (end_radius - radius) / (steps - 1)
        radii = [radius + step * change for step in range(steps)]
        step_length = arc / math.fsum(1.0 / r for r in radii)
        for r in radii:
            yield step_length, sign / r

    def _steps(self, section: Section, length: float) -> int:
        """
        Return the number of steps that the game's loader cuts a segment into.

        :param section: of the segment
        :param length: of the segment [m]
        """
        if length > MAX_LENGTH:
            raise TrackFileError(
                f"{section.place}: the segment is {length:g} m long, at most {MAX_LENGTH:g} m "
                "make sense"
            )
        if section.texts.get("profil", "spline") != "spline":
            return 1
        wanted = section.number("profil steps", 1.0)
        step_length = section.number("profil steps length", self.step_length)
        steps = int(wanted)
        if steps == 1 and step_length:
            steps = _quotient(length, step_length) + 1
        if steps < 1:
            raise TrackFileError(
                f"{section.place}: the segment is cut into {steps} steps, so that the game would "
                f"leave it out; 'profil steps' is {wanted:g}, at least 1 is allowed, and 'profil "
                f"steps length' is {step_length:g}, at least 0 is allowed"
            )
        if len(self.fine) + steps > MAX_STEPS:
            raise TrackFileError(
                f"{section.place}: the segment is cut into {steps} steps, at most {MAX_STEPS} of "
                "the whole road make sense; see 'profil steps' and 'profil steps length'"
            )
        return steps


def _quotient(length: float, step_length: float) -> int:
    """
    Divide in single precision, as the game does: else some roads have a step more or less.

    :param length: of a segment [m]
    :param step_length: of its steps [m]
    :return: their number, rounded towards 0; more than allowed if they are many
    """
    if length > MAX_STEPS * abs(step_length):
        return MAX_STEPS
    return int(np.float32(length) / np.float32(step_length))


def _width(keys: Keys, name: str, default: float, least: float = 0.0) -> float:
    """
    Read a width.

    :param keys: of a part beside the road
    :param name: after the prefix
    :param default: if it is not there [m]
    :param least: that is allowed [m]
    """
    width = keys.number(name, default)
    if not least <= width <= MAX_WIDTH:
        raise TrackFileError(
            f"{keys.section.place}: '{keys.prefix}{name}' is {width:g} m; {least:g} to "
            f"{MAX_WIDTH:g} is allowed"
        )
    return width


def _side_width(side: Keys, name: str, default: float) -> float:
    """Read the width of a side. The game takes a negative one, and lays no ground there."""
    return _width(side, name, default, -MAX_WIDTH)


def _positive(section: Section, name: str) -> float:
    """
    Read a number that has to be there and above 0.

    :param section: of a segment
    :param name: of the number
    :return: its value
    """
    value = section.number(name, 0.0)
    if value < LEAST:
        raise TrackFileError(
            f"{section.place}: the segment needs '{name}' above 0, it is {value:g}; at least "
            f"{LEAST:g} makes sense"
        )
    return value


def _joined(steps: list[Segment]) -> list[Segment]:
    """
    Join the steps of one segment again unless it is a spiral: they serve elevation only.

    :param steps: of one segment of the file
    :return: one segment, or the steps of a spiral
    """
    first, last = steps[0], steps[-1]
    if first.curvature != last.curvature:
        return steps
    return [
        first._replace(
            length=first.length * len(steps), left_end=last.left_end, right_end=last.right_end
        )
    ]


def _corner(segments: Sequence[Segment]) -> tuple[float, float]:
    """
    Find the lower left corner of the map, which TORCS makes the origin of its coordinates.

    The game's loader of version 3 mirrors the right side of right bends when it looks for the
    corner; of the tracks it ships, that moves the origin of dirt-4 only. It is not done here.

    :param segments: in the steps of the game's loader
    :return: x and y [m] with the beginning of the road's right edge as origin
    """
    from sb3_torcs import maths  # compiled: a long road has 100,000 samples

    curvatures = np.array([s.curvature for s in segments])
    samples = np.where(curvatures != 0.0, SAMPLES_PER_ARC, 1)
    lengths = np.array([s.length for s in segments])
    turns, chords = curvatures * lengths / samples, lengths / samples
    half = 0.5 * turns[curvatures != 0.0]
    chords[curvatures != 0.0] *= maths.directions(half)[:, 1] / half
    left, right = np.array([_reach(s) for s in segments]).T

    turns, chords, left, right = (
        np.repeat(row, samples) for row in (turns, chords, left, right)
    )  # now of each sample
    headings = np.cumsum([0.0, *turns])
    moved = chords[:, None] * maths.directions(headings[:-1] + 0.5 * turns)
    x, y = np.cumsum([(0.0, 0.5 * segments[0].width_start), *moved], axis=0)[1:].T
    cosines, sines = maths.directions(headings[1:]).T
    low_x = min(0.0, *((x - side * sines).min() for side in (left, right)))
    low_y = min(0.0, *((y + side * cosines).min() for side in (left, right)))
    return float(low_x), float(low_y)


def _reach(segment: Segment) -> tuple[float, float]:
    """How far the ground reaches from the axis to the left and, negative, to the right [m]."""
    left, right = segment.left_end, segment.right_end
    if segment.curvature:
        left, right = max(segment.left_start, left), max(segment.right_start, right)
    return 0.5 * segment.width_end + left, -0.5 * segment.width_end - right


def _grid(root: Section, segments: list[Segment], width: float) -> Grid:
    """
    Find where the race engine puts the only car of a practice session.

    The rules and defaults are those of ``initStartingGrid`` in the game's ``raceinit.cpp``: two
    places side by side, the first of them 10 m before the start line, on the side of the first
    bend unless the track says otherwise.

    :param root: the outermost section
    :param segments: of the track
    :param width: of the road [m]
    :return: the place
    """
    section = root.child("Starting Grid")
    first_bend = next((s.curvature for s in segments if s.curvature), -1.0)
    side = section.texts.get("pole position side", LEFT if first_bend > 0.0 else RIGHT)
    places = max(int(section.number("rows", 2.0)), 1)
    from_pole_edge = width / (places + 1)
    offset = 0.5 * width - from_pole_edge
    return Grid(section.number("distance to start", 10.0), offset if side == LEFT else -offset)


def read_track_xml(
    path: Path, folders: Sequence[Path] | None = None, *, located: bool = True
) -> Track:
    """
    Read a track file of TORCS.

    :param path: of the file
    :param folders: of TORCS's data, with the surfaces of all tracks; ``None`` looks for them
    :param located: whether to find where the game puts the road, which takes a third of the time;
        else the road begins at the origin
    :return: the track as the game lays it, its gap at the start line included
    :raises TrackFileError: naming file and line
    """
    root = read_params(path, torcs_folders() if folders is None else folders)
    header = root.child("Header")
    version = int(header.number("version", 0.0))
    if not 0 <= version <= 4:
        raise TrackFileError(f"{header.place}: version {version} of the format; known are 0 to 4")
    builder = _Builder(root, version)
    listed = builder.main.child("Track Segments" if version >= 4 else "segments")
    for name, section in listed.children.items():
        if "type" in section.texts:
            builder.add(name, section)
    if not builder.segments:
        raise TrackFileError(f"{listed.place}: there are no track segments")
    check_pits(builder.main, version, builder.names, builder.fine)
    low_x, low_y = _corner(builder.fine) if located else (0.0, 0.5 * builder.width)
    return Track(
        path.stem,
        header.texts.get("category", "road"),
        tuple(builder.segments),
        "torcs",
        start_x=-low_x,
        start_y=0.5 * builder.width - low_y,
        grid=_grid(root, builder.segments, builder.width),
        steps=tuple(builder.fine),
    )
