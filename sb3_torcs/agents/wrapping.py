"""Rebuild the wrappers of a training around an environment.

The RL Zoo's order is: ``env_wrapper``, ``vec_env_wrapper``, ``normalize``, ``frame_stack``. The
first changes the environment, and is put around it here. The last two change what a model sees, so
they belong to the driver (:class:`sb3_torcs.agents.models.ModelDriver`).
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator, Mapping
from typing import Any

import gymnasium as gym
from gymnasium import spaces

from sb3_torcs.agents.saved.file import raise_mismatch
from sb3_torcs.errors import ModelMismatch, ModelNotTrusted, PackageMissing
from sb3_torcs.files import as_list, import_advice, path_and_arguments, plain_python

__all__ = ["LEFT_OUT", "find_unbuildable", "frames_of", "normalizes", "stack_space", "wrap_env"]

TRUSTED_PACKAGES = ("sb3_torcs", "gymnasium", "stable_baselines3", "sb3_contrib", "rl_zoo3")
"""Whose wrappers a record may name: importing them, and putting them around, does no harm."""

LEFT_OUT = {
    "Monitor", "NormalizeReward", "OrderEnforcing", "PassiveEnvChecker", "RecordEpisodeStatistics",
    "RecordVideo", "TimeLimit",
}  # fmt: skip
"""Wrappers that end or write down a training, and change nothing that is seen or done."""

REFUSED = {
    "TimeAwareObservation": "shows a training's time limit, and a race has another; train without "
    "it",
    "NormalizeObservation": "learns statistics, which no model keeps; train with SB3's "
    "VecNormalize",
}
"""Wrappers that would show something else than in the training, and why."""

PASSING_ON = {"MirrorVecEnv", "VecMonitor", "VecCheckNan", "VecNormalize", "VecVideoRecorder"}
"""Wrappers of vectors that leave a single car as it is, or whose statistics are kept with the
model."""
VECTORS = ("sb3_torcs.vec_env", "stable_baselines3.common.vec_env")
"""Where they are defined."""


def wrap_env(
    env: gym.Env[Any, Any], hyperparameters: Mapping[str, Any], *, trust: bool = False
) -> gym.Env[Any, Any]:
    """
    Put the wrappers of a training around an environment.

    :param env: the bare one
    :param hyperparameters: of the training, as the RL Zoo reads them
    :param trust: import wrappers of any package
    :return: the environment that the model knows; the bare one if there are no wrappers
    :raises ModelNotTrusted: if a wrapper is neither of this package nor of those it is made from
    :raises PackageMissing: if a wrapper cannot be imported
    :raises ModelMismatch: if it is not a wrapper, or does not fit this environment
    """
    items = list(_items(hyperparameters, "env_wrapper"))
    if items:
        # In a training SB3's Monitor is here; some wrappers inspect the environment below them.
        env = gym.Wrapper(env)
    for path, kwargs in items:
        name = path.rpartition(".")[2]
        if name in LEFT_OUT:
            continue
        if name in REFUSED:
            raise ModelMismatch(f"{path} {REFUSED[name]}")
        wrapper = _import(path, trust)
        with raise_mismatch(f"the training's wrapper {path} does not go around the car", "give"):
            env = wrapper(env, **kwargs)
    return env


def frames_of(hyperparameters: Mapping[str, Any]) -> int | None:
    """
    Read how many observations a model sees at once.

    :param hyperparameters: of its training
    :return: their number; ``None`` if it sees one as it is
    :raises ModelMismatch: if it is not a number
    """
    frames = hyperparameters.get("frame_stack")
    if frames is not None and (type(frames) is not int or frames < 1):
        raise ModelMismatch(f"frame_stack of a training is {frames!r}; expected a number >= 1")
    return frames


def stack_space(space: spaces.Space[Any], frames: int | None) -> spaces.Space[Any]:
    """
    Return the space of so many observations at once.

    :param space: of one
    :param frames: how many; ``None`` is one as it is
    :return: as behind ``VecFrameStack``
    :raises ModelMismatch: if they cannot be put in a row
    """
    if frames is None:
        return space
    if not isinstance(space, spaces.Box) or len(space.shape) != 1:
        raise ModelMismatch(
            f"frame_stack is for observations that are one row of numbers, not for {space}"
        )
    from stable_baselines3.common.vec_env.stacked_observations import StackedObservations

    return StackedObservations(1, frames, space).stacked_observation_space


def normalizes(normalize: Any) -> bool:
    """
    Read whether a training has normalized observations.

    :param normalize: of its hyperparameters; a string is Python that the zoo evaluates
    """
    if isinstance(normalize, str):
        try:
            normalize = plain_python(normalize)
        except ValueError:  # code: to take it for a yes asks for the statistics
            return True
    if isinstance(normalize, Mapping):
        return bool(normalize and normalize.get("norm_obs", True))
    return normalize is True


def find_unbuildable(hyperparameters: Mapping[str, Any]) -> str | None:
    """
    Find a wrapper that cannot be put around a single car.

    :param hyperparameters: of a training
    :return: why not; ``None`` if there is none
    """
    for path, _ in _items(hyperparameters, "vec_env_wrapper"):
        package, _, name = path.rpartition(".")
        if name not in PASSING_ON or not package.startswith(VECTORS):
            return (
                f"vec_env_wrapper {path} changes vectors of environments, and cannot be put around "
                "the one car of an evaluation; use an env_wrapper, or frame_stack"
            )
    return None


def _items(hyperparameters: Mapping[str, Any], key: str) -> Iterator[tuple[str, dict[str, Any]]]:
    """Read dotted paths and arguments in any of the zoo's forms."""
    for item in as_list(hyperparameters.get(key)):
        try:
            yield path_and_arguments(item)
        except ValueError:
            raise ModelMismatch(
                f"{key} of a training has {item!r}; expected a dotted path, or one with arguments"
            ) from None


def _import(path: str, trust: bool) -> Any:
    """Import a wrapper by its dotted path."""
    module, _, name = path.rpartition(".")
    if module == "__main__":
        raise ModelMismatch(
            f"the model was trained behind {name}, a wrapper of a script, which nothing else can "
            "import; put it into a module, or evaluate the model in the script, by evaluate_policy "
            "of SB3"
        )
    if module.partition(".")[0] not in TRUSTED_PACKAGES and not trust:
        raise ModelNotTrusted(
            f"the model was trained behind the wrapper {path}, and importing it runs its code; if "
            "you know who made it, add --trust (from Python: trust=True)"
        )
    try:
        found = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise PackageMissing(
            f"the model was trained behind the wrapper {path}, which does not import ({error}); "
            f"{import_advice(module)}"
        ) from error
    if not (isinstance(found, type) and issubclass(found, gym.Wrapper)):
        raise ModelMismatch(
            f"env_wrapper of a training has {path}, which is not a gymnasium.Wrapper"
        )
    return found
