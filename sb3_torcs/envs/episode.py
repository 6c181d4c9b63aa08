"""The state of an episode, one record for each car.

A :class:`~sb3_torcs.envs.racing.RacingEnv` holds an array of one such record, and a
:class:`~sb3_torcs.envs.batch.Batch` an array of many. The rules that move an episode on are
compiled functions of such arrays: ``help_cars`` (driver aids), ``hold_controls`` (delay),
``end_episodes`` (ends), :class:`~sb3_torcs.rewards.Rewards`, :class:`~sb3_torcs.sensors.Eyes`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from sb3_torcs.car import (
    CAR_NUMBERS,
    CAR_RECORD,
    MAX_DELAY,
    RESTING,
    CarState,
    Controls,
    FloatArray,
    car_from_record,
)

__all__ = [
    "EPISODE",
    "RULES",
    "Episodes",
    "begin_episode",
    "car_of",
    "copy_of",
    "new_episodes",
    "numbers_of",
]

Episodes = npt.NDArray[np.void]
"""(n,) of :data:`EPISODE`."""

CONTROLS = np.dtype([(name, "f8") for name in Controls._fields])
"""A :class:`~sb3_torcs.car.Controls` as a record; a gear of nan leaves it to the gearbox."""

EPISODE = np.dtype(
    [
        ("car", CAR_RECORD),  # now
        ("controls", CONTROLS),  # asked for in the latest timestep, after aids have changed them
        ("delay", "f8"),  # [control ticks] by which controls arrive late
        ("waiting", "f8", (MAX_DELAY + 1, len(Controls._fields))),  # on their way, oldest first
        ("timesteps", "f8"),  # taken in the episode
        ("laps", "f8"),  # whole laps driven in it
        ("lap_time", "f8"),  # [s] of the lap that the latest timestep completed, else 0
        ("standing", "f8"),  # [control ticks] for which the car has made no headway
        ("patience", "f8"),  # [control ticks] for which it may
        ("race_end", "f8"),  # why the race ends the episode, an index in REASONS; 0 if not
        ("over", "f8"),  # why the episode is over, an index in REASONS; 0 goes on
    ]
)
"""The state of an episode. All of it is numbers in double precision."""

RULES = np.dtype(
    [
        ("laps", "f8"),  # after which an episode ends
        ("runoff", "f8"),  # [m] how far the car may be beside the road
        ("recovery", "f8"),  # [control ticks] without headway; 0 for none backwards
        ("ticks", "f8"),  # [control ticks] of a timestep
        ("unstick", "f8"),  # 1 if the car has this driver aid, and so on
        ("keep_distance", "f8"),
        ("keep_clear", "f8"),
        ("catch_slides", "f8"),
    ]
)
"""What stays the same all through an episode."""


def new_episodes(number: int) -> Episodes:
    """
    Make records of episodes that have not begun.

    :param number: of them
    """
    episodes = np.zeros(number, EPISODE)
    episodes["controls"] = RESTING
    return episodes


def numbers_of(records: Any) -> FloatArray:
    """
    Look at records as a matrix of the same numbers.

    :param records: (n,) contiguous, of :data:`EPISODE` or :data:`RULES`
    :return: (n, numbers of a record)
    """
    return records.view(np.float64).reshape(len(records), -1)


def copy_of(records: Any) -> Any:
    """
    Copy records; faster than numpy, which copies field by field.

    :param records: (n,) contiguous, of :data:`EPISODE` or :data:`RULES`
    """
    return records.view(np.float64).copy().view(records.dtype)


def begin_episode(episode: Any, car: CarState, delay: int, patience: int) -> None:
    """
    Begin an episode.

    :param episode: a record, changed
    :param car: before the first timestep
    :param delay: by which controls arrive late [control ticks]
    :param patience: for how long the car may stand [control ticks]
    """
    episode["car"] = car
    episode["controls"] = RESTING
    episode["waiting"] = np.array(RESTING, np.float64)  # whose gear is nan
    episode["delay"], episode["patience"] = delay, patience
    episode["laps"] = car.laps
    for name in ("timesteps", "lap_time", "standing", "race_end", "over"):
        episode[name] = 0.0


def car_of(episodes: Episodes, index: int = 0) -> CarState:
    """
    Read the car of an episode.

    :param episodes: (n,)
    :param index: of the episode
    :return: the car, a copy
    """
    return car_from_record(numbers_of(episodes)[index, :CAR_NUMBERS])
