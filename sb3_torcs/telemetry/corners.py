"""The corners of a track, found from its segments."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

from sb3_torcs.tracks.track import CURVATURE, LENGTH, START, Track

__all__ = ["Corner", "corners_of", "stretches"]

WIDEST = 300.0  # [m] of radius; a road that bends less counts as straight
SHORTEST_GAP = 20.0  # [m] of straight between two corners; less, and they are one
LEAST_TURN = math.radians(15.0)  # a corner turns more


class Corner(NamedTuple):
    """A stretch of road that turns to one side."""

    begin: float  # [m] from the line
    end: float  # [m]
    turn: float  # [rad] left positive
    radius: float  # [m] where it is tightest

    @property
    def left(self) -> bool:
        """Whether it turns to the left."""
        return self.turn > 0.0


def corners_of(track: Track) -> list[Corner]:
    """
    Find the corners of a track: neighbouring segments that turn to one side.

    :param track: any circuit
    :return: in the order of driving; one across the line is two
    """
    found: list[Corner] = []
    for row in track.table:
        begin, length, curvature = (float(row[column]) for column in (START, LENGTH, CURVATURE))
        if abs(curvature) < 1.0 / WIDEST:
            continue
        piece = Corner(begin, begin + length, curvature * length, 1.0 / abs(curvature))
        if found and found[-1].left == piece.left and begin - found[-1].end < SHORTEST_GAP:
            last = found.pop()
            radius = min(last.radius, piece.radius)
            piece = Corner(last.begin, piece.end, last.turn + piece.turn, radius)
        found.append(piece)
    return [corner for corner in found if abs(corner.turn) >= LEAST_TURN]


def stretches(corners: Sequence[Corner], length: float) -> list[tuple[float, float]]:
    """
    Divide a lap among its corners, in the middle between each two.

    :param corners: of the track
    :param length: of the track [m]
    :return: begin and end of each corner's stretch [m]; together they are the lap
    """
    middles = [0.5 * (one.end + other.begin) for one, other in itertools.pairwise(corners)]
    return list(itertools.pairwise([0.0, *middles, length])) if corners else []
