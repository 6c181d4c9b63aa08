"""Speed of environments, in processor time on one core; compared ones are measured in turns."""

from __future__ import annotations

import statistics
import time
from typing import Any

import gymnasium as gym

from sb3_torcs.bench.drives import TICKS_PER_TURN, Figures, scripted_actions

__all__ = ["environments", "resets"]

LITE = "sb3_torcs:TorcsLite-v0"
RACETRACK_STEPS_PER_TURN = 10
RESETS = 200


def environments(seconds: float) -> Figures:
    """
    Measure TorcsLite-v0's control ticks and racetrack-v1's timesteps, in turns.

    :param seconds: of processor time, at least one turn each [s]
    :return: the medians over the turns
    """
    import highway_env  # noqa: F401  registers racetrack-v1

    lite = gym.make(LITE, action_repeat=1)
    racetrack = gym.make("racetrack-v1")
    actions = scripted_actions(lite, TICKS_PER_TURN)
    racetrack.action_space.seed(0)
    others = [racetrack.action_space.sample() for _ in range(RACETRACK_STEPS_PER_TURN)]
    rates: dict[str, list[float]] = {"lite_ticks_per_s": [], "racetrack_v1_steps_per_s": []}
    spent = 0.0
    while spent < seconds:
        for name, env, sequence in zip(rates, (lite, racetrack), (actions, others), strict=True):
            taken = _drive(env, sequence)
            rates[name].append(len(sequence) / taken)
            spent += taken
    lite.close()
    racetrack.close()
    return {name: statistics.median(values) for name, values in rates.items()}


def _drive(env: gym.Env[Any, Any], actions: list[Any]) -> float:
    """
    Do actions after a reset, and reset again when an episode ends.

    ``gymnasium.utils.performance`` does random actions, and measures the wall clock with resets,
    which is something else on a busy machine, and with a car that leaves the road at once.

    :param env: any environment
    :param actions: to do
    :return: processor time without the resets [s]
    """
    env.reset(seed=0)
    spent, begin = 0.0, time.process_time()
    for action in actions:
        _, _, terminated, truncated, _ = env.step(action)
        if terminated or truncated:
            spent += time.process_time() - begin
            env.reset()
            begin = time.process_time()
    return spent + time.process_time() - begin


def resets() -> Figures:
    """
    Measure a reset of an environment that has been reset before.

    :return: ``lite_reset_ms``
    """
    env = gym.make(LITE)
    env.reset(seed=0)
    begin = time.process_time()
    for _ in range(RESETS):
        env.reset()
    spent = time.process_time() - begin
    env.close()
    return {"lite_reset_ms": 1000.0 * spent / RESETS}
