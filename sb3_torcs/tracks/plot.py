"""A picture of a track, with a driven line if there is one."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sb3_torcs.car import KMH, FloatArray
from sb3_torcs.errors import InvalidOption
from sb3_torcs.files import IN_A_FOLDER, PICTURES, atomic_file, checked_ending
from sb3_torcs.tracks.track import CURVATURE, LENGTH, Track

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import LineCollection

__all__ = ["edges", "plot_track"]

SIZE = 8.0  # [in] of the longer side of the picture
STEP = 5.0  # [m] between points of the drawn edges, at most
TURN_STEP = math.radians(3.0)  # [rad] between them, at most
ROAD_COLOUR = "#c9ccd1"
EDGE_COLOUR = "#4a4f57"
START_COLOUR = "#c1272d"


def plot_track(
    track: Track,
    path: str | Path,
    line: FloatArray | None = None,
    speed: FloatArray | None = None,
    title: str | None = None,
    fastest: float | None = None,
    label: str = "speed [km/h]",
) -> None:
    """
    Draw a track seen from above, to scale.

    :param track: to draw
    :param path: of the picture; its suffix says the format: ``.png``, ``.svg`` or ``.pdf``
    :param line: places the car has passed, x and y, (n, 2) [m]
    :param speed: at these places, (n,) [m/s]; without it the line has one colour
    :param title: above the picture; ``None`` is the track's name and measures
    :param fastest: speed at the end of the colours, which begin at 0 [m/s]; ``None`` spreads them
        over the given speeds
    :param label: of the colours
    :raises InvalidOption: if ``track`` is no track
    :raises OutputNotWritable: if the file cannot be written, or has another suffix; the previous
        one is kept
    """
    if not isinstance(track, Track):
        raise InvalidOption(
            f"track is {track!r}; expected a track, e.g. "
            'sb3_torcs.tracks.catalogue.load_track("aalborg")'
        )
    path = checked_ending(path, PICTURES)
    # Drawing is rare and its import is slow. Figures of their own leave the caller's windows be.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=_size(track), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.set_aspect("equal")
    _draw_road(axes, track)
    _draw_start(axes, track)
    if line is not None:
        drawn = _draw_line(axes, np.asarray(line), speed)
        if drawn is not None:
            if fastest is not None:
                drawn.set_clim(0.0, KMH * fastest)
            figure.colorbar(drawn, ax=axes, label=label, shrink=0.8)
    measures = (
        f"{track.category}/{track.name}: {track.length:.0f} m, {track.width:.0f} m wide, "
        f"tightest bend {track.tightest_radius:.0f} m"
    )
    axes.set_title(measures if title is None else title)
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")
    with atomic_file(path, IN_A_FOLDER) as aside:
        figure.savefig(aside, dpi=120)


def _size(track: Track) -> tuple[float, float]:
    """
    Fit the picture to the track's proportions.

    :param track: to draw
    :return: width and height [in], with room for title, labels and colour bar
    """
    extent = np.ptp(edges(track)[0], axis=0)
    width, height = SIZE * extent / max(float(extent.max()), 1e-9)
    return max(float(width), 0.4 * SIZE) + 1.5, max(float(height), 0.3 * SIZE) + 1.0


def edges(track: Track) -> tuple[FloatArray, FloatArray]:
    """
    Trace the edges of the road.

    :param track: whose road it is
    :return: left and right edge, each x and y, (n, 2) [m], closed
    """
    left, right = [], []
    for index, (segment, row) in enumerate(zip(track.segments, track.table, strict=True)):
        steps = max(
            math.ceil(row[LENGTH] / STEP), math.ceil(abs(row[CURVATURE]) * row[LENGTH] / TURN_STEP)
        )
        steps = 1 if segment.curvature == 0.0 else steps
        for fraction in np.linspace(0.0, 1.0, steps + 1):
            half = 0.5 * segment.width_at(float(fraction))
            along = float(fraction) * segment.length
            left.append(track.pose_on(index, along, half)[:2])
            right.append(track.pose_on(index, along, -half)[:2])
    return np.array(left), np.array(right)


def _draw_road(axes: Axes, track: Track) -> None:
    """
    Draw the surface in its true width and both edges.

    :param axes: to draw on
    :param track: whose road it is
    """
    from matplotlib.collections import PolyCollection

    left, right = edges(track)
    # Piece by piece: one ring would leave holes where a road crosses over itself.
    pieces = np.stack([left[:-1], left[1:], right[1:], right[:-1]], axis=1)
    axes.add_collection(
        PolyCollection(list(pieces), facecolors=ROAD_COLOUR, edgecolors=ROAD_COLOUR, linewidths=0.8)
    )
    for edge in (left, right):
        axes.plot(*edge.T, color=EDGE_COLOUR, linewidth=0.8)


def _draw_start(axes: Axes, track: Track) -> None:
    """
    Draw the start line, and beside it an arrow in the direction of driving.

    :param axes: to draw on
    :param track: whose start it is
    """
    half = 0.5 * track.width
    scale = 0.05 * float(np.ptp(edges(track)[0], axis=0).max())
    places = [track.pose(0.0, offset)[:2] for offset in (half, -half)]
    axes.plot(*np.array(places).T, color=START_COLOUR, linewidth=2.5, solid_capstyle="butt")
    tail = track.pose(0.0, half + 0.6 * scale)
    tip = (tail.x + scale * math.cos(tail.heading), tail.y + scale * math.sin(tail.heading))
    axes.annotate(
        "",
        xy=tip,
        xytext=tail[:2],
        arrowprops={"arrowstyle": "-|>", "color": START_COLOUR, "linewidth": 2.0},
    )


def _draw_line(axes: Axes, line: FloatArray, speed: FloatArray | None) -> LineCollection | None:
    """
    Draw where the car went.

    :param axes: to draw on
    :param line: x and y, (n, 2) [m]
    :param speed: (n,) [m/s] or nothing
    :return: what the colour bar explains, or nothing
    """
    from matplotlib import collections

    if speed is None:
        axes.plot(*line.T, color="#1f5fa8", linewidth=1.6)
        return None
    pieces = np.stack([line[:-1], line[1:]], axis=1)
    shown = collections.LineCollection(
        list(pieces), zorder=3, cmap="plasma", linewidths=1.8, capstyle="round"
    )
    shown.set_array(0.5 * KMH * (np.asarray(speed)[:-1] + np.asarray(speed)[1:]))
    axes.add_collection(shown)
    return shown
