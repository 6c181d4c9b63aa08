"""The learning curves of a study as pictures: one of each variant, and one of all of them."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Any

import numpy as np

from sb3_torcs.studies.curves import COMPLETES, PANELS, Learning
from sb3_torcs.studies.estimates import Array, Estimate

__all__ = ["draw_together", "draw_variant"]

MANY = 10  # variants that can have colours of their own


def draw_variant(learning: Learning) -> bytes:
    """Draw distance, lap time and success of one variant over timesteps, as PNG."""
    figure, panels = _figure([learning])
    for name in ("distance", "lap"):
        for curves in learning.seeds:
            own = curves["timesteps"] / 1000.0, _drawable(curves[name])
            panels[name].plot(*own, color="tab:blue", alpha=0.35, linewidth=0.8)
    _bands(panels, learning, "tab:red")
    panels[COMPLETES].plot(
        learning.timesteps / 1000.0, learning.so_far, color="tab:blue", linestyle="--"
    )
    panels[COMPLETES].legend(["in this evaluation", "95 %", "in one so far"], fontsize=8)
    figure.suptitle(learning.title, fontsize=11)
    return _as_png(figure)


def draw_together(variants: Sequence[Learning]) -> bytes:
    """Draw the means of all variants over timesteps, each with its interval, as PNG."""
    from matplotlib import colormaps

    figure, panels = _figure(variants)
    colours = colormaps["tab10" if len(variants) <= MANY else "turbo"]
    for number, learning in enumerate(variants):
        colour = colours(number if len(variants) <= MANY else number / len(variants))
        _bands(panels, learning, colour)
        panels["distance"].plot([], [], color=colour, label=learning.title)
    figure.legend(loc="outside lower center", ncols=3, fontsize=8)
    return _as_png(figure)


def _figure(variants: Sequence[Learning]) -> tuple[Any, dict[str, Any]]:
    """Make a figure with a panel for each kind of curve."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12.0, 3.4), layout="constrained")
    panels = dict(zip(PANELS, figure.subplots(1, len(PANELS)), strict=True))
    trials = [trial for learning in variants for trial in learning.trials]
    for name, panel in panels.items():
        panel.set_ylabel(PANELS[name])
        panel.set_xlabel("thousand timesteps learned from")
        panel.set_xlim(0.0, 1.02 * max(trial.train[-1]["decisions"] for trial in trials) / 1000.0)
        panel.grid(alpha=0.3)
    panels[COMPLETES].set_ylim(-0.03, 1.03)
    seeds = [curves for learning in variants for curves in learning.seeds]
    if not any(np.isfinite(curves["lap"]).any() for curves in seeds):
        laps = panels["lap"]
        laps.set_yticks([])
        laps.text(0.5, 0.5, "no seed has one", ha="center", transform=laps.transAxes)
    return figure, panels


def _bands(panels: dict[str, Any], learning: Learning, colour: Any) -> None:
    """Draw the means of a variant's seeds, as far as all seeds are."""
    for name, panel in panels.items():
        _band(panel, learning.timesteps / 1000.0, learning.figures[name], colour)


def _as_png(figure: Any) -> bytes:
    figure.axes[0].set_ylim(bottom=0.0)  # at last: it also keeps the top where it is
    picture = io.BytesIO()
    figure.savefig(picture, dpi=100)
    return picture.getvalue()


def _band(panel: Any, timesteps: Array, figure: Estimate, colour: Any) -> None:
    """Draw a figure and its interval, which ends where the axes do if it has no end."""
    value = _drawable(figure.value)
    alone = "o" if np.isfinite(value).sum() == 1 else ""  # a line needs two points
    panel.plot(timesteps, value, color=colour, linewidth=2.0, marker=alone)
    top = np.where(np.isfinite(figure.high), figure.high, panel.get_ylim()[1])
    shown = np.isfinite(value) & np.isfinite(figure.low)
    panel.fill_between(
        timesteps, figure.low, top, where=shown, color=colour, alpha=0.2, linewidth=0.0
    )


def _drawable(values: Array) -> Array:
    """Leave a gap where there is no lap."""
    return np.where(np.isfinite(values), values, np.nan)
