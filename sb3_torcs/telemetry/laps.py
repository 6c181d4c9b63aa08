"""The laps of a drive, and samples of a lap at places that are the same for all laps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from sb3_torcs.car import FloatArray
from sb3_torcs.telemetry.drives import WHEELS
from sb3_torcs.tracks.track import Track

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["Drive", "Lap", "SampledLap", "drives_of", "grid_of", "sample"]

STEP = 1.0  # [m] between two samples of a lap
MOST_SAMPLES = 5000  # of a lap; longer tracks get longer steps
STANDING_SPEED = 5.0  # [m/s] of a car that has just set off from the grid, at most
ROLLING = 10.0  # [m/s] from which a wheel's radius can be measured
PEDAL_UP = 0.1  # [-] of a pedal's travel; below, a wheel rolls freely


@dataclass(frozen=True)
class Lap:
    """One whole lap of a drive."""

    number: int  # from 1
    time: float  # [s]
    rows: pd.DataFrame
    standing: bool  # whether it begins on the grid


@dataclass(frozen=True)
class Drive:
    """What one driver drove."""

    driver: str
    track: str
    car: str
    world: str
    laps: list[Lap]
    distance: float  # [m] the longest of the episodes

    def best(self, *, flying: bool) -> Lap | None:
        """
        Find the best lap.

        :param flying: whether laps from the grid are left out
        """
        laps = [lap for lap in self.laps if not (flying and lap.standing)]
        return min(laps, key=lambda lap: lap.time, default=None)


@dataclass(frozen=True)
class SampledLap:
    """A lap at places that are the same for all laps of a track."""

    lap: Lap
    time: FloatArray  # (n,) [s] since the lap began
    offset: FloatArray  # (n,) [m] from the axis, left positive
    channels: dict[str, FloatArray]  # (n,) each: speed, throttle, brake, steering, gear and more


def drives_of(frame: pd.DataFrame) -> list[Drive]:
    """
    Divide a table into drives.

    :param frame: as of :func:`~sb3_torcs.telemetry.read_drives`
    :return: one drive per driver, in the order of the table
    """
    groups = frame.groupby(["driver", "track", "car", "world"], sort=False, observed=True)
    return [
        Drive(driver, track, car, world, _laps(rows), float(rows["distance_raced"].max()))
        for (driver, track, car, world), rows in groups
    ]


def _laps(rows: pd.DataFrame) -> list[Lap]:
    """Cut the whole laps out of one driver's episodes."""
    laps = []
    for _, race in rows.groupby("episode", sort=True):
        parts = dict(iter(race.groupby("laps", sort=True)))
        for done, part in parts.items():
            if done + 1 in parts:  # whose first row says how long this lap took
                time = float(parts[done + 1]["last_lap_time"].iloc[0])
                driven = _from_the_line(part)
                standing = done == 0 and len(driven) == len(part) and not _is_flying(driven)
                laps.append(Lap(int(done) + 1, time, driven, standing))
    return laps


def _from_the_line(rows: pd.DataFrame) -> pd.DataFrame:
    """Leave out the way to the line, where the lap's clock begins anew, of a start elsewhere."""
    (begins,) = np.nonzero(np.diff(rows["lap_time"].to_numpy(float)) < 0.0)
    return rows.iloc[begins[-1] + 1 :] if begins.size else rows


def _is_flying(rows: pd.DataFrame) -> bool:
    """Tell whether a drive begins behind the line at speed; the grid lies before it."""
    place = rows["distance_from_start"]
    return bool(place.iloc[0] < 0.5 * place.max() and rows["speed_x"].iloc[0] > STANDING_SPEED)


def grid_of(track: Track) -> FloatArray:
    """
    Choose the places at which laps are sampled.

    :param track: of the laps
    :return: (n,) distances from the line [m], the first 0 and the last the track's length
    """
    steps = int(min(np.ceil(track.length / STEP), MOST_SAMPLES))
    return np.linspace(0.0, track.length, steps + 1)


def sample(lap: Lap, grid: FloatArray) -> SampledLap:
    """
    Interpolate a lap at the places of a grid.

    :param lap: of a drive
    :param grid: (n,) as of :func:`grid_of`
    """
    rows, length = lap.rows, grid[-1]
    column = {name: rows[name].to_numpy(float) for name in _NEEDED}
    distance = np.unwrap(column["distance_from_start"], period=length)
    distance -= length * np.floor(distance[-1] / length)
    distance = np.maximum.accumulate(distance)  # a car that slides back is not there again
    elapsed = column["lap_time"]
    before = 0.0 if distance[0] >= 0.0 else distance[0]  # the first lap begins behind the line
    time = np.interp(grid, [before, *distance, length], [0.0, *elapsed, lap.time])
    place = np.clip(np.searchsorted(distance, grid, side="right") - 1, 0, len(distance) - 1)
    values = {
        "speed": column["speed_x"],
        "throttle": column["throttle"],
        "brake": column["brake"],
        "steering": column["steering"],
        "position": 2.0 * column["distance_from_axis"] / column["track_width"],
        "slip": _slip(column),
    }
    channels = {name: np.interp(grid, distance, value) for name, value in values.items()}
    channels["gear"] = column["gear"][place]
    offset = np.interp(grid, distance, column["distance_from_axis"])
    return SampledLap(lap, time, offset, channels)


_SPINS = tuple(f"wheel_speed_{wheel}" for wheel in WHEELS)
_NEEDED = (
    "distance_from_start", "lap_time", "speed_x", "throttle", "brake", "steering", "gear",
    "distance_from_axis", "track_width", *_SPINS,
)  # fmt: skip


def _slip(column: dict[str, FloatArray]) -> FloatArray:
    """
    Compute the slip of the wheel that slips most: above 0 it spins, below it locks.

    A wheel's radius is its speed over its rotation, in the middle of the rows in which it rolls
    freely.

    :param column: (n,) each
    :return: (n,) [-] the tread's speed over the car's, minus 1
    """
    speed = np.maximum(column["speed_x"], 1.0)
    pedals = np.maximum(column["throttle"], column["brake"])
    rolls = (column["speed_x"] > ROLLING) & (pedals < PEDAL_UP)
    if not rolls.any():
        rolls = column["speed_x"] > ROLLING
    slips = []
    for name in _SPINS:
        spin = column[name]
        radii = speed[rolls] / np.maximum(spin[rolls], 1.0)
        radius = float(np.median(radii)) if radii.size else 0.0
        slips.append(radius * spin / speed - 1.0)
    stacked = np.array(slips)
    most = np.abs(stacked).argmax(axis=0)
    return stacked[most, np.arange(stacked.shape[1])]
