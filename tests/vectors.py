"""Races that are driven at once, held to single ones."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_torcs.vec_env import TorcsVecEnv


def assert_they_see_the_same(env_id, **options):
    """Three cars of either kind see the same, to the bit, across the ends of episodes."""
    ours = TorcsVecEnv(3, env_id=env_id, **options)
    theirs = DummyVecEnv([lambda: Monitor(gym.make(env_id, **options))] * 3)
    for envs in (ours, theirs):
        envs.seed(1)
        envs.action_space.seed(1)
    assert ours.reset().tobytes() == theirs.reset().tobytes()
    for step in range(40):
        actions = np.array([theirs.action_space.sample() for _ in range(3)])
        (one, *_, infos), (other, *_, others) = ours.step(actions), theirs.step(actions)
        assert one.tobytes() == other.tobytes(), step
        for info, same in zip(infos, others, strict=True):
            last, expected = info.get("terminal_observation"), same.get("terminal_observation")
            assert (last is None) == (expected is None)
            assert last is None or last.tobytes() == expected.tobytes()
    ours.close()
    theirs.close()
