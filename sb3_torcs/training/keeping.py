"""Save a training while it learns, so that its files are complete however it ends.

Each file is written into a folder beside the others first, and moved when it is whole. So a kill, a
power cut or a full disk leaves what was saved before.
"""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from sb3_torcs.agents.saved.record import STATISTICS
from sb3_torcs.car import check_count
from sb3_torcs.errors import OutputNotWritable, TrainingDiverged
from sb3_torcs.files import writable_folder

__all__ = [
    "REPLAY_BUFFER",
    "SAVING",
    "KeepCallback",
    "WholeFiles",
    "check_healthy",
    "tensorboard_folder",
]

SAVING = "saving what was learned; Ctrl-C once more drops it\n"

UNFINISHED = ".unfinished"
REPLAY_BUFFER = "replay_buffer.pkl"


class WholeFiles:
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


class KeepCallback(BaseCallback):
    """
    Save the last model while it learns, with everything that a training resumes from.

    That is the replay buffer of an off-policy algorithm, and the statistics of ``VecNormalize``.
    It also moves the files of the callbacks before it to their final paths.

    :param files: folder of the run
    :param name: of the model's file, without ``.zip``; and of the folder of the statistics
    :param every: calls between two savings
    :param others: calls between two files of each callback that writes aside, too
    :param interrupts: signals so far: with one of them the training ends, also if Python has
        ignored the ``KeyboardInterrupt`` that it raised, as it does in code that C calls
    :param verbose: as in ``BaseCallback``
    """

    def __init__(
        self,
        files: WholeFiles,
        name: str,
        every: int,
        others: Sequence[int] = (),
        interrupts: Sequence[int] = (),
        *,
        verbose: int = 0,
    ) -> None:
        super().__init__(verbose)
        check_count("every", every)
        self.files = files
        self.name = name
        self.every = every
        self._others = others
        self._interrupts = interrupts

    def _init_callback(self) -> None:
        (self.files.aside / self.name).mkdir(parents=True, exist_ok=True)
        self._count()

    def _on_rollout_start(self) -> None:
        self._count()

    def _on_training_end(self) -> None:
        self._count()

    def _count(self) -> None:
        """Note that the model has learned from all timesteps so far."""
        self._learned_from = self.model.num_timesteps

    def _on_step(self) -> bool:
        if self._interrupts:
            raise KeyboardInterrupt
        if any(self.n_calls % other == 0 for other in self._others):
            self.files.settle()
        if self.n_calls % self.every == 0:
            self.keep()
        return True

    def keep(self) -> None:
        """
        Save the model and what belongs to it. The previous files stay until then.

        The replay buffer comes last: it is large, and may not fit on the disk.

        :raises TrainingDiverged: if the model computes no numbers any more, and would replace a
            good one
        """
        check_healthy(self.model)
        self.files.drop()
        aside = self.files.aside
        with (aside / f"{self.name}.zip").open("wb") as file, self._without_unfinished():
            self.model.save(file)
        statistics = self.model.get_vec_normalize_env()
        if statistics is not None:
            statistics.save(str(aside / self.name / STATISTICS))
        self.files.settle()
        if getattr(self.model, "replay_buffer", None) is not None:
            with (aside / REPLAY_BUFFER).open("wb") as file:
                self.model.save_replay_buffer(file)  # type: ignore[attr-defined]
            self.files.settle()

    @contextlib.contextmanager
    def _without_unfinished(self) -> Iterator[None]:
        """Leave a rollout out of the model's count from which it has not learned yet."""
        model, seen = self.model, self.model.num_timesteps
        if isinstance(model, OnPolicyAlgorithm):
            model.num_timesteps = self._learned_from
        try:
            yield
        finally:
            model.num_timesteps = seen


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
