"""The report of a study: learning curves and tables from its results, every seed shown.

Curves are interquartile means with 95 % stratified bootstrap intervals (Agarwal et al. 2021,
arXiv:2108.13264, by rliable); the bootstrap is seeded, so the same results give the same report.
"""

from __future__ import annotations

import csv
import io
import itertools
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from sb3_torcs.errors import StudyError
from sb3_torcs.ladder import RUNGS
from sb3_torcs.study_file import slug
from sb3_torcs.study_folder import RECIPE, RESULTS, ROWS, write_whole

__all__ = ["Estimate", "Results", "estimate", "iqm", "read_results", "write_report"]

Array = npt.NDArray[np.float64]

REPETITIONS = 2000  # of the bootstrap
LEVEL = 0.95
FEWEST = 3  # seeds that have an interval
NO_LAP = math.inf  # [s] worse than any, so that whoever has none is not forgotten


class Estimate(NamedTuple):
    """A figure over seeds, and the interval that it lies in."""

    value: Array  # (points,)
    low: Array  # (points,)
    high: Array  # (points,)


class Results(NamedTuple):
    """The rows of one variant with one seed."""

    variant: str
    seed: int
    train: list[dict[str, Any]]
    final: list[dict[str, Any]]

    @property
    def evaluations(self) -> list[list[dict[str, Any]]]:
        """Rows of the training, one list of tracks per evaluation."""
        return [list(rows) for _, rows in itertools.groupby(self.train, lambda r: r["decisions"])]

    def at_home(self) -> dict[str, Any] | None:
        """Return the final drive on the track that chose the model."""
        home = self.train[0]["track"]
        return next((row for row in self.final if row["track"] == home), None)


def read_results(folder: Path) -> list[Results]:
    """
    Read what a study has come to.

    :param folder: of the study
    :return: its trials, in the order of the file
    :raises StudyError: if there is nothing to report
    """
    file = folder / RESULTS
    try:
        with file.open(newline="", encoding="utf-8") as lines:
            rows = [_read(row) for row in csv.DictReader(lines, restval="")]
        trials = _trials(rows)
    except (FileNotFoundError, NotADirectoryError):
        raise StudyError(
            f"'{folder}' holds no {RESULTS}; give the folder of a study: sb3-torcs study FILE.yml"
        ) from None
    except (OSError, csv.Error, KeyError, ValueError) as error:
        raise StudyError(
            f"{file} cannot be read as results ({type(error).__name__}: {error}); the command that "
            "ran the study writes it anew: sb3-torcs study FILE.yml"
        ) from error
    if not rows:
        raise StudyError(f"{file} is empty: no agent was evaluated yet; let the study run on")
    return trials


def _trials(rows: Sequence[dict[str, Any]]) -> list[Results]:
    """Sort rows into trials, and make sure that each has what the report builds on."""
    trials = []
    for (variant, seed), group in itertools.groupby(rows, lambda r: (r["variant"], r["seed"])):
        own = list(group)
        train = [row for row in own if row["phase"] == "train"]
        if not any(row["kept"] for row in train):
            raise ValueError(f"no evaluation of {variant}, {seed} has kept a model")
        trials.append(Results(variant, seed, train, [r for r in own if r["phase"] == "final"]))
    return trials


def _read(row: dict[str, str]) -> dict[str, Any]:
    """Turn a row's cells into values."""
    laps = [float(cell) for cell in row["lap_times_s"].split()]
    numbers = {
        key: float(row[key]) if row[key] else None
        for key in ("wall_s", "cpu_s", "best_flying_lap_s", "race_time_s", "distance_m", "damage")
    }
    whole = {key: int(row[key]) for key in ("seed", "decisions", "episodes", "laps")}
    truths = {key: row[key] == "1" for key in ("completes", "kept")}
    if row["ladder"] not in ("", *RUNGS):
        raise ValueError(f"there is no rung '{row['ladder']}'")
    return {**row, **numbers, **whole, **truths, "lap_times_s": laps}


def iqm(scores: Array) -> Array:
    """
    Average the middle half of the seeds: rliable's ``aggregate_iqm`` for all points at once.

    :param scores: (seeds, 1, points)
    :return: (points,)
    """
    from scipy.stats import trim_mean

    return np.asarray(trim_mean(scores, proportiontocut=0.25, axis=0)[0])


def share(scores: Array) -> Array:
    """
    Average all seeds: what share of them is 1.

    :param scores: (seeds, 1, points)
    :return: (points,)
    """
    return np.asarray(scores.mean(axis=0)[0])


def estimate(scores: Array, function: Callable[[Array], Array] = iqm) -> Estimate:
    """
    Estimate a figure over seeds, with a stratified bootstrap.

    :param scores: (seeds, points)
    :param function: of (seeds, 1, points)
    :return: value and interval
    """
    from rliable.library import StratifiedBootstrap

    class Seeded(StratifiedBootstrap):
        """Draws from its own generator; rliable's draws from that of the whole process."""

        def update_indices(self) -> tuple[Any, ...]:
            drawn = self.generator.choice(self._num_items, self._args_shape, replace=True)
            return (drawn, *self._strata_indices)

    stacked = scores[:, None, :]
    drawn = Seeded(stacked, seed=0).apply(function, reps=REPETITIONS)
    tail = 0.5 * (1.0 - LEVEL)
    # Without interpolation, which would make nonsense of a lap that was never driven.
    low, high = np.quantile(drawn, [tail, 1.0 - tail], axis=0, method="inverted_cdf")
    return Estimate(function(stacked), low, high)


def write_report(folder: Path, output: Path) -> Path:
    """
    Write ``report.md`` and its pictures.

    :param folder: of the study
    :param output: folder for the report; it is made
    :return: the report
    :raises StudyError: if there is nothing to report
    :raises OutputNotWritable: if the report cannot be written
    """
    trials = read_results(folder)
    study = trials[0].train[0]["study"]
    lines = [
        f"# {study}",
        "",
        "How these figures are meant is said in the evaluation protocol: a model is chosen by the "
        "evaluations of its training, and measured afresh; *completes* is three laps in a row from "
        "the grid without leaving the road. Intervals are 95 % stratified bootstrap intervals.",
        "",
        *_waiting(folder),
        *_summary(trials),
        *_seeds(trials),
        *_ladder(trials),
        *_shares(trials),
    ]
    for variant, group in _variants(trials).items():
        picture = output / f"learning-{slug(variant)}.png"
        write_whole(picture, _drawn(variant, group))
        lines += [f"## Learning: {variant}", "", f"![{variant}]({picture.name})", ""]
    lines += [
        "Thin: every seed; bold: the interquartile mean of the seeds. A seed without a lap counts "
        "as infinitely slow, so the mean of the lap times begins when enough seeds have one. "
        "Bold curves end where the seed ends that has come least far.",
        "",
    ]
    report = output / "report.md"
    write_whole(report, "\n".join(lines).encode())
    return report


def _waiting(folder: Path) -> list[str]:
    """Name the agents that no figure can speak of, so that whoever failed early is not left out."""
    recipes = sorted(folder.glob(f"*/{RECIPE}"))
    waiting = [file.parent.name for file in recipes if not (file.parent / ROWS).is_file()]
    return [f"Not evaluated yet, and in no figure: {', '.join(waiting)}.", ""] if waiting else []


def _homes(trials: Sequence[Results]) -> str:
    """Name the track that chose the models, the first if there are several."""
    names = {trial.train[0]["track"] for trial in trials}
    if len(names) > 1:
        return "each on the first track that chose its model"
    several = any(len(trial.evaluations[0]) > 1 for trial in trials)
    return f"on {names.pop()}" + (", the first of those that chose the models" if several else "")


def _variants(trials: Sequence[Results]) -> dict[str, list[Results]]:
    groups: dict[str, list[Results]] = {}
    for trial in trials:
        groups.setdefault(trial.variant, []).append(trial)
    return groups


def _markdown(title: str, headers: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Lay out a section with a table; numbers stand to the right of the first column."""
    rules = ["---", *["---:"] * (len(headers) - 1)]
    cells = [[" ".join(cell.split()).replace("|", "\\|") for cell in row] for row in rows]
    return [f"## {title}", "", *(f"| {' | '.join(row)} |" for row in (headers, rules, *cells)), ""]


def _seconds(value: float | None) -> str:
    return "-" if value is None or not math.isfinite(value) else f"{value:.3f}"


def _summary(trials: Sequence[Results]) -> list[str]:
    """One line per variant, on the track that chose the models."""
    rows = []
    for variant, group in _variants(trials).items():
        homes = [home for home in (trial.at_home() for trial in group) if home is not None]
        laps = [row["best_flying_lap_s"] or NO_LAP for row in homes if row["completes"]]
        laps += [NO_LAP] * (len(homes) - len(laps))
        firsts = [_first_lap(trial) for trial in group]
        middle = estimate(np.array(laps)[:, None]) if len(laps) >= FEWEST else None
        rows.append(
            [
                variant,
                _completing(homes, len(group)),
                _seconds(min(laps, default=None)),
                _seconds(_median(laps)),
                "-" if middle is None else _with_interval(middle),
                *(
                    _count(_median([NO_LAP if row is None else row[key] / unit for row in firsts]))
                    for key, unit in (("decisions", 1.0), ("episodes", 1.0), ("wall_s", 60.0))
                ),
            ]
        )
    headers = [
        "variant", "seeds that complete", "best flying lap s", "median s", "IQM s",
        "first whole lap: decisions", "episodes", "minutes",
    ]  # fmt: skip
    return _markdown(f"Summary, {_homes(trials)}", headers, rows)


def _completing(homes: Sequence[dict[str, Any]], seeds: int) -> str:
    """Count the seeds that complete, and say how many are not counted."""
    counted = f"{sum(row['completes'] for row in homes)} of {len(homes)}"
    return counted if len(homes) == seeds else f"{counted}, {seeds - len(homes)} not measured"


def _median(values: Sequence[float]) -> float | None:
    """The middle one, or the worse of the two in the middle."""
    return sorted(values)[len(values) // 2] if values else None


def _count(value: float | None) -> str:
    return "-" if value is None or not math.isfinite(value) else f"{value:,.0f}"


def _with_interval(figure: Estimate) -> str:
    if not np.isfinite(figure.low[0]):
        return "-"
    low, high = _seconds(figure.low[0]), _seconds(figure.high[0])
    return f"{_seconds(figure.value[0])} ({low} to {high})"


def _first_lap(trial: Results) -> dict[str, Any] | None:
    """Find the first evaluation with a whole lap."""
    return next((row for row in trial.train if row["laps"] >= 1), None)


def _seeds(trials: Sequence[Results]) -> list[str]:
    """Every seed, failures too."""
    rows = []
    for trial in trials:
        home, first = trial.at_home(), _first_lap(trial)
        evaluations = trial.evaluations
        completed = sum(all(row["completes"] for row in tracks) for tracks in evaluations)
        kept = [row["decisions"] for row in trial.train if row["kept"]]
        laps = [_seconds(lap) for lap in home["lap_times_s"]] if home else []
        rows.append(
            [
                f"{trial.variant}, {trial.seed}",
                "not measured" if home is None else "yes" if home["completes"] else "no",
                ", ".join(laps) or "-",
                "-" if home is None else f"{home['distance_m']:.0f}",
                "-" if home is None else home["end"],
                f"{kept[-1]:,} of {trial.train[-1]['decisions']:,}",
                f"{completed} of {len(evaluations)}",
                "never" if first is None else f"{first['decisions']:,}",
                "-" if first is None else f"{first['episodes']:,}",
                "-" if first is None else f"{first['wall_s'] / 60.0:.1f}",
            ]
        )
    headers = [
        "variant, seed", "completes", "laps s", "distance m", "end", "model kept at",
        "evaluations that complete", "first whole lap: decisions", "episodes", "minutes",
    ]  # fmt: skip
    return _markdown(f"Every seed, {_homes(trials)}", headers, rows)


def _ladder(trials: Sequence[Results]) -> list[str]:
    """How many seeds of each variant stand at least on each rung, per track."""
    rows = []
    for variant, group in _variants(trials).items():
        finals = [row for trial in group for row in trial.final]
        for track in dict.fromkeys(row["track"] for row in finals):
            drives = [row for row in finals if row["track"] == track]
            heights = [RUNGS.index(row["ladder"]) if row["ladder"] else -1 for row in drives]
            laps = [row["best_flying_lap_s"] for row in drives if row["completes"]]
            counts = [str(sum(height >= rung for height in heights)) for rung in range(len(RUNGS))]
            lap = _seconds(min((lap for lap in laps if lap), default=None))
            rows.append([f"{variant}, {track}", str(len(drives)), *counts, lap])
    headers = ["variant, track", "seeds", *RUNGS, "best flying lap s"]
    return _markdown("The ladder: seeds that stand on a rung or higher", headers, rows)


def _shares(trials: Sequence[Results]) -> list[str]:
    """How many of the tracks each seed completes."""
    rows = []
    for trial in trials:
        seen = {row["track"] for row in trial.train}
        others = [row["completes"] for row in trial.final if row["track"] not in seen]
        every = [row["completes"] for row in trial.final]
        cells = [
            f"{sum(found)} of {len(found)} ({100.0 * sum(found) / len(found):.0f} %)"
            if found
            else "-"
            for found in (every, others)
        ]
        rows.append([f"{trial.variant}, {trial.seed}", *cells])
    headers = ["variant, seed", "tracks completed", "of those that did not choose its model"]
    return _markdown("Tracks completed", headers, rows)


def _curves(trial: Results) -> dict[str, Array]:
    """
    Arrange the evaluations of a trial, means over its tracks.

    :param trial: that was evaluated
    :return: decisions, distance [m], best lap so far [s], and whether all laps were driven, each
        (evaluations,)
    """

    def curve(value: Callable[[dict[str, Any]], float]) -> Array:
        return np.array([np.mean([value(row) for row in tracks]) for tracks in trial.evaluations])

    return {
        "decisions": curve(lambda row: row["decisions"]),
        "distance": curve(lambda row: row["distance_m"]),
        "lap": np.minimum.accumulate(curve(lambda row: row["best_flying_lap_s"] or NO_LAP)),
        "completes": curve(lambda row: row["completes"]),
    }


def _drawn(variant: str, group: Sequence[Results]) -> bytes:
    """Draw distance, lap time and success over decisions, as PNG."""
    from matplotlib.figure import Figure

    every = [_curves(trial) for trial in group]
    length = min(len(curves["decisions"]) for curves in every)
    # As far as all seeds are.
    shared = {name: np.array([curves[name][:length] for curves in every]) for name in every[0]}
    decisions = shared["decisions"].mean(axis=0) / 1000.0
    figure = Figure(figsize=(12.0, 3.4), layout="constrained")
    panels = figure.subplots(1, 3)
    for panel, name, label in zip(
        panels[:2],
        ("distance", "lap"),
        ("distance of three laps [m]", "best flying lap so far [s]"),
        strict=True,
    ):
        for curves in every:
            own = curves["decisions"] / 1000.0, _drawable(curves[name])
            panel.plot(*own, color="tab:blue", alpha=0.35, linewidth=0.8)
        _band(panel, decisions, estimate(shared[name]))
        panel.set_ylabel(label)
    panels[0].set_ylim(bottom=0.0)
    if not any(np.isfinite(curves["lap"]).any() for curves in every):
        panels[1].set_yticks([])
        panels[1].text(0.5, 0.5, "no seed has one", ha="center", transform=panels[1].transAxes)
    _band(panels[2], decisions, estimate(shared["completes"], share))
    so_far = np.maximum.accumulate(shared["completes"], axis=1).mean(axis=0)
    panels[2].plot(decisions, so_far, color="tab:blue", linestyle="--")
    panels[2].set_ylabel("share of races that complete")
    panels[2].set_ylim(-0.03, 1.03)
    panels[2].legend(["in this evaluation", "95 %", "in one so far"], fontsize=8)
    for panel in panels:
        panel.set_xlabel("thousand decisions learned from")
        panel.set_xlim(0.0, 1.02 * max(curves["decisions"][-1] for curves in every) / 1000.0)
        panel.grid(alpha=0.3)
    figure.suptitle(f"{variant}: {len(group)} seeds", fontsize=11)
    picture = io.BytesIO()
    figure.savefig(picture, dpi=100)
    return picture.getvalue()


def _band(panel: Any, decisions: Array, figure: Estimate) -> None:
    """Draw a figure and its interval, which ends where the axes do if it has no end."""
    value = _drawable(figure.value)
    panel.plot(decisions, value, color="tab:red", linewidth=2.0)
    top = np.where(np.isfinite(figure.high), figure.high, panel.get_ylim()[1])
    shown = np.isfinite(value) & np.isfinite(figure.low)
    panel.fill_between(
        decisions, figure.low, top, where=shown, color="tab:red", alpha=0.2, linewidth=0.0
    )


def _drawable(values: Array) -> Array:
    """Leave a gap where there is no lap."""
    return np.where(np.isfinite(values), values, np.nan)
