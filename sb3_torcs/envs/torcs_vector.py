"""Many ``Torcs-v0`` in one process, driven on threads, as ``gym.make_vec`` makes them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from contextlib import suppress
from functools import partial
from typing import Any, NoReturn

import numpy as np
import numpy.typing as npt
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from sb3_torcs.actions import listed_actions
from sb3_torcs.backends.native import NativeFleet
from sb3_torcs.backends.several import present_world, shared_worlds
from sb3_torcs.car import CarState, check_count
from sb3_torcs.envs.conditions import Part
from sb3_torcs.envs.making import (
    MANY_RACES,
    NO_LIMIT,
    checked_threads,
    checked_time_limit,
)
from sb3_torcs.envs.racing import Observation
from sb3_torcs.envs.torcs import TorcsEnv
from sb3_torcs.errors import CarLost, EnvClosed, InvalidAction, InvalidOption
from sb3_torcs.torcs.installation import find_game
from sb3_torcs.torcs.starting_list import guests_of

__all__ = ["TorcsVectorEnv"]

Answer = tuple[Observation, float, bool, bool, dict[str, Any]]
Answers = tuple[
    npt.NDArray[np.float32],  # (n, size) observations
    npt.NDArray[np.float64],  # (n,) rewards
    npt.NDArray[np.bool_],  # (n,) terminated
    npt.NDArray[np.bool_],  # (n,) truncated
    dict[str, Any],
]


class TorcsVectorEnv(SyncVectorEnv):
    """
    Several races of the real TORCS, driven at once by threads of this process.

    It does what :class:`gymnasium.vector.SyncVectorEnv` over ``Torcs-v0`` does, to the bit, in less
    time: rewards and observations of races that are ready are computed while others still drive.

    :param num_envs: races
    :param threads: that share the work, at least 1; ``None`` is one per core, and one per race at
        most
    :param max_episode_steps: timesteps after which an episode is truncated, as in ``gym.make``:
        ``None`` is the limit that ``Torcs-v0`` is registered with, -1 is none
    :param autoreset_mode: when a race that has ended begins anew
    :param options: of :class:`~sb3_torcs.envs.torcs.TorcsEnv`, the same for all races
    :raises InvalidOption: if an option has a value that is not allowed
    """

    @shared_worlds()
    def __init__(
        self,
        num_envs: int = 1,
        *,
        threads: int | None = None,
        max_episode_steps: int | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        **options: Any,
    ) -> None:
        check_count("num_envs", num_envs, MANY_RACES)
        most = checked_threads(threads)
        if options.get("backend", "native") != "native":
            raise InvalidOption(
                f"backend is {options['backend']!r}; races on threads are for backend 'native', "
                "others drive with gym.make_vec(..., vectorization_mode='async')"
            )
        opponents = options.get("opponents", ())
        if guests_of(opponents, find_game()):
            raise InvalidOption(
                f"opponents is {opponents!r}, with agents among them; such races drive by "
                "sb3_torcs.vec_env.TorcsVecEnv, or gym.make_vec(..., vectorization_mode='async')"
            )
        limit = checked_time_limit(max_episode_steps, "Torcs-v0")
        timesteps = math.inf if limit == NO_LIMIT else limit
        self.envs: list[_LimitedRace]  # type: ignore[assignment]  # a list of Env, says Gymnasium
        self._env_obs: list[Observation | None]  # type: ignore[assignment]  # of None, says Gymnasium
        super().__init__(
            [lambda: _LimitedRace(timesteps, **options)] * int(num_envs),
            autoreset_mode=autoreset_mode,
        )
        self.threads = min(most, self.num_envs)
        worlds: list[Any] = [present_world(env.backend) for env in self.envs]
        self._fleet: Any = NativeFleet(worlds, self.threads)

    def step(self, actions: Iterable[npt.NDArray[np.float32]]) -> Answers:
        """
        Hold an action in each race, for ``action_repeat`` control ticks.

        :param actions: (n, numbers of an action)
        :return: observations, rewards, terminated, truncated, infos
        :raises InvalidAction: if there is not one action per race, or one is none
        """
        if self.closed:
            raise EnvClosed("step after close; make new environments with gym.make_vec")
        shape = self.action_space.shape or ()
        rows = listed_actions(actions, shape, ": take them from envs.action_space.sample()")
        anew = self._begin_anew()
        going = [index for index in range(self.num_envs) if not anew[index]]
        # All before any sets out: a wrong one leaves all races where they are.
        for index in going:
            try:
                self.envs[index].read_action(rows[index])
            except InvalidAction as error:
                raise InvalidAction(f"environment {index}: {error}") from error
        parts = {index: self.envs[index].held_parts() for index in going}
        try:
            for index, (held, *_) in parts.items():
                self._fleet.put(index, present_world(self.envs[index].backend))
                self._fleet.begin(index, *held)
            for index, (_, *later) in parts.items():
                for held in later:  # the controls have arrived
                    self._go_on(index, held)
            return self._collect(anew)
        except BaseException:
            self._fleet.finish()  # so that a reset finds no thread at work
            raise

    def _go_on(self, race: int, held: Part) -> None:
        """Drive the next part of a timestep, unless the race has failed in the one before."""
        with suppress(CarLost):  # told when the car is collected
            self._fleet.wait(race)
            self._fleet.begin(race, *held)

    def _begin_anew(self) -> list[bool]:
        """Say for each race whether this timestep begins an episode instead."""
        ended: list[bool] = self._autoreset_envs.tolist()
        if self.autoreset_mode == AutoresetMode.NEXT_STEP:
            return ended
        if self.autoreset_mode == AutoresetMode.DISABLED and any(ended):
            raise ResetNeeded(
                "an episode has ended, and autoreset_mode is DISABLED; call "
                "reset(options={'reset_mask': terminated | truncated}) first"
            )
        return [False] * self.num_envs

    def _collect(self, anew: list[bool]) -> Answers:
        """Take the cars in order; what is done here is done while later ones still drive."""
        number = self.num_envs
        observations = np.empty((number, self.envs[0].view.size), np.float32)
        rewards = np.zeros(number)
        terminated, truncated = np.zeros(number, np.bool_), np.zeros(number, np.bool_)
        infos: dict[str, Any] = {}
        same_step = self.autoreset_mode == AutoresetMode.SAME_STEP
        for index, env in enumerate(self.envs):
            if anew[index]:
                observation, info = env.reset()
            else:
                observation, reward, end, cut, info = env.finish_step(
                    partial(self._fleet.wait, index)
                )
                rewards[index] = reward
                if end or cut:
                    terminated[index], truncated[index] = end, cut
                    if same_step:
                        self._gather(infos, {"final_obs": observation, "final_info": info}, index)
                        observation, info = env.reset()
            observations[index] = observation
            self._env_obs[index] = observation
            self._gather(infos, info, index)
        self._autoreset_envs = terminated | truncated
        return observations, rewards, terminated, truncated, infos

    def _gather(self, infos: dict[str, Any], info: dict[str, Any], index: int) -> None:
        """
        Do what ``_add_info`` does in half its time, for the kinds of values that are here.

        :param infos: values by name, and masks of who has one by ``_`` and the name
        :param info: of one race, added to them
        :param index: of the race
        """
        for name, value in info.items():
            mask_name = f"_{name}"
            if mask_name not in infos:
                infos[name] = self._room(value)
                infos[mask_name] = np.zeros(self.num_envs, np.bool_)
            if isinstance(value, dict):
                self._gather(infos[name], value, index)
            else:
                infos[name][index] = value
            infos[mask_name][index] = True

    def _room(self, value: Any) -> Any:
        """Make room for what all races say, by what the first of them does."""
        if isinstance(value, dict):
            return {}
        if type(value) in (int, float, bool):
            return np.zeros(self.num_envs, type(value))
        return np.full(self.num_envs, None, object)

    def __reduce__(self) -> NoReturn:
        raise InvalidOption(
            "a TorcsVectorEnv, whose threads drive its races, cannot be copied or pickled; make "
            "another one with the same arguments"
        )

    def close_extras(self, **kwargs: Any) -> None:
        """
        Close all races and end the threads.

        :param kwargs: as of SyncVectorEnv
        """
        self.__dict__.pop("_fleet", None)  # not there if a race could not be made
        super().close_extras(**kwargs)


class _LimitedRace(TorcsEnv):
    """One of the races, which counts its timesteps as ``TimeLimit`` would."""

    def __init__(self, timesteps: float, **options: Any) -> None:
        super().__init__(**options)
        self._timesteps = timesteps
        self._elapsed = 0

    def reset(self, **kwargs: Any) -> tuple[Observation, dict[str, Any]]:
        self._elapsed = 0
        return super().reset(**kwargs)

    def finish_step(self, drive: Callable[[], CarState]) -> Answer:
        observation, reward, terminated, truncated, info = super().finish_step(drive)
        self._elapsed += 1
        truncated = truncated or self._elapsed >= self._timesteps
        return observation, reward, terminated, truncated, info
