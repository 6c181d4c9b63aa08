"""``sb3-torcs train``: its options, the folder of a run, and how a run ends."""

from __future__ import annotations

import contextlib
import dataclasses
import inspect
import os
import re
import shlex
import shutil
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import yaml
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from sb3_torcs.agents.models import find_model, saved_timesteps
from sb3_torcs.agents.saved.algorithm import algorithm_class
from sb3_torcs.agents.saved.record import BEST_MODEL
from sb3_torcs.callbacks.display import Unbroken
from sb3_torcs.callbacks.lines import LinePicturesCallback
from sb3_torcs.callbacks.progress import RacingProgressCallback
from sb3_torcs.car import check_count
from sb3_torcs.errors import OutputNotWritable, TrainingDiverged
from sb3_torcs.files import as_list, lock, writable_folder
from sb3_torcs.signals import count_interrupts
from sb3_torcs.torcs.track_names import stable_kwargs
from sb3_torcs.training import zoo
from sb3_torcs.training.keeping import REPLAY_BUFFER, SAVING, Keeper, tensorboard_folder
from sb3_torcs.training.resuming import check_resumable, recorded_entry
from sb3_torcs.training.trial import Recipe, Training

__all__ = ["Run", "TrainOptions", "continuing_command", "train", "train_run"]

SLICES = 40  # evaluations of a whole training, unless --eval-freq says otherwise; or savings
SHORTEST_EVAL_FREQ = 1000  # timesteps

OF_ONE_RUN = (
    "folder", "tensorboard", "eval_freq", "eval_episodes", "seed", "progress", "pictures",
)  # fmt: skip
"""Options that a model's record does not hold."""


@dataclasses.dataclass(frozen=True)
class TrainOptions:
    """
    The options of a training.

    :param algo: as the RL Zoo calls it
    :param env: a registered racing environment
    :param entry: of the hyperparameter file; ``None`` is the environment's own
    :param conf_file: hyperparameter file; ``None`` is the shipped one of the algorithm
    :param track: instead of the entry's
    :param hyperparams: values that replace those of the entry
    :param env_kwargs: arguments of the environment that replace those of the entry
    :param timesteps: to learn from; ``None`` is what the entry says, or what is left of the
        training that is resumed
    :param seed: of everything
    :param folder: gets ``ALGO/ENV_1``, ``ALGO/ENV_2``, ...
    :param tensorboard: its log folder; ``None`` is ``FOLDER/tensorboard``
    :param eval_freq: timesteps between evaluations, 0 for none; ``None`` is a fortieth of the
        training, and at least 1000 where it has as many, and a rollout of PPO
    :param eval_episodes: per track and evaluation
    :param resume: a saved model (.zip) or a run's folder to continue from, with the entry that it
        has learned by unless ``entry`` or ``conf_file`` is given
    :param trust: accept a model without a record
    :param progress: show a progress bar, and a line for each evaluation
    :param pictures: folder for pictures of the driven lines, one a minute, and their table
        ``laps.csv``; ``None`` draws none
    """

    algo: str = "ddpg"
    env: str = "Torcs-v0"
    entry: str | None = None
    conf_file: str | Path | None = None
    track: str | None = None
    hyperparams: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    env_kwargs: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    timesteps: int | None = None
    seed: int = 0
    folder: str | Path = "logs"
    tensorboard: str | Path | None = None
    eval_freq: int | None = None
    eval_episodes: int = 1
    resume: str | Path | None = None
    trust: bool = False
    progress: bool = True
    pictures: str | Path | None = None


@dataclasses.dataclass(frozen=True)
class Run:
    """The result of a training."""

    folder: Path
    timesteps: int  # that it learned from
    wanted: int  # timesteps that were asked for
    signal: int | None  # that ended it early, e.g. SIGINT of Ctrl-C
    last_model: Path
    env_kwargs: Mapping[str, Any]  # of its environments

    @property
    def best_model(self) -> Path:
        """The best model by evaluation, or the last one if there was no evaluation yet."""
        best = self.folder / BEST_MODEL
        return best if best.is_file() else self.last_model


def train(options: TrainOptions) -> Path:
    """
    Train, and keep the model even if Ctrl-C ends it early.

    :param options: what to train, and where to put it
    :return: the run's folder: ``best_model.zip``, ``ENV.zip`` (the last one), logs
    """
    return train_run(options).folder


def train_run(options: TrainOptions) -> Run:
    """
    Train, and return the result.

    :param options: what to train, and where to put it
    :return: the result
    :raises ZooConfigError: if the hyperparameters have something that nothing would read
    :raises InvalidOption: if a number is not allowed
    :raises OutputNotWritable: if a folder cannot be written
    """
    _check_numbers(options)
    resume = None if options.resume is None else find_model(options.resume, prefer_last=True)
    entry, place = _entry(options, resume)
    with contextlib.closing(zoo.checked_env(entry, options.env, place)) as env:
        if resume is not None:
            _prepare_resuming(options, resume, entry, env)
    if options.pictures is not None:
        writable_folder(options.pictures)
    folder = writable_folder(options.folder)
    tensorboard = tensorboard_folder(options.tensorboard or folder / "tensorboard")
    name = options.env.replace("/", "-")  # as the zoo writes an id with a namespace
    with _new_run(folder / options.algo, name) as run_folder:
        _write_config(run_folder / name, options, entry)
        training = _training(options, entry, run_folder, tensorboard / name, resume)
    return _learn(options, training, run_folder)


def _check_numbers(options: TrainOptions) -> None:
    if options.timesteps is not None:
        check_count("timesteps", options.timesteps)
    check_count("eval_episodes", options.eval_episodes)
    check_count("seed", options.seed, least=0)


def _entry(options: TrainOptions, resume: Path | None) -> tuple[dict[str, Any], zoo.Place]:
    """
    Read, change and check the hyperparameters.

    :param options: what to train
    :param resume: the model to resume, which knows its own, unless others are given; ``None``
        begins a training
    :return: the entry, and where it stands
    """
    zoo.check_racing(options.env)
    entry: dict[str, Any] = {}
    if resume is not None and options.entry is None and options.conf_file is None:
        entry = recorded_entry(resume, options.algo, options.env)
    if resume is not None and "policy" in entry:
        place = zoo.Place(resume, "as it was recorded")
    else:
        name = options.env if options.entry is None else options.entry
        place = zoo.Place(zoo.config_file(options.algo, options.conf_file), name)
        entry = {**zoo.read_entry(*place), **entry}
    entry.update(options.hyperparams)
    if options.timesteps is not None:
        entry["n_timesteps"] = options.timesteps
    own = {} if options.track is None else {"track": options.track}
    own.update(options.env_kwargs)
    if own and isinstance(entry.get("env_kwargs"), Mapping | None):
        entry["env_kwargs"] = {**(entry.get("env_kwargs") or {}), **own}
    zoo.check_entry(entry, options.algo, options.env, place)
    entry["n_timesteps"] = zoo.timesteps(entry)
    if entry.get("env_kwargs"):
        entry["env_kwargs"] = stable_kwargs(entry["env_kwargs"])
    return entry, place


def _prepare_resuming(options: TrainOptions, resume: Path, entry: dict[str, Any], env: Any) -> None:
    """
    Check the model to resume. With its replay buffer it needs only what is left of a warm-up.

    :param options: what to train
    :param resume: the model
    :param entry: its hyperparameters; is adapted
    :param env: one of those to train in
    """
    buffer = check_resumable(resume, env, options.algo, entry, trust=options.trust)
    if "learning_starts" in entry and buffer:
        left = int(entry["learning_starts"]) - saved_timesteps(resume)
        entry["learning_starts"] = max(left, 0)
    replays = issubclass(algorithm_class(options.algo), OffPolicyAlgorithm)
    if replays and not buffer:
        _note(f"there is no {REPLAY_BUFFER} beside '{resume}': the training fills an empty one")
    if resume.name == BEST_MODEL and Path(str(options.resume)).expanduser().is_dir():
        _note(f"'{options.resume}' has no last model; going on from the best one")
    if "n_steps" in entry and replays:
        # SB3 chooses the class of the replay buffer as before; given its own choice, it would warn.
        entry.setdefault("replay_buffer_class", None)


def _note(sentence: str) -> None:
    sys.stderr.write(f"sb3-torcs: {sentence}\n")


@contextlib.contextmanager
def _new_run(folder: Path, name: str) -> Iterator[Path]:
    """
    Make the folder of a run, ``ENV_N``; remove it if the run does not begin.

    :param folder: of all runs of an algorithm; is made
    :param name: of the environment
    """
    folder.mkdir(parents=True, exist_ok=True)
    with contextlib.ExitStack() as stack:
        # Two runs that begin at the same time would take the same number. Windows does not open
        # folders, and some file systems have no locks.
        with contextlib.suppress(OSError):
            directory = os.open(folder, os.O_RDONLY)
            stack.callback(os.close, directory)
            lock(directory, wait=True)
        runs = (re.fullmatch(rf"{re.escape(name)}_(\d+)", own.name) for own in folder.iterdir())
        run_folder = folder / f"{name}_{max((int(run[1]) for run in runs if run), default=0) + 1}"
        run_folder.mkdir()
    try:
        yield run_folder
    except BaseException:  # Ctrl-C, too
        shutil.rmtree(run_folder)
        raise


def _write_config(folder: Path, options: TrainOptions, entry: Mapping[str, Any]) -> None:
    """Write the files that the zoo's scripts read of a run."""
    folder.mkdir()
    words = {"algo": options.algo, "env": options.env, "seed": options.seed, "env_kwargs": None}
    for name, content in (("config.yml", dict(entry)), ("args.yml", words)):
        (folder / name).write_text(yaml.safe_dump(content), encoding="utf-8")


def _training(
    options: TrainOptions,
    entry: dict[str, Any],
    folder: Path,
    tensorboard: Path,
    resume: Path | None,
) -> Training:
    """Build the training of a run, with what it shows."""
    wanted, frequency = entry["n_timesteps"], options.eval_freq
    if frequency is None:
        # Within a rollout the policy does not change.
        shortest = min(wanted, SHORTEST_EVAL_FREQ), _rollout(options.algo, entry)
        frequency = max(wanted // SLICES, *shortest)
    own = as_list((entry.get("env_kwargs") or {}).get("track", "aalborg"))
    tracks = tuple(dict.fromkeys(own)) if frequency > 0 else ()
    interval = frequency if frequency > 0 else max(wanted // SLICES, 1)
    recipe = Recipe(options.algo, options.env, entry, options.seed, interval, tracks)
    training = Training(
        recipe,
        exact=False,
        episodes=options.eval_episodes,
        folder=folder,
        tensorboard=tensorboard,
        resume=resume,
    )
    if options.progress:
        training.callbacks.insert(0, RacingProgressCallback())
    if options.pictures is not None:
        training.callbacks.append(LinePicturesCallback(folder=str(options.pictures)))
    return training


def _rollout(algo: str, entry: Mapping[str, Any]) -> int:
    """Return the timesteps between two updates of an algorithm without a replay buffer, else 0."""
    kind = algorithm_class(algo)
    if not issubclass(kind, OnPolicyAlgorithm):
        return 0
    usual = inspect.signature(kind).parameters["n_steps"].default
    return int(entry.get("n_steps", usual)) * int(entry.get("n_envs", 1))


def _learn(options: TrainOptions, training: Training, folder: Path) -> Run:
    """
    Let the agent learn. Whatever ends that, save what it has learned.

    :param options: what to train
    :param training: that begins
    :param folder: of the run
    """
    keeper = Keeper(training, folder)
    # `tee` may end at Ctrl-C, before the model is saved.
    out, err = Unbroken(sys.stdout), Unbroken(sys.stderr)
    redirected = contextlib.redirect_stdout(out), contextlib.redirect_stderr(err)
    with contextlib.closing(training), redirected[0], redirected[1]:
        try:
            with count_interrupts(2, SAVING) as seen:
                keeper.learn(seen)
        except (OSError, TrainingDiverged) as error:
            raise _explained(error, _result(training, folder, None), options) from error
        if training.model.num_timesteps == 0:
            shutil.rmtree(folder)
            raise KeyboardInterrupt
    return _result(training, folder, seen[0] if seen else None)


def _result(training: Training, folder: Path, signal: int | None) -> Run:
    """Return how far a training is."""
    recipe = training.recipe
    last_model = folder / f"{folder.name.rpartition('_')[0]}.zip"
    timesteps = saved_timesteps(last_model) if last_model.is_file() else 0
    return Run(folder, timesteps, recipe.budget, signal, last_model, recipe.env_kwargs)


def _explained(error: OSError | TrainingDiverged, result: Run, options: TrainOptions) -> Exception:
    """Compose a message: why a training ended, what is saved, and what to type."""
    why, kind, remedy = str(error), type(error), "lower the learning_rate"
    if isinstance(error, OSError):
        why = f"cannot write '{error.filename or result.folder}': {error.strerror or error}"
        kind, remedy = OutputNotWritable, "make room, or choose another folder"
    best = result.best_model
    if not result.timesteps and best.is_file():  # a later file had no room
        result = dataclasses.replace(result, last_model=best, timesteps=saved_timesteps(best))
    if result.timesteps >= result.wanted:
        learned = f"kept: '{result.last_model}', which has learned from all timesteps"
        return kind(f"{why}; {learned}; see it: sb3-torcs evaluate '{result.best_model}'")
    if result.timesteps > 0:
        kept = f"kept: '{result.last_model}', {result.timesteps} of {result.wanted} timesteps"
        if kind is TrainingDiverged:  # the command goes on with the recorded one
            remedy += " (add: --hyperparams learning_rate=NUMBER)"
        command = continuing_command(options, result)
        return kind(f"{why}; {kept}; {remedy}, and go on with: {command}")
    return kind(f"{why}; nothing was kept yet; {remedy}, and start again")


def continuing_command(options: TrainOptions, result: Run) -> str:
    """
    Compose the command that continues a training. The model's record holds what is left out.

    :param options: of the training
    :param result: how far it came
    """
    words = ["sb3-torcs", "train", "--resume", str(result.last_model)]
    for field in dataclasses.fields(options):
        value = getattr(options, field.name)
        if field.name not in OF_ONE_RUN or (value == field.default and field.name != "seed"):
            continue
        option = field.name.replace("_", "-")
        words += ["--no-progress"] if field.name == "progress" else [f"--{option}", str(value)]
    return shlex.join(words)
