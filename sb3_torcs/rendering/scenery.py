"""A track as coloured strips of ground, made once and drawn from above many times."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from sb3_torcs.car import FloatArray
from sb3_torcs.rendering.highway import to_highway
from sb3_torcs.tracks.track import Segment, Surface, Track

__all__ = ["GRASS_FAR", "WALL", "WHITE", "Chunk", "Colour", "Scenery"]

Colour = tuple[int, int, int]

GRASS_FAR: Colour = (48, 84, 44)  # behind the walls
GRASS: Colour = (84, 132, 66)
ROAD: Colour = (78, 80, 86)
PAVED: Colour = (114, 115, 118)  # beside the road: lighter, so that the road stands out
WALL: Colour = (190, 188, 182)
WHITE: Colour = (240, 240, 240)
BLACK: Colour = (24, 24, 24)
COLOURS: dict[str, Colour] = {  # by a word in TORCS's name of a surface
    "grass": GRASS,
    "sand": (198, 176, 128),
    "gravel": (160, 150, 132),
    "dirt": (146, 112, 78),
    "mud": (112, 86, 62),
    "curb": (176, 78, 70),
    "concrete": (140, 140, 136),
    "asphalt": PAVED,
    "road": PAVED,
    "tar": PAVED,
}

STATION = 8.0  # [m] at most between two cross-sections
TURN = 0.06  # [rad] likewise
CHUNK_SECTIONS = 24  # cross-sections at most in a chunk, which is drawn or left out as a whole
CHUNK_TURN = 1.0  # [rad] a strip that turned back on itself would have holes
INNER = 0.95  # [-] of the radius: grounds inside a bend end before its centre
BAND = 6.0  # [m] length of the darker bands beside the road, and of the gaps between them
SHADE = 0.92  # [-] their brightness against the ground's
SQUARE = 0.9  # [m] of the chequered line at the start, two rows deep


class Chunk(NamedTuple):
    """A stretch of road with one colour for each ground."""

    points: FloatArray  # (n, 4, 2) [m] left wall, left edge, right edge, right wall
    road: Colour
    left: Colour
    right: Colour


class Scenery:
    """
    The drawn surfaces of a track, in highway-env's frame.

    :param track: any circuit
    """

    def __init__(self, track: Track) -> None:
        self.chunks = _chunks(track)
        self.bands = _bands(track)
        self._chunk_circles = _circles(self.chunks)
        self._band_circles = _circles(self.bands)
        self._start = to_highway(track.start_x, track.start_y)
        self.start_line = _start_line(track)

    def near(self, position: FloatArray, distance: float) -> tuple[list[Chunk], list[Chunk]]:
        """
        Select the surfaces that may be visible from a position.

        :param position: (2,) of the place [m]
        :param distance: range of sight [m]
        :return: chunks of road and its sides, and bands, which shade the sides only
        """
        return (
            _within(self.chunks, self._chunk_circles, position, distance),
            _within(self.bands, self._band_circles, position, distance),
        )

    def sees_start(self, position: FloatArray, distance: float) -> bool:
        """Whether the start line may be seen from a place; parameters as in :meth:`near`."""
        return math.dist(position, self._start) < distance


def _circles(chunks: list[Chunk]) -> FloatArray:
    """
    Draw a circle round each chunk.

    :param chunks: of the scenery
    :return: (n, 3) centre and radius [m]
    """
    circles = np.empty((len(chunks), 3))
    for circle, chunk in zip(circles, chunks, strict=True):
        centre = 0.5 * (chunk.points.min((0, 1)) + chunk.points.max((0, 1)))
        circle[:] = *centre, np.linalg.norm(chunk.points - centre, axis=-1).max()
    return circles


def _within(
    chunks: list[Chunk], circles: FloatArray, position: FloatArray, distance: float
) -> list[Chunk]:
    """Select the chunks whose circle is within a distance [m] of a position."""
    gaps = np.hypot(circles[:, 0] - position[0], circles[:, 1] - position[1]) - circles[:, 2]
    return [chunks[index] for index in np.flatnonzero(gaps < distance)]


def colour(surface: Surface, default: Colour) -> Colour:
    """
    Choose the colour of a ground.

    :param surface: the ground
    :param default: if its name tells nothing
    """
    return next((c for word, c in COLOURS.items() if word in surface.name.lower()), default)


def _colours(segment: Segment) -> tuple[Colour, Colour, Colour]:
    """Return the colours of a segment's road, left ground and right ground."""
    road = colour(segment.road, PAVED)
    return (
        ROAD if road == PAVED else road,
        colour(segment.left, GRASS),
        colour(segment.right, GRASS),
    )


def _cross_section(track: Track, index: int, along: float) -> list[tuple[float, float]]:
    """
    Cut a segment across.

    :param track: any circuit
    :param index: of the segment
    :param along: the axis from the segment's beginning [m]
    :return: (4, 2) left wall, left edge, right edge, right wall [m]
    """
    segment = track.segments[index]
    x, y, heading = track.pose_on(index, along, 0.0)
    sin, cos = math.sin(heading), math.cos(heading)
    return [(x - o * sin, -(y + o * cos)) for o in _offsets(segment, along / segment.length)]


def _offsets(segment: Segment, share: float) -> tuple[float, float, float, float]:
    """
    Give the lateral positions of left wall, left edge, right edge and right wall [m].

    :param segment: of the track
    :param share: how far along it, in [0, 1]
    """
    half, left, right = (
        begin + share * (end - begin)
        for begin, end in (
            (0.5 * segment.width_start, 0.5 * segment.width_end),
            (segment.left_start, segment.left_end),
            (segment.right_start, segment.right_end),
        )
    )
    inner = INNER / abs(segment.curvature) if segment.curvature else math.inf
    if segment.curvature > 0.0:
        return min(half + left, max(inner, half)), half, -half, -half - right
    return half + left, half, -half, -min(half + right, max(inner, half))


def _pieces(track: Track) -> Iterator[tuple[Chunk, float]]:
    """Cut segments into strips of at most CHUNK_SECTIONS, with the angle that each turns [rad]."""
    for index, s in enumerate(track.segments):
        parts = math.ceil(max(s.length / STATION, abs(s.curvature) * s.length / TURN, 1.0))
        sections = [_cross_section(track, index, s.length * i / parts) for i in range(parts + 1)]
        step = min(CHUNK_SECTIONS, math.floor(CHUNK_TURN / TURN))
        for begin in range(0, parts, step):
            points = np.array(sections[begin : begin + step + 1])
            turn = abs(s.curvature) * s.length * (len(points) - 1) / parts
            yield Chunk(points, *_colours(s)), turn


def _chunks(track: Track) -> list[Chunk]:
    """Join neighbouring strips of the same colours, as far as they stay short and open."""
    groups: list[list[Chunk]] = []
    sections, turned = 0, 0.0
    for piece, turn in _pieces(track):
        sections, turned = sections + len(piece.points), turned + turn
        if (
            groups
            and piece[1:] == groups[-1][0][1:]
            and sections <= CHUNK_SECTIONS
            and turned <= CHUNK_TURN
        ):
            groups[-1].append(piece)
        else:
            groups.append([piece])
            sections, turned = len(piece.points), turn
    return [
        Chunk(np.concatenate([piece.points for piece in group]), *group[0][1:]) for group in groups
    ]


def _bands(track: Track) -> list[Chunk]:
    """Shade the sides at even intervals, so that the picture shows the speed."""
    bands = []
    count = int(track.length / (2.0 * BAND))
    for number in range(count):
        begin = number * track.length / count
        places = [track.find(begin + 0.5 * BAND * i) for i in range(3)]
        first, *others = (_colours(track.segments[index]) for index, _ in places)
        if all(other == first for other in others):
            points = np.array([_cross_section(track, *place) for place in places])
            shaded = (tuple(int(SHADE * part) for part in ground) for ground in first)
            bands.append(Chunk(points, *shaded))  # type: ignore[arg-type]
    return bands


def _start_line(track: Track) -> list[tuple[Colour, FloatArray]]:
    """
    Lay a chequered line across the road.

    :param track: any circuit
    :return: colour and corners (4, 2) [m] of each square
    """
    half = 0.5 * track.width
    columns = max(round(track.width / SQUARE), 2)
    squares = []
    for row in range(2):
        for column in range(columns):
            right, left = (half - 2.0 * half * (column + i) / columns for i in (1, 0))
            corners = [
                to_highway(*track.pose((row + along) * SQUARE, offset)[:2])
                for along, offset in ((0, left), (1, left), (1, right), (0, right))
            ]
            squares.append(((WHITE, BLACK)[(row + column) % 2], np.array(corners)))
    return squares
