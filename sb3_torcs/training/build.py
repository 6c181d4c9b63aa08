"""Build the algorithm, the environments and the callbacks that an entry describes.

The keys of an entry, and what each of them becomes, are those of the RL Zoo, so that both train the
same model.
"""

from __future__ import annotations

import contextlib
import copy
import importlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.noise import (
    ActionNoise,
    NormalActionNoise,
    OrnsteinUhlenbeckActionNoise,
)
from stable_baselines3.common.utils import ConstantSchedule
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecFrameStack, VecNormalize

from sb3_torcs.agents.saved.algorithm import algorithm_class
from sb3_torcs.errors import Sb3TorcsError, ZooConfigError
from sb3_torcs.files import as_list, path_and_arguments
from sb3_torcs.training.keeping import REPLAY_BUFFER
from sb3_torcs.training.resuming import restore_statistics
from sb3_torcs.training.schedules import FallingSchedule
from sb3_torcs.training.zoo import OURS, ZOO_KEYS
from sb3_torcs.training.zoo_data import SCHEDULES, policy_classes
from sb3_torcs.vec_env import TorcsVecEnv

__all__ = ["Built", "build"]

REFUSED = (AssertionError, NotImplementedError, TypeError, ValueError)
"""What an algorithm raises for arguments that it does not take."""

POLICY = ("policy", "policy_kwargs")  # a loaded model keeps its own


class Built(NamedTuple):
    """What an entry describes."""

    model: Any  # of any algorithm; its environments are ``model.get_env()``
    callbacks: list[BaseCallback]


def build(
    algo: str,
    env_id: str,
    entry: Mapping[str, Any],
    *,
    seed: int = 0,
    folder: Path | None = None,
    tensorboard: Path | None = None,
    resume: Path | None = None,
) -> Built:
    """
    Build an algorithm, its environments and its callbacks.

    :param algo: as the zoo calls it
    :param env_id: of a registered environment
    :param entry: of a hyperparameter file, checked
    :param seed: of the training
    :param folder: for Monitor's files; ``None`` writes none
    :param tensorboard: for TensorBoard's files; ``None`` writes none
    :param resume: a saved model to continue from; its replay buffer lies beside it
    :return: the algorithm and the callbacks
    :raises ZooConfigError: if the algorithm refuses the entry
    """
    entry = copy.deepcopy(dict(entry))
    callbacks = [each(**arguments) for each, arguments in _classes(entry, "callback")]
    env = _environments(env_id, entry, seed, folder, resume)
    with contextlib.ExitStack() as unless_built:
        unless_built.callback(env.close)
        options = {
            **_algorithm_options(entry, env),
            "env": env, "seed": seed, "device": "cpu", "verbose": 0,
            "tensorboard_log": None if tensorboard is None else str(tensorboard),
        }  # fmt: skip
        try:
            model = _model(algorithm_class(algo), options, resume)
        except REFUSED as error:
            if isinstance(error, Sb3TorcsError):
                raise
            why = " ".join(str(error).split())
            raise ZooConfigError(
                f"{algo} cannot learn in {env_id} by this entry: {why}; change the entry, or "
                "choose another --algo"
            ) from error
        unless_built.pop_all()
    return Built(model, callbacks)


def _model(algorithm: Any, options: dict[str, Any], resume: Path | None) -> Any:
    """Make a new model, or load one, whose policy stays, with its replay buffer."""
    if resume is None:
        return algorithm(**options)
    kept = {name: value for name, value in options.items() if name not in POLICY}
    model = algorithm.load(resume, **kept)
    buffer = resume.parent / REPLAY_BUFFER
    if buffer.is_file():
        model.load_replay_buffer(buffer)
    return model


def _environments(
    env_id: str, entry: Mapping[str, Any], seed: int, folder: Path | None, resume: Path | None
) -> VecEnv:
    """
    Make the environments: within Monitor, then the entry's wrappers, statistics and frames.

    Where the engine can drive several cars on threads they are in :class:`TorcsVecEnv`, which
    returns what ``DummyVecEnv`` would, to the bit.
    """
    n_envs = int(entry.get("n_envs", 1))
    env_kwargs = entry.get("env_kwargs") or {}
    spec, wrapper = gym.spec(env_id), _wrapper(entry, "env_wrapper")
    on_threads = n_envs > 1 and env_id in OURS and wrapper is None
    on_threads &= env_kwargs.get("backend", "native") == "native"
    env = make_vec_env(
        spec.make,
        n_envs,
        seed,
        env_kwargs=env_kwargs,
        monitor_dir=None if folder is None else str(folder),
        monitor_kwargs=entry.get("monitor_kwargs"),
        wrapper_class=wrapper,
        vec_env_cls=TorcsVecEnv if on_threads else DummyVecEnv,
    )
    around = _wrapper(entry, "vec_env_wrapper")
    if around is not None:
        env = around(env)
    if entry.get("normalize"):
        options = entry["normalize"] if isinstance(entry["normalize"], Mapping) else {}
        gamma = {"gamma": entry["gamma"]} if "gamma" in entry else {}
        env = VecNormalize(env, **{**options, **gamma})
        if resume is not None:
            restore_statistics(env, resume)
    if entry.get("frame_stack") is not None:
        env = VecFrameStack(env, entry["frame_stack"])
    return env


def _algorithm_options(entry: Mapping[str, Any], env: VecEnv) -> dict[str, Any]:
    """Return the arguments of the algorithm's constructor that an entry gives."""
    options = {key: value for key, value in entry.items() if key not in ZOO_KEYS}
    for key in SCHEDULES:
        if key in options:
            options[key] = _schedule(options[key])
    if isinstance(options.get("train_freq"), list):
        options["train_freq"] = tuple(options["train_freq"])
    policy = entry["policy"]
    options["policy"] = _import(policy) if "." in policy else policy
    if "policy_kwargs" in entry:
        options["policy_kwargs"] = policy_classes(entry)
    if entry.get("noise_type") is not None:
        options["action_noise"] = _noise(entry["noise_type"], entry["noise_std"], env)
    return options


def _schedule(value: Any) -> Any:
    """Read ``lin_0.001`` and numbers, of which negative ones mean none."""
    if isinstance(value, str):
        return FallingSchedule(float(value.removeprefix("lin_")))
    return value if value is None or value < 0 else ConstantSchedule(float(value))


def _noise(kind: str, deviation: float, env: VecEnv) -> ActionNoise:
    assert isinstance(env.action_space, spaces.Box)
    size = env.action_space.shape[0]
    noise = NormalActionNoise if "normal" in kind else OrnsteinUhlenbeckActionNoise
    return noise(mean=np.zeros(size), sigma=deviation * np.ones(size))


def _classes(entry: Mapping[str, Any], key: str) -> list[tuple[Any, dict[str, Any]]]:
    """Import the classes of a key, with the arguments of each."""
    items = [path_and_arguments(item) for item in as_list(entry.get(key))]
    return [(_import(path), arguments) for path, arguments in items]


def _wrapper(entry: Mapping[str, Any], key: str) -> Callable[[Any], Any] | None:
    """Return what puts the wrappers of a key around an environment, the first one innermost."""
    classes = _classes(entry, key)

    def wrap(env: Any) -> Any:
        for each, arguments in classes:
            env = each(env, **arguments)
        return env

    return wrap if classes else None


def _import(path: str) -> Any:
    """Import a class by its dotted path."""
    module, _, name = path.rpartition(".")
    return getattr(importlib.import_module(module), name)
