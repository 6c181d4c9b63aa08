"""Races that are driven at once, held to single ones."""

from __future__ import annotations

from contextlib import contextmanager

import gymnasium as gym
import numpy as np
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_torcs.vec_env import TorcsVecEnv


@contextmanager
def both_kinds(env_id, seed=1, **options):
    """Make three cars of either kind, and close them afterwards."""
    ours = TorcsVecEnv(3, env_id=env_id, **options)
    theirs = DummyVecEnv([lambda: Monitor(gym.make(env_id, **options))] * 3)
    for envs in (ours, theirs):
        envs.seed(seed)
        envs.action_space.seed(seed)
    yield ours, theirs
    ours.close()
    theirs.close()


def assert_they_see_the_same(ours, theirs, steps=40):
    """They answer the same, to the bit, across the ends of episodes."""
    assert ours.reset().tobytes() == theirs.reset().tobytes()
    for step in range(steps):
        actions = np.array([theirs.action_space.sample() for _ in range(3)])
        (*answers, infos), (*same_answers, others) = ours.step(actions), theirs.step(actions)
        for one, other in zip(answers, same_answers, strict=True):
            assert one.tobytes() == other.tobytes(), step
        for info, same in zip(infos, others, strict=True):
            last, expected = info.get("terminal_observation"), same.get("terminal_observation")
            assert (last is None) == (expected is None)
            assert last is None or last.tobytes() == expected.tobytes()
