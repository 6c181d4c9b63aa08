"""The RL Zoo's own training, with files that are there whole or not at all."""

from __future__ import annotations

import contextlib
import copy
import fcntl
import locale
import os
import sys
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import rl_zoo3.train
from rl_zoo3.callbacks import SaveVecNormalizeCallback
from rl_zoo3.exp_manager import ExperimentManager
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import CheckpointCallback, EvalCallback

from sb3_torcs.agents.model_writing import RecordCallback, recipe
from sb3_torcs.errors import InvalidOption, WorkerLost
from sb3_torcs.training.keeping import KeepCallback, WholeFiles

__all__ = ["Manager", "command_as_text", "train"]

SAVINGS = 40  # of a training without evaluations


class Manager(ExperimentManager):
    """
    The zoo's manager of one training, which keeps what was learned at each evaluation.

    :param arguments: of the zoo's own
    :param keywords: of the zoo's own
    """

    def __init__(self, *arguments: Any, **keywords: Any) -> None:
        log_folder = arguments[3]
        with _alone(Path(log_folder) / arguments[1]):
            # The zoo numbers a run by the folders that it finds: two that began at once would
            # write into one.
            super().__init__(*arguments, **keywords)
            self.create_log_folder()
        self.files = WholeFiles(Path(self.save_path))
        if self.optimize_hyperparameters:
            self.tensorboard_log = None  # a search writes none, and would warn of it

    def read_hyperparameters(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """
        Read what the training is asked for, and keep it for the model's record.

        :return: the same twice, the first to be changed
        """
        hyperparameters, said = super().read_hyperparameters()
        self._asked = copy.deepcopy(dict(said))
        return hyperparameters, said

    def create_callbacks(self) -> None:
        """
        Let the zoo's callbacks write aside, between the two of ours.

        One writes the model's record, before anything saves the model; the other keeps what was
        learned.
        """
        asked = {**self._asked, "env_kwargs": self.env_kwargs, "n_timesteps": self.n_timesteps}
        self.callbacks.append(RecordCallback(recipe(self.algo, self.env_name.gym_id, asked)))
        super().create_callbacks()
        if self.optimize_hyperparameters:
            return
        for callback in self.callbacks:
            if isinstance(callback, CheckpointCallback) and callback.save_path == self.save_path:
                callback.save_path = str(self.files.aside)
            if isinstance(callback, EvalCallback):
                self._write_aside(callback)
        every = self.eval_freq
        if every <= 0:
            every = max(self.n_timesteps // SAVINGS // self.n_envs, 1)
        self.keeper = KeepCallback(self.files, self.env_name, every)
        self.callbacks.append(self.keeper)

    def _write_aside(self, callback: EvalCallback) -> None:
        """Change the places of an evaluation's files, if they are those of the run."""
        if callback.best_model_save_path != self.save_path:
            return
        callback.best_model_save_path = str(self.files.aside)
        callback.log_path = str(self.files.aside / "evaluations")
        if isinstance(callback.callback_on_new_best, SaveVecNormalizeCallback):
            callback.callback_on_new_best.save_path = str(self.files.aside / self.env_name)

    def learn(self, model: BaseAlgorithm) -> None:
        """
        Train; if an error ends it, keep what can be kept.

        :param model: to be trained
        """
        self.keeper.init_callback(model)
        try:
            with self._named_errors():
                super().learn(model)
        except Exception as error:
            with contextlib.suppress(OSError):
                if self.keeper.is_healthy():
                    self.keeper.keep()
            self.files.close()
            if isinstance(error, EOFError | ConnectionError):
                raise WorkerLost("a process with a car of the training has ended") from error
            raise

    def save_trained_model(self, model: BaseAlgorithm) -> None:
        """
        Keep the last model.

        :param model: that was trained
        """
        del model  # which the callback knows
        try:
            with self._named_errors():
                self.keeper.keep()
        finally:
            self.files.close()

    def hyperparameters_optimization(self) -> None:
        """
        Search hyperparameters, which leaves reports and no model.

        :raises InvalidOption: if it ends before any trial does
        """
        try:
            super().hyperparameters_optimization()
        except ValueError as error:
            if "No trials are completed" not in str(error):
                raise
            raise InvalidOption(
                "no trial of the search has come to its end; let it run longer, or give it more "
                "--n-trials"
            ) from error

    @contextlib.contextmanager
    def _named_errors(self) -> Iterator[None]:
        """Let the error of a file that cannot be written name it; SB3's do not."""
        try:
            yield
        except OSError as error:
            if error.filename is None:
                begun = [self.files.place(file) for file in self.files.unfinished()]
                error.filename = str([*begun, self.save_path][0])
            raise


@contextlib.contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """
    Let others wait.

    :param folder: of all runs of an algorithm; is made
    """
    folder.mkdir(parents=True, exist_ok=True)
    directory = os.open(folder, os.O_RDONLY)
    try:
        with contextlib.suppress(OSError):  # of file systems without locks
            fcntl.flock(directory, fcntl.LOCK_EX)
        yield
    finally:
        os.close(directory)


def train(words: list[str], managers: list[Manager]) -> None:
    """
    Run the zoo's own training in this process.

    :param words: of its command line
    :param managers: gets the manager of the training, once there is one
    """

    def manager(*arguments: Any, **keywords: Any) -> Manager:
        managers.append(Manager(*arguments, **keywords))
        return managers[-1]

    # The zoo's function with our manager in the place of its own; the zoo itself stays as it is.
    names = {**vars(rl_zoo3.train), "ExperimentManager": manager}
    zoo_train = types.FunctionType(rl_zoo3.train.train.__code__, names)
    before = sys.argv
    sys.argv = ["rl_zoo3.train", *words]
    try:
        with command_as_text():
            zoo_train()
    finally:
        sys.argv = before


@contextlib.contextmanager
def command_as_text() -> Iterator[None]:
    """Let the zoo write the process's command line into a file, also if a path in it is no text."""
    before = sys.orig_argv
    encoding = locale.getpreferredencoding(False)
    sys.orig_argv = [word.encode(encoding, "backslashreplace").decode(encoding) for word in before]
    try:
        yield
    finally:
        sys.orig_argv = before
