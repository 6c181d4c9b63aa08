"""Values in hyperparameter files: no string is evaluated, and each is one that fits its key."""

from __future__ import annotations

import ast
import contextlib
import copy
import importlib
import re
from collections.abc import Callable, Container, Iterable, Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym
from torch import nn
from torch.nn.modules import activation

from sb3_torcs.car import is_count, is_number
from sb3_torcs.errors import ZooConfigError, near_miss
from sb3_torcs.files import plain_python

__all__ = [
    "EVALUATED",
    "SCHEDULES",
    "as_data",
    "check_class",
    "check_data",
    "check_jax",
    "check_noise",
    "check_numbers",
    "check_sight",
    "policy_arguments",
    "policy_classes",
    "suggest_entries",
]

EVALUATED = (
    "monitor_kwargs", "normalize", "policy_kwargs", "replay_buffer_class", "replay_buffer_kwargs",
)  # fmt: skip
"""What the zoo evaluates as Python where it is a string."""


def as_data(entry: Mapping[str, Any]) -> dict[str, Any]:
    """
    Replace strings that the zoo would evaluate by their values, if these are plain data.

    :param entry: of a hyperparameter file
    :return: a copy; strings that are more than data are unchanged
    """
    result = copy.deepcopy(dict(entry))
    for key in EVALUATED:
        if isinstance(result.get(key), str):
            with contextlib.suppress(ValueError):
                result[key] = plain_python(result[key])
    return result


def check_data(entry: Mapping[str, Any], place: str) -> None:
    """
    Make sure that the zoo evaluates no string of an entry as code.

    ``policy_kwargs`` may be a string of data and activations, as in the zoo's own files:
    ``dict(net_arch=[64], activation_fn=nn.ReLU)``.

    :param entry: of :func:`as_data`
    :param place: where it stands, for the message
    :raises ZooConfigError: if a string is more than data
    """
    for key in EVALUATED:
        if not isinstance(entry.get(key), str):
            continue
        if key != "policy_kwargs" or isinstance(policy_arguments(entry), str):
            raise ZooConfigError(
                f"{place}: {key} is {entry[key]!r:.80}, which is code, and no code is evaluated; "
                "write a mapping, as in the shipped files"
            )


def check_class(found: Callable[..., Any], path: str, key: str, place: str) -> None:
    """
    Make sure that a dotted path names a class of the kind that its key needs.

    :param found: what was imported
    :param path: its dotted path
    :param key: under which it stands
    :param place: where that is, for the message
    :raises ZooConfigError: if it is of another kind
    """
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.policies import BasePolicy
    from stable_baselines3.common.vec_env import VecEnvWrapper

    kinds: dict[str, type] = {
        "callback": BaseCallback,
        "env_wrapper": gym.Wrapper,
        "policy": BasePolicy,
        "vec_env_wrapper": VecEnvWrapper,
    }
    kind = kinds[key]
    if not isinstance(found, type) or not issubclass(found, kind):
        raise ZooConfigError(
            f"{place}: {key} '{path}' is not a subclass of {kind.__module__}.{kind.__qualname__}; "
            "correct the dotted path"
        )


def check_jax(policy: Any, policy_kwargs: Any, place: str) -> None:
    """
    Make sure that an entry for SBX asks for nothing of PyTorch.

    :param policy: class of the policy
    :param policy_kwargs: of :func:`as_data`; a string names an activation of PyTorch
    :param place: where they stand, for the message
    :raises ZooConfigError: if it does
    """
    base = importlib.import_module("sbx.common.policies").BaseJaxPolicy
    named = "policy" if not issubclass(policy, base) else "policy_kwargs"
    if named == "policy" or isinstance(policy_kwargs, str):
        raise ZooConfigError(
            f"{place}: {named} is of PyTorch, and SBX computes with JAX; the shipped entry for "
            "it is that of sac; for others give a file of your own: --conf-file"
        )


def check_sight(policy: Any, space: gym.Space[Any], place: str) -> None:
    """
    Make sure that a policy of SB3 can read an environment's observations.

    :param policy: its alias or dotted path
    :param space: of the observations
    :param place: where the policy stands, for the message
    :raises ZooConfigError: if it reads pictures, dicts or rows of numbers, and gets another kind
    """
    from stable_baselines3.common.preprocessing import is_image_space

    _, dotted, name = str(policy).rpartition(".")
    kinds = {"Cnn": "pictures", "MultiInput": "dicts", "Mlp": "rows of numbers"}
    needs = next((kind for kind in kinds if kind in name), None)
    gets = "MultiInput" if isinstance(space, gym.spaces.Dict) else "Mlp"
    if needs == "Cnn" and is_image_space(space):
        gets = "Cnn"
    if needs is not None and needs != gets:
        other = f"{gets}Policy" if dotted else name.replace(needs, gets)
        raise ZooConfigError(
            f"{place}: policy is {policy}, which reads {kinds[needs]}, and the environment "
            f"gives {kinds[gets]}; use {other}"
        )


def _is_budget(value: Any) -> bool:
    try:
        return not isinstance(value, bool) and 1.0 <= float(value) < float("inf")
    except (TypeError, ValueError):
        return False


def _is_schedule(value: Any) -> bool:
    if isinstance(value, str):
        return bool(re.fullmatch(f"lin_{NUMBER}", value))
    return value is None or (is_number(value) and value >= 0.0)


def _is_entropy_weight(value: Any) -> bool:
    return is_number(value) or bool(isinstance(value, str) and re.fullmatch(AUTO, value))


def _is_frequency(value: Any) -> bool:
    if isinstance(value, list | tuple):
        return len(value) == 2 and is_count(value[0]) and value[1] in ("step", "episode")
    return is_count(value)


def _is_share(value: Any) -> bool:
    return is_number(value) and 0.0 <= value <= 1.0


NUMBER = r"(\d+\.?\d*|\.\d+)(e[+-]?\d+)?"  # in texts that SB3 or the zoo read
AUTO = f"auto(_{NUMBER})?"
"""Lets SAC and its like learn the weight of the entropy, from the value that follows."""

NOISE_TYPES = ("normal", "ornstein-uhlenbeck")

SCHEDULES = ("learning_rate", "clip_range", "clip_range_vf", "delta_std")
"""What the zoo lets fall to 0 over a training if it is written as ``lin_…``."""

NUMBERS: tuple[tuple[tuple[str, ...], Callable[[Any], bool], str], ...] = (
    (("n_timesteps",), _is_budget, "a number >= 1"),
    (
        SCHEDULES,
        _is_schedule,
        "a number >= 0 (for YAML 1e-3 is text, and 1.0e-3 a number), or lin_NUMBER to fall to 0",
    ),
    (
        (
            "n_envs",
            "batch_size",
            "buffer_size",
            "n_steps",
            "n_epochs",
            "policy_delay",
            "target_update_interval",
        ),
        is_count,
        "a whole number >= 1, e.g. 64",
    ),
    (("train_freq",), _is_frequency, "a whole number >= 1, or e.g. [1, episode]"),
    (
        ("ent_coef",),
        _is_entropy_weight,
        "a number, e.g. 1.0e-3 (for YAML 1e-3 is text); SAC, TQC and CrossQ also learn it: auto, "
        "or auto_0.1 to begin with 0.1",
    ),
    (
        ("vf_coef", "max_grad_norm"),
        is_number,
        "a number, e.g. 5.0e-1 (for YAML 5e-1 is text)",
    ),
    (
        ("target_kl",),
        lambda value: value is None or is_number(value),
        "a number, e.g. 1.0e-2 (for YAML 1e-2 is text)",
    ),
    (
        ("frame_stack",),
        lambda value: value is None or is_count(value),
        "a whole number >= 1, e.g. 4",
    ),
    (("gamma", "tau", "gae_lambda"), _is_share, "a number from 0 to 1, e.g. 0.005"),
    (
        ("learning_starts",),
        lambda value: is_count(value, 0),
        "a whole number >= 0",
    ),
    (
        ("gradient_steps",),
        lambda value: is_count(value, -1) and value != 0,
        "a whole number >= 1, or -1",
    ),
)
"""Numbers that are read, or used, only when the training has begun: keys, rule, and its words."""


def check_numbers(entry: Mapping[str, Any], taken: Container[str], place: str) -> None:
    """
    Make sure that numbers have values with which a training can run.

    :param entry: of a hyperparameter file
    :param taken: names of the arguments that the algorithm takes
    :param place: where it stands, for the message
    :raises ZooConfigError: for the first one that has not
    """
    for keys, good, words in NUMBERS:
        for key in keys:
            if key in entry and not good(entry[key]):
                raise ZooConfigError(f"{place}: {key} is {entry[key]!r}; expected {words}")
    weight = entry.get("ent_coef")
    if isinstance(weight, str) and "target_entropy" not in taken:
        raise ZooConfigError(
            f"{place}: ent_coef is '{weight}', which this algorithm does not learn; expected a "
            "number, e.g. 1.0e-3"
        )


def check_noise(entry: Mapping[str, Any], exploring: bool, algo: str, place: str) -> None:
    """
    Make sure that the zoo can build the action noise of an entry.

    :param entry: of a hyperparameter file
    :param exploring: whether the algorithm takes an action noise
    :param algo: as the zoo calls it
    :param place: where the entry stands, for the message
    :raises ZooConfigError: if it cannot
    """
    kind: Any = entry.get("noise_type")
    deviation: Any = entry.get("noise_std")
    if kind is None:
        return
    if not exploring:
        raise ZooConfigError(
            f"{place}: noise_type is {kind!r}, and {algo} takes no action noise; remove it, or use "
            "ddpg, td3, sac or tqc"
        )
    if not isinstance(kind, str) or not any(known in kind for known in NOISE_TYPES):
        raise ZooConfigError(
            f"{place}: noise_type is {kind!r}; expected one of {', '.join(NOISE_TYPES)}"
        )
    if not is_number(deviation) or deviation < 0.0:
        raise ZooConfigError(
            f"{place}: noise_type needs a noise_std, and that is {deviation!r}; expected a number "
            ">= 0, e.g. 0.1"
        )


def policy_arguments(entry: Mapping[str, Any]) -> Any:
    """
    Read the ``policy_kwargs`` of an entry, also those that name activations.

    :param entry: of :func:`as_data`
    :return: names and values, with activations as text; or what stands there, if it cannot be read
    """
    value = entry.get("policy_kwargs")
    try:
        return _with_activations(value) if isinstance(value, str) else value
    except ValueError:
        return value


def policy_classes(entry: Mapping[str, Any]) -> Any:
    """
    Read the ``policy_kwargs`` of a checked entry for the algorithm.

    :param entry: of :func:`as_data`
    :return: names and values, with activations as classes of PyTorch
    """
    arguments = policy_arguments(entry)
    if isinstance(entry["policy_kwargs"], str) and isinstance(arguments.get("activation_fn"), str):
        arguments["activation_fn"] = getattr(nn, arguments["activation_fn"])
    return arguments


def _with_activations(text: str) -> Any:
    """Read an expression that is plain data once ``nn.ReLU`` and its like are replaced."""

    class Named(ast.NodeTransformer):
        def visit_Attribute(self, node: ast.Attribute) -> ast.expr:
            owner, _, name = ast.unparse(node).rpartition(".")
            known = owner == "nn" and name in activation.__all__
            return ast.Constant(name) if known else node

    return plain_python(text, Named())


def suggest_entries(name: str, known: Iterable[str], path: Path) -> str:
    """
    Complete a message about an entry that a hyperparameter file lacks.

    :param name: of the entry
    :param known: the names of those that the file has
    :param path: of the file, beside which others may have it
    :return: e.g. ``"; it has: Torcs-v0; ppo.yml has it, so add: --algo ppo"``
    """
    elsewhere = ""
    for other in sorted(path.parent.glob("*.yml")):
        with contextlib.suppress(OSError, UnicodeDecodeError):
            if re.search(rf"^{re.escape(name)}:", other.read_text(encoding="utf-8"), re.MULTILINE):
                elsewhere = f"; {other.name} has it, so add: --algo {other.stem}"
    return near_miss(name, known, f"it has: {', '.join(known)}{elsewhere}")
