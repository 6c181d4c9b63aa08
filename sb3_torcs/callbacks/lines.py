"""The lines that a training learns to drive, as a series of pictures and a table."""

from __future__ import annotations

import csv
import math
import time
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback

from sb3_torcs.callbacks.driven_line import DrivenLine
from sb3_torcs.callbacks.progress import RacingProgressCallback, spoken_moment
from sb3_torcs.callbacks.tree import callbacks_in
from sb3_torcs.car import is_number
from sb3_torcs.errors import InvalidOption
from sb3_torcs.files import writable_folder

if TYPE_CHECKING:
    from matplotlib.figure import SubFigure

__all__ = ["DrivenLap", "LinePicturesCallback", "draw_learning", "driven_laps"]

TABLE = "laps.csv"
SHOWN = 6  # pictures of a series in the picture of the learning, at most
COLUMNS = 3  # of them in a row
SIZE, ROW = 15.0, 4.4  # [in] its width, and the height of the curves and of each row
FASTEST = 70.0  # [m/s] the end of the colours, the same in all pictures of a series


class DrivenLap(NamedTuple):
    """One row of the table: what an evaluation of the training drove."""

    seconds: float  # [s] since the training began
    timesteps: int  # that were learned from until then
    distance: float  # [m]
    lap_time: float | None  # [s] of the whole lap, if it was one
    picture: str  # its file, or nothing


def driven_laps(folder: Path) -> list[DrivenLap]:
    """
    Read the table of a series.

    :param folder: of a :class:`LinePicturesCallback`
    :return: its rows, without those that a full disk cut off
    """
    if not (folder / TABLE).is_file():
        return []
    laps = []
    with (folder / TABLE).open(newline="", encoding="utf-8") as file:
        for row in csv.reader(file):
            try:
                seconds, timesteps, distance, lap_time, picture = row
                time_of_lap = float(lap_time) if lap_time else None
                lap = DrivenLap(
                    float(seconds), int(timesteps), float(distance), time_of_lap, picture
                )
            except ValueError:  # the header, or half a row
                continue
            laps.append(lap)
    return laps


class LinePicturesCallback(BaseCallback):
    """
    Draw lines that are driven after evaluations, and write a table of all evaluations.

    It writes ``001.png``, ``002.png``, ... and ``laps.csv`` into the folder; a resumed training
    continues the series. The first evaluation and the first whole lap are always drawn. If a file
    cannot be written later, the series ends with a warning, but the training continues.

    :param folder: is made when the training begins, which is an ``OutputNotWritable`` if it cannot
        be written
    :param every: seconds between two pictures, at least [s]
    :param verbose: as in ``BaseCallback``
    """

    def __init__(self, *, folder: str, every: float = 60.0, verbose: int = 0) -> None:
        super().__init__(verbose)
        if not is_number(every) or every < 0.0:
            raise InvalidOption(f"every is {every!r} s; expected 0 or more")
        self.folder = Path(folder)
        self.every = every
        self.writable = True

    def _on_training_start(self) -> None:
        callbacks = list(callbacks_in(self.locals.get("callback")))
        self._progress = [item for item in callbacks if isinstance(item, RacingProgressCallback)]
        self._begun, self._first = time.monotonic(), self.model.num_timesteps
        self._due = -math.inf  # [s] since then
        writable_folder(self.folder)
        self._before = driven_laps(self.folder)
        self._complete = any(lap.lap_time for lap in self._before)

    def _on_step(self) -> bool:
        return True

    def take_line(self, line: DrivenLine) -> None:
        """
        Keep one line.

        :param line: that was driven after an evaluation
        """
        if not self.writable:
            return
        now = time.monotonic() - self._begun
        last = self._before[-1] if self._before else DrivenLap(0.0, 0, 0.0, None, "")
        lap = DrivenLap(
            now + last.seconds,
            self.num_timesteps - self._first + last.timesteps,
            line.distance,
            line.lap_time,
            "",
        )
        first_lap = line.lap_time is not None and not self._complete
        self._complete |= first_lap
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            if first_lap or now >= self._due:
                self._due = now + self.every
                lap = lap._replace(picture=self._draw(line, lap).name)
            self._write(lap)
        except OSError as error:
            self.writable = False
            self._say(f"no more pictures: {error}")
            if not self._progress:
                warnings.warn(f"no more pictures: {error}", stacklevel=2)

    def _draw(self, line: DrivenLine, lap: DrivenLap) -> Path:
        # Graphics load only when there is something to draw.
        from sb3_torcs.tracks.plot import plot_track

        number = max((int(path.stem) for path in _pictures(self.folder)), default=0) + 1
        path = self.folder / f"{number:03d}.png"
        driven = f"{lap.lap_time:.2f} s" if lap.lap_time else f"{max(lap.distance, 0.0):.0f} m"
        title = f"{spoken_moment(lap.seconds)}, {lap.timesteps:,} timesteps: {driven}"
        points = np.column_stack([line.x, line.y])
        plot_track(line.track, path, line=points, speed=line.speed, title=title, fastest=FASTEST)
        self._say(f"{spoken_moment(lap.seconds)}: the line it drives, {path}")
        return path

    def _write(self, lap: DrivenLap) -> None:
        path = self.folder / TABLE
        new = not path.exists()
        with path.open("a", newline="", encoding="utf-8") as file:
            writer = csv.writer(file, lineterminator="\n")
            if new:
                writer.writerow(DrivenLap._fields)
            lap_time = f"{lap.lap_time:.3f}" if lap.lap_time else ""
            seconds, distance = f"{lap.seconds:.1f}", f"{lap.distance:.1f}"
            writer.writerow((seconds, lap.timesteps, distance, lap_time, lap.picture))

    def _say(self, text: str) -> None:
        for progress in self._progress:
            progress.say(text)


def draw_learning(folder: Path, path: Path) -> None:
    """
    Draw how a training learned: distances and lap times of its evaluations, and some of its lines.

    :param folder: of a :class:`LinePicturesCallback`
    :param path: of the picture
    :raises InvalidOption: if the folder has no evaluations
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.image import imread

    laps = driven_laps(folder)
    if not laps:
        raise InvalidOption(f"'{folder / TABLE}' has no evaluations; train for longer")
    pictures = _pictures(folder)
    numbers = np.linspace(0, len(pictures) - 1, SHOWN).round().astype(int)
    chosen = [pictures[number] for number in np.unique(numbers)] if pictures else []
    rows = math.ceil(len(chosen) / COLUMNS)
    figure = Figure(figsize=(SIZE, ROW * (1 + rows)), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(1 + rows, 1)
    _draw_curves(figure.add_subfigure(grid[0]), laps)
    for row in range(rows):
        cells = figure.add_subfigure(grid[1 + row]).subplots(1, COLUMNS)
        for number, axes in enumerate(cells, row * COLUMNS):
            axes.axis("off")
            if number < len(chosen):
                axes.imshow(imread(chosen[number]))
    figure.savefig(path, dpi=120)


def _pictures(folder: Path) -> list[Path]:
    """List the pictures of a series, the oldest first."""
    numbered = [path for path in folder.glob("*.png") if path.stem.isdecimal()]
    return sorted(numbered, key=lambda path: int(path.stem))


def _draw_curves(figure: SubFigure, laps: list[DrivenLap]) -> None:
    whole = [lap for lap in laps if lap.lap_time]
    distance, lap_time = figure.subplots(1, 2)
    distance.set_title("distance of an evaluation, at most a lap [m]")
    distance.plot([lap.seconds / 60.0 for lap in laps], [lap.distance for lap in laps], ".-")
    lap_time.set_title("time of its lap from a standing start [s]")
    minutes, seconds = [lap.seconds / 60.0 for lap in whole], [lap.lap_time for lap in whole]
    lap_time.plot(minutes, np.array(seconds, float), ".-", color="tab:green")
    for axes in (distance, lap_time):
        axes.set_xlabel("training [min]")
        axes.set_xlim(0.0, laps[-1].seconds / 60.0)
        axes.grid(alpha=0.3)
