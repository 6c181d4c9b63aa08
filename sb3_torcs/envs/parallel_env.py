"""Several agents in one race of the real TORCS, as PettingZoo's Parallel API has them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import ExitStack
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from sb3_torcs.car import CarState, check_count
from sb3_torcs.envs.batch import Batch
from sb3_torcs.envs.ends import FINISHED
from sb3_torcs.envs.making import NO_LIMIT, checked_time_limit
from sb3_torcs.envs.torcs_race import make_race
from sb3_torcs.errors import EnvClosed, InvalidAction, InvalidOption, needs_extra

with needs_extra("parallel_env"):
    from pettingzoo import ParallelEnv

__all__ = ["TorcsParallelEnv", "parallel_env"]

Observation = npt.NDArray[np.float32]
Action = npt.NDArray[np.float32]

MAX_STEPS = 3000  # timesteps, as of ``Torcs-v0``


class TorcsParallelEnv(ParallelEnv[str, Observation, Action]):
    """
    A race of several agents, each with its own car, beside robots.

    Observations, actions, rewards and ends are those of ``Torcs-v0``, for each agent. With
    ``laps`` the race is flagged: who crosses the line after the winner has finished, too, and ends
    with ``"laps"``. An agent whose episode ends leaves ``agents``, its car is taken off the road,
    and the others race on. ``info`` holds that of ``Torcs-v0``, and the ``place``,
    ``gap_ahead`` and ``gap_behind`` [m], ``contacts`` with other cars, and those by own ``faults``.

    :param agents: their number
    :param max_episode_steps: timesteps after which all are truncated; ``None`` or -1 is never
    :param options: of :func:`~sb3_torcs.envs.torcs_race.make_race`
    :raises InvalidOption: if an option has a value that is not allowed
    """

    metadata: dict[str, Any] = {  # noqa: RUF012
        "name": "torcs_v0",
        "render_modes": [],
        "is_parallelizable": True,
    }
    render_mode = None

    def __init__(
        self, agents: int = 2, *, max_episode_steps: int | None = MAX_STEPS, **options: Any
    ) -> None:
        limit = checked_time_limit(
            NO_LIMIT if max_episode_steps is None else max_episode_steps,
            "Torcs-v0",
            unlimited="None",
        )
        if options.pop("render_mode", None) is not None:
            raise InvalidOption(
                "render_mode is for Torcs-v0; `sb3-torcs race --video FILE.mp4` shows a race of "
                "several agents"
            )
        options.setdefault("flagged", options.get("laps") is not None)
        envs = make_race(agents, **options)
        self.possible_agents = [f"agent_{number}" for number in range(agents)]
        self.agents: list[str] = []
        self._envs = dict(zip(self.possible_agents, envs, strict=True))
        self._race = envs[0].seat.race
        self._limit = math.inf if limit == NO_LIMIT else limit
        self._batch = Batch(envs, names=self.possible_agents)
        self._closed = False
        self.observation_spaces: dict[str, spaces.Space[Any]] = {
            name: env.observation_space for name, env in self._envs.items()
        }
        self.action_spaces: dict[str, spaces.Space[Any]] = {
            name: env.action_space for name, env in self._envs.items()
        }

    def observation_space(self, agent: str) -> spaces.Space[Any]:
        """
        Return what an agent may see.

        :param agent: its name
        """
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> spaces.Space[Any]:
        """
        Return what an agent may do.

        :param agent: its name
        """
        return self.action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Observation], dict[str, dict[str, Any]]]:
        """
        Begin a race.

        :param seed: of the random numbers of this and the following races
        :param options: where the field starts, as of ``Torcs-v0``; the place is the first agent's.
            The name ``options`` is ignored: PettingZoo's own tests hand it over
        :return: observations and infos
        :raises InvalidOption: if the seed or options have wrong values, and the race before goes
            on; or if the game lets no car start there, and there is no race then
        :raises EnvClosed: after ``close``
        """
        self._check_open("reset")
        if seed is not None:
            check_count("seed", seed, least=0)
        if isinstance(options, Mapping):
            options = {name: value for name, value in options.items() if name != "options"}
        next(iter(self._envs.values())).check_start(options)  # before anything changes
        self._race.end()
        self.agents = []
        answers = {
            name: env.reset(seed=None if seed is None else int(seed) + number, options=options)
            for number, (name, env) in enumerate(self._envs.items())
        }
        for index in range(len(self._envs)):
            self._batch.enter(index)
        self.agents = list(self.possible_agents)
        observations = {name: seen for name, (seen, _) in answers.items()}
        return observations, {name: _with_race(info) for name, (_, info) in answers.items()}

    def step(self, actions: Mapping[str, Action]) -> Any:
        """
        Hold an action in each car that still races.

        :param actions: by agent
        :return: observations, rewards, terminations, truncations and infos, by agent
        :raises InvalidAction: if one is missing or invalid; then no car has been driven
        :raises EnvClosed: before ``reset``, after the race and after ``close``
        """
        self._check_open("step")
        if not self.agents:
            raise EnvClosed("step before reset or after the race; call reset first")
        given = actions if isinstance(actions, Mapping) else ()
        missing = [name for name in self.agents if name not in given]
        if missing:
            raise InvalidAction(f"no action of {', '.join(missing)}; give one of each in `agents`")
        racing = {name: self.possible_agents.index(name) for name in self.agents}
        indices = np.array(list(racing.values()))
        timestep = self._batch.step([actions[name] for name in racing], indices)
        for name, index in racing.items():
            if self._envs[name].seat.finished:
                timestep.after["race_end"][index] = FINISHED
        over = timestep.ended | (timestep.after["race_end"] != 0.0)
        rewards = self._batch.value(timestep, ~over)
        late = timestep.after["timesteps"] >= self._limit
        answers: tuple[dict[str, Any], ...] = ({}, {}, {}, {}, {})
        leaving = []
        for name, index in racing.items():
            if over[index]:
                act = partial(self._envs[name].step, actions[name])
                answer = self._batch.finish(index, timestep, act)
                seen, reward, terminated, truncated, info = answer
            else:
                seen, reward, terminated, truncated = (
                    timestep.observations[index],
                    rewards[index],
                    False,
                    False,
                )
                info = timestep.info(index)
            truncated = truncated or bool(late[index] and not terminated)
            values = seen, reward, terminated, truncated, _with_race(info)
            for part, value in zip(answers, values, strict=True):
                part[name] = value
            if terminated or truncated:
                leaving.append(name)
        for name in leaving:  # only now, since the others have still seen these cars
            self.agents.remove(name)
            self._envs[name].seat.retire()
        return answers

    def _check_open(self, what: str) -> None:
        if self._closed:
            raise EnvClosed(f"{what} after close; make a new environment with parallel_env")

    def render(self) -> None:
        """Draw nothing: there are no modes."""

    def close(self) -> None:
        """Close the race, whatever one of its cars raises. A second call does nothing."""
        if not self._closed:
            self._batch.close()
        self._closed = True
        self.agents = []
        with ExitStack() as closing:
            for env in self._envs.values():
                closing.callback(env.close)


def _with_race(info: dict[str, Any]) -> dict[str, Any]:
    car: CarState = info["car"]
    return {
        **info,
        "place": car.race_position,
        "gap_ahead": car.gap_ahead,
        "gap_behind": car.gap_behind,
        "contacts": int(car.contacts),
        "faults": int(car.faults),
    }


def parallel_env(agents: int = 2, **options: Any) -> TorcsParallelEnv:
    """
    Make a race of several agents.

    :param agents: their number
    :param options: of :class:`TorcsParallelEnv`
    """
    return TorcsParallelEnv(agents, **options)
