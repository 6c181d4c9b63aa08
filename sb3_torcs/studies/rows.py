"""The rows of a study's results: evaluations of a training, and the final measurements."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sb3_torcs.agents.models import load_driver
from sb3_torcs.evaluation.protocol import Episode, evaluate
from sb3_torcs.policies.threads import one_thread
from sb3_torcs.studies.config import FIELDS, Trial
from sb3_torcs.studies.storage import DIVERGED
from sb3_torcs.training.trial import Row, Training

__all__ = ["final_row", "rows_of_nothing", "training_rows"]

NOTHING_DRIVEN = Episode(0, [], 0.0, DIVERGED, 0.0, 0.0)  # by an agent that was never evaluated
KEPT_AT = ("decisions", "episodes", "wall_s", "cpu_s")


def training_rows(trial: Trial, training: Training) -> list[Row]:
    """
    Return a row for each evaluation and track so far.

    :param trial: of a study
    :param training: of the trial
    """
    return [_row(trial, "train", row) for row in training.rows]


def rows_of_nothing(trial: Trial, training: Training) -> list[Row]:
    """
    Return the rows of an agent that has diverged before its first evaluation.

    :param trial: of a study
    :param training: of the trial
    """
    phases = [("train", track) for track in trial.eval_tracks]
    phases += [("final", track) for track in trial.final_tracks]
    progress = {**training.progress(), "kept": True}
    return [
        _row(trial, phase, {**trial.row(track, NOTHING_DRIVEN), **progress})
        for phase, track in phases
    ]


@one_thread()
def final_row(trial: Trial, model: Path, track: str, progress: Row) -> Row:
    """
    Measure a trial's best model on one track, in a fresh evaluation.

    :param trial: whose model it is
    :param model: the file; there is none of an agent that has diverged before its first evaluation
    :param track: to drive on
    :param progress: the row of the evaluation that the model was kept for
    :return: a row of the results
    """
    race = NOTHING_DRIVEN
    if progress["end"] != DIVERGED:
        with contextlib.closing(trial.race_environment(track)) as env:
            (race,) = evaluate(env, load_driver(model, env, trial.algo))
    kept_at = {name: progress[name] for name in KEPT_AT}
    return _row(trial, "final", {**trial.row(track, race), **kept_at, "kept": True})


def _row(trial: Trial, phase: str, driven: Mapping[str, Any]) -> Row:
    """Complete a row by what only the study knows."""
    own = {"study": trial.study, "variant": trial.variant, "seed": trial.seed, "phase": phase}
    return {field: {**driven, **own}[field] for field in FIELDS}
