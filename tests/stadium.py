"""A small track to be drawn, and a car on it."""

from __future__ import annotations

import math

import numpy as np

from sb3_torcs.car import CarState, Controls
from sb3_torcs.tracks.track import Segment, Surface, Track

ANGLES = np.radians(np.linspace(-90.0, 90.0, 19))
COASTING = Controls(0.0, 0.0, 0.0)
ASPHALT, GRASS = Surface("asphalt", 1.0, 0.001, 0.5, 10.0), Surface("grass", 0.6, 0.01, 0.5, 10.0)


def segment(length, curvature, width_start=10.0, width_end=10.0):
    ground = (6.0, 6.0, 6.0, 6.0)
    surfaces = (ASPHALT, GRASS, GRASS, ASPHALT, ASPHALT)
    return Segment(length, curvature, width_start, width_end, *ground, *surfaces)


def stadium(curvature):
    """Two straights and two half circles; the first straight grows wider, the second narrower."""
    bend = math.pi / abs(curvature)
    segments = (
        segment(200.0, 0.0, 10.0, 12.0),
        segment(bend, curvature, 12.0, 12.0),
        segment(200.0, 0.0, 12.0, 10.0),
        segment(bend, curvature),
    )
    return Track("stadium", "road", segments, start_x=3.0, start_y=-7.0, start_heading=0.4)


def state(track, distance, offset=0.0, heading_error=0.0, speed=(30.0, 0.0)):
    place = track.pose(distance, offset)
    width = track.segments[track.find(distance)[0]].width_start
    motion = (place.heading - heading_error, 0.0, *speed, 0.0, 0.3)
    road = (heading_error, offset, width, distance % track.length, distance)
    timing = (0, 1.0, 0.0, 0.0, 1)
    arrays = (np.zeros(4), np.full(19, 50.0), np.full(36, 200.0))
    return CarState(1.0, place.x, place.y, *motion, *road, 700.0, 4, 90.0, 0.0, *timing, *arrays)
