"""Every control tick of a drive, whatever the length of the agent's timesteps."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np

from sb3_torcs.backends.base import Backend
from sb3_torcs.backends.several import present_world
from sb3_torcs.car import CarState, Controls, Start
from sb3_torcs.telemetry.drives import DriveLabel, DriveLog
from sb3_torcs.tracks.catalogue import stable_name

__all__ = ["LoggedWorld", "TickedWorld", "log_drives"]


class TickedWorld:
    """
    A world that shows its car after every control tick, and drives as it would without.

    :param world: that is driven
    :param show: called with the car, and with the controls that it holds
    """

    def __init__(self, world: Backend, show: Callable[[CarState, Controls], None]) -> None:
        self._world = world
        self._show = show

    def reset(self, rng: np.random.Generator, start: Start | None) -> CarState:
        """Begin an episode; see :class:`~sb3_torcs.backends.base.Backend`."""
        return self._world.reset(rng, start)

    def step(self, controls: Controls, ticks: int) -> CarState:
        """Drive on, one tick after the other; see :class:`~sb3_torcs.backends.base.Backend`."""
        engine = getattr(present_world(self._world), "engine", None)
        try:
            for left in reversed(range(ticks)):
                if engine is not None:  # noise is drawn with what the agent sees, the last tick
                    engine.mute_noise(left > 0)
                state = self._world.step(controls, 1)
                self._show(state, controls)
        finally:
            if engine is not None:
                engine.mute_noise(False)
        return state

    def __getattr__(self, name: str) -> Any:
        if name == "_world":  # of a copy that is being made
            raise AttributeError(name)
        return getattr(self._world, name)


class LoggedWorld(TickedWorld):
    """
    A world that notes its car after every control tick.

    :param world: that is driven
    :param log: that is filled
    :param driver: its name
    :param env_id: of the environment
    """

    def __init__(self, world: Backend, log: DriveLog, driver: str, env_id: str) -> None:
        super().__init__(world, lambda car, controls: log.add(self._label, car, controls))
        self._log = log
        self._label = DriveLabel(driver, "", "", env_id, episode=0)

    def reset(self, rng: np.random.Generator, start: Start | None) -> CarState:
        """Begin an episode; see :class:`~sb3_torcs.backends.base.Backend`."""
        state = super().reset(rng, start)
        track = stable_name(self._world.track)  # track and car may be drawn before the reset
        self._label = self._label._replace(
            track=track, car=self._world.car, episode=self._label.episode + 1
        )
        self._log.tracks[self._label] = self._world.track
        return state


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
