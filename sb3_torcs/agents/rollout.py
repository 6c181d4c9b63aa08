"""A driver in an environment: the one loop that resets, asks for actions and steps."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from sb3_torcs.car import CarState

__all__ = ["Driver", "Environment", "Timestep", "drive"]


class Driver(Protocol):
    """What drives: a Stable-Baselines3 model, or anything that predicts like one."""

    def predict(
        self,
        observation: npt.NDArray[np.float32],
        state: Any = None,
        episode_start: npt.NDArray[np.bool_] | None = None,
        deterministic: bool = False,
    ) -> tuple[npt.NDArray[np.float32], Any]:
        """Choose an action; the state that comes with it is given back at the next timestep."""


class Environment(Protocol):
    """What is driven in: a ``gymnasium.Env``, or what has these two methods of it."""

    def reset(self, *, seed: int | None, options: dict[str, Any] | None) -> tuple[Any, Any]:
        """Begin an episode; return the observation and the info."""

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Return observation, reward, terminated, truncated and info."""


@dataclass(frozen=True)
class Timestep:
    """One timestep of a drive."""

    observation: npt.NDArray[np.float32]  # that the driver saw
    action: npt.NDArray[np.float32]
    reward: float
    next_observation: npt.NDArray[np.float32]
    terminated: bool
    truncated: bool
    info: dict[str, Any]

    @property
    def done(self) -> bool:
        """Whether the episode has ended."""
        return self.terminated or self.truncated

    @property
    def car(self) -> CarState:
        """The car after the step."""
        car: CarState = self.info["car"]
        return car


def drive(
    env: Environment,
    driver: Driver,
    *,
    seed: int | None = None,
    options: Mapping[str, Any] | None = None,
    over: Callable[[], bool] | None = None,
) -> Iterator[Timestep]:
    """
    Drive one episode, deterministically.

    :param env: a racing environment
    :param driver: chooses the actions
    :param seed: of the reset
    :param options: of the reset
    :param over: asked before each timestep whether that was all; ``None`` ends with the episode
    :return: the timesteps, one by one
    """
    observation, _ = env.reset(seed=seed, options=None if options is None else dict(options))
    episode_start = np.ones(1, dtype=bool)
    state, done = None, False
    while not (done if over is None else over()):
        action, state = driver.predict(observation, state, episode_start, deterministic=True)
        episode_start = np.zeros(1, dtype=bool)
        after, reward, terminated, truncated, info = env.step(action)
        step = Timestep(
            observation, action, float(reward), after, bool(terminated), bool(truncated), info
        )
        observation, done = after, step.done
        yield step
