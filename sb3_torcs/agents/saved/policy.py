"""The policy of a saved model as plain data, and back, without a pickle."""

from __future__ import annotations

import importlib
import inspect
import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_torcs.errors import ModelNotTrusted, needs_extra

__all__ = [
    "Spaces",
    "build_policy",
    "plain",
    "plain_policy",
    "plain_space",
    "restore_space",
]

POLICY_MODULES = (
    "sb3_torcs.policies",
    "stable_baselines3.common.policies",
    "stable_baselines3.dqn.policies",
    "stable_baselines3.sac.policies",
    "stable_baselines3.td3.policies",
    "sb3_contrib.ars.policies",
    "sb3_contrib.common.maskable.policies",
    "sb3_contrib.common.recurrent.policies",
    "sb3_contrib.crossq.policies",
    "sb3_contrib.qrdqn.policies",
    "sb3_contrib.tqc.policies",
)
"""Where the policies are that a file may name: importing them, and building one, does no harm."""

PART_MODULES = (
    "stable_baselines3.common.torch_layers",
    "torch.nn.modules.activation",
    "torch.nn.modules.linear",
)
"""Where the classes are that the arguments of such a policy may name."""

FOR_LEARNING = ("optimizer_class", "optimizer_kwargs")
"""Arguments of a policy that a driver has no use for."""

COUNTS = ("n_critics", "n_lstm_layers")
MAX_NUMBERS = 2**28  # of the largest network that is built without --trust
MAX_SPACE = 2**24  # numbers in an observation

Spaces = tuple[spaces.Space[Any], spaces.Space[Any]]


def plain(value: Any) -> Any:
    """
    Turn a value into JSON's types.

    :param value: of numbers, words, lists, arrays, mappings and classes
    :return: the same; an array becomes a list, and a class becomes ``{"class": its dotted path}``
    :raises TypeError: for anything else
    """
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, np.generic | np.ndarray):
        return plain(value.tolist())
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, Mapping) and all(isinstance(key, str) for key in value):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, type):
        return {"class": f"{value.__module__}.{value.__qualname__}"}
    raise TypeError(f"{value!r:.80} is a {type(value).__name__}")


def plain_policy(model: Any) -> dict[str, Any]:
    """
    Describe the policy of a model.

    :param model: an algorithm of Stable-Baselines3
    :return: its class and its arguments as plain data, or why that is impossible
    """
    kwargs = {key: item for key, item in model.policy_kwargs.items() if key not in FOR_LEARNING}
    if getattr(model, "use_sde", False):
        kwargs["use_sde"] = True
    try:
        return {**plain(model.policy_class), "kwargs": plain(kwargs)}
    except TypeError as error:
        return {"unreadable": f"its policy_kwargs are no plain data: {error}"}


def plain_space(space: spaces.Space[Any]) -> dict[str, Any]:
    """
    Describe a space.

    :param space: of observations or actions
    :return: its kind and its numbers; empty if its kind is not known here
    """
    if isinstance(space, spaces.Box):
        bounds = {name: _bound(getattr(space, name)) for name in ("low", "high")}
        return {"kind": "Box", "shape": list(space.shape), "dtype": str(space.dtype), **bounds}
    if isinstance(space, spaces.Discrete):
        return {"kind": "Discrete", "n": int(space.n), "start": int(space.start)}
    return {}


def _bound(values: np.ndarray) -> Any:
    """Write equal numbers once."""
    numbers = values.ravel().tolist()
    return numbers[0] if len(set(numbers)) == 1 else numbers


def restore_space(said: Any) -> spaces.Space[Any] | None:
    """
    Build a space from its description.

    :param said: by :func:`plain_space`
    :return: the space; ``None`` if it was not described
    :raises ValueError: if the description is wrong
    """
    if not said:
        return None
    if said["kind"] == "Discrete":
        return spaces.Discrete(int(said["n"]), start=int(said["start"]))
    shape, dtype = tuple(int(size) for size in said["shape"]), np.dtype(str(said["dtype"]))
    if said["kind"] != "Box" or math.prod(shape) > MAX_SPACE or dtype.kind not in "fiu":
        raise ValueError(f"a space of kind {said['kind']!r}, {shape}, {dtype}")
    low, high = (np.asarray(said[name], dtype) for name in ("low", "high"))
    low, high = (np.broadcast_to(bound.reshape(-1), math.prod(shape)) for bound in (low, high))
    return spaces.Box(low.reshape(shape).copy(), high.reshape(shape).copy(), shape, dtype.type)


def build_policy(said: Mapping[str, Any], seen: Spaces) -> Any:
    """
    Build a policy from its description.

    :param said: by :func:`plain_policy`
    :param seen: the observation space and the action space
    :return: the policy, without its weights; it cannot learn
    :raises ModelNotTrusted: if that takes more than plain data and known classes
    """
    from stable_baselines3.common.policies import ActorCriticPolicy

    from sb3_torcs.policies.optimizers import IdleOptimizer

    if "unreadable" in said:
        raise ModelNotTrusted(str(said["unreadable"]))
    path, kwargs = str(said.get("class")), dict(said.get("kwargs") or {})
    policy_class = _known_class(path, POLICY_MODULES)
    kwargs = {key: _build(item) for key, item in kwargs.items() if key not in FOR_LEARNING}
    widths = [item for item in _numbers(kwargs) if item > 0]
    counts = [kwargs.get(name) or 1 for name in COUNTS]
    if sum(widths) ** 2 * max(counts) > MAX_NUMBERS:
        raise ModelNotTrusted(f"its network would have more than {MAX_NUMBERS} numbers")
    given = {"observation_space": seen[0], "action_space": seen[1], "lr_schedule": lambda _: 0.0}
    taken = inspect.signature(policy_class).parameters
    if "optimizer_class" in taken or "kwargs" in taken:
        kwargs["optimizer_class"] = IdleOptimizer
    if issubclass(policy_class, ActorCriticPolicy):
        kwargs["ortho_init"] = False  # of weights that are replaced: it would load LAPACK
    return policy_class(**{key: given[key] for key in given if key in taken}, **kwargs)


def _known_class(path: str, modules: tuple[str, ...]) -> type:
    """Find a class by its dotted path, in these modules only."""
    module, _, name = path.rpartition(".")
    if module not in modules:
        raise ModelNotTrusted(f"'{path}' is none of SB3's, sb3-contrib's or sb3_torcs's classes")
    with needs_extra(f"'{path}'"):
        found = getattr(importlib.import_module(module), name, None)
    if not isinstance(found, type) or found.__module__ != module:
        raise ModelNotTrusted(f"'{module}' has no class '{name}'")
    return found


def _build(item: Any) -> Any:
    """Put the classes back into plain data."""
    if isinstance(item, dict):
        if set(item) == {"class"}:
            return _known_class(str(item["class"]), PART_MODULES)
        return {key: _build(value) for key, value in item.items()}
    return [_build(value) for value in item] if isinstance(item, list) else item


def _numbers(item: Any) -> Iterator[int]:
    """Walk over all whole numbers in plain data."""
    if isinstance(item, dict | list):
        for value in item.values() if isinstance(item, dict) else item:
            yield from _numbers(value)
    elif isinstance(item, int) and not isinstance(item, bool):
        yield item
