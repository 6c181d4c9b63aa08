"""Many races in one process as an environment of Stable-Baselines3, driven on threads."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any, NoReturn

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium.wrappers import OrderEnforcing
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from sb3_torcs.backends.seats import Seat, SharedRace
from sb3_torcs.backends.several import shared_worlds
from sb3_torcs.car import check_count
from sb3_torcs.envs.batch import Batch, Outcome
from sb3_torcs.envs.ends import RACE_OVER
from sb3_torcs.envs.making import MANY_RACES, EnvMaker, checked_threads, env_makers, refuse_flag
from sb3_torcs.envs.racing import RacingEnv
from sb3_torcs.errors import EnvClosed, InvalidOption
from sb3_torcs.signals import defer_signals
from sb3_torcs.vec_env.info import TRUNCATED, LazyInfo

__all__ = ["TorcsVecEnv"]

ENDLESS = 1 << 62


class TorcsVecEnv(DummyVecEnv):
    """
    Several races, driven at once by threads of this process.

    It returns what ``DummyVecEnv`` over the same environments in ``Monitor`` returns, to the bit,
    in less time. ``make_vec_env`` and the RL Zoo can use it instead of ``DummyVecEnv``.

    With several ``agents`` each car of each race is an environment: those of the first race come
    first. When the episode of a car ends, the car rejoins its race: it is put down in the middle of
    the longest stretch of road without cars, repaired and rolling, and its next episode begins
    there, while the others race on. A race is over when each of its agents has ended the episode
    that it began the race with; episodes that began later are then truncated, with ``"race"`` as
    their ``end``, and the next race begins for all.

    :param races: their number, or functions that make the environments. Wrappers may be
        ``Monitor``, ``TimeLimit`` and ``OrderEnforcing`` only
    :param agents: cars that learn in each race
    :param threads: that share the work, at least 1; ``None`` is one per core, and one per race at
        most
    :param env_id: ``"Torcs-v0"`` or ``"TorcsLite-v0"``
    :param env_kwargs: as of ``gym.make``, the same for all races; with several agents those of
        :func:`~sb3_torcs.envs.torcs_race.make_race`, but for ``flagged``.
        ``max_episode_steps`` may be a list, which goes round the races: ``[450, 1400]`` lets every
        other race practise the start
    :raises InvalidOption: if an option has a value that is not allowed
    """

    @shared_worlds()
    def __init__(
        self,
        races: int | list[EnvMaker] | tuple[EnvMaker, ...] = 1,
        agents: int = 1,
        threads: int | None = None,
        *,
        env_id: str = "Torcs-v0",
        **env_kwargs: Any,
    ) -> None:
        self._batch: Batch | None = None
        check_count("agents", agents)
        most = checked_threads(threads)
        if isinstance(races, (list, tuple)) and races:
            if env_kwargs:
                names = ", ".join(env_kwargs)
                raise InvalidOption(f"{names} is for races made here; give it to your functions")
            if agents != 1:
                raise InvalidOption(
                    f"agents is {agents}, with functions that make environments of one; give the "
                    "number of races"
                )
            for maker in races:
                if not callable(maker):
                    raise InvalidOption(
                        f"races has {maker!r} in it; give functions that make environments, e.g. "
                        "[lambda: gym.make('Torcs-v0')], or the number of races"
                    )
            makers = list(races)
        else:
            check_count("races", races, MANY_RACES)
            made = env_makers(int(races), agents, env_id, env_kwargs)  # type: ignore[arg-type]
            makers = [partial(_monitored, make) for make in made]
        super().__init__(makers)
        try:
            self._wrappers = [_Wrappers(env) for env in self._envs]
            self._shared = _shared_races([wrappers.racing for wrappers in self._wrappers])
            self._batch = Batch([wrappers.racing for wrappers in self._wrappers], most)
        except BaseException:
            self.close()
            raise
        self.threads = self._batch.threads
        self._elapsed = np.zeros(self.num_envs, np.int64)  # timesteps of the episodes
        self._limits = np.full(self.num_envs, ENDLESS)
        self._watched = [i for i, wrappers in enumerate(self._wrappers) if wrappers.is_watched]

    @property
    def envs(self) -> list[gym.Env[Any, Any]]:
        """The environments, brought up to date."""
        if self._driving:
            self._leave()
        return self._envs

    @envs.setter
    def envs(self, envs: list[gym.Env[Any, Any]]) -> None:
        """Set the environments, as ``DummyVecEnv`` does once."""
        self._envs = envs
        self._driving = False

    @property
    def _open_batch(self) -> Batch:
        if self._batch is None:
            raise EnvClosed("step after close; make a new environment")
        return self._batch

    def reset(self) -> VecEnvObs:
        """
        Begin an episode in each environment.

        :return: observations
        :raises InvalidOption: if an option is wrong, and the episodes go on
        """
        if len(self._options) != self.num_envs:
            raise InvalidOption(
                f"set_options got a list of {len(self._options)} for {self.num_envs} environments; "
                "give one dict, or one for each"
            )
        for wrappers, options in zip(self._wrappers, self._options, strict=True):
            wrappers.racing.check_start(options)  # a wrong one leaves all races as they are
        for race in self._shared:
            race.end()
        return super().reset()

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """
        Seed the next reset, each environment by another number.

        :param seed: of the first one; ``None`` draws it
        :return: the seeds
        :raises InvalidOption: if it is no whole number from 0 up
        """
        if seed is not None:
            check_count("seed", seed, least=0)
        return super().seed(seed)

    def step_wait(self) -> VecEnvStepReturn:
        """
        Hold an action in each environment.

        :return: observations, rewards, dones and infos
        :raises InvalidAction: if there is not one action per environment, or one is invalid; then
            no race has been driven
        """
        batch = self._open_batch
        if not self._driving:
            self._enter()
        timestep = batch.step(self.actions)
        dones = np.zeros(self.num_envs, np.bool_)
        infos: list[Any] = [LazyInfo(timestep, i) for i in range(self.num_envs)]
        over = timestep.ended | (self._elapsed + 1 >= self._limits)
        failures: list[Exception] = []
        # Ctrl-C waits meanwhile: a race between two episodes could not be driven on.
        with defer_signals() if over.any() else contextlib.nullcontext():
            self._end_races(over, timestep)
            values = batch.value(timestep, ~over)
            rewards = np.array(values, np.float32)
            self._elapsed += ~over
            for i in np.flatnonzero(~over).tolist():
                self._wrappers[i].append(values[i])
            last: dict[int, Any] = {}
            for i in np.flatnonzero(over).tolist():
                with self._kept(failures, i):
                    last[i] = self._finish(i, timestep)
            # Only now, since the cars of a race share its track, which a reset may change.
            for i, answer in last.items():
                with self._kept(failures, i):
                    answer = self._go_on(i, answer)
                    timestep.observations[i], rewards[i], dones[i], infos[i] = answer
        if self._watched or failures:
            self._leave()
        for i in self._watched:
            if not over[i]:  # an environment whose episode ended has drawn itself
                self._wrappers[i].racing.render()
        if failures:
            raise failures[0]
        return timestep.observations, rewards, dones, infos

    def _end_races(self, over: npt.NDArray[np.bool_], timestep: Outcome) -> None:
        """End the races all of whose first episodes are over; with them end all their others."""
        for race, members in self._shared.items():
            ending = {number for number, i in members.items() if over[i]}
            if ending and race.is_over(ending):
                race.end()
                for i in members.values():
                    if not over[i]:
                        timestep.after["race_end"][i] = RACE_OVER
                    over[i] = True

    @contextlib.contextmanager
    def _kept(self, failures: list[Exception], i: int) -> Iterator[None]:
        """Keep the error of a race, which is raised when the other races have been handled."""
        try:
            yield
        except Exception as error:
            error.add_note(f"in environment {i} of {self.num_envs}")
            failures.append(error)

    def _finish(self, i: int, timestep: Outcome) -> Any:
        """Take the last timestep of an episode through all wrappers; return what they return."""
        self._wrappers[i].leave(int(self._elapsed[i]))
        return self._open_batch.finish(i, timestep, partial(self._envs[i].step, self.actions[i]))

    def _go_on(self, i: int, answer: Any) -> tuple[Any, float, bool, dict[str, Any]]:
        """Begin the next episode; return what a timestep that ends one returns."""
        observation, reward, terminated, truncated, info = answer
        info[TRUNCATED] = truncated and not terminated
        done = terminated or truncated
        if done:
            info["terminal_observation"] = observation
            observation, self.reset_infos[i] = self._envs[i].reset()
        self._enter_race(i)
        return observation, reward, done, info

    def _enter(self) -> None:
        """Take the states of all races over from their environments."""
        for i in range(self.num_envs):
            self._enter_race(i)
        self._driving = True

    def _enter_race(self, i: int) -> None:
        self._elapsed[i], self._limits[i] = self._wrappers[i].enter()
        self._open_batch.enter(i)

    def _leave(self) -> None:
        """Give the states of all races back to their environments."""
        self._driving = False
        if self._batch is not None:
            for i, wrappers in enumerate(self._wrappers):
                self._batch.leave(i)
                wrappers.leave(int(self._elapsed[i]))

    def __reduce__(self) -> NoReturn:
        raise InvalidOption(
            "a TorcsVecEnv, whose threads drive its races, cannot be copied or pickled; make "
            "another one with the same arguments"
        )

    def close(self) -> None:
        """Close all races, also those after one that fails to, and end the threads."""
        with contextlib.ExitStack() as closing:
            if self._batch is not None:
                closing.callback(self._batch.close)
                self._batch = None
            for env in reversed(self._envs):
                closing.callback(env.close)


class _Wrappers:
    """
    The wrappers of one environment, which count timesteps and sum rewards.

    :param env: the outermost wrapper
    :raises InvalidOption: if there is another wrapper, which would not see every timestep
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        self._monitor: Monitor[Any, Any] | None = None
        self._limit: Any = None
        if not isinstance(env.unwrapped, RacingEnv):
            raise InvalidOption(
                f"{env} is no racing environment; TorcsVecEnv is for Torcs-v0 and TorcsLite-v0, "
                "use DummyVecEnv for others"
            )
        self.racing = env.unwrapped
        kind = type(self.racing)
        if kind.step is not RacingEnv.step:
            raise InvalidOption(
                f"{kind.__name__} has a step of its own, which TorcsVecEnv would not call in each "
                "timestep; use DummyVecEnv"
            )
        while isinstance(env, gym.Wrapper):
            names = {
                kind.__name__ for kind in type(env).__mro__
            }  # the RL Zoo has its own TimeLimit
            if type(env) is Monitor and self._monitor is None:
                self._monitor = env
            elif "TimeLimit" in names and self._limit is None:
                self._limit = env
            elif type(env) is not OrderEnforcing:
                raise InvalidOption(
                    f"an environment is wrapped in {type(env).__name__}, which would not see the "
                    "timesteps of TorcsVecEnv; leave the wrapper out, or use DummyVecEnv"
                )
            env = env.env
        self.append: Callable[[float], None] = self._forget
        self._noted = 0  # timesteps of this episode that the monitor knows

    @property
    def is_watched(self) -> bool:
        """Whether each timestep is shown in a window."""
        return self.racing.render_mode == "human"

    def _forget(self, reward: float) -> None:
        """Do nothing with a reward, where there is no monitor."""

    def enter(self) -> tuple[int, int]:
        """
        Read the state of the wrappers.

        :return: timesteps of the present episode, and the time limit
        :raises EnvClosed: if there is no episode
        """
        self.racing.check_ready()
        if self._monitor is not None:
            if self._monitor.needs_reset:
                raise RuntimeError("Tried to step environment that needs reset")
            self.append = self._monitor.rewards.append
        if self._limit is None:
            self._noted = 0
            return 0, ENDLESS
        self._noted = self._limit._elapsed_steps
        return self._noted, self._limit._max_episode_steps

    def leave(self, elapsed: int) -> None:
        """
        Bring the wrappers up to date.

        :param elapsed: timesteps of the present episode
        """
        if self._monitor is not None:
            self._monitor.total_steps += elapsed - self._noted
        if self._limit is not None:
            self._limit._elapsed_steps = elapsed
        self._noted = elapsed


def _shared_races(envs: Sequence[RacingEnv]) -> dict[SharedRace, dict[int, int]]:
    """Return the races of several agents: each agent's number, and the index of its environment."""
    members: dict[SharedRace, dict[int, int]] = {}
    for i, env in enumerate(envs):
        seat: Any = env.backend
        if isinstance(seat, Seat):
            members.setdefault(seat.race, {})[seat.number] = i
    for race, places in members.items():
        refuse_flag(race.loaded.flagged)
        if max(places.values()) - min(places.values()) >= len(places):
            raise InvalidOption(
                f"environments {sorted(places.values())} are the agents of one race, with others "
                "between them; list the agents of each race one after the other"
            )
    return members


def _monitored(make: EnvMaker) -> gym.Env[Any, Any]:
    return Monitor(make())
