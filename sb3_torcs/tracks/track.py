"""A track of straights and arcs.

A :class:`Track` is a closed chain of segments of constant curvature in a plane: elevation and
banking are left to worlds that have them. It has geometry only; backends
drive on it.
"""

from __future__ import annotations

import functools
import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from sb3_torcs import maths
from sb3_torcs.car import FloatArray
from sb3_torcs.tracks.profile import RoadProfile, road_profile

__all__ = [
    "CURVATURE",
    "LENGTH",
    "START",
    "WIDTH_END",
    "WIDTH_START",
    "Grid",
    "Segment",
    "Surface",
    "Track",
    "TrackSummary",
    "closed",
    "closing_gap",
]

# Columns of Track.table, one row per segment: plain integers, so that compiled code can use them.
START = 0  # [m] along the axis from the start line to the segment's beginning
LENGTH = 1  # [m]
CURVATURE = 2  # [1/m] left positive
X = 3  # [m] of the axis at the segment's beginning
Y = 4  # [m]
HEADING = 5  # [rad] of the axis at the segment's beginning; not wrapped
WIDTH_START = 6  # [m]
WIDTH_END = 7  # [m]
LEFT_START = 8  # [m]
LEFT_END = 9  # [m]
RIGHT_START = 10  # [m]
RIGHT_END = 11  # [m]
ROAD_FRICTION = 12  # [-]
ROAD_ROLLING_RESISTANCE = 13  # [-]
LEFT_FRICTION = 14  # [-]
LEFT_ROLLING_RESISTANCE = 15  # [-]
RIGHT_FRICTION = 16  # [-]
RIGHT_ROLLING_RESISTANCE = 17  # [-]
LEFT_WALL_FRICTION = 18  # [-]
LEFT_WALL_REBOUND = 19  # [-]
LEFT_WALL_DAMAGE = 20  # [-]
RIGHT_WALL_FRICTION = 21  # [-]
RIGHT_WALL_REBOUND = 22  # [-]
RIGHT_WALL_DAMAGE = 23  # [-]
COLUMNS = 24

CLOSED_WITHIN = 1e-9  # [m] and [rad] what counts as no gap at the start line
NO_PIVOT = 1e-12  # [-] of the largest: what is no more than rounding
MAX_GAP = 0.005  # [-] of the length: a chain that misses its start by more is no circuit


class Surface(NamedTuple):
    """The effect of a ground on tyres, and of a wall on a car."""

    name: str
    friction: float  # [-] factor on the tyre's own coefficient of friction
    rolling_resistance: float  # [-] resisting force per load
    rebound: float  # [-] share of the normal speed given back by a wall
    damage: float  # [-] factor on the damage of an impact


class Segment(NamedTuple):
    """A stretch of road of constant curvature."""

    length: float  # [m] along the axis
    curvature: float  # [1/m] of the axis, left positive, 0 on a straight
    width_start: float  # [m] of the road
    width_end: float  # [m]
    left_start: float  # [m] of ground between the road's left edge and the wall
    left_end: float  # [m]
    right_start: float  # [m]
    right_end: float  # [m]
    road: Surface
    left: Surface
    right: Surface
    left_wall: Surface
    right_wall: Surface

    def width_at(self, share: float) -> float:
        """
        Compute the width of the road.

        :param share: of the segment's length, 0 to 1
        :return: [m]
        """
        return self.width_start + share * (self.width_end - self.width_start)


class Grid(NamedTuple):
    """The first grid slot."""

    distance: float  # [m] along the axis before the start line
    offset: float  # [m] from the axis, left positive


class Pose(NamedTuple):
    """A position and a direction in the track's plane."""

    x: float  # [m]
    y: float  # [m]
    heading: float  # [rad] not wrapped: it counts the turns of the road


class TrackSummary(NamedTuple):
    """One line of the list of tracks."""

    name: str
    category: str
    length_m: float
    width_m: float
    tightest_radius_m: float
    source: str


@dataclass(frozen=True, eq=False)
class Track:
    """
    A circuit; two tracks are equal only if they are the same object.

    :param name: as one types it, e.g. ``"aalborg"``
    :param category: ``"road"``, ``"oval"`` or ``"dirt"``
    :param segments: from the start line on, in the direction of driving
    :param source: where it came from
    :param start_x: of the axis at the start line [m]
    :param start_y: of the axis at the start line [m]
    :param start_heading: of the axis at the start line [rad]
    :param grid: the first grid slot
    :param steps: the same road as the game's loader lays it, step by step and with its gap at the
        start line; empty for what is no file of the game
    :param file: that it was read from, if any; absolute, links followed
    """

    name: str
    category: str
    segments: tuple[Segment, ...] = field(repr=False)
    source: Literal["bundled", "torcs", "file", "random"] = "file"
    start_x: float = 0.0
    start_y: float = 0.0
    start_heading: float = 0.0
    grid: Grid = field(default=Grid(distance=10.0, offset=0.0))
    steps: tuple[Segment, ...] = field(default=(), repr=False)
    file: Path | None = field(default=None, repr=False)

    @functools.cached_property
    def length(self) -> float:
        """Length of a lap along the axis [m]."""
        return math.fsum(segment.length for segment in self.segments)

    @property
    def width(self) -> float:
        """Width of the road at the start line [m]."""
        return self.segments[0].width_start

    @functools.cached_property
    def tightest_radius(self) -> float:
        """Radius of the axis in the tightest bend [m]."""
        sharpest = max(abs(s.curvature) for s in self.segments)
        return 1.0 / sharpest if sharpest else math.inf

    @functools.cached_property
    def table(self) -> FloatArray:
        """All segments as numbers, (n_segments, COLUMNS), read-only; for compiled code."""
        table = np.empty((len(self.segments), COLUMNS))
        start = 0.0
        begin = Pose(self.start_x, self.start_y, self.start_heading)
        poses = _chain(self.segments, begin)
        for row, s, pose in zip(table, self.segments, poses, strict=False):
            row[:LENGTH] = start
            row[LENGTH:X] = s.length, s.curvature
            row[X:WIDTH_START] = pose
            row[WIDTH_START:ROAD_FRICTION] = s[2:8]
            row[ROAD_FRICTION:LEFT_WALL_FRICTION] = [
                value
                for ground in (s.road, s.left, s.right)
                for value in (ground.friction, ground.rolling_resistance)
            ]
            row[LEFT_WALL_FRICTION:] = [
                value
                for wall in (s.left_wall, s.right_wall)
                for value in (wall.friction, wall.rebound, wall.damage)
            ]
            start += s.length
        table.setflags(write=False)
        return table

    @functools.cached_property
    def profile(self) -> RoadProfile:
        """The road ahead of any place. The track is a plane, so its slope and banking are 0."""
        table = self.table
        widths = 0.5 * (table[:, WIDTH_START] + table[:, WIDTH_END])
        flat = np.zeros(len(table))
        return road_profile(
            table[:, LENGTH], table[:, CURVATURE], widths, flat, table[:, ROAD_FRICTION], flat
        )

    @functools.cached_property
    def _starts(self) -> list[float]:
        """Where the segments begin [m]; a list, since one number is found in it faster."""
        starts: list[float] = self.table[:, START].tolist()
        return starts

    def find(self, distance: float) -> tuple[int, float]:
        """
        Find the segment at a place.

        :param distance: along the axis from the start line [m]; any number, it wraps
        :return: index of the segment, and how far along it the place is [m]
        """
        distance %= self.length
        index = bisect_right(self._starts, distance) - 1
        return index, distance - self._starts[index]

    def pose(self, distance: float, offset: float = 0.0) -> Pose:
        """
        Place and direction on the road.

        :param distance: along the axis from the start line [m]; any number, it wraps
        :param offset: from the axis, left positive [m]
        :return: x [m], y [m] and the axis' heading there [rad]
        """
        return self.pose_on(*self.find(distance), offset)

    def pose_on(self, index: int, along: float, offset: float = 0.0) -> Pose:
        """
        Place and direction on a segment.

        :param index: of the segment
        :param along: the axis from the segment's beginning [m]
        :param offset: from the axis, left positive [m]
        :return: x [m], y [m] and the axis' heading there [rad]
        """
        curvature, *begin = self.table[index, CURVATURE:WIDTH_START].tolist()
        x, y, heading = _advance(Pose(*begin), along, curvature)
        cosine, sine = maths.cos_sin(heading)
        return Pose(x - offset * sine, y + offset * cosine, heading)

    def summary(self) -> TrackSummary:
        """Return the figures that a list of tracks shows."""
        return TrackSummary(
            self.name, self.category, self.length, self.width, self.tightest_radius, self.source
        )


def _advance(pose: Pose, length: float, curvature: float) -> Pose:
    """
    Follow an arc. The chord form has no special case for nearly straight arcs.

    :param pose: at the arc's beginning
    :param length: to follow [m]
    :param curvature: of the arc [1/m], left positive
    :return: the pose there
    """
    half_turn = 0.5 * curvature * length
    chord = length * (maths.sin(half_turn) / half_turn if half_turn else 1.0)
    direction = pose.heading + half_turn
    cosine, sine = maths.cos_sin(direction)
    return Pose(pose.x + chord * cosine, pose.y + chord * sine, direction + half_turn)


def _chain(segments: Sequence[Segment], begin: Pose | None = None) -> FloatArray:
    """
    Follow all segments, as :func:`_advance` does one.

    :param segments: from the start line on
    :param begin: the pose there; the origin if left out
    :return: (n + 1, 3) the poses where they begin and where the last one ends
    """
    lengths = np.array([segment.length for segment in segments])
    half_turns = 0.5 * np.array([segment.curvature for segment in segments]) * lengths
    bent = half_turns != 0.0
    x, y, heading = begin or Pose(0.0, 0.0, 0.0)
    lengths[bent] *= maths.directions(half_turns[bent])[:, 1] / half_turns[bent]
    headings = np.cumsum([heading, *np.repeat(half_turns, 2)])
    chords = lengths[:, None] * maths.directions(headings[1::2])
    places = np.cumsum([(x, y), *chords], axis=0)
    return np.column_stack([places, headings[::2]])


def closing_gap(segments: Sequence[Segment]) -> Pose:
    """
    Measure by how much a chain of segments misses its own beginning.

    :param segments: from the start line on
    :return: x and y of the end seen from the start [m], and the turn missing or in excess of
        whole turns [rad]
    """
    x, y, heading = _chain(segments)[-1].tolist()
    return Pose(x, y, math.remainder(heading, math.tau))


def closed(segments: Sequence[Segment]) -> tuple[Segment, ...]:
    """
    Stretch and shrink segments by as little as it takes to make the end meet the start.

    TORCS lets its circuits end centimetres from where they began and jumps over the gap. A
    world with one frame for the whole lap needs them to meet. Curvatures, and with them the
    continuity of the road's direction, are untouched; of all changes of lengths that close the
    chain to 1e-9, the one with the smallest sum of (change)²/length is taken (Gauss-Newton). A
    chain that is closed already comes back as it is.

    :param segments: from the start line on
    :return: the segments, closed
    :raises ValueError: if the chain is far from being a circuit
    """
    gap = closing_gap(segments)
    length = math.fsum(segment.length for segment in segments)
    if math.hypot(gap.x, gap.y) > MAX_GAP * length or abs(gap.heading) > MAX_GAP * math.tau:
        raise ValueError(
            f"the end lies {math.hypot(gap.x, gap.y):.2f} m and {math.degrees(gap.heading):.2f} "
            f"degrees from the start; a circuit has to close within {100.0 * MAX_GAP} % of its "
            f"length ({length:.1f} m)"
        )
    for _ in range(20):
        if max(abs(value) for value in gap) <= CLOSED_WITHIN:
            return tuple(segments)
        segments = _closing_step(segments, gap)
        gap = closing_gap(segments)
    raise ValueError("no small change of the segments' lengths makes the end meet the start")


def _closing_step(segments: Sequence[Segment], gap: Pose) -> tuple[Segment, ...]:
    """
    Do one step of least change towards a closed chain.

    :param segments: from the start line on
    :param gap: of these segments
    :return: segments with other lengths
    """
    x, y, heading = _chain(segments)[1:].T
    lengths = np.array([segment.length for segment in segments])
    curvatures = np.array([segment.curvature for segment in segments])
    cosines, sines = maths.directions(heading).T
    # One metre more of a segment moves the rest along its end and turns it about its end.
    effect = np.stack([
        cosines - curvatures * (y[-1] - y), sines + curvatures * (x[-1] - x), curvatures
    ])  # fmt: skip
    weighted = effect * lengths
    sums = [[math.fsum(row * column) for column in effect] for row in weighted]
    shares = _solved(sums, [-value for value in gap])
    change = sum(share * row for share, row in zip(shares, weighted, strict=True))
    # No segment may shrink to nothing; what is left over is for the next step.
    change = np.maximum(change, -0.5 * lengths)
    return tuple(
        s._replace(length=float(s.length + d)) for s, d in zip(segments, change, strict=True)
    )


def _solved(matrix: list[list[float]], wanted: list[float]) -> list[float]:
    """
    Solve a symmetric system by elimination, in one order on every machine.

    :param matrix: (n, n) of no negative eigenvalue
    :param wanted: (n,)
    :return: (n,) 0 for what the rest decides already
    """
    left, found = list(range(len(wanted))), [0.0] * len(wanted)
    rows = [[*row, value] for row, value in zip(matrix, wanted, strict=True)]
    least = NO_PIVOT * max(rows[i][i] for i in left)
    order = []
    while left and rows[best := max(left, key=lambda i: rows[i][i])][best] > least:
        left.remove(best)
        order.append(best)
        for i in left:
            factor = rows[i][best] / rows[best][best]
            rows[i] = [a - factor * b for a, b in zip(rows[i], rows[best], strict=True)]
    for i in reversed(order):
        known = math.fsum(rows[i][j] * found[j] for j in range(len(found)) if j != i)
        found[i] = (rows[i][-1] - known) / rows[i][i]
    return found
