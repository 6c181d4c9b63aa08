"""Metrics of driving during a training: lap times, how episodes end, speed, use of the brake.

They go to Stable-Baselines3's own logger (TensorBoard, CSV, the table on the screen). With
:data:`MONITOR_KWARGS` Monitor writes some of them to ``monitor.csv``, too.
"""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt
import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.logger import Image, Logger, TensorBoardOutputFormat
from stable_baselines3.common.vec_env import VecEnv

from sb3_torcs.actions import ACTIONS, BRAKE_THRESHOLD, PEDALS, ActionLayout, layout_of_width
from sb3_torcs.callbacks.driven_line import DrivenLine, drive_lap, line_image
from sb3_torcs.callbacks.tree import callbacks_in
from sb3_torcs.car import check_count
from sb3_torcs.errors import InvalidOption
from sb3_torcs.rewards import CRASHES
from sb3_torcs.vec_env import glance

__all__ = [
    "ENDS",
    "MONITOR_KWARGS",
    "DrivingMetricsCallback",
    "LineListener",
    "mean_q",
]

MONITOR_KWARGS: dict[str, tuple[str, ...] | list[str]] = {
    "reset_keywords": [],
    "info_keywords": ["laps", "best_lap_time", "distance", "damage", "end"],
}
"""
For ``Monitor`` and ``make_vec_env(monitor_kwargs=...)``, and as a plain mapping for the YAML::

    monitor_kwargs:
      reset_keywords: []
      info_keywords: [laps, best_lap_time, distance, damage, end]

Each episode's row of ``monitor.csv`` then holds these, too. Monitor adds the two together, and its
default for the first is a tuple: hence the empty list. A ``best_lap_time`` of 0 is no whole lap.
"""

ENDS = (*CRASHES, "laps", "race", "time_limit")

SATURATED = 0.01  # [-] of an actuator's range: an action so near to a limit counts as at it
RECORD_EVERY = 100  # calls between two records of the means over timesteps
TEXT_FORMATS = ("stdout", "log", "json", "csv")  # these formats refuse pictures


def mean_q(model: BaseAlgorithm, size: int = 256) -> float | None:
    """
    Ask the critic about the newest transitions of the replay buffer.

    They are taken in order, without a random choice, so that the training does not change.

    :param model: any algorithm
    :param size: transitions to ask about
    :return: the mean Q, or ``None`` for an algorithm without replay buffer, or with an empty one
    """
    buffer, critic = getattr(model, "replay_buffer", None), getattr(model, "critic", None)
    stored = getattr(buffer, "observations", None)
    if buffer is None or critic is None or not isinstance(stored, np.ndarray) or not buffer.size():
        return None
    rows = min(math.ceil(size / buffer.n_envs), buffer.size())
    newest = (buffer.pos - 1 - np.arange(rows)) % buffer.buffer_size
    observations = stored[newest].reshape(-1, *stored.shape[2:])
    actions = buffer.actions[newest].reshape(len(observations), -1)
    normalizer = model.get_vec_normalize_env()
    if normalizer is not None:
        observations = normalizer.normalize_obs(observations)
    was_training = critic.training
    critic.train(False)
    with th.no_grad():
        values = critic(
            th.as_tensor(observations, dtype=th.float32, device=model.device),
            th.as_tensor(actions, dtype=th.float32, device=model.device),
        )
    critic.train(was_training)
    return float(th.stack(list(values)).mean())


@dataclass
class _Steps:
    """Sums over timesteps, and their number."""

    count: int = 0
    speed: float = 0.0  # [m/s]
    braking: int = 0
    names: tuple[str, ...] = PEDALS.names
    saturated: list[int] = field(default_factory=list)

    def __post_init__(self) -> None:
        """Begin with 0 for each actuator."""
        self.saturated = [0] * len(self.names)

    def count_actions(
        self,
        actions: npt.NDArray[np.floating],
        layout: ActionLayout,
        limits: tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]],
    ) -> None:
        """
        Count timesteps, those with the brake, and those at limits.

        :param actions: one per race
        :param layout: that reads them
        :param limits: of an action's numbers; values beyond them count as at the limit
        """
        low, high = limits
        free = ((low < actions) & (actions < high)).sum(axis=0).tolist()
        self.count += len(actions)
        self.braking += sum(layout.read(row)[2] > BRAKE_THRESHOLD for row in actions.tolist())
        self.saturated = [
            n + len(actions) - inside for n, inside in zip(self.saturated, free, strict=True)
        ]

    def add(self, other: _Steps) -> None:
        """Add the sums of another and reset that."""
        self.count += other.count
        self.speed += other.speed
        self.braking += other.braking
        self.saturated = [a + b for a, b in zip(self.saturated, other.saturated, strict=True)]
        other.__init__(names=self.names)  # type: ignore[misc]

    def record(self, logger: Logger) -> None:
        """Record the means."""
        logger.record("driving/speed", self.speed / self.count)
        logger.record("driving/brake_share", self.braking / self.count)
        for name, saturated in zip(self.names, self.saturated, strict=True):
            logger.record(f"driving/saturation_{name}", saturated / self.count)


@dataclass
class _Watched:
    """An evaluation callback, and its last call that was followed."""

    callback: EvalCallback
    seen: int


@runtime_checkable
class LineListener(Protocol):
    """A callback that is given the line of each lap that is driven after an evaluation."""

    def take_line(self, line: DrivenLine) -> None:
        """
        Take a line.

        :param line: that has just been driven
        """


class DrivingMetricsCallback(BaseCallback):
    """
    Log how the car drives, for any algorithm, number of environments and kind of ``VecEnv``.

    Use it in every training that you look at in TensorBoard.

    ========================================  ==============================================  ======
    ``driving/…``                             what                                            unit
    ========================================  ==============================================  ======
    ``lap_time``                              mean of the laps completed                      s
    ``best_lap_time``                         best lap of the training so far                 s
    ``laps``, ``distance``                    mean of the episodes that ended                 -, m
    ``end_off_track``, ``end_stuck``, …       share of the episodes that ended this way       -
    ``speed``                                 mean along the car                              m/s
    ``brake_share``                           share of timesteps with the brake beyond 5 %    -
    ``saturation_steering`` (… ``_brake``)    share of timesteps within 1 % of a limit        -
    ``q``                                     mean Q of the newest transitions                -
    ``noise_scale``                           of the action noise, if it has one              -
    ``evaluation_lap_time``                   of the driven line                              s
    ``line``                                  the driven line (TensorBoard image)
    ========================================  ==============================================  ======

    ``reward/TERM`` is the sum of a term of the reward over an episode, as the mean of the episodes
    that ended.

    Means are taken since the logger's previous row. After each evaluation of an
    ``EvalCallback`` of the training, one more lap is driven in its environment if TensorBoard
    shows its line, or if another callback of the training has ``take_line``, which then gets it.

    :param q_every: timesteps of the vector of environments between two estimates of Q
    :param q_size: transitions to ask the critic about
    :param line: whether TensorBoard shows the line after evaluations
    :param line_timesteps: timesteps after which a lap is given up
    :param verbose: as in ``BaseCallback``
    """

    def __init__(
        self,
        *,
        q_every: int = 1000,
        q_size: int = 256,
        line: bool = True,
        line_timesteps: int = 1500,
        verbose: int = 0,
    ) -> None:
        super().__init__(verbose)
        for name, value in (
            ("q_every", q_every),
            ("q_size", q_size),
            ("line_timesteps", line_timesteps),
        ):
            check_count(name, value)
        self.q_every = q_every
        self.q_size = q_size
        self.line = line
        self.line_timesteps = line_timesteps
        self.best_lap_time: float | None = None  # [s] of the training
        self.best_evaluation_lap_time: float | None = None  # [s] of the lines driven
        self.listeners: list[LineListener] = []  # of the training

    def _on_training_start(self) -> None:
        space = self.training_env.action_space
        width = space.shape[0] if isinstance(space, spaces.Box) else 0
        layout = layout_of_width(width)
        if layout is None:
            raise InvalidOption(
                f"the actions of this environment have shape {space.shape}; DrivingMetricsCallback "
                "is for Torcs-v0 and TorcsLite-v0, and knows their actions: "
                f"{', '.join(ACTIONS)}"
            )
        self._layout = layout
        self._pending = _Steps(names=layout.names)  # not yet recorded
        self._window = _Steps(names=layout.names)  # since the logger's previous row
        assert isinstance(space, spaces.Box)
        low, high = (np.asarray(bound, np.float64) for bound in (space.low, space.high))
        margin = SATURATED * (high - low)
        self._terms: list[dict[str, float]] = [{} for _ in range(self.training_env.num_envs)]
        self._limits = low + margin, high - margin
        if self.model.num_timesteps == 0:  # not one that goes on
            self.best_lap_time = self.best_evaluation_lap_time = None
        others = list(callbacks_in(self.locals.get("callback")))
        # Others get the lines from this one.
        same = (callback for callback in others if isinstance(callback, DrivingMetricsCallback))
        first = next(same, self)
        listening: list[LineListener] = [
            callback
            for callback in others
            if not isinstance(callback, DrivingMetricsCallback)
            and isinstance(callback, LineListener)
        ]
        self.listeners = listening if first is self else []  # each line once
        self._evaluations = [
            _Watched(callback, callback.n_calls)
            for callback in others
            if isinstance(callback, EvalCallback)
        ]

    def _on_step(self) -> bool:
        # PPO has two: the actions that it drew, and those clipped for the environment.
        actions = self.locals.get("clipped_actions", self.locals["actions"])
        infos, dones = self.locals["infos"], self.locals["dones"]
        self._pending.count_actions(actions, self._layout, self._limits)
        for info, done, terms in zip(infos, dones.tolist(), self._terms, strict=True):
            speed, lap_time, values = glance(info)
            self._pending.speed += speed
            for term, value in values.items():
                terms[term] = terms.get(term, 0.0) + value
            if lap_time:
                self._record_lap(lap_time)
            if done:
                self._record_episode(info, terms)
        if self.n_calls % RECORD_EVERY == 0:
            self._record_steps()
        if self.n_calls % self.q_every == 0:
            self._record_q()
        self._follow_evaluations()
        return True

    def _on_training_end(self) -> None:
        # An EvalCallback later in the list may have evaluated after our last call.
        self._follow_evaluations()

    def _record_lap(self, seconds: float) -> None:
        self.logger.record_mean("driving/lap_time", seconds)
        self.best_lap_time = min(seconds, self.best_lap_time or math.inf)

    def _record_episode(self, info: dict[str, Any], terms: dict[str, float]) -> None:
        mean = self.logger.record_mean
        for term, total in terms.items():
            mean(f"reward/{term}", total)
        terms.clear()
        mean("driving/distance", info["distance"])
        mean("driving/laps", info["laps"])
        end = info.get("end") or "time_limit"
        for way in ENDS:
            mean(f"driving/end_{way}", float(way == end))
        if self.best_lap_time is not None:
            self.logger.record("driving/best_lap_time", self.best_lap_time)
        self._record_noise()
        self._record_steps()  # off-policy algorithms write a row at the end of an episode

    def _record_steps(self) -> None:
        if "driving/speed" not in self.logger.name_to_value:  # the logger wrote a row
            self._window = _Steps(names=self._layout.names)
        if self._pending.count:
            self._window.add(self._pending)
            self._window.record(self.logger)

    def _record_q(self) -> None:
        value = mean_q(self.model, self.q_size)
        if value is not None:
            self.logger.record("driving/q", value)

    def _record_noise(self) -> None:
        noise = getattr(self.model, "action_noise", None)
        # The same in all environments of a vector.
        noise = next(iter(getattr(noise, "noises", ())), noise)
        scale = getattr(noise, "scale", None)
        if scale is not None:
            self.logger.record("driving/noise_scale", float(scale))

    def _follow_evaluations(self) -> None:
        """Drive and draw a line if an evaluation has just ended."""
        for watched in self._evaluations:
            evaluation = watched.callback
            calls, every = evaluation.n_calls, evaluation.eval_freq
            if calls != watched.seen and every > 0 and calls % every == 0:
                watched.seen = calls
                self._record_line(evaluation.eval_env)

    def _record_line(self, env: VecEnv) -> None:
        if not (self._shows_lines() or self.listeners):
            return
        chance = copy.deepcopy(env.get_attr("np_random"))
        line = drive_lap(self.model, env, self.line_timesteps)
        for index, generator in enumerate(chance):  # so that later evaluations are unchanged
            env.set_attr("np_random", generator, index)
        for listener in (self, *self.listeners):
            listener.take_line(line)
        # Dump at once, as EvalCallback does: the next row may come much later.
        self.logger.dump(self.num_timesteps)

    def _shows_lines(self) -> bool:
        formats = self.logger.output_formats
        return self.line and any(isinstance(f, TensorBoardOutputFormat) for f in formats)

    def take_line(self, line: DrivenLine) -> None:
        """
        Log the line of an evaluation.

        :param line: that was driven
        """
        if line.lap_time is not None:
            best = self.best_evaluation_lap_time or math.inf
            self.best_evaluation_lap_time = min(line.lap_time, best)
            self.logger.record("driving/evaluation_lap_time", line.lap_time)
        if self._shows_lines():
            picture = Image(line_image(line), "HWC")
            self.logger.record("driving/line", picture, exclude=TEXT_FORMATS)
