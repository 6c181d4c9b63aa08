"""Where episodes begin."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from sb3_torcs.car import MAX_START_SPEED, Start, StartName, is_number
from sb3_torcs.errors import InvalidOption
from sb3_torcs.rewards import safe_speed
from sb3_torcs.tracks.track import Track

__all__ = ["RESET_OPTIONS", "Starts", "read_start"]

RESET_OPTIONS = ("distance", "track_position", "heading_error", "speed")

# A random start: anywhere on the track, near the axis, roughly along it, at any moderate speed; but
# one in ten on the grid, since an agent that never stood still does not know how to set off.
RANDOM_GRID_SHARE = 0.1
RANDOM_TRACK_POSITION = 0.6  # [-]
RANDOM_HEADING_ERROR = 0.25  # [rad]
RANDOM_SPEED = 40.0  # [m/s] default

# A hard start: some way before a place where an episode ended badly, at a speed that can be lost.
REMEMBERED = 32  # [-] places per track
HARD_AHEAD = 20.0, 300.0  # [m] from the start to such a place


class Starts:
    """
    Draws where episodes begin.

    :param start: ``"grid"`` or ``"random"``
    """

    def __init__(self, start: StartName) -> None:
        self.start = start
        self.speed = RANDOM_SPEED  # [m/s] at most
        self.hard = 0.0  # share of random starts
        self.mishaps: dict[str, deque[float]] = {}  # [m] from the start line, per track

    def remember(self, track: Track, distance: float) -> None:
        """
        Take note of an episode that ended badly, unless its track was drawn and never comes again.

        :param track: where it was driven
        :param distance: of its end from the start line [m]
        """
        if track.source == "random":
            return
        self.mishaps.setdefault(_key(track), deque(maxlen=REMEMBERED)).append(distance)

    def set_mishaps(self, mishaps: Mapping[str, Sequence[float]]) -> None:
        """
        Replace what was remembered.

        :param mishaps: places of bad ends by the track's name or file [m from the start line]
        """
        self.mishaps = {track: deque(places, REMEMBERED) for track, places in mishaps.items()}

    def draw(self, rng: np.random.Generator, track: Track) -> Start | None:
        """
        Choose a start.

        :param rng: generator of the environment
        :param track: of the episode
        :return: ``None`` on the grid
        """
        if self.start == "grid" or rng.uniform() < RANDOM_GRID_SHARE:
            return None
        places = self.mishaps.get(_key(track))
        if places and self.hard > 0.0 and rng.uniform() < self.hard:
            ahead = rng.uniform(*HARD_AHEAD)
            where = _on_lap(places[int(rng.integers(len(places)))] - ahead, track.length)
            speed = min(self.speed, safe_speed(ahead))
        else:
            where, speed = rng.uniform(0.0, track.length), self.speed
        return Start(
            where,
            rng.uniform(-RANDOM_TRACK_POSITION, RANDOM_TRACK_POSITION),
            rng.uniform(-RANDOM_HEADING_ERROR, RANDOM_HEADING_ERROR),
            rng.uniform(0.0, speed),
        )


def _key(track: Track) -> str:
    """Tell tracks apart: files may have any name."""
    return track.name if track.source != "file" or track.file is None else str(track.file)


def _on_lap(distance: float, length: float) -> float:
    """Find the place on a lap, from 0 to less than the length: tiny negative ones are rounded."""
    place = distance % length
    return place if place < length else 0.0


def read_start(options: Any, length: float) -> Start:
    """
    Read the options of ``reset``.

    :param options: where the episode begins; what is left out is 0
    :param length: of the track [m]
    :raises InvalidOption: if no car can start so
    """
    if not isinstance(options, Mapping):
        raise InvalidOption(
            f"options of reset is {options!r}; expected a dict, e.g. {{'distance': 100.0}}"
        )
    for name, value in options.items():
        if name not in RESET_OPTIONS:
            raise InvalidOption(
                f"unknown reset option {name!r}; allowed: {', '.join(RESET_OPTIONS)}"
            )
        if not is_number(value):
            raise InvalidOption(f"reset option {name} is {value!r}; expected a number")
    values = {name: float(options.get(name, 0.0)) for name in RESET_OPTIONS}
    if abs(values["track_position"]) > 1.0:
        raise InvalidOption(
            f"track_position is {values['track_position']:g}; expected -1 (right edge) to 1"
        )
    if not 0.0 <= values["speed"] <= MAX_START_SPEED:
        raise InvalidOption(f"speed is {values['speed']:g} m/s; expected 0 to {MAX_START_SPEED:g}")
    if abs(values["heading_error"]) > math.pi:
        raise InvalidOption(f"heading_error is {values['heading_error']:g} rad; expected -pi to pi")
    return Start(
        _on_lap(values["distance"], length),
        values["track_position"],
        values["heading_error"],
        values["speed"],
    )
