"""Writing the record of a training into its model, and so into each file saved of it."""

from __future__ import annotations

import contextlib
import io
import json
import os
import sys
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import stable_baselines3 as sb3
import torch as th
from gymnasium import spaces
from gymnasium.envs.registration import WrapperSpec
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.save_util import data_to_json
from stable_baselines3.common.vec_env import VecEnv, VecFrameStack, VecNormalize, unwrap_vec_wrapper

from sb3_torcs import __version__
from sb3_torcs.agents.saved.algorithm import find_base_algorithm, zoo_name
from sb3_torcs.agents.saved.file import IDLE, VALUES, find_saved, saved_data, saved_weights
from sb3_torcs.agents.saved.policy import (
    plain,
    plain_policy,
    plain_space,
    restore_space,
)
from sb3_torcs.agents.saved.record import (
    RECORD,
    VERSION,
    record_within,
)
from sb3_torcs.agents.wrapping import LEFT_OUT
from sb3_torcs.errors import InvalidOption, ModelMismatch
from sb3_torcs.files import atomic_file
from sb3_torcs.policies.inputs import columns_of
from sb3_torcs.torcs.track_names import stable_kwargs
from sb3_torcs.tracks.catalogue import stable_name
from sb3_torcs.tracks.track import Track

__all__ = ["RecordCallback", "recipe", "write_driver", "write_record"]

SEEN_LAST = ("_last_obs", "_last_original_obs", "_last_episode_starts", "ep_info_buffer")
"""What a training saw last, of which SB3 keeps one per environment."""

Recipe = Mapping[str, Any]


def recipe(
    algo: str | None, env_id: str | None, hyperparameters: Mapping[str, Any]
) -> dict[str, Any]:
    """
    Compose the first part of a record: the options of a training.

    :param algo: as the zoo calls it
    :param env_id: of the environment, if it has one
    :param hyperparameters: the entry of the hyperparameter file, changes applied
    :return: the first part of a record
    """
    kwargs = _plain_part(stable_kwargs(hyperparameters.get("env_kwargs") or {}))
    entry = {**_plain_part(hyperparameters), **({"env_kwargs": kwargs} if kwargs else {})}
    return {"algo": algo, "env_id": env_id, "env_kwargs": kwargs, "hyperparameters": entry}


class RecordCallback(BaseCallback):
    """
    Writes the record into the model, so that ``sb3-torcs`` drives it as in its training.

    Use it in your own script: pass it to ``learn``, before the callbacks that save the model.
    ``sb3-torcs train`` and ``study`` use it themselves.

    :param asked: options of the training, of :func:`recipe`; ``None`` reads them from the
        environment, which keeps the arguments of ``gym.make`` and Gymnasium's wrappers
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
    Write the record into a model. Files that are saved from now on hold it.

    :param model: that learns
    :param asked: options of the training, of :func:`recipe`
    """
    own = type(model)
    record = {
        "version": VERSION,
        **asked,
        "observation_space": plain_space(model.observation_space),
        "action_space": plain_space(model.action_space),
        "policy": plain_policy(model),
        "subclass": None
        if find_base_algorithm(own) is own
        else f"{own.__module__}.{own.__qualname__}",
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


def write_driver(model: str | Path, driver: str | Path, *, value_function: bool = True) -> None:
    """
    Write a small file of a model that can drive but not learn, with its record.

    The weights of critics and of targets are NaN, and the optimizers are empty, which compress
    well. Stock SB3 still loads the file and predicts the same to the bit. A training that resumes
    from it fails with the first update.

    :param model: the complete file, that ``model.save`` wrote
    :param driver: the file to write, completely or not at all; it may be the same
    :param value_function: whether to keep that of PPO, from which another training may go on.
        Without it, sensors that only the value function saw (``actor_sensors``) are left out, too
    :raises InvalidOption: if ``model`` is no path
    :raises ModelMismatch: if the model cannot be read, or has no record of its training
    :raises OutputNotWritable: if the file cannot be written; the previous one is kept
    """
    if not isinstance(model, str | Path):
        raise InvalidOption(
            f"model is a {type(model).__name__}; write_driver takes the path of a saved one: "
            "model.save('model.zip'), then write_driver('model.zip', 'driver.zip')"
        )
    model, driver = find_saved(model), Path(os.path.expanduser(driver))
    data, weights = saved_data(model), saved_weights(model)
    if record_within(model, data) is None:
        raise ModelMismatch(
            f"'{model}' has no record of its training; pass sb3_torcs.callbacks.RecordCallback to "
            "learn, and save it again"
        )
    data[RECORD]["driver_only"] = True
    if not value_function:
        _leave_out_sensors(data, weights)
    for name in SEEN_LAST:
        data.pop(name, None)
    left_out = tuple(name for name in IDLE if name not in VALUES or not value_function)
    for name, tensor in weights.items():
        if name.startswith(left_out) and tensor.is_floating_point():
            tensor.fill_(float("nan"))
    _write_parts(
        model, driver, {"data": json.dumps(data).encode(), "policy.pth": _torch_file(weights)}
    )


def _write_parts(model: Path, driver: Path, parts: Mapping[str, bytes]) -> None:
    """Write the file of a model with other parts, and with empty optimizers."""
    with (
        atomic_file(driver) as aside,
        zipfile.ZipFile(model) as source,
        zipfile.ZipFile(aside, "w") as target,
    ):
        for name in source.namelist():
            content = parts[name] if name in parts else source.read(name)
            if name.endswith("optimizer.pth"):
                state = th.load(io.BytesIO(content), map_location="cpu", weights_only=True)
                content = _torch_file({**state, "state": {}})
            # No date: the same model makes the same file.
            target.writestr(zipfile.ZipInfo(name), content, zipfile.ZIP_DEFLATED, 9)


def _leave_out_sensors(data: dict[str, Any], weights: dict[str, th.Tensor]) -> None:
    """Let a driver see only what its actor sees."""
    record = data[RECORD]
    sensors = record["policy"].get("kwargs", {}).get("actor_sensors")
    if sensors is None:
        return
    seen = restore_space(record["observation_space"])
    assert isinstance(seen, spaces.Box)
    columns = columns_of(seen, sensors)
    chosen = spaces.Box(seen.low[columns], seen.high[columns])
    data.update(json.loads(data_to_json({"observation_space": chosen})))
    record["observation_space"] = plain_space(chosen)
    record["env_kwargs"] = {**record["env_kwargs"], "sensors": list(sensors)}
    if record["statistics"] is not None:
        known = record["statistics"]
        own = {name: np.take(known[name], columns).tolist() for name in ("mean", "var")}
        record["statistics"] = {**known, **own}
    layers = VALUES[1] + "0.weight", VALUES[0] + "weight"  # the latter, if there is no hidden one
    first = next(name for name in layers if name in weights)
    weights[first] = weights[first][:, columns]


def _torch_file(value: Any) -> bytes:
    """Return what ``torch.save`` writes."""
    file = io.BytesIO()
    th.save(value, file)
    return file.getvalue()


def _recipe_of_environment(model: BaseAlgorithm) -> Recipe:
    """Compose the recipe of a script's training from the arguments of ``gym.make``."""
    env = model.get_env()
    assert env is not None
    (spec,) = env.get_attr("spec", 0)
    algo = zoo_name(find_base_algorithm(type(model)))
    seen = _frames_of(env)
    if spec is None:
        return recipe(algo, None, seen)
    wrappers = [_wrapper_item(wrapper) for wrapper in spec.additional_wrappers]
    if any(wrappers):
        seen["env_wrapper"] = [item for item in wrappers if item]
    kwargs = {name: value for name, value in spec.kwargs.items() if name != "render_mode"}
    tracks = kwargs.get("track")
    if isinstance(tracks, Track):
        kwargs["track"] = stable_name(tracks)
    elif isinstance(tracks, (list, tuple)):
        kwargs["track"] = [stable_name(t) if isinstance(t, Track) else t for t in tracks]
    return recipe(algo, spec.id, {"env_kwargs": kwargs, **seen})


def _wrapper_item(spec: WrapperSpec) -> dict[str, Any] | None:
    """
    Compose the zoo's item of a wrapper that changes what is seen or done.

    :param spec: what Gymnasium knows of it; own wrappers may not keep their arguments
    :return: its dotted path with arguments; ``None`` if it changes neither
    """
    module, _, name = spec.entry_point.partition(":")
    kind = getattr(sys.modules.get(module), name, None)
    if name in LEFT_OUT or (isinstance(kind, type) and issubclass(kind, gym.RewardWrapper)):
        return None
    return {f"{module}.{name}": _plain_part(spec.kwargs or {})}


def _frames_of(env: VecEnv) -> dict[str, Any]:
    """Tell of a frame stack, but of none within statistics: a driver has it around them."""
    stack, outer = (unwrap_vec_wrapper(env, kind) for kind in (VecFrameStack, VecNormalize))
    if outer is not None and outer.norm_obs and unwrap_vec_wrapper(outer, VecFrameStack):
        return {}
    return {} if stack is None else {"frame_stack": stack.stacked_obs.n_stack}


def _plain_part(values: Mapping[str, Any]) -> dict[str, Any]:
    """Leave out everything that is not plain data."""
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
