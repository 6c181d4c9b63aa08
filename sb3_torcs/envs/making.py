"""How the races of a vector environment are made."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import gymnasium as gym
from gymnasium.wrappers import TimeLimit

from sb3_torcs import cores
from sb3_torcs.car import checked_flag, is_count
from sb3_torcs.envs.racing import RacingEnv
from sb3_torcs.envs.torcs_race import make_race
from sb3_torcs.errors import InvalidOption
from sb3_torcs.torcs.installation import find_game
from sb3_torcs.torcs.opponents import agents_among

__all__ = [
    "MANY_RACES",
    "NO_LIMIT",
    "EnvMaker",
    "checked_threads",
    "checked_time_limit",
    "env_makers",
    "refuse_flag",
]

EnvMaker = Callable[[], gym.Env[Any, Any]]

NO_LIMIT = -1  # as in gym.make
MANY_RACES = 10_000  # [-] at once: a greater number is mistyped


def checked_time_limit(steps: Any, env_id: str, *, unlimited: str = "-1") -> int:
    """
    Check the option ``max_episode_steps`` as ``gym.make`` means it.

    :param steps: timesteps; ``None`` is the limit that the environment is registered with, -1 none
    :param env_id: of the environment
    :param unlimited: what to advise for no limit
    :return: timesteps, or ``NO_LIMIT``
    :raises InvalidOption: if it is no such number
    """
    if steps is None:
        return gym.spec(env_id).max_episode_steps or NO_LIMIT
    if not is_count(steps, NO_LIMIT) or steps == 0:
        raise InvalidOption(
            f"max_episode_steps is {steps!r}; expected a whole number >= 1, or {unlimited} for no "
            "limit"
        )
    return int(steps)


def checked_threads(threads: Any) -> int:
    """
    Check how many threads are to drive.

    :param threads: their number; ``None`` is one per core
    :return: their number
    :raises InvalidOption: if it is no such number
    """
    if threads is None:
        return cores.number()
    if not is_count(threads):
        raise InvalidOption(f"threads is {threads!r}; expected a whole number >= 1, or None")
    return int(threads)


def env_makers(races: int, agents: int, env_id: str, env_kwargs: dict[str, Any]) -> list[EnvMaker]:
    """
    Return functions that make the environments of some races, one for each agent.

    :param races: their number
    :param agents: in each
    :param env_id: ``"Torcs-v0"`` or ``"TorcsLite-v0"``; as in ``gym.make``, also after the name of
        the package that registers it: ``"sb3_torcs:Torcs-v0"``
    :param env_kwargs: of all races; ``max_episode_steps`` may be a list, which goes round
    :raises InvalidOption: if there are no such races
    """
    if not isinstance(env_id, str):
        raise InvalidOption(f"env_id is {env_id!r}; expected 'Torcs-v0' or 'TorcsLite-v0'")
    module, _, env_id = env_id.rpartition(":")
    if module:
        importlib.import_module(module)
    if agents > 1 or _has_agents(env_id, env_kwargs):
        return _shared(races, agents, env_id, env_kwargs)
    limits = _limits(env_kwargs.get("max_episode_steps"), env_id, races)
    kwargs = [{**env_kwargs, "max_episode_steps": limit} for limit in limits]
    return [partial(gym.make, env_id, **each) for each in kwargs]


def _has_agents(env_id: str, env_kwargs: dict[str, Any]) -> bool:
    """Whether agents are among the opponents, whom only a shared race can ask."""
    opponents = env_kwargs.get("opponents", ())
    if not isinstance(opponents, (list, tuple)):
        return False
    several = any(not isinstance(name, str) for name in opponents)
    return env_id == "Torcs-v0" and (several or bool(agents_among(opponents, find_game())))


def _shared(races: int, agents: int, env_id: str, env_kwargs: dict[str, Any]) -> list[EnvMaker]:
    """Make races of several agents; return a function for each environment."""
    if env_id != "Torcs-v0":
        raise InvalidOption(
            f"agents is {agents}, and {env_id} has one car in each race; races are of Torcs-v0"
        )
    options = dict(env_kwargs)
    refuse_flag(checked_flag("flagged", options.pop("flagged", False)))
    limits = _limits(options.pop("max_episode_steps", None), env_id, races)
    envs = [(env, limit) for limit in limits for env in make_race(agents, **options)]
    for env, _ in envs:  # RecordCallback reads it, as gym.make writes it
        env.spec = replace(gym.spec(env_id), kwargs=options, max_episode_steps=None)
    return [partial(_limited, env, limit) for env, limit in envs]


def refuse_flag(flagged: bool) -> None:
    """
    Refuse a race whose agents are flagged off.

    :param flagged: whether they are
    :raises InvalidOption: if so
    """
    if flagged:
        raise InvalidOption(
            "flagged is True, but a car that is flagged off leaves its race, and here it rejoins; "
            "leave it out, or race by sb3_torcs.parallel_env"
        )


def _limits(steps: Any, env_id: str, races: int) -> list[int]:
    """Return the time limit of each race."""
    several = steps if isinstance(steps, (list, tuple)) else [steps]
    if not several:
        raise InvalidOption("max_episode_steps is an empty list; give a number, or some of them")
    limits = [checked_time_limit(each, env_id) for each in several]
    return [limits[race % len(limits)] for race in range(races)]


def _limited(env: RacingEnv, steps: int) -> gym.Env[Any, Any]:
    return env if steps == NO_LIMIT else TimeLimit(env, steps)
