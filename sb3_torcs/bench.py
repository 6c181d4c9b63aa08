"""How fast things are: each figure in processor time, on one core, the compared ones in turns."""

from __future__ import annotations

import argparse
import contextlib
import io
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

__all__ = ["KEYS", "environments", "resets", "stages", "training_share"]

KEYS = (
    "lite_ticks_per_s",
    "racetrack_v1_steps_per_s",
    "lite_reset_ms",
    "torcs_limit_ticks_per_s",
    "torcs_cpp_ticks_per_s",
    "torcs_env_ticks_per_s",
    "torcs_env_repeat5_ticks_per_s",
    "torcs_reset_ms",
    "torcs_load_ms",
    "torcs_vector2_ratio",
    "scr_ticks_per_s",
    "scr_reset_ms",
    "game_frames_per_s",
    "policy_updates_per_s",
    "policy_plain_updates_per_s",
    "policy_fast_updates_per_s",
    "training_env_share",
)
"""All figures, in the order they are shown; those of worlds that are not here stay empty."""

LITE = "sb3_torcs:TorcsLite-v0"
TICKS_PER_TURN = 3000  # a minute of driving
RACETRACK_STEPS_PER_TURN = 10
RESETS = 200
WARM_UP = 50  # training steps before the clock starts
BATCH = 64

Figures = dict[str, float | None]


def stages(seconds: float) -> dict[str, Callable[[], Figures]]:
    """
    List the measurements.

    :param seconds: to spend on all of them, about [s]
    :return: by name; each returns some of the figures
    """
    from sb3_torcs import bench_scr, bench_torcs

    share = seconds / 6.0
    return {
        "environments": lambda: environments(share),
        "resets": resets,
        "game": _where_it_is(lambda: bench_torcs.ticks(share)),
        "game resets": _where_it_is(bench_torcs.resets),
        "game loads": _where_it_is(bench_torcs.loads),
        "game threads": _where_it_is(lambda: bench_torcs.vector(share)),
        "SCR": _where_it_is(lambda: bench_scr.ticks(share)),
        "SCR resets": _where_it_is(bench_scr.resets),
        "pictures": _where_it_is(bench_scr.pictures),
        "policy": lambda: _policy(share),
        "training": lambda: training_share(max(int(40.0 * share), 100)),
    }


def _where_it_is(measure: Callable[[], Figures]) -> Callable[[], Figures]:
    """Leave figures of the game empty where it cannot be driven."""

    def measured() -> Figures:
        from sb3_torcs.errors import BackendUnavailable

        try:
            return measure()
        except BackendUnavailable:  # sb3-torcs doctor says why
            return {}

    return measured


def environments(seconds: float) -> Figures:
    """
    Measure TorcsLite-v0's control ticks and racetrack-v1's steps, in turns.

    :param seconds: of processor time, at least one turn each [s]
    :return: the medians over the turns
    """
    import highway_env  # noqa: F401  registers racetrack-v1

    lite = gym.make(LITE, action_repeat=1)
    racetrack = gym.make("racetrack-v1")
    actions = _scripted_actions(lite)
    racetrack.action_space.seed(0)
    others = [racetrack.action_space.sample() for _ in range(RACETRACK_STEPS_PER_TURN)]
    rates: dict[str, list[float]] = {"lite_ticks_per_s": [], "racetrack_v1_steps_per_s": []}
    spent = 0.0
    while spent < seconds:
        for name, env, sequence in zip(rates, (lite, racetrack), (actions, others), strict=True):
            taken = _drive(env, sequence)
            rates[name].append(len(sequence) / taken)
            spent += taken
    lite.close()
    racetrack.close()
    return {name: statistics.median(values) for name, values in rates.items()}


def _scripted_actions(env: gym.Env[Any, Any]) -> list[npt.NDArray[np.float32]]:
    """Let the scripted driver choose actions from the grid on, and end before the episode does."""
    from sb3_torcs.drivers import ScriptedDriver
    from sb3_torcs.evaluation import drive

    steps = list(zip(drive(env, ScriptedDriver(), seed=0), range(TICKS_PER_TURN), strict=False))
    return [step.action for step, _ in steps if not step.done]


def _drive(env: gym.Env[Any, Any], actions: list[Any]) -> float:
    """
    Do actions from a reset on, and begin again where an episode ends.

    :param env: any environment
    :param actions: to do
    :return: processor time without the resets [s]
    """
    env.reset(seed=0)
    spent, begin = 0.0, time.process_time()
    for action in actions:
        _, _, terminated, truncated, _ = env.step(action)
        if terminated or truncated:
            spent += time.process_time() - begin
            env.reset()
            begin = time.process_time()
    return spent + time.process_time() - begin


def resets() -> Figures:
    """
    Measure a reset of an environment that has been reset before.

    :return: ``lite_reset_ms``
    """
    env = gym.make(LITE)
    env.reset(seed=0)
    begin = time.process_time()
    for _ in range(RESETS):
        env.reset()
    spent = time.process_time() - begin
    env.close()
    return {"lite_reset_ms": 1000.0 * spent / RESETS}


def _policy(seconds: float) -> Figures:
    """Measure the policy's updates."""
    from sb3_torcs.bench_policy import measure

    return measure(batch_size=BATCH, seconds=seconds)


class _TimedVecEnv(VecEnvWrapper):
    """Adds up the time that steps take, with everything that wraps the environment."""

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
    """Runs callbacks, adds up their time, and holds the clock of whole training steps."""

    def __init__(self, callbacks: list[BaseCallback], env: _TimedVecEnv, start: int) -> None:
        super().__init__(callbacks)
        self._timed_env = env
        self._start = start
        self._spent = 0.0
        self._began = 0.0
        self.share = 0.0

    def on_step(self) -> bool:
        begin = time.process_time()
        go_on = super().on_step()
        end = time.process_time()
        self._spent += end - begin
        if self.num_timesteps <= self._start:  # the clock runs from the end of this call on
            self._began, self._spent, self._timed_env.spent = end, 0.0, 0.0
        else:
            self.share = (self._spent + self._timed_env.spent) / (end - self._began)
        return go_on


def training_share(steps: int) -> Figures:
    """
    Measure what part of a DDPG training step the environment and the callbacks take.

    The shipped hyperparameters are used, with a short warm-up and a small memory; evaluations are
    no training steps and are left out.

    :param steps: training steps to measure
    :return: ``training_env_share``, in [0, 1]
    """
    import torch as th
    import yaml
    from rl_zoo3.exp_manager import ExperimentManager

    import sb3_torcs  # noqa: F401  registers the environment
    from sb3_torcs.zoo import config_file, read_entry

    entry = read_entry(config_file("ddpg"), "TorcsLite-v0")
    start = int(entry["batch_size"]) + WARM_UP
    entry.update(learning_starts=int(entry["batch_size"]), buffer_size=start + steps)
    threads = th.get_num_threads()
    th.set_num_threads(1)
    try:
        with (
            tempfile.TemporaryDirectory() as scratch,
            contextlib.redirect_stdout(io.StringIO()),
        ):
            config = Path(scratch) / "ddpg.yml"
            config.write_text(yaml.safe_dump({"TorcsLite-v0": entry}), encoding="utf-8")
            manager = ExperimentManager(
                argparse.Namespace(),
                "ddpg",
                "TorcsLite-v0",
                scratch,
                eval_freq=-1,
                n_timesteps=start + steps,
                verbose=0,
                device="cpu",
                config=str(config),
            )
            model, _ = manager.setup_experiment()
            env = _TimedVecEnv(model.env)
            model.env = env
            callbacks = _TimedCallbacks(manager.callbacks, env, start)
            model.learn(start + steps, callback=callbacks)
            env.close()
    finally:
        th.set_num_threads(threads)
    return {"training_env_share": callbacks.share}
