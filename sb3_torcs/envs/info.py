"""The contents of ``info``."""

from __future__ import annotations

from typing import Any, TypedDict

from sb3_torcs.car import CarState

__all__ = ["RacingInfo", "racing_info"]


class RacingInfo(TypedDict):
    """The contents of ``info``, in every timestep. Values that do not exist yet are 0 or empty."""

    laps: int  # whole laps driven in this episode
    lap_time: float  # [s] of the lap that this timestep has completed, else 0
    best_lap_time: float  # [s] of the best whole lap, 0 before there is one
    distance: float  # [m] along the road since the episode began
    off_track: bool
    damage: float  # [points]
    reward_terms: dict[str, float]  # they sum to the reward exactly
    car: CarState  # everything else
    end: str  # why the episode ended; empty if the time limit truncated it


def racing_info(
    car: CarState, lap_time: float, terms: dict[str, float], end: str | None = None
) -> dict[str, Any]:
    """
    Make the ``info`` of a timestep.

    :param car: at the end of the timestep
    :param lap_time: of the lap that the timestep has completed, else 0 [s]
    :param terms: of the reward
    :param end: why the episode ended, or ``None``
    """
    info: RacingInfo = {
        "laps": car.laps,
        "lap_time": lap_time,
        "best_lap_time": car.best_lap_time,
        "distance": car.distance_raced,
        "off_track": car.off_track,
        "damage": car.damage,
        "reward_terms": terms,
        "car": car,
        "end": end or "",
    }
    return info  # type: ignore[return-value]  # Gymnasium says dict, and it is one
