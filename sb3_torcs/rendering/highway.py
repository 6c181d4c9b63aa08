"""A track and its car in the classes of highway-env: a road network, and a vehicle on it.

Importing this module loads highway-env, and with it pygame, matplotlib and pandas. Only
:mod:`sb3_torcs.rendering.viewer` needs it, and that is loaded by the first ``render()``.

The track's frame has y upwards, highway-env draws y downwards. So a point (x, y) of the track is
(x, -y) here and a heading h is -h: left stays left on the picture.
"""

from __future__ import annotations

import math
import os
from bisect import bisect_right
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from sb3_torcs.car import CAR_LENGTH, CAR_WIDTH, CarState, FloatArray
from sb3_torcs.tracks.track import Segment, Track


@contextmanager
def unchanged_environment() -> Iterator[None]:
    """Undo the changes of ``os.environ`` that are made within, by pygame and highway-env, too."""
    before = dict(os.environ)
    try:
        yield
    finally:
        for name in os.environ.keys() - before.keys():
            del os.environ[name]
        os.environ.update(before)


with unchanged_environment():
    os.environ["PYGAME_HIDE_SUPPORT_PROMPT"] = "1"  # its greeting would spoil the output of --json
    import pygame
    import pygame.gfxdraw
    from highway_env.road.graphics import WorldSurface
    from highway_env.road.lane import AbstractLane, CircularLane, LineType, StraightLane
    from highway_env.road.road import Road, RoadNetwork
    from highway_env.vehicle.graphics import VehicleGraphics
    from highway_env.vehicle.kinematics import Vehicle

__all__ = [
    "RaceCar",
    "Road",
    "RoadNetwork",
    "VehicleGraphics",
    "WorldSurface",
    "lane_index",
    "pygame",
    "road_network",
    "to_highway",
    "unchanged_environment",
]

LINES = (LineType.CONTINUOUS_LINE, LineType.CONTINUOUS_LINE)


def to_highway(x: float, y: float) -> FloatArray:
    """
    Turn a point of the track's frame into one of highway-env's.

    :param x: [m]
    :param y: [m]
    :return: (2,) [m]
    """
    return np.array([x, -y])


class _Tapering:
    """Gives a lane of highway-env a width that changes evenly along it."""

    width: float  # [m] at the beginning, as in highway-env
    length: float  # [m]

    def __init__(self, *args: Any, width_end: float, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.width_end = width_end  # [m]

    def width_at(self, longitudinal: float) -> float:
        """
        Return the width of the lane at a distance along it.

        :param longitudinal: along the lane [m]
        :return: the width [m]
        """
        share = min(max(longitudinal / self.length, 0.0), 1.0)
        return self.width + share * (self.width_end - self.width)

    def to_config(self) -> dict[str, Any]:
        """Describe the lane so that ``from_config`` makes it again."""
        config: dict[str, Any] = super().to_config()  # type: ignore[misc]
        config["config"]["width_end"] = self.width_end
        return config


class TaperingStraight(_Tapering, StraightLane):
    """A straight whose width changes along it."""


class TaperingArc(_Tapering, CircularLane):
    """An arc whose width changes along it."""


def _lane(segment: Segment, x: float, y: float, heading: float) -> AbstractLane:
    """
    Turn one segment into a lane.

    :param segment: of the track
    :param x: of the axis at the segment's beginning, in the track's frame [m]
    :param y: likewise [m]
    :param heading: of the axis there [rad]
    """
    start, heading = to_highway(x, y), -heading
    options: dict[str, Any] = {
        "width": segment.width_start,
        "width_end": segment.width_end,
        "line_types": LINES,
        "speed_limit": RaceCar.MAX_SPEED,
    }
    if segment.curvature == 0.0:
        direction = np.array([math.cos(heading), math.sin(heading)])
        return TaperingStraight(start, start + segment.length * direction, **options)
    radius = 1.0 / abs(segment.curvature)
    # "Clockwise" is as seen on the screen, where a right turn is.
    turn = -1.0 if segment.curvature > 0.0 else 1.0
    phase = heading - 0.5 * math.pi * turn
    centre = start - radius * np.array([math.cos(phase), math.sin(phase)])
    end_phase = phase + turn * segment.length / radius
    return TaperingArc(centre, radius, phase, end_phase, clockwise=turn > 0.0, **options)


def lane_index(segment: int, segments: int) -> tuple[str, str, int]:
    """
    Name the lane of a segment, as highway-env names lanes.

    :param segment: its index
    :param segments: how many the track has
    :return: node at the beginning, node at the end, and 0: the road is one lane wide
    """
    return str(segment), str((segment + 1) % segments), 0


def road_network(track: Track) -> RoadNetwork:
    """
    Lay out a track as a ring of lanes, one per segment.

    :param track: any circuit
    :return: a network for highway-env; lateral positions count to the right, as they do there
    """
    network = RoadNetwork()
    for index, segment in enumerate(track.segments):
        begin, end, _ = lane_index(index, len(track.segments))
        network.add_lane(begin, end, _lane(segment, *track.pose_on(index, 0.0)))
    return network


class RaceCar(Vehicle):
    """
    A vehicle of highway-env that is moved by a backend.

    :param road: highway-env's road; its network comes from :func:`road_network`
    :param track: the same track
    :param state: where the car is
    """

    LENGTH, WIDTH = CAR_LENGTH, CAR_WIDTH
    MAX_SPEED = 100.0  # [m/s]
    color = (214, 62, 44)

    def __init__(self, road: Road, track: Track, state: CarState) -> None:
        # Without a road the base class searches no lane; `pose` knows it.
        super().__init__(None, to_highway(state.x, state.y), -state.yaw, state.speed_x)
        self.road = road
        self._starts: list[float] = track.table[:, 0].tolist()  # [m] where each segment begins
        self.pose(state)

    def pose(self, state: CarState) -> None:
        """
        Move the car to the position of its state.

        :param state: as the backend returned it
        """
        self.position = to_highway(state.x, state.y)
        self.heading = -state.yaw
        self.speed = state.speed_x
        self._speed_y = state.speed_y
        self._distance = state.distance_from_start
        self.on_state_update()

    @property
    def velocity(self) -> FloatArray:
        """The velocity [m/s], sliding included."""
        cos, sin = math.cos(self.heading), math.sin(self.heading)
        left = self._speed_y
        return np.array([self.speed * cos + left * sin, self.speed * sin - left * cos])

    def step(self, dt: float) -> None:
        """
        Do nothing, since the backend moves the car.

        The base class would move it a second time, by highway-env's kinematic model.

        :param dt: not used [s]
        """

    def on_state_update(self) -> None:
        """Find the lane by the distance along the track; the base class compares all lanes."""
        segment = max(bisect_right(self._starts, self._distance) - 1, 0)
        self.lane_index = lane_index(segment, len(self._starts))
        self.lane = self.road.network.get_lane(self.lane_index)
