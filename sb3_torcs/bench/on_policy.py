"""How fast PPO learns in ``TorcsVecEnv``, and in ``DummyVecEnv``, on two cores."""

from __future__ import annotations

import contextlib
import io
import itertools
import os
import time
from collections.abc import Iterator
from typing import Any

from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_torcs import cores
from sb3_torcs.bench.drives import Figures
from sb3_torcs.callbacks import LeanUpdatesCallback
from sb3_torcs.policies.threads import one_thread
from sb3_torcs.vec_env import TorcsVecEnv

__all__ = ["ppo"]

ENTRY = "Torcs-v0"  # of the hyperparameter file, and the environment
CORES = 2
ROLLOUTS = 4  # of a turn


class _Clock(BaseCallback):
    """Reads the clock before each rollout."""

    def _init_callback(self) -> None:
        self.times: list[float] = []

    def _on_rollout_start(self) -> None:
        self.times.append(time.perf_counter())

    def _on_step(self) -> bool:
        return True


class _Training:
    """
    A training with the shipped entry, which goes on for a turn now and then.

    :param entry: of ``ppo.yml``
    :param plain: in ``DummyVecEnv``, with SB3's own updates
    """

    def __init__(self, entry: dict[str, Any], plain: bool) -> None:
        from sb3_torcs.training.build import build

        self.model, self.callbacks = build("ppo", ENTRY, entry)
        self.model.set_logger(Logger(None, []))  # SB3's own leaves an empty folder behind
        self.made = self.model.get_env()
        if plain:
            assert isinstance(self.made, TorcsVecEnv)
            envs = self.made.envs
            self.callbacks = [own for own in self.callbacks if type(own) is not LeanUpdatesCallback]
            self.model.set_env(DummyVecEnv([lambda env=env: env for env in envs]))  # type: ignore[misc]
        self.batch = self.model.n_steps * self.model.n_envs
        self.rates = [0.0]  # [1/s] timesteps, of each rollout with its update

    def turn(self) -> None:
        """Learn from a few rollouts, of which the first warms up."""
        clock = _Clock()
        with contextlib.redirect_stdout(io.StringIO()):
            self.model.learn(
                (ROLLOUTS + 1) * self.batch,
                callback=CallbackList([*self.callbacks, clock]),
                reset_num_timesteps=False,
            )
        begins = clock.times[1:]
        self.rates += [self.batch / (end - begin) for begin, end in itertools.pairwise(begins)]


def ppo(seconds: float) -> Figures:
    """
    Measure trainings with the shipped entry of PPO for Torcs-v0, in turns, on two cores.

    :param seconds: of wall time, at least one turn of each [s]
    :return: ``ppo_timesteps_per_s`` as ``sb3-torcs train`` learns, and
        ``ppo_dummy_timesteps_per_s`` in ``DummyVecEnv`` with SB3's own updates: of the best rollout
        with its update, by the wall clock, since other programs only slow down; ``None`` on a
        single core, and where a process cannot choose its cores
    """
    from sb3_torcs.training.zoo import config_file, read_entry

    names = "ppo_timesteps_per_s", "ppo_dummy_timesteps_per_s"
    if cores.number() < CORES or not hasattr(os, "sched_setaffinity"):
        return dict.fromkeys(names)
    entry = read_entry(config_file("ppo"), ENTRY)
    begin = time.perf_counter()
    with _on_two_cores():
        trainings = [_Training(entry, plain) for plain in (False, True)]
        while len(trainings[0].rates) == 1 or time.perf_counter() - begin < seconds:
            for training in trainings:
                training.turn()
        for training in trainings:
            training.made.close()
    return {name: max(each.rates) for name, each in zip(names, trainings, strict=True)}


@contextlib.contextmanager
def _on_two_cores() -> Iterator[None]:
    """Let this thread, and those that it starts, run on two cores, and PyTorch on one."""
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, sorted(before)[:CORES])
    try:
        with one_thread():
            yield
    finally:
        os.sched_setaffinity(0, before)
