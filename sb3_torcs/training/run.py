"""Training with the RL Zoo: options, checks, the run, and its result."""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import inspect
import shlex
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sb3_torcs.car import check_count
from sb3_torcs.errors import (
    InvalidOption,
    OutputNotWritable,
    TrainingDiverged,
    WorkerLost,
    check_extras,
)
from sb3_torcs.files import listed, writable_folder
from sb3_torcs.signals import counted_interrupts
from sb3_torcs.torcs.track_names import lasting_kwargs

__all__ = ["Run", "TrainOptions", "going_on", "train", "train_run"]

if TYPE_CHECKING:
    from sb3_torcs.training.manager import Manager
    from sb3_torcs.training.zoo import Place

EVALUATIONS = 40  # of a whole training, unless --eval-freq says otherwise
SHORTEST_EVAL_FREQ = 1000  # timesteps

PROGRESS = "sb3_torcs.callbacks.RacingProgressCallback"
PICTURES = "sb3_torcs.callbacks.LinePicturesCallback"
WORKER = "sb3_torcs.training.zoo.UninterruptedWorker"
OF_ONE_RUN = (PROGRESS, PICTURES, WORKER)
"""What options add to an entry; a training that is resumed has its own options."""
PLACES = (
    ("--algo",), ("--env",), ("-n", "--n-timesteps"), ("-f", "--log-folder"),
    ("-conf", "--conf-file"), ("-uuid", "--uuid"),
)  # fmt: skip
"""Options of the zoo that decide where things are; ours say the same."""
CHANGES = ("-params", "--hyperparams")  # the zoo's names of its changes to an entry


@dataclasses.dataclass(frozen=True)
class TrainOptions:
    """
    The options of a training.

    :param algo: as the RL Zoo calls it
    :param env: a registered environment
    :param entry: of the hyperparameter file; ``None`` is the environment's own
    :param conf_file: hyperparameter file; ``None`` is the shipped one of the algorithm
    :param track: instead of the entry's
    :param timesteps: to learn from; ``None`` is what the entry says, or what is left of the
        training that is resumed
    :param seed: of everything
    :param folder: gets ``ALGO/ENV_1``, ``ALGO/ENV_2``, ...
    :param tensorboard: its log folder; ``None`` is ``FOLDER/tensorboard``
    :param eval_freq: timesteps between evaluations; ``None`` is a fortieth of the
        training, and at least 1000 where it has as many, and a rollout of PPO
    :param eval_episodes: per evaluation
    :param resume: a saved model (.zip) or a run's folder to continue from, with the entry that it
        has learned by unless ``entry`` or ``conf_file`` is given
    :param trust: accept a model without a record, and evaluate strings of the hyperparameter file
    :param progress: show a progress bar
    :param pictures: folder for pictures of the driven lines, one a minute, and their table
        ``laps.csv``; ``None`` draws none
    :param zoo_args: further arguments for the RL Zoo, which override the options
    """

    algo: str = "ddpg"
    env: str = "TorcsLite-v0"
    entry: str | None = None
    conf_file: str | Path | None = None
    track: str | None = None
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
    zoo_args: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True)
class Run:
    """The result of a training."""

    folder: Path
    timesteps: int  # that it learned from
    wanted: int  # timesteps that were asked for
    signal: int | None  # that ended it early, e.g. SIGINT of Ctrl-C
    last_model: Path | None  # None after a search of hyperparameters
    env_kwargs: Mapping[str, Any]  # of its environments

    @property
    def best_model(self) -> Path | None:
        """The best model by evaluation, or the last one if there was no evaluation yet."""
        from sb3_torcs.agents.saved.record import BEST_MODEL

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
    :raises InvalidOption: if a number is not allowed, or if the arguments for the zoo cannot be
        read, or would move the model
    :raises OutputNotWritable: if a folder cannot be written
    :raises PackageMissing: if the RL Zoo is not installed
    """
    from sb3_torcs.agents.models import find_model
    from sb3_torcs.training import zoo
    from sb3_torcs.training.keeping import tensorboard_folder

    check_extras("to train", "rl_zoo3")
    _check_numbers(options)
    resume = None if options.resume is None else find_model(options.resume, prefer_last=True)
    entry, changed, place = _entry(options, resume)
    with contextlib.closing(zoo.checked_env(changed, options.env, place)) as env:
        if resume is not None:
            _check_resumed(options, resume, entry, env, changed)
    wanted = zoo.timesteps(changed) if options.timesteps is None else options.timesteps
    if any(word.endswith("subproc") for word in options.zoo_args):
        entry["env_wrapper"] = [*listed(entry.get("env_wrapper")), WORKER]
    if options.progress or options.pictures is not None:
        entry["callback"] = _with_display(options, entry.get("callback"))
    folder = writable_folder(options.folder)
    tensorboard = tensorboard_folder(options.tensorboard or folder / "tensorboard")
    words = _zoo_words(options, wanted, changed)
    words += ["--log-folder", str(folder), "--tensorboard-log", str(tensorboard)]
    words += ["--trained-agent", str(resume)] if resume else []
    words += options.zoo_args
    return _run_zoo(options, words, entry, wanted, changed["env_kwargs"])


def _check_numbers(options: TrainOptions) -> None:
    if options.timesteps is not None:
        check_count("timesteps", options.timesteps)
    check_count("eval_episodes", options.eval_episodes)
    check_count("seed", options.seed, least=0)


def _entry(
    options: TrainOptions, resume: Path | None
) -> tuple[dict[str, Any], dict[str, Any], Place]:
    """
    Read and check the hyperparameters.

    :param options: what to train
    :param resume: the model to resume, which knows its own, unless others are given; ``None``
        begins anew
    :return: the entry, before and after the changes of the zoo's arguments, and where it stands
    """
    from sb3_torcs.training import zoo
    from sb3_torcs.training.resuming import recorded_entry

    zoo.check_registered(options.env)
    entry: dict[str, Any] = {}
    if resume is not None and options.entry is None and options.conf_file is None:
        entry = recorded_entry(resume, options.algo, options.env, without=OF_ONE_RUN)
    if resume is not None and "policy" in entry:
        place = zoo.Place(resume, "as it was recorded")
    else:
        name = options.env if options.entry is None else options.entry
        place = zoo.Place(zoo.config_file(options.algo, options.conf_file), name)
        entry = {**zoo.read_entry(*place), **entry}
    if options.track is not None:
        entry["env_kwargs"] = {**(entry.get("env_kwargs") or {}), "track": options.track}
    changed = {**entry, **_changes(options.zoo_args)}
    zoo.check_entry(changed, options.algo, options.env, place, trust=options.trust)
    for each in (entry, changed):  # of which the zoo and we write records
        if each.get("env_kwargs"):
            each["env_kwargs"] = lasting_kwargs(each["env_kwargs"])
    return entry, {**changed, "env_kwargs": changed.get("env_kwargs") or {}}, place


def _changes(zoo_args: Sequence[str]) -> dict[str, Any]:
    """Read the changes that the zoo will make to an entry by its arguments, and refuse others."""
    from rl_zoo3.utils import StoreDict

    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    parser.add_argument(*CHANGES, nargs="+", action=StoreDict, default={})
    parser.add_argument("--env-kwargs", nargs="+", action=StoreDict)
    parser.add_argument("--n-eval-envs", type=int, default=1)
    for names in PLACES:
        parser.add_argument(*names, nargs="?", const="", dest=names[-1])
    try:
        known, _ = parser.parse_known_args(zoo_args)
    except Exception as error:  # values are evaluated, which can raise anything
        raise InvalidOption(
            f"'{shlex.join(zoo_args)}' cannot be read ({error}); values are Python, e.g. "
            "--hyperparams gamma:0.98 \"learning_rate:'lin_0.001'\""
        ) from error
    for *_, name in PLACES:
        if vars(known)[name] is not None:
            raise InvalidOption(
                f"'{name}' after -- is refused: sb3-torcs would not find the model; before -- "
                "there are --algo, --env, --timesteps, --folder and --conf-file"
            )
    if known.n_eval_envs < 1:
        raise InvalidOption(f"--n-eval-envs is {known.n_eval_envs}; expected at least 1")
    for key in ("callback", "env_wrapper"):
        if key in known.hyperparams:  # the zoo would drop ours, such as the progress bar
            raise InvalidOption(
                f"'{key}' after -- is refused; write it into a file, and give --conf-file FILE.yml"
            )
    if known.env_kwargs is None:
        return dict(known.hyperparams)
    return {**known.hyperparams, "env_kwargs": known.env_kwargs}


def _check_resumed(
    options: TrainOptions,
    resume: Path,
    entry: dict[str, Any],
    env: Any,
    changed: Mapping[str, Any],
) -> None:
    """
    Check the model to resume. With its replay buffer it needs only what is left of a warm-up.

    :param options: what to train
    :param resume: the model
    :param entry: its hyperparameters; is adapted
    :param env: one of those to train in
    :param changed: the entry after the changes of the zoo's arguments
    """
    from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

    from sb3_torcs.agents.models import saved_timesteps
    from sb3_torcs.agents.saved.algorithm import algorithm_class
    from sb3_torcs.agents.saved.record import BEST_MODEL
    from sb3_torcs.training.keeping import REPLAY_BUFFER
    from sb3_torcs.training.resuming import check_resumable

    buffer = check_resumable(resume, env, options.algo, changed, trust=options.trust)
    if "learning_starts" in entry and buffer:
        left = int(entry["learning_starts"]) - saved_timesteps(resume)
        entry["learning_starts"] = max(left, 0)
    replays = issubclass(algorithm_class(options.algo), OffPolicyAlgorithm)
    if replays and not buffer:
        _tell(f"there is no {REPLAY_BUFFER} beside '{resume}': the training fills an empty one")
    if resume.name == BEST_MODEL and Path(str(options.resume)).expanduser().is_dir():
        _tell(f"'{options.resume}' has no last model; going on from the best one")
    if "n_steps" in entry and replays:
        # SB3 chooses the class of the replay buffer as before; given its own choice, it would warn.
        entry.setdefault("replay_buffer_class", None)


def _tell(sentence: str) -> None:
    sys.stderr.write(f"sb3-torcs: {sentence}\n")


def _rollout(algo: str, entry: Mapping[str, Any]) -> int:
    """Return the timesteps between two updates of an algorithm without a replay buffer, else 0."""
    from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

    from sb3_torcs.agents.saved.algorithm import algorithm_class

    kind = algorithm_class(algo)
    if not issubclass(kind, OnPolicyAlgorithm):
        return 0
    usual = inspect.signature(kind).parameters["n_steps"].default
    return int(entry.get("n_steps", usual)) * int(entry.get("n_envs", 1))


def _zoo_words(options: TrainOptions, wanted: int, entry: Mapping[str, Any]) -> list[str]:
    """Compose the zoo's command line, files and folders aside."""
    from sb3_torcs.training import zoo

    env_kwargs = entry["env_kwargs"]
    eval_freq = options.eval_freq
    if eval_freq is None:
        shortest = min(wanted, SHORTEST_EVAL_FREQ)
        # Within a rollout the policy does not change.
        eval_freq = max(wanted // EVALUATIONS, shortest, _rollout(options.algo, entry))
    words = ["--n-timesteps", str(wanted), "--seed", str(options.seed)]
    words += ["--eval-freq", str(eval_freq), "--eval-episodes", str(options.eval_episodes)]
    words += ["--num-threads", "1", "--device", "cpu", "--verbose", "0", "--save-replay-buffer"]
    # Evaluations start on the grid and have time for a whole race, unlike the training's episodes.
    mine = ("start", zoo.TIME_LIMIT)
    evaluation = {name: value for name, value in env_kwargs.items() if name not in mine}
    if evaluation:
        # The zoo does not give the file's env_kwargs to the evaluation's environment.
        words += ["--eval-env-kwargs", *(f"{name}:{value!r}" for name, value in evaluation.items())]
    return words


def _with_display(options: TrainOptions, callbacks: Any) -> list[Any]:
    """
    Add the pictures, and in front the progress bar: the zoo ends its first callback on Ctrl-C.

    :param options: what to train
    :param callbacks: of the entry, in any of the zoo's forms
    :return: as a list
    """
    items = listed(callbacks)
    if options.pictures is not None:
        items.append({PICTURES: {"folder": str(writable_folder(options.pictures))}})
    if not options.progress:
        return items
    return [PROGRESS, *(item for item in items if item != PROGRESS)]


def _run_zoo(
    options: TrainOptions,
    words: list[str],
    entry: dict[str, Any],
    wanted: int,
    env_kwargs: Mapping[str, Any],
) -> Run:
    """
    Run the zoo's own training in this process.

    :param options: what to train
    :param words: of the zoo's command line
    :param entry: of the hyperparameter file
    :param wanted: timesteps to learn from
    :param env_kwargs: of its environments
    """
    from sb3_torcs.callbacks.display import Unbroken
    from sb3_torcs.training import manager as zoo_training
    from sb3_torcs.training.keeping import SAVING

    managers: list[Manager] = []
    # `tee` may end at Ctrl-C, before the zoo prints that it saves the model.
    out, err = Unbroken(sys.stdout), Unbroken(sys.stderr)
    redirected = contextlib.redirect_stdout(out), contextlib.redirect_stderr(err)
    try:
        with redirected[0], redirected[1], counted_interrupts(2, SAVING) as seen:
            zoo_training.train(options.algo, options.env, entry, words, managers, seen)
    except (OSError, WorkerLost, TrainingDiverged) as error:
        if not managers:
            raise
        raise _told(error, _result(managers[0], wanted, env_kwargs, None), options) from error
    return _result(managers[0], wanted, env_kwargs, seen[0] if seen else None)


def _result(
    manager: Manager, wanted: int, env_kwargs: Mapping[str, Any], signal: int | None
) -> Run:
    """Read the result of a training from its folder."""
    from sb3_torcs.agents.models import saved_timesteps

    if manager.optimize_hyperparameters:
        return Run(Path(manager.log_path), 0, wanted, signal, None, env_kwargs)
    folder = Path(manager.save_path)
    last_model = folder / f"{manager.env_name}.zip"
    timesteps = saved_timesteps(last_model) if last_model.is_file() else 0
    return Run(folder, timesteps, wanted, signal, last_model, env_kwargs)


def _told(
    error: OSError | WorkerLost | TrainingDiverged, result: Run, options: TrainOptions
) -> Exception:
    """Compose a message: why a training ended, what is saved, and what to type."""
    from sb3_torcs.agents.models import saved_timesteps

    why, kind = str(error), type(error)
    if isinstance(error, TrainingDiverged):
        remedy = "lower the learning_rate"
    elif isinstance(error, WorkerLost):
        remedy = "see above why"
    else:
        why = f"cannot write '{error.filename or result.folder}': {error.strerror or error}"
        kind, remedy = OutputNotWritable, "make room, or choose another folder"
    # A later file may have had no room.
    if not result.timesteps and (best := result.best_model) is not None and best.is_file():
        result = dataclasses.replace(result, last_model=best, timesteps=saved_timesteps(best))
    if result.timesteps >= result.wanted:
        learned = f"kept: '{result.last_model}', which has learned from all timesteps"
        return kind(f"{why}; {learned}; see it: sb3-torcs evaluate '{result.best_model}'")
    if result.timesteps > 0:
        kept = f"kept: '{result.last_model}', {result.timesteps} of {result.wanted} timesteps"
        if kind is TrainingDiverged:  # the command goes on with the recorded one
            remedy += " (add: -- --hyperparams learning_rate:NUMBER)"
        return kind(f"{why}; {kept}; {remedy}, and go on with: {going_on(options, result)}")
    return kind(f"{why}; nothing was kept yet; {remedy}, and start again")


def going_on(options: TrainOptions, result: Run) -> str:
    """
    Compose the command that continues a training.

    What the model's record holds is left out: given again, it would count instead of what is left,
    and a learning rate that falls over the training would begin anew.

    :param options: of the training
    :param result: how far it came
    """
    from sb3_torcs.agents.models import training_record

    left = result.wanted - result.timesteps
    after = dataclasses.replace(options, resume=result.last_model, timesteps=left)
    if result.last_model is not None and result.last_model.is_file():
        record = training_record(result.last_model)
        if record.env_id == options.env and "policy" in record.hyperparameters:
            words = _without_recorded(options.zoo_args, record.hyperparameters)
            after = dataclasses.replace(after, entry=None, conf_file=None, zoo_args=words)
    return _command(after)


def _without_recorded(
    zoo_args: Sequence[str], hyperparameters: Mapping[str, Any]
) -> tuple[str, ...]:
    """Leave out the changes of an entry that a record holds; it holds no classes, for one."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument(*CHANGES, nargs="+", default=[])
    known, words = parser.parse_known_args(zoo_args)
    missing = object()
    unknown = {
        key
        for key, value in _changes(zoo_args).items()
        if hyperparameters.get(key, missing) != value
    }
    kept = [word for word in known.hyperparams if word.partition(":")[0] in unknown]
    return (*words, *(["--hyperparams", *kept] if kept else []))


def _command(options: TrainOptions) -> str:
    """Compose the command with these options."""
    words = ["sb3-torcs", "train"]
    for field in dataclasses.fields(options):
        value = getattr(options, field.name)
        if field.name == "zoo_args" or (value == field.default and field.name != "seed"):
            continue
        option = field.name.replace("_", "-")
        if isinstance(value, bool):
            words.append(f"--{option}" if value else f"--no-{option}")
        else:
            words += [f"--{option}", str(value)]
    return shlex.join([*words, *(["--", *options.zoo_args] if options.zoo_args else [])])
