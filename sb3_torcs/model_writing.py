"""Writing down, in a model that learns, how it learns: each file that is saved of it then tells."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np
import stable_baselines3 as sb3
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback

from sb3_torcs import __version__
from sb3_torcs.model_policy import plain, plain_policy, plain_space
from sb3_torcs.model_record import RECORD, VERSION

__all__ = ["RecordCallback", "recipe", "write_record"]

Recipe = Mapping[str, Any]


def recipe(algo: str, env_id: str | None, hyperparameters: Mapping[str, Any]) -> dict[str, Any]:
    """
    Compose what a training was asked for.

    :param algo: as the zoo calls it
    :param env_id: of the environment, if it has one
    :param hyperparameters: the entry of the hyperparameter file, changes applied
    :return: the first part of a record
    """
    kwargs = _plain_part(hyperparameters.get("env_kwargs") or {})
    entry = {**_plain_part(hyperparameters), **({"env_kwargs": kwargs} if kwargs else {})}
    return {"algo": algo, "env_id": env_id, "env_kwargs": kwargs, "hyperparameters": entry}


class RecordCallback(BaseCallback):
    """
    Writes down in the model how it learns, so that ``sb3-torcs`` drives it as it has learned.

    ``sb3-torcs train`` and ``study`` do so by themselves; a script of one's own gives the callback
    to ``learn``, before those that save the model.

    :param asked: what the training was asked for, of :func:`recipe`; ``None`` looks at the
        environment, which knows what ``gym.make`` was given
    :param verbose: as in ``BaseCallback``
    """

    def __init__(self, asked: Recipe | None = None, verbose: int = 0) -> None:
        super().__init__(verbose)
        self._asked = asked

    def _on_training_start(self) -> None:
        write_record(self.model, self._asked or _recipe_of_environment(self.model))

    def _on_step(self) -> bool:
        if self.model.get_vec_normalize_env() is not None:
            getattr(self.model, RECORD)["statistics"] = _statistics(self.model)
        return True


def write_record(model: BaseAlgorithm, asked: Recipe) -> None:
    """
    Write down in a model how it learns; whatever saves it from now on saves that, too.

    :param model: that learns
    :param asked: what the training was asked for, of :func:`recipe`
    """
    record = {
        "version": VERSION,
        **asked,
        "observation_space": plain_space(model.observation_space),
        "action_space": plain_space(model.action_space),
        "policy": plain_policy(model),
        "statistics": _statistics(model),
        "start_time": model.start_time,  # tells whether a record is of the last training
        "packages": {
            "sb3_torcs": __version__,
            "stable_baselines3": sb3.__version__,
            "torch": str(th.__version__),
            "numpy": np.__version__,
            "gymnasium": gym.__version__,
        },
    }
    setattr(model, RECORD, record)


def _recipe_of_environment(model: BaseAlgorithm) -> Recipe:
    """Find out what a script has made: ``gym.make`` keeps what it was given."""
    env = model.get_env()
    assert env is not None
    (spec,) = env.get_attr("spec", 0)
    name = type(model).__name__
    algo = "ppo_lstm" if name == "RecurrentPPO" else name.lower()
    if spec is None:
        return recipe(algo, None, {})
    kwargs = {name: value for name, value in spec.kwargs.items() if name != "render_mode"}
    return recipe(algo, spec.id, {"env_kwargs": kwargs})


def _plain_part(values: Mapping[str, Any]) -> dict[str, Any]:
    """Leave out what is no plain data."""
    found = {}
    for name, value in values.items():
        with contextlib.suppress(TypeError):
            found[name] = plain(value)
    return found


def _statistics(model: BaseAlgorithm) -> dict[str, Any] | None:
    """Describe the statistics of the observations, if the model learns from normalized ones."""
    normalizer = model.get_vec_normalize_env()
    if normalizer is None or not normalizer.norm_obs:
        return None
    found: Any = normalizer.obs_rms  # one: no environment of racing has a dictionary
    return {
        "mean": found.mean.tolist(),
        "var": found.var.tolist(),
        "epsilon": float(normalizer.epsilon),
        "clip_obs": float(normalizer.clip_obs),
    }
