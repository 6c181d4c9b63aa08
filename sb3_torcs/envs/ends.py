"""Why an episode ends."""

from __future__ import annotations

import math

from numba import njit
from numba.extending import register_jitable

from sb3_torcs import maths
from sb3_torcs.car import KMH, MAX_DAMAGE, CarState
from sb3_torcs.envs.episode import Episodes

__all__ = [
    "FINISHED",
    "GRACE_TICKS",
    "LOST",
    "RACE_OVER",
    "REASONS",
    "STUCK_SPEED",
    "STUCK_TICKS",
    "TRUNCATING",
    "end_episodes",
    "end_of",
    "stands",
]

cos = maths.compiled(maths.cos)

STUCK_SPEED = 5.0 / KMH  # [m/s] along the road; slower than walking counts as standing
STUCK_TICKS = 75  # control ticks of standing that end an episode: 1.5 s
GRACE_TICKS = 150  # 3 s to get going after a standing start
BACKWARDS_ANGLE = 0.5 * math.pi  # [rad] to the road from which the car faces backwards

REASONS = ("", "laps", "off_track", "backwards", "damage", "stuck", "race", "lost")
"""Why an episode ends, by the number in its record; the first one goes on."""

FINISHED, OFF_TRACK, BACKWARDS, DAMAGE, STUCK, RACE_OVER, LOST = range(1, len(REASONS))

TRUNCATING = ("laps", "race")
"""The ends of an episode that are no fault of the driver's."""


@register_jitable
def end_of(car: CarState, laps: float, runoff: float, recovery: float) -> int:
    """Return why the state of a car ends its episode, 0 if it does not."""
    if car.laps >= laps:
        return FINISHED
    if abs(car.distance_from_axis) > 0.5 * car.track_width + runoff:
        return OFF_TRACK
    if recovery == 0 and abs(car.heading_error) > BACKWARDS_ANGLE:
        return BACKWARDS
    return DAMAGE if car.damage >= MAX_DAMAGE else 0


@register_jitable
def stands(car: CarState) -> bool:
    """Check whether a car is slower along the road than walking, or faces backwards."""
    along = cos(car.heading_error)
    return along < 0.0 or car.speed_x * along < STUCK_SPEED


@njit(cache=True)
def end_episodes(episodes: Episodes, rules: Episodes) -> None:
    """
    Find out whether a timestep ends episodes, and count it, its laps, and how long cars stand.

    :param episodes: (n,) of :data:`~sb3_torcs.envs.episode.EPISODE` at the end of a timestep; their
        ``over``, ``timesteps``, ``laps``, ``lap_time``, ``standing`` and ``patience`` change
    :param rules: (n,) of :data:`~sb3_torcs.envs.episode.RULES`
    """
    for row in range(len(episodes)):
        episode, rule = episodes[row], rules[row]
        car = episode.car
        episode.timesteps += 1.0
        episode.lap_time = car.last_lap_time if car.laps > episode.laps else 0.0
        episode.laps = car.laps
        over = end_of(car, rule.laps, rule.runoff, rule.recovery)
        if over == 0:
            if stands(car):
                episode.standing += rule.ticks
            else:
                episode.standing, episode.patience = 0.0, max(float(STUCK_TICKS), rule.recovery)
            if episode.standing > episode.patience:
                over = STUCK
        episode.over = over if over else episode.race_end
