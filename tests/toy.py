"""A racing environment without a race: what callbacks and policies need of one, in a few lines."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_torcs.sensors import View


class ToyRace(gym.Env[np.ndarray, np.ndarray]):
    """Random observations, ten timesteps an episode; the reward says which reward is set."""

    observation_space = spaces.Box(View().low, View().high)
    action_space = spaces.Box(np.array([-1, 0, 0], np.float32), np.array([1, 1, 1], np.float32))

    def __init__(self, reward: str = "progress", start: str = "grid") -> None:
        self.reward = reward
        self.start = start
        self.actions: list[np.ndarray] = []

    def set_reward(self, reward: str) -> str:
        previous, self.reward = self.reward, reward
        return previous

    def set_start(self, start: str) -> str:
        previous, self.start = self.start, start
        return previous

    def settings(self) -> tuple[str, str]:
        return self.reward, self.start

    def taken(self) -> np.ndarray:
        return np.array(self.actions)

    def _observe(self) -> np.ndarray:
        return self.np_random.uniform(-1, 1, 29).astype(np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.time = 0
        return self._observe(), {}

    def step(self, action):
        self.time += 1
        self.actions.append(np.array(action))
        reward = float(len(self.reward))
        info = {"reward_terms": {"speed": reward - 1.0, "crash": 1.0}, "start": self.start}
        return self._observe(), reward, self.time == 10, False, info
