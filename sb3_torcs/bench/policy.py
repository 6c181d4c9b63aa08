"""Models that are ready to be updated, with nothing behind their spaces."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3 import DDPG, TD3
from stable_baselines3.common.logger import Logger
from stable_baselines3.td3.policies import TD3Policy

from sb3_torcs.sensors import View

__all__ = ["SpacesOnly", "fill", "updater"]

TRANSITIONS = 2000
"""Random transitions to learn from."""


class SpacesOnly(gym.Env[np.ndarray, np.ndarray]):
    """The spaces of a racing environment, and nothing behind them."""

    observation_space = spaces.Box(View().low, View().high)
    action_space = spaces.Box(
        np.array([-1, 0, 0], np.float32), np.array([1, 1, 1], np.float32), dtype=np.float32
    )


def updater(
    policy: type[TD3Policy], batch_size: int, algorithm: type[TD3] = DDPG, **policy_kwargs: Any
) -> TD3:
    """
    Make a DDPG that is ready to update: random transitions in its replay buffer, no output.

    :param policy: class of the policy
    :param batch_size: transitions per update
    :param algorithm: or TD3
    :param policy_kwargs: arguments of the policy
    :return: the model; the same twice for the same arguments
    """
    model = algorithm(
        policy,
        SpacesOnly(),
        buffer_size=TRANSITIONS,
        batch_size=batch_size,
        policy_kwargs=policy_kwargs,
        seed=0,
        device="cpu",
    )
    fill(model)
    return model


def fill(model: TD3) -> None:
    """
    Let a model of one environment be ready to update: random transitions, and no output.

    :param model: with an empty replay buffer
    """
    model.set_logger(Logger(None, []))
    rng = np.random.default_rng(0)
    assert model.replay_buffer is not None
    for _ in range(TRANSITIONS):
        obs, next_obs = rng.uniform(-1, 1, (2, 1, 29))
        action, reward = rng.uniform(-1, 1, (1, 3)), rng.uniform(-1, 1, 1)
        model.replay_buffer.add(obs, next_obs, action, reward, np.zeros(1), [{}])
