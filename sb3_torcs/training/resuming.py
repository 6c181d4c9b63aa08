"""Go on with a training from a saved model."""

from __future__ import annotations

import pickle
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.vec_env import VecNormalize

from sb3_torcs.agents.models import check_spaces, saved_spaces, saved_timesteps, training_record
from sb3_torcs.agents.saved.algorithm import check_same
from sb3_torcs.agents.saved.file import raise_mismatch
from sb3_torcs.agents.wrapping import frames_of, normalizes
from sb3_torcs.car import range_finder_angles
from sb3_torcs.errors import ModelMismatch, ModelNotTrusted
from sb3_torcs.training.keeping import REPLAY_BUFFER
from sb3_torcs.training.zoo_data import SCHEDULES, as_data, policy_arguments

__all__ = ["check_resumable", "recorded_entry", "restore_statistics"]


def recorded_entry(model: Path, algo: str, env_id: str) -> dict[str, Any]:
    """
    Take the entry that a model has learned by, for what is left of its training.

    What falls over the training goes on from where it is. A training that has ended is held again.

    :param model: the file
    :param algo: that is to learn, as the zoo calls it
    :param env_id: of the environment in which it is to learn
    :return: the entry; of a script's model only ``env_kwargs``, and empty if nothing fits
    :raises ModelMismatch: if it cannot be read, or is of another algorithm
    """
    record = training_record(model)
    check_same(model, record.algo, algo, to_learn=True)
    if record.env_id != env_id:
        return {}
    with raise_mismatch(f"the hyperparameters in the record of '{model}' cannot be read", "give"):
        entry = as_data(record.hyperparameters)
        if "n_timesteps" not in entry:
            return entry
        whole = int(float(entry["n_timesteps"]))
        left = whole - saved_timesteps(model)
        if 0 < left < whole:
            entry["n_timesteps"] = left
            for key in SCHEDULES:
                if isinstance(entry.get(key), str):
                    first = float(entry[key].removeprefix("lin_"))
                    entry[key] = f"lin_{first * left / whole}"
    return entry


def restore_statistics(env: VecNormalize, model: Path) -> None:
    """
    Go on with the statistics of a model's training.

    Its record holds those of the observations, without their count, for which the timesteps stand.

    :param env: new, with the options of the entry; stays as it is if none are known
    :param model: the file
    """
    record = training_record(model)
    if record.statistics_file is not None:
        said = f"'{record.statistics_file}' holds no statistics to continue with"
        with raise_mismatch(said, "give"), record.statistics_file.open("rb") as file:
            saved = pickle.load(file)
            env.obs_rms, env.ret_rms = saved.obs_rms, saved.ret_rms
    elif record.statistics is not None:
        observed: Any = env.obs_rms  # one: no environment of racing has a dictionary
        observed.mean = np.array(record.statistics.mean)
        observed.var = np.array(record.statistics.var)
        observed.count = saved_timesteps(model)


def check_resumable(
    model: Path,
    env: gym.Env[Any, Any],
    algo: str,
    entry: Mapping[str, Any],
    *,
    trust: bool = False,
) -> bool:
    """
    Make sure that a training can resume from a model.

    :param model: the file; its replay buffer and its record lie beside it
    :param env: that the training is to go on in
    :param algo: that is to learn, as the zoo calls it
    :param entry: the hyperparameters with which it is to learn
    :param trust: accept a model without a record
    :return: whether there is a replay buffer to resume with
    :raises ModelMismatch: if they do not belong together
    :raises ModelNotTrusted: if it has no record of a training
    """
    from stable_baselines3.common.save_util import load_from_pkl

    record = training_record(model)
    if record.driver_only:
        raise ModelMismatch(
            f"'{model}' holds what drives and not what learns: its critics and optimizers were "
            "left out; train again, with the hyperparameters in the config.yml beside it"
        )
    if not record.known and not trust:
        raise ModelNotTrusted(
            f"'{model}' does not tell that `sb3-torcs train` or the RL Zoo made it. To go on from "
            "a model runs whatever code is pickled in it and in the replay buffer beside it; if "
            "you know who made them, add --trust"
        )
    if record.subclass is not None:
        raise ModelMismatch(
            f"'{model}' has learned by {record.subclass}, and would go on by plain {record.algo}; "
            "go on in your own script"
        )
    check_same(model, record.algo, algo, to_learn=True)
    frames = frames_of(entry)
    before, after = (_lasting(each) for each in (record.hyperparameters, entry))
    for what, was in before.items():
        now = after.get(what)
        if record.known and was != now:
            raise ModelMismatch(
                f"'{model}' has learned with {what} {was}, and would go on with {now}; give the "
                "--conf-file or the --hyperparams of before"
            )
    check_spaces(model, saved_spaces(model, trust=True), env, frames)
    finders, name = record.env_kwargs.get("range_finders", "scr"), "range_finder_angles"
    angles = env.get_wrapper_attr(name) if env.has_wrapper_attr(name) else None
    if (
        record.env_id
        and angles is not None
        and not np.allclose(range_finder_angles(finders), angles)
    ):
        raise ModelMismatch(
            f"'{model}' has learned with range_finders {finders!r}, and would go on with others; "
            "give the --env, --entry or --conf-file of before"
        )
    file = model.parent / REPLAY_BUFFER
    if not file.is_file():
        return False
    n_envs = int(entry.get("n_envs", 1))
    said = f"'{file}' is not a replay buffer to continue with"
    with raise_mismatch(said, "remove it, or give"), file.open("rb") as content:
        buffer = load_from_pkl(content)
        if buffer.n_envs != n_envs:
            raise ModelMismatch(
                f"'{file}' is of {buffer.n_envs} cars at once, and the training would have "
                f"{n_envs}; give n_envs {buffer.n_envs}, or remove the file to begin with an empty "
                "one"
            )
        size, before_size = int(entry.get("buffer_size", 0)), buffer.buffer_size * n_envs
        if size and max(size // n_envs, 1) != buffer.buffer_size:
            raise ModelMismatch(
                f"'{file}' keeps {before_size} timesteps, and the training would keep {size}; give "
                f"buffer_size {before_size}, or remove the file to begin with an empty one"
            )
    return True


def _lasting(entry: Mapping[str, Any]) -> dict[str, Any]:
    """Return what of a training cannot change: how it sees, and its networks."""
    lasting: dict[str, Any] = {
        "frame_stack": frames_of(entry),
        "normalize": normalizes(entry.get("normalize")),
    }
    if "policy" in entry:  # a script's record does not tell it
        lasting["policy"] = str(entry["policy"]).rpartition(".")[2]
        lasting["policy_kwargs"] = policy_arguments(as_data(entry)) or {}
    return lasting
