"""A rollout of an environment, to the bit."""

from __future__ import annotations

import hashlib

import gymnasium as gym
import numpy as np

import sb3_torcs  # noqa: F401


def rollout_digest(env_id, options):
    """Act at random; return a digest of all observations and rewards."""
    env = gym.make(env_id, start="random", **options)
    env.action_space.seed(7)
    digest = hashlib.sha256(env.reset(seed=7)[0].tobytes())
    for _ in range(300):
        observation, reward, terminated, truncated, _ = env.step(env.action_space.sample())
        digest.update(observation.tobytes() + np.float64(reward).tobytes())
        if terminated or truncated:
            digest.update(env.reset()[0].tobytes())
    return digest.hexdigest()
