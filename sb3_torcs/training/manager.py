"""The one place that starts the RL Zoo.

:func:`train` runs the zoo's training and writes each file completely or not at all. For studies,
:func:`build` lets the zoo make an algorithm and its environments only.
"""

from __future__ import annotations

import argparse
import contextlib
import copy
import io
import locale
import os
import shutil
import sys
import tempfile
import types
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import rl_zoo3.train
import yaml
from rl_zoo3.callbacks import SaveVecNormalizeCallback
from rl_zoo3.exp_manager import ExperimentManager
from rl_zoo3.hyperparams_opt import HYPERPARAMS_SAMPLER
from rl_zoo3.utils import ALGOS
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback, EvalCallback
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv, VecNormalize

import sb3_torcs  # noqa: F401  registers the environments
from sb3_torcs.agents.saved.algorithm import algorithm_class
from sb3_torcs.agents.saved.record import STATISTICS
from sb3_torcs.agents.saved.writing import RecordCallback, recipe
from sb3_torcs.callbacks import RacingProgressCallback
from sb3_torcs.callbacks.learning import end_changes
from sb3_torcs.errors import (
    InvalidOption,
    Sb3TorcsError,
    TrainingDiverged,
    WorkerLost,
    ZooConfigError,
)
from sb3_torcs.files import lock
from sb3_torcs.signals import counted_interrupts
from sb3_torcs.training.keeping import SAVING, KeepCallback, WholeFiles
from sb3_torcs.training.resuming import restore_statistics
from sb3_torcs.training.workers import WorkersVecEnv
from sb3_torcs.training.zoo import OURS
from sb3_torcs.vec_env import TorcsVecEnv

__all__ = ["Built", "Manager", "build", "train"]

SAVINGS = 40  # of a training without evaluations
RECORDS = ("config.yml", "args.yml")  # of a run: evaluate and watch read them


class Built(NamedTuple):
    """The algorithm and the callbacks that the zoo makes of an entry."""

    model: Any  # of any algorithm; its environments are ``model.get_env()``
    callbacks: list[BaseCallback]
    records: dict[str, bytes]  # the zoo's own of the run, by file name


def build(algo: str, env_id: str, entry: Mapping[str, Any], *, seed: int = 0) -> Built:
    """
    Let the zoo build an algorithm, its environments and its callbacks, without writing files.

    :param algo: as the zoo calls it
    :param env_id: of a registered environment
    :param entry: of a hyperparameter file
    :param seed: of the training
    """
    said = argparse.Namespace(algo=algo, env=env_id, seed=seed)
    with tempfile.TemporaryDirectory() as scratch, contextlib.redirect_stdout(io.StringIO()):
        manager = _EntryManager(
            said, algo, env_id, scratch, eval_freq=-1, seed=seed, verbose=0, device="cpu",
            entry=entry,
        )  # fmt: skip
        with contextlib.ExitStack() as unless_built:
            unless_built.callback(manager.close_envs)
            with _command_as_text():
                model, _ = manager.setup_experiment()
            unless_built.pop_all()
        folder = Path(manager.params_path)
        records = {name: (folder / name).read_bytes() for name in RECORDS}
    return Built(model, manager.callbacks, records)


def train(
    algo: str,
    env_id: str,
    entry: Mapping[str, Any],
    words: list[str],
    managers: list[Manager],
    interrupts: Sequence[int] = (),
) -> None:
    """
    Run the zoo's own training in this process.

    :param algo: as the zoo calls it
    :param env_id: of a registered environment
    :param entry: of a hyperparameter file
    :param words: further arguments of the zoo's command line
    :param managers: gets the manager of the training, once there is one
    :param interrupts: gets the signals that are to end the training
    """

    def manager(*arguments: Any, **keywords: Any) -> Manager:
        managers.append(Manager(*arguments, entry=entry, **keywords))
        managers[-1].interrupts = interrupts
        return managers[-1]

    ALGOS.setdefault(algo, algorithm_class(algo))  # those of SBX, as SBX's documentation does
    first = ["--gym-packages", "sb3_torcs", "--algo", algo, "--env", env_id]
    # The zoo's function, with our manager and our arguments instead of its own.
    names = {**vars(rl_zoo3.train), "ExperimentManager": manager}
    names["argparse"] = types.SimpleNamespace(ArgumentParser=_parser_of([*first, *words]))
    zoo_train = types.FunctionType(rl_zoo3.train.train.__code__, names)
    try:
        with _command_as_text():
            zoo_train()
    finally:
        for made in managers:  # the zoo leaves those of evaluations open
            made.close_envs()


def _parser_of(words: list[str]) -> type[argparse.ArgumentParser]:
    """Make the class of a parser that reads these arguments, not those of the process."""

    class Parser(argparse.ArgumentParser):
        def __init__(self) -> None:
            super().__init__(prog="rl_zoo3.train", allow_abbrev=False)

        def parse_args(self) -> argparse.Namespace:  # type: ignore[override]
            return super().parse_args(words)

    return Parser


class _EntryManager(ExperimentManager):
    """
    The zoo's manager of an entry.

    It lets several cars of a training drive on threads, or in processes that Ctrl-C cannot hang,
    and resumes a training with the statistics of its model.

    :param arguments: of the zoo's own
    :param entry: of a hyperparameter file
    :param keywords: of the zoo's own
    """

    vec_env_class: type[VecEnv]

    def __init__(self, *arguments: Any, entry: Mapping[str, Any], **keywords: Any) -> None:
        self._made: list[VecEnv] = []
        self._entry = entry
        super().__init__(*arguments, **keywords)

    def read_hyperparameters(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """
        Give the entry to the zoo, which reads files only.

        :return: two equal dicts, of which the zoo changes the first
        """
        # The file lives no longer than this, so that a training that is killed leaves none behind.
        with tempfile.TemporaryDirectory() as scratch:
            self.config = str(Path(scratch) / "zoo.yml")
            text = yaml.safe_dump({self.env_name.gym_id: dict(self._entry)})
            Path(self.config).write_text(text, encoding="utf-8")
            return super().read_hyperparameters()

    def create_envs(self, n_envs: int, eval_env: bool = False, no_log: bool = False) -> VecEnv:
        """
        Make environments as the zoo does, but in :class:`TorcsVecEnv` where threads can drive them.

        Those in processes are in :class:`WorkersVecEnv`, which Ctrl-C cannot hang.

        :param n_envs: how many
        :param eval_env: whether they are for evaluations
        :param no_log: whether to write no ``monitor.csv``
        :return: what ``DummyVecEnv`` would be, to the bit
        """
        own = self.vec_env_class
        if own is SubprocVecEnv:
            self.vec_env_class = WorkersVecEnv
        elif own is DummyVecEnv and n_envs > 1 and self._on_threads():
            self.vec_env_class = TorcsVecEnv
        try:
            self._made.append(super().create_envs(n_envs, eval_env, no_log))
            return self._made[-1]
        finally:
            self.vec_env_class = own

    def _maybe_normalize(self, env: VecEnv, eval_env: bool) -> VecEnv:
        """
        Normalize as the zoo does; a training that is resumed with the statistics of its model.

        The zoo knows them only in a run's own folder.

        :param env: that is to be normalized, or not
        :param eval_env: whether it is for evaluations, which change no statistics
        :return: the environment, within ``VecNormalize`` if the entry asks for it
        """
        normalized = super()._maybe_normalize(env, eval_env)
        model = Path(self.trained_agent)
        known_to_zoo = (model.parent / self.env_name / STATISTICS).is_file()
        if self.continue_training and isinstance(normalized, VecNormalize) and not known_to_zoo:
            restore_statistics(normalized, model)
        return normalized

    def close_envs(self) -> None:
        """Close all environments, which the zoo leaves open where it cannot build the algorithm."""
        for env in self._made:
            env.close()

    def _on_threads(self) -> bool:
        """Say whether no part of the entry has to see each timestep of a race."""
        world = self.env_kwargs.get("backend", "native")
        return self.env_name.gym_id in OURS and self.env_wrapper is None and world == "native"


class Manager(_EntryManager):
    """
    The zoo's manager of one training. It saves the model at each evaluation.

    :param arguments: of the zoo's own
    :param keywords: of the zoo's own, and ``entry``
    :raises InvalidOption: if the zoo cannot search the algorithm's hyperparameters, and is to
    """

    interrupts: Sequence[int] = ()
    """Signals so far; with one of them the training ends."""

    def __init__(self, *arguments: Any, **keywords: Any) -> None:
        _, algo, _, log_folder, *_ = arguments
        with _alone(Path(log_folder) / algo):
            # The zoo numbers a run by the folders that exist. Two runs that begin at the same time
            # would write into one folder.
            super().__init__(*arguments, **keywords)
            if self.optimize_hyperparameters and self.algo not in HYPERPARAMS_SAMPLER:
                raise InvalidOption(
                    f"the RL Zoo cannot search hyperparameters of {self.algo}; it can of: "
                    f"{', '.join(sorted(HYPERPARAMS_SAMPLER))}"
                )
            self.create_log_folder()
        self.files = WholeFiles(Path(self.save_path))
        if self.optimize_hyperparameters:
            self.tensorboard_log = None  # a search writes no such files, and would warn

    def setup_experiment(self) -> tuple[BaseAlgorithm, dict[str, Any]] | None:
        """
        Build the algorithm, its environments and its callbacks.

        :return: as the zoo's own
        :raises ZooConfigError: if the algorithm refuses what it is given; its folder is removed
        """
        try:
            return super().setup_experiment()
        except BaseException as error:  # Ctrl-C, too
            self._leave_nothing()
            refused = AssertionError, NotImplementedError, TypeError, ValueError
            if isinstance(error, Sb3TorcsError) or not isinstance(error, refused):
                raise
            why = " ".join(str(error).split())
            raise ZooConfigError(
                f"{self.algo} cannot learn in {self.env_name.gym_id} by this entry: {why}; change "
                "the entry, or choose another --algo"
            ) from error

    def _leave_nothing(self) -> None:
        """Close the environments, and remove the folder of a run that has not begun."""
        self.close_envs()
        shutil.rmtree(self.save_path)

    def read_hyperparameters(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """
        Read the hyperparameters, and keep them for the model's record.

        :return: two equal dicts, of which the zoo changes the first
        """
        hyperparameters, said = super().read_hyperparameters()
        self._asked = copy.deepcopy(dict(said))
        return hyperparameters, said

    def create_callbacks(self) -> None:
        """
        Put the zoo's callbacks between two of ours, and let them write to temporary names.

        Our first callback writes the model's record before any other saves the model, and only the
        progress bar stands before it: the zoo ends its first callback even if it has not begun. Our
        last one moves complete files to their names.
        """
        asked = {**self._asked, "env_kwargs": self.env_kwargs, "n_timesteps": self.n_timesteps}
        record = RecordCallback(recipe(self.algo, self.env_name.gym_id, asked))
        behind_bar = isinstance(next(iter(self.callbacks), None), RacingProgressCallback)
        self.callbacks.insert(int(behind_bar), record)
        super().create_callbacks()
        if self.optimize_hyperparameters:
            return
        writing = []
        for callback in self.callbacks:
            if isinstance(callback, CheckpointCallback) and callback.save_path == self.save_path:
                callback.save_path = str(self.files.aside)
                writing.append(callback.save_freq)
            if isinstance(callback, EvalCallback) and self._write_aside(callback):
                writing.append(callback.eval_freq)
        every = self.eval_freq
        if every <= 0:
            every = max(self.n_timesteps // SAVINGS // self.n_envs, 1)
        self.keeper = KeepCallback(self.files, self.env_name, every, writing, self.interrupts)
        self.callbacks.append(self.keeper)

    def _write_aside(self, callback: EvalCallback) -> bool:
        """Let an evaluation write to temporary names, and tell whether it is one of the run."""
        if callback.best_model_save_path != self.save_path:
            return False
        callback.best_model_save_path = str(self.files.aside)
        callback.log_path = str(self.files.aside / "evaluations")
        if isinstance(callback.callback_on_new_best, SaveVecNormalizeCallback):
            callback.callback_on_new_best.save_path = str(self.files.aside / self.env_name)
        return True

    def learn(self, model: BaseAlgorithm) -> None:
        """
        Train; if an error ends the training, save the model.

        :param model: to be trained
        """
        self.keeper.init_callback(model)
        try:
            with self._named_errors():
                super().learn(model)
        except Exception as error:
            if self.interrupts and type(error) is RuntimeError:
                return  # numba's, after a Ctrl-C that Python has ignored while it compiled
            if model.num_timesteps == 0 and isinstance(error, InvalidOption):
                self._leave_nothing()  # a callback has refused to begin
                raise
            end_changes(model)
            try:
                with contextlib.suppress(OSError):
                    self.keeper.keep()
            except TrainingDiverged as diverged:
                raise diverged from error
            finally:
                self.files.close()
            if isinstance(error, EOFError | ConnectionError):
                raise WorkerLost("a process with a car of the training has ended") from error
            raise

    def save_trained_model(self, model: BaseAlgorithm) -> None:
        """
        Keep the last model. A large replay buffer takes a minute: one Ctrl-C then ends nothing, but
        a second one does.

        :param model: that was trained
        """
        try:
            end_changes(model)
            with self._named_errors(), counted_interrupts(1, SAVING):
                self.keeper.keep()
        finally:
            self.files.close()

    def hyperparameters_optimization(self) -> None:
        """
        Search hyperparameters. This writes reports and no model.

        :raises InvalidOption: if the search ends before its first trial
        """
        try:
            super().hyperparameters_optimization()
        except ValueError as error:
            if "No trials are completed" not in str(error):
                raise
            raise InvalidOption(
                "no trial of the search has ended; let it run longer, or give it more --n-trials"
            ) from error

    @contextlib.contextmanager
    def _named_errors(self) -> Iterator[None]:
        """Add the file's name to the error of a file that cannot be written."""
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
    Hold a lock, so that other trainings wait.

    :param folder: of all runs of an algorithm; is made
    """
    folder.mkdir(parents=True, exist_ok=True)
    with contextlib.ExitStack() as stack:
        # Windows does not open folders, and some file systems have no locks.
        with contextlib.suppress(OSError):
            directory = os.open(folder, os.O_RDONLY)
            stack.callback(os.close, directory)
            lock(directory, wait=True)
        yield


@contextlib.contextmanager
def _command_as_text() -> Iterator[None]:
    """Let the zoo write the command line to a file, also if a path in it is not valid text."""
    before = sys.orig_argv
    encoding = locale.getpreferredencoding(False)
    sys.orig_argv = [word.encode(encoding, "backslashreplace").decode(encoding) for word in before]
    try:
        yield
    finally:
        sys.orig_argv = before
