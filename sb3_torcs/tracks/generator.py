"""Random circuits: a polygon around a point, its corners rounded by arcs.

The corners lie at increasing angles around a centre, so the polygon cannot cross itself; where
its distance from the centre falls and rises again, the road bends the other way. Rounding keeps
the road's direction continuous and the lap closed by construction. A road that comes too near to
itself, or has no room for a drivable bend, is drawn again.
"""

from __future__ import annotations

import math

import numpy as np

from sb3_torcs import maths
from sb3_torcs.car import FloatArray
from sb3_torcs.tracks.track import Grid, Segment, Surface, Track, closed, closing_gap

__all__ = ["plain_segment", "random_track"]

LENGTHS = (1500.0, 4000.0)  # [m] of a lap
WIDTHS = (10.0, 15.0)  # [m] of the road
VERGES = (2.0, 5.0)  # [m] of grass on each side
MIN_RADIUS = 15.0  # [m] leaves room inside for half the widest road and its verge
MAX_RADIUS = 400.0  # [m]
CORNERS = (8, 15)  # [-] of the polygon: from, up to but without
NEAREST_CORNER = 0.4  # [-] of the farthest corner's distance from the centre
CORNER_SHARE = 0.45  # [-] of an edge that one rounding may use; the rest stays straight
TIGHTEST_SHARE = 0.3  # [-] of the widest possible radius: bends look chosen, not squeezed
MIN_START_STRAIGHT = 100.0  # [m] the grid has to stand on a straight
START_SHARE = 0.4  # [-] of that straight lies before the start line
SPARE = 3.0  # [m] between the walls of two parts of the road, at least
SAMPLE = 5.0  # [m] between places whose distances are compared
ATTEMPTS = 1000  # [-] nearly every one succeeds: this is never reached by chance

# The figures of the surfaces of these names in TORCS 1.3.7, data/tracks/surfaces.xml.
ASPHALT = Surface("asphalt", 1.2, 0.001, 0.5, 10.0)
GRASS = Surface("grass", 0.4, 0.01, 0.5, 10.0)
BARRIER = Surface("barrier", 0.0, 0.001, 0.5, 10.0)


def random_track(rng: np.random.Generator) -> Track:
    """
    Draw a circuit that is closed, drivable and does not touch itself.

    :param rng: random generator; the same state gives the same track
    :return: the track
    """
    for _ in range(ATTEMPTS):
        width = float(rng.uniform(*WIDTHS))
        verge = float(rng.uniform(*VERGES))
        shape = _rounded(_polygon(rng), rng)
        if shape is None:
            continue
        segments = [plain_segment(length, curvature, width, verge) for length, curvature in shape]
        length = math.fsum(segment.length for segment in segments)
        if not LENGTHS[0] <= length <= LENGTHS[1]:
            continue
        gap = closing_gap(segments)
        if max(abs(gap.x), abs(gap.y)) > 1e-6 or not _apart(segments, width + 2.0 * verge + SPARE):
            continue
        first_bend = next(s.curvature for s in segments if s.curvature)
        return Track(
            "random",
            "road",
            closed(segments),
            "random",
            # As TORCS has it: on the side of the first bend, a third of the road from its edge.
            grid=Grid(10.0, math.copysign(width / 6.0, first_bend)),
        )
    raise RuntimeError(f"no drivable track in {ATTEMPTS} attempts; use another generator")


def _polygon(rng: np.random.Generator) -> FloatArray:
    """
    Draw the corners.

    :param rng: source of chance
    :return: x and y of the corners in order, (n, 2) [m]
    """
    n = int(rng.integers(*CORNERS))
    gaps = rng.uniform(0.5, 1.5, n)
    angles = math.tau * np.cumsum(gaps) / gaps.sum()
    radii = rng.uniform(NEAREST_CORNER, 1.0, n)
    stretch = rng.uniform(0.6, 1.0)
    corners = maths.directions(angles) * radii[:, None] * [1.0, stretch]
    if rng.random() < 0.5:
        corners = corners[::-1]
    perimeter = maths.lengths(np.roll(corners, -1, axis=0) - corners).sum()
    return np.asarray(corners * rng.uniform(*LENGTHS) / perimeter)


def _rounded(corners: FloatArray, rng: np.random.Generator) -> list[tuple[float, float]] | None:
    """
    Round the corners and begin the lap on the longest straight.

    :param corners: of the polygon, (n, 2) [m]
    :param rng: source of chance
    :return: lengths [m] and curvatures [1/m] from the start line on; nothing if it cannot be done
    """
    n = len(corners)
    edges = np.roll(corners, -1, axis=0) - corners
    before = np.roll(edges, 1, axis=0)
    ahead, aside = (
        (edges * before).sum(axis=1),
        before[:, 0] * edges[:, 1] - before[:, 1] * edges[:, 0],
    )
    turns = list(map(maths.atan2, aside.tolist(), ahead.tolist()))
    sides = maths.lengths(edges).tolist()
    radii, tangents = [], []
    for i, turn in enumerate(turns):
        room = CORNER_SHARE * min(sides[i - 1], sides[i])
        steepness = maths.tan(0.5 * abs(turn))
        widest = min(room / steepness, MAX_RADIUS)
        if widest < MIN_RADIUS:
            return None
        tightest = max(MIN_RADIUS, TIGHTEST_SHARE * widest)
        radii.append(float(rng.uniform(tightest, widest)))
        tangents.append(radii[-1] * steepness)
    straights = [sides[i] - tangents[i] - tangents[(i + 1) % n] for i in range(n)]
    first = max(range(n), key=straights.__getitem__)
    if straights[first] < MIN_START_STRAIGHT:
        return None
    shape = [((1.0 - START_SHARE) * straights[first], 0.0)]
    for i in range(first + 1, first + n + 1):
        turn, radius, straight = turns[i % n], radii[i % n], straights[i % n]
        shape.append((radius * abs(turn), math.copysign(1.0 / radius, turn)))
        shape.append((straight * (START_SHARE if i == first + n else 1.0), 0.0))
    return shape


def plain_segment(length: float, curvature: float, width: float, verge: float) -> Segment:
    """
    Lay asphalt and grass along a stretch of the axis.

    :param length: of the stretch [m]
    :param curvature: of the stretch [1/m]
    :param width: of the road [m]
    :param verge: width of the grass on each side [m]
    :return: the segment
    """
    return Segment(
        length, curvature, width, width, verge, verge, verge, verge,
        ASPHALT, GRASS, GRASS, BARRIER, BARRIER,
    )  # fmt: skip


def _apart(segments: list[Segment], clearance: float) -> bool:
    """
    Check that no part of the road comes too near to another.

    :param segments: of a closed lap
    :param clearance: smallest distance between two parts of the axis [m]
    :return: whether they keep it
    """
    track = Track("candidate", "road", tuple(segments))
    n = math.ceil(track.length / SAMPLE)
    step = track.length / n
    x, y = _axis(track, np.arange(n, dtype=np.float64) * step)
    twice_x, twice_y = np.concatenate([x, x]), np.concatenate([y, y])
    # Points close to each other along the road may be near; beyond half a turn they may not.
    for far in range(math.floor(0.5 * math.pi * clearance / step) + 1, n // 2 + 1):
        gaps_x, gaps_y = twice_x[far : far + n] - x, twice_y[far : far + n] - y
        if (gaps_x * gaps_x + gaps_y * gaps_y).min() < clearance * clearance:
            return False
    return True


def _axis(track: Track, places: FloatArray) -> tuple[FloatArray, FloatArray]:
    """
    Locate many places of the axis at once.

    :param track: to look at
    :param places: distances from the start line [m], (n,)
    :return: x and y [m], (n,) each
    """
    start, _, curvature, x, y, heading = track.table[:, :6].T
    index = np.searchsorted(start, places, side="right") - 1
    along = places - start[index]
    half_turn = 0.5 * curvature[index] * along
    bent = half_turn != 0.0
    chord = along.copy()
    chord[bent] *= maths.directions(half_turn[bent])[:, 1] / half_turn[bent]
    ahead = maths.directions(heading[index] + half_turn)
    return x[index] + chord * ahead[:, 0], y[index] + chord * ahead[:, 1]
