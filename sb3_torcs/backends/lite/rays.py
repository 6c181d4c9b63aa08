"""Range finders of the fallback world: exact ray casting against the road's edges.

An edge is a chain of straight lines and circular arcs; where a curve changes its width its edges
are no arcs, so they are divided into chords of at most half a metre. Unlike the SCR server's
finders, which take each segment's starting width, these see the road as it is drawn.
"""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from sb3_torcs import maths
from sb3_torcs.car import FloatArray
from sb3_torcs.tracks.track import Track

cos_sin = maths.compiled(maths.cos_sin)

__all__ = ["RANGE", "Edges", "cast", "road_edges"]

RANGE = 200.0  # [m] of an SCR range finder since 2010
CHORD = 0.5  # [m] longest chord standing for an edge that is neither straight nor round
WINDOW = 1.25 * RANGE  # [m] of road before and behind the car that is searched: an inner edge
# is shorter than the axis, so a beam of 200 m can reach further than 200 m along it

SLACK = 1e-9  # [m], [-] neighbouring shapes overlap by this much, so that no beam slips between

# Columns of an edge: for a line the end points; for an arc centre, radius, the unit vector to its
# middle, and the cosine of half its angle. RADIUS is 0 for a line.
AX, AY, BX, BY, RADIUS, COS_HALF = range(6)


class Edges(NamedTuple):
    """Both edges of a road, in the order of its segments."""

    shapes: FloatArray  # (n, 6)
    first: npt.NDArray[np.int64]  # (segments + 1,) index of each segment's first shape
    reach: npt.NDArray[np.int64]  # (segments, 2) how many segments back and on are in the window


def _line(a: tuple[float, float], b: tuple[float, float]) -> list[float]:
    return [a[0], a[1], b[0], b[1], 0.0, 0.0]


def _arc(track: Track, index: int, offset: float) -> list[float]:
    """One round edge: the axis' arc moved sideways by ``offset`` [m]."""
    length, curvature = track.segments[index][:2]
    x, y, heading = track.pose_on(index, 0.0)
    middle = heading + 0.5 * curvature * length
    side = math.copysign(1.0, curvature)
    cosine, sine = maths.cos_sin(heading)
    centre = (x - sine / curvature, y + cosine / curvature)
    along, across = maths.cos_sin(middle)
    return [
        *centre,
        side * across,
        -side * along,
        abs(1.0 / curvature - offset),
        maths.cos(0.5 * abs(curvature) * length),
    ]


def _edge(track: Track, index: int, side: int) -> list[list[float]]:
    """The shapes of one side of one segment, and the joint to the next where widths jump."""
    segment = track.segments[index]
    after = (index + 1) % len(track.segments)
    onward = 0.5 * side * track.segments[after].width_start
    begin, end = (0.5 * side * width for width in (segment.width_start, segment.width_end))
    tip = track.pose_on(index, segment.length, end)[:2]
    shapes = []
    if segment.curvature != 0.0 and begin == end and segment.curvature * begin < 1.0:
        shapes.append(_arc(track, index, begin))
    else:
        parts = 1 if segment.curvature == 0.0 else math.ceil(segment.length / CHORD)
        points = [
            track.pose_on(index, segment.length * i / parts, begin + (end - begin) * i / parts)[:2]
            for i in range(parts + 1)
        ]
        shapes.extend(_line(a, b) for a, b in itertools.pairwise(points))
    if end != onward:
        shapes.append(_line(tip, track.pose_on(after, 0.0, onward)[:2]))
    return shapes


def road_edges(track: Track) -> Edges:
    """
    Lay out the edges of a track for :func:`cast`.

    :param track: any closed track
    """
    shapes: list[list[float]] = []
    first = [0]
    for index in range(len(track.segments)):
        shapes += _edge(track, index, 1) + _edge(track, index, -1)
        first.append(len(shapes))
    return Edges(np.array(shapes), np.array(first), _reach([s.length for s in track.segments]))


def _reach(lengths: list[float]) -> npt.NDArray[np.int64]:
    """How many segments back and on must be searched from each, to see WINDOW metres."""
    n = len(lengths)
    reach = np.zeros((n, 2), dtype=np.int64)
    for index in range(n):
        for column, step in ((0, -1), (1, 1)):
            seen = 0.0
            while seen < WINDOW and reach[index].sum() < n - 1:
                reach[index, column] += 1
                seen += lengths[(index + step * int(reach[index, column])) % n]
    return reach


@njit(cache=True)
def _hit_line(shape: FloatArray, x: float, y: float, dx: float, dy: float) -> float:
    """Distance [m] along a unit ray to a line, or RANGE."""
    ex, ey = shape[BX] - shape[AX], shape[BY] - shape[AY]
    determinant = ex * dy - ey * dx
    if determinant == 0.0:
        return RANGE
    ax, ay = shape[AX] - x, shape[AY] - y
    along = (ex * ay - ey * ax) / determinant
    share = (dx * ay - dy * ax) / determinant
    return along if along >= 0.0 and -SLACK <= share <= 1.0 + SLACK else RANGE


@njit(cache=True)
def _hit_arc(shape: FloatArray, x: float, y: float, dx: float, dy: float) -> float:
    """Distance [m] along a unit ray to an arc, or RANGE."""
    cx, cy, radius = x - shape[AX], y - shape[AY], shape[RADIUS]
    nearest = -(cx * dx + cy * dy)
    square = radius * radius - (cx + nearest * dx) ** 2 - (cy + nearest * dy) ** 2
    if square < 0.0:
        return RANGE
    root = math.sqrt(square)
    for along in (nearest - root, nearest + root):
        if along >= 0.0:
            px, py = cx + along * dx, cy + along * dy
            if px * shape[BX] + py * shape[BY] >= radius * shape[COS_HALF] - SLACK:
                return along
    return RANGE


@njit(cache=True)
def cast(
    shapes: FloatArray,
    first: npt.NDArray[np.int64],
    reach: npt.NDArray[np.int64],
    segment: int,
    pose: tuple[float, float, float],
    angles: FloatArray,
    out: FloatArray,
) -> None:
    """
    Measure the distances to the road's edge.

    :param shapes: ``Edges.shapes``
    :param first: ``Edges.first``
    :param reach: ``Edges.reach``
    :param segment: index of the segment the car is on
    :param pose: x [m], y [m], yaw [rad] of the car
    :param angles: (n,) [rad] of the beams against the car's axis, left negative as in SCR
    :param out: (n,) [m] filled with distances in [0, RANGE]
    """
    x, y, yaw = pose
    n = reach.shape[0]
    rays = angles.shape[0]
    ahead = np.empty((rays, 2))
    for ray in range(rays):
        ahead[ray, 0], ahead[ray, 1] = cos_sin(yaw - angles[ray])
    out[:] = RANGE
    for step in range(-reach[segment, 0], reach[segment, 1] + 1):
        at = (segment + step) % n
        for index in range(first[at], first[at + 1]):
            shape = shapes[index]
            for ray in range(rays):
                if shape[RADIUS] == 0.0:
                    distance = _hit_line(shape, x, y, ahead[ray, 0], ahead[ray, 1])
                else:
                    distance = _hit_arc(shape, x, y, ahead[ray, 0], ahead[ray, 1])
                out[ray] = min(out[ray], distance)
