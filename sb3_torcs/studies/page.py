"""The report of a study as one HTML file: curves of all seeds, tables that sort, links."""

from __future__ import annotations

import os
import shlex
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sb3_torcs.studies.config import trial_name
from sb3_torcs.studies.curves import COMPLETES, PANELS, Learning
from sb3_torcs.studies.estimates import Array, Estimate
from sb3_torcs.telemetry.document import Cell, chip, colour_of, dash_of, document, paragraph, table

__all__ = ["Section", "study_page"]

BESIDE = {"lap report": "lap.html", "video": "lap.mp4"}
"""What a seed's folder may hold, and where."""


class Section(NamedTuple):
    """A table of the report."""

    title: str
    headers: Sequence[str]
    rows: Sequence[Sequence[str]]


def study_page(
    name: str,
    notes: Sequence[str],
    sections: Sequence[Section],
    variants: Sequence[Learning],
    *,
    folder: Path,
    output: Path,
) -> str:
    """
    Make the page of a study.

    :param name: of the study
    :param notes: what a reader should know first
    :param sections: the tables
    :param variants: how each learned
    :param folder: of the study
    :param output: folder that the page will lie in
    :return: HTML, which works without any other file and without a network
    """
    panels = _panels(variants)
    legend = " ".join(
        f"{chip(number)}{escape(learning.variant)}&emsp;"
        for number, learning in enumerate(variants)
    )
    body = [
        f"<header><h1>{escape(name)}</h1>",
        *(paragraph(note) for note in notes),
        "</header><main><h2>Learning</h2>",
        f"<p>{legend}</p>",
        paragraph("Thin: every seed; point at one to see which. Bold: the interquartile mean of "
                  "the seeds, and its 95 % interval. Of the share of races that complete: the mean "
                  "of all seeds, and its interval, without single seeds.", "note"),
        f'<div class="panels">{"".join(_frame(panel) for panel in panels)}</div>',
    ]  # fmt: skip
    for section in sections:
        body += [f"<h2>{escape(section.title)}</h2>"]
        body += [table(section.headers, [section.rows], kind="sortable")]
    body += ["<h2>Laps of each seed</h2>", *_links(variants, folder, output), "</main>"]
    return document(name, "\n".join(body), {"panels": panels}, ["page_study.js"])


def _frame(panel: Mapping[str, Any]) -> str:
    return f'<div id="{panel["id"]}"></div>'


def _panels(variants: Sequence[Learning]) -> list[dict[str, Any]]:
    """Return the panels with the curves of all seeds."""
    panels = []
    for name, title in PANELS.items():
        curves: list[dict[str, Any]] = []
        for number, learning in enumerate(variants):
            if name != COMPLETES:
                for trial, seed in zip(learning.trials, learning.seeds, strict=True):
                    told = f"{learning.variant}, seed {trial.seed}"
                    curves.append(_curve(told, number, seed["timesteps"], seed[name]))
            curves += _mean(learning, number, name)
        from_zero = "tozero" if name == "distance" else "normal"
        panel = {"id": f"panel-{name}", "title": title, "curves": curves, "rangemode": from_zero}
        panels.append(panel | ({"range": [-0.03, 1.03]} if name == COMPLETES else {}))
    return panels


def _curve(text: str, number: int, x: Array, y: Array, **more: Any) -> dict[str, Any]:
    """Return a curve as the script draws it; what is not finite leaves a gap."""
    values = [round(float(value), 4) if np.isfinite(value) else None for value in y]
    looks = {"colour": colour_of(number), "dash": dash_of(number)}
    return {"text": escape(text), **looks, "x": x.tolist(), "y": values, **more}


def _mean(learning: Learning, number: int, name: str) -> list[dict[str, Any]]:
    """Return the interval and the mean of a variant's seeds, as far as all seeds are."""
    x, figure = learning.timesteps, learning.figures[name]
    told = f"{learning.variant}, {len(learning.trials)} seeds"
    return [*_band(told, number, x, figure), _curve(told, number, x, figure.value, bold=True)]


def _band(text: str, number: int, x: Array, figure: Estimate) -> list[dict[str, Any]]:
    """Return the outline of an interval, where both of its ends are finite."""
    whole = np.isfinite(figure.low) & np.isfinite(figure.high)
    if whole.sum() < 2:
        return []
    outline = np.concatenate([figure.low[whole], figure.high[whole][::-1]])
    around = np.concatenate([x[whole], x[whole][::-1]])
    return [_curve(text, number, around, outline, band=True)]


def _links(variants: Sequence[Learning], folder: Path, output: Path) -> Sequence[str]:
    """Link each seed's lap report and video, or say how to make them."""
    rows: list[list[Cell | str]] = []
    for learning in variants:
        for trial in learning.trials:
            home = folder / trial_name(learning.variant, trial.seed)
            cells = [_link(home / file, what, output) for what, file in BESIDE.items()]
            rows.append([f"{learning.variant}, {trial.seed}", *cells])
    first = variants[0]
    example = folder / trial_name(first.variant, first.trials[0].seed)
    report, video = f"{example}/lap.html", f"{example}/lap.mp4"
    how = shlex.join(["sb3-torcs", "evaluate", str(example), "--report", report, "--video", video])
    told = f"A seed's lap report and video are made by: {how}. Then write this page again."
    return [table(["variant, seed", *BESIDE], [rows], words=3), paragraph(told, "note")]


def _link(file: Path, text: str, output: Path) -> Cell:
    """Cell with a link to a file, if it is there."""
    if not file.is_file():
        return Cell("–")
    return Cell(text, html=f'<a href="{escape(os.path.relpath(file, output))}">{text}</a>')
