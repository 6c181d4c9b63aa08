"""The evaluation protocol: drive some episodes and write down what happened."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any, Protocol

import gymnasium as gym
import numpy as np
import numpy.typing as npt

from sb3_torcs.car import CarState

__all__ = ["Driver", "Episode", "Step", "drive", "evaluate"]


class Driver(Protocol):
    """What drives: a Stable-Baselines3 model, or anything that predicts like one."""

    def predict(
        self, observation: npt.NDArray[np.float32], *, deterministic: bool = True
    ) -> tuple[npt.NDArray[np.float32], Any]:
        """Choose an action."""


@dataclass(frozen=True)
class Step:
    """One decision of a drive."""

    car: CarState  # after it
    action: npt.NDArray[np.float32]  # (3,)
    reward: float
    info: dict[str, Any]
    done: bool


@dataclass(frozen=True)
class Episode:
    """One episode of an evaluation."""

    laps: int
    lap_times: list[float]  # [s]
    distance: float  # [m]
    end: str  # as in ``info``, or "time_limit"
    damage: float  # [points]
    episode_return: float

    def as_dict(self) -> dict[str, Any]:
        """Return the fields as the command prints them."""
        fields = asdict(self)
        fields["return"] = fields.pop("episode_return")
        return fields


def drive(env: gym.Env[Any, Any], driver: Driver, *, seed: int | None = None) -> Iterator[Step]:
    """
    Drive one episode, deterministically.

    :param env: a racing environment
    :param driver: chooses the actions
    :param seed: of the reset
    :return: the decisions, one by one
    """
    observation, _ = env.reset(seed=seed)
    done = False
    while not done:
        action, _ = driver.predict(observation, deterministic=True)
        observation, reward, terminated, truncated, info = env.step(action)
        done = terminated or truncated
        yield Step(info["car"], action, float(reward), info, done)


def evaluate(
    env: gym.Env[Any, Any], driver: Driver, *, episodes: int = 1, seed: int = 0
) -> list[Episode]:
    """
    Drive some episodes from the environment's own start.

    :param env: a racing environment
    :param driver: chooses the actions, deterministically
    :param episodes: how many
    :param seed: of the first reset; the next episodes go on from it
    :return: what happened in each
    """
    results = []
    for number in range(episodes):
        lap_times, total = [], 0.0
        info: dict[str, Any] = {}
        for step in drive(env, driver, seed=seed if number == 0 else None):
            info = step.info
            total += step.reward
            if "lap_time" in info:
                lap_times.append(info["lap_time"])
        results.append(
            Episode(
                laps=info["laps"],
                lap_times=lap_times,
                distance=info["distance"],
                end=info["end"] or "time_limit",
                damage=info["damage"],
                episode_return=total,
            )
        )
    return results
