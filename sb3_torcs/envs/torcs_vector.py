"""Many races in one process, driven on threads, as ``gym.make_vec`` makes them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any, ClassVar, NoReturn

import numpy as np
import numpy.typing as npt
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from sb3_torcs.actions import list_actions
from sb3_torcs.backends.several import shared_worlds
from sb3_torcs.car import check_count
from sb3_torcs.envs.batch import Batch, Outcome
from sb3_torcs.envs.making import (
    MANY_RACES,
    NO_LIMIT,
    checked_threads,
    checked_time_limit,
)
from sb3_torcs.envs.racing import Observation, RacingEnv
from sb3_torcs.envs.torcs import TorcsEnv
from sb3_torcs.envs.torcs_lite import TorcsLiteEnv
from sb3_torcs.errors import EnvClosed, InvalidOption

__all__ = ["TorcsLiteVectorEnv", "TorcsVectorEnv"]

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
    time.

    :param num_envs: races
    :param threads: that share the work, at least 1; ``None`` is one per core, and one per race at
        most
    :param max_episode_steps: timesteps after which an episode is truncated, as in ``gym.make``:
        ``None`` is the limit that the environment is registered with, -1 is none
    :param autoreset_mode: when a race that has ended begins again
    :param options: of :class:`~sb3_torcs.envs.torcs.TorcsEnv`, the same for all races
    :raises InvalidOption: if an option has a value that is not allowed
    """

    env_id: ClassVar[str] = "Torcs-v0"
    kind: ClassVar[Callable[..., RacingEnv]] = TorcsEnv

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
        limit = checked_time_limit(max_episode_steps, self.env_id)
        self._limit = math.inf if limit == NO_LIMIT else limit
        self._batch: Batch | None = None
        self._driving = False
        self._env_obs: list[Observation | None]  # type: ignore[assignment]  # of None, says Gymnasium
        make = partial(type(self).kind, **options)
        super().__init__([make] * int(num_envs), autoreset_mode=autoreset_mode)
        self._batch = Batch(self._envs, most)
        self.threads = self._batch.threads

    @property  # type: ignore[override]  # a list of Env, says Gymnasium
    def envs(self) -> list[RacingEnv]:
        """The environments, brought up to date."""
        if self._driving and self._batch is not None:
            for index in range(len(self._envs)):
                self._batch.leave(index)
        self._driving = False
        return self._envs

    @envs.setter
    def envs(self, envs: list[RacingEnv]) -> None:
        """Set the environments, as ``SyncVectorEnv`` does once."""
        self._envs = envs

    def step(self, actions: Iterable[npt.NDArray[np.float32]]) -> Answers:
        """
        Hold an action in each race, for ``action_repeat`` control ticks.

        :param actions: (n, numbers of an action)
        :return: observations, rewards, terminated, truncated, infos
        :raises InvalidAction: if there is not one action per race, or one is none
        """
        if self.closed or self._batch is None:
            raise EnvClosed("step after close; make new environments with gym.make_vec")
        shape = self.action_space.shape or ()
        rows: Any = actions
        if getattr(actions, "shape", None) != shape:
            rows = list_actions(actions, shape, ": take them from envs.action_space.sample()")
        starting = self._starting()
        going = np.flatnonzero(~starting)
        if not self._driving:
            self._enter()
        driven = rows[going] if isinstance(rows, np.ndarray) else [rows[index] for index in going]
        timestep = self._batch.step(driven, going)
        over = timestep.ended | (timestep.after["timesteps"] >= self._limit)
        return self._collect(self._batch, timestep, rows, starting, over & ~starting)

    def _enter(self) -> None:
        """Let the batch take over all races."""
        assert self._batch is not None
        for index, env in enumerate(self._envs):
            env.check_ready()
            self._batch.enter(index)
        self._driving = True

    def _starting(self) -> npt.NDArray[np.bool_]:
        """Find the races in which this timestep begins an episode instead."""
        ended = self._autoreset_envs
        if self.autoreset_mode == AutoresetMode.NEXT_STEP:
            return ended.copy()
        if self.autoreset_mode == AutoresetMode.DISABLED and ended.any():
            raise ResetNeeded(
                "an episode has ended, and autoreset_mode is DISABLED; call "
                "reset(options={'reset_mask': terminated | truncated}) first"
            )
        return np.zeros(self.num_envs, np.bool_)

    def _collect(
        self,
        batch: Batch,
        timestep: Outcome,
        rows: Any,
        starting: npt.NDArray[np.bool_],
        over: npt.NDArray[np.bool_],
    ) -> Answers:
        """Finish episodes that are over, begin others, and gather what all races return."""
        observations = timestep.observations
        rewards = np.array(batch.value(timestep, ~(starting | over)))
        terminated, truncated = np.zeros((2, self.num_envs), np.bool_)
        infos: dict[str, Any] = {}
        for index, env in enumerate(self._envs):
            resets = starting[index]
            if over[index]:
                act = partial(env.step, rows[index])
                answer = batch.finish(index, timestep, act)
                observations[index], rewards[index], ended, cut, info = answer
                cut = cut or timestep.after["timesteps"][index] >= self._limit
                terminated[index], truncated[index] = ended, cut
                resets = self.autoreset_mode == AutoresetMode.SAME_STEP
                if resets:
                    self._gather(infos, {"final_obs": answer[0], "final_info": info}, index)
            elif not resets:
                info = timestep.info(index)
                if self.render_mode == "human":
                    batch.leave(index)
                    env.render()
            if resets:
                observations[index], info = env.reset()
                batch.enter(index)
            if starting[index]:
                rewards[index] = 0.0
            self._env_obs[index] = observations[index].copy()
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
        """Allocate an array of one value per race, typed by the first value."""
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
        batch = self.__dict__.get("_batch")  # none if a race could not be made
        self._driving, self._batch = False, None
        if batch is not None:
            batch.close()
        super().close_extras(**kwargs)


class TorcsLiteVectorEnv(TorcsVectorEnv):
    """
    Several races of the fallback physics, driven at once by threads of this process.

    :param num_envs: as of :class:`TorcsVectorEnv`, and so on
    :param options: of :class:`~sb3_torcs.envs.torcs_lite.TorcsLiteEnv`, the same for all races
    """

    env_id = "TorcsLite-v0"
    kind = TorcsLiteEnv
