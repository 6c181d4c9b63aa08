"""``sb3-torcs train``: train an agent by an entry of a hyperparameter file."""

from __future__ import annotations

import argparse
import dataclasses
import shlex
from typing import TYPE_CHECKING, Any

from sb3_torcs.cli.common import positive, seed, setting
from sb3_torcs.signals import EXIT_STATUS

if TYPE_CHECKING:
    from sb3_torcs.training.run import Run, TrainOptions

__all__ = ["add_parser", "run"]

EPILOG = """\
Values are YAML:
  sb3-torcs train --hyperparams batch_size=128 learning_rate=lin_0.001
  sb3-torcs train --env-kwargs track=forza sensors=[base,line]

Ctrl-C saves the model and prints the command that continues the training. A kill or a full disk
loses at most what was learned since the last evaluation. TensorBoard shows the training while it
runs: tensorboard --logdir logs/tensorboard
"""


def add_parser(subparsers: Any) -> None:
    """
    :param subparsers: of the command
    """
    parser = subparsers.add_parser(
        "train",
        help="train an agent by the shipped hyperparameters or your own",
        description="Train an agent by an entry of a hyperparameter file, which is checked before "
        "anything starts.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add(
        "--algo",
        help="ddpg (default), td3, sac, a2c or ppo; with SBX also sbx_sac; others of the zoo with "
        "a --conf-file",
    )
    add("--env", metavar="ID", help="Torcs-v0 (default), or TorcsLite-v0, which needs no game")
    add("--entry", metavar="NAME", help='block of the hyperparameter file, e.g. "as the post"; '
        "default: the one called as --env")  # fmt: skip
    add("--conf-file", metavar="FILE", help="hyperparameter file; default: the shipped one")
    add("--track", metavar="T", help="track; default: the entry's; `sb3-torcs tracks` lists them")
    add(
        "--hyperparams",
        nargs="+",
        type=setting,
        default=(),
        metavar="NAME=VALUE",
        help="values that replace those of the entry",
    )
    add(
        "--env-kwargs",
        nargs="+",
        type=setting,
        default=(),
        metavar="NAME=VALUE",
        help="arguments of the environment that replace those of the entry",
    )
    add(
        "--timesteps",
        type=positive,
        metavar="N",
        help="timesteps to learn from; default: the entry's",
    )
    add("--seed", type=seed, default=0, metavar="S", help="default: 0")
    add("--folder", default="logs", help="folder of models and logs; default: logs")
    add("--tensorboard", metavar="DIR", help="default: FOLDER/tensorboard")
    add(
        "--eval-freq",
        type=int,
        metavar="N",
        help="timesteps between evaluations, 0 for none; default: a fortieth of --timesteps, and "
        "at least a rollout of PPO",
    )
    add(
        "--eval-episodes",
        type=positive,
        default=1,
        metavar="N",
        help="races per track and evaluation; default: 1",
    )
    add(
        "--resume",
        metavar="MODEL",
        help="continue from a saved model (.zip) or a run's folder, with its own hyperparameters, "
        "track and timesteps that are left, unless you give others; runs code that is pickled in "
        "model and replay buffer: only if you trust their author",
    )
    add(
        "--trust",
        action="store_true",
        help="resume a model without a record: only if you trust its author",
    )
    add("--progress", action=argparse.BooleanOptionalAction, default=True, help="progress bar")
    add("--pictures", metavar="DIR", help="draw the line of an evaluation lap about once a minute")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """
    :param args: from the command line
    :return: the exit status
    """
    from sb3_torcs.training.run import TrainOptions, train_run

    values = {field.name: getattr(args, field.name) for field in dataclasses.fields(TrainOptions)}
    settings = {name: dict(values[name]) for name in ("hyperparams", "env_kwargs")}
    options = TrainOptions(**{**values, **settings, **_trained_before(args)})
    result = train_run(options)
    print("\n".join(_closing_words(options, result)))
    return 0 if result.signal is None else EXIT_STATUS + result.signal


def _trained_before(args: argparse.Namespace) -> dict[str, str]:
    """Take algorithm and environment from the model to resume, unless they are given."""
    from sb3_torcs.agents.models import TrainingRecord, find_model, training_record
    from sb3_torcs.training.run import TrainOptions

    record = TrainingRecord()
    if args.resume is not None:
        record = training_record(find_model(args.resume, prefer_last=True))
    return {
        "algo": args.algo or record.algo or TrainOptions.algo,
        "env": args.env or record.env_id or TrainOptions.env,
    }


def _closing_words(options: TrainOptions, result: Run) -> list[str]:
    """Name the files and the commands to type next."""
    from sb3_torcs.agents.saved.algorithm import SBX
    from sb3_torcs.training.run import continuing_command

    learned = f"learned from {result.timesteps} of {result.wanted} timesteps"
    lines = [f"{learned}; folder: {result.folder}"]
    evaluated = result.best_model != result.last_model
    lines += [f"best model by evaluation: {result.best_model}"] if evaluated else []
    lines += [f"last model: {result.last_model}"]
    if options.resume is not None:
        lines += [f"before that, which may be better still: {options.resume}"]
    if result.timesteps < result.wanted:
        lines += ["go on with:", f"  {continuing_command(options, result)}"]
    words = ["sb3-torcs", "evaluate", str(result.best_model), "--env", options.env]
    track, car = (result.env_kwargs.get(name) for name in ("track", "car"))
    if track:
        words += ["--track", track[0] if isinstance(track, list) else track]
    words += ["--car", car[0]] if isinstance(car, list) else []  # evaluate drives one of them
    words += ["--trust"] if options.algo.startswith(SBX) else []  # whose models are pickled
    lines += ["see what it learned:", f"  {shlex.join(words)}"]
    return lines
