"""What part of a training timestep the environment and the callbacks take."""

from __future__ import annotations

import contextlib
import io
import time
from typing import Any

from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

from sb3_torcs import cores
from sb3_torcs.bench.drives import Figures
from sb3_torcs.policies.threads import one_thread

__all__ = ["training_rate", "training_share"]


AT_THE_BEGINNING = "sb3_torcs.callbacks.replay.GradientStepsCallback"
"""Makes more updates per timestep at the beginning of a training than later."""

WARM_UP = 50  # training timesteps before the clock starts


class _TimedVecEnv(VecEnvWrapper):
    """Adds up the time that timesteps take, with everything that wraps the environment."""

    def __init__(self, venv: VecEnv) -> None:
        super().__init__(venv)
        self.spent = 0.0

    def reset(self) -> Any:
        return self.venv.reset()

    def step_wait(self) -> VecEnvStepReturn:
        begin = time.process_time()
        result = self.venv.step_wait()
        self.spent += time.process_time() - begin
        return result


class _TimedCallbacks(CallbackList):
    """Runs callbacks, adds up their time, and holds the clock of whole training timesteps."""

    def __init__(self, callbacks: list[BaseCallback], env: _TimedVecEnv, start: int) -> None:
        super().__init__(callbacks)
        self._timed_env = env
        self._start = start
        self._spent = 0.0
        self._began = 0.0
        self._first = 0
        self.share = 0.0  # of the environment and the callbacks
        self.rate = 0.0  # [1/s] timesteps

    def on_step(self) -> bool:
        begin = time.process_time()
        go_on = super().on_step()
        end = time.process_time()
        self._spent += end - begin
        if self.num_timesteps <= self._start:  # the clock runs from the end of this call on
            self._began, self._spent, self._timed_env.spent = end, 0.0, 0.0
            self._first = self.num_timesteps
        else:
            self.share = (self._spent + self._timed_env.spent) / (end - self._began)
            self.rate = (self.num_timesteps - self._first) / (end - self._began)
        return go_on


def training_share(steps: int) -> Figures:
    """
    Measure what part of a DDPG training timestep the environment and the callbacks take.

    The shipped hyperparameters for ``TorcsLite-v0`` are used.

    :param steps: training timesteps to measure
    :return: ``training_env_share``, in [0, 1]
    """
    return {"training_env_share": _learn("TorcsLite-v0", steps).share}


def training_rate(steps: int) -> Figures:
    """
    Measure how fast the default DDPG entry learns ``Torcs-v0``, after its beginning.

    :param steps: training timesteps to measure
    :return: ``ddpg_timesteps_per_s``
    """
    return {"ddpg_timesteps_per_s": _learn("Torcs-v0", steps).rate}


def _learn(env_id: str, steps: int) -> _TimedCallbacks:
    """Learn with a short warm-up and a small replay buffer, on one core."""
    from sb3_torcs.training.build import build
    from sb3_torcs.training.zoo import config_file, read_entry

    entry = read_entry(config_file("ddpg"), env_id)
    start = int(entry["batch_size"]) + WARM_UP
    entry.update(learning_starts=int(entry["batch_size"]), buffer_size=start + steps)
    entry.update(n_timesteps=start + steps)
    entry["callback"] = [own for own in entry["callback"] if AT_THE_BEGINNING not in own]
    with cores.at_most(1), one_thread():
        model, chosen = build("ddpg", env_id, entry)
        env = _TimedVecEnv(model.env)
        model.env = env
        callbacks = _TimedCallbacks(chosen, env, start)
        model.set_logger(Logger(None, []))  # SB3's own leaves an empty folder behind
        with contextlib.redirect_stdout(io.StringIO()):
            model.learn(start + steps, callback=callbacks)
        env.close()
    return callbacks
