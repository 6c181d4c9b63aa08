"""What measurements drive: races, actions of the scripted driver, resets."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt

__all__ = [
    "RACES",
    "REPEAT",
    "TICKS_PER_TURN",
    "TORCS",
    "Actions",
    "Figures",
    "mean_reset_ms",
    "scripted_actions",
    "scripted_batches",
]

TORCS = "sb3_torcs:Torcs-v0"
REPEAT = 5  # control ticks per timestep, the default
TICKS_PER_TURN = 3000  # a minute of driving
RACES = 16

Figures = dict[str, float | None]
Actions = list[npt.NDArray[np.float32]]


def scripted_actions(env: gym.Env[Any, Any], number: int) -> Actions:
    """
    Let the scripted driver choose actions from the grid on, and end before the episode does.

    :param env: to drive in
    :param number: of actions, at most
    """
    from sb3_torcs.agents.rollout import drive
    from sb3_torcs.agents.scripted import ScriptedDriver

    steps = list(zip(drive(env, ScriptedDriver(), seed=0), range(number), strict=False))
    return [step.action for step, _ in steps if not step.done]


def scripted_batches(observations: Any, step: Callable[[Any], Any], number: int) -> Actions:
    """
    Let the scripted driver choose actions for many cars at once.

    :param observations: from a reset
    :param step: of a vector environment; returns the next observations first
    :param number: of actions
    """
    from sb3_torcs.agents.scripted import ScriptedDriver

    driver, actions = ScriptedDriver(), []
    for _ in range(number):
        actions.append(driver.predict(observations)[0])
        observations = step(actions[-1])[0]
    return actions


def mean_reset_ms(env: gym.Env[Any, Any], number: int, clock: Callable[[], float]) -> float:
    """
    Time resets of an environment that was reset before, to the grid and elsewhere by turns.

    :param env: is closed
    :param number: of each kind
    :param clock: returns seconds
    :return: the mean of both [ms]
    """
    env.reset(seed=0)
    spent = 0.0
    for _ in range(number):
        for start in ("grid", "random"):
            env.get_wrapper_attr("set_start")(start)
            begin = clock()
            env.reset()
            spent += clock() - begin
    env.close()
    return 1000.0 * spent / (2 * number)
