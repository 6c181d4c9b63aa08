"""The comparison of laps: where one driver is faster than another, and in which corner."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from sb3_torcs.actions import BRAKE_THRESHOLD
from sb3_torcs.car import FloatArray
from sb3_torcs.errors import DriveFileError
from sb3_torcs.telemetry.corners import Corner, corners_of, stretches
from sb3_torcs.telemetry.laps import Drive, Lap, SampledLap, grid_of, sample
from sb3_torcs.tracks.track import Track

__all__ = ["Comparison", "CornerPass", "DriverLap", "compare_drives"]

SECTORS = 3  # of one length each; the game's tracks have none
NEAR_THE_LINE = 20.0  # [m] within which a lap is seen, unless its rows lie farther apart


@dataclass(frozen=True)
class CornerPass:
    """How a driver takes a corner."""

    distance: float  # [m] from the line to the corner's beginning
    braking_point: float | None  # [m] from the line; None for a driver who does not brake
    entry_speed: float  # [m/s] at the corner's beginning
    apex_speed: float  # [m/s] the lowest in the corner
    exit_speed: float  # [m/s] at its end
    time_lost: float  # [s] against the first driver, on the corner's stretch of the lap


@dataclass(frozen=True)
class DriverLap:
    """A driver's lap beside those of the others."""

    drive: Drive
    sampled: SampledLap
    delta: FloatArray  # (n,) [s] behind the first driver
    corners: list[CornerPass]
    sectors: list[float]  # [s]

    @property
    def lap(self) -> Lap:
        """The lap that is compared."""
        return self.sampled.lap


@dataclass(frozen=True)
class Comparison:
    """Laps of several drivers on one track; the first is what the others are measured against."""

    track: Track
    distance: FloatArray  # (n,) [m] from the line
    corners: list[Corner]
    drivers: list[DriverLap]
    left_out: list[Drive]  # without a whole lap
    drives: list[Drive]  # all, in the order of naming

    def as_dict(self, html: str | None) -> dict[str, Any]:
        """
        Return the figures as the command prints them.

        :param html: path of the page
        """
        compared = {id(one.drive): one for one in self.drivers}
        drivers = [_figures(drive, compared.get(id(drive))) for drive in self.drives]
        return {"track": self.track.name, "html": html, "drivers": drivers}


def _figures(drive: Drive, own: DriverLap | None) -> dict[str, Any]:
    """Return the figures of a driver; of one without a whole lap there are none."""
    if own is None:
        return {"driver": drive.driver, "lap_time": None, "delta_at_end": None, "corners": []}
    return {
        "driver": drive.driver,
        "lap_time": own.lap.time,
        "delta_at_end": float(own.delta[-1]),
        "corners": [asdict(corner) for corner in own.corners],
    }


def compare_drives(drives: Sequence[Drive], track: Track) -> Comparison:
    """
    Lay the best laps of drivers on each other.

    They are flying laps, or if one of the drivers has none, the best of each from the grid or not.

    :param drives: on this track
    :param track: that they were driven on
    :raises DriveFileError: if no driver completed a lap, or a lap is of another road
    """
    able = [drive for drive in drives if drive.laps]
    if not able:
        far = ", ".join(f"{drive.driver} drove {drive.distance:.0f} m" for drive in drives)
        raise DriveFileError(
            f"no driver completed a lap of {track.name} ({track.length:.0f} m): {far}; choose "
            "another driver, e.g. inferno"
        )
    flying = all(drive.best(flying=True) for drive in able)
    grid = grid_of(track)
    laps = [(drive, lap) for drive in able if (lap := drive.best(flying=flying))]
    for drive, lap in laps:
        _check_road(drive, lap, track)
    sampled = [sample(lap, grid) for _, lap in laps]
    corners = corners_of(track)
    first = sampled[0]
    drivers = [
        DriverLap(
            drive=drive,
            sampled=own,
            delta=own.time - first.time,
            corners=_passes(own, first, grid, corners),
            sectors=_sectors(own, grid),
        )
        for (drive, _), own in zip(laps, sampled, strict=True)
    ]
    left_out = [drive for drive in drives if not drive.laps]
    return Comparison(track, grid, corners, drivers, left_out, list(drives))


def _check_road(drive: Drive, lap: Lap, track: Track) -> None:
    """Refuse a lap of a road that only has the same name."""
    reached = float(lap.rows["distance_from_start"].max())
    longest = float(lap.rows["distance_raced"].diff().max())  # [m] between two rows
    if abs(reached - track.length) > max(NEAR_THE_LINE, longest):
        raise DriveFileError(
            f"{drive.driver} drove laps of {reached:.0f} m, but {track.name} has "
            f"{track.length:.0f} m: another road of that name; say which with --track FILE"
        )


def _passes(
    own: SampledLap, first: SampledLap, grid: FloatArray, corners: Sequence[Corner]
) -> list[CornerPass]:
    """Measure a driver in each corner."""
    speed, delta = own.channels["speed"], own.time - first.time
    borders = stretches(corners, float(grid[-1]))
    passes = []
    lost_before = 0.0
    for corner, (begin, end) in zip(corners, borders, strict=True):
        within = speed[(grid >= corner.begin) & (grid <= corner.end)].tolist()
        entry_speed, exit_speed = np.interp([corner.begin, corner.end], grid, speed).tolist()
        lost_so_far = float(np.interp(end, grid, delta))
        passes.append(
            CornerPass(
                distance=corner.begin,
                braking_point=_braking_point(own, grid, begin, corner),
                entry_speed=entry_speed,
                apex_speed=min(*within, entry_speed, exit_speed),
                exit_speed=exit_speed,
                time_lost=lost_so_far - lost_before,
            )
        )
        lost_before = lost_so_far
    return passes


def _braking_point(own: SampledLap, grid: FloatArray, begin: float, corner: Corner) -> float | None:
    """
    Find where a driver begins to brake for a corner.

    :param own: the lap
    :param grid: its places
    :param begin: of the corner's stretch [m]
    :param corner: the corner
    :return: the first place on the brake up to the slowest one of the corner [m]
    """
    inside = (grid >= corner.begin) & (grid <= corner.end)
    speed = own.channels["speed"][inside]
    slowest = grid[inside][speed.argmin()] if len(speed) else corner.begin  # between two places
    before = (grid >= begin) & (grid <= slowest)
    braking = grid[before & (own.channels["brake"] > BRAKE_THRESHOLD)]
    return float(braking[0]) if braking.size else None


def _sectors(own: SampledLap, grid: FloatArray) -> list[float]:
    """Return the times of a lap's sectors [s]."""
    ends = np.linspace(0.0, grid[-1], SECTORS + 1)[1:]
    times = np.interp(ends, grid, own.time)
    return [float(time) for time in np.diff(times, prepend=0.0)]
