"""Speed of the game in a process of its own: over the SCR protocol, and of its pictures.

Measured by the wall clock, since two processes take turns.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable

import gymnasium as gym

from sb3_torcs.bench.drives import (
    REPEAT,
    TICKS_PER_TURN,
    TORCS,
    Figures,
    mean_reset_ms,
    scripted_actions,
)

__all__ = ["pictures", "resets", "ticks"]

RESETS = 30  # of each kind
SIZE = (640, 480)  # [pixels]
PICTURES = 60


def ticks(seconds: float) -> Figures:
    """
    Measure ``env.step`` of a drive with ``backend="scr"``.

    :param seconds: at least one turn [s]
    :return: ``scr_ticks_per_s``, control ticks, the median over the turns
    """
    env = gym.make(TORCS, backend="scr", action_repeat=REPEAT)
    actions = scripted_actions(env, TICKS_PER_TURN // REPEAT)
    rates: list[float] = []
    begin = time.perf_counter()
    while not rates or time.perf_counter() - begin < seconds:
        env.reset(seed=0)
        spent = _time(lambda: [env.step(action) for action in actions])
        rates.append(REPEAT * len(actions) / spent)
    env.close()
    return {"scr_ticks_per_s": statistics.median(rates)}


def resets() -> Figures:
    """
    Measure a reset of an environment that was reset before, to the grid and elsewhere by turns.

    :return: ``scr_reset_ms``, the mean of both
    """
    env = gym.make(TORCS, backend="scr")
    return {"scr_reset_ms": mean_reset_ms(env, RESETS, time.perf_counter)}


def pictures() -> Figures:
    """
    Measure ``env.render()`` of the game's own pictures, one per timestep.

    :return: ``game_frames_per_s``
    """
    env = gym.make(TORCS, render_mode="rgb_array", picture={"size": SIZE})
    actions = scripted_actions(env, PICTURES)
    env.reset(seed=0)
    env.render()  # starts the game
    spent = 0.0
    for action in actions:
        env.step(action)
        spent += _time(env.render)
    env.close()
    return {"game_frames_per_s": len(actions) / spent}


def _time(work: Callable[[], object]) -> float:
    """Take the time of something [s]."""
    begin = time.perf_counter()
    work()
    return time.perf_counter() - begin
