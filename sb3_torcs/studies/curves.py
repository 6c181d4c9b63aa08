"""The learning curves of a study: of each seed, and of all seeds of a variant."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from sb3_torcs.studies.estimates import Array, Estimate, estimate, iqm, share
from sb3_torcs.studies.results import Results

__all__ = ["COMPLETES", "NO_LAP", "PANELS", "Learning", "learning_of"]

NO_LAP = np.inf  # [s] stands for no lap: worse than any lap time
COMPLETES = "completes"
PANELS = {
    "distance": "distance of three laps [m]",
    "lap": "best flying lap so far [s]",
    COMPLETES: "share of races that complete",
}
"""What is drawn over timesteps."""


class Learning(NamedTuple):
    """How the seeds of a variant learned."""

    variant: str
    trials: Sequence[Results]
    seeds: Sequence[dict[str, Array]]  # of each, timesteps and the curves of PANELS
    timesteps: Array  # (n,) mean of the seeds, as far as all of them are
    figures: dict[str, Estimate]  # (n,) each, of the curves of PANELS
    so_far: Array  # (n,) share of the seeds that have completed an evaluation by then

    @property
    def title(self) -> str:
        """What it is called beside its curves."""
        return f"{self.variant}: {len(self.trials)} seeds"


def learning_of(variant: str, trials: Sequence[Results]) -> Learning:
    """
    Arrange the evaluations of a variant.

    :param variant: its name
    :param trials: of its seeds, that were evaluated
    """
    seeds = [_curves_of(trial) for trial in trials]
    length = min(len(curves["timesteps"]) for curves in seeds)
    shared = {name: np.array([curves[name][:length] for curves in seeds]) for name in seeds[0]}
    figures = {name: estimate(shared[name], share if name == COMPLETES else iqm) for name in PANELS}
    so_far = np.maximum.accumulate(shared[COMPLETES], axis=1).mean(axis=0)
    return Learning(variant, trials, seeds, shared["timesteps"].mean(axis=0), figures, so_far)


def _curves_of(trial: Results) -> dict[str, Array]:
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
        COMPLETES: curve(lambda row: row["completes"]),
    }
