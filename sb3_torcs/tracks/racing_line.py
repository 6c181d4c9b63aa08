"""The racing line: a path of little bend within a road, and how fast it may be driven.

The path is found by relaxation from coarse to fine: one place after the other is moved across the
road to where the bends about it are least (compare Heilmeier et al., "Minimum curvature trajectory
planning and control for an autonomous race car", 2020). What a move does to the distances between
places is left out; so a long bend, whose line could lie anywhere, is driven on its inside, which is
shorter and faster.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from sb3_torcs import maths
from sb3_torcs.car import FloatArray
from sb3_torcs.tracks.profile import RoadProfile
from sb3_torcs.tracks.track import Track
from sb3_torcs.tracks.view_ahead import FASTEST, place_at

__all__ = [
    "LINE_DISTANCES",
    "LINE_PLACES",
    "RacingLine",
    "driven",
    "look_along",
    "racing_line",
]

_atan2, _hypot = maths.compiled(maths.atan2), maths.compiled(maths.hypot)

LINE_DISTANCES = (
    0, 8, 16, 24, 33, 43, 54, 66, 80, 95, 112, 132, 155, 180, 208, 240, 275, 315, 355, 400,
)  # fmt: skip
"""[m] ahead of the car, at which the intervals of the view along the line meet."""
LINE_PLACES = len(LINE_DISTANCES) - 1

_AHEAD = np.array(LINE_DISTANCES, np.float64)

COARSEST = 32  # [-] places from one that is moved to the next, in the first relaxation
SPACING = 2.0  # [m] between places, about
SWEEPS = 200  # [-] over all places, of each relaxation
EDGE = 1.5  # [m] from the edge of the road to the middle of the car, at least

GRAVITY = 9.81  # [m/s²]
USUAL_FRICTION = 1.1  # [-] of asphalt
# What a careful driver dares in the default car on usual asphalt. The best agents and robots take
# bends 10 to 30 % faster.
TYRES = 1.4  # [-] force across per load
DOWNFORCE = 0.003  # [1/m] load of the air per mass and speed²
BRAKING = 12.0  # [m/s²]
LEAST = 1.0  # [m/s²] across that every road bears
HILLS = 20.0  # [m] before and after a place, over which the road's rise and fall are measured


class RacingLine(NamedTuple):
    """A path along a road, at places at equal distances along the road's axis."""

    table: FloatArray  # (n + 1, 5) see the columns
    step: float  # [m] along the axis from one place to the next


# Columns of its table.
OFFSET = 0  # [m] from the axis, left positive
TURN = 1  # [rad] of the line since the start line
SPEED = 2  # [m²/s²] the square of the speed at which the place can be driven
SLOWING = 3  # [m/s²] with which brakes slow down there
HALF_WIDTH = 4  # [m] of the road


@njit(cache=True)
def _relax(
    axis: FloatArray,
    normals: FloatArray,
    room: FloatArray,
    offsets: FloatArray,
    stride: int,
    sweeps: int,
) -> None:
    """
    Move the line's places across the road until the bends between them are least.

    The integral of the squared curvature is the sum of (second difference of places)² / distance³,
    whose distances count as constant in a move.

    :param axis: (n, 2) places on the road's axis [m]
    :param normals: (n, 2) to the left
    :param room: (n,) to both sides [m]
    :param offsets: (n,) of the line [m], changed at each ``stride``-th place
    :param stride: a divisor of n
    :param sweeps: over all of them
    """
    n = len(offsets)
    x, y = np.empty(5), np.empty(5)
    for _ in range(sweeps):
        for i in range(0, n, stride):
            for k in range(5):
                j = (i + (k - 2) * stride) % n
                x[k] = axis[j, 0] + offsets[j] * normals[j, 0]
                y[k] = axis[j, 1] + offsets[j] * normals[j, 1]
            slope = curve = 0.0
            for k in range(1, 4):
                across_x = x[k - 1] - 2.0 * x[k] + x[k + 1]
                across_y = y[k - 1] - 2.0 * y[k] + y[k + 1]
                along = 0.5 * _hypot(x[k + 1] - x[k - 1], y[k + 1] - y[k - 1])
                part = -2.0 if k == 2 else 1.0  # of this place in the second difference
                weight = part / max(along, 1e-3) ** 3
                slope += weight * (across_x * normals[i, 0] + across_y * normals[i, 1])
                curve += weight * part
            moved = offsets[i] - slope / curve
            offsets[i] = min(max(moved, -room[i]), room[i])


def _between(offsets: FloatArray, stride: int) -> None:
    """Put the places between those of a stride on straight lines across the road."""
    n = len(offsets)
    coarse = np.arange(0, n + stride, stride)
    known = np.append(offsets[::stride], offsets[0])
    offsets[:] = np.interp(np.arange(n), coarse, known)


class _Path(NamedTuple):
    """Where a racing line lies, and what decides how fast it may be driven."""

    offsets: FloatArray  # (n,) from the axis, left positive [m]
    turned: FloatArray  # (n,) since the start line [rad]
    lap: float  # [rad] that a whole lap turns
    half_widths: FloatArray  # (n,) of the road [m]
    curvature: FloatArray  # (n,) left positive [1/m]
    grip: FloatArray  # (n,) of the surface, against usual asphalt [-]
    banking: FloatArray  # (n,) by how much the road rises to the left [m/m]
    climb: FloatArray  # (n + 1,) since the start line [m]
    step: float  # [m] along the axis from one place to the next


@lru_cache(maxsize=512)
def racing_line(road: RoadProfile) -> RacingLine:
    """
    Find the racing line of a road, and how fast it may be driven.

    It takes some hundredths of a second, once per road.

    :param road: closed
    :return: the line
    """
    path = _path(road)
    speed, slowing = _limits(path)
    table = np.stack([path.offsets, path.turned, speed, slowing, path.half_widths], axis=1)
    table = np.vstack([table, table[0]])
    table[-1, TURN] += path.lap
    table.setflags(write=False)
    return RacingLine(table, path.step)


def _path(road: RoadProfile) -> _Path:
    """Find where the racing line of a closed road lies."""
    length = road.step * (len(road.sums) - 1)
    n = COARSEST * max(round(length / (SPACING * COARSEST)), 1)
    step = length / n
    places = np.linspace(0.0, length, n + 1)
    at = np.linspace(0.0, length, len(road.sums))
    turn, area, climb = (np.interp(places, at, column) for column in road.sums.T)
    friction, banking = (
        np.interp(places[:-1], at, column) for column in (road.frictions, road.bankings)
    )
    lap = 2.0 * math.pi * round(turn[-1] / (2.0 * math.pi))
    axis, heading = _closed(turn, lap, step)
    ahead = maths.directions(heading)
    normals = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1)
    widths = np.diff(area) / step
    half_widths = 0.5 * np.minimum(widths, np.roll(widths, 1))

    offsets = np.zeros(n)
    room = np.maximum(half_widths - EDGE, 0.0)
    stride = COARSEST
    while stride > 0:
        _relax(axis, normals, room, offsets, stride, SWEEPS)
        _between(offsets, stride)
        stride //= 2

    line = axis + offsets[:, None] * normals
    turned, curvature = _turn(line, heading[0], lap)
    grip = friction / USUAL_FRICTION
    return _Path(offsets, turned, lap, half_widths, curvature, grip, banking, climb, step)


def _closed(turn: FloatArray, lap: float, step: float) -> tuple[FloatArray, FloatArray]:
    """
    Lay a road's axis, with the gap at the start line shared out along the road.

    :param turn: (n + 1,) of the axis since the start line [rad]
    :param lap: its whole turns [rad]
    :param step: from one place to the next [m]
    :return: (n, 2) places [m], and (n,) headings there [rad]
    """
    share = np.linspace(0.0, 1.0, len(turn))
    heading = turn - (turn[-1] - lap) * share
    middle = 0.5 * (heading[:-1] + heading[1:])
    chain = np.cumsum(step * maths.directions(middle), axis=0)
    places = np.vstack([np.zeros(2), chain])
    return (places - places[-1] * share[:, None])[:-1], heading[:-1]


def _turn(line: FloatArray, heading: float, lap: float) -> tuple[FloatArray, FloatArray]:
    """
    Measure how a closed line turns.

    :param line: (n, 2) its places [m]
    :param heading: of the axis at the first of them [rad]
    :param lap: whole turns [rad]
    :return: (n,) the turn since the start line [rad], and (n,) the curvature [1/m]
    """
    chords = np.roll(line, -1, axis=0) - line
    after = np.unwrap([_atan2(y, x) for x, y in chords.tolist()])
    after += 2.0 * math.pi * round((heading - after[0]) / (2.0 * math.pi))
    before = np.append(after[-1] - lap, after[:-1])
    lengths = maths.lengths(chords)
    return 0.5 * (before + after), 2.0 * (after - before) / (lengths + np.roll(lengths, 1))


def _limits(path: _Path) -> tuple[FloatArray, FloatArray]:
    """
    Find how fast the places of a line can be driven.

    Tyres hold a car by a share of its load, which is less on a crest, more in a dip, and more with
    the air's downforce; and gravity holds it by the banking:
    v² · curvature = grip · tyres · (g + v² · (rounding + downforce)) + g · banking.

    :param path: of the line
    :return: (n,) squares of the speeds [m²/s²], and (n,) how fast brakes slow down [m/s²]
    """
    climb, step, curvature, banking = path.climb, path.step, path.curvature, path.banking
    level = (climb - climb[-1] * np.linspace(0.0, 1.0, len(climb)))[:-1]
    rounding = _rounding(level, HILLS, step)
    tyres = path.grip * TYRES
    held = GRAVITY * (tyres - np.sign(curvature) * banking)
    needed = np.abs(curvature) - tyres * (rounding + DOWNFORCE)
    speed = np.maximum(held, LEAST) / np.maximum(needed, LEAST / FASTEST**2)
    slowing = path.grip * BRAKING + GRAVITY * np.diff(climb) / step
    return np.minimum(speed, FASTEST**2), np.maximum(slowing, LEAST)


def _rounding(level: FloatArray, reach: float, step: float) -> FloatArray:
    """
    Measure how a closed road rounds up and down.

    :param level: (n,) of its places [m]
    :param reach: before and after a place [m]
    :param step: from one place to the next [m]
    :return: (n,) the change of its slope [1/m], negative on crests
    """
    n = max(round(reach / step), 1)
    apart = n * step
    return (np.roll(level, n) - 2.0 * level + np.roll(level, -n)) / (apart * apart)


def driven(track: Track) -> tuple[FloatArray, FloatArray]:
    """
    Lay the racing line of a track, and how fast it may be driven on the way to its bends.

    :param track: as a plane
    :return: (n, 2) places [m], and (n,) speeds there [m/s]
    """
    table, step = racing_line(track.profile)
    speed = table[:, SPEED].copy()
    for k in range(2 * len(table), 0, -1):  # two laps back, since the last bend slows the start
        before, i = (k - 1) % len(table), k % len(table)
        speed[before] = min(speed[before], speed[i] + 2.0 * table[before, SLOWING] * step)
    places = [track.pose(i * step, offset)[:2] for i, offset in enumerate(table[:, OFFSET])]
    return np.array(places), np.sqrt(speed)


@njit(cache=True)
def look_along(
    table: FloatArray,
    step: float,
    distance: float,
    track_position: float,
    speed: float,
    numbers: npt.NDArray[np.float64],
) -> None:
    """
    See the racing line from a car.

    :param table: of a :class:`RacingLine`
    :param step: of it [m]
    :param distance: of the car from the start line [m]
    :param track_position: of the car: 1 on the left edge of the road, -1 on the right one
    :param speed: of the car [m/s]
    :param numbers: (3, places) filled: how far to the left of the car the line lies where each
        interval begins [m], its mean curvature there [1/m], and by how much the car may be faster
        now in the light of it [m/s]
    """
    n = len(table) - 1
    offset = track_position * _at(table, step, distance, HALF_WIDTH)
    turned = _at(table, step, distance + _AHEAD[0], TURN)
    for i in range(numbers.shape[1]):
        here, there = distance + _AHEAD[i], distance + _AHEAD[i + 1]
        numbers[0, i] = _at(table, step, here, OFFSET) - offset
        before, turned = turned, _at(table, step, there, TURN)
        numbers[1, i] = (turned - before) / (there - here)
        least = FASTEST**2
        for k in range(math.floor(here / step), math.floor(there / step)):
            ahead = max(k * step - distance, 0.0)
            j = k % n
            least = min(least, table[j, SPEED] + 2.0 * table[j, SLOWING] * ahead)
        numbers[2, i] = math.sqrt(least) - speed


@njit(cache=True)
def _at(table: FloatArray, step: float, distance: float, column: int) -> float:
    """A column of the table, between two places; a turn goes on from lap to lap."""
    laps, index, share = place_at(table, step, distance)
    value = table[index, column] + share * (table[index + 1, column] - table[index, column])
    if column == TURN:
        value += laps * (table[len(table) - 1, TURN] - table[0, TURN])
    return float(value)
