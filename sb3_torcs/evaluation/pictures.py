"""The best lap of an evaluation, as a video from above and as a line on the map."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from sb3_torcs.car import FloatArray
from sb3_torcs.telemetry.drives import COLUMNS, DriveLog, car_of, controls_of
from sb3_torcs.tracks.track import Track

__all__ = ["BestLap", "best_lap", "draw_line", "save_video"]

VIDEO_TICKS = 2  # control ticks per frame: 25 frames per second, in real time
VIDEO_FPS = 25
COLUMN = {name: number for number, name in enumerate(COLUMNS)}


class BestLap(NamedTuple):
    """The fastest whole lap, or the longest drive if there is none."""

    rows: FloatArray  # (control ticks, columns)
    track: Track
    time: float | None  # [s] of the lap; ``None`` if there is no whole one

    @property
    def distance(self) -> float:
        """How far the car was at its end [m]."""
        return float(self.rows[-1, COLUMN["distance_raced"]])


def best_lap(log: DriveLog) -> BestLap:
    """
    Find the fastest whole lap, or the longest drive if there is none.

    :param log: of a drive in an environment, with a row at least
    """
    best: BestLap | None = None
    farthest: BestLap | None = None
    for label, rows in log.episodes().items():
        track, laps = log.tracks[label], rows[:, COLUMN["laps"]]
        whole = BestLap(rows, track, None)
        if farthest is None or whole.distance > farthest.distance:
            farthest = whole
        for (end,) in np.argwhere(np.diff(laps) > 0.0):
            time = float(rows[end + 1, COLUMN["last_lap_time"]])
            if best is None or best.time is None or time < best.time:
                best = BestLap(rows[laps == laps[end]], track, time)
    found = best or farthest
    assert found is not None, "an evaluation drives one timestep at least"
    return found


def draw_line(lap: BestLap, path: Path) -> None:
    """
    Draw the line of a lap, coloured by speed.

    :param lap: of :func:`best_lap`
    :param path: of the picture
    """
    from sb3_torcs.tracks.plot import plot_track

    line = lap.rows[:, [COLUMN["x"], COLUMN["y"]]]
    plot_track(lap.track, path, line=line, speed=lap.rows[:, COLUMN["speed_x"]])


def save_video(lap: BestLap, path: Path, range_finder_angles: FloatArray | None) -> None:
    """
    Record a lap from above, in real time.

    :param lap: of :func:`best_lap`
    :param path: of the video
    :param range_finder_angles: (19,) [rad]; ``None`` draws no beams
    """
    from sb3_torcs.rendering.encoder import write_video
    from sb3_torcs.rendering.viewer import Viewer

    rows = lap.rows[VIDEO_TICKS - 1 :: VIDEO_TICKS]

    def frames(viewer: Any) -> Iterator[npt.NDArray[np.uint8]]:
        for row in rows:
            yield viewer.frame(lap.track, car_of(row), controls_of(row), range_finder_angles)

    with contextlib.closing(Viewer()) as viewer:
        write_video(path, frames(viewer), VIDEO_FPS, total=len(rows))
