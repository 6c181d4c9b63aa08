"""A drive noted tick by tick, whatever the length of the agent's timesteps."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np

from sb3_torcs.backends.base import Backend
from sb3_torcs.car import CarState, Controls, Start
from sb3_torcs.telemetry.drives import DriveLabel, DriveLog

__all__ = ["LoggedWorld", "log_drives"]


class LoggedWorld:
    """
    A world that notes its car after every control tick.

    :param world: that is driven
    :param log: that is filled
    :param driver: its name
    :param env_id: of the environment
    """

    def __init__(self, world: Backend, log: DriveLog, driver: str, env_id: str) -> None:
        self._world = world
        self._log = log
        self._label = DriveLabel(driver, "", world.car, env_id, episode=0)

    def reset(self, rng: np.random.Generator, start: Start | None) -> CarState:
        """Begin an episode; see :class:`~sb3_torcs.backends.base.Backend`."""
        state = self._world.reset(rng, start)
        track = self._world.track.name  # a random one is drawn before the reset
        self._label = self._label._replace(track=track, episode=self._label.episode + 1)
        return state

    def step(self, controls: Controls, ticks: int) -> CarState:
        """Drive on, one tick after the other, which comes to the same."""
        for _ in range(ticks):
            state = self._world.step(controls, 1)
            self._log.add(self._label, state, controls)
        return state

    def __getattr__(self, name: str) -> Any:
        return getattr(self._world, name)


def log_drives(env: gym.Env[Any, Any], driver: str) -> DriveLog:
    """
    Note everything that is driven in an environment from its next reset on.

    :param env: a racing environment, or a wrapper of one
    :param driver: name of who drives
    :return: the log, which fills
    """
    log = DriveLog()
    racing: Any = env.unwrapped
    assert env.spec is not None, "every racing environment is registered"
    racing.backend = LoggedWorld(racing.backend, log, driver, env.spec.id)
    return log
