"""How fast ``TorcsVecEnv`` is: many races on one thread and on two, and many cars in one race."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

import gymnasium as gym
import numpy as np

from sb3_torcs import cores
from sb3_torcs.bench.drives import (
    RACES,
    REPEAT,
    TORCS,
    Actions,
    Figures,
    scripted_actions,
    scripted_batches,
)

if TYPE_CHECKING:
    from sb3_torcs.vec_env import TorcsVecEnv

__all__ = ["race", "vec_env"]

TIMESTEPS = 100  # of a drive
AGENTS = 8  # in one race
RACE_TIMESTEPS = 300  # of one: the field has spread by then
PART = 20  # timesteps per measurement by the wall clock: short enough for an idle moment


def vec_env(seconds: float) -> Figures:
    """
    Measure 16 races of Torcs-v0, five ticks per timestep, without resets.

    :param seconds: of wall time, at least one turn [s]
    :return: ``vec_env_timesteps_per_s``, of all races on one thread, by the processor's clock, the
        median over the turns; and ``vec_env_two_threads_ratio``, the best rate on two threads
        divided by the best on one, both by the wall clock, since other programs only slow down
    """
    from sb3_torcs.vec_env import TorcsVecEnv

    single = gym.make(TORCS)
    actions = [np.tile(asked, (RACES, 1)) for asked in scripted_actions(single, TIMESTEPS)]
    single.close()
    one, two = (TorcsVecEnv(RACES, threads=threads) for threads in (1, 2))
    processor: list[float] = []
    slow, fast = [0.0], [0.0]
    begin = time.perf_counter()
    while not processor or time.perf_counter() - begin < seconds:
        processor += _rates(one, actions, TIMESTEPS, time.process_time)
        slow += _rates(one, actions, PART, time.perf_counter)
        fast += _rates(two, actions, PART, time.perf_counter)
    one.close()
    two.close()
    several = cores.number() > 1
    return {
        "vec_env_timesteps_per_s": statistics.median(processor),
        "vec_env_two_threads_ratio": max(fast) / max(slow) if several else None,
    }


def race(seconds: float, agents: int = AGENTS) -> Figures:
    """
    Measure one race of several agents on one thread, five ticks per timestep.

    :param seconds: of processor time, at least one turn [s]
    :param agents: in the race
    :return: ``race_car_ticks_per_s``: control ticks of all cars, the median over the turns
    """
    from sb3_torcs.vec_env import TorcsVecEnv

    envs = TorcsVecEnv(1, agents, threads=1)
    envs.seed(0)
    actions = scripted_batches(envs.reset(), envs.step, RACE_TIMESTEPS)
    rates: list[float] = []
    begin = time.process_time()
    while not rates or time.process_time() - begin < seconds:
        envs.seed(0)
        rates += _rates(envs, actions, len(actions), time.process_time)
    envs.close()
    return {"race_car_ticks_per_s": REPEAT * statistics.median(rates)}


def _rates(
    envs: TorcsVecEnv, actions: Actions, part: int, clock: Callable[[], float]
) -> list[float]:
    """Return the timesteps per second of all races, of each part of a drive."""
    envs.reset()
    envs.step(actions[0])  # takes the races over
    rates = []
    for first in range(0, len(actions), part):
        asked = actions[first : first + part]
        begin = clock()
        for action in asked:
            envs.step(action)
        rates.append(envs.num_envs * len(asked) / (clock() - begin))
    return rates
