"""The folder of a study, with the state of each trial. A kill at any time leaves it valid.

::

    FOLDER/
      results.csv                 all rows of all trials
      VARIANT-seed0/
        recipe.yml                what the training depends on
        rows.json                 of the evaluations so far
        diverged.txt              why the training ended early, if it did
        best_model.zip            what `sb3-torcs evaluate` reads
        checkpoint-000012/        to go on from; gone when the training is over
"""

from __future__ import annotations

import contextlib
import csv
import io
import json
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import yaml

from sb3_torcs.agents.saved.record import BEST_MODEL
from sb3_torcs.errors import StudyError
from sb3_torcs.files import atomic_file, lock, read_yaml
from sb3_torcs.studies.config import FIELDS, Study, Trial
from sb3_torcs.training.trial import track_name

__all__ = [
    "DIVERGED",
    "RECIPE",
    "RESULTS",
    "ROWS",
    "WHY_DIVERGED",
    "Files",
    "StudyFolder",
    "write_atomically",
]

Files = dict[str, bytes]
"""Contents of files by name."""

RESULTS = "results.csv"
WHY_DIVERGED = "diverged.txt"
DIVERGED = "diverged"  # the end of a race that no model is there to drive
RECIPE, ROWS, LOCK = "recipe.yml", "rows.json", ".lock"
CHECKPOINT = "checkpoint-"
GOING_ON = (
    "make room, or give another folder, and type the command again: what was written before is kept"
)


class StudyFolder:
    """
    The folder of a study.

    :param path: of the folder; it is made
    :param study: that is run in it
    """

    def __init__(self, path: Path, study: Study) -> None:
        self.path = path
        self.study = study
        path.mkdir(parents=True, exist_ok=True)

    @property
    def results(self) -> Path:
        """The table of all rows."""
        return self.path / RESULTS

    @contextlib.contextmanager
    def locked(self) -> Iterator[None]:
        """Lock the folder against other processes. A killed process releases the lock."""
        with (self.path / LOCK).open("w") as file:
            try:
                # What filelock does, in as few lines.
                lock(file.fileno(), wait=False)
            except BlockingIOError as error:
                raise StudyError(
                    f"another process runs the study in '{self.path}'; wait for it, or give "
                    "another --folder"
                ) from error
            try:
                yield
            finally:
                with contextlib.suppress(OSError):
                    if [item.name for item in self.path.iterdir()] == [LOCK]:
                        shutil.rmtree(self.path)  # nothing was begun

    def of(self, trial: Trial) -> Path:
        """
        Return the folder of a trial.

        :param trial: of the study
        :return: where its files are
        """
        return self.path / trial.name

    def begin(self) -> None:
        """
        Make a folder for each trial, and make sure that those that are there are of this study.

        :raises StudyError: if the folder is of another study, or if a trial was begun with another
            recipe
        """
        for file in self.path.glob(f"*/{RECIPE}"):
            other = _parsed(file, _recipe)["study"]
            if other != self.study.name:
                raise StudyError(
                    f"'{self.path}' holds the study '{other}'; give another --folder for "
                    f"'{self.study.name}'"
                )
        for trial in self.study.trials:
            file = self.of(trial) / RECIPE
            recipe = trial.recipe()
            if not file.is_file():
                write_atomically(file, yaml.safe_dump(recipe, sort_keys=False).encode())
                continue
            before = _parsed(file, _recipe)
            if before != recipe:
                raise StudyError(
                    f"'{file.parent}' was begun with another {_difference(before, recipe)}; give "
                    "another --folder, or remove that one to begin it anew"
                )
            needed = BEST_MODEL if self.trained(trial) else f"{CHECKPOINT}*"
            has_model = any(row["end"] != DIVERGED for row in self.rows(trial))
            if has_model and not any(self.of(trial).glob(needed)):
                raise StudyError(
                    f"'{file.parent}' has lost its {needed}; remove that folder to begin this "
                    "agent anew"
                )

    def rows(self, trial: Trial) -> list[dict[str, Any]]:
        """
        Read the evaluations of a trial.

        :param trial: of the study
        :return: its rows, those during the training first
        """
        return _rows(self.of(trial) / ROWS)

    def trained(self, trial: Trial) -> bool:
        """
        Check whether the training of a trial is complete.

        :param trial: of the study
        :return: whether all its timesteps were learned from, or it has diverged
        """
        if self.diverged(trial) is not None:
            return True
        learned = [row["decisions"] for row in self.rows(trial) if row["phase"] == "train"]
        return bool(learned) and learned[-1] >= trial.budget

    def diverged(self, trial: Trial) -> str | None:
        """
        Read why a training ended early.

        :param trial: of the study
        :return: how it diverged; ``None`` if it did not
        """
        file = self.of(trial) / WHY_DIVERGED
        return file.read_text(encoding="utf-8") if file.is_file() else None

    def missing(self, trial: Trial) -> list[str]:
        """
        List the tracks on which the best model was not measured yet.

        :param trial: of the study
        :return: tracks, as the study file calls them
        """
        done = {row["track"] for row in self.rows(trial) if row["phase"] == "final"}
        return [track for track in trial.final_tracks if track_name(track) not in done]

    def ended(self, trial: Trial) -> bool:
        """
        Check whether a trial is complete.

        :param trial: of the study
        :return: whether it is trained and measured
        """
        return self.trained(trial) and not self.missing(trial)

    def checkpoint(self, trial: Trial) -> Path | None:
        """
        Find the checkpoint that a trial continues from.

        :param trial: of the study
        :return: a folder; ``None`` if the trial has not come so far
        """
        return max(self.of(trial).glob(f"{CHECKPOINT}*"), default=None)

    def state(self, trial: Trial) -> tuple[Files | None, bool, list[str]]:
        """
        Return the state of a trial.

        :param trial: of the study
        :return: the files to go on from, if any; whether the training is over; tracks on which the
            best model is still to be measured
        """
        over = self.trained(trial)
        source = self.of(trial) if over else self.checkpoint(trial)
        files = None
        if source is not None:
            files = {file.name: file.read_bytes() for file in source.iterdir() if file.is_file()}
        return files, over, self.missing(trial)

    def put(self, trial: Trial, files: Mapping[str, bytes], rows: list[dict[str, Any]]) -> None:
        """
        Write the newest state of a trial, and remove the previous one.

        :param trial: of the study
        :param files: of its checkpoint
        :param rows: of its evaluations so far
        :raises StudyError: if the trial is already as far: two workers drive it
        :raises OutputNotWritable: if there is no room; the previous state is kept
        """
        if len(rows) <= len(self.rows(trial)):
            raise StudyError(f"another worker has taken {trial.name} farther; this one stops")
        folder = self.of(trial)
        over = rows[-1]["decisions"] >= trial.budget
        before = [*folder.glob(f"{CHECKPOINT}*"), *folder.glob(f".{CHECKPOINT}*")]
        if not over:
            aside = folder / f".{CHECKPOINT}new"
            shutil.rmtree(aside, ignore_errors=True)
            try:
                for file, content in files.items():
                    write_atomically(aside / file, content)
                aside.rename(folder / f"{CHECKPOINT}{len(rows):06d}")
            except OSError:
                shutil.rmtree(aside, ignore_errors=True)  # it may fill the disk
                raise
        if BEST_MODEL in files:
            write_atomically(folder / BEST_MODEL, files[BEST_MODEL])
        write_atomically(folder / ROWS, json.dumps(rows).encode())
        for old in before:
            shutil.rmtree(old, ignore_errors=True)
        self.write_results()

    def put_diverged(self, trial: Trial, why: str, nothing: list[dict[str, Any]]) -> None:
        """
        End a training that has diverged. Its best model of before is what it has learned.

        :param trial: of the study
        :param why: the message
        :param nothing: its rows if there was no evaluation before
        """
        if not self.rows(trial):
            write_atomically(self.of(trial) / ROWS, json.dumps(nothing).encode())
        write_atomically(self.of(trial) / WHY_DIVERGED, why.encode())
        for old in self.of(trial).glob(f"{CHECKPOINT}*"):
            shutil.rmtree(old, ignore_errors=True)
        self.write_results()

    def put_finals(self, trial: Trial, rows: Iterable[dict[str, Any]]) -> None:
        """
        Add the final measurements of a trial.

        :param trial: of the study
        :param rows: one per track
        """
        done = self.rows(trial)
        known = {row["track"] for row in done if row["phase"] == "final"}
        done += [row for row in rows if row["track"] not in known]
        write_atomically(self.of(trial) / ROWS, json.dumps(done).encode())
        self.write_results()

    def write_results(self) -> None:
        """
        Write all rows into one table, in the order of the study file.

        Rows of trials that are no longer in the file come last.
        """
        named = [self.of(trial) / ROWS for trial in self.study.trials]
        others = sorted(set(self.path.glob(f"*/{ROWS}")).difference(named))
        table = io.StringIO()
        writer = csv.writer(table, lineterminator="\n")
        writer.writerow(FIELDS)
        for file in (*named, *others):
            writer.writerows([_cell(row[field]) for field in FIELDS] for row in _rows(file))
        write_atomically(self.results, table.getvalue().encode())


def _rows(file: Path) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = _parsed(file, _table) if file.is_file() else []
    return rows


NUMBER, MAYBE = (int, float), (int, float, type(None))
KINDS: dict[str, tuple[type, ...]] = {
    **dict.fromkeys(("study", "variant", "phase", "track", "end", "ladder"), (str,)),
    **dict.fromkeys(("seed", "decisions", "episodes", "laps"), (int,)),
    **dict.fromkeys(("wall_s", "cpu_s", "distance_m", "damage", "return"), NUMBER),
    **dict.fromkeys(("best_flying_lap_s", "race_time_s"), MAYBE),
    **dict.fromkeys(("completes", "kept"), (bool,)),
    "lap_times_s": (list,),
}
"""What the values of a row are."""


def _table(text: str) -> list[dict[str, Any]]:
    rows: Any = json.loads(text)
    if not isinstance(rows, list) or any(set(FIELDS) - set(row) for row in rows):
        raise ValueError(f"expected a list of rows with {', '.join(FIELDS)}")
    for number, row in enumerate(rows):
        for field in FIELDS:
            if not isinstance(row[field], KINDS[field]):
                raise ValueError(f"row {number}: {field} is {_short(row[field])}")
    return rows


def _short(value: Any) -> str:
    """Show a value, or the beginning of a long one."""
    text = repr(value)
    return text if len(text) <= 40 else f"{text[:40]}…"


def _recipe(text: str) -> dict[str, Any]:
    recipe: Any = read_yaml(text)
    if not isinstance(recipe, dict) or "study" not in recipe:
        raise ValueError("expected 'key: value' lines, study among them")
    return recipe


def _difference(before: Any, after: Any) -> str:
    """List the keys in which two recipes differ, at any depth."""
    if not isinstance(before, dict) or not isinstance(after, dict):
        return f"(it was {before!r})"
    changed = []
    for key in {**after, **before}:
        one, two = before.get(key), after.get(key)
        if isinstance(one, dict) and isinstance(two, dict) and one != two:
            changed.append(f"{key}: {_difference(one, two)}")
        elif one != two:
            was = f"it was {one!r}" if key in before else "it was not there"
            changed.append(f"{key} ({was})")
    return ", ".join(changed)


def _cell(value: Any) -> Any:
    """Format a cell: lap times with spaces between, booleans as 1 and 0, ``None`` as empty."""
    if isinstance(value, list):
        return " ".join(str(item) for item in value)
    return int(value) if isinstance(value, bool) else value


def _parsed(file: Path, parse: Callable[[str], Any]) -> Any:
    """Read a file that was written here."""
    try:
        return parse(file.read_text(encoding="utf-8"))
    except (OSError, TypeError, ValueError, RecursionError, yaml.YAMLError) as error:
        why = " ".join(str(error).split())
        raise StudyError(
            f"'{file}' cannot be read ({why}); repair it, or remove '{file.parent}' to begin "
            "this agent anew"
        ) from error


def write_atomically(file: Path, content: bytes) -> None:
    """
    Write a file of a study completely or not at all.

    :param file: to be written, in a folder that is made
    :param content: of it
    :raises OutputNotWritable: if it cannot be written; the previous file is kept
    """
    with atomic_file(file, GOING_ON, parents=True) as aside:
        aside.write_bytes(content)
