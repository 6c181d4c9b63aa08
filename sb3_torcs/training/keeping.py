"""Files that are complete or not there, and models that are worth saving.

Each file is written into a folder beside the others first, and moved when it is whole. So a kill, a
power cut or a full disk leaves what was saved before.
"""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from sb3_torcs.agents.saved.record import BEST_MODEL, STATISTICS
from sb3_torcs.callbacks.learning import end_changes
from sb3_torcs.callbacks.progress import RacingProgressCallback
from sb3_torcs.errors import InvalidOption, OutputNotWritable, TrainingDiverged
from sb3_torcs.files import writable_folder
from sb3_torcs.signals import count_interrupts

if TYPE_CHECKING:
    from sb3_torcs.training.trial import Training

__all__ = [
    "REPLAY_BUFFER",
    "SAVING",
    "Keeper",
    "StagingFolder",
    "check_healthy",
    "tensorboard_folder",
]

SAVING = "saving what was learned; Ctrl-C once more drops it\n"

UNFINISHED = ".unfinished"
REPLAY_BUFFER = "replay_buffer.pkl"


class StagingFolder:
    """
    A folder whose files are there whole, or not at all.

    Write into :attr:`aside`, and call :meth:`settle`.

    :param folder: where the files are to be
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.aside = folder / UNFINISHED

    def unfinished(self) -> list[Path]:
        """Return the files that are not moved yet, in the order in which they were begun."""
        files = [file for file in self.aside.rglob("*") if file.is_file()]
        return sorted(files, key=lambda file: file.stat().st_mtime_ns)

    def settle(self) -> None:
        """Move the files, which are complete, to their final paths."""
        files = self.unfinished()
        for file in files:
            with file.open("r+b") as content:  # Windows flushes only what may be written
                os.fsync(content.fileno())
        for file in files:
            file.replace(self.place(file))

    def place(self, file: Path) -> Path:
        """
        Return the final path of a file.

        :param file: in :attr:`aside`
        :return: its path; the folder of it is made
        """
        target = self.folder / file.relative_to(self.aside)
        target.parent.mkdir(parents=True, exist_ok=True)
        return target

    def drop(self) -> None:
        """Remove unfinished files."""
        for file in self.unfinished():
            file.unlink()

    def close(self) -> None:
        """Remove the folder aside."""
        shutil.rmtree(self.aside, ignore_errors=True)


class Keeper:
    """
    Saves a training into the folder of its run.

    :param training: that learns
    :param folder: of the run
    """

    def __init__(self, training: Training, folder: Path) -> None:

        self.training = training
        self.name = folder.name.rpartition("_")[0]  # of the environment
        self.files = StagingFolder(folder)

    def learn(self, interrupts: list[int]) -> None:
        """
        Let the agent learn, and save it at the end.

        A large replay buffer takes a minute: one Ctrl-C then ends nothing, but a second one does.

        :param interrupts: signals so far: with one of them the training ends
        """
        try:
            with self._named_errors():
                try:
                    self.training.run(self.keep, interrupts)
                    return
                except KeyboardInterrupt:
                    pass
                except RuntimeError as error:
                    # numba's, after a Ctrl-C that Python has ignored while it compiled
                    if not interrupts or type(error) is not RuntimeError:
                        raise
                self._end_callbacks()
                if self.training.model.num_timesteps:
                    with count_interrupts(1, SAVING):
                        self.keep()
        except Exception as error:
            self._end_callbacks()
            if self.training.model.num_timesteps == 0 and isinstance(error, InvalidOption):
                shutil.rmtree(self.files.folder)  # a callback has refused to begin
                raise
            try:
                with contextlib.suppress(OSError):
                    self.keep()
            except TrainingDiverged as diverged:
                raise diverged from error
            raise
        finally:
            self.files.close()

    def keep(self) -> None:
        """
        Save the model and what belongs to it. The previous files stay until then.

        The replay buffer comes last: it is large, and may not fit on the disk.

        :raises TrainingDiverged: if the model computes no numbers any more, and would replace a
            good one
        """
        training, aside = self.training, self.files.aside
        check_healthy(training.model)
        self.files.drop()
        (aside / self.name).mkdir(parents=True, exist_ok=True)
        with self._without_unfinished():
            (aside / f"{self.name}.zip").write_bytes(training.model_file())
        if training.rows:
            (aside / BEST_MODEL).write_bytes(training.best_model or b"")
            self._write_evaluations(aside / "evaluations.npz")
        if training.normalizer is not None:
            training.normalizer.save(str(aside / self.name / STATISTICS))
        self.files.settle()
        if getattr(training.model, "replay_buffer", None) is not None:
            with (aside / REPLAY_BUFFER).open("wb") as file:
                training.model.save_replay_buffer(file)
            self.files.settle()

    def _end_callbacks(self) -> None:
        """Undo what callbacks changed for an update, and leave the terminal as it was."""
        end_changes(self.training.model)
        for callback in self.training.callbacks:
            if isinstance(callback, RacingProgressCallback):
                callback.on_training_end()

    def _write_evaluations(self, file: Path) -> None:
        """Write the table that SB3's ``EvalCallback`` writes."""
        timesteps = np.unique([row["decisions"] for row in self.training.rows])
        results = np.array([row["return"] for row in self.training.rows])
        np.savez(file, timesteps=timesteps, results=results.reshape(len(timesteps), -1))

    @contextlib.contextmanager
    def _without_unfinished(self) -> Iterator[None]:
        """Subtract a rollout from the model's count that it has not learned from yet."""
        model, seen = self.training.model, self.training.model.num_timesteps
        if isinstance(model, OnPolicyAlgorithm):
            model.num_timesteps = self.training.learned_from
        try:
            yield
        finally:
            model.num_timesteps = seen

    @contextlib.contextmanager
    def _named_errors(self) -> Iterator[None]:
        """Add the file's name to the error of a file that cannot be written."""
        try:
            yield
        except OSError as error:
            if error.filename is None:
                begun = [self.files.place(file) for file in self.files.unfinished()]
                error.filename = str([*begun, self.files.folder][0])
            raise


def check_healthy(model: BaseAlgorithm) -> None:
    """
    Make sure that a model computes numbers.

    :param model: that learns
    :raises TrainingDiverged: if a weight is not finite, or what the model does next
    """
    if not _is_healthy(model):
        raise TrainingDiverged(
            f"the training has diverged: after {model.num_timesteps} timesteps its model computes "
            "no numbers any more"
        )


def _is_healthy(model: BaseAlgorithm) -> bool:
    if not all(bool(th.isfinite(w).all()) for w in model.policy.parameters()):
        return False
    if model._last_obs is None:
        return True
    try:
        actions, _ = model.policy.predict(model._last_obs, deterministic=True)
    except ValueError:  # of a distribution whose mean is no number
        return False
    return bool(np.isfinite(actions).all())


def tensorboard_folder(folder: str | Path) -> Path:
    """
    Make a folder for TensorBoard, whose code accepts only UTF-8 names.

    :param folder: of its files
    :return: the folder
    :raises OutputNotWritable: if it cannot be written, or has another name
    """
    path = writable_folder(folder)
    try:
        str(path.absolute()).encode()
    except UnicodeEncodeError as error:
        raise OutputNotWritable(
            f"TensorBoard cannot write to '{path}', whose name is not UTF-8; give another folder: "
            "--tensorboard DIR"
        ) from error
    return path
