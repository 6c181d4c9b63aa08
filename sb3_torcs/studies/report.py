"""The report of a study: learning curves and tables from its results, every seed shown."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sb3_torcs.errors import StudyError, check_extras
from sb3_torcs.evaluation.ladder import RUNGS
from sb3_torcs.studies.config import FIELDS, slug
from sb3_torcs.studies.curves import NO_LAP, learning_of
from sb3_torcs.studies.estimates import Estimate, estimate
from sb3_torcs.studies.page import Section, study_page
from sb3_torcs.studies.pictures import draw_together, draw_variant
from sb3_torcs.studies.results import Results
from sb3_torcs.studies.storage import RECIPE, RESULTS, ROWS, WHY_DIVERGED, write_atomically

__all__ = ["read_results", "write_report"]

FEWEST = 3  # fewest seeds for an interval
NOTE = (
    "How these figures are meant is said in the evaluation protocol: a model is chosen by the "
    "evaluations of its training, and measured afresh; *completes* is three laps in a row from "
    "the grid without leaving the road. Intervals are 95 % stratified bootstrap intervals."
)
TOGETHER = "learning.png"  # the picture of all variants


def read_results(folder: Path) -> list[Results]:
    """
    Read the results of a study.

    :param folder: of the study
    :return: its trials, in the order of the file
    :raises StudyError: if there are no results
    """
    file = folder / RESULTS
    try:
        with file.open(newline="", encoding="utf-8") as lines:
            reader = csv.DictReader(lines, restval="")
            missing = [name for name in FIELDS if name not in (reader.fieldnames or FIELDS)]
            if missing:
                raise ValueError(f"it has no column {', '.join(missing[:3])}")
            rows = [_read(row) for row in reader]
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
    """Sort rows into trials, and make sure that each has the rows that the report needs."""
    trials = []
    rows_of: dict[tuple[str, int], list[dict[str, Any]]] = {}  # of several machines, maybe mixed
    for row in rows:
        rows_of.setdefault((row["variant"], row["seed"]), []).append(row)
    for (variant, seed), own in rows_of.items():
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
    told = [*numbers.items(), *whole.items(), *(("lap_times_s", lap) for lap in laps)]
    for key, value in told:
        least = -math.inf if key == "distance_m" else 0.0  # a car may drive backwards
        if value is not None and not (math.isfinite(value) and value >= least):
            raise ValueError(f"{key} is {value!r}; expected a number that is not negative")
    if row["phase"] not in ("train", "final"):
        raise ValueError(f"there is no phase '{row['phase']}'")
    if row["ladder"] not in ("", *RUNGS):
        raise ValueError(f"there is no rung '{row['ladder']}'")
    return {**row, **numbers, **whole, **truths, "lap_times_s": laps}


def write_report(folder: Path, output: Path) -> Path:
    """
    Write ``report.html``, and ``report.md`` with its pictures, which say the same.

    :param folder: of the study
    :param output: folder for the report; it is made
    :return: ``report.md``; the page lies beside it
    :raises StudyError: if there is nothing to report
    :raises OutputNotWritable: if the report cannot be written
    :raises PackageMissing: if Plotly is not installed
    """
    check_extras("the report", "plotly")
    trials = read_results(folder)
    study = trials[0].train[0]["study"]
    notes = [NOTE, *_waiting(folder), *_diverged(folder)]
    every = [_summary(trials), _seeds(trials), _ladder(trials), _shares(trials)]
    sections = [section for section in every if section.rows]
    lines = [f"# {study}", ""]
    for note in notes:
        lines += [note, ""]
    for section in sections:
        lines += _markdown(section)
    variants = [learning_of(variant, group) for variant, group in _variants(trials).items()]
    if len(variants) > 1:
        write_atomically(output / TOGETHER, draw_together(variants))
        lines += ["## Learning: all variants", "", f"![all variants]({TOGETHER})", ""]
    for learning in variants:
        picture = output / f"learning-{slug(learning.variant)}.png"
        write_atomically(picture, draw_variant(learning))
        shown = f"![{learning.variant}]({picture.name})"
        lines += [f"## Learning: {learning.variant}", "", shown, ""]
    lines += [
        "Thin: every seed; bold: the interquartile mean of the seeds, and of the share of races "
        "that complete the mean of all. A seed without a lap counts as infinitely slow, so the "
        "mean of the lap times begins when enough seeds have one. "
        "Bold curves end where the seed ends that has come least far.",
        "",
    ]
    report = output / "report.md"
    write_atomically(report, "\n".join(lines).encode())
    plain = [note.replace("*", "") for note in notes]
    page = study_page(study, plain, sections, variants, folder=folder, output=output)
    write_atomically(report.with_suffix(".html"), page.encode())
    return report


def _waiting(folder: Path) -> list[str]:
    """List the agents without figures, such as those that failed early."""
    recipes = sorted(folder.glob(f"*/{RECIPE}"))
    waiting = [file.parent.name for file in recipes if not (file.parent / ROWS).is_file()]
    return [f"Not evaluated yet, and in no figure: {', '.join(waiting)}."] if waiting else []


def _diverged(folder: Path) -> list[str]:
    """List the agents whose training ended early."""
    return [
        f"{file.parent.name}: {file.read_text(encoding='utf-8')}. Its figures are those of its "
        "best model of before, or of no lap if there was none."
        for file in sorted(folder.glob(f"*/{WHY_DIVERGED}"))
    ]


def _homes(trials: Sequence[Results]) -> str:
    """Return the track whose evaluations chose the models; the first if there are several."""
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


def _markdown(section: Section) -> list[str]:
    """Lay out a section with a table; numbers stand to the right of the first column."""
    title, headers, rows = section
    rules = ["---", *["---:"] * (len(headers) - 1)]
    cells = [[" ".join(cell.split()).replace("|", "\\|") for cell in row] for row in rows]
    return [f"## {title}", "", *(f"| {' | '.join(row)} |" for row in (headers, rules, *cells)), ""]


def _seconds(value: float | None) -> str:
    return "-" if value is None or not math.isfinite(value) else f"{value:.3f}"


def _summary(trials: Sequence[Results]) -> Section:
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
                    _count(
                        _median([NO_LAP if row is None else row[key] / unit for row in firsts]), n
                    )
                    for key, unit, n in (
                        ("decisions", 1.0, 0),
                        ("episodes", 1.0, 0),
                        ("wall_s", 60.0, 1),
                    )
                ),
            ]
        )
    headers = [
        "variant", "seeds that complete", "best flying lap s", "median s", "IQM s",
        "first whole lap: timesteps", "episodes", "minutes",
    ]  # fmt: skip
    return Section(f"Summary, {_homes(trials)}", headers, rows)


def _completing(homes: Sequence[dict[str, Any]], seeds: int) -> str:
    """Count the seeds that complete all laps, and those without a result."""
    if not homes:
        return "not measured yet"
    counted = f"{sum(row['completes'] for row in homes)} of {len(homes)}"
    return counted if len(homes) == seeds else f"{counted}, {seeds - len(homes)} not measured"


def _median(values: Sequence[float]) -> float | None:
    """The middle one, or the worse of the two in the middle."""
    return sorted(values)[len(values) // 2] if values else None


def _count(value: float | None, decimals: int) -> str:
    return "-" if value is None or not math.isfinite(value) else f"{value:,.{decimals}f}"


def _with_interval(figure: Estimate) -> str:
    if not np.isfinite(figure.low[0]):
        return "-"
    low, high = _seconds(figure.low[0]), _seconds(figure.high[0])
    return f"{_seconds(figure.value[0])} ({low} to {high})"


def _first_lap(trial: Results) -> dict[str, Any] | None:
    """Find the first evaluation with a whole lap."""
    return next((row for row in trial.train if row["laps"] >= 1), None)


def _seeds(trials: Sequence[Results]) -> Section:
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
        "evaluations that complete", "first whole lap: timesteps", "episodes", "minutes",
    ]  # fmt: skip
    return Section(f"Every seed, {_homes(trials)}", headers, rows)


def _ladder(trials: Sequence[Results]) -> Section:
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
    return Section("The ladder: seeds that stand on a rung or higher", headers, rows)


def _shares(trials: Sequence[Results]) -> Section:
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
    return Section("Tracks completed", headers, rows)
