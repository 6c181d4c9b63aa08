"""The evaluation protocol: drive some episodes, write down what happened, and say what is better.

It is written for people in ``docs/evaluation.md``; everything that compares drivers comes here.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from types import MappingProxyType
from typing import Any, NamedTuple

import gymnasium as gym

from sb3_torcs.agents.rollout import Driver, Timestep, drive
from sb3_torcs.agents.saved.record import DRIVEN_WITH
from sb3_torcs.car import CONTROL_TICK, MANY_LAPS, check_count
from sb3_torcs.envs.options import TORCS
from sb3_torcs.errors import InvalidOption, near_miss
from sb3_torcs.telemetry import COLUMNS, DriveLog
from sb3_torcs.torcs.track_names import RANDOM_TRACK

__all__ = [
    "DEFAULT_TRACK",
    "GAME",
    "KEPT",
    "RACE_LAPS",
    "Driver",
    "Episode",
    "Merit",
    "Timestep",
    "drive",
    "evaluate",
    "evaluate_robot",
    "merit",
    "race_environment",
    "time_limit",
]

DEFAULT_TRACK = "aalborg"
RACE_LAPS = 3  # from the grid in a row: what it takes to *complete* a track
GAME, WITHOUT_GAME = "Torcs-v0", "TorcsLite-v0"
LONGEST_TRACK = 10000.0  # [m] for such a one, whose length is not known beforehand
KEPT = ("track", "car", "reward", *DRIVEN_WITH)
"""What an evaluation takes from the training's environment, unless it is told otherwise."""


@dataclass(frozen=True)
class Episode:
    """One episode of an evaluation."""

    laps: int
    lap_times: list[float]  # [s]
    distance: float  # [m]
    end: str  # as in ``info``, or "time_limit"
    damage: float  # [points]
    episode_return: float | None  # ``None`` of a robot, which gets no reward

    @property
    def finished(self) -> bool:
        """Whether all laps that were asked for were driven, without leaving the road."""
        return self.end == "laps"

    @property
    def race_time(self) -> float:
        """Seconds from the start to the end of the last whole lap; 0 without one."""
        return sum(self.lap_times)

    @property
    def flying_lap(self) -> float | None:
        """The best lap [s] but the first one, which begins standing."""
        return min(self.lap_times[1:], default=None)

    def as_dict(self) -> dict[str, Any]:
        """Return the fields as the command prints them."""
        fields = asdict(self)
        fields["return"] = fields.pop("episode_return")
        return fields


class Merit(NamedTuple):
    """How good races are, in the order in which it counts: greater is better."""

    finished: int  # races whose laps were all driven
    distance: float  # [m] in the others
    haste: float  # [s] minus the time of those that were finished


def merit(races: Sequence[Episode]) -> Merit:
    """
    Score the races of one driver, one race per track from the grid. Training keeps the best model.

    On one track, a race of three whole laps beats one without; among those, the shorter time wins;
    among the others, the longer distance.

    :param races: of one driver
    :return: to be compared with that of another driver on the same tracks
    """
    finished = [race for race in races if race.finished]
    others = [race.distance for race in races if not race.finished]
    return Merit(len(finished), sum(others), -sum(race.race_time for race in finished))


def time_limit(kwargs: Mapping[str, Any]) -> int:
    """
    Compute the time limit of an evaluation, long enough for the slowest car that is not stuck.

    :param kwargs: of the environment, with ``laps``
    :return: timesteps
    :raises InvalidOption: if ``action_repeat`` is no whole number of at least 1
    """
    from sb3_torcs.envs.ends import STUCK_SPEED
    from sb3_torcs.tracks.catalogue import load_track

    track = kwargs.get("track", DEFAULT_TRACK)
    length = LONGEST_TRACK if track == RANDOM_TRACK else load_track(track).length
    # One lap more than asked for: for the way from the grid to the line, and as a margin.
    seconds = (kwargs["laps"] + 1) * length / STUCK_SPEED
    action_repeat = kwargs.get("action_repeat", 5)
    check_count("action_repeat", action_repeat)
    return math.ceil(seconds / (action_repeat * CONTROL_TICK))


def race_environment(
    env_id: str,
    env_kwargs: Mapping[str, Any] | None = None,
    track: str | None = None,
    *,
    laps: int = RACE_LAPS,
    hyperparameters: Mapping[str, Any] = MappingProxyType({}),
    trust: bool = False,
) -> gym.Env[Any, Any]:
    """
    Build the environment of an evaluation: laps from the grid.

    It takes track, car, reward, and what an agent drives with (:data:`KEPT`) from the training. It
    leaves out the rest, so that all races are alike: start, time limit, conditions, opponents,
    noise, pictures, and what ends episodes.

    :param env_id: of the training
    :param env_kwargs: of the training; ``None`` if they are not known
    :param track: instead of the training's
    :param laps: to drive
    :param hyperparameters: of the training, whose wrappers are put around the environment
    :param trust: as of :func:`~sb3_torcs.agents.wrapping.wrap_env`
    :return: the environment, whose time limit never ends a race
    :raises InvalidOption: if ``laps`` is no whole number of at least 1, if there is no ``env_id``,
        or if no environment has such an argument
    """
    from sb3_torcs.agents.wrapping import wrap_env

    check_count("laps", laps, MANY_LAPS)
    if not isinstance(env_id, str):
        raise InvalidOption(
            f"env_id is {env_id!r}, as in the record of a model that does not tell where it was "
            f"trained; pass '{GAME}' or '{WITHOUT_GAME}'"
        )
    env_kwargs = env_kwargs or {}
    _check_names(env_kwargs, env_id)
    kwargs = {name: env_kwargs[name] for name in KEPT if name in env_kwargs}
    kwargs.update({"laps": laps}, **({} if track is None else {"track": track}))
    env = gym.make(env_id, max_episode_steps=time_limit(kwargs), **kwargs)
    return wrap_env(env, hyperparameters, trust=trust)


def _check_names(env_kwargs: Mapping[str, Any], env_id: str) -> None:
    """Refuse arguments that no racing environment has: a mistyped one would have no effect."""
    if env_id.rpartition(":")[2] not in (GAME, WITHOUT_GAME):
        return  # somebody's own, whose arguments are not known here
    # A record of one may be driven in the other; and of gym.make, and of races of several agents.
    known = {*TORCS, "max_episode_steps", "flagged"}
    for name in env_kwargs:
        if name not in known:
            raise InvalidOption(
                f"env_kwargs has '{name}', which no environment takes{near_miss(name, known)}"
            )


def evaluate(
    env: gym.Env[Any, Any], driver: Driver, *, episodes: int = 1, seed: int = 0
) -> list[Episode]:
    """
    Drive some episodes from the environment's own start.

    :param env: a racing environment
    :param driver: chooses the actions, deterministically
    :param episodes: how many
    :param seed: of the first reset; the next episodes go on from it
    :return: the results of each
    :raises InvalidOption: if ``episodes`` is no whole number of at least 1, ``seed`` none of at
        least 0, ``env`` no single environment, or ``driver`` cannot drive
    """
    check_count("episodes", episodes)
    check_count("seed", seed, least=0)
    if not isinstance(env, gym.Env):
        raise InvalidOption(
            f"{type(env).__name__} is no single environment; evaluate drives one that gym.make or "
            "race_environment has made"
        )
    if not callable(getattr(driver, "predict", None)):
        raise InvalidOption(
            f"driver is {driver!r}, which has no predict; pass a model, or what "
            "sb3_torcs.agents.load_driver(path, env) returns"
        )
    results = []
    for number in range(episodes):
        lap_times, total = [], 0.0
        info: dict[str, Any] = {}
        for timestep in drive(env, driver, seed=int(seed) if number == 0 else None):
            info = timestep.info
            total += timestep.reward
            if info["lap_time"]:
                lap_times.append(info["lap_time"])
        results.append(
            Episode(
                laps=info["laps"],
                lap_times=lap_times,
                distance=info["distance"],
                end=info["end"] or "time_limit",
                damage=info["damage"],
                episode_return=total,
            )
        )
    return results


def evaluate_robot(robot: tuple[str, int], track: str, laps: int, log: DriveLog) -> Episode:
    """
    Let a robot of the game drive laps from the grid, alone.

    :param robot: name and index
    :param track: its name, or the path of a file
    :param laps: to drive
    :param log: gets a row per control tick
    :return: what it drove
    """
    from sb3_torcs.agents.robots import race

    (result,) = race([robot], track, laps, log=log)
    *_, rows = log.episodes().values()
    return Episode(
        laps=result.laps_completed,
        lap_times=[lap.time for lap in result.laps],
        distance=float(rows[-1, [*COLUMNS].index("distance_raced")]),
        end="out" if result.out else "laps",
        damage=float(result.damage),
        episode_return=None,
    )
