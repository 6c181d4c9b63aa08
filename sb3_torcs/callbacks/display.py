"""What a terminal shows of a training: a progress bar, and curves of its evaluations."""

from __future__ import annotations

import contextlib
import sys
import weakref
from collections.abc import Sequence
from typing import Any, TextIO

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

__all__ = ["Display", "Unbroken", "bars"]

BLOCKS = " ▁▂▃▄▅▆▇█"
CURVE_HEIGHT = 5  # lines
MARGIN = 10  # columns beside a curve, for its numbers
LOWEST = 0.9  # of the best lap's time: the foot of the curve of lap times


def bars(values: Sequence[float | None], low: float, high: float, width: int) -> list[str]:
    """
    Draw values as upright bars.

    :param values: the oldest first; ``None`` leaves a gap
    :param low: value of no bar
    :param high: value of a full bar
    :param width: columns; with more values than columns, some values are left out
    :return: :data:`CURVE_HEIGHT` lines, the top one first
    """
    if len(values) > width:
        values = [values[(number + 1) * len(values) // width - 1] for number in range(width)]
    steps = len(BLOCKS) - 1
    heights = [
        0
        if value is None
        else max(1, round(steps * CURVE_HEIGHT * min((value - low) / (high - low), 1.0)))
        for value in values
    ]
    return [
        "".join(BLOCKS[min(max(height - steps * row, 0), steps)] for height in heights)
        for row in reversed(range(CURVE_HEIGHT))
    ]


class Display:
    """
    The lower lines of a terminal, which stay there while others scroll above them.

    :param stream: of the terminal
    :param total: timesteps of the training
    """

    def __init__(self, stream: TextIO, total: int) -> None:
        self._console = Console(file=stream, force_terminal=True, highlight=False)
        self._bar = ProgressBar(total=total)
        self._total = total
        self._live = Live(
            console=self._console,
            auto_refresh=False,  # no thread: SubprocVecEnv may still have to fork
            redirect_stdout=sys.stdout.isatty(),
            redirect_stderr=sys.stderr.isatty(),
        )
        self._live.start()
        self._console.show_cursor(True)
        # SB3 does not tell callbacks when an error ends the training.
        self.close = weakref.finalize(self, self._live.stop)

    def say(self, text: str, style: str = "") -> None:
        """
        Write a line that stays.

        :param text: to write
        :param style: of rich, e.g. ``"bold"``
        """
        self._console.print(Text(text, style))

    def show(
        self,
        timesteps: int,
        text: str,
        distances: Sequence[float],
        lap_times: Sequence[float | None],
        lap_length: float,
    ) -> None:
        """
        Draw everything again.

        :param timesteps: that were learned from
        :param text: below the bar
        :param distances: of the evaluations [m]
        :param lap_times: of the evaluations [s]; ``None`` is no whole lap
        :param lap_length: [m]
        """
        self._bar.update(min(timesteps, self._total))
        head = Table.grid(padding=(0, 1), expand=True)
        head.add_column()
        head.add_column(ratio=1)
        head.add_column()
        share = f"{min(100 * timesteps // max(self._total, 1), 100):3d}%"
        head.add_row(share, self._bar, f"{timesteps}/{self._total} timesteps")
        parts: list[RenderableType] = [head, Text(text, no_wrap=True, overflow="ellipsis")]
        if distances and not self._console.options.ascii_only:
            parts.insert(0, self._curves(distances, lap_times, lap_length))
        self._live.update(Group(*parts), refresh=True)

    def _curves(
        self, distances: Sequence[float], lap_times: Sequence[float | None], lap_length: float
    ) -> Table:
        """Put the curves of distance and lap time side by side."""
        width = max(self._console.width // 2 - MARGIN, 1)
        curves = Table.grid(padding=(0, 1))
        titles = Text("distance of evaluations [m]", "dim"), Text("time of their lap [s]", "dim")
        curves.add_row("", titles[0], "", titles[1])
        driven = bars(distances, 0.0, lap_length, width)
        laps = [seconds for seconds in lap_times if seconds is not None]
        best, worst = min(laps, default=0.0), max(laps, default=0.0)
        timed = bars(lap_times, LOWEST * best, worst, width) if laps else [""] * CURVE_HEIGHT
        labels = [("", "")] * CURVE_HEIGHT
        labels[0] = (f"{lap_length:.0f}", f"{worst:.1f}" if laps else "")
        labels[-1] = ("0", f"{LOWEST * best:.1f}" if laps else "")
        for (left, right), distance, time in zip(labels, driven, timed, strict=True):
            cells = (
                Text(left),
                Text(distance.ljust(width), "cyan"),
                Text(right),
                Text(time, "green"),
            )
            curves.add_row(*cells)
        return curves


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
