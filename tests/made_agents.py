"""Copies of shipped agents that say something else of their training."""

from __future__ import annotations

from stable_baselines3 import PPO

from sb3_torcs.agents.models import find_model
from sb3_torcs.agents.saved.record import RECORD


def copied_agent(name, path, frame_stack=1, **env_kwargs):
    """
    Copy an agent of PPO, but for what its record says.

    :param name: of a shipped agent
    :param path: of the new file
    :param frame_stack: how many timesteps it sees at once
    :param env_kwargs: arguments of its environment that change
    :return: the path as a string
    """
    model = PPO.load(find_model(name), device="cpu")
    record = getattr(model, RECORD)
    record["env_kwargs"].update(env_kwargs)
    record["hyperparameters"] |= {"env_kwargs": record["env_kwargs"], "frame_stack": frame_stack}
    model.save(path)
    return str(path)
