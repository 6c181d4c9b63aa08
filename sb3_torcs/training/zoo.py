"""Hyperparameter files: find them, and check them before anything starts.

The RL Zoo passes unknown keys to the algorithm, for some keys hours later. This module reads an
entry by the same rules, and reports a key that nothing would read.
"""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
import inspect
import os
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import yaml
from stable_baselines3.common.policies import ActorCriticPolicy

from sb3_torcs.agents.saved.algorithm import ALGORITHMS, SBX, algorithm_class
from sb3_torcs.agents.wrapping import find_unbuildable, normalizes, wrap_env
from sb3_torcs.car import is_count, look_both_ways, range_finder_angles
from sb3_torcs.errors import InvalidOption, ModelMismatch, ZooConfigError, near_miss
from sb3_torcs.files import as_list, import_advice, path_and_arguments, read_yaml
from sb3_torcs.training.zoo_data import (
    as_data,
    check_class,
    check_data,
    check_jax,
    check_noise,
    check_numbers,
    check_sight,
    policy_arguments,
    suggest_entries,
)

__all__ = [
    "OURS",
    "TIME_LIMIT",
    "ZOO_KEYS",
    "Place",
    "check_entry",
    "check_env_kwargs",
    "check_racing",
    "check_registered",
    "checked_env",
    "config_file",
    "read_config",
    "read_entry",
    "timesteps",
]

Entry = dict[str, Any]

ZOO_KEYS = frozenset(
    {
        "callback", "env_kwargs", "env_wrapper", "frame_stack", "monitor_kwargs", "n_envs",
        "n_timesteps", "noise_std", "noise_type", "normalize", "policy", "policy_kwargs",
        "vec_env_wrapper",
    }
)  # fmt: skip
"""What the RL Zoo itself reads of an entry; all else goes to the algorithm's constructor."""

GIVEN_BY_ZOO = ("self", "env", "tensorboard_log", "seed", "verbose", "device", "_init_setup_model")
"""Arguments of the constructor that the zoo passes itself: in an entry they would clash."""

GIVEN_BY_POLICY_OWNER = ("self", "observation_space", "action_space", "lr_schedule")
"""Arguments of a policy that the algorithm passes itself."""

TIME_LIMIT = "max_episode_steps"
"""What ``gym.make`` itself takes of an entry's ``env_kwargs``: it holds for training episodes."""

REQUIRED = ("n_timesteps", "policy")

OURS = ("Torcs-v0", "TorcsLite-v0")


class Place(NamedTuple):
    """The file and the name of an entry, for messages."""

    file: Path
    entry: str

    def __str__(self) -> str:
        return f"{self.file}, entry '{self.entry}'"


def shipped_folder() -> Path:
    """Return the folder of the shipped files: the installed package, or that of a checkout."""
    spec = importlib.util.find_spec("sb3_torcs.zoo_configs")
    if spec is not None and spec.submodule_search_locations:
        return Path(next(iter(spec.submodule_search_locations)))
    return Path(__file__).resolve().parents[2] / "zoo_configs"


def config_file(
    algo: str, conf_file: str | Path | None = None, option: str = "--conf-file FILE.yml"
) -> Path:
    """
    Find the hyperparameter file of an algorithm.

    :param algo: as the zoo calls it, e.g. ``"ddpg"``
    :param conf_file: a file to use instead of the shipped one
    :param option: how to give such a file, for the message
    :return: its path
    :raises ZooConfigError: if there is none
    """
    if conf_file is not None:
        path = Path(os.path.expanduser(conf_file))
        if not path.is_file():
            raise ZooConfigError(f"there is no hyperparameter file '{path}'; give a .yml file")
        return path
    path = shipped_folder() / f"{algo.removeprefix(SBX)}.yml"
    if not path.is_file():
        known = sorted(file.stem for file in shipped_folder().glob("*.yml"))
        example = shipped_folder() / "sac.yml"
        advice = f"shipped: {', '.join(known)}; else give a changed copy of {example}: {option}"
        raise ZooConfigError(
            f"no hyperparameters are shipped for the algorithm '{algo}'"
            f"{near_miss(algo, () if algo in ALGORITHMS else known, advice)}"
        )
    return path


def read_config(path: Path) -> dict[str, Entry]:
    """
    Read a hyperparameter file.

    :param path: of a YAML file
    :return: its entries by name
    :raises ZooConfigError: if it is not a mapping of mappings
    """
    try:
        entries = read_yaml(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        mark = getattr(error, "problem_mark", None)
        line = f", line {mark.line + 1}" if mark else ""
        problem = getattr(error, "problem", None) or error
        raise ZooConfigError(f"{path}{line}: not YAML: {problem}") from error
    if not isinstance(entries, dict) or not entries:
        raise ZooConfigError(f"{path}: expected entries 'ENV-ID: {{key: value}}'")
    for name, entry in entries.items():
        if not isinstance(name, str):
            raise ZooConfigError(f"{path}: an entry is called {name!r}; expected a word")
        if not isinstance(entry, dict):
            raise ZooConfigError(f"{Place(path, name)}: expected a mapping, got {entry!r:.80}")
    return entries


def read_entry(path: Path, name: str) -> Entry:
    """
    Read one entry, as a copy.

    :param path: of a YAML file
    :param name: of the entry: an environment's id, or what the file calls it
    :return: the entry; that called ``default`` is of every environment without one of its own
    :raises ZooConfigError: if the file has no such entry
    """
    entries = read_config(path)
    if name in gym.registry and name not in entries and "default" in entries:
        name = "default"
    if name not in entries:
        raise ZooConfigError(f"{path} has no entry '{name}'{suggest_entries(name, entries, path)}")
    return as_data(entries[name])


def check_entry(entry: Entry, algo: str, env_id: str, place: Place) -> None:
    """
    Make sure that every key of an entry is used.

    :param entry: as read from the file
    :param algo: as the zoo calls it
    :param env_id: a registered environment
    :param place: where the entry stands
    :raises ZooConfigError: for the first mistake
    """
    check_data(entry, str(place))
    try:
        algorithm = algorithm_class(algo)
    except InvalidOption as error:
        raise ZooConfigError(str(error)) from None
    for key in REQUIRED:
        if key not in entry:
            raise ZooConfigError(f"{place}: key '{key}' is missing")
    constructor = (_arguments(algorithm) or set()) - set(GIVEN_BY_ZOO)
    check_numbers(entry, constructor, str(place))
    _check_keys(entry, ZOO_KEYS | constructor, "key", place)
    check_noise(entry, "action_noise" in constructor, algo, str(place))
    policy = _policy(entry["policy"], algorithm, place)
    _check_call("policy_kwargs", policy, policy_arguments(entry), place, GIVEN_BY_POLICY_OWNER)
    if algo.startswith(SBX):
        check_jax(policy, entry.get("policy_kwargs"), str(place))
    for key in ("callback", "env_wrapper", "vec_env_wrapper"):
        for path, arguments in _items(entry.get(key), key, place):
            _check_call(f"{key} {path}", _imported(path, key, place), arguments, place)
    reason = find_unbuildable(entry)
    if reason is not None:
        raise ZooConfigError(f"{place}: {reason}; or take it away: 'vec_env_wrapper: null'")
    check_env_kwargs(entry.get("env_kwargs"), env_id, place)
    _check_wrappers(entry, place)
    _check_symmetric(entry, place)
    if entry.get("normalize") and entry.get("frame_stack") and "buffer_size" in constructor:
        raise ZooConfigError(
            f"{place}: {algo} cannot learn with both normalize and frame_stack, since its replay "
            "buffer keeps what is not normalized; take normalize away: observations are scaled"
        )


def checked_env(entry: Entry, env_id: str, place: Place) -> gym.Env[Any, Any]:
    """
    Make one environment of a training, so that a mistake is reported before anything starts.

    :param entry: that :func:`check_entry` has seen
    :param env_id: a registered environment
    :param place: where the entry stands
    :return: the environment within its wrappers; whoever calls closes it
    :raises ZooConfigError: if a wrapper does not go around it, or the policy cannot read it
    """
    env = gym.make(env_id, **(entry.get("env_kwargs") or {}))
    with contextlib.ExitStack() as unless_checked:
        unless_checked.callback(env.close)
        try:
            driven = wrap_env(env, entry, trust=True)
        except ModelMismatch as error:
            if error.__cause__ is None:
                raise ZooConfigError(f"{place}: {error}") from error
            raise ZooConfigError(
                f"{place}: an env_wrapper does not go around the car ({error.__cause__}); "
                "give its arguments below its dotted path"
            ) from error
        check_sight(entry["policy"], driven.observation_space, str(place))
        unless_checked.pop_all()
    return driven


def _check_symmetric(entry: Entry, place: Place) -> None:
    """Make sure that observations have a mirror image, if the policy is symmetric."""
    arguments = policy_arguments(entry)
    if not isinstance(arguments, Mapping) or not arguments.get("symmetric"):
        return
    if normalizes(entry.get("normalize")):
        raise ZooConfigError(
            f"{place}: policy_kwargs has symmetric, which needs observations whose middle is 0, "
            "and normalize moves it; take one of them away: the observations are scaled already"
        )
    if (entry.get("frame_stack") or 1) > 1:
        raise ZooConfigError(
            f"{place}: policy_kwargs has symmetric, which needs one observation at a time, and "
            f"frame_stack is {entry['frame_stack']}; take one of them away"
        )
    env_kwargs = entry.get("env_kwargs") or {}
    if not look_both_ways(range_finder_angles(env_kwargs.get("range_finders", "scr"))):
        raise ZooConfigError(
            f"{place}: policy_kwargs has symmetric, which needs range finders that look equally "
            "far to both sides; take it away, or set range_finders to scr or narrow"
        )


def check_env_kwargs(env_kwargs: Any, env_id: str, place: Place | str) -> None:
    """
    Check what goes to ``gym.make``.

    :param env_kwargs: names and values
    :param env_id: of the environment
    :param place: where they were given
    :raises ZooConfigError: if the environment does not have one of them
    """
    if not isinstance(env_kwargs, Mapping | None):
        raise ZooConfigError(f"{place}: env_kwargs is {env_kwargs!r}; expected '{{key: value}}'")
    if env_kwargs is not None and TIME_LIMIT in env_kwargs:
        limit = env_kwargs[TIME_LIMIT]
        if not is_count(limit):
            raise ZooConfigError(
                f"{place}: {TIME_LIMIT} is {limit!r}; expected a whole number of timesteps >= 1"
            )
        env_kwargs = {key: value for key, value in env_kwargs.items() if key != TIME_LIMIT}
    _check_call("env_kwargs", _env_class(env_id), env_kwargs, place)


def _check_wrappers(entry: Entry, place: Place) -> None:
    """Check what goes to Monitor and to VecNormalize."""
    from stable_baselines3.common.monitor import Monitor
    from stable_baselines3.common.vec_env import VecNormalize

    _check_call("normalize", VecNormalize, entry.get("normalize"), place, ("self", "venv"))
    keywords = entry.get("monitor_kwargs")
    _check_call("monitor_kwargs", Monitor, keywords, place, ("self", "env", "filename"))
    if isinstance(keywords, Mapping):
        kinds = {type(keywords.get(key, ())) for key in ("info_keywords", "reset_keywords")}
        # Monitor adds the two, which have to be of one type; its default is a tuple.
        if len(kinds) > 1:
            raise ZooConfigError(
                f"{place}: monitor_kwargs needs both info_keywords and reset_keywords as lists; "
                "add the other one as []"
            )


def check_registered(env_id: str) -> None:
    """
    Make sure that an environment exists.

    :param env_id: as for ``gym.make``, without a module
    :raises ZooConfigError: if it is not registered
    """
    if env_id not in gym.registry:
        hint = near_miss(env_id, OURS, f"ours: {', '.join(OURS)}")
        raise ZooConfigError(f"no environment '{env_id}' is registered{hint}")


def check_racing(env_id: str) -> None:
    """
    Make sure that an environment exists and is one of racing.

    :param env_id: as for ``gym.make``, without a module
    :raises ZooConfigError: if it is not
    """
    from sb3_torcs.envs.racing import RacingEnv

    check_registered(env_id)
    built = _env_class(env_id)
    if not (isinstance(built, type) and issubclass(built, RacingEnv)):
        raise ZooConfigError(f"{env_id} is not a racing environment; ours: {', '.join(OURS)}")


def timesteps(entry: Entry) -> int:
    """
    Read the number of timesteps of an entry. YAML reads ``1e5`` as a string.

    :param entry: that :func:`check_entry` has seen
    :return: its ``n_timesteps``
    """
    return int(float(entry["n_timesteps"]))


def _env_class(env_id: str) -> Callable[..., Any]:
    """Return what builds an environment."""
    entry_point = gym.spec(env_id).entry_point
    if isinstance(entry_point, str):
        module, _, name = entry_point.partition(":")
        return getattr(importlib.import_module(module), name)
    if entry_point is None:
        raise ZooConfigError(f"{env_id} has no entry point; register it with one")
    return entry_point


def _policy(name: Any, algorithm: Any, place: Place) -> Callable[..., Any]:
    """Find the class that a policy's alias or dotted path stands for."""
    known = algorithm.policy_aliases
    advice = f"allowed: {', '.join(known)}"
    if isinstance(name, str) and "." in name:
        policy = _imported(name, "policy", place)
        fits = any(issubclass(each, ActorCriticPolicy) for each in known.values())
        if not fits and isinstance(policy, type) and issubclass(policy, ActorCriticPolicy):
            raise ZooConfigError(f"{place}: {name} is a policy for PPO and A2C; {advice}")
        return policy
    if not isinstance(name, str) or name not in known:
        advice += ", or a dotted path such as sb3_torcs.policies.SplitHeadPolicy"
        raise ZooConfigError(f"{place}: unknown policy {name!r}{near_miss(name, known, advice)}")
    return known[name]


def _items(value: Any, key: str, place: Place) -> list[tuple[str, Mapping[str, Any]]]:
    """
    Read a list of callbacks or wrappers in any of the zoo's forms.

    :param value: a dotted path, ``{path: {argument: value}}``, a list of those, or ``None``
    :param key: its key
    :param place: where it stands
    :return: dotted paths and their arguments
    """
    result: list[tuple[str, Mapping[str, Any]]] = []
    for item in as_list(value):
        try:
            result.append(path_and_arguments(item))
        except ValueError:
            raise ZooConfigError(
                f"{place}: {key} has {item!r}; expected a dotted path, or one dotted path with "
                "its arguments indented below it (check the indentation)"
            ) from None
    return result


def _imported(path: str, key: str, place: Place) -> Callable[..., Any]:
    """Import a class by its dotted path."""
    module_name, _, name = path.rpartition(".")
    try:
        module = importlib.import_module(module_name)
    except (ImportError, ValueError) as error:
        raise ZooConfigError(
            f"{place}: {key} '{path}' does not import ({error}); {import_advice(module_name)}"
        ) from error
    if not hasattr(module, name):
        raise ZooConfigError(
            f"{place}: {key} '{path}': {module_name} has no '{name}'"
            f"{near_miss(name, vars(module), 'correct the dotted path')}"
        )
    found = getattr(module, name)
    check_class(found, path, key, str(place))
    return found


def _arguments(function: Callable[..., Any]) -> set[str] | None:
    """
    Return the names of a constructor's arguments, with those that it passes to its bases.

    :param function: a class, or a function that builds one
    :return: the names; ``None`` if it takes any
    """
    names: set[str] = set()
    for step in function.__mro__[:-1] if inspect.isclass(function) else (function,):
        own = vars(step).get("__init__") if inspect.isclass(step) else step
        if own is None:
            continue
        parameters = inspect.signature(own).parameters.values()
        kinds = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)
        names.update(p.name for p in parameters if p.kind in kinds)
        if not any(p.kind is inspect.Parameter.VAR_KEYWORD for p in parameters):
            return names
    return None


def _check_call(
    what: str,
    function: Callable[..., Any],
    arguments: Any,
    place: Place | str,
    given: Iterable[str] = ("self",),
) -> None:
    """Make sure that a constructor has these arguments; the zoo evaluates strings itself."""
    known = _arguments(function)
    if isinstance(arguments, Mapping) and known is not None:
        _check_keys(arguments, known - set(given), f"{what}: argument", place)


def _check_keys(
    mapping: Mapping[str, Any], known: Iterable[str], what: str, place: Place | str
) -> None:
    """Make sure that all keys are known."""
    known = sorted(known)
    for key in mapping:
        if key not in known:
            hint = near_miss(key, known) or f"; allowed: {', '.join(known)}"
            raise ZooConfigError(f"{place}: unknown {what} '{key}'{hint}")
