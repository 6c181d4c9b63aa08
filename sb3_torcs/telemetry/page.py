"""The lap report: a comparison of laps as one HTML file."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from html import escape
from typing import Any

import numpy as np

from sb3_torcs.car import KMH, FloatArray
from sb3_torcs.telemetry.comparison import Comparison, CornerPass, DriverLap
from sb3_torcs.telemetry.document import (
    FOLDER,
    Cell,
    chip,
    colour_of,
    dash_of,
    document,
    paragraph,
    table,
)
from sb3_torcs.telemetry.laps import Lap
from sb3_torcs.tracks.plot import edges
from sb3_torcs.tracks.track import Track

__all__ = ["lap_report", "missing", "summary"]

MOST_SLIP = 0.5  # [-] that is shown; a car that turns round slips by any number
EQUAL = 0.0005  # [s] less is no difference
IN_TITLE = 3  # laps that the title names
BESIDE = 1.6  # [-] of the road's width, from its middle to a corner's number


def lap_report(comparison: Comparison) -> str:
    """
    Make the page of a comparison.

    :param comparison: of laps
    :return: HTML, which works without any other file and without a network
    """
    drivers, track = comparison.drivers, comparison.track
    laps = [f"{one.drive.driver} {clock(one.lap.time)}" for one in drivers]
    shown = ", ".join(laps[:IN_TITLE]) + (
        f" and {len(laps) - IN_TITLE} more" if laps[IN_TITLE:] else ""
    )
    title = f"{track.name}: {shown}"
    body = "\n".join(
        [
            f"<header><h1>{escape(title)}</h1>",
            _folded([paragraph(sentence) for sentence in summary(comparison)]),
            *(paragraph(sentence, "note missing") for sentence in missing(comparison)),
            "</header>",
            "<main>",
            _moment(drivers),
            "<h2>Corners</h2>",
            paragraph(
                "The speeds are those at a corner's beginning, at its slowest point and at its "
                "end. A corner's time counts from the middle of the straight before it to the "
                "middle of the straight after it, so the times lost add up to the whole lap's.",
                "note",
            ),
            _corners(comparison),
            "<h2>Sectors</h2>",
            paragraph("Three of one length; the best times are bold.", "note"),
            _sectors(drivers),
            "<h2>Laps</h2>",
            _laps(comparison),
            "</main>",
            "<footer>Made by sb3-torcs. Works offline; nothing is sent anywhere.</footer>",
        ]
    )
    return document(title, body, _data(comparison), ["page.js"])


def _folded(paragraphs: Sequence[str]) -> str:
    """Hide all but a few paragraphs until somebody asks for them."""
    few, rest = paragraphs[: IN_TITLE - 1], "".join(paragraphs[IN_TITLE - 1 :])
    more = f"<details><summary>The others</summary>{rest}</details>" if rest else ""
    return "".join(few) + more


def clock(seconds: float) -> str:
    """Format a lap time, e.g. ``1:23.456``."""
    thousandths = round(1000.0 * seconds)
    return f"{thousandths // 60000}:{thousandths / 1000.0 % 60.0:06.3f}"


def _signed(seconds: float) -> str:
    sign = "±" if abs(seconds) < EQUAL else "+" if seconds > 0.0 else "−"
    return f"{sign}{abs(seconds):.3f}"


def summary(comparison: Comparison) -> list[str]:
    """
    Say in words who is faster, and where.

    :param comparison: of laps
    :return: a sentence per driver but the first
    """
    first, *others = comparison.drivers
    name, sentences = first.drive.driver, []
    for one in others:
        behind = float(one.delta[-1])
        told = f"{one.drive.driver} is {abs(behind):.3f} s "
        told += f"{'slower' if behind > 0.0 else 'faster'} than {name}"
        if abs(behind) < EQUAL:
            told = f"{one.drive.driver} is as fast as {name}"
        lost = [corner.time_lost for corner in one.corners]
        if lost:
            worst, best = int(np.argmax(lost)), int(np.argmin(lost))
            parts = []
            if lost[best] < -EQUAL:
                parts.append(f"it gains most at corner {best + 1} ({-lost[best]:.3f} s)")
            if lost[worst] > EQUAL:
                parts.append(f"it loses most at corner {worst + 1} ({lost[worst]:.3f} s)")
            told += "".join(f"{', and ' if n else ': '}{part}" for n, part in enumerate(parts))
        sentences.append(f"{told}.")
    return sentences


def missing(comparison: Comparison) -> list[str]:
    """
    Say what a reader might miss or misread.

    :param comparison: of laps
    """
    notes = [
        f"{drive.driver} drove no whole lap: it came {round(drive.distance)} m far."
        for drive in comparison.left_out
    ]
    drivers = comparison.drivers
    for what, values in (
        ("cars", {one.drive.driver: one.drive.car for one in drivers}),
        ("worlds", {one.drive.driver: one.drive.world for one in drivers}),
    ):
        if len(set(values.values())) > 1:
            told = ", ".join(f"{driver} in {value}" for driver, value in values.items())
            notes.append(f"The {what} differ: {told}.")
    if len(drivers) == 1:
        hint = "" if comparison.left_out else ": name another driver to see time gained and lost"
        notes.append(f"There is one lap only{hint}.")
    standing = [one.drive.driver for one in drivers if one.lap.standing]
    if standing:
        notes.append(f"From the grid, not flying: the lap of {', '.join(standing)}.")
    return notes


def _name(number: int, one: DriverLap) -> Cell:
    """Cell with a driver's colour and name."""
    name = one.drive.driver
    return Cell(name, html=f"{chip(number)}{escape(name)}")


def _moment(drivers: Sequence[DriverLap]) -> str:
    """Lay out charts, map and the table of the moment, which the script fills."""
    rows = "".join(
        f'<tr id="driver-{number}"><td class="word">{_name(number, one).html}</td>'
        f"{'<td></td>' * 5}</tr>"
        for number, one in enumerate(drivers)
    )
    return (FOLDER / "page.html").read_text(encoding="utf-8").replace("READOUT", rows)


def _corners(comparison: Comparison) -> str:
    """Table of the corners, one group of rows per corner."""
    headers = (
        "corner", "driver", "brakes m before", "entry km/h", "slowest km/h", "exit km/h",
        "time lost s",
    )  # fmt: skip
    groups = []
    for number, corner in enumerate(comparison.corners):
        side = "left" if corner.left else "right"
        told = f"{number + 1}, {side}, {corner.begin:.0f} m"
        radius = f'<span class="wide">, radius {corner.radius:.0f} m</span>'
        place = Cell(told, html=told + radius)
        groups.append(
            [
                [place if row == 0 else "", *_pass_cells(row, one, one.corners[number])]
                for row, one in enumerate(comparison.drivers)
            ]
        )
    return table(headers, groups, words=2)


def _pass_cells(place: int, one: DriverLap, own: CornerPass) -> list[Cell | str]:
    """Cells of a driver in a corner."""
    brakes = "–" if own.braking_point is None else f"{round(own.distance - own.braking_point)}"
    speeds = (own.entry_speed, own.apex_speed, own.exit_speed)
    lost = "" if place == 0 else _signed(own.time_lost)
    return [_name(place, one), brakes.replace("-", "−"), *(f"{KMH * v:.0f}" for v in speeds), lost]


def _sectors(drivers: Sequence[DriverLap]) -> str:
    """Table of the sectors."""
    count = len(drivers[0].sectors)
    best = [min(one.sectors[n] for one in drivers) for n in range(count)]
    rows: list[list[Cell | str]] = [
        [
            _name(place, one),
            *(Cell(f"{own:.3f}", best=own == best[n]) for n, own in enumerate(one.sectors)),
            clock(one.lap.time),
            "" if place == 0 else _signed(float(one.delta[-1])),
        ]
        for place, one in enumerate(drivers)
    ]
    if len(drivers) > 1:
        rows.append(["best of all", *(f"{own:.3f}" for own in best), clock(sum(best)), ""])
    headers = ["driver", *(f"sector {n + 1} s" for n in range(count)), "lap", "behind s"]
    return table(headers, [rows])


def _laps(comparison: Comparison) -> str:
    """Table of all laps; the compared one is bold."""
    most = max(len(drive.laps) for drive in comparison.drives)
    headers = ["driver", "world", "car", *(f"lap {n + 1}" for n in range(most))]
    compared = {id(one.lap) for one in comparison.drivers}
    rows: list[list[Cell | str]] = [
        [
            drive.driver,
            drive.world,
            drive.car,
            *(_lap_cell(lap, best=id(lap) in compared) for lap in drive.laps),
            *([""] * (most - len(drive.laps))),
        ]
        for drive in comparison.drives
    ]
    note = "The bold ones are compared."
    return paragraph(note, "note") + table(headers, [rows], words=3)


def _lap_cell(lap: Lap, *, best: bool) -> Cell:
    """Cell with a lap's time."""
    return Cell(f"{clock(lap.time)}{' from the grid' if lap.standing else ''}", best=best)


def _data(comparison: Comparison) -> dict[str, Any]:
    """Pack what the script draws."""
    track, grid = comparison.track, comparison.distance
    return {
        "distance": _packed(grid),
        "road": _road(track),
        "corners": [
            {
                "begin": corner.begin,
                "end": corner.end,
                **_beside(track, 0.5 * (corner.begin + corner.end), corner.left),
            }
            for corner in comparison.corners
        ],
        "drivers": [
            {
                "name": one.drive.driver,
                "colour": colour_of(number),
                "dash": dash_of(number),
                "columns": {name: _packed(own) for name, own in _columns(one, track, grid).items()},
            }
            for number, one in enumerate(comparison.drivers)
        ],
    }


def _columns(one: DriverLap, track: Track, grid: FloatArray) -> dict[str, FloatArray]:
    """Return what is drawn of a lap, (n,) each."""
    own = one.sampled
    line = [track.pose(d, offset) for d, offset in zip(grid, own.offset, strict=True)]
    return {
        **own.channels,
        "speed": KMH * own.channels["speed"],
        "slip": np.clip(own.channels["slip"], -MOST_SLIP, MOST_SLIP),
        "time": own.time,
        "delta": one.delta,
        "x": np.array([place.x for place in line]),
        "y": np.array([place.y for place in line]),
    }


def _packed(values: FloatArray) -> str:
    """Pack numbers as the script reads them: 32 bits each, little end first."""
    return base64.b64encode(values.astype("<f4").tobytes()).decode()


def _road(track: Track) -> dict[str, Any]:
    """Return the road's edges and its start line, rounded to centimetres."""

    def axes(points: FloatArray) -> dict[str, list[float]]:
        x, y = np.round(points, 2).T.tolist()
        return {"x": x, "y": y}

    left, right = edges(track)
    half = 0.5 * track.width
    line = np.array([track.pose(0.0, offset)[:2] for offset in (half, -half)])
    return {"left": axes(left), "right": axes(right), "line": axes(line)}


def _beside(track: Track, distance: float, left: bool) -> dict[str, float]:
    """Return a place beside the road, on the outer side of a bend."""
    place = track.pose(distance, (-BESIDE if left else BESIDE) * track.width)
    return {"x": round(place.x, 2), "y": round(place.y, 2)}
