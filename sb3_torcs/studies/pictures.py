"""The learning curves of a study: a picture of each variant, and one of all of them."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from sb3_torcs.studies.estimates import Array, Estimate, estimate, share
from sb3_torcs.studies.results import Results

__all__ = ["NO_LAP", "PANELS", "curves_of", "draw_together", "draw_variant"]

MANY = 10  # variants that can have colours of their own
NO_LAP = np.inf  # [s] stands for no lap: worse than any lap time
PANELS = (("distance", "distance of three laps [m]"), ("lap", "best flying lap so far [s]"))


def curves_of(trial: Results) -> dict[str, Array]:
    """
    Arrange the evaluations of a trial, means over its tracks.

    :param trial: that was evaluated
    :return: timesteps, distance [m], best lap so far [s], and whether all laps were driven, each
        (evaluations,)
    """

    def curve(value: Callable[[dict[str, Any]], float]) -> Array:
        return np.array([np.mean([value(row) for row in tracks]) for tracks in trial.evaluations])

    return {
        "timesteps": curve(lambda row: row["decisions"]),
        "distance": curve(lambda row: row["distance_m"]),
        "lap": np.minimum.accumulate(curve(lambda row: row["best_flying_lap_s"] or NO_LAP)),
        "completes": curve(lambda row: row["completes"]),
    }


def draw_variant(variant: str, group: Sequence[Results]) -> bytes:
    """Draw distance, lap time and success of one variant over timesteps, as PNG."""
    figure, panels = _figure(group)
    every = [curves_of(trial) for trial in group]
    for panel, (name, _) in zip(panels, PANELS, strict=False):
        for curves in every:
            own = curves["timesteps"] / 1000.0, _drawable(curves[name])
            panel.plot(*own, color="tab:blue", alpha=0.35, linewidth=0.8)
    if not any(np.isfinite(curves["lap"]).any() for curves in every):
        panels[1].set_yticks([])
        panels[1].text(0.5, 0.5, "no seed has one", ha="center", transform=panels[1].transAxes)
    timesteps, shared = _bands(panels, every, "tab:red")
    so_far = np.maximum.accumulate(shared["completes"], axis=1).mean(axis=0)
    panels[2].plot(timesteps, so_far, color="tab:blue", linestyle="--")
    panels[2].legend(["in this evaluation", "95 %", "in one so far"], fontsize=8)
    figure.suptitle(f"{variant}: {len(group)} seeds", fontsize=11)
    return _as_png(figure)


def draw_together(variants: Mapping[str, Sequence[Results]]) -> bytes:
    """Draw the means of all variants over timesteps, each with its interval, as PNG."""
    from matplotlib import colormaps

    figure, panels = _figure([trial for group in variants.values() for trial in group])
    colours = colormaps["tab10" if len(variants) <= MANY else "turbo"]
    for number, (variant, group) in enumerate(variants.items()):
        colour = colours(number if len(variants) <= MANY else number / len(variants))
        _bands(panels, [curves_of(trial) for trial in group], colour)
        panels[0].plot([], [], color=colour, label=f"{variant}: {len(group)} seeds")
    figure.legend(loc="outside lower center", ncols=3, fontsize=8)
    return _as_png(figure)


def _figure(trials: Sequence[Results]) -> tuple[Any, Any]:
    """Make a figure with one panel each for distance, lap time and success."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12.0, 3.4), layout="constrained")
    panels = figure.subplots(1, 3)
    labels = [label for _, label in PANELS]
    for panel, label in zip(panels, [*labels, "share of races that complete"], strict=True):
        panel.set_ylabel(label)
        panel.set_xlabel("thousand timesteps learned from")
        panel.set_xlim(0.0, 1.02 * max(trial.train[-1]["decisions"] for trial in trials) / 1000.0)
        panel.grid(alpha=0.3)
    panels[2].set_ylim(-0.03, 1.03)
    return figure, panels


def _bands(panels: Any, every: Sequence[dict[str, Array]], colour: Any) -> tuple[Array, Any]:
    """Draw the means of a variant's seeds, as far as all seeds are."""
    length = min(len(curves["timesteps"]) for curves in every)
    shared = {name: np.array([curves[name][:length] for curves in every]) for name in every[0]}
    timesteps = shared["timesteps"].mean(axis=0) / 1000.0
    for panel, (name, _) in zip(panels, PANELS, strict=False):
        _band(panel, timesteps, estimate(shared[name]), colour)
    _band(panels[2], timesteps, estimate(shared["completes"], share), colour)
    return timesteps, shared


def _as_png(figure: Any) -> bytes:
    figure.axes[0].set_ylim(bottom=0.0)  # at last: it also keeps the top where it is
    picture = io.BytesIO()
    figure.savefig(picture, dpi=100)
    return picture.getvalue()


def _band(panel: Any, timesteps: Array, figure: Estimate, colour: Any) -> None:
    """Draw a figure and its interval, which ends where the axes do if it has no end."""
    value = _drawable(figure.value)
    panel.plot(timesteps, value, color=colour, linewidth=2.0)
    top = np.where(np.isfinite(figure.high), figure.high, panel.get_ylim()[1])
    shown = np.isfinite(value) & np.isfinite(figure.low)
    panel.fill_between(
        timesteps, figure.low, top, where=shown, color=colour, alpha=0.2, linewidth=0.0
    )


def _drawable(values: Array) -> Array:
    """Leave a gap where there is no lap."""
    return np.where(np.isfinite(values), values, np.nan)
