"""The progress of a training, as a bar or as lines."""

from __future__ import annotations

import math
import os
import sys
import time
from typing import Any, TextIO

from stable_baselines3.common.callbacks import BaseCallback

from sb3_torcs.callbacks.display import Display, Unbroken
from sb3_torcs.callbacks.driven_line import DrivenLine
from sb3_torcs.callbacks.metrics import DrivingMetricsCallback
from sb3_torcs.callbacks.tree import callbacks_in
from sb3_torcs.car import is_number
from sb3_torcs.errors import InvalidOption

__all__ = ["RacingProgressCallback", "spoken_moment", "spoken_time"]

REDRAW = 0.2  # [s] between two pictures of the display
FIRST_LAP = "bold green"  # style of the line that tells of it


def spoken_time(seconds: float) -> str:
    """
    Format a duration.

    :param seconds: [s]
    :return: e.g. ``"1 h 05 min"``, ``"12 min"`` or ``"40 s"``
    """
    whole = round(seconds)
    if whole < 100:
        return f"{whole} s"
    minutes = round(whole / 60)
    return f"{minutes} min" if minutes < 100 else f"{minutes // 60} h {minutes % 60:02d} min"


def spoken_moment(seconds: float) -> str:
    """
    Format a moment of a training.

    :param seconds: since it began [s]
    :return: e.g. ``"12 s"`` or ``"1 min 12 s"``
    """
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02d} s" if minutes else f"{rest} s"


class RacingProgressCallback(BaseCallback):
    """
    Show the progress: timesteps, episode, distance of the last one, best lap, time left.

    On a terminal this is a bar; elsewhere (a log file, CI) a line every ``every`` seconds. The
    training does not depend on the clock. With the
    :class:`~sb3_torcs.callbacks.DrivingMetricsCallback` of the same training, there are a line for
    each evaluation, and on a terminal curves of them. The first whole lap is reported at once.

    :param every: seconds between two lines where there is no terminal [s]
    :param stream: where to write; ``None`` is the standard error
    :param verbose: as in ``BaseCallback``
    """

    def __init__(
        self, *, every: float = 30.0, stream: TextIO | None = None, verbose: int = 0
    ) -> None:
        super().__init__(verbose)
        if not is_number(every) or every <= 0.0:
            raise InvalidOption(f"every is {every!r} s; expected more than 0")
        self.every = every
        self._stream = stream
        self._display: Display | None = None
        self._ended = True  # has not begun
        self._forget()

    def _forget(self) -> None:
        """Begin to count from zero."""
        self.episodes = 0
        self.distance: float | None = None  # [m] of the last episode
        self.best_lap_time: float | None = None  # [s]
        self._distances: list[float] = []  # [m] of the evaluations
        self._lap_times: list[float | None] = []  # [s]
        self._lap_length = 0.0  # [m]

    def _on_training_start(self) -> None:
        stream: Any = Unbroken(self._stream or sys.stderr)
        self._out = stream
        self._ended = False
        if self.model.num_timesteps == 0:  # not one that goes on
            self._forget()
        self._total = int(self.locals["total_timesteps"])
        self._first = self.model.num_timesteps
        self._started = self._spoken = time.monotonic()
        self._metrics = [
            callback
            for callback in callbacks_in(self.locals.get("callback"))
            if isinstance(callback, DrivingMetricsCallback)
        ]
        if stream.isatty() and os.environ.get("TERM") != "dumb":
            self._display = Display(stream, self._total)

    def _on_step(self) -> bool:
        for info, done in zip(self.locals["infos"], self.locals["dones"], strict=True):
            if info.get("lap_time"):
                self._take_lap(info["lap_time"], ", by a car that learns")
            if done:
                self.episodes += 1
                self.distance = info.get("distance")
        now = time.monotonic()
        if now - self._spoken >= (REDRAW if self._display is not None else self.every):
            self._spoken = now
            self._show(now)
        return True

    def _on_training_end(self) -> None:
        if self._ended:  # the RL Zoo ends its first callback twice
            return
        self._ended = True
        self._show(time.monotonic())
        if self._display is not None:
            self._display.close()
            self._display = None

    def describe(self, now: float) -> str:
        """
        Format everything but the timesteps.

        :param now: the present time of the monotonic clock [s]
        :return: e.g. ``"episode 12, last 345 m, best lap 91.20 s, 4 min left"``
        """
        done = self.num_timesteps - self._first
        parts = [f"episode {self.episodes}"]
        if self.distance is not None:
            parts.append(f"last {self.distance:.0f} m")
        best = self.best_lap_time
        parts.append("no whole lap yet" if best is None else f"best lap {best:.2f} s")
        if done > 0:
            left = (now - self._started) / done * max(self._total - self.num_timesteps, 0)
            parts.append(f"{spoken_time(left)} left")
        return ", ".join(parts)

    def say(self, text: str, style: str = "") -> None:
        """
        Write a line that stays, also on a terminal.

        :param text: to write
        :param style: of rich, e.g. ``"bold"``
        """
        if self._display is not None:
            self._display.say(text, style)
            return
        self._out.write(f"{text}\n")
        self._out.flush()

    def _moment(self) -> str:
        return spoken_moment(time.monotonic() - self._started)

    def _take_lap(self, seconds: float | None, where: str = "") -> None:
        if seconds is None or seconds >= (self.best_lap_time or math.inf):
            return
        if self.best_lap_time is None:
            self.say(f"{self._moment()}: the first whole lap, {seconds:.2f} s{where}", FIRST_LAP)
        self.best_lap_time = seconds

    def take_line(self, line: DrivenLine) -> None:
        """
        Tell what was driven after an evaluation.

        :param line: that was driven
        """
        lap_time, known = line.lap_time, [seconds for seconds in self._lap_times if seconds]
        self._distances.append(line.distance)
        self._lap_times.append(lap_time)
        self._lap_length = line.track.length
        first = lap_time is not None and self.best_lap_time is None
        self._take_lap(lap_time)
        if lap_time is None:
            self.say(f"{self._moment()}: {max(line.distance, 0.0):.0f} m")
        elif not first:
            best = ", the best so far" if known and lap_time < min(known) else ""
            self.say(f"{self._moment()}: a whole lap, {lap_time:.2f} s{best}")

    def _show(self, now: float) -> None:
        for metrics in self._metrics:
            self._take_lap(metrics.best_evaluation_lap_time)
        text = self.describe(now)
        if self._display is not None:
            curves = self._distances, self._lap_times, self._lap_length
            self._display.show(self.num_timesteps, text, *curves)
            return
        share = min(100 * self.num_timesteps // max(self._total, 1), 100)  # PPO goes beyond
        self._out.write(f"{share}% {self.num_timesteps}/{self._total} timesteps, {text}\n")
        self._out.flush()
