"""The progress of a training, as a bar or as lines."""

from __future__ import annotations

import contextlib
import sys
import time
from typing import Any, TextIO

from stable_baselines3.common.callbacks import BaseCallback

from sb3_torcs.callbacks.metrics import DrivingMetricsCallback, callbacks_in
from sb3_torcs.car import is_number
from sb3_torcs.errors import InvalidOption

__all__ = ["RacingProgressCallback", "Unbroken", "spoken_time"]

BAR = "{percentage:3.0f}% {bar} {n_fmt}/{total_fmt} timesteps{postfix}"
REDRAW = 0.2  # [s] between two looks of the bar


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


class Unbroken:
    """
    Text output that drops its text when the reader of the pipe, such as ``tee``, has ended.

    :param stream: to write to
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        """
        :param text: to write
        :return: its length
        """
        with contextlib.suppress(OSError):
            self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        """Flush the stream."""
        with contextlib.suppress(OSError):
            self._stream.flush()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


class RacingProgressCallback(BaseCallback):
    """
    Show the progress: timesteps, episode, distance of the last one, best lap, time left.

    On a terminal this is a bar; elsewhere (a log file, CI) a line every ``every`` seconds. The
    training does not depend on the clock. Lap times of evaluations come from the
    :class:`~sb3_torcs.callbacks.DrivingMetricsCallback` of the same training, if it has one.

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
        self.episodes = 0
        self.distance: float | None = None  # [m] of the last episode
        self.best_lap_time: float | None = None  # [s]
        self._stream = stream
        self._bar: Any = None
        self._ended = True  # has not begun

    def _on_training_start(self) -> None:
        stream: Any = Unbroken(self._stream or sys.stderr)
        self._out = stream
        self._ended = False
        self._total = int(self.locals["total_timesteps"])
        self._first = self.model.num_timesteps
        self._started = self._spoken = time.monotonic()
        self._metrics = [
            callback
            for callback in callbacks_in(self.locals.get("callback"))
            if isinstance(callback, DrivingMetricsCallback)
        ]
        if stream.isatty():
            from tqdm import tqdm

            class Bar(tqdm):
                monitor_interval = 0  # no thread: SubprocVecEnv may still have to fork

            self._bar = Bar(
                total=self._total,
                initial=self._first,
                file=stream,
                bar_format=BAR,
                dynamic_ncols=True,
                mininterval=REDRAW,
            )

    def _on_step(self) -> bool:
        for info, done in zip(self.locals["infos"], self.locals["dones"], strict=True):
            if info.get("lap_time"):
                self._take_lap(info["lap_time"])
            if done:
                self.episodes += 1
                self.distance = info.get("distance")
        now = time.monotonic()
        if now - self._spoken >= (REDRAW if self._bar is not None else self.every):
            self._spoken = now
            self._show(now)
        return True

    def _on_training_end(self) -> None:
        if self._ended:  # the RL Zoo ends its first callback twice
            return
        self._ended = True
        self._show(time.monotonic())
        if self._bar is not None:
            self._bar.close()

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

    def _take_lap(self, seconds: float | None) -> None:
        if seconds is not None and (self.best_lap_time is None or seconds < self.best_lap_time):
            self.best_lap_time = seconds

    def _show(self, now: float) -> None:
        for metrics in self._metrics:
            self._take_lap(metrics.best_evaluation_lap_time)
        text = self.describe(now)
        if self._bar is not None:
            self._bar.set_postfix_str(text, refresh=False)
            self._bar.n = min(self.num_timesteps, self._total)
            self._bar.refresh()
            return
        share = 100 * self.num_timesteps // max(self._total, 1)
        self._out.write(f"{share}% {self.num_timesteps}/{self._total} timesteps, {text}\n")
        self._out.flush()
